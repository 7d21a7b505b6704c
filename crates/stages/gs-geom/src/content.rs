//! How much of the photographs' content small pictures hold, and how long to stay with them for that.
//!
//! Small pictures are cheap, and all there is to learn as long as the Gaussians are blurred (the idea of DashGaussian,
//! Chen et al. 2025: let the photographs' frequencies decide on the picture size). A picture shrunk by a divisor lacks
//! the frequencies above; against the full picture that bounds the PSNR, and once the optimisation is near the bound it
//! has to see larger ones.

use crate::photographs::{Photographs, shrunk};
use gs_io::Result;
use gs_scene::Image;
use rayon::prelude::*;

/// Divisors of the picture size that a run may begin with, coarse to fine.
pub const DIVISORS: [u32; 5] = [8, 6, 4, 3, 2];
/// Photographs that are looked at, evenly spread.
const VIEWS: usize = 12;
/// Pixels of a photograph that are looked at, about.
const SAMPLES: usize = 1 << 16;
/// Smaller pictures, in pixels of the shorter side, are not used: the window of SSIM would be mostly border.
const LEAST_SIDE: u32 = 24;
/// Share of the iterations before the pictures are full.
const COARSE_SHARE: f64 = 0.4;
/// Gain over pictures of one colour, in dB, for which the pictures have to be full.
const FULL_GAIN: f64 = 24.0;

/// What shrinking loses: a divisor, and how many dB better than a flat picture the shrunk one, enlarged again, still is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gain {
    /// Divisor of the picture size.
    pub divisor: u32,
    /// Ratio of the photographs' variance to the mean squared error of the shrunk ones, dB.
    pub decibels: f64,
}

/// Measures the divisors that leave pictures of a useful size, coarse to fine.
///
/// # Errors
/// When a photograph cannot be read.
pub fn measure(photographs: &Photographs<'_>) -> Result<Vec<Gain>> {
    let count = photographs.len();
    let views: Vec<usize> = (0..count.min(VIEWS)).map(|i| i * count / count.min(VIEWS)).collect();
    let side = |divisor: u32| {
        let sides = (0..count).map(|i| shrunk(photographs.camera(i), divisor)).map(|c| c.width.min(c.height));
        sides.min().unwrap_or(0)
    };
    let divisors: Vec<u32> = DIVISORS.into_iter().filter(|&d| side(d) >= LEAST_SIDE).collect();
    let of_view = |&i: &usize| {
        let image = photographs.image(i)?;
        let losses: Vec<f64> = divisors.iter().map(|&d| lost(&image, d)).collect();
        Ok((variance(&image), losses))
    };
    let all = views.par_iter().map(of_view).collect::<Result<Vec<(f64, Vec<f64>)>>>()?;
    let variance: f64 = all.iter().map(|(v, _)| v).sum();
    let gain = |(k, &divisor): (usize, &u32)| {
        let loss: f64 = all.iter().map(|(_, l)| l[k]).sum();
        // Photographs of one colour lose nothing, and have nothing to gain.
        let ratio = if variance > 0.0 { variance / loss.max(1e-10 * variance) } else { 1.0 };
        Gain { divisor, decibels: 10.0 * ratio.log10() }
    };
    Ok(divisors.iter().enumerate().map(gain).collect())
}

/// Picture sizes for a run of `iterations`, as [`crate::schedule::Schedule::coarse`] has them: a divisor is in use until
/// its share of `FULL_GAIN` of the coarse part is over.
pub fn stages(gains: &[Gain], iterations: u32) -> Vec<(u32, u32)> {
    let coarse = COARSE_SHARE * f64::from(iterations);
    let mut last = 0;
    let mut stages = Vec::new();
    for gain in gains {
        let until = (coarse * (gain.decibels / FULL_GAIN).clamp(0.0, 1.0)) as u32;
        if until > last {
            stages.push((until, gain.divisor));
            last = until;
        }
    }
    stages
}

/// Mean squared difference of the picture from itself shrunk and enlarged again.
fn lost(image: &Image, divisor: u32) -> f64 {
    let size = |v: u32| ((f64::from(v) / f64::from(divisor)).round() as u32).max(1);
    let small = image.resize_area(size(image.width), size(image.height));
    let (sx, sy) = (f64::from(small.width) / f64::from(image.width), f64::from(small.height) / f64::from(image.height));
    let square = |pixel: usize, x: usize, y: usize| {
        // Pixel centres lie at +0.5.
        let blurred = small.sample((x as f64 + 0.5) * sx, (y as f64 + 0.5) * sy);
        blurred.iter().zip(&image.rgb[3 * pixel..]).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>()
    };
    mean_over(image, square) / 3.0
}

/// Variance of the picture's values about its mean colour.
fn variance(image: &Image) -> f64 {
    let mean = [0, 1, 2].map(|c| mean_over(image, |pixel, _, _| f64::from(image.rgb[3 * pixel + c])));
    let square = |pixel: usize, _, _| (0..3).map(|c| (f64::from(image.rgb[3 * pixel + c]) - mean[c]).powi(2)).sum();
    mean_over(image, square) / 3.0
}

/// Mean of `value(pixel, x, y)` over a grid of pixels.
fn mean_over(image: &Image, value: impl Fn(usize, usize, usize) -> f64) -> f64 {
    let (w, h) = (image.width as usize, image.height as usize);
    let step = ((w * h / SAMPLES) as f64).sqrt().max(1.0) as usize;
    let (mut sum, mut count) = (0.0, 0usize);
    for y in (0..h).step_by(step) {
        for x in (0..w).step_by(step) {
            sum += value(y * w + x, x, y);
            count += 1;
        }
    }
    sum / count.max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Waves of this period, in pixels.
    fn waves(period: f32) -> Image {
        let value = |x: usize| 0.5 + 0.4 * (std::f32::consts::TAU * x as f32 / period).sin();
        let rgb = (0..96 * 128).flat_map(|i| [value(i % 128); 3]).collect();
        Image { width: 128, height: 96, rgb, alpha: None }
    }

    #[test]
    fn fine_waves_are_lost_and_long_ones_are_not() {
        let wave = |period| {
            let image = waves(period);
            [8, 4, 2].map(|d| 10.0 * (variance(&image) / lost(&image, d)).log10())
        };
        let (fine, long) = (wave(5.0), wave(64.0));
        assert!(fine[0] < 1.0 && fine[1] < 2.0 && fine[2] > 2.0 && fine[2] < 10.0, "{fine:?}");
        assert!(long[0] > 10.0 && long[1] > long[0] + 5.0 && long[2] > long[1] + 5.0, "{long:?}");
        assert!((variance(&waves(16.0)) - 0.08).abs() < 1e-3);
    }

    #[test]
    fn more_content_ends_the_small_pictures_earlier() {
        let gain = |divisor, decibels| Gain { divisor, decibels };
        let smooth = stages(&[gain(8, 12.0), gain(4, 18.0), gain(2, 40.0)], 1000);
        assert_eq!(smooth, [(200, 8), (300, 4), (400, 2)]);
        let fine = stages(&[gain(8, 0.0), gain(4, 6.0), gain(2, 12.0)], 1000);
        assert_eq!(fine, [(100, 4), (200, 2)]);
        assert_eq!(stages(&[gain(4, -3.0)], 1000), []);
        assert_eq!(stages(&[gain(2, 9.0)], 1), []);
    }
}
