//! Which part, thing or group a feature means.

use crate::ranking::{Question, norm};
use artifacts::{Granule, Instances, Members, flat};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// How much it counts that the masks show a granule as one, beside how well it suits the feature: the best score of all is one unit
/// above the mean of all. 0.3 to 1 give nearly the same on synthetic scenes (docs/results/queries.md).
const FIT: f64 = 0.6;
/// What scores at least this on that scale is meant, too, ...
const NEARLY: f64 = 0.8;
/// ... where at most this share of it is selected already.
const AGAIN: f64 = 0.1;
/// A granule is a part of an instance when at least this share of it lies in the instance, of which it is at most [`PART`].
const INSIDE: f64 = 0.8;
/// See [`INSIDE`].
const PART: f64 = 0.6;

/// Granules laid out for many queries.
pub struct Granules<'a> {
    instances: &'a Instances,
    lengths: Vec<f64>,
}

/// What a granule is beside the instances.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Kind {
    /// A part of an instance.
    Part,
    /// An instance, more or less.
    Thing,
    /// Several instances, or pieces of several.
    Group,
}

/// The granule that answers a query.
#[derive(Debug, Clone, PartialEq)]
pub struct Meant {
    /// Its index.
    pub granule: u32,
    /// What it is.
    pub kind: Kind,
    /// Its score with the feature: cosine or relevancy, as of instances.
    pub score: f32,
    /// The instances of which at least half is in it, those with most Gaussians in it first; of a part the instance that holds most of it.
    /// Then those of what is meant with it.
    pub instances: Vec<u32>,
    /// Its Gaussians and those of what is meant with it, ascending.
    pub gaussians: Vec<u32>,
}

impl<'a> Granules<'a> {
    /// Lays out the granules of these instances.
    pub fn new(instances: &'a Instances) -> Self {
        let lengths = instances.granule_descriptor.rows().into_iter().map(flat).map(norm).collect();
        Self { instances, lengths }
    }

    /// The granule that a feature means, of those that masks show in at least `min_support` views: the one with the highest sum of its
    /// score, on a scale on which the mean of all is 0 and the best 1, and of its fit with masks, which counts 0.6. A part and the
    /// whole often score the same, and then the masks tell. "Plate" may mean several: what scores nearly as well elsewhere is selected
    /// with it. None where none has a score.
    pub fn meant(&self, feature: &[f32], negatives: &[Vec<f32>], min_support: u32) -> Option<Meant> {
        let granules = &self.instances.granules;
        let scores = self.scores(feature, negatives, min_support);
        let mean = scores.iter().map(|s| f64::from(s.1)).sum::<f64>() / scores.len().max(1) as f64;
        let above = scores.iter().map(|s| f64::from(s.1)).fold(mean, f64::max) - mean;
        let scaled = |score: f32| if above > 0.0 { (f64::from(score) - mean) / above } else { 0.0 };
        let rank = |&(q, score): &(usize, f32)| scaled(score) + FIT * f64::from(granules[q].fit);
        // Of equals the first.
        let best = scores.iter().map(|s| (s, rank(s))).reduce(|a, b| if b.1 > a.1 { b } else { a });
        let mut meant = best.map(|(&(q, score), _)| self.meaning(q as u32, score))?;
        let mut more: Vec<&(usize, f32)> = scores.iter().filter(|s| scaled(s.1) >= NEARLY).collect();
        more.sort_by(|a, b| rank(b).total_cmp(&rank(a)).then(a.0.cmp(&b.0)));
        for &&(q, score) in &more {
            let other = self.meaning(q as u32, score);
            let again = other.gaussians.iter().filter(|i| meant.gaussians.binary_search(i).is_ok()).count();
            if again as f64 <= AGAIN * other.gaussians.len() as f64 {
                meant.gaussians.extend(other.gaussians);
                meant.gaussians.sort_unstable();
                meant.gaussians.dedup();
                let new: Vec<u32> = other.instances.into_iter().filter(|k| !meant.instances.contains(k)).collect();
                meant.instances.extend(new);
            }
        }
        Some(meant)
    }

