//! Furniture. Backs are at +y, fronts face -y; what hangs on walls has its back at y = 0.

use crate::random::vary;
use crate::things::class::{ivory, metal, tip, wood};
use crate::things::material::{Material, Paint, Pattern, matt};
use crate::things::model::Model;
use crate::things::shape::Shape;
use rand_chacha::ChaCha8Rng;
use std::f64::consts::TAU;

pub(super) fn chair(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let timber = wood(vary(rng, 0.15));
    let cloth = paint.matt();
    let (w, seat_at) = (0.42, 0.42);
    m.part("legs").legs([0.5 * w - 0.03; 2], [0.04, 0.04, seat_at], 0.006, timber);
    m.part("seat").block([w, w, 0.055], 0.02, [0.0, 0.0, seat_at], cloth);
    m.part("back");
    for x in [-1.0, 1.0] {
        m.rod([x * 0.16, 0.5 * w - 0.03, seat_at + 0.05], [x * 0.16, 0.5 * w + 0.01, seat_at + 0.42], 0.016, timber);
    }
    let lean = tip(-6.0);
    m.add_turned(Shape::block([0.5 * w, 0.018, 0.12], 0.016), [0.0, 0.5 * w - 0.002, seat_at + 0.33], lean, cloth);
}

pub(super) fn stool(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let timber = wood(vary(rng, 0.15));
    m.part("legs");
    let h = 0.46 * vary(rng, 0.06);
    for k in 0..4 {
        let a = TAU * (f64::from(k) + 0.5) / 4.0;
        m.rod([0.18 * a.cos(), 0.18 * a.sin(), 0.016], [0.12 * a.cos(), 0.12 * a.sin(), h], 0.016, timber);
    }
    m.part("seat").lathe(
        &[(0.0, h), (0.17, h), (0.185, h + 0.015), (0.185, h + 0.04), (0.165, h + 0.058), (0.0, h + 0.064)],
        paint.matt(),
    );
}

pub(super) fn armchair(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let cloth = paint.matt().with(Pattern::Clouds { size: 0.1, amount: 0.12 });
    let k = vary(rng, 0.05);
    m.part("seat").block([0.52, 0.56, 0.30], 0.04, [0.0, -0.02, 0.06], cloth.in_color(cloth.albedo * 1.1));
    m.part("back").block([0.72, 0.15, 0.72], 0.06, [0.0, 0.30, 0.06], cloth);
    for side in [-1.0, 1.0] {
        m.part("arm").block([0.12, 0.56, 0.48], 0.05, [side * 0.32, -0.02, 0.06], cloth);
    }
    m.part("legs");
    for (x, y) in [(-1.0, -0.24), (1.0, -0.24), (-1.0, 0.30), (1.0, 0.30)] {
        m.block([0.05, 0.05, 0.10], 0.008, [x * 0.31, y, 0.0], wood(0.7));
    }
    m.scale(k);
}

pub(super) fn sofa(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let cloth = paint.matt().with(Pattern::Clouds { size: 0.1, amount: 0.12 });
    let w = 1.6 * vary(rng, 0.08);
    m.part("base").block([w, 0.80, 0.22], 0.03, [0.0, 0.0, 0.08], cloth);
    m.part("back").block([w, 0.18, 0.72], 0.06, [0.0, 0.33, 0.08], cloth);
    for side in [-1.0, 1.0] {
        m.part("arm").block([0.16, 0.80, 0.52], 0.06, [side * (0.5 * w - 0.02), 0.0, 0.08], cloth);
        let half = 0.5 * w - 0.12;
        let pale = cloth.in_color(cloth.albedo * 0.9 + 0.05);
        m.part("seat cushion").block([half, 0.60, 0.16], 0.05, [side * 0.5 * half, -0.06, 0.29], pale);
    }
    m.part("legs").legs([0.5 * w - 0.08, 0.35], [0.05, 0.05, 0.09], 0.008, wood(0.7));
}

pub(super) fn bed(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (w, d) = (1.95, 0.95);
    let timber = wood(vary(rng, 0.2));
    m.part("frame").block([w, d, 0.16], 0.02, [0.0, 0.0, 0.12], timber);
    m.block([0.05, d, 0.75], 0.01, [-0.5 * w, 0.0, 0.0], timber);
    m.legs([0.9, 0.4], [0.06, 0.06, 0.13], 0.005, timber);
    m.part("mattress").block([w - 0.08, d - 0.04, 0.18], 0.05, [0.0, 0.0, 0.28], matt([0.90, 0.89, 0.86]));
    let other = paint.albedo() * 0.6 + 0.2;
    let cloth = paint.matt().with(Pattern::Checks { other, size: 0.16 });
    m.part("blanket").block([1.25, d, 0.07], 0.03, [0.30, 0.0, 0.43], cloth);
    let soft = Shape::ellipsoid([0.22, 0.36, 0.08]);
    m.part("pillow").add(soft, [-0.70, 0.0, 0.51], matt([0.88, 0.86, 0.90]));
}

