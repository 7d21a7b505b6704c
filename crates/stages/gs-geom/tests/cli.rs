//! The program and its files, as people and later stages meet them.

mod common;

use common::world::{PIXELS, SIZE, balls, points, scene, write_world};
use common::{Folder, json, killed, record, refused, run, succeeds, training};
use gs_scene::{Image, PointCloud, ply};
use serde_json::{Value, json};
use std::fs;
use std::path::PathBuf;
use std::process::Command;
use std::sync::OnceLock;

/// Geometry and curve of an undisturbed training.
fn undisturbed() -> &'static (Vec<u8>, Vec<u8>) {
    static ONCE: OnceLock<(Vec<u8>, Vec<u8>)> = OnceLock::new();
    ONCE.get_or_init(|| {
        let dir = Folder::new();
        let out = dir.path("g.ply");
        succeeds(&training(scene(), &out, "160", &["--threads", "2"]));
        (fs::read(&out).unwrap(), fs::read(format!("{out}.curve.jsonl")).unwrap())
    })
}

#[test]
fn a_small_world_is_learnt_well() {
    let dir = Folder::new();
    let (out, metrics) = (dir.path("new/g.ply"), dir.path("m.json"));
    succeeds(&["train", "--scene", scene(), "--out", &out, "--iterations", "400", "--max-gaussians", "1500"]);
    succeeds(&["eval", "--scene", scene(), "--geometry", &out, "--out", &metrics]);
    let m = json(&metrics);
    assert_eq!(m["split"], "test");
    assert_eq!(m["views"].as_array().unwrap().len(), 2);
    // Eight views, 36 degrees apart, of overlapping balls.
    assert!(m["psnr_heldout"].as_f64().unwrap() > 25.0 && m["ssim_heldout"].as_f64().unwrap() > 0.85, "{m}");
    let g = ply::read_gaussians(&out).unwrap();
    assert_eq!(g.sh_degree, 3);
    assert!(g.len() > points().len(), "it densified");
    // The header says how it was made, not where or when.
    let bytes = fs::read(&out).unwrap();
    let header = String::from_utf8_lossy(&bytes[..2000]).into_owned();
    assert!(
        header.contains("comment made by gs-geom") && header.contains("comment schedule.iterations 400"),
        "{header}"
    );
    assert!(!header.contains(scene()) && !header.contains(&dir.path("")));
    // The curve falls; finished runs leave no checkpoint.
    let curve = fs::read_to_string(format!("{out}.curve.jsonl")).unwrap();
    let losses: Vec<f64> =
        curve.lines().map(|l| serde_json::from_str::<Value>(l).unwrap()["loss"].as_f64().unwrap()).collect();
    assert_eq!(losses.len(), 100);
    assert!(losses[99] < 0.3 * losses[0], "{losses:?}");
    assert!(curve.lines().last().unwrap().contains("psnr_heldout"));
    assert!(fs::read_to_string(format!("{out}.curve.svg")).unwrap().contains("held-out"));
    assert!(!PathBuf::from(format!("{out}.checkpoint")).exists());
    let record = record(&out);
    assert_eq!(record["summary"]["gaussians"], g.len());
}

#[test]
fn thread_counts_do_not_matter_and_seeds_do() {
    let dir = Folder::new();
    let out = dir.path("g.ply");
    succeeds(&training(scene(), &out, "160", &["--threads", "1"]));
    assert_eq!(fs::read(&out).unwrap(), undisturbed().0);
    assert_eq!(fs::read(format!("{out}.curve.jsonl")).unwrap(), undisturbed().1);
    let other = dir.path("h.ply");
    succeeds(&["train", "--scene", scene(), "--out", &other, "--iterations", "20", "--seed", "1"]);
    succeeds(&["train", "--scene", scene(), "--out", &out, "--iterations", "20", "--seed", "2"]);
    assert_ne!(fs::read(&out).unwrap(), fs::read(&other).unwrap());
}

