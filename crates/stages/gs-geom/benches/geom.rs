//! Quality for the time: trains scenes in alternative ways and writes figures (JSON), a plot (SVG) and a table
//! (Markdown).
//!
//! `cargo bench -p gs-geom --bench geom -- --out geom.json --plot plot.svg --table table.md --scene name=folder@160px
//! [--scene ...] [--iterations 300,1000] [--seeds 3] [--jobs 2] [--max-gaussians 15000]`
//!
//! Runs that the JSON file holds already are not run again: delete it after a change of the programs. Each run is a process of its own on one thread. Wall-clock time says little on a machine that does other things too,
//! so the plot is over the processor time of the process. Scenes whose folder is missing are skipped.

#![expect(clippy::print_stderr, reason = "a program for people to run")]

use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

/// The alternatives: a name and the options that make it.
const SETTINGS: [(&str, &[&str]); 9] = [
    ("3DGS", &["--densify", "adaptive", "--schedule", "full", "--adam", "dense"]),
    ("sparse Adam", &["--densify", "adaptive", "--schedule", "full", "--adam", "sparse"]),
    ("coarse", &["--densify", "adaptive", "--schedule", "coarse", "--adam", "dense"]),
    ("content", &["--densify", "adaptive", "--schedule", "content", "--adam", "dense"]),
    ("absgrad, coarse", &["--densify", "absgrad", "--schedule", "coarse", "--adam", "dense"]),
    ("absgrad, content", &["--densify", "absgrad", "--schedule", "content", "--adam", "dense"]),
    ("mcmc", &["--densify", "mcmc", "--schedule", "full", "--adam", "dense"]),
    ("mcmc, content", &["--densify", "mcmc", "--schedule", "content", "--adam", "dense"]),
    ("antialias", &["--densify", "adaptive", "--schedule", "coarse", "--adam", "dense", "--antialias"]),
];
const COLORS: [&str; 9] =
    ["#444444", "#999999", "#1f77b4", "#d62728", "#17becf", "#ff7f0e", "#2ca02c", "#9467bd", "#8c564b"];
/// The figures of a run, and what they are called in the record of a run.
const FIGURES: [&str; 7] =
    ["psnr_heldout", "ssim_heldout", "gaussians", "cpu_seconds", "it_per_cpu_s", "it_per_s", "peak_rss_bytes"];

/// One process to run.
#[derive(Debug, Clone)]
struct Job {
    scene: usize,
    setting: usize,
    iterations: u32,
    seed: u32,
}

struct Scene {
    name: String,
    folder: PathBuf,
    resolution: String,
}

#[derive(Default)]
struct Options {
    out: PathBuf,
    plot: Option<PathBuf>,
    table: Option<PathBuf>,
    scenes: Vec<Scene>,
    iterations: Vec<u32>,
    seeds: u32,
    jobs: usize,
    max_gaussians: String,
    /// Names of the settings to run; all where it is empty.
    settings: Vec<String>,
}

fn options() -> Result<Options, String> {
    let mut o = Options {
        out: "geom.json".into(),
        iterations: vec![300, 1000],
        seeds: 3,
        jobs: 1,
        max_gaussians: "15000".into(),
        ..Options::default()
    };
    let mut arguments = std::env::args().skip(1).filter(|a| a != "--bench");
    while let Some(name) = arguments.next() {
        let value = arguments.next().ok_or_else(|| format!("{name} needs a value"))?;
        let number = || value.parse::<u32>().map_err(|_| format!("{name}: not a number: {value}"));
        match name.as_str() {
            "--out" => o.out = value.into(),
            "--plot" => o.plot = Some(value.into()),
            "--table" => o.table = Some(value.into()),
            "--seeds" => o.seeds = number()?,
            "--jobs" => o.jobs = number()?.max(1) as usize,
            "--max-gaussians" => o.max_gaussians = value,
            "--settings" => {
                // Names have commas in them.
                o.settings = value.split('/').map(|s| s.trim().to_string()).filter(|s| !s.is_empty()).collect();
                let known = |s: &&String| SETTINGS.iter().any(|(name, _)| *name == s.as_str());
                if let Some(unknown) = o.settings.iter().find(|s| !known(s)) {
                    return Err(format!("--settings: no setting is called {unknown}"));
                }
            }
            "--iterations" => {
                o.iterations = value
                    .split(',')
                    .map(|v| v.parse().map_err(|_| format!("not a number: {v}")))
                    .collect::<Result<_, _>>()?;
            }
            "--scene" => {
                let parts = value.split_once('=').and_then(|(n, rest)| Some((n, rest.rsplit_once('@')?)));
                let (name, (folder, resolution)) = parts.ok_or("--scene needs name=folder@resolution")?;
                if Path::new(folder).is_dir() {
                    let (name, resolution) = (name.to_string(), resolution.to_string());
                    o.scenes.push(Scene { name, folder: folder.into(), resolution });
                } else {
                    eprintln!("skipping {name}: no folder {folder}");
                }
            }
            _ => return Err(format!("unknown option {name}")),
        }
    }
    Ok(o)
}

