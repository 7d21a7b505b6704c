//! The program on small scenes, with a segmenter by colour in place of SAM and an encoder whose features can be computed
//! by hand in place of CLIP (scripts/make_onnx_testdata.py makes both).

use artifacts::{
    Draft, Instances, Level, MaskFeatures, MaskMaps, MaskTruth, TrueObject, TruePart, TrueScene, Witness,
    features_path, flat, maps_path, read_mask_names,
};
use gs_io::Artifact;
use gs_scene::Image;
use ndarray::Array3;
use serde_json::json;
use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsStr;
use std::fmt::Debug;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

const WIDTH: usize = 128;
const HEIGHT: usize = 64;
const SAM: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/testdata/sam");
const CLIP: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../lib/onnx-models/testdata/clip");

/// Colour of a pixel: a green ceiling over a grey wall with a dark square, a bright square, and in it a slightly different
/// one.
fn color(view: usize, x: usize, y: usize) -> [u8; 3] {
    let x = x.wrapping_sub(view * 8);
    match (x, y) {
        (_, 0..12) => [60, 180, 60],
        (80..112, 24..40) => [250, 235, 240],
        (72..112, 16..48) => [250, 250, 240],
        (16..48, 16..48) => [20, 30, 10],
        _ => [128, 128, 128],
    }
}

fn run(args: &[impl AsRef<OsStr>]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_mask-embed")).args(args).output().unwrap()
}

fn ok(args: &[impl AsRef<OsStr> + Debug]) -> String {
    let out = run(args);
    let text = String::from_utf8_lossy(&out.stderr).into_owned();
    assert!(out.status.success(), "{args:?}: {text}");
    text
}

#[test]
fn more_memory_than_there_may_be_is_refused_before_the_first_view() {
    let scene = Scene::new(1);
    let masks = &scene.masks;
    let limit = ["--memory-limit", "2M"];
    let e = error(&scene.masks_args(masks, &limit));
    assert!(e.contains("--memory-limit: the run needs more memory than it may take") && e.contains("--threads"), "{e}");
    assert!(!masks.join("masks.json").exists() && !maps_path(masks, "v0").exists());
    scene.make_masks(masks, &[]);
    let e = error(&scene.embed_args(&limit));
    assert!(e.contains("--memory-limit"), "{e}");
    assert!(!features_path(masks, "v0").exists());
    ok(&scene.embed_args(&[]));
    // What stands already needs no model to run.
    ok(&scene.embed_args(&limit));
}

/// The one line of an error, with exit code 2.
fn error(args: &[impl AsRef<OsStr> + Debug]) -> String {
    let out = run(args);
    let text = String::from_utf8_lossy(&out.stderr).into_owned();
    assert_eq!(out.status.code(), Some(2), "{args:?}: {text}");
    let last = text.lines().last().unwrap_or_default().to_string();
    assert!(last.starts_with("mask-embed: error: "), "{text}");
    last
}

fn path(p: &Path) -> &str {
    p.to_str().unwrap()
}

struct Scene {
    _dir: tempfile::TempDir,
    folder: PathBuf,
    masks: PathBuf,
}

