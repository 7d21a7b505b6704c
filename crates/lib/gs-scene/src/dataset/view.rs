//! One view: a photograph, the camera that took it, and the pinhole camera that stands for it.

use super::depth::{Depth, DepthMap};
use super::mask::Mask;
use super::upright::{Turn, turn_planes};
use super::{RawView, Resolution, Split};
use crate::lens::Lens;
use crate::{Camera, Image, size_within};
use glam::DVec3;
use gs_io::{Error, Result};
use multiversion::multiversion;
use rayon::prelude::*;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// A posed photograph.
#[derive(Debug, Clone, PartialEq)]
pub struct View {
    /// File name relative to the images folder, or as the dataset gives it.
    pub name: String,
    /// Where the photograph lies.
    pub image_path: PathBuf,
    /// The undistorted camera at the requested resolution.
    pub camera: Camera,
    /// What the view is for.
    pub split: Split,
    stem: String,
    lens: Lens,
    depth: Option<Depth>,
    mask: Option<PathBuf>,
    turn: Turn,
    /// The pose's translation as the dataset gives it; that of the camera is of the world less a shift.
    translation: DVec3,
}

impl View {
    pub(super) fn new(raw: RawView, stem: String, split: Split, resolution: Resolution) -> Result<Self> {
        let RawView { name, image_path, lens, rotation, translation, depth, mask, turn, .. } = raw;
        let Some(zoom) = lens.zoom() else {
            return Err(Error::new("the lens distortion is too strong to take out")
                .file(image_path)
                .field("camera")
                .found(format!("{:?}", lens.distortion))
                .hint("check the coefficients, or run COLMAP's image_undistorter"));
        };
        let [fx, fy, cx, cy] = lens.focal_center;
        let (width, height) = lens.size;
        let full = Camera { width, height, fx: fx * zoom, fy: fy * zoom, cx, cy, rotation, translation };
        let (width, height) = resolution.apply(width, height);
        let camera = full.resized(width, height);
        Ok(Self { name, image_path, camera, split, stem, lens, depth, mask, turn, translation })
    }

    /// By what masks and other files of this view are found: the file name without folder and last extension. Where
    /// two views of the dataset share that, the folders before it too, joined by `_`.
    pub fn stem(&self) -> &str {
        &self.stem
    }

    /// The pose's translation as the dataset gives it.
    pub(super) fn translation(&self) -> DVec3 {
        self.translation
    }

    /// Takes the camera to the world less a shift.
    pub(super) fn shift_to(&mut self, shift: [f64; 3]) {
        self.camera.translation = self.translation + self.camera.rotation * DVec3::from(shift);
    }

    pub(super) fn lens(&self) -> &Lens {
        &self.lens
    }

    /// Decodes the photograph, turns it upright, undistorts it and brings it to the camera's size.
    ///
    /// # Errors
    /// When the file cannot be read or its size is not the camera's.
    pub fn load_image(&self) -> Result<Image> {
        self.load(self.camera.width, self.camera.height)
    }

    /// As [`Self::load_image`], at the photograph's own size, or with a longer side of so many pixels where it is larger.
    pub fn load_image_within(&self, longest: u32) -> Result<Image> {
        let (w, h) = size_within(self.lens.size, longest);
        self.load(w, h)
    }

    /// Where the depth image lies, if there is one.
    pub fn depth_path(&self) -> Option<&Path> {
        self.depth.as_ref().map(|d| &*d.path)
    }

    /// Decodes the depth image, undistorted as the photograph is; none where there is none.
    ///
    /// # Errors
    /// When it cannot be read, is neither a picture of 16-bit grey nor an npy file, or lies on a side beside the photograph.
    pub fn load_depth(&self) -> Result<Option<DepthMap>> {
        self.depth.as_ref().map(|d| d.load(self)).transpose()
    }

    /// The mask that the dataset has of the photograph, if there is one.
    pub fn mask_path(&self) -> Option<&Path> {
        self.mask.as_deref()
    }

    /// Decodes a mask of the photograph, of the same size as that.
    ///
    /// # Errors
    /// When it cannot be read or has another size.
    pub fn read_mask(&self, path: &Path) -> Result<Mask> {
        let mask = Mask::read(path, self.turn)?;
        self.lens.expect_size((mask.width, mask.height), path)?;
        Ok(mask)
    }

    /// As [`Self::read_mask`], undistorted, `[height][width]` at the camera's size: by how much each pixel counts, 0 to 1.
    pub fn load_mask(&self, path: &Path) -> Result<Vec<f32>> {
        let Mask { width, height, values, .. } = self.read_mask(path)?;
        let grey = Image { width, height, rgb: values.into_iter().flat_map(|v| [v; 3]).collect(), alpha: None };
        let flat = self.flat(grey, self.camera.width, self.camera.height);
        Ok(flat.rgb.iter().step_by(3).copied().collect())
    }

    fn load(&self, width: u32, height: u32) -> Result<Image> {
        let photo = Image::read_turned(&self.image_path, self.turn.photograph)?;
        self.lens.expect_size((photo.width, photo.height), &self.image_path)?;
        Ok(self.flat(photo, width, height))
    }

