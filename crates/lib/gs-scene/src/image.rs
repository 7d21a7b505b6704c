//! Photographs and other pictures, as f32 RGB.

use gs_io::{Error, IoContext, Result, write_bytes};
use image::metadata::Orientation;
use image::{DynamicImage, ImageDecoder, ImageReader, Limits};
use rayon::prelude::*;
use std::fs::File;
use std::io::{BufRead, BufReader, Cursor, Seek};
use std::path::Path;

/// Pixels that a picture may have at most.
const MAX_PIXELS: u64 = 1 << 28;
/// Pixels per byte of file beyond which a header lies: a gray PNG of one colour has about 1,030, a JPEG about 500.
const MAX_PIXELS_PER_BYTE: u64 = 2_000;
/// Bytes beside the pixels that decoders may take whatever the file's length: a row of 2^20 pixels.
const BESIDE: u64 = 8 << 20;

/// A picture: sRGB values as stored, not linearised.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Image {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// `[height][width][rgb]`, 0 to 1.
    pub rgb: Vec<f32>,
    /// `[height][width]`, 0 to 1, where the file has an alpha channel.
    pub alpha: Option<Vec<f32>>,
}

/// Width and height of a picture file as its pixels lie, from its header.
pub fn size_of(path: impl AsRef<Path>) -> Result<(u32, u32)> {
    let path = path.as_ref();
    header_of(path)?.into_dimensions().map_err(|e| unreadable(path, &e))
}

/// A reader of a picture file's header.
fn header_of(path: &Path) -> Result<ImageReader<BufReader<File>>> {
    let reader = ImageReader::open(path).at("open", path)?.with_guessed_format().at("read", path)?;
    Ok(bounded(reader, std::fs::metadata(path).at("read", path)?.len(), 0))
}

/// Bounds what a picture of so many bytes may be unpacked to beside its pixels: a colour profile of a PNG may claim any size, and is
/// left out where it is larger. Pixels take at most 8 bytes.
fn bounded<R: BufRead + Seek>(mut reader: ImageReader<R>, bytes: u64, pixels: u64) -> ImageReader<R> {
    let most = BESIDE.saturating_add(bytes.saturating_mul(2)).saturating_add(pixels.saturating_mul(8));
    let mut limits = Limits::default();
    limits.max_alloc = limits.max_alloc.map(|usual| usual.min(most));
    reader.limits(limits);
    reader
}

/// Width and height of a picture file as its pixels lie, and how its EXIF data would have them turned, from its header.
pub(crate) fn size_and_turn(path: &Path) -> Result<((u32, u32), Orientation)> {
    let mut decoder = header_of(path)?.into_decoder().map_err(|e| unreadable(path, &e))?;
    Ok((decoder.dimensions(), turn_of(&mut decoder)))
}

/// EXIF data that cannot be read turn nothing.
fn turn_of(decoder: &mut impl ImageDecoder) -> Orientation {
    decoder.orientation().unwrap_or(Orientation::NoTransforms)
}

/// The size of a picture that is turned.
pub(crate) fn turned_size((width, height): (u32, u32), turn: Orientation) -> (u32, u32) {
    use Orientation::{Rotate90, Rotate90FlipH, Rotate270, Rotate270FlipH};
    if matches!(turn, Rotate90 | Rotate270 | Rotate90FlipH | Rotate270FlipH) {
        (height, width)
    } else {
        (width, height)
    }
}

