//! The program on a small scene on disk: instances and descriptors, the same bytes for any thread count, and bad input.

use artifacts::{
    Draft, Features, FootprintsBuilder, Graph, Health, Instances, MaskFeatures, MaskMaps, Row, hash_folder, role,
};
use glam::DVec3;
use gs_io::{Artifact, Provenance, hash_file};
use gs_scene::dataset::{self, LoadOptions, Resolution};
use gs_scene::splat::{self, Extra};
use gs_scene::{Camera, Gaussians, Image, ply};
use ndarray::{Array2, Array3, arr2, aview1};
use serde_json::{Value, json};
use stage::RunRecord;
use std::ops::Range;
use std::path::PathBuf;
use std::process::{Command, Output};

const SIZE: usize = 48;
const VIEWS: usize = 4;
/// Gaussians of each of the two things; one more lies behind every camera.
const EACH: usize = 40;

fn gaussians() -> Gaussians {
    let mut g = Gaussians::default();
    for i in 0..2 * EACH {
        let side = if i < EACH { -0.6 } else { 0.6 };
        let (a, b) = ((i % 5) as f32, (i % EACH / 5) as f32);
        g.means.push([side + a * 0.08 - 0.16, b * 0.1 - 0.35, (i % 3) as f32 * 0.15]);
    }
    g.means.push([-0.5, 0.0, -50.0]);
    let n = g.means.len();
    g.log_scales = vec![[-2.3; 3]; n];
    g.rotations = vec![[1.0, 0.0, 0.0, 0.0]; n];
    g.opacity_logits = vec![4.0; n];
    g.sh = (0..3 * n).map(|i| (i % 7) as f32 * 0.1).collect();
    g
}

/// A scene with all that cluster-match reads, and where it writes.
struct Scene {
    _dir: tempfile::TempDir,
    root: PathBuf,
}

