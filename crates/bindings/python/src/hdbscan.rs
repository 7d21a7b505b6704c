//! HDBSCAN.

use crate::work::run;
use hdbscan_exact::{
    Clustering, CondensedEdge, CondensedTree, Edge, Metric, Options, Selection, approximate_predict, cluster_graph,
    cluster_until,
};
use numpy::{IntoPyArray, PyArray1, PyReadonlyArray1, PyReadonlyArray2};
use pyo3::prelude::*;
use pyo3::types::PyDict;

/// Parameters, as the Python half checked them.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct Parameters {
    min_cluster_size: usize,
    min_samples: usize,
    epsilon: f64,
    leaf: bool,
    allow_single_cluster: bool,
    cosine: bool,
    threads: usize,
}

impl Parameters {
    fn options(&self) -> Options {
        Options {
            min_cluster_size: self.min_cluster_size,
            min_samples: self.min_samples,
            epsilon: self.epsilon,
            selection: if self.leaf { Selection::Leaf } else { Selection::ExcessOfMass },
            allow_single_cluster: self.allow_single_cluster,
            metric: if self.cosine { Metric::Cosine } else { Metric::Euclidean },
        }
    }
}

/// The condensed tree over distinct points, column by column.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub struct Tree<'py> {
    parent: PyReadonlyArray1<'py, u32>,
    child: PyReadonlyArray1<'py, u32>,
    lambda_val: PyReadonlyArray1<'py, f64>,
    child_size: PyReadonlyArray1<'py, u32>,
    points: u32,
    clusters: u32,
    selected: PyReadonlyArray1<'py, u32>,
}

/// Clusters points [n, dim].
#[pyfunction]
pub fn hdbscan<'py>(
    py: Python<'py>,
    points: PyReadonlyArray2<'py, f32>,
    parameters: Parameters,
) -> PyResult<Bound<'py, PyDict>> {
    let dim = points.as_array().ncols();
    let points: Vec<f32> = points.as_array().iter().copied().collect();
    let options = parameters.options();
    let found = run(py, parameters.threads, |stop| cluster_until(&points, dim, &options, stop))?;
    found.map_or_else(|| Ok(PyDict::new(py)), |c| to_python(py, c))
}

/// Clusters n points by edges (a, b) of given lengths.
#[pyfunction]
pub fn hdbscan_graph<'py>(
    py: Python<'py>,
    n: usize,
    a: PyReadonlyArray1<'py, u32>,
    b: PyReadonlyArray1<'py, u32>,
    weight: PyReadonlyArray1<'py, f64>,
    parameters: Parameters,
) -> PyResult<Bound<'py, PyDict>> {
    let (a, b, weight) = (a.as_array(), b.as_array(), weight.as_array());
    let edges: Vec<Edge> = a.iter().zip(b).zip(weight).map(|((&a, &b), &w)| Edge::new(a, b, w)).collect();
    let options = parameters.options();
    to_python(py, run(py, parameters.threads, |_| cluster_graph(n, edges, &options))?)
}

/// The clusters of queries [m, dim]: labels and probabilities.
#[pyfunction]
#[expect(clippy::type_complexity, reason = "two arrays")]
pub fn hdbscan_predict<'py>(
    py: Python<'py>,
    points: PyReadonlyArray2<'py, f32>,
    tree: Tree<'py>,
    queries: PyReadonlyArray2<'py, f32>,
    parameters: Parameters,
) -> PyResult<(Bound<'py, PyArray1<i32>>, Bound<'py, PyArray1<f32>>)> {
    let dim = points.as_array().ncols();
    let [points, queries] = [points, queries].map(|p| p.as_array().iter().copied().collect::<Vec<f32>>());
    let rows = tree.parent.as_array().into_iter().zip(tree.child.as_array());
    let rows = rows.zip(tree.lambda_val.as_array()).zip(tree.child_size.as_array());
    let edge = |(((&parent, &child), &lambda), &size)| CondensedEdge { parent, child, lambda, size };
    let clustering = Clustering {
        tree: CondensedTree { points: tree.points, clusters: tree.clusters, edges: rows.map(edge).collect() },
        selected: tree.selected.as_array().to_vec(),
        ..Clustering::default()
    };
    let options = parameters.options();
    let found = run(py, parameters.threads, |_| approximate_predict(&points, dim, &clustering, &options, &queries))?;
    Ok((found.labels.into_pyarray(py), found.probabilities.into_pyarray(py)))
}

fn to_python(py: Python<'_>, c: Clustering) -> PyResult<Bound<'_, PyDict>> {
    let out = PyDict::new(py);
    out.set_item("labels", c.labels.into_pyarray(py))?;
    out.set_item("probabilities", c.probabilities.into_pyarray(py))?;
    out.set_item("outlier_scores", c.outlier_scores.into_pyarray(py))?;
    out.set_item("distinct", c.distinct.into_pyarray(py))?;
    let tree = PyDict::new(py);
    let edges = &c.tree.edges;
    tree.set_item("parent", edges.iter().map(|e| e.parent).collect::<Vec<_>>().into_pyarray(py))?;
    tree.set_item("child", edges.iter().map(|e| e.child).collect::<Vec<_>>().into_pyarray(py))?;
    tree.set_item("lambda_val", edges.iter().map(|e| e.lambda).collect::<Vec<_>>().into_pyarray(py))?;
    tree.set_item("child_size", edges.iter().map(|e| e.size).collect::<Vec<_>>().into_pyarray(py))?;
    tree.set_item("points", c.tree.points)?;
    tree.set_item("clusters", c.tree.clusters)?;
    tree.set_item("selected", c.selected.into_pyarray(py))?;
    out.set_item("tree", tree)?;
    Ok(out)
}
