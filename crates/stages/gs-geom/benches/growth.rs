//! Cost of an iteration against the number of Gaussians, of pixels and of threads, with fitted exponents: JSON and a
//! Markdown table.
//!
//! `cargo bench -p gs-geom --bench growth -- --out growth.json --table growth.md --scene folder [--gaussians
//! 4000,8000,16000,32000] [--widths 120,240,480,960] [--threads 1,2] [--repeats 3] [--iterations 40]`
//!
//! The Gaussians are learnt first, at 480 pixels, once for each number, and kept beside the JSON. Then short optimisations
//! go on from them without densification and with all spherical harmonics; every configuration is run once before any is run
//! again. Costs are processor time, and for threads wall-clock time.

#![expect(clippy::print_stderr, reason = "a program for people to run")]

use serde_json::{Value, json};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Width at which Gaussians and threads are varied, pixels.
const WIDTH: u32 = 480;
/// Iterations that learn the Gaussians.
const LEARNING: &str = "600";

struct Options {
    out: PathBuf,
    table: Option<PathBuf>,
    scene: PathBuf,
    gaussians: Vec<u32>,
    widths: Vec<u32>,
    threads: Vec<u32>,
    repeats: u32,
    iterations: u32,
}

fn options() -> Result<Options, String> {
    let mut o = Options {
        out: "growth.json".into(),
        table: None,
        scene: PathBuf::new(),
        gaussians: vec![4000, 8000, 16_000, 32_000],
        widths: vec![120, 240, 480, 960],
        threads: vec![1, 2],
        repeats: 3,
        iterations: 40,
    };
    let mut arguments = std::env::args().skip(1).filter(|a| a != "--bench");
    while let Some(name) = arguments.next() {
        let value = arguments.next().ok_or_else(|| format!("{name} needs a value"))?;
        let numbers = || -> Result<Vec<u32>, String> {
            value.split(',').map(|v| v.parse().map_err(|_| format!("{name}: not a number: {v}"))).collect()
        };
        match name.as_str() {
            "--out" => o.out = value.into(),
            "--table" => o.table = Some(value.into()),
            "--scene" => o.scene = value.into(),
            "--gaussians" => o.gaussians = numbers()?,
            "--widths" => o.widths = numbers()?,
            "--threads" => o.threads = numbers()?,
            "--repeats" => o.repeats = numbers()?[0],
            "--iterations" => o.iterations = numbers()?[0],
            _ => return Err(format!("unknown option {name}")),
        }
    }
    Ok(o)
}

/// Runs `gs-geom train`; its record.
fn train(scene: &Path, out: &Path, more: &[&str]) -> Result<Value, String> {
    let program = std::env::var_os("GS_GEOM").unwrap_or(env!("CARGO_BIN_EXE_gs-geom").into());
    let mut command = Command::new(program);
    command.args(["train", "--quiet", "--no-resume", "--holdout", "0", "--schedule", "full"]);
    command.args(["--checkpoint-every", "100000000"]).args(more).arg("--scene").arg(scene).arg("--out").arg(out);
    let output = command.output().map_err(|e| e.to_string())?;
    if !output.status.success() {
        return Err(String::from_utf8_lossy(&output.stderr).into_owned());
    }
    let record = std::fs::read(format!("{}.run.json", out.display())).map_err(|e| e.to_string())?;
    serde_json::from_slice(&record).map_err(|e| e.to_string())
}

/// One way to run: what is varied, and its three numbers.
#[derive(Clone, Copy)]
struct Configuration {
    varied: &'static str,
    gaussians: u32,
    width: u32,
    threads: u32,
}

