//! The photographs to learn from, decoded once where memory allows, at the picture size in use.

pub mod border;
pub mod masks;

use gs_io::{Result, Watched};
use gs_scene::dataset::View;
use gs_scene::{Camera, Image, image_has_alpha};
use masks::Masks;
use rayon::prelude::*;

/// Photographs as 8-bit RGB, with alpha where they have it.
pub struct Photographs<'a> {
    views: Vec<&'a View>,
    masks: Masks,
    watched: &'a Watched,
    budget: usize,
    /// Bytes per pixel of each photograph: 3, and 1 for alpha.
    bytes: Vec<usize>,
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

    fn over(&self, background: [f32; 3]) -> Target {
        let values = |bytes: &Vec<u8>| bytes.iter().map(|&v| unit(v)).collect();
        Target::over(values(&self.rgb), self.alpha.as_ref().map(values), background)
    }
}

/// What a render is compared with.
#[derive(Debug, Clone, PartialEq)]
pub struct Target {
    /// `[height][width][rgb]`, 0 to 1, over some background.
    pub rgb: Vec<f32>,
    /// `[height][width]`, 0 to 1, where the photograph has an alpha channel or a mask.
    pub alpha: Option<Vec<f32>>,
}

impl Target {
    /// A photograph that is multiplied by its alpha, with a colour behind it.
    fn over(mut rgb: Vec<f32>, alpha: Option<Vec<f32>>, background: [f32; 3]) -> Self {
        for (pixel, a) in rgb.as_chunks_mut::<3>().0.iter_mut().zip(alpha.iter().flatten()) {
            for (v, b) in pixel.iter_mut().zip(background) {
                *v += (1.0 - a) * b;
            }
        }
        Self { rgb, alpha }
    }
}

fn unit(v: u8) -> f32 {
    f32::from(v) * (1.0 / 255.0)
}

impl<'a> Photographs<'a> {
    /// Decodes the photographs of `views` and keeps up to `budget` bytes of them.
    pub fn load(views: Vec<&'a View>, masks: Masks, budget: usize, watched: &'a Watched) -> Result<Self> {
        let cameras: Vec<Camera> = views.iter().map(|v| v.camera.clone()).collect();
        let bytes = views.par_iter().map(|v| bytes_per_pixel(v, &masks)).collect::<Result<Vec<usize>>>()?;
        let fits = fitting(&cameras, &bytes, full_share(budget));
        let decode = |(view, fits): (&&View, bool)| {
            fits.then(|| unchanged(view, &masks, watched).map(|i| Picture::new(&i))).transpose()
        };
        let full = views.par_iter().zip(fits).map(decode).collect::<Result<_>>()?;
        Ok(Self { views, masks, watched, budget, bytes, divisor: 1, cameras, full, small: Vec::new() })
    }

    /// Bytes of the photographs that are kept at their own size.
    pub fn kept_bytes(&self) -> usize {
        let size = |p: &Picture| p.rgb.len() + p.alpha.as_ref().map_or(0, Vec::len);
        self.full.iter().flatten().map(size).sum()
    }

    pub fn names(&self) -> impl Iterator<Item = &str> + Clone {
        self.views.iter().map(|v| v.name.as_str())
    }

    pub fn len(&self) -> usize {
        self.views.len()
    }

    /// Changes the picture size to the views' own divided by `divisor`.
    pub fn set_divisor(&mut self, divisor: u32) -> Result<()> {
        if divisor == self.divisor {
            return Ok(());
        }
        self.divisor = divisor;
        self.small = Vec::new();
        self.cameras = self.views.iter().map(|v| shrunk(&v.camera, divisor)).collect();
        if divisor > 1 {
            let fits = fitting(&self.cameras, &self.bytes, self.budget - full_share(self.budget));
            let shrink = |(i, fits): (usize, bool)| fits.then(|| self.shrink(i)).transpose();
            self.small = fits.into_par_iter().enumerate().map(shrink).collect::<Result<_>>()?;
        }
        Ok(())
    }

    /// Photograph `i` at its own size, over black where it has alpha. It is the same 8-bit picture whether it was kept or
    /// not.
    fn image(&self, i: usize) -> Result<Image> {
        let camera = &self.views[i].camera;
        self.full[i].as_ref().map_or_else(|| Ok(self.decoded(i)?.image(camera)), |p| Ok(p.image(camera)))
    }

    fn decoded(&self, i: usize) -> Result<Picture> {
        Ok(Picture::new(&unchanged(self.views[i], &self.masks, self.watched)?))
    }

    fn shrink(&self, i: usize) -> Result<Picture> {
        let c = &self.cameras[i];
        Ok(Picture::new(&self.image(i)?.resize_area(c.width, c.height)))
    }

    /// The camera of photograph `i` at the picture size in use.
    pub fn camera(&self, i: usize) -> &Camera {
        &self.cameras[i]
    }

