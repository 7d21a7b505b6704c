//! What a scene is known to show: masks and what they mean, labels, points, scans, and the layouts of benchmarks.

pub mod benchmark;
pub mod label;
pub mod language;
pub mod masks;
pub mod named;
pub mod points;
pub mod polygon;
pub(crate) mod regions;
#[cfg(test)]
mod relations;
pub mod scannet;

use gs_io::{Error, Result, write_bytes};
use serde::Serialize;
use std::path::Path;

/// Writes a JSON file.
pub fn write_json(path: &Path, value: &impl Serialize) -> Result<()> {
    let json = serde_json::to_vec(value).map_err(|e| Error::new(e.to_string()).file(path))?;
    write_bytes(path, &json)
}
