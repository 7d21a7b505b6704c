//! A dual encoder whose features can be computed by hand (scripts/make_onnx_testdata.py makes it): an image feature is
//! the mean of each channel and a 1, a text feature counts ids modulo 4.

use onnx_models::{ClipConfig, ClipImage, ClipText, EngineOptions, Tokenizer};
use std::path::{Path, PathBuf};

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("testdata/clip")
}

fn unit(v: [f64; 4]) -> Vec<f32> {
    let n = v.iter().map(|x| x * x).sum::<f64>().sqrt();
    v.iter().map(|x| (x / n) as f32).collect()
}

fn close(a: &[f32], b: &[f32]) -> bool {
    a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-6)
}

#[test]
fn image_features_are_normalised_and_do_not_depend_on_the_batch() {
    let clip = ClipImage::open(folder(), &EngineOptions::default()).unwrap();
    assert_eq!((clip.size(), clip.dimension(), clip.config().name.as_str()), (8, 4, "test-clip"));
    // 37 pictures: ten batches, the last of them short. Channel c of picture i is flat.
    let flat = |i: usize, c: usize| ((i * 31 + c * 77) % 256) as u8;
    let crops: Vec<u8> = (0..37).flat_map(|i| (0..3).flat_map(move |c| [flat(i, c); 64])).collect();
    let features = clip.encode(&crops).unwrap();
    for i in 0..37 {
        let mean = |c: usize| f64::from(flat(i, c)) / 255.0;
        assert!(close(&features[i * 4..i * 4 + 4], &unit([mean(0), mean(1), mean(2), 1.0])), "picture {i}");
    }
    assert_eq!(clip.encode(&crops[..192]).unwrap(), features[..4]);
    assert!(clip.encode(&[]).unwrap().is_empty());
}

#[test]
fn mean_and_std_are_taken_from_the_configuration() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::copy(folder().join("image.onnx"), dir.path().join("image.onnx")).unwrap();
    let black = [0u8; 192];
    // Without a configuration: OpenAI's constants, and the size that the graph declares.
    let clip = ClipImage::open(dir.path(), &EngineOptions::default()).unwrap();
    let d = ClipConfig::default();
    let expected = |mean: [f32; 3], std: [f32; 3]| {
        let v = |c: usize| -f64::from(mean[c]) / f64::from(std[c]);
        unit([v(0), v(1), v(2), 1.0])
    };
    assert_eq!(clip.size(), 8);
    assert!(close(&clip.encode(&black).unwrap(), &expected(d.mean, d.std)));
    std::fs::write(dir.path().join("clip.json"), r#"{"mean": [1, 2, 3], "std": [0.5, 0.25, 4]}"#).unwrap();
    let clip = ClipImage::open(dir.path().join("image.onnx"), &EngineOptions::default()).unwrap();
    assert!(close(&clip.encode(&black).unwrap(), &expected([1.0, 2.0, 3.0], [0.5, 0.25, 4.0])));
}

#[test]
fn text_features_come_from_the_real_tokenizer() {
    let clip = ClipText::open(folder(), &EngineOptions::default()).unwrap();
    let features = clip.encode(&["a photo of a cat", "hello world!"]).unwrap();
    let tokenizer = Tokenizer::default();
    for (i, text) in ["a photo of a cat", "hello world!"].into_iter().enumerate() {
        let mut counts = [0.0; 4];
        let ids = tokenizer.encode(text, 77);
        for id in ids.iter().chain(&vec![0; 77 - ids.len()]) {
            counts[*id as usize % 4] += 1.0;
        }
        assert!(close(&features[i * 4..i * 4 + 4], &unit(counts)));
    }
}

#[test]
fn wrong_models_and_configurations_are_named() {
    let options = EngineOptions::default();
    let dir = tempfile::tempdir().unwrap();
    let image = |what: &Path| ClipImage::open(what, &options).err().unwrap().to_string();
    let e = image(dir.path());
    assert!(e.contains("image.onnx: no such model; fetch one with make clip"), "{e}");
    // The text encoder in place of the image encoder.
    let e = image(&folder().join("text.onnx"));
    assert!(e.contains("found integers of rank 2, expected floats of rank 4"), "{e}");
    std::fs::copy(folder().join("image.onnx"), dir.path().join("image.onnx")).unwrap();
    for (json, part) in [
        ("{\"dimension\": 5}", "found [1, 4], expected [1, 5]"),
        ("{\"std\": [1, 0, 1]}", "clip.json: std: not a usable value; found [1.0, 0.0, 1.0]"),
        ("{\"imagesize\": 5}", "unknown field `imagesize`"),
        ("{\"image_size\": 16}", "another shape; found [any, 3, 8, 8] in the model, expected [1, 3, 16, 16]"),
        ("{\"image_size\": 99999999}", "expected at most 4096"),
        ("{\"context_length\": 2}", "expected 3 to 4096"),
        ("{", "not a CLIP configuration"),
    ] {
        std::fs::write(dir.path().join("clip.json"), json).unwrap();
        let e = image(dir.path());
        assert!(e.contains(part) && !e.contains('\n'), "{e}");
    }
}
