//! The engine against the readable model.

use super::*;
use crate::contrastive::model::Propagated;
use crate::contrastive::real::Real;
use crate::contrastive::solver::Solver;
use crate::contrastive::state::State;
use crate::contrastive::testing::{context, mask_set};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

fn options(layers: usize, loss: Loss) -> Contrastive {
    Contrastive { layers, loss, ..Contrastive::default() }
}

/// The same model, drawn in f32 or f64.
fn model<T: Real>(d: usize, options: &Contrastive, context: &Context) -> Model<T> {
    Model::new(d, options.clone(), context, &mut ChaCha8Rng::seed_from_u64(5))
}

/// Largest difference as a share of the largest value.
fn difference(found: &[f32], exact: &[f64]) -> f64 {
    assert_eq!(found.len(), exact.len());
    let largest = exact.iter().fold(0.0f64, |a, b| a.max(b.abs()));
    found.iter().zip(exact).map(|(f, e)| (f64::from(*f) - e).abs()).fold(0.0, f64::max) / largest.max(1e-30)
}

fn check(d: usize, options: Contrastive, kind: Neighbours, propagate: bool) {
    let name = format!("{d} {options:?} {kind:?} {propagate}");
    let context = context(4501, kind, propagate);
    let set = mask_set(&context, 23, 3);
    let (mut model, exact) = (model::<f32>(d, &options, &context), model::<f64>(d, &options, &context));
    let propagated = exact.propagate(&context);
    let beside: Vec<f64> = (0..23 * d).map(|i| if i < 40 { (i * i % 7) as f64 - 2.0 } else { 0.0 }).collect();
    let beside = (exact.options.loss == Loss::CrossView).then_some(&beside[..]);
    let step = exact.step(&context, &propagated, &set, 77, beside);

    let mut engine = Engine::new(&context, &model);
    engine.propagate(&model);
    let evaluated = engine.evaluate(&model, &set, 77, beside);
    assert!((evaluated.loss - step.loss).abs() <= 1e-5 * step.loss.abs(), "{name}: {} {}", evaluated.loss, step.loss);
    assert!((evaluated.separation - step.separation).abs() <= 1e-5);
    let alignment = exact.alignment(&context, &propagated, &set);
    assert!((engine.alignment(&model, &set) - alignment).abs() <= 1e-5, "{name}: alignment");
    let finals: Vec<f64> = exact.final_features(&context, &propagated).iter().map(|v| f64::from(*v)).collect();
    assert!(difference(&engine.final_features(&model), &finals) <= 1e-5, "{name}: features");

    let before = model.features.clone();
    let mut adam = Adam::new(before.len());
    let totals = engine.update_features(&mut model, &mut adam, &set, &evaluated, 77, &Rates::at(0.0, 1));
    let layers = engine.network_gradients(&model, &totals);
    assert!(before == model.features);
    // The first mean is a tenth of the gradient.
    adam.mean.iter_mut().for_each(|m| *m *= 10.0);
    let rows: Vec<f32> =
        set.columns.iter().flat_map(|&p| adam.mean[p as usize * d..(p as usize + 1) * d].to_vec()).collect();
    let off = difference(&rows, &step.features);
    assert!(off <= 1e-5, "{name}: gradients of features {off:e}");
    let sum = |v: &[f32]| v.iter().map(|v| f64::from(v.abs())).sum::<f64>();
    assert!((sum(&adam.mean) - sum(&rows)).abs() <= 1e-6 * sum(&rows), "{name}: a gradient without a column");
    assert_eq!(layers.len(), step.layers.len());
    for (found, exact) in layers.iter().zip(&step.layers) {
        let off = difference(found, exact);
        assert!(off <= 1e-5, "{name}: gradients of weights {off:e}");
    }
}

#[test]
fn agrees_with_the_readable_model() {
    use Neighbours::{AnchorInputs, Anchors, Gaussians};
    for layers in 0..=4 {
        for kind in [Gaussians, Anchors, AnchorInputs] {
            check(6, options(layers, Loss::Printed), kind, true);
        }
    }
    for d in [2, 5, 16, 64] {
        check(d, options(2, Loss::WithSelf), Anchors, true);
    }
    check(6, options(2, Loss::HalfMask), Gaussians, true);
    check(6, options(2, Loss::CrossView), Gaussians, true);
    for kind in [Gaussians, Anchors] {
        check(6, Contrastive { last_relu: false, bias: true, ..options(2, Loss::Printed) }, kind, true);
        check(6, options(3, Loss::Printed), kind, false);
    }
}

/// Features that the readable model learns in `n` iterations on some views in turn.
fn by_readable<T: Real>(context: &Context, sets: &[MaskSet], mut model: Model<T>, n: u64) -> Vec<f64> {
    let mut adam = Adam::<T>::new(model.features.len());
    let mut weights: Vec<Adam<T>> = model.layers.iter().map(|l| Adam::new(l.weights.len())).collect();
    let d = model.dim;
    for i in 0..n {
        let set = &sets[i as usize % sets.len()];
        let step = model.step(context, &model.propagate(context), set, i, None);
        let mut dense = vec![T::default(); model.features.len()];
        for (row, &place) in step.features.chunks_exact(d).zip(&set.columns) {
            dense[place as usize * d..(place as usize + 1) * d].copy_from_slice(row);
        }
        adam.update(&mut model.features, &dense, 1e-3, i + 1);
        for ((layer, adam), gradient) in model.layers.iter_mut().zip(&mut weights).zip(&step.layers) {
            adam.update(&mut layer.weights, gradient, 1e-3, i + 1);
        }
    }
    model.features.iter().map(|v| v.get()).collect()
}

