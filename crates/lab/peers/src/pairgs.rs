//! PairGS (arXiv 2607.01140): Gaussians belong together where the masks of all views say so, asked only of likely pairs, and a
//! tree of clusters built from the answers. The authors' code is not public.
//!
//! Known are the steps: mask features lifted to Gaussians; nearest neighbours by a few dimensions of them and by scaled
//! positions; an affinity of each such pair from masks of many views and the Gaussians' weights in them; a tree of clusters,
//! `TreeDBSCAN`, that knows parents and children and drops redundant and spurious clusters. The formulas of the affinity and of
//! the tree were not in what we could read. Chosen here, as the strongest of what was tried on scenes for tuning:
//! - lifting: the mean of the masks' features by blending weight; their principal components, of total variance 1, beside
//!   positions of total variance `position_scale` squared;
//! - affinity: with p(m) the share of a Gaussian's weight in a view that lies in mask m, the sum of p_i(m) p_j(m) is the chance
//!   that a piece of one and a piece of the other lie in the same mask. The affinity is its mean over the views that see both,
//!   weighted by the root of the product of both weights there. Levels count as views of their own;
//! - tree: DBSCAN at all thresholds at once. That is HDBSCAN on the graph, with the distance [`FLOOR`] + 1 - affinity and an
//!   affinity in place of the core distance. Stability (excess of mass) cuts the tree. Spurious are clusters of few Gaussians,
//!   redundant those that leave their parent at a high affinity. Gaussians left over join their most affine neighbour.
//!
//! The published system asks the tree for each text. Here instances are one cut of it, as every system's are; their descriptors
//! are the means of the masks that show them, one a view (those of the lifted features did as well).

use crate::cli::Peer;
use crate::product::{Grouping, Product};
use crate::union::root;
use crate::world::{Inputs, World};
use artifacts::LEVELS;
use gs_io::{Error, Result};
use hdbscan_exact::{Edge, Metric, Selection, cluster_graph};
use nalgebra::DMatrix;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::Serialize;
use stage::Stage;

/// Distance of two Gaussians that all views put together: so stability stays finite, and differences between affinities near 1
/// do not outweigh all others.
const FLOOR: f64 = 0.1;
/// Rounds of the iteration for principal components, and directions that it takes beside those wanted.
const ROUNDS: usize = 4;
const SPARE: usize = 8;
/// Rows that one task handles.
const CHUNK: usize = 4096;
/// Points in a leaf of the search tree.
const LEAF: usize = 16;
/// Principal components of the lifted features that neighbours are sought by.
const DIMENSIONS: usize = 8;

/// Settings.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct Options {
    #[command(flatten)]
    #[serde(flatten)]
    inputs: Inputs,
    /// Nearest Gaussians that each proposes an edge to, 1 to 256
    #[arg(long, value_name = "COUNT", default_value_t = 16, value_parser = stage::within(1..=256usize))]
    neighbours: usize,
    /// How much positions count beside semantics for neighbours, as a factor of their deviation, above 0
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, value_parser = stage::positive::<f32>)]
    position_scale: f32,
    /// Gaussians, itself counted, that must be as affine to one as the cluster asks for, 1 to 256
    #[arg(long, value_name = "COUNT", default_value_t = 8, value_parser = stage::within(1..=256usize))]
    min_points: usize,
    /// Fewest Gaussians of a cluster, 2 or more
    #[arg(long, value_name = "COUNT", default_value_t = 12, value_parser = stage::within(2..=1_000_000usize))]
    min_size: usize,
    /// Clusters that leave their parents above this affinity are redundant, 0 to 1
    #[arg(long, value_name = "AFFINITY", default_value_t = 0.9, value_parser = stage::within(0.0..=1.0f64))]
    redundant: f64,
}

/// What a Gaussian weighs in a mask.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Share {
    /// Level of a view.
    image: u32,
    /// Row of the footprints.
    mask: u32,
    weight: f32,
}

