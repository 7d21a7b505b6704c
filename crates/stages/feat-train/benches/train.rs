//! `make bench-train`: what an iteration of training costs at a million Gaussians, 100,000 anchors and 300 views, and what
//! the closed form costs there. [`scene`] says how the scene is made. Writes out/bench/train.json; docs/training.md has the
//! figures.

mod scene;

use feat_train::contrastive::adam::{Adam, Rates};
use feat_train::contrastive::context::Context;
use feat_train::contrastive::engine::Engine;
use feat_train::contrastive::loss;
use feat_train::contrastive::masks::MaskSet;
use feat_train::contrastive::model::Model;
use feat_train::contrastive::train::{Trained, Training, train};
use feat_train::options::{Contrastive, Loss};
use glam::DVec3;
use gs_raster::{RasterOptions, TILE, render_features, tile_weights};
use gs_scene::{Camera, Gaussians};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use scene::{Scene, scene};
use serde_json::{Value, json};
use std::path::Path;
use std::time::Instant;

/// Gaussians along a side of the surface.
const SIDE: usize = 1000;
/// Views.
const VIEWS: usize = 300;
/// Iterations of a run; the time of a training is extrapolated.
const ITERATIONS: u64 = 100;
/// Runs, of which the median is reported.
const RUNS: usize = 5;
/// Dimension of the features.
const DIM: usize = 6;

/// What a run of the engine gave, per iteration.
struct Run {
    seconds: f64,
    /// Of all threads together.
    cpu_seconds: f64,
    network_bytes: usize,
}

fn layered(layers: usize) -> Contrastive {
    Contrastive { layers, ..Contrastive::default() }
}

/// Processor time of this process; 0 where the system does not say.
fn cpu_seconds() -> f64 {
    stage::cpu_seconds().unwrap_or(0.0)
}

/// Iterations of the engine, from a fresh model, on the views in an order that jumps about.
fn run(context: &Context, sets: &[MaskSet], layers: usize, iterations: u64) -> Run {
    let mut model = Model::<f32>::new(DIM, layered(layers), context, &mut ChaCha8Rng::seed_from_u64(0));
    let mut engine = Engine::new(context, &model);
    let mut adam = Adam::new(model.features.len());
    let mut weights: Vec<Adam<f32>> = model.layers.iter().map(|l| Adam::new(l.weights.len())).collect();
    let (start, cpu) = (Instant::now(), cpu_seconds());
    for i in 0..iterations {
        let set = &sets[i as usize * 7 % sets.len()];
        engine.propagate(&model);
        let evaluated = engine.evaluate(&model, set, i, None);
        let gradients = engine.backward(&mut model, &mut adam, set, &evaluated, i, &Rates::at(1e-3, i + 1));
        for ((layer, adam), gradient) in model.layers.iter_mut().zip(&mut weights).zip(&gradients) {
            adam.update(&mut layer.weights, gradient, 1e-3, i + 1);
        }
    }
    let n = iterations as f64;
    Run {
        seconds: start.elapsed().as_secs_f64() / n,
        cpu_seconds: (cpu_seconds() - cpu) / n,
        network_bytes: engine.network_bytes(),
    }
}

/// Least, median and most.
fn spread(mut values: Vec<f64>) -> [f64; 3] {
    values.sort_by(f64::total_cmp);
    [values[0], values[values.len() / 2], values[values.len() - 1]]
}

/// Mean loss of views by features `[n][d]` in the order of kept Gaussians: those of a model without layers.
fn mean_loss(context: &Context, sets: &[MaskSet], features: &[f32]) -> f64 {
    let mut model = Model::<f32>::new(DIM, layered(0), context, &mut ChaCha8Rng::seed_from_u64(0));
    let of = |&i: &u32| &features[i as usize * DIM..(i as usize + 1) * DIM];
    model.features = context.order.iter().flat_map(of).copied().collect();
    let propagated = model.propagate(context);
    let of = |set: &MaskSet| {
        let centroids = model.centroids(context, &propagated, set);
        loss::evaluate(Loss::Printed, &centroids, None, DIM, model.options.tau).loss
    };
    sets.iter().map(of).sum::<f64>() / sets.len() as f64
}

/// Whole trainings on a small scene, to the end and with `--early-stop`: what stopping saves, and what it costs in the
/// loss of the views that neither learns from.
fn early_stop() -> Value {
    let (side, views) = (100, 60);
    let s = scene(side);
    let context = s.context();
    let sets = s.views(&context, views);
    let every_tenth = |held: bool| sets.iter().enumerate().filter(move |(i, _)| (i % 10 == 9) == held);
    let of = |held: bool| every_tenth(held).map(|(_, set)| set.clone()).collect::<Vec<_>>();
    let (held_out, seen) = (of(true), of(false));
    let row = |sets: &[MaskSet], early_stop: bool| {
        let training = Training { dim: DIM, options: Contrastive { early_stop, ..Contrastive::default() }, seed: 0 };
        let (cpu, silent) = (cpu_seconds(), stage::Stage::silent("bench"));
        let trained: Trained =
            train(&context, sets, &training, None, &silent, |_| Ok(())).expect("training needs no file");
        json!({
            "iterations": trained.iterations, "cpu_seconds": cpu_seconds() - cpu,
            "held_out_loss": mean_loss(&context, &held_out, &trained.features),
        })
    };
    json!({
        "gaussians": side * side, "views": views, "held_out": held_out.len(),
        "to_the_end": row(&seen, false), "early_stop": row(&sets, true),
    })
}

