//! Tools, as they lie on a bench: along x with the grip at -x, most of them a few millimetres thick somewhere.

use crate::random::vary;
use crate::things::class::{ivory, metal, tip, wood};
use crate::things::material::{Material, Paint, Pattern, albedo, glazed, matt};
use crate::things::model::{Model, profile, z_towards};
use crate::things::shape::Shape;
use glam::{DMat3, DVec3};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use std::f64::consts::PI;

/// Steel that is darker than what other things are made of.
fn steel() -> Material {
    matt([0.50, 0.50, 0.53]).gleaming(0.2)
}

/// Black rubber or plastic.
fn rubber() -> Material {
    matt([0.20, 0.19, 0.20]).gleaming(0.05)
}

/// Adds a solid of revolution about x, which begins at `from`.
fn along_x(m: &mut Model, profile: &[(f64, f64)], from: [f64; 3], material: Material) {
    m.turn_rotated(profile, from, z_towards(DVec3::X), material);
}

/// Adds a turned grip from x = -0.105 to 0, as of screwdrivers and chisels, with its axis `r` above the ground.
fn grip(m: &mut Model, r: f64, material: Material) {
    let profile = profile(
        [0.0, 0.7 * r, r, 0.85 * r, r, 0.9 * r, 0.55 * r, 0.0],
        [0.0, 0.0, 0.012, 0.040, 0.070, 0.092, 0.105, 0.105],
    );
    along_x(m, &profile, [-0.105, 0.0, r], material);
}

/// Adds a block whose lower edge at the end of +x lies on the ground: its end at x = 0 is `z` above it.
fn leaning(m: &mut Model, [length, width, thickness]: [f64; 3], z: f64, material: Material) {
    let lean = ((z - 0.5 * thickness) / length).asin();
    let shape = Shape::block([0.5 * length, 0.5 * width, 0.5 * thickness], 0.0);
    let centre = [0.5 * length * lean.cos(), 0.0, z - 0.5 * length * lean.sin()];
    m.add_turned(shape, centre, DMat3::from_rotation_y(lean), material);
}

pub(super) fn screwdriver(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (r, length) = (0.0145 * vary(rng, 0.15), 0.11 * vary(rng, 0.25));
    m.part("handle");
    grip(m, r, paint.glazed());
    m.part("shaft").rod([-0.004, 0.0, r], [length, 0.0, 0.0036], 0.0035, metal());
}

pub(super) fn chisel(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let width = 0.020 * vary(rng, 0.4);
    m.part("handle");
    grip(m, 0.015, paint.glazed());
    m.part("blade");
    leaning(m, [0.12 * vary(rng, 0.12), width, 0.004], 0.015, metal());
    along_x(m, &[(0.0, 0.0), (0.010, 0.0), (0.007, 0.022), (0.0, 0.022)], [-0.004, 0.0, 0.015], metal());
}

pub(super) fn file(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    m.part("handle");
    grip(m, 0.013, paint.matt());
    let teeth = Pattern::Stripes { other: albedo([0.62, 0.62, 0.64]), across: DVec3::new(70.0, 40.0, 0.0) };
    m.part("blade");
    leaning(m, [0.17 * vary(rng, 0.12), 0.020, 0.005], 0.013, steel().with(teeth));
}

pub(super) fn hammer(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (length, r) = (0.17 * vary(rng, 0.12), 0.0165);
    m.part("handle").rod([-0.12, 0.0, 0.015], [length, 0.0, r], 0.0095, wood(vary(rng, 0.15)));
    m.rod([-0.12, 0.0, 0.0146], [-0.02, 0.0, 0.0146], 0.0145, paint.matt());
    let face = [(0.0, -0.058), (r, -0.058), (r, -0.035), (0.011, -0.028), (0.012, 0.02), (0.0, 0.02)];
    m.part("head").turn_rotated(&face, [length, 0.0, r], z_towards(DVec3::Y), steel());
    for side in [-1.0, 1.0] {
        let claw = Shape::block([0.006, 0.024, 0.005], 0.002);
        let turn = DMat3::from_rotation_z(-0.35 - 0.12 * side);
        m.add_turned(claw, [length + 0.001 + 0.008 * side, 0.038, r], turn, steel());
    }
}