/// Runs a job; its figures.
fn run(o: &Options, job: &Job) -> Result<Value, String> {
    let scene = &o.scenes[job.scene];
    let (name, flags) = SETTINGS[job.setting];
    let folder = o.out.with_extension("runs");
    std::fs::create_dir_all(&folder).map_err(|e| e.to_string())?;
    let out = folder.join(format!("{}-{}-{}-{}.ply", scene.name, job.setting, job.iterations, job.seed));
    let mut command = Command::new(std::env::var_os("GS_GEOM").unwrap_or(env!("CARGO_BIN_EXE_gs-geom").into()));
    command.args(["train", "--quiet", "--no-resume", "--threads", "1", "--max-gaussians", &o.max_gaussians]);
    command.args(["--resolution", &scene.resolution, "--checkpoint-every", "100000000"]).args(flags);
    command.args(["--iterations", &job.iterations.to_string(), "--seed", &job.seed.to_string()]);
    command.arg("--scene").arg(&scene.folder).arg("--out").arg(&out);
    let output = command.output().map_err(|e| e.to_string())?;
    if !output.status.success() {
        return Err(String::from_utf8_lossy(&output.stderr).into_owned());
    }
    let record = std::fs::read(format!("{}.run.json", out.display())).map_err(|e| e.to_string())?;
    let record: Value = serde_json::from_slice(&record).map_err(|e| e.to_string())?;
    let s = &record["summary"];
    let per = |seconds: &Value| seconds.as_f64().map(|t| f64::from(job.iterations) / t.max(1e-9));
    Ok(json!({
        "scene": scene.name, "resolution": scene.resolution, "setting": name, "options": flags.join(" "),
        "iterations": job.iterations, "seed": job.seed, "max_gaussians": o.max_gaussians,
        "psnr_heldout": s["psnr_heldout"], "ssim_heldout": s["ssim_heldout"], "gaussians": s["gaussians"],
        "cpu_seconds": s["cpu_seconds"], "it_per_cpu_s": per(&s["cpu_seconds"]),
        "it_per_s": per(&record["wall_seconds"]), "peak_rss_bytes": record["peak_rss_bytes"],
    }))
}

/// Median, least and most of every figure over the seeds, by scene, setting and iterations.
fn summary(runs: &[Value]) -> Vec<Value> {
    let mut groups: BTreeMap<(String, usize, u64), Vec<&Value>> = BTreeMap::new();
    for run in runs {
        let setting = SETTINGS.iter().position(|s| run["setting"] == s.0).unwrap_or(usize::MAX);
        let key = (run["scene"].as_str().unwrap_or("").into(), setting, run["iterations"].as_u64().unwrap_or(0));
        groups.entry(key).or_default().push(run);
    }
    let mut all = Vec::new();
    for ((scene, setting, iterations), runs) in groups {
        let mut one = json!({
            "scene": scene, "setting": SETTINGS[setting].0, "options": SETTINGS[setting].1.join(" "),
            "iterations": iterations, "seeds": runs.len(),
        });
        for figure in FIGURES {
            let mut values: Vec<f64> = runs.iter().filter_map(|r| r[figure].as_f64()).collect();
            values.sort_by(f64::total_cmp);
            if let (Some(least), Some(most)) = (values.first(), values.last()) {
                let middle = (values[(values.len() - 1) / 2] + values[values.len() / 2]) / 2.0;
                one[figure] = json!({"median": middle, "least": least, "most": most});
            }
        }
        all.push(one);
    }
    all
}

/// Whether a run is that of a job.
fn is_of(o: &Options, job: &Job, run: &Value) -> bool {
    let (scene, flags) = (&o.scenes[job.scene], SETTINGS[job.setting].1.join(" "));
    run["scene"] == *scene.name
        && run["resolution"] == *scene.resolution
        && run["options"] == *flags
        && run["iterations"] == job.iterations
        && run["seed"] == job.seed
        && run["max_gaussians"] == *o.max_gaussians
}

