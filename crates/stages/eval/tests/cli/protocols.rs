//! The protocols on a synthetic scene, against `scripts/protocol_oracle.py`. Where there is no Python with numpy and
//! OpenCV 4.8 to 4.10 (CAGS_PYTHON names one), the numbers it gave are the golden ones of `testdata/protocols.json`.

use crate::fixture::{failed, provenance, read_json};
use artifacts::{Features, Instances, OrientedBox, TruePoints, TrueScene, flat};
use gs_io::{hash_bytes, hash_file};
use gs_scene::Gaussians;
use ndarray::{Array2, aview1};
use serde_json::{Map, Value, json};
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// The ids of the classes that things take in turn; 40 is no class of any set.
const NYU: [u32; 9] = [1, 2, 7, 5, 11, 33, 40, 3, 34];
const NAMES: [(u32, &str); 19] = artifacts::NYU40;
const DIM: usize = 24;

struct Scene {
    dir: tempfile::TempDir,
    /// Of the dataset's folder.
    name: &'static str,
}

impl Scene {
    /// A synthetic room; a Gaussian on every seventh or so point of its surfaces; instances as a method might find them:
    /// two things joined, one cut in two, noise, one without a descriptor.
    fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let scene = dir.path().join("scene0000_00");
        let faults = synth_scene::masks::Faults { granularity: 0.5, boundary: 1, missing: 0.1, ..Default::default() };
        let options = synth_scene::write::Options {
            seed: 3,
            objects: 6,
            views: 5,
            width: 120,
            height: 90,
            points: 50,
            faults,
            label_every: 2,
            ..synth_scene::write::Options::default()
        };
        synth_scene::write::run(&stage::Stage::silent("synth-scene"), &scene, &options).unwrap();
        let truth = TruePoints::read(scene.join("truth/points.safetensors")).unwrap();
        let things = TrueScene::read(scene.join("truth/scene.json")).unwrap().objects;
        let step = (truth.position.len() / 2500).max(1);
        let points: Vec<usize> = (0..truth.position.len()).step_by(step).collect();
        let this = Self { dir, name: "scene0000_00" };
        let mut g = Gaussians::default();
        let mut label = Vec::new();
        let (merged, cut) = (things.len() as i32 - 1, things.len() as i32 - 3);
        for (n, &p) in points.iter().enumerate() {
            let thing = truth.instance[p];
            g.means.push(truth.position[p]);
            let flat = [0.03f32, 0.02, 0.01 + 0.01 * (n % 3) as f32];
            g.log_scales.push(flat.map(f32::ln));
            g.rotations.push([1.0, 0.1 * (n % 5) as f32, 0.2, 0.05 * (n % 7) as f32]);
            // Every eleventh is faint.
            g.opacity_logits.push(if n % 11 == 0 { -3.0 } else { 3.0 });
            g.sh.extend([0.0; 3]);
            label.push(match thing {
                _ if n % 13 == 0 => -1,
                t if t == merged => merged - 1,
                t if t == cut && n % 3 == 0 => merged,
                t => t,
            });
        }
        gs_scene::ply::write_gaussians(this.geometry(), &g, &[]).unwrap();
        let k = things.len();
        let mut descriptor = Array2::zeros((k, DIM));
        for i in (0..k).filter(|&i| i != 4) {
            descriptor[[i, i % DIM]] = 1.0;
            descriptor[[i, (i + 1) % DIM]] = 0.3;
        }
        let instances = Instances {
            descriptor,
            support: (0..k as u32).map(|i| if i == 1 { 1 } else { 3 + i }).collect(),
            score: (0..k).map(|i| 0.2 + 0.1 * ((i * 5) % 7) as f32).collect(),
            count: (0..k as i32).map(|i| label.iter().filter(|&&l| l == i).count() as u32).collect(),
            centroid: vec![[0.0; 3]; k],
            bbox_min: vec![[0.0; 3]; k],
            bbox_max: vec![[0.0; 3]; k],
            oriented: vec![OrientedBox::default(); k],
            node: vec![-1; label.len()],
            label,
            ..Instances::default()
        };
        instances.write(this.instances(), provenance(&this.geometry(), &this.scene())).unwrap();
        // Texts: names of things, without the last but one, which is then never asked for; and the names of classes.
        let axis = |i: usize| -> Vec<f32> { (0..DIM).map(|d| if d == i % DIM { 1.0 } else { 0.1 }).collect() };
        let mut texts = Map::new();
        for t in things.iter().filter(|t| t.id as usize != k - 2) {
            texts.insert(t.name.clone(), json!(axis(t.id as usize)));
        }
        for (id, name) in NAMES {
            let thing = NYU.iter().position(|&n| n == id).unwrap_or(20);
            texts.insert(name.into(), json!(axis(thing)));
        }
        std::fs::write(this.texts(), Value::Object(texts).to_string()).unwrap();
        // The scan: vertices are the Gaussians' centres.
        let mut ply = format!(
            "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n\
             property uchar red\nproperty uchar green\nproperty uchar blue\nproperty uchar alpha\nproperty ushort label\n\
             element face 0\nproperty list uchar int vertex_indices\nend_header\n",
            points.len()
        )
        .into_bytes();
        for (n, &p) in points.iter().enumerate() {
            ply.extend(truth.position[p].iter().flat_map(|v| v.to_le_bytes()));
            ply.extend([9, 9, 9, 255]);
            let class = if n % 17 == 0 { 0 } else { NYU[truth.instance[p] as usize % NYU.len()] };
            ply.extend((class as u16).to_le_bytes());
        }
        std::fs::write(scene.join("scene0000_00_vh_clean_2.labels.ply"), ply).unwrap();
        // Two segments a thing; every nineteenth vertex is of a segment that nobody owns.
        let segment =
            |(n, &p): (usize, &usize)| if n % 19 == 0 { 9999 } else { 2 * truth.instance[p] + (n % 2) as i32 };
        let segments: Vec<i32> = points.iter().enumerate().map(segment).collect();
        let segs = json!({"params": {}, "sceneId": "scene0000_00", "segIndices": segments});
        std::fs::write(scene.join("scene0000_00_vh_clean_2.0.010000.segs.json"), segs.to_string()).unwrap();
        let groups: Vec<Value> = things
            .iter()
            .map(|t| json!({"id": t.id, "objectId": t.id, "segments": [2 * t.id, 2 * t.id + 1], "label": t.class}))
            .collect();
        let aggregation = json!({"sceneId": "scene0000_00", "segGroups": groups});
        std::fs::write(scene.join("scene0000_00.aggregation.json"), aggregation.to_string()).unwrap();
        this
    }

    fn at(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }
    fn scene(&self) -> PathBuf {
        self.at(self.name)
    }
    fn geometry(&self) -> PathBuf {
        self.at("geometry.ply")
    }
    fn instances(&self) -> PathBuf {
        self.at("instances.safetensors")
    }
    fn texts(&self) -> PathBuf {
        self.at("texts.json")
    }
    fn features(&self) -> PathBuf {
        self.at("features.safetensors")
    }

    /// Features by instance: one direction for each but the last two, which look alike.
    fn write_features(&self) {
        let (instances, _) = Instances::read(self.instances()).unwrap();
        let (dim, n) = (instances.len(), instances.label.len());
        let thing = |i: usize| usize::try_from(instances.label[i]).map_or(0, |l| l.min(dim - 2));
        let values = Array2::from_shape_fn((n, dim), |(i, c)| if c == thing(i) { 2.0 } else { 0.0 });
        let features = Features { kept: (0..n as u32).collect(), values };
        features.write(self.features(), provenance(&self.geometry(), &self.scene())).unwrap();
    }

    fn run(&self, command: &str, rest: &[&str]) -> Output {
        // One protocol does not write over the results of another.
        let _ = std::fs::remove_dir_all(self.at("out"));
        let mut c = Command::new(env!("CARGO_BIN_EXE_eval"));
        c.arg(command).arg("--instances").arg(self.instances()).arg("--geometry").arg(self.geometry());
        c.arg("--scene").arg(self.scene()).arg("--text-features").arg(self.texts()).arg("--out").arg(self.at("out"));
        c.args(rest).output().unwrap()
    }

    fn metrics(&self, command: &str, rest: &[&str]) -> Value {
        let o = self.run(command, rest);
        assert!(o.status.success(), "{}", String::from_utf8_lossy(&o.stderr));
        read_json(&self.at("out/metrics.json"))
    }

    /// Content of everything that the scores depend on; of instances the values, whatever else their file holds.
    fn hash(&self) -> String {
        let (i, _) = Instances::read(self.instances()).unwrap();
        let mut all = format!("{:?}{:?}{:?}{:?}", i.label, flat(i.descriptor.view()), i.support, i.score);
        for name in ["geometry.ply", "texts.json"] {
            all += &hash_file(self.at(name)).unwrap();
        }
        let mut labels: Vec<PathBuf> =
            std::fs::read_dir(self.scene().join("label")).unwrap().map(|e| e.unwrap().path()).collect();
        labels.retain(|p| p.extension().is_some_and(|e| e == "json"));
        labels.sort();
        labels.iter().for_each(|p| all += &hash_file(p).unwrap());
        hash_bytes(all.as_bytes())
    }
}

