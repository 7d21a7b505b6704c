//! A small run, and a server of it.
#![allow(dead_code, reason = "each test uses a part of this")]

use artifacts::{Features, Instances, OrientedBox, TreeEdge, role};
use glam::DVec3;
use gs_io::{Provenance, hash_file};
use gs_scene::dataset::{self, LoadOptions};
use gs_scene::{Camera, Gaussians, Image};
use ndarray::arr2;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

pub const SIZE: (u32, u32) = (64, 48);

/// A run of two balls, one before the other, seen by two cameras; instance 0 is in front. Ball 1 has two parts.
pub struct Run {
    pub dir: tempfile::TempDir,
    /// Where texts come from: an option and its value.
    texts: [String; 2],
}

pub fn gaussians() -> Gaussians {
    let mut g = Gaussians::default();
    for (x, z, scale) in [(0.0, 2.0, 0.1f32), (0.0, 4.0, 0.4), (0.9, 4.0, 0.4), (0.0, 9.0, 0.1)] {
        g.means.push([x, 0.0, z]);
        g.log_scales.push([scale.ln(); 3]);
        g.rotations.push([1.0, 0.0, 0.0, 0.0]);
        g.opacity_logits.push(if z > 8.0 { -30.0 } else { 6.0 });
        g.sh.extend([0.5, 0.0, -0.5]);
    }
    g
}

pub fn camera(x: f64) -> Camera {
    Camera::look_at(DVec3::new(x, 0.0, 0.0), DVec3::new(0.0, 0.0, 4.0), -DVec3::Y, SIZE.0, SIZE.1, 1.0)
}

/// A click on a pixel of the first view.
pub fn click(x: u32, y: u32, hidden: &[u32]) -> Value {
    let c = camera(0.0);
    let camera = json!({"width": SIZE.0, "height": SIZE.1, "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy,
        "rotation": c.rotation.transpose().to_cols_array(), "translation": c.translation.to_array()});
    json!({"camera": camera, "x": x, "y": y, "hidden": hidden})
}

