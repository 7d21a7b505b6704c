//! Clustering of Gaussians by their features.

use artifacts::{Features, Graph, TreeEdge};
use hdbscan_exact::{Clustering, Edge, Options, approximate_predict, cluster, cluster_graph};
use rand::seq::index;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rayon::prelude::*;

/// Gaussians that one task handles.
const CHUNK: usize = 4096;

/// Which pairs of Gaussians the hierarchy may join.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Space {
    /// Any two: HDBSCAN of standardised features as free points (the paper)
    Free,
    /// Spatial neighbours only: HDBSCAN on the graph of neighbours
    Graph,
}

/// How far apart the features of two spatial neighbours are.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Distance {
    /// 1 - cosine
    Cosine,
    /// Length of the difference of the features at unit length, sqrt(2 - 2 cosine)
    Chord,
    /// Length of the difference of the standardised features
    Euclidean,
}

/// Features standardised per channel over all Gaussians, (f - mean) / deviation (paper, "Instance Clustering"); a channel
/// without deviation becomes zeros. Sums in f64.
pub fn standardise(values: &[f32], dim: usize) -> Vec<f32> {
    let n = (values.len() / dim.max(1)).max(1) as f64;
    let sums = |f: &(dyn Fn(usize, f64) -> f64 + Sync)| -> Vec<f64> {
        let parts: Vec<Vec<f64>> = values
            .par_chunks(CHUNK * dim)
            .map(|rows| {
                let mut s = vec![0.0; dim];
                for row in rows.chunks_exact(dim) {
                    for (c, v) in row.iter().enumerate() {
                        s[c] += f(c, f64::from(*v));
                    }
                }
                s
            })
            .collect();
        let mut total = vec![0.0; dim];
        for part in parts {
            total.iter_mut().zip(part).for_each(|(t, p)| *t += p);
        }
        total
    };
    let mean: Vec<f64> = sums(&|_, v| v).iter().map(|s| s / n).collect();
    let deviation: Vec<f64> = sums(&|c, v| (v - mean[c]).powi(2)).iter().map(|s| (s / n).sqrt()).collect();
    // A deviation that is rounding noise of the mean is no deviation.
    let scale: Vec<f64> =
        mean.iter().zip(&deviation).map(|(m, d)| if *d > 1e-6 * m.abs().max(1e-30) { 1.0 / d } else { 0.0 }).collect();
    let mut out = vec![0.0; values.len()];
    out.par_chunks_mut(dim).zip(values.par_chunks(dim)).with_min_len(CHUNK).for_each(|(o, v)| {
        for c in 0..dim {
            o[c] = ((f64::from(v[c]) - mean[c]) * scale[c]) as f32;
        }
    });
    out
}

/// Features averaged over each Gaussian and its spatial neighbours, `rounds` times.
pub fn smooth(values: &[f32], dim: usize, neighbours: &[u32], k: usize, rounds: usize) -> Vec<f32> {
    let mut now = values.to_vec();
    for _ in 0..rounds {
        let mut next = vec![0.0; now.len()];
        next.par_chunks_mut(dim).enumerate().with_min_len(CHUNK).for_each(|(i, out)| {
            out.copy_from_slice(&now[i * dim..(i + 1) * dim]);
            for &j in &neighbours[i * k..(i + 1) * k] {
                for (o, v) in out.iter_mut().zip(&now[j as usize * dim..(j as usize + 1) * dim]) {
                    *o += v;
                }
            }
            out.iter_mut().for_each(|o| *o /= (k + 1) as f32);
        });
        now = next;
    }
    now
}

/// Clusters the kept Gaussians. `distance` counts on the graph only.
pub fn group(
    features: &Features,
    graph: &Graph,
    space: Space,
    distance: Distance,
    smoothing: usize,
    options: &Options,
) -> Clustering {
    let dim = features.dim.max(1);
    let values = smooth(&features.values, dim, &graph.gaussian_knn, graph.gaussian_k, smoothing);
    match space {
        Space::Free => cluster(&standardise(&values, dim), dim, options),
        Space::Graph => {
            let between = FeatureDistance::new(values, dim, distance);
            let edges = neighbour_edges(graph, &between, options.min_samples);
            drop(between);
            cluster_graph(features.kept.len(), edges, options)
        }
    }
}

