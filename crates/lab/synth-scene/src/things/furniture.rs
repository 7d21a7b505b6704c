//! Furniture of rooms and kitchens. Backs are at +y, fronts face -y; what hangs on walls has its back at y = 0.

use crate::things::catalogue::{Class, Naming, Place, metal, vary, wood};
use crate::things::material::{Material, Paint, Pattern, albedo};
use crate::things::model::Model;
use crate::things::shape::Shape;
use glam::DVec3;
use rand_chacha::ChaCha8Rng;

const ANY: &[usize] = &[0, 1, 2, 3, 4, 5, 6, 7, 8];
const PALE: &[usize] = &[8, 7, 3, 6];

const fn class(
    name: &'static str,
    place: Place,
    paints: &'static [usize],
    build: fn(&Paint, &mut ChaCha8Rng) -> Model,
) -> Class {
    Class { name, naming: Naming::Colored, place, paints, build }
}

/// What stands with its back to a wall.
pub const ALONG_WALLS: &[Class] = &[
    class("bed", Place::Floor, ANY, bed),
    class("sofa", Place::Floor, ANY, sofa),
    class("bookshelf", Place::Floor, PALE, bookshelf),
    class("desk", Place::Floor, PALE, desk),
    class("side table", Place::Floor, ANY, side_table),
    class("refrigerator", Place::Floor, PALE, refrigerator),
];
/// What hangs on a wall, with the height of its origin.
pub const ON_WALLS: &[(Class, f64)] = &[
    (class("door", Place::Wall, ANY, door), 0.0),
    (class("window", Place::Wall, PALE, window), 1.0),
    (class("curtain", Place::Wall, ANY, curtain), 0.85),
];
/// The wall cabinet of kitchens and the height of its lower side.
pub const WALL_CABINET: (Class, f64) = (class("wall cabinet", Place::Wall, ANY, wall_cabinet), 1.55);
/// The shelf of kitchens and the height of its board.
pub const SHELF: (Class, f64) = (class("shelf", Place::Wall, ANY, shelf), 1.35);
/// The sink and the stove of kitchens, which stand on the counter.
pub const SINK: Class = class("sink", Place::Table, PALE, sink);
/// The stove.
pub const STOVE: Class = class("stove", Place::Table, &[9, 8], stove);

fn bed(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let (w, d) = (1.95, 0.95);
    let timber = wood(vary(rng, 0.2));
    let frame = m.part("frame");
    m.block(frame, [w, d, 0.16], 0.02, [0.0, 0.0, 0.12], timber);
    m.block(frame, [0.05, d, 0.75], 0.01, [-0.5 * w, 0.0, 0.0], timber);
    for (x, y) in [(-0.9, -0.4), (0.9, -0.4), (-0.9, 0.4), (0.9, 0.4)] {
        m.block(frame, [0.06, 0.06, 0.13], 0.005, [x, y, 0.0], timber);
    }
    let mattress = m.part("mattress");
    m.block(mattress, [w - 0.08, d - 0.04, 0.18], 0.05, [0.0, 0.0, 0.28], Material::matt(albedo([0.90, 0.89, 0.86])));
    let blanket = m.part("blanket");
    let other = paint.albedo() * 0.6 + 0.2;
    let cloth = Material::matt(paint.albedo()).with(Pattern::Checks { other, size: 0.16 });
    m.block(blanket, [1.25, d, 0.07], 0.03, [0.30, 0.0, 0.43], cloth);
    let pillow = m.part("pillow");
    let soft = Shape::Ellipsoid { radii: DVec3::new(0.22, 0.36, 0.08) };
    m.add(pillow, soft, [-0.70, 0.0, 0.51], Material::matt(albedo([0.88, 0.86, 0.90])));
    m
}

