//! Georeferenced scenes through the program.

mod common;

use common::world::{balls, photograph, points, ring, write_scene};
use common::{Folder, json, record, refused, succeeds, training};
use gs_scene::{Gaussians, PointCloud, ply, splat};
use std::collections::BTreeSet;

const UTM: [f64; 3] = [448_262.4, 5_411_932.7, 114.0];

#[test]
fn a_georeferenced_scene_trains_as_at_home() {
    let dir = Folder::new();
    let (scene, out) = (dir.path("utm"), dir.path("g.ply"));
    write_scene(&scene, &ring(10), &PointCloud { shift: UTM, ..points() }, photograph);
    let said = succeeds(&training(&scene, &out, "120", &[]));
    assert!(said.contains("is subtracted from it"), "{said}");
    let shift = ply::read_gaussians(&out).unwrap().shift;
    assert!((0..3).all(|c| (shift[c] - UTM[c]).abs() < 2.0), "{shift:?}");
    assert_eq!(record(&out)["summary"]["shift"], serde_json::json!(shift));
    let psnr = record(&out)["summary"]["psnr_heldout"].as_f64().unwrap();
    assert!(psnr > 20.0, "{psnr}");
    let g = ply::read_gaussians(&out).unwrap();
    let values = |c: usize| g.means.iter().map(|m| m[c].to_bits()).collect::<BTreeSet<u32>>().len();
    assert!(2 * values(1) > g.len(), "{} values of y in {} Gaussians", values(1), g.len());

    // Gaussians in any format that keeps the shift fit the photographs; those without it are refused.
    let measured = |file: &str| {
        // Only a PLY says which views training held out.
        let eval = [
            "eval",
            "--scene",
            &scene,
            "--geometry",
            file,
            "--holdout",
            "8",
            "--out",
            &dir.path("m.json"),
            "--overwrite",
        ];
        succeeds(&eval);
        json(&dir.path("m.json"))["psnr_heldout"].as_f64().unwrap()
    };
    assert!((measured(&out) - psnr).abs() < 0.1, "{} {psnr}", measured(&out));
    let [glb, spz] = ["g.glb", "g.spz"].map(|name| dir.path(name));
    assert!(!succeeds(&["convert", &out, &glb]).contains("warning"));
    assert!((measured(&glb) - psnr).abs() < 0.1, "{} {psnr}", measured(&glb));
    assert!(succeeds(&["convert", &out, &spz]).contains("warning: the shift "));
    let lost = refused(&["eval", "--scene", &scene, "--geometry", &spz, "--out", &dir.path("n.json")]);
    assert!(lost.contains("lie far apart") && lost.contains("found 0 0 0"), "{lost}");

    // A box is in the world's coordinates.
    let [x, y, z] = UTM;
    let half = format!("{x},{},{},{},{},{}", y - 9.0, z - 9.0, x + 9.0, y + 9.0, z + 9.0);
    succeeds(&["convert", &out, &dir.path("half.ply"), "--crop", &half]);
    let kept = ply::read_gaussians(dir.path("half.ply")).unwrap();
    assert!(kept.shift == shift && kept.means.iter().all(|m| f64::from(m[0]) + shift[0] >= x - 1e-6));
    assert!((1..g.len()).contains(&kept.len()), "{}", kept.len());

    // It goes on from Gaussians with another shift, and ends in its own.
    let moved = Gaussians { shift: UTM, ..balls(60) };
    let init = dir.path("init.ply");
    ply::write_gaussians(&init, &moved, &[]).unwrap();
    let again = dir.path("again.ply");
    succeeds(&training(&scene, &again, "1", &["--init", &init, "--densify", "none", "--no-skip"]));
    let started = ply::read_gaussians(&again).unwrap();
    for (a, b) in started.means.iter().zip(&moved.means) {
        assert!(
            (0..3).all(|c| (f64::from(a[c]) + started.shift[c] - f64::from(b[c]) - UTM[c]).abs() < 0.05),
            "{a:?} {b:?}"
        );
    }
}

#[test]
fn renders_of_far_gaussians_are_a_far_dataset() {
    let dir = Folder::new();
    let (file, out) = (dir.path("far.ply"), dir.path("views"));
    ply::write_gaussians(&file, &Gaussians { shift: UTM, ..balls(60) }, &[]).unwrap();
    succeeds(&["views", "--geometry", &file, "--out", &out, "--views", "6", "--size", "64x48"]);
    succeeds(&["eval", "--scene", &out, "--geometry", &file, "--out", &dir.path("m.json"), "--holdout", "2"]);
    let psnr = json(&dir.path("m.json"))["psnr_heldout"].as_f64().unwrap();
    assert!(psnr > 45.0, "{psnr}");
    let v = json(&format!("{out}/views.json"));
    assert_eq!(v["shift"], serde_json::json!(UTM));
    assert_eq!(splat::read(&file).unwrap().gaussians.shift, UTM);
}