/// The model that the engine learns, and the alignment of the first view then.
fn by_engine(context: &Context, sets: &[MaskSet], model: Model<f32>, n: u64) -> (Model<f32>, f64) {
    let (options, mut state) = (model.options.clone(), State::new(model));
    let mut solver = Solver::new(context, &state.model);
    for i in 0..n {
        let set = &sets[i as usize % sets.len()];
        solver.forward(&state.model, set, None, i);
        solver.update(&mut state, set, i, &options);
    }
    let alignment = solver.alignment(&state.model, &sets[0]);
    (state.model, alignment)
}

fn wide(v: &[f32]) -> Vec<f64> {
    v.iter().map(|v| f64::from(*v)).collect()
}

#[test]
fn stays_with_the_readable_model_in_f64_for_1000_iterations() {
    let context = context(400, Neighbours::Gaussians, true);
    let sets = [mask_set(&context, 9, 3), mask_set(&context, 12, 4)];
    let printed = options(2, Loss::Printed);
    let start: Model<f32> = model(6, &printed, &context);
    let oracle = by_readable(&context, &sets, model::<f64>(6, &printed, &context), 1000);
    let readable = by_readable(&context, &sets, start.clone(), 1000);
    let found = wide(&by_engine(&context, &sets, start.clone(), 1000).0.features);
    let apart = |a: &[f64], b: &[f64]| {
        let squares: f64 = a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum();
        (squares / a.len() as f64).sqrt()
    };
    // Adam takes a step of full size for the sign of a gradient, however small: rounding is amplified in any f32.
    let (moved, off) = (apart(&oracle, &wide(&start.features)), apart(&oracle, &found));
    let usual = apart(&oracle, &readable);
    assert!(moved > 0.05, "{moved}");
    assert!(off < 0.03 * moved && off < 4.0 * usual, "{off:e} of {moved:e}; {usual:e}");
}

#[test]
fn threads_do_not_change_a_bit() {
    let context = context(20_000, Neighbours::Anchors, true);
    let sets = [mask_set(&context, 30, 3), mask_set(&context, 20, 4)];
    assert!(sets[0].pieces.len() > 4);
    let start: Model<f32> = model(6, &options(3, Loss::HalfMask), &context);
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let readable = start.step(&context, &start.propagate(&context), &sets[0], 7, None);
            let alignment = start.alignment(&context, &Propagated::default(), &sets[0]);
            (by_engine(&context, &sets, start.clone(), 5), readable, alignment)
        })
    };
    assert!(with(1) == with(3));
}

/// A mask set of given masks over ranges of places.
fn set_of(context: &Context, masks: &[Range<u32>]) -> MaskSet {
    let entries = masks.iter().enumerate().flat_map(|(k, r)| r.clone().map(move |p| (p, k as u16, 0.01)));
    MaskSet::from_entries((0..masks.len() as u32).collect(), vec![100.0; masks.len()], entries.collect(), context)
}

#[test]
fn constant_features_and_colors_give_zeros_not_noise() {
    let mut context = context(640, Neighbours::Gaussians, true);
    context.colors.fill([0.1, 0.7, 0.3]);
    let mut model: Model<f32> = model(6, &options(2, Loss::Printed), &context);
    model.features.fill(0.1);
    assert!(model.propagate(&context).hat.iter().all(|v| *v == 0.0));
    let mut engine = Engine::new(&context, &model);
    engine.propagate(&model);
    assert!(engine.inputs[0].as_flattened().iter().all(|v| *v == 0.0));
    assert!(engine.around[0].as_flattened().iter().all(|v| *v == 0.0));
    assert!(engine.hat.iter().all(|v| *v == 0.0));
    // Training goes on from there without a number that is none.
    let (learnt, _) = by_engine(&context, &[mask_set(&context, 9, 3)], model, 50);
    assert!(learnt.features.iter().all(|v| v.is_finite()));
}

#[test]
fn one_mask_or_masks_without_entries_or_direction_move_nothing_wrongly() {
    let context = context(64, Neighbours::Gaussians, true);
    let fresh = |layers| -> Model<f32> { model(6, &options(layers, Loss::Printed), &context) };
    let learnt = |model, masks: &[Range<u32>]| by_engine(&context, &[set_of(&context, masks)], model, 5).0.features;
    let start = fresh(2).features;
    // One mask: nothing to tell apart.
    assert_eq!(learnt(fresh(2), std::slice::from_ref(&(0..30))), start);
    // A mask without entries takes no part.
    let with = learnt(fresh(2), &[0..20, 5..5, 30..60]);
    assert_eq!(with, learnt(fresh(2), &[0..20, 30..60]));
    assert_ne!(with, start);
    // A centroid of zero length has no direction.
    let mut model = fresh(0);
    model.features[..120].fill(0.0);
    let features = learnt(model, &[0..20, 30..45, 45..60]);
    assert!(features[..120].iter().all(|v| *v == 0.0) && features.iter().all(|v| v.is_finite()));
}

#[test]
fn a_hundred_thousand_iterations_at_a_low_temperature_stay_finite() {
    let context = context(40, Neighbours::Gaussians, true);
    let cold = Contrastive { tau: 1e-3, ..options(2, Loss::Printed) };
    let (learnt, _) = by_engine(&context, &[mask_set(&context, 4, 3)], model(6, &cold, &context), 100_000);
    assert!(learnt.layers.iter().flat_map(|l| &l.weights).all(|w| w.is_finite()));
    assert!(learnt.features.iter().all(|v| v.abs() < 100.0), "features drift");
}
