//! `gs-geom inspect`: what is in a file of Gaussians (counts, bounds, histograms, faults), or which files a dataset has.

use crate::bounds::Bounds;
use crate::memory;
use crate::options::{Inspect, bytes, note_shift};
use gs_io::{IoContext, Result};
use gs_scene::Gaussians;
use gs_scene::dataset::{self, LoadOptions};
use gs_scene::splat::{self, Splat};
use serde::Serialize;
use serde_json::{Value, json};
use stage::Stage;
use std::fmt::Write as _;
use std::time::UNIX_EPOCH;

/// A quaternion counts as normalised when its length is this near to 1.
const UNIT_TOLERANCE: f32 = 1e-3;
/// Bins of the opacities' histogram, each a tenth wide.
const OPACITY_BINS: usize = 10;
/// Decades of the scales' histogram: from 1e-10 to 1e10; beyond, the outermost bin counts.
const DECADES: std::ops::Range<i32> = -10..10;

impl Inspect {
    /// Prints to standard output: text, or JSON objects.
    pub(crate) fn run(&self, json: bool, stage: &Stage) -> Result<()> {
        let text = if self.file.is_dir() { self.list(json)? } else { self.describe(json, stage)? };
        stage.print(&text).map(drop)
    }

    fn describe(&self, json: bool, stage: &Stage) -> Result<String> {
        stage.needs(memory::of_file(bytes(&self.file)?), "give a smaller file")?;
        let Splat { gaussians, antialias, axes, kind, left_out } = splat::read(&self.file)?;
        let report = inspect(&gaussians);
        let mut object = json!(report);
        let mut file_bytes = 0;
        for file in splat::files(&self.file)? {
            file_bytes += std::fs::metadata(&file).at("read", &file)?.len();
        }
        object["file_bytes"] = file_bytes.into();
        object["format"] = kind.into();
        object["axes"] = axes.to_string().into();
        object["antialias"] = antialias.into();
        note_shift(&mut object, gaussians.shift);
        object["not_read"] = left_out.into();
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

/// Gaussians with a number that is not finite, by parameter. A Gaussian may count in several.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
struct NonFinite {
    /// In any parameter.
    gaussians: usize,
    means: usize,
    log_scales: usize,
    rotations: usize,
    opacity_logits: usize,
    sh: usize,
    /// An infinite opacity logit: fully opaque or transparent to some tools, and read as +-50; not a fault.
    infinite_opacity_logits: usize,
}

/// One bar of a histogram: how many values v have `from` <= v < `to`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
struct Bin {
    from: f64,
    /// Upper edge; the last bin includes it.
    to: f64,
    count: usize,
}

/// Everything that `gs-geom inspect` prints.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct Report {
    gaussians: usize,
    sh_degree: u8,
    /// Bounds of the finite centres; none where there is none.
    bounds: Option<Bounds>,
    /// From the 1st to the 99th percentile of the finite centres, axis by axis.
    robust_bounds: Option<Bounds>,
    /// Opacities after the sigmoid, 0 to 1.
    opacity: Vec<Bin>,
    /// Gaussians below 1/255, which no view draws.
    invisible: usize,
    /// Standard deviations along the three axes of every Gaussian, world units, by decade.
    scale: Vec<Bin>,
    /// Percentiles 0, 50, 99 and 100 of largest by smallest scale.
    aspect: Option<[f32; 4]>,
    non_finite: NonFinite,
    /// Quaternions whose length differs from 1 by more than 1e-3; allowed, but some viewers draw them wrong.
    rotations_not_normalised: usize,
    /// Quaternions of length zero: never drawn.
    rotations_zero: usize,
    /// Bytes the parameters take in memory.
    memory_bytes: usize,
}

/// Looks at the Gaussians as they are, finite or not.
fn inspect(g: &Gaussians) -> Report {
    let n = g.len();
    let lengths: Vec<f32> = g.rotations.iter().map(|q| q.iter().map(|v| v * v).sum::<f32>().sqrt()).collect();
    let opacities: Vec<f32> = (0..n).map(|i| g.opacity(i)).filter(|o| !o.is_nan()).collect();
    Report {
        gaussians: n,
        sh_degree: g.sh_degree,
        bounds: bounds(g, 0.0),
        robust_bounds: bounds(g, 0.01),
        opacity: opacity_histogram(&opacities),
        invisible: opacities.iter().filter(|&&o| o < 1.0 / 255.0).count(),
        scale: scale_histogram(g),
        aspect: aspect(g),
        non_finite: non_finite(g),
        rotations_not_normalised: lengths.iter().filter(|&&l| (l - 1.0).abs() > UNIT_TOLERANCE).count(),
        rotations_zero: lengths.iter().filter(|&&l| l <= 1e-12).count(),
        memory_bytes: 4 * n * (11 + g.sh_stride()),
    }
}

/// Bounds of the finite centres without the share `cut` of them at either end of each axis.
fn bounds(g: &Gaussians, cut: f64) -> Option<Bounds> {
    let axis = |c: usize| {
        let mut values: Vec<f32> = g.means.iter().filter(|m| m.iter().all(|v| v.is_finite())).map(|m| m[c]).collect();
        values.sort_unstable_by(f32::total_cmp);
        Some((percentile(&values, cut)?, percentile(&values, 1.0 - cut)?))
    };
    let [x, y, z] = [axis(0)?, axis(1)?, axis(2)?];
    Some(Bounds { low: [x.0, y.0, z.0], high: [x.1, y.1, z.1] })
}

/// The value below which the share `at` of sorted values lies (nearest rank); none of none.
fn percentile(sorted: &[f32], at: f64) -> Option<f32> {
    let last = sorted.len().checked_sub(1)?;
    sorted.get((at * last as f64).round() as usize).copied()
}

fn opacity_histogram(opacities: &[f32]) -> Vec<Bin> {
    let mut counts = [0; OPACITY_BINS];
    for o in opacities {
        counts[((o * OPACITY_BINS as f32) as usize).min(OPACITY_BINS - 1)] += 1;
    }
    let edge = |i: usize| i as f64 / OPACITY_BINS as f64;
    counts.into_iter().enumerate().map(|(i, count)| Bin { from: edge(i), to: edge(i + 1), count }).collect()
}

/// By decade, from the first that is not empty to the last.
fn scale_histogram(g: &Gaussians) -> Vec<Bin> {
    let mut counts = vec![0; DECADES.len()];
    for s in g.log_scales.iter().flatten().filter(|s| !s.is_nan()) {
        let decade = (f64::from(*s) / std::f64::consts::LN_10).floor();
        counts[(decade - f64::from(DECADES.start)).clamp(0.0, (DECADES.len() - 1) as f64) as usize] += 1;
    }
    let edge = |i: i32| 10f64.powi(i);
    let all = DECADES.zip(counts).map(|(d, count)| Bin { from: edge(d), to: edge(d + 1), count }).collect::<Vec<_>>();
    let some = |b: &Bin| b.count > 0;
    match (all.iter().position(some), all.iter().rposition(some)) {
        (Some(first), Some(last)) => all[first..=last].to_vec(),
        _ => Vec::new(),
    }
}

fn aspect(g: &Gaussians) -> Option<[f32; 4]> {
    let spread = |s: &[f32; 3]| {
        let (low, high) = s.iter().fold((f32::MAX, f32::MIN), |(l, h), &v| (l.min(v), h.max(v)));
        (high - low).exp()
    };
    let mut all: Vec<f32> = g.log_scales.iter().filter(|s| s.iter().all(|v| v.is_finite())).map(spread).collect();
    all.sort_unstable_by(f32::total_cmp);
    let at = |share| percentile(&all, share);
    Some([at(0.0)?, at(0.5)?, at(0.99)?, at(1.0)?])
}

fn non_finite(g: &Gaussians) -> NonFinite {
    let count = |bad: &dyn Fn(usize) -> bool| (0..g.len()).filter(|&i| bad(i)).count();
    let any = |values: &[f32]| values.iter().any(|v| !v.is_finite());
    NonFinite {
        gaussians: count(&|i| g.not_finite(i).is_some()),
        means: count(&|i| any(&g.means[i])),
        log_scales: count(&|i| any(&g.log_scales[i])),
        rotations: count(&|i| any(&g.rotations[i])),
        opacity_logits: count(&|i| g.opacity_logits[i].is_nan()),
        sh: count(&|i| any(g.sh_of(i))),
        infinite_opacity_logits: count(&|i| g.opacity_logits[i].is_infinite()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::training::optimiser::zeros;

    #[test]
    fn everything_is_counted() {
        let mut g = zeros(101, 1);
        for i in 0..101 {
            g.means[i] = [i as f32, -(i as f32), 0.5];
            g.rotations[i] = [1.0, 0.0, 0.0, 0.0];
            g.log_scales[i] = [0.01f32.ln() + 0.1, 0.01f32.ln() + 0.1, 2.0f32.ln()];
        }
        g.means[100] = [f32::NAN, 0.0, 0.0];
        g.rotations[0] = [0.0; 4];
        g.rotations[1] = [2.0, 0.0, 0.0, 0.0];
        g.opacity_logits[2] = f32::INFINITY;
        g.opacity_logits[3] = f32::NAN;
        g.opacity_logits[4] = -9.0;
        g.log_scales[5] = [f32::INFINITY, 0.0, 0.0];
        g.sh[12 * 6 + 5] = f32::NEG_INFINITY;
        let r = inspect(&g);
        assert_eq!((r.gaussians, r.sh_degree, r.memory_bytes), (101, 1, 101 * 4 * 23));
        assert_eq!(r.bounds, Some(Bounds { low: [0.0, -99.0, 0.5], high: [99.0, 0.0, 0.5] }));
        assert_eq!(r.robust_bounds, Some(Bounds { low: [1.0, -98.0, 0.5], high: [98.0, -1.0, 0.5] }));
        let wanted = NonFinite {
            gaussians: 4,
            means: 1,
            log_scales: 1,
            rotations: 0,
            opacity_logits: 1,
            sh: 1,
            infinite_opacity_logits: 1,
        };
        assert_eq!(r.non_finite, wanted);
        assert_eq!((r.rotations_zero, r.rotations_not_normalised, r.invisible), (1, 2, 1));
        let counts: Vec<usize> = r.opacity.iter().map(|b| b.count).collect();
        assert_eq!(counts, [1, 0, 0, 0, 0, 98, 0, 0, 0, 1]);
        assert_eq!(r.scale.first().map(|b| (b.from, b.count)), Some((0.01, 200)));
        assert_eq!(r.scale.iter().map(|b| b.count).sum::<usize>(), 303);
        let aspect = r.aspect.unwrap();
        assert!((aspect[1] - 200.0 / 0.1f32.exp()).abs() < 0.1, "{aspect:?}");
        assert_eq!((inspect(&zeros(0, 0)).bounds, inspect(&zeros(0, 0)).aspect), (None, None));
    }
}
