//! Farthest points and nearest neighbours of points in space.

use crate::work::run;
use graph_precompute::positions::shifted;
use gs_scene::points::{KdTree, farthest_points};
use numpy::{IntoPyArray, PyArray1, PyArray2, PyReadonlyArray2};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;

/// The tree over points [n, 3], all of which must be within what f32 can square.
fn tree_of(points: &[[f32; 3]]) -> PyResult<KdTree> {
    let near = shifted(points);
    let odd = near.usable.iter().zip(0u32..).find(|(a, b)| **a != *b).map_or(near.usable.len(), |u| u.1 as usize);
    if odd < points.len() {
        return Err(PyValueError::new_err(format!("point {odd} is not finite, or beyond 1e18")));
    }
    Ok(KdTree::new(&near.points))
}

fn rows(points: &PyReadonlyArray2<'_, f32>) -> Vec<[f32; 3]> {
    points.as_array().rows().into_iter().map(|r| [r[0], r[1], r[2]]).collect()
}

/// `count` points of [n, 3], each the farthest from those before it, and the nearest of them to every point.
#[pyfunction]
#[expect(clippy::type_complexity, reason = "two arrays")]
pub fn farthest_point_sample<'py>(
    py: Python<'py>,
    points: PyReadonlyArray2<'py, f32>,
    count: usize,
    start: u32,
    threads: usize,
) -> PyResult<(Bound<'py, PyArray1<i64>>, Bound<'py, PyArray1<i64>>)> {
    let points = rows(&points);
    let found = run(py, threads, |_| tree_of(&points).map(|tree| farthest_points(&tree, count, start)))??;
    let wide = |of: Vec<u32>| of.into_iter().map(i64::from).collect::<Vec<i64>>();
    Ok((wide(found.anchors).into_pyarray(py), wide(found.nearest).into_pyarray(py)))
}

/// The `k` nearest other points of each of [n, 3].
#[pyfunction]
pub fn nearest_neighbours<'py>(
    py: Python<'py>,
    points: PyReadonlyArray2<'py, f32>,
    k: usize,
    threads: usize,
) -> PyResult<Bound<'py, PyArray2<i64>>> {
    let points = rows(&points);
    let found = run(py, threads, |_| tree_of(&points).map(|tree| tree.all_nearest(k)))??;
    Ok(found.mapv(i64::from).into_pyarray(py))
}
