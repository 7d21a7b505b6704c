//! The program and its files, as people and later stages meet them.

use artifacts::{Level, MaskMaps, MaskTruth, TruePoints, TrueScene, maps_path};
use glam::DVec3;
use gs_io::npy;
use gs_scene::dataset::{self, LoadOptions, Split};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;
use synth_scene::write::Options;

fn run(to: &str, out: &Path, arguments: &[&str]) -> Output {
    let mut program = Command::new(env!("CARGO_BIN_EXE_synth-scene"));
    program.arg(to).arg(out).args(["--size", "tiny", "--quiet"]).args(arguments).output().unwrap()
}

fn make(out: &Path, arguments: &[&str]) {
    let o = run("--out", out, arguments);
    assert!(o.status.success(), "{}", String::from_utf8_lossy(&o.stderr));
}

/// What a run says that is refused.
fn refused(out: &Path, arguments: &[&str]) -> String {
    let o = run("--out", out, arguments);
    assert_eq!(o.status.code(), Some(2), "{arguments:?}");
    String::from_utf8_lossy(&o.stderr).trim_end().to_string()
}

/// All files below a folder with their contents, without the records of runs.
fn contents(root: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut all = BTreeMap::new();
    let mut folders = vec![root.to_path_buf()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if !path.to_string_lossy().ends_with(".run.json") {
                all.insert(path.strip_prefix(root).unwrap().to_path_buf(), std::fs::read(&path).unwrap());
            }
        }
    }
    all
}

/// A tiny scene without faults, made once.
fn exact() -> &'static Path {
    static ONCE: OnceLock<tempfile::TempDir> = OnceLock::new();
    ONCE.get_or_init(|| {
        let dir = tempfile::tempdir().unwrap();
        make(dir.path(), &["--seed", "3", "--granularity-p", "0", "--boundary-noise", "0", "--missing", "0"]);
        dir
    })
    .path()
}

fn stem(view: usize) -> String {
    format!("frame_{:05}", view + 1)
}

fn exact_options() -> Options {
    Options { seed: 3, objects: 8, views: 8, width: 160, height: 120, points: 1500, ..Options::default() }
}

#[test]
fn the_same_seed_gives_the_same_bytes_for_any_number_of_threads() {
    let dir = tempfile::tempdir().unwrap();
    let (a, b, c) = (dir.path().join("a"), dir.path().join("b"), dir.path().join("c"));
    make(&a, &["--threads", "1", "--views", "4"]);
    make(&b, &["--threads", "2", "--views", "4"]);
    make(&c, &["--seed", "1", "--views", "4"]);
    let (of_a, of_b, of_c) = (contents(&a), contents(&b), contents(&c));
    assert_eq!(of_a.keys().collect::<Vec<_>>(), of_b.keys().collect::<Vec<_>>());
    for (path, bytes) in &of_a {
        assert!(*bytes == of_b[path], "{}", path.display());
    }
    let differ = |name: &str| of_a[Path::new(name)] != of_c[Path::new(name)];
    assert!(differ("images/frame_00001.png") && differ("sparse/0/points3D.bin") && differ("truth/scene.json"));
}

#[test]
fn a_workshop_has_the_same_bytes_for_any_number_of_threads() {
    let dir = tempfile::tempdir().unwrap();
    let made = |name: &str, threads: &str| {
        let out = dir.path().join(name);
        make(&out, &["--family", "workshop", "--objects", "20", "--views", "2", "--threads", threads]);
        contents(&out)
    };
    assert!(made("a", "1") == made("b", "2"));
}

#[test]
fn an_unfinished_or_older_scene_is_replaced_whole() {
    let dir = tempfile::tempdir().unwrap();
    let (a, b) = (dir.path().join("a"), dir.path().join("b"));
    // As left by a run that was killed: no marker, and files that the next run does not make.
    make(&a, &["--views", "5", "--features"]);
    std::fs::remove_file(a.join("truth/scene.json")).unwrap();
    make(&a, &["--views", "3"]);
    make(&b, &["--views", "3"]);
    assert!(contents(&a) == contents(&b));
}

#[test]
fn a_dataset_of_another_origin_is_left_alone() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::create_dir(dir.path().join("images")).unwrap();
    std::fs::write(dir.path().join("images/holiday.jpg"), "dear").unwrap();
    let said = refused(dir.path(), &[]);
    assert!(said.contains("images/holiday.jpg: the output exists and would be lost"), "{said}");
    assert_eq!(said.lines().count(), 1, "{said}");
    assert_eq!(std::fs::read(dir.path().join("images/holiday.jpg")).unwrap(), b"dear");
}

