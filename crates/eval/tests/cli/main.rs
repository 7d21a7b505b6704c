//! `eval` as people run it.

mod fixture;

use fixture::{Fixture, stem};
use std::fs;

const TABLE: &str = "--text-features|{}/text.json|--out|{}/out";

#[test]
fn a_query_writes_the_selection_in_every_form() {
    let f = Fixture::new(2);
    let printed =
        f.good("query", &format!("{TABLE}|--text|red ball|--text|blue ball|--views|frame_00002,frame_00004.png"));
    assert!(printed.contains("\"red ball\" (1 Gaussians selected)"), "{printed}");
    let q = f.json("out/query.json");
    assert_eq!((q["instances"].as_u64(), q["dimension"].as_u64()), (Some(3), Some(2)));
    let red = &q["queries"][0];
    assert_eq!(red["selected"], serde_json::json!([0]));
    assert!((red["score"].as_f64().unwrap() - 1.0).abs() < 1e-6);
    assert_eq!(red["ranking"][2]["instance"], 2);
    assert_eq!(red["views"][0]["view"], "frame_00002");
    let all = gs_scene::ply::read_gaussians(f.geometry()).unwrap();
    let selected = gs_scene::ply::read_gaussians(f.path().join("out/red-ball.ply")).unwrap();
    assert_eq!(selected, all.select(&[0]));
    let mask = image::open(f.path().join("out/red-ball.frame_00002.mask.png")).unwrap().to_luma8();
    assert_eq!(mask.dimensions(), (fixture::WIDTH, fixture::HEIGHT));
    let inside = mask.pixels().filter(|p| p.0 == [255]).count() as u64;
    assert_eq!(red["views"][0]["pixels"].as_u64(), Some(inside));
    let (x, y, _) = fixture::cameras()[2].project(glam::DVec3::from_array(fixture::CENTRES[0]));
    assert_eq!(mask[(x as u32, y as u32)].0, [255]);
    assert!(f.path().join("out/blue-ball.frame_00004.overlay.png").exists());
    assert!(f.path().join("out/query.json.run.json").exists());
}

#[test]
fn pictures_are_of_views_where_the_selection_was_matched() {
    let f = Fixture::new(2);
    f.good("query", &format!("{TABLE}|--text|red ball"));
    let views: Vec<String> = f.json("out/query.json")["queries"][0]["views"]
        .as_array()
        .unwrap()
        .iter()
        .map(|v| v["view"].as_str().unwrap().to_string())
        .collect();
    assert_eq!(views, [stem(1), stem(5)]);
}

#[test]
fn top_k_and_threshold_select() {
    let f = Fixture::new(2);
    let selected = |extra: &str| {
        f.good("query", &format!("{TABLE}|--text|thing|--views|frame_00002|{extra}"));
        f.json("out/query.json")["queries"][0]["selected"].to_string()
    };
    assert_eq!(selected(""), "[0]");
    assert_eq!(selected("--top-k|2"), "[0,1]");
    assert_eq!(selected("--threshold|0.5"), "[0,1]");
    assert_eq!(selected("--threshold|-1"), "[0,1,2]");
    assert_eq!(selected("--threshold|0.9"), "[]");
}

#[test]
fn a_text_encoder_takes_any_words() {
    let f = Fixture::new(2);
    let clip = concat!(env!("CARGO_MANIFEST_DIR"), "/../onnx-models/testdata/clip");
    let encoder = onnx_models::ClipText::open(clip, &onnx_models::EngineOptions::default()).unwrap();
    let words = "a round thing, nowhere in a table";
    let feature = encoder.encode(&[words]).unwrap();
    let opposite: Vec<f32> = feature.iter().map(|v| -v).collect();
    f.write_described(&[opposite, feature, vec![0.0; 4]], |g| g as i32);
    f.good("query", &format!("--clip|{clip}|--text|{words}|--views|frame_00002|--out|{{}}/out"));
    let q = f.json("out/query.json");
    assert_eq!(q["text_source"], "CLIP text encoder test-clip");
    assert_eq!(q["queries"][0]["selected"], serde_json::json!([1]));
    assert!((q["queries"][0]["score"].as_f64().unwrap() - 1.0).abs() < 1e-6);
    assert_eq!(q["queries"][0]["ranking"].as_array().unwrap().len(), 2, "a zero descriptor has no cosine");
    f.good("score", &format!("--clip|{clip}|--out|{{}}/score.json"));
    assert_eq!(f.json("score.json")["query_pairs"], 4);
    f.write_instances(2, |g| g as i32);
    let e = f.bad("query", &format!("--clip|{clip}|--text|{words}|--out|{{}}/other"));
    assert!(e.contains("found dimension 2, expected 4 (CLIP text encoder test-clip)"), "{e}");
}

