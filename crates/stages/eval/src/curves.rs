//! Training curves: `*.curve.jsonl` files, one JSON object of numbers per line.

use crate::svg::Series;
use gs_io::{Error, IoContext, Result};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;

/// The key that runs along the x axis.
const STEP: &str = "iteration";

/// Reads one series per numeric key other than `iteration`, by name. Lines without `iteration` count on by one. Keys
/// that some lines lack (such as an occasional PSNR) have fewer points.
///
/// # Errors
/// When the file cannot be read or a line is no JSON object. An unfinished last line (of a stage that was killed) is no
/// error.
pub fn read(path: impl AsRef<Path>) -> Result<Vec<Series>> {
    let path = path.as_ref();
    let text = std::fs::read_to_string(path).at("read", path)?;
    let mut series: BTreeMap<String, Vec<(f64, f64)>> = BTreeMap::new();
    for (i, line) in text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty()) {
        let object = match serde_json::from_str::<serde_json::Map<String, Value>>(line) {
            Ok(object) => object,
            Err(_) if i + 1 == text.lines().count() && !text.ends_with('\n') => break,
            Err(e) => {
                return Err(Error::new(format!("not a JSON object: {e}")).file(path).field(format!("line {}", i + 1)));
            }
        };
        let x = object.get(STEP).and_then(Value::as_f64).unwrap_or(i as f64);
        for (key, value) in object.iter().filter(|(k, _)| *k != STEP) {
            if let Some(y) = value.as_f64() {
                series.entry(key.clone()).or_default().push((x, y));
            }
        }
    }
    Ok(series.into_iter().map(|(name, points)| Series { name, points }).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn curve(text: &str) -> Result<Vec<Series>> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.curve.jsonl");
        std::fs::write(&path, text).unwrap();
        read(&path)
    }

    #[test]
    fn one_series_per_number() {
        let s = curve(
            "{\"iteration\":10,\"loss\":0.5,\"note\":\"x\"}\n\n{\"iteration\":20,\"loss\":0.25,\"psnr\":21}\n{\"iter",
        )
        .unwrap();
        let names: Vec<&str> = s.iter().map(|s| s.name.as_str()).collect();
        assert_eq!(names, ["loss", "psnr"]);
        assert_eq!(s[0].points, [(10.0, 0.5), (20.0, 0.25)]);
        assert_eq!(s[1].points, [(20.0, 21.0)]);
        assert!(curve("").unwrap().is_empty());
    }

    #[test]
    fn a_bad_line_is_named() {
        let e = curve("{\"loss\":1}\n[1]\n").unwrap_err().to_string();
        assert!(e.contains("line 2"), "{e}");
    }
}