#[test]
fn a_time_budget_is_a_plan_that_can_be_run_without_it() {
    let dir = Folder::new();
    let (out, again) = (dir.path("g.ply"), dir.path("h.ply"));
    let given = ["train", "--scene", scene(), "--densify", "mcmc", "--max-gaussians", "400", "--out"];
    let budget = ["--time-budget", "1.5s", "--iterations", "300"];
    // A run that was killed keeps to its plan, however fast the machine is by then.
    killed(&[&given[..], &[&out], &budget].concat(), &out, "1");
    let kept = json(&format!("{out}.plan.json"));
    succeeds(&[&given[..], &[&out], &budget].concat());
    let record = record(&out);
    let plan = &record["summary"]["plan"];
    assert_eq!(plan["made"], kept);
    assert!(plan["made"]["plan"]["iterations"].as_u64().unwrap() <= 300, "{plan}");
    let options: Vec<&str> = plan["options"].as_str().unwrap().split(' ').collect();
    succeeds(&[&given[..5], &["--out", &again], &options].concat());
    assert_eq!(fs::read(&out).unwrap(), fs::read(&again).unwrap(), "{plan}");
    assert_eq!(dir.names().len(), 8);
    let e = refused(&["train", "--scene", scene(), "--out", &out, "--time-budget", "1s", "--init", "none.ply"]);
    assert!(e.contains("none.ply"), "{e}");
}

#[test]
fn a_killed_run_goes_on_to_the_same_bytes() {
    let dir = Folder::new();
    let out = dir.path("g.ply");
    // By the number of iterations, and by the clock as where nothing is asked for.
    for every in ["1", "0.01s"] {
        killed(&training(scene(), &out, "160", &[]), &out, every);
        let said = succeeds(&training(scene(), &out, "160", &["--checkpoint-every", "0.01s"]));
        assert!(said.contains("going on after iteration"), "{said}");
        assert_eq!(fs::read(&out).unwrap(), undisturbed().0);
        assert_eq!(fs::read(format!("{out}.curve.jsonl")).unwrap(), undisturbed().1);
        assert_eq!(dir.names(), ["g.ply", "g.ply.curve.jsonl", "g.ply.curve.svg", "g.ply.run.json"]);
        fs::remove_file(&out).unwrap();
    }
}

#[test]
#[cfg(unix)]
fn a_signal_ends_with_a_checkpoint_and_usable_gaussians() {
    let dir = Folder::new();
    let out = dir.path("g.ply");
    let arguments = training(scene(), &out, "100000", &["--checkpoint-every", "1"]);
    let o = common::disturbed(&arguments, &out, |child| {
        assert!(Command::new("kill").args(["-TERM", &child.id().to_string()]).status().unwrap().success());
    });
    assert_eq!(o.status.code(), Some(130));
    assert_eq!(dir.names(), [".g.ply.lock", "g.ply.checkpoint", "g.ply.partial.ply"]);
    assert!(!ply::read_gaussians(dir.path("g.ply.partial.ply")).unwrap().is_empty());
}

#[test]
fn a_checkpoint_of_other_parameters_is_not_used() {
    let dir = Folder::new();
    let out = dir.path("g.ply");
    killed(&training(scene(), &out, "160", &["--holdout", "5"]), &out, "1");
    let o = run(&training(scene(), &out, "160", &[]));
    let said = String::from_utf8_lossy(&o.stderr);
    assert!(o.status.success() && said.contains("beginning anew") && said.contains("another run"), "{said}");
    assert_eq!(fs::read(&out).unwrap(), undisturbed().0);
}

