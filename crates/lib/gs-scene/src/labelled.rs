//! Gaussians with the instance of each, to write some of them as a splat of their own.

use crate::splat::{self, Extra, Format};
use crate::{Geometry, ply};
use gs_io::Result;
use std::path::Path;

/// Gaussians with the instance of each.
pub struct Labelled<'a> {
    geometry: &'a Geometry,
    /// Instance of every Gaussian, -1 for none.
    label: &'a [i32],
    /// The rows of the geometry's file, where they can be copied.
    rows: Option<ply::Vertices>,
    comments: Vec<String>,
}

impl<'a> Labelled<'a> {
    /// `label` is as long as there are Gaussians; `file` is where `geometry` was read from, and `own` are comments for a PLY, such as
    /// `made by export 0.1.0`.
    ///
    /// # Errors
    /// When the file cannot be read any more.
    pub fn new(geometry: &'a Geometry, file: &Path, label: &'a [i32], own: Vec<String>) -> Result<Self> {
        // Rows with numbers that are not finite would break those who read the file.
        let plain = geometry.damaged.is_empty() && Format::of_file(file)? == Format::Ply;
        let rows = plain.then(|| ply::Vertices::read(file)).transpose()?;
        Ok(Self { geometry, label, rows, comments: geometry.comments(own) })
    }

    /// Writes the Gaussians `which`, ascending, with all their harmonics, in the format that the file's name says; to a PLY with
    /// the instance of each and all other properties that the geometry's PLY has. Gives what the format loses, in words ([`splat::lost`]).
    ///
    /// # Errors
    /// When no format has such a name, or the file cannot be written.
    pub fn write(&self, to: &Path, which: &[u32]) -> Result<Vec<String>> {
        let format = Format::to_write(to)?;
        match (format, &self.rows) {
            (Format::Ply, Some(rows)) => rows.write(to, which, Some(self.label), &self.comments).map(|()| Vec::new()),
            _ => {
                let own: Vec<i32> = which.iter().map(|&i| self.label[i as usize]).collect();
                let antialias = self.geometry.antialias;
                // No other format has a place for it.
                let instance = (format == Format::Ply).then_some(&own[..]);
                let extra = Extra { comments: &self.comments, antialias, instance };
                let chosen = self.geometry.gaussians.select(which);
                splat::write(to, &chosen, &extra)?;
                splat::lost(to, &chosen)
            }
        }
    }
}