fn main() -> Result<(), String> {
    let o = options()?;
    let before = std::fs::read(&o.out).ok().and_then(|b| serde_json::from_slice::<Value>(&b).ok());
    let mut before = before.and_then(|v| v["runs"].as_array().cloned()).unwrap_or_default();
    let mut jobs = Vec::new();
    // The seeds last: what is there when one loses patience is then complete for fewer seeds.
    for seed in 0..o.seeds {
        for &iterations in &o.iterations {
            for scene in 0..o.scenes.len() {
                let wanted = |s: &usize| o.settings.is_empty() || o.settings.iter().any(|w| w == SETTINGS[*s].0);
                let settings = (0..SETTINGS.len()).filter(wanted);
                jobs.extend(settings.map(|setting| Job { scene, setting, iterations, seed }));
            }
        }
    }
    before.retain(|run| jobs.iter().any(|job| is_of(&o, job, run)));
    jobs.retain(|job| !before.iter().any(|run| is_of(&o, job, run)));
    write_all(&o, &before)?;
    let (next, runs) = (AtomicUsize::new(0), Mutex::new(before));
    let work = || {
        while let Some(job) = jobs.get(next.fetch_add(1, Ordering::Relaxed)) {
            let result = run(&o, job)?;
            eprintln!("{result}");
            let mut runs = runs.lock().map_err(|e| e.to_string())?;
            runs.push(result);
            write_all(&o, &runs)?;
        }
        Ok(())
    };
    std::thread::scope(|scope| {
        let threads: Vec<_> = (0..o.jobs).map(|_| scope.spawn(work)).collect();
        threads.into_iter().try_for_each(|t| t.join().map_err(|_| "a thread panicked".to_string())?)
    })
}

fn write_all(o: &Options, runs: &[Value]) -> Result<(), String> {
    let groups = summary(runs);
    let write = |path: &Path, text: &str| gs_io::write_bytes(path, text.as_bytes()).map_err(|e| e.to_string());
    let all = json!({"max_gaussians": o.max_gaussians, "settings": groups, "runs": runs});
    write(&o.out, &serde_json::to_string_pretty(&all).map_err(|e| e.to_string())?)?;
    if let Some(path) = &o.plot {
        write(path, &plot(&groups))?;
    }
    if let Some(path) = &o.table {
        write(path, &table(&groups))?;
    }
    Ok(())
}

fn median(group: &Value, figure: &str) -> f64 {
    group[figure]["median"].as_f64().unwrap_or(f64::NAN)
}

fn table(groups: &[Value]) -> String {
    let mut t = "| scene | setting | iterations | PSNR (least to most) | SSIM | Gaussians | CPU s | it per CPU s | peak MB |\n|---|---|---|---|---|---|---|---|---|\n".to_string();
    for g in groups {
        let (p, m) = (&g["psnr_heldout"], |figure| median(g, figure));
        let _ = writeln!(
            t,
            "| {} | {} | {} | {:.2} ({:.2} to {:.2}) | {:.4} | {:.0} | {:.1} | {:.1} | {:.0} |",
            g["scene"].as_str().unwrap_or(""),
            g["setting"].as_str().unwrap_or(""),
            g["iterations"],
            m("psnr_heldout"),
            p["least"].as_f64().unwrap_or(f64::NAN),
            p["most"].as_f64().unwrap_or(f64::NAN),
            m("ssim_heldout"),
            m("gaussians"),
            m("cpu_seconds"),
            m("it_per_cpu_s"),
            m("peak_rss_bytes") / 1e6
        );
    }
    t
}

/// A point of a line: x, and median, least and most of y.
type Point = (f64, f64, f64, f64);

