//! What is known of each instance: size, place, support, language.

use artifacts::{Extents, Instances, MaskFeatures, Match, Witness, flat};
use ndarray::{Array2, aview1};
use std::collections::BTreeMap;

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

/// The masks that say what each instance means: of its matches the `most` of the highest score, 0 for all (paper), which count alike.
pub fn witnesses(matches: &[Match], most: usize) -> Vec<Witness> {
    let mut all = Vec::new();
    for own in matches.chunk_by(|a, b| a.instance == b.instance) {
        let best = best(own.iter().map(|m| f64::from(m.score)), most);
        let witness = |m: Match| Witness { of: m.instance, view: m.view, mask: m.mask, weight: 1.0 };
        all.extend(best.into_iter().map(|i| witness(own[i])));
    }
    all
}

/// Where the `most` largest of some values are, ascending; of equals the first; 0 for all.
pub(crate) fn best(values: impl Iterator<Item = f64>, most: usize) -> Vec<usize> {
    let mut order: Vec<(usize, f64)> = values.enumerate().collect();
    order.sort_by(|a, b| b.1.total_cmp(&a.1));
    order.truncate(if most == 0 { order.len() } else { most });
    let mut found: Vec<usize> = order.into_iter().map(|(i, _)| i).collect();
    found.sort_unstable();
    found
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
        let of = |most| descriptors(2, &witnesses(&i.matches, most), &features);
        assert!((of(0)[[0, 0]] - 0.5f32.sqrt()).abs() < 1e-6);
        assert_eq!(of(0).row(1), aview1(&[0.0, 0.0]));
        assert_eq!(of(1).row(0), aview1(&[1.0, 0.0]), "the match that fits best");
        assert_eq!(of(2), of(0));
    }

    #[test]
    fn the_best_keep_their_order_and_equals_go_to_the_first() {
        let values = || [0.5, 0.9, 0.5, 0.7].into_iter();
        assert_eq!(best(values(), 3), [0, 1, 3]);
        assert_eq!(best(values(), 9), [0, 1, 2, 3]);
        assert_eq!(best(values(), 0), [0, 1, 2, 3]);
    }
}
