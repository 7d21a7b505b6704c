//! Runs that fail, are extended, or are fed what breaks arithmetic.

mod common;

use common::world::{PIXELS, SIZE, balls, photograph, points, ring, scene, write_scene, write_world};
use common::{Folder, disturbed, killed, refused, succeeds, training};
use glam::DVec3;
use gs_scene::{Camera, Gaussians, Image, PointCloud, ply};
use serde_json::Value;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

#[test]
fn a_failing_run_saves_a_checkpoint_and_goes_on_to_the_same_bytes() {
    let dir = Folder::new();
    let [scene, whole, away] = ["scene", "whole.ply", "away"].map(|name| dir.path(name));
    write_world(&scene, 10, &points());
    succeeds(&training(&scene, &whole, "400", &[]));
    let (images, one) = (format!("{scene}/images"), format!("{scene}/images/04.png"));
    let (old, other) = (fs::read(&one).unwrap(), fs::read(format!("{images}/05.png")).unwrap());
    // Photographs that are read again in every iteration, and that are kept in memory.
    for cache in ["0", "1G"] {
        let out = dir.path(&format!("{cache}.ply"));
        let arguments = training(&scene, &out, "400", &["--image-cache", cache, "--checkpoint-every", "10"]);
        let same = || {
            for suffix in ["", ".curve.jsonl"] {
                assert_eq!(fs::read(format!("{out}{suffix}")).unwrap(), fs::read(format!("{whole}{suffix}")).unwrap());
            }
            fs::remove_file(&out).unwrap();
        };
        // A touched photograph is the same.
        let touched = disturbed(&arguments, &out, |_| {
            for i in 0..10 {
                let (path, copy) = (format!("{images}/{i:02}.png"), format!("{scene}/copy.png"));
                fs::copy(&path, &copy).unwrap();
                fs::rename(copy, path).unwrap();
            }
        });
        assert!(touched.status.success(), "{}", String::from_utf8_lossy(&touched.stderr));
        same();
        let goes_on = |wanted: &str, disturb: &dyn Fn(), repair: &dyn Fn()| {
            let o = disturbed(&arguments, &out, |_| disturb());
            let said = String::from_utf8_lossy(&o.stderr);
            assert_eq!(o.status.code(), Some(2), "{said}");
            assert!(said.contains("saved a checkpoint after iteration") && said.contains(wanted), "{said}");
            repair();
            assert!(succeeds(&arguments).contains("going on after iteration"));
            same();
        };
        let changed = "images/04.png: the file changed while this run was reading it";
        goes_on(changed, &|| fs::write(&one, &other).unwrap(), &|| fs::write(&one, &old).unwrap());
        // A folder where the result should go: the last step, like any that fails there, loses nothing.
        goes_on("after iteration 400", &|| fs::create_dir(&out).unwrap(), &|| fs::remove_dir(&out).unwrap());
        if cache == "0" {
            let rename = |from: &String, to: &String| fs::rename(from, to).unwrap();
            goes_on("No such file", &|| rename(&images, &away), &|| rename(&away, &images));
        }
    }
}

