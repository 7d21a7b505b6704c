//! A CLIP of ViT-B/16's size and random weights (scripts/make_clip_random.py) beside what ONNX Runtime makes of it from the ids of
//! CLIPTokenizer: scripts/test_clip_model.sh makes it, names it in `CLIP_TEST` and runs this.

use onnx_models::{ClipImage, ClipText, EngineArgs, EngineOptions, Tokenizer};
use std::path::{Path, PathBuf};

#[derive(serde::Deserialize)]
struct Tokens {
    text: String,
    ids: Vec<i32>,
}

fn tokens() -> Vec<Tokens> {
    serde_json::from_str(include_str!("../testdata/tokens.json")).unwrap()
}

#[test]
fn ids_are_those_of_transformers() {
    let tokenizer = Tokenizer::default();
    for Tokens { text, ids } in tokens() {
        assert_eq!(tokenizer.encode(&text, 77), ids, "{text:?}");
    }
}

/// The built-in engine, and ONNX Runtime where `ORT_TEST_LIBRARY` names it.
fn engines() -> Vec<EngineOptions> {
    let library = std::env::var_os("ORT_TEST_LIBRARY").map(PathBuf::from);
    let all = [None, library.clone()].into_iter().take(1 + usize::from(library.is_some()));
    all.map(|onnx_runtime| EngineArgs { onnx_runtime }.options()).collect()
}

fn folder() -> PathBuf {
    let whole = || Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../out/clip-random-12");
    std::env::var_os("CLIP_TEST").map_or_else(whole, PathBuf::from)
}

/// Asserts that no number is off by more than 1e-5.
#[allow(clippy::print_stdout, reason = "how far it is off is the result")]
fn assert_near(found: &[f32], folder: &Path, oracle: &str) {
    let expected = gs_io::npy::read_f32(folder.join(oracle)).unwrap();
    assert_eq!(found.len(), expected.len());
    let off = found.iter().zip(&expected).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    println!("{oracle}: at most {off:.1e} off");
    assert!(off < 1e-5, "{oracle}: {off}");
}

#[test]
#[ignore = "needs a model that scripts/test_clip_model.sh makes; run make test-data"]
fn texts_of_all_lengths_are_those_of_onnx_runtime() {
    let texts: Vec<String> = tokens().into_iter().map(|t| t.text).collect();
    for options in engines() {
        let clip = ClipText::open(folder(), &options).unwrap();
        clip.check().unwrap();
        assert_near(&clip.encode(&texts).unwrap(), &folder(), "texts.npy");
        let one_by_one: Vec<f32> = texts.iter().flat_map(|t| clip.encode(&[t]).unwrap()).collect();
        assert_near(&one_by_one, &folder(), "texts.npy");
    }
}

#[test]
#[ignore = "needs a model that scripts/test_clip_model.sh makes; run make test-data"]
fn pictures_are_those_of_onnx_runtime() {
    let pictures = gs_io::npy::read_f32(folder().join("pictures.npy")).unwrap();
    let pictures: Vec<u8> = pictures.iter().map(|&v| v as u8).collect();
    for options in engines() {
        let clip = ClipImage::open(folder(), &options).unwrap();
        assert_near(&clip.encode(&pictures).unwrap(), &folder(), "images.npy");
    }
}
