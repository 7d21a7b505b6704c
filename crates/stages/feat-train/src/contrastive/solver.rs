//! What computes an iteration: the engine, or the readable model where the engine does not serve the options.

use super::adam::Rates;
use super::context::Context;
use super::cross_view;
use super::engine::Engine;
use super::loss::Evaluated;
use super::masks::MaskSet;
use super::model::{Model, Propagated, Step};
use super::state::State;
use crate::options::Contrastive;
use std::rc::Rc;

/// One of the two, and what it found of the iteration under way.
pub enum Solver<'a> {
    Fast(Box<Engine<'a>>, Evaluated),
    /// The readable model; `dense` has room for gradients of all features.
    Plain {
        context: &'a Context,
        propagated: Propagated<f32>,
        step: Step<f32>,
        /// All zeros but for the columns of the view at hand.
        dense: Vec<f32>,
    },
}

impl<'a> Solver<'a> {
    /// The one that serves the options of `model`.
    pub fn new(context: &'a Context, model: &Model<f32>) -> Self {
        if Engine::serves(&model.options) {
            Self::Fast(Box::new(Engine::new(context, model)), Evaluated::default())
        } else {
            let dense = vec![0.0; model.features.len()];
            Self::Plain { context, propagated: Propagated::default(), step: Step::default(), dense }
        }
    }

    /// Loss and separation on the masks of one view.
    pub fn forward(&mut self, model: &Model<f32>, set: &MaskSet, beside: Option<&MaskSet>, noise: u64) -> [f64; 2] {
        let d = model.dim;
        match self {
            Self::Fast(engine, evaluated) => {
                engine.propagate(model);
                let positives = beside.map(|b| cross_view::positives(set, b, &engine.centroids(model, b), d));
                *evaluated = engine.evaluate(model, set, noise, positives.as_deref());
                [evaluated.loss, evaluated.separation]
            }
            Self::Plain { context, propagated, step, .. } => {
                *propagated = model.propagate(context);
                let centroids = |b: &MaskSet| model.centroids(context, propagated, b);
                let positives = beside.map(|b| cross_view::positives(set, b, &centroids(b), d));
                *step = model.step(context, propagated, set, noise, positives.as_deref());
                [step.loss, step.separation]
            }
        }
    }

    /// Mean loss of views, which nothing is learnt from.
    pub fn mean_loss(&mut self, model: &Model<f32>, sets: &[Rc<MaskSet>]) -> f64 {
        let losses: f64 = sets.iter().map(|set| self.forward(model, set, None, 0)[0]).sum();
        losses / sets.len() as f64
    }

    /// Mean cosine of a mask's Gaussians with its centroid.
    pub fn alignment(&self, model: &Model<f32>, set: &MaskSet) -> f64 {
        match self {
            Self::Fast(engine, _) => engine.alignment(model, set),
            Self::Plain { context, propagated, .. } => model.alignment(context, propagated, set),
        }
    }

    /// Updates all parameters by what [`Solver::forward`] found.
    pub fn update(&mut self, state: &mut State, set: &MaskSet, noise: u64, options: &Contrastive) {
        state.iteration += 1;
        let State { model, features, layers, iteration, .. } = state;
        let gradients = match self {
            Self::Fast(engine, evaluated) => {
                let rates = Rates::at(options.lr, *iteration);
                let totals = engine.update_features(model, features, set, evaluated, noise, &rates);
                engine.network_gradients(model, &totals)
            }
            Self::Plain { step, dense, .. } => {
                let d = model.dim;
                for (row, &place) in step.features.chunks_exact(d).zip(&set.columns) {
                    dense[place as usize * d..(place as usize + 1) * d].copy_from_slice(row);
                }
                features.update(&mut model.features, dense, options.lr, *iteration);
                for &place in &set.columns {
                    dense[place as usize * d..(place as usize + 1) * d].fill(0.0);
                }
                std::mem::take(&mut step.layers)
            }
        };
        for ((layer, adam), gradient) in model.layers.iter_mut().zip(layers).zip(&gradients) {
            adam.update(&mut layer.weights, gradient, options.weight_lr, *iteration);
        }
    }

    /// f_final of all Gaussians.
    pub fn final_features(&mut self, model: &Model<f32>) -> Vec<f32> {
        match self {
            Self::Fast(engine, _) => {
                engine.propagate(model);
                engine.final_features(model)
            }
            Self::Plain { context, .. } => model.final_features(context, &model.propagate(context)),
        }
    }

    /// Bytes that the graph network's activations take; with the engine, also their gradients.
    pub fn network_bytes(&self) -> usize {
        match self {
            Self::Fast(engine, _) => engine.network_bytes(),
            Self::Plain { propagated, .. } => propagated.bytes(),
        }
    }
}
