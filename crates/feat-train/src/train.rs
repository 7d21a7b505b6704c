//! The training loop of the paper's stage 2, with checkpoints.

use crate::adam::Adam;
use crate::checkpoint::{self, Checkpoint};
use crate::model::{Model, Settings, splitmix};
use crate::network::Layer;
use crate::scene::{Context, MaskSet};
use gs_io::{Error, Provenance, Result};
use rand::SeedableRng;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use stage::Stage;
use std::path::Path;

/// How to train.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainOptions {
    /// The model.
    pub settings: Settings,
    /// Iterations, one view each.
    pub iterations: u64,
    /// Learning rate of features.
    pub rate: f64,
    /// Learning rate of the graph network.
    pub weight_rate: f64,
    /// Seed.
    pub seed: u64,
    /// Iterations between checkpoints; 0 for none.
    pub checkpoint_every: u64,
    /// Iterations between points of the curve.
    pub curve_every: u64,
}

/// A point of the training curve.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize)]
pub struct CurvePoint {
    /// Iterations done.
    pub iteration: u64,
    /// Mean loss since the point before.
    pub loss: f64,
    /// Mean cosine of a mask's Gaussians with its centroid, in the last view.
    pub alignment: f64,
    /// 1 - mean cosine of the centroids of different masks, mean since the point before.
    pub separation: f64,
}

/// What training gives.
#[derive(Debug, Clone, PartialEq)]
pub struct Trained {
    /// f_final `[n][d]`, in the order of `kept`.
    pub features: Vec<f32>,
    /// The curve.
    pub curve: Vec<CurvePoint>,
    /// Iteration of the checkpoint it continued from.
    pub resumed_at: u64,
}

/// Trains on `sets`, each with at least two masks. `checkpoint`: where checkpoints lie, and what one of this very run
/// says of itself. `on_curve` is called with the whole curve at each checkpoint and at the end.
///
/// # Errors
/// When the loss is not finite, a checkpoint cannot be written, or the stage was interrupted (after a last checkpoint).
pub fn train(
    context: &Context,
    sets: &[MaskSet<f32>],
    options: &TrainOptions,
    checkpoint: Option<(&Path, &Provenance)>,
    stage: &Stage,
    on_curve: impl Fn(&[CurvePoint]) -> Result<()>,
) -> Result<Trained> {
    let mut rng = ChaCha8Rng::seed_from_u64(options.seed);
    let model = Model::<f32>::new(options.settings.clone(), context, &mut rng);
    let mut state = State::new(model);
    if let Some((path, provenance)) = checkpoint {
        state.restore(path, provenance, options.iterations, stage);
    }
    let resumed_at = state.iteration;
    let d = options.settings.dim;
    let mut dense = vec![0.0f32; state.model.features.len()];
    let mut order: Vec<u32> = Vec::new();
    let mut epoch = u64::MAX;
    let mut progress = stage.progress("iterations", options.iterations).resumed_at(resumed_at);
    while state.iteration < options.iterations {
        let now = state.iteration / sets.len() as u64;
        if now != epoch {
            epoch = now;
            order = shuffled(sets.len(), options.seed, epoch);
        }
        let set = &sets[order[(state.iteration % sets.len() as u64) as usize] as usize];
        let propagated = state.model.propagate(context);
        let noise = splitmix(options.seed ^ splitmix(state.iteration));
        let step = state.model.step(context, &propagated, set, noise);
        if !step.loss.is_finite() {
            return Err(Error::new("the loss is not finite")
                .field(format!("iteration {}", state.iteration + 1))
                .found(step.loss)
                .hint("lower --lr, or raise --tau"));
        }
        let alignment_due =
            (state.iteration + 1).is_multiple_of(options.curve_every) || state.iteration + 1 == options.iterations;
        if alignment_due {
            let alignment = state.model.alignment(context, &propagated, set);
            state.window.add(step.loss, step.separation);
            let point = state.window.take(state.iteration + 1, alignment);
            state.curve.push(point);
        } else {
            state.window.add(step.loss, step.separation);
        }
        state.update(set, &step.features, &step.layers, &mut dense, d, options);
        let due = options.checkpoint_every > 0 && state.iteration.is_multiple_of(options.checkpoint_every);
        let interrupted = stage.interrupted();
        if let Some((path, provenance)) = checkpoint
            && state.iteration < options.iterations
            && (due || interrupted)
        {
            state.save(path, provenance)?;
            on_curve(&state.curve)?;
        }
        if interrupted && state.iteration < options.iterations {
            return Err(Error::new("interrupted"));
        }
        let loss = state.curve.last().map_or(step.loss, |p| p.loss);
        progress.set(state.iteration, &[("loss", loss)]);
    }
    let last = state.curve.last().copied().unwrap_or_default();
    progress.finish(&[("loss", last.loss), ("alignment", last.alignment), ("separation", last.separation)]);
    on_curve(&state.curve)?;
    let propagated = state.model.propagate(context);
    Ok(Trained { features: state.model.final_features(context, &propagated), curve: state.curve, resumed_at })
}