impl Run {
    pub fn new() -> Self {
        let dir = tempfile::tempdir().unwrap();
        let texts = ["--text-features".into(), dir.path().join("text.json").display().to_string()];
        let run = Self { dir, texts };
        let (g, scene) = (gaussians(), run.scene());
        std::fs::create_dir_all(scene.join("images")).unwrap();
        std::fs::create_dir_all(run.out()).unwrap();
        let geometry = run.out().join("geometry.ply");
        gs_scene::ply::write_gaussians(&geometry, &g, &[]).unwrap();
        let mut frames = Vec::new();
        for (k, x) in [0.0, 0.5].into_iter().enumerate() {
            let camera = camera(x);
            let rgb = gs_raster::render(&g, &camera, &gs_raster::RasterOptions::default()).rgb;
            let name = format!("images/f{k}.png");
            Image { width: SIZE.0, height: SIZE.1, rgb, alpha: None }.write_png(scene.join(&name)).unwrap();
            frames.push((name, camera));
        }
        dataset::write_transforms(&scene.join("transforms.json"), &frames, [0.0; 3]).unwrap();
        let provenance = || run.provenance();
        let edge = |parent, child, instance| TreeEdge { parent, child, lambda: 1.0, size: 1, instance };
        let instances = Instances {
            label: vec![0, 1, 1, -1],
            descriptor: arr2(&[[1.0, 0.0], [0.0, 1.0]]),
            support: vec![2, 2],
            score: vec![0.9, 0.8],
            count: vec![1, 2],
            centroid: vec![g.means[0], [0.45, 0.0, 4.0]],
            bbox_min: vec![g.means[0], g.means[1]],
            bbox_max: vec![g.means[0], g.means[2]],
            oriented: vec![
                OrientedBox {
                    axes: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
                    ..Default::default()
                };
                2
            ],
            views: vec!["f0".into(), "f1".into()],
            matches: vec![
                artifacts::Match { instance: 0, view: 0, mask: 1, score: 0.9, visible: 9.0 },
                artifacts::Match { instance: 1, view: 1, mask: 2, score: 0.8, visible: 9.0 },
            ],
            tree: vec![edge(10, 11, 0), edge(10, 12, 1), edge(12, 13, -1), edge(12, 14, -1)],
            node: vec![11, 13, 14, -1],
            ..Instances::default()
        };
        instances.write(run.out().join("instances.safetensors"), provenance()).unwrap();
        let values = arr2(&[[1.0, 0.0], [0.0, 1.0], [0.1, 0.9]]);
        let features = Features { kept: vec![0, 1, 2], values };
        features.write(run.out().join("features.safetensors"), provenance()).unwrap();
        std::fs::write(run.dir.path().join("text.json"), r#"{"near ball": [1, 0], "far ball": [0, 1]}"#).unwrap();
        run
    }

    /// What the run was made from.
    fn provenance(&self) -> Provenance {
        let dataset = dataset::load(&self.scene(), &LoadOptions::default()).unwrap().hash().unwrap();
        let geometry = hash_file(self.out().join("geometry.ply")).unwrap();
        let inputs = [(role::GEOMETRY.to_string(), geometry), (role::DATASET.to_string(), dataset)];
        Provenance { inputs: BTreeMap::from(inputs), ..Provenance::default() }
    }

    /// Says that the instances are of the photographs as they are now.
    pub fn sign(&self) {
        let path = self.out().join("instances.safetensors");
        Instances::read(&path).unwrap().0.write(&path, self.provenance()).unwrap();
    }

    /// The run with a language model whose every answer takes most of a second.
    pub fn with_slow_words() -> Self {
        let mut run = Self::new();
        let clip = run.dir.path().join("clip");
        std::fs::create_dir(&clip).unwrap();
        for name in ["text.onnx", "clip.json"] {
            std::fs::copy(Path::new(env!("CARGO_MANIFEST_DIR")).join("testdata/slow").join(name), clip.join(name))
                .unwrap();
        }
        run.texts = ["--clip".into(), clip.display().to_string()];
        run
    }

    /// What a vocabulary calls the balls: `names.json`, about instances of this hash.
    pub fn write_names(&self, instances: &str) {
        let naming = |instance: u32, name: &str, sure: bool| json!({"instance": instance, "names": [{"name": name, "score": 0.9}], "margin": 0.1, "sure": sure});
        let names = json!({"format": "names", "version": 1, "instances": instances, "source": "test", "model": "m",
            "vocabulary": "v", "words": 3, "by_chance": 0.1, "named": [naming(0, "sun", true), naming(1, "planet", false)]});
        std::fs::write(self.out().join("names.json"), names.to_string()).unwrap();
    }

    /// The content hash of the instances.
    pub fn instances(&self) -> String {
        Instances::read(self.out().join("instances.safetensors")).unwrap().1.hash().into()
    }

    pub fn scene(&self) -> PathBuf {
        self.dir.path().join("scene")
    }

    pub fn out(&self) -> PathBuf {
        self.dir.path().join("out")
    }

    pub fn arguments(&self, command: &str) -> Vec<String> {
        let at = |p: &Path| p.display().to_string();
        let (out, scene) = (self.out(), self.scene());
        let pairs = [("--run-dir", at(&out)), ("--scene", at(&scene)), ("--geometry", at(&out.join("geometry.ply")))];
        let pairs = pairs.into_iter().flat_map(|(option, value)| [option.to_string(), value]);
        [command.to_string()].into_iter().chain(pairs).chain(self.texts.clone()).collect()
    }

    pub fn run(&self, command: &str, more: &[&str]) -> Output {
        Command::new(env!("CARGO_BIN_EXE_explore")).args(self.arguments(command)).args(more).output().unwrap()
    }

    pub fn serve(&self, more: &[&str]) -> Server {
        let mut command = Command::new(env!("CARGO_BIN_EXE_explore"));
        let command = command.args(self.arguments("serve")).args(["--port", "0"]).args(more).stderr(Stdio::piped());
        let mut child = command.spawn().unwrap();
        let lines = BufReader::new(child.stderr.take().unwrap()).lines().map_while(Result::ok);
        let url = lines.into_iter().find_map(|l| Some(l.split_once("http://")?.1.split(' ').next()?.to_string()));
        let (host, path) = url
            .expect("the server says where it is")
            .split_once('/')
            .map(|(h, p)| (h.to_string(), format!("/{p}")))
            .unwrap();
        Server { child, host, path }
    }
}

/// The version in the head of an answer; empty where there is none.
fn tag(head: &str) -> String {
    let tag = head.lines().find_map(|line| line.strip_prefix("etag: "));
    tag.unwrap_or_default().to_string()
}

/// Status, headers and body of an answer; `headers` end with line breaks.
pub fn http(server: &str, method: &str, path: &str, headers: &str, body: &str) -> (u16, String, Vec<u8>) {
    let mut stream = TcpStream::connect(server).unwrap();
    let host = if headers.contains("Host:") { String::new() } else { format!("Host: {server}\r\n") };
    let length = body.len();
    write!(
        stream,
        "{method} {path} HTTP/1.1\r\n{host}Connection: close\r\nContent-Length: {length}\r\n{headers}\r\n{body}"
    )
    .unwrap();
    let mut stream = BufReader::new(stream);
    let mut head = String::new();
    while !head.ends_with("\r\n\r\n") {
        assert_ne!(stream.read_line(&mut head).unwrap(), 0, "an answer that ends in its head: {head}");
    }
    let status = head.split(' ').nth(1).unwrap().parse().unwrap();
    let head = head.to_lowercase();
    // Some servers wait for us to close.
    let length = head.lines().find_map(|line| line.strip_prefix("content-length:")?.trim().parse().ok());
    let mut body = Vec::new();
    stream.take(length.unwrap_or(u64::MAX)).read_to_end(&mut body).unwrap();
    (status, head, body)
}

pub struct Server {
    child: Child,
    pub host: String,
    pub path: String,
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Server {
    /// Most memory that the server has had so far, in bytes; on Linux only.
    pub fn peak(&self) -> u64 {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.child.id())).unwrap();
        let peak = status.lines().find_map(|l| l.strip_prefix("VmHWM:")).unwrap();
        1024 * peak.trim().trim_end_matches(" kB").parse::<u64>().unwrap()
    }

