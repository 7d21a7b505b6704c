//! The records of all stages that made a run.

use gs_io::Result;
use serde_json::Value;
use stage::RunRecord;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Stages in the order in which they run.
const ORDER: [&str; 7] =
    ["synth-scene", "gs-geom", "mask-embed", "graph-precompute", "feat-train", "cluster-match", "eval"];
/// Suffix of a record's file name.
const SUFFIX: &str = ".run.json";

/// A run of a stage and the outputs it has a record beside.
#[derive(Debug, Clone, PartialEq)]
pub struct Run {
    /// File names of the outputs, with commas between.
    pub output: String,
    /// What the stage wrote of itself.
    pub record: RunRecord,
}

impl Run {
    /// The stage's name, with its command where it has several: `gs-geom train`.
    pub fn name(&self) -> String {
        match self.record.parameters.get("command").and_then(Value::as_str) {
            Some(command) => format!("{} {command}", self.record.program),
            None => self.record.program.clone(),
        }
    }

    /// Whether both did the same: a run with several outputs leaves a record beside each.
    fn did_as(&self, other: &Self) -> bool {
        let (a, b) = (&self.record, &other.record);
        (&a.program, &a.parameters, &a.inputs) == (&b.program, &b.parameters, &b.inputs)
    }

    /// The figures of its summary, as text.
    pub fn figures(&self) -> String {
        let Value::Object(summary) = &self.record.summary else { return String::new() };
        let figure = |(key, value): (&String, &Value)| {
            let text = match value {
                Value::Number(n) if n.is_f64() => report::plot::number(n.as_f64()?),
                Value::Number(n) => grouped(&n.to_string()),
                Value::String(s) => s.clone(),
                Value::Bool(b) => b.to_string(),
                _ => return None,
            };
            Some(format!("{} {text}", key.replace('_', " ")))
        };
        summary.iter().filter_map(figure).collect::<Vec<_>>().join(", ")
    }
}

/// All records in these folders and their sub-folders (three deep), in the order of the pipeline; each file once, and
/// not the record of `except`.
pub fn read_all(folders: &[&Path], except: &Path) -> Result<Vec<Run>> {
    let mut paths: BTreeMap<PathBuf, PathBuf> = BTreeMap::new();
    for folder in folders {
        walk(folder, 3, &mut paths);
    }
    if let Ok(except) = RunRecord::path(except).canonicalize() {
        paths.remove(&except);
    }
    let mut runs = Vec::with_capacity(paths.len());
    for path in paths.into_values() {
        let name = path.to_string_lossy().into_owned();
        let output = PathBuf::from(name.strip_suffix(SUFFIX).unwrap_or(&name));
        let record = RunRecord::read(&output)?;
        runs.push(Run { output: output.file_name().unwrap_or_default().to_string_lossy().into_owned(), record });
    }
    let place = |r: &Run| ORDER.iter().position(|&s| s == r.record.program).unwrap_or(ORDER.len());
    // gs-geom eval comes after gs-geom train, whatever the alphabet says.
    runs.sort_by_cached_key(|r| (place(r), r.name().ends_with(" eval"), r.name(), r.output.clone()));
    let mut merged: Vec<Run> = Vec::with_capacity(runs.len());
    for run in runs {
        match merged.iter_mut().find(|m| m.did_as(&run)) {
            Some(same) => {
                same.output += &format!(", {}", run.output);
                // The last record to be written covers all of the run.
                if run.record.wall_seconds > same.record.wall_seconds {
                    same.record = run.record;
                }
            }
            None => merged.push(run),
        }
    }
    Ok(merged)
}

fn walk(folder: &Path, depth: usize, paths: &mut BTreeMap<PathBuf, PathBuf>) {
    let Ok(entries) = std::fs::read_dir(folder) else { return };
    for entry in entries.flatten() {
        let path = entry.path();
        if path.is_dir() {
            if depth > 0 {
                walk(&path, depth - 1, paths);
            }
        } else if path.to_string_lossy().ends_with(SUFFIX) {
            // Folders may lie in one another: the same file counts once.
            paths.insert(path.canonicalize().unwrap_or_else(|_| path.clone()), path);
        }
    }
}

/// Seconds by stage, of runs as [`read_all`] gives them.
pub fn seconds(runs: &[Run]) -> BTreeMap<String, f64> {
    let mut all = BTreeMap::new();
    for run in runs {
        *all.entry(run.name()).or_default() += run.record.wall_seconds;
    }
    all
}

/// A whole number with a comma between every three digits.
pub fn grouped(digits: &str) -> String {
    let (sign, digits) = digits.strip_prefix('-').map_or(("", digits), |d| ("-", d));
    let groups: Vec<_> = digits.as_bytes().rchunks(3).rev().map(String::from_utf8_lossy).collect();
    format!("{sign}{}", groups.join(","))
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;
    use stage::Stage;

    #[test]
    fn records_are_found_once_in_pipeline_order() {
        let dir = tempfile::tempdir().unwrap();
        let sub = dir.path().join("query");
        let none = BTreeMap::new();
        for (program, command, output) in [
            ("eval", "query", sub.join("query.json")),
            ("eval", "report", dir.path().join("report.html")),
            ("gs-geom", "train", dir.path().join("geometry.ply")),
            ("gs-geom", "eval", dir.path().join("geom_metrics.json")),
            ("graph-precompute", "", dir.path().join("graph.safetensors")),
            ("graph-precompute", "", dir.path().join("footprints.safetensors")),
        ] {
            let p = if command.is_empty() { json!({"k": 16}) } else { json!({"command": command}) };
            let summary = json!({"gaussians": 12345, "psnr": 26.54321, "list": [1]});
            let stage = Stage::silent(program);
            let mut claim = stage.outputs(output).claim().unwrap();
            stage.record(&mut claim, p, none.clone(), summary).unwrap();
        }
        let runs = read_all(&[dir.path(), &sub, Path::new("/no/such")], &dir.path().join("report.html")).unwrap();
        let names: Vec<String> = runs.iter().map(|r| format!("{}: {}", r.name(), r.output)).collect();
        assert_eq!(
            names,
            [
                "gs-geom train: geometry.ply",
                "gs-geom eval: geom_metrics.json",
                "graph-precompute: footprints.safetensors, graph.safetensors",
                "eval query: query.json"
            ]
        );
        assert_eq!(runs[0].figures(), "gaussians 12,345, psnr 26.54");
        assert_eq!(seconds(&runs).len(), 4);
        let took = |output: &str| RunRecord::read(dir.path().join(output)).unwrap().wall_seconds;
        let graph = took("footprints.safetensors").max(took("graph.safetensors"));
        assert_eq!(seconds(&runs)["graph-precompute"], graph);
    }

    #[test]
    fn digits_are_grouped() {
        for (d, g) in [("7", "7"), ("1234", "1,234"), ("-123456", "-123,456"), ("1000000", "1,000,000")] {
            assert_eq!(grouped(d), g);
        }
    }
}
