//! SPZ of Niantic: numbers in whole bytes, each kind for all Gaussians together, compressed.
//!
//! Versions 1 to 3 are one gzip stream behind whose header of 16 bytes positions, opacities, colours, scales, rotations and
//! harmonics follow one another; version 4 has a header of 32 bytes, extensions, a table of contents, and a zstd stream for each
//! of these. Axes are right, up, back, unless an extension says otherwise.

use super::Splat;
pub(super) mod writer;

use super::axes::{SYSTEMS, System};
use super::compressed_ply::from_three;
use super::stream::Stream;
use crate::{Gaussians, logit, sh_coefficients};
use flate2::bufread::GzDecoder;
use gs_io::{Error, IoContext, Result};
use ruzstd::decoding::StreamingDecoder;
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;

const MAGIC: [u8; 4] = *b"NGSP";
/// The constant harmonic coefficient has this factor instead of the basis function's, so that a byte reaches beyond 0 to 1.
const COLOR_FACTOR: f32 = 0.15;
/// Bytes of a Gaussian's position.
const POSITION: u64 = 9;
/// Bytes that one byte of a file may stand for, as Niantic's own reader has it (gzip reaches 1032).
const EXPANSION: u64 = 1040;
/// Flags of the header.
const ANTIALIASED: u8 = 1;
const EXTENDED: u8 = 2;
/// The extension of Adobe that names the axes.
const COORDINATE_SYSTEM: u32 = 0xADBE_0003;
/// Bytes of extensions that are looked at.
const MOST_EXTENSIONS: u64 = 1 << 16;
/// The least limit of a zstd window.
const WINDOW: u64 = 8 << 20;

/// What a header says.
struct Header {
    version: u32,
    count: usize,
    /// Degree of the harmonics in the file, to 4.
    degree: u8,
    fractional_bits: u8,
    flags: u8,
}

impl Header {
    /// The first 16 bytes of all versions; the last is for the caller.
    fn read(bytes: &[u8; 16], file_bytes: u64) -> Result<Self> {
        let word = |at: usize| u32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]);
        let wrong = |field: &str, at: usize| {
            Error::new("not a value of SPZ").field(format!("{field}, byte {at} of the header"))
        };
        if bytes[..4] != MAGIC {
            return Err(wrong("magic", 0).found(format!("{:?}", &bytes[..4])).expected("NGSP"));
        }
        let header = Self {
            version: word(4),
            count: word(8) as usize,
            degree: bytes[12],
            fractional_bits: bytes[13],
            flags: bytes[14],
        };
        if !(1..=4).contains(&header.version) {
            return Err(wrong("version", 4).found(header.version).expected("1 to 4"));
        }
        let most = file_bytes.saturating_mul(EXPANSION) / POSITION;
        if header.count as u64 > most {
            let expected = format!("at most {most} in {file_bytes} bytes");
            return Err(wrong("number of points", 8).found(header.count).expected(expected));
        }
        if header.degree > 4 {
            return Err(wrong("degree of harmonics", 12).found(header.degree).expected("0 to 4"));
        }
        if header.fractional_bits > 24 {
            return Err(wrong("fractional bits", 13).found(header.fractional_bits).expected("0 to 24"));
        }
        Ok(header)
    }

    fn rotation_bytes(&self) -> usize {
        if self.version >= 3 { 4 } else { 3 }
    }

    fn position_bytes(&self) -> usize {
        if self.version == 1 { 6 } else { 9 }
    }

    fn harmonics_bytes(&self) -> usize {
        3 * (sh_coefficients(self.degree) - 1)
    }
}

/// How many Gaussians a file claims to hold, and the degree of their harmonics here.
pub(super) fn claim(path: &Path) -> Result<(u64, u8)> {
    let mut file = BufReader::with_capacity(1 << 12, File::open(path).at("open", path)?);
    let file_bytes = file.get_ref().metadata().at("read", path)?.len();
    let start = match file.fill_buf().at("read", path)?.starts_with(&MAGIC) {
        true => Stream::new(file).array("header")?,
        false => Stream::new(GzDecoder::new(file)).array("header")?,
    };
    let header = Header::read(&start, file_bytes)?;
    Ok((header.count as u64, header.degree.min(3)))
}

/// Reads an SPZ file; the caller names it in errors.
pub(super) fn read(path: &Path) -> Result<Splat> {
    let mut file = BufReader::with_capacity(1 << 16, File::open(path).at("open", path)?);
    let file_bytes = file.get_ref().metadata().at("read", path)?.len();
    if file.fill_buf().at("read", path)?.starts_with(&MAGIC) {
        return read_streams(file, file_bytes);
    }
    let mut data = Stream::new(GzDecoder::new(file));
    let header = Header::read(&data.array("header")?, file_bytes)?;
    if header.version > 3 {
        let found = format!("version {} in gzip", header.version);
        return Err(Error::new("not a value of SPZ").field("version").found(found).expected("1 to 3"));
    }
    let mut parts = Parts::default();
    for kind in KINDS {
        parts.read(kind, &header, &mut data)?;
    }
    // Read to the end, where gzip's checksum is.
    let behind = data.rest(MOST_EXTENSIONS, "extensions")?;
    parts.finish(&header, if header.flags & EXTENDED == 0 { &[] } else { &behind })
}

