//! HDBSCAN (Campello, Moulavi, Sander 2013; McInnes and Healy 2017), exact and deterministic.
//!
//! Core distances come from a kd-tree, the minimum spanning tree of mutual reachability distances from Boruvka's algorithm
//! on the same tree; edges have one total order (weight, smaller index, larger index), so the result does not depend on
//! the number of threads. Points of equal coordinates are collapsed into one with a weight. The same hierarchy can be
//! built from the edges of a given graph ([`cluster_graph`]).
//!
//! `min_samples` counts the point itself, as scikit-learn does (Python's `hdbscan` does not: its 9 is 10 here).

mod agreement;
mod boruvka;
mod condense;
mod kdtree;
mod linkage;
mod metric;
mod neighbours;
mod predict;
mod select;

pub use agreement::adjusted_rand;
pub use condense::{CondensedEdge, CondensedTree};
pub use linkage::Edge;
pub use metric::Metric;
pub use neighbours::core_distances;
pub use predict::{Prediction, approximate_predict};
pub use select::Selection;

use std::sync::atomic::AtomicBool;

/// For what is not to be stopped.
static NEVER: AtomicBool = AtomicBool::new(false);

/// Parameters of a clustering.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Options {
    /// Fewest points of a cluster, at least 2.
    pub min_cluster_size: usize,
    /// Neighbours, the point itself included, whose distance is the core distance; at least 1.
    pub min_samples: usize,
    /// Clusters that are born below this distance are joined with their parents; 0 for none.
    pub epsilon: f64,
    /// How clusters are chosen from the hierarchy.
    pub selection: Selection,
    /// Whether all points may be one cluster.
    pub allow_single_cluster: bool,
    /// What distance is between points; edges of a graph have theirs.
    pub metric: Metric,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            min_cluster_size: 5,
            min_samples: 5,
            epsilon: 0.0,
            selection: Selection::ExcessOfMass,
            allow_single_cluster: false,
            metric: Metric::Euclidean,
        }
    }
}

/// The result of a clustering.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Clustering {
    /// Cluster of every point, from 0; -1 for noise.
    pub labels: Vec<i32>,
    /// How firmly a point belongs to its cluster, 0 to 1; 0 for noise.
    pub probabilities: Vec<f32>,
    /// How far a point is an outlier of the densest it could belong to, 0 to 1: (last - lambda) / last, where it leaves its
    /// cluster of the tree at lambda and `last` is the largest finite lambda in that cluster and below (GLOSH, Campello,
    /// Moulavi, Zimek and Sander 2015).
    pub outlier_scores: Vec<f32>,
    /// The cluster of the tree that every point leaves it from: the smallest that holds it, whether selected or not.
    pub nodes: Vec<u32>,
    /// The distinct point of the tree that every point is.
    pub distinct: Vec<u32>,
    /// The condensed tree.
    pub tree: CondensedTree,
    /// The node of the tree that was selected for each cluster, by label.
    pub selected: Vec<u32>,
}

/// Clusters `points`, `[n][dim]` flattened.
///
/// # Panics
/// When `dim` is 0, does not divide the number of values, or a value is not finite; with [`Metric::Cosine`] also when a point
/// is 0.
pub fn cluster(points: &[f32], dim: usize, options: &Options) -> Clustering {
    cluster_until(points, dim, options, &NEVER).expect("nothing stops it")
}

/// [`cluster`], which ends soon after `stop` is set, with nothing.
///
/// # Panics
/// As [`cluster`].
pub fn cluster_until(points: &[f32], dim: usize, options: &Options, stop: &AtomicBool) -> Option<Clustering> {
    assert!(dim > 0 && points.len().is_multiple_of(dim), "points are [n][dim]");
    assert!(points.iter().all(|v| v.is_finite()), "points are finite");
    let unique = kdtree::Unique::new(&options.metric.prepare(points, dim), dim);
    let (mut edges, mut core) =
        boruvka::spanning_tree(&unique.points, dim, &unique.weights, options.min_samples, stop)?;
    // The order of the edges stays.
    edges.iter_mut().for_each(|e| e.weight = options.metric.of_euclidean(e.weight));
    core.iter_mut().for_each(|c| *c = options.metric.of_euclidean(*c));
    let tree = condense::condense(&edges, &unique.weights, &core, options.min_cluster_size);
    Some(select::label(tree, &unique.of_point, options))
}

/// Clusters `n` points by the edges of a graph, weights being distances; parts of the graph that are not connected are
/// joined at infinite distance.
///
/// # Panics
/// When an edge names a point beyond `n` or has a weight that is NaN or negative.
pub fn cluster_graph(n: usize, edges: impl Into<Vec<Edge>>, options: &Options) -> Clustering {
    let forest = linkage::spanning_forest(n, edges);
    let tree = condense::condense(&forest, &vec![1; n], &vec![0.0; n], options.min_cluster_size);
    let identity: Vec<u32> = (0..n as u32).collect();
    select::label(tree, &identity, options)
}