/// What every Gaussian weighs in which masks, and its lifted feature.
struct Lifted {
    /// Where the shares of each Gaussian begin; n + 1.
    start: Vec<usize>,
    /// By Gaussian, then mask, which is by image too.
    shares: Vec<Share>,
    /// Sum of features by weight, `[n][dim]`.
    sums: Vec<f64>,
    /// Sum of the weights of masks with a feature; n.
    weights: Vec<f64>,
}

impl Lifted {
    fn read(world: &World) -> Result<Self> {
        let (n, dim, rows) = (world.kept(), world.dim(), world.rows());
        let mut start = vec![0; n + 1];
        world.footprints.in_batches(&rows, |_, batch| {
            batch.iter().flat_map(|e| &e.gaussians).for_each(|&i| start[i as usize + 1] += 1);
        })?;
        (0..n).for_each(|i| start[i + 1] += start[i]);
        let mut next = start.clone();
        let mut shares = vec![Share::default(); start[n]];
        let (mut sums, mut weights) = (vec![0.0; n * dim], vec![0.0; n]);
        world.footprints.in_batches(&rows, |rows, batch| {
            for (&mask, entries) in rows.iter().zip(batch) {
                let row = &world.footprints.rows[mask as usize];
                let feature = world.feature(row);
                for (i, weight) in entries.iter().map(|(i, w)| (i as usize, w)) {
                    shares[next[i]] = Share { image: row.view * LEVELS as u32 + row.level, mask, weight };
                    next[i] += 1;
                    let Some(feature) = feature else { continue };
                    weights[i] += f64::from(weight);
                    let sum = &mut sums[i * dim..(i + 1) * dim];
                    sum.iter_mut().zip(feature).for_each(|(s, f)| *s += f64::from(weight) * f64::from(*f));
                }
            }
        })?;
        Ok(Self { start, shares, sums, weights })
    }

    fn of(&self, i: u32) -> &[Share] {
        &self.shares[self.start[i as usize]..self.start[i as usize + 1]]
    }

    /// The lifted features, `[n][dim]`; zeros where no mask has one.
    fn means(&self, dim: usize) -> Vec<f32> {
        let weight = |at: usize| self.weights[at / dim].max(1e-12);
        self.sums.iter().enumerate().map(|(at, s)| (s / weight(at)) as f32).collect()
    }
}

/// The affinity of two Gaussians, 0 to 1, from what each weighs in which masks; 0 where no view shows both.
fn affinity(a: &[Share], b: &[Share]) -> f64 {
    let (mut a, mut b) = (a.chunk_by(|x, y| x.image == y.image), b.chunk_by(|x, y| x.image == y.image));
    let (mut same, mut all) = (0.0, 0.0);
    let (mut own, mut other) = (a.next(), b.next());
    while let (Some(x), Some(y)) = (own, other) {
        let order = x[0].image.cmp(&y[0].image);
        if order.is_eq() {
            let weight = |list: &[Share]| list.iter().map(|s| f64::from(s.weight)).sum::<f64>();
            let pairs = x.iter().flat_map(|s| y.iter().filter(|t| t.mask == s.mask).map(move |t| (s, t)));
            let common = pairs.map(|(s, t)| f64::from(s.weight) * f64::from(t.weight)).sum::<f64>();
            let both = (weight(x) * weight(y)).sqrt();
            same += if both > 0.0 { common / both } else { 0.0 };
            all += both;
        }
        own = if order.is_le() { a.next() } else { own };
        other = if order.is_ge() { b.next() } else { other };
    }
    if all > 0.0 { (same / all).min(1.0) } else { 0.0 }
}