fn sofa(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let cloth = Material::matt(paint.albedo()).with(Pattern::Clouds { size: 0.1, amount: 0.12 });
    let w = 1.6 * vary(rng, 0.08);
    let base = m.part("base");
    m.block(base, [w, 0.80, 0.22], 0.03, [0.0, 0.0, 0.08], cloth);
    let back = m.part("back");
    m.block(back, [w, 0.18, 0.72], 0.06, [0.0, 0.33, 0.08], cloth);
    for side in [-1.0, 1.0] {
        let arm = m.part("arm");
        m.block(arm, [0.16, 0.80, 0.52], 0.06, [side * (0.5 * w - 0.02), 0.0, 0.08], cloth);
        let seat = m.part("seat cushion");
        let half = 0.5 * w - 0.12;
        let pale = Material { albedo: cloth.albedo * 0.9 + 0.05, ..cloth };
        m.block(seat, [half, 0.60, 0.16], 0.05, [side * 0.5 * half, -0.06, 0.29], pale);
    }
    let legs = m.part("legs");
    for (x, y) in [(-1.0, -0.35), (1.0, -0.35), (-1.0, 0.35), (1.0, 0.35)] {
        m.block(legs, [0.05, 0.05, 0.09], 0.008, [x * (0.5 * w - 0.08), y, 0.0], wood(0.7));
    }
    m
}

fn bookshelf(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let (w, d, h) = (0.95 * vary(rng, 0.1), 0.30, 1.75);
    let lacquer = Material::matt(paint.albedo());
    let frame = m.part("frame");
    for side in [-1.0, 1.0] {
        m.block(frame, [0.03, d, h], 0.003, [side * (0.5 * w - 0.015), 0.0, 0.0], lacquer);
    }
    m.block(frame, [w - 0.06, 0.012, h], 0.0, [0.0, 0.5 * d - 0.006, 0.0], lacquer);
    let boards = m.part("shelves");
    for k in 0..5 {
        let z = 0.06 + 0.41 * f64::from(k);
        m.block(boards, [w - 0.06, d - 0.014, 0.025], 0.002, [0.0, -0.007, z], lacquer);
        let room = if k < 4 { 0.37 } else { 0.5 };
        m.top_under([0.0, -0.01], [0.5 * w - 0.04, 0.5 * d - 0.012], z + 0.0255, room);
    }
    m
}

fn desk(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let (w, d, h) = (1.30 * vary(rng, 0.1), 0.66, 0.74);
    let top = m.part("top");
    m.block(top, [w, d, 0.03], 0.005, [0.0, 0.0, h - 0.03], wood(vary(rng, 0.2)));
    let legs = m.part("legs");
    for (x, y) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
        m.rod(legs, [x * (0.5 * w - 0.05), y * 0.28, 0.02], [x * (0.5 * w - 0.05), y * 0.28, h - 0.03], 0.02, metal());
    }
    let lacquer = Material::matt(paint.albedo());
    for k in 0..2 {
        let drawer = m.part("drawer");
        let z = h - 0.20 - 0.17 * f64::from(k);
        m.block(drawer, [0.38, d - 0.1, 0.16], 0.006, [0.5 * w - 0.30, 0.0, z], lacquer);
        m.rod(drawer, [0.5 * w - 0.36, -0.31, z + 0.08], [0.5 * w - 0.24, -0.31, z + 0.08], 0.008, metal());
    }
    m.top([0.0, 0.0], [0.5 * w - 0.01, 0.5 * d - 0.01], h);
    m
}

fn side_table(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let (r, h) = (0.26 * vary(rng, 0.1), 0.52 * vary(rng, 0.1));
    let top = m.part("top");
    m.turn(top, &[(0.0, h - 0.025), (r, h - 0.025), (r, h), (0.0, h)], [0.0; 3], Material::glazed(paint.albedo()));
    let leg = m.part("leg");
    m.rod(leg, [0.0, 0.0, 0.02], [0.0, 0.0, h - 0.03], 0.02, metal());
    m.turn(leg, &[(0.0, 0.0), (0.16, 0.0), (0.15, 0.015), (0.02, 0.03)], [0.0; 3], metal());
    m.top([0.0, 0.0], [0.68 * r, 0.68 * r], h + 0.0005);
    m
}

