//! `gs-geom views` through the program: a ball from all sides, a room from within, and what is refused.

mod common;

use common::{Folder, json, refused, succeeds};
use glam::{DQuat, DVec3};
use gs_scene::dataset::{self, Format, LoadOptions};
use gs_scene::{Gaussians, ply};
use serde_json::Value;
use std::path::Path;

/// Flat Gaussians at places with normals.
fn flat(of: &[(DVec3, DVec3)], scale: f64) -> Gaussians {
    let n = of.len();
    let turn = |normal: DVec3| DQuat::from_rotation_arc(DVec3::Z, normal);
    Gaussians {
        means: of.iter().map(|p| p.0.as_vec3().to_array()).collect(),
        log_scales: vec![[scale.ln() as f32, scale.ln() as f32, (0.05 * scale).ln() as f32]; n],
        rotations: of.iter().map(|p| turn(p.1)).map(|q| [q.w, q.x, q.y, q.z].map(|v| v as f32)).collect(),
        opacity_logits: vec![3.0; n],
        sh: (0..3 * n).map(|i| (i as f32 * 1.7).sin()).collect(),
        sh_degree: 0,
        ..Gaussians::default()
    }
}

/// A hollow ball of radius 1.
fn ball() -> Gaussians {
    let golden = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    let at = |i: usize| {
        let z = 1.0 - (2.0 * i as f64 + 1.0) / 1500.0;
        let (r, (sin, cos)) = ((1.0 - z * z).sqrt(), (golden * i as f64).sin_cos());
        DVec3::new(r * cos, r * sin, z)
    };
    flat(&(0..1500).map(|i| (at(i), at(i))).collect::<Vec<_>>(), 0.05)
}

/// A closed room of 4 x 3.2 x 2 around the origin with a table, z up, turned by `turn`.
fn room(turn: DQuat) -> Gaussians {
    let mut all = Vec::new();
    let mut wall = |middle: DVec3, a: DVec3, b: DVec3| {
        for i in 0..25 * 25 {
            let t = |k: usize| -1.0 + 2.0 * k as f64 / 24.0;
            let place = middle + t(i % 25) * a + t(i / 25) * b;
            all.push((turn * place, turn * a.cross(b).normalize()));
        }
    };
    let [x, y, z] = [DVec3::X * 2.0, DVec3::Y * 1.6, DVec3::Z];
    for (middle, a, b) in [(x, y, z), (y, z, x), (z, x, y)] {
        wall(middle, a, b);
        wall(-middle, a, b);
    }
    wall(DVec3::new(0.4, 0.2, -0.6), DVec3::X * 0.6, DVec3::Y * 0.4);
    flat(&all, 0.09)
}

/// Writes a geometry and makes its views; the folder and views.json.
fn views(folder: &Folder, name: &str, g: &Gaussians, more: &[&str]) -> (String, Value) {
    let (geometry, out) = (folder.path(&format!("{name}.ply")), folder.path(name));
    ply::write_gaussians(&geometry, g, &[]).unwrap();
    let size = ["views", "--geometry", &geometry, "--out", &out, "--size", "128x96"];
    succeeds(&[&size, more].concat());
    let told = json(&format!("{out}/views.json"));
    (out, told)
}

fn vector(v: &Value) -> DVec3 {
    DVec3::from_slice(&v.as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect::<Vec<_>>())
}

#[test]
fn a_ball_is_seen_from_all_sides() {
    let folder = Folder::new();
    let (out, told) = views(&folder, "ball", &ball(), &["--views", "48"]);
    assert_eq!((told["look"].as_str(), told["up_from"].as_str()), (Some("outside-in"), Some("convention")), "{told}");
    assert!(told["coverage"]["seen_by_8"].as_f64().unwrap() >= 0.99, "{}", told["coverage"]);
    let cameras = told["views"].as_array().unwrap();
    for view in cameras {
        let eye = vector(&view["position"]);
        assert!(eye.length() > 1.3 && vector(&view["forward"]).dot(-eye.normalize()) > 0.6, "{view}");
        assert!(view["shown"].as_f64().unwrap() > 0.1, "{view}");
    }
    // Both layouts are the same dataset: pictures, poses, points.
    let colmap = dataset::load(Path::new(&out), &LoadOptions::default()).unwrap();
    assert_eq!((colmap.format, colmap.views.len()), (Format::Colmap, cameras.len()));
    assert!(colmap.points.len() == 1500 && colmap.warnings.is_empty());
    let transforms = dataset::load(Path::new(&format!("{out}/transforms.json")), &LoadOptions::default()).unwrap();
    for (a, b) in colmap.views.iter().zip(&transforms.views) {
        let off = (a.camera.position() - b.camera.position()).length();
        assert!(a.name == b.name && off < 1e-9 && (a.camera.rotation - b.camera.rotation).col(0).length() < 1e-9);
    }
    assert!(colmap.views[0].load_image().unwrap().rgb.iter().any(|&v| v > 0.3), "a black picture");
    assert!(Path::new(&format!("{out}/contact.png")).exists());
}

