//! Floor and walls, and what hangs on them: backs are at y = 0, fronts face -y.

use crate::random::vary;
use crate::things::class::{ivory, metal};
use crate::things::material::{Material, Paint, Pattern, matt};
use crate::things::model::Model;
use crate::things::shape::Shape;
use glam::DVec3;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;

/// The floor of a room with the given half extents.
pub fn floor(half: [f64; 2]) -> Model {
    let mut m = Model::default();
    let boards = matt([0.60, 0.52, 0.45]).with(Pattern::Wood { board: 0.24 });
    m.part("floor").add(Shape::block([half[0] + 0.1, half[1] + 0.1, 0.05], 0.0), [0.0, 0.0, -0.05], boards);
    m
}

/// A wall of the given length and height with its front at y = 0, facing -y, and a skirting board.
pub fn wall(length: f64, height: f64, color: DVec3) -> Model {
    let mut m = Model::default();
    let plaster = Material::matt(color).with(Pattern::Clouds { size: 0.7, amount: 0.10 });
    m.part("wall").add(Shape::block([0.5 * length, 0.05, 0.5 * height], 0.0), [0.0, 0.05, 0.5 * height], plaster);
    m.part("skirting board").block([length, 0.02, 0.10], 0.0, [0.0, -0.01, 0.0], matt([0.86, 0.84, 0.80]));
    m
}

pub(super) fn painting(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (w, h, bar) = (0.62, 0.46, 0.045);
    m.part("frame");
    let lacquer = paint.glazed();
    for side in [-1.0, 1.0] {
        m.add(Shape::block([0.5 * w, 0.018, 0.5 * bar], 0.006), [0.0, -0.018, side * (0.5 * h - 0.5 * bar)], lacquer);
        m.add(Shape::block([0.5 * bar, 0.018, 0.5 * h], 0.006), [side * (0.5 * w - 0.5 * bar), -0.018, 0.0], lacquer);
    }
    let ground = Material::matt(ivory()).with(Pattern::Painting { picture: rng.random_range(0..1000) });
    m.part("canvas").add(Shape::block([0.5 * w - 0.02, 0.006, 0.5 * h - 0.02], 0.0), [0.0, -0.008, 0.0], ground);
}

pub(super) fn door(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (w, h) = (0.85, 2.0 * vary(rng, 0.02));
    let white = matt([0.88, 0.87, 0.84]);
    m.part("frame");
    for side in [-1.0, 1.0] {
        m.block([0.08, 0.05, h + 0.08], 0.005, [side * (0.5 * w + 0.04), -0.025, 0.0], white);
    }
    m.block([w + 0.16, 0.05, 0.08], 0.005, [0.0, -0.025, h], white);
    m.part("leaf").block([w, 0.03, h], 0.003, [0.0, -0.015, 0.0], paint.matt());
    for z in [0.25, 1.15] {
        m.block([0.6 * w, 0.01, 0.65], 0.004, [0.0, -0.034, z], Material::matt(paint.albedo() * 0.85));
    }
    m.part("handle").rod([0.33, -0.03, 1.0], [0.33, -0.075, 1.0], 0.010, metal());
    m.rod([0.33, -0.075, 1.0], [0.22, -0.075, 1.0], 0.010, metal());
}

pub(super) fn window(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (w, h) = (1.1 * vary(rng, 0.1), 0.95);
    m.part("frame");
    let lacquer = paint.matt();
    for side in [-1.0, 0.0, 1.0] {
        m.block([0.05, 0.05, h], 0.004, [side * (0.5 * w - 0.025), -0.025, 0.0], lacquer);
    }
    for z in [0.0, h - 0.05] {
        m.block([w, 0.05, 0.05], 0.004, [0.0, -0.025, z], lacquer);
    }
    let sky = matt([0.62, 0.75, 0.88]).gleaming(0.2).glowing(0.5);
    m.part("glass").block([w - 0.02, 0.02, h - 0.02], 0.0, [0.0, -0.010, 0.01], sky);
    m.part("sill").block([w + 0.1, 0.12, 0.03], 0.005, [0.0, -0.06, -0.03], lacquer);
}

pub(super) fn curtain(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (folds, h) = (9, 1.35 * vary(rng, 0.05));
    let cloth = paint.matt();
    m.part("rod").rod([-0.45, -0.06, h], [0.45, -0.06, h], 0.012, metal());
    m.part("cloth");
    for k in 0..folds {
        let x = -0.36 + 0.09 * f64::from(k);
        let y = -0.06 - 0.012 * f64::from(k % 2);
        m.rod([x, y, 0.05], [x, y, h - 0.05], 0.048, cloth);
    }
}
