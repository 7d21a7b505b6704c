//! SOG of PlayCanvas: numbers as the pixels of WebP pictures, which `meta.json` describes; in a folder, or in a zip.
//!
//! Version 1 has ranges of which a byte is a share, version 2 tables of 256 values. Positions have 16 bits, in two pictures.
//! Harmonics are rows of a palette.

mod tables;
pub(super) mod writer;

use super::compressed_ply::from_three;
use super::{Splat, plain_name};
use crate::{Gaussians, logit, sh_coefficients};
use gs_io::{Error, IoContext, Result};
use image_webp::WebPDecoder;
use serde_json::Value;
use std::fs::File;
use std::io::{BufReader, Cursor, Read};
use std::path::{Path, PathBuf};
use zip::ZipArchive;

/// The file that describes the others.
pub(super) const META: &str = "meta.json";
/// Gaussians for each byte of all files beyond which a header lies: scans have one in 13 bytes.
const GAUSSIANS_PER_BYTE: u64 = 64;
/// Pixels of the palette of harmonics: 65,536 rows of 15 at most.
const MOST_PALETTE: u64 = 1 << 20;
/// What an archive's file may be larger than the archive.
const EXPANSION: u64 = 16;
/// Rows of the palette beside one another.
const PALETTE_COLUMNS: usize = 64;

/// Where the files are.
enum Store {
    Folder(PathBuf),
    Archive(ZipArchive<BufReader<File>>, u64),
}

impl Store {
    fn get(&mut self, name: &str) -> Result<Vec<u8>> {
        match self {
            Self::Folder(folder) => {
                let path = folder.join(plain_name(name)?);
                std::fs::read(&path).at("read", &path)
            }
            Self::Archive(archive, bytes) => {
                let fail = |e: String| Error::new(format!("cannot be read from the archive: {e}")).field(name);
                let most = EXPANSION * *bytes;
                let mut file = archive.by_name(name).map_err(|e| fail(e.to_string()))?;
                let mut data = Vec::new();
                (&mut file).take(most + 1).read_to_end(&mut data).map_err(|e| fail(e.to_string()))?;
                if data.len() as u64 > most {
                    let expected = format!("at most {most} bytes, by the archive's length");
                    return Err(Error::new("the file is too large").field(name).expected(expected));
                }
                Ok(data)
            }
        }
    }
}

/// The files of an unbundled SOG: `meta.json` first, then those that it names.
pub(super) fn files(meta: &Path) -> Result<Vec<PathBuf>> {
    let value = parse(&std::fs::read(meta).at("read", meta)?)?;
    let mut files = vec![meta.to_path_buf()];
    for group in ["means", "scales", "quats", "sh0", "shN"] {
        for name in value[group]["files"].as_array().into_iter().flatten().filter_map(Value::as_str) {
            files.push(meta.with_file_name(plain_name(name)?));
        }
    }
    Ok(files)
}

fn parse(bytes: &[u8]) -> Result<Value> {
    serde_json::from_slice(bytes).map_err(|e| Error::new(format!("not JSON: {e}")).field(META))
}

/// Reads a SOG in a folder by its `meta.json`; the caller names the file in errors.
pub(super) fn read_folder(meta: &Path) -> Result<Splat> {
    let all = files(meta)?;
    let mut bytes = 0;
    for file in &all {
        bytes += std::fs::metadata(file).at("read", file)?.len();
    }
    let store = Store::Folder(meta.parent().unwrap_or(Path::new("")).to_path_buf());
    Reader { store, meta: parse(&std::fs::read(meta).at("read", meta)?)?, bytes, count: 0 }.read("unbundled")
}

fn open_archive(path: &Path) -> Result<Store> {
    let file = File::open(path).at("open", path)?;
    let bytes = file.metadata().at("read", path)?.len();
    let archive = ZipArchive::new(BufReader::new(file)).map_err(|e| Error::new(format!("not a zip: {e}")))?;
    Ok(Store::Archive(archive, bytes))
}

/// Reads a SOG in a zip.
pub(super) fn read_archive(path: &Path) -> Result<Splat> {
    let mut store = open_archive(path)?;
    let meta = parse(&store.get(META)?)?;
    let bytes = std::fs::metadata(path).at("read", path)?.len();
    Reader { store, meta, bytes, count: 0 }.read("bundled")
}

/// How many Gaussians a description claims.
fn count(meta: &Value) -> u64 {
    meta["count"].as_u64().or_else(|| meta["means"]["shape"][0].as_u64()).unwrap_or(0)
}

/// How many Gaussians a file claims to hold, and the degree of their harmonics at most.
pub(super) fn claim(path: &Path) -> Result<(u64, u8)> {
    let meta = if super::starts_with(path, b"PK")? {
        parse(&open_archive(path)?.get(META)?)?
    } else {
        parse(&std::fs::read(path).at("read", path)?)?
    };
    let degree = if meta["shN"].is_object() { meta["shN"]["bands"].as_u64().unwrap_or(3).min(3) as u8 } else { 0 };
    Ok((count(&meta).min(u64::from(u32::MAX)), degree))
}

