//! PLY files: 3DGS Gaussians and coloured point clouds.
//!
//! The reader takes any property order, ascii and both binary byte orders, other elements and lists (skipped), and
//! PlayCanvas's compressed PLY; the
//! writer writes what the original 3DGS code writes. Read by hand because a million Gaussians are 248 MB and generic
//! readers need many times that.

mod copy;
mod shift;
pub(crate) mod table;

use crate::middle::{less, shift_of};
use crate::splat::compressed_ply;
use crate::{Gaussians, sh_coefficients};
pub use copy::{INSTANCE, IdColumn, Vertices};
use gs_io::{Error, IoContext, Result, write_atomic};
pub use shift::comment as shift_comment;
use std::io::Read;
use std::io::Write;
use std::path::Path;
use table::{AGAIN, Table};

/// Coloured points, such as COLMAP's or a scan's vertices.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PointCloud {
    /// Positions in the world, less [`Self::shift`].
    pub positions: Vec<[f32; 3]>,
    /// 8-bit sRGB colours, as many as positions.
    pub colors: Vec<[u8; 3]>,
    /// What was subtracted from the positions, as for [`Gaussians::shift`].
    pub shift: [f64; 3],
}

impl PointCloud {
    /// Number of points.
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// Brings points that are far from the origin near it.
    fn settle(&mut self) {
        let by = shift_of(self.positions.iter().map(|p| p.map(f64::from)));
        self.positions.iter_mut().for_each(|p| *p = less(p.map(f64::from), by));
        self.shift = shift::sum(self.shift, by);
    }

    /// The same points with another [`Self::shift`].
    pub fn shift_to(&mut self, shift: [f64; 3]) {
        if self.shift != shift {
            let by = [0, 1, 2].map(|c| shift[c] - self.shift[c]);
            self.positions.iter_mut().for_each(|p| *p = less(p.map(f64::from), by));
            self.shift = shift;
        }
    }
}

/// Longest header that is read on its own, bytes.
const MAX_HEADER: u64 = 1 << 20;

/// What `take` makes of the vertices of a file and of the shift that its comments give; errors name the file.
fn vertices<T>(path: &Path, take: impl FnOnce(&Table<'_>, [f64; 3]) -> Result<T>) -> Result<T> {
    let bytes = std::fs::read(path).at("read", path)?;
    let read = || take(&table::read(&bytes)?, shift::of(&bytes)?);
    read().map_err(|e| e.file(path))
}

/// Properties of vertices by which Gaussians are known: as they are, and packed.
const OF_GAUSSIANS: [&str; 2] = ["opacity", "packed_color"];

/// The bytes of a file as far as a header may reach.
fn read_start(path: &Path) -> Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let file = std::fs::File::open(path).at("open", path)?;
    file.take(MAX_HEADER).read_to_end(&mut bytes).at("read", path)?;
    Ok(bytes)
}

/// The comment lines of a PLY's header, without the word `comment`, and whether its vertices have each of [`OF_GAUSSIANS`].
fn read_header(path: &Path) -> Result<(Vec<String>, [bool; 2])> {
    let bytes = read_start(path)?;
    let (comments, there) = table::read_header(&bytes, OF_GAUSSIANS).map_err(|e| e.file(path))?;
    Ok((comments.into_iter().map(String::from).collect(), there))
}

/// The comments of a PLY; none of a file of another format.
pub(crate) fn comments(path: &Path) -> Result<Vec<String>> {
    // A SOG may be a folder.
    let mut start = Vec::new();
    if path.is_file() {
        std::fs::File::open(path).at("open", path)?.take(3).read_to_end(&mut start).at("read", path)?;
    }
    if start == b"ply" { Ok(read_header(path)?.0) } else { Ok(Vec::new()) }
}

/// The comment of a PLY whose Gaussians were learnt with the 2D filter of Mip-Splatting.
pub const ANTIALIASED: &str = "antialias true";