/// A Python that has what the oracle needs.
fn python() -> Option<String> {
    let python = std::env::var("CAGS_PYTHON").unwrap_or_else(|_| "python3".into());
    let check = "import numpy, cv2; v = tuple(map(int, cv2.__version__.split('.')[:2])); assert (4, 8) <= v <= (4, 10)";
    let found = Command::new(&python).args(["-c", check]).output().is_ok_and(|o| o.status.success());
    found.then_some(python)
}

/// Runs the oracle where it can be run; else looks the case up among the golden values.
struct Oracle {
    python: Option<String>,
    golden: Value,
    hash: String,
    made: Map<String, Value>,
}

fn golden_path() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("testdata/protocols.json")
}

impl Oracle {
    fn new(scene: &Scene) -> Self {
        let golden =
            std::fs::read(golden_path()).ok().and_then(|b| serde_json::from_slice(&b).ok()).unwrap_or_default();
        Self { python: python(), golden, hash: scene.hash(), made: Map::new() }
    }

    fn ask(&mut self, case: &str, arguments: &[&str]) -> Value {
        let Some(python) = &self.python else {
            let remedy = "set CAGS_PYTHON and CAGS_GOLDEN=1 to make new ones";
            assert_eq!(self.golden["hash"], self.hash, "{case}: the golden values are of another scene; {remedy}");
            return self.golden["cases"][case].clone();
        };
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../scripts/protocol_oracle.py");
        let o = Command::new(python).arg(script).args(arguments).output().unwrap();
        assert!(o.status.success(), "{}", String::from_utf8_lossy(&o.stderr));
        let value: Value = serde_json::from_slice(&o.stdout).unwrap();
        self.made.insert(case.into(), value.clone());
        value
    }

