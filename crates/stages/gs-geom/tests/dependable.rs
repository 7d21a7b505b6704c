//! Runs that fail, are extended, or are fed what breaks arithmetic.

mod common;

use common::{disturbed, killed, refused, succeeds};
use glam::{DQuat, DVec3};
use gs_geom::training::checkpoint;
use gs_raster::{RasterOptions, render};
use gs_scene::{Camera, Gaussians, Image, PointCloud, ply};
use serde_json::Value;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

const SIZE: (u32, u32) = (64, 48);

/// `n` Gaussians on a spiral around the origin.
fn spiral(n: usize) -> Gaussians {
    let t = |i: usize| i as f32 / n as f32;
    Gaussians {
        means: (0..n).map(|i| [(9.0 * t(i)).cos() * t(i), (9.0 * t(i)).sin() * t(i), t(i) - 0.5]).collect(),
        log_scales: vec![[-2.2, -2.5, -2.0]; n],
        rotations: vec![[1.0, 0.2, -0.1, 0.3]; n],
        opacity_logits: vec![1.0; n],
        sh: (0..3 * n).map(|i| (i as f32 * 1.7).sin()).collect(),
        sh_degree: 0,
    }
}

/// A COLMAP scene with `views` photographs `picture` of cameras around the origin, whose focal length is `focal` times
/// the width.
fn write_scene(root: &Path, views: usize, focal: f64, picture: impl Fn(&Camera) -> Vec<f32>) {
    let (w, h) = SIZE;
    let camera = |i: usize| {
        let a = i as f64 / views as f64 * std::f64::consts::TAU;
        let eye = DVec3::new(3.0 * a.cos(), 3.0 * a.sin(), 0.5);
        let mut c = Camera::look_at(eye, DVec3::ZERO, DVec3::Z, w, h, 1.0);
        (c.fx, c.fy) = (focal * f64::from(w), focal * f64::from(w));
        c
    };
    let cameras: Vec<Camera> = (0..views).map(camera).collect();
    let points = PointCloud { positions: spiral(60).means, colors: vec![[200, 100, 50]; 60] };
    common::write_scene(root, &cameras, &points, |_, c, path| {
        Image { width: w, height: h, rgb: picture(c), alpha: None }.write_png(path).unwrap();
    });
}

fn spiral_seen_by(c: &Camera) -> Vec<f32> {
    render(&spiral(60), c, &RasterOptions::default()).rgb
}

/// A folder with a scene in it.
struct Folder(common::Folder);

impl Folder {
    fn new() -> Self {
        let folder = Self(common::Folder::new());
        write_scene(Path::new(&folder.path("scene")), 9, 1.0, spiral_seen_by);
        folder
    }

    fn path(&self, name: &str) -> String {
        self.0.path(name)
    }
}