/// Whether a PLY's comments say that its Gaussians were learnt with the 2D filter of Mip-Splatting ([`ANTIALIASED`]), and so
/// are to be rendered with it.
pub fn is_antialiased(path: impl AsRef<Path>) -> Result<bool> {
    Ok(read_header(path.as_ref())?.0.iter().any(|c| c == ANTIALIASED))
}

/// Whether a PLY's vertices are Gaussians rather than points: whether they have an opacity.
pub fn holds_gaussians(path: impl AsRef<Path>) -> Result<bool> {
    Ok(read_header(path.as_ref())?.1 != [false; 2])
}

/// How many vertices a PLY's header says that it has.
pub(crate) fn count(path: &Path) -> Result<u64> {
    let header = read_start(path)?;
    table::count_of_vertices(&header).map_err(|e| e.file(path))
}

/// Whether a PLY is a compressed one.
pub(crate) fn is_compressed(path: &Path) -> Result<bool> {
    Ok(read_header(path)?.1[1])
}

/// Reads the Gaussians of a 3DGS PLY. Without `f_rest_*` the spherical harmonics have degree 0; normals are ignored.
/// Infinite opacity logits, which some tools write for fully opaque Gaussians, become +-50.
///
/// # Errors
/// When the file is damaged or is no 3DGS PLY, or a parameter is not finite.
pub fn read_gaussians(path: impl AsRef<Path>) -> Result<Gaussians> {
    let path = path.as_ref();
    let mut g = read_gaussians_as_they_are(path)?;
    g.bound_opacities();
    g.check_whole().map_err(|e| e.file(path))?;
    Ok(g)
}

/// Reads the Gaussians of a 3DGS PLY as [`read_gaussians`] does, but takes every number as it stands, finite or not: for
/// looking at damaged files and repairing them.
pub fn read_gaussians_as_they_are(path: impl AsRef<Path>) -> Result<Gaussians> {
    let path = path.as_ref();
    let bytes = std::fs::read(path).at("read", path)?;
    from_bytes(&bytes).map_err(|e| e.file(path))
}

/// The Gaussians of a PLY's bytes, as [`read_gaussians_as_they_are`] gives them.
fn from_bytes(bytes: &[u8]) -> Result<Gaussians> {
    let [vertices, chunks, sh] = table::read_elements(bytes, ["vertex", "chunk", "sh"])?;
    let vertices = vertices.ok_or_else(table::no_vertices)?;
    let mut g = match compressed_ply::is_compressed(&vertices) {
        true => compressed_ply::read(&vertices, chunks.as_ref(), sh.as_ref())?,
        false => gaussians_of(&vertices)?,
    };
    g.shift = shift::sum(g.shift, shift::of(bytes)?);
    Ok(g)
}

fn gaussians_of(table: &Table<'_>) -> Result<Gaussians> {
    let rest = table.count_of("f_rest_");
    let sh_degree = compressed_ply::degree_of_rest(rest).ok_or_else(|| {
        Error::new("impossible number of spherical-harmonics properties")
            .field("f_rest_*")
            .found(rest)
            .expected("0, 9, 24 or 45")
            .hint(AGAIN)
    })?;
    // The file holds them channel by channel, memory coefficient by coefficient.
    let k = sh_coefficients(sh_degree);
    let mut sh = ["f_dc_0", "f_dc_1", "f_dc_2"].map(String::from).to_vec();
    sh.extend((0..k - 1).flat_map(|c| [0, 1, 2].map(|channel| format!("f_rest_{}", channel * (k - 1) + c))));
    let (shift, means) = table.places()?;
    Ok(Gaussians {
        means,
        log_scales: table.arrays(["scale_0", "scale_1", "scale_2"])?,
        rotations: table.arrays(["rot_0", "rot_1", "rot_2", "rot_3"])?,
        opacity_logits: table.values(&["opacity"])?,
        sh: table.values(&sh)?,
        sh_degree,
        shift,
    })
}

/// A PLY's header as far as its comments: `comments` in lines of their own, and the shift where there is one.
pub(crate) fn header_start(comments: &[String], shift: [f64; 3]) -> String {
    let mut header = String::from("ply\nformat binary_little_endian 1.0\n");
    let comments = comments.iter().cloned().chain(shift_comment(shift));
    header.extend(comments.map(|c| format!("comment {}\n", c.replace(['\n', '\r'], " "))));
    header
}

