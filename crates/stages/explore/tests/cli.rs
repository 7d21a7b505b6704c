//! The program and its server, without a browser.

mod common;

use artifacts::Edits;
use common::{Run, SIZE, camera, click, gaussians};
use glam::DVec3;
use serde_json::{Value, json};

#[test]
fn a_text_no_better_than_by_chance_is_said() {
    let run = Run::new();
    let mut table = json!({"near ball": [1, 0], "far ball": [0, 1], "ghost": [0.7, 0.7]});
    query::Unrelated::texts().for_each(|t| table[t] = json!([0.6, 0.8]));
    std::fs::write(run.dir.path().join("text.json"), table.to_string()).unwrap();
    let server = run.serve(&[]);
    let ask = |text: &str| server.json("GET", &format!("/find?text={text}"), &Value::Null);
    let ghost = ask("ghost")["verdict"].take();
    assert_eq!(ghost["matches"], json!(false));
    assert!((ghost["best"].as_f64().unwrap() - 0.5f64.sqrt()).abs() < 1e-6);
    assert!((ghost["by_chance"].as_f64().unwrap() - 0.8).abs() < 1e-6);
    assert_eq!(ask("far%20ball")["verdict"]["matches"], json!(true));
    let door = |text: &str| server.json("POST", "/tools/find", &json!({"text": text}));
    assert_eq!((&door("ghost")["matches"], &door("ghost")["by_chance"]), (&json!(false), &json!(0.8)));
    // A name that a person gave needs no score.
    server.json("PUT", "/edits", &json!([{"op": "rename", "instance": 1, "name": "Ghost"}]));
    assert_eq!(door("ghost")["matches"], json!(true));
    let page = run.dir.path().join("page.html");
    let written = run.run("page", &["--out", page.to_str().unwrap(), "--text", "ghost"]);
    assert!(written.status.success(), "{}", String::from_utf8_lossy(&written.stderr));
    assert!(std::fs::read_to_string(page).unwrap().contains("\"verdict\":{"));
}