pub(super) fn mallet(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (length, r) = (0.15 * vary(rng, 0.1), 0.030 * vary(rng, 0.12));
    m.part("handle").rod([-0.13, 0.0, 0.0125], [length, 0.0, r], 0.012, wood(vary(rng, 0.2)));
    let head = profile([0.0, 0.94 * r, r, r, 0.94 * r, 0.0], [-0.052, -0.052, -0.046, 0.046, 0.052, 0.052]);
    m.part("head").turn_rotated(&head, [length, 0.0, r], z_towards(DVec3::Y), paint.matt());
}

pub(super) fn saw(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let length = 0.20 * vary(rng, 0.1);
    let lacquer = paint.matt();
    m.part("handle").add(Shape::Ring { major: 0.034, minor: 0.0115, arc: PI }, [-0.045, 0.0, 0.0115], lacquer);
    m.add(Shape::block([0.016, 0.040, 0.0115], 0.005), [-0.002, 0.0, 0.0115], lacquer);
    m.part("blade");
    leaning(m, [length, 0.075, 0.0016], 0.0115, metal());
    let lean = (0.0107 / length).asin();
    let back = Shape::block([0.5 * length - 0.01, 0.006, 0.003], 0.0);
    let at = [0.5 * length - 0.01, 0.036, 0.0115 + 0.0022 - 0.5 * length * lean.sin()];
    m.part("back").add_turned(back, at, DMat3::from_rotation_y(lean), rubber());
}

pub(super) fn pliers(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (open, r) = (0.024 * vary(rng, 0.25), 0.0075);
    m.part("handles");
    for side in [-1.0, 1.0] {
        m.rod([-0.115, side * open, r], [-0.035, side * 0.016, r], r, paint.glazed());
        m.rod([-0.035, side * 0.016, r], [0.0, side * 0.006, r], 0.006, paint.glazed());
    }
    m.part("jaws");
    for side in [-1.0, 1.0] {
        let jaw = Shape::block([0.028, 0.0055, 0.006], 0.002);
        m.add_turned(jaw, [0.028, side * 0.0068, r], DMat3::from_rotation_z(-0.09 * side), steel());
    }
    m.turn(&[(0.0, 0.0), (0.013, 0.0), (0.013, 0.0145), (0.0, 0.0155)], [0.0, 0.0, 0.0], steel());
}

pub(super) fn scissors(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let length = 0.10 * vary(rng, 0.15);
    m.part("handles");
    for side in [-1.0, 1.0] {
        let ring = Shape::Ring { major: 0.020, minor: 0.0055, arc: PI };
        m.add(ring, [-0.075, side * 0.0262, 0.0055], paint.glazed());
        m.rod([-0.057, side * 0.021, 0.0055], [-0.010, side * 0.004, 0.0055], 0.005, paint.glazed());
    }
    m.part("blades");
    for side in [-1.0, 1.0] {
        let blade = Shape::block([0.5 * length, 0.006, 0.001], 0.0);
        let (turn, z) = (DMat3::from_rotation_z(-0.07 * side), 0.0055 + 0.0012 * side);
        m.add_turned(blade, [0.5 * length - 0.014, side * -0.002, z], turn, metal());
    }
    m.turn(&[(0.0, 0.002), (0.005, 0.002), (0.005, 0.010), (0.0, 0.0105)], [0.0, 0.0, 0.0], steel());
}

pub(super) fn wrench(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let length = 0.16 * vary(rng, 0.25);
    let half = 0.5 * length;
    m.part("shank").block([length - 0.02, 0.014, 0.007], 0.003, [0.0; 3], paint.glazed());
    m.part("ring").add(Shape::Ring { major: 0.011, minor: 0.0045, arc: PI }, [-half, 0.0, 0.0045], metal());
    // Open at +x.
    let jaw = Shape::Ring { major: 0.013, minor: 0.0055, arc: 2.35 };
    m.part("jaw").add_turned(jaw, [half, 0.0, 0.0055], DMat3::from_rotation_z(PI), metal());
}

pub(super) fn paintbrush(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (w, t) = (0.045 * vary(rng, 0.35), 0.014);
    let profile = profile([0.0, 0.005, 0.0072, 0.006, 0.0075, 0.0], [0.0, 0.0, 0.05, 0.09, 0.12, 0.12]);
    m.part("handle");
    along_x(m, &profile, [-0.12, 0.0, 0.0073], paint.glazed());
    m.add(Shape::block([0.014, 0.40 * w, 0.005], 0.003), [-0.008, 0.0, 0.0073], paint.glazed());
    m.part("ferrule").block([0.032, w, t], 0.002, [0.020, 0.0, 0.0], metal());
    let hair = matt([0.74, 0.62, 0.42]);
    let dark = Pattern::Stripes { other: hair.albedo * 0.75, across: DVec3::new(0.0, 160.0, 0.0) };
    m.part("bristles").block([0.055, 0.96 * w, 0.8 * t], 0.004, [0.060, 0.0, 0.1 * t], hair.with(dark));
}

