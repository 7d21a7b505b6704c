//! Files of Gaussians in the formats that people hold: which one a file has, reading it, writing it (docs/splats.md).
//!
//! Whatever a format's axes, Gaussians in memory have those of a PLY of the original 3DGS code: x right, y down, z forward.

mod axes;
pub mod compressed_ply;
mod dot_splat;
mod gltf;
pub mod packing;
mod reach;
mod sog;
mod spz;
mod stream;
#[cfg(test)]
pub(crate) mod testing;

use crate::ply::IdColumn;
use crate::{Gaussians, ply, say_shift, sh_coefficients};
use gs_io::{Error, IoContext, Result, hash_files, write_atomic};
use std::fs::File;
use std::io::{Read, Write};
use std::path::{Component, Path, PathBuf};

pub use axes::{System, turn};
pub use reach::lost;

/// A format of files of Gaussians.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// PLY of 3DGS: `.ply`.
    Ply,
    /// PLY as PlayCanvas compresses it: `.compressed.ply`.
    CompressedPly,
    /// SPZ of Niantic: `.spz`. Versions 1 to 4 are read, 3 is written.
    Spz,
    /// SOG of PlayCanvas: a zip, `.sog`, or a folder with `meta.json`. Versions 1 and 2 are read; version 2 is written, as a zip.
    Sog,
    /// 32 bytes a Gaussian, of antimatter15: `.splat`.
    Splat,
    /// glTF with `KHR_gaussian_splatting`: `.glb` is read and written, `.gltf` is read.
    Gltf,
}

/// What a file of Gaussians holds.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Splat {
    /// The Gaussians in the file's order, every number as it stands there, finite or not.
    pub gaussians: Gaussians,
    /// Whether they were learnt with the 2D filter of Mip-Splatting, where the format says so.
    pub antialias: bool,
    /// The axes that the file's numbers were taken to have: what the format, or the file, says. [`turn`] makes others of them.
    pub axes: System,
    /// The format for people, such as `SPZ version 4`.
    pub kind: String,
    /// What the file has that was left out or taken as something else.
    pub left_out: Vec<String>,
}

/// What is written beside the Gaussians.
#[derive(Debug, Clone, Copy, Default)]
pub struct Extra<'a> {
    /// Comments, in PLYs and GLBs; other formats have no place for them.
    pub comments: &'a [String],
    /// Whether the Gaussians were learnt with the 2D filter of Mip-Splatting; .splat and GLB cannot say it.
    pub antialias: bool,
    /// Numbers of each Gaussian, such as its instance: in a PLY only.
    pub ids: &'a [IdColumn<'a>],
}

/// First bytes by which a file is known.
const MAGIC: [(&[u8], Format); 5] = [
    (b"ply", Format::Ply),
    (b"NGSP", Format::Spz),
    (&[0x1f, 0x8b], Format::Spz),
    (b"PK\x03\x04", Format::Sog),
    (b"glTF", Format::Gltf),
];

/// Endings of names, the more particular first, and whether such a file is written.
const NAMES: [(&str, Format, bool); 8] = [
    (".compressed.ply", Format::CompressedPly, true),
    (".ply", Format::Ply, true),
    (".spz", Format::Spz, true),
    (".splat", Format::Splat, true),
    (".glb", Format::Gltf, true),
    (".gltf", Format::Gltf, false),
    (".sog", Format::Sog, true),
    ("meta.json", Format::Sog, false),
];

/// The formats of a name, in small letters or capitals.
fn named(path: &Path) -> Option<(Format, bool)> {
    let name = path.file_name().unwrap_or_default().to_string_lossy().to_lowercase();
    NAMES.iter().find(|(ending, ..)| name.ends_with(ending)).map(|(_, format, written)| (*format, *written))
}

impl Format {
    /// The format that a file of this name is written in.
    ///
    /// # Errors
    /// When the name has no ending of one that can be written.
    pub fn to_write(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        match named(path) {
            Some((format, true)) => Ok(format),
            _ => Err(Error::new("no format that can be written has such a name")
                .file(path)
                .expected("a name that ends in .ply, .compressed.ply, .spz, .sog, .splat or .glb")),
        }
    }

    /// The format that a name says, where it says one.
    pub fn of_name(path: impl AsRef<Path>) -> Option<Self> {
        named(path.as_ref()).map(|(format, _)| format)
    }

