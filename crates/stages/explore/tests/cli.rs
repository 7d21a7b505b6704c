//! The program and its server, without a browser.

use artifacts::{Edits, Features, Instances, OrientedBox, TreeEdge, role};
use glam::DVec3;
use gs_io::{Provenance, hash_file};
use gs_scene::dataset::{self, LoadOptions};
use gs_scene::{Camera, Gaussians, Image};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

const SIZE: (u32, u32) = (64, 48);

/// A run of two balls, one before the other, seen by two cameras; instance 0 is in front. Ball 1 has two parts.
struct Run {
    dir: tempfile::TempDir,
}

fn gaussians() -> Gaussians {
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

fn camera(x: f64) -> Camera {
    Camera::look_at(DVec3::new(x, 0.0, 0.0), DVec3::new(0.0, 0.0, 4.0), -DVec3::Y, SIZE.0, SIZE.1, 1.0)
}

impl Run {
    fn new() -> Self {
        let run = Self { dir: tempfile::tempdir().unwrap() };
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
            let (r, eye) = (camera.rotation, camera.position());
            // OpenGL: y up, z backwards.
            let row = |i: usize| [r.row(0)[i], -r.row(1)[i], -r.row(2)[i], eye[i]];
            frames.push(json!({"file_path": name, "transform_matrix": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]}));
        }
        let c = camera(0.0);
        let transforms =
            json!({"w": SIZE.0, "h": SIZE.1, "fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "frames": frames});
        std::fs::write(scene.join("transforms.json"), transforms.to_string()).unwrap();
        let dataset = dataset::load(&scene, &LoadOptions::default()).unwrap().hash().unwrap();
        let inputs =
            [(role::GEOMETRY.to_string(), hash_file(&geometry).unwrap()), (role::DATASET.to_string(), dataset)];
        let provenance = || Provenance { inputs: BTreeMap::from(inputs.clone()), ..Provenance::default() };
        let edge = |parent, child, instance| TreeEdge { parent, child, lambda: 1.0, size: 1, instance };
        let instances = Instances {
            label: vec![0, 1, 1, -1],
            dim: 2,
            descriptor: vec![1.0, 0.0, 0.0, 1.0],
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
        let features =
            Features { kept: vec![0, 1, 2], dim: 2, values: vec![1.0, 0.0, 0.0, 1.0, 0.1, 0.9], ..Features::default() };
        features.write(run.out().join("features.safetensors"), provenance()).unwrap();
        std::fs::write(run.dir.path().join("text.json"), r#"{"near ball": [1, 0], "far ball": [0, 1]}"#).unwrap();
        run
    }

    fn scene(&self) -> PathBuf {
        self.dir.path().join("scene")
    }

    fn out(&self) -> PathBuf {
        self.dir.path().join("out")
    }

    fn arguments(&self, command: &str) -> Vec<String> {
        let at = |p: &Path| p.display().to_string();
        let (out, scene) = (self.out(), self.scene());
        let pairs = [("--run-dir", at(&out)), ("--scene", at(&scene)), ("--geometry", at(&out.join("geometry.ply")))];
        let pairs = pairs.into_iter().flat_map(|(option, value)| [option.to_string(), value]);
        let texts = ["--text-features".to_string(), at(&self.dir.path().join("text.json"))];
        [command.to_string()].into_iter().chain(pairs).chain(texts).collect()
    }

    fn run(&self, command: &str, more: &[&str]) -> Output {
        Command::new(env!("CARGO_BIN_EXE_explore")).args(self.arguments(command)).args(more).output().unwrap()
    }

    fn serve(&self, more: &[&str]) -> Server {
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

struct Server {
    child: Child,
    host: String,
    path: String,
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Server {
    /// Status, headers and body of an answer; `headers` end with line breaks.
    fn ask(&self, method: &str, path: &str, headers: &str, body: &str) -> (u16, String, Vec<u8>) {
        let mut stream = TcpStream::connect(&self.host).unwrap();
        let host = if headers.contains("Host:") { String::new() } else { format!("Host: {}\r\n", self.host) };
        write!(
            stream,
            "{method} {path} HTTP/1.1\r\n{host}Connection: close\r\nContent-Length: {}\r\n{headers}\r\n{body}",
            body.len()
        )
        .unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        let end = answer.windows(4).position(|w| w == b"\r\n\r\n").unwrap();
        let head = String::from_utf8_lossy(&answer[..end]).into_owned();
        let status = head.split(' ').nth(1).unwrap().parse().unwrap();
        (status, head.to_lowercase(), answer[end + 4..].to_vec())
    }

    fn get(&self, path: &str) -> (u16, Vec<u8>) {
        let (status, _, body) = self.ask("GET", path, "", "");
        (status, body)
    }

    fn json(&self, method: &str, path: &str, body: &Value) -> Value {
        let (status, _, answer) = self.ask(method, path, "Content-Type: application/json\r\n", &body.to_string());
        assert_eq!(status, 200, "{path}: {}", String::from_utf8_lossy(&answer));
        serde_json::from_slice(&answer).unwrap()
    }
}

fn click(x: u32, y: u32, hidden: &[u32]) -> Value {
    let c = camera(0.0);
    let camera = json!({"width": SIZE.0, "height": SIZE.1, "fx": c.fx, "fy": c.fy, "cx": c.cx, "cy": c.cy,
        "rotation": c.rotation.transpose().to_cols_array(), "translation": c.translation.to_array()});
    json!({"camera": camera, "x": x, "y": y, "hidden": hidden})
}

#[test]
fn the_server_answers_clicks_texts_edits_and_selections() {
    let run = Run::new();
    let server = run.serve(&[]);
    let scene = server.json("GET", "/scene.json", &Value::Null);
    assert_eq!((scene["gaussians"].as_u64(), scene["of"].as_u64()), (Some(3), Some(4)), "one is too faint to be drawn");
    assert_eq!(scene["cells"], json!([[0, 11], [1, 13], [1, 14], [-1, -1]]));
    assert_eq!(scene["words"]["names"], json!(["far ball", "near ball"]));
    assert_eq!(server.get("/scene.bin").1.len() as u64, scene["bytes"].as_u64().unwrap());

    // The near ball hides the far one; hidden, what is behind it is found.
    assert_eq!(server.json("POST", "/pick", &click(32, 24, &[]))["instance"], json!(0));
    let behind = server.json("POST", "/pick", &click(32, 24, &[0]));
    assert_eq!((&behind["instance"], &behind["cell"]), (&json!(1), &json!(1)));
    assert!((behind["position"][2].as_f64().unwrap() - 4.0).abs() < 0.01);
    assert_eq!(server.json("POST", "/pick", &click(1, 1, &[]))["instance"], Value::Null);

    let found = server.json("GET", "/find?text=far%20ball", &Value::Null);
    assert_eq!(found["scores"], json!([0.0, 1.0]));

    // Split and named: ids stay, the file says what was done, and the answers follow.
    let edits = json!([{"op": "split", "instance": 1}, {"op": "rename", "instance": 2, "name": "Moon"}]);
    let list = server.json("PUT", "/edits", &edits);
    assert_eq!(list.as_array().unwrap().len(), 3);
    assert_eq!(list[2]["name"], json!("Moon"));
    assert_eq!(Edits::read(run.out().join("instances.edits.json")).unwrap().edits.len(), 2);
    assert_eq!(server.json("GET", "/find?text=moon", &Value::Null)["named"], json!([2]));
    assert_eq!(server.json("POST", "/pick", &click(32, 24, &[0]))["instance"], json!(1));
    let right = camera(0.0).project(DVec3::new(0.9, 0.0, 4.0));
    assert_eq!(server.json("POST", "/pick", &click(right.0 as u32, right.1 as u32, &[]))["instance"], json!(2));

    // What is saved has every Gaussian of the cells, also those that the page does not draw.
    let ply = |body: &Value| {
        let (status, _, bytes) = server.ask("POST", "/selection", "", &body.to_string());
        assert_eq!(status, 200);
        std::fs::write(run.dir.path().join("s.ply"), bytes).unwrap();
        gs_scene::ply::read_gaussians(run.dir.path().join("s.ply")).unwrap()
    };
    assert_eq!(ply(&json!({"cells": [1, 2]})), gaussians().select(&[1, 2]));
    assert_eq!(ply(&json!({"cells": [1, 2], "others": true})), gaussians().select(&[0, 3]));

    for picture in ["/photograph/0", "/photograph/1", "/preview/1", "/preview/1", "/thumbnail/0", "/thumbnail/1"] {
        let (status, bytes) = server.get(picture);
        assert_eq!((status, &bytes[..2]), (200, &[0xff, 0xd8][..]), "{picture}");
    }
    drop(server);
    // The edits are there when the page is opened again.
    let again = run.serve(&[]).json("GET", "/scene.json", &Value::Null);
    assert_eq!((again["edits"].clone(), again["edited"].as_array().unwrap().len()), (edits, 3));
}

#[test]
fn bad_questions_are_refused_and_the_server_goes_on() {
    let run = Run::new();
    let server = run.serve(&[]);
    let mut far = click(0, 0, &[]);
    far["camera"]["fx"] = json!(0.0);
    for (method, path, body, expected) in [
        ("POST", "/pick", "{", "not understood"),
        ("POST", "/pick", &click(64, 0, &[])["x"].to_string(), "not understood"),
        ("POST", "/pick", &click(64, 0, &[]).to_string(), "outside of the picture"),
        ("POST", "/pick", &click(0, 0, &[99]).to_string(), "no such cell"),
        ("POST", "/pick", &far.to_string(), "not a camera"),
        ("GET", "/find?text=zebra", "", "no such text in the table"),
        ("PUT", "/edits", r#"[{"op": "split", "instance": 0}]"#, "edits[0].instance"),
        ("PUT", "/edits", r#"[{"op": "explode"}]"#, "not understood"),
        ("POST", "/selection", r#"{"cells": []}"#, "nothing is selected"),
        ("POST", "/selection", r#"{"cells": [4]}"#, "no such cell"),
        ("GET", "/photograph/2", "", "no such view"),
        ("GET", "/thumbnail/7", "", "no such instance"),
    ] {
        let (status, _, answer) = server.ask(method, path, "", body);
        let answer = String::from_utf8_lossy(&answer);
        assert!(status == 400 && answer.contains(expected), "{path} {body}: {status} {answer}");
    }
    assert!(!run.out().join("instances.edits.json").exists(), "a bad edit is not kept");
    // Nothing but the page and the scene is ever served.
    for path in [
        "/instances.safetensors",
        "/app/../../Cargo.toml",
        "/app/..%2f..%2fmain.rs",
        "/app/index.html",
        "/../out/geometry.ply",
        "//etc/passwd",
    ] {
        assert_eq!(server.get(path).0, 404, "{path}");
    }
    let (status, head, page) = server.ask("GET", "/", "", "");
    assert!(
        status == 200
            && head.contains("content-security-policy: default-src 'self'")
            && page.starts_with(b"<!doctype html>")
    );
    for stranger in ["Host: evil.example\r\n", "Origin: http://evil.example\r\n"] {
        assert_eq!(server.ask("GET", "/scene.json", stranger, "").0, 403, "{stranger}");
    }
    assert_eq!(server.get("/scene.json").0, 200);
}

#[test]
fn other_machines_need_the_secret() {
    let run = Run::new();
    let server = run.serve(&["--bind", "127.0.0.1"]);
    assert!(server.path.len() > 30, "{}", server.path);
    assert_eq!(server.get("/scene.json").0, 404);
    assert_eq!(server.get(&format!("/{:032x}/scene.json", 0)).0, 404);
    assert_eq!(server.get(&format!("{}scene.json", server.path)).0, 200);
    assert_eq!(server.get(&server.path).0, 200);
}

#[test]
fn one_file_holds_the_scene() {
    let run = Run::new();
    let out = run.dir.path().join("scene.html");
    let file = out.display().to_string();
    let made = run.run("page", &["--out", &file, "--text", "far ball", "--photographs", "1"]);
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let page = std::fs::read_to_string(&out).unwrap();
    assert!(page.contains("\"far ball\":[0.0,1.0]") && page.matches("data:image/jpeg").count() == 3);
    let first = std::fs::read(&out).unwrap();
    assert!(
        run.run("page", &["--out", &file, "--text", "far ball", "--photographs", "1", "--threads", "1"])
            .status
            .success()
    );
    assert_eq!(std::fs::read(&out).unwrap(), first, "the same bytes");
    // Somebody else's file stays.
    let theirs = run.dir.path().join("theirs.html");
    std::fs::write(&theirs, "mine").unwrap();
    let refused = run.run("page", &["--out", &theirs.display().to_string()]);
    assert!(refused.status.code() == Some(2) && std::fs::read(&theirs).unwrap() == b"mine");
    let said = |more: &[&str]| String::from_utf8_lossy(&run.run("page", more).stderr).into_owned();
    assert!(said(&["--out", &file, "--text", "zebra"]).contains("no such text in the table"));
}

#[test]
fn what_cannot_be_shown_is_said_in_one_line() {
    let run = Run::new();
    let refused = |change: &dyn Fn(), expected: &str| {
        change();
        let said = run.run("serve", &["--port", "0"]);
        let text = String::from_utf8_lossy(&said.stderr).into_owned();
        assert!(
            said.status.code() == Some(2) && text.contains(expected) && text.matches("error: ").count() == 1,
            "{text}"
        );
    };
    let edits = run.out().join("instances.edits.json");
    let other = r#"{"format": "instances.edits", "version": 1, "instances": "other", "edits": []}"#;
    refused(&|| std::fs::write(&edits, other).unwrap(), "these edits are about other instances");
    std::fs::remove_file(&edits).unwrap();
    let busy = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = busy.local_addr().unwrap().port().to_string();
    let said = run.run("serve", &["--port", &port]);
    assert!(said.status.code() == Some(2) && String::from_utf8_lossy(&said.stderr).contains("cannot listen"));
    let said = run.run("serve", &["--port", "0", "--memory-limit", "1M"]);
    assert!(said.status.code() == Some(2) && String::from_utf8_lossy(&said.stderr).contains("--max-gaussians"));
    let image = run.scene().join("images/f1.png");
    refused(&|| std::fs::copy(run.scene().join("images/f0.png"), &image).map(drop).unwrap(), "dataset");
    refused(&|| std::fs::write(run.out().join("geometry.ply"), "ply").unwrap(), "geometry");
    refused(&|| std::fs::remove_file(run.out().join("instances.safetensors")).unwrap(), "the run is not finished");
}