#[test]
#[cfg(unix)]
fn signals_that_were_ignored_at_the_start_stay_ignored() {
    let dir = Folder::new();
    // A shell that ignores some of them, as nohup does SIGHUP and a shell in the background SIGINT.
    for (ignored, sent, ends) in [("HUP", "HUP", 0), ("HUP", "TERM", 130), ("INT", "INT", 0)] {
        let out = dir.path(&format!("{ignored}{sent}.ply"));
        let iterations = if ends == 0 { "160" } else { "100000" };
        let arguments = training(scene(), &out, iterations, &["--checkpoint-every", "20", "--holdout", "0"]);
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
fn what_cannot_fit_is_refused_before_it_is_made() {
    let dir = Folder::new();
    let (out, geometry) = (dir.path("out"), dir.path("g.ply"));
    ply::write_gaussians(&geometry, &balls(60), &[]).unwrap();
    let refused = |arguments: &[&str]| {
        let said = refused(arguments);
        assert!(!Path::new(&out).exists(), "{arguments:?}");
        said
    };
    let random = ["--init", "random", "--init-points"];
    let start =
        |count: &str, more: &[&str]| refused(&[&training(scene(), &out, "20", &random)[..], &[count], more].concat());
    for more in [&["--memory-limit", "1G"][..], &["--memory-limit", "1G", "--time-budget", "9s"]] {
        let said = start("900000000", more);
        assert!(said.contains("--memory-limit: the run needs more memory than it may take"), "{said}");
        // Few of the points may be kept, but all are made.
        let said = start("900000000", &[more, &["--max-gaussians", "60"]].concat());
        assert!(said.contains("found about 12.6G needed"), "{said}");
    }
    assert!(
        start("900000000", &[])
            .contains("memory of this machine or its control group: the run needs more memory than it may take")
    );
    // Every command has a forecast.
    let limit = ["--memory-limit", "1M"];
    let drawn = ["--scene", scene(), "--geometry", &geometry, "--out", &out];
    for arguments in [
        &training(scene(), &out, "20", &["--init", &geometry])[..],
        &[&["render"], &drawn[..]].concat(),
        &[&["eval"], &drawn[..]].concat(),
        &["inspect", &geometry],
        &["convert", &geometry, &format!("{out}.ply")],
    ] {
        let said = refused(&[arguments, &limit].concat());
        assert!(said.contains("--memory-limit: the run needs more memory than it may take"), "{said}");
    }
    succeeds(&["inspect", &geometry, "--memory-limit", "1G"]);
}

#[test]
#[cfg(target_os = "linux")]
fn memory_that_ends_is_said_in_one_line() {
    let dir = Folder::new();
    let out = dir.path("g.ply");
    let random = ["--init", "random", "--init-points", "3000000", "--threads", "1", "--quiet"];
    let ended = Command::new("sh")
        .args(["-c", "ulimit -v 150000 && exec \"$0\" \"$@\"", env!("CARGO_BIN_EXE_gs-geom")])
        .args(training(scene(), &out, "20", &random))
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&ended.stderr);
    assert!(ended.status.code() == Some(2) && said.lines().count() == 1, "{:?} {said}", ended.status);
    assert!(said.starts_with("gs-geom: error: memory: there is no more: ") && !Path::new(&out).exists(), "{said}");
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
    /// Standard deviations, as logarithms: of 1e-8 and 1e4.
    const TINY: f32 = -18.420_681;
    const HUGE: f32 = 9.210_34;
    type Change = fn(&mut Gaussians, usize);
    let cases: [(&str, Change); 14] = [
        ("needles", |g, i| g.log_scales[i] = [0.0, 1e-6f32.ln(), 1e-6f32.ln()]),
        ("specks", |g, i| g.log_scales[i] = [TINY; 3]),
        ("giants", |g, i| g.log_scales[i] = [HUGE; 3]),
        ("giant needles", |g, i| g.log_scales[i] = [HUGE, TINY, TINY]),
        ("transparent", |g, i| g.opacity_logits[i] = -50.0),
        ("opaque", |g, i| g.opacity_logits[i] = f32::INFINITY),
        // The plane through the first camera, across its axis, and the near plane.
        ("on the camera plane", |g, i| g.means[i] = [3.0 + 0.01 * (i % 3) as f32, i as f32 * 0.1, 0.5]),
        ("in the camera", |g, i| g.means[i] = [3.0, 0.0, 0.5]),
        ("far away", |g, i| g.means[i] = [1e6, -1e6, 1e6 + i as f32]),
        ("tiny quaternions", |g, i| g.rotations[i] = [1e-30; 4]),
        ("large quaternions", |g, i| g.rotations[i] = [1e18, -1e18, 1e18, 0.0]),
        ("small quaternions", |g, i| g.rotations[i] = [1e-20, 0.0, 1e-20, 0.0]),
        ("glaring", |g, i| g.sh[3 * i..3 * i + 3].fill(1e30)),
        ("black", |g, i| g.sh[3 * i..3 * i + 3].fill(-1e30)),
    ];
    for (name, change) in cases {
        let mut g = balls(60);
        (0..60).step_by(2).for_each(|i| change(&mut g, i));
        let (result, said) = stressed(scene(), &dir, &g);
        assert!(!result.is_empty(), "{name}");
        if name == "tiny quaternions" {
            assert!(said.contains("30 Gaussians of --init have a quaternion of length 0"), "{said}");
            assert!(said.contains("could not be drawn, in the worst iteration: 0 not finite, 30 of"), "{said}");
        }
    }
    let mut coinciding = balls(3000);
    coinciding.means.fill([0.1, 0.0, 0.0]);
    assert!(stressed(scene(), &dir, &coinciding).0.len() >= 1000);
}

#[test]
fn gaussians_that_are_not_finite_are_never_written() {
    let dir = Folder::new();
    let out = dir.path("g.ply");
    killed(&training(scene(), &out, "60", &[]), &out, "1");
    // The next step goes wrong: a moment is not a number.
    let state = format!("{out}.checkpoint");
    let checkpoint = gs_io::Artifact::open(&state, "gs-geom-checkpoint", 5).unwrap();
    let moments = &checkpoint.tensor::<f32>("first_means", &[None, Some(3)]).unwrap()[..9];
    let moments: Vec<u8> = moments.iter().flat_map(|v| v.to_le_bytes()).collect();
    let mut bytes = fs::read(&state).unwrap();
    let at = bytes.windows(36).position(|w| w == moments).unwrap();
    bytes[at..at + 4].copy_from_slice(&f32::NAN.to_le_bytes());
    gs_io::artifact::seal(&mut bytes);
    fs::write(&state, bytes).unwrap();
    let said = refused(&training(scene(), &out, "60", &[]));
    assert!(said.contains("g.ply: iteration 60: Gaussians are not finite; nothing is written; found "), "{said}");
    assert!(said.contains("points and poses") && !said.contains("saved a checkpoint"), "{said}");
    assert!(!Path::new(&out).exists());
}

/// A scene in which the cameras' translations are changed, but not the photographs.
fn moved(root: &str, views: usize, points: &PointCloud, change: impl Fn(&mut Camera)) {
    let mut cameras = ring(views);
    cameras.iter_mut().for_each(change);
    write_scene(root, &cameras, points, |i, _, path| photograph(i, &ring(views)[i], path));
}

#[test]
fn scenes_beyond_the_range_of_numbers_are_refused_before_the_first_step() {
    let dir = Folder::new();
    let (scene, out) = (dir.path("scene"), dir.path("g.ply"));
    moved(&scene, 9, &points(), |c| c.translation *= 1e300);
    let said = refused(&training(&scene, &out, "60", &[]));
    assert!(said.contains("translation: no camera has this; found ["), "{said}");
    let one = PointCloud { positions: vec![[0.0; 3]], colors: vec![[200, 100, 50]], ..PointCloud::default() };
    moved(&scene, 9, &one, |c| c.translation *= 1e-60);
    let said = refused(&training(&scene, &out, "60", &[]));
    assert!(said.contains("iteration 0: Gaussians are not finite") && said.contains("points and poses"), "{said}");
    assert!(!Path::new(&out).exists());
}

#[test]
fn a_scene_far_from_the_origin_is_learnt() {
    // 1e6 from the origin a float has steps of 0.06.
    let dir = Folder::new();
    let mut g = balls(60);
    g.means.iter_mut().for_each(|m| m[0] += 1e6);
    let root = dir.path("far");
    moved(&root, 4, &points(), |c| c.translation -= c.rotation * DVec3::new(1e6, 0.0, 0.0));
    stressed(&root, &dir, &g);
}

#[test]
fn pictures_of_one_colour_one_view_and_any_focal_length_stay_finite() {
    let dir = Folder::new();
    for (name, views, focal, grey) in [
        ("flat", 4, 1.0, 0.5),
        ("one", 1, 1.0, 0.5),
        ("wide", 3, 1.0 / 64.0, 0.5),
        ("tele", 3, 1e5 / 64.0, 0.5),
        ("tele1e3", 2, 1e3 / 64.0, 0.5),
        ("black", 2, 1.0, 0.0),
    ] {
        let (root, out) = (dir.path(name), dir.path("own.ply"));
        let mut cameras = ring(views);
        cameras.iter_mut().for_each(|c| (c.fx, c.fy) = (focal * f64::from(SIZE.0), focal * f64::from(SIZE.0)));
        let flat = Image { width: SIZE.0, height: SIZE.1, rgb: vec![grey; 3 * PIXELS], alpha: None };
        write_scene(&root, &cameras, &points(), |_, _, path| flat.write_png(path).unwrap());
        stressed(&root, &dir, &balls(60));
        // From its own points, too.
        succeeds(&training(&root, &out, "40", &["--holdout", "0"]));
        ply::read_gaussians(&out).unwrap();
    }
}