fn refrigerator(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let (w, d, h) = (0.60, 0.60, 1.60 * vary(rng, 0.06));
    let enamel = Material { specular: 0.12, ..Material::matt(paint.albedo()) };
    let body = m.part("body");
    m.block(body, [w, d, h], 0.01, [0.0; 3], enamel);
    for (name, z, height) in [("lower door", 0.05, 0.60 * h), ("upper door", 0.60 * h + 0.07, 0.40 * h - 0.09)] {
        let door = m.part(name);
        let front = Material { albedo: enamel.albedo * 0.92 + 0.03, ..enamel };
        m.block(door, [w - 0.02, 0.03, height], 0.008, [0.0, -0.5 * d - 0.015, z], front);
        let (x, y) = (-0.22, -0.5 * d - 0.06);
        m.rod(door, [x, y, z + 0.3 * height], [x, y, z + 0.7 * height], 0.012, metal());
    }
    m
}

fn door(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let (w, h) = (0.85, 2.0 * vary(rng, 0.02));
    let white = Material::matt(albedo([0.88, 0.87, 0.84]));
    let frame = m.part("frame");
    for side in [-1.0, 1.0] {
        m.block(frame, [0.08, 0.05, h + 0.08], 0.005, [side * (0.5 * w + 0.04), -0.025, 0.0], white);
    }
    m.block(frame, [w + 0.16, 0.05, 0.08], 0.005, [0.0, -0.025, h], white);
    let leaf = m.part("leaf");
    m.block(leaf, [w, 0.03, h], 0.003, [0.0, -0.015, 0.0], Material::matt(paint.albedo()));
    for z in [0.25, 1.15] {
        m.block(leaf, [0.6 * w, 0.01, 0.65], 0.004, [0.0, -0.034, z], Material::matt(paint.albedo() * 0.85));
    }
    let handle = m.part("handle");
    m.rod(handle, [0.33, -0.03, 1.0], [0.33, -0.075, 1.0], 0.010, metal());
    m.rod(handle, [0.33, -0.075, 1.0], [0.22, -0.075, 1.0], 0.010, metal());
    m
}

fn window(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let (w, h) = (1.1 * vary(rng, 0.1), 0.95);
    let frame = m.part("frame");
    let lacquer = Material::matt(paint.albedo());
    for side in [-1.0, 0.0, 1.0] {
        m.block(frame, [0.05, 0.05, h], 0.004, [side * (0.5 * w - 0.025), -0.025, 0.0], lacquer);
    }
    for z in [0.0, h - 0.05] {
        m.block(frame, [w, 0.05, 0.05], 0.004, [0.0, -0.025, z], lacquer);
    }
    let pane = m.part("glass");
    let sky = Material { specular: 0.2, ..Material::matt(albedo([0.62, 0.75, 0.88])) }.glowing(0.5);
    m.block(pane, [w - 0.02, 0.02, h - 0.02], 0.0, [0.0, -0.010, 0.01], sky);
    let sill = m.part("sill");
    m.block(sill, [w + 0.1, 0.12, 0.03], 0.005, [0.0, -0.06, -0.03], lacquer);
    m
}

fn curtain(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let (folds, h) = (9, 1.35 * vary(rng, 0.05));
    let cloth = Material::matt(paint.albedo());
    let rod = m.part("rod");
    m.rod(rod, [-0.45, -0.06, h], [0.45, -0.06, h], 0.012, metal());
    let drape = m.part("cloth");
    for k in 0..folds {
        let x = -0.36 + 0.09 * f64::from(k);
        let y = -0.06 - 0.012 * f64::from(k % 2);
        m.rod(drape, [x, y, 0.05], [x, y, h - 0.05], 0.048, cloth);
    }
    m
}

fn wall_cabinet(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let (w, d, h) = (0.75 * vary(rng, 0.1), 0.32, 0.62);
    let lacquer = Material::matt(paint.albedo());
    let body = m.part("body");
    m.block(body, [w, d, h], 0.004, [0.0, -0.5 * d, 0.0], lacquer);
    for side in [-1.0, 1.0] {
        let leaf = m.part("door");
        let front = Material { albedo: lacquer.albedo * 0.88 + 0.05, ..lacquer };
        m.block(leaf, [0.5 * w - 0.01, 0.02, h - 0.02], 0.004, [side * 0.25 * w, -d - 0.01, 0.01], front);
        m.rod(leaf, [side * 0.05, -d - 0.035, 0.08], [side * 0.05, -d - 0.035, 0.20], 0.007, metal());
    }
    m
}