fn header(count: usize, comments: &[String], shift: [f64; 3], properties: &[(&str, String)]) -> String {
    let mut header = header_start(comments, shift);
    header += &format!("element vertex {count}\n");
    header.extend(properties.iter().map(|(kind, name)| format!("property {kind} {name}\n")));
    header + "end_header\n"
}

/// Writes the standard 3DGS layout: little-endian floats, 62 properties at degree 3. `comments` become comment lines.
pub fn write_gaussians(path: impl AsRef<Path>, gaussians: &Gaussians, comments: &[String]) -> Result<()> {
    let (path, rows) = (path.as_ref(), (gaussians.len(), 0..gaussians.len()));
    write_atomic(path, |w| write_rows(w, path, gaussians, rows, &[], comments))
}

/// The same for the Gaussians `rows` only, in that order, without a copy of them.
pub fn write_some_gaussians(
    path: impl AsRef<Path>,
    gaussians: &Gaussians,
    rows: &[u32],
    comments: &[String],
) -> Result<()> {
    let (path, rows) = (path.as_ref(), (rows.len(), rows.iter().map(|&i| i as usize)));
    write_atomic(path, |w| write_rows(w, path, gaussians, rows, &[], comments))
}

/// The bytes of the file that [`write_some_gaussians`] writes.
pub fn some_gaussians(gaussians: &Gaussians, rows: &[u32], comments: &[String]) -> Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let rows = (rows.len(), rows.iter().map(|&i| i as usize));
    write_rows(&mut bytes, Path::new("a PLY in memory"), gaussians, rows, &[], comments)?;
    Ok(bytes)
}