/// An iteration on footprints beside one that renders: features are rasterised, averaged over the pixels of masks, and
/// the gradient goes back from the pixels to the Gaussians. 102,400 Gaussians, one view of 1000 x 750 from straight above,
/// and a grid of 80 masks.
fn against_rendering() -> Value {
    let (side, width, height, across, down) = (320, 1000, 750, 10, 8);
    let s = scene(side);
    let (context, n) = (s.context(), s.positions.len());
    let gaussians = Gaussians {
        means: s.positions.clone(),
        log_scales: vec![[-0.4, -0.5, -0.6]; n],
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; n],
        opacity_logits: vec![2.0; n],
        sh: vec![0.0; 3 * n],
        sh_degree: 0,
    };
    let target = DVec3::new(side as f64 / 2.0, side as f64 / 2.0, 0.0);
    let eye = target - DVec3::new(0.0, 0.0, side as f64);
    let camera = Camera::look_at(eye, target, DVec3::Y, width as u32, height as u32, 0.9);
    let options = RasterOptions::default();
    let mask_at = |pixel: usize| pixel / width * down / height * across + pixel % width * across / width;
    let mask_of: Vec<usize> = (0..width * height).map(mask_at).collect();
    let features = vec![0.5f32; n * DIM];
    let rendering = || {
        let image = render_features(&gaussians, &features, DIM, &camera, &options);
        let mut means = vec![0.0f32; across * down * DIM];
        for (pixel, f) in image.chunks_exact(DIM).enumerate() {
            let mean = &mut means[mask_of[pixel] * DIM..][..DIM];
            mean.iter_mut().zip(f).for_each(|(m, f)| *m += f);
        }
        // The adjoint: as if the gradient of a mask were its mean.
        let tiles = tile_weights(&gaussians, &camera, &options, true, |t| {
            let mut sums = vec![0.0f32; t.gaussians.len() * DIM];
            for (sum, w) in sums.chunks_exact_mut(DIM).zip(t.weights.chunks_exact(TILE * TILE)) {
                let inside = |at: usize| at % TILE < t.width && at / TILE < t.height;
                for (at, w) in w.iter().enumerate().filter(|&(at, w)| *w > 0.0 && inside(at)) {
                    let mean = &means[mask_of[(t.y0 + at / TILE) * width + t.x0 + at % TILE] * DIM..];
                    sum.iter_mut().zip(mean).for_each(|(s, g)| *s += w * g);
                }
            }
            sums
        });
        assert!(!tiles.is_empty());
    };
    let clock = |f: &dyn Fn()| {
        let start = Instant::now();
        f();
        start.elapsed().as_secs_f64()
    };
    let cell = |v: f32, cells: usize| ((v.max(0.0) as usize).min(side - 1)) * cells / side;
    let entry = |(place, &i): (usize, &u32)| {
        let [x, y, _] = s.positions[i as usize];
        (place as u32, (cell(y, down) * across + cell(x, across)) as u16, 1e-3)
    };
    let entries = context.order.iter().enumerate().map(entry).collect();
    let masks = across * down;
    let set = MaskSet::from_entries((0..masks as u32).collect(), vec![9375.0; masks], entries, &context);
    let engine = spread((0..RUNS).map(|_| run(&context, std::slice::from_ref(&set), 2, 10).seconds).collect())[1];
    let rendering = spread((0..RUNS).map(|_| clock(&rendering)).collect())[1];
    json!({ "gaussians": n, "rendering_seconds": rendering, "engine_seconds": engine, "ratio": rendering / engine })
}

/// The program itself, with the closed form.
fn closed_form(s: &Scene, folder: &Path) -> Value {
    let mut record = s.run(VIEWS, &[], folder);
    record.summary["singular_values"].take();
    json!({
        "seconds": record.wall_seconds, "cpu_seconds": record.cpu_seconds, "peak_rss_bytes": record.peak_rss_bytes,
        "summary": record.summary,
    })
}

fn main() {
    let out = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../out/bench/train.json");
    let folder = out.parent().expect("a file in a folder");
    std::fs::create_dir_all(folder).expect("the folder can be made");
    let s = scene(SIDE);
    let closed_form = closed_form(&s, folder);
    let context = s.context();
    let sets = s.views(&context, VIEWS);
    let first = run(&context, &sets, 2, ITERATIONS);
    let peak = stage::peak_rss_bytes();
    let mut runs = vec![first];
    runs.extend((1..RUNS).map(|_| run(&context, &sets, 2, ITERATIONS)));
    let by_layers = |layers: usize| {
        let run = run(&context, &sets, layers, ITERATIONS / 4);
        json!({
            "layers": layers, "network_bytes": run.network_bytes, "seconds_per_iteration": run.seconds,
            "cpu_seconds_per_iteration": run.cpu_seconds,
        })
    };
    let seconds = spread(runs.iter().map(|r| r.seconds).collect());
    let report = json!({
        "gaussians": context.order.len(), "anchors": context.anchors.len(), "views": sets.len(), "dim": DIM, "layers": 2,
        "columns": sets.iter().map(|s| s.columns.len()).sum::<usize>(),
        "entries": sets.iter().map(|s| s.mask.len()).sum::<usize>(), "threads": rayon::current_num_threads(),
        "seconds_per_iteration": seconds[1], "least_and_most": [seconds[0], seconds[2]],
        "cpu_seconds_per_iteration": spread(runs.iter().map(|r| r.cpu_seconds).collect())[1],
        "seconds_of_10000_iterations": 1e4 * seconds[1], "peak_rss_bytes": peak,
        "by_layers": (0..=4).map(by_layers).collect::<Value>(),
        "early_stop": early_stop(), "rendering": against_rendering(), "closed_form": closed_form,
    });
    let text = serde_json::to_string_pretty(&report).expect("a report is JSON") + "\n";
    eprint!("{text}");
    std::fs::write(&out, text).expect("the report can be written");
}