    /// The format of a file to read: by its first bytes, and where these say nothing by its name.
    ///
    /// # Errors
    /// When it cannot be read, or is of none.
    pub fn of_file(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let file = unfolded(path);
        let mut start = Vec::new();
        File::open(&file).at("open", &file)?.take(64).read_to_end(&mut start).at("read", &file)?;
        let known = MAGIC.iter().find(|(magic, _)| start.starts_with(magic)).map(|(_, format)| *format);
        match known.or_else(|| named(&file).map(|(format, _)| format)) {
            Some(Self::Ply) if known.is_some() && ply::is_compressed(&file)? => Ok(Self::CompressedPly),
            // Text and what has no first bytes of its own goes by its name.
            Some(format) if known.is_some() || [Self::Splat, Self::Sog, Self::Gltf].contains(&format) => Ok(format),
            _ => Err(Error::new("not a file of Gaussians")
                .file(path)
                .found(format!("bytes that begin with {:?}", String::from_utf8_lossy(&start[..start.len().min(8)])))
                .expected("PLY, compressed PLY, SPZ, SOG (.sog or meta.json), .splat, .glb or .gltf")),
        }
    }
}

/// The file by which an unbundled SOG in a folder is read.
fn unfolded(path: &Path) -> PathBuf {
    if path.is_dir() { path.join(sog::META) } else { path.to_path_buf() }
}

/// All files that a file of Gaussians consists of, itself first: several for an unbundled SOG and for a glTF with buffers beside
/// it.
pub fn files(path: impl AsRef<Path>) -> Result<Vec<PathBuf>> {
    let file = unfolded(path.as_ref());
    let named = |e: Error| e.file(&file);
    match Format::of_file(&file)? {
        Format::Sog if !starts_with(&file, b"PK")? => sog::files(&file).map_err(named),
        Format::Gltf if !starts_with(&file, b"glTF")? => gltf::files(&file).map_err(named),
        _ => Ok(vec![file]),
    }
}

/// How many Gaussians a file says that it has. Only headers are read, and nothing is unpacked.
///
/// # Errors
/// When it is of no known format, or the header is damaged.
pub fn count(path: impl AsRef<Path>) -> Result<u64> {
    let file = unfolded(path.as_ref());
    match Format::of_file(&file)? {
        Format::Ply | Format::CompressedPly => ply::count(&file),
        Format::Splat => Ok(std::fs::metadata(&file).at("read", &file)?.len() / dot_splat::BYTES),
        Format::Spz => spz::claim(&file).map(|claim| claim.0),
        Format::Sog => sog::claim(&file).map(|claim| claim.0),
        Format::Gltf => gltf::claim(&file).map(|claim| claim.0),
    }
    .map_err(|e| e.file(path))
}

/// Bytes that the Gaussians of a file would take as a PLY, about: what they take in memory. Only headers are read.
pub fn bytes_as_ply(path: impl AsRef<Path>) -> Result<u64> {
    let file = unfolded(path.as_ref());
    let bytes = std::fs::metadata(&file).at("read", &file)?.len();
    let claimed = |(count, degree): (u64, u8)| 4 * count * (14 + 3 * sh_coefficients(degree) as u64);
    match Format::of_file(&file)? {
        Format::Ply => Ok(bytes),
        // Numbers may have fewer bytes than floats.
        Format::Gltf => gltf::claim(&file).map(|claim| claimed(claim).max(bytes)),
        // 16 bytes become 56, and each further byte 4.
        Format::CompressedPly | Format::Splat => Ok(4 * bytes),
        Format::Spz => spz::claim(&file).map(claimed),
        Format::Sog => sog::claim(&file).map(claimed),
    }
    .map_err(|e| e.file(path))
}

/// Content hash of a file of Gaussians: that of the file, or of all of [`files`] where there are several.
pub fn hash(path: impl AsRef<Path>) -> Result<String> {
    let all = files(path)?;
    match &all[..] {
        [one] => gs_io::hash_file(one),
        _ => hash_files(all.iter().map(|f| (f.file_name().unwrap_or_default().to_string_lossy(), f))),
    }
}

fn starts_with(path: &Path, magic: &[u8]) -> Result<bool> {
    let mut start = Vec::new();
    File::open(path).at("open", path)?.take(magic.len() as u64).read_to_end(&mut start).at("read", path)?;
    Ok(start == magic)
}

