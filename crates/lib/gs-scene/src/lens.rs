//! The camera as it took a photograph, with the distortion of its lens.

use crate::distortion::Distortion;
use crate::image;
use gs_io::{Error, Result};
use std::path::Path;

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
    pub(crate) fn check_size(&self, path: &Path) -> Result<()> {
        self.expect_size(image::size_of(path)?, path)
    }

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

    /// Where in the photograph the pinhole camera's point (x, y) is seen; the pinhole camera has the same principal
    /// point and `zoom` times the focal lengths.
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
