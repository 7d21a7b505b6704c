//! Lens distortion of the OpenCV family.

/// Coefficients of OpenCV's model; SIMPLE_RADIAL and RADIAL are its special cases.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Distortion {
    /// Radial coefficients of r^2, r^4 and r^6 in the numerator.
    pub k: [f64; 3],
    /// Radial coefficients of r^2, r^4 and r^6 in the denominator (FULL_OPENCV).
    pub denominator: [f64; 3],
    /// Tangential coefficients.
    pub p: [f64; 2],
}

impl Distortion {
    /// Whether all coefficients are zero.
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }

    /// Where the lens sends the ray through (x, y, 1): normalised image coordinates, undistorted to distorted.
    pub fn distort(&self, x: f64, y: f64) -> (f64, f64) {
        let r2 = x * x + y * y;
        let poly = |c: &[f64; 3]| 1.0 + r2 * (c[0] + r2 * (c[1] + r2 * c[2]));
        let radial = poly(&self.k) / poly(&self.denominator);
        let [p1, p2] = self.p;
        (
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn matches_the_formula_by_hand() {
        let d = Distortion { k: [0.1, -0.02, 0.0], p: [0.001, -0.002], ..Distortion::default() };
        let (x, y) = d.distort(0.5, -0.25);
        let (r2, radial) = (0.3125, 1.0 + 0.1 * 0.3125 - 0.02 * 0.3125 * 0.3125);
        assert!((x - (0.5 * radial + 2.0 * 0.001 * 0.5 * -0.25 - 0.002 * (r2 + 0.5))).abs() < 1e-15);
        assert!((y - (-0.25 * radial + 0.001 * (r2 + 0.125) - 2.0 * 0.002 * 0.5 * -0.25)).abs() < 1e-15);
    }
}
