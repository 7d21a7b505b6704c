//! A scene of two balls above a floor, small enough to know everything about it: photographs rendered from the
//! Gaussians themselves, truth and labels in closed form.

use artifacts::{
    Features, Instances, MaskMaps, Match, OrientedBox, TrueObject, TruePart, TruePoints, TrueScene, maps_path, role,
};
use glam::DVec3;
use gs_io::{Provenance, hash_file};
use gs_raster::RasterOptions;
use gs_scene::dataset::{self, LoadOptions};
use gs_scene::{Camera, Gaussians, Image};
use ndarray::{Array2, Array3};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// Arguments of a query, and of a score, with the table of texts.
pub const TABLE: &str = "--text-features|{}/text.json|--out|{}/out";
pub const SCORE: &str = "--text-features|{}/text.json|--out|{}/score.json";
pub const WIDTH: u32 = 96;
pub const HEIGHT: u32 = 72;
pub const VIEWS: usize = 9;
/// Centres of the red and the blue ball.
pub const CENTRES: [[f64; 3]; 2] = [[-0.6, 0.0, 0.5], [0.6, 0.0, 0.5]];
const SIGMA: f64 = 0.3;

/// What an artifact says that was made from these.
pub fn provenance(geometry: &Path, scene: &Path) -> Provenance {
    let dataset = dataset::load(scene, &LoadOptions::default()).unwrap().hash().unwrap();
    let geometry = hash_file(geometry).unwrap();
    let inputs = BTreeMap::from([(role::GEOMETRY.to_string(), geometry), (role::DATASET.to_string(), dataset)]);
    Provenance { inputs, ..Provenance::default() }
}

pub struct Fixture {
    dir: tempfile::TempDir,
}

