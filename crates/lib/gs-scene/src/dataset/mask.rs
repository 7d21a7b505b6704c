//! Masks that say which pixels of a photograph count.

use super::upright::Turn;
use crate::image::{decode, is_jpeg};
use gs_io::{IoContext, Result};
use std::path::Path;

/// How much the pixels of a photograph count.
#[derive(Debug, Clone, PartialEq)]
pub struct Mask {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// `[height][width]`, 0 to 1.
    pub values: Vec<f32>,
    /// What is odd in how it is written.
    pub odd: Option<Odd>,
}

/// How a mask is written, where that isn't black and white.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Odd {
    /// No value is above 1, which counts as white.
    ZeroAndOne,
    /// Of 16 bits a pixel, with no value above 255, which counts as white.
    EightBits,
    /// One colour all over, with the mask in the alpha channel.
    Alpha,
    /// The brightest pixel counts by less than a half.
    Dim,
    /// No pixel counts.
    Black,
}

impl std::fmt::Display for Odd {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::ZeroAndOne => "have no value above 1: taken as white",
            Self::EightBits => "have 16 bits a pixel and no value above 255: taken as white",
            Self::Alpha => "have one colour all over and transparent pixels: these do not count, the others do",
            Self::Dim => "have no pixel of half the white: all their pixels count by less than a half; write 255 where a pixel counts",
            Self::Black => "are black: no pixel of them counts",
        })
    }
}

impl Mask {
    /// Reads a mask, turned as belongs to its photograph: a pixel counts by its brightness times its alpha. Where all pixels are of one
    /// colour, the alpha alone counts. White is the largest number that a pixel can have, or what [`Odd`] says.
    ///
    /// # Errors
    /// When it is no PNG or JPEG.
    pub(super) fn read(path: &Path, turn: Turn) -> Result<Self> {
        let bytes = std::fs::read(path).at("read", path)?;
        let mut picture = decode(&bytes, path)?;
        picture.apply_orientation(turn.of_companion((picture.width(), picture.height())));
        let most = if picture.color().bytes_per_pixel() > picture.color().channel_count() { u16::MAX } else { 255 };
        let picture = picture.into_rgba16();
        let (width, height) = picture.dimensions();
        let pixels = picture.pixels().map(|p| p.0);
        let transparent = pixels.clone().any(|[.., a]| a < u16::MAX);
        let first = picture.pixels().next().map(|p| p.0);
        if transparent && pixels.clone().all(|[r, g, b, _]| first.is_some_and(|f| f[..3] == [r, g, b])) {
            let values: Vec<f32> = pixels.map(|[.., a]| f32::from(a) / f32::from(u16::MAX)).collect();
            let odd = if values.iter().any(|v| *v > 0.0) { Odd::Alpha } else { Odd::Black };
            return Ok(Self { width, height, values, odd: Some(odd) });
        }
        // Of 16 bits, whatever the file has: 255 of 8 bits is 65,535 of these.
        let unit = f32::from(u16::MAX / most);
        let value = |[r, g, b, a]: [u16; 4]| {
            let sum = [r, g, b].map(f32::from).iter().sum::<f32>();
            sum / (3.0 * unit) * (f32::from(a) / f32::from(u16::MAX))
        };
        let mut values: Vec<f32> = pixels.map(value).collect();
        let brightest = values.iter().copied().fold(0.0, f32::max);
        // JPEG blurs values: none is exact.
        let (white, odd) = if brightest > 0.0 && brightest <= 1.0 && !is_jpeg(&bytes) {
            (1.0, Some(Odd::ZeroAndOne))
        } else if most > 255 && brightest > 0.0 && brightest <= 255.0 {
            (255.0, Some(Odd::EightBits))
        } else {
            (f32::from(most), None)
        };
        values.iter_mut().for_each(|v| *v /= white);
        let odd = odd.or((brightest == 0.0).then_some(Odd::Black)).or((brightest < 0.5 * white).then_some(Odd::Dim));
        Ok(Self { width, height, values, odd })
    }
}
