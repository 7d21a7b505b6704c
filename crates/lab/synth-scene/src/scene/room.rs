//! What all rooms share: floor and walls, rectangles on the ground, and how things are called.

use crate::scene::{Identity, Scene};
use crate::things::class::{Class, Naming};
use crate::things::material::albedo;
use crate::things::walls;
use glam::{DVec2, DVec3};
use std::f64::consts::FRAC_PI_2;

/// Height of the table tops in metres.
pub const TABLE_HEIGHT: f64 = 0.72;
const WALL_HEIGHT: f64 = 2.7;
const WALLS: [(&str, [f64; 3]); 4] = [
    ("white", [0.87, 0.86, 0.83]),
    ("green", [0.70, 0.78, 0.68]),
    ("yellow", [0.88, 0.82, 0.66]),
    ("blue", [0.66, 0.75, 0.82]),
];

/// A rectangle on the ground, turned.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Footprint {
    pub centre: DVec2,
    pub half: DVec2,
    pub yaw: f64,
}

impl Footprint {
    pub fn axes(&self) -> [DVec2; 2] {
        let x = DVec2::from_angle(self.yaw);
        [x, x.perp()]
    }

    fn corners(&self) -> [DVec2; 4] {
        let [x, y] = self.axes();
        let (x, y) = (x * self.half.x, y * self.half.y);
        [self.centre + x + y, self.centre + x - y, self.centre - x + y, self.centre - x - y]
    }

    /// Whether the two come closer than `gap`, by separating axes.
    pub fn touches(&self, other: &Self, gap: f64) -> bool {
        let span = |corners: [DVec2; 4], axis: DVec2| {
            corners
                .iter()
                .map(|c| c.dot(axis))
                .fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)))
        };
        self.axes().into_iter().chain(other.axes()).all(|axis| {
            let (a, b) = (span(self.corners(), axis), span(other.corners(), axis));
            a.0 < b.1 + gap && b.0 < a.1 + gap
        })
    }

    /// Whether it lies within another one.
    pub fn inside(&self, other: &Self) -> bool {
        let [x, y] = other.axes();
        self.corners().iter().all(|&c| {
            let d = c - other.centre;
            d.dot(x).abs() <= other.half.x && d.dot(y).abs() <= other.half.y
        })
    }

    /// A footprint of half extents `half` beside this one, `gap` away from it. `turn` (0 to 1) chooses the side and the
    /// turn, `shift` (-1 to 1) how far the middles are apart along the side.
    pub fn beside(&self, half: DVec2, gap: f64, turn: f64, shift: f64) -> Self {
        let side = (turn * 16.0) as usize;
        let turned = side / 4 % 2 == 1;
        let size = if turned { DVec2::new(half.y, half.x) } else { half };
        let [x, y] = self.axes();
        let sign = if side.is_multiple_of(2) { 1.0 } else { -1.0 };
        let slide = 0.6 * shift * (self.half + size);
        let offset = match side / 2 % 2 {
            0 => x * (sign * (self.half.x + size.x + gap)) + y * slide.y,
            _ => y * (sign * (self.half.y + size.y + gap)) + x * slide.x,
        };
        let half_turns = FRAC_PI_2 * (f64::from(turned) + 2.0 * (side / 8) as f64);
        Self { centre: self.centre + offset, half, yaw: self.yaw + half_turns }
    }
}

pub(crate) fn name_of(class: &Class, color: &str, repeated: bool) -> String {
    match class.naming {
        Naming::Plain if !repeated => class.name.to_string(),
        Naming::Of(before, after) => {
            // "in a" becomes "in an" before a vowel.
            let n = if before.ends_with(" a") && color.starts_with(['a', 'e', 'i', 'o', 'u']) { "n" } else { "" };
            format!("{before}{n} {color} {after}")
        }
        Naming::Plain | Naming::Colored => format!("{color} {}", class.name),
    }
}

/// Half the length of a wall of a room with the given half extents, and its distance from the middle.
pub(crate) fn wall_span(half: DVec2, wall: usize) -> (f64, f64) {
    if wall.is_multiple_of(2) { (half.x, half.y) } else { (half.y, half.x) }
}

/// Places the floor and the walls of a room with the given half extents.
pub(crate) fn enclose(scene: &mut Scene, half: DVec2) {
    let of = |name: String, class, color| Identity { name, class, color, background: true };
    scene.place(&walls::floor(half.to_array()), of("floor".into(), "floor", "brown"), DVec3::ZERO, 0.0);
    for (k, (color, srgb)) in WALLS.into_iter().enumerate() {
        let (length, distance) = wall_span(half, k);
        let yaw = FRAC_PI_2 * k as f64;
        let at = DVec2::from_angle(yaw).rotate(DVec2::new(0.0, distance)).extend(0.0);
        // A little longer than the room, so that walls meet behind its corners.
        let wall = walls::wall(2.0 * length + 0.1, WALL_HEIGHT, albedo(srgb));
        scene.place(&wall, of(format!("{color} wall"), "wall", color), at, yaw);
    }
}
