//! The anchor graph over the kept Gaussians (paper, "Local Graph Sampling").

use crate::fps::farthest_points;
use crate::kdtree::KdTree;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// How the graph is made.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GraphOptions {
    /// Share of the Gaussians that become anchors, in (0, 1]; at least one does.
    pub anchor_ratio: f64,
    /// Neighbours per anchor.
    pub k: usize,
    /// Spatial neighbours per Gaussian.
    pub gaussian_k: usize,
    /// Seed of the first anchor.
    pub seed: u64,
}

impl Default for GraphOptions {
    fn default() -> Self {
        Self { anchor_ratio: 0.1, k: 16, gaussian_k: 16, seed: 0 }
    }
}

/// The graph's arrays, as in [`artifacts::Graph`].
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct AnchorGraph {
    /// Anchors in the order of sampling; M.
    pub anchors: Vec<u32>,
    /// Nearest points of each anchor; `[M][k]`.
    pub knn: Vec<u32>,
    /// Nearest anchors of each anchor; `[M][k]`.
    pub anchor_knn: Vec<u32>,
    /// Nearest anchor of each point; n.
    pub nearest_anchor: Vec<u32>,
    /// Nearest points of each point; `[n][gaussian_k]`.
    pub gaussian_knn: Vec<u32>,
}

/// Anchors, neighbours and nearest anchors of `points` (finite, shifted to a near origin).
pub fn anchor_graph(points: &[[f32; 3]], options: &GraphOptions) -> AnchorGraph {
    let n = points.len();
    if n == 0 {
        return AnchorGraph::default();
    }
    let tree = KdTree::new(points);
    let count = ((n as f64 * options.anchor_ratio) as usize).clamp(1, n);
    let start = ChaCha8Rng::seed_from_u64(options.seed).random_range(0..n as u32);
    let sample = farthest_points(&tree, count, start);
    let anchor_points: Vec<[f32; 3]> = sample.anchors.iter().map(|&a| points[a as usize]).collect();
    let queries: Vec<_> = sample.anchors.iter().map(|&a| (points[a as usize], Some(a))).collect();
    AnchorGraph {
        knn: tree.nearest_many(&queries, options.k, |m| sample.anchors[m]),
        anchor_knn: KdTree::new(&anchor_points).all_nearest(options.k),
        gaussian_knn: tree.all_nearest(options.gaussian_k),
        nearest_anchor: sample.nearest,
        anchors: sample.anchors,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kdtree::distance;
    use crate::testing::points;
    use proptest::prelude::*;
    use rand::Rng;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(60))]
        #[test]
        fn the_graph_is_what_it_says(p in points(1..250), ratio in 0.01f64..1.0, seed in 0u64..9) {
            let options = GraphOptions { anchor_ratio: ratio, k: 5, gaussian_k: 3, seed };
            let g = anchor_graph(&p, &options);
            let m = g.anchors.len();
            prop_assert_eq!(m, ((p.len() as f64 * ratio) as usize).max(1));
            let mut distinct = g.anchors.clone();
            distinct.sort_unstable();
            distinct.dedup();
            prop_assert_eq!(distinct.len(), m);
            // Nearest anchors, by brute force: distance first, then the order of choice.
            for (i, &a) in g.nearest_anchor.iter().enumerate() {
                let d = |a: usize| distance(p[g.anchors[a] as usize], p[i]);
                let best = (0..m).fold(0, |b, a| if d(a) < d(b) { a } else { b });
                prop_assert_eq!(a as usize, best);
            }
            for (a, row) in g.anchor_knn.chunks_exact(5).enumerate() {
                let mut want: Vec<usize> = (0..m).filter(|&b| b != a).collect();
                let key = |b: &usize| (distance(p[g.anchors[a] as usize], p[g.anchors[*b] as usize]), *b);
                want.sort_by(|x, y| key(x).partial_cmp(&key(y)).unwrap());
                want.resize(5, a);
                prop_assert!(row.iter().zip(&want).all(|(&r, &w)| r as usize == w), "{row:?} {want:?}");
            }
            let padded_with_self = p.len() > 5 || g.knn.chunks_exact(5).zip(&g.anchors).all(|(row, a)| row[4] == *a);
            prop_assert!(padded_with_self);
        }
    }

    #[test]
    fn threads_do_not_change_the_graph() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let p: Vec<[f32; 3]> = (0..20_000).map(|_| std::array::from_fn(|_| rng.random_range(-1f32..1.0))).collect();
        let with = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| anchor_graph(&p, &GraphOptions::default()))
        };
        assert_eq!(with(1), with(3));
    }
}
