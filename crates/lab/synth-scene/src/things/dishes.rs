//! Dishes, pots, cutlery, and food on them.

use crate::random::vary;
use crate::things::class::{ivory, metal, tip, wood};
use crate::things::material::{Material, PAINTS, Paint, Pattern, matt};
use crate::things::model::{Model, profile, z_towards};
use crate::things::shape::Shape;
use glam::{DMat3, DVec3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use std::f64::consts::{FRAC_PI_2, PI, TAU};

/// A cup with a handle and a disc of coffee.
fn cup(m: &mut Model, r: f64, h: f64, foot: f64, material: Material) {
    let wall = 0.11 * r;
    let (lip, inner) = (r - 0.5 * wall, r - wall);
    let profile = profile(
        [0.0, 0.72 * r, 0.86 * r, 0.96 * r, r, r, lip, inner, inner, 0.7 * r, 0.0],
        [0.0, 0.0, 0.06 * h, 0.25 * h, 0.6 * h, 0.985 * h, h, 0.985 * h, 0.5 * h, 0.1 * h, 0.1 * h],
    );
    m.part("cup").turn(&profile, [0.0, 0.0, foot], material);
    let ring = Shape::Ring { major: 0.3 * h, minor: 0.085 * h, arc: 1.42 };
    m.part("handle").add_turned(ring, [0.97 * r, 0.0, foot + 0.55 * h], tip(90.0), material);
    m.part("coffee").turn(&[(r - 1.05 * wall, 0.86 * h), (0.0, 0.86 * h)], [0.0, 0.0, foot], matt([0.33, 0.19, 0.10]));
}

pub(super) fn mug(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (r, h) = (0.052 * vary(rng, 0.08), 0.125 * vary(rng, 0.1));
    let mut material = paint.glazed();
    if rng.random::<f64>() < 0.4 {
        material = material.with(Pattern::Stripes { other: ivory(), across: DVec3::Z * 16.0 });
    }
    cup(m, r, h, 0.0, material);
}

pub(super) fn coffee_set(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let material = paint.glazed();
    let s = 0.115 * vary(rng, 0.06);
    let profile =
        [(0.0, 0.0), (0.5 * s, 0.0), (0.98 * s, 0.022), (s, 0.026), (0.96 * s, 0.027), (0.5 * s, 0.007), (0.0, 0.007)];
    m.part("saucer").lathe(&profile, Material::glazed(paint.albedo() * 0.75 + ivory() * 0.25));
    cup(m, 0.5 * s, 0.09, 0.0072, material);
    let lean = DMat3::from_rotation_y((-11f64).to_radians());
    let (y, z) = (-0.70 * s, 0.0305);
    m.part("spoon").add_turned(Shape::ellipsoid([0.024, 0.015, 0.005]), [-0.5 * s, y, z - 0.006], lean, metal());
    m.rod([-0.35 * s, y, z - 0.002], [0.85 * s, y, z + 0.010], 0.0045, metal());
}

pub(super) fn plate_of_cookies(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let r = 0.15 * vary(rng, 0.06);
    let rim =
        [(0.0, 0.0), (0.6 * r, 0.0), (0.98 * r, 0.022), (r, 0.026), (0.96 * r, 0.027), (0.62 * r, 0.010), (0.0, 0.010)];
    m.part("plate").lathe(&rim, paint.glazed());
    let dough = matt([0.80, 0.55, 0.27]).with(Pattern::Clouds { size: 0.012, amount: 0.35 });
    let count = rng.random_range(4..=5);
    let (c, h) = (0.040, 0.016);
    let profile = profile(
        [0.0, 0.85 * c, 0.98 * c, c, 0.9 * c, 0.6 * c, 0.0],
        [0.0, 0.0, 0.2 * h, 0.5 * h, 0.85 * h, h, 1.05 * h],
    );
    let start = rng.random::<f64>() * TAU;
    for k in 0..count {
        let a = start + TAU * f64::from(k) / f64::from(count);
        let ring = 0.5 * r * if count == 4 { 0.88 } else { 0.95 };
        m.part("cookie").turn(&profile, [ring * a.cos(), ring * a.sin(), 0.0102], dough);
    }
    m.part("cookie").turn(&profile, [0.0, 0.0, 0.0102 + 1.06 * h], dough);
}

pub(super) fn bowl_of_fruit(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let r = 0.15 * vary(rng, 0.06);
    let h = 0.095;
    let profile = profile(
        [0.0, 0.45 * r, 0.47 * r, 0.72 * r, 0.92 * r, r, 0.97 * r, 0.88 * r, 0.66 * r, 0.4 * r, 0.0],
        [0.0, 0.0, 0.008, 0.25 * h, 0.6 * h, h, 1.02 * h, 0.65 * h, 0.3 * h, 0.16 * h, 0.15 * h],
    );
    m.part("bowl").lathe(&profile, paint.glazed());
    let fruit: [(&str, [f64; 3], DVec3); 4] = [
        ("apple", [0.78, 0.13, 0.12], DVec3::new(0.047, 0.047, 0.043)),
        ("orange", [0.94, 0.52, 0.10], DVec3::splat(0.046)),
        ("lemon", [0.94, 0.83, 0.20], DVec3::new(0.052, 0.038, 0.038)),
        ("green apple", [0.52, 0.70, 0.20], DVec3::new(0.046, 0.046, 0.042)),
    ];
    let start = rng.random::<f64>() * TAU;
    for (k, (name, srgb, radii)) in fruit.into_iter().enumerate() {
        let skin = matt(srgb).gleaming(0.08);
        let a = start + TAU * k as f64 / 3.0;
        let at = if k < 3 { [0.058 * a.cos(), 0.058 * a.sin(), 0.092] } else { [0.0, 0.0, 0.155] };
        m.part(name).add_turned(Shape::Ellipsoid { radii }, at, DMat3::from_rotation_z(a), skin);
        if name.contains("apple") {
            let [x, y, z] = at;
            m.rod([x, y, z + 0.038], [x + 0.008, y, z + 0.058], 0.003, matt([0.46, 0.30, 0.18]));
        }
    }
}

pub(super) fn kettle(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let k = vary(rng, 0.08);
    let enamel = paint.glazed().gleaming(0.15);
    let profile = profile(
        [0.0, 0.080, 0.092, 0.098, 0.094, 0.080, 0.060, 0.0],
        [0.0, 0.0, 0.012, 0.04, 0.08, 0.12, 0.145, 0.147],
    );
    m.part("body").lathe(&profile, enamel);
    let out = DVec3::new(0.62, 0.0, 0.78);
    let spout = [(0.026, 0.0), (0.013, 0.09), (0.009, 0.09), (0.012, 0.06), (0.0, 0.06)];
    m.part("spout").turn_rotated(&spout, [0.075, 0.0, 0.055], z_towards(out), enamel);
    let dark = matt([0.20, 0.18, 0.17]).gleaming(0.08);
    let ring = Shape::Ring { major: 0.072, minor: 0.010, arc: 1.75 };
    m.part("handle").add_turned(ring, [0.0, 0.0, 0.150], tip(90.0) * DMat3::from_rotation_z(FRAC_PI_2), dark);
    m.part("lid")
        .lathe(&[(0.050, 0.146), (0.050, 0.152), (0.035, 0.160), (0.0, 0.163)], enamel.in_color(enamel.albedo * 0.8));
    m.add(Shape::sphere(0.013), [0.0, 0.0, 0.172], dark);
    m.scale(k);
}

pub(super) fn bottle(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let k = vary(rng, 0.08);
    let glass = paint.matt().gleaming(0.25);
    let profile = profile(
        [0.0, 0.040, 0.045, 0.045, 0.040, 0.026, 0.018, 0.017, 0.0],
        [0.0, 0.0, 0.008, 0.17, 0.20, 0.225, 0.25, 0.29, 0.29],
    );
    m.part("body").lathe(&profile, glass);
    let print = Pattern::Stripes { other: paint.albedo() * 0.6 + 0.3, across: DVec3::Z * 25.0 };
    m.part("label").lathe(&[(0.0455, 0.06), (0.0455, 0.14)], Material::matt(ivory()).with(print));
    m.part("cap").lathe(&[(0.020, 0.275), (0.020, 0.305), (0.016, 0.309), (0.0, 0.309)], matt([0.85, 0.70, 0.30]));
    m.scale(k);
}

pub(super) fn plate(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let r = 0.12 * vary(rng, 0.12);
    let glaze = paint.glazed();
    m.part("well").lathe(&[(0.62 * r, 0.009), (0.0, 0.009)], glaze.in_color(glaze.albedo * 0.6 + 0.3));
    let profile = [(0.0, 0.0), (0.6 * r, 0.0), (0.98 * r, 0.019), (r, 0.022), (0.96 * r, 0.023), (0.62 * r, 0.009)];
    m.part("rim").lathe(&profile, glaze);
    m.top([0.0, 0.0], [0.42 * r, 0.42 * r], 0.0095);
}

pub(super) fn bowl(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (r, h) = (0.085 * vary(rng, 0.12), 0.07 * vary(rng, 0.1));
    let glaze = paint.glazed();
    m.part("outside")
        .lathe(&[(0.0, 0.0), (0.45 * r, 0.0), (0.5 * r, 0.08 * h), (0.85 * r, 0.5 * h), (r, h), (0.94 * r, h)], glaze);
    m.part("inside")
        .lathe(&[(0.94 * r, h), (0.78 * r, 0.5 * h), (0.4 * r, 0.15 * h), (0.0, 0.13 * h)], glaze.in_color(ivory()));
}

pub(super) fn glass(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let k = vary(rng, 0.12);
    let clear = matt([0.80, 0.86, 0.88]).gleaming(0.25);
    m.part("foot").lathe(&[(0.0, 0.0), (0.034, 0.0), (0.034, 0.003), (0.006, 0.008)], clear);
    m.part("stem").rod([0.0, 0.0, 0.008], [0.0, 0.0, 0.075], 0.004, clear);
    m.part("cup").lathe(&[(0.0, 0.075), (0.026, 0.088), (0.036, 0.115), (0.033, 0.155), (0.031, 0.155)], clear);
    m.part("drink").lathe(&[(0.0335, 0.130), (0.0, 0.130)], paint.glazed());
    m.scale(k);
}

pub(super) fn jar(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (r, h) = (0.045 * vary(rng, 0.15), 0.11 * vary(rng, 0.2));
    let body = [(0.0, 0.0), (0.95 * r, 0.0), (r, 0.008), (r, 0.85 * h), (0.8 * r, h), (0.0, h)];
    m.part("body").lathe(&body, paint.matt().gleaming(0.2));
    m.part("lid").lathe(&[(0.86 * r, h - 0.002), (0.86 * r, h + 0.018), (0.0, h + 0.018)], matt([0.85, 0.80, 0.72]));
    let print = Pattern::Stripes { other: paint.albedo(), across: DVec3::Z * 30.0 };
    m.part("label").lathe(&[(1.008 * r, 0.22 * h), (1.008 * r, 0.65 * h)], Material::matt(ivory()).with(print));
    m.top([0.0, 0.0], [0.6 * r, 0.6 * r], h + 0.0185);
}

pub(super) fn pot(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let k = vary(rng, 0.12);
    let enamel = paint.matt().gleaming(0.2);
    m.part("body").lathe(&[(0.0, 0.0), (0.10, 0.0), (0.108, 0.010), (0.11, 0.11), (0.105, 0.11)], enamel);
    let lid = enamel.in_color(enamel.albedo * 0.7 + 0.1);
    m.part("lid").lathe(&[(0.107, 0.112), (0.104, 0.120), (0.05, 0.132), (0.0, 0.134)], lid);
    m.add(Shape::sphere(0.016), [0.0, 0.0, 0.146], matt([0.15; 3]));
    m.part("handles");
    for side in [-1.0, 1.0] {
        let turn = DMat3::from_rotation_z(if side > 0.0 { 0.0 } else { PI });
        let ring = Shape::Ring { major: 0.028, minor: 0.006, arc: 1.5 };
        m.add_turned(ring, [side * 0.108, 0.0, 0.085], turn, matt([0.15; 3]));
    }
    m.scale(k);
}

pub(super) fn pan(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let k = vary(rng, 0.1);
    let iron = matt([0.17, 0.17, 0.18]).gleaming(0.12);
    let profile = [(0.0, 0.0), (0.095, 0.0), (0.125, 0.045), (0.121, 0.045), (0.092, 0.006), (0.0, 0.006)];
    m.part("body").turn(&profile, [-0.06, 0.0, 0.0], iron);
    m.part("handle").rod([0.06, 0.0, 0.040], [0.235, 0.0, 0.062], 0.011, paint.matt());
    m.scale(k);
}

pub(super) fn cutting_board(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (w, d) = (0.34 * vary(rng, 0.1), 0.23 * vary(rng, 0.1));
    m.part("board").block([w, d, 0.02], 0.006, [0.0; 3], wood(vary(rng, 0.2)));
    m.part("stripe").block([0.025, d + 0.002, 0.022], 0.002, [0.42 * w, 0.0, 0.0], paint.matt());
    m.top([-0.05 * w, 0.0], [0.40 * w, 0.47 * d], 0.0205);
}

pub(super) fn knife(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let k = vary(rng, 0.15);
    m.part("blade").block([0.15, 0.024, 0.0025], 0.0005, [0.062, 0.0, 0.004], metal());
    m.part("handle").rod([-0.125, 0.0, 0.0085], [-0.012, 0.0, 0.0085], 0.0085, paint.matt());
    m.scale(k);
}

pub(super) fn fork(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let k = vary(rng, 0.1);
    m.part("handle").rod([-0.10, 0.0, 0.006], [0.03, 0.0, 0.006], 0.006, paint.matt());
    m.part("tines").block([0.018, 0.026, 0.003], 0.001, [0.043, 0.0, 0.005], metal());
    for j in 0..4 {
        let y = -0.0105 + 0.007 * f64::from(j);
        m.rod([0.05, y, 0.0065], [0.095, y, 0.0085], 0.0018, metal());
    }
    m.scale(k);
}

pub(super) fn dish_rack(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let wire = paint.matt().gleaming(0.15);
    let (w, d, h) = (0.17, 0.12, 0.11);
    m.part("frame");
    for (a, b) in [([-w, -d], [w, -d]), ([w, -d], [w, d]), ([w, d], [-w, d]), ([-w, d], [-w, -d])] {
        for z in [0.005, h] {
            m.rod([a[0], a[1], z], [b[0], b[1], z], 0.005, wire);
        }
        m.rod([a[0], a[1], 0.005], [a[0], a[1], h], 0.005, wire);
    }
    m.part("wires");
    for j in 0..7 {
        let x = -w + 2.0 * w * (f64::from(j) + 0.5) / 7.0;
        m.rod([x, -d, 0.012], [x, d, 0.012], 0.003, wire);
        m.rod([x, -d, 0.012], [x, -d, h], 0.003, wire);
    }
    let upright = tip(90.0);
    for j in 0..rng.random_range(2..=4) {
        let y = -0.06 + 0.04 * f64::from(j);
        let color = PAINTS[rng.random_range(0..PAINTS.len())].albedo();
        let profile = [(0.0, -0.004), (0.075, -0.002), (0.078, 0.0), (0.075, 0.003), (0.0, 0.001)];
        m.part("plate").turn_rotated(&profile, [0.0, y, 0.093], upright, Material::glazed(color));
    }
}

pub(super) fn tray(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (w, d) = (0.42 * vary(rng, 0.1), 0.30 * vary(rng, 0.1));
    m.part("base").block([w, d, 0.012], 0.004, [0.0; 3], paint.matt());
    m.part("rim").rim([w, d], [0.014, 0.034], 0.004, wood(0.8));
    m.top([0.0, 0.0], [0.5 * w - 0.016, 0.5 * d - 0.016], 0.0125);
}
