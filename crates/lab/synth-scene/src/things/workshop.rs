//! What is built into a workshop: bench, shelves and pegboard. All run along a wall at y = 0 and face -y, and come in
//! stretches of [`STRETCH`] metres each.

use crate::things::class::{metal, wood};
use crate::things::material::{Pattern, matt};
use crate::things::model::Model;
use crate::things::shape::Shape;

/// Length of a stretch of bench, shelves or pegboard.
pub const STRETCH: f64 = 0.90;
/// Depth of the bench, and height of its upper side.
pub const BENCH: [f64; 2] = [0.62, 0.90];
/// Heights of the shelves' upper sides.
pub const SHELVES: [f64; 3] = [1.19, 1.46, 1.73];
/// Depth of the shelves.
pub const SHELF_DEPTH: f64 = 0.21;
/// Height of what fits between two shelves.
pub const SHELF_ROOM: f64 = 0.245;
/// Free length of a shelf.
pub const SHELF_LENGTH: f64 = STRETCH - 0.06;
/// Distance of the pegboard's front from the wall.
pub const BOARD_FRONT: f64 = 0.018;
/// Heights of the pegboard's lower and upper edges.
pub const BOARD: [f64; 2] = [0.99, 1.80];
/// Thickness of the shelves' boards.
const PLANK: f64 = 0.018;
/// Radius of a peg.
const PEG: f64 = 0.0034;
/// Between the bench and what stands on it, so that the two surfaces are not one.
const GAP: f64 = 0.0005;

/// The middle along the wall of stretch `k` of `count`.
pub fn middle(k: usize, count: usize) -> f64 {
    STRETCH * (k as f64 - 0.5 * (count - 1) as f64)
}

/// A bench of `count` stretches: background, but with parts. Things may stand on all of it but a strip at the wall, before
/// which tools hang.
pub fn bench(count: usize) -> Model {
    let [depth, height] = BENCH;
    let mut m = Model::default();
    m.part("top");
    for k in 0..count {
        m.block([STRETCH, depth, 0.05], 0.0, [middle(k, count), -0.5 * depth, height - 0.05], wood(1.05));
    }
    m.part("legs");
    for k in 0..=count {
        let x = middle(k, count) - 0.5 * STRETCH + if k == 0 { 0.06 } else { -0.06 };
        for y in [-0.08, 0.08 - depth] {
            m.block([0.08, 0.08, height - 0.05], 0.004, [x, y, 0.0], wood(0.75));
        }
    }
    m.part("drawers");
    for k in 0..count {
        let x = middle(k, count);
        m.block([0.66, depth - 0.12, 0.15], 0.004, [x, -0.5 * depth + 0.01, height - 0.20], wood(0.9));
        m.rod([x - 0.07, 0.045 - depth, height - 0.12], [x + 0.07, 0.045 - depth, height - 0.12], 0.008, metal());
    }
    m.top([0.0, -0.5 * depth - 0.05], [0.5 * STRETCH * count as f64 - 0.01, 0.5 * depth - 0.06], height + GAP);
    m
}

/// Shelves in the stretches `at` of `count`, without tops of their own: rows of things stand on them.
pub fn shelves(at: &[usize], count: usize) -> Model {
    let mut m = Model::default();
    let paint = matt([0.88, 0.86, 0.81]);
    let (low, high) = (SHELVES[0] - 0.06, SHELVES[2] + SHELF_ROOM + PLANK);
    let y = -0.5 * SHELF_DEPTH;
    m.part("boards");
    for x in at.iter().map(|&k| middle(k, count)) {
        for top in SHELVES {
            m.block([STRETCH - 0.04, SHELF_DEPTH, PLANK], 0.0, [x, y, top - PLANK], paint);
        }
    }
    m.part("sides");
    for x in at.iter().map(|&k| middle(k, count)) {
        for side in [-1.0, 1.0] {
            m.block([PLANK, SHELF_DEPTH, high - low], 0.0, [x + side * (0.5 * STRETCH - 0.011), y, low], paint);
        }
    }
    m
}

/// A pegboard in the stretches `at` of `count`, with a peg for each of `pegs`: x, z and how far it stands out.
pub fn pegboard(at: &[usize], count: usize, pegs: &[[f64; 3]]) -> Model {
    let mut m = Model::default();
    let [low, high] = BOARD;
    let half = [0.5 * STRETCH - 0.005, 0.5 * BOARD_FRONT, 0.5 * (high - low)];
    let pressed = matt([0.76, 0.67, 0.52]).with(Pattern::Clouds { size: 0.015, amount: 0.06 });
    m.part("board");
    for &k in at {
        m.add(Shape::block(half, 0.0), [middle(k, count), -half[1], 0.5 * (low + high)], pressed);
    }
    m.part("pegs");
    for &[x, z, out] in pegs {
        m.rod([x, -0.5 * BOARD_FRONT, z], [x, -BOARD_FRONT - out, z + 0.1 * out], PEG, metal());
    }
    if pegs.is_empty() {
        // A part has pieces: pegs that are not in use.
        for &k in at {
            m.rod([middle(k, count), 0.0, high - 0.1], [middle(k, count), -0.06, high - 0.1], PEG, metal());
        }
    }
    m
}