/// The rest of a file of version 4.
fn read_streams(file: impl Read, file_bytes: u64) -> Result<Splat> {
    let mut file = Stream::new(file);
    let start: [u8; 32] = file.array("header")?;
    let mut first = [0; 16];
    first.copy_from_slice(&start[..16]);
    let header = Header::read(&first, file_bytes)?;
    let wrong = |field: &str, at: u64| {
        Error::new("not a value of SPZ").field(format!("{field}, byte {at} of the file")).hint("export the file again")
    };
    if header.version != 4 {
        return Err(wrong("version", 4).found(format!("{} without gzip", header.version)).expected(4));
    }
    // Kinds of which there are no bytes have no stream.
    let sizes = KINDS.map(|kind| kind.bytes(&header) as u64 * header.count as u64);
    let streams = sizes.iter().filter(|s| **s > 0).count();
    if usize::from(start[15]) != streams {
        return Err(wrong("number of streams", 15).found(start[15]).expected(streams));
    }
    let contents_at = u64::from(u32::from_le_bytes([start[16], start[17], start[18], start[19]]));
    let data_at = contents_at + 16 * streams as u64;
    if contents_at < 32 || data_at > file_bytes {
        let expected = format!("32 to {}", file_bytes.saturating_sub(16 * streams as u64));
        return Err(wrong("place of the table of contents", 16).found(contents_at).expected(expected));
    }
    let before = file.rest((contents_at - 32).min(MOST_EXTENSIONS), "extensions")?;
    file.skip(contents_at - 32 - before.len() as u64, "extensions")?;
    let extensions = if header.flags & EXTENDED == 0 { Vec::new() } else { before };
    let mut packed_sizes = Vec::new();
    for (i, size) in sizes.iter().filter(|s| **s > 0).enumerate() {
        let [packed, unpacked] = [0, 1].map(|_| file.array("table of contents").map(u64::from_le_bytes));
        let (packed, unpacked) = (packed?, unpacked?);
        if unpacked != *size {
            let at = contents_at + 16 * i as u64 + 8;
            return Err(wrong("unpacked size in the table of contents", at).found(unpacked).expected(size));
        }
        packed_sizes.push(packed);
    }
    let total = packed_sizes.iter().try_fold(data_at, |sum, size| sum.checked_add(*size));
    if total != Some(file_bytes) {
        return Err(wrong("sizes in the table of contents", contents_at)
            .found(format!("streams of {packed_sizes:?} bytes"))
            .expected(format!("{} bytes in all", file_bytes - data_at)));
    }
    let (mut parts, mut packed_sizes) = (Parts::default(), packed_sizes.into_iter());
    for (kind, size) in KINDS.into_iter().zip(sizes).filter(|(_, size)| *size > 0) {
        let mut packed = file.part(packed_sizes.next().unwrap_or(0));
        let window = size.next_power_of_two().max(WINDOW);
        let unpacked = StreamingDecoder::new_with_max_window_size(&mut packed, window)
            .map_err(|e| Error::new(format!("cannot be unpacked: {e}")).field(kind.name()))?;
        let mut unpacked = Stream::new(unpacked);
        parts.read(kind, &header, &mut unpacked)?;
        unpacked.end(kind.name())?;
        std::io::copy(&mut packed, &mut std::io::sink()).map_err(|e| Error::new(e.to_string()).field(kind.name()))?;
    }
    parts.finish(&header, &extensions)
}

/// A kind of numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Positions,
    Opacities,
    Colors,
    Scales,
    Rotations,
    Harmonics,
}

/// In the order of the file.
const KINDS: [Kind; 6] =
    [Kind::Positions, Kind::Opacities, Kind::Colors, Kind::Scales, Kind::Rotations, Kind::Harmonics];

impl Kind {
    fn name(self) -> &'static str {
        match self {
            Self::Positions => "positions",
            Self::Opacities => "alphas",
            Self::Colors => "colors",
            Self::Scales => "scales",
            Self::Rotations => "rotations",
            Self::Harmonics => "spherical harmonics",
        }
    }

    /// Bytes of a Gaussian.
    fn bytes(self, header: &Header) -> usize {
        match self {
            Self::Positions => header.position_bytes(),
            Self::Opacities => 1,
            Self::Colors | Self::Scales => 3,
            Self::Rotations => header.rotation_bytes(),
            Self::Harmonics => header.harmonics_bytes(),
        }
    }
}

/// What was read so far. The constant coefficients wait for the others.
#[derive(Default)]
struct Parts {
    g: Gaussians,
    colors: Vec<[u8; 3]>,
}

