//! The program on a small scene: every command, what it writes, and bad input.

use artifacts::{Edit, Edits, Extents, Instances, Match, role};
use gs_io::{Artifact, Provenance, hash_file};
use gs_scene::{Camera, Gaussians, Image, ply};
use objects::{Ids, NameSource, RelationKind, Scene};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// Lower and upper corners of a table top, a mug on it, a book in a box, that box beside the mug, and a box under the table.
const THINGS: [([f32; 3], [f32; 3]); 5] = [
    ([0.0, 0.0, 0.7], [2.0, 1.0, 0.75]),
    ([0.4, 0.4, 0.75], [0.5, 0.5, 0.85]),
    ([0.62, 0.42, 0.76], [0.68, 0.48, 0.78]),
    ([0.55, 0.35, 0.75], [0.75, 0.55, 0.9]),
    ([0.8, 0.3, 0.0], [1.2, 0.7, 0.4]),
];
/// Gaussians of each.
const EACH: usize = 9 * 9 * 9;

/// Gaussians on grids through the things, with one of no thing first; harmonics of degree 1.
fn gaussians() -> (Gaussians, Vec<i32>) {
    let (mut means, mut label) = (vec![[50.0; 3]], vec![-1]);
    for (k, (low, high)) in THINGS.iter().enumerate() {
        for i in 0..EACH {
            let at = [i % 9, i / 9 % 9, i / 81];
            means.push([0, 1, 2].map(|c| low[c] + (high[c] - low[c]) * at[c] as f32 / 8.0));
            label.push(k as i32);
        }
    }
    let n = means.len();
    let g = Gaussians {
        log_scales: vec![[-4.0, -5.0, -4.5]; n],
        rotations: (0..n).map(|i| [1.0, i as f32 * 0.001, 0.0, 0.5]).collect(),
        opacity_logits: vec![3.0; n],
        sh: (0..12 * n).map(|i| (i % 97) as f32 * 0.01).collect(),
        sh_degree: 1,
        means,
        ..Gaussians::default()
    };
    (g, label)
}

struct Run {
    dir: tempfile::TempDir,
}

impl Run {
    fn new() -> Self {
        let run = Self { dir: tempfile::tempdir().unwrap() };
        let (g, label) = gaussians();
        ply::write_gaussians(run.path("geometry.ply"), &g, &[]).unwrap();
        run.write(&g, label);
        run
    }

    fn write(&self, g: &Gaussians, label: Vec<i32>) {
        let k = THINGS.len();
        let e = Extents::of(&g.means, &label, k);
        let instances = Instances {
            node: vec![-1; label.len()],
            label,
            support: vec![1; k],
            score: (0..k).map(|i| 0.9 - 0.1 * i as f32).collect(),
            count: e.count,
            centroid: e.centroid,
            bbox_min: e.bbox_min,
            bbox_max: e.bbox_max,
            oriented: e.oriented,
            views: vec!["v0".into()],
            matches: vec![Match { instance: 1, view: 0, mask: 12, score: 0.8, visible: 40.0 }],
            ..Instances::default()
        };
        let mut inputs = BTreeMap::from([(role::GEOMETRY.into(), hash_file(self.path("geometry.ply")).unwrap())]);
        if let Ok(dataset) = self.dataset() {
            inputs.insert(role::DATASET.into(), dataset.hash().unwrap());
        }
        instances.write(self.path("instances.safetensors"), Provenance { inputs, ..Provenance::default() }).unwrap();
    }

    fn dataset(&self) -> gs_io::Result<gs_scene::dataset::Dataset> {
        gs_scene::dataset::load(&self.path("photos"), &gs_scene::dataset::LoadOptions::default())
    }

    /// Photographs from around the table, tilted down.
    fn photographs(&self) {
        std::fs::create_dir_all(self.path("photos/images")).unwrap();
        let mut frames = Vec::new();
        for v in 0..4u32 {
            let (sin, cos) = (f64::from(v) * 1.3).sin_cos();
            let eye = glam::DVec3::new(1.0 + 3.0 * cos, 0.5 + 3.0 * sin, 2.5);
            let c = Camera::look_at(eye, glam::DVec3::new(1.0, 0.5, 0.7), glam::DVec3::Z, 16, 16, 1.0);
            let name = format!("images/v{v}.png");
            let image = Image { width: 16, height: 16, rgb: vec![0.5; 3 * 256], alpha: None };
            image.write_png(self.path(&format!("photos/{name}"))).unwrap();
            frames.push((name, c));
        }
        gs_scene::dataset::write_transforms(&self.path("photos/transforms.json"), &frames, [0.0; 3]).unwrap();
    }