    /// With CAGS_GOLDEN set, writes what the oracle said as the new golden values.
    fn finish(self) {
        if std::env::var_os("CAGS_GOLDEN").is_some() {
            let all = json!({"hash": self.hash, "cases": self.made});
            std::fs::write(golden_path(), serde_json::to_string_pretty(&all).unwrap() + "\n").unwrap();
        }
    }
}

#[track_caller]
fn same(ours: &Value, theirs: &Value, what: &str) {
    match (ours.as_f64(), theirs.as_f64()) {
        (Some(a), Some(b)) => assert!((a - b).abs() < 1e-6, "{what}: {a} and {b}"),
        _ => assert_eq!(ours, theirs, "{what}"),
    }
}

#[test]
fn the_protocols_agree_with_an_independent_implementation() {
    let s = Scene::new();
    let mut oracle = Oracle::new(&s);
    let text = |p: PathBuf| p.to_string_lossy().into_owned();
    let (labels, saved) = (text(s.scene().join("label")), text(s.at("saved")));
    let mut spread = Vec::new();
    for (rendering, averaging, figures) in [("selected", "objects", "figures"), ("visible", "frames", "frame_figures")]
    {
        let folder = format!("{saved}-{rendering}");
        let rest = ["--silhouette", rendering, "--save-predictions", &folder];
        let ours = s.metrics("lerf", &rest);
        assert!(ours["figures"]["pairs"].as_u64().unwrap() >= 8, "{}", ours["figures"]);
        spread.push(ours["figures"]["miou"].as_f64().unwrap());
        let case = format!("lerf {rendering}");
        let theirs = oracle.ask(&case, &["lerf", &labels, &folder, "--averaging", averaging]);
        for figure in ["miou", "macc25", "macc50"] {
            same(&ours[figures][figure], &theirs[figure], &format!("{case} {figure}"));
        }
        let pairs = theirs["pairs"].as_array().unwrap();
        assert_eq!(pairs.len(), ours["pairs"].as_array().unwrap().len());
        for (a, b) in ours["pairs"].as_array().unwrap().iter().zip(pairs) {
            assert_eq!((&a["frame"], &a["category"]), (&b["frame"], &b["category"]));
            same(&a["iou"], &b["iou"], &format!("{case} {} {}", a["frame"], a["category"]));
        }
        assert!(ours["notes"].to_string().contains("it has no text feature"), "{}", ours["notes"]);
    }
    assert!(spread.iter().all(|m| (0.01..0.99).contains(m)), "a case that says nothing: {spread:?}");
    if oracle.python.is_some() {
        oracle.ask("pictures", &["pictures", &labels]);
        let folder = format!("{saved}-selected");
        let ours = s.metrics("lerf", &["--truth", "pictures"]);
        let theirs = oracle.ask("lerf pictures", &["lerf", &labels, &folder, "--truth", "pictures"]);
        same(&ours["figures"]["miou"], &theirs["miou"], "truth from JPEGs");
    }
    // Masks read back score as those that were rendered.
    let o = Command::new(env!("CARGO_BIN_EXE_eval"))
        .args(["lerf", "--predictions", &format!("{saved}-selected"), "--labels", &labels, "--out"])
        .arg(s.at("read"))
        .output()
        .unwrap();
    assert!(o.status.success(), "{}", String::from_utf8_lossy(&o.stderr));
    same(&read_json(&s.at("read/metrics.json"))["figures"]["miou"], &json!(spread[0]), "saved masks");

    let (geometry, instances, texts, scan) =
        (text(s.geometry()), text(s.instances()), text(s.texts()), text(s.scene()));
    let mut seen = Vec::new();
    for rest in [&["--association", "one-to-one"][..], &["--association", "nearest"]] {
        let ours = s.metrics("scannet", rest);
        let case = format!("scannet {}", rest.join(" "));
        let arguments = [&["scannet", &geometry, &instances, &texts, &scan], rest].concat();
        let theirs = oracle.ask(&case, &arguments);
        for set in ours["sets"].as_array().unwrap() {
            let size = set["size"].to_string();
            for figure in ["miou", "macc"] {
                same(&set[figure], &theirs["sets"][&size][figure], &format!("{case} {size} {figure}"));
            }
        }
        for figure in ["miou", "acc25", "acc50", "ap25", "ap50"] {
            same(&ours["instances"][figure], &theirs["instances"][figure], &format!("{case} instances {figure}"));
        }
        seen.push(ours["sets"][0]["miou"].to_string());
    }
    assert_ne!(seen[0], seen[1], "every rule gives another number");
    oracle.finish();
}

