//! The training loop of the paper's stage 2, with checkpoints.

use crate::adam::{Adam, Rates};
use crate::checkpoint::{self, Checkpoint};
use crate::cross_view;
use crate::fast::{Engine, Shortcuts};
use crate::loss::{Evaluated, Loss};
use crate::model::{Model, Propagated, Settings, Step, splitmix};
use crate::network::Layer;
use crate::real::Weight;
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
    /// What to do less often than the method asks for.
    pub shortcuts: Shortcuts,
    /// Hold out every tenth view and stop when their loss has settled.
    pub early_stop: bool,
}

/// Of so many mask sets one is held out for [`TrainOptions::early_stop`].
const HELD_OUT: usize = 10;
/// Of those held out, at most so many are looked at.
const MOST_HELD_OUT: usize = 16;
/// Iterations between looks at them.
const LOOK_EVERY: u64 = 250;
/// Training ends after so many looks without a better loss ...
const PATIENCE: f64 = 4.0;
/// ... better meaning lower by this, in nats.
const BETTER: f64 = 1e-3;

/// Lowest loss of the held-out views, and how many looks ago it was.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Settled {
    lowest: f64,
    looks: f64,
}

impl Settled {
    /// Whether the loss has settled, given that of a look.
    fn look(&mut self, loss: f64) -> bool {
        if loss < self.lowest - BETTER {
            *self = Self { lowest: loss, looks: 0.0 };
        } else {
            self.looks += 1.0;
        }
        self.looks >= PATIENCE
    }
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
    /// Learning rate of features.
    pub rate: f64,
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
    /// Iterations done: fewer than asked for when it stopped early.
    pub iterations: u64,
    /// Bytes that the graph network took; none where the readable model trained, which keeps no account.
    pub network_bytes: Option<usize>,
}

/// Trains on `sets`, each with at least two masks. `checkpoint`: where checkpoints lie, and what one of this very run
/// says of itself. `on_curve` is called with the whole curve at each checkpoint and at the end.
///
/// # Errors
/// When the loss is not finite, a checkpoint cannot be written, or the stage was interrupted (after a last checkpoint).
pub fn train<W: Weight>(
    context: &Context,
    sets: &[MaskSet<W>],
    options: &TrainOptions,
    checkpoint: Option<(&Path, &Provenance)>,
    stage: &Stage,
    on_curve: impl Fn(&[CurvePoint]) -> Result<()>,
) -> Result<Trained> {
    let mut rng = ChaCha8Rng::seed_from_u64(options.seed);
    let model = Model::<f32>::new(options.settings.clone(), context, &mut rng);
    let mut state = State::new(model);
    let mut statistics = Vec::new();
    if let Some((path, provenance)) = checkpoint {
        statistics = state.restore(path, provenance, options.iterations, stage);
    }
    let mut way = Way::new(context, &state.model, options);
    way.restore(&statistics);
    let resumed_at = state.iteration;
    let (held_out, seen): (Vec<_>, Vec<_>) =
        sets.iter().enumerate().partition(|(i, _)| options.early_stop && i % HELD_OUT == HELD_OUT - 1);
    let held_out: Vec<&MaskSet<W>> = held_out.into_iter().map(|(_, set)| set).take(MOST_HELD_OUT).collect();
    let sets: Vec<&MaskSet<W>> = seen.into_iter().map(|(_, set)| set).collect();
    if options.early_stop && held_out.is_empty() {
        stage.warn(&format!("--early-stop needs {HELD_OUT} views with masks: training to the end"));
    }
    let mut order: Vec<u32> = Vec::new();
    let mut epoch = u64::MAX;
    let mut progress = stage.progress("iterations", options.iterations).resumed_at(resumed_at);
    while state.iteration < options.iterations {
        let now = state.iteration / sets.len() as u64;
        if now != epoch {
            epoch = now;
            order = shuffled(sets.len(), options.seed, epoch);
        }
        let set = sets[order[(state.iteration % sets.len() as u64) as usize] as usize];
        let noise = splitmix(options.seed ^ splitmix(state.iteration));
        let beside = beside(&sets, set, noise, &options.settings);
        let [loss, separation] = way.forward(&state.model, set, beside, noise, state.iteration);
        if !loss.is_finite() {
            return Err(Error::new("the loss is not finite")
                .field(format!("iteration {}", state.iteration + 1))
                .found(loss)
                .hint("lower --lr, or raise --tau"));
        }
        state.window.add(loss, separation);
        if (state.iteration + 1).is_multiple_of(options.curve_every) || state.iteration + 1 == options.iterations {
            let alignment = way.alignment(&state.model, set);
            let point = state.window.take(state.iteration + 1, alignment, options.rate);
            state.curve.push(point);
        }
        way.update(&mut state, set, noise, options);
        let settled = state.iteration.is_multiple_of(LOOK_EVERY)
            && !held_out.is_empty()
            && state.settled.look(way.mean_loss(&state.model, &held_out, state.iteration));
        let due = options.checkpoint_every > 0 && state.iteration.is_multiple_of(options.checkpoint_every);
        let interrupted = stage.interrupted();
        if let Some((path, provenance)) = checkpoint
            && state.iteration < options.iterations
            && (due || interrupted)
        {
            state.save(path, provenance, way.statistics())?;
            on_curve(&state.curve)?;
        }
        if interrupted && state.iteration < options.iterations {
            return Err(Error::new("interrupted"));
        }
        let loss = state.curve.last().map_or(loss, |p| p.loss);
        progress.set(state.iteration, &[("loss", loss)]);
        if settled {
            stage.info(&format!(
                "stopped after {} of {} iterations: the loss of held-out views has settled at {:.4}",
                state.iteration, options.iterations, state.settled.lowest
            ));
            break;
        }
    }
    let last = state.curve.last().copied().unwrap_or_default();
    progress.finish(&[("loss", last.loss), ("alignment", last.alignment), ("separation", last.separation)]);
    on_curve(&state.curve)?;
    let features = way.final_features(&state.model, state.iteration);
    let network_bytes = match &way {
        Way::Fast(engine, _) => Some(engine.network_bytes()),
        Way::Plain { .. } => None,
    };
    Ok(Trained { features, curve: state.curve, resumed_at, iterations: state.iteration, network_bytes })
}

