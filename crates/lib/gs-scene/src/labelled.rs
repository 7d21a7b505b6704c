//! Gaussians with the instance of each, to write some of them as a splat of their own.

use crate::ply::{INSTANCE, IdColumn};
use crate::splat::{self, Extra, Format};
use crate::{Geometry, ply};
use gs_io::Result;
use std::path::Path;

/// Gaussians with the instance of each.
pub struct Labelled<'a> {
    geometry: &'a Geometry,
    /// For every Gaussian its instance, and what else a PLY is to say of it.
    ids: Vec<IdColumn<'a>>,
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
        Ok(Self { geometry, ids: vec![(INSTANCE, label)], rows, comments: geometry.comments(own) })
    }

    /// With one number more for every Gaussian in a PLY.
    pub fn with(mut self, ids: IdColumn<'a>) -> Self {
        self.ids.push(ids);
        self
    }

    /// Writes the Gaussians `which`, ascending, with all their harmonics, in the format that the file's name says; to a PLY with
    /// the instance of each and all other properties that the geometry's PLY has. Gives those that the file has, in its order, and what
    /// the format loses, in words ([`splat::lost`]).
    ///
    /// # Errors
    /// When no format has such a name, or the file cannot be written.
    pub fn write(&self, to: &Path, which: &[u32]) -> Result<(Vec<u32>, Vec<String>)> {
        let format = Format::to_write(to)?;
        match (format, &self.rows) {
            (Format::Ply, Some(rows)) => {
                rows.write(to, which, &self.ids, &self.comments).map(|()| (which.to_vec(), Vec::new()))
            }
            _ => {
                let of = |(_, all): &IdColumn<'_>| which.iter().map(|&i| all[i as usize]).collect();
                let own: Vec<Vec<i32>> = self.ids.iter().map(of).collect();
                let mut ids: Vec<IdColumn<'_>> = self.ids.iter().zip(&own).map(|(c, own)| (c.0, &own[..])).collect();
                // No other format has a place for them.
                ids.retain(|_| format == Format::Ply);
                let extra = Extra { comments: &self.comments, antialias: self.geometry.antialias, ids: &ids };
                let chosen = self.geometry.gaussians.select(which);
                let order = splat::write(to, &chosen, &extra)?;
                let of = |order: Vec<u32>| order.into_iter().map(|at| which[at as usize]).collect();
                Ok((order.map_or_else(|| which.to_vec(), of), splat::lost(to, &chosen)?))
            }
        }
    }
}
