//! Inputs of a graph that are always the same, as `model.json` gives them.

use gs_io::{Error, Result};
use onnx_models::{Kind, Tensor, ValueInfo};
use serde::Deserialize;
use std::path::Path;

/// Name of the file.
pub(crate) const FILE: &str = "model.json";
/// Most values of a constant input.
const MOST: usize = 1 << 24;

/// Numbers of an input: one for all its values, or each.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(untagged)]
pub(crate) enum Numbers {
    All(f32),
    Each(Vec<f32>),
}

/// The input's numbers in its shape; axes that are free have one. Of an empty list the last free axis has none.
///
/// # Errors
/// When the number of values is another.
pub(crate) fn constant(info: &ValueInfo, numbers: &Numbers, model: &Path) -> Result<Tensor<'static>> {
    let given = match numbers {
        Numbers::All(_) => 1,
        Numbers::Each(all) => all.len(),
    };
    let mut shape: Vec<usize> = match &info.shape {
        Some(axes) => axes.iter().map(|a| a.unwrap_or(1)).collect(),
        None => vec![given],
    };
    let last_free = info.shape.as_ref().and_then(|axes| axes.iter().rposition(Option::is_none));
    if let (0, Some(axis)) = (given, last_free) {
        shape[axis] = 0;
    }
    let count = shape.iter().try_fold(1usize, |n, &d| n.checked_mul(d)).filter(|n| *n <= MOST);
    let values = match (numbers, count) {
        (Numbers::All(v), Some(count)) => vec![*v; count],
        (Numbers::Each(all), Some(count)) if all.len() == count => all.clone(),
        _ => {
            return Err(Error::new("the input has another number of values")
                .file(model)
                .field(&info.name)
                .found(format!("{given} in {FILE}"))
                .expected(format!("one number, or as many as {shape:?} has")));
        }
    };
    Ok(match info.kind {
        Some(Kind::Integer) => Tensor::i32(&shape, values.into_iter().map(|v| v as i32).collect::<Vec<_>>()),
        _ => Tensor::f32(&shape, values),
    })
}
