//! More things for table tops and kitchen counters, with thin structures, contents and flat tops to put others on.

use crate::things::catalogue::{Class, Naming, Place, ivory, metal, tip, vary, wood};
use crate::things::material::{Material, PAINTS, Paint, Pattern, albedo};
use crate::things::model::{Model, z_towards};
use crate::things::shape::Shape;
use glam::{DMat3, DVec3};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use std::f64::consts::{PI, TAU};

const ANY: &[usize] = &[0, 1, 2, 3, 4, 5, 6, 7, 8, 9];
const VIVID: &[usize] = &[0, 1, 2, 3, 4, 5, 6, 7];

const fn class(name: &'static str, paints: &'static [usize], build: fn(&Paint, &mut ChaCha8Rng) -> Model) -> Class {
    Class { name, naming: Naming::Colored, place: Place::Table, paints, build }
}

/// What stands on tables, counters and shelves besides the catalogue's.
pub const PROPS: &[Class] = &[
    class("plate", ANY, plate),
    class("bowl", ANY, bowl),
    class("glass", VIVID, glass),
    class("jar", VIVID, jar),
    class("pot", ANY, pot),
    class("pan", ANY, pan),
    class("cutting board", VIVID, cutting_board),
    class("knife", VIVID, knife),
    class("fork", VIVID, fork),
    class("dish rack", ANY, dish_rack),
    class("vase", ANY, vase),
    class("puzzle cube", VIVID, puzzle_cube),
    class("toy rocket", VIVID, toy_rocket),
    Class {
        name: "row of books",
        naming: Naming::Of("row of", "books"),
        place: Place::Table,
        paints: VIVID,
        build: row_of_books,
    },
    class("book", VIVID, book),
    class("tray", ANY, tray),
    class("headphones", ANY, headphones),
    class("ball", VIVID, ball),
];

fn plate(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let r = 0.12 * vary(rng, 0.12);
    let glaze = Material::glazed(paint.albedo());
    let flat = m.part("well");
    m.turn(flat, &[(0.62 * r, 0.009), (0.0, 0.009)], [0.0; 3], Material { albedo: glaze.albedo * 0.6 + 0.3, ..glaze });
    let rim = m.part("rim");
    let profile = [(0.0, 0.0), (0.6 * r, 0.0), (0.98 * r, 0.019), (r, 0.022), (0.96 * r, 0.023), (0.62 * r, 0.009)];
    m.turn(rim, &profile, [0.0; 3], glaze);
    m.top([0.0, 0.0], [0.42 * r, 0.42 * r], 0.0095);
    m
}

fn bowl(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let (r, h) = (0.085 * vary(rng, 0.12), 0.07 * vary(rng, 0.1));
    let glaze = Material::glazed(paint.albedo());
    let body = m.part("outside");
    m.turn(
        body,
        &[(0.0, 0.0), (0.45 * r, 0.0), (0.5 * r, 0.08 * h), (0.85 * r, 0.5 * h), (r, h), (0.94 * r, h)],
        [0.0; 3],
        glaze,
    );
    let inside = m.part("inside");
    m.turn(
        inside,
        &[(0.94 * r, h), (0.78 * r, 0.5 * h), (0.4 * r, 0.15 * h), (0.0, 0.13 * h)],
        [0.0; 3],
        Material { albedo: ivory(), ..glaze },
    );
    m
}

fn glass(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let k = vary(rng, 0.12);
    let clear = Material { specular: 0.25, ..Material::matt(albedo([0.80, 0.86, 0.88])) };
    let foot = m.part("foot");
    m.turn(foot, &[(0.0, 0.0), (0.034, 0.0), (0.034, 0.003), (0.006, 0.008)], [0.0; 3], clear);
    let stem = m.part("stem");
    m.rod(stem, [0.0, 0.0, 0.008], [0.0, 0.0, 0.075], 0.004, clear);
    let cup = m.part("cup");
    m.turn(cup, &[(0.0, 0.075), (0.026, 0.088), (0.036, 0.115), (0.033, 0.155), (0.031, 0.155)], [0.0; 3], clear);
    let drink = m.part("drink");
    m.turn(drink, &[(0.0335, 0.130), (0.0, 0.130)], [0.0; 3], Material::glazed(paint.albedo()));
    m.scaled(k)
}