    fn flat(&self, photo: Image, width: u32, height: u32) -> Image {
        let flat = if self.lens.distortion.is_none() { photo } else { self.undistort(&photo) };
        flat.resize_area(width, height)
    }

    /// Whether the lens bends straight lines: what was made from the photograph as it lies on disk has them bent, too.
    pub fn is_distorted(&self) -> bool {
        !self.lens.distortion.is_none()
    }

    /// Whether the camera sees the photograph as it lies on disk: neither turned nor bent. [`Self::straighten`] then changes nothing.
    pub fn is_straight(&self) -> bool {
        !self.is_distorted() && self.turn.lying.is_none()
    }

    /// Brings numbers that cannot be mixed, such as mask ids, to the camera of the view: turns them upright, takes the distortion out,
    /// and gives their width and height. `planes` are pictures `[height][width]`, one after the other, of the photograph as it lies on
    /// disk, and may be smaller than it, not of another shape.
    pub fn straighten<T: Copy>(&self, planes: &mut [T], (width, height): (usize, usize)) -> (usize, usize) {
        let turn = self.turn.of_companion((width as u32, height as u32));
        let (width, height) = turn_planes(planes, (width, height), turn);
        self.undistort_nearest(planes, width, height);
        (width, height)
    }

    /// Takes the distortion out: each pixel takes the number of the nearest one, at the place that [`Self::load_image`] takes its
    /// colour from.
    pub(super) fn undistort_nearest<T: Copy>(&self, planes: &mut [T], width: usize, height: usize) {
        if !self.is_distorted() || width * height == 0 {
            return;
        }
        let (zoom, (w, h)) = (self.zoom(), self.lens.size);
        let (sx, sy) = (f64::from(w) / width as f64, f64::from(h) / height as f64);
        // The cast turns what is below zero, and NaN, into 0.
        let nearest = |v: f64, size: usize| (v as usize).min(size - 1);
        let from = (0..width * height).into_par_iter().map(|i| {
            let (u, v) = self.lens.locate(zoom, ((i % width) as f64 + 0.5) * sx, ((i / width) as f64 + 0.5) * sy);
            (nearest(v / sy, height) * width + nearest(u / sx, width)) as u32
        });
        let from: Vec<u32> = from.collect();
        for plane in planes.chunks_exact_mut(width * height) {
            let bent = plane.to_vec();
            plane.iter_mut().zip(&from).for_each(|(to, &i)| *to = bent[i as usize]);
        }
    }

    /// By how much the pinhole camera's focal lengths are longer than the lens's.
    fn zoom(&self) -> f64 {
        self.camera.resized(self.lens.size.0, self.lens.size.1).fx / self.lens.focal_center[0]
    }

    /// Resamples the photograph as the pinhole camera would have seen it.
    fn undistort(&self, photo: &Image) -> Image {
        let (w, zoom) = (photo.width as usize, self.zoom());
        let mut rgb = vec![0.0f32; photo.rgb.len()];
        rgb.par_chunks_mut(3 * w).enumerate().for_each_init(
            || vec![(0.0, 0.0); w],
            |places, (y, row)| {
                locate_row(&self.lens, zoom, y as f64 + 0.5, places);
                let pixels = row.as_chunks_mut::<3>().0.iter_mut();
                pixels.zip(places).for_each(|(pixel, place)| *pixel = photo.sample(place.0, place.1));
            },
        );
        let alpha = photo.alpha.as_ref().map(|_| {
            let of = |i: usize| self.lens.locate(zoom, (i % w) as f64 + 0.5, (i / w) as f64 + 0.5);
            let pixels = (0..w * photo.height as usize).into_par_iter().map(of);
            pixels.map(|place| photo.sample_alpha(place.0, place.1)).collect()
        });
        Image { rgb, alpha, ..*photo }
    }
}

/// [`Lens::locate`] of a row's pixels.
#[multiversion(targets("x86_64+avx2"))]
fn locate_row(lens: &Lens, zoom: f64, y: f64, places: &mut [(f64, f64)]) {
    for (x, place) in places.iter_mut().enumerate() {
        *place = lens.locate(zoom, x as f64 + 0.5, y);
    }
}

/// Each view's stem; see [`View::stem`].
pub(super) fn stems(names: &[&str]) -> Result<Vec<String>> {
    let short = |name: &&str| Path::new(name).file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let long = |name: &&str| Path::new(name).with_extension("").to_string_lossy().replace(['/', '\\'], "_");
    let stems: Vec<String> = names.iter().map(short).collect();
    if stems.iter().collect::<BTreeSet<_>>().len() == stems.len() {
        return Ok(stems);
    }
    let stems: Vec<String> = names.iter().map(long).collect();
    let mut seen = BTreeSet::new();
    match stems.iter().position(|s| !seen.insert(s)) {
        None => Ok(stems),
        Some(i) => Err(Error::new("two views have the same name")
            .field(names[i])
            .hint("rename the photographs: masks are found by name without extension")),
    }
}
