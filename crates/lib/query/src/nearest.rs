//! The nearest Gaussian or point.

use gs_scene::{Gaussians, points::KdTree};
use rayon::prelude::*;

/// Index of the nearest Gaussian among `candidates` (ascending indices) for each vertex; none when there are none.
pub fn nearest(gaussians: &Gaussians, candidates: &[u32], vertices: &[[f32; 3]]) -> Vec<Option<u32>> {
    let positions: Vec<[f32; 3]> = candidates.iter().map(|&i| gaussians.means[i as usize]).collect();
    nearest_of(&positions, vertices).into_iter().map(|n| n.map(|n| candidates[n as usize])).collect()
}

/// Index of the nearest of `positions` for each point, the lowest of equals; none when there are none.
pub fn nearest_of(positions: &[[f32; 3]], points: &[[f32; 3]]) -> Vec<Option<u32>> {
    let tree = KdTree::new(positions);
    let one = |found: &mut Vec<_>, &p: &[f32; 3]| {
        tree.nearest(p, 1, found);
        found.first().map(|&(_, index)| index)
    };
    points.par_iter().map_init(Vec::new, one).collect()
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