fn shelf(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let w = 1.1 * vary(rng, 0.1);
    let board = m.part("board");
    m.block(board, [w, 0.24, 0.025], 0.003, [0.0, -0.12, 0.0], Material::matt(paint.albedo()));
    let brackets = m.part("brackets");
    for side in [-1.0, 1.0] {
        m.rod(brackets, [side * 0.4 * w, -0.01, -0.15], [side * 0.4 * w, -0.20, -0.012], 0.008, metal());
    }
    m.top([0.0, -0.125], [0.5 * w - 0.01, 0.11], 0.0255);
    m
}

fn sink(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let steel = Material { specular: 0.25, ..Material::matt(albedo([0.72, 0.72, 0.74])) };
    let (w, d) = (0.52 * vary(rng, 0.06), 0.42);
    let rim = m.part("rim");
    for (x, y, sx, sy) in [(0.0, 0.5, w, 0.04), (0.0, -0.5, w, 0.04), (0.5, 0.0, 0.04, d), (-0.5, 0.0, 0.04, d)] {
        m.block(rim, [sx, sy, 0.03], 0.006, [x * (w - 0.04), y * (d - 0.04), 0.0], Material::glazed(paint.albedo()));
    }
    let basin = m.part("basin");
    m.block(basin, [w - 0.05, d - 0.05, 0.005], 0.0, [0.0; 3], steel);
    m.turn(basin, &[(0.03, 0.006), (0.0, 0.006)], [0.0; 3], Material::matt(albedo([0.2; 3])));
    let tap = m.part("tap");
    let back = 0.5 * d - 0.02;
    m.rod(tap, [0.0, back, 0.02], [0.0, back, 0.24], 0.013, steel);
    m.rod(tap, [0.0, back, 0.24], [0.0, back - 0.16, 0.25], 0.011, steel);
    m.rod(tap, [0.0, back - 0.16, 0.25], [0.0, back - 0.16, 0.20], 0.011, steel);
    m
}

fn stove(paint: &Paint, rng: &mut ChaCha8Rng) -> Model {
    let mut m = Model::default();
    let (w, d) = (0.56 * vary(rng, 0.04), 0.48);
    let top = m.part("top");
    m.block(top, [w, d, 0.02], 0.004, [0.0; 3], Material { specular: 0.2, ..Material::matt(paint.albedo()) });
    let iron = Material::matt(albedo([0.30, 0.28, 0.28]));
    for (x, y) in [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)] {
        let plate = m.part("hot plate");
        m.turn(plate, &[(0.085, 0.02), (0.083, 0.026), (0.0, 0.026)], [x * 0.25 * w, y * 0.24 * d, 0.0], iron);
    }
    m.top([0.0, 0.0], [0.42 * w, 0.42 * d], 0.0265);
    m
}

/// A kitchen counter of the given length and depth with its back at +y: background, but with parts.
pub fn counter(length: f64, depth: f64, height: f64) -> Model {
    let mut m = Model::default();
    let body = m.part("body");
    let white = Material::matt(albedo([0.84, 0.83, 0.80]));
    m.block(body, [length - 0.02, depth - 0.06, height - 0.04], 0.004, [0.0, 0.02, 0.0], white);
    let top = m.part("worktop");
    let stone = Material::matt(albedo([0.52, 0.48, 0.45])).with(Pattern::Clouds { size: 0.03, amount: 0.18 });
    m.block(top, [length, depth, 0.04], 0.006, [0.0, 0.0, height - 0.04], Material { specular: 0.08, ..stone });
    let doors = m.part("doors");
    let count = (length / 0.55).round().max(1.0) as usize;
    let step = length / count as f64;
    for k in 0..count {
        let x = -0.5 * length + step * (k as f64 + 0.5);
        let front = Material::matt(albedo([0.78, 0.80, 0.80]));
        m.block(doors, [step - 0.02, 0.02, height - 0.16], 0.004, [x, -0.5 * depth + 0.04, 0.08], front);
        m.rod(
            doors,
            [x - 0.07, -0.5 * depth + 0.02, height - 0.14],
            [x + 0.07, -0.5 * depth + 0.02, height - 0.14],
            0.007,
            metal(),
        );
    }
    m.top([0.0, 0.0], [0.5 * length - 0.01, 0.5 * depth - 0.01], height + 0.0005);
    m
}
