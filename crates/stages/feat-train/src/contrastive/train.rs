//! The training loop of the paper's stage 2, with checkpoints.

use super::checkpoint;
use super::context::Context;
use super::masks::MaskSets;
use super::model::Model;
use super::solver::Solver;
use super::state::{CurvePoint, State};
use crate::inputs::Inputs;
use crate::options::Args;
use crate::outputs::{Made, write_curve};
use gs_io::{Error, Result, mixed};
use ndarray::Array2;
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use report::curve::Panel;
use serde_json::json;
use stage::Stage;

/// Iterations between points of the curve: a point costs about an iteration, for the alignment of a view.
const CURVE_EVERY: u64 = 50;
/// Iterations between checkpoints: about 20 seconds at a million Gaussians, whose state takes less than one to write.
const CHECKPOINT_EVERY: u64 = 1000;

/// Panels of the curve.
const PANELS: [Panel; 4] = [
    ("loss", "loss", "#1f77b4"),
    ("alignment", "alignment: mean cosine of a mask's Gaussians with its centroid", "#2ca02c"),
    ("separation", "separation: 1 - mean cosine of different masks", "#d62728"),
    ("rate", "learning rate of features", "#7f7f7f"),
];

/// Trains on `sets`, with checkpoints beside the output, and writes the curve at each of them and at the end.
pub fn train(args: &Args, inputs: &Inputs, context: &Context, mut sets: MaskSets<'_>, stage: &Stage) -> Result<Made> {
    let (options, seed, dim) = (&args.options.method(), args.common.seed, args.options.trained_dim());
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut state = State::new(Model::new(dim, options.clone(), context, &mut rng));
    // A checkpoint serves runs of any number of iterations, as long as everything else is equal.
    let mut parameters = args.options.parameters(seed);
    parameters["contrastive"]["iterations"].take();
    let provenance = stage.provenance("", 0, parameters, inputs.hashes.clone());
    let path = checkpoint::path(&args.out);
    checkpoint::resume(&mut state, &path, &provenance, options.iterations, stage);
    let draw = |curve: &[CurvePoint]| write_curve(&args.out, curve.iter().map(|p| json!(p)), &PANELS);
    let resumed_at = state.iteration;
    let mut solver = Solver::new(context, &state.model);
    let mut order = Views { count: sets.len() as u64, seed, epoch: u64::MAX, order: Vec::new() };
    let mut progress = stage.progress("iterations", options.iterations).resumed_at(resumed_at);
    while state.iteration < options.iterations {
        let set = &*sets.get(order.at(state.iteration))?;
        let noise = mixed(seed ^ mixed(state.iteration));
        let [loss, separation] = solver.forward(&state.model, set, noise);
        if !loss.is_finite() {
            return Err(Error::new("the loss is not finite")
                .field(format!("iteration {}", state.iteration + 1))
                .found(loss)
                .hint("try another --loss or --seed"));
        }
        state.window.add(loss, separation);
        if (state.iteration + 1).is_multiple_of(CURVE_EVERY) || state.iteration + 1 == options.iterations {
            let alignment = solver.alignment(&state.model, set);
            let point = state.window.take(state.iteration + 1, alignment, options.lr);
            state.curve.push(point);
        }
        solver.update(&mut state, set, options);
        let (unfinished, interrupted) = (state.iteration < options.iterations, stage.interrupted());
        if unfinished && (interrupted || state.iteration.is_multiple_of(CHECKPOINT_EVERY)) {
            checkpoint::write(&path, &provenance, &mut state)?;
            draw(&state.curve)?;
        }
        if interrupted && unfinished {
            stage.go_on()?;
        }
        progress.set(state.iteration, &[("loss", state.curve.last().map_or(loss, |p| p.loss))]);
    }
    let last = state.curve.last().copied().unwrap_or_default();
    progress.finish(&[("loss", last.loss), ("alignment", last.alignment), ("separation", last.separation)]);
    draw(&state.curve)?;
    let summary = json!({ "views": sets.len(), "last": last, "resumed_at": resumed_at, "iterations": state.iteration,
        "gaussians": inputs.graph.kept.len(), "network_bytes": solver.network_bytes() });
    let shape = (inputs.graph.kept.len(), dim);
    let values =
        Array2::from_shape_vec(shape, solver.final_features(&state.model)).expect("a feature of each Gaussian");
    Ok(Made { values, summary })
}

/// The order of views: every view once in an epoch.
struct Views {
    count: u64,
    seed: u64,
    epoch: u64,
    order: Vec<u32>,
}

impl Views {
    fn at(&mut self, iteration: u64) -> usize {
        let epoch = iteration / self.count;
        if epoch != self.epoch {
            let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
            // Stream 0 drew the model.
            rng.set_stream(epoch + 1);
            self.epoch = epoch;
            self.order = (0..self.count as u32).collect();
            self.order.shuffle(&mut rng);
        }
        self.order[(iteration % self.count) as usize] as usize
    }
}
