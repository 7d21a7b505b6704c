//! A panoptic model of full size with random weights beside what transformers makes of the same photograph:
//! scripts/test_panoptic.py makes both, names their folder in `PANOPTIC_TEST` and runs this.

use mask_embed::panoptic::Panoptic;
use onnx_models::{EngineOptions, RgbImage};
use std::path::PathBuf;
use std::time::Instant;

#[test]
#[ignore = "needs a model that scripts/test_panoptic.py makes, which runs this"]
#[allow(clippy::print_stdout, reason = "how far it is off and what it takes is the result")]
fn segments_are_those_of_transformers() {
    let Some(folder) = std::env::var_os("PANOPTIC_TEST").map(PathBuf::from) else {
        println!("SKIPPED: a panoptic model of full size: run scripts/test_panoptic.py");
        return;
    };
    let onnx_runtime = std::env::var_os("ORT_TEST_LIBRARY").map(PathBuf::from);
    let photo = image::open(folder.join("photo.png")).unwrap().to_rgb8();
    let photo = RgbImage { width: photo.width() as usize, height: photo.height() as usize, pixels: photo.into_raw() };
    let expected = image::open(folder.join("ids.png")).unwrap().to_luma8();
    let size = [expected.width() as usize, expected.height() as usize];

    let model = Panoptic::open(&folder, &EngineOptions { onnx_runtime, threads_per_run: 0 }).unwrap();
    let start = Instant::now();
    let found = model.segments(&photo, size).unwrap();
    let seconds = start.elapsed().as_secs_f64();
    let memory = stage::peak_rss_bytes().unwrap_or(0) >> 20;

    let off = found.ids.iter().zip(expected.pixels()).filter(|(id, e)| **id + 1 != i32::from(e.0[0])).count();
    println!("{off} of {} pixels differ; {seconds:.2} s, {memory} MiB at most", size[0] * size[1]);
    let segments: serde_json::Value =
        serde_json::from_slice(&std::fs::read(folder.join("segments.json")).unwrap()).unwrap();
    let segments = segments.as_array().unwrap();
    assert_eq!(found.masks.len(), segments.len());
    for (found, expected) in found.masks.iter().zip(segments) {
        assert_eq!(expected["name"], found.name);
        assert!((expected["score"].as_f64().unwrap() - f64::from(found.score)).abs() < 1e-3, "{found:?} {expected}");
    }
    // Where two masks are as likely, the last digits decide.
    assert!(off * 1000 < size[0] * size[1]);
}
