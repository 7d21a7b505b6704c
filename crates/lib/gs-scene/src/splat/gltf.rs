//! glTF 2.0 with `KHR_gaussian_splatting`: numbers in accessors of mesh primitives, which nodes place in a scene.
//!
//! Scales are linear and opacities from 0 to 1; rotations are x y z w; harmonics have 3DGS's order and signs. Axes are right-handed
//! with y up and z forward, so x to the left.

mod accessor;
mod scene;
pub(super) mod writer;

use super::Splat;
use super::axes::{Axes, System};
use crate::middle::shift_of;
use crate::{Gaussians, logit, sh_coefficients};
use accessor::Buffers;
use glam::DVec3;
use gs_io::{Error, IoContext, Result};
use serde_json::Value;
use std::path::{Path, PathBuf};

/// Bytes of the buffers for each Gaussian at least: 24 where accessors do not overlap, and a mesh may be shown a few times.
const LEAST_BYTES: usize = 8;
const EXTENSION: &str = "KHR_gaussian_splatting";
/// Left, up, forward to right, down, forward, and back.
pub(super) const FLIPS: [f64; 3] = [-1.0, -1.0, 1.0];
/// The parts of a GLB.
const GLB_MAGIC: [u8; 4] = *b"glTF";
const JSON_CHUNK: [u8; 4] = *b"JSON";
const BINARY_CHUNK: [u8; 4] = *b"BIN\0";

/// The name of an attribute of the extension.
fn attribute(name: &str) -> String {
    format!("{EXTENSION}:{name}")
}

/// The name of the attribute of harmonic coefficient `i`, the constant one first.
fn coefficient(i: usize) -> String {
    let degree = i.isqrt();
    attribute(&format!("SH_DEGREE_{degree}_COEF_{}", i - degree * degree))
}

/// A file's description, and its binary chunk where it is a GLB.
fn open(bytes: &[u8]) -> Result<(Value, Option<&[u8]>)> {
    let json = |bytes: &[u8]| {
        serde_json::from_slice(bytes).map_err(|e| Error::new(format!("not JSON: {e}")).field("the JSON of the glTF"))
    };
    if !bytes.starts_with(&GLB_MAGIC) {
        return Ok((json(bytes)?, None));
    }
    let wrong = |field: &str, at: usize| {
        Error::new("not a value of GLB").field(format!("{field}, byte {at}")).hint("copy or export the file again")
    };
    let word = |at: usize| bytes.get(at..at + 4).map(|b| u32::from_le_bytes([b[0], b[1], b[2], b[3]]));
    let version = word(4);
    if version != Some(2) {
        return Err(wrong("version", 4).found(format!("{version:?}")).expected(2));
    }
    let mut chunks = Vec::new();
    let mut at = 12;
    while at < bytes.len() && chunks.len() < 2 {
        let size = word(at).ok_or_else(|| wrong("length of a chunk", at).found("the end of the file"))? as usize;
        let chunk = bytes.get(at + 4..at + 8).zip(bytes.get(at + 8..).and_then(|rest| rest.get(..size)));
        chunks.push(chunk.ok_or_else(|| {
            wrong("length of a chunk", at)
                .found(size)
                .expected(format!("at most {}", bytes.len().saturating_sub(at + 8)))
        })?);
        at += 8 + size;
    }
    match chunks[..] {
        [(kind, description), ref rest @ ..] if *kind == JSON_CHUNK => {
            let binary = rest.first().filter(|(kind, _)| **kind == BINARY_CHUNK).map(|(_, data)| *data);
            Ok((json(description)?, binary))
        }
        _ => Err(wrong("first chunk", 12).expected("JSON")),
    }
}

/// The files that a glTF consists of: itself first, then the buffers beside it.
pub(super) fn files(path: &Path) -> Result<Vec<PathBuf>> {
    let bytes = std::fs::read(path).at("read", path)?;
    let (description, _) = open(&bytes)?;
    let mut all = vec![path.to_path_buf()];
    for buffer in description["buffers"].as_array().into_iter().flatten() {
        if let Some(uri) = buffer["uri"].as_str().filter(|uri| !uri.starts_with("data:")) {
            all.push(path.with_file_name(super::plain_name(uri)?));
        }
    }
    Ok(all)
}

/// How many Gaussians the scene of a glTF claims to show, or as many as its files can hold, and the degree of their harmonics at most.
pub(super) fn claim(path: &Path) -> Result<(u64, u8)> {
    let bytes = std::fs::read(path).at("read", path)?;
    let (description, _) = open(&bytes)?;
    let (mut count, mut degree) = (0u64, 0);
    for (_, mesh) in scene::placed_meshes(&description)? {
        let primitives = description["meshes"][mesh]["primitives"].as_array().into_iter().flatten();
        for primitive in primitives.filter(|p| p["extensions"][EXTENSION].is_object()) {
            let positions = primitive["attributes"]["POSITION"].as_u64().and_then(|at| usize::try_from(at).ok());
            let own = positions.and_then(|at| description["accessors"][at]["count"].as_u64()).unwrap_or(0);
            count = count.saturating_add(own);
            degree = degree.max(degree_of(&primitive["attributes"]));
        }
    }
    let mut held = 0;
    for file in files(path)? {
        held += std::fs::metadata(&file).at("read", &file)?.len();
    }
    Ok((count.min(held / LEAST_BYTES as u64), degree))
}

/// The degree of harmonics of which a primitive has attributes.
fn degree_of(attributes: &Value) -> u8 {
    (1..=3).take_while(|&d| attributes[coefficient(sh_coefficients(d - 1))].is_u64()).count() as u8
}

