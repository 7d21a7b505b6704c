//! Models that are asked for nouns, on small graphs, beside what numpy makes of their answers (scripts/make_onnx_testdata.py).

use mask_embed::concepts::Concepts;
use mask_embed::panoptic::Segments;
use onnx_models::{EngineOptions, RgbImage};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

const MAP: [usize; 2] = [120, 80];
const NOUNS: [&str; 6] = ["sky", "grass", "car", "roof", "vehicle", "room"];

fn folder(export: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("testdata").join(format!("concepts-{export}"))
}

fn open(folder: &Path, nouns: &[&str], options: &EngineOptions) -> gs_io::Result<Concepts> {
    Concepts::open(folder, &nouns.iter().map(ToString::to_string).collect::<Vec<_>>(), options)
}

/// What the model of a folder sees of its photograph.
fn run(folder: &Path, nouns: &[&str]) -> gs_io::Result<Segments> {
    open(folder, nouns, &EngineOptions::default())?.segments(&photo(), MAP, usize::MAX)
}

fn photo() -> RgbImage {
    let photo = image::open(folder("samexporter").join("photo.png")).unwrap().to_rgb8();
    RgbImage { width: photo.width() as usize, height: photo.height() as usize, pixels: photo.into_raw() }
}

fn names(found: &Segments) -> Vec<&str> {
    found.masks.iter().map(|m| m.name.as_str()).collect()
}

/// A copy of an export's folder, with this `model.json`.
fn described(export: &str, model: &Value) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    for file in folder(export).read_dir().unwrap() {
        let file = file.unwrap();
        std::fs::copy(file.path(), dir.path().join(file.file_name())).unwrap();
    }
    std::fs::write(dir.path().join("model.json"), model.to_string()).unwrap();
    dir
}

#[test]
fn masks_are_those_of_numpy_for_every_export_and_engine() {
    let mut engines = vec![EngineOptions::default()];
    match std::env::var_os("ORT_TEST_LIBRARY") {
        Some(library) => engines.push(EngineOptions { onnx_runtime: Some(library.into()), ..EngineOptions::default() }),
        None => eprintln!("SKIPPED: ONNX Runtime (set ORT_TEST_LIBRARY and ORT_DISABLE_TELEMETRY=1 to try it)"),
    }
    for (export, options) in ["samexporter", "pixl"].iter().flat_map(|e| engines.iter().map(move |o| (e, o))) {
        let folder = folder(export);
        let found = open(&folder, &NOUNS, options).unwrap().segments(&photo(), MAP, usize::MAX).unwrap();
        let expected: Value = serde_json::from_slice(&std::fs::read(folder.join("segments.json")).unwrap()).unwrap();
        assert_eq!(found.masks.len(), expected.as_array().unwrap().len(), "{found:?}");
        for (found, expected) in found.masks.iter().zip(expected.as_array().unwrap()) {
            assert_eq!(expected["name"], found.name);
            assert!(
                (expected["score"].as_f64().unwrap() - f64::from(found.score)).abs() < 1e-5,
                "{found:?} {expected}"
            );
        }
        let expected = image::open(folder.join("ids.png")).unwrap().to_luma8();
        let off = found.ids.iter().zip(expected.pixels()).filter(|(id, e)| **id + 1 != i32::from(e.0[0])).count();
        assert!(off * 1000 < MAP[0] * MAP[1], "{export}: {off} pixels differ");
    }
}

#[test]
fn only_what_is_asked_for_is_found() {
    let folder = folder("samexporter");
    // Neither capitals nor other words change what a word means to this model.
    assert_eq!(names(&run(&folder, &["red CAR", "teapot"]).unwrap()), ["red CAR"]);
    assert!(run(&folder, &["teapot"]).unwrap().masks.is_empty());
    // The surer of two nouns for one thing has it, whatever their order.
    assert_eq!(names(&run(&folder, &["vehicle", "car"]).unwrap()), ["car"]);
    let mut model = open(&folder, &NOUNS, &EngineOptions::default()).unwrap();
    assert_eq!(names(&model.segments(&photo(), MAP, 1).unwrap()), ["sky"]);
    let hash = |nouns: &[&str]| open(&folder, nouns, &EngineOptions::default()).unwrap().hash().to_string();
    assert_eq!(model.hash(), hash(&NOUNS));
    assert_ne!(model.hash(), hash(&NOUNS[..5]));
}