#[test]
fn both_rules_of_selection_stand_in_one_table() {
    let s = Scene::new();
    s.write_features();
    let (features, saved) = (s.features().display().to_string(), s.at("saved").display().to_string());
    let alone = s.metrics("lerf", &[]);
    assert_eq!(alone["rules"].as_array().unwrap().len(), 1);
    let m = s.metrics("lerf", &["--features", &features]);
    let (best, theirs) = (&m["rules"][0], &m["rules"][1]);
    assert_eq!((&best["name"], &theirs["name"]), (&json!("top1"), &json!("opengaussian")));
    assert_eq!(
        (&best["figures"], &alone["figures"]),
        (&m["figures"], &m["figures"]),
        "the figures are those of the first"
    );
    assert_ne!(best["figures"]["miou"], theirs["figures"]["miou"]);
    let table = std::fs::read_to_string(s.at("out/table.md")).unwrap();
    assert!(table.contains("top1** |") && table.contains("opengaussian** |"), "{table}");
    assert!(table.contains("outliers by neighbours left out"), "{table}");

    let ask = ["--features", &features, "--protocol", "opengaussian", "--save-predictions", &saved];
    let o = s.metrics("lerf", &ask);
    assert_eq!((&o["rules"][0], &o["rules"][1], &o["figures"]), (theirs, best, &theirs["figures"]));
    // Of the instances that 5 views matched the last two look alike: who selects one selects both.
    let k = Instances::read(s.instances()).unwrap().0.len() as u64;
    let selected = |name: &str, m: &Value| m["objects"][name]["instances"].clone();
    let pair = |v: &Value| v == &json!([k - 1, k - 2]) || v == &json!([k - 2, k - 1]);
    let objects = o["objects"].as_object().unwrap();
    assert!(objects.keys().any(|name| pair(&selected(name, &o))), "{objects:?}");
    assert!(objects.keys().all(|name| selected(name, &o).as_array().unwrap().iter().all(|i| i.as_u64() >= Some(2))));
    assert!(theirs["zeros"].to_string().contains("fewer than 100 of its Gaussians"), "{theirs}");
    // The masks that are saved are those of the figures.
    let labels = s.scene().join("label").display().to_string();
    let read = Command::new(env!("CARGO_BIN_EXE_eval"))
        .args(["lerf", "--predictions", &saved, "--labels", &labels, "--out"])
        .arg(s.at("read"))
        .output()
        .unwrap();
    assert!(read.status.success(), "{}", String::from_utf8_lossy(&read.stderr));
    let read = read_json(&s.at("read/metrics.json"));
    same(&read["figures"]["miou"], &theirs["figures"]["miou"], "saved masks");
    assert!(std::fs::read_to_string(s.at("read/table.md")).unwrap().contains("**masks of another program**"));

    let bad = |rest: &[&str], parts: &[&str]| failed(&s.run("lerf", rest), parts);
    bad(&["--protocol", "opengaussian"], &["--features: --protocol opengaussian joins", "found none"]);
    bad(&[&ask[..4], &["--top-k", "2"]].concat(), &["--top-k: --protocol opengaussian fixes it"]);
}