/// Reads the Gaussians of a glTF; the caller names it in errors.
pub(super) fn read(path: &Path) -> Result<Splat> {
    let bytes = std::fs::read(path).at("read", path)?;
    let (description, binary) = open(&bytes)?;
    let buffers = Buffers::open(&description, binary, path)?;
    let mut all = Gaussians::default();
    let mut left_out = Vec::new();
    let placed: Vec<_> =
        scene::placed_meshes(&description)?.into_iter().map(|(map, m)| (scene::ours(map), m)).collect();
    // Where nodes place meshes far away, in double precision.
    let shift = shift_of(placed.iter().map(|(map, _)| map.w_axis.truncate().to_array()));
    for (mut map, mesh) in placed {
        map.w_axis -= DVec3::from(shift).extend(0.0);
        let axes =
            Axes::affine(map).map_err(|e| e.field(format!("the node of meshes[{mesh}], its global transform")))?;
        for (i, primitive) in description["meshes"][mesh]["primitives"].as_array().into_iter().flatten().enumerate() {
            if primitive["extensions"][EXTENSION].is_object() {
                let at = |e: Error| e.field(format!("meshes[{mesh}].primitives[{i}]"));
                let mut part = gaussians(primitive, &description, &buffers).map_err(at)?;
                axes.apply(&mut part);
                append(&mut all, part);
                if all.len() > buffers.bytes() / LEAST_BYTES {
                    return Err(Error::new(
                        "more Gaussians than its buffers can hold: meshes or accessors repeat the same bytes",
                    )
                    .field("nodes")
                    .found(format!("{} Gaussians", all.len()))
                    .expected(format!(
                        "at most {} in {} bytes",
                        buffers.bytes() / LEAST_BYTES,
                        buffers.bytes()
                    )));
                }
                notes(&primitive["extensions"][EXTENSION], &mut left_out);
            }
        }
    }
    all.shift = shift;
    if all.is_empty() {
        return Err(Error::new("no primitive with Gaussians")
            .field("meshes")
            .expected(format!("a primitive with the extension {EXTENSION} in the scene")));
    }
    let kind = format!("glTF 2.0 with {EXTENSION}");
    Ok(Splat { gaussians: all, antialias: false, axes: System::GLTF, kind, left_out })
}

/// What of an extension's properties was not followed.
fn notes(extension: &Value, left_out: &mut Vec<String>) {
    let known = [("kernel", "ellipse"), ("colorSpace", "srgb_rec709_display"), ("projection", "perspective")];
    for (key, value) in known {
        let note = format!("{key} {}: taken as {value}", extension[key]);
        if !extension[key].is_null() && extension[key] != value && !left_out.contains(&note) {
            left_out.push(note);
        }
    }
}

/// The Gaussians of a primitive, in its own axes but with signs as in [`scene::ours`].
fn gaussians(primitive: &Value, description: &Value, buffers: &Buffers) -> Result<Gaussians> {
    let packed: Vec<&String> =
        primitive["extensions"][EXTENSION]["extensions"].as_object().into_iter().flatten().map(|(k, _)| k).collect();
    if let [name, ..] = packed[..] {
        return Err(Error::new("Gaussians packed by a further extension are not read")
            .found(name)
            .expected("plain accessors")
            .hint("export the glTF without compression, or give the SPZ that it was made from"));
    }
    let attributes = &primitive["attributes"];
    let get = |name: &str| -> Result<accessor::Accessor<'_>> {
        let index = attributes[name].as_u64().ok_or_else(|| Error::new("no such attribute").field(name))?;
        buffers.accessor(description, index).map_err(|e| e.field(format!("{name}, accessors[{index}]")))
    };
    let means: Vec<[f32; 3]> = get("POSITION")?.vectors()?;
    let n = means.len();
    let fits = |name: &str, found: usize| match found == n {
        true => Ok(()),
        false => Err(Error::new("not a value for each position").field(name).found(found).expected(n)),
    };
    let [rotation, scale, opacity] = ["ROTATION", "SCALE", "OPACITY"].map(attribute);
    let log_scales = get(&scale)?.vectors::<3>()?.into_iter().map(|s| s.map(f32::ln)).collect::<Vec<_>>();
    fits(&scale, log_scales.len())?;
    let rotations: Vec<[f32; 4]> =
        get(&rotation)?.vectors::<4>()?.into_iter().map(|[x, y, z, w]| [w, x, y, z]).collect();
    fits(&rotation, rotations.len())?;
    let opacity_logits: Vec<f32> = get(&opacity)?.vectors::<1>()?.into_iter().map(|[o]| logit(o)).collect();
    fits(&opacity, opacity_logits.len())?;
    let sh_degree = degree_of(attributes);
    let k = sh_coefficients(sh_degree);
    let mut sh = vec![0.0; 3 * k * n];
    for i in 0..k {
        let name = coefficient(i);
        let values = get(&name)?.vectors::<3>()?;
        fits(&name, values.len())?;
        sh.chunks_exact_mut(3 * k).zip(values).for_each(|(row, rgb)| row[3 * i..3 * i + 3].copy_from_slice(&rgb));
    }
    Ok(Gaussians { means, log_scales, rotations, opacity_logits, sh, sh_degree, shift: [0.0; 3] })
}

/// Adds Gaussians behind others; the lower degree of harmonics is filled with zeros.
fn append(all: &mut Gaussians, part: Gaussians) {
    if all.is_empty() {
        *all = part;
        return;
    }
    let degree = all.sh_degree.max(part.sh_degree);
    *all = std::mem::take(all).with_degree(degree);
    let part = part.with_degree(degree);
    all.means.extend(part.means);
    all.log_scales.extend(part.log_scales);
    all.rotations.extend(part.rotations);
    all.opacity_logits.extend(part.opacity_logits);
    all.sh.extend(part.sh);
}
