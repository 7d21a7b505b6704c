//! Other things for table tops: lamps, books, plants, what lies on desks.

use crate::random::vary;
use crate::things::class::{ivory, metal, tip};
use crate::things::material::{BLUE, GREEN, Material, PAINTS, Paint, Pattern, RED, YELLOW, albedo, glazed, matt};
use crate::things::model::{Model, profile, z_towards};
use crate::things::shape::Shape;
use glam::{DMat3, DVec3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use std::f64::consts::{PI, TAU};

pub(super) fn lamp(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let k = vary(rng, 0.08);
    m.part("base").lathe(
        &[(0.0, 0.0), (0.085, 0.0), (0.085, 0.014), (0.075, 0.022), (0.02, 0.034), (0.0, 0.034)],
        glazed([0.35, 0.27, 0.22]),
    );
    m.part("stem").rod([0.0, 0.0, 0.02], [0.0, 0.0, 0.30], 0.012, metal());
    let cloth = Material::matt(paint.albedo() * 0.9 + 0.05).glowing(0.25);
    m.part("shade").lathe(&[(0.128, 0.25), (0.085, 0.42), (0.081, 0.42), (0.124, 0.25), (0.128, 0.25)], cloth);
    m.part("bulb").add(Shape::sphere(0.032), [0.0, 0.0, 0.325], matt([1.0, 0.95, 0.8]).glowing(0.8));
    m.scale(k);
}

pub(super) fn laptop(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (w, d) = (0.35, 0.24);
    let shell = paint.matt().gleaming(0.08);
    let dark = if paint.name == "black" { albedo([0.42, 0.42, 0.45]) } else { albedo([0.25, 0.25, 0.28]) };
    let keys = Pattern::Keys { other: dark, half: [0.44 * w, 0.30 * d], above: 0.007 };
    m.part("keyboard").block([w, d, 0.02], 0.004, [0.0, 0.0, 0.0], shell.with(keys));
    let open = (105.0 + 15.0 * rng.random::<f64>()).to_radians();
    let up = DVec3::new(0.0, -open.cos(), open.sin());
    let lid = DMat3::from_cols(DVec3::X, up, DVec3::X.cross(up));
    let centre = DVec3::new(0.0, 0.5 * d - 0.006, 0.022) + up * (0.5 * d);
    m.part("screen").add_turned(Shape::block([0.5 * w, 0.5 * d, 0.006], 0.004), centre.to_array(), lid, shell);
    // z of the lid points to the user.
    let glass = glazed([0.36, 0.52, 0.72])
        .with(Pattern::Stripes { other: albedo([0.62, 0.76, 0.86]), across: DVec3::new(4.0, 5.0, 0.0) })
        .glowing(0.15);
    let front = centre + lid.z_axis * 0.0062;
    m.add_turned(Shape::block([0.46 * w, 0.44 * d, 0.0008], 0.0), front.to_array(), lid, glass);
}

pub(super) fn books(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let mut z = 0.0;
    let names = ["bottom book", "middle book", "top book"];
    for (k, name) in names.into_iter().enumerate() {
        let size = [0.25 - 0.02 * k as f64, 0.18 - 0.015 * k as f64, 0.036 * vary(rng, 0.2)];
        let half = 0.5 * DVec3::from_array(size);
        let shade = [0.7, 1.15, 0.9][k];
        let cover = Material::matt((paint.albedo() * shade + [0.0, 0.03, 0.0][k]).min(DVec3::splat(0.9)))
            .with(Pattern::Pages { other: ivory(), inner: half - DVec3::new(0.004, 0.004, 0.005) });
        let angle = 0.35 * (rng.random::<f64>() - 0.5);
        let block = Shape::Block { half, round: 0.002 };
        m.part(name).add_turned(block, [0.0, 0.0, z + half.z], DMat3::from_rotation_z(angle), cover);
        z += size[2] + 0.0005;
    }
    m.top([0.0, 0.0], [0.08, 0.05], z);
}

pub(super) fn row_of_books(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let count = rng.random_range(4..=7);
    let mut x = 0.0;
    let mut sizes = Vec::new();
    for _ in 0..count {
        let size = [0.028 * vary(rng, 0.35), 0.14 * vary(rng, 0.1), 0.20 * vary(rng, 0.15)];
        x += size[0] + 0.0005;
        sizes.push(size);
    }
    let mut at = -0.5 * x;
    for size in sizes {
        let half = 0.5 * DVec3::from_array(size);
        let tone = 0.75 + 0.5 * rng.random::<f64>();
        let cover = (paint.albedo() * tone).min(DVec3::splat(0.9));
        m.part("book").block(size, 0.002, [at + half.x, 0.0, 0.0], Material::matt(cover));
        at += size[0] + 0.0005;
    }
}

pub(super) fn book(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let size = [0.21 * vary(rng, 0.15), 0.15 * vary(rng, 0.15), 0.03 * vary(rng, 0.4)];
    let half = 0.5 * DVec3::from_array(size);
    let pages = Pattern::Pages { other: ivory(), inner: half - DVec3::new(0.004, 0.004, 0.005) };
    m.part("cover").block(size, 0.002, [0.0; 3], paint.matt().with(pages));
    let (title, at) = ([0.5 * size[0], 0.25 * size[1], 0.001], [0.0, 0.2 * size[1], size[2]]);
    m.part("title").block(title, 0.0, at, Material::matt(ivory()));
    m.top([0.0, -0.05 * size[1]], [0.45 * size[0], 0.4 * size[1]], size[2] + 0.0015);
}

pub(super) fn gift_box(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (w, h) = (0.17 * vary(rng, 0.1), 0.12 * vary(rng, 0.15));
    let paper = paint.matt().with(Pattern::Checks { other: paint.albedo() * 0.72 + 0.10, size: 0.045 });
    m.part("box").block([w, w, h], 0.003, [0.0; 3], paper);
    m.part("lid").block([w + 0.012, w + 0.012, 0.032], 0.003, [0.0, 0.0, h], Material::matt(paint.albedo() * 0.8));
    let silk = Material::glazed(if paint.name == "yellow" || paint.name == "orange" {
        albedo([0.75, 0.15, 0.15])
    } else {
        albedo([0.95, 0.83, 0.35])
    });
    let top = h + 0.032;
    m.part("ribbon").block([w + 0.016, 0.026, top + 0.002], 0.0, [0.0; 3], silk);
    m.block([0.026, w + 0.016, top + 0.002], 0.0, [0.0; 3], silk);
    for side in [-1.0, 1.0] {
        let lean = DMat3::from_rotation_y(side * 0.9);
        m.add_turned(Shape::ellipsoid([0.012, 0.016, 0.034]), [side * 0.026, 0.0, top + 0.022], lean, silk);
    }
}

pub(super) fn plant(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    m.part("pot").lathe(
        &[(0.0, 0.0), (0.050, 0.0), (0.066, 0.085), (0.074, 0.085), (0.074, 0.105), (0.066, 0.105), (0.062, 0.09)],
        paint.matt(),
    );
    m.part("soil").lathe(&[(0.063, 0.092), (0.0, 0.097)], matt([0.28, 0.19, 0.13]));
    m.part("leaves");
    let start = rng.random::<f64>() * TAU;
    for k in 0..11 {
        let t = f64::from(k);
        let azimuth = start + t * 2.4;
        let lean = 0.18 + 0.075 * t;
        let out = DVec3::new(azimuth.cos() * lean.sin(), azimuth.sin() * lean.sin(), lean.cos());
        let length = 0.10 - 0.003 * t;
        let centre = DVec3::new(0.0, 0.0, 0.10) + out * length;
        let green = albedo([0.22 + 0.015 * t, 0.50 + 0.012 * t, 0.20]);
        let leaf = Shape::ellipsoid([0.026, 0.007, length]);
        m.add_turned(leaf, centre.to_array(), z_towards(out), Material::matt(green));
    }
    m.scale(vary(rng, 0.08));
}

pub(super) fn vase(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let k = vary(rng, 0.12);
    let profile = profile(
        [0.0, 0.032, 0.048, 0.040, 0.020, 0.026, 0.022, 0.016],
        [0.0, 0.0, 0.045, 0.09, 0.125, 0.145, 0.145, 0.125],
    );
    m.part("vase").lathe(&profile, paint.glazed());
    m.part("stems");
    m.part("flowers");
    let start = rng.random::<f64>() * TAU;
    let petals = PAINTS[[0, 3, 5, 6][rng.random_range(0..4)]].albedo();
    for j in 0..5 {
        let a = start + TAU * f64::from(j) / 5.0;
        let out = 0.05 + 0.012 * f64::from(j % 2);
        let head = [out * a.cos(), out * a.sin(), 0.25 + 0.02 * f64::from(j % 3)];
        m.again("stems").rod([0.0, 0.0, 0.10], head, 0.003, matt([0.25, 0.50, 0.22]));
        let (flower, up) = (Shape::ellipsoid([0.026, 0.026, 0.012]), z_towards(DVec3::new(a.cos(), a.sin(), 1.5)));
        m.again("flowers").add_turned(flower, head, up, Material::matt(petals));
        m.add(Shape::sphere(0.010), [head[0], head[1], head[2] + 0.008], Material::matt(PAINTS[3].albedo()));
    }
    m.scale(k);
}

pub(super) fn candle(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    m.part("holder").lathe(
        &[(0.0, 0.0), (0.075, 0.0), (0.078, 0.010), (0.070, 0.014), (0.045, 0.008), (0.0, 0.008)],
        matt([0.80, 0.66, 0.34]).gleaming(0.2),
    );
    let h = 0.14 * vary(rng, 0.2);
    m.part("wax").lathe(
        &[(0.034, 0.008), (0.034, h), (0.031, h + 0.004), (0.024, h), (0.0, h - 0.004)],
        paint.matt().gleaming(0.06),
    );
    m.part("flame").rod([0.0, 0.0, h - 0.004], [0.0, 0.0, h + 0.010], 0.0025, matt([0.1; 3]));
    m.add(Shape::ellipsoid([0.011, 0.011, 0.025]), [0.0, 0.0, h + 0.030], matt([1.0, 0.80, 0.30]).glowing(1.0));
}

pub(super) fn clock(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (r, y) = (0.075, 0.028);
    let forward = tip(90.0);
    let lacquer = paint.matt().gleaming(0.12);
    let case = [(0.0, -y), (0.9 * r, -y), (r, -0.6 * y), (r, y), (0.88 * r, y + 0.004), (0.88 * r, y - 0.004)];
    let face = [(0.88 * r, y - 0.003), (0.0, y - 0.003)];
    m.part("case").turn_rotated(&case, [0.0, 0.0, 0.093], forward, lacquer);
    m.part("face").turn_rotated(&face, [0.0, 0.0, 0.093], forward, Material::matt(ivory()));
    m.part("hands");
    let ink = matt([0.15, 0.15, 0.18]);
    let time = rng.random::<f64>() * TAU;
    for (length, angle) in [(0.56, time), (0.40, time * 7.0 + 1.0)] {
        let tip_at = [length * r * angle.sin(), -y - 0.001, 0.093 + length * r * angle.cos()];
        m.rod([0.0, -y - 0.001, 0.093], tip_at, 0.004, ink);
    }
    m.part("feet");
    for side in [-1.0, 1.0] {
        m.rod([side * 0.045, 0.0, 0.040], [side * 0.058, 0.0, 0.010], 0.010, metal());
    }
    m.scale(1.1 * vary(rng, 0.08));
}

pub(super) fn pencil_holder(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (r, h) = (0.050, 0.115);
    let material = paint.matt().with(Pattern::Stripes { other: paint.albedo() * 0.6 + 0.15, across: DVec3::Z * 20.0 });
    m.part("holder").lathe(&[(0.0, 0.0), (r, 0.0), (r, h), (r - 0.005, h), (r - 0.005, 0.006), (0.0, 0.006)], material);
    let start = rng.random::<f64>() * TAU;
    for k in 0..4 {
        let a = start + TAU * f64::from(k) / 4.0;
        let color = PAINTS[[RED, YELLOW, BLUE, GREEN][k as usize]].albedo();
        let low = [-0.020 * a.cos(), -0.020 * a.sin(), 0.018];
        let high = [0.046 * a.cos(), 0.046 * a.sin(), 0.195 + 0.008 * f64::from(k)];
        m.part("pencil").rod(low, high, 0.0085, Material::glazed(color));
    }
    m.scale(vary(rng, 0.08));
}

pub(super) fn headphones(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let shell = paint.glazed();
    let arch = Shape::Ring { major: 0.075, minor: 0.007, arc: 1.57 };
    m.part("band").add_turned(arch, [0.0, 0.0, 0.040], tip(90.0) * DMat3::from_rotation_z(PI / 2.0), shell);
    m.part("cups");
    for side in [-1.0, 1.0] {
        let radii = DVec3::new(0.020, 0.034, 0.040);
        m.add(Shape::Ellipsoid { radii }, [side * 0.075, 0.0, 0.040], matt([0.18; 3]));
    }
    m.scale(vary(rng, 0.1));
}
