//! The nearest Gaussian or point.

use gs_scene::Gaussians;
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rayon::prelude::*;

/// Index of the nearest Gaussian among `candidates` (ascending indices) for each vertex; none when there are none.
pub fn nearest(gaussians: &Gaussians, candidates: &[u32], vertices: &[[f32; 3]]) -> Vec<Option<u32>> {
    let positions: Vec<[f32; 3]> = candidates.iter().map(|&i| gaussians.means[i as usize]).collect();
    nearest_of(&positions, vertices).into_iter().map(|n| n.map(|n| candidates[n as usize])).collect()
}

/// Index of the nearest of `positions` for each point; none when there are none.
pub fn nearest_of(positions: &[[f32; 3]], points: &[[f32; 3]]) -> Vec<Option<u32>> {
    let tree = (!positions.is_empty()).then(|| ImmutableKdTree::<f32, 3>::new_from_slice(positions).ok()).flatten();
    let Some(tree) = tree else { return vec![None; points.len()] };
    let one = |p: &[f32; 3]| Some(tree.query(p).nearest_one::<SquaredEuclidean<f32>>().execute().item);
    points.par_iter().map(one).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_candidate_is_found() {
        let mut g = Gaussians::default();
        for x in [0.0, 1.0, 2.0] {
            g.means.push([x, 0.0, 0.0]);
        }
        assert_eq!(nearest(&g, &[0, 2], &[[0.9, 0.0, 0.0], [1.2, 0.0, 0.0]]), [Some(0), Some(2)]);
        assert_eq!(nearest(&g, &[], &[[0.0; 3]]), [None]);
    }
}