#[test]
fn rows_say_how_instances_were_made() {
    let s = Scene::new();
    s.write_features();
    let features = hash_file(s.features()).unwrap();
    // As cluster-match and feat-train leave them: provenance, and a record of each run beside its output.
    let (instances, made) = Instances::read(s.instances()).unwrap();
    let mut provenance = made.provenance().clone();
    provenance
        .inputs
        .extend([("features", &features), ("masks", &"maps".to_string())].map(|(k, v)| (k.into(), v.clone())));
    provenance.parameters = json!({"cluster": "free"});
    provenance.extra = Value::Null;
    instances.write(s.instances(), provenance.clone()).unwrap();
    std::fs::create_dir(s.at("masks")).unwrap();
    let record = |output: PathBuf, parameters: Value, inputs: Value, files: Value| {
        let record = json!({"program": "p", "version": "1", "revision": "", "program_hash": "", "parameters": parameters,
            "arguments": ["--masks", "gone/masks", "--features", s.features()], "inputs": inputs, "seed": 0, "threads": 1,
            "machine": stage::Machine::here(), "started": 0, "wall_seconds": 0.0, "cpu_seconds": null, "peak_rss_bytes": null,
            "memory_predicted_bytes": null, "skipped": [], "summary": null, "written": {"by": "p", "files": files}});
        std::fs::write(stage::RunRecord::path(output), record.to_string()).unwrap();
    };
    record(s.instances(), json!({}), json!(provenance.inputs), json!({}));
    let row = |expected: &str| {
        for command in ["lerf", "scannet"] {
            s.metrics(command, &[]);
            let table = std::fs::read_to_string(s.at("out/table.md")).unwrap();
            assert!(table.contains(&format!("| **{expected}, ")), "{expected}: {table}");
        }
        std::fs::read_to_string(s.at("out/table.md")).unwrap()
    };
    let table = row("unrecorded method, free clustering, given masks, given features");
    assert!(!table.contains("of LangSplat"), "{table}");
    let trained = json!({"preset": "paper", "contrastive": {"iterations": 2000}});
    record(s.features(), trained, json!({}), json!({"features.safetensors": features}));
    row("paper (2000 iterations), free clustering, given masks, given features");
    record(s.features(), json!({"preset": null}), json!({}), json!({"features.safetensors": features}));
    row("closed form, free clustering, given masks, given features");
    record(s.features(), json!({"preset": null}), json!({}), json!({"features.safetensors": "others"}));
    row("unrecorded method, free clustering, given masks, given features");
    // What mask-embed leaves in the folder of masks.
    let manifest = |name: &str, inputs: Value| {
        let manifest =
            json!({"format": "masks", "version": 1, "program": "mask-embed", "parameters": {}, "inputs": inputs});
        std::fs::write(s.at("masks").join(name), manifest.to_string()).unwrap();
    };
    manifest("masks.json", json!({"sam": "hash"}));
    manifest("features.json", json!({"masks": "maps"}));
    let table = row("unrecorded method, free clustering, SAM masks, CLIP features");
    assert!(table.contains("scene0000_00: there are no masks of LangSplat; those of SAM"), "{table}");
    assert!(table.contains("the masks have no features of LangSplat"), "{table}");
    let made = &read_json(&s.at("out/metrics.json"))["made"];
    assert_eq!((&made["clustering"], &made["masks"]), (&json!("free"), &json!("SAM")));
    // A record of another run says nothing.
    record(s.instances(), json!({}), json!({}), json!({}));
    row("unrecorded method, free clustering, unrecorded masks, unrecorded features");
}