impl Parts {
    fn read(&mut self, kind: Kind, header: &Header, data: &mut Stream<impl Read>) -> Result<()> {
        let (n, g, field) = (header.count, &mut self.g, kind.name());
        match kind {
            Kind::Positions if header.version == 1 => {
                g.means = data.items(n, field, |b: &[u8; 6]| {
                    [0, 2, 4].map(|at| half::f16::from_le_bytes([b[at], b[at + 1]]).to_f32())
                })?;
            }
            Kind::Positions => {
                let unit = 0.5f32.powi(i32::from(header.fractional_bits));
                g.means = data.items(n, field, |b: &[u8; 9]| {
                    // 24 bits, sign and all, in the upper part of 32.
                    [0, 3, 6].map(|at| (i32::from_le_bytes([0, b[at], b[at + 1], b[at + 2]]) >> 8) as f32 * unit)
                })?;
            }
            Kind::Opacities => {
                g.opacity_logits = data.items(n, field, |[a]: &[u8; 1]| logit(f32::from(*a) / 255.0))?;
            }
            Kind::Colors => self.colors = data.items(n, field, |b: &[u8; 3]| *b)?,
            Kind::Scales => {
                g.log_scales = data.items(n, field, |b: &[u8; 3]| b.map(|v| f32::from(v) / 16.0 - 10.0))?;
            }
            Kind::Rotations if header.rotation_bytes() == 3 => {
                g.rotations = data.items(n, field, |b: &[u8; 3]| {
                    let [x, y, z] = b.map(|v| f32::from(v) / 127.5 - 1.0);
                    [(1.0 - x * x - y * y - z * z).max(0.0).sqrt(), x, y, z]
                })?;
            }
            Kind::Rotations => g.rotations = data.items(n, field, |b: &[u8; 4]| rotation_of(u32::from_le_bytes(*b)))?,
            Kind::Harmonics => {
                // Degree 4 is walked through and left out.
                g.sh_degree = header.degree.min(3);
                let kept = 3 * (sh_coefficients(g.sh_degree) - 1);
                let color = |c: u8| (f32::from(c) / 255.0 - 0.5) / COLOR_FACTOR;
                let (mut row, colors) = (vec![0; header.harmonics_bytes()], std::mem::take(&mut self.colors));
                for rgb in colors {
                    data.fill(&mut row, field)?;
                    g.sh.extend(rgb.map(color));
                    g.sh.extend(row[..kept].iter().map(|v| (f32::from(*v) - 128.0) / 128.0));
                }
            }
        }
        Ok(())
    }

    /// All, in our axes.
    fn finish(mut self, header: &Header, extensions: &[u8]) -> Result<Splat> {
        if header.harmonics_bytes() == 0 {
            self.read(Kind::Harmonics, header, &mut Stream::new(std::io::empty()))?;
        }
        let mut left_out = Vec::new();
        if header.degree > 3 {
            left_out.push("spherical harmonics of degree 4".to_string());
        }
        let system = coordinate_system(extensions, &mut left_out)?;
        system.to_ours().apply(&mut self.g);
        Ok(Splat {
            gaussians: self.g,
            antialias: header.flags & ANTIALIASED != 0,
            axes: system,
            kind: format!("SPZ version {}", header.version),
            left_out,
        })
    }
}

/// The axes that the extensions name: right, up, back if none does.
fn coordinate_system(extensions: &[u8], left_out: &mut Vec<String>) -> Result<System> {
    let mut system = System::SPZ;
    let mut rest = extensions;
    while let Some((head, tail)) = rest.split_at_checked(8) {
        let word = |at: usize| u32::from_le_bytes([head[at], head[at + 1], head[at + 2], head[at + 3]]);
        let at = extensions.len() - rest.len();
        let Some((value, tail)) = tail.split_at_checked(word(4) as usize) else {
            return Err(Error::new("the record is longer than the extensions")
                .field(format!("extension, byte {at} of the extensions"))
                .found(format!("{} bytes", word(4)))
                .expected(format!("at most {}", tail.len())));
        };
        if word(0) == COORDINATE_SYSTEM {
            let number = value.first_chunk().map_or(u32::MAX, |b| u32::from_le_bytes(*b));
            let found = SYSTEMS.get((number as usize).wrapping_sub(1)).copied();
            system = match found {
                Some(found) => found,
                // Not said.
                None if number == 0 => system,
                None => {
                    return Err(Error::new("unknown axes")
                        .field(format!("extension SPZ_ADOBE_coordinate_system, byte {at} of the extensions"))
                        .found(number)
                        .expected("0 to 16"));
                }
            };
        } else {
            left_out.push(format!("extension {:#010x} of {} bytes", word(0), value.len()));
        }
        rest = tail;
    }
    Ok(system)
}

/// Which part of x y z w is largest, in 2 bits, and the others: a sign and 9 bits each. Ours is w x y z.
fn rotation_of(word: u32) -> [f32; 4] {
    let small = [20, 10, 0].map(|shift| {
        let size = (word >> shift & 511) as f32 / 511.0 * std::f32::consts::FRAC_1_SQRT_2;
        if word >> shift & 512 == 0 { size } else { -size }
    });
    let [x, y, z, w] = from_three(small, (word >> 30) as usize);
    [w, x, y, z]
}