impl Scene {
    fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let s = Self { root: dir.path().to_path_buf(), _dir: dir };
        for folder in ["images", "masks", "out"] {
            std::fs::create_dir_all(s.path(folder)).unwrap();
        }
        let mut frames = Vec::new();
        for v in 0..VIEWS {
            let eye = DVec3::new(v as f64 * 0.1 - 0.15, -0.1, -3.0);
            let c = Camera::look_at(eye, DVec3::ZERO, DVec3::NEG_Y, SIZE as u32, SIZE as u32, 0.9);
            frames.push((format!("images/v{v}.png"), c));
            let (w, n) = (SIZE as u32, SIZE * SIZE);
            Image { width: w, height: w, rgb: vec![0.5; 3 * n], alpha: None }
                .write_png(s.path(&format!("images/v{v}.png")))
                .unwrap();
        }
        dataset::write_transforms(&s.path("transforms.json"), &frames, [0.0; 3]).unwrap();
        ply::write_gaussians(s.path("geometry.ply"), &gaussians(), &[]).unwrap();
        for v in 0..VIEWS {
            s.masks(v, &s.seen(v));
        }
        s.artifacts(|_| {});
        s
    }

    fn path(&self, name: &str) -> PathBuf {
        self.root.join(name)
    }

    /// Which thing each pixel of a view shows: 0, 1, or -1.
    fn seen(&self, view: usize) -> Vec<i32> {
        let camera = &self.dataset().views[view].camera;
        let things = [0..EACH as u32, EACH as u32..2 * EACH as u32].map(|own| {
            let thing = gaussians().select(&own.collect::<Vec<_>>());
            gs_raster::render(&thing, camera, &gs_raster::RasterOptions::default()).alpha
        });
        let shown = |p: usize| things.iter().position(|alpha| alpha[p] > 0.5);
        (0..SIZE * SIZE).map(|p| shown(p).map_or(-1, |thing| thing as i32)).collect()
    }

    /// Id maps of a view: the two things on the large level (ids 3 and 4), both as one on the others (ids 0 to 2).
    fn masks(&self, view: usize, seen: &[i32]) {
        let both = |id: i32| seen.iter().map(move |&s| if s < 0 { -1 } else { id });
        let large = seen.iter().map(|&s| if s < 0 { -1 } else { 3 + s });
        let ids = both(0).chain(both(1)).chain(both(2)).chain(large).collect();
        let ids = Array3::from_shape_vec((4, SIZE, SIZE), ids).unwrap();
        MaskMaps { ids }.write(self.path(&format!("masks/v{view}_s.npy"))).unwrap();
    }

    /// Language features: things at right angles to each other, slightly different in each view.
    fn language(&self, views: Range<usize>) {
        for v in views {
            let both = [0.6, 0.6, 0.5];
            let values = arr2(&[both, both, both, [1.0, 0.0, 0.1 * v as f32], [0.0, 2.0, 0.0]]);
            MaskFeatures { values }.write(self.path(&format!("masks/v{v}_f.npy"))).unwrap();
        }
    }

    fn dataset(&self) -> dataset::Dataset {
        dataset::load(&self.root, &LoadOptions { resolution: Resolution::Divisor(1.0), holdout: 0 }).unwrap()
    }

    /// Writes graph, footprints and features; `change` may change the features first.
    fn artifacts(&self, change: impl Fn(&mut Features)) {
        self.artifacts_with(&[], change);
    }

    /// The same, with `small` masks in every view.
    fn artifacts_with(&self, small: &[Range<usize>], change: impl Fn(&mut Features)) {
        let n = 2 * EACH;
        let means = gaussians().means;
        let near = |i: usize| -> [u32; 8] {
            let square = |j: usize| (0..3).map(|k| (means[i][k] - means[j][k]).powi(2)).sum::<f32>();
            let mut others: Vec<usize> = (0..n).filter(|&j| j != i).collect();
            others.sort_by(|&a, &b| square(a).total_cmp(&square(b)).then(a.cmp(&b)));
            std::array::from_fn(|k| others[k] as u32)
        };
        let mut seen_views = vec![VIEWS as u32; n + 1];
        seen_views[n] = 0;
        let graph = Graph {
            kept: (0..n as u32).collect(),
            anchors: vec![0],
            nearest_anchor: vec![0; n],
            gaussian_knn: (0..n).map(near).collect::<Vec<_>>().into(),
            seen_weight: seen_views.iter().map(|&v| v as f32).collect(),
            seen_views,
            ..Graph::default()
        };
        let views = (0..VIEWS).map(|v| format!("v{v}")).collect();
        let mut footprints = FootprintsBuilder { views, kept: graph.kept.clone(), ..FootprintsBuilder::default() };
        // As the id maps have it: both things in one medium mask, each in its large one.
        for view in 0..VIEWS as u32 {
            let small = small.iter().map(|own| (1, 1, own.clone()));
            for (level, mask, own) in small.chain([(2, 2, 0..n), (3, 3, 0..EACH), (3, 4, EACH..n)]) {
                let row = Row { view, level, mask, pixels: 50, gated: 50, alpha: 1.0 };
                footprints.push(row, own.map(|i| (i as u32, 1.0)));
            }
        }
        let value = |i: usize| {
            let noise = |k: usize| ((i * 31 + k * 17) % 23) as f32 * 0.004;
            if i < EACH { [1.0, noise(1), noise(2)] } else { [noise(3), 1.0, noise(4)] }
        };
        let values = (0..n).map(value).collect::<Vec<_>>().into();
        let mut features = Features { kept: graph.kept.clone(), values };
        change(&mut features);
        self.write(&graph, &footprints, &features);
    }

    fn write(&self, graph: &Graph, footprints: &FootprintsBuilder, features: &Features) {
        let provenance = |inputs: &[(&str, String)]| Provenance {
            parameters: json!({"holdout": 0}),
            inputs: inputs.iter().map(|(role, hash)| ((*role).to_string(), hash.clone())).collect(),
            ..Provenance::default()
        };
        let origin = provenance(&[
            (role::GEOMETRY, hash_file(self.path("geometry.ply")).unwrap()),
            (role::DATASET, self.dataset().hash().unwrap()),
            (role::MASKS, hash_folder(self.path("masks"), "_s.npy").unwrap()),
        ]);
        let [to_graph, to_footprints] = ["graph.safetensors", "footprints.safetensors"].map(|name| self.path(name));
        graph.write(&to_graph, origin.clone()).unwrap();
        footprints.write(&to_footprints, origin).unwrap();
        let hash = |path, format: &str| Artifact::open(path, format, 1).unwrap().hash().to_string();
        let inputs =
            [(role::GRAPH, hash(to_graph, Graph::FORMAT)), (role::FOOTPRINTS, hash(to_footprints, "footprints"))];
        features.write(self.path("features.safetensors"), provenance(&inputs)).unwrap();
    }

    fn run(&self, extra: &[&str]) -> Output {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cluster-match"));
        command.arg("--scene").arg(&self.root);
        if !extra.contains(&"--out") {
            command.arg("--out").arg(self.path("out/instances.safetensors"));
        }
        for (option, file) in [
            ("--geometry", "geometry.ply"),
            ("--graph", "graph.safetensors"),
            ("--footprints", "footprints.safetensors"),
            ("--features", "features.safetensors"),
            ("--masks", "masks"),
        ] {
            command.arg(option).arg(self.path(file));
        }
        if !extra.contains(&"--min-cluster-size") {
            command.args(["--min-cluster-size", "8"]);
        }
        command.args(extra).output().unwrap()
    }

    /// Runs without features.
    fn run_without(&self, extra: &[&str]) -> Output {
        let mut command = Command::new(env!("CARGO_BIN_EXE_cluster-match"));
        command.arg("--scene").arg(&self.root).args(["--min-cluster-size", "8"]);
        for file in
            ["out/instances.safetensors", "geometry.ply", "graph.safetensors", "footprints.safetensors", "masks"]
        {
            let option = if file.starts_with("out") { "out" } else { file.split('.').next().unwrap() };
            command.arg(format!("--{option}")).arg(self.path(file));
        }
        command.args(extra).output().unwrap()
    }

    fn succeed(&self, extra: &[&str]) -> (Instances, String) {
        let out = self.run(extra);
        let said = String::from_utf8_lossy(&out.stderr).into_owned();
        assert!(out.status.success(), "{said}");
        (Instances::read(self.path("out/instances.safetensors")).unwrap().0, said)
    }

    /// Runs, and expects exit code 2, one line with all `needles`, and old outputs as they were.
    fn fail(&self, extra: &[&str], needles: &[&str]) {
        let out = self.path("out/instances.safetensors");
        std::fs::write(&out, "good").unwrap();
        let o = self.run(&[extra, &["--overwrite"]].concat());
        let said = String::from_utf8_lossy(&o.stderr).into_owned();
        assert_eq!(o.status.code(), Some(2), "{said}");
        for needle in needles {
            assert!(said.contains(needle), "{needle:?} is not in {said:?}");
        }
        let errors: Vec<&str> = said.lines().filter(|l| l.starts_with("cluster-match: error: ")).collect();
        assert_eq!((errors.len(), said.contains("panicked")), (1, false), "{said}");
        assert_eq!(std::fs::read(&out).unwrap(), b"good");
        std::fs::remove_file(&out).unwrap();
    }
}