/// The order of views in an epoch: every view once.
fn shuffled(count: usize, seed: u64, epoch: u64) -> Vec<u32> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    // Stream 0 drew the model.
    rng.set_stream(epoch + 1);
    let mut order: Vec<u32> = (0..count as u32).collect();
    order.shuffle(&mut rng);
    order
}

/// Sums since the last point of the curve.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Window {
    loss: f64,
    separation: f64,
    count: f64,
}

impl Window {
    fn add(&mut self, loss: f64, separation: f64) {
        self.loss += loss;
        self.separation += separation;
        self.count += 1.0;
    }

    fn take(&mut self, iteration: u64, alignment: f64) -> CurvePoint {
        let w = std::mem::take(self);
        CurvePoint { iteration, loss: w.loss / w.count, alignment, separation: w.separation / w.count }
    }
}

/// Everything that changes while training.
struct State {
    model: Model<f32>,
    features: Adam<f32>,
    layers: Vec<Adam<f32>>,
    iteration: u64,
    window: Window,
    curve: Vec<CurvePoint>,
}

impl State {
    fn new(model: Model<f32>) -> Self {
        Self {
            features: Adam::new(model.features.len()),
            layers: model.layers.iter().map(|l| Adam::new(l.weights.len())).collect(),
            model,
            iteration: 0,
            window: Window::default(),
            curve: Vec::new(),
        }
    }

    fn update(
        &mut self,
        set: &MaskSet<f32>,
        features: &[f32],
        layers: &[Vec<f32>],
        dense: &mut [f32],
        d: usize,
        options: &TrainOptions,
    ) {
        self.iteration += 1;
        for (row, &place) in features.chunks_exact(d).zip(&set.columns) {
            dense[place as usize * d..(place as usize + 1) * d].copy_from_slice(row);
        }
        self.features.update(&mut self.model.features, dense, options.rate, self.iteration);
        for &place in &set.columns {
            dense[place as usize * d..(place as usize + 1) * d].fill(0.0);
        }
        for ((layer, adam), gradient) in self.model.layers.iter_mut().zip(&mut self.layers).zip(layers) {
            adam.update(&mut layer.weights, gradient, options.weight_rate, self.iteration);
        }
    }

    fn save(&self, path: &Path, provenance: &Provenance) -> Result<()> {
        let flat = |of: &dyn Fn(usize) -> Vec<f32>| (0..self.layers.len()).flat_map(of).collect::<Vec<f32>>();
        checkpoint::write(
            path,
            provenance,
            &Checkpoint {
                iteration: self.iteration,
                window: [self.window.loss, self.window.separation, self.window.count],
                curve: self.curve.clone(),
                parameters: [
                    &self.model.features[..],
                    &flat(&|l| self.model.layers[l].weights.clone()),
                    &self.features.mean,
                    &self.features.square,
                    &flat(&|l| self.layers[l].mean.clone()),
                    &flat(&|l| self.layers[l].square.clone()),
                ]
                .map(<[f32]>::to_vec),
            },
        )
    }

    /// Continues from the checkpoint at `path` if it is of this very run and not past its end.
    fn restore(&mut self, path: &Path, provenance: &Provenance, iterations: u64, stage: &Stage) {
        if !path.exists() {
            return;
        }
        let weights: usize = self.model.layers.iter().map(|l: &Layer<f32>| l.weights.len()).sum();
        let n = self.model.features.len();
        match checkpoint::read(path, provenance, [n, weights, n, n, weights, weights]) {
            Ok(c) if c.iteration <= iterations => {
                let [features, layers, mean, square, layer_mean, layer_square] = c.parameters;
                self.model.features = features;
                (self.features.mean, self.features.square) = (mean, square);
                let mut at = 0;
                for (layer, adam) in self.model.layers.iter_mut().zip(&mut self.layers) {
                    let range = at..at + layer.weights.len();
                    at = range.end;
                    layer.weights.copy_from_slice(&layers[range.clone()]);
                    adam.mean.copy_from_slice(&layer_mean[range.clone()]);
                    adam.square.copy_from_slice(&layer_square[range]);
                }
                self.window = Window { loss: c.window[0], separation: c.window[1], count: c.window[2] };
                self.curve = c.curve;
                self.iteration = c.iteration;
                stage.info(&format!("continuing from iteration {}", self.iteration));
            }
            Ok(c) => stage.info(&format!("the checkpoint is past the end (iteration {}): starting anew", c.iteration)),
            Err(e) => stage.info(&format!("the checkpoint is not of this run, starting anew ({e})")),
        }
    }
}