/// Another view to take positives from, for the loss that asks for them.
fn beside<'a, W: Weight>(
    sets: &[&'a MaskSet<W>],
    set: &MaskSet<W>,
    noise: u64,
    settings: &Settings,
) -> Option<&'a MaskSet<W>> {
    let other = sets[(splitmix(noise) % sets.len() as u64) as usize];
    (settings.loss == Loss::CrossView && !std::ptr::eq(other, set)).then_some(other)
}

/// By what an iteration is computed.
enum Way<'a> {
    /// The engine, for the settings that it serves, and what it found of the iteration under way.
    Fast(Box<Engine<'a>>, Evaluated),
    /// The readable model.
    Plain { context: &'a Context, propagated: Propagated<f32>, step: Step<f32>, dense: Vec<f32> },
}

impl<'a> Way<'a> {
    fn new(context: &'a Context, model: &Model<f32>, options: &TrainOptions) -> Self {
        if Engine::serves(&model.settings) {
            Self::Fast(Box::new(Engine::new(context, model, options.shortcuts)), Evaluated::default())
        } else {
            let dense = vec![0.0; model.features.len()];
            Self::Plain { context, propagated: Propagated::default(), step: Step::default(), dense }
        }
    }

    fn statistics(&self) -> Vec<f64> {
        match self {
            Self::Fast(engine, _) => engine.statistics(),
            Self::Plain { .. } => Vec::new(),
        }
    }

    fn restore(&mut self, statistics: &[f64]) {
        if let Self::Fast(engine, _) = self {
            engine.restore(statistics);
        }
    }

    /// Loss and separation.
    fn forward<W: Weight>(
        &mut self,
        model: &Model<f32>,
        set: &MaskSet<W>,
        beside: Option<&MaskSet<W>>,
        noise: u64,
        iteration: u64,
    ) -> [f64; 2] {
        let d = model.settings.dim;
        match self {
            Self::Fast(engine, evaluated) => {
                engine.propagate(model, iteration);
                let positives = beside.map(|b| cross_view::positives(set, b, &engine.centroids(model, b), d));
                *evaluated = engine.evaluate_beside(model, set, noise, positives.as_deref());
                [evaluated.loss, evaluated.separation]
            }
            Self::Plain { context, propagated, step, .. } => {
                *propagated = model.propagate(context);
                let centroids = |b: &MaskSet<W>| model.centroids(context, propagated, b);
                let positives = beside.map(|b| cross_view::positives(set, b, &centroids(b), d));
                *step = model.step_beside(context, propagated, set, noise, positives.as_deref());
                [step.loss, step.separation]
            }
        }
    }

    /// Mean loss of views, which nothing is learnt from.
    fn mean_loss<W: Weight>(&mut self, model: &Model<f32>, sets: &[&MaskSet<W>], iteration: u64) -> f64 {
        let losses: f64 = sets.iter().map(|set| self.forward(model, set, None, 0, iteration)[0]).sum();
        losses / sets.len() as f64
    }

    fn alignment<W: Weight>(&self, model: &Model<f32>, set: &MaskSet<W>) -> f64 {
        match self {
            Self::Fast(engine, _) => engine.alignment(model, set),
            Self::Plain { context, propagated, .. } => model.alignment(context, propagated, set),
        }
    }

    /// Moves all parameters by what [`Way::forward`] found.
    fn update<W: Weight>(&mut self, state: &mut State, set: &MaskSet<W>, noise: u64, options: &TrainOptions) {
        let done = state.iteration;
        state.iteration += 1;
        let State { model, features, layers, iteration, .. } = state;
        let gradients = match self {
            Self::Fast(engine, evaluated) => {
                let rates = Rates::at(options.rate, *iteration);
                engine.backward(model, features, set, evaluated, noise, &rates, done)
            }
            Self::Plain { step, dense, .. } => {
                let d = model.settings.dim;
                for (row, &place) in step.features.chunks_exact(d).zip(&set.columns) {
                    dense[place as usize * d..(place as usize + 1) * d].copy_from_slice(row);
                }
                features.update(&mut model.features, dense, options.rate, *iteration);
                for &place in &set.columns {
                    dense[place as usize * d..(place as usize + 1) * d].fill(0.0);
                }
                std::mem::take(&mut step.layers)
            }
        };
        for ((layer, adam), gradient) in model.layers.iter_mut().zip(layers).zip(&gradients) {
            adam.update(&mut layer.weights, gradient, options.weight_rate, *iteration);
        }
    }

    fn final_features(&mut self, model: &Model<f32>, iteration: u64) -> Vec<f32> {
        match self {
            Self::Fast(engine, _) => {
                engine.propagate(model, iteration);
                engine.final_features(model)
            }
            Self::Plain { context, .. } => model.final_features(context, &model.propagate(context)),
        }
    }
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

    fn take(&mut self, iteration: u64, alignment: f64, rate: f64) -> CurvePoint {
        let w = std::mem::take(self);
        CurvePoint { iteration, loss: w.loss / w.count, alignment, separation: w.separation / w.count, rate }
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
    settled: Settled,
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
            settled: Settled { lowest: f64::MAX, looks: 0.0 },
        }
    }

    fn save(&self, path: &Path, provenance: &Provenance, statistics: Vec<f64>) -> Result<()> {
        let flat = |of: &dyn Fn(usize) -> Vec<f32>| (0..self.layers.len()).flat_map(of).collect::<Vec<f32>>();
        checkpoint::write(
            path,
            provenance,
            &Checkpoint {
                iteration: self.iteration,
                window: [self.window.loss, self.window.separation, self.window.count],
                settled: [self.settled.lowest, self.settled.looks],
                curve: self.curve.clone(),
                statistics,
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

    /// Continues from the checkpoint at `path` if it is of this very run and not past its end; gives its statistics.
    fn restore(&mut self, path: &Path, provenance: &Provenance, iterations: u64, stage: &Stage) -> Vec<f64> {
        if !path.exists() {
            return Vec::new();
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
                self.settled = Settled { lowest: c.settled[0], looks: c.settled[1] };
                self.curve = c.curve;
                self.iteration = c.iteration;
                stage.info(&format!("continuing from iteration {}", self.iteration));
                return c.statistics;
            }
            Ok(c) => stage.info(&format!("the checkpoint is past the end (iteration {}): starting anew", c.iteration)),
            Err(e) => stage.info(&format!("the checkpoint is not of this run, starting anew ({e})")),
        }
        Vec::new()
    }
}
