//! PSNR and SSIM of renders against photographs.

use crate::loss::{Pair, ssim};
use crate::photographs::over_background;
use gs_io::Result;
use gs_raster::{RasterOptions, render};
use gs_scene::Gaussians;
use gs_scene::dataset::{Split, View};
use serde::Serialize;

/// PSNR of equal pictures, dB: the mean squared error counts as at least 1e-10.
const MOST_PSNR: f64 = 100.0;

/// Figures of one view.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ViewMetrics {
    /// Name of the photograph.
    pub name: String,
    /// `train` or `test`.
    pub split: &'static str,
    /// Peak signal-to-noise ratio, dB.
    pub psnr: f64,
    /// Structural similarity, -1 to 1.
    pub ssim: f64,
}

/// PSNR in dB for values from 0 to 1.
///
/// # Panics
/// When the pictures have different sizes.
pub fn psnr(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len());
    let sum: f64 = a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum();
    let error = sum / a.len().max(1) as f64;
    (-10.0 * error.log10()).min(MOST_PSNR)
}

/// Renders a view and compares it with its photograph. The render is clamped to 0 to 1 but not rounded to 8 bits.
///
/// # Errors
/// When the photograph cannot be read.
pub fn measure(g: &Gaussians, view: &View, options: &RasterOptions) -> Result<ViewMetrics> {
    let target = over_background(view.load_image()?, options.background).rgb;
    let (psnr, ssim) = compare(g, &view.camera, options, &target);
    let split = if view.split == Split::Test { "test" } else { "train" };
    Ok(ViewMetrics { name: view.name.clone(), split, psnr, ssim })
}

/// PSNR and SSIM of a render against `target`, `[height][width][rgb]`.
pub fn compare(g: &Gaussians, camera: &gs_scene::Camera, options: &RasterOptions, target: &[f32]) -> (f64, f64) {
    let mut rgb = render(g, camera, options).rgb;
    rgb.iter_mut().for_each(|v| *v = v.clamp(0.0, 1.0));
    (psnr(&rgb, target), ssim(Pair { render: &rgb, target, width: camera.width as usize }))
}

/// Mean of some figure over views; `None` of none.
pub fn mean(values: impl Iterator<Item = f64>) -> Option<f64> {
    let (sum, count) = values.fold((0.0, 0u32), |(s, n), v| (s + v, n + 1));
    (count > 0).then(|| sum / f64::from(count))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn psnr_of_known_errors() {
        assert!((psnr(&[0.5; 12], &[0.6; 12]) - 20.0).abs() < 1e-5);
        assert_eq!(psnr(&[0.5; 12], &[0.5; 12]), 100.0);
        assert_eq!(mean([1.0, 2.0].into_iter()), Some(1.5));
        assert_eq!(mean([].into_iter()), None);
    }
}
