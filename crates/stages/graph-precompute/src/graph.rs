//! The anchor graph over the kept Gaussians (paper, "Local Graph Sampling").

use artifacts::Graph;
use gs_scene::points::{KdTree, distance, farthest_points};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Spatial neighbours per Gaussian: the best of 4, 8, 16 and 32 on a scene of 12,000 (79, 81, 86 and 82 % instance mIoU).
pub const GAUSSIAN_K: usize = 16;

/// The graph of `points` (finite, shifted to a near origin): a share of `anchor_ratio` of them are anchors, at least one,
/// with `k` neighbours each. `seed` chooses the first anchor. What is not about neighbours is empty.
pub fn anchor_graph(points: &[[f32; 3]], anchor_ratio: f64, k: usize, seed: u64) -> Graph {
    let n = points.len();
    let count = ((n as f64 * anchor_ratio) as usize).clamp(1, n);
    let start = ChaCha8Rng::seed_from_u64(seed).random_range(0..n as u32);
    let tree = KdTree::new(points);
    // Sampling is one long chain of choices for one core; neighbours keep the others busy meanwhile.
    let (gaussian_knn, sample) = rayon::join(|| tree.all_nearest(GAUSSIAN_K), || farthest_points(&tree, count, start));
    let anchors = sample.anchors;
    let anchor_points: Vec<[f32; 3]> = anchors.iter().map(|&a| points[a as usize]).collect();
    Graph {
        knn: tree.nearest_to(&anchors, k),
        anchor_knn: KdTree::new(&anchor_points).all_nearest(k),
        gaussian_knn,
        nearest_anchor: sample.nearest,
        anchors,
        ..Graph::default()
    }
}

/// How far Gaussians are from their anchors, in world units: the p-th largest of all distances.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize)]
pub struct AnchorDistances {
    /// Half are nearer.
    pub median: f64,
    /// Nine of ten are nearer.
    pub p90: f64,
    /// 99 of 100 are nearer.
    pub p99: f64,
    /// None is farther.
    pub largest: f64,
}

impl AnchorDistances {
    /// Of the points that a graph was made of.
    pub fn of(graph: &Graph, points: &[[f32; 3]]) -> Self {
        let to_anchor = |(p, &a): (&[f32; 3], &u32)| distance(points[graph.anchors[a as usize] as usize], *p);
        let mut all: Vec<f32> = points.iter().zip(&graph.nearest_anchor).map(to_anchor).collect();
        all.sort_unstable_by(f32::total_cmp);
        let at = |share: f64| {
            let rank = (share * all.len() as f64).ceil() as usize;
            f64::from(all[rank.max(1) - 1]).sqrt()
        };
        Self { median: at(0.5), p90: at(0.9), p99: at(0.99), largest: at(1.0) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use rand::RngExt;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(60))]
        #[test]
        fn the_graph_is_what_it_says(
            p in prop::collection::vec(prop::array::uniform3((-8i8..8).prop_map(|v| f32::from(v) / 4.0)), 1..250),
            ratio in 0.01f64..1.0,
            seed in 0u64..9,
        ) {
            let g = anchor_graph(&p, ratio, 5, seed);
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
            for (a, row) in g.anchor_knn.rows().into_iter().enumerate() {
                let mut want: Vec<usize> = (0..m).filter(|&b| b != a).collect();
                let key = |b: &usize| (distance(p[g.anchors[a] as usize], p[g.anchors[*b] as usize]), *b);
                want.sort_by(|x, y| key(x).partial_cmp(&key(y)).unwrap());
                want.resize(5, a);
                prop_assert!(row.iter().zip(&want).all(|(&r, &w)| r as usize == w), "{row:?} {want:?}");
            }
            let padded_with_self = p.len() > 5 || g.knn.rows().into_iter().zip(&g.anchors).all(|(row, a)| row[4] == *a);
            prop_assert!(padded_with_self);
        }
    }

    #[test]
    fn distances_to_anchors_are_summed_up() {
        // Ten points in a row, the anchor first: distances 0 to 9.
        let points: Vec<[f32; 3]> = (0..10).map(|i| [i as f32, 0.0, 0.0]).collect();
        let g = Graph { anchors: vec![0], nearest_anchor: vec![0; 10], ..Graph::default() };
        assert_eq!(AnchorDistances::of(&g, &points), AnchorDistances { median: 4.0, p90: 8.0, p99: 9.0, largest: 9.0 });
    }

    #[test]
    fn threads_do_not_change_the_graph() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let p: Vec<[f32; 3]> = (0..20_000).map(|_| std::array::from_fn(|_| rng.random_range(-1f32..1.0))).collect();
        let with = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| anchor_graph(&p, 0.1, 16, 0))
        };
        assert_eq!(with(1), with(3));
    }
}