#[test]
fn densify_fixed_keeps_number_order_and_place() {
    let dir = Folder::new();
    let out = dir.path("g.ply");
    succeeds(&training(scene(), &out, "160", &["--densify", "fixed"]));
    let (g, cloud) = (ply::read_gaussians(&out).unwrap(), points());
    assert_eq!(g.means.len(), cloud.len());
    for (a, b) in g.means.iter().zip(&cloud.positions) {
        assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-6), "{a:?} {b:?}");
    }
    let first = g.opacity_logits[0];
    assert!(g.opacity_logits.iter().any(|&o| o != first), "the rest is learnt");
}

#[test]
fn a_scene_without_points_starts_at_random_and_a_ply_can_be_refined() {
    let dir = Folder::new();
    let bare = dir.path("bare");
    write_world(&bare, 10, &PointCloud::default());
    let out = dir.path("g.ply");
    succeeds(&["train", "--scene", &bare, "--out", &out, "--iterations", "200", "--init-points", "500"]);
    let psnr = |out: &str| record(out)["summary"]["psnr_heldout"].as_f64().unwrap();
    assert!(psnr(&out) > 18.0, "{}", psnr(&out));
    let refined = dir.path("h.ply");
    let arguments = ["train", "--scene", &bare, "--out", &refined, "--init", &out, "--iterations", "60"];
    succeeds(&[&arguments[..], &["--sh-degree", "1", "--densify", "none"]].concat());
    let g = ply::read_gaussians(&refined).unwrap();
    assert_eq!(g.sh_degree, 1);
    assert!(psnr(&refined) > psnr(&out));
    assert!(refused(&["train", "--scene", &bare, "--out", &out, "--densify", "fixed"]).contains("no points to keep"));
}

#[test]
fn views_are_rendered_and_measured() {
    let dir = Folder::new();
    let g = balls(60);
    let geometry = dir.path("g.ply");
    ply::write_gaussians(&geometry, &g, &[]).unwrap();
    let base = ["--scene", scene(), "--geometry", &geometry];
    let out = dir.path("views");
    succeeds(&[&["render"], &base[..], &["--out", &out, "--exr"]].concat());
    for name in ["00", "08"] {
        let picture = Image::read(format!("{out}/{name}.png")).unwrap();
        let photo = Image::read(format!("{}/images/{name}.png", scene())).unwrap();
        assert_eq!(picture.to_rgb8(), photo.to_rgb8(), "the same Gaussians, the same picture");
        let exr = exr::prelude::read_all_flat_layers_from_file(format!("{out}/{name}.exr")).unwrap();
        let channels = &exr.layer_data[0].channel_data.list;
        let names: Vec<String> = channels.iter().map(|c| c.name.to_string()).collect();
        assert_eq!(names, ["A", "B", "G", "R", "Z"]);
        let values = |i: usize| channels[i].sample_data.values_as_f32().collect::<Vec<f32>>();
        let (alpha, depth) = (values(0), values(4));
        assert_eq!(alpha.len(), PIXELS);
        let seen: Vec<f32> = alpha.iter().zip(&depth).filter(|(a, _)| **a > 0.5).map(|(_, z)| *z).collect();
        assert!(!seen.is_empty() && seen.iter().all(|z| (1.0..6.0).contains(z)));
    }
    assert_eq!(fs::read_dir(&out).unwrap().count(), 4);
    let some = dir.path("some");
    succeeds(&[&["render"], &base[..], &["--out", &some, "--views", "03,05.png", "--resolution", "2"]].concat());
    assert_eq!(fs::read_dir(&some).unwrap().count(), 2);
    assert_eq!(Image::read(format!("{some}/05.png")).unwrap().width, SIZE.0 / 2);

    let metrics = dir.path("m.json");
    succeeds(&[&["eval"], &base[..], &["--out", &metrics, "--holdout", "8"]].concat());
    let m = json(&metrics);
    assert!(m["psnr_heldout"].as_f64().unwrap() > 55.0, "8-bit photographs of the same Gaussians: {m}");
    let o = run(&[&["eval"], &base[..], &["--out", &metrics, "--holdout", "0"]].concat());
    assert!(o.status.success() && String::from_utf8_lossy(&o.stderr).contains("no view is held out"));
    let m = json(&metrics);
    assert_eq!((&m["split"], &m["psnr_heldout"]), (&Value::from("train"), &Value::Null));
    assert!(m["psnr_train"].as_f64().unwrap() > 55.0 && m["views"].as_array().unwrap().len() == 10);

    assert!(refused(&[&["render"], &base[..], &["--out", &some, "--views", "99"]].concat()).contains("no such view"));
    let e = refused(&[&["render"], &base[..], &["--out", &some, "--holdout", "0"]].concat());
    assert!(e.contains("no views to render"), "{e}");
}

