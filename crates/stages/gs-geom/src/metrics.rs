//! PSNR and SSIM of renders against photographs.

use crate::photographs::masks::{Alpha, Masks, multiply};
use crate::photographs::{Target, exact_target};
use crate::training::loss::{Derivatives, Pair, ssim};
use gs_io::Result;
use gs_raster::{RasterOptions, render};
use gs_scene::Gaussians;
use gs_scene::dataset::{Split, View};
use gs_sfm::solve;
use serde::Serialize;

/// PSNR of equal pictures, dB: the mean squared error counts as at least 1e-10.
const MOST_PSNR: f64 = 100.0;

/// Figures of one view.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ViewMetrics {
    pub name: String,
    /// `train`, `test`, or `unknown` where it may be either.
    pub split: &'static str,
    /// Peak signal-to-noise ratio, dB; none where no pixel counts.
    pub psnr: Option<f64>,
    /// Structural similarity, -1 to 1; none where no pixel counts.
    pub ssim: Option<f64>,
    /// The PSNR once the render's colours went through the affine map (3x4) that brings them nearest to the photograph's: it leaves out
    /// exposure and white balance, which no scene can know of a photograph that it never saw.
    pub psnr_fitted: Option<f64>,
}

/// PSNR in dB for values from 0 to 1.
pub fn psnr(a: &[f32], b: &[f32]) -> f64 {
    assert_eq!(a.len(), b.len());
    let sum: f64 = a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum();
    let error = sum / a.len().max(1) as f64;
    (-10.0 * error.log10()).min(MOST_PSNR)
}

/// Renders a view and compares it with its photograph. The render is clamped to 0 to 1 but not rounded to 8 bits.
pub fn measure(
    g: &Gaussians,
    view: &View,
    options: &RasterOptions,
    alpha: Alpha,
    masks: &Masks,
    room: &mut Derivatives,
) -> Result<ViewMetrics> {
    let target = exact_target(view, masks, behind(alpha, options.background))?;
    let mut rgb = render(g, &view.camera, &RasterOptions { depth: false, ..options.clone() }).rgb;
    let mut mapped = fitted(&rgb, &target, alpha);
    let (psnr, ssim) = compare(&mut rgb, view.camera.width as usize, &target, alpha, room).unzip();
    let psnr_fitted = compare(&mut mapped, view.camera.width as usize, &target, alpha, room).map(|f| f.0);
    let split = if view.split == Split::Test { "test" } else { "train" };
    Ok(ViewMetrics { name: view.name.clone(), split, psnr, ssim, psnr_fitted })
}

/// The render through the affine map of colours that brings it nearest to the target, in the least-squares sense of the pixels that count.
fn fitted(rgb: &[f32], target: &Target, alpha: Alpha) -> Vec<f32> {
    let weights = target.alpha.as_ref().filter(|_| alpha == Alpha::Ignore);
    let (mut a, mut b) = ([[0.0; 4]; 4], [[0.0; 4]; 3]);
    let pixels = rgb.as_chunks::<3>().0;
    for (i, (p, wanted)) in pixels.iter().zip(target.rgb.as_chunks::<3>().0).enumerate() {
        let weight = weights.map_or(1.0, |w| w[i]);
        let [r, g, blue] = p.map(|v| v.clamp(0.0, 1.0));
        let row = [r, g, blue, 1.0].map(|v| f64::from(weight * v));
        for j in 0..4 {
            (0..4).for_each(|k| a[j][k] += row[j] * row[k]);
            (0..3).for_each(|c| b[c][j] += row[j] * f64::from(wanted[c]));
        }
    }
    // A picture of one colour says little: as a thousandth of a pixel that stays as it is.
    (0..4).for_each(|k| a[k][k] += 1e-3);
    (0..3).for_each(|c| b[c][c] += 1e-3);
    let map: Vec<[f64; 4]> = b.iter().filter_map(|b| solve(a, *b)).collect();
    let [red, green, blue] = map[..] else { return rgb.to_vec() };
    let through = |p: &[f32; 3]| {
        let [r, g, b] = p.map(|v| f64::from(v.clamp(0.0, 1.0)));
        [red, green, blue].map(|m| (m[0] * r + m[1] * g + m[2] * b + m[3]) as f32)
    };
    pixels.iter().flat_map(through).collect()
}