/// Clusters a random `sample` of the kept Gaussians as free points, and gives the others the clusters that they would fall
/// into. `min_cluster_size` shrinks with the sample, to 2 at least. The tree speaks of the sample alone.
pub fn group_sample(
    features: &Features,
    graph: &Graph,
    smoothing: usize,
    sample: usize,
    seed: u64,
    options: &Options,
) -> Clustering {
    let dim = features.dim.max(1);
    let n = features.kept.len();
    let values = standardise(&smooth(&features.values, dim, &graph.gaussian_knn, graph.gaussian_k, smoothing), dim);
    if sample >= n {
        return cluster(&values, dim, options);
    }
    let mut chosen = index::sample(&mut ChaCha8Rng::seed_from_u64(seed), n, sample).into_vec();
    chosen.sort_unstable();
    let mut is_chosen = vec![false; n];
    chosen.iter().for_each(|&i| is_chosen[i] = true);
    let rest: Vec<usize> = (0..n).filter(|&i| !is_chosen[i]).collect();
    let rows =
        |of: &[usize]| -> Vec<f32> { of.iter().flat_map(|&i| &values[i * dim..(i + 1) * dim]).copied().collect() };
    let least = (options.min_cluster_size as f64 * sample as f64 / n as f64).ceil() as usize;
    let options = Options { min_cluster_size: least.max(2), ..*options };
    let points = rows(&chosen);
    let mut out = cluster(&points, dim, &options);
    let others = approximate_predict(&points, dim, &out, &options, &rows(&rest));
    let mut labels = vec![-1; n];
    chosen.iter().zip(&out.labels).chain(rest.iter().zip(&others.labels)).for_each(|(&i, &l)| labels[i] = l);
    let mut nodes = vec![0; n];
    chosen.iter().zip(&out.nodes).chain(rest.iter().zip(&others.nodes)).for_each(|(&i, &node)| nodes[i] = node);
    let mut probabilities = vec![0.0; n];
    let all = chosen.iter().zip(&out.probabilities).chain(rest.iter().zip(&others.probabilities));
    all.for_each(|(&i, &p)| probabilities[i] = p);
    // Outlier scores are of clustered points only.
    let mut outlier_scores = vec![0.0; n];
    chosen.iter().zip(&out.outlier_scores).for_each(|(&i, &s)| outlier_scores[i] = s);
    (out.labels, out.nodes) = (labels, nodes);
    (out.probabilities, out.outlier_scores) = (probabilities, outlier_scores);
    out
}

/// Distances of features, [`Distance`].
struct FeatureDistance {
    /// Features at unit length (zeros where there is no direction) or standardised.
    values: Vec<f32>,
    /// Which of them have no direction.
    nowhere: Vec<bool>,
    dim: usize,
    distance: Distance,
}

impl FeatureDistance {
    fn new(values: Vec<f32>, dim: usize, distance: Distance) -> Self {
        let mut values = if distance == Distance::Euclidean { standardise(&values, dim) } else { values };
        if distance != Distance::Euclidean {
            values.par_chunks_mut(dim).with_min_len(CHUNK).for_each(unit);
        }
        let nowhere = values.par_chunks(dim).with_min_len(CHUNK).map(|row| row.iter().all(|&v| v == 0.0)).collect();
        Self { values, nowhere, dim, distance }
    }

    fn get(&self, a: usize, b: usize) -> f64 {
        let row = |i: usize| &self.values[i * self.dim..(i + 1) * self.dim];
        // Differences keep the digits that 1 - dot product would lose between near-equal features.
        let square = match self.distance {
            // A feature without a direction has a cosine of 0 with any other.
            Distance::Cosine | Distance::Chord if self.nowhere[a] || self.nowhere[b] => 2.0,
            _ => square_of_difference(row(a), row(b)),
        };
        if self.distance == Distance::Cosine { 0.5 * square } else { square.sqrt() }
    }
}

/// |a - b|², in f64.
fn square_of_difference(a: &[f32], b: &[f32]) -> f64 {
    const PARTIAL: usize = 8;
    let square = |a: f32, b: f32| (f64::from(a) - f64::from(b)).powi(2);
    let mut sums = [0.0; PARTIAL];
    let (mut a, mut b) = (a.chunks_exact(PARTIAL), b.chunks_exact(PARTIAL));
    for (a, b) in a.by_ref().zip(b.by_ref()) {
        for c in 0..PARTIAL {
            sums[c] += square(a[c], b[c]);
        }
    }
    let rest: f64 = a.remainder().iter().zip(b.remainder()).map(|(&a, &b)| square(a, b)).sum();
    sums.iter().sum::<f64>() + rest
}

/// Brings a feature to unit length, or to zeros where it has no direction.
fn unit(row: &mut [f32]) {
    let norm = row.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
    let scale = if norm > 1e-30 { 1.0 / norm } else { 0.0 };
    row.iter_mut().for_each(|v| *v = (f64::from(*v) * scale) as f32);
}