/// Writes a PLY to `w`, which errors call `place`.
pub(crate) fn write_rows(
    w: &mut dyn Write,
    place: &Path,
    gaussians: &Gaussians,
    (count, rows): (usize, impl Iterator<Item = usize>),
    ids: &[IdColumn<'_>],
    comments: &[String],
) -> Result<()> {
    gaussians.check().map_err(|e| e.file(place))?;
    let k = sh_coefficients(gaussians.sh_degree);
    let mut names: Vec<String> =
        ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"].map(String::from).into();
    names.extend((0..3 * (k - 1)).map(|i| format!("f_rest_{i}")));
    names.extend(["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"].map(String::from));
    let mut properties: Vec<(&str, String)> = names.into_iter().map(|n| ("float", n)).collect();
    properties.extend(ids.iter().map(|(name, _)| ("int", (*name).to_string())));
    w.write_all(header(count, comments, gaussians.shift, &properties).as_bytes()).at("write", place)?;
    let mut row: Vec<u8> = Vec::with_capacity(4 * properties.len());
    for i in rows {
        row.clear();
        let mut put = |v: f32| row.extend_from_slice(&v.to_le_bytes());
        gaussians.means[i].into_iter().chain([0.0; 3]).for_each(&mut put);
        let sh = gaussians.sh_of(i);
        sh[..3].iter().copied().for_each(&mut put);
        for channel in 0..3 {
            (1..k).for_each(|c| put(sh[3 * c + channel]));
        }
        put(gaussians.opacity_logits[i]);
        gaussians.log_scales[i].into_iter().chain(gaussians.rotations[i]).for_each(&mut put);
        row.extend(ids.iter().flat_map(|(_, l)| l[i].to_le_bytes()));
        w.write_all(&row).at("write", place)?;
    }
    Ok(())
}

/// Reads a coloured point cloud; white where the file has no colours. Colours stored as floats lie in 0 to 1, others in 0 to
/// 255.
///
/// # Errors
/// When the file is damaged, has no positions, or one is not finite, or a colour lies outside its range.
pub fn read_points(path: impl AsRef<Path>) -> Result<PointCloud> {
    vertices(path.as_ref(), |table, given| {
        let (shift, positions) = table.places()?;
        let mut points = PointCloud {
            positions: check_finite(positions)?,
            shift: shift::sum(shift, given),
            ..PointCloud::default()
        };
        points.settle();
        let channel = |name| {
            let Some(c) = table.find(name) else { return Ok(vec![255; table.count]) };
            let (most, kind) = if c.is_float() { (1.0, "float") } else { (255.0, "whole number") };
            let byte = |(i, v): (usize, f32)| {
                // Rounded first: arithmetic on floats ends a little beside 0 and 1.
                let scaled = (255.0 / most * v).round();
                if (0.0..=255.0).contains(&scaled) {
                    return Ok(scaled as u8);
                }
                Err(Error::new("a colour is out of range")
                    .field(format!("vertex {i}, {name}"))
                    .found(v)
                    .expected(format!("0 to {most}, since the property is a {kind}"))
                    .hint("store red, green and blue as uchar from 0 to 255"))
            };
            table.gather(&[c]).into_iter().enumerate().map(byte).collect::<Result<Vec<u8>>>()
        };
        let (r, g, b) = (channel("red")?, channel("green")?, channel("blue")?);
        points.colors = (0..table.count).map(|i| [r[i], g[i], b[i]]).collect();
        Ok(points)
    })
}

/// Refuses positions that are not finite.
fn check_finite(positions: Vec<[f32; 3]>) -> Result<Vec<[f32; 3]>> {
    let bad = |p: &[f32; 3]| p.iter().any(|v| !v.is_finite());
    let Some(first) = positions.iter().position(bad) else { return Ok(positions) };
    let all = positions.iter().filter(|p| bad(p)).count();
    Err(Error::new("a position is not finite")
        .field(format!("vertex {first}"))
        .found(format!("{:?}, and {all} of {} vertices are so", positions[first], positions.len()))
        .expected("finite x, y and z")
        .hint("remove these vertices, or export the PLY again"))
}

/// Reads the positions of a PLY's vertices, less a shift such as [`Gaussians::shift`], and a whole-number property of each, such as `label`
/// of ScanNet's `*.labels.ply`.
///
/// # Errors
/// When the file is damaged, lacks the property, a position is not finite, or a value is not a whole number from 0 to
/// 16,777,216.
pub fn read_labels(path: impl AsRef<Path>, property: &str, shift: [f64; 3]) -> Result<(Vec<[f32; 3]>, Vec<u32>)> {
    vertices(path.as_ref(), |table, given| {
        let whole = |(i, v): (usize, f32)| {
            if v.fract() == 0.0 && (0.0..=16_777_216.0).contains(&v) {
                return Ok(v as u32);
            }
            Err(Error::new("not a label").field(format!("vertex {i}, {property}")).found(v))
        };
        let labels = table.values(&[property])?.into_iter().enumerate().map(whole).collect::<Result<Vec<u32>>>()?;
        let positions = table.places_less([0, 1, 2].map(|c| shift[c] - given[c]))?;
        Ok((check_finite(positions)?, labels))
    })
}

/// Writes a coloured point cloud, little-endian.
///
/// # Errors
/// When there are not as many colours as positions or the file cannot be written.
pub fn write_points(path: impl AsRef<Path>, points: &PointCloud, comments: &[String]) -> Result<()> {
    let path = path.as_ref();
    if points.colors.len() != points.positions.len() {
        return Err(Error::new("not a colour for each position")
            .file(path)
            .found(points.colors.len())
            .expected(points.positions.len()));
    }
    let floats = ["x", "y", "z"].map(|n| ("float", String::from(n)));
    let bytes = ["red", "green", "blue"].map(|n| ("uchar", String::from(n)));
    let properties = [floats, bytes].concat();
    write_atomic(path, |w| {
        w.write_all(header(points.len(), comments, points.shift, &properties).as_bytes()).at("write", path)?;
        for (p, c) in points.positions.iter().zip(&points.colors) {
            let [x, y, z] = p.map(f32::to_le_bytes);
            w.write_all(&[&x[..], &y, &z, c].concat()).at("write", path)?;
        }
        Ok(())
    })
}
