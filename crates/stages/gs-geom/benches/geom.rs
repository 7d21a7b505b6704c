//! Quality for the time: trains scenes in alternative ways and writes figures (JSON), a table (Markdown) and curves (SVG).
//!
//! `cargo bench -p gs-geom --bench geom -- OUT.json NAME=FOLDER@RESOLUTION...`, with `ITERATIONS`, `SEEDS`, `ONLY` (settings,
//! with commas) and `MAX_GAUSSIANS` (the program's default where it is empty) from the environment. Each run is a process of its own on one thread, and its figures are over processor
//! time, because other programs stretch wall-clock time. Runs whose result lies beside the JSON are not run again. Scenes
//! whose folder is missing are skipped.

#![expect(clippy::print_stderr, reason = "a program for people to run")]

mod common;

use common::{numbers, setting, summary, train, write};
use report::plot::Chart;
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// The alternatives: a name and the options that make it.
const SETTINGS: [(&str, &[&str]); 5] = [
    ("defaults", &[]),
    ("preset 3dgs", &["--preset", "3dgs"]),
    ("full", &["--schedule", "full"]),
    ("mcmc", &["--densify", "mcmc", "--schedule", "full"]),
    ("antialias", &["--antialias"]),
];

/// The figures of a run.
fn figures(record: &Value, iterations: u32) -> [(&'static str, f64); 6] {
    let (s, number) = (&record["summary"], |v: &Value| v.as_f64().unwrap_or(f64::NAN));
    let seconds = number(&s["cpu_seconds"]);
    [
        ("psnr_heldout", number(&s["psnr_heldout"])),
        ("ssim_heldout", number(&s["ssim_heldout"])),
        ("gaussians", number(&s["gaussians"])),
        ("cpu_seconds", seconds),
        ("it_per_cpu_s", f64::from(iterations) / seconds.max(1e-9)),
        ("peak_rss_bytes", number(&record["peak_rss_bytes"])),
    ]
}

fn main() -> Result<(), String> {
    let mut arguments = std::env::args().skip(1).filter(|a| a != "--bench");
    let out = PathBuf::from(arguments.next().ok_or("which file to write?")?);
    let (mut iterations, seeds) = (numbers("ITERATIONS", "500,2000")?, numbers("SEEDS", "3")?[0]);
    iterations.sort_unstable();
    let (most, only) = (setting("MAX_GAUSSIANS", ""), setting("ONLY", ""));
    let only: Vec<&str> = only.split(',').filter(|name| !name.is_empty()).collect();
    let mut all = Vec::new();
    let mut table = "| scene | setting | iterations | PSNR (least to most) | SSIM | Gaussians | CPU s | it per CPU s | peak MB |\n|---|---|---|---|---|---|---|---|---|\n".to_string();
    for scene in arguments {
        let parts = scene.split_once('=').and_then(|(name, rest)| Some((name, rest.rsplit_once('@')?)));
        let (name, (folder, resolution)) = parts.ok_or("a scene is NAME=FOLDER@RESOLUTION")?;
        if !Path::new(folder).is_dir() {
            eprintln!("skipping {name}: no folder {folder}");
            continue;
        }
        for (setting, options) in SETTINGS.iter().filter(|s| only.is_empty() || only.contains(&s.0)) {
            for &n in &iterations {
                let mut runs = Vec::new();
                for seed in 0..seeds {
                    let file = format!("{name}-{resolution}-{setting}-{n}-{most}-{seed}.ply");
                    let (n, seed) = (n.to_string(), seed.to_string());
                    let mut more =
                        vec!["--threads", "1", "--resolution", resolution, "--iterations", &n, "--seed", &seed];
                    if !most.is_empty() {
                        more.extend(["--max-gaussians", &most]);
                    }
                    more.extend(*options);
                    runs.push(train(Path::new(folder), &out.with_extension("runs").join(file), &more)?);
                }
                let (group, row) = group(name, setting, n, &runs);
                eprint!("{row}");
                table += &row;
                all.push(group);
            }
        }
    }
    write(&out.with_extension("svg"), &curves(&all))?;
    let all = json!({"max_gaussians": most, "settings": all});
    write(&out, &serde_json::to_string_pretty(&all).map_err(|e| e.to_string())?)?;
    write(&out.with_extension("md"), &table)
}

/// A chart for each scene: held-out PSNR over processor time, medians; the first setting and the others beside it.
fn curves(groups: &[Value]) -> String {
    let median = |g: &Value, key: &str| g[key]["median"].as_f64().unwrap_or(f64::NAN);
    let charts = groups.chunk_by(|a, b| a["scene"] == b["scene"]).map(|of| {
        let mut lines = of.chunk_by(|a, b| a["setting"] == b["setting"]).map(|of| {
            let points = of.iter().map(|g| (median(g, "cpu_seconds"), median(g, "psnr_heldout")));
            (of[0]["setting"].as_str().unwrap_or_default().to_string(), points.collect())
        });
        let (first, line) = lines.next().unwrap_or_default();
        let title = format!("{}: {first}", of[0]["scene"].as_str().unwrap_or_default());
        let axes = "processor seconds; upwards: held-out PSNR in dB".into();
        (Chart { title, axes, line, beside: lines.collect(), ..Chart::default() }, "#0b5fa5")
    });
    report::plot::file(&charts.collect::<Vec<_>>())
}

/// Runs that differ by their seeds, as JSON and as a row of the table.
fn group(scene: &str, setting: &str, iterations: u32, runs: &[Value]) -> (Value, String) {
    let figures: Vec<_> = runs.iter().map(|r| figures(r, iterations)).collect();
    let mut one = json!({"scene": scene, "setting": setting, "iterations": iterations, "seeds": runs.len()});
    let [p, ssim, gaussians, cpu, rate, peak] = std::array::from_fn(|k| {
        let [least, median, most] = summary(figures.iter().map(|f| f[k].1).collect());
        one[figures[0][k].0] = json!({"median": median, "least": least, "most": most});
        [least, median, most]
    });
    let row = format!(
        "| {scene} | {setting} | {iterations} | {:.2} ({:.2} to {:.2}) | {:.4} | {:.0} | {:.1} | {:.1} | {:.0} |\n",
        p[1],
        p[0],
        p[2],
        ssim[1],
        gaussians[1],
        cpu[1],
        rate[1],
        peak[1] / 1e6
    );
    (one, row)
}