fn jar(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let (r, h) = (0.045 * vary(rng, 0.15), 0.11 * vary(rng, 0.2));
    let body = m.part("body");
    m.turn(body, &[(0.0, 0.0), (0.95 * r, 0.0), (r, 0.008), (r, 0.85 * h), (0.8 * r, h), (0.0, h)], [0.0; 3], {
        Material { specular: 0.2, ..Material::matt(paint.albedo()) }
    });
    let lid = m.part("lid");
    m.turn(
        lid,
        &[(0.86 * r, h - 0.002), (0.86 * r, h + 0.018), (0.0, h + 0.018)],
        [0.0; 3],
        Material::matt(albedo([0.85, 0.80, 0.72])),
    );
    let label = m.part("label");
    m.turn(label, &[(1.008 * r, 0.22 * h), (1.008 * r, 0.65 * h)], [0.0; 3], {
        Material::matt(ivory()).with(Pattern::Stripes { other: paint.albedo(), across: DVec3::Z * 30.0 })
    });
    m.top([0.0, 0.0], [0.6 * r, 0.6 * r], h + 0.0185);
    m
}

fn pot(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let k = vary(rng, 0.12);
    let enamel = Material { specular: 0.2, ..Material::matt(paint.albedo()) };
    let body = m.part("body");
    m.turn(body, &[(0.0, 0.0), (0.10, 0.0), (0.108, 0.010), (0.11, 0.11), (0.105, 0.11)], [0.0; 3], enamel);
    let lid = m.part("lid");
    m.turn(lid, &[(0.107, 0.112), (0.104, 0.120), (0.05, 0.132), (0.0, 0.134)], [0.0; 3], {
        Material { albedo: enamel.albedo * 0.7 + 0.1, ..enamel }
    });
    m.add(lid, Shape::sphere(0.016), [0.0, 0.0, 0.146], Material::matt(albedo([0.15; 3])));
    let handles = m.part("handles");
    for side in [-1.0, 1.0] {
        let turn = DMat3::from_rotation_z(if side > 0.0 { 0.0 } else { PI });
        let ring = Shape::Ring { major: 0.028, minor: 0.006, arc: 1.5 };
        m.add_turned(handles, ring, [side * 0.108, 0.0, 0.085], turn, Material::matt(albedo([0.15; 3])));
    }
    m.scaled(k)
}

fn pan(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let k = vary(rng, 0.1);
    let iron = Material { specular: 0.12, ..Material::matt(albedo([0.17, 0.17, 0.18])) };
    let body = m.part("body");
    let profile = [(0.0, 0.0), (0.095, 0.0), (0.125, 0.045), (0.121, 0.045), (0.092, 0.006), (0.0, 0.006)];
    m.turn(body, &profile, [-0.06, 0.0, 0.0], iron);
    let handle = m.part("handle");
    m.rod(handle, [0.06, 0.0, 0.040], [0.235, 0.0, 0.062], 0.011, Material::matt(paint.albedo()));
    m.scaled(k)
}

fn cutting_board(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let (w, d) = (0.34 * vary(rng, 0.1), 0.23 * vary(rng, 0.1));
    let board = m.part("board");
    m.block(board, [w, d, 0.02], 0.006, [0.0; 3], wood(vary(rng, 0.2)));
    let edge = m.part("stripe");
    m.block(edge, [0.025, d + 0.002, 0.022], 0.002, [0.42 * w, 0.0, 0.0], Material::matt(paint.albedo()));
    m.top([-0.05 * w, 0.0], [0.40 * w, 0.47 * d], 0.0205);
    m
}

fn knife(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let k = vary(rng, 0.15);
    let blade = m.part("blade");
    m.block(blade, [0.15, 0.024, 0.0025], 0.0005, [0.062, 0.0, 0.004], metal());
    let grip = m.part("handle");
    m.rod(grip, [-0.125, 0.0, 0.0085], [-0.012, 0.0, 0.0085], 0.0085, Material::matt(paint.albedo()));
    m.scaled(k)
}

fn fork(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let k = vary(rng, 0.1);
    let grip = m.part("handle");
    m.rod(grip, [-0.10, 0.0, 0.006], [0.03, 0.0, 0.006], 0.006, Material::matt(paint.albedo()));
    let tines = m.part("tines");
    m.block(tines, [0.018, 0.026, 0.003], 0.001, [0.043, 0.0, 0.005], metal());
    for j in 0..4 {
        let y = -0.0105 + 0.007 * f64::from(j);
        m.rod(tines, [0.05, y, 0.0065], [0.095, y, 0.0085], 0.0018, metal());
    }
    m.scaled(k)
}