#[test]
fn bad_options_are_refused_before_anything_is_written() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("scene");
    for (arguments, part) in [
        (["--objects", "61"], "--objects: too many things for a studio; found 61, expected 1 to 60"),
        (["--objects", "0"], "--objects"),
        (["--views", "0"], "--views"),
        (["--width", "8"], "--width"),
        (["--height", "99999"], "--height"),
        (["--points", "0"], "--points"),
        (["--granularity-p", "1.5"], "'1.5' for '--granularity-p <PROBABILITY>': expected 0 to 1"),
        (["--granularity-p", "NaN"], "--granularity-p"),
        (["--missing", "2"], "--missing"),
        (["--boundary-noise", "99"], "--boundary-noise"),
        (["--pose-noise", "11"], "--pose-noise"),
        (["--detail", "1.5"], "--detail"),
    ] {
        let said = refused(&out, &arguments);
        assert!(said.contains(part) && said.contains("expected"), "{said}");
        assert!(!out.exists(), "nothing is begun");
    }
}

#[test]
fn more_memory_than_there_may_be_is_refused_before_an_earlier_scene_goes() {
    let dir = tempfile::tempdir().unwrap();
    make(dir.path(), &["--views", "2"]);
    let before = contents(dir.path());
    let said = refused(dir.path(), &["--views", "3", "--memory-limit", "2M"]);
    assert!(said.contains("--memory-limit") && said.contains("needed") && said.lines().count() == 1, "{said}");
    assert_eq!(contents(dir.path()), before);
}

#[test]
fn a_run_takes_about_the_memory_that_it_forecasts() {
    let dir = tempfile::tempdir().unwrap();
    for (name, options) in [
        ("tiny", &[][..]),
        ("high", &["--views", "2", "--width", "1600", "--height", "1200"]),
        ("room", &["--family", "room", "--views", "6", "--objects", "30", "--width", "240", "--height", "180"]),
    ] {
        make(&dir.path().join(name), &[&["--threads", "2"], options].concat());
        let record = stage::RunRecord::read(dir.path().join(name).join("truth/scene.json")).unwrap();
        let Some(peak) = record.peak_rss_bytes else { return };
        let (forecast, peak) = (record.memory_predicted_bytes.unwrap() as f64, peak as f64);
        // How much of the program itself lies in memory differs from system to system: 20 MB.
        assert!((forecast - peak).abs() < 0.4 * peak + 20e6, "{name}: forecast {forecast}, peak {peak}");
    }
}

#[test]
fn an_output_that_cannot_be_written_is_an_error_of_one_line() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("file");
    std::fs::write(&file, "in the way").unwrap();
    let said = refused(&file.join("scene"), &[]);
    assert!(said.contains("cannot create the folder") && said.lines().count() == 1, "{said}");
    assert_eq!(std::fs::read(&file).unwrap(), b"in the way");
}

#[test]
fn the_scene_reads_back_as_a_colmap_dataset() {
    let data = dataset::load(exact(), &LoadOptions::default()).unwrap();
    assert_eq!(data.views.len(), 8);
    assert_eq!(data.points.positions.len(), 1500);
    assert!(data.warnings.is_empty(), "{:?}", data.warnings);
    assert_eq!(data.views_of(Split::Test).count(), 1);
    let options = exact_options();
    let made = options.cameras(&options.scene());
    for (view, camera) in data.views.iter().zip(&made) {
        assert!((view.camera.position() - camera.position()).length() < 1e-9);
        let p = DVec3::new(0.1, -0.2, 0.8);
        let ((u, v, _), (s, t, _)) = (view.camera.project(p), camera.project(p));
        assert!((u - s).abs() < 1e-6 && (v - t).abs() < 1e-6);
        let image = view.load_image().unwrap();
        assert_eq!((image.width, image.height), (160, 120));
        let mean = image.rgb.iter().sum::<f32>() / image.rgb.len() as f32;
        assert!((0.2..0.8).contains(&mean), "neither dark nor blown out: {mean}");
    }
}