#[test]
fn a_description_changes_what_is_found() {
    let with = |model: Value| run(described("samexporter", &model).path(), &NOUNS).unwrap();
    // The rest of the room is a tenth of its mask.
    let rest = with(json!({"overlap": 0.09}));
    assert_eq!(names(&rest), ["grass", "sky", "roof", "car", "room"]);
    assert!(rest.ids.iter().all(|&id| id >= 0));
    assert_eq!(names(&with(json!({"threshold": 0.95}))), ["grass"]);
    // A box that counts, of zeros though it is.
    assert!(with(json!({"constants": {"box_masks": [1, 1, 1, 0, 1, 1, 1, 1]}})).masks.is_empty());
    let dir = described("samexporter", &json!({"image": "of/photo.onnx"}));
    std::fs::create_dir(dir.path().join("of")).unwrap();
    std::fs::rename(dir.path().join("sam3_image_encoder.onnx"), dir.path().join("of/photo.onnx")).unwrap();
    assert_eq!(run(dir.path(), &NOUNS).unwrap().masks.len(), 4);
}

#[test]
fn what_is_missing_or_wrong_is_said() {
    let error = |export: &str, model: Value, nouns: &[&str], words: &[&str]| {
        let e = run(described(export, &model).path(), nouns).unwrap_err().to_string();
        assert!(words.iter().all(|w| e.contains(w)), "{e}");
    };
    let settings =
        |model: Value, words: &[&str]| error("samexporter", model, &NOUNS, &[&["model.json"], words].concat());
    settings(json!({"overlap": 1.5}), &["overlap", "found 1.5, expected 0 to 1"]);
    settings(json!({"std": [0.2, 0, 0.2]}), &["mean or std", "expected finite numbers, the last positive"]);
    settings(json!({"treshold": 0.5}), &["unknown field `treshold`", "docs/masks.md"]);
    settings(json!({"constants": {"boxes": 0}}), &["boxes", "no such input", "one of original_height", "box_coords"]);
    settings(json!({"inputs": {"language_mask": "mask"}}), &["language_mask", "found mask", "text_attention_mask"]);
    error(
        "samexporter",
        json!({"decoder": "none.onnx"}),
        &NOUNS,
        &["none.onnx: no such model", "samexporter", "model.json"],
    );
    error("samexporter", json!({"decoder": "photo.png"}), &NOUNS, &["photo.png", "not an ONNX model"]);
    error(
        "samexporter",
        json!({"decoder": "sam3_image_encoder.onnx"}),
        &NOUNS,
        &["image: nothing says what this input gets"],
    );
    let swapped = json!({"inputs": {"language_features": "text_embeds"}});
    error("samexporter", swapped, &NOUNS, &["language_features", "another shape", "found [32, 1, 6]"]);
    let dark = json!({"constants": {"box_coords": 1e39}});
    error("samexporter", dark, &NOUNS, &["sam3_decoder.onnx: the model does not give finite numbers"]);
    let only_files = |text: &str| json!({"image": "efficientsam3_ev_m_image_encoder.onnx", "text": text, "decoder": "efficientsam3_ev_m_decoder.onnx"});
    let text = "efficientsam3_ev_m_text_encoder.onnx";
    error("pixl", only_files(text), &NOUNS, &["exemplar_boxes: nothing says", "found nothing", "constants", "pos_0"]);
    let none = ["no such output", "pred_logits", "found vision_pos_enc_0", "samexporter 0.5 or later"];
    let inputs =
        json!({"image": "sam3_image_encoder.onnx", "decoder": "sam3_image_encoder.onnx", "constants": {"image": 0}});
    error("samexporter", inputs, &NOUNS, &none);
    let long = "a very long name of a thing that nobody would ever think of in so many words";
    error(
        "pixl",
        only_files(text),
        &["sky", long],
        &["--nouns", "too long", long, "19 tokens", "at most 16", "fewer words"],
    );
}
