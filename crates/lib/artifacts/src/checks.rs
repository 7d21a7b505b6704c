//! What readers and writers of several artifacts share.

use gs_io::artifact::Element;
use gs_io::{Artifact, Error, Result};
use ndarray::Array2;
use std::fmt::Display;

/// Names of the views (file stems) that an artifact speaks of.
pub(crate) fn view_names(a: &Artifact) -> Result<Vec<String>> {
    serde_json::from_value(a.provenance().extra["views"].clone())
        .map_err(|e| Error::new(format!("no list of view names: {e}")).file(a.path()).field("views"))
}

/// A tensor of rows and columns.
pub(crate) fn table<T: Element>(a: &Artifact, name: &str, shape: [Option<usize>; 2]) -> Result<Array2<T>> {
    let values = a.tensor::<T>(name, &shape)?.to_vec();
    shaped(a, name, values)
}

/// The values of a tensor of rows and columns, all finite, that was left in the file.
pub(crate) fn finite(a: &Artifact, name: &str, rows: usize) -> Result<Array2<f32>> {
    let dim = a.extents::<f32>(name, &[Some(rows), None])?[1];
    let values: Vec<f32> = a.read(name, 0..rows * dim)?;
    if let Some(at) = values.iter().position(|v| !v.is_finite()) {
        return Err(Error::new("not a finite number")
            .file(a.path())
            .field(format!("{name}[{}][{}]", at / dim, at % dim))
            .found(values[at])
            .hint("run the stage that makes it again"));
    }
    shaped(a, name, values)
}

fn shaped<T: Element>(a: &Artifact, name: &str, values: Vec<T>) -> Result<Array2<T>> {
    let shape = a.extents::<T>(name, &[None, None])?;
    Ok(Array2::from_shape_vec((shape[0], shape[1]), values).expect("as many values as its extents say"))
}

/// Refuses tensor `name` where one of its values is not `good`, as a function of its position and itself.
pub(crate) fn check<T: Copy + Display>(
    a: &Artifact,
    name: &str,
    values: &[T],
    good: impl Fn(usize, T) -> bool,
    wrong: &str,
    expected: impl Fn(usize) -> String,
) -> Result<()> {
    check_part(a, name, 0, values, good, wrong, expected)
}

/// [`check`] of some values, of which the first is the tensor's value `first`.
pub(crate) fn check_part<T: Copy + Display>(
    a: &Artifact,
    name: &str,
    first: usize,
    values: &[T],
    good: impl Fn(usize, T) -> bool,
    wrong: &str,
    expected: impl Fn(usize) -> String,
) -> Result<()> {
    match (0..values.len()).find(|&i| !good(i, values[i])) {
        None => Ok(()),
        Some(at) => Err(Error::new(wrong)
            .file(a.path())
            .field(format!("{name}[{}]", first + at))
            .found(values[at])
            .expected(expected(at))
            .hint("run the stage that makes it again")),
    }
}

/// Checks that every index of tensor `name` is below `limit`.
pub(crate) fn below(a: &Artifact, name: &str, indices: &[u32], limit: usize) -> Result<()> {
    below_part(a, name, 0, indices, limit)
}

/// [`below`] of some values, of which the first is the tensor's value `first`.
pub(crate) fn below_part(a: &Artifact, name: &str, first: usize, indices: &[u32], limit: usize) -> Result<()> {
    let expected = |_| format!("below {limit}");
    check_part(a, name, first, indices, |_, i| (i as usize) < limit, "index out of range", expected)
}

/// Checks that `kept` ascends and stays below `total` (where known: `usize::MAX` otherwise).
pub(crate) fn check_kept(a: &Artifact, kept: &[u32], total: usize) -> Result<()> {
    below(a, "kept", kept, total)?;
    let ascends = |at: usize, k| at == 0 || kept[at - 1] < k;
    check(a, "kept", kept, ascends, "indices do not ascend", |at| format!("more than {}", kept[at - 1]))
}

/// Checks that labels are instances, or -1.
pub(crate) fn check_labels(a: &Artifact, name: &str, labels: &[i32], instances: usize) -> Result<()> {
    let good = |_, l| (-1..instances as i64).contains(&i64::from(l));
    check(a, name, labels, good, "index out of range", |_| format!("-1 to {}", instances as i64 - 1))
}

/// One field of all rows of a table, as a tensor.
pub(crate) fn column<S, T>(all: &[S], field: impl Fn(&S) -> T) -> Vec<T> {
    all.iter().map(field).collect()
}
