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
/// Of so many mask sets one is held out for `--early-stop`.
const HELD_OUT: usize = 10;
/// Of those held out, at most so many are looked at.
const MOST_HELD_OUT: usize = 16;
/// Iterations between looks at them.
const LOOK_EVERY: u64 = 250;

/// Panels of the curve.
const PANELS: [Panel; 4] = [
    ("loss", "loss", "#1f77b4"),
    ("alignment", "alignment: mean cosine of a mask's Gaussians with its centroid", "#2ca02c"),
    ("separation", "separation: 1 - mean cosine of different masks", "#d62728"),
    ("rate", "learning rate of features", "#7f7f7f"),
];

/// Trains on `sets`, with checkpoints beside the output, and writes the curve at each of them and at the end.
pub fn train(args: &Args, inputs: &Inputs, context: &Context, mut sets: MaskSets<'_>, stage: &Stage) -> Result<Made> {
    let (options, seed, dim) = (&args.options.contrastive, args.common.seed, args.options.trained_dim());
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
    let (held_out, seen) = hold_out(sets.len(), options.early_stop, stage);
    let held_out = held_out.into_iter().map(|i| sets.get(i)).collect::<Result<Vec<_>>>()?;
    let mut order = Views { count: seen.len() as u64, seed, epoch: u64::MAX, order: Vec::new() };
    let mut progress = stage.progress("iterations", options.iterations).resumed_at(resumed_at);
    while state.iteration < options.iterations {
        let set = &*sets.get(seen[order.at(state.iteration)])?;
        let noise = mixed(seed ^ mixed(state.iteration));
        let [loss, separation] = solver.forward(&state.model, set, noise);
        if !loss.is_finite() {
            return Err(Error::new("the loss is not finite")
                .field(format!("iteration {}", state.iteration + 1))
                .found(loss)
                .hint("lower --lr, or raise --tau"));
        }
        state.window.add(loss, separation);
        if (state.iteration + 1).is_multiple_of(CURVE_EVERY) || state.iteration + 1 == options.iterations {
            let alignment = solver.alignment(&state.model, set);
            let point = state.window.take(state.iteration + 1, alignment, options.lr);
            state.curve.push(point);
        }
        solver.update(&mut state, set, options);
        let settled = state.iteration.is_multiple_of(LOOK_EVERY)
            && !held_out.is_empty()
            && state.settled.look(solver.mean_loss(&state.model, &held_out));
        let (unfinished, interrupted) = (state.iteration < options.iterations, stage.interrupted());
        if unfinished && (interrupted || state.iteration.is_multiple_of(CHECKPOINT_EVERY)) {
            checkpoint::write(&path, &provenance, &mut state)?;
            draw(&state.curve)?;
        }
        if interrupted && unfinished {
            stage.go_on()?;
        }
        progress.set(state.iteration, &[("loss", state.curve.last().map_or(loss, |p| p.loss))]);
        if settled {
            stage.info(&format!(
                "stopped after {} of {} iterations: the loss of the held-out views no longer falls below {:.4}",
                state.iteration, options.iterations, state.settled.lowest
            ));
            break;
        }
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

/// The sets that are held out and those that are learnt from, of `count`.
fn hold_out(count: usize, early_stop: bool, stage: &Stage) -> (Vec<usize>, Vec<usize>) {
    let (mut held_out, seen): (Vec<_>, Vec<_>) = (0..count).partition(|i| early_stop && i % HELD_OUT == HELD_OUT - 1);
    if early_stop && held_out.is_empty() {
        stage.warn(&format!("--early-stop needs {HELD_OUT} views with masks: training to the end"));
    }
    held_out.truncate(MOST_HELD_OUT);
    (held_out, seen)
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