/// The first `count` principal components of rows of `dim` values, or all where there are fewer; as many columns as that, and
/// `[n][columns]`.
fn principal(values: &[f32], dim: usize, count: usize, rng: &mut ChaCha8Rng) -> (usize, Vec<f32>) {
    let count = count.min(dim);
    let width = (count + SPARE).min(dim);
    let n = values.len() / dim.max(1);
    if width == 0 || n == 0 {
        return (0, Vec::new());
    }
    let mut mean = vec![0.0; dim];
    values.chunks_exact(dim).for_each(|row| mean.iter_mut().zip(row).for_each(|(m, v)| *m += f64::from(*v)));
    let chunk = |rows: &[f32]| {
        DMatrix::from_fn(rows.len() / dim, dim, |i, c| f64::from(rows[i * dim + c]) - mean[c] / n as f64)
    };
    // Rows in chunks, so that the values are not in memory twice; their sums in order.
    let sum = |f: &(dyn Fn(DMatrix<f64>) -> DMatrix<f64> + Sync)| {
        let parts: Vec<DMatrix<f64>> = values.par_chunks(CHUNK * dim).map(|rows| f(chunk(rows))).collect();
        parts.into_iter().reduce(|a, b| a + b).unwrap_or_default()
    };
    let mut basis = DMatrix::from_fn(dim, width, |_, _| rng.random_range(-1.0..1.0));
    for _ in 0..ROUNDS {
        basis = sum(&|x| x.tr_mul(&(&x * &basis))).qr().q();
    }
    let eigen = sum(&|x| (&x * &basis).tr_mul(&(&x * &basis))).symmetric_eigen();
    let mut order: Vec<usize> = (0..width).collect();
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
    let axes = (basis * eigen.eigenvectors).select_columns(&order[..count]);
    let parts: Vec<Vec<f32>> = values
        .par_chunks(CHUNK * dim)
        .map(|rows| (chunk(rows) * &axes).transpose().iter().map(|&v| v as f32).collect())
        .collect();
    (count, parts.concat())
}

/// Brings rows of `dim` values to mean 0 and a total deviation of `deviation`; rows that are all alike become zeros.
fn scale(values: &mut [f32], dim: usize, deviation: f64) {
    let n = (values.len() / dim.max(1)).max(1) as f64;
    let column = |c: usize| values.iter().skip(c).step_by(dim).map(|v| f64::from(*v));
    let means: Vec<f64> = (0..dim).map(|c| column(c).sum::<f64>() / n).collect();
    let squares: f64 = (0..dim).map(|c| column(c).map(|v| (v - means[c]).powi(2)).sum::<f64>()).sum();
    let factor = if squares > 1e-20 { deviation / (squares / n).sqrt() } else { 0.0 };
    values.iter_mut().enumerate().for_each(|(at, v)| *v = ((f64::from(*v) - means[at % dim]) * factor) as f32);
}

/// A kd-tree over points; the crates at hand do not break ties by index.
struct Search<'a> {
    points: &'a [f32],
    dim: usize,
}

impl Search<'_> {
    fn at(&self, i: u32, axis: usize) -> f32 {
        self.points[i as usize * self.dim + axis]
    }

    /// Sorts points so that the halves of every range lie on both sides of a plane: the axis along which the range is widest,
    /// through its middle point. `axes` gets the axis by middle.
    fn build(&self, order: &mut [u32], axes: &mut [u32]) {
        if order.len() <= LEAF {
            return;
        }
        let width = |axis: usize| {
            let ends =
                order.iter().map(|&i| self.at(i, axis)).fold((f32::MAX, f32::MIN), |e, v| (e.0.min(v), e.1.max(v)));
            ends.1 - ends.0
        };
        let axis = (1..self.dim).fold((0, width(0)), |best, c| if width(c) > best.1 { (c, width(c)) } else { best }).0;
        let middle = order.len() / 2;
        order.select_nth_unstable_by(middle, |&a, &b| self.at(a, axis).total_cmp(&self.at(b, axis)).then(a.cmp(&b)));
        axes[middle] = axis as u32;
        let ((low, high), (low_axes, high_axes)) = (order.split_at_mut(middle), axes.split_at_mut(middle));
        self.build(low, low_axes);
        self.build(&mut high[1..], &mut high_axes[1..]);
    }

    /// Looks at the points of a range that may be among the nearest `k` of point `i`: (squared distance, index), ascending.
    fn visit(&self, (order, axes): (&[u32], &[u32]), (i, k): (u32, usize), best: &mut Vec<(f32, u32)>) {
        let mut look = |j: u32| {
            let d = (0..self.dim).map(|c| (self.at(i, c) - self.at(j, c)).powi(2)).sum::<f32>();
            let place = best.partition_point(|&(e, other)| e.total_cmp(&d).then(other.cmp(&j)).is_lt());
            if j != i && place < k {
                best.truncate(k - 1);
                best.insert(place, (d, j));
            }
        };
        if order.len() <= LEAF {
            order.iter().for_each(|&j| look(j));
            return;
        }
        let middle = order.len() / 2;
        look(order[middle]);
        let beyond = self.at(i, axes[middle] as usize) - self.at(order[middle], axes[middle] as usize);
        let halves = [(&order[..middle], &axes[..middle]), (&order[middle + 1..], &axes[middle + 1..])];
        let near = usize::from(beyond > 0.0);
        self.visit(halves[near], (i, k), best);
        if best.len() < k || beyond * beyond <= best[k - 1].0 {
            self.visit(halves[1 - near], (i, k), best);
        }
    }
}

