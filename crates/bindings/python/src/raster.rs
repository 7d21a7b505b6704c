//! The rasteriser, both ways.

use crate::gaussians::{Arrays, ArraysOut, CameraIn, to_arrays, to_camera};
use crate::work::run;
use gs_raster::{PixelGradients, RasterOptions, Workspace, render as rasterise};
use gs_scene::Gaussians;
use numpy::ndarray::{Array2, Array3};
use numpy::{IntoPyArray, PyArray2, PyArray3, PyReadonlyArray2, PyReadonlyArray3};
use pyo3::prelude::*;

/// Background, near plane (none: by the size of the scene), 2D filter, threads.
type Settings = ([f32; 3], Option<f32>, bool, usize);

fn options(g: &Gaussians, (background, near, antialias, _): Settings, depth: bool) -> RasterOptions {
    let fit = RasterOptions::fit(g);
    RasterOptions { background, near: near.unwrap_or(fit.near), antialias, depth, ..fit }
}

/// Colour, accumulated alpha, depth times alpha.
#[pyfunction]
#[expect(clippy::type_complexity, reason = "three arrays")]
pub fn render<'py>(
    py: Python<'py>,
    gaussians: Arrays<'py>,
    camera: CameraIn,
    settings: Settings,
) -> PyResult<(Bound<'py, PyArray3<f32>>, Bound<'py, PyArray2<f32>>, Bound<'py, PyArray2<f32>>)> {
    let (g, camera) = (gaussians.to_gaussians()?, to_camera(camera));
    let options = options(&g, settings, true);
    let r = run(py, settings.3, |_| rasterise(&g, &camera, &options))?;
    let (h, w) = (r.height as usize, r.width as usize);
    let image = |values| Array2::from_shape_vec((h, w), values).expect("a value of each pixel").into_pyarray(py);
    let rgb = Array3::from_shape_vec((h, w, 3), r.rgb).expect("three values of each pixel").into_pyarray(py);
    Ok((rgb, image(r.alpha), image(r.depth)))
}

/// The gradient of every parameter, given that of every pixel.
#[pyfunction]
pub fn render_backward<'py>(
    py: Python<'py>,
    gaussians: Arrays<'py>,
    camera: CameraIn,
    d_rgb: PyReadonlyArray3<'py, f32>,
    d_alpha: Option<PyReadonlyArray2<'py, f32>>,
    d_depth: Option<PyReadonlyArray2<'py, f32>>,
    settings: Settings,
) -> PyResult<ArraysOut<'py>> {
    let (g, camera) = (gaussians.to_gaussians()?, to_camera(camera));
    let options = RasterOptions { sh_degree: g.sh_degree, ..options(&g, settings, d_depth.is_some()) };
    let rgb: Vec<f32> = d_rgb.as_array().iter().copied().collect();
    let [alpha, depth] = [d_alpha, d_depth].map(|d| d.map(|d| d.as_array().iter().copied().collect::<Vec<f32>>()));
    let found = run(py, settings.3, |_| {
        let mut workspace = Workspace::default();
        workspace.forward(&g, &camera, &options);
        let pixels = PixelGradients { rgb: &rgb, alpha: alpha.as_deref(), depth: depth.as_deref() };
        std::mem::take(workspace.backward(&g, &camera, &options, pixels))
    })?;
    let gradient = Gaussians {
        means: found.means,
        log_scales: found.log_scales,
        rotations: found.rotations,
        opacity_logits: found.opacity_logits,
        sh: found.sh,
        sh_degree: g.sh_degree,
        ..Gaussians::default()
    };
    Ok(to_arrays(py, gradient))
}
