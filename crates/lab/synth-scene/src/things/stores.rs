//! What stands on the shelves of a workshop: jars, cans, boxes, spools, manuals, and sets whose parts are alike.

use crate::random::vary;
use crate::things::class::{ivory, metal, wood};
use crate::things::material::{Material, PAINTS, Paint, Pattern, VIVID, albedo, glazed, matt};
use crate::things::model::{Model, profile};
use crate::things::shape::Shape;
use glam::{DMat3, DVec3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use std::f64::consts::{PI, TAU};

/// Brown cardboard.
fn cardboard() -> Material {
    matt([0.72, 0.58, 0.40])
}

/// Adds a jar of greyish glass with what is in it and a lid, at a place on the ground.
fn jar_at(m: &mut Model, [r, h]: [f64; 2], at: [f64; 3], fill: f64, lid: Material) {
    let glass = matt([0.74, 0.80, 0.80]).gleaming(0.25);
    m.part("glass").turn(&[(0.0, 0.0), (0.95 * r, 0.0), (r, 0.005), (r, 0.06 * h)], at, glass);
    m.turn(&[(r, fill * h), (r, 0.86 * h), (0.85 * r, 0.93 * h)], at, glass);
    let screws = matt([0.46, 0.42, 0.38]).with(Pattern::Clouds { size: 0.008, amount: 0.5 });
    m.part("screws").turn(&[(r, 0.06 * h), (r, fill * h)], at, screws);
    let cap = [(0.0, 0.92 * h), (0.93 * r, 0.92 * h), (0.93 * r, 0.99 * h), (0.86 * r, h), (0.0, h)];
    m.part("lid").turn(&cap, at, lid);
}

pub(super) fn screw_jar(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (r, h) = (0.036 * vary(rng, 0.15), 0.10 * vary(rng, 0.2));
    jar_at(m, [r, h], [0.0; 3], 0.3 + 0.4 * rng.random::<f64>(), paint.glazed());
    m.top([0.0, 0.0], [0.6 * r, 0.6 * r], h + 0.0005);
}

pub(super) fn rack_of_jars(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (count, r, h) = (rng.random_range(3..=5), 0.026, 0.078 * vary(rng, 0.15));
    let step = 2.0 * r + 0.001;
    let length = step * f64::from(count) + 0.016;
    m.part("rack").block([length, 0.064, 0.010], 0.002, [0.0; 3], wood(1.0));
    m.block([length, 0.006, 0.034], 0.001, [0.0, 0.029, 0.0], wood(1.0));
    for k in 0..count {
        let x = step * (f64::from(k) - 0.5 * f64::from(count - 1));
        jar_at(m, [r, h], [x, -0.004, 0.0102], 0.3 + 0.4 * rng.random::<f64>(), paint.glazed());
    }
}

pub(super) fn tin_can(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (r, h) = (0.038 * vary(rng, 0.12), 0.105 * vary(rng, 0.15));
    let rim = [(0.0, 0.0), (r, 0.0), (r, h), (0.95 * r, h), (0.94 * r, h - 0.001), (0.0, h)];
    m.part("can").lathe(&rim, metal());
    m.part("label").lathe(&[(1.012 * r, 0.10 * h), (1.012 * r, 0.90 * h)], paint.matt());
    m.lathe(&[(1.016 * r, 0.35 * h), (1.016 * r, 0.62 * h)], Material::matt(ivory()));
    m.top([0.0, 0.0], [0.65 * r, 0.65 * r], h + 0.0005);
}

pub(super) fn paint_can(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (r, h) = (0.055 * vary(rng, 0.12), 0.125 * vary(rng, 0.12));
    m.part("can").lathe(&[(0.0, 0.0), (r, 0.0), (r, 0.97 * h), (0.97 * r, h), (0.82 * r, h)], paint.glazed());
    m.part("lid").lathe(&[(0.82 * r, h), (0.80 * r, h + 0.002), (0.0, h + 0.002)], metal());
    m.part("label").lathe(&[(1.01 * r, 0.25 * h), (1.01 * r, 0.72 * h)], Material::matt(ivory()));
    // The wire hangs down at the front.
    m.part("handle");
    let bend = |k: u32| {
        let a = PI * f64::from(k) / 6.0;
        [(r + 0.004) * a.cos(), -0.3 * r - (0.7 * r + 0.002) * a.sin(), h * (0.86 - 0.38 * a.sin())]
    };
    (0..6).for_each(|k| m.rod(bend(k), bend(k + 1), 0.0016, metal()));
    m.top([0.0, 0.0], [0.56 * r, 0.56 * r], h + 0.0025);
}

pub(super) fn spray_can(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (r, h) = (0.028 * vary(rng, 0.1), 0.135 * vary(rng, 0.12));
    m.part("can").lathe(&[(0.0, 0.0), (0.96 * r, 0.0), (r, 0.004), (r, h), (0.72 * r, h + 0.012)], paint.glazed());
    m.part("label").lathe(&[(1.012 * r, 0.22 * h), (1.012 * r, 0.60 * h)], Material::matt(ivory()));
    let cap = [(0.85 * r, h + 0.002), (0.85 * r, h + 0.034), (0.78 * r, h + 0.038), (0.0, h + 0.038)];
    m.part("cap").lathe(&cap, Material::glazed(paint.albedo() * 0.55 + 0.12));
}

pub(super) fn glue_bottle(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let s = vary(rng, 0.15);
    m.part("bottle").add(Shape::block([0.027, 0.017, 0.055], 0.012), [0.0, 0.0, 0.055], matt([0.90, 0.89, 0.85]));
    m.part("label").add(Shape::block([0.024, 0.0178, 0.028], 0.006), [0.0, 0.0, 0.050], paint.matt());
    m.part("nozzle")
        .lathe(&[(0.012, 0.105), (0.012, 0.120), (0.004, 0.150), (0.003, 0.162), (0.0, 0.162)], paint.glazed());
    m.scale(s);
}

pub(super) fn oil_can(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let k = vary(rng, 0.15);
    m.part("can").lathe(
        &[(0.0, 0.0), (0.042, 0.0), (0.044, 0.006), (0.040, 0.05), (0.014, 0.078), (0.0, 0.078)],
        paint.glazed(),
    );
    m.part("spout").rod([0.0, 0.0, 0.07], [0.055, 0.0, 0.165], 0.0042, metal());
    let ring = Shape::Ring { major: 0.024, minor: 0.0035, arc: 1.5 };
    m.part("handle").add_turned(
        ring,
        [-0.030, 0.0, 0.055],
        DMat3::from_rotation_x(0.5 * PI) * DMat3::from_rotation_z(PI),
        metal(),
    );
    m.scale(k);
}

pub(super) fn spool_of_wire(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (r, h) = (0.032 * vary(rng, 0.2), 0.05 * vary(rng, 0.3));
    let plastic = matt([0.30, 0.29, 0.30]);
    m.part("spool");
    for z in [0.0, h - 0.003] {
        let disc = [(0.0, z), (r, z), (r, z + 0.003), (0.008, z + 0.003), (0.008, z + 0.0032)];
        m.lathe(&disc, plastic);
    }
    m.lathe(&[(0.008, h + 0.0002), (0.0, h + 0.0002)], matt([0.1; 3]));
    let turns = Pattern::Stripes { other: paint.albedo() * 0.7, across: DVec3::Z * 180.0 };
    let wire = paint.glazed().with(turns);
    m.part("wire").lathe(&[(0.80 * r, 0.003), (0.82 * r, 0.5 * h), (0.80 * r, h - 0.003)], wire);
    m.top([0.0, 0.0], [0.65 * r, 0.65 * r], h + 0.0005);
}

pub(super) fn coil_of_cable(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (r, minor) = (0.060 * vary(rng, 0.2), 0.005);
    m.part("cable");
    for k in 0..4 {
        let (x, y) = (0.003 * rng.random::<f64>(), 0.003 * rng.random::<f64>());
        let major = if k % 2 == 0 { r } else { r - 0.008 };
        m.add(Shape::Ring { major, minor, arc: PI }, [x, y, minor + 0.0075 * f64::from(k)], paint.matt());
    }
    let tie = matt([0.22, 0.21, 0.22]);
    m.part("tie");
    for side in [-1.0, 1.0] {
        m.block([0.028, 0.008, 0.036], 0.003, [side * (r - 0.004), 0.0, 0.0], tie);
    }
}

pub(super) fn roll_of_tape(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (r, h) = (0.042 * vary(rng, 0.2), 0.024 * vary(rng, 0.4));
    let core = 0.6 * r;
    m.part("tape").lathe(&[(core, 0.0), (r, 0.0), (r, h), (core, h)], paint.matt().gleaming(0.06));
    let inner = [(core, h), (0.92 * core, h), (0.92 * core, 0.0), (core, 0.0)];
    m.part("core").lathe(&inner, cardboard());
}

pub(super) fn screw_box(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let size = [0.09 * vary(rng, 0.3), 0.075 * vary(rng, 0.3), 0.05 * vary(rng, 0.35)];
    let [w, d, h] = size;
    m.part("box").block([w, d, 0.72 * h], 0.001, [0.0; 3], cardboard());
    m.part("lid").block([w + 0.002, d + 0.002, 0.30 * h], 0.001, [0.0, 0.0, 0.70 * h], paint.matt());
    m.part("label").block(
        [0.6 * w, 0.0012, 0.42 * h],
        0.0,
        [0.0, -0.5 * d - 0.0004, 0.14 * h],
        Material::matt(ivory()),
    );
    m.top([0.0, 0.0], [0.48 * w, 0.48 * d], h + 0.0005);
}

pub(super) fn stack_of_boxes(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let mut z = 0.0;
    for (k, name) in ["bottom box", "middle box", "top box"].into_iter().enumerate() {
        let shrink = 1.0 - 0.12 * k as f64;
        let size = [0.115 * shrink * vary(rng, 0.1), 0.085 * shrink * vary(rng, 0.1), 0.048 * vary(rng, 0.25)];
        let tone = paint.albedo() * [0.75, 1.1, 0.92][k];
        let turn = DMat3::from_rotation_z(0.3 * (rng.random::<f64>() - 0.5));
        let half = size.map(|s| 0.5 * s);
        let at = [0.0, 0.0, z + half[2]];
        m.part(name).add_turned(Shape::block(half, 0.0015), at, turn, Material::matt(tone.min(DVec3::splat(0.9))));
        z += size[2] + 0.0005;
    }
}

pub(super) fn drawer_box(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (w, d, rows) = (0.17, 0.10, rng.random_range(2..=3));
    let h = 0.04 * f64::from(rows) + 0.006;
    m.part("body").block([w, d, h], 0.003, [0.0, 0.004, 0.0], matt([0.48, 0.48, 0.50]));
    for row in 0..rows {
        for column in 0..3 {
            let x = (f64::from(column) - 1.0) * 0.054;
            let z = 0.005 + 0.04 * f64::from(row);
            m.part("drawer").block([0.050, 0.008, 0.036], 0.002, [x, -0.5 * d + 0.001, z], paint.matt());
            m.block([0.014, 0.006, 0.006], 0.002, [x, -0.5 * d - 0.004, z + 0.02], paint.matt());
        }
    }
    m.top([0.0, 0.0], [0.48 * w, 0.45 * d], h + 0.0005);
}

pub(super) fn tool_box(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (w, d, h) = (0.30 * vary(rng, 0.1), 0.15, 0.11);
    m.part("box").block([w, d, h], 0.006, [0.0; 3], paint.matt().gleaming(0.08));
    m.part("lid").block(
        [w + 0.006, d + 0.006, 0.035],
        0.008,
        [0.0, 0.0, h],
        Material::matt(paint.albedo() * 0.75 + 0.02),
    );
    m.part("latches");
    for side in [-1.0, 1.0] {
        m.block([0.022, 0.008, 0.035], 0.001, [side * 0.3 * w, -0.5 * d - 0.004, h - 0.02], metal());
    }
    let z = h + 0.06;
    m.part("handle").rod([-0.055, 0.0, z], [0.055, 0.0, z], 0.007, matt([0.2; 3]));
    for side in [-1.0, 1.0] {
        m.rod([side * 0.055, 0.0, h + 0.03], [side * 0.055, 0.0, z], 0.006, matt([0.2; 3]));
    }
}

/// A book that stands with its spine towards -y: `thickness` along x. Gives its size.
fn upright(m: &mut Model, thickness: f64, rng: &mut ChaCha8Rng, cover: Material) -> [f64; 3] {
    let [w, d, h] = [thickness, 0.145 * vary(rng, 0.08), 0.185 * vary(rng, 0.08)];
    let board = (0.15 * w).min(0.0025);
    m.part("cover").block([w, board, h], 0.0, [0.0, 0.5 * (board - d), 0.0], cover);
    for side in [-1.0, 1.0] {
        m.block([board, d, h], 0.0, [side * 0.5 * (w - board), 0.0, 0.0], cover);
    }
    m.part("pages").block([w - 2.0 * board, d - 0.004, h - 0.006], 0.0, [0.0, 0.0, 0.003], Material::matt(ivory()));
    [w, d, h]
}

/// Adds a title to the spine of such a book, over shares of its width and height, from a share of its height upwards.
fn title(m: &mut Model, [w, d, h]: [f64; 3], size: [f64; 2], from: f64) {
    let at = [0.0, -0.5 * d - 0.0003, from * h];
    m.part("title").block([size[0] * w, 0.001, size[1] * h], 0.0, at, Material::matt(ivory()));
}

pub(super) fn manual(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let size = upright(m, 0.024 * vary(rng, 0.45), rng, paint.matt());
    title(m, size, [0.8, 0.3], 0.5);
}

pub(super) fn magazine(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let size = upright(m, 0.008 * vary(rng, 0.35), rng, paint.glazed());
    title(m, size, [0.96, 0.2], 0.7);
}

/// An open cup on the ground, with its rim at `h`.
fn cup(m: &mut Model, r: f64, h: f64, material: Material) {
    m.part("cup").lathe(&[(0.0, 0.0), (r, 0.0), (r, h), (r - 0.003, h), (r - 0.003, 0.005), (0.0, 0.005)], material);
}

pub(super) fn pencil_cup(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (r, h) = (0.036, 0.085 * vary(rng, 0.12));
    cup(m, r, h, paint.matt());
    let start = rng.random::<f64>() * TAU;
    for k in 0..5 {
        let a = start + TAU * f64::from(k) / 5.0;
        let color = PAINTS[VIVID[rng.random_range(0..VIVID.len())]].albedo();
        let (low, high) = ([-0.014 * a.cos(), -0.014 * a.sin(), 0.012], [0.026 * a.cos(), 0.026 * a.sin()]);
        let top = 0.14 + 0.01 * f64::from(k % 3);
        m.part("pencil").rod(low, [high[0], high[1], top], 0.0042, Material::glazed(color));
    }
    m.part("ruler").block([0.026, 0.0025, 0.17], 0.0, [0.0, 0.004, 0.008], matt([0.88, 0.80, 0.52]));
}

pub(super) fn jar_of_brushes(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    cup(m, 0.036, 0.08 * vary(rng, 0.15), matt([0.74, 0.80, 0.80]).gleaming(0.25));
    let start = rng.random::<f64>() * TAU;
    for k in 0..4 {
        let a = start + TAU * f64::from(k) / 4.0;
        let at = |out: f64, z: f64| [out * a.cos(), out * a.sin(), z];
        let top = 0.135 + 0.012 * f64::from(k % 2);
        m.part("brush handle").rod(at(-0.008, 0.010), at(0.024, top), 0.0038, paint.glazed());
        let hair = profile([0.0, 0.0052, 0.0065, 0.002, 0.0], [0.0, 0.0, 0.014, 0.030, 0.032]);
        m.part("bristles").turn(&hair, at(0.0245, top), matt([0.70, 0.57, 0.36]));
    }
}

pub(super) fn set_of_screwdrivers(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let count = rng.random_range(4..=6);
    let step = 0.031;
    let length = step * f64::from(count) + 0.012;
    m.part("rack").block([length, 0.045, 0.045 * vary(rng, 0.15)], 0.003, [0.0; 3], wood(0.9));
    for k in 0..count {
        let x = step * (f64::from(k) - 0.5 * f64::from(count - 1));
        // The set runs from the small one to the large one.
        let r = 0.0095 + 0.0008 * f64::from(k);
        let low = 0.070 + 0.004 * f64::from(k);
        m.part("shaft").rod([x, 0.0, 0.03], [x, 0.0, low + 0.004], 0.0032, metal());
        let handle =
            profile([0.0, 0.6 * r, r, 0.85 * r, r, 0.7 * r, 0.0], [0.0, 0.0, 0.012, 0.04, 0.065, 0.078, 0.080]);
        m.part("handle").turn(&handle, [x, 0.0, low], paint.glazed());
    }
}

pub(super) fn battery(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (r, h) = (0.014 * vary(rng, 0.15), 0.055 * vary(rng, 0.1));
    m.part("body").lathe(&[(0.0, 0.0), (r, 0.0), (r, 0.68 * h)], paint.glazed());
    m.part("top").lathe(&[(r, 0.68 * h), (r, h), (0.0, h)], glazed([0.72, 0.52, 0.24]));
    m.part("terminal")
        .lathe(&[(0.35 * r, h), (0.35 * r, h + 0.003), (0.0, h + 0.003)], Material::matt(albedo([0.75; 3])));
}