/// A picture, four bytes a pixel.
struct Picture {
    width: usize,
    rgba: Vec<[u8; 4]>,
}

struct Reader {
    store: Store,
    meta: Value,
    /// Of all files.
    bytes: u64,
    count: usize,
}

impl Reader {
    fn read(mut self, where_: &str) -> Result<Splat> {
        let version = match &self.meta["version"] {
            Value::Null => 1,
            v if *v == 2 => 2,
            v => return Err(self.wrong("version").found(v).expected("2, or none for version 1")),
        };
        let count = count(&self.meta);
        let most = self.bytes.saturating_mul(GAUSSIANS_PER_BYTE);
        if count == 0 || count > most {
            return Err(self.wrong("count").found(count).expected(format!("1 to {most} in {} bytes", self.bytes)));
        }
        self.count = count as usize;
        let mut g = Gaussians { means: self.means()?, ..Gaussians::default() };
        // A tag that is none damages one Gaussian, not the scene.
        g.rotations = self.each("quats", 0, |p| match p[3] {
            tag @ 252..=255 => {
                let small = [0, 1, 2].map(|k| (f32::from(p[k]) / 255.0 * 2.0 - 1.0) * std::f32::consts::FRAC_1_SQRT_2);
                from_three(small, usize::from(tag - 252))
            }
            _ => [f32::NAN; 4],
        })?;
        let scales = self.table("scales", version, 3)?;
        g.log_scales = self.each("scales", 0, |p| [0, 1, 2].map(|k| scales.value(k, p[k])))?;
        let colors = self.table("sh0", version, 4)?;
        let first: Vec<([f32; 3], f32)> = self.each("sh0", 0, |p| {
            let rgb = [0, 1, 2].map(|k| colors.value(k, p[k]));
            (rgb, if version == 1 { colors.value(3, p[3]) } else { logit(f32::from(p[3]) / 255.0) })
        })?;
        g.opacity_logits = first.iter().map(|(_, o)| *o).collect();
        let palette = if self.meta["shN"].is_object() { Some(self.palette(version)?) } else { None };
        match palette {
            None => g.sh = first.iter().flat_map(|(rgb, _)| *rgb).collect(),
            Some(palette) => {
                let labels = self.each("shN", 1, |p| usize::from(u16::from_le_bytes([p[0], p[1]])))?;
                g.sh_degree = palette.degree;
                g.sh = Vec::with_capacity(self.count * g.sh_stride());
                for ((rgb, _), label) in first.iter().zip(labels) {
                    g.sh.extend(rgb);
                    palette.push(label, &mut g.sh);
                }
            }
        }
        let antialias = self.meta["model"] == "antialiased" || self.meta["antialias"] == true;
        let kind = format!("SOG version {version}, {where_}");
        Ok(Splat { gaussians: g, antialias, kind, ..Splat::default() })
    }

    fn wrong(&self, field: &str) -> Error {
        Error::new("not a value of SOG").field(format!("{META}, {field}")).hint("export the file again")
    }

    /// Numbers of a list in the description.
    fn numbers(&self, group: &str, key: &str, least: usize) -> Result<Vec<f64>> {
        let list = self.meta[group][key].as_array();
        let numbers: Option<Vec<f64>> = list.and_then(|l| l.iter().map(Value::as_f64).collect());
        numbers.filter(|n| n.len() >= least).ok_or_else(|| {
            let found = list.map_or("none".to_string(), |l| format!("a list of {}", l.len()));
            self.wrong(&format!("{group}.{key}")).found(found).expected(format!("{least} numbers"))
        })
    }

    /// A picture that the description names.
    fn picture(&mut self, group: &str, which: usize, most: u64) -> Result<Picture> {
        let field = format!("{group}.files[{which}]");
        let name = self.meta[group]["files"][which].as_str().map(String::from);
        let name = name.ok_or_else(|| self.wrong(&field).expected("the name of a picture"))?;
        let bytes = self.store.get(&name)?;
        let fail = |e: &dyn std::fmt::Display| Error::new(format!("not a WebP picture: {e}")).field(&name);
        let mut decoder = WebPDecoder::new(Cursor::new(&bytes)).map_err(|e| fail(&e))?;
        let (width, height) = decoder.dimensions();
        let pixels = u64::from(width) * u64::from(height);
        if pixels > most {
            return Err(Error::new("the picture is too large, or its header lies")
                .field(name)
                .found(format!("{width}x{height}"))
                .expected(format!("at most {most} pixels")));
        }
        let channels = if decoder.has_alpha() { 4 } else { 3 };
        let mut data = vec![0; pixels as usize * channels];
        decoder.read_image(&mut data).map_err(|e| fail(&e))?;
        let rgba = match channels {
            4 => data.as_chunks().0.to_vec(),
            _ => data.as_chunks::<3>().0.iter().map(|&[r, g, b]| [r, g, b, 255]).collect(),
        };
        Ok(Picture { width: width as usize, rgba })
    }

