//! Real spherical harmonics up to degree 3, in 3DGS's order and signs.

use glam::DVec3;

const C0: f64 = 0.282_094_791_773_878_14;
const C1: f64 = 0.488_602_511_902_919_9;
const C2: [f64; 5] = [
    1.092_548_430_592_079_2,
    -1.092_548_430_592_079_2,
    0.315_391_565_252_520_05,
    -1.092_548_430_592_079_2,
    0.546_274_215_296_039_6,
];
const C3: [f64; 7] = [
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
pub(crate) fn basis(degree: u8, DVec3 { x, y, z }: DVec3) -> [f64; 16] {
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

/// Gradients of the basis functions as functions of x, y, z.
#[inline(always)]
fn basis_gradient(degree: u8, DVec3 { x, y, z }: DVec3) -> [DVec3; 16] {
    let mut b = [DVec3::ZERO; 16];
    let v = DVec3::new;
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

/// A direction at length 1 (0 for what has none), and 1 / its length (or 0).
#[inline(always)]
pub(crate) fn unit(d: DVec3) -> (DVec3, f64) {
    let length = d.dot(d).sqrt();
    let inverse = if length > 0.0 { 1.0 / length } else { 0.0 };
    (d * inverse, inverse)
}

/// d loss / d direction (of any length), given per basis function the sum over channels of coefficient times d loss / d colour.
#[inline(always)]
pub(crate) fn direction_gradient(degree: u8, direction: DVec3, weights: &[f64; 16]) -> DVec3 {
    let (d, inverse) = unit(direction);
    let gradient = basis_gradient(degree, d);
    let mut d_unit = DVec3::ZERO;
    for (w, g) in weights.iter().zip(gradient).skip(1) {
        d_unit += w * g;
    }
    (d_unit - d * d.dot(d_unit)) * inverse
}