/// The two things' instances, by label.
fn things(i: &Instances) -> (usize, usize) {
    let (a, b) = (i.label[0], i.label[EACH]);
    assert!(a >= 0 && b >= 0 && a != b, "{:?}", i.label);
    assert!(
        i.label[..EACH].iter().all(|&l| l == a) && i.label[EACH..2 * EACH].iter().all(|&l| l == b),
        "{:?}",
        i.label
    );
    (a as usize, b as usize)
}

#[test]
fn instances_are_found_matched_and_described_the_same_for_any_number_of_threads() {
    let s = Scene::new();
    s.language(0..VIEWS);
    let (i, said) = s.succeed(&["--threads", "1"]);
    assert!(said.contains("2 instances among 80 Gaussians") && said.contains("skipped 1 of 81 Gaussians"), "{said}");
    let (a, b) = things(&i);
    // The one that no view sees has the label of what is nearest.
    assert_eq!((i.len(), i.label[2 * EACH]), (2, a as i32));
    assert_eq!((i.support[a], i.support[b], i.dim()), (VIEWS as u32, VIEWS as u32, 3));
    assert!(i.score[a] > 0.5 && i.score[b] > 0.5);
    assert!(i.matches.iter().all(|m| m.mask == if m.instance as usize == a { 3 } else { 4 }), "{:?}", i.matches);
    assert_eq!(i.count[a] + i.count[b], 81);
    assert!(i.centroid[b][0] > 0.4 && i.bbox_min[b][0] > 0.3 && i.bbox_max[b][0] < 0.9);
    // Mean of unit features (1, 0, 0.1 v), made a unit again; the other is (0, 1, 0) in every view.
    let mut mean = [0.0f64; 3];
    for v in 0..VIEWS {
        let length = (1.0 + (0.1 * v as f64).powi(2)).sqrt();
        (mean[0], mean[2]) = (mean[0] + 1.0 / length, mean[2] + 0.1 * v as f64 / length);
    }
    let length = mean.iter().map(|v| v * v).sum::<f64>().sqrt();
    for (found, expected) in i.descriptor_of(a).iter().zip(mean) {
        assert!((f64::from(*found) - expected / length).abs() < 1e-6);
    }
    assert_eq!(i.descriptor_of(b), aview1(&[0.0, 1.0, 0.0]));
    assert_eq!(i.tree.iter().filter(|e| e.instance >= 0).count(), 2);

    // Beside it: the Gaussians as they were with their instances, labels, and a text.
    assert_eq!(ply::read_gaussians(s.path("out/instances.ply")).unwrap(), gaussians());
    let file = std::fs::read(s.path("out/instances.ply")).unwrap();
    let header = file.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    assert!(String::from_utf8_lossy(&file[..header]).contains("property int instance\n"));
    let rows = file[header..].chunks_exact((file.len() - header) / i.label.len());
    let written: Vec<i32> = rows.map(|r| i32::from_le_bytes(*r.last_chunk().unwrap())).collect();
    assert_eq!(written, i.label);
    let labels = gs_io::npy::read_f32(s.path("out/instances.labels.npy")).unwrap();
    assert!(labels.iter().zip(&i.label).all(|(a, b)| *a == *b as f32) && labels.shape() == [81]);
    let text: Value = serde_json::from_slice(&std::fs::read(s.path("out/instances.json")).unwrap()).unwrap();
    assert_eq!(text["instances"].as_array().unwrap().len(), 2);
    assert_eq!(text["instances"][b]["matches"][1]["view"], "v1");
    // How sound it is, said, listed and kept for the report.
    let health = Health::of(&Instances::read(s.path("out/instances.safetensors")).unwrap().1).unwrap().unwrap();
    assert_eq!(text["health"], json!(health));
    let largest = f64::from(i.count[a].max(i.count[b])) / 81.0;
    assert!(health.largest == largest && health.purity == Some(0.75), "{health:?}");
    assert!(said.contains("of the Gaussians in the largest instance; "), "{said}");
    // Where it stands in the tree: its cluster holds its Gaussians, and above it is only the whole scene.
    for k in [a, b] {
        let own = i.family(k).unwrap().own;
        let members: Vec<u32> = (0..81).filter(|&g| i.label[g as usize] == k as i32).collect();
        assert_eq!((own.len(), i.gaussians_of_cluster(own[0])), (1, members));
        let listed = &text["instances"][k];
        assert_eq!((&listed["clusters"], &listed["parent"]), (&json!(own), &Value::Null));
    }

    let outputs = || {
        ["safetensors", "ply", "labels.npy", "json"]
            .map(|e| std::fs::read(s.path(&format!("out/instances.{e}"))).unwrap())
    };
    let first = outputs();
    s.succeed(&["--threads", "2"]);
    assert!(first == outputs(), "the number of threads changes the outputs");
}

