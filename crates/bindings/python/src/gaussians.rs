//! Gaussians, cameras and files of Gaussians between numpy and Rust.

use crate::work::run;
use glam::{DMat3, DVec3};
use gs_scene::ply::INSTANCE;
use gs_scene::splat::{self, Extra};
use gs_scene::{Camera, Gaussians};
use numpy::ndarray::{Array2, Array3};
use numpy::{IntoPyArray, PyArray1, PyArray2, PyArray3, PyReadonlyArray1, PyReadonlyArray2, PyReadonlyArray3};
use pyo3::exceptions::{PyOSError, PyValueError};
use pyo3::prelude::*;
use std::path::PathBuf;

/// The arrays of `cags.Gaussians`, whose shapes the Python half checked: float32, C order.
#[derive(FromPyObject)]
pub struct Arrays<'py> {
    means: PyReadonlyArray2<'py, f32>,
    log_scales: PyReadonlyArray2<'py, f32>,
    rotations: PyReadonlyArray2<'py, f32>,
    opacity_logits: PyReadonlyArray1<'py, f32>,
    sh: PyReadonlyArray3<'py, f32>,
    shift: [f64; 3],
}

impl Arrays<'_> {
    /// A copy, which other threads may use while Python changes the arrays.
    pub fn to_gaussians(&self) -> PyResult<Gaussians> {
        let degree = match self.sh.as_array().shape()[1] {
            1 => 0,
            4 => 1,
            9 => 2,
            _ => 3,
        };
        Ok(Gaussians {
            means: self.means.as_slice()?.as_chunks().0.to_vec(),
            log_scales: self.log_scales.as_slice()?.as_chunks().0.to_vec(),
            rotations: self.rotations.as_slice()?.as_chunks().0.to_vec(),
            opacity_logits: self.opacity_logits.as_slice()?.to_vec(),
            sh: self.sh.as_slice()?.to_vec(),
            sh_degree: degree,
            shift: self.shift,
        })
    }
}

/// Means, logarithms of scales, rotations, opacity logits, harmonics.
pub type ArraysOut<'py> = (
    Bound<'py, PyArray2<f32>>,
    Bound<'py, PyArray2<f32>>,
    Bound<'py, PyArray2<f32>>,
    Bound<'py, PyArray1<f32>>,
    Bound<'py, PyArray3<f32>>,
);

/// The arrays of `cags.Gaussians`, made of Gaussians or of what is laid out like them, without a copy.
pub fn to_arrays(py: Python<'_>, g: Gaussians) -> ArraysOut<'_> {
    fn table<const N: usize>(py: Python<'_>, rows: Vec<[f32; N]>) -> Bound<'_, PyArray2<f32>> {
        let shape = (rows.len(), N);
        Array2::from_shape_vec(shape, rows.into_flattened()).expect("rows of N").into_pyarray(py)
    }
    let shape = (g.len(), g.sh_stride() / 3, 3);
    let sh = Array3::from_shape_vec(shape, g.sh).expect("harmonics of each Gaussian").into_pyarray(py);
    let (means, scales, rotations) = (table(py, g.means), table(py, g.log_scales), table(py, g.rotations));
    (means, scales, rotations, g.opacity_logits.into_pyarray(py), sh)
}

/// Width, height, fx, fy, cx, cy, rotation row by row, translation.
pub type CameraIn = (u32, u32, f64, f64, f64, f64, [[f64; 3]; 3], [f64; 3]);

/// A camera, whose numbers the Python half checked.
pub fn to_camera((width, height, fx, fy, cx, cy, rows, translation): CameraIn) -> Camera {
    let rotation = DMat3::from_cols_array_2d(&rows).transpose();
    Camera { width, height, fx, fy, cx, cy, rotation, translation: DVec3::from(translation) }
}

/// Reads a file of any format of Gaussians.
#[pyfunction]
pub fn read_gaussians(py: Python<'_>, path: PathBuf) -> PyResult<(ArraysOut<'_>, bool, [f64; 3])> {
    let there = path.exists();
    let failed =
        |e: gs_io::Error| if there { PyValueError::new_err(e.to_string()) } else { PyOSError::new_err(e.to_string()) };
    let found = run(py, 0, |_| splat::read(&path))?.map_err(failed)?;
    let (antialias, shift) = (found.antialias, found.gaussians.shift);
    Ok((to_arrays(py, found.gaussians), antialias, shift))
}

/// Writes a file in the format that its name says.
#[pyfunction]
pub fn write_gaussians(
    py: Python<'_>,
    path: PathBuf,
    gaussians: Arrays<'_>,
    antialias: bool,
    instance: Option<PyReadonlyArray1<'_, i32>>,
) -> PyResult<()> {
    let g = gaussians.to_gaussians()?;
    let instance: Option<Vec<i32>> = instance.map(|i| i.as_array().to_vec());
    let ids: Vec<_> = instance.iter().map(|labels| (INSTANCE, &labels[..])).collect();
    let extra = Extra { antialias, ids: &ids, ..Extra::default() };
    run(py, 0, |_| splat::write(&path, &g, &extra))?.map(drop).map_err(|e| PyValueError::new_err(e.to_string()))
}
