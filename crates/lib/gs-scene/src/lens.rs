//! The camera as it took a photograph, with the distortion of its lens.

use gs_io::{Error, Result};
use std::path::Path;

/// Coefficients of OpenCV's model; SIMPLE_RADIAL and RADIAL are its special cases.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(crate) struct Distortion {
    /// Radial coefficients of r^2, r^4 and r^6 in the numerator.
    pub(crate) k: [f64; 3],
    /// Radial coefficients of r^2, r^4 and r^6 in the denominator (FULL_OPENCV).
    pub(crate) denominator: [f64; 3],
    /// Tangential coefficients.
    pub(crate) p: [f64; 2],
}

impl Distortion {
    /// Whether all coefficients are zero.
    pub(crate) fn is_none(&self) -> bool {
        *self == Self::default()
    }

    /// Where the lens sends the ray through (x, y, 1): normalised image coordinates, undistorted to distorted.
    #[inline(always)]
    pub(crate) fn distort(&self, x: f64, y: f64) -> (f64, f64) {
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

/// The camera as it took the photograph.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Lens {
    /// Width and height of the photograph.
    pub(crate) size: (u32, u32),
    /// fx, fy, cx, cy in pixels of the photograph.
    pub(crate) focal_center: [f64; 4],
    /// Zero for pinhole models.
    pub(crate) distortion: Distortion,
}

impl Lens {
    /// Refuses a photograph of another size.
    pub(crate) fn expect_size(&self, (w, h): (u32, u32), path: &Path) -> Result<()> {
        if (w, h) == self.size {
            return Ok(());
        }
        Err(Error::new("the photograph has another size than its camera")
            .file(path)
            .field("size")
            .found(format!("{w}x{h}"))
            .expected(format!("{}x{}", self.size.0, self.size.1))
            .hint("use the photographs that the poses were made from"))
    }

    /// The lens with focal lengths so many times as long. Its distortion bends the same pixels by as much: what was undistorted
    /// before stays as it is.
    pub(crate) fn zoomed(&self, by: f64) -> Self {
        let [fx, fy, cx, cy] = self.focal_center;
        let Distortion { k, denominator, p } = self.distortion;
        let radial = |k: [f64; 3]| [k[0] * by.powi(2), k[1] * by.powi(4), k[2] * by.powi(6)];
        let distortion = Distortion { k: radial(k), denominator: radial(denominator), p: p.map(|p| p * by) };
        Self { focal_center: [fx * by, fy * by, cx, cy], distortion, ..*self }
    }

    /// The lens of the photograph turned clockwise by a quarter. Radial distortion stays; the tangential turns as the vector (p2, p1).
    pub(crate) fn turned_quarter(&self) -> Self {
        let ([fx, fy, cx, cy], (width, height)) = (self.focal_center, self.size);
        let [p1, p2] = self.distortion.p;
        let distortion = Distortion { p: [p2, -p1], ..self.distortion };
        Self { size: (height, width), focal_center: [fy, fx, f64::from(height) - cy, cx], distortion }
    }

    /// Where in the photograph the pinhole camera's point (x, y) is seen; the pinhole camera has the same principal
    /// point and `zoom` times the focal lengths.
    #[inline(always)]
    pub(crate) fn locate(&self, zoom: f64, x: f64, y: f64) -> (f64, f64) {
        let [fx, fy, cx, cy] = self.focal_center;
        let (u, v) = self.distortion.distort((x - cx) / (fx * zoom), (y - cy) / (fy * zoom));
        (u * fx + cx, v * fy + cy)
    }

    /// The smallest zoom, at least 1, at which the photograph fills the whole pinhole image: a lens that pulls the
    /// corners outwards leaves nothing to show there. None where there is no such zoom up to 4.
    pub(crate) fn zoom(&self) -> Option<f64> {
        if self.distortion.is_none() {
            return Some(1.0);
        }
        (0..=600).map(|i| 1.0 + 0.005 * f64::from(i)).find(|&zoom| self.fills(zoom))
    }

    /// Whether the pinhole image's border lies within the photograph, by half a pixel, and the lens does not fold: the
    /// way from the principal point to the border only ever leads outwards.
    fn fills(&self, zoom: f64) -> bool {
        const STEPS: i32 = 64;
        let (w, h) = (f64::from(self.size.0), f64::from(self.size.1));
        let [_, _, cx, cy] = self.focal_center;
        let border = (0..=STEPS).map(|i| f64::from(i) / f64::from(STEPS));
        let mut border = border.flat_map(|t| [(t * w, 0.0), (t * w, h), (0.0, t * h), (w, t * h)]);
        border.all(|(x, y)| {
            let mut before = 0.0;
            (1..=8).all(|i| {
                let t = f64::from(i) / 8.0;
                let (u, v) = self.locate(zoom, cx + t * (x - cx), cy + t * (y - cy));
                let distance = (u - cx).hypot(v - cy);
                let outwards = distance > before;
                before = distance;
                outwards && (-0.5..=w + 0.5).contains(&u) && (-0.5..=h + 0.5).contains(&v)
            })
        })
    }
}