/// Decodes a PNG or JPEG that was read from `path`, with the pixels as they lie: no EXIF data turn them.
///
/// # Errors
/// When it is no picture, or claims more pixels than so many bytes can hold.
pub fn decode(bytes: &[u8], path: &Path) -> Result<DynamicImage> {
    let reader = || ImageReader::new(Cursor::new(bytes)).with_guessed_format().at("read", path);
    let length = bytes.len() as u64;
    let (w, h) = bounded(reader()?, length, 0).into_dimensions().map_err(|e| unreadable(path, &e))?;
    let pixels = u64::from(w) * u64::from(h);
    let most = MAX_PIXELS.min(length.saturating_mul(MAX_PIXELS_PER_BYTE));
    if pixels > most {
        return Err(Error::new("the picture is too large, or its header lies")
            .file(path)
            .field("size")
            .found(format!("{w}x{h} in {} bytes", bytes.len()))
            .expected(format!("at most {most} pixels"))
            .hint("shrink it, or copy it again"));
    }
    // Decoders fill what is missing with grey, which would be learnt.
    if is_jpeg(bytes) && !reaches_its_end(bytes) {
        return Err(unreadable(path, &"the JPEG ends before its end mark, so a part of it is missing"));
    }
    bounded(reader()?, length, pixels).decode().map_err(|e| unreadable(path, &e))
}

/// How a JPEG begins.
const JPEG: [u8; 2] = [0xFF, 0xD8];

pub(crate) fn is_jpeg(bytes: &[u8]) -> bool {
    bytes.starts_with(&JPEG)
}

/// Whether the bytes of a JPEG go on to its end mark. Segments with a length are skipped, so that the end of a small picture within one
/// is not taken for it (ITU T.81, B.1.1).
fn reaches_its_end(bytes: &[u8]) -> bool {
    let mut at = JPEG.len();
    while let Some(found) = bytes.get(at..).and_then(|rest| rest.iter().position(|&b| b == 0xFF)) {
        at += found + 1;
        match bytes.get(at) {
            Some(0xD9) => return true,
            // Data, filling, and marks without a length.
            Some(0x00 | 0x01 | 0xD0..=0xD8) => at += 1,
            Some(0xFF) => {}
            _ => match bytes.get(at + 1..at + 3) {
                Some(&[high, low]) => at += 1 + usize::from(u16::from_be_bytes([high, low])).max(2),
                _ => return false,
            },
        }
    }
    false
}

/// Whether a picture file has an alpha channel, from its header.
pub fn has_alpha(path: impl AsRef<Path>) -> Result<bool> {
    let path = path.as_ref();
    let decoder = header_of(path)?.into_decoder().map_err(|e| unreadable(path, &e))?;
    Ok(decoder.color_type().has_alpha())
}

/// Width and height of a picture of this size, shrunk to a longer side of so many pixels where it is larger.
pub fn size_within((width, height): (u32, u32), longest: u32) -> (u32, u32) {
    let by = (f64::from(longest) / f64::from(width.max(height))).min(1.0);
    let [width, height] = [width, height].map(|v| ((f64::from(v) * by).round() as u32).max(1));
    (width, height)
}

fn unreadable(path: &Path, e: &dyn std::fmt::Display) -> Error {
    Error::new(format!("not a readable picture: {e}"))
        .file(path)
        .expected("a PNG or JPEG")
        .hint("convert or copy it again")
}

impl Image {
    /// An image of `width` x `height` pixels from 8-bit RGB.
    ///
    /// # Panics
    /// When `data` is not `3 * width * height` long.
    pub fn from_rgb8(width: u32, height: u32, data: &[u8]) -> Self {
        assert_eq!(data.len(), 3 * width as usize * height as usize);
        Self { width, height, rgb: data.iter().map(|&v| f32::from(v) / 255.0).collect(), alpha: None }
    }

    /// The image as 8-bit RGB, rounded.
    pub fn to_rgb8(&self) -> Vec<u8> {
        self.rgb.iter().map(|&v| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8).collect()
    }