#[test]
fn what_is_skipped_changes_nothing() {
    let dir = Folder::new();
    let mut g = balls(60);
    g.opacity_logits[10..15].fill(-9.0);
    let start = dir.path("start.ply");
    ply::write_gaussians(&start, &g, &[]).unwrap();
    let (out, all) = (dir.path("g.ply"), dir.path("all.ply"));
    let refine = ["--init", &start, "--densify", "none"];
    succeeds(&training(scene(), &out, "160", &refine));
    succeeds(&training(scene(), &all, "160", &[&refine[..], &["--no-skip"]].concat()));
    let (drawn, whole) = (ply::read_gaussians(&out).unwrap(), ply::read_gaussians(&all).unwrap());
    let rows: Vec<u32> = (0..whole.len() as u32).filter(|&i| whole.opacity(i as usize) >= 1.0 / 255.0).collect();
    assert!(rows.len() < whole.len(), "{} Gaussians, all of them drawn", whole.len());
    assert_eq!(drawn, whole.select(&rows));

    let (flat, geometry) = (dir.path("flat.ply"), dir.path("zeros.ply"));
    ply::write_gaussians(&flat, &balls(60), &[]).unwrap();
    succeeds(&["convert", &flat, &geometry, "--sh-degree", "3"]);
    let metrics = dir.path("m.json");
    let said = succeeds(&["eval", "--scene", scene(), "--geometry", &geometry, "--out", &metrics]);
    assert!(said.contains("skipped spherical harmonics of degrees 1 to 3"), "{said}");
}

#[test]
fn damaged_gaussians_are_skipped_as_in_every_stage() {
    let dir = Folder::new();
    let mut g = balls(60);
    g.means[7][1] = f32::NAN;
    let (damaged, without, metrics) = (dir.path("damaged.ply"), dir.path("without.ply"), dir.path("m.json"));
    ply::write_gaussians(&damaged, &g, &[]).unwrap();
    let others: Vec<u32> = (0..g.len() as u32).filter(|&i| i != 7).collect();
    ply::write_gaussians(&without, &g.select(&others), &[]).unwrap();
    let views = |geometry: &str| {
        succeeds(&["eval", "--scene", scene(), "--geometry", geometry, "--out", &metrics]);
        let m = json(&metrics);
        (m["views"].clone(), m["gaussians"].clone())
    };
    let (seen, count) = views(&damaged);
    assert_eq!((&seen, count), (&views(&without).0, Value::from(g.len())));
    let pictures = dir.path("pictures");
    for arguments in [["eval", "--out", &metrics], ["render", "--out", &pictures]] {
        let said = succeeds(&[&arguments[..], &["--scene", scene(), "--geometry", &damaged]].concat());
        assert!(said.contains("skipped 1 of 60 Gaussians: damaged"), "{said}");
    }
    // What is trained on has to be whole: refused before any work.
    let out = dir.path("g.ply");
    let said = refused(&training(scene(), &out, "160", &["--init", &damaged]));
    assert!(said.contains("vertex 7, x, y, z: a parameter is not finite"), "{said}");
    (g.means[7], g.rotations[7]) = ([0.0; 3], [0.0; 4]);
    ply::write_gaussians(&damaged, &g, &[]).unwrap();
    let said = refused(&training(scene(), &out, "160", &["--init", &damaged]));
    assert!(said.contains("vertex 7, rot_*: a parameter is a rotation of length 0"), "{said}");
    g.means.fill([f32::NAN; 3]);
    ply::write_gaussians(&damaged, &g, &[]).unwrap();
    let e = refused(&["eval", "--scene", scene(), "--geometry", &damaged, "--out", &out]);
    assert!(e.contains("no Gaussian is whole"), "{e}");
}