    fn edits(&self, edits: Vec<Edit>) {
        let artifact = Artifact::open(self.path("instances.safetensors"), Instances::FORMAT, 1).unwrap();
        Edits { instances: artifact.hash().into(), edits }.write(self.path("edits.json")).unwrap();
    }

    fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    /// Runs `export COMMAND` on the scene with an output of this name.
    fn run(&self, command: &str, out: &str, extra: &[&str]) -> Output {
        let [geometry, instances, out] = ["geometry.ply", "instances.safetensors", out].map(|f| self.path(f));
        let mut run = Command::new(env!("CARGO_BIN_EXE_export"));
        run.current_dir(self.dir.path()).arg(command).arg("--geometry").arg(geometry);
        run.arg("--instances").arg(instances).arg("--out").arg(out).args(extra).output().unwrap()
    }

    fn succeed(&self, command: &str, out: &str, extra: &[&str]) -> String {
        let o = self.run(command, out, extra);
        let said = String::from_utf8_lossy(&o.stderr).into_owned();
        assert!(o.status.success(), "{said}");
        said
    }

    /// Expects exit code 2 and one line with all `needles`, and no output.
    fn fail(&self, command: &str, out: &str, extra: &[&str], needles: &[&str]) {
        let before = self.path(out).exists();
        let o = self.run(command, out, extra);
        let said = String::from_utf8_lossy(&o.stderr).into_owned();
        assert_eq!(o.status.code(), Some(2), "{said}");
        needles.iter().for_each(|n| assert!(said.contains(n), "{n:?} is not in {said:?}"));
        let errors = said.lines().filter(|l| l.starts_with("export: error: ")).count();
        assert_eq!((errors, said.contains("panicked")), (1, false), "{said}");
        assert_eq!(self.path(out).exists(), before);
    }
}

/// The files in a folder that objects are in.
fn objects_in(folder: &Path) -> Vec<String> {
    let names = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap());
    let mut names: Vec<String> = names.filter(|n| n.starts_with("object_")).collect();
    names.sort();
    names
}

#[test]
fn scene_json_tells_objects_and_relations() {
    let run = Run::new();
    let names = Edit::Rename { instance: 1, name: "red \"mug\"".into() };
    run.edits(vec![names, Edit::Scale { from: [0.0; 3], to: [0.0, 0.0, 2.0], metres: 1.0 }]);
    run.succeed("scene", "scene.json", &["--edits", "edits.json", "--up", "z"]);
    let scene = Scene::read(run.path("scene.json")).unwrap();
    assert_eq!((scene.objects.len(), scene.metres_per_unit), (5, Some(0.5)));
    let mug = scene.object(1).unwrap();
    assert_eq!(mug.name.as_ref().map(|n| (&n.text[..], n.from)), Some(("red \"mug\"", NameSource::Edits)));
    assert_eq!(mug.best_view.as_ref().map(|b| (&b.view[..], b.mask)), Some(("v0", 12)));
    let told: Vec<(u32, RelationKind, u32)> =
        scene.relations.iter().map(|r| (r.subject, r.relation, r.object)).collect();
    use RelationKind::{In, NextTo, On, Under};
    assert_eq!(told, [(1, On, 0), (1, NextTo, 3), (2, In, 3), (3, On, 0), (4, Under, 0)]);

    // A vocabulary names what nobody else did, and a guess is said to be one.
    let hash = Instances::read(run.path("instances.safetensors")).unwrap().1.hash().to_string();
    let naming = |instance: u32, name: &str, sure: bool| json!({"instance": instance, "names": [{"name": name, "score": 0.5}], "margin": 0.1, "sure": sure});
    let by_words = |hash: &str| {
        let names = json!({"format": "names", "version": 1, "instances": hash, "source": "", "model": "", "vocabulary": "",
            "words": 3, "by_chance": null, "named": [naming(0, "table", true), naming(1, "cup", true), naming(2, "box", false)]});
        std::fs::write(run.path("names.json"), names.to_string()).unwrap();
    };
    by_words(&hash);
    run.succeed("scene", "scene.json", &["--edits", "edits.json", "--names", "names.json"]);
    let scene = Scene::read(run.path("scene.json")).unwrap();
    let called = scene.objects.iter().map(|o| o.name.as_ref().map_or("-".into(), ToString::to_string));
    assert_eq!(called.collect::<Vec<_>>(), ["table", "red \"mug\"", "box?", "-", "-"]);
    by_words("other");
    run.fail("scene", "new.json", &["--names", "names.json"], &["names of other instances", "run eval names again"]);
    // Without what is up there are no boxes that stand upright.
    run.succeed("scene", "bare.json", &[]);
    let bare: Value = serde_json::from_slice(&std::fs::read(run.path("bare.json")).unwrap()).unwrap();
    assert_eq!((&bare["up"], &bare["objects"][0]["box"]["upright"]), (&Value::Null, &json!(false)));
}