/// Reads a file of Gaussians, and takes every number as it stands.
///
/// # Errors
/// When the file is of no known format, or is damaged; the error names field and place.
pub fn read(path: impl AsRef<Path>) -> Result<Splat> {
    let path = path.as_ref();
    let file = &unfolded(path);
    let plain = |kind: &str| -> Result<Splat> {
        let (gaussians, antialias) = (ply::read_gaussians_as_they_are(file)?, ply::is_antialiased(file)?);
        Ok(Splat { gaussians, antialias, kind: kind.into(), ..Splat::default() })
    };
    let splat = match Format::of_file(file)? {
        Format::Ply => plain("PLY"),
        Format::CompressedPly => plain("compressed PLY"),
        Format::Spz => spz::read(file),
        Format::Sog if starts_with(file, b"PK")? => sog::read_archive(file),
        Format::Sog => sog::read_folder(file),
        Format::Splat => dot_splat::read(file),
        Format::Gltf => gltf::read(file),
    };
    let mut splat = splat.map_err(|e| e.file(path))?;
    if splat.gaussians.settle() {
        let shift = splat.gaussians.shift;
        let far = shift.iter().fold(0.0f32, |most, v| most.max(v.abs() as f32));
        splat.left_out.push(format!(
            "digits of the centres, which lie about {}, where single precision has steps of {} units: export them in doubles, or less a shift",
            say_shift(shift),
            far.next_up() - far
        ));
    }
    Ok(splat)
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
    match Format::of_file(path)? {
        Format::Ply => ply::holds_gaussians(path),
        _ => Ok(true),
    }
}

/// Writes Gaussians in the format that the file's name says. Returns the indices of those that the file has, in its order; none where
/// it has all of them in theirs.
///
/// # Errors
/// When the name says no format that is written, the format cannot hold them, or the file cannot be written. All but PLY hold whole
/// Gaussians only; what else a format cannot hold, [`lost`] says.
pub fn write(path: impl AsRef<Path>, gaussians: &Gaussians, extra: &Extra<'_>) -> Result<Option<Vec<u32>>> {
    let path = path.as_ref();
    let format = Format::to_write(path)?;
    check(format, gaussians, extra).map_err(|e| e.file(path))?;
    let order = reach::order(format, gaussians);
    write_atomic(path, |w| put(w, path, format, gaussians, order.as_deref(), extra).map_err(|e| e.file(path)))?;
    Ok(order)
}

/// The bytes of the file that [`write()`] writes.
///
/// # Errors
/// As [`write()`].
pub fn encode(format: Format, gaussians: &Gaussians, extra: &Extra<'_>) -> Result<Vec<u8>> {
    check(format, gaussians, extra)?;
    let mut bytes = Vec::new();
    let order = reach::order(format, gaussians);
    put(&mut bytes, Path::new("a file in memory"), format, gaussians, order.as_deref(), extra)?;
    Ok(bytes)
}

fn check(format: Format, gaussians: &Gaussians, extra: &Extra<'_>) -> Result<()> {
    gaussians.check()?;
    for (_, instance) in extra.ids {
        if instance.len() != gaussians.len() {
            return Err(Error::new("not a label per Gaussian").found(instance.len()).expected(gaussians.len()));
        }
        if format != Format::Ply {
            return Err(Error::new("only a PLY holds instances").hint("write a name that ends in .ply"));
        }
    }
    match format {
        Format::Ply => Ok(()),
        _ if gaussians.is_empty() => Err(Error::new("no Gaussians").hint("only a PLY may hold none")),
        _ => gaussians.check_whole(),
    }
}

fn put(
    w: &mut dyn Write,
    place: &Path,
    format: Format,
    g: &Gaussians,
    order: Option<&[u32]>,
    extra: &Extra<'_>,
) -> Result<()> {
    let chosen = order.map(|order| g.select(order));
    let g = chosen.as_ref().unwrap_or(g);
    let mut comments = extra.comments.to_vec();
    if extra.antialias && !comments.iter().any(|c| c == ply::ANTIALIASED) {
        comments.push(ply::ANTIALIASED.into());
    }
    match format {
        Format::Ply => ply::write_rows(w, place, g, (g.len(), 0..g.len()), extra.ids, &comments),
        Format::CompressedPly => compressed_ply::write(w, place, g, &comments),
        Format::Spz => spz::writer::write(w, place, g, extra.antialias),
        Format::Splat => dot_splat::write(w, place, g),
        Format::Gltf => gltf::writer::write(w, place, g, extra.comments),
        Format::Sog => sog::writer::write(w, place, g, extra.antialias),
    }
}

/// A file's name that leads to no other folder.
fn plain_name(name: &str) -> Result<&str> {
    let components: Vec<_> = Path::new(name).components().collect();
    match components[..] {
        [Component::Normal(_)] if !name.contains(['/', '\\']) => Ok(name),
        _ => Err(Error::new("not the name of a file in the same folder").found(name)),
    }
}
