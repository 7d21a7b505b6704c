//! Scenes far from the origin, such as georeferenced ones: single precision has steps of half a unit there.

mod common;

use common::cloud;
use glam::DVec3;
use gs_scene::dataset::{self, Dataset, LoadOptions};
use gs_scene::splat::{self, Extra};
use gs_scene::{Camera, Gaussians, Geometry, Image, Labelled, PointCloud, colmap, ply};
use serde_json::json;
use std::fs;
use std::path::Path;

/// Where a survey has it: UTM, metres.
const UTM: [f64; 3] = [448_262.4, 5_411_932.7, 114.0];

/// A PLY of Gaussians at [`UTM`] whose positions have this type, and those positions.
fn georeferenced(path: &Path, g: &Gaussians, encoding: &str, kind: &str) -> Vec<[f64; 3]> {
    let exact: Vec<[f64; 3]> = g.means.iter().map(|m| [0, 1, 2].map(|c| f64::from(m[c]) + UTM[c])).collect();
    let names = ["f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2"];
    let names = [&names[..], &["rot_0", "rot_1", "rot_2", "rot_3"]].concat();
    let mut header = format!("ply\nformat {encoding} 1.0\nelement vertex {}\n", g.len());
    ["x", "y", "z"].iter().for_each(|n| header += &format!("property {kind} {n}\n"));
    names.iter().for_each(|n| header += &format!("property float {n}\n"));
    let mut bytes = (header + "end_header\n").into_bytes();
    for (i, p) in exact.iter().enumerate() {
        let rest = [g.sh_of(i), &[g.opacity_logits[i]], &g.log_scales[i], &g.rotations[i]].concat();
        let big = encoding.ends_with("big_endian");
        if encoding == "ascii" {
            let words: Vec<String> =
                p.iter().map(ToString::to_string).chain(rest.iter().map(ToString::to_string)).collect();
            bytes.extend(format!("{}\n", words.join(" ")).bytes());
            continue;
        }
        for v in p {
            let narrow = *v as f32;
            match kind {
                "double" => bytes.extend(if big { v.to_be_bytes() } else { v.to_le_bytes() }),
                _ => bytes.extend(if big { narrow.to_be_bytes() } else { narrow.to_le_bytes() }),
            }
        }
        rest.iter().for_each(|v| bytes.extend(if big { v.to_be_bytes() } else { v.to_le_bytes() }));
    }
    fs::write(path, bytes).unwrap();
    exact
}

/// How far Gaussians are from where they should be at most.
fn off(g: &Gaussians, exact: &[[f64; 3]]) -> f64 {
    assert_eq!(g.len(), exact.len());
    let of = |(m, p): (&[f32; 3], &[f64; 3])| {
        (0..3).map(|c| (f64::from(m[c]) + g.shift[c] - p[c]).abs()).fold(0.0, f64::max)
    };
    g.means.iter().zip(exact).map(of).fold(0.0, f64::max)
}

#[test]
fn doubles_keep_their_digits_through_every_format_that_can() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("utm.ply");
    for encoding in ["binary_little_endian", "binary_big_endian", "ascii"] {
        let exact = georeferenced(&path, &cloud(300, 0), encoding, "double");
        let read = Geometry::read(&path).unwrap();
        assert!(off(&read.gaussians, &exact) < 1e-6, "{encoding}: {}", off(&read.gaussians, &exact));
        assert_eq!(read.damage(), None);
        for (name, most) in [("a.ply", 1e-6), ("a.glb", 1e-6), ("a.compressed.ply", 0.02)] {
            let out = dir.path().join(name);
            splat::write(&out, &read.gaussians, &Extra::default()).unwrap();
            let back = splat::read(&out).unwrap().gaussians;
            // A compressed PLY has an order of its own.
            let far =
                if name == "a.compressed.ply" { (back.shift[1] - UTM[1]).abs() - 8.0 } else { off(&back, &exact) };
            assert!(far < most, "{encoding}, {name}: {far}");
        }
    }
}

