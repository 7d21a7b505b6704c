//! How well the features of a mask's Gaussians agree: a figure of the training curve.

use super::loss::{directions, dot};
use super::masks::MaskSet;
use rayon::prelude::*;

/// Mean over masks of the weighted mean cosine between a mask's Gaussians and its centroid `[K][d]`. `feature` writes the
/// feature of the Gaussian at a place.
pub fn alignment(set: &MaskSet, centroids: &[f64], d: usize, feature: impl Fn(usize, &mut [f64]) + Sync) -> f64 {
    let masks = set.len();
    let (unit, _) = directions(centroids, d);
    let parts: Vec<Vec<f64>> = set
        .pieces
        .par_windows(2)
        .map(|bounds| {
            let (mut sums, mut f) = (vec![0.0; 2 * masks], vec![0.0; d]);
            for c in bounds[0] as usize..bounds[1] as usize {
                feature(set.columns[c] as usize, &mut f);
                let (u, _) = directions(&f, d);
                let (mask, weight) = set.entries(c);
                for (&k, &w) in mask.iter().zip(weight) {
                    let (k, w) = (k as usize, f64::from(w));
                    sums[k] += w * dot(&u, &unit[k * d..(k + 1) * d]);
                    sums[masks + k] += w;
                }
            }
            sums
        })
        .collect();
    let mut sums = vec![0.0; 2 * masks];
    for part in parts {
        sums.iter_mut().zip(part).for_each(|(s, p)| *s += p);
    }
    let means = (0..masks).filter(|&k| sums[masks + k] > 0.0).map(|k| sums[k] / sums[masks + k]);
    means.sum::<f64>() / masks.max(1) as f64
}