#[test]
fn one_gaussian_and_one_view_are_enough() {
    let dir = Folder::new();
    let root = dir.path("one");
    let cloud = PointCloud { positions: vec![[0.1, 0.0, 0.0]], colors: vec![[200, 100, 50]], ..PointCloud::default() };
    write_world(&root, 1, &cloud);
    let out = dir.path("g.ply");
    let e = refused(&["train", "--scene", &root, "--out", &out]);
    assert!(e.contains("every view is held out") && e.contains("--holdout 0"), "{e}");
    succeeds(&["train", "--scene", &root, "--out", &out, "--holdout", "0", "--iterations", "40"]);
    let g = ply::read_gaussians(&out).unwrap();
    assert!(!g.is_empty() && g.means.iter().flatten().all(|v| v.is_finite()));
}

#[test]
fn bad_input_is_refused_in_one_line() {
    let dir = Folder::new();
    let out = dir.path("g.ply");
    fs::write(&out, "a good geometry").unwrap();
    let train = |scene: &str, more: &[&str]| {
        refused(&[&["train", "--scene", scene, "--out", &out, "--iterations", "5", "--overwrite"], more].concat())
    };
    let missing = dir.path("missing");
    assert!(train(&missing, &[]).contains("no such folder"));

    let shape = dir.path("shape");
    write_world(&shape, 10, &points());
    let other = Image { width: 30, height: 80, rgb: vec![0.5; 30 * 80 * 3], alpha: None };
    other.write_png(format!("{shape}/images/03.png")).unwrap();
    let e = train(&shape, &[]);
    assert!(e.contains("03.png") && e.contains("found 30x80, expected 72x56"), "{e}");
    fs::write(format!("{shape}/images/03.png"), b"\x89PNG\r\n\x1a\n").unwrap();
    assert!(train(&shape, &[]).contains("03.png"));

    let nan = dir.path("nan");
    let mut cloud = points();
    cloud.positions[4][1] = f32::NAN;
    write_world(&nan, 10, &cloud);
    let e = train(&nan, &[]);
    assert!(e.contains("finite") && e.contains("points3D"), "{e}");

    let cut = dir.path("cut.ply");
    let whole = dir.path("whole.ply");
    ply::write_gaussians(&whole, &balls(60), &[]).unwrap();
    let bytes = fs::read(&whole).unwrap();
    fs::write(&cut, &bytes[..bytes.len() - 5]).unwrap();
    assert!(train(scene(), &["--init", &cut]).contains("cut.ply"));
    assert!(
        refused(&["eval", "--scene", scene(), "--geometry", &cut, "--out", &out, "--overwrite"]).contains("cut.ply")
    );
    assert!(refused(&["render", "--scene", scene(), "--geometry", &missing, "--out", &out]).contains("missing"));

    for (option, value) in [("--densify-every", "0"), ("--max-gaussians", "0"), ("--init-points", "2000000000")] {
        // With --check before the photographs are looked for.
        for e in [train(scene(), &[option, value]), train(&missing, &[option, value, "--check"])] {
            assert!(e.contains(option) && e.contains("invalid value"), "{e}");
        }
    }
    succeeds(&["train", "--scene", &missing, "--out", &out, "--check"]);
    let e = train(scene(), &["--memory-limit", "1M"]);
    assert!(e.contains("--memory-limit") && e.contains("--max-gaussians") && e.contains("at most 1M"), "{e}");
    assert_eq!(fs::read_to_string(&out).unwrap(), "a good geometry");
    let blocked = format!("{out}/g.ply");
    assert!(refused(&["train", "--scene", scene(), "--out", &blocked]).contains("cannot create the folder"));
    assert!(refused(&["train", "--scene", scene(), "--out", &shape]).contains("a folder is in the way"));
}