#[test]
fn the_provenance_holds_every_option_and_the_forecast_is_near_the_peak() {
    let s = Scene::new();
    s.succeed(&["--cluster", "free"]);
    let (_, a) = Instances::read(s.path("out/instances.safetensors")).unwrap();
    let expected = json!({
        "cluster": "free", "agreement": 0.18, "min_cluster_size": 8, "min_samples": 10, "epsilon": 0.0,
        "allow_single_cluster": false, "join": 0.0, "votes": 0, "split": 0.0, "levels": ["large"],
        "granules": 0, "describe_views": 0,
    });
    assert_eq!(a.provenance().parameters, expected);
    let record = RunRecord::read(s.path("out/instances.safetensors")).unwrap();
    if let (Some(forecast), Some(peak)) = (record.memory_predicted_bytes, record.peak_rss_bytes) {
        let (forecast, peak) = (forecast as f64, peak as f64);
        // How much of the program itself lies in memory differs from system to system: 20 MB.
        assert!((forecast - peak).abs() < 0.5 * peak + 20e6, "forecast {forecast}, peak {peak}");
    }
}

#[test]
fn parts_that_are_small_beside_their_instance_leave_it() {
    const SMALL: Range<usize> = 0..10;
    let s = Scene::new();
    s.artifacts_with(&[SMALL, 10..EACH, EACH..2 * EACH], |_| {});
    // Small masks alone would part it in the first place.
    let levels = ["--levels", "small,medium,large", "--agreement", "0"];
    let whole = s.succeed(&[&levels[..], &["--split", "0"]].concat()).0;
    let (i, said) = s.succeed(&[&levels[..], &["--split", "0.3"]].concat());
    assert!(whole.len() == 2 && i.len() == 3 && said.contains("1 small things within others"), "{said}");
    for (at, (&before, &after)) in whole.label.iter().zip(&i.label).enumerate().take(2 * EACH) {
        assert_eq!(after, if SMALL.contains(&at) { 2 } else { before }, "{at}");
    }
    // It is a part of what it was in.
    let family = i.family(2).unwrap();
    assert_eq!(family.parent, Some(i.family(whole.label[0] as usize).unwrap().own[0]));
    assert_eq!(i.gaussians_of_cluster(family.own[0]), SMALL.map(|i| i as u32).collect::<Vec<_>>());
    // Larger than that share, it stays.
    assert_eq!(s.succeed(&levels).0.len(), 2);
}