/// Edges between spatial neighbours with mutual reachability, each once: a Gaussian's core distance is the distance to the
/// (`min_samples` - 1)-th nearest in features among its spatial neighbours, or to the last where there are fewer.
fn neighbour_edges(graph: &Graph, between: &FeatureDistance, min_samples: usize) -> Vec<Edge> {
    let (n, k) = (graph.kept.len(), graph.gaussian_k);
    let list = |i: usize| &graph.gaussian_knn[i * k..(i + 1) * k];
    // To all neighbours; rows are padded with the Gaussian itself, which does not count.
    let mut distances = vec![0.0f64; n * k];
    let core: Vec<f64> = distances
        .par_chunks_mut(k.max(1))
        .enumerate()
        .with_min_len(CHUNK)
        .map_init(Vec::new, |sorted, (i, own)| {
            own.iter_mut().zip(list(i)).for_each(|(d, &j)| *d = between.get(i, j as usize));
            sorted.clear();
            sorted.extend(own.iter().zip(list(i)).filter(|(_, j)| **j as usize != i).map(|(d, _)| *d));
            sorted.sort_unstable_by(f64::total_cmp);
            match min_samples.saturating_sub(1).min(sorted.len()) {
                0 => 0.0,
                at => sorted[at - 1],
            }
        })
        .collect();
    // Of two Gaussians that are each other's neighbours the first has the edge.
    let mine = |i: usize, j: usize| i < j || j < i && !list(j).contains(&(i as u32));
    (0..core.len())
        .into_par_iter()
        .with_min_len(CHUNK)
        .flat_map_iter(|i| {
            let core = &core;
            let neighbours = list(i).iter().map(|&j| j as usize).zip(&distances[i * k..(i + 1) * k]);
            let own = neighbours.filter(move |(j, _)| mine(i, *j));
            own.map(move |(j, &d)| Edge::new(i as u32, j as u32, d.max(core[i]).max(core[j])))
        })
        .collect()
}

