//! A thing in its own frame: named parts made of primitives. z is up, the origin is where it stands.

use crate::things::material::Material;
use crate::things::shape::Shape;
use glam::{DMat3, DVec3};

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

    /// Half extents in x and y of an upright box around the origin that holds the model, and its height.
    pub fn extent(&self) -> (f64, f64, f64) {
        let corners = self.pieces.iter().flat_map(|piece| {
            let (half, centre) = piece.shape.bounds();
            (0..8).map(move |k| {
                let sign = DVec3::new(f64::from(k & 1), f64::from(k >> 1 & 1), f64::from(k >> 2 & 1)) * 2.0 - 1.0;
                piece.rotation * (centre + half * sign) + piece.offset
            })
        });
        corners.fold((0.0, 0.0, 0.0), |(x, y, z), c| (c.x.abs().max(x), c.y.abs().max(y), c.z.max(z)))
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
    fn scaling_scales_the_extent() {
        let mut m = Model::default();
        m.part("box").block([0.2, 0.4, 0.6], 0.01, [0.0; 3], Material::matt(DVec3::ONE));
        m.scale(2.0);
        let (x, y, z) = m.extent();
        assert!((x - 0.2).abs() < 1e-12 && (y - 0.4).abs() < 1e-12 && (z - 1.2).abs() < 1e-12);
    }
}