#[test]
fn options_do_what_they_say() {
    let s = Scene::new();
    for extra in [
        &["--cluster", "free", "--min-samples", "5"][..],
        &["--cluster", "graph", "--epsilon", "0.3", "--min-samples", "4"],
        &["--cluster", "graph", "--votes", "0", "--join", "0"],
        &["--votes", "8", "--join", "0"],
    ] {
        let (i, said) = s.succeed(extra);
        things(&i);
        assert_eq!(i.support, [VIEWS as u32; 2], "{extra:?}");
        // Without language the rest is there, and it is said.
        assert!(i.dim() == 0 && i.descriptor.is_empty() && said.contains("skipped language descriptors"), "{said}");
    }
    // Another level: one mask for both things, which each covers half of, or the best of two levels.
    let graph = ["--levels", "medium", "--cluster", "graph"];
    let (i, _) = s.succeed(&[&graph[..], &["--join", "0"]].concat());
    assert!(i.matches.iter().all(|m| m.mask == 2 && m.score < 0.7) && !i.matches.is_empty());
    // What masks show as one is joined.
    let (i, said) = s.succeed(&graph);
    assert!(i.len() == 1 && i.label.iter().all(|&l| l == 0) && said.contains("1 instances after joining"), "{said}");
    assert!(i.tree.iter().all(|e| e.instance <= 0));
    let (i, said) = s.succeed(&["--levels", "medium"]);
    assert!(i.len() == 1 && i.label.iter().all(|&l| l == 0), "{said}");
    let (i, said) = s.succeed(&["--levels", "medium", "--cluster", "free", "--min-samples", "5"]);
    assert!(i.len() == 2, "{said}");
    let (i, _) = s.succeed(&["--levels", "medium", "--cluster", "free", "--min-samples", "5", "--join", "0.5"]);
    assert_eq!(i.len(), 1, "joined where that is asked for");
    let (i, _) = s.succeed(&["--levels", "medium,large"]);
    assert!(i.matches.len() == 2 * VIEWS && i.matches.iter().all(|m| m.mask >= 3));

    // Noise: a Gaussian that is like neither thing gets the instance of its nearest neighbour.
    s.artifacts(|f| f.values.row_mut(0).assign(&aview1(&[-4.0, -4.0, 0.0])));
    things(&s.succeed(&["--cluster", "free", "--min-samples", "5"]).0);
}

#[test]
fn features_are_read_where_they_are_clustered() {
    let s = Scene::new();
    let with = s.succeed(&[]).0;
    let out = s.run_without(&["--overwrite"]);
    assert!(out.status.success(), "{}", String::from_utf8_lossy(&out.stderr));
    let without = Instances::read(s.path("out/instances.safetensors")).unwrap().0;
    assert!(with == without && !without.matches.is_empty());
    assert!(s.succeed(&["--overwrite"]).1.contains("skipped --features: clustering by the masks does not read them"));
    for space in ["free", "graph"] {
        let out = s.run_without(&["--overwrite", "--cluster", space]);
        let said = String::from_utf8_lossy(&out.stderr).into_owned();
        assert!(out.status.code() == Some(2) && said.contains("--features"), "{said}");
    }
}

