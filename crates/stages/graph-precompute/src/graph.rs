//! The anchor graph over the kept Gaussians (paper, "Local Graph Sampling").

use crate::contract::contracted;
use crate::fps::farthest_points;
use crate::kdtree::{KdTree, distance};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// In which space anchors are spread evenly.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Space {
    /// The scene's own
    World,
    /// The far background drawn together to a shell twice as wide as the scene's middle
    Contracted,
}

/// How the graph is made.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GraphOptions {
    /// Share of the Gaussians that become anchors, in (0, 1]; at least one does.
    pub anchor_ratio: f64,
    /// Neighbours per anchor.
    pub k: usize,
    /// Spatial neighbours per Gaussian.
    pub gaussian_k: usize,
    /// Where distances are taken for the sampling; neighbours and nearest anchors are always those of the world.
    pub space: Space,
    /// Seed of the first anchor.
    pub seed: u64,
}

impl Default for GraphOptions {
    fn default() -> Self {
        Self { anchor_ratio: 0.1, k: 16, gaussian_k: 16, space: Space::World, seed: 0 }
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
    let count = ((n as f64 * options.anchor_ratio) as usize).clamp(1, n);
    let start = ChaCha8Rng::seed_from_u64(options.seed).random_range(0..n as u32);
    let tree = KdTree::new(points);
    // Sampling is one long chain of choices for one core; neighbours keep the others busy meanwhile.
    let (gaussian_knn, sample) = rayon::join(
        || tree.all_nearest(options.gaussian_k),
        || match options.space {
            Space::World => farthest_points(&tree, count, start),
            Space::Contracted => farthest_points(&KdTree::new(&contracted(points)), count, start),
        },
    );
    let anchors = sample.anchors;
    let anchor_points: Vec<[f32; 3]> = anchors.iter().map(|&a| points[a as usize]).collect();
    let anchor_tree = KdTree::new(&anchor_points);
    let nearest_anchor = match options.space {
        Space::World => sample.nearest,
        Space::Contracted => {
            let queries: Vec<_> = points.iter().map(|&p| (p, None)).collect();
            anchor_tree.nearest_many(&queries, 1, |_| 0)
        }
    };
    AnchorGraph {
        knn: tree.nearest_to(&anchors, options.k),
        anchor_knn: anchor_tree.all_nearest(options.k),
        gaussian_knn,
        nearest_anchor,
        anchors,
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

impl AnchorGraph {
    /// Distribution of the distances of `points` (those that the graph was made of) to their nearest anchors.
    pub fn distances(&self, points: &[[f32; 3]]) -> AnchorDistances {
        let to_anchor = |(p, &a): (&[f32; 3], &u32)| distance(points[self.anchors[a as usize] as usize], *p);
        AnchorDistances::of(points.iter().zip(&self.nearest_anchor).map(to_anchor).collect())
    }
}

impl AnchorDistances {
    /// Of squared distances.
    fn of(mut all: Vec<f32>) -> Self {
        all.sort_unstable_by(f32::total_cmp);
        let at = |share: f64| {
            let rank = (share * all.len() as f64).ceil() as usize;
            all.get(rank.max(1) - 1).map_or(0.0, |d| f64::from(*d).sqrt())
        };
        Self { median: at(0.5), p90: at(0.9), p99: at(0.99), largest: at(1.0) }
    }
}

/// How anchors are shared out between the middle of a scene, where its things are, and the rest.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize)]
pub struct MiddleAnchors {
    /// Share of the anchors that lie among the half of the Gaussians nearest to the scene's middle; a half would be even.
    pub share: f64,
    /// How far the Gaussians of that half are from their anchors.
    pub distance: AnchorDistances,
}

impl AnchorGraph {
    /// Looks at the half of `points` (those that the graph was made of, around their middle) that is nearest to the origin.
    pub fn middle(&self, points: &[[f32; 3]]) -> MiddleAnchors {
        let mut radii: Vec<f32> = points.iter().map(|&p| distance([0.0; 3], p)).collect();
        if radii.is_empty() {
            return MiddleAnchors::default();
        }
        let half = (radii.len() - 1) / 2;
        let radius = *radii.select_nth_unstable_by(half, f32::total_cmp).1;
        let inside = |p: &[f32; 3]| distance([0.0; 3], *p) <= radius;
        let among = self.anchors.iter().filter(|&&a| inside(&points[a as usize])).count();
        let served = points.iter().zip(&self.nearest_anchor).filter(|(p, _)| inside(p));
        let all = served.map(|(p, &a)| distance(points[self.anchors[a as usize] as usize], *p)).collect();
        MiddleAnchors { share: among as f64 / self.anchors.len() as f64, distance: AnchorDistances::of(all) }
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
        fn the_graph_is_what_it_says(
            p in points(1..250),
            ratio in 0.01f64..1.0,
            seed in 0u64..9,
            contract in proptest::bool::ANY,
        ) {
            let space = if contract { Space::Contracted } else { Space::World };
            let options = GraphOptions { anchor_ratio: ratio, k: 5, gaussian_k: 3, space, seed };
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
    fn distances_to_anchors_are_summed_up() {
        // Ten points in a row, the anchor first: distances 0 to 9.
        let points: Vec<[f32; 3]> = (0..10).map(|i| [i as f32, 0.0, 0.0]).collect();
        let g = AnchorGraph { anchors: vec![0], nearest_anchor: vec![0; 10], ..AnchorGraph::default() };
        assert_eq!(g.distances(&points), AnchorDistances { median: 4.0, p90: 8.0, p99: 9.0, largest: 9.0 });
        assert_eq!(AnchorGraph::default().distances(&[]), AnchorDistances::default());
        // The nearer half of these to the origin are the first five, which hold the anchor.
        let middle = g.middle(&points);
        let distance = AnchorDistances { median: 2.0, p90: 4.0, p99: 4.0, largest: 4.0 };
        assert_eq!(middle, MiddleAnchors { share: 1.0, distance });
        assert_eq!(AnchorGraph::default().middle(&[]), MiddleAnchors::default());
    }

    #[test]
    fn a_far_background_takes_most_anchors_unless_it_is_contracted() {
        let mut rng = ChaCha8Rng::seed_from_u64(6);
        // 9 of 10 points in a room of 2 units, the rest up to 200 units away.
        let p: Vec<[f32; 3]> = (0..10_000)
            .map(|i| {
                let r = if i % 10 == 0 { 200.0 } else { 1.0 };
                std::array::from_fn(|_| rng.random_range(-r..r))
            })
            .collect();
        let room = |space| {
            let g = anchor_graph(&p, &GraphOptions { space, ..GraphOptions::default() });
            g.anchors.iter().filter(|&&a| !a.is_multiple_of(10)).count()
        };
        let (world, contracted) = (room(Space::World), room(Space::Contracted));
        assert!(world < 100 && contracted > 500, "{world} {contracted} of 1000");
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