#[test]
fn cameras_tell_what_is_up_and_queries_what_things_are_called() {
    let run = Run::new();
    run.photographs();
    let (g, label) = gaussians();
    run.write(&g, label);
    let answer =
        |text: &str, id: u32| json!({"text": text, "kind": "text", "ranking": [{"instance": id, "score": 0.5}]});
    std::fs::write(run.path("query.json"), json!({"queries": [answer("mug", 1), answer("table", 0)]}).to_string())
        .unwrap();
    run.fail("scene", "scene.json", &["--query", "query.json"], &["query.json.run.json"]);
    // The record of a query: that of any stage, with its inputs.
    run.succeed("scene", "a.json", &["--up", "z"]);
    let mut record: Value = serde_json::from_slice(&std::fs::read(run.path("a.json.run.json")).unwrap()).unwrap();
    std::fs::write(run.path("query.json.run.json"), record.to_string()).unwrap();
    run.succeed("scene", "scene.json", &["--scene", "photos", "--query", "query.json"]);
    let scene = Scene::read(run.path("scene.json")).unwrap();
    assert!((scene.up.unwrap().direction[2] - 1.0).abs() < 1e-6, "{:?}", scene.up);
    let names: Vec<_> = scene.objects.iter().map(|o| o.name.as_ref().map(|n| n.text.clone())).collect();
    assert_eq!(names, [Some("table".into()), Some("mug".into()), None, None, None]);
    let unseen: Vec<f32> = scene.objects.iter().map(|o| o.unseen.unwrap()).collect();
    // The table has so few Gaussians that one sees through; the mug's bottom stands on it; the book lies in a box.
    assert!(unseen[0] < 0.1 && (0.16..0.7).contains(&unseen[1]) && unseen[2] == 1.0, "{unseen:?}");
    record["inputs"]["instances"] = json!("0123456789abcdef");
    std::fs::write(run.path("query.json.run.json"), record.to_string()).unwrap();
    run.fail("scene", "b.json", &["--query", "query.json"], &["queries of other instances; found 0123456789ab"]);
}

#[test]
fn splats_keep_harmonics_and_ids_and_can_do_without_an_object() {
    let run = Run::new();
    let (g, label) = gaussians();
    run.succeed("splats", "all.ply", &["--ids"]);
    assert_eq!(ply::read_gaussians(run.path("all.ply")).unwrap(), g);
    assert_eq!(Ids::read(run.path("all.ply"), g.len()).unwrap().instance, label);
    run.succeed("splats", "rest.ply", &["--without", "1,3"]);
    let rest: Vec<u32> = (0..g.len() as u32).filter(|&i| ![1, 3].contains(&label[i as usize])).collect();
    assert_eq!(ply::read_gaussians(run.path("rest.ply")).unwrap(), g.select(&rest));
    run.succeed("splats", "some.ply", &["--only", "4,0"]);
    let (_, ids) = ply::read_labels(run.path("some.ply"), "instance", [0.0; 3]).unwrap();
    assert!(ids.len() == 2 * EACH && ids[..EACH].iter().all(|&i| i == 0) && ids[EACH..].iter().all(|&i| i == 4));

    run.succeed("objects", "things", &[]);
    let names: Vec<String> = (0..5).map(|k| format!("object_{k:04}.ply")).collect();
    assert_eq!(objects_in(&run.path("things")), names);
    let own: Vec<u32> = (0..g.len() as u32).filter(|&i| label[i as usize] == 3).collect();
    assert_eq!(ply::read_gaussians(run.path("things/object_0003.ply")).unwrap(), g.select(&own));
    // What an earlier run wrote and this one did not goes.
    run.succeed("objects", "things", &["--only", "2"]);
    assert_eq!(objects_in(&run.path("things")), ["object_0002.ply"]);
    std::fs::write(run.path("things/mine.ply"), "mine").unwrap();
    run.fail("objects", "things", &[], &["mine.ply", "the output exists and would be lost"]);
}

