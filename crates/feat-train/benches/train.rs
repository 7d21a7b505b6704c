//! `make bench-train`: what an iteration of training costs at a million Gaussians, 100,000 anchors and 300 views.
//! [`scene`] says how the scene is made. Writes out/bench/train.json.

mod scene;

use clap::Parser;
use feat_train::adam::{Adam, Rates};
use feat_train::fast::{Engine, Shortcuts};
use feat_train::loss::Loss;
use feat_train::model::{Init, Model, Settings};
use feat_train::normalize::Axis;
use feat_train::scene::{Context, MaskSet, Neighbours};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use scene::{Scene, Size, scene};
use serde_json::{Value, json};
use std::path::PathBuf;
use std::time::Instant;

#[derive(Debug, Parser)]
struct Args {
    /// Iterations of a run; the time of 10,000 is extrapolated
    #[arg(long, default_value_t = 100)]
    iterations: usize,
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

/// Iterations of the readable model with the dense optimiser, as training was before it was made fast.
fn reference(context: &Context, sets: &[MaskSet<f32>], iterations: usize) -> Value {
    let mut model = Model::<f32>::new(settings(2), context, &mut ChaCha8Rng::seed_from_u64(0));
    let mut adam = Adam::new(model.features.len());
    let mut layers: Vec<Adam<f32>> = model.layers.iter().map(|l| Adam::new(l.weights.len())).collect();
    let d = model.settings.dim;
    let mut dense = vec![0.0; model.features.len()];
    let mut seconds = [0.0; 3];
    for i in 0..iterations {
        let set = &sets[i * 7 % sets.len()];
        let start = Instant::now();
        let propagated = model.propagate(context);
        seconds[0] += start.elapsed().as_secs_f64();
        let start = Instant::now();
        let step = model.step(context, &propagated, set, i as u64);
        seconds[1] += start.elapsed().as_secs_f64();
        let start = Instant::now();
        dense.fill(0.0);
        for (row, &place) in step.features.chunks_exact(d).zip(&set.columns) {
            dense[place as usize * d..(place as usize + 1) * d].copy_from_slice(row);
        }
        adam.update(&mut model.features, &dense, 1e-3, i as u64 + 1);
        for ((layer, adam), gradient) in model.layers.iter_mut().zip(&mut layers).zip(&step.layers) {
            adam.update(&mut layer.weights, gradient, 1e-3, i as u64 + 1);
        }
        seconds[2] += start.elapsed().as_secs_f64();
    }
    let each = seconds.map(|s| s / iterations as f64);
    json!({ "seconds": each.iter().sum::<f64>(), "propagate": each[0], "step": each[1], "adam": each[2] })
}

/// Iterations of the engine, from a fresh model.
fn fast(context: &Context, sets: &[MaskSet<f32>], layers: usize, shortcuts: Shortcuts, iterations: usize) -> Value {
    let mut model = Model::<f32>::new(settings(layers), context, &mut ChaCha8Rng::seed_from_u64(0));
    let mut engine = Engine::new(context, &model, shortcuts);
    let mut adam = Adam::new(model.features.len());
    let mut weights: Vec<Adam<f32>> = model.layers.iter().map(|l| Adam::new(l.weights.len())).collect();
    let start = Instant::now();
    for i in 0..iterations as u64 {
        let set = &sets[i as usize * 7 % sets.len()];
        engine.propagate(&model, i);
        let evaluated = engine.evaluate(&model, set, i);
        let rates = Rates::at(1e-3, i + 1);
        let gradients = engine.backward(&mut model, &mut adam, set, &evaluated, i, &rates, i);
        for ((layer, adam), gradient) in model.layers.iter_mut().zip(&mut weights).zip(&gradients) {
            adam.update(&mut layer.weights, gradient, 1e-3, i + 1);
        }
    }
    let each = |d: std::time::Duration| d.as_secs_f64() / iterations as f64;
    let t = engine.timings;
    json!({
        "seconds": each(start.elapsed()),
        "propagate": each(t.propagate), "centroids": each(t.centroids), "loss": each(t.loss),
        "features": each(t.features), "backward": each(t.backward),
    })
}

fn main() {
    let args = Args::parse();
    rayon::ThreadPoolBuilder::new().num_threads(args.threads).build_global().expect("the first pool");
    let s: Scene = scene(Size { side: args.side, views: args.views });
    let context = s.context(Neighbours::Gaussians, false);
    let sets = s.views(&context);
    let entries: usize = sets.iter().map(|s| s.mask.len()).sum();
    let columns: usize = sets.iter().map(|s| s.columns.len()).sum();
    eprintln!("{} Gaussians, {columns} columns, {entries} entries", context.order.len());
    let found = if std::env::var("FAST").is_ok() { json!(0) } else { reference(&context, &sets, args.iterations) };
    let context = s.context(Neighbours::Gaussians, true);
    let sets = s.views(&context);
    let quick = fast(&context, &sets, 2, Shortcuts::default(), args.iterations);
    let report = json!({
        "fast": quick,
        "gaussians": context.order.len(), "anchors": context.anchors.len(), "views": sets.len(),
        "reference": found, "peak_rss_bytes": stage::peak_rss_bytes(),
    });
    eprintln!("{report:#}");
    let text = serde_json::to_string_pretty(&report).expect("a report is JSON") + "\n";
    std::fs::create_dir_all(args.out.parent().expect("a file in a folder")).expect("the folder can be made");
    std::fs::write(&args.out, text).expect("the report can be written");
}
