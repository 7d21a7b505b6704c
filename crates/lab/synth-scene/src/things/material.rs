//! Colours and patterns of surfaces: functions of the position, of low frequency and moderate contrast, so that
//! photographs taken a hand's breadth apart agree.

use glam::DVec3;
use std::f64::consts::TAU;

/// A colour with a name that people use.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Paint {
    pub name: &'static str,
    /// sRGB, 0 to 1.
    pub srgb: [f64; 3],
}

/// The colours that things come in.
pub const PAINTS: [Paint; 10] = [
    Paint { name: "red", srgb: [0.80, 0.16, 0.15] },
    Paint { name: "blue", srgb: [0.16, 0.34, 0.75] },
    Paint { name: "green", srgb: [0.20, 0.58, 0.27] },
    Paint { name: "yellow", srgb: [0.93, 0.78, 0.18] },
    Paint { name: "orange", srgb: [0.92, 0.50, 0.13] },
    Paint { name: "purple", srgb: [0.50, 0.25, 0.66] },
    Paint { name: "pink", srgb: [0.93, 0.55, 0.68] },
    Paint { name: "turquoise", srgb: [0.18, 0.68, 0.68] },
    Paint { name: "white", srgb: [0.90, 0.89, 0.86] },
    Paint { name: "black", srgb: [0.16, 0.16, 0.18] },
];

// Positions in PAINTS.
pub(super) const RED: usize = 0;
pub(super) const BLUE: usize = 1;
pub(super) const GREEN: usize = 2;
pub(super) const YELLOW: usize = 3;
pub(super) const ORANGE: usize = 4;
pub(super) const PURPLE: usize = 5;
pub(super) const PINK: usize = 6;
pub(super) const TURQUOISE: usize = 7;
pub(super) const WHITE: usize = 8;
pub(super) const BLACK: usize = 9;
pub(super) const VIVID: &[usize] = &[RED, BLUE, GREEN, YELLOW, ORANGE, PURPLE, PINK, TURQUOISE];
pub(super) const ANY: &[usize] = &[RED, BLUE, GREEN, YELLOW, ORANGE, PURPLE, PINK, TURQUOISE, WHITE, BLACK];

impl Paint {
    pub fn albedo(&self) -> DVec3 {
        albedo(self.srgb)
    }

    pub fn matt(&self) -> Material {
        matt(self.srgb)
    }

    pub fn glazed(&self) -> Material {
        glazed(self.srgb)
    }
}

/// A matt surface of an sRGB colour.
pub fn matt(srgb: [f64; 3]) -> Material {
    Material::matt(albedo(srgb))
}

/// A glazed or polished surface of an sRGB colour.
pub fn glazed(srgb: [f64; 3]) -> Material {
    Material::glazed(albedo(srgb))
}

/// Linear reflectance of an sRGB colour.
pub fn albedo(srgb: [f64; 3]) -> DVec3 {
    DVec3::from_array(srgb.map(|c| if c <= 0.040_45 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }))
}

/// How a surface's colour varies over it. `other` is the second colour, linear; lengths are in metres.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Pattern {
    /// Faint clouds of this size and relative amplitude.
    Clouds { size: f64, amount: f64 },
    /// Soft-edged stripes across a direction, whose length is stripes per metre.
    Stripes { other: DVec3, across: DVec3 },
    /// Soft-edged squares of this side in x and y.
    Checks { other: DVec3, size: f64 },
    /// Boards along x with grain, `board` wide.
    Wood { board: f64 },
    /// Keys on a block's upper side: within half extents in x and y, above a height.
    Keys { other: DVec3, half: [f64; 2], above: f64 },
    /// Layers of paper at the sides of a book: outside of half extents in x and y, within those in z.
    Pages { other: DVec3, inner: DVec3 },
    /// A few soft blobs of other colours: a painting, chosen by a number.
    Painting { picture: u32 },
}

/// What a surface is made of.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Material {
    /// Diffuse reflectance, linear.
    pub albedo: DVec3,
    pub pattern: Pattern,
    /// Strength of the highlight, 0 to about 0.3.
    pub specular: f64,
    /// Share of the mirror image at a right angle, 0 to about 0.3; it grows towards grazing angles.
    pub mirror: f64,
    /// Light given off, as a multiple of the albedo: lampshades and flames.
    pub glow: f64,
}

impl Material {
    /// A matt surface with faint clouds.
    pub fn matt(albedo: DVec3) -> Self {
        Self { albedo, pattern: Pattern::Clouds { size: 0.06, amount: 0.10 }, specular: 0.0, mirror: 0.0, glow: 0.0 }
    }

    pub fn glazed(albedo: DVec3) -> Self {
        Self::matt(albedo).gleaming(0.10)
    }

    pub fn gleaming(self, specular: f64) -> Self {
        Self { specular, ..self }
    }

    /// The same material in another colour, linear.
    pub fn in_color(self, albedo: DVec3) -> Self {
        Self { albedo, ..self }
    }

    pub fn with(self, pattern: Pattern) -> Self {
        Self { pattern, ..self }
    }

    pub fn glowing(self, glow: f64) -> Self {
        Self { glow, ..self }
    }