    /// A picture with a pixel for each Gaussian.
    fn pixels(&mut self, group: &str, which: usize) -> Result<Vec<[u8; 4]>> {
        // As wide as high and a multiple of four: never much larger than the count.
        let mut rgba = self.picture(group, which, 2 * self.count as u64 + (1 << 16))?.rgba;
        if rgba.len() < self.count {
            let field = format!("{group}.files[{which}]");
            return Err(self
                .wrong(&field)
                .found(format!("{} pixels", rgba.len()))
                .expected(format!("one for each of {} Gaussians", self.count)));
        }
        rgba.truncate(self.count);
        Ok(rgba)
    }

    /// What `take` makes of each Gaussian's pixel.
    fn each<T>(&mut self, group: &str, which: usize, take: impl Fn([u8; 4]) -> T) -> Result<Vec<T>> {
        Ok(self.pixels(group, which)?.into_iter().map(take).collect())
    }

    /// Positions: the low and high bytes of shares of a range, of sign(x) ln(1 + |x|).
    fn means(&mut self) -> Result<Vec<[f32; 3]>> {
        let (low, high) = (self.numbers("means", "mins", 3)?, self.numbers("means", "maxs", 3)?);
        let (lower, upper) = (self.pixels("means", 0)?, self.pixels("means", 1)?);
        let at = |k: usize, l: u8, u: u8| {
            let share = f64::from(u16::from_le_bytes([l, u])) / 65535.0;
            let v = low[k] + (high[k] - low[k]) * share;
            (v.signum() * v.abs().exp_m1()) as f32
        };
        Ok(lower.iter().zip(&upper).map(|(l, u)| [0, 1, 2].map(|k| at(k, l[k], u[k]))).collect())
    }

    /// What bytes stand for.
    fn table(&self, group: &str, version: u32, channels: usize) -> Result<Table> {
        if version == 2 {
            return Ok(Table::Values(self.numbers(group, "codebook", 256)?));
        }
        let (low, high) = (self.numbers(group, "mins", channels)?, self.numbers(group, "maxs", channels)?);
        Ok(Table::Ranges(low.into_iter().zip(high).collect()))
    }

    fn palette(&mut self, version: u32) -> Result<Palette> {
        let picture = self.picture("shN", 0, MOST_PALETTE)?;
        let table = match version {
            2 => self.table("shN", 2, 1)?,
            _ => {
                let number = |key: &str| {
                    let field = format!("shN.{key}");
                    self.meta["shN"][key].as_f64().ok_or_else(|| self.wrong(&field).expected("a number"))
                };
                Table::Ranges(vec![(number("mins")?, number("maxs")?); 3])
            }
        };
        // The picture is as wide as 64 rows of the palette.
        let degree = (1..=3).find(|&d| picture.width == PALETTE_COLUMNS * (sh_coefficients(d) - 1));
        let bands = self.meta["shN"]["bands"].as_u64();
        let degree = degree.filter(|d| version == 1 || bands == Some(u64::from(*d))).ok_or_else(|| {
            self.wrong("shN.bands")
                .found(format!("{bands:?} with a palette {} pixels wide", picture.width))
                .expected("1, 2 or 3 with 192, 512 or 960 pixels")
        })?;
        Ok(Palette { degree, picture, table })
    }
}

/// What bytes stand for.
enum Table {
    /// Of all channels.
    Values(Vec<f64>),
    /// Least and most, by channel.
    Ranges(Vec<(f64, f64)>),
}

impl Table {
    fn value(&self, channel: usize, byte: u8) -> f32 {
        match self {
            Self::Values(values) => values[usize::from(byte)] as f32,
            Self::Ranges(ranges) => {
                let (low, high) = ranges[channel];
                (low + (high - low) * f64::from(byte) / 255.0) as f32
            }
        }
    }
}

/// Coefficients beyond the constant one, shared by many Gaussians.
struct Palette {
    degree: u8,
    picture: Picture,
    table: Table,
}

impl Palette {
    /// Adds row `label`, `[coefficients][rgb]`; a row that is not there damages one Gaussian.
    fn push(&self, label: usize, sh: &mut Vec<f32>) {
        let k = sh_coefficients(self.degree) - 1;
        let at = label / PALETTE_COLUMNS * self.picture.width + label % PALETTE_COLUMNS * k;
        match self.picture.rgba.get(at..at + k) {
            Some(row) => sh.extend(row.iter().flat_map(|p| [0, 1, 2].map(|c| self.table.value(c, p[c])))),
            None => sh.extend(std::iter::repeat_n(f32::NAN, 3 * k)),
        }
    }
}
