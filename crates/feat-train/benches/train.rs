//! `make bench-train`: what an iteration of training costs at a million Gaussians, 100,000 anchors and 300 views.
//! [`scene`] says how the scene is made. Writes out/bench/train.json.

mod rendering;
mod scene;

use clap::Parser;
use feat_train::adam::{Adam, Rates};
use feat_train::fast::{Engine, Shortcuts, Timings};
use feat_train::loss::Loss;
use feat_train::model::{Init, Model, Settings};
use feat_train::normalize::Axis;
use feat_train::scene::{Context, MaskSet, Neighbours};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rendering::View;
use scene::scene;
use serde_json::{Value, json};
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// Iterations of a training.
const ITERATIONS: u64 = 10_000;

#[derive(Debug, Parser)]
struct Args {
    /// Iterations of a run; the time of 10,000 is extrapolated
    #[arg(long, default_value_t = 100)]
    iterations: u64,
    /// Runs, of which the median is reported
    #[arg(long, default_value_t = 5)]
    runs: usize,
    /// Gaussians along a side of the surface
    #[arg(long, default_value_t = 1000)]
    side: usize,
    /// Views
    #[arg(long, default_value_t = 300)]
    views: usize,
    /// Threads; 0 for one per core
    #[arg(long, default_value_t = 0)]
    threads: usize,
    /// Where the report goes
    #[arg(long, default_value = "out/bench/train.json")]
    out: PathBuf,
    /// Given by cargo
    #[arg(long, hide = true)]
    bench: bool,
}

fn settings(layers: usize) -> Settings {
    Settings {
        dim: 6,
        layers,
        norm_axis: Axis::Channel,
        loss: Loss::Printed,
        tau: 0.1,
        cohesion: 0.0,
        init: Init::Uniform,
    }
}

/// What a run of the engine gave.
struct Run {
    seconds: f64,
    /// Of all threads together.
    cpu_seconds: f64,
    timings: Timings,
    features: Vec<f32>,
    loss: f64,
    network_bytes: usize,
}

/// The views in an order that jumps about.
fn view(sets: &[MaskSet<f32>], i: u64) -> &MaskSet<f32> {
    &sets[i as usize * 7 % sets.len()]
}

/// Iterations of the engine, from a fresh model.
fn engine(context: &Context, sets: &[MaskSet<f32>], layers: usize, shortcuts: Shortcuts, iterations: u64) -> Run {
    let mut model = Model::<f32>::new(settings(layers), context, &mut ChaCha8Rng::seed_from_u64(0));
    let mut engine = Engine::new(context, &model, shortcuts);
    let mut adam = Adam::new(model.features.len());
    let mut weights: Vec<Adam<f32>> = model.layers.iter().map(|l| Adam::new(l.weights.len())).collect();
    let mut loss = 0.0;
    let (start, cpu) = (Instant::now(), cpu_seconds());
    for i in 0..iterations {
        let set = view(sets, i);
        engine.propagate(&model, i);
        let evaluated = engine.evaluate(&model, set, i);
        let rates = Rates::at(1e-3, i + 1);
        let gradients = engine.backward(&mut model, &mut adam, set, &evaluated, i, &rates, i);
        for ((layer, adam), gradient) in model.layers.iter_mut().zip(&mut weights).zip(&gradients) {
            adam.update(&mut layer.weights, gradient, 1e-3, i + 1);
        }
        loss += evaluated.loss / iterations as f64;
    }
    let n = iterations as f64;
    Run {
        seconds: start.elapsed().as_secs_f64() / n,
        cpu_seconds: (cpu_seconds() - cpu) / n,
        timings: engine.timings,
        network_bytes: engine.network_bytes(),
        features: model.features,
        loss,
    }
}

