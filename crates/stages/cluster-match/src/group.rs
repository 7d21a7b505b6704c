//! Clustering of Gaussians by their features.

use artifacts::{Graph, TreeEdge, flat};
use hdbscan_exact::{Clustering, Edge, Options, cluster, cluster_graph};
use ndarray::Array2;
use rayon::prelude::*;

/// Gaussians that one task handles.
const CHUNK: usize = 4096;

/// Features standardised per dimension over all Gaussians, (f - mean) / deviation (paper, "Instance Clustering"); a dimension
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

/// Clusters the kept Gaussians by their features, `[n][dim]`, on the graph of spatial neighbours.
pub fn on_graph(features: &Array2<f32>, graph: &Graph, options: &Options) -> Clustering {
    let chords = Chords::new(flat(features.view()).to_vec(), features.ncols().max(1));
    let edges = neighbour_edges(graph, &chords, options.min_samples);
    drop(chords);
    cluster_graph(graph.kept.len(), edges, options)
}

/// Clusters the Gaussians by their features as free points (paper, "Instance Clustering").
pub fn free(features: &Array2<f32>, options: &Options) -> Clustering {
    let dim = features.ncols().max(1);
    cluster(&standardise(flat(features.view()), dim), dim, options)
}

/// Distances of features on the graph: lengths of the difference at unit length, sqrt(2 - 2 cosine).
struct Chords {
    /// Features at unit length; zeros where there is no direction.
    values: Vec<f32>,
    /// Which of them have no direction.
    nowhere: Vec<bool>,
    dim: usize,
}

impl Chords {
    fn new(mut values: Vec<f32>, dim: usize) -> Self {
        values.par_chunks_mut(dim).with_min_len(CHUNK).for_each(unit);
        let nowhere = values.par_chunks(dim).with_min_len(CHUNK).map(|row| row.iter().all(|&v| v == 0.0)).collect();
        Self { values, nowhere, dim }
    }

    fn get(&self, a: usize, b: usize) -> f64 {
        // A feature without a direction has a cosine of 0 with any other.
        if self.nowhere[a] || self.nowhere[b] {
            return 2.0f64.sqrt();
        }
        // Differences keep the digits that 1 - dot product would lose between near-equal features.
        let row = |i: usize| &self.values[i * self.dim..(i + 1) * self.dim];
        square_of_difference(row(a), row(b)).sqrt()
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
fn neighbour_edges(graph: &Graph, between: &Chords, min_samples: usize) -> Vec<Edge> {
    let (n, k) = (graph.kept.len(), graph.gaussian_knn.ncols());
    let list = |i: usize| flat(graph.gaussian_knn.row(i));
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
    use ndarray::arr2;

    #[test]
    fn standardised_dimensions_have_mean_0_and_deviation_1_and_constants_vanish() {
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
    fn two_rods() -> Graph {
        let n = 60usize;
        let neighbours = (0..n as i32).map(|i| {
            let (low, high) = if i < 30 { (0, 29) } else { (30, 59) };
            [i - 2, i - 1, i + 1, i + 2].map(|j| j.clamp(low, high) as u32)
        });
        let gaussian_knn = neighbours.collect::<Vec<_>>().into();
        Graph { kept: (0..n as u32).collect(), gaussian_knn, ..Graph::default() }
    }

    #[test]
    fn rods_of_one_feature_are_one_thing_in_features_and_two_in_space() {
        let g = two_rods();
        let f = Array2::from_shape_fn((60, 2), |(i, c)| [1.0, 0.001 * (i % 7) as f32][c]);
        let o = Options { min_cluster_size: 10, min_samples: 3, epsilon: 0.1, ..Options::default() };
        let c = on_graph(&f, &g, &o);
        assert_eq!(c.selected.len(), 2);
        assert_ne!(c.labels[5], c.labels[45]);
    }

    #[test]
    fn distances_are_those_of_the_angle() {
        let chords = Chords::new(vec![2.0, 0.0, 0.0, 3.0, 0.0, 0.0, 5.0, 5.0, 4.0, 0.0], 2);
        let root = 0.5f64.sqrt();
        for (a, b, expected) in [(0, 1, 1.0), (0, 3, 1.0 - root), (0, 4, 0.0), (0, 2, 1.0), (2, 2, 1.0)] {
            assert!((chords.get(a, b) - (2.0 * expected).sqrt()).abs() < 1e-7, "{a} {b}");
        }
    }

    #[test]
    fn every_pair_of_neighbours_has_one_edge() {
        // 0 and 1 name each other, 2 names 0 only, 3 is alone: padded with itself.
        let graph =
            Graph { kept: (0..4).collect(), gaussian_knn: arr2(&[[1, 0], [0, 1], [0, 2], [3, 3]]), ..Graph::default() };
        let between = Chords::new(vec![1.0, 0.0, 1.0, 0.1, 1.0, 0.3, 1.0, 0.9], 2);
        let pairs = |samples| -> Vec<(u32, u32, f64)> {
            neighbour_edges(&graph, &between, samples).into_iter().map(|e| (e.a, e.b, e.weight)).collect()
        };
        let [near, far] = [between.get(0, 1), between.get(0, 2)];
        assert_eq!(pairs(1), [(0, 1, near), (0, 2, far)]);
        // Core distances of the second nearest, itself included, change nothing here; a larger edge stays.
        assert_eq!(pairs(2), [(0, 1, near), (0, 2, far)]);
        // Nine dimensions: whole partial sums and a rest.
        let (a, b): (Vec<f32>, Vec<f32>) = (0..9).map(|c| (c as f32, 2.0 * c as f32)).unzip();
        assert_eq!(square_of_difference(&a, &b), 204.0);
    }
}
