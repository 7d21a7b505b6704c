//! Panoptic models on small graphs, beside what transformers makes of their answers (scripts/make_onnx_testdata.py).

use mask_embed::panoptic::{Panoptic, Segments};
use onnx_models::{EngineOptions, RgbImage};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

const MAP: [usize; 2] = [120, 80];

fn folder(family: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("testdata").join(format!("panoptic-{family}"))
}

fn photo(path: &Path) -> RgbImage {
    let photo = image::open(path).unwrap().to_rgb8();
    RgbImage { width: photo.width() as usize, height: photo.height() as usize, pixels: photo.into_raw() }
}

fn run(folder: &Path, photo: &RgbImage, size: [usize; 2]) -> gs_io::Result<Segments> {
    Panoptic::open(folder, &EngineOptions::default())?.segments(photo, size)
}

fn json(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

/// Asserts that segments are those of `segments.json`.
fn assert_segments(found: &Segments, folder: &Path) {
    let expected = json(&folder.join("segments.json"));
    let expected = expected.as_array().unwrap();
    assert_eq!(found.masks.len(), expected.len(), "{found:?}");
    for (found, expected) in found.masks.iter().zip(expected) {
        assert_eq!(expected["name"], found.name);
        assert!((expected["score"].as_f64().unwrap() - f64::from(found.score)).abs() < 1e-4, "{found:?} {expected}");
    }
}

#[test]
fn segments_are_those_of_transformers() {
    for family in ["detr", "mask2former", "oneformer", "eomt"] {
        let folder = folder(family);
        let found = run(&folder, &photo(&folder.join("photo.png")), MAP).unwrap();
        assert_segments(&found, &folder);
        let expected = image::open(folder.join("ids.png")).unwrap().to_luma8();
        assert_eq!(found.ids.dim(), (MAP[1], MAP[0]));
        let off = found.ids.iter().zip(expected.pixels()).filter(|(id, e)| **id + 1 != i32::from(e.0[0])).count();
        assert_eq!(off, 0, "{family}");
    }
}

/// A copy of a family's folder, with fields of a file that are replaced.
struct Changed(tempfile::TempDir);

impl Changed {
    fn new(family: &str, file: &str, changes: Value) -> Self {
        let dir = tempfile::tempdir().unwrap();
        for name in ["model.onnx", "config.json", "preprocessor_config.json", "model.json"] {
            let from = folder(family).join(name);
            if from.exists() {
                std::fs::copy(from, dir.path().join(name)).unwrap();
            }
        }
        let changed = Self(dir);
        let path = changed.path().join(file);
        let mut content = if path.exists() { json(&path) } else { json!({}) };
        for (field, value) in changes.as_object().unwrap() {
            content[field] = value.clone();
        }
        std::fs::write(path, content.to_string()).unwrap();
        changed
    }

    fn path(&self) -> &Path {
        self.0.path()
    }

    /// The error of opening and running it.
    fn error(&self, words: &[&str]) {
        let e = run(self.path(), &photo(&folder("detr").join("photo.png")), MAP).unwrap_err().to_string();
        assert!(words.iter().all(|w| e.contains(w)), "{e}");
    }
}

#[test]
fn photographs_of_any_size_give_maps_of_any_size() {
    let folder = folder("detr");
    let small = photo(&folder.join("photo.png"));
    let model = Panoptic::open(&folder, &EngineOptions::default()).unwrap();
    let expected = model.segments(&small, MAP).unwrap();
    let (width, height) = (3 * small.width, 3 * small.height);
    let large = onnx_models::resize_rgb(&small, width, height);
    let found = model.segments(&large, MAP).unwrap();
    let same = found.ids.iter().zip(&expected.ids).filter(|(a, b)| a == b).count();
    assert!(same * 100 > 98 * MAP[0] * MAP[1] && found.masks.len() == expected.masks.len(), "{same}");
    assert_eq!(model.segments(&small, [0, 7]).unwrap().ids.dim(), (7, 0));
    // Black all over: every query says none.
    let black = RgbImage { width: 40, height: 90, pixels: vec![0; 40 * 90 * 3] };
    let none = model.segments(&black, [4, 9]).unwrap();
    assert!(none.masks.is_empty() && none.ids.iter().all(|&id| id == -1));
}

#[test]
fn the_folder_may_be_as_the_hub_has_it() {
    let changed = Changed::new("detr", "model.json", json!({"threshold": 1.0}));
    std::fs::create_dir(changed.path().join("onnx")).unwrap();
    std::fs::rename(changed.path().join("model.onnx"), changed.path().join("onnx/model.onnx")).unwrap();
    let photo = photo(&folder("detr").join("photo.png"));
    // No score is larger than 1.
    assert!(run(changed.path(), &photo, MAP).unwrap().masks.is_empty());
    let hash = |folder: &Path| Panoptic::open(folder, &EngineOptions::default()).unwrap().hash().to_string();
    let before = hash(changed.path());
    std::fs::write(changed.path().join("model.json"), r#"{"overlap": 0, "mask_threshold": 0.4}"#).unwrap();
    assert!(run(changed.path(), &photo, MAP).unwrap().masks.len() > 3 && hash(changed.path()) != before);
}

#[test]
fn what_is_missing_or_wrong_is_said() {
    let without = |file: &str, words: &[&str]| {
        let changed = Changed::new("detr", "model.json", json!({}));
        std::fs::remove_file(changed.path().join(file)).unwrap();
        changed.error(words);
    };
    without("model.onnx", &["model.onnx: no such model", "onnx/model.onnx"]);
    without("config.json", &["config.json: no such file", "copy it"]);
    without("preprocessor_config.json", &["preprocessor_config.json: no such file", "copy it"]);
    let error = |family: &str, file: &str, changes: Value, words: &[&str]| {
        Changed::new(family, file, changes).error(&[&[file], words].concat());
    };
    let config = |changes: Value, words: &[&str]| error("detr", "config.json", changes, words);
    config(json!({"model_type": "segformer"}), &["model_type", "found segformer", "expected detr, mask2former"]);
    config(
        json!({"id2label": {"0": "sky"}}),
        &["id2label", "found no 1, expected names for 0 to 3", "copy config.json"],
    );
    config(json!({"id2label": 3}), &["not what describes such a model", "invalid type", "docs/masks.md"]);
    let shown = |changes: Value, words: &[&str]| error("detr", "preprocessor_config.json", changes, words);
    shown(json!({"image_std": [0.2, 0, 0.2]}), &["image_std", "found", "expected finite numbers"]);
    shown(json!({"rescale_factor": -1}), &["rescale_factor", "found -1", "the first and the last positive"]);
    shown(json!({"size": {}}), &["size", "found Size", "expected shortest_edge and longest_edge, or height and width"]);
    shown(json!({"size": {"height": 64, "width": 1_000_000}}), &["size", "1000000", "1 to 8192 pixels"]);
    shown(json!({"size": {"shortest_edge": 64}, "size_divisor": 0}), &["size_divisor", ", 0, expected"]);
    let settings = |family: &str, changes: Value, words: &[&str]| error(family, "model.json", changes, words);
    settings("detr", json!({"overlap": 1.5}), &["overlap", "found 1.5, expected 0 to 1"]);
    settings("detr", json!({"treshold": 0.5}), &["unknown field `treshold`", "docs/masks.md"]);
    settings(
        "detr",
        json!({"constants": {"task": 0}}),
        &["constants.task", "no such input", "pixel_values, pixel_mask"],
    );
    settings("oneformer", json!({"constants": {}}), &["task_inputs", "nothing says what this input gets", "constants"]);
    settings("oneformer", json!({"constants": {"task_inputs": [1, 2]}}), &["task_inputs", "found 2", "[1, 4]"]);
}

#[test]
fn other_graphs_are_refused() {
    let outputs = Changed::new("detr", "config.json", json!({"model_type": "eomt"}));
    outputs.error(&["model.onnx: class_queries_logits", "no such output; found logits, pred_masks", "export the eomt"]);
    let graph = |path: &str, words: &[&str]| {
        let changed = Changed::new("detr", "model.json", json!({"constants": {}}));
        std::fs::copy(folder("detr").join(path), changed.path().join("model.onnx")).unwrap();
        changed.error(words);
    };
    graph("config.json", &["model.onnx", "not an ONNX model"]);
    let words =
        ["no input for a picture; found a, b", "expected floats [1, 3, height, width]", "give a panoptic model"];
    graph("../../../../lib/onnx-models/testdata/ops.onnx", &words);
    // The names of the outputs, of the same length, change places.
    let swapped = Changed::new("mask2former", "config.json", json!({}));
    let path = swapped.path().join("model.onnx");
    let mut bytes = std::fs::read(&path).unwrap();
    let [classes, masks] = [b"class_queries_logits", b"masks_queries_logits"];
    for at in 0..bytes.len() - classes.len() {
        let name = &mut bytes[at..at + classes.len()];
        if name == classes {
            name.copy_from_slice(masks);
        } else if name == masks {
            name.copy_from_slice(classes);
        }
    }
    std::fs::write(&path, bytes).unwrap();
    swapped.error(&["other shapes", "class_queries_logits [1, 7, 16, 24]", "expected [1, queries, classes + 1] and"]);
    let endless = Changed::new("detr", "preprocessor_config.json", json!({"rescale_factor": 1e37}));
    endless.error(&["model.onnx: the model does not give finite numbers"]);
}
