//! From the axes of a format to those of this workspace.

use crate::Gaussians;
use crate::harmonics::Turned;
use glam::{DMat3, DMat4, DQuat, DVec3};
use gs_io::{Error, Result};
use rayon::prelude::*;

/// Where the axes x, y, z of a file point: left or right, up or down, front or back, in three letters such as RDF.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct System([u8; 3]);

/// All of them, in the order of the numbers of SPZ's extension, from 1.
pub(super) const SYSTEMS: [System; 16] = [
    System(*b"LDB"),
    System(*b"RDB"),
    System(*b"LUB"),
    System(*b"RUB"),
    System(*b"LDF"),
    System(*b"RDF"),
    System(*b"LUF"),
    System(*b"RUF"),
    System(*b"LFD"),
    System(*b"RFD"),
    System(*b"LFU"),
    System(*b"RFU"),
    System(*b"LBD"),
    System(*b"RBD"),
    System(*b"LBU"),
    System(*b"RBU"),
];

impl System {
    /// Of a PLY of 3DGS, and of Gaussians in memory.
    pub const PLY: Self = Self(*b"RDF");
    /// Of an SPZ that names none.
    pub const SPZ: Self = Self(*b"RUB");
    /// Of glTF.
    pub(super) const GLTF: Self = Self(*b"LUF");

    /// The columns are where the system's axes point: in right, down, front.
    fn matrix(self) -> DMat3 {
        let axis = |name: u8| match name {
            b'L' => -DVec3::X,
            b'R' => DVec3::X,
            b'U' => -DVec3::Y,
            b'D' => DVec3::Y,
            b'B' => -DVec3::Z,
            _ => DVec3::Z,
        };
        DMat3::from_cols(axis(self.0[0]), axis(self.0[1]), axis(self.0[2]))
    }

    /// From these axes to right, down, front.
    pub(super) fn to_ours(self) -> Axes {
        Axes::turned(self.matrix())
    }
}

impl Default for System {
    fn default() -> Self {
        Self::PLY
    }
}

impl std::fmt::Display for System {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.iter().try_for_each(|&letter| write!(f, "{}", char::from(letter)))
    }
}

impl std::str::FromStr for System {
    type Err = Error;

    fn from_str(s: &str) -> Result<Self> {
        let known = SYSTEMS.into_iter().find(|system| system.to_string() == s.to_ascii_uppercase());
        known.ok_or_else(|| {
            Error::new("no axes")
                .found(s)
                .expected("where x, y and z point: R or L, then U or D, F or B in either order, such as RDF")
        })
    }
}

/// Turns Gaussians that were read as those of a file with the axes `from` into those of the same file with the axes `to`.
pub fn turn(g: &mut Gaussians, from: System, to: System) {
    if from != to {
        let turn = to.matrix() * from.matrix().transpose();
        Axes::turned(turn).apply(g);
        g.shift = (turn * DVec3::from(g.shift)).to_array();
    }
}

/// A change of axes: points p become scale * turn * p + shift.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Axes {
    turn: DMat3,
    scale: f64,
    shift: DVec3,
    harmonics: Turned,
    /// The axes' signs, where nothing but signs changes.
    flips: Option<[f64; 3]>,
}

impl Axes {
    /// The signs of the axes change. It undoes itself.
    pub fn flips(signs: [f64; 3]) -> Self {
        Self::of(DMat3::from_diagonal(DVec3::from(signs)), 1.0, DVec3::ZERO)
    }

    /// The columns of `turn` are the old axes in the new ones: orthogonal, mirrored or not.
    pub fn turned(turn: DMat3) -> Self {
        Self::of(turn, 1.0, DVec3::ZERO)
    }

    fn of(turn: DMat3, scale: f64, shift: DVec3) -> Self {
        let diagonal = turn == DMat3::from_diagonal(turn.diagonal());
        Self { turn, scale, shift, harmonics: Turned::new(turn), flips: diagonal.then(|| turn.diagonal().to_array()) }
    }

    /// An affine map that keeps angles.
    ///
    /// # Errors
    /// When it does not: when its last row is another than 0 0 0 1, or it stretches directions unequally.
    pub fn affine(map: DMat4) -> Result<Self> {
        let linear = DMat3::from_mat4(map);
        let lengths = [linear.x_axis, linear.y_axis, linear.z_axis].map(DVec3::length);
        let scale = (lengths[0] * lengths[1] * lengths[2]).cbrt();
        let turn = linear * (1.0 / scale);
        let off = (turn.transpose() * turn - DMat3::IDENTITY).to_cols_array();
        if !(map.row(3) == glam::DVec4::W && map.is_finite() && scale > 0.0 && off.iter().all(|v| v.abs() < 1e-3)) {
            return Err(Error::new("not a rotation, one scale for all axes and a translation")
                .found(format!("{:?}", map.to_cols_array()))
                .hint("apply the transform in the tool that wrote the file, and export it again"));
        }
        Ok(Self::of(nearest_rotation(turn), scale, map.w_axis.truncate()))
    }

    /// A point.
    pub fn point(&self, p: [f32; 3]) -> [f32; 3] {
        let p = DVec3::from(p.map(f64::from));
        let at = match self.flips {
            // Exact, and no number that is not finite spreads.
            Some([x, y, z]) => DVec3::new(x * p.x, y * p.y, z * p.z) * self.scale + self.shift,
            None => self.turn * p * self.scale + self.shift,
        };
        at.to_array().map(|v| v as f32)
    }