impl Fixture {
    /// Everything a finished run has; `language` is the dimension of the descriptors, 2 or 0.
    pub fn new(language: usize) -> Self {
        let f = Self { dir: tempfile::tempdir().unwrap() };
        let (scene, run) = (f.scene(), f.run());
        for folder in [scene.join("images"), scene.join("label"), scene.join("truth"), run] {
            std::fs::create_dir_all(folder).unwrap();
        }
        let g = gaussians();
        gs_scene::ply::write_gaussians(f.geometry(), &g, &[]).unwrap();
        let mut frames = Vec::new();
        for (i, camera) in cameras().iter().enumerate() {
            let name = stem(i);
            let out = gs_raster::render(&g, camera, &RasterOptions::default());
            let image = Image { width: WIDTH, height: HEIGHT, rgb: out.rgb, alpha: None };
            image.write_png(scene.join(format!("images/{name}.png"))).unwrap();
            frames.push((format!("images/{name}.png"), camera.clone()));
            f.write_masks(i, camera);
        }
        dataset::write_transforms(&scene.join("transforms.json"), &frames, [0.0; 3]).unwrap();
        for i in [1, 4] {
            f.write_label(i, &[("red ball", 0), ("blue ball", 1)], (WIDTH, HEIGHT));
        }
        f.write_truth();
        f.write_instances(language, |i| if i < 2 { i as i32 } else { 2 });
        f.write_features(&g);
        std::fs::write(f.table(), r#"{"red ball": [1, 0], "blue ball": [0, 2], "thing": [0.7, 0.7]}"#).unwrap();
        f
    }

    pub fn path(&self) -> &Path {
        self.dir.path()
    }
    pub fn scene(&self) -> PathBuf {
        self.path().join("balls")
    }
    pub fn run(&self) -> PathBuf {
        self.path().join("run")
    }
    pub fn geometry(&self) -> PathBuf {
        self.run().join("geometry.ply")
    }
    pub fn instances(&self) -> PathBuf {
        self.run().join("instances.safetensors")
    }
    pub fn table(&self) -> PathBuf {
        self.path().join("text.json")
    }

    pub fn provenance(&self) -> Provenance {
        provenance(&self.geometry(), &self.scene())
    }

    /// Instances with `label(group)` for the Gaussians of group 0 (red), 1 (blue), 2 (floor).
    pub fn write_instances(&self, dim: usize, label: impl Fn(usize) -> i32) {
        let all = [[1.0, 0.0], [0.0, 1.0], [-0.6, -0.8]];
        self.write_described(&all.map(|d| d[..dim].to_vec()), label);
    }

    /// The same with descriptors of one's own.
    fn write_described(&self, descriptors: &[Vec<f32>; 3], label: impl Fn(usize) -> i32) {
        let k = 3;
        let instances = Instances {
            label: groups().into_iter().map(label).collect(),
            descriptor: Array2::from_shape_vec((k, descriptors[0].len()), descriptors.concat()).unwrap(),
            support: vec![5, 4, 3],
            score: vec![0.8; k],
            count: vec![1, 1, 81],
            centroid: vec![[0.0; 3]; k],
            bbox_min: vec![[-1.0; 3]; k],
            bbox_max: vec![[1.0; 3]; k],
            oriented: vec![OrientedBox::default(); k],
            node: vec![-1; groups().len()],
            views: (0..VIEWS).map(stem).collect(),
            matches: vec![
                Match { instance: 0, view: 1, mask: 0, score: 0.9, ..Match::default() },
                Match { instance: 0, view: 5, mask: 0, score: 0.8, ..Match::default() },
                Match { instance: 0, view: 7, mask: 0, score: 0.2, ..Match::default() },
            ],
            ..Instances::default()
        };
        instances.write(self.instances(), self.provenance()).unwrap();
    }

    /// Makes instance 1 the one of this feature; instance 2 has none.
    pub fn write_found(&self, feature: Vec<f32>) {
        let opposite: Vec<f32> = feature.iter().map(|v| -v).collect();
        let none = vec![0.0; feature.len()];
        self.write_described(&[opposite, feature, none], |g| g as i32);
    }

    /// Changes the instances, or makes them those of a geometry that was changed.
    pub fn change_instances(&self, change: impl Fn(&mut Instances)) {
        let (mut instances, _) = Instances::read(self.instances()).unwrap();
        change(&mut instances);
        instances.write(self.instances(), self.provenance()).unwrap();
    }

    fn write_features(&self, g: &Gaussians) {
        let kept: Vec<u32> = (0..g.len() as u32).collect();
        let values = groups().iter().map(|&i| [i as f32, (i * i) as f32, 1.0]).collect::<Vec<_>>().into();
        Features { kept, values }.write(self.run().join("features.safetensors"), self.provenance()).unwrap();
    }

    fn write_masks(&self, i: usize, camera: &Camera) {
        let id = |(level, y, x)| {
            let inside = |centre| {
                let (cx, cy, r) = disc(camera, centre);
                (x as f64 + 0.5 - cx).hypot(y as f64 + 0.5 - cy) < r
            };
            CENTRES.iter().rposition(inside).map_or(-1, |k| (2 * level + k) as i32)
        };
        let maps = MaskMaps { ids: Array3::from_shape_fn((4, HEIGHT as usize, WIDTH as usize), id) };
        maps.write(maps_path(self.scene().join("language_features"), &stem(i))).unwrap();
    }

    /// Labels of view `i`: discs around the balls, in an image of `size`.
    pub fn write_label(&self, i: usize, categories: &[(&str, usize)], size: (u32, u32)) {
        let camera = cameras()[i].resized(size.0, size.1);
        let objects: Vec<_> = categories
            .iter()
            .map(|&(category, ball)| {
                let (cx, cy, r) = disc(&camera, &CENTRES[ball]);
                let polygon: Vec<[f64; 2]> =
                    (0..64).map(|k| f64::from(k) / 64.0 * TAU).map(|a| [cx + r * a.cos(), cy + r * a.sin()]).collect();
                json!({"category": category, "group": 1, "segmentation": polygon, "bbox": [0, 0, 1, 1]})
            })
            .collect();
        let label = json!({"info": {"name": stem(i), "width": size.0, "height": size.1}, "objects": objects});
        std::fs::write(self.scene().join(format!("label/{}.json", stem(i))), label.to_string()).unwrap();
    }

    fn write_truth(&self) {
        let mut t = TruePoints::default();
        let mut add = |p: [f64; 3], id: i32| {
            t.position.push(p.map(|v| v as f32));
            t.instance.push(id);
            t.part.push(id);
            t.class.push(id);
        };
        for (id, c) in CENTRES.iter().enumerate() {
            for k in 0..50 {
                let a = f64::from(k) * 2.4;
                add([c[0] + SIGMA * a.cos(), c[1] + SIGMA * a.sin(), c[2]], id as i32);
            }
        }
        (0..100).for_each(|k| add([f64::from(k % 10) * 0.4 - 1.8, f64::from(k / 10) * 0.4 - 1.8, -0.2], 2));
        t.write(self.scene().join("truth/points.safetensors"), Provenance::default()).unwrap();
        let thing = |id: u32, name: &str| TrueObject {
            id,
            name: name.into(),
            class: "ball".into(),
            color: "red".into(),
            background: id == 2,
            parts: vec![TruePart { id, name: name.into() }],
        };
        let objects = vec![thing(0, "red ball"), thing(1, "blue ball"), thing(2, "floor")];
        TrueScene { objects, parameters: json!({}) }.write(self.scene().join("truth/scene.json")).unwrap();
    }

    /// The command, with the scene and what was found in it where it reads `inputs`.
    pub fn command(&self, command: &str, inputs: bool) -> Command {
        let mut c = Command::new(env!("CARGO_BIN_EXE_eval"));
        c.arg(command).current_dir(self.path());
        if inputs {
            c.arg("--instances").arg(self.instances()).arg("--geometry").arg(self.geometry());
            c.arg("--scene").arg(self.scene());
        }
        c
    }

    /// Runs `eval` with these arguments, `|` between them; `{}` stands for the fixture's folder, `<>` for `{}`.
    pub fn eval(&self, command: &str, arguments: &str) -> Output {
        let place = self.path().display().to_string();
        let inputs = ["query", "score", "lerf"].contains(&command) && !arguments.contains("--predictions");
        let arguments = arguments.split('|').map(|a| a.trim().replace("{}", &place).replace("<>", "{}"));
        self.command(command, inputs).args(arguments.filter(|a| !a.is_empty())).output().unwrap()
    }

    /// Runs `eval`, expects success, and gives what it printed.
    #[track_caller]
    pub fn good(&self, command: &str, arguments: &str) -> String {
        let o = self.eval(command, arguments);
        assert!(o.status.success(), "{}", String::from_utf8_lossy(&o.stderr));
        String::from_utf8(o.stdout).unwrap()
    }

    /// The answers of `eval query` with the table of texts, in the folder `out`.
    #[track_caller]
    pub fn query(&self, arguments: &str) -> Value {
        self.good("query", &format!("{TABLE}|{arguments}"));
        self.json("out/query.json")["queries"].clone()
    }

    /// The scores of `eval score` with the table of texts.
    #[track_caller]
    pub fn score(&self, arguments: &str) -> Value {
        self.good("score", &format!("{SCORE}|{arguments}"));
        self.json("score.json")
    }

    /// Runs `eval`, expects success and that standard error holds these parts.
    #[track_caller]
    pub fn warned(&self, command: &str, arguments: &str, parts: &[&str]) {
        let o = self.eval(command, arguments);
        let said = String::from_utf8(o.stderr).unwrap();
        assert!(o.status.success() && parts.iter().all(|part| said.contains(part)), "{parts:?}: {said}");
    }

    /// Runs `eval`, expects exit code 2 and one line of error that holds these parts.
    #[track_caller]
    pub fn bad(&self, command: &str, arguments: &str, parts: &[&str]) {
        failed(&self.eval(command, arguments), parts);
    }

    pub fn json(&self, path: &str) -> Value {
        read_json(&self.path().join(path))
    }
}

/// Expects exit code 2 and one line of error that holds these parts.
#[track_caller]
pub fn failed(o: &Output, parts: &[&str]) {
    let error = String::from_utf8_lossy(&o.stderr);
    assert!(o.status.code() == Some(2) && !error.contains("panicked"), "{error}");
    let lines: Vec<&str> = error.lines().filter(|l| l.contains("error: ")).collect();
    assert!(lines.len() == 1 && parts.iter().all(|part| lines[0].contains(part)), "{parts:?}: {error}");
}

pub fn read_json(path: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap()
}

pub fn stem(i: usize) -> String {
    format!("frame_{i:05}")
}

pub fn cameras() -> Vec<Camera> {
    let eye = |i: usize| {
        // A half circle in front: neither ball ever hides the other.
        let a = (i as f64 / (VIEWS - 1) as f64 - 0.5) * 1.2 - TAU / 4.0;
        DVec3::new(4.0 * a.cos(), 4.0 * a.sin(), 1.5)
    };
    (0..VIEWS).map(|i| Camera::look_at(eye(i), DVec3::new(0.0, 0.0, 0.3), DVec3::Z, WIDTH, HEIGHT, 0.8)).collect()
}

fn groups() -> Vec<usize> {
    [vec![0, 1], vec![2; 81]].concat()
}

fn gaussians() -> Gaussians {
    let mut g = Gaussians::default();
    let mut add = |p: [f64; 3], sigma: f64, color: [f32; 3]| {
        g.means.push(p.map(|v| v as f32));
        g.log_scales.push([sigma.ln() as f32; 3]);
        g.rotations.push([1.0, 0.0, 0.0, 0.0]);
        g.opacity_logits.push(6.0);
        g.sh.extend(color.map(|c| (c - 0.5) / gs_scene::SH_C0));
    };
    add(CENTRES[0], SIGMA, [0.9, 0.1, 0.1]);
    add(CENTRES[1], SIGMA, [0.1, 0.2, 0.9]);
    for k in 0..81 {
        add([f64::from(k % 9) * 0.5 - 2.0, f64::from(k / 9) * 0.5 - 2.0, -0.2], 0.2, [0.6, 0.6, 0.55]);
    }
    g
}

/// Where a ball's accumulated alpha is above 0.7 in the image: centre and radius in pixels.
fn disc(camera: &Camera, centre: &[f64; 3]) -> (f64, f64, f64) {
    let (x, y, z) = camera.project(DVec3::from_array(*centre));
    let s = ((camera.fx * SIGMA / z).powi(2) + 0.3).sqrt();
    let opacity = 1.0 / (1.0 + (-6.0f64).exp());
    (x, y, s * (2.0 * (opacity.min(0.99) / 0.7).ln()).sqrt())
}