fn dish_rack(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let wire = Material { specular: 0.15, ..Material::matt(paint.albedo()) };
    let (w, d, h) = (0.17, 0.12, 0.11);
    let frame = m.part("frame");
    for (a, b) in [([-w, -d], [w, -d]), ([w, -d], [w, d]), ([w, d], [-w, d]), ([-w, d], [-w, -d])] {
        for z in [0.005, h] {
            m.rod(frame, [a[0], a[1], z], [b[0], b[1], z], 0.005, wire);
        }
        m.rod(frame, [a[0], a[1], 0.005], [a[0], a[1], h], 0.005, wire);
    }
    let wires = m.part("wires");
    for j in 0..7 {
        let x = -w + 2.0 * w * (f64::from(j) + 0.5) / 7.0;
        m.rod(wires, [x, -d, 0.012], [x, d, 0.012], 0.003, wire);
        m.rod(wires, [x, -d, 0.012], [x, -d, h], 0.003, wire);
    }
    let upright = tip(90.0);
    for j in 0..rng.random_range(2..=4) {
        let plate = m.part("plate");
        let y = -0.06 + 0.04 * f64::from(j);
        let color = PAINTS[rng.random_range(0..PAINTS.len())].albedo();
        let profile = [(0.0, -0.004), (0.075, -0.002), (0.078, 0.0), (0.075, 0.003), (0.0, 0.001)];
        m.turn_rotated(plate, &profile, [0.0, y, 0.093], upright, Material::glazed(color));
    }
    m
}

fn vase(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let k = vary(rng, 0.12);
    let body = m.part("vase");
    let profile = [
        (0.0, 0.0),
        (0.032, 0.0),
        (0.048, 0.045),
        (0.040, 0.09),
        (0.020, 0.125),
        (0.026, 0.145),
        (0.022, 0.145),
        (0.016, 0.125),
    ];
    m.turn(body, &profile, [0.0; 3], Material::glazed(paint.albedo()));
    let stems = m.part("stems");
    let flowers = m.part("flowers");
    let start = rng.random::<f64>() * TAU;
    let petals = PAINTS[[0, 3, 5, 6][rng.random_range(0..4)]].albedo();
    for j in 0..5 {
        let a = start + TAU * f64::from(j) / 5.0;
        let out = 0.05 + 0.012 * f64::from(j % 2);
        let head = [out * a.cos(), out * a.sin(), 0.25 + 0.02 * f64::from(j % 3)];
        m.rod(stems, [0.0, 0.0, 0.10], head, 0.003, Material::matt(albedo([0.25, 0.50, 0.22])));
        m.add_turned(
            flowers,
            Shape::Ellipsoid { radii: DVec3::new(0.026, 0.026, 0.012) },
            head,
            z_towards(DVec3::new(a.cos(), a.sin(), 1.5)),
            Material::matt(petals),
        );
        m.add(flowers, Shape::sphere(0.010), [head[0], head[1], head[2] + 0.008], Material::matt(PAINTS[3].albedo()));
    }
    m.scaled(k)
}

fn puzzle_cube(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let s = 0.075 * vary(rng, 0.15);
    let first = PAINTS.iter().position(|p| p.name == paint.name).unwrap_or(0);
    // Three layers of which the top one is turned.
    let twist = 0.5 * rng.random::<f64>();
    for (k, name) in ["bottom layer", "middle layer", "top layer"].into_iter().enumerate() {
        let layer = m.part(name);
        let half = DVec3::new(0.5 * s, 0.5 * s, s / 6.0 - 0.0005);
        let turn = DMat3::from_rotation_z(if k == 2 { twist } else { 0.0 });
        let other = PAINTS[(first + 2 * k + 2) % 8].albedo();
        let stickers = Material::glazed(paint.albedo()).with(Pattern::Checks { other, size: s / 3.0 });
        let z = s * (k as f64 + 0.5) / 3.0;
        m.add_turned(layer, Shape::Block { half, round: 0.002 }, [0.0, 0.0, z], turn, stickers);
    }
    m
}

