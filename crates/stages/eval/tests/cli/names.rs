//! `eval names`.

use crate::CLIP;
use crate::fixture::Fixture;
use artifacts::{Health, Instances, Naming, ScoredName, role};
use serde_json::{Value, json};
use std::fs;

const NAMES: &str = "--run-dir|{}/run|--geometry|{}/run/geometry.ply|--text-features|{}/text.json";

/// A run whose table tells all three things.
fn fixture() -> Fixture {
    let f = Fixture::new(2);
    fs::write(
        f.table(),
        r#"{"red ball": [1, 0], "blue ball": [0, 2], "floor": [-0.6, -0.8], "thing": [0.7, 0.7], "galaxy": [1, 0]}"#,
    )
    .unwrap();
    f
}

fn best(names: &Value) -> Vec<(u64, &str, bool)> {
    let one = |n: &'_ Value| n["instance"].as_u64().unwrap();
    let named = names["named"].as_array().unwrap();
    named.iter().map(|n| (one(n), n["names"][0]["name"].as_str().unwrap(), n["sure"].as_bool().unwrap())).collect()
}

#[test]
fn every_instance_gets_its_best_names() {
    let f = fixture();
    let printed = f.good("names", NAMES);
    let names = f.json("run/names.json");
    assert_eq!(best(&names).iter().map(|n| n.1).collect::<Vec<_>>(), ["red ball", "blue ball", "floor"]);
    assert_eq!((&names["words"], &names["source"]), (&json!(4), &json!("table of 5 text features")), "no galaxies");
    assert_eq!(names["named"][0]["names"].as_array().unwrap().len(), 3);
    assert!((names["named"][0]["names"][0]["score"].as_f64().unwrap() - 1.0).abs() < 1e-6);
    assert!(printed.contains("3 things by 4 names") && printed.contains("floor x 1"), "{printed}");
    // The words of a person: "thing", which lies between two, is none of them.
    fs::write(f.path().join("mine.txt"), "# mine\nred ball\nblue ball\n\nfloor\nFloor\n").unwrap();
    let mine = format!("{NAMES}|--vocabulary|{{}}/mine.txt");
    f.warned("names", &mine, &["name something again are left out: 1"]);
    let names = f.json("run/names.json");
    assert_eq!(best(&names), [(0, "red ball", true), (1, "blue ball", true), (2, "floor", true)]);
    assert!((names["by_chance"].as_f64().unwrap() - 4.8 / 7.0).abs() < 1e-5, "{names}");
    // The same bytes again, for any number of threads.
    let before = fs::read(f.run().join("names.json")).unwrap();
    f.good("names", &format!("{mine}|--threads|1"));
    assert_eq!(fs::read(f.run().join("names.json")).unwrap(), before);
    f.good("names", &format!("{mine}|--min-support|4|--out|{{}}/rare.json"));
    assert_eq!(best(&f.json("rare.json")).len(), 2);
}

#[test]
fn what_a_person_said_is_printed_and_kept_out_of_the_file() {
    let f = fixture();
    f.good("names", NAMES);
    let before = f.json("run/names.json");
    let edits = json!({"format": "instances.edits", "version": 1, "instances": before["instances"], "edits": [
        {"op": "rename", "instance": 0, "name": "my moon"}, {"op": "merge", "instances": [1, 2]}]});
    fs::write(f.run().join("instances.edits.json"), edits.to_string()).unwrap();
    let printed = f.good("names", NAMES);
    assert!(printed.contains("my moon") && !printed.contains("red ball x"), "{printed}");
    assert!(
        !printed.contains("blue ball x") && !printed.contains("floor x"),
        "merged ones are something else: {printed}"
    );
    assert_eq!(f.json("run/names.json"), before);
}

