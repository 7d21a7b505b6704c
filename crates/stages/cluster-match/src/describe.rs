//! What is known of each instance: size, place, support, language.

use artifacts::{Extents, Instances, MaskFeatures, Match, flat};
use ndarray::{Array2, aview1};
use std::collections::BTreeMap;

/// Gathers what is known of the instances. `labels` are those of all Gaussians, numbered 0 to K - 1 or -1; `features` are
/// mask features by view index. Scores are zero; views, tree and nodes are left empty.
///
/// A descriptor is the mean of the unit features of the masks, at unit length (paper).
pub fn describe(
    means: &[[f32; 3]],
    labels: Vec<i32>,
    instances: usize,
    mut matches: Vec<Match>,
    features: &BTreeMap<u32, MaskFeatures>,
) -> Instances {
    let dim = features.values().map(MaskFeatures::dim).next().unwrap_or(0);
    let Extents { count, centroid, bbox_min, bbox_max, oriented } = Extents::of(means, &labels, instances);
    let mut out = Instances {
        descriptor: Array2::zeros((instances, dim)),
        support: vec![0; instances],
        score: vec![0.0; instances],
        count,
        centroid,
        bbox_min,
        bbox_max,
        oriented,
        ..Instances::default()
    };
    let mut of_instance: Vec<Vec<Match>> = vec![Vec::new(); instances];
    for m in &matches {
        of_instance[m.instance as usize].push(*m);
    }
    for (k, own) in of_instance.iter().enumerate() {
        out.support[k] = own.len() as u32;
        let rows = own.iter().filter_map(|m| Some((1.0, flat(features.get(&m.view)?.row(m.mask as usize)?))));
        out.descriptor.row_mut(k).assign(&aview1(&mean_of_units(rows, dim)));
    }
    matches.sort_by_key(|m| (m.instance, m.view));
    Instances { label: labels, matches, ..out }
}

/// The weighted mean of the rows, each at unit length, at unit length; zero where there is none.
pub(crate) fn mean_of_units<'a>(rows: impl Iterator<Item = (f64, &'a [f32])>, dim: usize) -> Vec<f32> {
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
        let i = describe(&means, vec![0, 0, -1], 2, vec![m(1, 1, 0.2), m(0, 0, 0.8)], &features);
        assert_eq!((i.count[0], i.count[1], i.support[0], i.support[1]), (2, 0, 2, 0));
        assert_eq!((i.centroid[0], i.bbox_max[0]), ([1.0, 0.5, 0.0], [2.0, 1.0, 0.0]));
        assert!((i.descriptor_of(0)[0] - 0.5f32.sqrt()).abs() < 1e-6);
        assert_eq!(i.descriptor_of(1), aview1(&[0.0, 0.0]));
        assert_eq!(i.matches[0].view, 0);
    }
}
