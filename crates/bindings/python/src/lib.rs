//! The Rust half of the Python package `cags`: it takes and gives numpy arrays, releases the interpreter lock while it works,
//! and leaves checks of arguments, names and documentation to the Python half in `cags/`.

mod gaussians;
mod hdbscan;
mod points;
mod raster;
mod runs;
mod work;

use pyo3::prelude::*;

/// What the Python half calls.
#[pymodule]
mod _native {
    #[pymodule_export]
    use crate::gaussians::{read_gaussians, write_gaussians};
    #[pymodule_export]
    use crate::hdbscan::{hdbscan, hdbscan_graph, hdbscan_predict};
    #[pymodule_export]
    use crate::points::{farthest_point_sample, nearest_neighbours};
    #[pymodule_export]
    use crate::raster::{render, render_backward};
    #[pymodule_export]
    use crate::runs::{Labelled, Words, check_artifact, input_of_run};
}