#[test]
fn names_of_a_vocabulary_are_shown_only_for_their_instances() {
    let run = Run::new();
    run.write_names(&run.instances());
    let server = run.serve(&[]);
    let scene = server.json("GET", "/scene.json", &Value::Null);
    let guesses: Vec<&Value> = (0..2).map(|k| &scene["instances"][k]["guess"]).collect();
    assert_eq!(guesses, [&json!({"name": "sun", "sure": true}), &json!({"name": "planet", "sure": false})]);
    assert_eq!(scene["instances"][0]["name"], Value::Null, "no person said so");
    let names = |server: &common::Server| -> Vec<Value> {
        let list = server.json("POST", "/tools/list", &json!({}));
        list["objects"].as_array().unwrap().iter().map(|o| o["name"].clone()).collect()
    };
    assert_eq!(names(&server), [json!("sun"), json!("planet")]);
    // What was split is something else.
    server.json("PUT", "/edits", &json!([{"op": "split", "instance": 1}]));
    assert_eq!(names(&server), [json!("sun"), Value::Null, Value::Null]);
    drop(server);
    std::fs::remove_file(run.out().join("instances.edits.json")).unwrap();
    run.write_names("0123456789abcdef");
    let server = run.serve(&[]);
    let scene = server.json("GET", "/scene.json", &Value::Null);
    assert_eq!((&scene["instances"][0]["guess"], names(&server)), (&Value::Null, vec![Value::Null; 2]));
    let said = scene["messages"].to_string();
    assert!(said.contains("names are left out") && said.contains("found 0123456789ab"), "{said}");
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
    assert_eq!(found["text"], "far ball");
    assert_eq!(found["scores"], json!([0.0, 1.0]));

    // Split and named: ids stay, the file says what was done, and the answers follow.
    let edits = json!([{"op": "split", "instance": 1}, {"op": "rename", "instance": 2, "name": "Moon"},
        {"op": "note", "instance": 2, "text": "ours"}]);
    let list = server.json("PUT", "/edits", &edits)["instances"].take();
    assert_eq!(list.as_array().unwrap().len(), 3);
    assert_eq!(list[2]["name"], json!("Moon"));
    assert_eq!(Edits::read(run.out().join("instances.edits.json")).unwrap().edits.len(), 3);
    let noted = server.json("POST", "/tools/list", &json!({}));
    assert_eq!((&noted["objects"][1]["note"], &noted["objects"][2]["note"]), (&Value::Null, &json!("ours")));
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
fn a_lasso_catches_what_is_seen_and_what_is_given_away_stays_so() {
    let run = Run::new();
    let server = run.serve(&[]);
    let (w, h) = (f64::from(SIZE.0), f64::from(SIZE.1));
    let caught = |instance: i32, own: bool, hidden: &[u32], left: f64| {
        let mut lasso = click(0, 0, hidden);
        lasso["outline"] = json!([[left, 0.0], [w, 0.0], [w, h], [left, h]]);
        (lasso["instance"], lasso["own"]) = (instance.into(), own.into());
        let caught = server.json("POST", "/lasso", &lasso);
        (caught["gaussians"].as_str().unwrap().to_string(), caught["count"].as_u64().unwrap())
    };
    // The near ball hides a part of the far one; nothing that is too faint is ever caught.
    let one = ("2 1".to_string(), 1);
    assert_eq!((caught(1, true, &[], 0.0), caught(0, false, &[], 0.0)), (one.clone(), one));
    assert_eq!(caught(1, true, &[0], 0.0), ("1 2".to_string(), 2));
    assert_eq!((caught(0, true, &[], 0.0).1, caught(0, true, &[], 40.0)), (1, (String::new(), 0)));
    let right = camera(0.0).project(DVec3::new(0.9, 0.0, 4.0));
    let there = || server.json("POST", "/pick", &click(right.0 as u32, right.1 as u32, &[]))["instance"].take();
    assert_eq!(there(), json!(1));
    let assign = |instance: i32| json!([{"op": "assign", "instance": instance, "gaussians": "2 1"}]);
    let said = server.json("PUT", "/edits", &assign(-1));
    assert_eq!((said["instances"][1]["count"].as_u64(), &said["cut"]["assigned"]), (Some(1), &json!([[2]])));
    assert_eq!(there(), Value::Null);
    server.json("PUT", "/edits", &json!([assign(-1)[0], assign(0)[0]]));
    assert_eq!(there(), json!(0));
    let list = server.json("POST", "/tools/list", &json!({}));
    assert_eq!([&list["objects"][0]["gaussians"], &list["objects"][1]["gaussians"]], [&json!(2), &json!(1)]);
}

#[test]
fn bad_questions_are_refused_and_the_server_goes_on() {
    let run = Run::new();
    let server = run.serve(&[]);
    let mut far = click(0, 0, &[]);
    far["camera"]["fx"] = json!(0.0);
    let lasso = |width: u32, corners: usize| {
        let mut lasso = click(0, 0, &[]);
        lasso["camera"]["width"] = width.into();
        lasso["camera"]["height"] = (if width > 64 { 32_768 } else { 48 }).into();
        lasso["outline"] = json!(vec![[0.0, 0.0]; corners]);
        (lasso["instance"], lasso["own"]) = (0.into(), true.into());
        lasso
    };
    let long = format!("/find?text={}", "a".repeat(1001));
    for (method, path, body, expected) in [
        ("POST", "/pick", "{", "not understood"),
        ("POST", "/pick", &click(64, 0, &[])["x"].to_string(), "not understood"),
        ("POST", "/pick", &click(64, 0, &[]).to_string(), "outside of the picture"),
        ("POST", "/pick", &click(0, 0, &[99]).to_string(), "no such cell"),
        ("POST", "/pick", &far.to_string(), "not a camera"),
        ("GET", "/find?text=zebra", "", "no such text in the table"),
        ("GET", &long, "", "the text is too long; found 1001 characters"),
        ("PUT", "/edits", r#"[{"op": "split", "instance": 0}]"#, "edits[0].instance"),
        ("PUT", "/edits", r#"[{"op": "explode"}]"#, "not understood"),
        ("PUT", "/edits", r#"[{"op": "assign", "instance": 0, "gaussians": "9 9"}]"#, "edits[0].gaussians"),
        ("POST", "/lasso", &lasso(64, 2).to_string(), "not an outline; found 2 corners, expected 3 to 10000"),
        ("POST", "/lasso", &lasso(64, 10_001).to_string(), "not an outline; found 10001 corners"),
        ("POST", "/lasso", &lasso(32_768, 3).to_string(), "the picture is too large; found 1073741824 pixels"),
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
    assert!(head.contains("cross-origin-resource-policy: same-origin"), "{head}");
    for stranger in ["Host: evil.example\r\n", "Origin: http://evil.example\r\n", "Sec-Fetch-Site: cross-site\r\n"] {
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
    let made = run.run("page", &["--out", &file, "--text", "far ball"]);
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    let page = std::fs::read_to_string(&out).unwrap();
    assert!(page.contains("\"scores\":[0.0,1.0]") && page.matches("data:image/jpeg").count() == 4);
    let first = std::fs::read(&out).unwrap();
    assert!(run.run("page", &["--out", &file, "--text", "far ball", "--threads", "1"]).status.success());
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