#[test]
fn bad_queries_are_one_line_and_leave_no_output() {
    let f = Fixture::new(2);
    let with = |rest: &str| f.bad("query", &format!("{rest}|--out|{{}}/out"));
    let e = with("--text-features|{}/text.json|--text|red bal");
    assert!(e.contains("no such text in the table") && e.contains("\"red ball\""), "{e}");
    let e = with("--text-features|{}/text.json|--text|red ball|--views|frame_7");
    assert!(e.contains("--views: no such view; found frame_7"), "{e}");
    let e = with("--text-features|{}/none.json|--text|red ball");
    assert!(e.contains("none.json: cannot read"), "{e}");
    let e = with("--clip|{}/no-model|--text|red ball");
    assert!(e.contains("no-model"), "{e}");
    let e = with("--text|red ball");
    assert!(e.contains("expected --clip or --text-features"), "{e}");
    let e = with("--text-features|{}/text.json|--text|red ball|--alpha|1.5");
    assert!(e.contains("--alpha"), "{e}");
    fs::write(f.table(), r#"{"red ball": [1, 0, 0]}"#).unwrap();
    let e = with("--text-features|{}/text.json|--text|red ball");
    assert!(e.contains("another model") && e.contains("found dimension 2, expected 3"), "{e}");
    f.write_instances(0, |g| g as i32);
    let e = with("--text-features|{}/text.json|--text|red ball");
    assert!(e.contains("no language features") && e.contains("mask-embed"), "{e}");
    assert!(!f.path().join("out").exists());
}

#[test]
fn artifacts_of_another_scene_are_refused() {
    let f = Fixture::new(2);
    let mut g = gs_scene::ply::read_gaussians(f.geometry()).unwrap();
    g.means[0][0] += 0.25;
    gs_scene::ply::write_gaussians(f.geometry(), &g, &[]).unwrap();
    for (command, rest) in [
        ("query", "--text-features|{}/text.json|--text|red ball|--out|{}/out"),
        ("score", "--out|{}/out"),
        ("report", "--run-dir|{}/run|--scene|{}/balls|--out|{}/out"),
    ] {
        let e = f.bad(command, rest);
        assert!(e.contains("instances.safetensors: inputs.geometry: made from another geometry"), "{e}");
    }
    let f = Fixture::new(2);
    let transforms = f.scene().join("transforms.json");
    for i in 0..fixture::VIEWS {
        let other = format!("images/other_{i}.png");
        fs::rename(f.scene().join(format!("images/{}.png", stem(i))), f.scene().join(&other)).unwrap();
        let text = fs::read_to_string(&transforms).unwrap();
        fs::write(&transforms, text.replace(&format!("images/{}.png", stem(i)), &other)).unwrap();
    }
    let e = f.bad("score", "--out|{}/out");
    assert!(e.contains("another scene; found frame_00000 and 8 more"), "{e}");
    fs::remove_file(f.geometry()).unwrap();
    assert!(f.bad("score", "--out|{}/out").contains("geometry.ply: cannot open"));
    fs::write(f.instances(), b"short").unwrap();
    assert!(f.bad("score", "--out|{}/out").contains("instances.safetensors: not a safetensors artifact"));
    assert!(!f.path().join("out").exists());
}

#[test]
fn a_perfect_run_scores_high_and_the_csv_agrees() {
    let f = Fixture::new(2);
    let printed = f.good("score", "--text-features|{}/text.json|--out|{}/s/score.json");
    let s = f.json("s/score.json");
    assert_eq!(s["instance_miou"], 1.0, "{printed}");
    assert_eq!(
        (s["object_miou"].as_f64(), s["fragmented"].as_u64(), s["merging"].as_u64()),
        (Some(1.0), Some(0), Some(0))
    );
    assert!(s["query_miou"].as_f64().unwrap() > 0.8, "{printed}");
    assert_eq!((s["query_macc25"].as_f64(), s["query_pairs"].as_u64()), (Some(1.0), Some(4)));
    assert_eq!(s["queries"][1]["text"], "red ball");
    let csv = fs::read_to_string(f.path().join("s/score.queries.csv")).unwrap();
    let ious: Vec<f64> = csv.lines().skip(1).map(|l| l.rsplit(',').next().unwrap().parse().unwrap()).collect();
    let mean = ious.iter().sum::<f64>() / ious.len() as f64;
    assert!((mean - s["query_miou"].as_f64().unwrap()).abs() < 1e-5);
    let things = fs::read_to_string(f.path().join("s/score.things.csv")).unwrap();
    assert!(things.contains("2,\"floor\",true,100,1.000000,2,1"), "{things}");
    f.good("score", "--text-features|{}/text.json|--silhouette|visible|--out|{}/s/visible.json");
    let v = f.json("s/visible.json");
    assert_eq!(v["silhouette"][0], "visible");
    assert_eq!(v["query_miou"], s["query_miou_visible"]);
}

#[test]
fn labels_at_another_scale_are_scored_at_their_own() {
    let f = Fixture::new(2);
    for i in [1, 4] {
        f.write_label(i, &[("red ball", 0), ("blue ball", 1)], (4 * fixture::WIDTH, 4 * fixture::HEIGHT));
    }
    f.good("score", "--text-features|{}/text.json|--out|{}/score.json");
    assert!(f.json("score.json")["query_miou"].as_f64().unwrap() > 0.9);
    f.write_label(1, &[("red ball", 0)], (100, 100));
    let e = f.bad("score", "--text-features|{}/text.json|--out|{}/score.json");
    assert!(
        e.contains("frame_00001.json: info: the labelled image has another shape") && e.contains("found 100x100"),
        "{e}"
    );
}

#[test]
fn missing_predictions_count_as_zero_and_say_so() {
    let f = Fixture::new(2);
    f.write_label(4, &[("red ball", 0), ("green ball", 1)], (fixture::WIDTH, fixture::HEIGHT));
    fs::rename(f.scene().join("label/frame_00001.json"), f.scene().join("label/frame_09999.json")).unwrap();
    let o = f.eval("score", "--text-features|{}/text.json|--out|{}/score.json");
    let said = String::from_utf8_lossy(&o.stderr);
    assert!(said.contains("no text feature of the category \"green ball\""), "{said}");
    assert!(said.contains("frame_09999 is no view"), "{said}");
    let s = f.json("score.json");
    assert_eq!(s["query_pairs"], 4);
    assert_eq!(s["query_macc25"], 0.25, "one of four is found");
}

#[test]
fn all_noise_scores_zero() {
    let f = Fixture::new(2);
    f.write_instances(2, |_| -1);
    f.good("score", "--text-features|{}/text.json|--out|{}/score.json");
    let s = f.json("score.json");
    assert_eq!((s["instance_miou"].as_f64(), s["query_miou"].as_f64()), (Some(0.0), Some(0.0)));
}

#[test]
fn what_has_no_truth_is_skipped_with_a_reason() {
    let f = Fixture::new(0);
    fs::remove_dir_all(f.scene().join("truth")).unwrap();
    let printed = f.good("score", "--text-features|{}/text.json|--out|{}/score.json");
    assert!(printed.contains("no language features") && printed.contains("truth/points.safetensors"), "{printed}");
    let s = f.json("score.json");
    assert!(s["instance_miou"].is_null() && s["query_miou"].is_null());
    assert_eq!(s["skipped"].as_array().unwrap().len(), 2);
    fs::remove_dir_all(f.scene().join("label")).unwrap();
    assert!(f.good("score", "--out|{}/score.json").contains("the scene has no"));
    assert!(f.bad("score", "--labels|{}/none|--out|{}/score.json").contains("--labels: no such folder"));
}

#[test]
fn a_full_report_stands_alone() {
    let f = Fixture::new(2);
    let at = "--text-features|{}/text.json|--text|red ball|--out|{}/run/query";
    f.good("query", at);
    f.good("score", "--text-features|{}/text.json|--out|{}/run/score.json");
    fs::write(f.run().join("geom_metrics.json"), r#"{"psnr_heldout": 31.5, "ssim_heldout": 0.95}"#).unwrap();
    fs::write(
        f.run().join("geometry.ply.curve.jsonl"),
        "{\"iteration\":1,\"loss\":0.5}\n{\"iteration\":2,\"loss\":0.4}\n",
    )
    .unwrap();
    let printed = f.good("report", "--run-dir|{}/run|--scene|{}/balls|--out|{}/run/report.html");
    assert!(printed.contains("psnr_heldout   31.50"), "{printed}");
    let html = fs::read_to_string(f.run().join("report.html")).unwrap();
    for id in [
        "photographs",
        "id-maps",
        "features",
        "instances",
        "queries",
        "instance-scores",
        "query-scores",
        "training",
        "stages",
    ] {
        assert!(html.contains(&format!("<h2 id=\"{id}\"")), "{id}");
    }
    for outside in ["http:", "https:", "<script", "<link", "url(", "src=\"/"] {
        assert!(!html.contains(outside), "{outside}");
    }
    assert!(html.contains("eval score") && html.contains("<polyline"));
    let m = f.json("run/metrics.json");
    assert_eq!(
        (m["psnr_heldout"].as_f64(), m["gaussians"].as_u64(), m["instances"].as_u64()),
        (Some(31.5), Some(83), Some(3))
    );
    assert_eq!((m["query_count"].as_u64(), m["queries"][1]["text"].as_str()), (Some(2), Some("red ball")));
    assert!(m["seconds"]["eval score"].as_f64().unwrap() > 0.0);
    assert_eq!(m["skipped"], serde_json::json!([]));
}

#[test]
fn a_report_of_geometry_alone_says_what_is_left_out() {
    let f = Fixture::new(0);
    for name in ["instances.safetensors", "features.safetensors"] {
        fs::remove_file(f.run().join(name)).unwrap();
    }
    fs::remove_dir_all(f.scene().join("language_features")).unwrap();
    f.good("report", "--run-dir|{}/run|--scene|{}/balls|--title|Two <balls>|--out|{}/report.html");
    let html = fs::read_to_string(f.path().join("report.html")).unwrap();
    assert!(html.contains("<title>Two &lt;balls&gt;</title>") && html.contains("held out"));
    let m = f.json("metrics.json");
    let skipped = m["skipped"].to_string();
    for part in ["instances", "features", "id maps", "scores", "text queries", "PSNR"] {
        assert!(skipped.contains(part), "{part}: {skipped}");
    }
    assert!(m["instance_miou"].is_null());
    let e = f.bad("report", "--run-dir|{}/none|--scene|{}/balls|--out|{}/r.html");
    assert!(e.contains("geometry.ply"), "{e}");
    let e = f.bad("report", "--run-dir|{}/run|--scene|{}/none|--out|{}/r.html");
    assert!(e.contains("none"), "{e}");
}

#[test]
fn threads_do_not_change_a_byte() {
    let f = Fixture::new(2);
    for n in ["1", "2"] {
        f.good("query", &format!("--text-features|{{}}/text.json|--text|red ball|--threads|{n}|--out|{{}}/q{n}"));
        f.good("score", &format!("--text-features|{{}}/text.json|--threads|{n}|--out|{{}}/q{n}/score.json"));
        f.good("report", &format!("--run-dir|{{}}/run|--scene|{{}}/balls|--threads|{n}|--out|{{}}/q{n}/report.html"));
    }
    let mut compared = 0;
    for entry in fs::read_dir(f.path().join("q1")).unwrap().flatten() {
        let name = entry.file_name().into_string().unwrap();
        if !name.ends_with(".run.json") {
            let other = fs::read(f.path().join("q2").join(&name)).unwrap();
            assert!(fs::read(entry.path()).unwrap() == other, "{name}");
            compared += 1;
        }
    }
    assert!(compared >= 10, "{compared}");
}

#[test]
fn an_unwritable_output_is_named() {
    let f = Fixture::new(2);
    fs::write(f.path().join("file"), "x").unwrap();
    for (command, rest) in [
        ("query", "--text-features|{}/text.json|--text|red ball|--out|{}/file/out"),
        ("score", "--out|{}/file/score.json"),
        ("report", "--run-dir|{}/run|--scene|{}/balls|--out|{}/file/r.html"),
    ] {
        let e = f.bad(command, rest);
        assert!(e.contains("cannot create the folder") && e.contains("/file"), "{e}");
    }
}