/// The cluster-to-cluster edges of the condensed tree, with the instance selected at each child.
pub fn tree(clustering: &Clustering) -> Vec<TreeEdge> {
    let points = clustering.tree.points;
    clustering
        .tree
        .edges
        .iter()
        .filter(|e| e.child >= points)
        .map(|e| TreeEdge {
            parent: e.parent,
            child: e.child,
            lambda: e.lambda.min(f64::from(f32::MAX)) as f32,
            size: e.size,
            instance: clustering.selected.binary_search(&e.child).map_or(-1, |label| label as i32),
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn standardised_channels_have_mean_0_and_deviation_1_and_constants_vanish() {
        let values: Vec<f32> = (0..1000).flat_map(|i| [i as f32 * 0.5 + 1e4, 0.1, -(i as f32)]).collect();
        let s = standardise(&values, 3);
        for c in [0, 2] {
            let mean = s.iter().skip(c).step_by(3).map(|v| f64::from(*v)).sum::<f64>() / 1000.0;
            let square = s.iter().skip(c).step_by(3).map(|v| f64::from(*v).powi(2)).sum::<f64>() / 1000.0;
            assert!(mean.abs() < 1e-5 && (square - 1.0).abs() < 1e-4, "{mean} {square}");
        }
        assert!(s.iter().skip(1).step_by(3).all(|&v| v == 0.0));
    }

    /// Two rods along x with features along two axes; their ends touch neither in space nor in features.
    fn two_rods() -> (Features, Graph) {
        let n = 60usize;
        let values =
            (0..n).flat_map(|i| if i < 30 { [1.0, 0.01 * (i % 7) as f32] } else { [0.01 * (i % 5) as f32, 1.0] });
        let neighbours = (0..n as i32).flat_map(|i| {
            let (low, high) = if i < 30 { (0, 29) } else { (30, 59) };
            [i - 2, i - 1, i + 1, i + 2].map(|j| j.clamp(low, high) as u32)
        });
        let features = Features { kept: (0..n as u32).collect(), dim: 2, values: values.collect() };
        let graph = Graph {
            kept: features.kept.clone(),
            gaussian_k: 4,
            gaussian_knn: neighbours.collect(),
            ..Graph::default()
        };
        (features, graph)
    }

    #[test]
    fn both_spaces_find_two_rods() {
        let (f, g) = two_rods();
        let o = Options { min_cluster_size: 10, min_samples: 3, ..Options::default() };
        for space in [Space::Free, Space::Graph] {
            for distance in [Distance::Cosine, Distance::Chord, Distance::Euclidean] {
                let c = group(&f, &g, space, distance, 0, &o);
                assert_eq!(c.selected.len(), 2, "{space:?} {distance:?}");
                assert!(c.labels[5] != c.labels[45] && c.labels[5] >= 0 && c.labels[45] >= 0, "{space:?} {distance:?}");
                let tree = tree(&c);
                assert_eq!(tree.iter().filter(|e| e.instance >= 0).count(), 2);
            }
        }
    }

    #[test]
    fn a_sample_finds_the_same_two_rods() {
        let (f, g) = two_rods();
        let o = Options { min_cluster_size: 20, min_samples: 3, ..Options::default() };
        let all = group(&f, &g, Space::Free, Distance::Chord, 0, &o);
        assert_eq!(group_sample(&f, &g, 0, 60, 1, &o), all);
        let c = group_sample(&f, &g, 0, 30, 1, &o);
        assert_eq!((c.selected.len(), c.labels.len(), c.tree.points <= 30), (2, 60, true));
        for rod in [&c.labels[..30], &c.labels[30..]] {
            let known: Vec<i32> = rod.iter().copied().filter(|&l| l >= 0).collect();
            assert!(known.len() > 20 && known.iter().all(|&l| l == known[0]), "{rod:?}");
        }
        let in_a_cluster = c.nodes.iter().filter(|n| c.selected.contains(n)).count();
        assert_eq!(in_a_cluster, c.labels.iter().filter(|&&l| l >= 0).count(), "predicted ones have a node as well");
        assert_eq!(c, group_sample(&f, &g, 0, 30, 1, &o));
    }

    #[test]
    fn rods_of_one_feature_are_one_thing_in_features_and_two_in_space() {
        let (mut f, g) = two_rods();
        f.values = (0..60).flat_map(|i| [1.0, 0.001 * (i % 7) as f32]).collect();
        let o = Options { min_cluster_size: 10, min_samples: 3, epsilon: 0.1, ..Options::default() };
        let c = group(&f, &g, Space::Graph, Distance::Chord, 0, &o);
        assert_eq!(c.selected.len(), 2);
        assert_ne!(c.labels[5], c.labels[45]);
    }

    #[test]
    fn distances_are_those_of_the_angle() {
        let values = [2.0, 0.0, 0.0, 3.0, 0.0, 0.0, 5.0, 5.0, 4.0, 0.0];
        let (cosine, chord) =
            [Distance::Cosine, Distance::Chord].map(|d| FeatureDistance::new(values.to_vec(), 2, d)).into();
        let root = 0.5f64.sqrt();
        for (a, b, expected) in [(0, 1, 1.0), (0, 3, 1.0 - root), (0, 4, 0.0), (0, 2, 1.0), (2, 2, 1.0)] {
            assert!((cosine.get(a, b) - expected).abs() < 1e-7, "{a} {b}");
            assert!((chord.get(a, b) - (2.0 * expected).sqrt()).abs() < 1e-7, "{a} {b}");
        }
        let euclidean = FeatureDistance::new(vec![0.0, 7.0, 2.0, 7.0, 0.0, 7.0, 2.0, 7.0], 2, Distance::Euclidean);
        assert!((euclidean.get(0, 1) - 2.0).abs() < 1e-6 && euclidean.get(0, 2) == 0.0);
    }

    #[test]
    fn every_pair_of_neighbours_has_one_edge_whoever_names_whom() {
        // 0 and 1 name each other, 2 names 0 only, 3 is alone: padded with itself.
        let graph = Graph {
            kept: (0..4).collect(),
            gaussian_k: 2,
            gaussian_knn: vec![1, 0, 0, 1, 0, 2, 3, 3],
            ..Graph::default()
        };
        let between = FeatureDistance::new(vec![0.0, 1.0, 3.0, 9.0], 1, Distance::Euclidean);
        let pairs = |samples| -> Vec<(u32, u32, f64)> {
            neighbour_edges(&graph, &between, samples).into_iter().map(|e| (e.a, e.b, e.weight)).collect()
        };
        let [near, far] = [between.get(0, 1), between.get(0, 2)];
        assert_eq!(pairs(1), [(0, 1, near), (0, 2, far)]);
        // Core distances of the second nearest, itself included, change nothing here; a larger edge stays.
        assert_eq!(pairs(2), [(0, 1, near), (0, 2, far)]);
        // Nine channels: whole partial sums and a rest.
        let (a, b): (Vec<f32>, Vec<f32>) = (0..9).map(|c| (c as f32, 2.0 * c as f32)).unzip();
        assert_eq!(square_of_difference(&a, &b), 204.0);
    }

    #[test]
    fn smoothing_averages_over_neighbours() {
        let s = smooth(&[0.0, 3.0, 6.0], 1, &[1, 2, 0, 2, 1, 0], 2, 1);
        assert_eq!(s, [3.0, 3.0, 3.0]);
        assert_eq!(smooth(&[0.0, 3.0, 6.0], 1, &[1, 2, 0, 2, 1, 0], 2, 0), [0.0, 3.0, 6.0]);
    }
}