#[test]
fn ids_say_the_class_of_each_gaussian() {
    let run = Run::new();
    let (g, label) = gaussians();
    let call = |instance, name: &str| Edit::Rename { instance, name: name.into() };
    run.edits(vec![call(1, "plate"), call(2, "mug"), call(3, "plate")]);
    run.succeed("splats", "all.ply", &["--ids", "--edits", "edits.json"]);
    let ids = Ids::read(run.path("all.ply"), g.len()).unwrap();
    assert_eq!(ids.classes, ["mug", "plate"]);
    let of: Vec<(u32, i32)> = ids.objects.iter().map(|o| (o.instance_id, o.class_id)).collect();
    assert_eq!(of, [(0, -1), (1, 1), (2, 0), (3, 1), (4, -1)]);
    // The three are the last of a row.
    let bytes = std::fs::read(run.path("all.ply")).unwrap();
    let header = String::from_utf8_lossy(&bytes[..3000]).into_owned();
    let last = "property int instance\nproperty int instance_id\nproperty int class_id\nend_header\n";
    let start = header.find(last).unwrap_or_else(|| panic!("{header}")) + last.len();
    let row = (bytes.len() - start) / g.len();
    for (i, &label) in label.iter().enumerate() {
        let row = &bytes[start + i * row..][..row];
        let word = |back: usize| i32::from_le_bytes(row[row.len() - 4 * back..][..4].try_into().unwrap());
        let class = of.iter().find(|o| o.0 as i32 == label).map_or(-1, |o| o.1);
        assert_eq!([word(3), word(2), word(1)], [label, label, class]);
    }
    assert_eq!(ply::read_gaussians(run.path("all.ply")).unwrap(), g);
    run.fail("splats", "o.ply", &["--ids", "--names", "all.ply"], &["all.ply"]);
}

#[test]
fn every_format_of_splats_is_written_with_ids_beside_it() {
    let run = Run::new();
    let (g, label) = gaussians();
    for format in ["compressed.ply", "spz", "sog", "splat", "glb"] {
        let (all, things) = (format!("all.{format}"), format!("things-{format}"));
        run.succeed("splats", &all, &["--ids"]);
        let read = gs_scene::splat::read(run.path(&all)).unwrap().gaussians;
        assert_eq!(read.len(), g.len(), "{format}");
        let own = Ids::read(run.path(&all), g.len()).unwrap().instance;
        if ["compressed.ply", "sog"].contains(&format) {
            // Another order: each lies in the thing that it is said to be of.
            for (m, &id) in read.means.iter().zip(&own) {
                let (low, high) = usize::try_from(id).map_or(([50.0; 3], [50.0; 3]), |id| THINGS[id]);
                assert!((0..3).all(|c| low[c] - 0.05 < m[c] && m[c] < high[c] + 0.05), "{format}: {m:?} of {id}");
            }
            assert!((0..5).all(|id| own.iter().filter(|o| **o == id).count() == EACH), "{format}");
            assert_ne!(own, label, "{format}");
        } else {
            let off = |i: usize| (0..3).map(|c| (read.means[i][c] - g.means[i][c]).abs()).fold(0.0, f32::max);
            assert!((0..g.len()).all(|i| off(i) < 0.01), "{format}: another order or other places");
            assert_eq!(own, label, "{format}");
        }
        run.succeed("objects", &things, &["--format", format, "--only", "2"]);
        assert_eq!(objects_in(&run.path(&things)), [format!("object_0002.{format}")]);
        let thing = gs_scene::splat::read(run.path(&things).join(format!("object_0002.{format}"))).unwrap();
        assert_eq!(thing.gaussians.len(), EACH, "{format}");
    }
    // What a format leaves out has no id.
    let mut far = g.clone();
    far.means[0] = [1e6, 0.0, 0.0];
    ply::write_gaussians(run.path("geometry.ply"), &far, &[]).unwrap();
    run.write(&far, label.clone());
    assert!(run.succeed("splats", "far.spz", &["--ids"]).contains("1 of 3646 Gaussians are left out"));
    assert_eq!(Ids::read(run.path("far.spz"), g.len() - 1).unwrap().instance, label[1..]);
}

