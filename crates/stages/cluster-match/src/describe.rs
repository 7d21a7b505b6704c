//! What is known of each instance: size, place, support, language.

use artifacts::{Extents, Instances, MaskFeatures, Match, Witness, flat};
use ndarray::{Array2, aview1};
use std::collections::{BTreeMap, BTreeSet};

/// Gathers what is known of the instances but their descriptors. `labels` are those of all Gaussians, numbered 0 to K - 1 or -1. Scores
/// are zero; views, tree and nodes are left empty.
pub fn gather(means: &[[f32; 3]], labels: Vec<i32>, instances: usize, mut matches: Vec<Match>) -> Instances {
    let Extents { count, centroid, bbox_min, bbox_max, oriented } = Extents::of(means, &labels, instances);
    let mut support = vec![0; instances];
    matches.iter().for_each(|m| support[m.instance as usize] += 1);
    matches.sort_by_key(|m| (m.instance, m.view));
    Instances {
        label: labels,
        descriptor: Array2::zeros((instances, 0)),
        support,
        score: vec![0.0; instances],
        count,
        centroid,
        bbox_min,
        bbox_max,
        oriented,
        matches,
        ..Instances::default()
    }
}

/// A mask that somebody reads already is taken in place of one that fits up to so much better: 1 is as well.
const NEARLY: f64 = 0.9;

/// Chooses the masks that say what instances and granules mean, so that few masks are read: encoding them takes most of the time.
#[derive(Default)]
pub struct Witnesses {
    /// View and mask of all that were chosen.
    read: BTreeSet<(u32, u32)>,
}

impl Witnesses {
    /// The masks of each instance: of its matches the `most` of the highest score, 0 for all (paper). They count alike.
    pub fn of_instances(&mut self, matches: &[Match], most: usize) -> Vec<Witness> {
        let of_one = |own: &[Match]| {
            let witness = |m: &Match| Witness { of: m.instance, view: m.view, mask: m.mask, weight: 1.0 };
            self.choose(own.iter().map(|m| (f64::from(m.score), witness(m))), most)
        };
        matches.chunk_by(|a, b| a.instance == b.instance).flat_map(of_one).collect()
    }

    /// The `most` witnesses of one instance or granule that fit best, in their order; 0 for all. Of those that fit nearly as well as
    /// the last of these, ones that are read already come first.
    pub(crate) fn choose(&mut self, own: impl Iterator<Item = (f64, Witness)>, most: usize) -> Vec<Witness> {
        let mut own: Vec<(usize, f64, Witness)> = own.enumerate().map(|(i, (fit, w))| (i, fit, w)).collect();
        if most > 0 && own.len() > most {
            // Of equals the first: the sorts are stable.
            own.sort_by(|a, b| b.1.total_cmp(&a.1));
            let least = NEARLY * own[most - 1].1;
            let costs = |(_, fit, w): &(usize, f64, Witness)| *fit < least || !self.read.contains(&(w.view, w.mask));
            own.sort_by_key(costs);
            own.truncate(most);
            own.sort_by_key(|(i, ..)| *i);
        }
        self.read.extend(own.iter().map(|(.., w)| (w.view, w.mask)));
        own.into_iter().map(|(.., w)| w).collect()
    }
}

/// A descriptor for each of `count` instances or granules, `[count][dim]`: the mean of the unit features of its masks, each with its
/// weight, at unit length (paper). `features` are those of masks by view index; zero where none of the masks has one.
pub fn descriptors(count: usize, witnesses: &[Witness], features: &BTreeMap<u32, MaskFeatures>) -> Array2<f32> {
    let dim = features.values().map(MaskFeatures::dim).next().unwrap_or(0);
    let mut all = Array2::zeros((count, dim));
    for own in witnesses.chunk_by(|a, b| a.of == b.of) {
        let feature = |w: &Witness| Some((w.weight, flat(features.get(&w.view)?.row(w.mask as usize)?)));
        all.row_mut(own[0].of as usize).assign(&aview1(&mean_of_units(own.iter().filter_map(feature), dim)));
    }
    all
}

/// The weighted mean of the rows, each at unit length, at unit length; zero where there is none.
fn mean_of_units<'a>(rows: impl Iterator<Item = (f64, &'a [f32])>, dim: usize) -> Vec<f32> {
    let mut sum = vec![0.0f64; dim];
    for (weight, row) in rows.filter_map(|(weight, row)| Some((weight, unit(row)?))) {
        sum.iter_mut().zip(row).for_each(|(s, v)| *s += weight * f64::from(v));
    }
    let sum: Vec<f32> = sum.into_iter().map(|v| v as f32).collect();
    unit(&sum).unwrap_or(sum)
}

fn unit(row: &[f32]) -> Option<Vec<f32>> {
    let norm = row.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
    (norm > 1e-12).then(|| row.iter().map(|v| (f64::from(*v) / norm) as f32).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::arr2;

    #[test]
    fn descriptors_are_unit_means_and_boxes_hold_their_gaussians() {
        let means = [[0.0, 0.0, 0.0], [2.0, 1.0, 0.0], [9.0; 3]];
        let f = MaskFeatures { values: arr2(&[[3.0, 0.0], [0.0, 1.0]]) };
        let features = BTreeMap::from([(0, f.clone()), (1, f)]);
        let m = |view, mask, score| Match { instance: 0, view, mask, score, visible: 1.0 };
        let i = gather(&means, vec![0, 0, -1], 2, vec![m(1, 1, 0.2), m(0, 0, 0.8)]);
        assert_eq!((i.count[0], i.count[1], i.support[0], i.support[1]), (2, 0, 2, 0));
        assert_eq!((i.centroid[0], i.bbox_max[0]), ([1.0, 0.5, 0.0], [2.0, 1.0, 0.0]));
        assert_eq!(i.matches[0].view, 0);
        let of = |most| descriptors(2, &Witnesses::default().of_instances(&i.matches, most), &features);
        assert!((of(0)[[0, 0]] - 0.5f32.sqrt()).abs() < 1e-6);
        assert_eq!(of(0).row(1), aview1(&[0.0, 0.0]));
        assert_eq!(of(1).row(0), aview1(&[1.0, 0.0]), "the match that fits best");
        assert_eq!(of(2), of(0));
    }

    #[test]
    fn the_best_keep_their_order_and_what_is_read_already_comes_first() {
        let own = |fits: &[f64]| -> Vec<(f64, Witness)> {
            let of = |(i, &fit): (usize, &f64)| (fit, Witness { of: 0, view: i as u32, mask: 7, weight: 1.0 });
            fits.iter().enumerate().map(of).collect()
        };
        let views = |read: &[(u32, u32)], fits: &[f64], most| {
            let mut w = Witnesses { read: read.iter().copied().collect() };
            w.choose(own(fits).into_iter(), most).iter().map(|w| w.view).collect::<Vec<_>>()
        };
        let fits = [0.5, 0.9, 0.5, 0.7];
        assert_eq!(views(&[], &fits, 3), [0, 1, 3], "of equals the first");
        assert_eq!(views(&[], &fits, 9), [0, 1, 2, 3]);
        assert_eq!(views(&[], &fits, 0), [0, 1, 2, 3]);
        assert_eq!(views(&[(2, 7)], &fits, 3), [1, 2, 3], "as good, and read already");
        assert_eq!(views(&[(2, 8)], &fits, 3), [0, 1, 3], "another mask");
        assert_eq!(views(&[(0, 7)], &fits, 2), [1, 3], "far from as good");
    }
}