/// PSNR over processor time and over iterations, a column per scene.
fn plot(groups: &[Value]) -> String {
    let mut scenes: Vec<&str> = groups.iter().filter_map(|g| g["scene"].as_str()).collect();
    scenes.dedup();
    let (width, height) = (380.0, 260.0);
    let total = (width * scenes.len().max(1) as f64, 2.0 * height + 60.0);
    let mut s = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {} {}\" font-family=\"sans-serif\" font-size=\"11\">\n<rect width=\"100%\" height=\"100%\" fill=\"white\"/>\n",
        total.0, total.1
    );
    for (column, scene) in scenes.iter().enumerate() {
        for (row, axis) in ["CPU seconds", "iterations"].into_iter().enumerate() {
            let lines: Vec<(usize, Vec<Point>)> = (0..SETTINGS.len())
                .map(|setting| {
                    let own = |g: &&Value| g["scene"] == *scene && g["setting"] == SETTINGS[setting].0;
                    let point = |g: &Value| {
                        let x =
                            if row == 0 { median(g, "cpu_seconds") } else { g["iterations"].as_f64().unwrap_or(0.0) };
                        let p = |which: &str| g["psnr_heldout"][which].as_f64().unwrap_or(f64::NAN);
                        (x, p("median"), p("least"), p("most"))
                    };
                    (setting, groups.iter().filter(own).map(point).collect())
                })
                .collect();
            let at = (column as f64 * width, row as f64 * height);
            panel(&mut s, at, (width, height), &format!("{scene}: held-out PSNR (dB) over {axis}"), &lines);
        }
    }
    for (i, (name, _)) in SETTINGS.iter().enumerate() {
        let (x, y) = (46.0 + 180.0 * (i % 4) as f64, 2.0 * height + 20.0 + 20.0 * (i / 4) as f64);
        let _ = writeln!(
            s,
            "<rect x=\"{x}\" y=\"{}\" width=\"12\" height=\"4\" fill=\"{}\"/><text x=\"{}\" y=\"{y}\">{name}</text>",
            y - 6.0,
            COLORS[i],
            x + 18.0
        );
    }
    s + "</svg>\n"
}

fn panel(s: &mut String, at: (f64, f64), size: (f64, f64), title: &str, lines: &[(usize, Vec<Point>)]) {
    let all: Vec<Point> =
        lines.iter().flat_map(|(_, l)| l.iter().copied()).filter(|p| p.1.is_finite() && p.0 > 0.0).collect();
    let fold = |v: &dyn Fn(&Point) -> f64, f: fn(f64, f64) -> f64| all.iter().map(v).reduce(f).unwrap_or(1.0);
    let (x0, x1) = (fold(&|p| p.0, f64::min) / 1.1, fold(&|p| p.0, f64::max) * 1.1);
    let (y0, y1) = (fold(&|p| p.2, f64::min).floor(), fold(&|p| p.3, f64::max).ceil());
    let (left, right, top, bottom) = (at.0 + 40.0, at.0 + size.0 - 16.0, at.1 + 28.0, at.1 + size.1 - 24.0);
    // Time is shown as ratios.
    let px = |x: f64| left + (x / x0).ln() / (x1 / x0).ln() * (right - left);
    let py = |y: f64| bottom - (y - y0) / (y1 - y0).max(1e-9) * (bottom - top);
    let _ = writeln!(s, "<text x=\"{left}\" y=\"{}\" font-weight=\"bold\">{title}</text>", top - 10.0);
    let step = ((y1 - y0) / 6.0).ceil().max(1.0);
    let mut y = y0;
    while y <= y1 {
        let _ = writeln!(
            s,
            "<line x1=\"{left}\" x2=\"{right}\" y1=\"{0:.1}\" y2=\"{0:.1}\" stroke=\"#ddd\"/><text x=\"{1}\" y=\"{2:.1}\" text-anchor=\"end\">{y}</text>",
            py(y),
            left - 6.0,
            py(y) + 4.0
        );
        y += step;
    }
    let ticks = (0..7).flat_map(|e| [1.0, 2.0, 5.0].map(|m| m * 10f64.powi(e))).filter(|t| (x0..=x1).contains(t));
    for t in ticks {
        let _ = writeln!(
            s,
            "<line x1=\"{0:.1}\" x2=\"{0:.1}\" y1=\"{top}\" y2=\"{bottom}\" stroke=\"#eee\"/><text x=\"{0:.1}\" y=\"{1}\" text-anchor=\"middle\">{t}</text>",
            px(t),
            bottom + 14.0
        );
    }
    for (setting, points) in lines {
        let color = COLORS[*setting];
        let path: Vec<String> = points.iter().map(|p| format!("{:.1},{:.1}", px(p.0), py(p.1))).collect();
        let _ = writeln!(
            s,
            "<polyline points=\"{}\" fill=\"none\" stroke=\"{color}\" stroke-width=\"1.6\"/>",
            path.join(" ")
        );
        for p in points {
            let _ = writeln!(
                s,
                "<line x1=\"{0:.1}\" x2=\"{0:.1}\" y1=\"{1:.1}\" y2=\"{2:.1}\" stroke=\"{color}\"/><circle cx=\"{0:.1}\" cy=\"{3:.1}\" r=\"2.5\" fill=\"{color}\"/>",
                px(p.0),
                py(p.2),
                py(p.3),
                py(p.1)
            );
        }
    }
}
