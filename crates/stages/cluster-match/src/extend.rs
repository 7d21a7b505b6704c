//! Labels for Gaussians that the clustering left out: noise, and Gaussians that no view sees.

use gs_io::{Error, Result};
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rayon::prelude::*;
use std::num::NonZero;

/// Gives every Gaussian for which `wanted` holds the label and the node of the tree of the nearest Gaussian that has a label
/// (>= 0); ties go to the lower index. Nothing changes where nobody has a label.
///
/// # Errors
/// When the tree of labelled centres cannot be built.
pub fn from_nearest(
    means: &[[f32; 3]],
    labels: &mut [i32],
    nodes: &mut [i32],
    wanted: impl Fn(usize) -> bool + Sync,
) -> Result<usize> {
    let finite = |p: &[f32; 3]| p.iter().all(|v| v.is_finite());
    // Distinct places only: the tree cannot split heaps of coincident points.
    let mut known: Vec<u32> =
        (0..means.len() as u32).filter(|&i| labels[i as usize] >= 0 && finite(&means[i as usize])).collect();
    known.sort_by(|&a, &b| {
        let (p, q) = (means[a as usize], means[b as usize]);
        p[0].total_cmp(&q[0]).then(p[1].total_cmp(&q[1])).then(p[2].total_cmp(&q[2])).then(a.cmp(&b))
    });
    known.dedup_by(|b, a| means[*a as usize] == means[*b as usize]);
    known.sort_unstable();
    if known.is_empty() {
        return Ok(0);
    }
    // Centred, so that far-away scenes keep their digits.
    let origin = means[known[0] as usize];
    let shift = |p: [f32; 3]| [0, 1, 2].map(|k| p[k] - origin[k]);
    let places: Vec<[f32; 3]> = known.iter().map(|&i| shift(means[i as usize])).collect();
    let tree = ImmutableKdTree::<f32, 3>::new_from_slice(&places)
        .map_err(|e| Error::new(format!("cannot index the Gaussians' centres: {e:?}")))?;
    let some = NonZero::new(4.min(places.len())).expect("there is one");
    let found: Vec<(usize, usize)> = (0..means.len())
        .into_par_iter()
        .filter(|&i| wanted(i) && finite(&means[i]))
        .filter_map(|i| {
            let near = tree.query(&shift(means[i])).nearest_n::<SquaredEuclidean<f32>>(some).execute();
            let best = near.iter().map(|n| (n.distance, n.item)).min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
            best.map(|(_, item)| (i, known[item as usize] as usize))
        })
        .collect();
    let count = found.len();
    for (i, near) in found {
        (labels[i], nodes[i]) = (labels[near], nodes[near]);
    }
    Ok(count)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_labelled_gaussian_decides() {
        let means = [[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [4.0, 0.0, 0.0], [6.0, 0.0, 0.0], [5.0, 0.0, 0.0]];
        let (mut labels, mut nodes) = ([0, 1, -1, -1, -1], [8, 9, 7, 7, 7]);
        assert_eq!(from_nearest(&means, &mut labels, &mut nodes, |i| (2..4).contains(&i)).unwrap(), 2);
        assert_eq!((labels, nodes), ([0, 1, 0, 1, -1], [8, 9, 8, 9, 7]));
        let mut none = [-1; 5];
        from_nearest(&means, &mut none, &mut nodes, |_| true).unwrap();
        assert_eq!(none, [-1; 5]);
        let mut heap = [3, 3, -1];
        from_nearest(&[[1.0; 3]; 3], &mut heap, &mut [5; 3], |i| i == 2).unwrap();
        assert_eq!(heap, [3, 3, 3]);
    }
}