    /// Reads a PNG or JPEG, upright: turned as its EXIF data say.
    ///
    /// # Errors
    /// When the file cannot be read, is no picture, or is too large.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let (_, turn) = size_and_turn(path.as_ref())?;
        Self::read_turned(path.as_ref(), turn)
    }

    /// Reads a PNG or JPEG and turns it.
    pub(crate) fn read_turned(path: &Path, turn: Orientation) -> Result<Self> {
        let mut decoded = decode(&std::fs::read(path).at("read", path)?, path)?;
        decoded.apply_orientation(turn);
        let alpha = || decoded.to_rgba8().pixels().map(|p| f32::from(p[3]) / 255.0).collect();
        let alpha = decoded.color().has_alpha().then(alpha);
        Ok(Self { alpha, ..Self::from_rgb8(decoded.width(), decoded.height(), decoded.into_rgb8().as_raw()) })
    }

    /// The image as a PNG in memory, 8 bits a channel, without alpha.
    pub fn to_png(&self) -> Vec<u8> {
        let buffer = image::RgbImage::from_raw(self.width, self.height, self.to_rgb8()).expect("the sizes fit");
        let mut png = Cursor::new(Vec::new());
        DynamicImage::from(buffer).write_to(&mut png, image::ImageFormat::Png).expect("writing to memory");
        png.into_inner()
    }

    /// Writes a PNG, 8 bits a channel, without alpha.
    pub fn write_png(&self, path: impl AsRef<Path>) -> Result<()> {
        write_bytes(path, &self.to_png())
    }

    /// The image at another size; each new pixel is the mean of the area it covers (bilinear where the image grows).
    #[must_use]
    pub fn resize_area(&self, width: u32, height: u32) -> Self {
        if (width, height) == (self.width, self.height) {
            return self.clone();
        }
        let size = (self.width as usize, self.height as usize);
        let to = (width as usize, height as usize);
        Self {
            width,
            height,
            rgb: resize_planes::<3>(&self.rgb, size, to),
            alpha: self.alpha.as_ref().map(|a| resize_planes::<1>(a, size, to)),
        }
    }

    /// Bilinear value of channel values at pixel coordinates (centres at +0.5), the border repeated.
    #[inline]
    pub(crate) fn sample(&self, x: f64, y: f64) -> [f32; 3] {
        let (w, h) = (self.width as usize, self.height as usize);
        let (pixels, mut out) = (self.rgb.as_chunks::<3>().0, [0.0; 3]);
        for (at, weight) in corners(x, y, w, h) {
            let pixel = &pixels[at];
            for c in 0..3 {
                out[c] += weight * pixel[c];
            }
        }
        out
    }

    /// Bilinear alpha at pixel coordinates; 1 without an alpha channel.
    pub(crate) fn sample_alpha(&self, x: f64, y: f64) -> f32 {
        let (w, h) = (self.width as usize, self.height as usize);
        self.alpha.as_ref().map_or(1.0, |a| corners(x, y, w, h).iter().map(|&(at, weight)| weight * a[at]).sum())
    }
}

/// The four pixels around a point and their bilinear weights.
fn corners(x: f64, y: f64, w: usize, h: usize) -> [(usize, f32); 4] {
    // max comes first: it turns NaN into 0.
    let (x, y) = ((x - 0.5).max(0.0).min((w - 1) as f64), (y - 0.5).max(0.0).min((h - 1) as f64));
    // Casts are floors of what is not negative, and call no library.
    let (x0, y0) = (x as usize, y as usize);
    let (fx, fy) = ((x - x0 as f64) as f32, (y - y0 as f64) as f32);
    let (x1, y1) = ((x0 + 1).min(w - 1), (y0 + 1).min(h - 1));
    [
        (y0 * w + x0, (1.0 - fx) * (1.0 - fy)),
        (y0 * w + x1, fx * (1.0 - fy)),
        (y1 * w + x0, (1.0 - fx) * fy),
        (y1 * w + x1, fx * fy),
    ]
}

/// Weights of source pixels per target pixel along one axis.
fn axis_weights(from: usize, to: usize) -> Vec<Vec<(usize, f32)>> {
    let scale = from as f64 / to as f64;
    (0..to)
        .map(|t| {
            if scale <= 1.0 {
                let x = ((t as f64 + 0.5) * scale - 0.5).clamp(0.0, (from - 1) as f64);
                let i = x.floor() as usize;
                let f = (x - i as f64) as f32;
                return vec![(i, 1.0 - f), ((i + 1).min(from - 1), f)];
            }
            let (a, b) = (t as f64 * scale, (t + 1) as f64 * scale);
            let last = (b.ceil() as usize).min(from);
            (a.floor() as usize..last)
                .map(|i| (i, ((b.min((i + 1) as f64) - a.max(i as f64)) / scale) as f32))
                .collect()
        })
        .collect()
}

