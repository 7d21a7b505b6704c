//! The photographs to learn from, decoded once where memory allows, at the picture size in use.

use gs_io::Result;
use gs_scene::dataset::View;
use gs_scene::{Camera, Image};
use rayon::prelude::*;

/// Photographs as 8-bit RGB, with alpha where they have it.
pub struct Photographs<'a> {
    views: Vec<&'a View>,
    budget: usize,
    divisor: u32,
    cameras: Vec<Camera>,
    /// At the views' own size; none where the budget ran out: those are decoded whenever they are wanted.
    full: Vec<Option<Picture>>,
    /// At the picture size in use, where that is smaller and the budget allows.
    small: Vec<Option<Picture>>,
}

/// A photograph in memory.
struct Picture {
    /// `[height][width][rgb]`, over black where there is alpha.
    rgb: Vec<u8>,
    /// `[height][width]`, where the file has an alpha channel.
    alpha: Option<Vec<u8>>,
}

impl Picture {
    fn new(image: &Image) -> Self {
        let alpha = image.alpha.as_ref().map(|a| a.iter().map(|v| (v * 255.0).round() as u8).collect());
        Self { rgb: image.to_rgb8(), alpha }
    }

    fn image(&self, camera: &Camera) -> Image {
        let image = Image::from_rgb8(camera.width, camera.height, &self.rgb);
        Image { alpha: self.alpha.as_ref().map(|a| a.iter().map(|&v| unit(v)).collect()), ..image }
    }

    fn over(&self, background: [f32; 3]) -> Vec<f32> {
        let mut rgb: Vec<f32> = self.rgb.iter().map(|&v| unit(v)).collect();
        for (pixel, &a) in rgb.as_chunks_mut::<3>().0.iter_mut().zip(self.alpha.iter().flatten()) {
            for (v, b) in pixel.iter_mut().zip(background) {
                *v += (1.0 - unit(a)) * b;
            }
        }
        rgb
    }
}

fn unit(v: u8) -> f32 {
    f32::from(v) * (1.0 / 255.0)
}

impl<'a> Photographs<'a> {
    /// Decodes the photographs of `views` and keeps up to `budget` bytes of them.
    ///
    /// # Errors
    /// When a photograph cannot be read or has another shape than its camera.
    pub fn load(views: Vec<&'a View>, budget: usize) -> Result<Self> {
        let cameras: Vec<Camera> = views.iter().map(|v| v.camera.clone()).collect();
        // A part is for the smaller pictures of a coarse start, at most half as wide and high.
        let fits = fitting(&cameras, budget / 5 * 4);
        let decode = |(view, fits): (&&View, bool)| fits.then(|| decode(view).map(|i| Picture::new(&i))).transpose();
        let full = views.par_iter().zip(fits).map(decode).collect::<Result<_>>()?;
        Ok(Self { views, budget, divisor: 1, cameras, full, small: Vec::new() })
    }

    /// No photographs, such as held-out ones where there are none.
    pub fn none() -> Self {
        Self { views: vec![], budget: 0, divisor: 1, cameras: vec![], full: vec![], small: vec![] }
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
        if divisor == self.divisor {
            return Ok(());
        }
        self.divisor = divisor;
        self.small = Vec::new();
        self.cameras = self.views.iter().map(|v| shrunk(&v.camera, divisor)).collect();
        if divisor > 1 {
            let fits = fitting(&self.cameras, self.budget / 5);
            let shrink = |(i, fits): (usize, bool)| fits.then(|| self.shrink(i)).transpose();
            self.small = fits.into_par_iter().enumerate().map(shrink).collect::<Result<_>>()?;
        }
        Ok(())
    }

    /// Photograph `i` at its own size, over black where it has alpha. It is the same 8-bit picture whether it was kept or
    /// not.
    ///
    /// # Errors
    /// When it has to be decoded again and cannot be.
    pub fn image(&self, i: usize) -> Result<Image> {
        let camera = &self.views[i].camera;
        match &self.full[i] {
            Some(picture) => Ok(picture.image(camera)),
            None => Ok(Picture::new(&decode(self.views[i])?).image(camera)),
        }
    }

    fn shrink(&self, i: usize) -> Result<Picture> {
        let c = &self.cameras[i];
        Ok(Picture::new(&self.image(i)?.resize_area(c.width, c.height)))
    }

    /// The camera of photograph `i` at the picture size in use.
    pub fn camera(&self, i: usize) -> &Camera {
        &self.cameras[i]
    }

    /// Photograph `i` as `[height][width][rgb]`, 0 to 1, with `background` behind its transparent pixels.
    ///
    /// # Errors
    /// When it has to be decoded again and cannot be.
    pub fn target(&self, i: usize, background: [f32; 3]) -> Result<Vec<f32>> {
        let kept = if self.divisor > 1 { &self.small } else { &self.full };
        match kept.get(i).and_then(Option::as_ref) {
            Some(picture) => Ok(picture.over(background)),
            None if self.divisor > 1 => Ok(self.shrink(i)?.over(background)),
            None => Ok(Picture::new(&decode(self.views[i])?).over(background)),
        }
    }
}

/// The camera at a fraction of its size, at least one pixel.
pub fn shrunk(camera: &Camera, divisor: u32) -> Camera {
    let shrink = |v: u32| ((f64::from(v) / f64::from(divisor.max(1))).round() as u32).max(1);
    camera.resized(shrink(camera.width), shrink(camera.height))
}

/// Which cameras' photographs fit in `budget` bytes, in order.
fn fitting(cameras: &[Camera], budget: usize) -> Vec<bool> {
    let mut left = budget;
    let fits = |c: &Camera| {
        let bytes = 3 * c.width as usize * c.height as usize;
        let fits = bytes <= left;
        left -= if fits { bytes } else { 0 };
        fits
    };
    cameras.iter().map(fits).collect()
}

/// A view's photograph, multiplied by its alpha: pictures can then be shrunk before a background is put behind them.
fn decode(view: &View) -> Result<Image> {
    let mut image = view.load_image()?;
    if let Some(alpha) = &image.alpha {
        for (pixel, a) in image.rgb.chunks_exact_mut(3).zip(alpha) {
            pixel.iter_mut().for_each(|v| *v *= a);
        }
    }
    Ok(image)
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
        let background = [0.0, 0.5, 1.0];
        let mut black = image.clone();
        black.rgb[3..].iter_mut().for_each(|v| *v *= 0.25);
        let kept = Picture::new(&black).over(background);
        let flat = over_background(image, background);
        assert_eq!(flat.rgb, [1.0, 0.5, 0.0, 0.25, 0.5, 0.75]);
        assert!(flat.alpha.is_none());
        assert!(kept.iter().zip(&flat.rgb).all(|(a, b)| (a - b).abs() < 0.004), "{kept:?}");
    }
}