#[test]
fn points_meshes_and_usd_are_written_the_same_each_time() {
    let run = Run::new();
    let bytes = |name: &str| std::fs::read(run.path(name)).unwrap();
    for out in ["a.las", "a.ply"] {
        run.succeed("points", out, &[]);
        let first = bytes(out);
        run.succeed("points", out, &["--threads", "1"]);
        assert_eq!(bytes(out), first);
    }
    let mut reader = las::Reader::from_path(run.path("a.las")).unwrap();
    assert_eq!(reader.read_all().unwrap().len(), 5 * EACH + 1);
    run.succeed("points", "faint.ply", &["--min-opacity", "0.99"]);
    assert!(ply::read_points(run.path("faint.ply")).unwrap().is_empty());

    let said = run.succeed("meshes", "hulls", &[]);
    assert!(said.contains("wrote 5 meshes") && !said.contains("boxes"), "{said}");
    let text = String::from_utf8(bytes("hulls/object_0001.obj")).unwrap();
    assert_eq!((text.matches("v ").count(), text.matches("f ").count()), (8, 12), "{text}");
    run.succeed("meshes", "plys", &["--format", "ply", "--only", "1"]);
    assert_eq!(ply::read_points(run.path("plys/object_0001.ply")).unwrap().len(), 8);

    run.edits(vec![Edit::Rename { instance: 1, name: "mug".into() }]);
    run.succeed("usd", "scene.usda", &["--up", "z", "--edits", "edits.json"]);
    let stage = String::from_utf8(bytes("scene.usda")).unwrap();
    assert_eq!(stage.matches("def ParticleField3DGaussianSplat").count(), 6, "five objects and what is in none");
    assert_eq!(stage.matches("def Mesh \"collider\"").count(), 5);
    assert!(stage.contains("displayName = \"mug\"") && stage.contains("sphericalHarmonicsDegree = 1"));
    run.succeed("usd", "flat.usda", &["--sh", "0"]);
    assert!(bytes("flat.usda").len() < stage.len());
}

#[test]
fn what_cannot_be_done_is_said_in_one_line() {
    let run = Run::new();
    run.fail("objects", "o", &["--only", "9"], &["--only: no such object; found 9, expected ids of objects, 0 to 4"]);
    run.fail("splats", "o.ply", &["--without", "0,7"], &["--without: no such object; found 7"]);
    run.fail("splats", "o.xyz", &[], &["o.xyz", "no format that can be written has such a name", ".sog"]);
    run.fail("points", "o.e57", &[], &["expected .las or .ply"]);
    run.fail("usd", "o.usdc", &[], &["expected .usda"]);
    run.fail("scene", "geometry.ply", &[], &["the output is one of the inputs"]);
    run.edits(vec![Edit::Merge { instances: vec![0, 1] }]);
    run.fail("splats", "o.ply", &["--edits", "edits.json", "--only", "1"], &["no such object; found 1"]);
    run.fail("scene", "o.json", &["--memory-limit", "1G"], &["does not forecast its memory"]);
    // Other Gaussians than those of the instances.
    let (g, _) = gaussians();
    ply::write_gaussians(run.path("geometry.ply"), &g.select(&[1, 0, 2]), &[]).unwrap();
    run.fail("scene", "o.json", &[], &["instances.safetensors"]);
    let up = run.run("scene", "o.json", &["--up", "sideways"]);
    assert_eq!(up.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&up.stderr).contains("not a direction"));
}

#[test]
fn damaged_gaussians_go_nowhere() {
    let run = Run::new();
    let (mut g, label) = gaussians();
    g.log_scales[0][0] = f32::NAN;
    ply::write_gaussians(run.path("geometry.ply"), &g, &[]).unwrap();
    run.write(&g, label);
    let said = run.succeed("points", "a.las", &["--min-opacity", "0"]);
    assert!(said.contains("skipped 1 of 3646 Gaussians: damaged"), "{said}");
    assert_eq!(las::Reader::from_path(run.path("a.las")).unwrap().read_all().unwrap().len(), 5 * EACH);
    run.succeed("splats", "all.ply", &[]);
    assert!(ply::read_gaussians(run.path("all.ply")).is_ok(), "anyone can read it");
}
