//! `make bench-train`: what an iteration of training costs at a million Gaussians, 100,000 anchors and 300 views.
//! [`scene`] says how the scene is made. Writes out/bench/train.json.

mod closed_form;
mod rendering;
mod scene;

use clap::Parser;
use feat_train::adam::{Adam, Rates};
use feat_train::fast::{Engine, Shortcuts, Timings};
use feat_train::loss::{self, Loss};
use feat_train::model::{Model, Settings};
use feat_train::real::{Half, Weight};
use feat_train::scene::{Context, MaskSet, Neighbours};
use feat_train::train::{TrainOptions, train};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rendering::View;
use scene::{Scene, scene};
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
    /// Measure the closed form alone
    #[arg(long)]
    closed_form: bool,
    /// Given by cargo
    #[arg(long, hide = true)]
    bench: bool,
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
fn view<W>(sets: &[MaskSet<W>], i: u64) -> &MaskSet<W> {
    &sets[i as usize * 7 % sets.len()]
}

/// Iterations of the engine, from a fresh model.
fn engine<W: Weight>(
    context: &Context,
    sets: &[MaskSet<W>],
    layers: usize,
    shortcuts: Shortcuts,
    iterations: u64,
) -> Run {
    let mut model = Model::<f32>::new(Settings::printed(6, layers), context, &mut ChaCha8Rng::seed_from_u64(0));
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
fn readable(context: &Context, sets: &[MaskSet], iterations: u64) -> [f64; 2] {
    let mut model = Model::<f32>::new(Settings::printed(6, 2), context, &mut ChaCha8Rng::seed_from_u64(0));
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

/// Processor time of this process; 0 where it is not told.
fn cpu_seconds() -> f64 {
    stage::cpu_seconds().unwrap_or(0.0)
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

/// Entries of footprints below this are dropped in the row of `graph-precompute --cut`.
const CUT: f32 = 1e-4;
/// Refresh of statistics in its row.
const EVERY: u64 = 10;

/// Bytes of the footprints.
fn footprint_bytes<W>(sets: &[MaskSet<W>]) -> usize {
    let of = |s: &MaskSet<W>| 4 * (s.columns.len() + s.start.len()) + (2 + size_of::<W>()) * s.mask.len();
    sets.iter().map(of).sum()
}

/// What changes the numbers: its time and its error, against the exact run of as many iterations.
fn approximations(s: &Scene, context: &Context, sets: &[MaskSet], exact: &Run, iterations: u64) -> Value {
    let start = Model::<f32>::new(Settings::printed(6, 2), context, &mut ChaCha8Rng::seed_from_u64(0)).features;
    let moved = apart(&exact.features, &start);
    let row = |name: &str, bytes: usize, run: Run| {
        json!({
            "option": name, "seconds_per_iteration": run.seconds, "cpu_seconds_per_iteration": run.cpu_seconds,
            "footprint_bytes": bytes, "features_off": apart(&run.features, &exact.features) / moved,
            "loss_off": (run.loss - exact.loss).abs(),
        })
    };
    let none = Shortcuts::default();
    let (refreshed, lazy) = (Shortcuts { stats_every: EVERY, ..none }, Shortcuts { lazy_adam: true, ..none });
    let bytes = footprint_bytes(sets);
    let mut rows = Vec::new();
    for (name, shortcuts) in [
        ("none".to_string(), none),
        (format!("--stats-every {EVERY}"), refreshed),
        ("--lazy-adam".to_string(), lazy),
        (format!("--stats-every {EVERY} --lazy-adam"), Shortcuts { stats_every: EVERY, lazy_adam: true }),
    ] {
        rows.push(row(&name, bytes, engine(context, sets, 2, shortcuts, iterations)));
    }
    let half = s.cut_views::<Half>(context, sets.len(), 0.0).0;
    rows.push(row("--half-weights", footprint_bytes(&half), engine(context, &half, 2, none, iterations)));
    drop(half);
    let (cut, dropped) = s.cut_views::<f32>(context, sets.len(), CUT);
    let mut cut_row = row(
        &format!("graph-precompute --cut {CUT}"),
        footprint_bytes(&cut),
        engine(context, &cut, 2, none, iterations),
    );
    let entries = |sets: &[MaskSet]| sets.iter().map(|s| s.mask.len()).sum::<usize>() as f64;
    cut_row["entries_dropped"] = json!(1.0 - entries(&cut) / entries(sets));
    cut_row["largest_change_of_a_centroid"] = json!(dropped);
    rows.push(cut_row);
    rows.into()
}

/// Mean loss of views by features `[n][d]` in the order of kept Gaussians.
fn mean_loss(context: &Context, sets: &[&MaskSet], features: &[f32]) -> f64 {
    let d = Settings::printed(6, 2).dim;
    let of = |set: &MaskSet| {
        let mut centroids = vec![0.0; set.len() * d];
        for (c, &place) in set.columns.iter().enumerate() {
            let i = context.order[place as usize] as usize;
            let (mask, weight) = set.entries(c);
            for (&k, w) in mask.iter().zip(weight) {
                let to = &mut centroids[k as usize * d..(k as usize + 1) * d];
                to.iter_mut().zip(&features[i * d..]).for_each(|(t, f)| *t += f64::from(*w) * f64::from(*f));
            }
        }
        loss::evaluate(Loss::Printed, &centroids, None, d, Settings::printed(6, 2).tau).loss
    };
    sets.iter().map(|set| of(set)).sum::<f64>() / sets.len() as f64
}

/// Whole trainings on a small scene, to the end and with `--early-stop`: what stopping saves, and what it costs in the
/// loss of the views that neither learns from.
fn early_stop() -> Value {
    let (side, views) = (100, 60);
    let s = scene(side);
    let context = s.context(Neighbours::Gaussians, true);
    let sets = s.views(&context, views);
    let (held_out, seen): (Vec<_>, Vec<_>) = sets.iter().enumerate().partition(|(i, _)| i % 10 == 9);
    let held_out: Vec<&MaskSet> = held_out.into_iter().map(|(_, set)| set).collect();
    let seen: Vec<MaskSet> = seen.into_iter().map(|(_, set)| set.clone()).collect();
    let run = |sets: &[MaskSet], early_stop: bool| {
        let options = TrainOptions {
            settings: Settings::printed(6, 2),
            iterations: ITERATIONS,
            rate: 1e-3,
            weight_rate: 1e-3,
            seed: 0,
            checkpoint_every: 0,
            curve_every: 1000,
            shortcuts: Shortcuts::default(),
            early_stop,
        };
        let clock = cpu_seconds();
        let silent = stage::Stage::silent("bench");
        let trained = train(&context, sets, &options, None, &silent, |_| Ok(())).expect("training works");
        (cpu_seconds() - clock, trained)
    };
    let (all_cpu, all) = run(&seen, false);
    let (early_cpu, early) = run(&sets, true);
    let row = |cpu: f64, t: &feat_train::train::Trained| json!({ "iterations": t.iterations, "cpu_seconds": cpu, "held_out_loss": mean_loss(&context, &held_out, &t.features) });
    json!({
        "gaussians": side * side, "views": views, "held_out": held_out.len(),
        "to_the_end": row(all_cpu, &all), "early_stop": row(early_cpu, &early),
    })
}

/// Time and memory of each number of layers.
fn layers(context: &Context, sets: &[MaskSet], iterations: u64) -> Value {
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
    let mut model = Model::<f32>::new(Settings::printed(6, 2), &context, &mut ChaCha8Rng::seed_from_u64(0));
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
    let folder = args.out.parent().expect("a file in a folder");
    std::fs::create_dir_all(folder).expect("the folder can be made");
    let closed_form = closed_form::measure(&s, args.views, args.threads, folder);
    if args.closed_form {
        eprintln!("{closed_form:#}");
        return;
    }
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
        "approximations": approximations(&s, &context, &sets, &runs[0], args.iterations),
        "early_stop": early_stop(),
        "by_layers": layers(&context, &sets, (args.iterations / 4).max(1)),
        "rendering": against_rendering(),
        "closed_form": closed_form,
    });
    let text = serde_json::to_string_pretty(&report).expect("a report is JSON") + "\n";
    eprint!("{text}");
    std::fs::write(&args.out, text).expect("the report can be written");
}
