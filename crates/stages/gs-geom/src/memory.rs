//! Forecasts of the memory that a run will take.
//!
//! The terms are counted from the sizes of the arrays that live at the same time; docs/performance.md compares them with
//! measured peaks, and so does tests/cli.rs on small scenes.

use gs_io::Result;
use gs_scene::dataset::Dataset;
use gs_scene::{image_size, sh_coefficients};
use serde::Serialize;
use stage::Bytes;

/// The program itself, its threads' stacks and the allocator's slack.
const BASE: u64 = 10 << 20;
/// Per pixel of the largest view in training: render with alpha 16, target 12, gradient 12, three maps of SSIM 36.
pub const PER_PIXEL: u64 = 76;
/// Per pixel of a photograph's file while it is decoded: 8-bit and f32 RGB.
const PER_DECODED_PIXEL: u64 = 15;
/// Per pixel while it is shrunk: f32 RGB, once for the pixels of new width and old height, twice for the result.
const PER_SHRUNK_PIXEL: u64 = 12;
/// Per tile that a drawn Gaussian touches: its entry in the tile's list and in the Gaussian's, and its gradient.
pub const PER_TILE: u64 = 56;
/// Per Gaussian in a step, besides its gradient: what the renderer keeps of those it draws, and their lists.
const PER_DRAWN: u64 = 200;

/// What a run's peak memory is made of, bytes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Forecast {
    /// Photographs kept decoded.
    pub photographs: u64,
    /// Photographs on their way from the file into memory.
    pub decoding: u64,
    /// Whether that happens in training too, and not only before it.
    pub decodes_again: bool,
    /// Pictures of one iteration.
    pub pictures: u64,
    /// Lists of the tiles' Gaussians and their gradients, of the views tried.
    pub tiles: u64,
    pub per_gaussian: u64,
}

/// Sizes of a dataset's photographs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pictures {
    /// Pixels of the largest view.
    pub pixels: u64,
    /// Width of the widest view.
    pub width: u64,
    /// Width and height of the largest photograph's file.
    pub file: (u32, u32),
}

impl Pictures {
    /// Those of a dataset.
    pub fn of(dataset: &Dataset) -> Result<Self> {
        let mut of = Self { pixels: 0, width: 0, file: (0, 0) };
        for view in &dataset.views {
            let (width, height) = (u64::from(view.camera.width), u64::from(view.camera.height));
            let (w, h) = image_size(&view.image_path)?;
            of.pixels = of.pixels.max(width * height);
            of.width = of.width.max(width);
            of.file = (of.file.0.max(w), of.file.1.max(h));
        }
        Ok(of)
    }

    /// Bytes that a photograph takes on its way from its file to a view.
    pub fn decoding(&self) -> u64 {
        let (w, h) = (u64::from(self.file.0), u64::from(self.file.1));
        PER_DECODED_PIXEL * w * h + PER_SHRUNK_PIXEL * (self.width * h + 2 * self.pixels)
    }
}

/// Bytes that a run takes for each Gaussian, with spherical harmonics of this degree.
pub fn per_gaussian(sh_degree: u8, densifies: bool) -> u64 {
    let numbers = 4 * numbers(sh_degree);
    // Parameters, two moments and sums of gradients. Beside them in a step: the gradient with that of the projected centre, and
    // the drawn Gaussians. Densification, at the end of a step, copies the parameters and each moment in turn, and the
    // allocator does not give all of it back: twice as much was measured. Tiles are counted with the Gaussians of the start; a
    // small one that comes later touches one or two.
    let copy = if densifies { 2 * numbers + 2 * PER_TILE } else { 0 };
    (3 * numbers + 8) + (numbers + 16 + PER_DRAWN + copy)
}

/// Numbers of a Gaussian: centre, scales, quaternion, opacity, spherical harmonics.
fn numbers(sh_degree: u8) -> u64 {
    11 + 3 * sh_coefficients(sh_degree) as u64
}

impl Forecast {
    /// What comes and goes. The allocator keeps what decoding took, in pieces into which the pictures and tiles of training
    /// fit only in part: half of the lesser comes on top, as measured.
    pub fn scratch(&self) -> u64 {
        let training = self.pictures + self.tiles;
        if self.decodes_again {
            return self.decoding + training;
        }
        self.decoding.max(training) + self.decoding.min(training) / 2
    }

    /// Peak memory with this number of Gaussians, bytes.
    pub fn peak(&self, gaussians: usize) -> Bytes {
        Bytes(
            (BASE + self.photographs + self.scratch())
                .saturating_add(self.per_gaussian.saturating_mul(gaussians as u64)),
        )
    }
}

/// What the program takes for itself where it does not train.
const PROGRAM: u64 = 5_000_000;

/// Peak in bytes of `inspect` and `convert`, for a file of `geometry` bytes: the file and its Gaussians at the same time.
pub fn of_file(geometry: u64) -> u64 {
    PROGRAM + 23 * geometry / 10
}

/// Peak in bytes of `convert` where it adds bands of spherical harmonics.
pub fn of_bands(gaussians: usize, from: u8, to: u8) -> u64 {
    PROGRAM + 4 * gaussians as u64 * (numbers(from) + numbers(to))
}

/// Peak in bytes of `convert` where photographs tell the axes: a copy that is turned.
pub fn of_axes(geometry: u64, pictures: &Pictures) -> u64 {
    of_figures(geometry, pictures) + geometry
}

/// Peak in bytes of `render`.
pub fn of_renders(geometry: u64, pictures: &Pictures, exr: bool) -> u64 {
    let bytes = if exr { 74 } else { 28 };
    of_file(geometry).max(PROGRAM + 9 * geometry / 5 + bytes * pictures.pixels)
}

/// Peak in bytes of `views`: beside a render, two grids, a bit of every Gaussian for each camera that is tried, and of the file's
/// Gaussians those that count.
pub fn of_views(geometry: u64, pixels: u64, views: usize) -> u64 {
    PROGRAM + 23 * geometry / 10 + 48 * pixels + (48 << 20) + 1_500_000 * views as u64 / 4
}

/// Peak in bytes of `eval`.
pub fn of_figures(geometry: u64, pictures: &Pictures) -> u64 {
    let measuring = PROGRAM + 9 * geometry / 5 + 86 * pictures.pixels;
    of_file(geometry).max(PROGRAM + geometry + pictures.decoding()).max(measuring)
}
