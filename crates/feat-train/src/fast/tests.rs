//! The engine against the readable model.

use super::*;
use crate::model::Init;
use crate::network::Layer;
use crate::testing::{context, mask_set};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

fn settings(dim: usize, layers: usize, loss: Loss) -> Settings {
    Settings { dim, layers, norm_axis: Axis::Channel, loss, tau: 0.1, cohesion: 0.0, init: Init::Uniform }
}

/// The same model in f64.
fn widened(model: &Model<f32>) -> Model<f64> {
    let wide = |v: &[f32]| v.iter().map(|&v| f64::from(v)).collect::<Vec<f64>>();
    Model {
        settings: model.settings.clone(),
        features: wide(&model.features),
        layers: model
            .layers
            .iter()
            .map(|l| Layer { input: l.input, neighbour: l.neighbour, output: l.output, weights: wide(&l.weights) })
            .collect(),
    }
}

fn wide_set(set: &MaskSet<f32>) -> MaskSet<f64> {
    MaskSet {
        rows: set.rows.clone(),
        pixels: set.pixels.clone(),
        columns: set.columns.clone(),
        start: set.start.clone(),
        mask: set.mask.clone(),
        weight: set.weight.iter().map(|&w| f64::from(w)).collect(),
        pieces: set.pieces.clone(),
    }
}

/// Largest difference as a share of the largest value.
fn difference(found: &[f32], exact: &[f64]) -> f64 {
    assert_eq!(found.len(), exact.len());
    let largest = exact.iter().fold(0.0f64, |a, b| a.max(b.abs()));
    found.iter().zip(exact).map(|(f, e)| (f64::from(*f) - e).abs()).fold(0.0, f64::max) / largest.max(1e-30)
}

fn check(settings: Settings, kind: Neighbours, propagate: bool) {
    let name = format!("{settings:?} {kind:?} {propagate}");
    let context = context(6001, kind, propagate);
    let set = mask_set::<f32>(&context, 23, 3);
    let mut model = Model::<f32>::new(settings, &context, &mut ChaCha8Rng::seed_from_u64(5));
    let exact = widened(&model);
    let propagated = exact.propagate(&context);
    let step = exact.step(&context, &propagated, &wide_set(&set), 77);

    let mut engine = Engine::new(&context, &model, Shortcuts::default());
    engine.propagate(&model, 0);
    let evaluated = engine.evaluate(&model, &set, 77);
    assert!((evaluated.loss - step.loss).abs() <= 1e-5 * step.loss.abs(), "{name}: {} {}", evaluated.loss, step.loss);
    assert!((evaluated.separation - step.separation).abs() <= 1e-5);
    let d = model.settings.dim;
    let alignment = exact.alignment(&context, &propagated, &wide_set(&set));
    assert!((engine.alignment(&model, &set) - alignment).abs() <= 1e-5, "{name}: alignment");
    let finals: Vec<f64> = exact.final_features(&context, &propagated).iter().map(|v| f64::from(*v)).collect();
    assert!(difference(&engine.final_features(&model), &finals) <= 1e-5, "{name}: features");

    let before = model.features.clone();
    let mut adam = Adam::new(before.len());
    let layers = engine.backward(&mut model, &mut adam, &set, &evaluated, 77, &Rates::none(), 0);
    assert!(before == model.features);
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
            check(settings(6, layers, Loss::Printed), kind, true);
        }
    }
    for d in [2, 3, 5, 8, 16, 17, 64] {
        check(settings(d, 2, Loss::WithSelf), Anchors, true);
    }
    check(settings(6, 2, Loss::HalfMask), Gaussians, true);
    for kind in [Gaussians, Anchors] {
        check(settings(6, 3, Loss::Printed), kind, false);
    }
}
