//! What came out, against what should have.

use gs_raster::{RasterOptions, render, render_reference};
use gs_scene::{Camera, Gaussians};

/// Largest difference of colour and alpha between the renderer and the reference in f64, over all pixels, beyond what the
/// rounding of inputs to single precision must change (exponents whose terms cancel, and alphas at a cut); and whether a pixel
/// is not finite.
pub fn render_error(gaussians: &Gaussians, camera: &Camera) -> (f64, bool) {
    let options = RasterOptions { sh_degree: gaussians.sh_degree, ..RasterOptions::default() };
    let fast = render(gaussians, camera, &options);
    let exact = render_reference(gaussians, camera, &options);
    // A layer that rounding turns on or off changes a pixel by its colour, which may be brighter than white.
    let colors = (0..gaussians.len()).flat_map(|i| gaussians.base_color(i)).map(|c| f64::from(c).abs());
    let brightest = colors.fold(1.0, f64::max);
    let mut worst = 0.0f64;
    let mut finite = true;
    for (i, e) in exact.iter().enumerate() {
        finite &= fast.alpha[i].is_finite() && (0..3).all(|c| fast.rgb[3 * i + c].is_finite());
        let colors = (0..3).map(|c| (f64::from(fast.rgb[3 * i + c]) - e.rgb[c]).abs());
        let error = colors.fold((f64::from(fast.alpha[i]) - e.alpha).abs(), f64::max);
        worst = worst.max((error - (e.doubt + e.rounding) * brightest).max(0.0));
    }
    (worst, !finite)
}
