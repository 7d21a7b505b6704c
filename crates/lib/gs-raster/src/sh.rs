//! Gradients of colours from spherical harmonics.

use glam::DVec3;
pub(crate) use gs_scene::harmonics::basis;
use gs_scene::harmonics::{C1, C2, C3};

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
