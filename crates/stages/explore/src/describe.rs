//! What the page knows of a scene besides its Gaussians: `scene.json`, and the bytes of `scene.bin`.

use crate::pack::CHUNK;
use crate::world::{Edited, World};
use axum::body::Bytes;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use gs_scene::Camera;
use query::TextSource;
use serde_json::{Value, json};

/// Raw arrays for the page, one after the other, each at a multiple of 16 bytes; with where each lies.
pub struct Blob {
    /// All arrays, little-endian.
    pub bytes: Bytes,
    /// Name, first byte and number of bytes of each.
    pub sections: Vec<(&'static str, usize, usize)>,
}

/// The arrays of a scene: docs/explore.md says what is in them.
pub fn blob(world: &World) -> Blob {
    let mut blob = Writer::default();
    let packed = &world.packed;
    blob.add("packed", packed.words.iter().flatten().flat_map(|w| w.to_le_bytes()));
    blob.add("chunks", packed.chunks.iter().flatten().flat_map(|v| v.to_le_bytes()));
    blob.add("harmonics", packed.harmonics.iter().flatten().flat_map(|w| w.to_le_bytes()));
    blob.add("features", world.feature_colors.iter().flatten().copied());
    let cells = packed.order.iter().map(|&i| world.cells.of[i as usize]);
    if world.cells.pairs.len() <= 1 << 16 {
        blob.add("cells", cells.flat_map(|c| (c as u16).to_le_bytes()));
    } else {
        blob.add("cells", cells.flat_map(u32::to_le_bytes));
    }
    Blob { bytes: blob.bytes.into(), sections: blob.sections }
}

#[derive(Default)]
struct Writer {
    bytes: Vec<u8>,
    sections: Vec<(&'static str, usize, usize)>,
}

impl Writer {
    fn add(&mut self, name: &'static str, bytes: impl Iterator<Item = u8>) {
        let start = self.bytes.len();
        self.bytes.extend(bytes);
        self.sections.push((name, start, self.bytes.len() - start));
        self.bytes.resize(self.bytes.len().next_multiple_of(16), 0);
    }
}

/// `scene.json`. `mode` is `serve` or `file`; `photographs` says of which views the page can have the photograph.
pub fn scene(world: &World, edited: &Edited, blob: &Blob, mode: &str, photographs: &[usize]) -> Value {
    let g = world.gaussians();
    let raster = &world.scene.raster;
    let instances = &world.scene.instances;
    let sections: serde_json::Map<String, Value> =
        blob.sections.iter().map(|&(name, start, length)| (name.into(), json!([start, length]))).collect();
    let tree: Vec<Value> =
        instances.tree.iter().map(|e| json!([e.parent, e.child, e.lambda, e.size, e.instance])).collect();
    let matches: Vec<Value> = instances
        .matches
        .iter()
        .filter_map(|m| {
            let view = world.view(&instances.views[m.view as usize])?.0;
            Some(json!([m.instance, view, m.mask, m.score, m.visible]))
        })
        .collect();
    json!({
        "name": world.source.name(),
        "mode": mode,
        "gaussians": world.packed.order.len(),
        "of": g.len(),
        "chunk": CHUNK,
        "degree": u8::from(!world.packed.harmonics.is_empty()),
        "harmonics_range": world.packed.harmonics_range,
        "near": raster.near,
        "antialias": raster.antialias,
        "spread": g.spread(),
        "bytes": blob.bytes.len(),
        "sections": sections,
        "cells": world.cells.pairs,
        "cell_counts": world.cells.counts,
        "cut": cut(edited, world),
        "tree": tree,
        "matches": matches,
        "instances": instances_of(None, world),
        "edited": instances_of(Some(edited), world),
        "cameras": cameras(world, photographs),
        "words": words(&world.words),
        "edits": edited.edits.edits,
        "instances_hash": world.scene.artifact.hash(),
        "messages": world.messages,
    })
}

/// The cells where edits cut them, and which of them each such edit assigned; null where none does.
pub fn cut(edited: &Edited, world: &World) -> Value {
    let cells = &edited.cells;
    if cells.assigned.is_empty() {
        return Value::Null;
    }
    let of: Vec<u8> = world.packed.order.iter().flat_map(|&i| cells.of[i as usize].to_le_bytes()).collect();
    json!({"cells": cells.pairs, "cell_counts": cells.counts, "of": STANDARD.encode(of), "assigned": cells.assigned})
}

/// The instances as a list.
pub fn instances_of(edited: Option<&Edited>, world: &World) -> Vec<Value> {
    let instances = edited.map_or(&world.scene.instances, |e| &e.instances);
    let name = |k: usize| edited.and_then(|e| e.remarks.names.get(&(k as u32)));
    // The page applies edits itself, so it gets what the vocabulary says of the instances before any.
    let guess = |k: usize| world.names.as_ref().filter(|_| edited.is_none()).and_then(|n| n.best(k as u32));
    let one = |k: usize| {
        let b = &instances.oriented[k];
        json!({
            "count": instances.count[k],
            "score": instances.score[k],
            "support": instances.support[k],
            "centroid": instances.centroid[k],
            "box": {"center": b.center, "axes": b.axes, "half": b.half_size},
            "name": name(k),
            "guess": guess(k).map(|g| json!({"name": g.name, "sure": g.sure})),
        })
    };
    (0..instances.len()).map(one).collect()
}

fn cameras(world: &World, photographs: &[usize]) -> Vec<Value> {
    let one = |(k, v): (usize, &gs_scene::dataset::View)| {
        let mut camera = camera(&v.camera);
        camera["name"] = v.stem().into();
        camera["photograph"] = photographs.contains(&k).into();
        camera
    };
    world.dataset.views.iter().enumerate().map(one).collect()
}

/// A camera as the page writes it: rotation by rows, camera from world.
pub fn camera(c: &Camera) -> Value {
    let rotation = c.rotation.transpose().to_cols_array();
    json!({
        "width": c.width, "height": c.height, "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy,
        "rotation": rotation, "translation": c.translation.to_array(),
    })
}

fn words(words: &Result<TextSource, String>) -> Value {
    match words {
        Ok(source) => {
            json!({"source": source.describe(), "names": source.names(), "any": matches!(source, TextSource::Clip(_))})
        }
        Err(why) => json!({"why": why}),
    }
}
