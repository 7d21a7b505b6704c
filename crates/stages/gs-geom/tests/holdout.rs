//! Which views training did not see travels with the Gaussians, and nothing is called unseen that is not.

mod common;

use common::world::{balls, points, scene, write_world};
use common::{Folder, json, succeeds};
use gs_scene::ply;
use serde_json::{Value, json};
use std::fs;

/// Gaussians of a short training on the ten views of a scene.
fn trained(scene: &str, out: &str, more: &[&str]) -> String {
    succeeds(&[&["train", "--scene", scene, "--out", out, "--iterations", "20"], more].concat())
}

/// Figures of `gs-geom eval`, and what it said.
fn measured(dir: &Folder, scene: &str, geometry: &str, more: &[&str]) -> (Value, String) {
    let out = dir.path("m.json");
    let said = succeeds(&[&["eval", "--scene", scene, "--geometry", geometry, "--out", &out], more].concat());
    (json(&out), said)
}

fn names(m: &Value) -> Vec<&str> {
    m["views"].as_array().unwrap().iter().map(|v| v["name"].as_str().unwrap()).collect()
}

#[test]
fn the_hold_out_of_training_is_that_of_later_stages() {
    let dir = Folder::new();
    let (out, copy) = (dir.path("g.ply"), dir.path("copy.ply"));
    trained(scene(), &out, &["--holdout", "5"]);
    succeeds(&["convert", &out, &copy, "--sh-degree", "0"]);
    for geometry in [&out, &copy] {
        let (m, said) = measured(&dir, scene(), geometry, &[]);
        assert_eq!((&m["split"], names(&m)), (&json!("test"), vec!["00.png", "05.png"]));
        assert!(m["psnr_heldout"].is_f64() && !said.contains("warning"), "{said}");
    }
    let pictures = dir.path("views");
    let render = ["render", "--scene", scene(), "--geometry", &out, "--out", &pictures];
    succeeds(&render);
    assert_eq!(fs::read_dir(&pictures).unwrap().count(), 2);
    let said = succeeds(&[&render[..], &["--holdout", "2"]].concat());
    assert!(said.contains("--holdout 2, but the Gaussians were trained with --holdout 5"), "{said}");
    // Of 00, 02, 04, 06 and 08 training saw all but the first; of every tenth view none.
    let (m, said) = measured(&dir, scene(), &out, &["--holdout", "2"]);
    assert!(said.contains("trained with --holdout 5: training saw 4 of the views held out here"), "{said}");
    assert_eq!(m["seen_by_training"], 4);
    assert_eq!(names(&measured(&dir, scene(), &out, &["--holdout", "10"]).0), ["00.png"]);
    // All views were learnt from.
    trained(scene(), &out, &["--holdout", "0", "--overwrite"]);
    let (m, said) = measured(&dir, scene(), &out, &[]);
    assert_eq!((&m["split"], &m["psnr_heldout"]), (&json!("train"), &Value::Null));
    assert!(said.contains("no view is held out"), "{said}");
}

#[test]
fn gaussians_that_do_not_say_it_have_no_held_out_views() {
    let dir = Folder::new();
    let (own, out) = (dir.path("scene"), dir.path("g.ply"));
    write_world(&own, 10, &points());
    ply::write_gaussians(&out, &balls(60), &[]).unwrap();
    let unknown = |geometry: &str| {
        let (m, said) = measured(&dir, &own, geometry, &[]);
        assert_eq!((&m["split"], &m["psnr_heldout"]), (&json!("unknown"), &Value::Null));
        assert!(m["psnr"].is_f64() && said.contains("do not say which of these views training saw"), "{said}");
    };
    unknown(&out);
    // Gaussians that started from those of another training may have learnt from more views.
    let (all, next) = (dir.path("all.ply"), dir.path("next.ply"));
    trained(&own, &all, &["--holdout", "0"]);
    for init in [&out, &all] {
        let said = trained(&own, &next, &["--init", init, "--overwrite"]);
        assert!(said.contains("no stage will call these unseen"), "{said}");
        unknown(&next);
    }
    // From those that held the same views out they have not.
    trained(&own, &out, &["--overwrite"]);
    trained(&own, &next, &["--init", &out, "--overwrite"]);
    assert_eq!(measured(&dir, &own, &next, &[]).0["split"], "test");
    // Other photographs than training had.
    write_world(&own, 9, &points());
    unknown(&next);
}