/// Iterations of the readable model with the dense optimiser, as training was before the engine: seconds and, of all
/// threads, CPU seconds of one.
fn readable(context: &Context, sets: &[MaskSet<f32>], iterations: u64) -> [f64; 2] {
    let mut model = Model::<f32>::new(settings(2), context, &mut ChaCha8Rng::seed_from_u64(0));
    let mut adam = Adam::new(model.features.len());
    let mut layers: Vec<Adam<f32>> = model.layers.iter().map(|l| Adam::new(l.weights.len())).collect();
    let d = model.settings.dim;
    let mut dense = vec![0.0; model.features.len()];
    let (start, cpu) = (Instant::now(), cpu_seconds());
    for i in 0..iterations {
        let set = view(sets, i);
        let propagated = model.propagate(context);
        let step = model.step(context, &propagated, set, i);
        for (row, &place) in step.features.chunks_exact(d).zip(&set.columns) {
            dense[place as usize * d..(place as usize + 1) * d].copy_from_slice(row);
        }
        adam.update(&mut model.features, &dense, 1e-3, i + 1);
        for &place in &set.columns {
            dense[place as usize * d..(place as usize + 1) * d].fill(0.0);
        }
        for ((layer, adam), gradient) in model.layers.iter_mut().zip(&mut layers).zip(&step.layers) {
            adam.update(&mut layer.weights, gradient, 1e-3, i + 1);
        }
    }
    [start.elapsed().as_secs_f64(), cpu_seconds() - cpu].map(|s| s / iterations as f64)
}

