//! `make bench-train`: what an iteration of training costs at a million Gaussians, 100,000 anchors and 300 views, and what
//! the closed form costs. [`scene`] says how the scene is made. Writes out/bench/train.json;
//! docs/performance.md has the figures.

mod scene;

use serde_json::{Value, json};
use std::path::Path;

/// Iterations of a run; the time of a training is extrapolated.
const ITERATIONS: u64 = 100;
/// Runs, of which the median is reported.
const RUNS: usize = 5;

/// Seconds on the clock and of all processors that an iteration takes, by a run of twice as many, and the network's bytes.
fn iteration(folder: &Path, layers: usize) -> (f64, f64, Value) {
    let [short, long] = [ITERATIONS, 2 * ITERATIONS].map(|iterations| {
        let (iterations, layers) = (iterations.to_string(), layers.to_string());
        scene::run(folder, &["--preset", "paper", "--iterations", &iterations, "--layers", &layers])
    });
    let cpu = long.cpu_seconds.unwrap_or(0.0) - short.cpu_seconds.unwrap_or(0.0);
    let n = ITERATIONS as f64;
    ((long.wall_seconds - short.wall_seconds) / n, cpu / n, long.summary["network_bytes"].clone())
}

fn main() {
    let out = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../out/bench");
    std::fs::create_dir_all(&out).expect("the folder can be made");
    let folder = tempfile::tempdir_in(&out).expect("the folder can be made");
    let folder = folder.path();
    scene::write(1000, 300, folder);
    let mut closed_form = scene::run(folder, &[]);
    closed_form.summary["singular_values"].take();
    let mut runs: Vec<(f64, f64, Value)> = (0..RUNS).map(|_| iteration(folder, 2)).collect();
    runs.sort_by(|a, b| a.0.total_cmp(&b.0));
    let (seconds, cpu_seconds, _) = runs[RUNS / 2];
    let by_layers = (0..=4).map(|layers| {
        let (seconds, cpu_seconds, bytes) = iteration(folder, layers);
        json!({ "layers": layers, "network_bytes": bytes, "seconds": seconds, "cpu_seconds": cpu_seconds })
    });
    let report = json!({
        "seconds_per_iteration": seconds, "least_and_most": [runs[0].0, runs[RUNS - 1].0],
        "cpu_seconds_per_iteration": cpu_seconds, "seconds_of_10000_iterations": 1e4 * seconds,
        "by_layers": by_layers.collect::<Value>(),
        "closed_form": {
            "seconds": closed_form.wall_seconds, "cpu_seconds": closed_form.cpu_seconds,
            "peak_rss_bytes": closed_form.peak_rss_bytes, "summary": closed_form.summary,
        },
    });
    let text = serde_json::to_string_pretty(&report).expect("a report is JSON") + "\n";
    eprint!("{text}");
    std::fs::write(out.join("train.json"), text).expect("the report can be written");
}