#[test]
fn labels_of_another_program_are_scored_vertex_by_vertex() {
    let s = Scene::new();
    let ply = s.scene().join("scene0000_00_vh_clean_2.labels.ply");
    let (_, truth) = gs_scene::ply::read_labels(&ply, "label", [0.0; 3]).unwrap();
    let file = s.at("labels.npy");
    let run = |rest: &[&str]| {
        let mut c = Command::new(env!("CARGO_BIN_EXE_eval"));
        c.args(["scannet", "--predictions"]).arg(&file).arg("--labels").arg(s.scene());
        c.arg("--out").arg(s.at("said")).args(rest).output().unwrap()
    };
    let score = |labels: &[i32]| {
        gs_io::npy::write_i32(&file, &aview1(labels)).unwrap();
        let o = run(&[]);
        assert!(o.status.success(), "{}", String::from_utf8_lossy(&o.stderr));
        read_json(&s.at("said/metrics.json"))
    };
    let same_as_truth: Vec<i32> = truth.iter().map(|&l| l as i32).collect();
    let m = score(&same_as_truth);
    assert!(m["sets"].as_array().unwrap().iter().all(|set| set["miou"] == 1.0 && set["macc"] == 1.0), "{}", m["sets"]);
    assert!(m["made"].is_null() && m["instances"].is_null());
    let table = std::fs::read_to_string(s.at("said/table.md")).unwrap();
    assert!(table.contains("**labels of another program, mean over scenes** | 100.00 |"), "{table}");
    assert!(table.contains("vertex labels labels.npy ("), "{table}");
    // Chairs (5) are called walls (1), tables (7) nothing; vertices without a class of the set cost nothing whatever they get.
    let said: Vec<i32> = truth
        .iter()
        .map(|&l| match l {
            5 | 0 | 40 => 1,
            7 => -1,
            l => l as i32,
        })
        .collect();
    let m = score(&said);
    let count = |class: u32| truth.iter().filter(|&&l| l == class).count() as f64;
    assert!(count(5) > 0.0 && count(7) > 0.0);
    let class = |id: u32| {
        let classes = m["sets"][0]["classes"].as_array().unwrap();
        classes.iter().find(|c| c["id"] == id).map(|c| (c["iou"].clone(), c["recall"].clone())).unwrap()
    };
    same(&class(1).0, &json!(count(1) / (count(1) + count(5))), "walls");
    assert_eq!((class(1).1, class(5), class(7)), (json!(1.0), (json!(0.0), json!(0.0)), (json!(0.0), json!(0.0))));
    let present: Vec<u32> = NAMES.iter().map(|n| n.0).filter(|&id| count(id) > 0.0).collect();
    let expected = (present.len() as f64 - 2.0) / present.len() as f64;
    same(&m["sets"][0]["macc"], &json!(expected), "two of the classes are lost");
    assert!(m["notes"].to_string().contains("count as missed"), "{}", m["notes"]);

    failed(&run(&["--scene", "x"]), &[]);
    std::fs::write(&file, "1 2 3").unwrap();
    failed(&run(&[]), &["labels.npy: not a label per vertex; found 3"]);
}

#[test]
fn tables_join_scenes_and_refuse_what_does_not_fit() {
    let s = Scene::new();
    s.metrics("scannet", &[]);
    std::fs::rename(s.at("out"), s.at("a")).unwrap();
    let first = read_json(&s.at("a/metrics.json"));
    std::fs::create_dir(s.at("b")).unwrap();
    let mut second = first.clone();
    second["scene"] = json!("scene0062_00");
    let put = |v: &Value| std::fs::write(s.at("b/metrics.json"), v.to_string()).unwrap();
    put(&second);
    let table = |folders: &[&str]| {
        let mut c = Command::new(env!("CARGO_BIN_EXE_eval"));
        c.arg("table").args(folders.iter().map(|f| s.at(f))).arg("--out").arg(s.at("t")).output().unwrap()
    };
    let o = table(&["a", "b"]);
    assert!(o.status.success(), "{}", String::from_utf8_lossy(&o.stderr));
    let printed = String::from_utf8(o.stdout).unwrap();
    assert!(printed.contains("| CAGS | 32.60 | 48.90 | 41.10 | 62.00 | 54.80 | 75.90 | its paper |"), "{printed}");
    assert!(printed.contains("not the 10") && printed.contains("text features table of"), "{printed}");
    let t = read_json(&s.at("t/metrics.json"));
    same(&t["mean_over_scenes"]["19"]["miou"], &first["sets"][0]["miou"], "twice the same scene");
    same(&t["pooled"]["19"]["macc"], &first["sets"][0]["macc"], "pooled with itself");
    let cags = t["tables"][0]["rows"].as_array().unwrap().iter().find(|r| r["name"] == "CAGS").unwrap();
    assert_eq!((&cags["percent"]["10 mIoU"], &cags["source"]), (&json!(54.8), &json!("its paper")));
    assert_eq!(t["tables"][1]["rows"][1]["name"], "scene0062_00");
    let page = std::fs::read_to_string(s.at("t/table.html")).unwrap();
    assert!(page.contains("its paper") && page.contains("54.80") && page.contains("scene0062_00"));
    let refused = |second: &str, part: &str| failed(&table(&["a", second]), &[part]);
    refused("a", "a scene is given twice");
    second["sets"][0]["confusion"]["weights"] = json!([1.0]);
    put(&second);
    refused("b", "a confusion matrix does not fit");
    put(&json!({"protocol": "x"}));
    refused("b", "protocol: not metrics of a protocol");
    s.metrics("lerf", &[]);
    refused("out", "two protocols");
}

