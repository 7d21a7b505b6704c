//! The engine against the readable model.

use super::*;
use crate::contrastive::network::Layer;
use crate::contrastive::real::Real;
use crate::contrastive::testing::{context, mask_set};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

fn options(layers: usize, loss: Loss) -> Contrastive {
    Contrastive { layers, loss, ..Contrastive::default() }
}

/// The same model in f64.
fn widened(model: &Model<f32>) -> Model<f64> {
    let wide = |v: &[f32]| v.iter().map(|&v| f64::from(v)).collect::<Vec<f64>>();
    Model {
        dim: model.dim,
        options: model.options.clone(),
        features: wide(&model.features),
        layers: model
            .layers
            .iter()
            .map(|l| Layer {
                input: l.input,
                neighbour: l.neighbour,
                output: l.output,
                weights: wide(&l.weights),
                relu: l.relu,
            })
            .collect(),
    }
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
    let mut model = Model::<f32>::new(d, options, &context, &mut ChaCha8Rng::seed_from_u64(5));
    let exact = widened(&model);
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
    let layers = engine.backward(&mut model, &mut adam, &set, &evaluated, 77, &Rates::at(0.0, 1));
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
        check(6, Contrastive { no_last_relu: true, ..options(2, Loss::Printed) }, kind, true);
        check(6, options(3, Loss::Printed), kind, false);
    }
}

/// Trains the engine or the readable model for `iterations` on two views in turn.
fn trained<T: Real>(
    model: &mut Model<T>,
    iterations: u64,
    mut step: impl FnMut(&mut Model<T>, u64) -> Vec<Vec<T>>,
) -> Vec<f64> {
    let mut weights: Vec<Adam<T>> = model.layers.iter().map(|l| Adam::new(l.weights.len())).collect();
    for i in 0..iterations {
        let gradients = step(model, i);
        for ((layer, adam), gradient) in model.layers.iter_mut().zip(&mut weights).zip(&gradients) {
            adam.update(&mut layer.weights, gradient, 1e-3, i + 1);
        }
    }
    model.features.iter().map(|v| v.get()).collect()
}

fn by_readable<T: Real>(context: &Context, sets: &[MaskSet], model: &mut Model<T>, n: u64) -> Vec<f64> {
    let mut adam = Adam::<T>::new(model.features.len());
    let d = model.dim;
    trained(model, n, |model, i| {
        let set = &sets[i as usize % sets.len()];
        let propagated = model.propagate(context);
        let step = model.step(context, &propagated, set, i, None);
        let mut dense = vec![T::default(); model.features.len()];
        for (row, &place) in step.features.chunks_exact(d).zip(&set.columns) {
            dense[place as usize * d..(place as usize + 1) * d].copy_from_slice(row);
        }
        adam.update(&mut model.features, &dense, 1e-3, i + 1);
        step.layers
    })
}

fn by_engine(context: &Context, sets: &[MaskSet], model: &mut Model<f32>, n: u64) -> Vec<f64> {
    let mut engine = Engine::new(context, model);
    let mut adam = Adam::new(model.features.len());
    trained(model, n, |model, i| {
        let set = &sets[i as usize % sets.len()];
        engine.propagate(model);
        let evaluated = engine.evaluate(model, set, i, None);
        engine.backward(model, &mut adam, set, &evaluated, i, &Rates::at(1e-3, i + 1))
    })
}

#[test]
fn stays_with_the_readable_model_in_f64_for_1000_iterations() {
    let context = context(400, Neighbours::Gaussians, true);
    let sets = [mask_set(&context, 9, 3), mask_set(&context, 12, 4)];
    let mut model = Model::<f32>::new(6, options(2, Loss::Printed), &context, &mut ChaCha8Rng::seed_from_u64(5));
    let start: Vec<f64> = model.features.iter().map(|v| f64::from(*v)).collect();
    let oracle = by_readable(&context, &sets, &mut widened(&model), 1000);
    let readable = by_readable(&context, &sets, &mut model.clone(), 1000);
    let found = by_engine(&context, &sets, &mut model, 1000);
    let apart = |a: &[f64], b: &[f64]| {
        let squares: f64 = a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum();
        (squares / a.len() as f64).sqrt()
    };
    // Adam takes a step of full size for the sign of a gradient, however small: rounding is amplified in any f32.
    let (moved, off, usual) = (apart(&oracle, &start), apart(&oracle, &found), apart(&oracle, &readable));
    eprintln!(
        "after 1000 iterations features moved by {moved:.1e} (root mean square); off f64 by {off:.1e} (the engine), \
         {usual:.1e} (the readable model in f32)"
    );
    assert!(moved > 0.05, "{moved}");
    assert!(off < 0.03 * moved && off < 4.0 * usual, "{off:e} of {moved:e}; {usual:e}");
}