pub(super) fn desk(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (w, d, h) = (1.30 * vary(rng, 0.1), 0.66, 0.74);
    m.part("top").block([w, d, 0.03], 0.005, [0.0, 0.0, h - 0.03], wood(vary(rng, 0.2)));
    m.part("legs");
    for (x, y) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
        m.rod([x * (0.5 * w - 0.05), y * 0.28, 0.02], [x * (0.5 * w - 0.05), y * 0.28, h - 0.03], 0.02, metal());
    }
    let lacquer = paint.matt();
    for k in 0..2 {
        let z = h - 0.20 - 0.17 * f64::from(k);
        m.part("drawer").block([0.38, d - 0.1, 0.16], 0.006, [0.5 * w - 0.30, 0.0, z], lacquer);
        m.rod([0.5 * w - 0.36, -0.31, z + 0.08], [0.5 * w - 0.24, -0.31, z + 0.08], 0.008, metal());
    }
    m.top([0.0, 0.0], [0.5 * w - 0.01, 0.5 * d - 0.01], h);
}

pub(super) fn side_table(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (r, h) = (0.26 * vary(rng, 0.1), 0.52 * vary(rng, 0.1));
    m.part("top").lathe(&[(0.0, h - 0.025), (r, h - 0.025), (r, h), (0.0, h)], paint.glazed());
    m.part("leg").rod([0.0, 0.0, 0.02], [0.0, 0.0, h - 0.03], 0.02, metal());
    m.lathe(&[(0.0, 0.0), (0.16, 0.0), (0.15, 0.015), (0.02, 0.03)], metal());
    m.top([0.0, 0.0], [0.68 * r, 0.68 * r], h + 0.0005);
}

pub(super) fn cabinet(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (w, d, h) = (0.62 * vary(rng, 0.08), 0.36, 0.66);
    let lacquer = paint.matt();
    m.part("body").block([w, d, h], 0.008, [0.0; 3], lacquer);
    m.block([w + 0.03, d + 0.03, 0.025], 0.006, [0.0, 0.0, h], wood(1.0));
    m.top([0.0, 0.0], [0.5 * w, 0.5 * d], h + 0.0255);
    for k in 0..2 {
        let z = 0.05 + 0.31 * f64::from(k);
        let front = lacquer.in_color(lacquer.albedo * 0.86 + 0.05);
        m.part("drawer").block([w - 0.06, 0.02, 0.28], 0.005, [0.0, -0.5 * d - 0.004, z], front);
        m.rod([-0.05, -0.5 * d - 0.028, z + 0.16], [0.05, -0.5 * d - 0.028, z + 0.16], 0.011, metal());
    }
}

pub(super) fn bookshelf(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (w, d, h) = (0.95 * vary(rng, 0.1), 0.30, 1.75);
    let lacquer = paint.matt();
    m.part("frame");
    for side in [-1.0, 1.0] {
        m.block([0.03, d, h], 0.003, [side * (0.5 * w - 0.015), 0.0, 0.0], lacquer);
    }
    m.block([w - 0.06, 0.012, h], 0.0, [0.0, 0.5 * d - 0.006, 0.0], lacquer);
    m.part("shelves");
    for k in 0..5 {
        let z = 0.06 + 0.41 * f64::from(k);
        m.block([w - 0.06, d - 0.014, 0.025], 0.002, [0.0, -0.007, z], lacquer);
        let room = if k < 4 { 0.37 } else { 0.5 };
        m.top_under([0.0, -0.01], [0.5 * w - 0.04, 0.5 * d - 0.012], z + 0.0255, room);
    }
}

pub(super) fn refrigerator(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (w, d, h) = (0.60, 0.60, 1.60 * vary(rng, 0.06));
    let enamel = paint.matt().gleaming(0.12);
    m.part("body").block([w, d, h], 0.01, [0.0; 3], enamel);
    for (name, z, height) in [("lower door", 0.05, 0.60 * h), ("upper door", 0.60 * h + 0.07, 0.40 * h - 0.09)] {
        let front = enamel.in_color(enamel.albedo * 0.92 + 0.03);
        m.part(name).block([w - 0.02, 0.03, height], 0.008, [0.0, -0.5 * d - 0.015, z], front);
        let (x, y) = (-0.22, -0.5 * d - 0.06);
        m.rod([x, y, z + 0.3 * height], [x, y, z + 0.7 * height], 0.012, metal());
    }
}

pub(super) fn waste_bin(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (r, h) = (0.13 * vary(rng, 0.08), 0.30);
    m.part("bin")
        .lathe(&[(0.0, 0.0), (0.82 * r, 0.0), (r, h), (r - 0.008, h), (0.8 * r, 0.012), (0.0, 0.012)], paint.matt());
    let white = Material::matt(ivory()).with(Pattern::Clouds { size: 0.02, amount: 0.2 });
    m.part("paper").add(Shape::sphere(0.060), [0.030, 0.015, 0.235], white);
    m.add(Shape::sphere(0.052), [-0.045, -0.03, 0.225], white);
}