    /// Reflectance at point `p` of the primitive's own frame.
    pub fn color(&self, p: DVec3) -> DVec3 {
        match self.pattern {
            Pattern::Clouds { size, amount } => self.albedo * (1.0 + amount * clouds(p / size)),
            Pattern::Stripes { other, across } => {
                let wave = (TAU * across.dot(p)).sin();
                self.albedo.lerp(other, soft(wave, 0.35)) * (1.0 + 0.06 * clouds(p / 0.05))
            }
            Pattern::Checks { other, size } => {
                let wave = (p.x / size * TAU / 2.0).sin() * (p.y / size * TAU / 2.0).sin();
                self.albedo.lerp(other, soft(wave, 0.25)) * (1.0 + 0.06 * clouds(p / (0.5 * size)))
            }
            Pattern::Wood { board } => {
                let row = (p.y / board).floor();
                let tone = noise(DVec3::new(0.37, row * 7.31, 0.5)) - 0.5;
                let seam = 1.0 - 0.25 * soft((TAU * p.y / board).cos() - 0.985, 0.02);
                let grain = clouds(DVec3::new(p.x / (2.0 * board) + row * 3.7, p.y / (0.18 * board), p.z / board));
                self.albedo * (1.0 + 0.22 * tone + 0.10 * grain) * seam
            }
            Pattern::Keys { other, half, above } => {
                let gap = (p.x * TAU / 0.045).cos().max((p.y * TAU / 0.035).cos());
                let key = p.z > above && p.x.abs() < half[0] && p.y.abs() < half[1];
                if key { other.lerp(self.albedo, 0.7 * soft(gap - 0.75, 0.2)) } else { self.albedo }
            }
            Pattern::Pages { other, inner } => {
                if p.z.abs() < inner.z && (p.x > inner.x || p.y.abs() > inner.y) {
                    other * (0.93 + 0.07 * (TAU * p.z / 0.008).sin())
                } else {
                    self.albedo * (1.0 + 0.08 * clouds(p / 0.05))
                }
            }
            Pattern::Painting { picture } => {
                let mut c = self.albedo;
                for k in 0..7u32 {
                    let h = |j: u32| hash(i64::from(picture), i64::from(k), i64::from(j));
                    let centre = DVec3::new(h(0) - 0.5, 0.0, h(1) - 0.5) * DVec3::new(0.7, 0.0, 0.5);
                    let paint = PAINTS[(h(2) * 8.0) as usize % 8].albedo();
                    let r = ((p - centre) * DVec3::new(1.0, 0.0, 1.0)).length();
                    c = c.lerp(paint, 0.85 * soft(0.06 + 0.09 * h(3) - r, 0.03));
                }
                c
            }
        }
    }
}

/// A step from 0 to 1 over `-width..width`.
fn soft(x: f64, width: f64) -> f64 {
    let t = (0.5 + 0.5 * x / width).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// Two octaves of value noise, about -1 to 1.
fn clouds(p: DVec3) -> f64 {
    (noise(p) + 0.5 * noise(p * 2.1 + 17.0)) / 0.75 - 1.0
}

/// Fine marks of a surface, as scratches, weave and grime make them: noise from 15 cm down to 1 cm, about -1 to 1.
pub fn marks(p: DVec3) -> f64 {
    [6.7, 16.3, 39.1, 97.0].iter().map(|&f| 2.0 * noise(p * f) - 1.0).sum::<f64>() / 2.0
}

/// A random number of 0..1 that belongs to a lattice point.
fn hash(x: i64, y: i64, z: i64) -> f64 {
    let mut h = (x as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15)
        ^ (y as u64).wrapping_mul(0xC2B2_AE3D_27D4_EB4F)
        ^ (z as u64).wrapping_mul(0x1656_67B1_9E37_79F9);
    h = (h ^ (h >> 29)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    h = (h ^ (h >> 32)).wrapping_mul(0x94D0_49BB_1331_11EB);
    ((h ^ (h >> 29)) >> 11) as f64 / (1u64 << 53) as f64
}

/// Value noise on the integer lattice, smooth, 0 to 1.
fn noise(p: DVec3) -> f64 {
    let cell = p.floor();
    let f = p - cell;
    let s = f * f * (3.0 - 2.0 * f);
    let at = |i: i64, j: i64, k: i64| hash(cell.x as i64 + i, cell.y as i64 + j, cell.z as i64 + k);
    let mix = |a: f64, b: f64, t: f64| a + (b - a) * t;
    let edge = |j, k| mix(at(0, j, k), at(1, j, k), s.x);
    mix(mix(edge(0, 0), edge(1, 0), s.y), mix(edge(0, 1), edge(1, 1), s.y), s.z)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patterns_stay_reflectances() {
        let grey = DVec3::splat(0.6);
        let patterns = [
            Pattern::Clouds { size: 0.1, amount: 0.2 },
            Pattern::Stripes { other: DVec3::ONE * 0.8, across: DVec3::X * 10.0 },
            Pattern::Checks { other: DVec3::ONE * 0.8, size: 0.1 },
            Pattern::Wood { board: 0.1 },
            Pattern::Keys { other: DVec3::ONE * 0.1, half: [0.1, 0.1], above: 0.0 },
            Pattern::Pages { other: DVec3::ONE * 0.8, inner: DVec3::splat(0.1) },
            Pattern::Painting { picture: 3 },
        ];
        for pattern in patterns {
            let m = Material::matt(grey).with(pattern);
            for i in 0..500 {
                let p = DVec3::new(f64::from(i) * 0.013 - 3.0, f64::from(i % 37) * 0.021, f64::from(i % 11) * 0.03);
                let (c, beside) = (m.color(p), m.color(p + DVec3::splat(1e-7)));
                assert!(c.min_element() > 0.0 && c.max_element() < 1.0, "{pattern:?} {c}");
                let sharp = matches!(pattern, Pattern::Keys { .. } | Pattern::Pages { .. } | Pattern::Wood { .. });
                assert!(sharp || (c - beside).length() < 1e-3, "{pattern:?}");
            }
        }
    }
}
