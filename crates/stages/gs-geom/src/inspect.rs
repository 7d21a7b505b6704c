//! `gs-geom inspect`.

pub mod report;

use crate::bounds::Bounds;
use crate::memory;
use crate::options::{Inspect, bytes};
use gs_io::{Error, IoContext, Result};
use gs_scene::dataset::{self, LoadOptions};
use gs_scene::ply;
use report::{Bin, Report, inspect};
use serde_json::json;
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
        if json {
            let failed = |e: serde_json::Error| Error::new(e.to_string()).file(&self.file);
            let mut object = serde_json::to_value(&report).map_err(failed)?;
            object["file_bytes"] = file_bytes.into();
            Ok(format!("{object}\n"))
        } else {
            Ok(text(&report, file_bytes))
        }
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

fn text(r: &Report, file_bytes: u64) -> String {
    let mut t = String::new();
    let mut line = |name: &str, value: String| {
        let _ = writeln!(t, "{name:<20}{value}");
    };
    line("Gaussians", r.gaussians.to_string());
    line("SH degree", r.sh_degree.to_string());
    let mib = |bytes: f64| format!("{:.1} MiB", bytes / f64::from(1 << 20));
    line("memory", format!("{} of parameters, {} on disk", mib(r.memory_bytes as f64), mib(file_bytes as f64)));
    line("bounds", corners(r.bounds));
    line("1% to 99%", corners(r.robust_bounds));
    if let Some([least, median, most, max]) = r.aspect {
        line("aspect", format!("least {least:.3}, median {median:.3}, 99% {most:.3}, greatest {max:.3}"));
    }
    line("below 1/255 opacity", format!("{} (never drawn)", r.invisible));
    let f = &r.non_finite;
    let parts = [
        ("means", f.means),
        ("scales", f.log_scales),
        ("rotations", f.rotations),
        ("opacity", f.opacity_logits),
        ("SH", f.sh),
    ];
    let parts: Vec<String> = parts.iter().filter(|p| p.1 > 0).map(|(name, n)| format!("{name} {n}")).collect();
    let parts = if parts.is_empty() { String::new() } else { format!(" ({})", parts.join(", ")) };
    line("not finite", format!("{}{parts}", f.gaussians));
    line("infinite opacity", format!("{} (read as opaque or transparent)", f.infinite_opacity_logits));
    line("quaternions", format!("{} not of length 1, {} of length 0", r.rotations_not_normalised, r.rotations_zero));
    bars(&mut t, "opacity", &r.opacity, |v| format!("{v:.1}"));
    bars(&mut t, "scale (standard deviation along each axis, world units)", &r.scale, |v| format!("{v:.0e}"));
    t
}

fn corners(b: Option<Bounds>) -> String {
    let point = |p: [f32; 3]| format!("({:.4}, {:.4}, {:.4})", p[0], p[1], p[2]);
    b.map_or("none: no centre is finite".into(), |b| format!("{} to {}", point(b.low), point(b.high)))
}

fn bars(t: &mut String, title: &str, bins: &[Bin], edge: impl Fn(f64) -> String) {
    let most = bins.iter().map(|b| b.count).max().unwrap_or(0).max(1);
    let _ = writeln!(t, "{title}");
    for b in bins {
        let bar = "#".repeat((40 * b.count).div_ceil(most));
        let _ = writeln!(t, "  {:>6} to {:<6}{:>9}  {bar}", edge(b.from), edge(b.to), b.count);
    }
}