    /// A logarithm of a scale.
    pub fn log_scale(&self, s: f32) -> f32 {
        if self.scale == 1.0 { s } else { (f64::from(s) + self.scale.ln()) as f32 }
    }

    /// A rotation w x y z. A mirrored Gaussian is one: its axes have no direction.
    pub fn rotation(&self, [w, x, y, z]: [f32; 4]) -> [f32; 4] {
        if let Some([a, b, c]) = self.flips.map(|f| f.map(|v| v as f32)) {
            return [w, b * c * x, a * c * y, a * b * z];
        }
        let turn = DQuat::from_mat3(&(self.turn * self.turn.determinant().signum()));
        let q = turn * DQuat::from_xyzw(x.into(), y.into(), z.into(), w.into());
        [q.w, q.x, q.y, q.z].map(|v| v as f32)
    }

    /// Coefficients of harmonics, `[coefficients][rgb]`.
    pub fn harmonics(&self, sh: &mut [f32]) {
        self.harmonics.apply(sh);
    }

    /// Changes Gaussians, in place.
    pub fn apply(&self, g: &mut Gaussians) {
        let stride = g.sh_stride();
        g.means.par_iter_mut().for_each(|p| *p = self.point(*p));
        g.log_scales.par_iter_mut().for_each(|s| *s = s.map(|s| self.log_scale(s)));
        g.rotations.par_iter_mut().for_each(|q| *q = self.rotation(*q));
        g.sh.par_chunks_mut(stride).for_each(|sh| self.harmonics(sh));
    }
}

/// The orthogonal matrix nearest to one that nearly is; signs of axes stay exact.
fn nearest_rotation(turn: DMat3) -> DMat3 {
    let polished = (0..4).fold(turn, |m, _| (m + m.inverse().transpose()) * 0.5);
    let exact = |v: f64| if (v - v.round()).abs() < 1e-12 { v.round() } else { v };
    DMat3::from_cols_array(&polished.to_cols_array().map(exact))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn covariance(g: &Gaussians, i: usize) -> DMat3 {
        let [w, x, y, z] = g.rotations[i].map(f64::from);
        let r = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
        let s = DMat3::from_diagonal(DVec3::from(g.log_scales[i].map(|s| f64::from(2.0 * s).exp())));
        r * s * r.transpose()
    }

    #[test]
    fn centres_and_covariances_follow_the_map() {
        let g = crate::splat::testing::cloud(50, 2);
        let turn = DMat3::from_axis_angle(DVec3::new(0.6, 0.0, 0.8), 1.3);
        let mirror = DMat3::from_diagonal(DVec3::new(1.0, -1.0, 1.0));
        for (linear, shift) in
            [(turn, DVec3::X), (2.5 * turn, DVec3::ONE), (mirror, DVec3::ZERO), (turn * mirror, DVec3::Z)]
        {
            let mut map = DMat4::from_mat3(linear);
            map.w_axis = shift.extend(1.0);
            let axes = Axes::affine(map).unwrap();
            let mut turned = g.clone();
            axes.apply(&mut turned);
            for i in 0..g.len() {
                let wanted = linear * DVec3::from(g.means[i].map(f64::from)) + shift;
                assert!((DVec3::from(turned.means[i].map(f64::from)) - wanted).length() < 1e-4);
                let (a, b) = (covariance(&turned, i), linear * covariance(&g, i) * linear.transpose());
                let largest = b.to_cols_array().iter().fold(0.0f64, |m, v| m.max(v.abs()));
                assert!((a - b).to_cols_array().iter().all(|v| v.abs() < 1e-4 * largest), "{a} {b}");
            }
        }
        assert!(Axes::affine(DMat4::from_scale(DVec3::new(1.0, 2.0, 1.0))).is_err());
        assert!(Axes::affine(DMat4::ZERO).is_err());
    }

    #[test]
    fn gaussians_are_turned_from_one_system_into_another_and_back() {
        let g = Gaussians { shift: [5000.0, 7000.0, 1.0], ..crate::splat::testing::cloud(20, 3) };
        let mut there = g.clone();
        turn(&mut there, System::SPZ, System::PLY);
        // The numbers of an SPZ as they lie: what was turned on the way is turned back.
        assert_eq!(there.means[3], [g.means[3][0], -g.means[3][1], -g.means[3][2]]);
        assert_eq!(there.shift, [5000.0, -7000.0, -1.0]);
        turn(&mut there, System::PLY, System::SPZ);
        assert_eq!(there, g);
        for system in SYSTEMS {
            assert_eq!(system.to_string().to_lowercase().parse::<System>().unwrap(), system);
            turn(&mut there, System::PLY, system);
            turn(&mut there, system, System::PLY);
            assert!(there.means.iter().zip(&g.means).all(|(a, b)| (0..3).all(|c| (a[c] - b[c]).abs() < 1e-6)));
        }
        for wrong in ["", "RDX", "RRB", "DRF", "RDFB"] {
            assert!(wrong.parse::<System>().is_err(), "{wrong}");
        }
    }

    #[test]
    fn flips_are_exact_and_undo_themselves() {
        let g = crate::splat::testing::cloud(50, 3);
        let axes = Axes::flips([1.0, -1.0, -1.0]);
        let mut there = g.clone();
        axes.apply(&mut there);
        assert_eq!(there.means[0], [g.means[0][0], -g.means[0][1], -g.means[0][2]]);
        assert_ne!(there, g);
        axes.apply(&mut there);
        assert_eq!(there, g);
    }
}
