//! Writing a GLB.

use super::super::axes::Axes;
use super::{BINARY_CHUNK, EXTENSION, FLIPS, GLB_MAGIC, JSON_CHUNK, attribute, coefficient};
use crate::{Gaussians, sh_coefficients};
use gs_io::{Error, IoContext, Result};
use serde_json::{Map, Value, json};
use std::io::Write;
use std::path::Path;

/// Component types of accessors.
const FLOAT: u32 = 5126;
const BYTE: u32 = 5121;
/// What views of vertices are for.
const ARRAY_BUFFER: u32 = 34962;

/// Adds the bytes of a Gaussian's vector.
type Put<'a> = Box<dyn Fn(usize, &mut Vec<u8>) + 'a>;

/// An attribute: its name, the type of its vectors, and how the vector of a Gaussian is written.
struct Attribute<'a> {
    name: String,
    kind: &'static str,
    component: u32,
    bytes: u64,
    put: Put<'a>,
}

fn floats<'a, const N: usize>(
    name: String,
    kind: &'static str,
    values: impl Fn(usize) -> [f32; N] + 'a,
) -> Attribute<'a> {
    let put = move |i: usize, row: &mut Vec<u8>| row.extend(values(i).map(f32::to_le_bytes).as_flattened());
    Attribute { name, kind, component: FLOAT, bytes: 4 * N as u64, put: Box::new(put) }
}

/// All attributes. `COLOR_0` is for viewers that know no Gaussians: points, whose colours are linear.
fn attributes<'a>(g: &'a Gaussians, axes: &'a Axes) -> Vec<Attribute<'a>> {
    let unit = |[w, x, y, z]: [f32; 4]| {
        let length = [w, x, y, z].iter().map(|v| v * v).sum::<f32>().sqrt();
        if length > 0.0 { [x, y, z, w].map(|v| v / length) } else { [0.0, 0.0, 0.0, 1.0] }
    };
    let linear = |v: f32| if v <= 0.04045 { v / 12.92 } else { ((v + 0.055) / 1.055).powf(2.4) };
    let color = move |i: usize, row: &mut Vec<u8>| {
        let byte = |v: f32| (255.0 * v).round() as u8;
        row.extend(g.base_color(i).map(|v| byte(linear(v.clamp(0.0, 1.0)))));
        row.push(byte(g.opacity(i)));
    };
    let mut all = vec![
        floats("POSITION".into(), "VEC3", move |i| axes.point(g.means[i])),
        Attribute { name: "COLOR_0".into(), kind: "VEC4", component: BYTE, bytes: 4, put: Box::new(color) },
        floats(attribute("ROTATION"), "VEC4", move |i| unit(axes.rotation(g.rotations[i]))),
        floats(attribute("SCALE"), "VEC3", |i| g.log_scales[i].map(f32::exp)),
        floats(attribute("OPACITY"), "SCALAR", |i| [g.opacity(i)]),
    ];
    all.extend((0..sh_coefficients(g.sh_degree)).map(|c| {
        floats(coefficient(c), "VEC3", move |i| {
            // A turn mixes the coefficients of one degree; flips change signs only.
            let mut sh = [0.0; 48];
            sh[3 * c..3 * c + 3].copy_from_slice(&g.sh_of(i)[3 * c..3 * c + 3]);
            axes.harmonics(&mut sh);
            [sh[3 * c], sh[3 * c + 1], sh[3 * c + 2]]
        })
    }));
    all
}

/// Writes a GLB, which errors call `place`, in the order of `g`.
pub(in crate::splat) fn write(w: &mut dyn Write, place: &Path, g: &Gaussians, comments: &[String]) -> Result<()> {
    let axes = Axes::flips(FLIPS);
    let attributes = attributes(g, &axes);
    let n = g.len() as u64;
    let binary: u64 = attributes.iter().map(|a| a.bytes * n).sum();
    let mut description = description(&attributes, g, &axes, binary, comments).to_string().into_bytes();
    description.resize(description.len().next_multiple_of(4), b' ');
    let total = 12 + 8 + description.len() as u64 + 8 + binary;
    let total = u32::try_from(total).map_err(|_| {
        Error::new("too large for a GLB")
            .found(format!("{total} bytes"))
            .expected("less than 4 GiB")
            .hint("write a PLY")
    })?;
    let mut put = |bytes: &[u8]| w.write_all(bytes).at("write", place);
    for part in [GLB_MAGIC, 2u32.to_le_bytes(), total.to_le_bytes()] {
        put(&part)?;
    }
    put(&(description.len() as u32).to_le_bytes())?;
    put(&JSON_CHUNK)?;
    put(&description)?;
    put(&(binary as u32).to_le_bytes())?;
    put(&BINARY_CHUNK)?;
    let mut row = Vec::new();
    for attribute in &attributes {
        for i in 0..g.len() {
            row.clear();
            (attribute.put)(i, &mut row);
            put(&row)?;
        }
    }
    Ok(())
}

fn description(attributes: &[Attribute<'_>], g: &Gaussians, axes: &Axes, binary: u64, comments: &[String]) -> Value {
    let (mut views, mut accessors, mut names) = (Vec::new(), Vec::new(), Map::new());
    let mut at = 0;
    for (i, a) in attributes.iter().enumerate() {
        let bytes = a.bytes * g.len() as u64;
        views.push(json!({"buffer": 0, "byteOffset": at, "byteLength": bytes, "target": ARRAY_BUFFER}));
        let mut accessor = json!({"bufferView": i, "componentType": a.component, "count": g.len(), "type": a.kind});
        if a.component == BYTE {
            accessor["normalized"] = true.into();
        }
        names.insert(a.name.clone(), i.into());
        accessors.push(accessor);
        at += bytes;
    }
    let bound = |start: f32, choose: fn(f32, f32) -> f32| {
        g.means.iter().map(|m| axes.point(*m)).fold([start; 3], |b, p| [0, 1, 2].map(|k| choose(b[k], p[k])))
    };
    accessors[0]["min"] = json!(bound(f32::INFINITY, f32::min));
    accessors[0]["max"] = json!(bound(f32::NEG_INFINITY, f32::max));
    let mut node = json!({"mesh": 0});
    if g.shift != [0.0; 3] {
        let flipped: Vec<f64> = g.shift.iter().zip(FLIPS).map(|(v, sign)| sign * v).collect();
        node["translation"] = json!(flipped);
    }
    let extension = json!({
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    });
    json!({
        "asset": {"version": "2.0", "generator": "gs-scene", "extras": {"comments": comments}},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [node],
        "meshes": [{"primitives": [{"attributes": names, "mode": 0, "extensions": {EXTENSION: extension}}]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": binary}],
    })
}