pub(super) fn putty_knife(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let w = 0.06 * vary(rng, 0.3);
    m.part("handle");
    grip(m, 0.013, paint.glazed());
    m.part("blade");
    leaning(m, [0.095, w, 0.0015], 0.013, metal());
    m.add(Shape::block([0.012, 0.009, 0.004], 0.002), [0.004, 0.0, 0.013], metal());
}

pub(super) fn utility_knife(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    m.part("handle").block([0.135 * vary(rng, 0.1), 0.030, 0.018], 0.006, [-0.06, 0.0, 0.0], paint.matt());
    m.part("slider").block([0.022, 0.008, 0.004], 0.001, [-0.045, 0.0, 0.0175], rubber());
    m.part("blade").add(Shape::block([0.022, 0.009, 0.0008], 0.0), [0.022, 0.0, 0.009], metal());
}

pub(super) fn hex_key(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (length, r) = (0.11 * vary(rng, 0.25), 0.0034 * vary(rng, 0.25));
    m.part("long arm").rod([0.0, 0.0, r], [length, 0.0, r], r, paint.glazed());
    m.part("short arm").rod([0.0, 0.0, r], [0.0, 0.032, r], 1.02 * r, metal());
}

pub(super) fn ruler(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let length = 0.28 * vary(rng, 0.12);
    m.part("ruler").block([length, 0.030, 0.0025], 0.0005, [0.0; 3], paint.matt());
    let marks = Pattern::Stripes { other: albedo([0.15; 3]), across: DVec3::new(100.0, 0.0, 0.0) };
    m.part("scale").block(
        [length - 0.01, 0.009, 0.0006],
        0.0,
        [0.0, 0.009, 0.0024],
        Material::matt(ivory()).with(marks),
    );
}

pub(super) fn pencil(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (length, r) = (0.15 * vary(rng, 0.25), 0.0040);
    let body = [(0.0, 0.0), (r, 0.0), (r, length), (0.0, length)];
    m.part("body");
    along_x(m, &body, [-0.5 * length, 0.0, r], paint.glazed());
    m.part("tip");
    let point = [(r, 0.0), (0.0012, 0.016), (0.0, 0.018)];
    along_x(m, &point, [0.5 * length, 0.0, r], matt([0.80, 0.62, 0.42]));
    m.part("eraser");
    along_x(m, &[(0.0, 0.0), (r, 0.0), (r, 0.012)], [-0.5 * length - 0.012, 0.0, r], matt([0.86, 0.52, 0.50]));
}

pub(super) fn spirit_level(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let length = 0.27 * vary(rng, 0.1);
    m.part("body").block([length, 0.024, 0.048], 0.003, [0.0; 3], paint.matt());
    let fluid = matt([0.72, 0.86, 0.25]).gleaming(0.2).glowing(0.1);
    for x in [-0.36, 0.0, 0.36] {
        m.part("vial").add(Shape::block([0.016, 0.0125, 0.011], 0.003), [x * length, 0.0, 0.026], fluid);
    }
}

pub(super) fn tape_measure(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let s = vary(rng, 0.1);
    m.part("case").block([0.068 * s, 0.038 * s, 0.064 * s], 0.012, [0.0; 3], paint.matt());
    let disc = [(0.0, 0.0), (0.021 * s, 0.0), (0.021 * s, 0.001), (0.0, 0.001)];
    m.part("label").turn_rotated(&disc, [0.0, -0.019 * s, 0.034 * s], tip(90.0), Material::matt(ivory()));
    m.part("tape").block([0.026, 0.022 * s, 0.0012], 0.0, [0.046 * s, 0.0, 0.005], matt([0.92, 0.82, 0.30]));
    m.block([0.002, 0.022 * s, 0.012], 0.0, [0.046 * s + 0.013, 0.0, 0.0], metal());
}