#[test]
fn floats_that_have_lost_their_digits_are_told_apart() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("utm.ply");
    let exact = georeferenced(&path, &cloud(300, 0), "binary_little_endian", "float");
    let read = Geometry::read(&path).unwrap();
    // What the file still has is kept.
    assert!(off(&read.gaussians, &exact) <= 0.25 && read.gaussians.shift != [0.0; 3]);
    let said = read.damage().unwrap();
    assert!(said.contains("not read: digits of the centres") && said.contains("steps of 0.5 units"), "{said}");
    // Of a scene at home nothing is said, and nothing is shifted.
    ply::write_gaussians(&path, &cloud(300, 0), &[]).unwrap();
    let home = Geometry::read(&path).unwrap();
    assert_eq!((home.damage(), home.gaussians.shift), (None, [0.0; 3]));
    assert!(!String::from_utf8_lossy(&fs::read(&path).unwrap()[..200]).contains("shift"));
}

/// Labelled copies of a PLY's rows keep what its positions mean.
#[test]
fn copied_rows_keep_their_shift() {
    let dir = tempfile::tempdir().unwrap();
    let (from, to) = (dir.path().join("utm.ply"), dir.path().join("some.ply"));
    let exact = georeferenced(&from, &cloud(40, 0), "binary_little_endian", "double");
    let label: Vec<i32> = (0..40).collect();
    let some: Vec<u32> = (5..15).collect();
    let own = dir.path().join("own.ply");
    splat::write(&own, &Geometry::read(&from).unwrap().gaussians, &Extra::default()).unwrap();
    for file in [&from, &own] {
        let geometry = Geometry::read(file).unwrap();
        let labelled = Labelled::new(&geometry, file, &label, Vec::new()).unwrap();
        assert_eq!(labelled.write(&to, &some).unwrap(), (some.clone(), Vec::new()));
        assert!(off(&splat::read(&to).unwrap().gaussians, &exact[5..15]) < 1e-6, "{}", file.display());
        let (_, lost) = labelled.write(&dir.path().join("some.spz"), &some).unwrap();
        assert!(lost.len() == 1 && lost[0].contains("has no place in this format"), "{lost:?}");
    }
}

/// Cameras in a ring around home, and points there.
fn scene() -> (Vec<(String, Camera)>, PointCloud) {
    let camera = |i: usize| {
        let a = f64::from(i as u32);
        let eye = DVec3::new(3.0 * a.cos(), 3.0 * a.sin(), 1.0);
        (format!("{i}.png"), Camera::look_at(eye, DVec3::ZERO, DVec3::Z, 32, 24, 1.0))
    };
    let g = cloud(60, 0);
    let points = PointCloud { colors: vec![[9; 3]; g.len()], positions: g.means, ..PointCloud::default() };
    ((0..6).map(camera).collect(), points)
}

/// The scene as a COLMAP model, moved by `shift`.
fn colmap_scene(root: &Path, shift: [f64; 3]) -> Dataset {
    let (views, points) = scene();
    colmap::write_model(&root.join("sparse/0"), &views, &PointCloud { shift, ..points }).unwrap();
    photographs(root, &views);
    dataset::load(root, &LoadOptions::default()).unwrap()
}

fn photographs(root: &Path, views: &[(String, Camera)]) {
    for (name, _) in views {
        let grey = Image { width: 32, height: 24, rgb: vec![0.5; 32 * 24 * 3], alpha: None };
        grey.write_png(root.join("images").join(name)).unwrap();
    }
}

/// Where the first camera sees the points of home, less the dataset's shift.
fn pixels(d: &Dataset, moved: [f64; 3]) -> Vec<(f64, f64, f64)> {
    let less = DVec3::from(moved) - DVec3::from(d.shift);
    scene().1.positions.iter().map(|p| d.views[0].camera.project(DVec3::from(p.map(f64::from)) + less)).collect()
}

fn assert_near(a: &[(f64, f64, f64)], b: &[(f64, f64, f64)]) {
    for (p, q) in a.iter().zip(b) {
        assert!((p.0 - q.0).abs() + (p.1 - q.1).abs() + (p.2 - q.2).abs() < 1e-5, "{p:?} {q:?}");
    }
}