#[test]
fn damaged_gaussians_belong_to_nothing_and_harm_nobody() {
    let s = Scene::new();
    let mut g = gaussians();
    g.log_scales[2 * EACH][1] = f32::NAN;
    ply::write_gaussians(s.path("geometry.ply"), &g, &[]).unwrap();
    s.artifacts(|_| {});
    let (i, said) = s.succeed(&[]);
    assert!(said.contains("skipped 1 of 81 Gaussians: damaged") && said.contains("vertex 80"), "{said}");
    assert!(!said.contains("never seen"), "{said}");
    things(&i);
    assert_eq!((i.label[2 * EACH], i.node[2 * EACH]), (-1, -1));
    // What is written can be read by anyone.
    assert_eq!(ply::read_gaussians(s.path("out/instances.ply")).unwrap().means[2 * EACH], g.means[2 * EACH]);
}

#[test]
fn instances_ply_keeps_all_harmonics_and_what_other_programs_wrote() {
    let s = Scene::new();
    let mut g = gaussians();
    let n = g.len();
    (g.sh_degree, g.sh) = (3, (0..48 * n).map(|i| (i % 101) as f32 * 0.01).collect());
    // Another program's number for each Gaussian, in place of the instance.
    let theirs: Vec<i32> = (0..n as i32).map(|i| 1000 + i).collect();
    let ids = [("segments", &theirs[..])];
    splat::write(s.path("geometry.ply"), &g, &Extra { ids: &ids, ..Extra::default() }).unwrap();
    s.artifacts(|_| {});
    let (i, _) = s.succeed(&[]);
    let out = s.path("out/instances.ply");
    assert_eq!(ply::read_gaussians(&out).unwrap(), g);
    let (_, kept) = ply::read_labels(&out, "segments", [0.0; 3]).unwrap();
    assert!(kept.iter().zip(&theirs).all(|(a, b)| *a == *b as u32));
    assert_eq!(ply::read_labels(&out, "instance", [0.0; 3]).is_err(), i.label.contains(&-1));
}

#[test]
fn a_geometry_learnt_with_the_filter_is_written_with_it() {
    let s = Scene::new();
    let (plain, _) = s.succeed(&[]);
    ply::write_gaussians(s.path("geometry.ply"), &gaussians(), &[ply::ANTIALIASED.into()]).unwrap();
    s.artifacts(|_| {});
    let (marked, _) = s.succeed(&[]);
    assert_eq!(plain.label, marked.label);
    assert!(ply::is_antialiased(s.path("out/instances.ply")).unwrap());
}

#[test]
fn scenes_without_anything_are_results_not_errors() {
    // All noise.
    let s = Scene::new();
    let (i, said) = s.succeed(&["--min-cluster-size", "60"]);
    assert!(i.is_empty() && i.matches.is_empty() && i.label.iter().all(|&l| l == -1));
    assert!(said.contains("everything is noise") && said.contains("--allow-single-cluster"), "{said}");
    assert_eq!(ply::read_gaussians(s.path("out/instances.ply")).unwrap().len(), 81);
    // One thing.
    s.artifacts(|f| f.values.assign(&aview1(&[0.0, 1.0, 0.0])));
    let (i, _) = s.succeed(&["--cluster", "free", "--allow-single-cluster"]);
    assert!(i.len() == 1 && i.label.iter().all(|&l| l == 0));
    // No masks at the level.
    s.artifacts(|_| {});
    let (i, _) = s.succeed(&["--cluster", "free", "--min-samples", "5", "--levels", "small"]);
    things(&i);
    assert!(i.matches.is_empty() && i.support == [0, 0]);
    let has_names = || {
        let made = Artifact::open(s.path("out/instances.safetensors"), "instances", 1).unwrap();
        made.provenance().inputs.contains_key(role::MASK_NAMES)
    };
    assert!(!has_names());
    // Those of a model that names what it sees, and saw nothing.
    for v in 0..VIEWS {
        let ids = Array3::from_elem((6, SIZE, SIZE), -1);
        MaskMaps { ids }.write(s.path(&format!("masks/v{v}_s.npy"))).unwrap();
    }
    s.artifacts(|_| {});
    s.succeed(&[]);
    assert!(has_names());
    // One Gaussian.
    ply::write_gaussians(s.path("geometry.ply"), &gaussians().select(&[0]), &[]).unwrap();
    let graph = Graph {
        kept: vec![0],
        anchors: vec![0],
        nearest_anchor: vec![0],
        seen_views: vec![4],
        seen_weight: vec![1.0],
        ..Graph::default()
    };
    let footprints =
        FootprintsBuilder { views: vec!["v0".into()], kept: vec![0], row_ptr: vec![0], ..Default::default() };
    s.write(&graph, &footprints, &Features { kept: vec![0], values: arr2(&[[1.0, 0.0]]) });
    let (i, said) = s.succeed(&[]);
    assert_eq!(i.label, [-1]);
    assert!(said.contains("skipped 3 of 4 views in matching") && said.contains("v1, v2, v3"), "{said}");
}