#[test]
fn true_points_show_where_the_instance_maps_say() {
    let root = exact();
    let options = exact_options();
    let scene = options.scene();
    let points = TruePoints::read(root.join("truth/points.safetensors")).unwrap();
    let data = dataset::load(root, &LoadOptions::default()).unwrap();
    let classes = scene.classes();
    let maps: Vec<ndarray::ArrayD<f32>> = data
        .views
        .iter()
        .map(|v| npy::read_f32(root.join("truth/views").join(format!("{}.npy", v.stem()))).unwrap())
        .collect();
    let (mut right, mut seen) = (0, 0);
    for i in (0..points.position.len()).step_by(7) {
        let p = DVec3::from_array(points.position[i].map(f64::from));
        let thing = scene.parts[points.part[i] as usize].thing;
        assert_eq!(thing as i32, points.instance[i]);
        assert_eq!(classes[points.class[i] as usize], scene.things[thing as usize].class);
        let mut views = 0;
        for (view, map) in data.views.iter().zip(&maps) {
            let (u, v, z) = view.camera.project(p);
            if z <= 0.0 || !(0.0..160.0).contains(&u) || !(0.0..120.0).contains(&v) {
                continue;
            }
            let eye = view.camera.position();
            let hit = scene.trace(eye, (p - eye).normalize(), 0.0).unwrap();
            if (hit.t - (p - eye).length()).abs() < 1e-4 {
                views += 1;
                right += usize::from(map[[v as usize, u as usize]] == points.instance[i] as f32);
            }
        }
        assert!(views > 0, "point {i} is seen by no view");
        seen += views;
    }
    // A point may fall into a pixel whose centre shows its neighbour.
    assert!(seen > 1000 && right as f64 > 0.97 * seen as f64, "{right} of {seen}");
}

#[test]
fn without_faults_large_masks_are_the_true_instances() {
    let root = exact();
    let truth = TrueScene::read(root.join("truth/scene.json")).unwrap();
    let masks = MaskTruth::read_all(root.join("truth/masks.json")).unwrap();
    assert_eq!(truth.objects.iter().filter(|o| !o.background).count(), 8);
    assert_eq!(masks.len(), 8);
    for v in 0..8 {
        let maps = MaskMaps::read(maps_path(root.join("language_features"), &stem(v))).unwrap();
        let shown = &masks[&stem(v)];
        assert_eq!(maps.id_count(), shown.len());
        // Labels are given for training and held-out views.
        assert_eq!(root.join("label").join(stem(v)).with_extension("json").exists(), v % 4 == 0);
        let view = npy::read_f32(root.join("truth/views").join(format!("{}.npy", stem(v)))).unwrap();
        assert_eq!(view.shape(), [120, 160]);
        let mut pairs = BTreeSet::new();
        for (&id, &instance) in maps.level(Level::LARGE).iter().zip(&view) {
            assert!(instance >= 0.0, "rooms are closed");
            if id >= 0 {
                pairs.insert((id, instance as u32));
                assert_eq!(shown[id as usize].caption, truth.objects[instance as usize].name);
            }
        }
        let ids: BTreeSet<i32> = pairs.iter().map(|p| p.0).collect();
        assert_eq!(ids.len(), pairs.len(), "a mask shows one thing");
    }
}

fn names(all: &BTreeMap<PathBuf, Vec<u8>>, folder: &str) -> BTreeMap<PathBuf, Vec<u8>> {
    let within = |(p, b): (&PathBuf, &Vec<u8>)| Some((p.strip_prefix(folder).ok()?.to_path_buf(), b.clone()));
    all.iter().filter_map(within).collect()
}

const SMALL: [&str; 8] = ["--objects", "4", "--views", "2", "--width", "80", "--height", "60"];

/// Options that set every fault.
const ALL: [&str; 7] = ["--corruption", "sam", "--features", "--pose-noise", "0.2", "--views", "3"];