#[test]
fn a_far_dataset_is_the_one_at_home_less_a_shift() {
    let dir = tempfile::tempdir().unwrap();
    let home = colmap_scene(&dir.path().join("home"), [0.0; 3]);
    let far = colmap_scene(&dir.path().join("far"), UTM);
    assert_eq!((home.shift, home.points.shift), ([0.0; 3], [0.0; 3]));
    assert!(far.shift == far.points.shift && (far.shift[1] - UTM[1]).abs() < 8.0, "{:?}", far.shift);
    assert_near(&pixels(&home, [0.0; 3]), &pixels(&far, UTM));
    for (p, q) in home.points.positions.iter().zip(&far.points.positions) {
        assert!(
            (0..3).all(|c| (f64::from(p[c]) + UTM[c] - f64::from(q[c]) - far.shift[c]).abs() < 1e-5),
            "{p:?} {q:?}"
        );
    }
    // Without points the cameras tell.
    let root = dir.path().join("transforms");
    let (views, _) = scene();
    let frame = |(name, c): &(String, Camera)| {
        let r = c.rotation.transpose();
        let p = c.position() + DVec3::from(UTM);
        let row = |i: usize| [r.x_axis[i], -r.y_axis[i], -r.z_axis[i], p[i]];
        json!({"file_path": format!("images/{name}"), "transform_matrix": [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]})
    };
    let focal = views[0].1.fx;
    let frames: Vec<_> = views.iter().map(frame).collect();
    photographs(&root, &views);
    fs::write(root.join("transforms.json"), json!({"fl_x": focal, "w": 32, "h": 24, "frames": frames}).to_string())
        .unwrap();
    let bare = dataset::load(&root, &LoadOptions::default()).unwrap();
    assert_ne!(bare.shift, [0.0; 3]);
    assert_near(&pixels(&home, [0.0; 3]), &pixels(&bare, UTM));
}

#[test]
fn cameras_follow_the_gaussians_and_stay_the_same_dataset() {
    let dir = tempfile::tempdir().unwrap();
    let (path, g) = (Path::new("g.ply"), cloud(300, 0));
    let mut far = colmap_scene(&dir.path().join("far"), UTM);
    let (hash, seen) = (far.hash().unwrap(), pixels(&far, UTM));
    // The Gaussians' own shift, of another program perhaps.
    let theirs = Gaussians { shift: [448_000.0, 5_412_000.0, 100.0], ..g.clone() };
    far.follow(&theirs, path).unwrap();
    assert_eq!((far.shift, far.hash().unwrap()), (theirs.shift, hash.clone()));
    assert_near(&pixels(&far, UTM), &seen);
    // Gaussians at home, whose shift nobody wrote down.
    let e = far.follow(&g, path).unwrap_err().to_string();
    for part in ["g.ply: shift: the Gaussians and the photographs lie far apart", "found 0 0 0", "448000 5412000 100"] {
        assert!(e.contains(part), "{part}: {e}");
    }
    let e = colmap_scene(&dir.path().join("home"), [0.0; 3]).follow(&theirs, path).unwrap_err().to_string();
    assert!(e.contains("found 448000 5412000 100; that of") && e.contains("is 0 0 0"), "{e}");
    assert_ne!(hash, colmap_scene(&dir.path().join("other"), UTM.map(|v| v + 500.0)).hash().unwrap());
}

#[test]
fn refined_cameras_are_written_as_they_are_in_the_world() {
    let dir = tempfile::tempdir().unwrap();
    let far = colmap_scene(&dir.path().join("far"), UTM);
    let cameras: Vec<Camera> = far.views.iter().map(|v| v.camera.clone()).collect();
    let file = dir.path().join("g.ply.cameras.json");
    dataset::refined::write(&file, &far, &cameras).unwrap();
    let refined = dataset::load(&file, &LoadOptions::default()).unwrap();
    assert_eq!(refined.shift, far.shift);
    assert_near(&pixels(&refined, UTM), &pixels(&far, UTM));
}

/// The right value of a user's report.
#[test]
#[ignore = "needs shared/data/cases; run make test-data"]
fn centres_of_a_georeferenced_splat_stay_where_they_are() {
    let case = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../../shared/data/cases/04-utm");
    let [utm, local] = ["utm splat.ply", "local splat.ply"].map(|name| splat::read(case.join(name)).unwrap().gaussians);
    let moved: Vec<[f64; 3]> =
        local.means.iter().map(|m| [0, 1, 2].map(|c| f64::from(m[c]) + [448_262.4, 5_411_932.7, 114.0][c])).collect();
    assert!(off(&utm, &moved) < 1e-3, "{}", off(&utm, &moved));
}