fn training<'a>(scene: &'a str, out: &'a str, iterations: &'a str, more: &[&'a str]) -> Vec<&'a str> {
    let all = ["train", "--scene", scene, "--out", out, "--iterations", iterations, "--densify-every", "20"];
    [&all, more].concat()
}

#[test]
fn a_run_whose_photographs_vanish_saves_a_checkpoint_and_goes_on_to_the_same_bytes() {
    let dir = Folder::new();
    let (scene, whole, out) = (dir.path("scene"), dir.path("whole.ply"), dir.path("g.ply"));
    succeeds(&training(&scene, &whole, "400", &[]));
    let photographs = format!("{scene}/images");
    let away = dir.path("away");
    let arguments = training(&scene, &out, "400", &["--image-cache", "0", "--checkpoint-every", "10"]);
    let o = disturbed(&arguments, &out, |_| fs::rename(&photographs, &away).unwrap());
    let said = String::from_utf8_lossy(&o.stderr);
    assert_eq!(o.status.code(), Some(2), "{said}");
    assert!(said.contains("saved a checkpoint after iteration") && said.contains("No such file"), "{said}");
    fs::rename(&away, &photographs).unwrap();
    let said = succeeds(&training(&scene, &out, "400", &[]));
    assert!(said.contains("going on after iteration"), "{said}");
    assert_eq!(fs::read(&out).unwrap(), fs::read(&whole).unwrap());
    let curve = |p: &str| fs::read(format!("{p}.curve.jsonl")).unwrap();
    assert_eq!(curve(&out), curve(&whole));
    assert!(fs::read_to_string(format!("{out}.curve.svg")).unwrap().contains("held-out"));
}

#[test]
fn a_touched_photograph_is_the_same_and_another_one_stops_the_run_at_once() {
    let dir = Folder::new();
    let (scene, whole) = (dir.path("scene"), dir.path("whole.ply"));
    succeeds(&training(&scene, &whole, "400", &[]));
    let photograph = format!("{scene}/images/04.png");
    let (old, other) = (fs::read(&photograph).unwrap(), fs::read(format!("{scene}/images/05.png")).unwrap());
    // Read again in every iteration, and kept in memory.
    for (out, more) in [("a.ply", ["--image-cache", "0"]), ("b.ply", ["--image-cache", "1G"])] {
        let out = dir.path(out);
        let arguments = training(&scene, &out, "400", &[&more[..], &["--checkpoint-every", "20"]].concat());
        let o = disturbed(&arguments, &out, |_| {
            for i in 0..9 {
                let (path, copy) = (format!("{scene}/images/{i:02}.png"), format!("{scene}/copy.png"));
                fs::copy(&path, &copy).unwrap();
                fs::rename(copy, path).unwrap();
            }
        });
        assert!(o.status.success(), "{}", String::from_utf8_lossy(&o.stderr));
        assert_eq!(fs::read(&out).unwrap(), fs::read(&whole).unwrap());

        let o = disturbed(&arguments, &out, |_| fs::write(&photograph, &other).unwrap());
        let said = String::from_utf8_lossy(&o.stderr);
        assert_eq!(o.status.code(), Some(2), "{said}");
        assert!(said.contains("saved a checkpoint after iteration"), "{said}");
        assert!(said.contains("images/04.png: the file changed while this run was reading it"), "{said}");
        fs::write(&photograph, &old).unwrap();
        fs::remove_file(&out).unwrap();
        assert!(succeeds(&arguments).contains("going on after iteration"));
        assert_eq!(fs::read(&out).unwrap(), fs::read(&whole).unwrap());
    }
}

#[test]
#[cfg(unix)]
fn signals_that_were_ignored_at_the_start_stay_ignored() {
    let dir = Folder::new();
    let scene = dir.path("scene");
    // A shell that ignores some of them, as nohup does SIGHUP and a shell in the background SIGINT.
    for (ignored, sent, ends) in [("HUP", "HUP", 0), ("HUP", "TERM", 130), ("INT", "INT", 0)] {
        let out = dir.path(&format!("{ignored}{sent}.ply"));
        let arguments = training(
            &scene,
            &out,
            if ends == 0 { "160" } else { "100000" },
            &["--checkpoint-every", "20", "--holdout", "0"],
        );
        let mut child = Command::new("sh")
            .args(["-c", &format!("trap '' {ignored}; exec \"$0\" \"$@\""), env!("CARGO_BIN_EXE_gs-geom")])
            .args(arguments)
            .stderr(std::process::Stdio::null())
            .spawn()
            .unwrap();
        while !PathBuf::from(format!("{out}.checkpoint")).exists() && child.try_wait().unwrap().is_none() {
            std::thread::sleep(Duration::from_millis(1));
        }
        assert!(Command::new("kill").args([&format!("-{sent}"), &child.id().to_string()]).status().unwrap().success());
        assert_eq!(child.wait().unwrap().code(), Some(ends), "{sent} where {ignored} is ignored");
        assert_eq!(PathBuf::from(&out).exists(), ends == 0);
    }
}

#[test]
fn a_run_that_cannot_write_its_result_saves_a_checkpoint() {
    let dir = Folder::new();
    let (scene, out) = (dir.path("scene"), dir.path("g.ply"));
    let arguments = training(&scene, &out, "300", &["--checkpoint-every", "10"]);
    // A folder where the result should go: the last step, like any that fails there, loses nothing.
    let o = disturbed(&arguments, &out, |_| fs::create_dir(&out).unwrap());
    let said = String::from_utf8_lossy(&o.stderr);
    assert_eq!(o.status.code(), Some(2), "{said}");
    assert!(said.contains("saved a checkpoint after iteration 300"), "{said}");
    fs::remove_dir(&out).unwrap();
    succeeds(&arguments);
    let whole = dir.path("whole.ply");
    succeeds(&training(&scene, &whole, "300", &[]));
    assert_eq!(fs::read(&out).unwrap(), fs::read(&whole).unwrap());
}

#[test]
fn what_cannot_fit_is_refused_before_it_is_made() {
    let dir = Folder::new();
    let (scene, out, geometry) = (dir.path("scene"), dir.path("out"), dir.path("g.ply"));
    ply::write_gaussians(&geometry, &spiral(60), &[]).unwrap();
    let refused = |arguments: &[&str]| {
        let said = refused(arguments);
        assert!(!Path::new(&out).exists(), "{arguments:?}");
        said
    };
    let random = ["--init", "random", "--init-points"];
    let start =
        |count: &str, more: &[&str]| refused(&[&training(&scene, &out, "20", &random)[..], &[count], more].concat());
    for more in [&["--memory-limit", "1G"][..], &["--memory-limit", "1G", "--time-budget", "9s"]] {
        let said = start("900000000", more);
        assert!(said.contains("--memory-limit: the run needs more memory than it may take"), "{said}");
        // Few of the points may be kept, but all are made.
        let said = start("900000000", &[more, &["--max-gaussians", "60"]].concat());
        assert!(said.contains("found about 12.6G needed"), "{said}");
    }
    assert!(start("900000000", &[]).contains("memory of this machine: the run needs more memory than it may take"));
    // Every command has a forecast.
    let limit = ["--memory-limit", "1M"];
    let drawn = ["--scene", &scene, "--geometry", &geometry, "--out", &out];
    for arguments in [
        &training(&scene, &out, "20", &["--init", &geometry])[..],
        &[&["render"], &drawn[..]].concat(),
        &[&["eval"], &drawn[..]].concat(),
        &["inspect", &geometry],
        &["convert", &geometry, &out],
    ] {
        assert!(
            refused(&[arguments, &limit].concat())
                .contains("--memory-limit: the run needs more memory than it may take")
        );
    }
    succeeds(&["inspect", &geometry, "--memory-limit", "1G"]);
}

/// Trains on from `g` and gives the result, all finite, with what the program said.
fn stressed(scene: &str, dir: &Folder, g: &Gaussians) -> (Gaussians, String) {
    let (init, out) = (dir.path("init.ply"), dir.path("stress.ply"));
    ply::write_gaussians(&init, g, &[]).unwrap();
    let said = succeeds(&training(scene, &out, "45", &["--init", &init, "--sh-degree", "1", "--holdout", "0"]));
    let result = ply::read_gaussians_as_they_are(&out).unwrap();
    for (name, values) in [
        ("means", result.means.as_flattened()),
        ("scales", result.log_scales.as_flattened()),
        ("rotations", result.rotations.as_flattened()),
        ("opacities", &result.opacity_logits),
        ("SH", &result.sh),
    ] {
        assert!(values.iter().all(|v| v.is_finite()), "{name}");
    }
    let curve = fs::read_to_string(format!("{out}.curve.jsonl")).unwrap();
    for line in curve.lines() {
        let v: Value = serde_json::from_str(line).unwrap();
        assert!(v["loss"].as_f64().is_some_and(f64::is_finite), "{line}");
    }
    (result, said)
}

#[test]
fn gaussians_that_break_arithmetic_leave_every_parameter_finite() {
    let dir = Folder::new();
    let scene = dir.path("scene");
    let (tiny, huge) = (1e-8f32.ln(), 1e4f32.ln());
    let eye = [3.0f32, 0.0, 0.5];
    type Change = Box<dyn Fn(&mut Gaussians, usize)>;
    let cases: Vec<(&str, Change)> = vec![
        ("needles", Box::new(|g, i| g.log_scales[i] = [0.0, 1e-6f32.ln(), 1e-6f32.ln()])),
        ("specks", Box::new(move |g, i| g.log_scales[i] = [tiny; 3])),
        ("giants", Box::new(move |g, i| g.log_scales[i] = [huge; 3])),
        ("giant needles", Box::new(move |g, i| g.log_scales[i] = [huge, tiny, tiny])),
        ("transparent", Box::new(|g, i| g.opacity_logits[i] = -50.0)),
        ("opaque", Box::new(|g, i| g.opacity_logits[i] = f32::INFINITY)),
        // The plane through the first camera, across its axis, and the near plane.
        (
            "on the camera plane",
            Box::new(move |g, i| g.means[i] = [eye[0] + 0.01 * (i % 3) as f32, i as f32 * 0.1, eye[2]]),
        ),
        ("in the camera", Box::new(move |g, i| g.means[i] = eye)),
        ("far away", Box::new(|g, i| g.means[i] = [1e6, -1e6, 1e6 + i as f32])),
        ("zero quaternions", Box::new(|g, i| g.rotations[i] = [0.0; 4])),
        ("large quaternions", Box::new(|g, i| g.rotations[i] = [1e18, -1e18, 1e18, 0.0])),
        ("small quaternions", Box::new(|g, i| g.rotations[i] = [1e-20, 0.0, 1e-20, 0.0])),
        ("glaring", Box::new(|g, i| g.sh[3 * i..3 * i + 3].fill(1e30))),
        ("black", Box::new(|g, i| g.sh[3 * i..3 * i + 3].fill(-1e30))),
    ];
    for (name, change) in cases {
        let mut g = spiral(60);
        (0..60).step_by(2).for_each(|i| change(&mut g, i));
        let (result, said) = stressed(&scene, &dir, &g);
        assert!(!result.is_empty(), "{name}");
        if name == "zero quaternions" {
            assert!(said.contains("30 Gaussians of --init have a quaternion of length 0"), "{said}");
            assert!(said.contains("could not be drawn, in the worst iteration: 0 not finite, 30 of"), "{said}");
        }
        let warnings: Vec<&str> =
            said.lines().filter(|l| l.contains("could not be drawn") || l.contains("were not")).collect();
        eprintln!("{name}: {} Gaussians left; {warnings:?}", result.len());
    }
}

#[test]
fn gaussians_that_are_not_finite_are_never_written() {
    let dir = Folder::new();
    let (scene, out) = (dir.path("scene"), dir.path("g.ply"));
    killed(&training(&scene, &out, "60", &[]), &out);
    // The next step goes wrong.
    let state = PathBuf::from(format!("{out}.checkpoint"));
    let run = gs_io::Artifact::open(&state, checkpoint::FORMAT, checkpoint::VERSION).unwrap().provenance().clone();
    let mut wrong = checkpoint::read(&state, &run).unwrap().unwrap();
    wrong.adam.first.means[3][1] = f32::NAN;
    checkpoint::write(&state, &wrong, run).unwrap();
    let said = refused(&training(&scene, &out, "60", &[]));
    assert!(said.contains("g.ply: iteration 60: Gaussians are not finite; nothing is written; found "), "{said}");
    assert!(said.contains("points and poses") && !said.contains("saved a checkpoint"), "{said}");
    assert!(!Path::new(&out).exists());
}

#[test]
fn scenes_beyond_the_range_of_numbers_are_refused_before_the_first_step() {
    let dir = Folder::new();
    let (scene, out) = (dir.path("scene"), dir.path("g.ply"));
    let file = format!("{scene}/sparse/0/images.txt");
    let images = fs::read_to_string(&file).unwrap();
    let with = |change: &dyn Fn(f64) -> f64| {
        let line = |line: &str| {
            let mut words: Vec<String> = line.split(' ').map(String::from).collect();
            for word in words.iter_mut().skip(5).take(3) {
                *word = change(word.parse().unwrap()).to_string();
            }
            words.join(" ") + "\n"
        };
        fs::write(&file, images.lines().map(line).collect::<String>()).unwrap();
        refused(&training(&scene, &out, "60", &[]))
    };
    let said = with(&|t| t * 1e300);
    assert!(said.contains("translation: no camera has this; found ["), "{said}");
    let points = format!("{scene}/sparse/0/points3D.txt");
    fs::write(&points, "1 0 0 0 200 100 50 0.5\n").unwrap();
    let said = with(&|t| t * 1e-60);
    assert!(said.contains("iteration 0: Gaussians are not finite") && said.contains("points and poses"), "{said}");
    assert!(!Path::new(&out).exists());
}

#[test]
fn thousands_of_coincident_gaussians_stay_finite() {
    let dir = Folder::new();
    let mut g = spiral(3000);
    g.means.fill([0.1, 0.0, 0.0]);
    let (result, _) = stressed(&dir.path("scene"), &dir, &g);
    assert!(result.len() >= 1000);
}

#[test]
fn a_scene_far_from_the_origin_is_learnt() {
    // 1e6 from the origin a float has steps of 0.06: the poses are moved, the scene with them.
    let dir = Folder::new();
    let far = [1e6f32, 0.0, 0.0];
    let mut g = spiral(60);
    g.means.iter_mut().for_each(|m| m[0] += far[0]);
    let root = dir.path("far");
    write_scene(Path::new(&root), 4, 1.0, spiral_seen_by);
    let file = format!("{root}/sparse/0/images.txt");
    let moved: String = fs::read_to_string(&file)
        .unwrap()
        .lines()
        .map(|line| {
            let mut words: Vec<String> = line.split(' ').map(String::from).collect();
            if words.len() > 8 {
                let v: Vec<f64> = words[1..8].iter().map(|w| w.parse().unwrap()).collect();
                let q = DQuat::from_xyzw(v[1], v[2], v[3], v[0]);
                let t = DVec3::new(v[4], v[5], v[6]) - q * DVec3::from(far.map(f64::from));
                for c in 0..3 {
                    words[5 + c] = t[c].to_string();
                }
            }
            words.join(" ") + "\n"
        })
        .collect();
    fs::write(&file, moved).unwrap();
    stressed(&root, &dir, &g);
}

#[test]
fn pictures_of_one_colour_one_view_and_any_focal_length_stay_finite() {
    let dir = Folder::new();
    let flat = |_: &Camera| vec![0.5; (3 * SIZE.0 * SIZE.1) as usize];
    for (name, views, focal) in [
        ("flat", 4, 1.0),
        ("one", 1, 1.0),
        ("wide", 3, 1.0 / 64.0),
        ("tele", 3, 1e5 / 64.0),
        ("tele1e3", 2, 1e3 / 64.0),
    ] {
        let root = dir.path(name);
        write_scene(Path::new(&root), views, focal, flat);
        stressed(&root, &dir, &spiral(60));
        // From its own points, too.
        let out = dir.path("own.ply");
        succeeds(&training(&root, &out, "40", &["--holdout", "0"]));
        ply::read_gaussians(&out).unwrap();
    }
    let root = dir.path("black");
    write_scene(Path::new(&root), 2, 1.0, |_| vec![0.0; (3 * SIZE.0 * SIZE.1) as usize]);
    stressed(&root, &dir, &spiral(60));
}
