//! Pictures for people: overlays, id maps in colours, and their encoding.

use gs_io::{Error, Result};
use image::{DynamicImage, RgbImage};

/// Colour by which a selection is marked, sRGB in 0 to 1.
const HIGHLIGHT: [f32; 3] = [0.78, 1.0, 0.05];

/// An sRGB picture, values 0 to 1.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// `[height][width]` colours.
    pub pixels: Vec<[f32; 3]>,
}

impl Picture {
    /// From flat rgb values (`[height][width][3]`), clamped to 0 to 1.
    ///
    /// # Panics
    /// When `rgb` has another length.
    pub fn new(width: u32, height: u32, rgb: &[f32]) -> Self {
        let (width, height) = (width as usize, height as usize);
        assert_eq!(rgb.len(), width * height * 3);
        let pixels = rgb.chunks_exact(3).map(|c| [c[0], c[1], c[2]].map(|v| v.clamp(0.0, 1.0))).collect();
        Self { width, height, pixels }
    }

    /// Brings out a mask: the rest is dimmed and greyed, the mask lightly tinted and outlined.
    ///
    /// # Panics
    /// When the mask has another size.
    #[must_use]
    pub fn highlighted(&self, mask: &[bool]) -> Self {
        assert_eq!(self.pixels.len(), mask.len());
        let outline = outline(mask, self.width, (self.width.max(self.height) / 400).max(1));
        let pixels = (0..self.pixels.len()).map(|i| {
            let c = self.pixels[i];
            if outline[i] {
                HIGHLIGHT
            } else if mask[i] {
                blend(c, HIGHLIGHT, 0.125)
            } else {
                let grey = 0.299 * c[0] + 0.587 * c[1] + 0.114 * c[2];
                blend(c, [grey; 3], 0.6).map(|v| 0.12 + 0.55 * v)
            }
        });
        Self { pixels: pixels.collect(), ..*self }
    }

    /// Lays a colour over every pixel: `opacity` of `overlay`.
    ///
    /// # Panics
    /// When `overlay` does not hold a value per pixel.
    #[must_use]
    pub fn overlaid(&self, overlay: &[[f32; 3]], opacity: f32) -> Self {
        assert_eq!(overlay.len(), self.pixels.len());
        let pixels = self.pixels.iter().zip(overlay).map(|(&c, &o)| blend(c, o, opacity)).collect();
        Self { pixels, ..*self }
    }

    fn rgb8(&self) -> RgbImage {
        let byte = |v: &f32| (v.clamp(0.0, 1.0) * 255.0).round() as u8;
        let bytes: Vec<u8> = self.pixels.iter().flatten().map(byte).collect();
        RgbImage::from_raw(self.width as u32, self.height as u32, bytes).expect("sizes agree")
    }

    /// The picture as a PNG file.
    pub fn png(&self) -> Result<Vec<u8>> {
        encode(&DynamicImage::ImageRgb8(self.rgb8()), image::ImageFormat::Png)
    }

    /// The picture as a JPEG file of the given quality (1 to 100), shrunk to at most `max_width`.
    pub fn jpeg(&self, max_width: usize, quality: u8) -> Result<Vec<u8>> {
        let mut full = self.rgb8();
        if self.width > max_width {
            let height = (self.height * max_width).div_ceil(self.width).max(1);
            full =
                image::imageops::resize(&full, max_width as u32, height as u32, image::imageops::FilterType::Triangle);
        }
        let mut out = Vec::new();
        image::codecs::jpeg::JpegEncoder::new_with_quality(&mut out, quality)
            .encode_image(&full)
            .map_err(|e| Error::new(format!("cannot encode a JPEG: {e}")))?;
        Ok(out)
    }
}

