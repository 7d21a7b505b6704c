//! `gs-geom inspect`.

pub mod report;

use crate::memory;
use crate::options::{Inspect, bytes};
use gs_io::{Error, IoContext, Result};
use gs_scene::dataset::{self, LoadOptions};
use gs_scene::ply;
use report::{Bin, Report, inspect};
use serde_json::{Value, json};
use stage::Stage;
use std::fmt::Write as _;
use std::time::UNIX_EPOCH;

impl Inspect {
    /// Prints to standard output: text, or JSON objects.
    pub(crate) fn run(&self, json: bool, stage: &Stage) -> Result<()> {
        let text = if self.file.is_dir() { self.list(json)? } else { self.describe(json, stage)? };
        stage.print(&text).map(drop)
    }

    fn describe(&self, json: bool, stage: &Stage) -> Result<String> {
        let file_bytes = bytes(&self.file)?;
        stage.needs(memory::of_file(file_bytes), "give a smaller file")?;
        let report = inspect(&ply::read_gaussians_as_they_are(&self.file)?);
        let failed = |e: serde_json::Error| Error::new(e.to_string()).file(&self.file);
        let mut object = serde_json::to_value(&report).map_err(failed)?;
        object["file_bytes"] = file_bytes.into();
        Ok(if json { format!("{object}\n") } else { text(&object, &report) })
    }

    /// A line for each file of the dataset, by which make knows whether one has changed.
    fn list(&self, json: bool) -> Result<String> {
        let mut lines = String::new();
        for file in dataset::load(&self.file, &LoadOptions::default())?.files {
            let facts = std::fs::metadata(&file).at("read", &file)?;
            let time = facts.modified().at("read", &file)?.duration_since(UNIX_EPOCH).unwrap_or_default();
            let (bytes, seconds) = (facts.len(), format!("{}.{:09}", time.as_secs(), time.subsec_nanos()));
            let _ = match json {
                true => {
                    writeln!(lines, "{}", json!({"file": file.to_string_lossy(), "bytes": bytes, "modified": seconds}))
                }
                false => writeln!(lines, "{bytes} {seconds} {}", file.display()),
            };
        }
        Ok(lines)
    }
}

/// A line for each figure, and bars for the histograms.
fn text(object: &Value, report: &Report) -> String {
    let mut t = String::new();
    let figures = object.as_object().into_iter().flatten().filter(|(key, _)| !["opacity", "scale"].contains(&&***key));
    for (key, value) in figures {
        let _ = writeln!(t, "{:<26}{value}", key.replace('_', " "));
    }
    bars(&mut t, "opacity", &report.opacity, |v| format!("{v:.1}"));
    bars(&mut t, "scale (standard deviation along each axis, world units)", &report.scale, |v| format!("{v:.0e}"));
    t
}

fn bars(t: &mut String, title: &str, bins: &[Bin], edge: impl Fn(f64) -> String) {
    let most = bins.iter().map(|b| b.count).max().unwrap_or(0).max(1);
    let _ = writeln!(t, "{title}");
    for b in bins {
        let bar = "#".repeat((40 * b.count).div_ceil(most));
        let _ = writeln!(t, "  {:>6} to {:<6}{:>9}  {bar}", edge(b.from), edge(b.to), b.count);
    }
}