fn resize_planes<const CHANNELS: usize>(data: &[f32], (w, h): (usize, usize), to: (usize, usize)) -> Vec<f32> {
    let (to_w, to_h) = to;
    let (wx, wy) = (axis_weights(w, to_w), axis_weights(h, to_h));
    let mut out = vec![0.0; to_w * to_h * CHANNELS];
    out.par_chunks_mut(to_w * CHANNELS).zip(&wy).for_each(|(row, rows)| {
        let mut line = vec![0.0f32; w * CHANNELS];
        for &(y, weight) in rows {
            for (l, s) in line.iter_mut().zip(&data[y * w * CHANNELS..(y + 1) * w * CHANNELS]) {
                *l += weight * s;
            }
        }
        let line = line.as_chunks::<CHANNELS>().0;
        for (pixel, columns) in row.as_chunks_mut::<CHANNELS>().0.iter_mut().zip(&wx) {
            for &(i, weight) in columns {
                for (p, v) in pixel.iter_mut().zip(&line[i]) {
                    *p += weight * v;
                }
            }
        }
    });
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn ramp(width: u32, height: u32) -> Image {
        let n = (width * height * 3) as usize;
        let value = |i: usize| ((i * 37) % 256) as f32 / 255.0;
        Image { width, height, rgb: (0..n).map(value).collect(), alpha: None }
    }

    #[test]
    fn a_jpeg_that_ends_early_is_refused_and_one_with_more_behind_it_is_read() {
        let picture = image::RgbImage::from_raw(48, 32, ramp(48, 32).to_rgb8()).unwrap();
        let mut jpeg = Cursor::new(Vec::new());
        DynamicImage::from(picture).write_to(&mut jpeg, image::ImageFormat::Jpeg).unwrap();
        // The small picture that cameras put within has an end of its own.
        let mut whole = jpeg.into_inner();
        let small = [0xFF, 0xE1, 0, 8, 0xFF, 0xD8, 1, 2, 0xFF, 0xD9];
        whole.splice(2..2, small);
        let read = |bytes: &[u8]| decode(bytes, Path::new("a.jpg"));
        assert!(read(&whole).is_ok() && read(&[&whole[..], b"more"].concat()).is_ok());
        for end in [200, whole.len() / 2, whole.len() - 40, whole.len() - 1] {
            let e = read(&whole[..end]).unwrap_err().to_string();
            assert!(e.contains("a.jpg: not a readable picture"), "{end}: {e}");
        }
        assert!(read(&whole[..whole.len() - 40]).unwrap_err().to_string().contains("ends before its end mark"));
    }

    #[test]
    fn shrinking_averages_areas() {
        // Five columns to two share the middle one; four rows to two are pairs.
        let (across, down) = ([0.1f32, 0.2, 0.4, 0.8, 1.0], [0.9, 0.7, 0.2, 0.4]);
        let gray: Vec<f32> = down.iter().flat_map(|d| across.map(|a| a * d)).collect();
        let rgb = gray.iter().flat_map(|v| [*v, 0.5 * v, 0.25 * v]).collect();
        let small = Image { width: 5, height: 4, rgb, alpha: Some(gray) }.resize_area(2, 2);
        let (across, down) = ([0.5 / 2.5, 2.0 / 2.5], [0.8, 0.3]);
        for (i, alpha) in small.alpha.unwrap().into_iter().enumerate() {
            let expected = across[i % 2] * down[i / 2];
            let rgb = [small.rgb[3 * i], 2.0 * small.rgb[3 * i + 1], 4.0 * small.rgb[3 * i + 2]];
            assert!([alpha, rgb[0], rgb[1], rgb[2]].iter().all(|v| (v - expected).abs() < 1e-6));
        }
    }

    #[test]
    fn sampling_is_bilinear_and_repeats_the_border() {
        let image = ramp(3, 2);
        let pixel = |x: usize, y: usize| image.rgb[3 * (3 * y + x)];
        assert_eq!(image.sample(1.5, 0.5)[0], pixel(1, 0));
        assert!(
            (image.sample(2.0, 1.0)[0] - (pixel(1, 0) + pixel(2, 0) + pixel(1, 1) + pixel(2, 1)) / 4.0).abs() < 1e-6
        );
        assert_eq!(image.sample(-50.0, 1e300)[0], pixel(0, 1));
        assert!(image.sample(f64::NAN, f64::INFINITY).iter().all(|v| v.is_finite()));
    }

    #[test]
    fn files_round_trip_and_keep_alpha() {
        let dir = tempfile::tempdir().unwrap();
        // The content, not the name, says what a file is.
        let path = dir.path().join("a.jpg");
        let image = ramp(7, 5);
        image.write_png(&path).unwrap();
        assert_eq!(Image::read(&path).unwrap(), image);
        assert_eq!(size_of(&path).unwrap(), (7, 5));
        assert!(!has_alpha(&path).unwrap());
        let gray = image::GrayAlphaImage::from_raw(2, 1, vec![51, 102, 255, 0]).unwrap();
        gray.save_with_format(&path, image::ImageFormat::Png).unwrap();
        let back = Image::read(&path).unwrap();
        assert_eq!(back.rgb, [0.2, 0.2, 0.2, 1.0, 1.0, 1.0]);
        assert_eq!(back.alpha.unwrap(), [0.4, 0.0]);
        assert!(has_alpha(&path).unwrap());
    }

    #[test]
    fn a_picture_whose_header_lies_is_refused_before_it_is_decoded() {
        let mut png = ramp(20, 16).to_png();
        // Width and height in IHDR, and the chunk's checksum after its 13 bytes.
        png[16..20].copy_from_slice(&16_000u32.to_be_bytes());
        png[20..24].copy_from_slice(&16_000u32.to_be_bytes());
        let bit = |c: u32| if c & 1 == 1 { c >> 1 ^ 0xEDB8_8320 } else { c >> 1 };
        let crc = !png[12..29].iter().fold(!0u32, |crc, &b| (0..8).fold(crc ^ u32::from(b), |c, _| bit(c)));
        png[29..33].copy_from_slice(&crc.to_be_bytes());
        let e = decode(&png, Path::new("a.png")).unwrap_err().to_string();
        assert!(e.contains("size: the picture is too large, or its header lies; found 16000x16000"), "{e}");
    }

    proptest! {
        #[test]
        fn shrinking_keeps_the_mean(w in 1u32..40, h in 1u32..40, to_w in 1u32..40, to_h in 1u32..40) {
            let (to_w, to_h) = (to_w.min(w), to_h.min(h));
            let image = ramp(w, h);
            let small = image.resize_area(to_w, to_h);
            prop_assert_eq!(small.rgb.len(), (3 * to_w * to_h) as usize);
            let mean = |v: &[f32]| v.iter().map(|&v| f64::from(v)).sum::<f64>() / v.len() as f64;
            prop_assert!((mean(&image.rgb) - mean(&small.rgb)).abs() < 1e-5);
        }

        #[test]
        fn a_plain_image_stays_plain_at_any_size(w in 1u32..30, h in 1u32..30, to_w in 1u32..60, to_h in 1u32..60) {
            let image = Image { width: w, height: h, rgb: vec![0.7; (3 * w * h) as usize], alpha: None };
            let other = image.resize_area(to_w, to_h);
            prop_assert!(other.rgb.iter().all(|v| (v - 0.7).abs() < 1e-5));
        }
    }
}