fn measure(o: &Options, folder: &Path, c: Configuration) -> Result<Value, String> {
    let init = folder.join(format!("{}.ply", c.gaussians));
    let (iterations, threads) = (o.iterations.to_string(), c.threads.to_string());
    let (resolution, init) = (format!("{}px", c.width), init.to_string_lossy().into_owned());
    let more = ["--init", &init, "--densify-until", "0", "--sh-every", "1", "--max-gaussians", "100000000"];
    let size = ["--iterations", &iterations, "--threads", &threads, "--resolution", &resolution];
    let record = train(&o.scene, &folder.join("timed.ply"), &[&more[..], &size].concat())?;
    let s = &record["summary"];
    let per = |v: &Value| v.as_f64().map(|t| 1e3 * t / f64::from(o.iterations));
    let parts = ["forward", "loss", "backward", "Adam", "rest"];
    let wall: f64 = parts.iter().filter_map(|p| per(&s["seconds"][*p])).sum();
    let mut one = json!({
        "varied": c.varied, "width": c.width, "threads": c.threads, "gaussians": s["gaussians"],
        "cpu_ms": per(&s["iteration_cpu_seconds"]), "wall_ms": wall,
    });
    for part in parts {
        one[part] = json!(s["seconds"][part].as_f64().map(|t| 1e3 * t / f64::from(o.iterations) / wall.max(1e-9)));
    }
    eprintln!("{one}");
    Ok(one)
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    let n = values.len();
    if n == 0 { f64::NAN } else { (values[(n - 1) / 2] + values[n / 2]) / 2.0 }
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
    let o = options()?;
    let folder = o.out.with_extension("runs");
    std::fs::create_dir_all(&folder).map_err(|e| e.to_string())?;
    for n in &o.gaussians {
        let out = folder.join(format!("{n}.ply"));
        if !out.exists() {
            let (most, width) = (n.to_string(), format!("{WIDTH}px"));
            let more = ["--iterations", LEARNING, "--max-gaussians", &most, "--resolution", &width];
            // A low threshold: the number is to be reached.
            train(&o.scene, &out, &[&more[..], &["--densify-gradient", "0.00002", "--densify-every", "50"]].concat())?;
            eprintln!("learnt {n} Gaussians");
        }
    }
    let middle = o.gaussians[o.gaussians.len() / 2];
    let one = Configuration { varied: "gaussians", gaussians: middle, width: WIDTH, threads: 1 };
    let mut all: Vec<Configuration> = o.gaussians.iter().map(|&gaussians| Configuration { gaussians, ..one }).collect();
    all.extend(o.widths.iter().map(|&width| Configuration { varied: "pixels", width, ..one }));
    all.extend(o.threads.iter().map(|&threads| Configuration { varied: "threads", threads, ..one }));
    let mut runs: Vec<Vec<Value>> = vec![Vec::new(); all.len()];
    for _ in 0..o.repeats {
        for (c, runs) in all.iter().zip(&mut runs) {
            runs.push(measure(&o, &folder, *c)?);
        }
    }
    let figure = |runs: &[Value], name: &str| median(runs.iter().filter_map(|r| r[name].as_f64()).collect());
    let mut table = "| varied | Gaussians | width | threads | CPU ms per iteration | wall ms | forward | loss | backward | Adam |\n|---|---|---|---|---|---|---|---|---|---|\n".to_string();
    for (c, runs) in all.iter().zip(&runs) {
        let f = |name| figure(runs, name);
        let _ = writeln!(
            table,
            "| {} | {:.0} | {} | {} | {:.1} | {:.1} | {:.0}% | {:.0}% | {:.0}% | {:.0}% |",
            c.varied,
            f("gaussians"),
            c.width,
            c.threads,
            f("cpu_ms"),
            f("wall_ms"),
            100.0 * f("forward"),
            100.0 * f("loss"),
            100.0 * f("backward"),
            100.0 * f("Adam")
        );
    }
    let of = |varied: &str, x: &dyn Fn(&Configuration, &[Value]) -> f64, y: &str| {
        let own = all.iter().zip(&runs).filter(|(c, _)| c.varied == varied);
        exponent(&own.map(|(c, r)| (x(c, r), figure(r, y))).collect::<Vec<_>>())
    };
    let exponents = json!({
        "gaussians": of("gaussians", &|_, r| figure(r, "gaussians"), "cpu_ms"),
        "pixels": of("pixels", &|c, _| f64::from(c.width).powi(2), "cpu_ms"),
        "threads_wall": of("threads", &|c, _| f64::from(c.threads), "wall_ms"),
    });
    let e = |name: &str| exponents[name].as_f64().unwrap_or(f64::NAN);
    let _ = writeln!(
        table,
        "\nCost grows as Gaussians^{:.2} and pixels^{:.2} (processor time), and as threads^{:.2} (wall-clock time).",
        e("gaussians"),
        e("pixels"),
        e("threads_wall")
    );
    let text = serde_json::to_string_pretty(&json!({"exponents": exponents, "runs": runs.concat()}));
    let write = |path: &Path, text: &str| gs_io::write_bytes(path, text.as_bytes()).map_err(|e| e.to_string());
    write(&o.out, &text.map_err(|e| e.to_string())?)?;
    o.table.map_or(Ok(()), |path| write(&path, &table))
}