    /// What the server answers to a request ([`http`]).
    pub fn ask(&self, method: &str, path: &str, headers: &str, body: &str) -> (u16, String, Vec<u8>) {
        http(&self.host, method, path, headers, body)
    }

    /// Sends edits that were made from a version; status, the version that there is then, and what is said.
    pub fn put_edits(&self, edits: &Value, of: Option<&str>) -> (u16, String, Value) {
        let headers = of.map_or(String::new(), |of| format!("If-Match: {of}\r\n"));
        let (status, head, body) = self.ask("PUT", "/edits", &headers, &edits.to_string());
        (status, tag(&head), serde_json::from_slice(&body).unwrap_or_default())
    }

    /// The edits that there are, and their version.
    pub fn edits(&self) -> (Value, String) {
        let (status, head, body) = self.ask("GET", "/edits", "", "");
        assert_eq!(status, 200);
        (serde_json::from_slice::<Value>(&body).unwrap()["edits"].take(), tag(&head))
    }

    pub fn get(&self, path: &str) -> (u16, Vec<u8>) {
        let (status, _, body) = self.ask("GET", path, "", "");
        (status, body)
    }

    pub fn json(&self, method: &str, path: &str, body: &Value) -> Value {
        let (status, _, answer) = self.ask(method, path, "Content-Type: application/json\r\n", &body.to_string());
        assert_eq!(status, 200, "{path}: {}", String::from_utf8_lossy(&answer));
        serde_json::from_slice(&answer).unwrap()
    }
}
