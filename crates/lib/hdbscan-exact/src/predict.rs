//! Points that took no part in a clustering get the cluster that they would have fallen into.

use crate::kdtree::Unique;
use crate::neighbours::{density_tree, nearest, neighbours};
use crate::select::Clusters;
use crate::{Clustering, NEVER, Options};

/// What [`approximate_predict`] says.
#[derive(Debug, Clone, PartialEq)]
pub struct Prediction {
    /// Cluster of every query, -1 for noise.
    pub labels: Vec<i32>,
    /// How firmly it belongs to it, 0 to 1; 0 for noise.
    pub probabilities: Vec<f32>,
    /// The cluster of the tree that it falls into: the smallest that holds it, whether selected or not.
    pub nodes: Vec<u32>,
}

/// The clusters of `queries`, `[m][dim]`, in `clustering`, which [`crate::cluster`] made of `points`, `[n][dim]`, with the same
/// `options`. The hierarchy stays as it is: a query joins the cluster of its neighbour by mutual reachability, or the ancestor
/// of it that holds at this distance.
///
/// By the rules of Python's `hdbscan` to the letter. With `m` = `min_samples` - 1, which is what it calls `min_samples`: the
/// neighbour is one of the 2 `m` nearest points; a point's core distance is here the one to its `m`-th nearest, itself
/// counted (one less than the tree was made with); that of a query the one to its (`m` + 1)-th nearest. So a query at the place
/// of a point need not get that point's label. The one difference: where the root is a cluster (`allow_single_cluster`),
/// queries that would leave it before any of its points stays are noise here, as points are, and members there.
///
/// # Panics
/// When `dim` is 0 or does not divide the numbers of values, a value is not finite, or `clustering` is not of `points`.
pub fn approximate_predict(
    points: &[f32],
    dim: usize,
    clustering: &Clustering,
    options: &Options,
    queries: &[f32],
) -> Prediction {
    assert!(dim > 0 && points.len().is_multiple_of(dim), "points are [n][dim]");
    assert!(queries.len().is_multiple_of(dim), "queries are [m][dim]");
    assert!(points.iter().chain(queries).all(|v| v.is_finite()), "points are finite");
    let count = queries.len() / dim;
    let unique = Unique::new(&options.metric.prepare(points, dim), dim);
    let queries = &*options.metric.prepare(queries, dim);
    let m = unique.weights.len();
    assert_eq!(m, clustering.tree.points as usize, "the clustering is of other points");
    if m == 0 || count == 0 {
        return Prediction { labels: vec![-1; count], probabilities: vec![0.0; count], nodes: vec![m as u32; count] };
    }
    let tree =
        density_tree(&unique.points, dim, &unique.weights, options.min_samples, &NEVER).expect("nothing stops it");
    let others = options.min_samples.saturating_sub(1).max(1);
    let core = neighbours(&tree, &unique.weights, others, &NEVER).expect("nothing stops it").core;
    let near = nearest(&tree, &unique.weights, queries, 2 * others);
    let clusters = Clusters::new(&clustering.tree);
    let selected: Vec<usize> = clustering.selected.iter().map(|&c| c as usize - m).collect();
    let label_of = clusters.labels(&selected);
    // Cluster and lambda at which each point leaves the tree.
    let mut leaves = vec![(0, 0.0); m];
    for e in clustering.tree.edges.iter().filter(|e| (e.child as usize) < m) {
        leaves[e.child as usize] = (e.parent as usize - m, e.lambda);
    }
    let least_in_root = clusters.least_in_root(&clustering.tree, options.epsilon);
    let predict = |row: &Vec<(f64, u32)>| -> (i32, (f32, u32)) {
        let mut held = 0;
        let mut own_core = 0.0;
        for &(d, q) in row {
            if held > others as u64 {
                break;
            }
            held += u64::from(unique.weights[tree.order[q as usize] as usize]);
            own_core = d;
        }
        let reach = |&(d, q): &(f64, u32)| d.max(own_core).max(core[q as usize]);
        let closest = row.iter().map(|b| (reach(b), b.0, tree.order[b.1 as usize]));
        let by = |a: &(f64, f64, u32), b: &(f64, f64, u32)| {
            a.0.total_cmp(&b.0).then(a.1.total_cmp(&b.1)).then(a.2.cmp(&b.2))
        };
        let Some((distance, _, neighbour)) = closest.min_by(by) else { return (-1, (0.0, m as u32)) };
        let distance = options.metric.of_euclidean(distance);
        let lambda = if distance > 0.0 { 1.0 / distance } else { f64::INFINITY };
        let (mut cluster, left) = leaves[neighbour as usize];
        if left > lambda {
            while let Some(parent) = clusters.parent[cluster].filter(|_| clusters.birth[cluster] >= lambda) {
                cluster = parent;
            }
        }
        let node = (cluster + m) as u32;
        let Some(label) = label_of[cluster] else { return (-1, (0.0, node)) };
        if selected[label] == 0 && lambda < least_in_root {
            return (-1, (0.0, node));
        }
        (label as i32, (clusters.probability(selected[label], lambda), node))
    };
    let (labels, (probabilities, nodes)) = near.iter().map(predict).unzip();
    Prediction { labels, probabilities, nodes }
}
