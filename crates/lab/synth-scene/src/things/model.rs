//! A thing in its own frame: named parts made of primitives. z is up, the origin is where it stands.

use crate::things::material::Material;
use crate::things::shape::Shape;
use glam::{DMat3, DVec3};
use std::f64::consts::FRAC_PI_2;

#[derive(Debug, Clone)]
pub struct Piece {
    pub part: usize,
    pub shape: Shape,
    /// `model_from_piece`.
    pub rotation: DMat3,
    pub offset: DVec3,
    pub material: Material,
}

/// A thing made of parts, not yet placed.
#[derive(Debug, Clone, Default)]
pub struct Model {
    /// Names of its parts; several may share a name, such as "cookie".
    pub parts: Vec<&'static str>,
    pub pieces: Vec<Piece>,
    /// Flat tops that other things may stand on.
    pub tops: Vec<Top>,
    current: usize,
}

/// A flat rectangle in x and y that other things may stand on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Top {
    pub centre: [f64; 2],
    pub half: [f64; 2],
    pub height: f64,
    /// Height of what fits between it and what is above it.
    pub room: f64,
}

impl Model {
    /// Begins a part: pieces go to it until another one is begun.
    pub fn part(&mut self, name: &'static str) -> &mut Self {
        self.current = self.parts.len();
        self.parts.push(name);
        self
    }

    /// Goes on with the part of this name.
    pub fn again(&mut self, name: &str) -> &mut Self {
        self.current = self.parts.iter().rposition(|&p| p == name).unwrap_or(self.current);
        self
    }

    /// Adds an upright primitive.
    pub fn add(&mut self, shape: Shape, offset: [f64; 3], material: Material) {
        self.add_turned(shape, offset, DMat3::IDENTITY, material);
    }

    /// Adds a rotated primitive.
    pub fn add_turned(&mut self, shape: Shape, offset: [f64; 3], rotation: DMat3, material: Material) {
        let offset = DVec3::from_array(offset);
        self.pieces.push(Piece { part: self.current, shape, rotation, offset, material });
    }

    /// Adds a solid of revolution about the vertical through the origin.
    pub fn lathe(&mut self, profile: &[(f64, f64)], material: Material) {
        self.turn(profile, [0.0; 3], material);
    }

    /// Adds a solid of revolution about the vertical through `offset`.
    pub fn turn(&mut self, profile: &[(f64, f64)], offset: [f64; 3], material: Material) {
        self.turn_rotated(profile, offset, DMat3::IDENTITY, material);
    }

    /// Adds a solid of revolution about a rotated axis.
    pub fn turn_rotated(&mut self, profile: &[(f64, f64)], offset: [f64; 3], rotation: DMat3, material: Material) {
        for shape in Shape::turned(profile) {
            self.add_turned(shape, offset, rotation, material);
        }
    }

    /// Adds a block with its lower side's centre at `foot`.
    pub fn block(&mut self, size: [f64; 3], round: f64, foot: [f64; 3], material: Material) {
        let half = size.map(|s| 0.5 * s);
        self.add(Shape::block(half, round), [foot[0], foot[1], foot[2] + half[2]], material);
    }

