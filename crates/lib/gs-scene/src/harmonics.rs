//! Real spherical harmonics up to degree 3, in 3DGS's order and signs, and what they become in other axes.

use glam::{DMat3, DVec3};

/// Factor of degree 0.
pub const C0: f64 = 0.282_094_791_773_878_14;
/// Factor of degree 1, whose functions are -y, z, -x.
pub const C1: f64 = 0.488_602_511_902_919_9;
/// Factors of degree 2.
pub const C2: [f64; 5] = [
    1.092_548_430_592_079_2,
    -1.092_548_430_592_079_2,
    0.315_391_565_252_520_05,
    -1.092_548_430_592_079_2,
    0.546_274_215_296_039_6,
];
/// Factors of degree 3.
pub const C3: [f64; 7] = [
    -0.590_043_589_926_643_5,
    2.890_611_442_640_554_4,
    -0.457_045_799_464_465_7,
    0.373_176_332_590_115_4,
    -0.457_045_799_464_465_7,
    1.445_305_721_320_277_2,
    -0.590_043_589_926_643_5,
];

/// Values of the basis at a unit direction; only the first (degree + 1)^2 are set.
#[inline(always)]
pub fn basis(degree: u8, DVec3 { x, y, z }: DVec3) -> [f64; 16] {
    let mut b = [0.0; 16];
    b[0] = C0;
    if degree >= 1 {
        b[1] = -C1 * y;
        b[2] = C1 * z;
        b[3] = -C1 * x;
    }
    let (xx, yy, zz) = (x * x, y * y, z * z);
    if degree >= 2 {
        b[4] = C2[0] * x * y;
        b[5] = C2[1] * y * z;
        b[6] = C2[2] * (2.0 * zz - xx - yy);
        b[7] = C2[3] * x * z;
        b[8] = C2[4] * (xx - yy);
    }
    if degree >= 3 {
        b[9] = C3[0] * y * (3.0 * xx - yy);
        b[10] = C3[1] * x * y * z;
        b[11] = C3[2] * y * (4.0 * zz - xx - yy);
        b[12] = C3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy);
        b[13] = C3[4] * x * (4.0 * zz - xx - yy);
        b[14] = C3[5] * z * (xx - yy);
        b[15] = C3[6] * x * (xx - 3.0 * yy);
    }
    b
}

/// How coefficients change when a scene is turned or mirrored.
#[derive(Debug, Clone, PartialEq)]
pub struct Turned {
    /// One square matrix a degree, 1 to 3: of 3, 5 and 7 rows, the rest zero.
    bands: [[[f64; 7]; 7]; 3],
}

/// Nodes and weights of Gauss and Legendre's rule for degree 7, z and -z.
const NODES: [(f64, f64); 2] =
    [(0.339_981_043_584_856_3, 0.652_145_154_862_546_1), (0.861_136_311_594_052_6, 0.347_854_845_137_453_9)];
/// Directions around the axis at each node: exact up to order 7.
const AROUND: u32 = 8;

impl Turned {
    /// For a scene whose directions d become `turn` d; `turn` is orthogonal. Row i, column j is the integral over the sphere of
    /// function i times function j in the old axes, by a rule that is exact for such products.
    pub fn new(turn: DMat3) -> Self {
        let mut bands = [[[0.0; 7]; 7]; 3];
        for (z, weight) in NODES.into_iter().flat_map(|(z, w)| [(z, w), (-z, w)]) {
            for k in 0..AROUND {
                let (sin, cos) = (std::f64::consts::TAU * (f64::from(k) + 0.5) / f64::from(AROUND)).sin_cos();
                let flat = (1.0 - z * z).sqrt();
                let d = DVec3::new(flat * cos, flat * sin, z);
                let (new, old) = (basis(3, d), basis(3, turn.transpose() * d));
                let share = weight * std::f64::consts::TAU / f64::from(AROUND);
                for (l, band) in (1..).zip(&mut bands) {
                    for i in 0..2 * l + 1 {
                        for j in 0..2 * l + 1 {
                            band[i][j] += share * new[l * l + i] * old[l * l + j];
                        }
                    }
                }
            }
        }
        // Flips of axes are exact.
        for value in bands.iter_mut().flatten().flatten() {
            if (*value - value.round()).abs() < 1e-12 {
                *value = value.round();
            }
        }
        Self { bands }
    }

    /// Changes the coefficients `[coefficients][rgb]` of one Gaussian, of any degree up to 3.
    pub fn apply(&self, sh: &mut [f32]) {
        for (l, band) in (1..).zip(&self.bands) {
            let Some(part) = sh.get_mut(3 * l * l..3 * (l + 1) * (l + 1)) else { return };
            for channel in 0..3 {
                let old: [f64; 7] = std::array::from_fn(|j| part.get(3 * j + channel).map_or(0.0, |v| f64::from(*v)));
                for i in 0..2 * l + 1 {
                    part[3 * i + channel] = (0..2 * l + 1).map(|j| band[i][j] * old[j]).sum::<f64>() as f32;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_turned_scene_shows_its_colour_from_the_turned_direction(
            axis in proptest::array::uniform3(-1.0f64..1.0), angle in -4.0f64..4.0, mirrored: bool,
            from in proptest::array::uniform3(-1.0f64..1.0), sh in proptest::collection::vec(-1.0f32..1.0, 48),
        ) {
            let (Some(axis), Some(from)) = (DVec3::from(axis).try_normalize(), DVec3::from(from).try_normalize())
                else { return Ok(()) };
            let turn = DMat3::from_axis_angle(axis, angle) * if mirrored { -1.0 } else { 1.0 };
            let mut turned = sh.clone();
            Turned::new(turn).apply(&mut turned);
            let color = |sh: &[f32], d: DVec3| -> f64 {
                basis(3, d).iter().zip(sh.chunks(3)).map(|(b, c)| b * f64::from(c[1])).sum()
            };
            prop_assert!((color(&sh, from) - color(&turned, turn * from)).abs() < 1e-5);
        }
    }

    #[test]
    fn flips_change_signs_and_nothing_else() {
        let sh: Vec<f32> = (0..48).map(|i| (i as f32).sin()).collect();
        let mut flipped = sh.clone();
        let flip = Turned::new(DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0)));
        flip.apply(&mut flipped);
        let signs = [1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1];
        for (i, (a, b)) in sh.iter().zip(&flipped).enumerate() {
            assert_eq!(*b, *a * signs[i / 3] as f32, "{i}");
        }
        // Fewer degrees are changed in the same way.
        let mut low = sh[..12].to_vec();
        flip.apply(&mut low);
        assert_eq!(low, flipped[..12]);
    }
}