#[test]
fn the_preset_of_3dgs_has_full_pictures_no_limit_and_removes_large_gaussians() {
    let dir = Folder::new();
    let out = dir.path("g.ply");
    let with = |more: &[&str]| {
        let base = ["train", "--scene", scene(), "--iterations", "12", "--overwrite", "--out", &out];
        let said = succeeds(&[&base[..], more].concat());
        (said, record(&out)["parameters"].clone())
    };
    let (said, p) = with(&["--preset", "3dgs"]);
    assert!(said.contains("no limit to their number"), "{said}");
    assert_eq!((&p["schedule"]["coarse"], &p["growth"]["max_gaussians"]), (&json!([]), &json!(usize::MAX)));
    assert!((p["densification"]["max_scale"].as_f64().unwrap() - 0.1).abs() < 1e-6, "{p}");
    let rates = |p: &Value| p["rates"]["position"].as_f64().unwrap();
    assert_eq!((rates(&p), &p["densification"]["split_reach"]), (1.6e-4, &Value::Null));
    assert_eq!(rates(&with(&["--preset", "3dgs", "--densify", "fixed"]).1), 0.0);
    let (said, p) = with(&["--preset", "3dgs", "--max-gaussians", "5000", "--schedule", "coarse"]);
    assert!(said.contains("at most") && p["growth"]["max_gaussians"] == 5000, "{said} {p}");
    assert_ne!(p["schedule"]["coarse"], json!([]));
    let p = with(&[]).1;
    assert_eq!((&p["densification"]["max_scale"], &p["densification"]["split_reach"]), (&Value::Null, &json!(1.0)));
    assert!(rates(&p) > 1.6e-4 && p["rates"]["opacity"] == 0.05, "{p}");
}

/// Checks that the forecast is near the peak.
fn near(forecast: &Value, out: &str) {
    let (forecast, peak) = (forecast.as_f64().unwrap(), record(out)["peak_rss_bytes"].as_f64().unwrap());
    // How much of the program itself lies in memory differs from system to system: 20 MB.
    assert!((forecast - peak).abs() < 0.34 * peak + 20e6, "{out}: forecast {forecast}, peak {peak}");
}

#[test]
#[cfg(target_os = "linux")]
fn forecasts_are_near_the_peaks() {
    let dir = Folder::new();
    let [geometry, metrics, pictures, converted] = ["g.ply", "m.json", "pictures", "c.ply"].map(|n| dir.path(n));
    let base = ["train", "--scene", scene(), "--threads", "2", "--iterations", "10", "--out", &geometry];
    for count in ["2000", "60000"] {
        let said = succeeds(&[&base[..], &["--init", "random", "--init-points", count]].concat());
        assert!(said.contains("memory: about"), "{said}");
        near(&record(&geometry)["summary"]["memory_predicted_bytes"], &geometry);
    }
    let drawn = ["--scene", scene(), "--geometry", &geometry, "--threads", "2", "--out"];
    for (command, out) in [
        ([&["render"], &drawn[..], &[&pictures]].concat(), &pictures),
        ([&["eval"], &drawn[..], &[&metrics]].concat(), &metrics),
        (vec!["convert", &geometry, &converted], &converted),
    ] {
        succeeds(&command);
        near(&record(out)["memory_predicted_bytes"], out);
    }
    assert!(refused(&[&base[..], &["--image-cache", "512"]].concat()).contains("512M or 2G"));
}