#[test]
fn instances_are_scored_where_there_is_no_text() {
    let s = Scene::new();
    let with = s.metrics("scannet", &[]);
    let run = |text: bool| {
        let _ = std::fs::remove_dir_all(s.at("out"));
        let mut c = Command::new(env!("CARGO_BIN_EXE_eval"));
        c.arg("scannet").arg("--instances").arg(s.instances()).arg("--geometry").arg(s.geometry());
        c.arg("--scene").arg(s.scene()).arg("--out").arg(s.at("out"));
        if text {
            c.arg("--text-features").arg(s.texts());
        }
        let o = c.output().unwrap();
        assert!(o.status.success(), "{}", String::from_utf8_lossy(&o.stderr));
        (String::from_utf8(o.stdout).unwrap(), read_json(&s.at("out/metrics.json")))
    };
    let scored = |(printed, without): (String, Value), why: &str| {
        assert_eq!(without["instances"], with["instances"]);
        assert_eq!(without["sets"], json!([]));
        // One table, of our figures alone, and one line that says why there is no other.
        let heads: Vec<&str> =
            printed.lines().filter(|l| l.starts_with("| Scan") || l.starts_with("| Methods")).collect();
        assert_eq!(heads, ["| Scan | instance mIoU | @25 | @50 | AP25 | AP50 |"], "{printed}");
        assert!(!printed.contains("19 mIoU") && !printed.contains("Published rows"), "{printed}");
        assert_eq!(printed.matches("no class scores").count(), 1, "{printed}");
        assert!(printed.contains(why), "{printed}");
    };
    scored(run(false), "neither --clip nor --text-features was given");
    let (mut i, _) = Instances::read(s.instances()).unwrap();
    i.descriptor = Array2::default((i.len(), 0));
    i.write(s.instances(), provenance(&s.geometry(), &s.scene())).unwrap();
    scored(run(true), "the instances have no language features");

    // A table of such scans is one of instances, too, with their mean.
    std::fs::rename(s.at("out"), s.at("a")).unwrap();
    let mut second = read_json(&s.at("a/metrics.json"));
    second["scene"] = json!("scene0062_00");
    second["instances"]["miou"] = json!(0.0);
    std::fs::create_dir(s.at("b")).unwrap();
    std::fs::write(s.at("b/metrics.json"), second.to_string()).unwrap();
    let mut c = Command::new(env!("CARGO_BIN_EXE_eval"));
    let o = c.arg("table").args(["a", "b"].map(|n| s.at(n))).arg("--out").arg(s.at("t")).output().unwrap();
    assert!(o.status.success(), "{}", String::from_utf8_lossy(&o.stderr));
    let printed = String::from_utf8(o.stdout).unwrap();
    assert!(printed.contains("| scene0062_00 | 0.00 |") && printed.contains("| mean over scenes |"), "{printed}");
    let mean = read_json(&s.at("t/metrics.json"))["instances_percent"]["instance mIoU"].as_f64().unwrap();
    assert!((mean - 50.0 * with["instances"]["miou"].as_f64().unwrap()).abs() < 1e-9);
}

#[test]
fn damaged_gaussians_leave_the_evaluation_of_a_scan() {
    let s = Scene::new();
    let mut g = gs_scene::ply::read_gaussians(s.geometry()).unwrap();
    (g.means[5][1], g.log_scales[6][0]) = (f32::NAN, f32::NAN);
    gs_scene::ply::write_gaussians(s.geometry(), &g, &[]).unwrap();
    let (mut i, _) = Instances::read(s.instances()).unwrap();
    (i.label[5], i.label[6]) = (-1, -1);
    i.write(s.instances(), provenance(&s.geometry(), &s.scene())).unwrap();
    // By number they leave with their vertices, faint or not; their neighbours speak for the place.
    let by_number = || s.metrics("scannet", &["--association", "one-to-one"]);
    let before = by_number();
    let (notes, faint) = (before["notes"].to_string(), (0..g.len()).filter(|n| n % 11 == 0).count());
    assert!(notes.contains(&format!("{} of {} vertices leave the evaluation", faint + 2, g.len())), "{notes}");
    // What they were predicted as is then no matter.
    (0..g.len()).step_by(11).for_each(|n| i.label[n] = n as i32 % 3);
    i.write(s.instances(), provenance(&s.geometry(), &s.scene())).unwrap();
    assert_eq!(by_number()["instances"], before["instances"]);
    let notes = s.metrics("scannet", &["--association", "nearest"])["notes"].to_string();
    assert!(!notes.contains("leave the evaluation"), "{notes}");
    let said = String::from_utf8(s.run("scannet", &["--association", "nearest"]).stderr).unwrap();
    assert!(said.contains(&format!("skipped 2 of {} Gaussians: damaged", g.len())), "{said}");
}