#[test]
fn a_tilted_room_is_seen_from_within_and_upright() {
    let folder = Folder::new();
    let turn = DQuat::from_axis_angle(DVec3::new(1.0, 0.5, 0.2).normalize(), 0.9);
    let (_, told) = views(&folder, "room", &room(turn), &["--views", "24", "--fov", "80"]);
    assert_eq!((told["look"].as_str(), told["up_from"].as_str()), (Some("inside-out"), Some("level")), "{told}");
    assert!(vector(&told["up"]).dot(turn * DVec3::Z) > 0.998, "{}", told["up"]);
    for view in told["views"].as_array().unwrap() {
        let eye = turn.inverse() * vector(&view["position"]);
        assert!(eye.abs().cmplt(DVec3::new(1.9, 1.5, 0.9)).all(), "in a wall: {eye}");
    }
    assert!(told["coverage"]["seen"].as_f64().unwrap() > 0.95, "{}", told["coverage"]);
    let (_, told) = views(&folder, "given", &room(turn), &["--views", "2", "--up", "0,-3,0", "--look", "outside-in"]);
    assert_eq!((vector(&told["up"]), told["up_from"].as_str()), (DVec3::NEG_Y, Some("given")));
    assert_eq!((told["look"].as_str(), told["views"].as_array().unwrap().len()), (Some("outside-in"), 2));
}

#[test]
fn the_same_seed_gives_the_same_bytes_at_any_number_of_threads() {
    let folder = Folder::new();
    let g = ball();
    let bytes = |name: &str, more: &[&str]| {
        let (out, _) = views(&folder, name, &g, &[&["--views", "6"], more].concat());
        let files = [
            "views.json",
            "transforms.json",
            "contact.png",
            "sparse/0/images.bin",
            "sparse/0/points3D.bin",
            "images/view_0000.png",
            "images/view_0005.png",
        ];
        files.map(|f| std::fs::read(format!("{out}/{f}")).unwrap())
    };
    let one = bytes("one", &["--threads", "1"]);
    assert!(one == bytes("two", &["--threads", "2"]));
    assert!(one[3] != bytes("other", &["--seed", "5"])[3]);
    // Again into the same folder, with fewer views: those of before are gone.
    views(&folder, "one", &g, &["--views", "3"]);
    assert!(!Path::new(&folder.path("one/images/view_0003.png")).exists());
    assert!(Path::new(&folder.path("one/images/view_0002.png")).exists());
}

#[test]
fn what_cannot_be_looked_at_is_refused() {
    let folder = Folder::new();
    let (geometry, out) = (folder.path("g.ply"), folder.path("out"));
    let mut g = ball();
    ply::write_gaussians(&geometry, &g, &[]).unwrap();
    let wrong = |more: &[&str], word: &str| {
        let said = refused(&[&["views", "--geometry", &geometry, "--out", &out], more].concat());
        assert!(said.contains(word), "{said}");
    };
    wrong(&["--up", "0,0,0"], "not a direction");
    wrong(&["--size", "640"], "not a size");
    wrong(&["--views", "0"], "1 to 1000");
    wrong(&["--fov", "170"], "20 to 120");
    g.opacity_logits.fill(-9.0);
    ply::write_gaussians(&geometry, &g, &[]).unwrap();
    wrong(&[], "fainter than 0.1");
    std::fs::write(&geometry, "no ply").unwrap();
    wrong(&[], "g.ply");
    assert!(!Path::new(&out).exists());
    // Nothing of somebody else is overwritten.
    ply::write_gaussians(&geometry, &ball(), &[]).unwrap();
    std::fs::create_dir(&out).unwrap();
    std::fs::write(format!("{out}/transforms.json"), "mine").unwrap();
    wrong(&[], "transforms.json: the output exists");
    assert_eq!(std::fs::read_to_string(format!("{out}/transforms.json")).unwrap(), "mine");
}