    /// Granules that masks show in enough views, each with its score as of instances.
    pub(crate) fn scores(&self, feature: &[f32], negatives: &[Vec<f32>], min_support: u32) -> Vec<(usize, f32)> {
        let Instances { granules, granule_descriptor, .. } = self.instances;
        let question = Question::new(feature, negatives);
        let descriptors = granule_descriptor.rows().into_iter().zip(&self.lengths).enumerate();
        let enough = descriptors.filter(|&(q, _)| granules[q].support >= min_support);
        enough.filter_map(|(q, (d, &length))| Some((q, question.score(flat(d), length)?))).collect()
    }

    fn meaning(&self, granule: u32, score: f32) -> Meant {
        let found: &Granule = &self.instances.granules[granule as usize];
        let gaussians = found.gaussians(self.instances);
        let mut inside = vec![0usize; self.instances.len()];
        for &i in &gaussians {
            if let Ok(k) = usize::try_from(self.instances.label[i as usize]) {
                inside[k] += 1;
            }
        }
        let mut most: Vec<usize> = (0..inside.len()).filter(|&k| inside[k] > 0).collect();
        most.sort_by_key(|&k| std::cmp::Reverse(inside[k]));
        let of_instance = |k: usize| inside[k] as f64 / f64::from(self.instances.count[k].max(1));
        let kind = match (found.members, most.first()) {
            (Members::Instance(_), _) | (_, None) => Kind::Thing,
            (_, Some(&k)) if (inside[k] as f64) < INSIDE * gaussians.len() as f64 => Kind::Group,
            (_, Some(&k)) if of_instance(k) <= PART => Kind::Part,
            _ => Kind::Thing,
        };
        let mut instances: Vec<u32> = most.iter().filter(|&&k| of_instance(k) >= 0.5).map(|&k| k as u32).collect();
        if instances.is_empty() || kind == Kind::Part {
            instances = most.first().map(|&k| k as u32).into_iter().collect();
        }
        Meant { granule, kind, score, instances, gaussians }
    }
}

/// A proposal is the same as one that fits better when their IoU is this or more.
pub const SAME: f64 = 0.3;

/// Of proposals that may overlap, each a fit and a set of numbers below `count`, those whose IoU with every kept one that fits better is
/// below `same`: their indices, best fit first; of equals the first.
pub fn different(proposals: &[(f32, Vec<u32>)], count: usize, same: f64) -> Vec<usize> {
    let mut order: Vec<usize> = (0..proposals.len()).collect();
    order.sort_by(|&a, &b| proposals[b].0.total_cmp(&proposals[a].0));
    // The kept ones that hold each number, and how much of each is in the one at hand.
    let mut holds: Vec<Vec<usize>> = vec![Vec::new(); count];
    order.retain(|&k| {
        let own = &proposals[k].1;
        let mut common = BTreeMap::new();
        own.iter().flat_map(|&i| &holds[i as usize]).for_each(|&other| *common.entry(other).or_insert(0usize) += 1);
        let union = |(other, both): (&usize, &usize)| (own.len() + proposals[*other].1.len() - both) as f64;
        let differs = common.iter().all(|(other, both)| (*both as f64) < same * union((other, both)));
        own.iter().filter(|_| differs).for_each(|&i| holds[i as usize].push(k));
        differs
    });
    order
}

#[cfg(test)]
mod tests {
    use super::*;
    use artifacts::TreeEdge;
    use ndarray::arr2;