fn toy_rocket(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let skin = Material { specular: 0.15, ..Material::matt(paint.albedo()) };
    let body = m.part("body");
    m.turn(body, &[(0.0, 0.03), (0.03, 0.03), (0.038, 0.09), (0.036, 0.15), (0.0, 0.15)], [0.0; 3], skin);
    let nose = m.part("nose");
    m.turn(nose, &[(0.036, 0.15), (0.022, 0.195), (0.0, 0.225)], [0.0; 3], Material::glazed(ivory()));
    let fins = m.part("fins");
    for j in 0..3 {
        let a = TAU * f64::from(j) / 3.0;
        let turn = DMat3::from_rotation_z(a);
        let half = DVec3::new(0.022, 0.004, 0.035);
        let at = turn * DVec3::new(0.045, 0.0, 0.0355);
        let red = Material::glazed(PAINTS[(j as usize * 3 + 1) % 8].albedo());
        m.add_turned(fins, Shape::Block { half, round: 0.003 }, at.to_array(), turn, red);
    }
    let window = m.part("window");
    m.add(window, Shape::Ellipsoid { radii: DVec3::new(0.014, 0.008, 0.014) }, [0.0, -0.033, 0.125], metal());
    m.scaled(vary(rng, 0.15))
}

fn row_of_books(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
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
        let part = m.part("book");
        let half = 0.5 * DVec3::from_array(size);
        let tone = 0.75 + 0.5 * rng.random::<f64>();
        let cover = (paint.albedo() * tone).min(DVec3::splat(0.9));
        m.block(part, size, 0.002, [at + half.x, 0.0, 0.0], Material::matt(cover));
        at += size[0] + 0.0005;
    }
    m
}

fn book(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let size = [0.21 * vary(rng, 0.15), 0.15 * vary(rng, 0.15), 0.03 * vary(rng, 0.4)];
    let half = 0.5 * DVec3::from_array(size);
    let cover = m.part("cover");
    let pages = Pattern::Pages { other: ivory(), inner: half - DVec3::new(0.004, 0.004, 0.005) };
    m.block(cover, size, 0.002, [0.0; 3], Material::matt(paint.albedo()).with(pages));
    let title = m.part("title");
    m.block(title, [0.5 * size[0], 0.25 * size[1], 0.001], 0.0, [0.0, 0.2 * size[1], size[2]], Material::matt(ivory()));
    m.top([0.0, -0.05 * size[1]], [0.45 * size[0], 0.4 * size[1]], size[2] + 0.0015);
    m
}

fn tray(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let (w, d) = (0.42 * vary(rng, 0.1), 0.30 * vary(rng, 0.1));
    let base = m.part("base");
    m.block(base, [w, d, 0.012], 0.004, [0.0; 3], Material::matt(paint.albedo()));
    let rim = m.part("rim");
    for (x, y, sx, sy) in [(0.0, 0.5, w, 0.014), (0.0, -0.5, w, 0.014), (0.5, 0.0, 0.014, d), (-0.5, 0.0, 0.014, d)] {
        m.block(rim, [sx, sy, 0.034], 0.004, [x * (w - 0.014), y * (d - 0.014), 0.0], wood(0.8));
    }
    m.top([0.0, 0.0], [0.5 * w - 0.016, 0.5 * d - 0.016], 0.0125);
    m
}

fn headphones(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let band = m.part("band");
    let shell = Material::glazed(paint.albedo());
    let arch = Shape::Ring { major: 0.075, minor: 0.007, arc: 1.57 };
    m.add_turned(band, arch, [0.0, 0.0, 0.040], tip(90.0) * DMat3::from_rotation_z(PI / 2.0), shell);
    let cups = m.part("cups");
    for side in [-1.0, 1.0] {
        let radii = DVec3::new(0.020, 0.034, 0.040);
        m.add(cups, Shape::Ellipsoid { radii }, [side * 0.075, 0.0, 0.040], Material::matt(albedo([0.18; 3])));
    }
    m.scaled(vary(rng, 0.1))
}

fn ball(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let r = 0.05 * vary(rng, 0.25);
    let lower = m.part("lower half");
    let half: Vec<(f64, f64)> =
        (0..=6).map(|k| f64::from(k) * PI / 12.0).map(|a| (r * a.sin(), r - r * a.cos())).collect();
    m.turn(lower, &half, [0.0; 3], Material::glazed(paint.albedo()));
    let upper = m.part("upper half");
    let half: Vec<(f64, f64)> =
        (6..=12).map(|k| f64::from(k) * PI / 12.0).map(|a| (r * a.sin(), r - r * a.cos())).collect();
    m.turn(upper, &half, [0.0; 3], Material::glazed(paint.albedo() * 0.5 + ivory() * 0.5));
    m
}