impl Scene {
    /// A scene of `views` photographs in transforms.json form.
    fn new(views: usize) -> Self {
        let dir = tempfile::tempdir().unwrap();
        let folder = dir.path().join("scene");
        std::fs::create_dir(&folder).unwrap();
        let frame = |v: usize| {
            let name = format!("v{v}.png");
            let pixels: Vec<u8> = (0..WIDTH * HEIGHT).flat_map(|i| color(v, i % WIDTH, i / WIDTH)).collect();
            Image::from_rgb8(WIDTH as u32, HEIGHT as u32, &pixels).write_png(folder.join(&name)).unwrap();
            json!({"file_path": name, "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]})
        };
        let frames: Vec<_> = (0..views).map(frame).collect();
        let scene = json!({"camera_angle_x": 0.9, "w": WIDTH, "h": HEIGHT, "frames": frames});
        std::fs::write(folder.join("transforms.json"), scene.to_string()).unwrap();
        Self { masks: dir.path().join("masks"), folder, _dir: dir }
    }

    fn masks_args(&self, out: &Path, more: &[&str]) -> Vec<String> {
        let choice = ["--points-per-side", "16", "--min-area", "20"];
        let args = ["masks", "--scene", path(&self.folder), "--out", path(out)];
        let sam: &[&str] = if more.contains(&"--sam") { &[] } else { &["--sam", SAM] };
        [&args, sam, &choice[..], more].concat().into_iter().map(String::from).collect()
    }

    fn make_masks(&self, out: &Path, more: &[&str]) -> String {
        ok(&self.masks_args(out, more))
    }

    fn embed_args(&self, more: &[&str]) -> Vec<String> {
        let args = ["embed", "--scene", path(&self.folder), "--masks", path(&self.masks), "--clip", CLIP];
        [&args[..], more].concat().into_iter().map(String::from).collect()
    }
}

/// All files of a folder but the records of runs, by name.
fn contents(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    std::fs::read_dir(folder)
        .unwrap()
        .map(|e| e.unwrap().path())
        .filter(|p| !path(p).ends_with(".run.json"))
        .map(|p| (p.file_name().unwrap().to_string_lossy().into_owned(), std::fs::read(&p).unwrap()))
        .collect()
}

#[test]
fn masks_follow_the_colours_at_every_level() {
    let scene = Scene::new(2);
    scene.make_masks(&scene.masks, &[]);
    for v in 0..2 {
        let maps = MaskMaps::read(maps_path(&scene.masks, &format!("v{v}"))).unwrap();
        assert_eq!((maps.width(), maps.height()), (WIDTH, HEIGHT));
        let at = |l: Level, x: usize, y: usize| maps.level(l)[[y, x + v * 8]];
        for level in Level::SAM {
            let (wall, dark, bright) = (at(level, 2, 20), at(level, 30, 30), at(level, 76, 44));
            assert!(wall >= 0 && dark >= 0 && bright >= 0 && wall != dark && dark != bright && wall != bright);
        }
        // The inner square is apart at level small and part of the bright one at level large.
        assert_ne!(at(Level::SMALL, 96, 32), at(Level::SMALL, 76, 44));
        assert_eq!(at(Level::LARGE, 96, 32), at(Level::LARGE, 76, 44));
        // A square's pixels, up to one at its border.
        let dark = at(Level::LARGE, 30, 30);
        for ((y, x), &id) in maps.level(Level::LARGE).indexed_iter() {
            let (x, y) = (x as i64 - v as i64 * 8, y as i64);
            let inside = (17..47).contains(&x) && (17..47).contains(&y);
            let outside = !(15..49).contains(&x) || !(15..49).contains(&y);
            assert!(if id == dark { !outside } else { !inside }, "at {x}, {y}");
        }
    }
    // A smaller map shows the same things.
    let small = scene.masks.with_file_name("small");
    scene.make_masks(&small, &["--map-size", "64"]);
    let maps = MaskMaps::read(maps_path(&small, "v0")).unwrap();
    assert_eq!((maps.width(), maps.height()), (64, 32));
    assert_eq!(maps.level(Level::LARGE)[[15, 20]], maps.level(Level::LARGE)[[22, 10]]);
}

#[test]
fn the_result_depends_neither_on_threads_nor_on_interruptions() {
    let scene = Scene::new(3);
    let other = scene.masks.with_file_name("other");
    scene.make_masks(&scene.masks, &["--threads", "1"]);
    let whole = contents(&scene.masks);
    assert_eq!(whole.len(), 7, "three maps, three notes, a manifest: {:?}", whole.keys());
    scene.make_masks(&other, &["--threads", "3"]);
    assert_eq!(whole, contents(&other));
    // As after a kill: no manifest, one view missing, one cut short, one without its note.
    for name in ["masks.json", "v0_s.npy", "v2_s.json"] {
        std::fs::remove_file(other.join(name)).unwrap();
    }
    std::fs::write(other.join("v1_s.npy"), &whole["v1_s.npy"][..1000]).unwrap();
    // It might as well have been edited by hand.
    assert!(error(&scene.masks_args(&other, &[])).contains("v1_s.npy: the output exists and would be lost"));
    std::fs::write(other.join("v2_s.json"), "{").unwrap();
    scene.make_masks(&other, &["--overwrite"]);
    assert_eq!(whole, contents(&other));
    // As after a kill while the last map was written, copied without hidden files: the notes say whose the rest is.
    for name in ["masks.json", "masks.json.run.json", "v1_s.npy"] {
        std::fs::remove_file(other.join(name)).unwrap();
    }
    let begun = r#"{"made_from": "", "hash": "", "facts": null, "begun": true}"#;
    std::fs::write(other.join("v2_s.json"), begun).unwrap();
    let said = scene.make_masks(&other, &[]);
    assert!(said.contains("skipped 1 of 3 views"), "{said}");
    assert_eq!(whole, contents(&other));
    // A map of somebody else has no note, or one of other bytes.
    for name in ["masks.json", "masks.json.run.json", "v2_s.json"] {
        std::fs::remove_file(other.join(name)).unwrap();
    }
    assert!(error(&scene.masks_args(&other, &[])).contains("v2_s.npy: the output exists and would be lost"));
    scene.make_masks(&other, &["--overwrite"]);
    // Again: nothing is made. With another parameter: everything is.
    let touched = || std::fs::metadata(other.join("v1_s.npy")).unwrap().modified().unwrap();
    let before = touched();
    let said = scene.make_masks(&other, &[]);
    assert!(said.contains("skipped 3 of 3 views: their id maps are done already"), "{said}");
    assert_eq!(touched(), before);
    let said = scene.make_masks(&other, &["--map-size", "799"]);
    assert!(!said.contains("done already"), "{said}");
    assert!(touched() > before);
    // A changed photograph: that view alone.
    scene.make_masks(&other, &[]);
    std::fs::copy(scene.folder.join("v0.png"), scene.folder.join("v1.png")).unwrap();
    let said = scene.make_masks(&other, &[]);
    assert!(said.contains("skipped 2 of 3 views"), "{said}");
    assert_eq!(std::fs::read(other.join("v1_s.npy")).unwrap(), whole["v0_s.npy"]);
}

#[test]
fn a_panoptic_model_adds_classes_with_names() {
    let scene = Scene::new(2);
    let other = scene.masks.with_file_name("other");
    scene.make_masks(&other, &[]);
    let model = export("panoptic-detr");
    let panoptic = ["--panoptic", path(&model), "--threads"];
    scene.make_masks(&scene.masks, &[&panoptic[..], &["1"]].concat());
    for view in ["v0", "v1"] {
        let [plain, named] = [&other, &scene.masks].map(|m| MaskMaps::read(maps_path(m, view)).unwrap());
        assert_eq!((plain.levels(), named.levels()), (&Level::SAM[..], &Level::ALL[..6]));
        Level::SAM.iter().for_each(|&l| assert_eq!(plain.level(l), named.level(l), "{l}"));
        let names = read_mask_names(&scene.masks, view).unwrap();
        let ids = named.level(Level::CLASSES).into_iter();
        let owned: BTreeSet<u32> = ids.filter_map(|&id| u32::try_from(id).ok()).collect();
        assert!(names.keys().all(|id| owned.contains(id)) && owned.len() > names.len(), "{names:?}");
        assert!(names.values().any(|m| m.name == "grass" && m.score > 0.9), "{names:?}");
        assert!(read_mask_names(&other, view).unwrap().is_empty());
    }
    // The same with more threads, in place of maps without classes; then nothing is left to do.
    scene.make_masks(&other, &[&panoptic[..], &["3"]].concat());
    assert_eq!(contents(&scene.masks), contents(&other));
    let said = scene.make_masks(&other, &[&panoptic[..], &["3"]].concat());
    assert!(said.contains("skipped 2 of 2 views: their id maps are done already"), "{said}");
    // A second model has a level of its own; of the same one it has the same masks.
    scene.make_masks(&other, &["--panoptic", path(&model), "--panoptic", path(&model)]);
    let maps = MaskMaps::read(maps_path(&other, "v0")).unwrap();
    let [first, second] = [4, 6].map(|at| maps.level(Level::ALL[at]));
    let apart = second[[0, 0]] - first[[0, 0]];
    assert!(apart > 0 && first.iter().zip(second).all(|(a, b)| *b == if *a < 0 { -1 } else { a + apart }));
    let named = read_mask_names(&other, "v0").unwrap();
    assert_eq!(named.len(), 2 * read_mask_names(&scene.masks, "v0").unwrap().len());
    let e = error(&scene.masks_args(&other, &["--panoptic", path(&model)].repeat(7)));
    assert!(e.contains("--panoptic: too many models; found 7, expected at most 6"), "{e}");
    let e = error(&scene.masks_args(&other, &["--panoptic", path(&scene.folder)]));
    assert!(e.contains("no such model"), "{e}");
}

#[test]
fn nouns_add_concepts_with_names() {
    let scene = Scene::new(2);
    let [other, both] = ["other", "both"].map(|name| scene.masks.with_file_name(name));
    let (model, nouns) = (export("concepts-samexporter"), scene.folder.join("nouns.txt"));
    std::fs::write(&nouns, "# mine\ngrass\nroof\nGrass\n").unwrap();
    let concepts = ["--concepts", path(&model), "--nouns", path(&nouns), "--threads"];
    let said = scene.make_masks(&scene.masks, &[&concepts[..], &["1"]].concat());
    assert!(said.contains("2 nouns are looked for") && said.contains("name something again are left out: 1"), "{said}");
    scene.make_masks(&other, &[]);
    for view in ["v0", "v1"] {
        let [plain, named] = [&other, &scene.masks].map(|m| MaskMaps::read(maps_path(m, view)).unwrap());
        Level::SAM.iter().for_each(|&l| assert_eq!(plain.level(l), named.level(l), "{l}"));
        assert!(named.level(Level::CLASSES).iter().all(|&id| id == -1));
        let names = read_mask_names(&scene.masks, view).unwrap();
        let at = |x, y| Some(&names.get(&named.mask(Level::CONCEPTS, [y, x])?)?.name[..]);
        // The ceiling is green; the bright square is a roof to this model; the dark one is nothing.
        assert_eq!([at(5, 4), at(108, 30), at(35, 30)], [Some("grass"), Some("roof"), None]);
    }
    // The same with more threads; then nothing is left to do, until there are other nouns.
    scene.make_masks(&other, &[&concepts[..], &["3"]].concat());
    assert_eq!(contents(&scene.masks), contents(&other));
    let again = || scene.make_masks(&other, &[&concepts[..], &["3"]].concat());
    assert!(again().contains("skipped 2 of 2 views: their id maps are done already"));
    std::fs::write(&nouns, "grass").unwrap();
    assert!(!again().contains("done already"));
    scene.make_masks(&both, &[&["--panoptic", path(&export("panoptic-detr"))], &concepts[..], &["2"]].concat());
    let maps = MaskMaps::read(maps_path(&both, "v0")).unwrap();
    let names = read_mask_names(&both, "v0").unwrap();
    let named = |level| names.keys().any(|id| maps.level(level).iter().any(|&i| i == *id as i32));
    assert!(named(Level::CLASSES) && named(Level::CONCEPTS));
    let bad = |args: &[&str], words: &[&str]| {
        let e = error(&scene.masks_args(&other, args));
        assert!(words.iter().all(|w| e.contains(w)), "{e}");
    };
    bad(&["--concepts", path(&scene.folder)], &["sam3_image_encoder.onnx: no such model", "samexporter"]);
    let alone = run(&scene.masks_args(&other, &["--nouns", path(&nouns)]));
    assert!(!alone.status.success() && String::from_utf8_lossy(&alone.stderr).contains("--concepts <FOLDER>"));
    std::fs::write(&nouns, "# none\n").unwrap();
    bad(&[&concepts[..], &["1"]].concat(), &["nouns.txt: too few names; found 0, expected at least 1, one a line"]);
}

/// A folder of an export other than SAM's own.
fn export(name: &str) -> PathBuf {
    Path::new(SAM).with_file_name(name)
}

#[test]
fn other_exports_are_used_as_their_description_says() {
    let scene = Scene::new(1);
    scene.make_masks(&scene.masks, &[]);
    let sam = MaskMaps::read(maps_path(&scene.masks, "v0")).unwrap();
    for name in ["edge-sam", "sam2", "efficient-sam", "sam2-hub", "sam-hub"] {
        let out = scene.masks.with_file_name(name);
        scene.make_masks(&out, &["--sam", path(&export(name))]);
        let maps = MaskMaps::read(maps_path(&out, "v0")).unwrap();
        if name == "edge-sam" {
            assert_eq!(maps, sam, "the same numbers by other names");
        }
        for level in &Level::SAM[1..] {
            let at = |x: usize, y: usize| maps.level(*level)[[y, x]];
            let things = [at(2, 20), at(30, 30), at(76, 44), at(64, 4)];
            assert!(things.iter().all(|&id| id >= 0), "{name}: {things:?}");
            assert_eq!(things.iter().collect::<BTreeSet<_>>().len(), 4, "{name}: {things:?}");
            assert_eq!(at(96, 32) == at(76, 44), *level != Level::SMALL, "{name}");
        }
        // Stretched or not, a thing lies where it lies.
        let dark = maps.level(Level::LARGE)[[30, 30]];
        let square = 16..48;
        let differ =
            |&((y, x), &id): &((usize, usize), &i32)| (id == dark) != (square.contains(&x) && square.contains(&y));
        assert!(maps.level(Level::LARGE).indexed_iter().filter(differ).count() < 140, "{name}");
    }
}

#[test]
fn a_wrong_description_of_an_export_is_refused_before_the_first_view() {
    let scene = Scene::new(1);
    let whole = r#""fit": "stretch", "decoder": "decoder.onnx", "masks": "masks", "pad_point": false"#;
    let all = r#""embeddings": {"image_embed": "image_embed", "high_res_feats_0": "high_res_feats_0", "high_res_feats_1": "high_res_feats_1"}"#;
    let cases = [
        ("sam2", "{".to_string(), "model.json: not a description of SAM's graphs: EOF"),
        ("sam2", r#"{"mode": 1}"#.into(), "unknown field `mode`, expected one of `encoder`, `decoder`"),
        ("sam2", r#"{"fit": "crop"}"#.into(), "unknown variant `crop`, expected `pad` or `stretch`"),
        (
            "sam2",
            r#"{"std": [1, 0, 1]}"#.into(),
            "std: not a usable value; found [1.0, 0.0, 1.0], expected three positive",
        ),
        ("sam2", r#"{"point_frame": -1}"#.into(), "point_frame: not a usable value; found -1, expected 0 to 4096"),
        ("sam2", "{}".into(), "sam.onnx: no such model"),
        ("sam2", r#"{"decoder": "decoder.onnx"}"#.into(), "decoder.onnx: low_res_masks: the model has no such value"),
        ("sam2", format!("{{{whole}}}"), "embeddings: the encoder has several outputs, and nothing says where they go"),
        (
            "sam2",
            format!(r#"{{{whole}, "embeddings": {{"image_embed": "embed"}}}}"#),
            "encoder.onnx: embed: the encoder has no such output; expected high_res_feats_0, high_res_feats_1, image_embed",
        ),
        (
            "sam2",
            format!(r#"{{{whole}, "embeddings": {{"image_embed": "image_embed"}}}}"#),
            "high_res_feats_1: nothing says what this input of the decoder gets",
        ),
        (
            "sam2",
            format!(r#"{{{whole}, {all}, "points": "points"}}"#),
            "decoder.onnx: points: the decoder has no such input; expected image_embed",
        ),
        (
            "sam2",
            format!(r#"{{{whole}, {all}, "points": "mask_input"}}"#),
            "nothing says what this input of the decoder gets",
        ),
        (
            "sam2",
            format!(r#"{{{whole}, {all}, "constants": {{"point_labels": 1}}}}"#),
            "decoder.onnx: point_labels: the input of the decoder is named twice",
        ),
        (
            "sam2",
            format!(r#"{{{whole}, {all}, "constants": {{"has_mask_input": [0, 0]}}}}"#),
            "has_mask_input: the input has another number of values; found 2 in model.json, expected one number",
        ),
        (
            "sam2",
            format!(
                r#"{{{whole}, "embeddings": {{"image_embed": "high_res_feats_0", "high_res_feats_0": "image_embed", "high_res_feats_1": "high_res_feats_1"}}}}"#
            ),
            "decoder.onnx: input high_res_feats_0: the input has another shape",
        ),
        // SAM's own export needs no description; a wrong one is read all the same.
        ("sam", r#"{"masks": "logits"}"#.into(), "sam.onnx: logits: the model has no such value"),
    ];
    for (name, text, expected) in cases {
        let folder = tempfile::tempdir().unwrap();
        for file in std::fs::read_dir(export(name)).unwrap().map(|e| e.unwrap().path()) {
            std::fs::copy(&file, folder.path().join(file.file_name().unwrap())).unwrap();
        }
        std::fs::write(folder.path().join("model.json"), &text).unwrap();
        let e = error(&scene.masks_args(&scene.masks, &["--sam", path(folder.path())]));
        assert!(e.contains(expected), "{text}: {e}");
        assert!(!maps_path(&scene.masks, "v0").exists());
    }
}

#[test]
fn points_within_masks_already_found_are_not_asked() {
    let scene = Scene::new(1);
    let said = scene.make_masks(&scene.masks, &[]);
    assert!(said.contains("of 128 points: within masks already found"), "{said}");
    let manifest = || serde_json::from_slice(&std::fs::read(scene.masks.join("masks.json")).unwrap()).unwrap();
    let asked = |json: &serde_json::Value| json["extra"]["views"]["v0"]["facts"]["asked"].as_u64().unwrap();
    let json: serde_json::Value = manifest();
    assert!(asked(&json) < 48, "{json}");
    // The provenance holds every option that shapes the maps.
    let expected = json!({
        "resolution": "auto", "engine": "rten", "map_size": 800, "min_area": 20,
        "points_per_side": 16, "pred_iou": 0.7, "stability": 0.7, "no_skip": false,
    });
    assert_eq!(json["parameters"], expected);
    scene.make_masks(&scene.masks, &["--no-skip"]);
    assert_eq!(asked(&manifest()), 128);
}

#[test]
fn features_are_those_of_the_crops() {
    let scene = Scene::new(2);
    scene.make_masks(&scene.masks, &[]);
    ok(&scene.embed_args(&[]));
    let maps = MaskMaps::read(maps_path(&scene.masks, "v0")).unwrap();
    let features = MaskFeatures::read(features_path(&scene.masks, "v0")).unwrap();
    assert_eq!(features.values.dim(), (maps.id_count(), 4));
    // The dark square fills its crop: the feature is (mean of each channel, 1), scaled.
    let dark = maps.level(Level::LARGE)[[30, 30]];
    let expected = [20.0, 30.0, 10.0, 255.0].map(|v: f64| v / (400.0f64 + 900.0 + 100.0 + 65025.0).sqrt());
    for (f, e) in features.row(dark as usize).unwrap().iter().zip(expected) {
        assert!((f64::from(*f) - e).abs() < 0.01, "{f} {e}");
    }
    for id in 0..features.values.nrows() {
        let norm: f32 = features.row(id).unwrap().iter().map(|v| v * v).sum();
        assert!((norm - 1.0).abs() < 1e-5);
    }
    // Same bytes with other threads, and nothing to do the second time.
    let first = contents(&scene.masks);
    let said = ok(&scene.embed_args(&[]));
    assert!(said.contains("skipped 2 of 2 views: their features are done already"), "{said}");
    for name in ["v0_f.npy", "v1_f.npy", "v0_f.json", "features.json"] {
        std::fs::remove_file(scene.masks.join(name)).unwrap();
    }
    ok(&scene.embed_args(&["--threads", "1"]));
    assert_eq!(first, contents(&scene.masks));
}

#[test]
fn only_the_masks_of_a_draft_are_encoded_and_what_is_there_stays() {
    let scene = Scene::new(2);
    scene.make_masks(&scene.masks, &[]);
    ok(&scene.embed_args(&[]));
    let all = ["v0", "v1"].map(|v| MaskFeatures::read(features_path(&scene.masks, v)).unwrap());
    let draft = scene.folder.join("draft.safetensors");
    let wants = |masks: &[(u32, u32)], inputs: &[(&str, String)]| {
        let of = |&(view, mask)| Witness { of: 0, view, mask, weight: 1.0 };
        let instances = Instances {
            descriptor: ndarray::Array2::zeros((1, 0)),
            support: vec![1],
            score: vec![1.0],
            count: vec![1],
            centroid: vec![[0.0; 3]],
            bbox_min: vec![[0.0; 3]],
            bbox_max: vec![[0.0; 3]],
            oriented: vec![artifacts::OrientedBox::default()],
            views: vec!["v0".into(), "v1".into()],
            ..Instances::default()
        };
        let of_instances = masks.iter().map(of).collect();
        let draft_of = Draft { instances, of_instances, of_granules: Vec::new(), masks: vec![9, 9] };
        let inputs = inputs.iter().map(|(role, hash)| (role.to_string(), hash.clone())).collect();
        draft_of.write(&draft, gs_io::Provenance { inputs, ..Default::default() }).unwrap();
    };
    let masks = [(artifacts::role::MASKS, artifacts::hash_folder(&scene.masks, "_s.npy").unwrap())];
    let only = ["--only", draft.to_str().unwrap()];
    // All have features already: nothing to do.
    wants(&[(0, 1)], &masks);
    let said = ok(&scene.embed_args(&only));
    assert!(said.contains("skipped 1 of 1 views: their features are done already"), "{said}");
    for v in ["v0", "v1"] {
        std::fs::remove_file(features_path(&scene.masks, v)).unwrap();
    }
    let rows = |found: &MaskFeatures, all: &MaskFeatures, ids: &[usize]| {
        for id in 0..all.values.nrows() {
            let expected = if ids.contains(&id) { all.values.row(id).to_vec() } else { vec![0.0; 4] };
            assert_eq!(found.values.row(id).to_vec(), expected, "{id}");
        }
    };
    ok(&scene.embed_args(&only));
    rows(&MaskFeatures::read(features_path(&scene.masks, "v0")).unwrap(), &all[0], &[1]);
    assert!(!features_path(&scene.masks, "v1").exists(), "no mask of it is wanted");
    // Another list: what is there is kept, and the manifest says what has a feature.
    wants(&[(0, 0), (1, 2)], &masks);
    ok(&scene.embed_args(&only));
    rows(&MaskFeatures::read(features_path(&scene.masks, "v0")).unwrap(), &all[0], &[0, 1]);
    rows(&MaskFeatures::read(features_path(&scene.masks, "v1")).unwrap(), &all[1], &[2]);
    let manifest = std::fs::read_to_string(scene.masks.join("features.json")).unwrap();
    let manifest: serde_json::Value = serde_json::from_str(&manifest).unwrap();
    assert_eq!(manifest["extra"]["views"]["v0"]["facts"]["only"], json!([0, 1]));
    // And all of them after that.
    ok(&scene.embed_args(&[]));
    for (v, all) in ["v0", "v1"].iter().zip(&all) {
        assert_eq!(&MaskFeatures::read(features_path(&scene.masks, v)).unwrap(), all);
    }
    wants(&[(0, 1)], &[(artifacts::role::MASKS, "0".repeat(64))]);
    assert!(error(&scene.embed_args(&only)).contains("another masks"));
    assert!(error(&scene.embed_args(&["--only", path(&scene.masks.join("masks.json"))])).contains("masks.json"));
}

#[test]
fn the_background_is_chosen_and_several_crops_are_averaged() {
    let scene = Scene::new(1);
    scene.make_masks(&scene.masks, &[]);
    let read = |crop: &str| {
        let said = ok(&scene.embed_args(&["--crop", crop]));
        assert!(!said.contains("done already"), "another crop makes other features: {said}");
        let manifest: serde_json::Value =
            serde_json::from_slice(&std::fs::read(scene.masks.join("features.json")).unwrap()).unwrap();
        assert_eq!(manifest["parameters"]["crop"], crop);
        MaskFeatures::read(features_path(&scene.masks, "v0")).unwrap().values
    };
    let (black, mean, near) = (read("black"), read("mean"), read("box20"));
    assert!(black != mean && mean != near && near != black);
    let together = read("black,mean,box20");
    for ((a, b), (c, t)) in black.rows().into_iter().zip(mean.rows()).zip(near.rows().into_iter().zip(together.rows()))
    {
        let sum: Vec<f64> = (0..a.len()).map(|i| [a[i], b[i], c[i]].map(f64::from).iter().sum()).collect();
        let norm = sum.iter().map(|v| v * v).sum::<f64>().sqrt();
        assert!(sum.iter().zip(t).all(|(s, t)| (s / norm - f64::from(*t)).abs() < 1e-6));
    }
    let e = String::from_utf8(run(&scene.embed_args(&["--crop", "black,white"])).stderr).unwrap();
    assert!(e.contains("'white' for '--crop") && e.contains("expected black, mean, or box0 to box200"), "{e}");
    // All of them in one file, those of a mask side by side.
    let out = scene.masks.with_file_name("crops.safetensors");
    let args =
        ["crops", "--scene", path(&scene.folder), "--masks", path(&scene.masks), "--out", path(&out), "--size", "8"];
    ok(&[&args[..], &["--crop", "black,box20"]].concat());
    let written = Artifact::open(&out, mask_embed::crops::CROPS_FORMAT, 1).unwrap();
    let mask = written.tensor::<u32>("mask", &[None]).unwrap();
    assert_eq!(mask.len(), 2 * black.nrows());
    assert!(mask.chunks(2).all(|m| m[0] == m[1]));
}

#[test]
fn crops_are_written_for_training() {
    let scene = Scene::new(2);
    scene.make_masks(&scene.masks, &[]);
    let truth = scene.folder.join("truth");
    let object = TrueObject {
        id: 0,
        name: "red mug".into(),
        class: "mug".into(),
        color: "red".into(),
        background: false,
        parts: vec![TruePart { id: 0, name: "handle".into() }],
    };
    TrueScene { objects: vec![object], parameters: serde_json::Value::Null }.write(truth.join("scene.json")).unwrap();
    let caption = "a photo of a cat".to_string();
    let mask = MaskTruth { level: 1, instances: vec![0], part: Some(0), kind: "part".into(), caption };
    MaskTruth::write_all(truth.join("masks.json"), &BTreeMap::from([("v0".into(), vec![mask])])).unwrap();
    let out = scene.masks.with_file_name("crops.safetensors");
    ok(&["crops", "--scene", path(&scene.folder), "--masks", path(&scene.masks), "--out", path(&out), "--size", "16"]);
    let a = Artifact::open(&out, mask_embed::crops::CROPS_FORMAT, 1).unwrap();
    let view = a.tensor::<u32>("view", &[None]).unwrap();
    let mask = a.tensor::<u32>("mask", &[Some(view.len())]).unwrap();
    let pixels = a.tensor::<u8>("pixels", &[Some(view.len()), Some(3), Some(16), Some(16)]).unwrap();
    assert_eq!(a.provenance().extra["views"], json!(["v0", "v1"]));
    let tokens: BTreeMap<String, Vec<i32>> = serde_json::from_value(a.provenance().extra["tokens"].clone()).unwrap();
    assert_eq!(tokens.keys().collect::<Vec<_>>(), ["a photo of a cat", "mug", "red mug"]);
    assert_eq!(tokens["a photo of a cat"], [320, 1125, 539, 320, 2368]);
    assert_eq!(tokens["red mug"][1..], tokens["mug"]);
    let maps = MaskMaps::read(maps_path(&scene.masks, "v0")).unwrap();
    assert_eq!(view.iter().filter(|&&v| v == 0).count(), maps.id_count());
    let dark = maps.level(Level::LARGE)[[30, 30]] as u32;
    let at = (0..view.len()).find(|&i| view[i] == 0 && mask[i] == dark).unwrap();
    let crop = &pixels[at * 768..(at + 1) * 768];
    assert_eq!([crop[8 * 16 + 8], crop[256 + 8 * 16 + 8], crop[512 + 8 * 16 + 8]], [20, 30, 10]);
}

fn write_grey(p: &Path, width: u32, values: [u16; 2]) {
    let picture = image::ImageBuffer::<image::Luma<u16>, _>::from_raw(width, 2 / width, values.to_vec()).unwrap();
    picture.save(p).unwrap();
}

#[test]
fn label_pictures_become_id_maps() {
    let dir = tempfile::tempdir().unwrap();
    let (labels, out) = (dir.path().join("labels"), dir.path().join("masks"));
    std::fs::create_dir(&labels).unwrap();
    image::GrayImage::from_raw(2, 2, vec![0, 3, 3, 9]).unwrap().save(labels.join("a.b.png")).unwrap();
    for (level, values) in [("default", [1, 0]), ("small", [60000, 700]), ("medium", [0, 0]), ("large", [5, 5])] {
        write_grey(&labels.join(format!("c_{level}.png")), 2, values);
    }
    ok(&["import", "--labels", path(&labels), "--out", path(&out)]);
    let a = MaskMaps::read(maps_path(&out, "a.b")).unwrap();
    assert_eq!(flat(a.ids.view()), [-1, 0, 0, 1, -1, 2, 2, 3, -1, 4, 4, 5, -1, 6, 6, 7]);
    let c = MaskMaps::read(maps_path(&out, "c")).unwrap();
    assert_eq!(flat(c.ids.view()), [0, -1, 2, 1, -1, -1, 3, 3]);
    assert!(out.join("masks.json").exists());

    let import = || error(&["import", "--labels", path(&labels), "--out", path(&out)]);
    write_grey(&labels.join("c_large.png"), 1, [5, 5]);
    assert!(import().contains("c_large.png: the levels of a view differ in size; found 1 x 2, expected 2 x 1"));
    std::fs::remove_file(labels.join("c_large.png")).unwrap();
    assert!(import().contains("c_large.png: the labels of a level are missing"));
    std::fs::write(labels.join("c.png"), "no picture").unwrap();
    assert!(import().contains("labels for all levels and for single ones"));
    for level in ["default", "small", "medium"] {
        std::fs::remove_file(labels.join(format!("c_{level}.png"))).unwrap();
    }
    assert!(import().contains("c.png: not a readable PNG"));
    image::RgbImage::new(2, 1).save(labels.join("c.png")).unwrap();
    assert!(import().contains("c.png: labels in colour; found Rgb8"));
    std::fs::remove_dir_all(&labels).unwrap();
    assert!(import().contains("labels: cannot list"));
    std::fs::create_dir(&labels).unwrap();
    assert!(import().contains("labels: no label pictures"));
    assert_eq!(MaskMaps::read(maps_path(&out, "c")).unwrap(), c, "a good output was overwritten");
    assert!(out.join("masks.json").exists());
}

#[test]
fn bad_input_is_one_line_and_exit_code_2() {
    let scene = Scene::new(2);
    scene.make_masks(&scene.masks, &[]);
    let good = contents(&scene.masks);
    let with = |folder: &Path, sam: &Path, out: &Path| {
        error(&["masks", "--scene", path(folder), "--sam", path(sam), "--out", path(out), "--points-per-side", "4"])
    };
    let dir = tempfile::tempdir().unwrap();
    let none = Vec::new();
    let [encoder, decoder] = ["encoder.onnx", "sam.onnx"].map(|name| std::fs::read(Path::new(SAM).join(name)).unwrap());
    let pointer = b"version https://git-lfs.github.com/spec/v1\n".to_vec();
    // No models; encoder and decoder exchanged; the encoder twice; a decoder that was not fetched.
    for (first, second, part) in [
        (&none, &none, "encoder.onnx: no such model; `make models` fetches it"),
        (&decoder, &encoder, "encoder.onnx: SAM's encoder has one input; found 6"),
        (&encoder, &encoder, "sam.onnx: low_res_masks: the model has no such value"),
        (&encoder, &pointer, "sam.onnx: not an ONNX model"),
    ] {
        for (name, bytes) in [("encoder.onnx", first), ("sam.onnx", second)].iter().filter(|(_, b)| !b.is_empty()) {
            std::fs::write(dir.path().join(name), bytes).unwrap();
        }
        let e = with(&scene.folder, dir.path(), &scene.masks);
        assert!(e.contains(part), "{e}");
    }
    let e = with(&scene.folder.join("none"), SAM.as_ref(), &scene.masks);
    assert!(e.contains("none"), "{e}");
    assert_eq!(good, contents(&scene.masks), "a good output was touched");
    // An output that cannot be written: a file stands where the folder should be.
    let blocked = dir.path().join("blocked");
    std::fs::write(&blocked, "x").unwrap();
    let e = with(&scene.folder, SAM.as_ref(), &blocked.join("masks"));
    assert!(e.contains("cannot create the folder"), "{e}");
    // A photograph cut short: the other view is made, no manifest appears.
    let photo = std::fs::read(scene.folder.join("v1.png")).unwrap();
    std::fs::write(scene.folder.join("v1.png"), &photo[..photo.len() / 2]).unwrap();
    let out = dir.path().join("out");
    let e = with(&scene.folder, SAM.as_ref(), &out);
    assert!(e.contains("v1.png: "), "{e}");
    assert!(out.join("v0_s.npy").exists() && !out.join("v1_s.npy").exists() && !out.join("masks.json").exists());
    std::fs::write(scene.folder.join("v1.png"), &photo).unwrap();

    let embed = |masks: &Path, clip: &Path| {
        error(&["embed", "--scene", path(&scene.folder), "--masks", path(masks), "--clip", path(clip)])
    };
    let e = embed(&scene.masks, dir.path());
    assert!(e.contains("image.onnx: no such model"), "{e}");
    let e = embed(&blocked.with_file_name("empty"), CLIP.as_ref());
    assert!(e.contains("empty: cannot list"), "{e}");
    std::fs::write(maps_path(&scene.masks, "v0"), &good["v0_s.npy"][..500]).unwrap();
    let e = embed(&scene.masks, CLIP.as_ref());
    assert!(e.contains("v0_s.npy: shape: the file's length does not fit its shape"), "{e}");
    // clap's own errors have exit code 2 as well.
    assert_eq!(run(&["masks", "--scene", "x", "--out", "y", "--points-per-side", "0"]).status.code(), Some(2));
}

#[test]
fn id_maps_of_another_shape_are_refused_before_the_first_view() {
    let scene = Scene::new(2);
    scene.make_masks(&scene.masks, &[]);
    let file = maps_path(&scene.masks, "v1");
    let maps = MaskMaps::read(&file).unwrap();
    MaskMaps { ids: maps.ids.permuted_axes([0, 2, 1]) }.write(&file).unwrap();
    let out = scene.masks.with_file_name("out");
    let inputs = ["--scene", path(&scene.folder), "--masks", path(&scene.masks), "--out", path(&out)];
    for command in [&["embed", "--clip", CLIP][..], &["crops"]] {
        let e = error(&[command, &inputs[..]].concat());
        let expected =
            "v1_s.npy: shape: the id map has another shape than the photograph; found 64x128, expected 128x64";
        assert!(e.contains(expected), "{e}");
        assert!(!out.exists());
    }
    // Smaller maps are whole pictures, too.
    MaskMaps { ids: Array3::zeros((4, 32, 64)) }.write(&file).unwrap();
    ok(&[&["embed", "--clip", CLIP], &inputs[..]].concat());
}