pub(super) fn wall_cabinet(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (w, d, h) = (0.75 * vary(rng, 0.1), 0.32, 0.62);
    let lacquer = paint.matt();
    m.part("body").block([w, d, h], 0.004, [0.0, -0.5 * d, 0.0], lacquer);
    for side in [-1.0, 1.0] {
        let front = lacquer.in_color(lacquer.albedo * 0.88 + 0.05);
        m.part("door").block([0.5 * w - 0.01, 0.02, h - 0.02], 0.004, [side * 0.25 * w, -d - 0.01, 0.01], front);
        m.rod([side * 0.05, -d - 0.035, 0.08], [side * 0.05, -d - 0.035, 0.20], 0.007, metal());
    }
}

pub(super) fn shelf(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let w = 1.1 * vary(rng, 0.1);
    m.part("board").block([w, 0.24, 0.025], 0.003, [0.0, -0.12, 0.0], paint.matt());
    m.part("brackets");
    for side in [-1.0, 1.0] {
        m.rod([side * 0.4 * w, -0.01, -0.15], [side * 0.4 * w, -0.20, -0.012], 0.008, metal());
    }
    m.top([0.0, -0.125], [0.5 * w - 0.01, 0.11], 0.0255);
}

pub(super) fn sink(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let steel = matt([0.72, 0.72, 0.74]).gleaming(0.25);
    let (w, d) = (0.52 * vary(rng, 0.06), 0.42);
    m.part("rim").rim([w, d], [0.04, 0.03], 0.006, paint.glazed());
    m.part("basin").block([w - 0.05, d - 0.05, 0.005], 0.0, [0.0; 3], steel);
    m.lathe(&[(0.03, 0.006), (0.0, 0.006)], matt([0.2; 3]));
    let back = 0.5 * d - 0.02;
    m.part("tap").rod([0.0, back, 0.02], [0.0, back, 0.24], 0.013, steel);
    m.rod([0.0, back, 0.24], [0.0, back - 0.16, 0.25], 0.011, steel);
    m.rod([0.0, back - 0.16, 0.25], [0.0, back - 0.16, 0.20], 0.011, steel);
}

pub(super) fn stove(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (w, d) = (0.56 * vary(rng, 0.04), 0.48);
    m.part("top").block([w, d, 0.02], 0.004, [0.0; 3], paint.matt().gleaming(0.2));
    let iron = matt([0.30, 0.28, 0.28]);
    for (x, y) in [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)] {
        let plate = [(0.085, 0.02), (0.083, 0.026), (0.0, 0.026)];
        m.part("hot plate").turn(&plate, [x * 0.25 * w, y * 0.24 * d, 0.0], iron);
    }
    m.top([0.0, 0.0], [0.42 * w, 0.42 * d], 0.0265);
}

/// A kitchen counter of the given length and depth with its back at +y: background, but with parts.
pub fn counter(length: f64, depth: f64, height: f64) -> Model {
    let mut m = Model::default();
    let white = matt([0.84, 0.83, 0.80]);
    m.part("body").block([length - 0.02, depth - 0.06, height - 0.04], 0.004, [0.0, 0.02, 0.0], white);
    let stone = matt([0.52, 0.48, 0.45]).with(Pattern::Clouds { size: 0.03, amount: 0.18 });
    m.part("worktop").block([length, depth, 0.04], 0.006, [0.0, 0.0, height - 0.04], stone.gleaming(0.08));
    m.part("doors");
    let count = (length / 0.55).round().max(1.0) as usize;
    let step = length / count as f64;
    for k in 0..count {
        let x = -0.5 * length + step * (k as f64 + 0.5);
        let front = matt([0.78, 0.80, 0.80]);
        m.block([step - 0.02, 0.02, height - 0.16], 0.004, [x, -0.5 * depth + 0.04, 0.08], front);
        let (y, z) = (-0.5 * depth + 0.02, height - 0.14);
        m.rod([x - 0.07, y, z], [x + 0.07, y, z], 0.007, metal());
    }
    m.top([0.0, 0.0], [0.5 * length - 0.01, 0.5 * depth - 0.01], height + 0.0005);
    m
}

/// A table of the given top: background, but with parts.
pub fn table(size: [f64; 2], height: f64, tone: f64) -> Model {
    let mut m = Model::default();
    m.part("top").block([size[0], size[1], 0.035], 0.006, [0.0, 0.0, height - 0.035], wood(tone));
    let corner = size.map(|s| 0.5 * s - 0.06);
    m.part("legs").legs(corner, [0.06, 0.06, height - 0.035], 0.006, wood(0.8 * tone));
    m
}
