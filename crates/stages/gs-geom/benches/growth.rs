//! Cost of an iteration against the number of Gaussians, of pixels and of threads, with fitted exponents: JSON and a
//! Markdown table.
//!
//! `cargo bench -p gs-geom --bench growth -- OUT.json SCENE`, with `GAUSSIANS`, `WIDTHS`, `COUNTS` (of threads) and `REPEATS`
//! from the environment. The Gaussians are learnt first, at 480 pixels, once for each number, and kept beside the JSON. Then
//! short trainings go on from them without densification; every configuration is run once before any is run again. Costs are
//! processor time, and for threads wall-clock time.

#![expect(clippy::print_stderr, reason = "a program for people to run")]

mod common;

use common::{numbers, summary, train, write};
use serde_json::{Value, json};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// Width at which Gaussians and threads are varied, pixels.
const WIDTH: u32 = 480;
/// Iterations that are timed.
const ITERATIONS: u32 = 40;
const PARTS: [&str; 5] = ["forward", "loss", "backward", "Adam", "rest"];

/// One way to run: what is varied, and its three numbers.
#[derive(Clone, Copy)]
struct Configuration {
    varied: &'static str,
    gaussians: u32,
    width: u32,
    threads: u32,
}

/// Figures of one timed run: milliseconds an iteration, and shares of the parts.
fn measure(scene: &Path, folder: &Path, c: Configuration, repeat: u32) -> Result<Value, String> {
    let init = folder.join(format!("{}.ply", c.gaussians)).to_string_lossy().into_owned();
    let (n, threads, width) = (ITERATIONS.to_string(), c.threads.to_string(), format!("{}px", c.width));
    let fixed = ["--holdout", "0", "--schedule", "full", "--densify", "none", "--init", &init, "--iterations", &n];
    let out = folder.join(format!("timed-{}-{}-{}-{repeat}.ply", c.gaussians, c.width, c.threads));
    let record = train(scene, &out, &[&fixed[..], &["--threads", &threads, "--resolution", &width]].concat())?;
    let s = &record["summary"];
    let per = |v: &Value| v.as_f64().map_or(f64::NAN, |t| 1e3 * t / f64::from(ITERATIONS));
    let wall: f64 = PARTS.iter().map(|p| per(&s["seconds"][*p])).sum();
    let mut one = json!({
        "varied": c.varied, "width": c.width, "threads": c.threads, "gaussians": s["gaussians"],
        "cpu_ms": per(&s["iteration_cpu_seconds"]), "wall_ms": wall,
    });
    for part in PARTS {
        one[part] = json!(per(&s["seconds"][part]) / wall.max(1e-9));
    }
    eprintln!("{one}");
    Ok(one)
}

/// Slope of ln y over ln x by least squares.
fn exponent(points: &[(f64, f64)]) -> f64 {
    let n = points.len() as f64;
    let logs: Vec<(f64, f64)> = points.iter().map(|(x, y)| (x.ln(), y.ln())).collect();
    let (mx, my) = (logs.iter().map(|p| p.0).sum::<f64>() / n, logs.iter().map(|p| p.1).sum::<f64>() / n);
    let (above, below) = logs.iter().fold((0.0, 0.0), |(a, b), (x, y)| (a + (x - mx) * (y - my), b + (x - mx).powi(2)));
    above / below
}

fn main() -> Result<(), String> {
    let arguments: Vec<PathBuf> = std::env::args().skip(1).filter(|a| a != "--bench").map(PathBuf::from).collect();
    let [out, scene] = &arguments[..] else { return Err("give OUT.json and a scene".into()) };
    let folder = out.with_extension("runs");
    let gaussians = numbers("GAUSSIANS", "4000,8000,16000,32000,64000")?;
    let width = format!("{WIDTH}px");
    for n in gaussians.iter().map(u32::to_string) {
        let start = ["--init", "random", "--init-points", &n, "--densify", "none", "--no-skip", "--holdout", "0"];
        let more = [&start[..], &["--iterations", "600", "--resolution", &width]].concat();
        train(scene, &folder.join(format!("{n}.ply")), &more)?;
    }
    let middle = gaussians[gaussians.len() / 2];
    let one = Configuration { varied: "gaussians", gaussians: middle, width: WIDTH, threads: 1 };
    let mut all: Vec<Configuration> = gaussians.iter().map(|&gaussians| Configuration { gaussians, ..one }).collect();
    let widths = numbers("WIDTHS", "120,240,480,960")?;
    all.extend(widths.iter().map(|&width| Configuration { varied: "pixels", width, ..one }));
    let threads = numbers("COUNTS", "1,2")?;
    all.extend(threads.iter().map(|&threads| Configuration { varied: "threads", threads, ..one }));
    let mut runs: Vec<Vec<Value>> = vec![Vec::new(); all.len()];
    for repeat in 0..numbers("REPEATS", "5")?[0] {
        for (c, runs) in all.iter().zip(&mut runs) {
            runs.push(measure(scene, &folder, *c, repeat)?);
        }
    }

    let median = |runs: &[Value], name: &str| summary(runs.iter().filter_map(|r| r[name].as_f64()).collect())[1];
    let mut table = "| varied | Gaussians | width | threads | CPU ms per iteration | wall ms | forward | loss | backward | Adam |\n|---|---|---|---|---|---|---|---|---|---|\n".to_string();
    for (c, runs) in all.iter().zip(&runs) {
        let n = median(runs, "gaussians");
        let _ = write!(table, "| {} | {n:.0} | {} | {} ", c.varied, c.width, c.threads);
        let _ = write!(table, "| {:.1} | {:.1} |", median(runs, "cpu_ms"), median(runs, "wall_ms"));
        PARTS[..4].iter().for_each(|part| table += &format!(" {:.0}% |", 100.0 * median(runs, part)));
        table += "\n";
    }
    let of = |varied: &str, x: &dyn Fn(&Configuration) -> f64, y: &str| {
        let own = all.iter().zip(&runs).filter(|(c, _)| c.varied == varied);
        exponent(&own.map(|(c, r)| (x(c), median(r, y))).collect::<Vec<_>>())
    };
    let exponents = [
        of("gaussians", &|c| f64::from(c.gaussians), "cpu_ms"),
        of("pixels", &|c| f64::from(c.width).powi(2), "cpu_ms"),
        of("threads", &|c| f64::from(c.threads), "wall_ms"),
    ];
    let [g, p, t] = exponents;
    let _ = writeln!(
        table,
        "\nCost grows as Gaussians^{g:.2} and pixels^{p:.2} (processor time), and as threads^{t:.2} (wall-clock time)."
    );
    let all = json!({"exponents": {"gaussians": g, "pixels": p, "threads_wall": t}, "runs": runs.concat()});
    write(out, &serde_json::to_string_pretty(&all).map_err(|e| e.to_string())?)?;
    write(&out.with_extension("md"), &table)
}