#[test]
fn threads_do_not_change_a_bit() {
    let context = context(20_000, Neighbours::Anchors, true);
    let sets = [mask_set(&context, 30, 3), mask_set(&context, 20, 4)];
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let mut rng = ChaCha8Rng::seed_from_u64(1);
            let mut model = Model::<f32>::new(6, options(3, Loss::HalfMask), &context, &mut rng);
            let features = by_engine(&context, &sets, &mut model, 5);
            let mut engine = Engine::new(&context, &model);
            engine.propagate(&model);
            let alignment = engine.alignment(&model, &sets[0]);
            (features, model, alignment)
        })
    };
    assert!(with(1) == with(3));
}

/// A mask set of given masks over ranges of places, with one that has no entry at all.
fn set_of(context: &Context, masks: &[Range<u32>]) -> MaskSet {
    let entries =
        masks.iter().enumerate().flat_map(|(k, r)| r.clone().map(move |p| (p, k as u16, 0.01))).collect::<Vec<_>>();
    MaskSet::from_entries((0..masks.len() as u32).collect(), vec![100.0; masks.len()], entries, context)
}

/// Trains for `n` iterations on one thread and says what came of it.
fn run_on(context: &Context, set: &MaskSet, model: &mut Model<f32>, n: u64) -> Vec<f64> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    let sets = [set.clone()];
    pool.install(|| by_engine(context, &sets, model, n))
}

#[test]
fn constant_features_and_colors_give_zeros_not_noise() {
    let mut context = context(640, Neighbours::Gaussians, true);
    context.colors.fill([0.1, 0.7, 0.3]);
    let mut model = Model::<f32>::new(6, options(2, Loss::Printed), &context, &mut ChaCha8Rng::seed_from_u64(1));
    model.features.fill(0.1);
    let mut engine = Engine::new(&context, &model);
    engine.propagate(&model);
    assert!(engine.inputs[0].as_flattened().iter().all(|v| *v == 0.0));
    assert!(engine.around[0].as_flattened().iter().all(|v| *v == 0.0));
    assert!(engine.hat.iter().all(|v| *v == 0.0));
    // Training goes on from there without a number that is none.
    let set = mask_set(&context, 9, 3);
    assert!(run_on(&context, &set, &mut model, 50).iter().all(|v| v.is_finite()));
}

#[test]
fn one_mask_or_masks_without_entries_or_direction_move_nothing_wrongly() {
    let context = context(64, Neighbours::Gaussians, true);
    let fresh =
        |layers| Model::<f32>::new(6, options(layers, Loss::Printed), &context, &mut ChaCha8Rng::seed_from_u64(1));
    // One mask: nothing to tell apart.
    let mut model = fresh(2);
    let start: Vec<f64> = model.features.iter().map(|v| f64::from(*v)).collect();
    assert_eq!(run_on(&context, &set_of(&context, std::slice::from_ref(&(0..30))), &mut model, 5), start);
    // A mask without entries takes no part.
    let with = run_on(&context, &set_of(&context, &[0..20, 5..5, 30..60]), &mut fresh(2), 5);
    let without = run_on(&context, &set_of(&context, &[0..20, 30..60]), &mut fresh(2), 5);
    assert_eq!(with, without);
    assert_ne!(with, start);
    // A centroid of zero length has no direction.
    let mut model = fresh(0);
    model.features[..120].fill(0.0);
    let features = run_on(&context, &set_of(&context, &[0..20, 30..45, 45..60]), &mut model, 5);
    assert!(features[..120].iter().all(|v| *v == 0.0) && features.iter().all(|v| v.is_finite()));
}

#[test]
fn a_hundred_thousand_iterations_at_a_low_temperature_stay_finite() {
    let context = context(40, Neighbours::Gaussians, true);
    let set = mask_set(&context, 4, 3);
    let cold = Contrastive { tau: 1e-3, ..options(2, Loss::Printed) };
    let mut model = Model::<f32>::new(6, cold, &context, &mut ChaCha8Rng::seed_from_u64(1));
    let features = run_on(&context, &set, &mut model, 100_000);
    let weights = model.layers.iter().flat_map(|l| &l.weights);
    assert!(features.iter().all(|v| v.is_finite()) && weights.clone().all(|w| w.is_finite()));
    let largest = features.iter().fold(0.0f64, |a, b| a.max(b.abs()));
    assert!(largest < 100.0, "features drift: {largest}");
}