/// User and system time of this process, in all; 0 where it is not told.
fn cpu_seconds() -> f64 {
    const TICKS_PER_SECOND: f64 = 100.0;
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    // After the name, which is in parentheses: state is field 0, user and system ticks 11 and 12.
    let fields = stat.rsplit(')').next().unwrap_or_default().split_whitespace().skip(11).take(2);
    fields.filter_map(|f| f.parse::<f64>().ok()).sum::<f64>() / TICKS_PER_SECOND
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn spread(values: &[f64]) -> [f64; 2] {
    [values.iter().copied().fold(f64::INFINITY, f64::min), values.iter().copied().fold(0.0, f64::max)]
}

/// Root mean square of the differences.
fn apart(a: &[f32], b: &[f32]) -> f64 {
    let squares: f64 = a.iter().zip(b).map(|(a, b)| f64::from(a - b) * f64::from(a - b)).sum();
    (squares / a.len() as f64).sqrt()
}

fn breakdown(runs: &[Run], iterations: u64) -> Value {
    let of = |part: fn(&Timings) -> Duration| {
        median(runs.iter().map(|r| part(&r.timings).as_secs_f64() / iterations as f64).collect())
    };
    json!({
        "propagate": of(|t| t.propagate),
        "centroids": of(|t| t.centroids),
        "loss": of(|t| t.loss),
        "columns_adam_statistics": of(|t| t.features),
        "network_backward": of(|t| t.backward),
    })
}

/// What the shortcuts save and cost, against the exact run of as many iterations.
fn shortcuts(context: &Context, sets: &[MaskSet<f32>], exact: &Run, iterations: u64) -> Value {
    let start = Model::<f32>::new(settings(2), context, &mut ChaCha8Rng::seed_from_u64(0)).features;
    let moved = apart(&exact.features, &start);
    let exactly = Shortcuts::default();
    let all = [
        ("none", exactly),
        ("--stats-every 10", Shortcuts { stats_every: 10, ..exactly }),
        ("--lazy-adam", Shortcuts { lazy_adam: true, ..exactly }),
        ("both", Shortcuts { stats_every: 10, lazy_adam: true }),
    ];
    let row = |(name, shortcuts): &(&str, Shortcuts)| {
        let run = engine(context, sets, 2, *shortcuts, iterations);
        json!({
            "option": name, "seconds_per_iteration": run.seconds, "cpu_seconds_per_iteration": run.cpu_seconds,
            "features_off": apart(&run.features, &exact.features) / moved, "loss_off": (run.loss - exact.loss).abs(),
        })
    };
    all.iter().map(row).collect()
}

/// Time and memory of each number of layers.
fn layers(context: &Context, sets: &[MaskSet<f32>], iterations: u64) -> Value {
    let row = |layers: usize| {
        let run = engine(context, sets, layers, Shortcuts::default(), iterations);
        json!({
            "layers": layers, "network_bytes": run.network_bytes, "seconds_per_iteration": run.seconds,
            "cpu_seconds_per_iteration": run.cpu_seconds,
        })
    };
    (0..=4).map(row).collect()
}

/// An iteration on footprints beside rendering and averaging, on 102,400 Gaussians and one view of 1000 x 750.
fn against_rendering() -> Value {
    let side = 320;
    let s = scene(side);
    let context = s.context(Neighbours::Gaussians, true);
    let mut model = Model::<f32>::new(settings(2), &context, &mut ChaCha8Rng::seed_from_u64(0));
    // As after some training: centroids of different directions.
    for (i, f) in model.features.iter_mut().enumerate() {
        *f = 3.0 * *f - 1.5 + (i / 6000 % 7) as f32 * 0.3;
    }
    let found = View::new(&s.positions, side as f64, 1000, 750).compare(&context, &model, 5);
    json!({
        "gaussians": side * side, "width": 1000, "height": 750, "rendering_seconds": found.rendering,
        "engine_seconds": found.engine, "ratio": found.rendering / found.engine,
        "difference": { "centroids": found.centroids, "loss": found.loss, "gradients": found.gradients },
    })
}

fn main() {
    let args = Args::parse();
    rayon::ThreadPoolBuilder::new().num_threads(args.threads).build_global().expect("the first pool");
    let s = scene(args.side);
    let context = s.context(Neighbours::Gaussians, true);
    let sets = s.views(&context, args.views);
    let entries: usize = sets.iter().map(|s| s.mask.len()).sum();
    let columns: usize = sets.iter().map(|s| s.columns.len()).sum();
    let first = engine(&context, &sets, 2, Shortcuts::default(), args.iterations);
    let peak = stage::peak_rss_bytes();
    // What training was before, on a few views in the order of the sampling, in turn with what it is.
    let sampling = s.context(Neighbours::Gaussians, false);
    let few_sets = s.views(&sampling, args.views.min(20));
    let (mut runs, mut before) = (vec![first], Vec::new());
    for _ in 1..args.runs {
        before.push(readable(&sampling, &few_sets, (args.iterations / 10).max(1)));
        runs.push(engine(&context, &sets, 2, Shortcuts::default(), args.iterations));
    }
    drop((sampling, few_sets));
    let seconds: Vec<f64> = runs.iter().map(|r| r.seconds).collect();
    let each = median(seconds.clone());
    let before_each = median(before.iter().map(|b| b[0]).chain((before.is_empty()).then_some(f64::NAN)).collect());
    let report = json!({
        "gaussians": context.order.len(), "anchors": context.anchors.len(), "views": sets.len(), "dim": 6, "layers": 2,
        "columns": columns, "entries": entries, "threads": rayon::current_num_threads(),
        "iterations": ITERATIONS, "measured_iterations": args.iterations, "runs": args.runs,
        "seconds": each * ITERATIONS as f64, "it_per_s": 1.0 / each,
        "seconds_per_iteration": each, "spread": spread(&seconds),
        "cpu_seconds_per_iteration": median(runs.iter().map(|r| r.cpu_seconds).collect()),
        "peak_rss_bytes": peak,
        "breakdown": breakdown(&runs, args.iterations),
        "before": {
            "seconds_per_iteration": before_each, "spread": spread(&before.iter().map(|b| b[0]).collect::<Vec<_>>()),
            "cpu_seconds_per_iteration": before.iter().map(|b| b[1]).sum::<f64>() / before.len() as f64,
            "ratio": before_each / each,
        },
        "shortcuts": shortcuts(&context, &sets, &runs[0], args.iterations),
        "by_layers": layers(&context, &sets, (args.iterations / 4).max(1)),
        "rendering": against_rendering(),
    });
    let text = serde_json::to_string_pretty(&report).expect("a report is JSON") + "\n";
    eprint!("{text}");
    let folder = args.out.parent().expect("a file in a folder");
    std::fs::create_dir_all(folder).expect("the folder can be made");
    std::fs::write(&args.out, text).expect("the report can be written");
}