#[test]
fn a_draft_lists_the_masks_that_are_read_and_is_gone_on_from() {
    let s = Scene::new();
    s.language(0..VIEWS);
    let all = |extra: &[&str]| {
        s.succeed(extra);
        let names = ["safetensors", "ply", "labels.npy", "json"];
        names.map(|e| std::fs::read(s.path("out/instances").with_extension(e)).unwrap())
    };
    for most in ["2", "0"] {
        let most = ["--describe-views", most];
        let whole = all(&most);
        std::fs::remove_dir_all(s.path("out")).unwrap();
        let draft = s.path("draft.safetensors");
        let options = |way: &'static str| [&most[..], &[way, draft.to_str().unwrap()]].concat();
        // Features are not read for it: there are none yet.
        (0..VIEWS).for_each(|v| std::fs::remove_file(s.path(&format!("masks/v{v}_f.npy"))).unwrap());
        let out = s.run(&options("--draft"));
        assert!(out.status.success() && !s.path("out").exists(), "{}", String::from_utf8_lossy(&out.stderr));
        let wanted = Draft::read(&draft).unwrap().0;
        let views_of_one = wanted.of_instances.chunk_by(|a, b| a.of == b.of).map(<[_]>::len).max();
        assert!(most[1] == "0" || views_of_one <= Some(2), "{views_of_one:?}");
        let wanted: Vec<(&str, Vec<u32>)> =
            wanted.wanted().into_iter().map(|(view, masks)| (view, masks.into_iter().collect())).collect();
        assert!(most[1] == "2" || wanted.len() == 4, "{wanted:?}");
        assert!(wanted.iter().all(|(_, masks)| masks.iter().all(|&m| m == 0 || m >= 3)), "{wanted:?}");
        s.language(0..VIEWS);
        // What is not wanted is not read.
        let features = |view: &str| s.path(&format!("masks/{view}_f.npy"));
        for (view, masks) in &wanted {
            let mut own = MaskFeatures::read(features(view)).unwrap();
            (0..5).filter(|m| !masks.contains(m)).for_each(|m| own.values.row_mut(m as usize).fill(9.0));
            own.write(features(view)).unwrap();
        }
        let [artifact, rest @ ..] = all(&options("--from"));
        assert_eq!(rest, whole[1..]);
        let tensors = |bytes: &[u8]| {
            let path = s.path("tensors.safetensors");
            std::fs::write(&path, bytes).unwrap();
            Instances::read(&path).unwrap().0
        };
        assert_eq!(tensors(&artifact), tensors(&whole[0]));
        s.language(0..VIEWS);
        assert_eq!(all(&options("--from"))[0], whole[0], "the same bytes with the same features");
        let other = ["--from", draft.to_str().unwrap(), "--describe-views", "1"];
        s.fail(&other, &["draft.safetensors", "describe_views", "made with another option"]);
    }
    s.fail(&["--from", s.path("features.safetensors").to_str().unwrap()], &["features.safetensors", "draft"]);
}

