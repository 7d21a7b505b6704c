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
}

impl Default for RasterOptions {
    fn default() -> Self {
        Self { background: [0.0; 3], sh_degree: 3, near: 0.01 }
    }
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
    /// Sum of blending weight times camera z, `[height][width]`; divide by alpha for a depth.
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
    /// Sum over pixels of the absolute values of that gradient (AbsGS).
    pub mean2d_abs: Vec<[f32; 2]>,
}
