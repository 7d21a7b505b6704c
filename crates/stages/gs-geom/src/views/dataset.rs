//! The files of the dataset.

use super::options::Size;
use gs_io::{Result, write_bytes};
use gs_scene::dataset::write_transforms;
use gs_scene::{Camera, Gaussians, PointCloud, colmap};
use report::picture::Picture;
use std::path::Path;

/// Most centres of Gaussians among the sparse points.
const POINTS: usize = 10_000;
/// Pictures side by side on the contact sheet, and their width in pixels.
const COLUMNS: usize = 6;
const THUMB: usize = 240;

/// The name of picture `i`.
pub fn name(i: usize) -> String {
    format!("view_{i:04}.png")
}

/// Files of the model, below the dataset's folder.
pub const MODEL: [&str; 3] = ["cameras.bin", "images.bin", "points3D.bin"];

/// Writes the cameras as a COLMAP model and as transforms.json, with some centres of the Gaussians `counted` as points.
pub fn write_cameras(folder: &Path, cameras: &[Camera], g: &Gaussians, counted: &[u32]) -> Result<()> {
    let views: Vec<(String, Camera)> = cameras.iter().enumerate().map(|(i, c)| (name(i), c.clone())).collect();
    let kept = || counted.iter().step_by(counted.len().div_ceil(POINTS).max(1)).map(|&i| i as usize);
    let color = |i: usize| g.base_color(i).map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8);
    let points = PointCloud {
        positions: kept().map(|i| g.means[i]).collect(),
        colors: kept().map(color).collect(),
        shift: g.shift,
    };
    colmap::write_model(&folder.join("sparse/0"), &views, &points)?;
    let views: Vec<_> = views.into_iter().map(|(name, camera)| (format!("images/{name}"), camera)).collect();
    write_transforms(&folder.join("transforms.json"), &views, g.shift)
}

/// Small pictures side by side.
pub struct Sheet {
    thumbs: Vec<Picture>,
    width: usize,
    height: usize,
}

impl Sheet {
    /// A sheet of pictures of this size.
    pub fn new(size: Size) -> Self {
        let width = THUMB.min(size.0 as usize);
        Self { thumbs: Vec::new(), width, height: (width * size.1 as usize / size.0 as usize).max(1) }
    }

    /// Adds a picture, already shrunk to the sheet's size.
    pub fn add(&mut self, image: &gs_scene::Image) {
        let small = image.resize_area(self.width as u32, self.height as u32);
        self.thumbs.push(Picture::new(small.width, small.height, &small.rgb));
    }

    /// Writes the sheet as a PNG: in rows, in order.
    pub fn write(&self, path: &Path) -> Result<()> {
        let columns = COLUMNS.min(self.thumbs.len()).max(1);
        let rows = self.thumbs.len().div_ceil(columns);
        let width = columns * self.width;
        let mut pixels = vec![[1.0; 3]; width * rows * self.height];
        for (k, thumb) in self.thumbs.iter().enumerate() {
            let (x, y) = (k % columns * self.width, k / columns * self.height);
            for (row, line) in thumb.pixels.chunks(self.width).enumerate() {
                let at = (y + row) * width + x;
                pixels[at..at + self.width].copy_from_slice(line);
            }
        }
        let sheet = Picture { width, height: rows * self.height, pixels };
        write_bytes(path, &sheet.png()?)
    }
}
