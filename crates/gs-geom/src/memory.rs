//! How much memory a run will take, told before it does.
//!
//! The terms are counted from the sizes of the arrays that live at the same time; docs/geometry-memory.md holds them
//! against measured peaks.

use gs_io::Error;
use gs_scene::{Camera, sh_coefficients};
use serde::Serialize;
use std::fmt;
use std::str::FromStr;

/// The program itself, its threads' stacks and the allocator's slack.
const BASE: u64 = 10 << 20;
/// Per pixel in training: render with alpha and depth 20, target 12, gradient 12, three maps of SSIM 36.
const PER_PIXEL: u64 = 80;
/// Per pixel of a photograph's file while it is decoded: 8-bit and f32 RGB.
const PER_DECODED_PIXEL: u64 = 15;
/// Per pixel while it is shrunk: f32 RGB, once for the pixels of new width and old height, twice for the result.
const PER_SHRUNK_PIXEL: u64 = 12;
/// Per tile that a drawn Gaussian touches: its entry in the tile's list and in the Gaussian's, and its gradient.
const PER_TILE: u64 = 56;
/// Per pixel of a cached photograph: 8-bit RGB.
const PER_CACHED_PIXEL: u64 = 3;
/// Numbers of a Gaussian besides its spherical harmonics: centre, scales, quaternion, opacity.
const PLAIN_NUMBERS: u64 = 11;

/// A number of bytes, written and read as `512M`, `2G`, `1.5G`, `64K` or `0` (powers of 1024).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Bytes(pub u64);

impl FromStr for Bytes {
    type Err = Error;

    fn from_str(s: &str) -> Result<Self, Error> {
        let plain = s.strip_suffix("iB").or_else(|| s.strip_suffix('B')).unwrap_or(s);
        let (digits, unit) = match plain.char_indices().last() {
            Some((at, 'K' | 'k')) => (&plain[..at], 10),
            Some((at, 'M' | 'm')) => (&plain[..at], 20),
            Some((at, 'G' | 'g')) => (&plain[..at], 30),
            Some((at, 'T' | 't')) => (&plain[..at], 40),
            _ => (plain, 0),
        };
        let value: Option<f64> = digits.parse().ok().filter(|v| (0.0..1e6).contains(v));
        match value {
            // A bare number could be taken for megabytes as well as bytes.
            Some(v) if unit > 0 || v == 0.0 => Ok(Self((v * f64::from(1u32 << (unit - 10).max(0)) * 1024.0) as u64)),
            _ => Err(Error::new("not an amount of memory")
                .found(s)
                .expected("a number with a unit such as 512M or 2G, or 0")),
        }
    }
}

impl fmt::Display for Bytes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (unit, shift) in [("T", 40), ("G", 30), ("M", 20), ("K", 10)] {
            if self.0 >= 1 << shift {
                let value = self.0 as f64 / (1u64 << shift) as f64;
                return if value.fract() == 0.0 || value >= 100.0 {
                    write!(f, "{value:.0}{unit}")
                } else {
                    write!(f, "{value:.1}{unit}")
                };
            }
        }
        write!(f, "{}", self.0)
    }
}

/// What a run's peak memory is made of, bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Forecast {
    /// Photographs kept decoded.
    pub photographs: u64,
    /// Photographs on their way from the file into memory, before training.
    pub decoding: u64,
    /// Pictures of one iteration.
    pub pictures: u64,
    /// Lists of the tiles' Gaussians and their gradients, of the views tried.
    pub tiles: u64,
    /// Per Gaussian.
    pub per_gaussian: u64,
}

impl Forecast {
    /// For photographs taken by `cameras`, whose largest file has `file_size` (width and height in pixels), decoded by
    /// `threads` at once; `tile_entries` is how many tiles the Gaussians of a view touch, all told.
    pub fn new<'a>(
        cameras: impl Iterator<Item = &'a Camera> + Clone,
        file_size: (u32, u32),
        tile_entries: u64,
        cache: Bytes,
        threads: usize,
        sh_degree: u8,
    ) -> Self {
        let pixels = |c: &Camera| u64::from(c.width) * u64::from(c.height);
        let all: u64 = cameras.clone().map(|c| PER_CACHED_PIXEL * pixels(c)).sum();
        let numbers = PLAIN_NUMBERS + 3 * sh_coefficients(sh_degree) as u64;
        // Parameters and two moments; beside them, while a checkpoint is written, its tensors and then its bytes. A step
        // takes no more: gradients, drawn Gaussians and their tiles.
        let state = 3 * 4 * numbers + 8;
        let (most, widest) = cameras.fold((0, 0), |(m, w), c| (pixels(c).max(m), u64::from(c.width).max(w)));
        let (w, h) = (u64::from(file_size.0), u64::from(file_size.1));
        Self {
            photographs: all.min(cache.0),
            decoding: threads as u64 * (PER_DECODED_PIXEL * w * h + PER_SHRUNK_PIXEL * (widest * h + 2 * most)),
            pictures: PER_PIXEL * most,
            tiles: PER_TILE * tile_entries,
            per_gaussian: 3 * state,
        }
    }

    /// Peak memory with so many Gaussians, bytes.
    pub fn peak(&self, gaussians: usize) -> Bytes {
        // The allocator keeps what decoding took, and the pictures and tiles of training fit into it.
        let scratch = self.decoding.max(self.pictures + self.tiles);
        Bytes((BASE + self.photographs + scratch).saturating_add(self.per_gaussian.saturating_mul(gaussians as u64)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    #[test]
    fn amounts_are_read_and_written() {
        for (s, n) in
            [("2G", 2u64 << 30), ("512M", 512 << 20), ("1.5GiB", 3 << 29), ("64kB", 65_536), ("0", 0), ("1T", 1 << 40)]
        {
            assert_eq!(s.parse::<Bytes>().unwrap(), Bytes(n), "{s}");
        }
        for wrong in ["", "G", "2048", "-1G", "nanG", "infG", "2X", "1e9G"] {
            assert!(wrong.parse::<Bytes>().is_err(), "{wrong}");
        }
        for (n, s) in [(2u64 << 30, "2G"), (3 << 29, "1.5G"), (700 << 20, "700M"), (12, "12")] {
            assert_eq!(Bytes(n).to_string(), s);
        }
    }

    #[test]
    fn the_cache_bounds_the_photographs_and_gaussians_count() {
        let camera = Camera::look_at(DVec3::X, DVec3::ZERO, DVec3::Z, 1000, 500, 1.0);
        let of = |cache, tiles| Forecast::new([&camera; 4].into_iter(), (2000, 1000), tiles, Bytes(cache), 2, 3);
        assert_eq!((of(u64::MAX, 0).photographs, of(100, 0).photographs), (6_000_000, 100));
        let decoding = 2 * (15 * 2_000_000 + 12 * (1_000_000 + 2 * 500_000));
        assert_eq!(of(0, 0).decoding, decoding);
        // Few tiles: decoding needs more at once; many: training does.
        let gaussians = 1000 * 3 * (12 * 59 + 8);
        assert_eq!(of(0, 0).peak(1000), Bytes(BASE + decoding + gaussians));
        assert_eq!(of(0, 5_000_000).peak(1000), Bytes(BASE + 40_000_000 + 56 * 5_000_000 + gaussians));
    }
}