#[test]
fn a_text_encoder_reads_the_everyday_words_once() {
    let f = Fixture::new(2);
    let model = f.path().join("clip");
    fs::create_dir(&model).unwrap();
    for file in ["text.onnx", "clip.json"] {
        let _ = fs::copy(format!("{CLIP}/{file}"), model.join(file));
    }
    let encoder = onnx_models::ClipText::open(&model, &onnx_models::EngineOptions::default()).unwrap();
    f.write_found(encoder.encode(&["teapot"]).unwrap());
    let ask = "--run-dir|{}/run|--geometry|{}/run/geometry.ply|--clip|{}/clip";
    f.good("names", ask);
    let names = f.json("run/names.json");
    assert_eq!(best(&names).len(), 2, "one has no descriptor");
    let score = names["named"][1]["names"][0]["score"].as_f64().unwrap();
    assert!(score > 0.9 && names["words"].as_u64().unwrap() > 1100, "{names}");
    let kept = || {
        fs::read_dir(&model)
            .unwrap()
            .filter(|e| e.as_ref().unwrap().file_name().to_string_lossy().starts_with("cags-texts-"))
            .count()
    };
    assert_eq!(kept(), 1);
    f.good("names", ask);
    assert_eq!((f.json("run/names.json"), kept()), (names, 1));
}

#[test]
fn the_report_counts_what_is_there() {
    let f = fixture();
    f.good("names", NAMES);
    let report = |part: &str| {
        f.good("report", "--run-dir|{}/run|--scene|{}/balls|--out|{}/report.html");
        let page = fs::read_to_string(f.path().join("report.html")).unwrap();
        assert!(page.contains(part), "{part}");
        page.contains("What is there")
    };
    assert!(report("blue ball ("));
    // Names of other instances are not shown.
    f.change_instances(|i| i.score[0] = 0.1);
    assert!(!report("names of other instances"));
}

#[test]
fn bad_vocabularies_and_sources_are_one_line() {
    let f = fixture();
    f.bad("names", "--run-dir|{}/run|--geometry|{}/run/geometry.ply", &["--clip", "nothing to compare names with"]);
    f.bad("names", &format!("{NAMES}|--vocabulary|{{}}/none.txt"), &["--vocabulary", "none.txt: cannot read"]);
    for (text, part) in [
        ("", "too few names; found 0, expected at least 2"),
        ("# none\n\n \n", "found 0"),
        ("red ball\n", "found 1"),
        ("red ball\nred\u{7} ball\n", "line 2: not a name"),
    ] {
        fs::write(f.path().join("bad.txt"), text).unwrap();
        f.bad("names", &format!("{NAMES}|--vocabulary|{{}}/bad.txt"), &["bad.txt", part]);
    }
    fs::write(f.path().join("bad.txt"), [0xff, 0xfe, b'a']).unwrap();
    f.bad("names", &format!("{NAMES}|--vocabulary|{{}}/bad.txt"), &["bad.txt: not text"]);
    fs::write(f.path().join("bad.txt"), "red ball\nteapot\n").unwrap();
    f.bad("names", &format!("{NAMES}|--vocabulary|{{}}/bad.txt"), &["no such text in the table", "teapot"]);
    fs::write(f.table(), r#"{"object": [1, 0], "galaxy": [0, 1]}"#).unwrap();
    f.bad("names", NAMES, &["text.json", "too few names"]);
    fs::write(f.table(), r#"{"a": [1, 0, 0], "b": [0, 1, 0]}"#).unwrap();
    f.bad("names", NAMES, &["another model"]);
    assert!(!f.run().join("names.json").exists());
}

#[test]
fn names_of_masks_stand_alone_without_texts_and_win_where_they_are_sure() {
    let f = fixture();
    let naming = |instance: u32, name: &str, score: f32| Naming {
        instance,
        names: vec![ScoredName { name: name.into(), score }],
        margin: score,
        sure: score >= 0.5,
    };
    let health = Health { names: vec![naming(0, "sports ball", 0.9), naming(2, "rug", 0.3)], ..Health::default() };
    let mut provenance = f.provenance();
    provenance.extra = json!({ "health": health });
    provenance.inputs.insert(role::MASK_NAMES.into(), String::new());
    let (instances, _) = Instances::read(f.instances()).unwrap();
    instances.write(f.instances(), provenance).unwrap();
    f.good("names", "--run-dir|{}/run|--geometry|{}/run/geometry.ply");
    let names = f.json("run/names.json");
    assert_eq!(best(&names), [(0, "sports ball", true), (2, "rug", false)]);
    assert_eq!((&names["source"], &names["words"]), (&json!("names of the masks"), &json!(2)));
    f.good("names", NAMES);
    let names = f.json("run/names.json");
    assert_eq!(best(&names).iter().map(|n| n.1).collect::<Vec<_>>(), ["sports ball", "blue ball", "floor"]);
}