    /// Photograph `i` with `background` behind its transparent pixels; over black it is multiplied by its alpha.
    pub fn target(&self, i: usize, background: [f32; 3]) -> Result<Target> {
        let kept = if self.divisor > 1 { &self.small } else { &self.full };
        match kept.get(i).and_then(Option::as_ref) {
            Some(picture) => Ok(picture.over(background)),
            None if self.divisor > 1 => Ok(self.shrink(i)?.over(background)),
            None => Ok(self.decoded(i)?.over(background)),
        }
    }
}

/// The camera at a fraction of its size, at least one pixel.
fn shrunk(camera: &Camera, divisor: u32) -> Camera {
    let shrink = |v: u32| ((f64::from(v) / f64::from(divisor.max(1))).round() as u32).max(1);
    camera.resized(shrink(camera.width), shrink(camera.height))
}

/// The part of a budget that is for photographs at their own size; the rest is for the smaller pictures of a coarse start,
/// at most half as wide and high.
pub fn full_share(budget: usize) -> usize {
    budget / 5 * 4
}

/// Bytes of a kept photograph's pixel.
pub fn bytes_per_pixel(view: &View, masks: &Masks) -> Result<usize> {
    let own = masks.of(view).is_some() || masks.border((view.camera.width, view.camera.height)).is_some();
    Ok(if own || image_has_alpha(&view.image_path)? { 4 } else { 3 })
}

/// Which photographs, of `bytes` a pixel, fit in `budget` bytes, in order.
fn fitting(cameras: &[Camera], bytes: &[usize], budget: usize) -> Vec<bool> {
    let mut left = budget;
    let fits = |(c, bytes): (&Camera, &usize)| {
        let bytes = bytes * c.width as usize * c.height as usize;
        let fits = bytes <= left;
        left -= if fits { bytes } else { 0 };
        fits
    };
    cameras.iter().zip(bytes).map(fits).collect()
}

/// As [`decode`], from files that are still as they were watched. They are looked at after they are read, so that what came of
/// another content is never used.
fn unchanged(view: &View, masks: &Masks, watched: &Watched) -> Result<Image> {
    let image = decode(view, masks);
    watched.check_one(&view.image_path)?;
    masks.of(view).map_or(Ok(()), |mask| watched.check_one(mask))?;
    image
}

/// A view's photograph, multiplied by its alpha and its mask: pictures can then be shrunk before a background is put behind
/// them.
fn decode(view: &View, masks: &Masks) -> Result<Image> {
    let mut image = view.load_image()?;
    let mask = masks.of(view).map(|mask| view.load_mask(mask)).transpose()?;
    let border = masks.border((image.width, image.height)).map(<[f32]>::to_vec);
    for mask in mask.into_iter().chain(border) {
        match &mut image.alpha {
            Some(alpha) => alpha.iter_mut().zip(&mask).for_each(|(a, m)| *a *= m),
            None => image.alpha = Some(mask),
        }
    }
    if let Some(alpha) = &image.alpha {
        for (pixel, a) in image.rgb.chunks_exact_mut(3).zip(alpha) {
            pixel.iter_mut().for_each(|v| *v *= a);
        }
    }
    Ok(image)
}

/// A view's photograph at full precision, with a colour behind its transparent pixels.
pub fn exact_target(view: &View, masks: &Masks, background: [f32; 3]) -> Result<Target> {
    let Image { rgb, alpha, .. } = decode(view, masks)?;
    Ok(Target::over(rgb, alpha, background))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn transparent_pixels_show_the_background() {
        // Multiplied by their alpha.
        let image =
            Image { width: 2, height: 1, rgb: vec![1.0, 0.5, 0.0, 0.25, 0.125, 0.0], alpha: Some(vec![1.0, 0.25]) };
        let kept = Picture::new(&image).over([0.0, 0.5, 1.0]);
        let wanted = [1.0, 0.5, 0.0, 0.25, 0.5, 0.75];
        assert!(kept.rgb.iter().zip(wanted).all(|(a, b)| (a - b).abs() < 0.004), "{kept:?}");
        assert!(kept.alpha.unwrap().iter().zip([1.0, 0.25]).all(|(a, b)| (a - b).abs() < 0.002));
    }

    #[test]
    fn photographs_fit_by_their_bytes() {
        let camera = Camera::look_at(glam::DVec3::X, glam::DVec3::ZERO, glam::DVec3::Z, 10, 10, 1.0);
        let cameras = vec![camera; 3];
        assert_eq!(fitting(&cameras, &[3, 4, 3], 699), [true, false, true]);
        assert_eq!(fitting(&cameras, &[3, 4, 3], 700), [true, true, false]);
        assert_eq!((full_share(0), full_share(1000)), (0, 800));
    }
}