#[test]
fn scans_that_do_not_fit_are_refused() {
    let s = Scene::new();
    let bad = |part: &str| failed(&s.run("scannet", &[]), &[part]);
    let labels = s.scene().join("scene0000_00_vh_clean_2.labels.ply");
    let whole = std::fs::read(&labels).unwrap();
    let mut moved = whole.clone();
    let at = moved.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    moved[at..at + 4].copy_from_slice(&100.0f32.to_le_bytes());
    std::fs::write(&labels, &moved).unwrap();
    bad("vertex 0: the Gaussian of this number lies elsewhere");
    s.metrics("scannet", &["--association", "nearest"]);
    std::fs::write(&labels, &whole[..whole.len() - 1]).unwrap();
    bad("cut short");
    std::fs::remove_file(&labels).unwrap();
    bad("*.labels.ply: not one file of labelled vertices; found 0");
}

#[test]
fn a_linked_scene_has_the_name_and_the_labels_of_its_link() {
    let s = Scene::new();
    // The disc calls it otherwise, and has labels of another scene beside it.
    let (store, data) = (s.at("store"), s.at("data"));
    std::fs::create_dir_all(store.join("label/disc-7")).unwrap();
    std::fs::create_dir_all(data.join("label")).unwrap();
    std::fs::rename(s.scene(), store.join("disc-7")).unwrap();
    std::fs::rename(store.join("disc-7/label"), data.join("label/my_room")).unwrap();
    let link = data.join("my_room");
    std::os::unix::fs::symlink("../store/disc-7", &link).unwrap();
    let run = |command: &str, scene: &Path| {
        let _ = std::fs::remove_dir_all(s.at("out"));
        let mut c = Command::new(env!("CARGO_BIN_EXE_eval"));
        c.arg(command)
            .arg("--instances")
            .arg(s.instances())
            .arg("--geometry")
            .arg(s.geometry())
            .arg("--scene")
            .arg(scene);
        c.arg("--text-features").arg(s.texts()).arg("--out").arg(s.at("out")).current_dir(&link);
        let o = c.output().unwrap();
        assert!(o.status.success(), "{}", String::from_utf8_lossy(&o.stderr));
        read_json(&s.at("out/metrics.json"))
    };
    for scene in [link.clone(), link.join("."), data.join("label/../my_room")] {
        let m = run("lerf", &scene);
        assert_eq!((&m["scene"], &m["features"]["labels"]), (&json!("my_room"), &json!("my_room")));
        assert!(m["pairs"].as_array().unwrap().len() >= 8);
        assert_eq!(run("scannet", &scene)["scene"], "my_room");
    }
}

#[test]
fn the_truth_of_a_scan_is_checked_with_its_texts() {
    let s = Scene::new();
    let run = || {
        let mut c = Command::new(env!("CARGO_BIN_EXE_eval"));
        c.args(["check", "--benchmark", "scannet", "--scene"]).arg(s.scene());
        c.arg("--text-features").arg(s.texts()).output().unwrap()
    };
    let o = run();
    let said = String::from_utf8(o.stdout).unwrap();
    assert!(o.status.success() && said.contains("text features of all 19 texts, dimension 24"), "{said}");
    let segs = s.scene().join("scene0000_00_vh_clean_2.0.010000.segs.json");
    std::fs::write(segs, r#"{"segIndices": [1, 2]}"#).unwrap();
    failed(&run(), &["not a segment per vertex"]);
    let labels = s.scene().join("scene0000_00_vh_clean_2.labels.ply");
    let whole = std::fs::read(&labels).unwrap();
    std::fs::write(&labels, &whole[..whole.len() - 1]).unwrap();
    failed(&run(), &["labels.ply", "cut short"]);
}

#[test]
fn a_benchmark_scene_asks_its_own_table() {
    let mut s = Scene::new();
    std::fs::rename(s.scene(), s.at("teatime")).unwrap();
    s.name = "teatime";
    let notes = s.metrics("lerf", &[])["notes"].to_string();
    // frame_00001, 3 and 5 are labelled; none is teatime's.
    assert!(notes.contains("not in the benchmark") && notes.contains("published numbers have 59"), "{notes}");
    assert!(notes.contains("no labelled object was scored"), "{notes}");
    let label = s.scene().join("label");
    std::fs::rename(label.join("frame_00001.json"), label.join("frame_00002.json")).unwrap();
    let m = s.metrics("lerf", &[]);
    assert!(m["pairs"].as_array().unwrap().iter().all(|p| p["iou"] == 0.0));
    assert!(m["notes"].to_string().contains("not in the benchmark's table of queries"), "{}", m["notes"]);
}