    /// A set of cup 0 (Gaussians 0 to 3, a handle 2, 3 of its own) and spoon 1 (Gaussians 4 to 6), and instance 2, a book (7).
    fn scene() -> Instances {
        let edge = |parent, child, instance| TreeEdge { parent, child, lambda: 1.0, size: 2, instance };
        let granule = |members, support, fit| Granule { members, support, fit };
        let u = 0.5f32.sqrt();
        Instances {
            label: vec![0, 0, 0, 0, 1, 1, 1, 2],
            node: vec![11, 11, 13, 13, 12, 12, 12, 14],
            tree: vec![edge(9, 10, -1), edge(9, 14, 2), edge(10, 11, 0), edge(10, 12, 1), edge(11, 13, -1)],
            count: vec![4, 3, 1],
            granules: vec![
                granule(Members::Instance(0), 5, 0.9),
                granule(Members::Cluster(13), 3, 0.8),
                granule(Members::Cluster(10), 4, 0.9),
                granule(Members::Instance(1), 5, 0.5),
                granule(Members::Cluster(12), 1, 0.5),
            ],
            granule_descriptor: arr2(&[
                [1.0, 0.0, 0.0],
                [0.8, 0.0, 0.6],
                [u, u, 0.0],
                [0.0, 1.0, 0.0],
                [0.0, 1.0, 0.0],
            ]),
            ..Instances::default()
        }
    }

    fn meant(feature: [f32; 3]) -> Meant {
        Granules::new(&scene()).meant(&feature, &[], 2).unwrap()
    }

    #[test]
    fn words_find_the_part_the_thing_and_the_group() {
        let cup = meant([1.0, 0.0, 0.0]);
        assert_eq!((cup.granule, cup.kind, cup.instances, cup.gaussians), (0, Kind::Thing, vec![0], vec![0, 1, 2, 3]));
        assert!((cup.score - 1.0).abs() < 1e-6);
        let handle = meant([0.5, 0.0, 0.8]);
        assert_eq!((handle.kind, handle.instances, handle.gaussians), (Kind::Part, vec![0], vec![2, 3]));
        let set = meant([1.0, 1.0, 0.0]);
        assert_eq!((set.kind, set.instances, set.gaussians), (Kind::Group, vec![0, 1], vec![0, 1, 2, 3, 4, 5, 6]));
    }

    #[test]
    fn what_scores_nearly_as_well_elsewhere_is_meant_too() {
        let mut i = scene();
        let meant = |i: &Instances| Granules::new(i).meant(&[1.0, 0.0, 0.0], &[], 2).unwrap();
        i.granules.push(Granule { members: Members::Instance(2), support: 4, fit: 0.7 });
        i.granule_descriptor.push_row(ndarray::aview1(&[0.95, 0.0, 0.31])).unwrap();
        let both = meant(&i);
        assert_eq!((both.granule, both.instances, both.gaussians), (0, vec![0, 2], vec![0, 1, 2, 3, 7]));
        i.granule_descriptor.row_mut(5).assign(&ndarray::aview1(&[0.6, 0.0, 0.8]));
        assert_eq!(meant(&i).gaussians, [0, 1, 2, 3]);
    }

    #[test]
    fn of_equal_scores_the_masks_decide_and_rare_ones_are_left_out() {
        // Spoon and set are equally far from this; the masks show the set better.
        let v = (std::f32::consts::PI / 8.0).sin_cos();
        assert_eq!(meant([v.0, v.1, 0.0]).kind, Kind::Group);
        let spoon = Granules::new(&scene()).meant(&[0.0, 1.0, -1.0], &[], 2).unwrap();
        assert_eq!((spoon.granule, spoon.kind), (3, Kind::Thing));
        assert_eq!(Granules::new(&scene()).meant(&[1.0; 3], &[], 6), None);
        assert_eq!(Granules::new(&scene()).meant(&[0.0; 3], &[], 0), None);
        assert_eq!(Granules::new(&Instances::default()).meant(&[], &[], 0), None);
    }

    #[test]
    fn of_proposals_that_are_nearly_the_same_the_best_fitting_stays() {
        let set = |range: std::ops::Range<u32>| range.collect::<Vec<u32>>();
        // The second is the first but for a point, the third a quarter of the first.
        let proposals = [(0.6, set(0..8)), (0.7, set(1..8)), (0.9, set(0..2)), (0.5, set(8..12))];
        assert_eq!(different(&proposals, 12, SAME), [2, 1, 3]);
        assert_eq!(different(&proposals, 12, 1.1), [2, 1, 0, 3]);
    }
}