/// Pairs of points of which one is among the `k` nearest of the other, ties by index; ascending, smaller index first.
fn candidates(points: &[f32], dim: usize, k: usize) -> Vec<(u32, u32)> {
    let (search, n) = (Search { points, dim }, points.len() / dim.max(1));
    let (mut order, mut axes): (Vec<u32>, _) = ((0..n as u32).collect(), vec![0; n]);
    search.build(&mut order, &mut axes);
    let near = |i: u32| {
        let mut best = Vec::with_capacity(k + 1);
        search.visit((&order, &axes), (i, k), &mut best);
        best.into_iter().map(move |(_, j)| (i.min(j), i.max(j)))
    };
    let mut pairs: Vec<(u32, u32)> = (0..n as u32).into_par_iter().flat_map_iter(near).collect();
    pairs.par_sort_unstable();
    pairs.dedup();
    pairs
}

/// TreeDBSCAN: clusters of `n` Gaussians, -1 for those left over, and their number. `pairs` have `affinities`.
fn tree(n: usize, pairs: &[(u32, u32)], affinities: &[f64], options: &Options) -> (Vec<i32>, usize) {
    let mut own = vec![Vec::new(); n];
    for (&(a, b), &affinity) in pairs.iter().zip(affinities) {
        own[a as usize].push(affinity);
        own[b as usize].push(affinity);
    }
    // The Gaussian itself is the first of its points.
    let core = |mut all: Vec<f64>| {
        all.sort_unstable_by(|a, b| b.total_cmp(a));
        if options.min_points < 2 { 1.0 } else { all.get(options.min_points - 2).copied().unwrap_or(0.0) }
    };
    let core: Vec<f64> = own.into_iter().map(core).collect();
    let distance = |affinity: f64| FLOOR + 1.0 - affinity;
    let reach = pairs.iter().zip(affinities).map(|(&(a, b), &w)| (a, b, w.min(core[a as usize]).min(core[b as usize])));
    // What no view puts together nothing connects.
    let edges: Vec<Edge> = reach.filter(|e| e.2 > 0.0).map(|(a, b, w)| Edge::new(a, b, distance(w))).collect();
    let settings = hdbscan_exact::Options {
        min_cluster_size: options.min_size,
        min_samples: options.min_points,
        epsilon: distance(options.redundant),
        selection: Selection::ExcessOfMass,
        allow_single_cluster: false,
        metric: Metric::Euclidean,
    };
    let clusters = cluster_graph(n, edges, &settings);
    (clusters.labels, clusters.selected.len())
}