/// A mask as a PNG file: 255 inside, 0 outside.
///
/// # Errors
/// When encoding fails.
///
/// # Panics
/// When `mask` has less than a value per pixel.
pub fn mask_png(width: usize, height: usize, mask: &[bool]) -> Result<Vec<u8>> {
    let bytes = mask.iter().map(|&b| 255 * u8::from(b)).collect();
    let grey = image::GrayImage::from_raw(width as u32, height as u32, bytes).expect("sizes agree");
    encode(&DynamicImage::ImageLuma8(grey), image::ImageFormat::Png)
}

fn encode(picture: &DynamicImage, format: image::ImageFormat) -> Result<Vec<u8>> {
    let mut out = std::io::Cursor::new(Vec::new());
    picture.write_to(&mut out, format).map_err(|e| Error::new(format!("cannot encode a picture: {e}")))?;
    Ok(out.into_inner())
}

/// The pixels outside a mask within `radius` (Chebyshev) of it: an outline that hides nothing of the inside.
fn outline(mask: &[bool], width: usize, radius: usize) -> Vec<bool> {
    // A square window is two passes of a line window.
    let height = mask.len() / width.max(1);
    let mut rows = vec![false; mask.len()];
    let mut out = rows.clone();
    for y in 0..height {
        for x in 0..width {
            rows[y * width + x] =
                mask[y * width..][x.saturating_sub(radius)..(x + radius + 1).min(width)].contains(&true);
        }
    }
    for y in 0..height {
        for x in 0..width {
            let near = (y.saturating_sub(radius)..(y + radius + 1).min(height)).any(|v| rows[v * width + x]);
            out[y * width + x] = near && !mask[y * width + x];
        }
    }
    out
}

/// `(1 - t) a + t b`.
fn blend(a: [f32; 3], b: [f32; 3], t: f32) -> [f32; 3] {
    [0, 1, 2].map(|k| a[k] + t * (b[k] - a[k]))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn picture() -> Picture {
        Picture::new(8, 6, &[0.5; 8 * 6 * 3])
    }

    #[test]
    fn a_highlight_marks_outline_inside_and_outside() {
        let mut mask = vec![false; 8 * 6];
        mask[2 * 8 + 3] = true;
        let h = picture().highlighted(&mask);
        assert_eq!(h.pixels[2 * 8 + 3].map(|v| (v * 1e4).round()), [5350.0, 5625.0, 4438.0]);
        assert_eq!(h.pixels[2 * 8 + 4], HIGHLIGHT);
        assert!((h.pixels[0][0] - 0.395).abs() < 1e-6);
    }

    #[test]
    fn the_outline_surrounds_without_overlap() {
        let mask: Vec<bool> = (0..40).map(|i| (1..3).contains(&(i / 10)) && (3..6).contains(&(i % 10))).collect();
        let o = outline(&mask, 10, 1);
        assert_eq!(o.iter().filter(|&&b| b).count(), 5 * 4 - 6);
        assert!(mask.iter().zip(&o).all(|(a, b)| !(a & b)));
    }

    #[test]
    fn files_decode_to_what_was_drawn() {
        let mut p = picture();
        p.pixels[0] = [1.0, 0.0, 0.2];
        let png = image::load_from_memory(&p.png().unwrap()).unwrap().to_rgb8();
        assert_eq!((png.dimensions(), png[(0, 0)].0, png[(1, 0)].0), ((8, 6), [255, 0, 51], [128; 3]));
        let jpeg = image::load_from_memory(&p.jpeg(4, 80).unwrap()).unwrap();
        assert_eq!((jpeg.width(), jpeg.height()), (4, 3));
        let mut mask = vec![false; 8 * 6];
        mask[9] = true;
        let m = image::load_from_memory(&mask_png(8, 6, &mask).unwrap()).unwrap().to_luma8();
        assert_eq!((m[(1, 1)].0, m[(0, 0)].0), ([255], [0]));
    }

    #[test]
    fn overlays_are_blended() {
        assert_eq!(picture().overlaid(&[[1.0, 1.0, 0.0]; 48], 0.5).pixels[5], [0.75, 0.75, 0.25]);
    }
}
