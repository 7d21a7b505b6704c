//! `feat-train --method spectral` at full size: the program itself, on files as graph-precompute writes them.

use crate::scene::{Scene, Things};
use artifacts::{FootprintsBuilder, Row, ScratchEntries, role};
use gs_io::{Provenance, hash_file};
use gs_scene::{Gaussians, ply};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;

/// Runs it on masks that follow things and on masks that follow none, in a folder for a while.
pub fn measure(scene: &Scene, views: usize, threads: usize, folder: &Path) -> Value {
    let things = Things::new((scene.positions.len() as f64).sqrt() as usize);
    json!({
        "things": run(scene, Some(&things), views, threads, folder),
        "no_things": run(scene, None, views, threads, folder),
    })
}

fn run(scene: &Scene, things: Option<&Things>, views: usize, threads: usize, folder: &Path) -> Value {
    let file = |name: &str| folder.join(format!("closed-form-{name}"));
    let (geometry, graph, footprints) =
        (file("geometry.ply"), file("graph.safetensors"), file("footprints.safetensors"));
    let n = scene.positions.len();
    let gaussians = Gaussians {
        means: scene.positions.clone(),
        log_scales: vec![[0.0; 3]; n],
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; n],
        opacity_logits: vec![2.0; n],
        sh: vec![0.0; 3 * n],
        sh_degree: 0,
    };
    ply::write_gaussians(&geometry, &gaussians, &[]).expect("room for the geometry");
    drop(gaussians);
    let inputs = BTreeMap::from([(role::GEOMETRY.to_string(), hash_file(&geometry).expect("just written"))]);
    let provenance = Provenance { inputs, ..Provenance::default() };
    scene.graph.write(&graph, provenance.clone()).expect("room for the graph");
    let (masks, entries) = write_footprints(scene, things, views, &footprints, provenance);
    let out = file("features.safetensors");
    let status = Command::new(env!("CARGO_BIN_EXE_feat-train"))
        .args(["--method", "spectral", "--quiet", "--threads", &threads.to_string(), "--geometry"])
        .arg(&geometry)
        .arg("--graph")
        .arg(&graph)
        .arg("--footprints")
        .arg(&footprints)
        .arg("--out")
        .arg(&out)
        .status();
    assert!(status.expect("the program starts").success());
    let record = std::fs::read(out.with_file_name("closed-form-features.safetensors.run.json")).expect("a record");
    let record: Value = serde_json::from_slice(&record).expect("JSON");
    for name in ["geometry.ply", "graph.safetensors", "footprints.safetensors", "features.safetensors"] {
        std::fs::remove_file(file(name)).expect("just written");
    }
    let summary = &record["summary"];
    let values: Vec<f64> = serde_json::from_value(summary["singular_values"].clone()).expect("numbers");
    let dim = summary["dim"].as_u64().expect("a number") as usize;
    json!({
        "masks": masks, "entries": entries, "seconds": record["wall_seconds"], "cpu_seconds": summary["cpu_seconds"],
        "peak_rss_bytes": record["peak_rss_bytes"],
        "evidence_seconds": summary["evidence_seconds"], "vectors_seconds": summary["vectors_seconds"],
        "passes": summary["passes"], "residual": summary["residual"], "dim": dim, "smoothed_entries": summary["entries"],
        "gram_entries": summary["gram_entries"], "singular_values": [values[0], values[dim - 1], values[values.len() - 1]],
    })
}

/// Masks and entries of all views, which are in memory one at a time.
fn write_footprints(
    scene: &Scene,
    things: Option<&Things>,
    views: usize,
    path: &Path,
    provenance: Provenance,
) -> (usize, u64) {
    let mut builder =
        FootprintsBuilder { kept: scene.graph.kept.clone(), row_ptr: vec![0], ..FootprintsBuilder::default() };
    let mut scratch = ScratchEntries::beside(path).expect("room for footprints");
    for v in 0..views {
        builder.views.push(v.to_string());
        let (mut entries, pixels) = scene.entries(v as u64, things);
        entries.sort_unstable_by_key(|e| (e.1, e.0));
        let mut entries = entries.into_iter().peekable();
        for (k, pixels) in pixels.into_iter().enumerate() {
            while let Some((i, _, w)) = entries.next_if(|e| usize::from(e.1) == k) {
                scratch.push(i, w * pixels as f32).expect("room for footprints");
            }
            builder.row_ptr.push(scratch.count);
            let pixels = pixels as u32;
            builder.rows.push(Row { view: v as u32, level: 3, mask: k as u32, pixels, gated: pixels, alpha: 0.9 });
        }
    }
    let counts = (builder.rows.len(), scratch.count);
    builder.write_with(scratch, path, provenance).expect("room for footprints");
    counts
}