#[test]
fn bad_input_is_one_line_and_leaves_outputs_alone() {
    let s = Scene::new();
    // clap's own errors have exit code 2 as well, and name option and range.
    for (option, value, expected) in [
        ("--min-cluster-size", "1", "expected 2 to"),
        ("--min-samples", "0", "expected 1 to"),
        ("--epsilon", "NaN", "expected 0 or more"),
        ("--join", "2", "expected 0 to 1"),
        ("--agreement", "1.1", "expected 0 to 1"),
        ("--levels", "huge", "expected default, small, medium, large, classes, concepts"),
    ] {
        let out = s.run(&[option, value]);
        let said = String::from_utf8_lossy(&out.stderr).into_owned();
        assert!(out.status.code() == Some(2) && said.contains(option) && said.contains(expected), "{said}");
    }
    s.fail(&["--out", s.path("out/x.json").to_str().unwrap()], &["--out", "another output has this name"]);
    std::fs::write(s.path("blocked"), "a file").unwrap();
    s.fail(&["--out", s.path("blocked/instances.safetensors").to_str().unwrap()], &["blocked"]);
    assert!(s.path("blocked").is_file());

    // Language features that do not fit the masks.
    s.language(0..VIEWS);
    let one = s.path("masks/v2_f.npy");
    MaskFeatures { values: Array2::from_elem((2, 3), 0.5) }.write(&one).unwrap();
    s.fail(&[], &["v2_f.npy", "fewer features than masks", "found 2", "at least 5"]);
    MaskFeatures { values: Array2::from_elem((5, 2), 0.5) }.write(&one).unwrap();
    s.fail(&[], &["v2_f.npy", "different models", "found 2", "expected 3"]);
    std::fs::write(&one, "no array").unwrap();
    s.fail(&[], &["v2_f.npy"]);
    std::fs::remove_file(&one).unwrap();
    let (i, said) = s.succeed(&[]);
    assert!(said.contains("masks that say what instances mean have no feature") && i.dim() == 3, "{said}");

    // Artifacts of another scene.
    s.masks(1, &[0; SIZE * SIZE]);
    s.fail(&[], &["footprints.safetensors", "another masks", "run make again"]);
    s.masks(1, &s.seen(1));
    let features = std::fs::read(s.path("features.safetensors")).unwrap();
    s.artifacts(|_| {});
    let graph = std::fs::read(s.path("graph.safetensors")).unwrap();
    let image = Image { width: SIZE as u32, height: SIZE as u32, rgb: vec![0.25; 3 * SIZE * SIZE], alpha: None };
    let old = std::fs::read(s.path("images/v3.png")).unwrap();
    image.write_png(s.path("images/v3.png")).unwrap();
    s.fail(&[], &["graph.safetensors", "another dataset"]);
    std::fs::write(s.path("images/v3.png"), old).unwrap();
    let mut other = gaussians();
    other.means[3][0] += 0.01;
    ply::write_gaussians(s.path("geometry.ply"), &other, &[]).unwrap();
    s.fail(&[], &["graph.safetensors", "another geometry"]);
    ply::write_gaussians(s.path("geometry.ply"), &gaussians(), &[]).unwrap();
    s.artifacts(|f| f.values[[2, 1]] = f32::NAN);
    let free = ["--cluster", "free"];
    s.fail(&free, &["features.safetensors", "features[2][1]", "not a finite number"]);
    s.artifacts(|f| f.values = Array2::default((2 * EACH, 0)));
    s.fail(&free, &["features.safetensors", "no dimension"]);
    std::fs::write(s.path("features.safetensors"), &features[..features.len() - 9]).unwrap();
    s.fail(&free, &["features.safetensors"]);
    std::fs::write(s.path("features.safetensors"), &features).unwrap();
    s.succeed(&[]);
    std::fs::write(s.path("graph.safetensors"), &graph[..50]).unwrap();
    s.fail(&[], &["graph.safetensors"]);
    std::fs::remove_file(s.path("graph.safetensors")).unwrap();
    s.fail(&[], &["graph.safetensors"]);
}

/// The header tells how many Gaussians there are: this file has nothing behind it, which only unpacking would find.
#[test]
fn a_limit_of_memory_holds_before_packed_gaussians_are_unpacked() {
    let s = Scene::new();
    let count = 10_000_000u32.to_le_bytes();
    let header = [&b"NGSP\x04\0\0\0"[..], &count, &[0, 12, 0, 5], &[32, 0, 0, 0], &[0; 12]].concat();
    std::fs::write(s.path("geometry.ply"), [header, vec![7; 100_000]].concat()).unwrap();
    s.fail(&["--memory-limit", "200M"], &["--memory-limit: the run needs more memory than it may take"]);
    s.fail(&["--memory-limit", "900G"], &["not a value of SPZ"]);
}
