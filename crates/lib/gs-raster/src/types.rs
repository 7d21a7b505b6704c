//! What goes in and what comes out.

/// How to rasterise.
#[derive(Debug, Clone, PartialEq)]
pub struct RasterOptions {
    /// Colour behind everything, sRGB 0 to 1.
    pub background: [f32; 3],
    /// Highest degree of spherical harmonics to use; bands the Gaussians do not have count as zero.
    pub sh_degree: u8,
    /// Gaussians nearer than this (camera z, world units) are not drawn.
    pub near: f32,
    /// Multiply opacities by sqrt(det(covariance) / det(covariance + 0.3 I)), so that a Gaussian smaller than a pixel keeps
    /// its weight when the low-pass widens it (the 2D filter of Mip-Splatting, Yu et al. 2024, as gsplat's "antialiased").
    pub antialias: bool,
    /// Render depth; else [`Rendered::depth`] is empty. What is not asked for is not computed.
    pub depth: bool,
}

impl Default for RasterOptions {
    fn default() -> Self {
        Self { background: [0.0; 3], sh_degree: 3, near: 0.01, antialias: false, depth: true }
    }
}

impl RasterOptions {
    /// How a geometry is to be rendered: as it was learnt.
    pub fn of(geometry: &gs_scene::Geometry) -> Self {
        Self { antialias: geometry.antialias, ..Self::fit(&geometry.gaussians) }
    }

    /// The defaults for these Gaussians: without the bands of harmonics that are zero, and a near plane of their scale.
    pub fn fit(gaussians: &gs_scene::Gaussians) -> Self {
        Self { sh_degree: gaussians.used_degree(), near: near_plane(gaussians.spread()), ..Self::default() }
    }
}

/// The near plane of a scene of this size (world units): a hundredth of it, so that a scene in kilometres is drawn as it is in
/// metres.
pub fn near_plane(size: f64) -> f32 {
    (0.01 * size).clamp(f64::from(f32::MIN_POSITIVE), f64::from(f32::MAX)) as f32
}

/// A rendered view.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Rendered {
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// `[height][width][rgb]`.
    pub rgb: Vec<f32>,
    /// Accumulated alpha, `[height][width]`, 0 to 1.
    pub alpha: Vec<f32>,
    /// Sum of blending weight times camera z, `[height][width]`; divide by alpha for a depth. Empty where
    /// [`RasterOptions::depth`] is off.
    pub depth: Vec<f32>,
}

/// d loss / d rendered pixels.
#[derive(Debug, Clone, Copy)]
pub struct PixelGradients<'a> {
    /// `[height][width][rgb]`.
    pub rgb: &'a [f32],
    /// `[height][width]`.
    pub alpha: Option<&'a [f32]>,
    /// `[height][width]`.
    pub depth: Option<&'a [f32]>,
}

/// d loss / d parameters, in the layouts of [`gs_scene::Gaussians`].
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Gradients {
    /// Of the centres.
    pub means: Vec<[f32; 3]>,
    /// Of the logarithms of the scales.
    pub log_scales: Vec<[f32; 3]>,
    /// Of the quaternions as stored (before they are normalised).
    pub rotations: Vec<[f32; 4]>,
    /// Of the opacity logits.
    pub opacity_logits: Vec<f32>,
    /// Of the spherical harmonics.
    pub sh: Vec<f32>,
    /// Of the projected centres, in pixels; zero for Gaussians that are not drawn.
    pub mean2d: Vec<[f32; 2]>,
    /// How many of the Gaussians drawn have a gradient that single precision does not hold: theirs are zero here.
    pub overflowed: usize,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_near_plane_goes_with_the_scene() {
        for by in [1e-6, 3.0, 1e6] {
            let ratio = f64::from(near_plane(by)) / f64::from(near_plane(1.0));
            assert!((ratio / by - 1.0).abs() < 1e-6, "{by}: {ratio}");
        }
        assert!(near_plane(0.0) > 0.0 && near_plane(1e300).is_finite());
    }
}
