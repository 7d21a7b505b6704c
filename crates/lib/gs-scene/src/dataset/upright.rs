//! Photographs whose EXIF data say that they lie on a side or upside down are turned upright, and their cameras with them.

use super::depth::DepthCamera;
use super::{RawDataset, RawView};
use crate::image::{size_and_turn, turned_size};
use glam::{DMat3, DVec3};
use gs_io::Result;
use image::metadata::Orientation;
use rayon::prelude::*;
use std::path::Path;

/// How the pictures of a view are turned as they are read.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Turn {
    /// What brings the photograph, as its pixels lie, to its camera.
    pub photograph: Orientation,
    /// Width and height of the photograph as its pixels lie, where the dataset's camera was of these: masks and depth images are, too.
    pub lying: Option<(u32, u32)>,
}

impl Turn {
    pub const NONE: Self = Self { photograph: Orientation::NoTransforms, lying: None };

    /// What brings a mask or depth image of this size to the camera. It is of the pixels as they lie where the camera was and the
    /// shape allows.
    pub fn of_companion(self, (width, height): (u32, u32)) -> Orientation {
        let fits = |(w, h): (u32, u32)| (w > h) == (width > height);
        if self.lying.is_some_and(fits) { self.photograph } else { Orientation::NoTransforms }
    }
}

/// Turns the views of a dataset upright. The size of a camera tells whether it was made from the pixels as they lie, as COLMAP does,
/// or from the turned photograph, as OpenCV reads it. Where both have one size, the pixels as they lie are meant, and it is said.
pub(super) fn turn(raw: &mut RawDataset) -> Result<()> {
    let unclear = raw.views.par_iter_mut().map(turn_view).collect::<Result<Vec<bool>>>()?;
    let count = unclear.iter().filter(|&&u| u).count();
    if count > 0 {
        let first = unclear.iter().position(|&u| u).map_or(String::new(), |i| raw.views[i].name.clone());
        raw.warnings.push(format!(
            "{count} of {} photographs, {first} first, are turned by EXIF data, and their size does not tell whether their cameras are, \
             too: taken as cameras of the pixels as they lie in the file, which COLMAP makes; if the poses were made from turned \
             photographs, write the turned ones to the files",
            raw.views.len()
        ));
    }
    Ok(())
}

/// Gives the view its turn; whether the camera's size leaves that open.
fn turn_view(view: &mut RawView) -> Result<bool> {
    let (lying, turn) = size_and_turn(&view.image_path)?;
    let upright = turned_size(lying, turn);
    if view.lens.size == upright && upright != lying {
        view.turn = Turn { photograph: turn, lying: None };
        return Ok(false);
    }
    view.lens.expect_size(lying, &view.image_path)?;
    // No camera sees a scene in a mirror, and a camera of depth beside the photograph's lies as that does: these stay as they lie.
    let alone = view.depth.as_ref().is_none_or(|d| d.camera == DepthCamera::Photograph);
    let quarters = quarters(turn).filter(|_| alone).unwrap_or(0);
    if quarters == 0 {
        return Ok(false);
    }
    for _ in 0..quarters {
        view.lens = view.lens.turned_quarter();
        // What lay to the right lies below, what lay below to the left.
        let turn = DMat3::from_cols(DVec3::Y, -DVec3::X, DVec3::Z);
        (view.rotation, view.translation) = (turn * view.rotation, turn * view.translation);
    }
    view.turn = Turn { photograph: turn, lying: Some(lying) };
    Ok(upright == lying)
}

/// Pictures `[height][width]`, one after the other, turned clockwise; gives their new width and height. Only quarters turn.
pub(super) fn turn_planes<T: Copy>(planes: &mut [T], size: (usize, usize), turn: Orientation) -> (usize, usize) {
    let quarters = quarters(turn).filter(|_| size.0 * size.1 > 0);
    (0..quarters.unwrap_or(0)).fold(size, |(width, height), _| {
        for plane in planes.chunks_exact_mut(width * height) {
            let lying = plane.to_vec();
            for (i, value) in lying.into_iter().enumerate() {
                plane[i % width * height + height - 1 - i / width] = value;
            }
        }
        (height, width)
    })
}

/// By how many quarters a turn goes clockwise; none where it mirrors or turns nothing.
fn quarters(turn: Orientation) -> Option<usize> {
    match turn {
        Orientation::Rotate90 => Some(1),
        Orientation::Rotate180 => Some(2),
        Orientation::Rotate270 => Some(3),
        _ => None,
    }
}

/// The size that the camera of a photograph was made for, where the dataset doesn't say: upright, unless the principal point lies nearer
/// to the middle of the pixels as they lie.
pub(super) fn size_by_center(path: &Path, center: Option<(f64, f64)>) -> Result<(u32, u32)> {
    let (lying, turn) = size_and_turn(path)?;
    let upright = turned_size(lying, turn);
    let off = |(w, h): (u32, u32)| center.map_or(0.0, |(x, y)| (x - 0.5 * f64::from(w)).hypot(y - 0.5 * f64::from(h)));
    Ok(if off(lying) < off(upright) { lying } else { upright })
}