    /// Adds four blocks, at the corners of the rectangle with the half extents `corner`.
    pub fn legs(&mut self, corner: [f64; 2], size: [f64; 3], round: f64, material: Material) {
        for (x, y) in [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)] {
            self.block(size, round, [x * corner[0], y * corner[1], 0.0], material);
        }
    }

    /// Adds a rim around a rectangle of the given size, of bars that are `bar` wide and `height` high.
    pub fn rim(&mut self, [w, d]: [f64; 2], [bar, height]: [f64; 2], round: f64, material: Material) {
        for (x, y, size) in [(0.0, 0.5, [w, bar]), (0.0, -0.5, [w, bar]), (0.5, 0.0, [bar, d]), (-0.5, 0.0, [bar, d])] {
            self.block([size[0], size[1], height], round, [x * (w - bar), y * (d - bar), 0.0], material);
        }
    }

    /// Adds a round rod from `a` to `b`.
    pub fn rod(&mut self, a: [f64; 3], b: [f64; 3], radius: f64, material: Material) {
        let (a, b) = (DVec3::from_array(a), DVec3::from_array(b));
        let shape = Shape::Capsule { half: 0.5 * (b - a).length(), radius };
        self.add_turned(shape, (0.5 * (a + b)).to_array(), z_towards(b - a), material);
    }

    /// Adds a flat top under the open air.
    pub fn top(&mut self, centre: [f64; 2], half: [f64; 2], height: f64) {
        self.top_under(centre, half, height, 10.0);
    }

    /// Adds a flat top with something `room` above it.
    pub fn top_under(&mut self, centre: [f64; 2], half: [f64; 2], height: f64, room: f64) {
        self.tops.push(Top { centre, half, height, room });
    }

    /// Makes the model `factor` times as large.
    pub fn scale(&mut self, factor: f64) {
        for piece in &mut self.pieces {
            piece.offset *= factor;
            piece.shape = piece.shape.scaled(factor);
        }
        for top in &mut self.tops {
            top.centre = top.centre.map(|c| c * factor);
            top.half = top.half.map(|h| h * factor);
            top.height *= factor;
            top.room *= factor;
        }
    }

    /// Moves the model so that its footprint lies around the origin.
    pub fn centre(&mut self) {
        let (low, high) = self.bounds();
        self.shift(-0.5 * (low + high) * DVec3::new(1.0, 1.0, 0.0));
    }

    /// Turns what lies along x so that it hangs at y = 0 and faces -y, from z = 0 upwards: with the end of -x above, or with
    /// that of +x. Nothing can stand on it then.
    pub fn hang(&mut self, tip_up: bool) {
        let half_turn = if tip_up { DMat3::from_diagonal(DVec3::new(-1.0, -1.0, 1.0)) } else { DMat3::IDENTITY };
        self.turn_over(DMat3::from_cols(-DVec3::Z, DVec3::X, -DVec3::Y) * half_turn);
        let (low, high) = self.bounds();
        self.shift(-DVec3::new(0.5 * (low.x + high.x), high.y, low.z));
    }

    /// Lays what stands upright on its side at +x, around the origin.
    pub fn lie_down(&mut self) {
        self.turn_over(DMat3::from_rotation_y(FRAC_PI_2));
        let (low, high) = self.bounds();
        self.shift(-DVec3::new(0.5 * (low.x + high.x), 0.5 * (low.y + high.y), low.z));
    }

    fn turn_over(&mut self, turn: DMat3) {
        for piece in &mut self.pieces {
            piece.offset = turn * piece.offset;
            piece.rotation = turn * piece.rotation;
        }
        self.tops.clear();
    }

    fn shift(&mut self, by: DVec3) {
        self.pieces.iter_mut().for_each(|piece| piece.offset += by);
        for top in &mut self.tops {
            top.centre = [top.centre[0] + by.x, top.centre[1] + by.y];
            top.height += by.z;
        }
    }

    /// The lowest and the highest coordinates of a box that holds the model.
    fn bounds(&self) -> (DVec3, DVec3) {
        let (low, high) = (DVec3::splat(f64::INFINITY), DVec3::splat(f64::NEG_INFINITY));
        self.corners().fold((low, high), |(low, high), c| (low.min(c), high.max(c)))
    }

    /// Half extents in x and y of an upright box around the origin that holds the model, and its height.
    pub fn extent(&self) -> (f64, f64, f64) {
        self.corners().fold((0.0, 0.0, 0.0), |(x, y, z), c| (c.x.abs().max(x), c.y.abs().max(y), c.z.max(z)))
    }

    /// The corners of the boxes around all pieces.
    fn corners(&self) -> impl Iterator<Item = DVec3> {
        self.pieces.iter().flat_map(|piece| {
            let (half, centre) = piece.shape.bounds();
            (0..8).map(move |k| {
                let sign = DVec3::new(f64::from(k & 1), f64::from(k >> 1 & 1), f64::from(k >> 2 & 1)) * 2.0 - 1.0;
                piece.rotation * (centre + half * sign) + piece.offset
            })
        })
    }
}