/// What is to lie behind a photograph's transparent pixels, where `background` is behind the scene: pixels that do not
/// count are black in both pictures.
pub fn behind(alpha: Alpha, background: [f32; 3]) -> [f32; 3] {
    if alpha == Alpha::Ignore { [0.0; 3] } else { background }
}

/// PSNR and SSIM of a render against `target`, which lies over [`behind`]. With [`Alpha::Ignore`] the PSNR is that of the
/// pixels that count, each weighed by the square of its alpha; in the SSIM the others are black in both pictures. `rgb`
/// (`[height][width][rgb]`) is clamped and masked in place. None where less than one pixel counts, as below a black mask:
/// both pictures are black then, which says nothing. `room` is to work in, whatever it held before.
pub fn compare(
    rgb: &mut [f32],
    width: usize,
    target: &Target,
    alpha: Alpha,
    room: &mut Derivatives,
) -> Option<(f64, f64)> {
    rgb.iter_mut().for_each(|v| *v = v.clamp(0.0, 1.0));
    let mut psnr_gain = 0.0;
    if let Some(weights) = target.alpha.as_ref().filter(|_| alpha == Alpha::Ignore) {
        multiply(rgb, weights);
        let count: f64 = weights.iter().map(|a| f64::from(*a).powi(2)).sum();
        if count < 1.0 {
            return None;
        }
        psnr_gain = 10.0 * (count / weights.len() as f64).log10();
    }
    let psnr = (psnr(rgb, &target.rgb) + psnr_gain).min(MOST_PSNR);
    Some((psnr, ssim(Pair { render: rgb, target: &target.rgb, width }, room)))
}

/// Means over views.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Means {
    /// Of the PSNR, dB; none where no view counts.
    pub psnr: Option<f64>,
    /// Of the SSIM.
    pub ssim: Option<f64>,
    /// A warning about views in which no pixel counts, if there are any.
    pub uncounted: Option<String>,
}

impl Means {
    /// Of each view's name with its PSNR and SSIM.
    pub fn of<'a>(views: impl Iterator<Item = (&'a str, Option<(f64, f64)>)> + Clone) -> Self {
        let figures: Vec<(f64, f64)> = views.clone().filter_map(|v| v.1).collect();
        let blank: Vec<&str> = views.filter(|v| v.1.is_none()).map(|v| v.0).collect();
        let uncounted = blank.first().map(|first| {
            let count = blank.len();
            format!("{count} of the views measured: no pixel counts there (a black mask), in {first} for one")
        });
        let mean = |of: fn(&(f64, f64)) -> f64| {
            (!figures.is_empty()).then(|| figures.iter().map(of).sum::<f64>() / figures.len() as f64)
        };
        Self { psnr: mean(|f| f.0), ssim: mean(|f| f.1), uncounted }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_map_of_colours_takes_exposure_out_and_leaves_the_rest() {
        let rgb: Vec<f32> = (0..300).map(|i| 0.5 + 0.3 * (i as f32 * 0.77).sin()).collect();
        let brighter = rgb.iter().map(|v| 0.8 * v + 0.1).collect();
        let mut target = Target { rgb: brighter, alpha: None };
        assert!(psnr(&fitted(&rgb, &target, Alpha::Background), &target.rgb) > 60.0);
        // A pixel that is another thing stays one.
        target.rgb[30..33].fill(1.0);
        let left = psnr(&fitted(&rgb, &target, Alpha::Background), &target.rgb);
        assert!((20.0..40.0).contains(&left), "{left}");
        // Where it does not count, it does not turn the map.
        let alpha = (0..100).map(|i| if i == 10 { 0.0 } else { 1.0 }).collect();
        target.alpha = Some(alpha);
        let mapped = fitted(&rgb, &target, Alpha::Ignore);
        assert!(mapped.iter().zip(&target.rgb).enumerate().all(|(i, (a, b))| i / 3 == 10 || (a - b).abs() < 1e-3));
    }

    #[test]
    fn psnr_of_known_errors() {
        assert!((psnr(&[0.5; 12], &[0.6; 12]) - 20.0).abs() < 1e-5);
        assert_eq!(psnr(&[0.5; 12], &[0.5; 12]), 100.0);
        let means = Means::of([("a", Some((1.0, 0.25))), ("b", Some((2.0, 0.75)))].into_iter());
        assert_eq!(means, Means { psnr: Some(1.5), ssim: Some(0.5), uncounted: None });
        assert_eq!(Means::of([].into_iter()), Means::default());
    }
}
