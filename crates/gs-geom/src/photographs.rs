//! The photographs to learn from, decoded once where memory allows, at the picture size in use.

use gs_io::Result;
use gs_scene::dataset::View;
use gs_scene::{Camera, Image};
use rayon::prelude::*;

/// Photographs over a background, as 8-bit RGB.
pub struct Photographs<'a> {
    views: Vec<&'a View>,
    background: [f32; 3],
    budget: usize,
    divisor: u32,
    cameras: Vec<Camera>,
    /// Decoded pictures; none where the budget ran out: those are decoded whenever they are wanted.
    pixels: Vec<Option<Vec<u8>>>,
}

impl<'a> Photographs<'a> {
    /// Decodes the photographs of `views`, with `background` behind transparent ones, and keeps up to `budget` bytes of
    /// them.
    ///
    /// # Errors
    /// When a photograph cannot be read or has another shape than its camera.
    pub fn load(views: Vec<&'a View>, background: [f32; 3], budget: usize, divisor: u32) -> Result<Self> {
        let mut all = Self { views, background, budget, divisor, cameras: Vec::new(), pixels: Vec::new() };
        all.reload()?;
        Ok(all)
    }

    /// Number of photographs.
    pub fn len(&self) -> usize {
        self.views.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.views.is_empty()
    }

    /// Changes the picture size to the views' own divided by `divisor`.
    ///
    /// # Errors
    /// As [`Self::load`].
    pub fn set_divisor(&mut self, divisor: u32) -> Result<()> {
        if divisor != self.divisor {
            self.divisor = divisor;
            self.reload()?;
        }
        Ok(())
    }

    fn reload(&mut self) -> Result<()> {
        let divisor = self.divisor.max(1);
        let shrink = |v: u32| ((f64::from(v) / f64::from(divisor)).round() as u32).max(1);
        self.cameras =
            self.views.iter().map(|v| v.camera.resized(shrink(v.camera.width), shrink(v.camera.height))).collect();
        // The old pictures go first: the budget holds for old and new together.
        self.pixels = Vec::new();
        let mut left = self.budget;
        let fits: Vec<bool> = self
            .cameras
            .iter()
            .map(|c| {
                let bytes = 3 * c.width as usize * c.height as usize;
                let fits = bytes <= left;
                left -= if fits { bytes } else { 0 };
                fits
            })
            .collect();
        self.pixels = fits
            .into_par_iter()
            .enumerate()
            .map(|(i, fits)| if fits { self.decode(i).map(Some) } else { Ok(None) })
            .collect::<Result<_>>()?;
        Ok(())
    }

    fn decode(&self, i: usize) -> Result<Vec<u8>> {
        let c = &self.cameras[i];
        Ok(over_background(self.views[i].load_image()?, self.background).resize_area(c.width, c.height).to_rgb8())
    }

    /// The camera of photograph `i` at the picture size in use.
    pub fn camera(&self, i: usize) -> &Camera {
        &self.cameras[i]
    }

    /// Photograph `i` as `[height][width][rgb]`, 0 to 1.
    ///
    /// # Errors
    /// When it has to be decoded again and cannot be.
    pub fn target(&self, i: usize) -> Result<Vec<f32>> {
        let decoded;
        let bytes = match &self.pixels[i] {
            Some(bytes) => bytes,
            None => {
                decoded = self.decode(i)?;
                &decoded
            }
        };
        Ok(bytes.iter().map(|&v| f32::from(v) * (1.0 / 255.0)).collect())
    }
}

/// The picture with a colour behind its transparent pixels.
pub fn over_background(mut image: Image, background: [f32; 3]) -> Image {
    if let Some(alpha) = image.alpha.take() {
        for (pixel, a) in image.rgb.chunks_exact_mut(3).zip(alpha) {
            for (v, b) in pixel.iter_mut().zip(background) {
                *v = a * *v + (1.0 - a) * b;
            }
        }
    }
    image
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn transparent_pixels_show_the_background() {
        let image =
            Image { width: 2, height: 1, rgb: vec![1.0, 0.5, 0.0, 1.0, 0.5, 0.0], alpha: Some(vec![1.0, 0.25]) };
        let flat = over_background(image, [0.0, 0.5, 1.0]);
        assert_eq!(flat.rgb, [1.0, 0.5, 0.0, 0.25, 0.5, 0.75]);
        assert!(flat.alpha.is_none());
    }
}
