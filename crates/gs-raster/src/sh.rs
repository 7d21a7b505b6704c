//! Real spherical harmonics up to degree 3, in 3DGS's order and signs.

// Digits for double precision, which the tests compile this file in.
#![allow(clippy::excessive_precision)]

use super::real::{Real, Vec3};
use gs_scene::sh_coefficients;

const C0: Real = 0.282_094_791_773_878_14;
const C1: Real = 0.488_602_511_902_919_92;
const C2: [Real; 5] = [
    1.092_548_430_592_079_2,
    -1.092_548_430_592_079_2,
    0.315_391_565_252_520_05,
    -1.092_548_430_592_079_2,
    0.546_274_215_296_039_59,
];
const C3: [Real; 7] = [
    -0.590_043_589_926_643_52,
    2.890_611_442_640_554_4,
    -0.457_045_799_464_465_74,
    0.373_176_332_590_115_4,
    -0.457_045_799_464_465_74,
    1.445_305_721_320_277_2,
    -0.590_043_589_926_643_52,
];

/// Values of the basis at a unit direction; only the first (degree + 1)^2 are set.
#[inline(always)]
fn basis(degree: u8, d: Vec3) -> [Real; 16] {
    let mut b = [0.0; 16];
    b[0] = C0;
    let (x, y, z) = (d.x, d.y, d.z);
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

/// Gradients of the basis functions as functions of x, y, z.
#[inline(always)]
fn basis_gradient(degree: u8, d: Vec3) -> [Vec3; 16] {
    let mut b = [Vec3::ZERO; 16];
    let (x, y, z) = (d.x, d.y, d.z);
    let v = Vec3::new;
    if degree >= 1 {
        b[1] = v(0.0, -C1, 0.0);
        b[2] = v(0.0, 0.0, C1);
        b[3] = v(-C1, 0.0, 0.0);
    }
    if degree >= 2 {
        b[4] = C2[0] * v(y, x, 0.0);
        b[5] = C2[1] * v(0.0, z, y);
        b[6] = C2[2] * v(-2.0 * x, -2.0 * y, 4.0 * z);
        b[7] = C2[3] * v(z, 0.0, x);
        b[8] = C2[4] * v(2.0 * x, -2.0 * y, 0.0);
    }
    if degree >= 3 {
        let (xx, yy, zz) = (x * x, y * y, z * z);
        b[9] = C3[0] * v(6.0 * x * y, 3.0 * xx - 3.0 * yy, 0.0);
        b[10] = C3[1] * v(y * z, x * z, x * y);
        b[11] = C3[2] * v(-2.0 * x * y, 4.0 * zz - xx - 3.0 * yy, 8.0 * y * z);
        b[12] = C3[3] * v(-6.0 * x * z, -6.0 * y * z, 6.0 * zz - 3.0 * xx - 3.0 * yy);
        b[13] = C3[4] * v(4.0 * zz - 3.0 * xx - yy, -2.0 * x * y, 8.0 * x * z);
        b[14] = C3[5] * v(2.0 * x * z, -2.0 * y * z, xx - yy);
        b[15] = C3[6] * v(3.0 * xx - 3.0 * yy, -6.0 * x * y, 0.0);
    }
    b
}

/// Colour seen along `direction` (any length), before it is cut at zero: 0.5 + sum of coefficients times basis.
pub(crate) fn color(sh: &[Real], degree: u8, direction: Vec3) -> [Real; 3] {
    let b = basis(degree, direction.normalize_or_zero());
    let mut out = [0.5; 3];
    for k in 0..sh_coefficients(degree) {
        for c in 0..3 {
            out[c] += b[k] * sh[3 * k + c];
        }
    }
    out
}

/// Adds d loss / d coefficients to `d_sh` and returns d loss / d direction (not normalised).
pub(crate) fn color_backward(sh: &[Real], degree: u8, direction: Vec3, d_color: [Real; 3], d_sh: &mut [Real]) -> Vec3 {
    // Loops of constant length for each degree.
    match degree {
        0 => color_backward_of::<0>(sh, direction, d_color, d_sh),
        1 => color_backward_of::<1>(sh, direction, d_color, d_sh),
        2 => color_backward_of::<2>(sh, direction, d_color, d_sh),
        _ => color_backward_of::<3>(sh, direction, d_color, d_sh),
    }
}

#[inline(always)]
fn color_backward_of<const DEGREE: u8>(sh: &[Real], direction: Vec3, d_color: [Real; 3], d_sh: &mut [Real]) -> Vec3 {
    let count = const { sh_coefficients(DEGREE) };
    let (sh, d_sh) = (&sh[..3 * count], &mut d_sh[..3 * count]);
    let length = direction.length();
    let d = direction.normalize_or_zero();
    let b = basis(DEGREE, d);
    for k in 0..count {
        for c in 0..3 {
            d_sh[3 * k + c] += b[k] * d_color[c];
        }
    }
    if DEGREE == 0 || length == 0.0 {
        return Vec3::ZERO;
    }
    let gradient = basis_gradient(DEGREE, d);
    let mut d_unit = Vec3::ZERO;
    for k in 1..count {
        let s = sh[3 * k] * d_color[0] + sh[3 * k + 1] * d_color[1] + sh[3 * k + 2] * d_color[2];
        d_unit += s * gradient[k];
    }
    (d_unit - d * d.dot(d_unit)) / length
}