impl Shape {
    fn scaled(&self, k: f64) -> Self {
        match *self {
            Self::Block { half, round } => Self::Block { half: half * k, round: round * k },
            Self::Ellipsoid { radii } => Self::Ellipsoid { radii: radii * k },
            Self::Turned { from, to, from_normal, to_normal } => {
                Self::Turned { from: from * k, to: to * k, from_normal, to_normal }
            }
            Self::Ring { major, minor, arc } => Self::Ring { major: major * k, minor: minor * k, arc },
            Self::Capsule { half, radius } => Self::Capsule { half: half * k, radius: radius * k },
        }
    }
}

/// A profile for [`Model::turn`] from its radii and heights.
pub fn profile<const N: usize>(radii: [f64; N], heights: [f64; N]) -> [(f64, f64); N] {
    std::array::from_fn(|i| (radii[i], heights[i]))
}

/// A rotation that takes z to `direction`.
pub fn z_towards(direction: DVec3) -> DMat3 {
    let z = direction.normalize_or(DVec3::Z);
    let helper = if z.z.abs() < 0.9 { DVec3::Z } else { DVec3::X };
    let x = helper.cross(z).normalize_or(DVec3::X);
    DMat3::from_cols(x, z.cross(x), z)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rod_joins_its_ends() {
        let mut m = Model::default();
        m.part("rod").rod([0.1, 0.2, 0.3], [0.4, 0.0, 0.9], 0.01, Material::matt(DVec3::ONE));
        let piece = &m.pieces[0];
        let Shape::Capsule { half, .. } = piece.shape else { panic!("a capsule") };
        let end = piece.rotation * DVec3::new(0.0, 0.0, half) + piece.offset;
        assert!((end - DVec3::new(0.4, 0.0, 0.9)).length() < 1e-12);
        assert!((z_towards(DVec3::new(0.3, -0.2, 0.1)).determinant() - 1.0).abs() < 1e-12);
    }

    #[test]
    fn what_hangs_has_its_back_at_the_wall_and_the_chosen_end_above() {
        for tip_up in [false, true] {
            let mut m = Model::default();
            m.part("grip").block([0.2, 0.06, 0.04], 0.0, [0.3, 0.1, 0.0], Material::matt(DVec3::ONE));
            m.part("tip").block([0.1, 0.02, 0.01], 0.0, [0.45, 0.1, 0.0], Material::matt(DVec3::ONE));
            m.top([0.3, 0.1], [0.05, 0.02], 0.04);
            m.centre();
            let (x, y, _) = m.extent();
            assert!((x - 0.15).abs() < 1e-12 && (y - 0.03).abs() < 1e-12);
            assert!((m.tops[0].centre[0] + 0.05).abs() < 1e-12 && m.tops[0].centre[1].abs() < 1e-12);
            m.hang(tip_up);
            let (low, high) = m.bounds();
            assert!((low - DVec3::new(-0.03, -0.04, 0.0)).length() < 1e-12, "{low}");
            assert!((high - DVec3::new(0.03, 0.0, 0.3)).length() < 1e-12, "{high}");
            assert_eq!(m.pieces[1].offset.z > m.pieces[0].offset.z, tip_up);
            assert!((m.pieces[0].rotation.determinant() - 1.0).abs() < 1e-12 && m.tops.is_empty());
        }
    }

    #[test]
    fn what_lies_down_lies_on_the_ground() {
        let mut m = Model::default();
        m.part("book").block([0.02, 0.15, 0.20], 0.0, [0.1, 0.0, 0.0], Material::matt(DVec3::ONE));
        m.lie_down();
        let (low, high) = m.bounds();
        assert!((low - DVec3::new(-0.10, -0.075, 0.0)).length() < 1e-12, "{low}");
        assert!((high - DVec3::new(0.10, 0.075, 0.02)).length() < 1e-12, "{high}");
    }

    #[test]
    fn scaling_scales_the_extent() {
        let mut m = Model::default();
        m.part("box").block([0.2, 0.4, 0.6], 0.01, [0.0; 3], Material::matt(DVec3::ONE));
        m.scale(2.0);
        let (x, y, z) = m.extent();
        assert!((x - 0.2).abs() < 1e-12 && (y - 0.4).abs() < 1e-12 && (z - 1.2).abs() < 1e-12);
    }
}
