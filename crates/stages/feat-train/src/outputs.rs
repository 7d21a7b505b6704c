//! What both methods give, and the curve that they write beside it.

use gs_io::{Result, with_suffix, write_bytes};
use ndarray::Array2;
use report::curve::{self, Panel};
use serde_json::Value;
use std::path::Path;

/// Features and what the record of the run says of them.
pub struct Made {
    /// `[n][dim]`, in the order of the graph's kept Gaussians.
    pub values: Array2<f32>,
    pub summary: Value,
}

/// Suffixes of the files beside the features: the curve and its picture.
pub const CURVE: [&str; 2] = [".curve.jsonl", ".curve.svg"];

/// Writes the curve of `out` as lines of JSON and as a picture.
pub fn write_curve(out: &Path, points: impl Iterator<Item = Value>, panels: &[Panel]) -> Result<()> {
    let lines: Vec<String> = points.map(|p| p.to_string()).collect();
    let text: String = lines.iter().map(|l| format!("{l}\n")).collect();
    write_bytes(with_suffix(out, CURVE[0]), text.as_bytes())?;
    write_bytes(with_suffix(out, CURVE[1]), curve::svg(&lines, panels).as_bytes())
}