pub(super) fn clamp(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (length, open) = (0.15 * vary(rng, 0.15), 0.075);
    let (z, round) = (0.010, 0.003);
    let iron = paint.matt();
    m.part("frame").add(Shape::block([0.5 * length, 0.009, z], round), [0.0, open, z], iron);
    for side in [-1.0, 1.0] {
        m.add(Shape::block([0.009, 0.5 * open + 0.009, z], round), [side * 0.5 * length, 0.5 * open, z], iron);
    }
    m.part("screw").rod([-0.5 * length - 0.06, 0.0, z], [0.5 * length - 0.055, 0.0, z], 0.0055, metal());
    along_x(m, &[(0.0, 0.0), (z, 0.0), (z, 0.008), (0.0, 0.008)], [0.5 * length - 0.056, 0.0, z], metal());
    let x = -0.5 * length - 0.052;
    m.part("bar").rod([x, -0.035, z], [x, 0.035, z], 0.0035, steel());
}

pub(super) fn power_drill(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let shell = paint.matt();
    m.part("battery").block([0.10, 0.062, 0.042], 0.008, [0.0; 3], rubber());
    let grip = Shape::block([0.020, 0.017, 0.062], 0.012);
    m.part("grip").add_turned(grip, [-0.006, 0.0, 0.095], DMat3::from_rotation_y(-0.10), rubber());
    let body = profile([0.0, 0.024, 0.030, 0.030, 0.022, 0.0], [0.0, 0.0, 0.012, 0.09, 0.125, 0.125]);
    m.part("body");
    along_x(m, &body, [-0.075, 0.0, 0.172], shell);
    m.part("chuck");
    along_x(m, &[(0.018, 0.0), (0.018, 0.018), (0.009, 0.036), (0.0, 0.036)], [0.050, 0.0, 0.172], rubber());
    m.part("bit").rod([0.08, 0.0, 0.172], [0.085 + 0.06 * vary(rng, 0.3), 0.0, 0.172], 0.003, metal());
}

/// A vise with its jaws towards -y, for the front edge of a bench.
pub(super) fn vise(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let iron = paint.matt();
    let open = 0.035 * vary(rng, 0.5);
    m.part("base").block([0.13, 0.13, 0.022], 0.004, [0.0, 0.05, 0.0], iron);
    m.block([0.075, 0.12, 0.07], 0.008, [0.0, 0.05, 0.02], iron);
    m.part("fixed jaw").block([0.14, 0.035, 0.06], 0.005, [0.0, 0.0175, 0.085], iron);
    m.block([0.14, 0.006, 0.024], 0.001, [0.0, -0.001, 0.119], metal());
    let y = -open;
    m.part("moving jaw").block([0.14, 0.03, 0.058], 0.005, [0.0, y - 0.022, 0.085], iron);
    m.block([0.05, open + 0.06, 0.04], 0.004, [0.0, 0.5 * (y - 0.03), 0.055], iron);
    m.block([0.14, 0.006, 0.024], 0.001, [0.0, y - 0.006, 0.119], metal());
    m.part("screw").rod([0.0, 0.03, 0.065], [0.0, y - 0.085, 0.065], 0.010, metal());
    let swing = 0.4 * (rng.random::<f64>() - 0.5);
    let reach = [0.06 * swing.cos(), 0.06 * swing.sin()];
    let y = y - 0.078;
    m.part("bar").rod([-reach[0], y, 0.065 - reach[1]], [reach[0], y, 0.065 + reach[1]], 0.005, steel());
}

pub(super) fn bolt(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let (length, r) = (0.055 * vary(rng, 0.3), 0.011);
    m.part("head");
    along_x(m, &[(0.0, 0.0), (r, 0.0), (r, 0.010), (0.0, 0.010)], [-0.010, 0.0, r], paint.glazed());
    m.part("shank").rod([0.0, 0.0, r], [length, 0.0, 0.0052], 0.005, metal());
    m.part("nut");
    along_x(m, &[(0.0, 0.0), (0.010, 0.0), (0.010, 0.009), (0.0, 0.009)], [0.5 * length, 0.0, 0.010], steel());
}

pub(super) fn light_bulb(m: &mut Model, paint: &Paint, rng: &mut ChaCha8Rng) {
    let r = 0.029 * vary(rng, 0.12);
    m.part("glass").add(Shape::ellipsoid([1.05 * r, r, r]), [0.02, 0.0, r], glazed(paint.srgb));
    along_x(m, &[(0.55 * r, 0.0), (0.75 * r, 0.02), (0.8 * r, 0.03)], [-0.025, 0.0, 0.92 * r], glazed(paint.srgb));
    let cap = [(0.0, 0.0), (0.006, 0.0), (0.55 * r, 0.006), (0.55 * r, 0.027), (0.0, 0.027)];
    m.part("cap");
    along_x(m, &cap, [-0.048, 0.0, 0.92 * r], metal());
}