#[test]
fn masks_alone_are_those_of_the_full_run() {
    let dir = tempfile::tempdir().unwrap();
    let (full, alone) = (dir.path().join("full"), dir.path().join("alone"));
    make(&full, &ALL);
    let masks = |arguments: &[&str]| run("--masks-to", &alone, arguments);
    // Masks of an earlier run with more views leave nothing behind.
    assert!(masks(&["--views", "4"]).status.success());
    assert!(masks(&ALL).status.success());
    let (full, alone_files) = (contents(&full), contents(&alone));
    let mut expected = names(&full, "language_features");
    expected.insert("masks.json".into(), full[Path::new("truth/masks.json")].clone());
    expected.insert("text_features.json".into(), full[Path::new("truth/text_features.json")].clone());
    assert_eq!(alone_files.keys().collect::<Vec<_>>(), expected.keys().collect::<Vec<_>>());
    assert!(alone_files == expected, "the same bytes");
    // What is not synthetic masks is left alone.
    std::fs::write(alone.join("masks.json"), r#"{"photographs": 7}"#).unwrap();
    let o = masks(&ALL);
    let said = String::from_utf8_lossy(&o.stderr);
    assert_eq!(o.status.code(), Some(2));
    assert!(said.contains("masks.json: the output exists and would be lost") && said.lines().count() == 1, "{said}");
}

/// Which folders of a scene each fault, and detail, may change.
#[test]
fn each_fault_changes_its_own_files_and_nothing_else() {
    let dir = tempfile::tempdir().unwrap();
    let with = |name: &str, arguments: &[&str]| {
        let out = dir.path().join(name);
        let exact = if arguments.contains(&"--corruption") { &[][..] } else { &["--corruption", "exact"] };
        let all = [exact, &["--features"], &SMALL[..], arguments].concat();
        make(&out, &all);
        contents(&out)
    };
    let exact = with("exact", &[]);
    let maps = ["language_features", "truth/masks.json", "truth/scene.json"];
    let edges = ["language_features", "truth/scene.json"];
    let poses = ["sparse/0/images.bin", "truth/scene.json", "truth/sparse"];
    let looks = ["images/frame", "sparse/0/points3D.bin", "truth/scene.json"];
    for (option, value, may) in [
        ("--granularity-p", "1", &maps[..]),
        ("--boundary-noise", "2", &edges),
        ("--missing", "0.5", &maps),
        ("--corruption", "sam", &maps),
        ("--pose-noise", "0.5", &poses),
        ("--detail", "1", &looks),
    ] {
        let changed = with(option, &[option, value]);
        let differs: BTreeSet<&PathBuf> =
            exact.keys().chain(changed.keys()).filter(|&p| exact.get(p) != changed.get(p)).collect();
        for path in differs.iter().map(|p| p.to_string_lossy()) {
            // Points carry the parameters that made them, no more.
            let allowed = path == "truth/points.safetensors" || may.iter().any(|m| path.contains(m));
            assert!(allowed, "{option} changes {path}");
        }
        for m in may {
            assert!(differs.iter().any(|p| p.to_string_lossy().contains(m)), "{option} does not change {m}");
        }
        let points = |name: &str| TruePoints::read(dir.path().join(name).join("truth/points.safetensors")).unwrap();
        assert_eq!(points("exact"), points(option));
    }
}

#[test]
fn a_corruption_sets_every_fault_and_an_option_replaces_one() {
    let dir = tempfile::tempdir().unwrap();
    let parameters = |name: &str, arguments: &[&str]| {
        let out = dir.path().join(name);
        make(&out, &[&SMALL[..], arguments].concat());
        TrueScene::read(out.join("truth/scene.json")).unwrap().parameters
    };
    let sam = parameters("sam", &["--corruption", "sam", "--features", "--missing", "0.2"]);
    let values = [("granularity_p", 0.1), ("boundary_noise", 2.0), ("missing", 0.2), ("spurious", 0.15)];
    for (name, value) in values.into_iter().chain([("torn", 1.0), ("swallow", 0.35)]) {
        assert_eq!(sam[name].as_f64(), Some(value), "{name}");
    }
    assert_eq!(sam["features"], serde_json::json!({"language": "words", "leaking": 0.1, "noise": 0.5}));
    let mild = parameters("mild", &[]);
    assert_eq!((mild["granularity_p"].as_f64(), mild["spurious"].as_f64()), (Some(0.3), Some(0.0)));
    assert!(mild["features"].is_null());
    assert!(mild.get("torn").is_none() && mild.get("swallow").is_none(), "as before there were such faults");
}

#[test]
fn families_are_written_whole_and_rooms_as_scans_too() {
    let dir = tempfile::tempdir().unwrap();
    for family in ["table", "kitchen", "workshop", "room"] {
        let out = dir.path().join("scene");
        make(&out, &[&["--family", family], &SMALL[..]].concat());
        let truth = TrueScene::read(out.join("truth/scene.json")).unwrap();
        assert_eq!(truth.parameters["family"], family);
        assert_eq!(truth.objects.iter().filter(|o| !o.background).count(), 4);
        let data = dataset::load(&out, &LoadOptions::default()).unwrap();
        assert!(data.warnings.is_empty() && data.views.len() == 2, "{:?}", data.warnings);
        // The scan of an earlier room does not outlive it.
        assert_eq!(out.join("scan").exists(), family == "room");
    }
    let scan = dir.path().join("scene/scan/scene0000_00_vh_clean_2.labels.ply");
    let (at, _) = gs_scene::ply::read_labels(&scan, "label", [0.0; 3]).unwrap();
    assert_eq!(at, TruePoints::read(dir.path().join("scene/truth/points.safetensors")).unwrap().position);
    make(&dir.path().join("scene"), &SMALL);
    assert!(!dir.path().join("scene/scan").exists());
    assert!(
        refused(&dir.path().join("many"), &["--family", "table", "--objects", "251"]).contains("expected 1 to 250")
    );
}

#[test]
fn miniatures_of_the_benchmarks_read_as_what_they_are() {
    let dir = tempfile::tempdir().unwrap();
    let options = ["--views", "6", "--objects", "6", "--points", "900", "--family", "room", "--features"];
    let folder = |name: &str, layout: &str| {
        let out = dir.path().join(layout).join(name);
        make(&out, &[&options[..], &["--layout", layout]].concat());
        // Made anew over itself, and over another layout, the same files lie there.
        let first = contents(&out);
        make(&out, &options);
        make(&out, &[&options[..], &["--layout", layout]].concat());
        assert!(first == contents(&out), "{layout}");
        out
    };
    let lerf = folder("teatime", "lerf-ovs");
    let data = dataset::load(&lerf, &LoadOptions::default()).unwrap();
    assert_eq!((data.format, data.views.len()), (dataset::Format::Colmap, 6));
    let labels: BTreeSet<String> = contents(&dir.path().join("lerf-ovs/label/teatime"))
        .keys()
        .map(|p| p.file_stem().unwrap().to_string_lossy().into_owned())
        .collect();
    assert_eq!(labels.len(), 6, "teatime has six frames that are scored");
    assert!(data.views.iter().all(|v| labels.contains(v.stem())) && labels.contains("frame_00140"));
    let truth = TrueScene::read(lerf.join("truth/scene.json")).unwrap();
    let names: Vec<&str> = truth.objects.iter().filter(|o| !o.background).map(|o| o.name.as_str()).collect();
    assert!(names.contains(&"stuffed bear") && names.contains(&"coffee mug"), "{names:?}");

    let table: BTreeMap<String, Vec<f32>> =
        serde_json::from_slice(&std::fs::read(lerf.join("truth/text_features.json")).unwrap()).unwrap();
    let queries: BTreeSet<&str> = artifacts::LERF_OVS.iter().flat_map(|s| s.queries).copied().collect();
    assert!(queries.iter().all(|q| table.contains_key(*q)), "one table serves all scenes");

    let scan = folder("scene0062_00", "scannet");
    let converted = folder("scene0062_00", "opengaussian");
    let one = LoadOptions { holdout: 0, ..LoadOptions::default() };
    let (a, b) = (dataset::load(&scan, &one).unwrap(), dataset::load(&converted, &one).unwrap());
    assert_eq!((a.format, b.format), (dataset::Format::ScanNet, dataset::Format::Transforms));
    let (vertices, _) =
        gs_scene::ply::read_labels(scan.join("scene0062_00_vh_clean_2.labels.ply"), "label", [0.0; 3]).unwrap();
    assert!(vertices.len() == 900 && a.points.positions == vertices && b.points.positions == vertices);
    assert!(!converted.join("scene0062_00_vh_clean_2.ply").exists());
    for (stem, view) in ["0", "20", "40", "60", "80", "100"].iter().zip(&a.views) {
        let same = b.views.iter().find(|v| v.stem() == *stem).unwrap();
        assert_eq!((view.stem(), view.split), (*stem, Split::Train));
        assert!((view.camera.position() - same.camera.position()).length() < 1e-6);
        let p = DVec3::new(0.1, -0.2, 0.8);
        assert!((view.camera.to_camera(p) - same.camera.to_camera(p)).length() < 1e-6);
        let maps = MaskMaps::read(maps_path(scan.join("language_features"), stem)).unwrap();
        assert!(maps.id_count() > 0);
    }

    let said = refused(&dir.path().join("kitchen"), &["--layout", "lerf-ovs"]);
    assert!(said.contains("the folder's name is none of the benchmark's"));
}
