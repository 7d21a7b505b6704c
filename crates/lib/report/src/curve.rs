//! Training curves: `*.curve.jsonl` files, one JSON object of numbers per line.

use crate::plot::{self, Chart};
use gs_io::{Error, IoContext, Result};
use serde_json::{Map, Value};
use std::collections::BTreeMap;
use std::path::Path;

/// The key that runs along the x axis.
const STEP: &str = "iteration";

/// One figure of a curve: its key in the lines, its title, its colour.
pub type Panel = (&'static str, &'static str, &'static str);

/// An SVG file of the lines of a curve, a chart for each panel. A line that is not JSON, or lacks a figure, has no point.
pub fn svg(lines: &[String], panels: &[Panel]) -> String {
    let values: Vec<Value> = lines.iter().filter_map(|l| serde_json::from_str(l).ok()).collect();
    let chart = |&(key, title, color): &Panel| {
        let point = |v: &Value| Some((v[STEP].as_f64()?, v[key].as_f64()?));
        (Chart { title: title.into(), line: values.iter().filter_map(point).collect(), ..Chart::default() }, color)
    };
    plot::file(&panels.iter().map(chart).collect::<Vec<_>>())
}

/// Reads one chart per numeric key other than `iteration`, by name. Lines without `iteration` count on by one. Keys
/// that some lines lack (such as an occasional PSNR) have fewer points.
///
/// # Errors
/// When the file cannot be read or a line is no JSON object. An unfinished last line (of a stage that was killed) is no
/// error.
pub fn read(path: impl AsRef<Path>) -> Result<Vec<Chart>> {
    let path = path.as_ref();
    let text = std::fs::read_to_string(path).at("read", path)?;
    let mut lines: BTreeMap<String, Vec<(f64, f64)>> = BTreeMap::new();
    for (i, line) in text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty()) {
        let object = match serde_json::from_str::<Map<String, Value>>(line) {
            Ok(object) => object,
            Err(_) if i + 1 == text.lines().count() && !text.ends_with('\n') => break,
            Err(e) => {
                return Err(Error::new(format!("not a JSON object: {e}")).file(path).field(format!("line {}", i + 1)));
            }
        };
        let x = object.get(STEP).and_then(Value::as_f64).unwrap_or(i as f64);
        for (key, value) in object.iter().filter(|(k, _)| *k != STEP) {
            if let Some(y) = value.as_f64() {
                lines.entry(key.clone()).or_default().push((x, y));
            }
        }
    }
    Ok(lines.into_iter().map(|(title, line)| Chart { title, line, ..Chart::default() }).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn curve(text: &str) -> Result<Vec<Chart>> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.curve.jsonl");
        std::fs::write(&path, text).unwrap();
        read(&path)
    }

    #[test]
    fn one_chart_per_number() {
        let s = curve(
            "{\"iteration\":10,\"loss\":0.5,\"note\":\"x\"}\n\n{\"iteration\":20,\"loss\":0.25,\"psnr\":21}\n{\"iter",
        )
        .unwrap();
        let names: Vec<&str> = s.iter().map(|s| s.title.as_str()).collect();
        assert_eq!(names, ["loss", "psnr"]);
        assert_eq!(s[0].line, [(10.0, 0.5), (20.0, 0.25)]);
        assert_eq!(s[1].line, [(20.0, 21.0)]);
        assert!(curve("").unwrap().is_empty());
    }

    #[test]
    fn a_bad_line_is_named() {
        let e = curve("{\"loss\":1}\n[1]\n").unwrap_err().to_string();
        assert!(e.contains("line 2"), "{e}");
    }

    #[test]
    fn every_panel_is_drawn_even_without_a_point() {
        let panels: [Panel; 2] = [("loss", "the loss", "red"), ("psnr", "dB", "blue")];
        let lines = [r#"{"iteration":5,"loss":0.5,"psnr":null}"#.into(), "not json".into()];
        let s = svg(&lines, &panels);
        assert_eq!((s.matches("<polyline").count(), s.matches(">none<").count()), (1, 1), "{s}");
        assert!(s.contains("the loss") && s.contains(r#"color="blue""#) && !s.contains("NaN"));
        assert_eq!(svg(&[], &panels).matches(">none<").count(), 2);
    }
}
