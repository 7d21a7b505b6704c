//! Toys.

use crate::random::vary;
use crate::things::class::{ivory, metal, tip};
use crate::things::material::{Material, PAINTS, Paint, Pattern, albedo, glazed, matt};
use crate::things::model::Model;
use crate::things::shape::Shape;
use glam::{DMat3, DVec3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use std::f64::consts::{PI, TAU};

pub(super) fn toy_bear(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let fur = Material::matt(paint.albedo() * 0.92 + 0.02).with(Pattern::Clouds { size: 0.015, amount: 0.15 });
    let pale = fur.in_color(fur.albedo * 0.45 + ivory() * 0.5);
    let ball = |x: f64, y: f64, z: f64| Shape::ellipsoid([x, y, z]);
    m.part("body").add(ball(0.062, 0.055, 0.075), [0.0, 0.0, 0.075], fur);
    m.add(ball(0.042, 0.020, 0.050), [0.0, -0.043, 0.072], pale);
    m.part("head").add(ball(0.052, 0.048, 0.047), [0.0, -0.005, 0.180], fur);
    m.add(ball(0.024, 0.020, 0.018), [0.0, -0.048, 0.170], pale);
    let dark = glazed([0.12, 0.10, 0.10]);
    m.add(Shape::sphere(0.008), [0.0, -0.068, 0.176], dark);
    m.part("ears");
    for side in [-1.0, 1.0] {
        m.again("head").add(Shape::sphere(0.0065), [side * 0.020, -0.046, 0.194], dark);
        m.again("ears").add(ball(0.020, 0.012, 0.020), [side * 0.042, 0.0, 0.220], fur);
        m.add(ball(0.012, 0.006, 0.012), [side * 0.042, -0.009, 0.220], pale);
    }
    m.part("arms");
    m.part("legs");
    for side in [-1.0, 1.0] {
        m.again("arms").rod([side * 0.052, -0.01, 0.118], [side * 0.082, -0.045, 0.070], 0.020, fur);
        m.again("legs").rod([side * 0.035, -0.02, 0.024], [side * 0.060, -0.085, 0.024], 0.024, fur);
        m.add(ball(0.018, 0.006, 0.018), [side * 0.0655, -0.106, 0.026], pale);
    }
    m.scale(1.1 * vary(rng, 0.08));
}

pub(super) fn toy_duck(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let skin = paint.matt().gleaming(0.12);
    m.part("body").add(Shape::ellipsoid([0.085, 0.062, 0.050]), [0.0, 0.0, 0.050], skin);
    m.add_turned(Shape::ellipsoid([0.040, 0.030, 0.016]), [-0.075, 0.0, 0.075], DMat3::from_rotation_y(0.6), skin);
    m.part("head").add(Shape::sphere(0.043), [0.050, 0.0, 0.122], skin);
    let bill = if paint.name == "yellow" { albedo([0.90, 0.36, 0.10]) } else { albedo([0.96, 0.74, 0.15]) };
    m.part("beak").add(Shape::ellipsoid([0.028, 0.022, 0.009]), [0.098, 0.0, 0.116], Material::glazed(bill));
    m.part("wings");
    for side in [-1.0, 1.0] {
        m.again("head").add(Shape::sphere(0.007), [0.082, side * 0.022, 0.136], glazed([0.08, 0.08, 0.08]));
        let (wing, dark) = (Shape::ellipsoid([0.045, 0.014, 0.026]), skin.in_color(skin.albedo * 0.82));
        m.again("wings").add_turned(wing, [-0.012, side * 0.056, 0.066], DMat3::from_rotation_y(0.25), dark);
    }
    m.scale(vary(rng, 0.1));
}

pub(super) fn toy_car(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let lacquer = paint.matt().gleaming(0.2);
    m.part("body").block([0.22, 0.10, 0.045], 0.016, [0.0, 0.0, 0.022], lacquer);
    m.part("cabin").block([0.115, 0.085, 0.046], 0.014, [-0.012, 0.0, 0.064], glazed([0.62, 0.74, 0.82]));
    m.block([0.10, 0.080, 0.012], 0.005, [-0.012, 0.0, 0.104], lacquer);
    m.part("wheels");
    let rubber = matt([0.17, 0.17, 0.18]);
    let tyre = [(0.0, 0.0), (0.028, 0.0), (0.028, 0.022), (0.024, 0.025), (0.0, 0.025)];
    for x in [-0.065, 0.065] {
        for side in [-1.0, 1.0] {
            let across = tip(-90.0 * side);
            let hub = [x, side * 0.034, 0.0285];
            m.turn_rotated(&tyre, hub, across, rubber);
            m.turn_rotated(&[(0.013, 0.0255), (0.0, 0.0275)], hub, across, metal());
        }
    }
    m.scale(vary(rng, 0.1));
}

pub(super) fn toy_blocks(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let first = PAINTS.iter().position(|p| p.name == paint.name).unwrap_or(0);
    let names = ["red block", "blue block", "green block", "yellow block"];
    let s = 0.072;
    for (k, foot) in [[-0.52 * s, 0.0, 0.0], [0.52 * s, 0.0, 0.0], [0.05 * s, 0.0, s + 0.0005]].into_iter().enumerate()
    {
        let color = (first + k) % 4;
        let half = DVec3::splat(0.5 * s);
        let angle = if k == 2 { 0.8 * (rng.random::<f64>() - 0.5) } else { 0.0 };
        let (block, at) = (Shape::Block { half, round: 0.005 }, [foot[0], foot[1], foot[2] + half.z]);
        m.part(names[color]).add_turned(block, at, DMat3::from_rotation_z(angle), PAINTS[color].matt());
    }
}

pub(super) fn puzzle_cube(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let s = 0.075 * vary(rng, 0.15);
    let first = PAINTS.iter().position(|p| p.name == paint.name).unwrap_or(0);
    // Three layers of which the top one is turned.
    let twist = 0.5 * rng.random::<f64>();
    for (k, name) in ["bottom layer", "middle layer", "top layer"].into_iter().enumerate() {
        let half = DVec3::new(0.5 * s, 0.5 * s, s / 6.0 - 0.0005);
        let turn = DMat3::from_rotation_z(if k == 2 { twist } else { 0.0 });
        let other = PAINTS[(first + 2 * k + 2) % 8].albedo();
        let stickers = paint.glazed().with(Pattern::Checks { other, size: s / 3.0 });
        let z = s * (k as f64 + 0.5) / 3.0;
        m.part(name).add_turned(Shape::Block { half, round: 0.002 }, [0.0, 0.0, z], turn, stickers);
    }
}

pub(super) fn toy_rocket(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let skin = paint.matt().gleaming(0.15);
    m.part("body").lathe(&[(0.0, 0.03), (0.03, 0.03), (0.038, 0.09), (0.036, 0.15), (0.0, 0.15)], skin);
    m.part("nose").lathe(&[(0.036, 0.15), (0.022, 0.195), (0.0, 0.225)], Material::glazed(ivory()));
    m.part("fins");
    for j in 0..3 {
        let a = TAU * f64::from(j) / 3.0;
        let turn = DMat3::from_rotation_z(a);
        let half = DVec3::new(0.022, 0.004, 0.035);
        let at = turn * DVec3::new(0.045, 0.0, 0.0355);
        let red = Material::glazed(PAINTS[(j as usize * 3 + 1) % 8].albedo());
        m.add_turned(Shape::Block { half, round: 0.003 }, at.to_array(), turn, red);
    }
    m.part("window").add(Shape::ellipsoid([0.014, 0.008, 0.014]), [0.0, -0.033, 0.125], metal());
    m.scale(vary(rng, 0.15));
}

pub(super) fn ball(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let r = 0.05 * vary(rng, 0.25);
    let line: Vec<(f64, f64)> =
        (0..=12).map(|k| f64::from(k) * PI / 12.0).map(|a| (r * a.sin(), r - r * a.cos())).collect();
    m.part("lower half").lathe(&line[..=6], paint.glazed());
    m.part("upper half").lathe(&line[6..], Material::glazed(paint.albedo() * 0.5 + ivory() * 0.5));
}
