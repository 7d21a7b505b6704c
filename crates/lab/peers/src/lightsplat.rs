//! LightSplat (Bang et al., CVPR 2026, arXiv 2603.24146): masks of all views that hold the same Gaussians and look alike are one object.
//! The authors' code is not public.
//!
//! Known are the steps: a mask holds the Gaussians that it shows with enough blending weight; masks of few Gaussians are dropped; two masks are
//! linked where the IoU of their Gaussians and the cosine of their features pass; an object is a connected component of the links. The thresholds
//! were not in what we could read: they are options. Here a Gaussian of several objects goes to the one whose masks give it most weight, and
//! an object has two masks or more. Without mask features the IoU alone links.

use crate::cli::Peer;
use crate::product::{Grouping, Product};
use crate::union::root;
use crate::world::{Inputs, World};
use gs_io::Result;
use rayon::prelude::*;
use serde::Serialize;
use stage::Stage;
use std::collections::BTreeMap;

/// Least IoU of an object with a mask that describes it.
const LEAST_IOU: f32 = 0.2;
/// Fewest Gaussians of a mask.
const LEAST_GAUSSIANS: usize = 20;

/// Settings.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct Options {
    #[command(flatten)]
    #[serde(flatten)]
    inputs: Inputs,
    /// Blending weight, summed over a mask's pixels, from which a Gaussian is in the mask
    #[arg(long, value_name = "PIXELS", default_value_t = 0.5, value_parser = stage::at_least(0.0f32))]
    weight: f32,
    /// Least IoU of the Gaussians of two linked masks, 0 to 1
    #[arg(long, value_name = "SHARE", default_value_t = 0.5, value_parser = stage::within(0.0..=1.0f64))]
    iou: f64,
    /// Least cosine of the features of two linked masks, -1 to 1
    #[arg(long, value_name = "COSINE", default_value_t = 0.8, value_parser = stage::within(-1.0..=1.0f32))]
    cosine: f32,
}

impl Peer for Options {
    fn inputs(&self) -> &Inputs {
        &self.inputs
    }

    fn make(&self, world: &World, stage: &Stage) -> Result<Product> {
        let footprints = &world.footprints;
        let (mut rows, mut sets) = (Vec::new(), Vec::new());
        for r in world.rows() {
            let entries = footprints.entries(r as usize)?;
            let set: Vec<(u32, f32)> = entries.iter().filter(|e| e.1 >= self.weight).collect();
            if set.len() >= LEAST_GAUSSIANS {
                rows.push(r);
                sets.push(set);
            }
        }
        let feature = |m: u32| world.feature(&footprints.rows[rows[m as usize] as usize]);
        let alike = |a: u32, b: u32| match (feature(a), feature(b)) {
            (Some(a), Some(b)) => a.iter().zip(b).map(|(x, y)| x * y).sum::<f32>() >= self.cosine,
            _ => world.dim() == 0,
        };
        let members: Vec<Vec<u32>> = sets.iter().map(|s| s.iter().map(|e| e.0).collect()).collect();
        let objects = components(&members, world.kept(), self.iou, alike);
        let (labels, instances) = labels(&sets, &objects, world.kept());
        stage.info(&format!("{} masks, {instances} objects", sets.len()));
        let labels = world.spread(&labels);
        let matches = world.matches(&labels, LEAST_IOU)?;
        Ok(Product::Instances(Grouping { labels, instances, matches, ..Grouping::default() }))
    }
}

/// A mask of the component of each mask, the same for all of one. Masks are linked from an IoU of `least` on if they are `alike`; each is the set
/// of its Gaussians, of `n`.
fn components(masks: &[Vec<u32>], n: usize, least: f64, alike: impl Fn(u32, u32) -> bool + Sync) -> Vec<u32> {
    let mut holding: Vec<Vec<u32>> = vec![Vec::new(); n];
    for (m, mask) in (0..).zip(masks) {
        mask.iter().for_each(|&i| holding[i as usize].push(m));
    }
    let links = (0..masks.len() as u32).into_par_iter().flat_map_iter(|a| {
        let mine = &masks[a as usize];
        let mut common = BTreeMap::<u32, usize>::new();
        for &i in mine {
            let before = holding[i as usize].iter().take_while(|&&b| b < a);
            before.for_each(|&b| *common.entry(b).or_default() += 1);
        }
        let union = |b: u32, both: usize| mine.len() + masks[b as usize].len() - both;
        let linked =
            common.into_iter().filter(|&(b, both)| both as f64 >= least * union(b, both) as f64 && alike(a, b));
        linked.map(move |(b, _)| (a, b)).collect::<Vec<_>>()
    });
    let links: Vec<(u32, u32)> = links.collect();
    let mut above: Vec<u32> = (0..masks.len() as u32).collect();
    for (a, b) in links {
        let (a, b) = (root(&mut above, a), root(&mut above, b));
        above[a.max(b) as usize] = a.min(b);
    }
    (0..masks.len() as u32).map(|m| root(&mut above, m)).collect()
}

/// The object of each of `n` Gaussians, -1 for none, and the number of objects: components of two masks or more that keep a Gaussian.
fn labels(masks: &[Vec<(u32, f32)>], component: &[u32], n: usize) -> (Vec<i32>, usize) {
    let mut sizes = vec![0; masks.len()];
    component.iter().for_each(|&c| sizes[c as usize] += 1);
    let mut weights: Vec<BTreeMap<u32, f64>> = vec![BTreeMap::new(); n];
    for (mask, &c) in masks.iter().zip(component).filter(|(_, c)| sizes[**c as usize] > 1) {
        mask.iter().for_each(|&(i, w)| *weights[i as usize].entry(c).or_default() += f64::from(w));
    }
    // Of equals the first.
    let most = |of: &BTreeMap<u32, f64>| of.iter().rev().max_by(|a, b| a.1.total_cmp(b.1)).map(|(&c, _)| c);
    let chosen: Vec<Option<u32>> = weights.iter().map(most).collect();
    let mut number = BTreeMap::new();
    chosen.iter().flatten().for_each(|&c| _ = number.insert(c, 0));
    number.values_mut().zip(0..).for_each(|(n, k)| *n = k);
    (chosen.iter().map(|c| c.map_or(-1, |c| number[&c])).collect(), number.len())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn masks_are_linked_in_chains_where_they_overlap_and_look_alike() {
        // 0 and 1 share three of five, 1 and 2 three of five, 0 and 2 one of seven; 3 is as 0 but looks different.
        let masks = [vec![0, 1, 2, 3], vec![1, 2, 3, 4], vec![2, 3, 4, 5], vec![0, 1, 2, 3], vec![6, 7]];
        let alike = |a: u32, b: u32| a != 3 && b != 3;
        assert_eq!(components(&masks, 8, 0.6, alike), [0, 0, 0, 3, 4]);
        assert_eq!(components(&masks, 8, 0.6, |_, _| true), [0, 0, 0, 0, 4]);
        assert_eq!(components(&masks, 8, 0.7, alike), [0, 1, 2, 3, 4]);
    }

    #[test]
    fn a_gaussian_goes_to_the_object_that_gives_it_most_weight() {
        let masks = [
            vec![(0, 1.0), (1, 1.0)],
            vec![(0, 1.0), (1, 0.5)],
            vec![(1, 1.0), (2, 1.0)],
            vec![(1, 1.0)],
            vec![(3, 9.0)],
        ];
        assert_eq!(labels(&masks, &[0, 0, 2, 2, 4], 5), (vec![0, 1, 1, -1, -1], 2));
    }
}
