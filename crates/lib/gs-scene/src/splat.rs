//! Files of Gaussians in the formats that people hold: which one a file has, reading it, writing it (docs/splats.md).
//!
//! Whatever the file's axes, what is read and given to write has those of a PLY of the original 3DGS code: x right, y down, z
//! forward (RDF) where the format says what its axes are.

pub(crate) mod axes;
pub mod compressed_ply;
mod spz;
mod stream;
#[cfg(test)]
pub(crate) mod testing;

use crate::{Gaussians, ply};
use gs_io::{Error, IoContext, Result};
use std::fs::File;
use std::io::Read;
use std::path::Path;

/// A format of files of Gaussians.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// PLY of 3DGS.
    Ply,
    /// PLY as PlayCanvas compresses it.
    CompressedPly,
    /// SPZ of Niantic, versions 1 to 4.
    Spz,
}

/// What a file of Gaussians holds.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Splat {
    /// The Gaussians in the file's order, every number as it stands there, finite or not.
    pub gaussians: Gaussians,
    /// Whether they were learnt with the 2D filter of Mip-Splatting, where the format says so.
    pub antialias: bool,
    /// The format for people, such as `SPZ version 4`.
    pub kind: String,
    /// What the file has that was left out.
    pub left_out: Vec<String>,
}

/// Bytes by which a file is known.
const MAGIC: [(&[u8], Format); 3] = [(b"ply", Format::Ply), (b"NGSP", Format::Spz), (&[0x1f, 0x8b], Format::Spz)];

/// The format of a file: by its first bytes, whatever its name.
///
/// # Errors
/// When it cannot be read, or is of none.
pub fn format_of(path: &Path) -> Result<Format> {
    let mut start = Vec::new();
    File::open(path).at("open", path)?.take(64).read_to_end(&mut start).at("read", path)?;
    let known = MAGIC.iter().find(|(magic, _)| start.starts_with(magic)).map(|(_, format)| *format);
    let format = known.ok_or_else(|| {
        Error::new("not a file of Gaussians")
            .file(path)
            .found(format!("{} bytes that begin with {:?}", start.len(), start.get(..4).unwrap_or(&start)))
            .expected("PLY, compressed PLY or SPZ")
    })?;
    if format == Format::Ply && ply::is_compressed(path)? {
        return Ok(Format::CompressedPly);
    }
    Ok(format)
}

/// Reads a file of Gaussians, and takes every number as it stands.
///
/// # Errors
/// When the file is of no known format, or is damaged; the error names field and place.
pub fn read(path: impl AsRef<Path>) -> Result<Splat> {
    let path = path.as_ref();
    let plain = |kind: &str| -> Result<Splat> {
        let (gaussians, antialias) = (ply::read_gaussians_as_they_are(path)?, ply::is_antialiased(path)?);
        Ok(Splat { gaussians, antialias, kind: kind.into(), left_out: Vec::new() })
    };
    match format_of(path)? {
        Format::Ply => plain("PLY"),
        Format::CompressedPly => plain("compressed PLY"),
        Format::Spz => spz::read(path).map_err(|e| e.file(path)),
    }
}

/// Reads a file of Gaussians all of which must be whole. Infinite opacity logits, which stand for an opacity of 0 or 1, become
/// +-50.
///
/// # Errors
/// As [`read`], and when a parameter is not finite.
pub fn read_whole(path: impl AsRef<Path>) -> Result<Splat> {
    let path = path.as_ref();
    let mut splat = read(path)?;
    splat.gaussians.bound_opacities();
    splat.gaussians.check_whole().map_err(|e| e.file(path))?;
    Ok(splat)
}

/// Whether a file holds Gaussians rather than the points of a PLY.
pub fn holds_gaussians(path: impl AsRef<Path>) -> Result<bool> {
    let path = path.as_ref();
    match format_of(path)? {
        Format::Ply => ply::holds_gaussians(path),
        _ => Ok(true),
    }
}
