//! An iteration of training: what the model says of one view, and the step that follows from it.

use super::context::Context;
use super::masks::MaskSet;
use super::model::{Model, Propagated, Step};
use super::state::State;
use crate::options::Contrastive;

/// Learning rate of the graph network.
const WEIGHT_RATE: f64 = 1e-3;

/// What the iteration under way found.
pub struct Solver<'a> {
    context: &'a Context,
    propagated: Propagated<f32>,
    step: Step<f32>,
    /// Room for gradients of all features: all zeros but for the columns of the view at hand.
    dense: Vec<f32>,
}

impl<'a> Solver<'a> {
    pub fn new(context: &'a Context, model: &Model<f32>) -> Self {
        let dense = vec![0.0; model.features.len()];
        Self { context, propagated: Propagated::default(), step: Step::default(), dense }
    }

    /// Loss and separation on the masks of one view. `noise` chooses pixels where not all take part.
    pub fn forward(&mut self, model: &Model<f32>, set: &MaskSet, noise: u64) -> [f64; 2] {
        self.propagated = model.propagate(self.context);
        self.step = model.step(self.context, &self.propagated, set, noise);
        [self.step.loss, self.step.separation]
    }

    /// Mean cosine of a mask's Gaussians with its centroid.
    pub fn alignment(&self, model: &Model<f32>, set: &MaskSet) -> f64 {
        model.alignment(self.context, &self.propagated, set)
    }

    /// Updates all parameters by what [`Solver::forward`] found.
    pub fn update(&mut self, state: &mut State, set: &MaskSet, options: &Contrastive) {
        state.iteration += 1;
        let State { model, features, layers, iteration, .. } = state;
        let d = model.dim;
        for (row, &place) in self.step.features.chunks_exact(d).zip(&set.columns) {
            self.dense[place as usize * d..(place as usize + 1) * d].copy_from_slice(row);
        }
        features.update(&mut model.features, &self.dense, options.lr, *iteration);
        for &place in &set.columns {
            self.dense[place as usize * d..(place as usize + 1) * d].fill(0.0);
        }
        for ((layer, adam), gradient) in model.layers.iter_mut().zip(layers).zip(&self.step.layers) {
            adam.update(&mut layer.weights, gradient, WEIGHT_RATE, *iteration);
        }
    }

    /// f_final of all Gaussians.
    pub fn final_features(&self, model: &Model<f32>) -> Vec<f32> {
        model.final_features(self.context, &model.propagate(self.context))
    }

    /// Bytes that the graph network's activations take.
    pub fn network_bytes(&self) -> usize {
        self.propagated.bytes()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::contrastive::testing::{context, mask_set};
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use std::ops::Range;

    fn model(options: &Contrastive, context: &Context) -> Model<f32> {
        Model::new(6, options.clone(), context, &mut ChaCha8Rng::seed_from_u64(5))
    }

    /// The model after `n` iterations on some views in turn.
    fn learnt(context: &Context, sets: &[MaskSet], model: Model<f32>, n: u64) -> Model<f32> {
        let (options, mut state) = (model.options.clone(), State::new(model));
        let mut solver = Solver::new(context, &state.model);
        for i in 0..n {
            let set = &sets[i as usize % sets.len()];
            solver.forward(&state.model, set, i);
            solver.update(&mut state, set, &options);
        }
        state.model
    }

    /// A mask set of given masks over ranges of places.
    fn set_of(context: &Context, masks: &[Range<u32>]) -> MaskSet {
        let entries = masks.iter().enumerate().flat_map(|(k, r)| r.clone().map(move |p| (p, k as u16, 0.01)));
        MaskSet::from_entries((0..masks.len() as u32).collect(), vec![100.0; masks.len()], entries.collect(), context)
    }

    #[test]
    fn threads_do_not_change_a_bit() {
        let context = context(20_000, true);
        let sets = [mask_set(&context, 30, 3), mask_set(&context, 20, 4)];
        assert!(sets[0].pieces.len() > 4);
        let start = model(&Contrastive { layers: 3, ..Contrastive::default() }, &context);
        let with = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let end = learnt(&context, &sets, start.clone(), 5);
                let alignment = end.alignment(&context, &end.propagate(&context), &sets[0]);
                (end, alignment)
            })
        };
        assert!(with(1) == with(3));
    }

    #[test]
    fn constant_features_and_colors_give_zeros_not_noise() {
        let mut context = context(640, true);
        context.colors.fill([0.1, 0.7, 0.3]);
        let mut model = model(&Contrastive::default(), &context);
        model.features.fill(0.1);
        assert!(model.propagate(&context).hat.iter().all(|v| *v == 0.0));
        // Training goes on from there without a number that is none.
        let learnt = learnt(&context, &[mask_set(&context, 9, 3)], model, 50);
        assert!(learnt.features.iter().all(|v| v.is_finite()));
    }

    #[test]
    fn one_mask_or_masks_without_entries_or_direction_move_nothing_wrongly() {
        let context = context(64, true);
        let fresh = |layers| model(&Contrastive { layers, ..Contrastive::default() }, &context);
        let after = |model, masks: &[Range<u32>]| learnt(&context, &[set_of(&context, masks)], model, 5).features;
        let start = fresh(2).features;
        // One mask: nothing to tell apart.
        assert_eq!(after(fresh(2), std::slice::from_ref(&(0..30))), start);
        // A mask without entries takes no part.
        let with = after(fresh(2), &[0..20, 5..5, 30..60]);
        assert_eq!(with, after(fresh(2), &[0..20, 30..60]));
        assert_ne!(with, start);
        // A centroid of zero length has no direction.
        let mut model = fresh(0);
        model.features[..120].fill(0.0);
        let features = after(model, &[0..20, 30..45, 45..60]);
        assert!(features[..120].iter().all(|v| *v == 0.0) && features.iter().all(|v| v.is_finite()));
    }

    #[test]
    fn ten_thousand_iterations_at_a_low_temperature_stay_finite() {
        let context = context(40, true);
        let cold = Contrastive { tau: 1e-3, ..Contrastive::default() };
        let learnt = learnt(&context, &[mask_set(&context, 4, 3)], model(&cold, &context), 10_000);
        assert!(learnt.layers.iter().flat_map(|l| &l.weights).all(|w| w.is_finite()));
        assert!(learnt.features.iter().all(|v| v.abs() < 100.0), "features drift");
    }
}