/// Gives those without a label that of their most affine neighbour, or of its most affine one, and so on: pairs join by falling
/// affinity, ties in their order, but never two labels.
fn settle(labels: &mut [i32], pairs: &[(u32, u32)], affinities: &[f64]) {
    let mut order: Vec<usize> = (0..pairs.len()).collect();
    order.par_sort_by(|&a, &b| affinities[b].total_cmp(&affinities[a]));
    let mut above: Vec<u32> = (0..labels.len() as u32).collect();
    for (a, b) in order.into_iter().map(|e| pairs[e]) {
        let (a, b) = (root(&mut above, a), root(&mut above, b));
        let label = labels[a as usize].max(labels[b as usize]);
        if labels[a as usize].min(labels[b as usize]) < 0 {
            above[b as usize] = a;
            labels[a as usize] = label;
        }
    }
    (0..labels.len()).for_each(|i| labels[i] = labels[root(&mut above, i as u32) as usize]);
}

impl Peer for Options {
    fn inputs(&self) -> &Inputs {
        &self.inputs
    }

    fn make(&self, world: &World, stage: &Stage) -> Result<Product> {
        let (n, dim) = (world.kept(), world.dim());
        if n == 0 {
            return Err(Error::new("no Gaussian is seen")
                .file(&self.inputs.footprints)
                .hint("run graph-precompute again with views that show the scene"));
        }
        let lifted = Lifted::read(world)?;
        let (columns, mut semantics) = if dim == 0 {
            stage.warn("masks without features: pairs are proposed by positions alone");
            (0, Vec::new())
        } else {
            let mut rng = ChaCha8Rng::seed_from_u64(stage.seed());
            principal(&lifted.means(dim), dim, DIMENSIONS, &mut rng)
        };
        scale(&mut semantics, columns, 1.0);
        let means = &world.geometry.gaussians.means;
        let mut positions: Vec<f32> = world.footprints.kept.iter().flat_map(|&i| means[i as usize]).collect();
        scale(&mut positions, 3, f64::from(self.position_scale));
        let row = |i: usize| semantics[i * columns..][..columns].iter().chain(&positions[3 * i..][..3]).copied();
        let points: Vec<f32> = (0..n).flat_map(row).collect();
        let pairs = candidates(&points, columns + 3, self.neighbours);
        let affinities: Vec<f64> = pairs.par_iter().map(|&(a, b)| affinity(lifted.of(a), lifted.of(b))).collect();
        let (mut labels, instances) = tree(n, &pairs, &affinities, self);
        let left = labels.iter().filter(|&&label| label < 0).count();
        settle(&mut labels, &pairs, &affinities);
        stage.info(&format!("{} pairs, {instances} instances, {left} Gaussians left over at first", pairs.len()));
        let labels = world.spread(&labels);
        let matches = world.matches(&labels, 0.0)?;
        Ok(Product::Instances(Grouping { labels, instances, matches, ..Grouping::default() }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::options;

    fn share(image: u32, mask: u32, weight: f32) -> Share {
        Share { image, mask, weight }
    }

    #[test]
    fn affinity_is_the_weighted_chance_of_a_common_mask() {
        let a = [share(0, 0, 3.0), share(0, 1, 1.0), share(2, 5, 2.0), share(3, 8, 9.0)];
        let b = [share(0, 0, 8.0), share(0, 1, 8.0), share(1, 3, 7.0), share(2, 6, 2.0)];
        // Views 0 and 2 show both. View 0: 3/4 * 1/2 + 1/4 * 1/2 = 1/2, by weight sqrt(4 * 16) = 8. View 2: 0, by weight 2.
        assert_eq!(affinity(&a, &b), 0.4);
        assert_eq!(affinity(&b, &a), 0.4);
        assert_eq!(affinity(&a[2..3], &a[2..3]), 1.0);
        assert_eq!(affinity(&a[3..], &b), 0.0, "no view shows both");
    }

    #[test]
    fn principal_components_find_the_long_axis_and_survive_rows_that_are_alike() {
        // Along (3, 4) / 5 at -5, 0 and 5.
        let values = [-3.0, -4.0, 0.0, 0.0, 3.0, 4.0];
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let (columns, mut found) = principal(&values, 2, 1, &mut rng);
        assert_eq!(columns, 1);
        assert!(found.iter().zip([5.0f32, 0.0, 5.0]).all(|(v, e)| (v.abs() - e).abs() < 1e-5), "{found:?}");
        assert!(found[0] * found[2] < 0.0);
        // Variance 50 / 3; to deviation 2.
        scale(&mut found, 1, 2.0);
        assert!((found[0].abs() - 5.0 * 2.0 / (50.0f32 / 3.0).sqrt()).abs() < 1e-5);
        let (_, alike) = principal(&[1.0; 20], 2, 2, &mut rng);
        assert!(alike.iter().all(|v| v.abs() < 1e-6), "{alike:?}");
    }

    #[test]
    fn candidates_are_the_nearest_with_ties_by_index() {
        // On a line at 0, 1, 2, 10: point 1 is as near to 0 as to 2.
        assert_eq!(candidates(&[0.0, 1.0, 2.0, 10.0], 1, 1), [(0, 1), (1, 2), (2, 3)]);
        // Against a search of all pairs, on a grid full of ties and with points that coincide.
        let points: Vec<f32> = (0..400).flat_map(|i| [(i % 7) as f32, (i / 7 % 5) as f32, (i % 3) as f32]).collect();
        let at = |i: usize| &points[i * 3..i * 3 + 3];
        let mut expected = Vec::new();
        for i in 0..400 {
            let square = |j: usize| at(i).iter().zip(at(j)).map(|(a, b)| (a - b).powi(2)).sum::<f32>() as u32;
            let mut all: Vec<(u32, usize)> = (0..400).filter(|&j| j != i).map(|j| (square(j), j)).collect();
            all.sort_unstable();
            expected.extend(all[..9].iter().map(|&(_, j)| (i.min(j) as u32, i.max(j) as u32)));
        }
        expected.sort_unstable();
        expected.dedup();
        assert_eq!(candidates(&points, 3, 9), expected);
    }

    #[test]
    fn the_tree_keeps_firm_groups_drops_redundant_splits_and_settles_the_rest() {
        // Four cliques of three at affinity 1. The first two hold at 0.92, so that their split is redundant; both hold on the third
        // at 0.88, all on the last at 0.2. Point 12 hangs on the last by 0.1 and on the first by 0.05.
        // Lambda is 1 / (1.1 - affinity): 10, 5.56, 4.55, 1.11. Masses are 3 (10 - 5.56) = 13.3 for each of the first two against
        // 6 (5.56 - 4.55) = 6.1 for both, and with 3 (10 - 4.55) = 16.4 for the third they outweigh 9 (4.55 - 1.11) = 30.9.
        let mut pairs: Vec<(u32, u32)> =
            (0..4).flat_map(|c| [(0, 1), (0, 2), (1, 2)].map(|(a, b)| (3 * c + a, 3 * c + b))).collect();
        let mut affinities = vec![1.0; pairs.len()];
        for (pair, affinity) in [((2, 3), 0.92), ((5, 6), 0.88), ((8, 9), 0.2), ((11, 12), 0.1), ((0, 12), 0.05)] {
            pairs.push(pair);
            affinities.push(affinity);
        }
        let (mut labels, k) = tree(13, &pairs, &affinities, &options("--min-size=3 --min-points=2"));
        assert_eq!(k, 3);
        assert_eq!(labels[12], -1);
        settle(&mut labels, &pairs, &affinities);
        let groups = [&labels[0..6], &labels[6..9], &labels[9..13]];
        assert!(groups.iter().all(|g| g.iter().all(|l| *l == g[0] && *l >= 0)), "{labels:?}");
        let (_, k) = tree(13, &pairs, &affinities, &options("--min-size=3 --min-points=2 --redundant=1"));
        assert_eq!(k, 4);
    }

    #[test]
    fn lifted_features_are_means_by_weight() {
        let lifted =
            Lifted { start: vec![0; 3], shares: Vec::new(), sums: vec![3.0, 1.0, 0.0, 2.0], weights: vec![4.0, 2.0] };
        assert_eq!(lifted.means(2), [0.75, 0.25, 0.0, 1.0]);
    }
}
