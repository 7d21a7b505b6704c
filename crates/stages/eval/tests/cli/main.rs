//! `eval` as people run it.

mod fixture;
mod protocols;

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
    let selected = gs_scene::ply::read_gaussians(f.path().join("out/01-red-ball.ply")).unwrap();
    assert_eq!(selected, all.select(&[0]));
    let mask = image::open(f.path().join("out/01-red-ball.frame_00002.mask.png")).unwrap().to_luma8();
    assert_eq!(mask.dimensions(), (fixture::WIDTH, fixture::HEIGHT));
    let inside = mask.pixels().filter(|p| p.0 == [255]).count() as u64;
    assert_eq!(red["views"][0]["pixels"].as_u64(), Some(inside));
    let (x, y, _) = fixture::cameras()[2].project(glam::DVec3::from_array(fixture::CENTRES[0]));
    assert_eq!(mask[(x as u32, y as u32)].0, [255]);
    assert!(f.path().join("out/02-blue-ball.frame_00004.overlay.png").exists());
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
    let clip = concat!(env!("CARGO_MANIFEST_DIR"), "/../../lib/onnx-models/testdata/clip");
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
    assert!(e.contains("'--alpha <VALUE>': expected 0 to 1"), "{e}");
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
        ("score", "--out|{}/out.json"),
        ("report", "--run-dir|{}/run|--scene|{}/balls|--out|{}/out.html"),
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
    assert!(e.contains("instances.safetensors: inputs.dataset: made from another dataset"), "{e}");
    fs::remove_file(f.geometry()).unwrap();
    assert!(f.bad("score", "--out|{}/out").contains("geometry.ply: cannot open"));
    fs::write(f.instances(), b"short").unwrap();
    assert!(f.bad("score", "--out|{}/out").contains("instances.safetensors: not a safetensors artifact"));
    assert!(!f.path().join("out").exists());
}

#[test]
fn a_perfect_run_scores_high() {
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
    let floor = &s["things"][2];
    assert_eq!((&floor["name"], &floor["background"], &floor["iou"]), (&"floor".into(), &true.into(), &1.0.into()));
    // The best instance for a label is the one that its text selects.
    assert_eq!(
        (s["label_miou"].as_f64(), s["labels"].as_array().unwrap().len()),
        (s["query_miou_visible"].as_f64(), 4)
    );
    assert_eq!(
        (s["labels"][0]["category"].as_str(), s["labels"][0]["instance"].as_i64()),
        (Some("blue ball"), Some(1))
    );
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
fn id_maps_are_measured() {
    let f = Fixture::new(0);
    let masks = f.scene().join("language_features");
    let eval = |masks: &std::path::Path, out: &str| {
        let mut c = std::process::Command::new(env!("CARGO_BIN_EXE_eval"));
        c.args(["masks", "--masks"]).arg(masks).arg("--out").arg(f.path().join(out)).output().unwrap()
    };
    let o = eval(&masks, "stats.json");
    let printed = String::from_utf8_lossy(&o.stdout).into_owned();
    assert!(o.status.success() && printed.contains("| large |"), "{printed}{}", String::from_utf8_lossy(&o.stderr));
    let stats = f.json("stats.json");
    assert_eq!(stats["views"], fixture::VIEWS);
    assert!(stats["levels"][3]["masks"][0].as_f64().unwrap() >= 1.0 && stats["levels"][3]["split"].is_null());
    let o = eval(&f.scene().join("label"), "none.json");
    let said = String::from_utf8_lossy(&o.stderr);
    assert!(o.status.code() == Some(2) && said.contains("no id maps") && said.lines().count() == 1, "{said}");
}

#[test]
fn what_has_no_truth_is_skipped_with_a_reason() {
    let f = Fixture::new(0);
    fs::remove_dir_all(f.scene().join("truth")).unwrap();
    let printed = f.good("score", "--text-features|{}/text.json|--out|{}/score.json");
    assert!(f.json("score.json")["label_miou"].as_f64().unwrap() > 0.5, "labels need no language");
    assert!(printed.contains("no language features") && printed.contains("truth/points.safetensors"), "{printed}");
    let s = f.json("score.json");
    assert!(s["instance_miou"].is_null() && s["query_miou"].is_null());
    assert_eq!(s["skipped"].as_array().unwrap().len(), 2);
    fs::remove_dir_all(f.scene().join("label")).unwrap();
    assert!(f.good("score", "--out|{}/score.json").contains("the scene has no"));
    assert!(f.bad("score", "--labels|{}/none|--out|{}/score.json").contains("--labels: no such folder"));
}

#[test]
fn more_memory_than_there_may_be_is_refused_at_the_start() {
    let f = Fixture::new(2);
    for (command, rest) in [
        ("score", "--text-features|{}/text.json|--out|{}/score.json"),
        ("query", "--text-features|{}/text.json|--text|red ball|--out|{}/out"),
    ] {
        let e = f.bad(command, &format!("{rest}|--memory-limit|2M"));
        assert!(e.contains("--memory-limit: the run needs more memory than it may take"), "{e}");
    }
    assert!(!f.path().join("out").exists() && !f.path().join("score.json").exists());
    // What is forecast is near what is taken, also where the program itself takes most.
    f.good("score", "--text-features|{}/text.json|--out|{}/score.json");
    let record = f.json("score.json.run.json");
    let of = |key: &str| record[key].as_f64();
    if let (Some(forecast), Some(peak)) = (of("memory_predicted_bytes"), of("peak_rss_bytes")) {
        // How much of the program itself lies in memory differs from system to system: 20 MB.
        assert!((forecast - peak).abs() < 0.5 * peak + 20e6, "forecast {forecast}, peak {peak}");
    }
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
    assert!(printed.contains("psnr_heldout     31.50 dB"), "{printed}");
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
    f.good("report", "--run-dir|{}/run|--scene|{}/balls|--out|{}/report.html");
    let html = fs::read_to_string(f.path().join("report.html")).unwrap();
    assert!(html.contains("<title>run</title>") && html.contains("held out"));
    let m = f.json("metrics.json");
    let skipped = m["skipped"].to_string();
    for part in ["instances", "features", "id maps", "scores", "text queries", "PSNR"] {
        assert!(skipped.contains(part), "{part}: {skipped}");
    }
    assert!(m["instance_miou"].is_null());
    // Gaussians that somebody else trained do not lie in the run.
    fs::rename(f.run().join("geometry.ply"), f.path().join("mine.ply")).unwrap();
    f.good("report", "--run-dir|{}/run|--geometry|{}/mine.ply|--scene|{}/balls|--out|{}/report.html");
    let e = f.bad("report", "--run-dir|{}/none|--scene|{}/balls|--out|{}/r/r.html");
    assert!(e.contains("geometry.ply"), "{e}");
    let e = f.bad("report", "--run-dir|{}/run|--scene|{}/none|--out|{}/r/r.html");
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
    assert!(compared >= 8, "{compared}");
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

#[test]
fn places_say_what_is_there() {
    let f = Fixture::new(2);
    let (x, y, _) = fixture::cameras()[2].project(glam::DVec3::from_array(fixture::CENTRES[1]));
    let pixel = format!("frame_00002:{},{}", x as u32, y as u32);
    let printed =
        f.good("query", &format!("{TABLE}|--pixel|{pixel}|--point|-0.6,0.1,0.5|--pixel|frame_00002.png:48,1"));
    assert!(printed.contains("blue ball") && printed.contains("nothing is there"), "{printed}");
    let q = f.json("out/query.json");
    let blue = &q["queries"][0];
    assert_eq!((&blue["kind"], &blue["selected"]), (&serde_json::json!("pixel"), &serde_json::json!([1])));
    assert_eq!(blue["place"]["names"][0][0], "blue ball");
    assert!(blue["score"].as_f64().unwrap() > 0.9 && blue["place"]["alpha_or_distance"].as_f64().unwrap() > 0.9);
    let shown = blue["views"].as_array().unwrap();
    assert!(shown.iter().any(|v| v["view"] == "frame_00002"), "the view that was asked about is shown");
    let sky = &q["queries"][1];
    assert!(sky["selected"].as_array().unwrap().is_empty() && sky["ply"].is_null(), "{sky}");
    let red = &q["queries"][2];
    assert_eq!((&red["kind"], &red["selected"]), (&serde_json::json!("point"), &serde_json::json!([0])));
    assert!((red["place"]["alpha_or_distance"].as_f64().unwrap() - 0.1).abs() < 1e-6);
    // Without language nothing has a name, but it is still there.
    let f = Fixture::new(0);
    f.good("query", &format!("--out|{{}}/out|--pixel|{pixel}"));
    assert_eq!(f.json("out/query.json")["queries"][0]["selected"], serde_json::json!([1]));
    let e = f.bad("query", "--out|{}/out|--pixel|frame_00002:96,1");
    assert!(e.contains("--pixel: the pixel lies outside the view; found 96,1"), "{e}");
    assert!(f.bad("query", "--out|{}/out|--pixel|frame_00002").contains("--pixel: not understood"));
    assert!(f.bad("query", "--out|{}/out|--point|1,2,inf").contains("--point: not a point"));
    assert!(f.bad("query", "--out|{}/out").contains("required arguments were not provided"));
}

#[test]
fn points_outside_the_scene_are_refused() {
    let f = Fixture::new(2);
    for (point, found) in [("1e30,0,0", "[1e30, 0.0, 0.0], 1.0000e30 from"), ("0,-60,0", "[0.0, -60.0, 0.0], ")] {
        let e = f.bad("query", &format!("{TABLE}|--point|0,0,0.5|--point|{point}"));
        assert!(e.contains("--point: the point lies outside the scene; found ") && e.contains(found), "{e}");
        assert!(!f.path().join("out").exists());
    }
    assert!(f.bad("query", &format!("{TABLE}|--point|1e300,0,0")).contains("--point: not a point"));
    // Somewhat beside the scene there is still something nearest.
    f.good("query", &format!("{TABLE}|--point|0,-6,0"));
}

#[test]
fn empty_texts_are_refused() {
    let f = Fixture::new(2);
    for (command, arguments, option) in [
        ("query", format!("{TABLE}|--text|red ball|--text="), "--text"),
        ("query", format!("{TABLE}|--text|red ball|--negatives=thing,"), "--negatives"),
        ("lerf", "--out|{}/out|--name=".into(), "--name"),
    ] {
        let e = f.bad(command, &arguments);
        assert!(e.contains(&format!("'{option} <")) && e.contains("': an empty text; expected words"), "{e}");
    }
    let e = f.bad("query", &format!("{TABLE}|--text|red ball|--negatives=thing, ,stuff"));
    assert!(e.contains("invalid value ' ' for '--negatives <TEXTS>': an empty text"), "{e}");
    assert!(f.bad("query", &format!("{TABLE}|--text|red ball|--template=")).contains("no place for the text"));
    assert!(!f.path().join("out").exists());
}

#[test]
fn a_report_shows_no_picture_from_outside_the_run() {
    let f = Fixture::new(2);
    f.good("query", &format!("{TABLE}|--text|red ball|--views|frame_00002"));
    fs::rename(f.path().join("out"), f.run().join("query")).unwrap();
    let file = f.run().join("query/query.json");
    let written = fs::read_to_string(&file).unwrap();
    let picture = f.scene().join("images/frame_00001.png");
    let name = "01-red-ball.frame_00002.overlay.png";
    assert!(written.contains(name));
    for outside in ["../../balls/images/frame_00001.png", picture.to_str().unwrap(), "./../../x.png", ""] {
        fs::write(&file, written.replace(name, outside)).unwrap();
        let e = f.bad("report", "--run-dir|{}/run|--scene|{}/balls|--out|{}/report.html");
        assert!(e.contains(&format!("query.json: overlay: a picture outside the run; found {outside}")), "{e}");
        assert!(!f.path().join("report.html").exists());
    }
    fs::write(&file, written).unwrap();
    f.good("report", "--run-dir|{}/run|--scene|{}/balls|--out|{}/report.html");
}

#[test]
fn several_texts_divide_the_cloud() {
    let f = Fixture::new(2);
    let at = "--text|blue ball|--text|red ball|--segment|--views|frame_00002";
    let printed = f.good("query", &format!("{TABLE}|{at}|--threshold|0"));
    assert!(printed.contains("segmentation (81 Gaussians without a text)"), "{printed}");
    let labels = gs_io::npy::read_f32(f.path().join("out/labels.npy")).unwrap();
    assert_eq!((labels.shape, &labels.data[..4]), (vec![83], &[1.0, 0.0, -1.0, -1.0][..]));
    let s = &f.json("out/query.json")["segmentation"];
    assert_eq!((&s["segments"][0]["text"], &s["segments"][0]["gaussians"]), (&"blue ball".into(), &1.into()));
    let g = gs_scene::ply::read_gaussians(f.path().join("out/segmentation.ply")).unwrap();
    assert_eq!(g.len(), 83);
    assert!(g.base_color(0) != g.base_color(1) && g.base_color(2) == g.base_color(3));
    assert!(f.path().join("out/segmentation.frame_00002.png").exists());
    let e = f.bad("query", &format!("{TABLE}|--text|red ball|--segment"));
    assert!(e.contains("--segment: nothing to choose between"), "{e}");
}

#[test]
fn a_picture_is_a_query() {
    let f = Fixture::new(2);
    let clip = concat!(env!("CARGO_MANIFEST_DIR"), "/../../lib/onnx-models/testdata/clip");
    let picture = f.scene().join("images/frame_00002.png");
    let encoder = onnx_models::ClipImage::open(clip, &onnx_models::EngineOptions::default()).unwrap();
    let image = gs_scene::Image::read(&picture).unwrap();
    let (width, height) = (image.width as usize, image.height as usize);
    let whole = onnx_models::RgbImage { width, height, pixels: image.to_rgb8() };
    let map = onnx_models::LabelMap { width, height, ids: &vec![0; width * height] };
    let bounds = onnx_models::Bounds { x0: 0, y0: 0, x1: width, y1: height };
    let feature = encoder.encode(&onnx_models::crop_mask(&whole, &map, 0, bounds, encoder.size())).unwrap();
    let opposite: Vec<f32> = feature.iter().map(|v| -v).collect();
    f.write_described(&[opposite, feature, vec![0.0; 4]], |g| g as i32);
    let ask =
        |rest: &str| format!("--clip|{clip}|--image|{}|{rest}|--views|frame_00002|--out|{{}}/out", picture.display());
    f.good("query", &ask(""));
    let q = &f.json("out/query.json")["queries"][0];
    assert_eq!(
        (&q["kind"], &q["text"], &q["selected"]),
        (&"image".into(), &"frame_00002".into(), &serde_json::json!([1]))
    );
    assert!((q["score"].as_f64().unwrap() - 1.0).abs() < 1e-6);
    let e = f.bad("query", &format!("{TABLE}|--image|{}", picture.display()));
    assert!(e.contains("pictures need an image encoder"), "{e}");
    f.write_instances(2, |g| g as i32);
    assert!(f.bad("query", &ask("")).contains("found dimension 2, expected 4"));
}

#[test]
fn negatives_templates_and_joining_change_the_answer() {
    let f = Fixture::new(2);
    let first = |rest: &str| {
        f.good("query", &format!("{TABLE}|--views|frame_00002|{rest}"));
        f.json("out/query.json")["queries"][0].clone()
    };
    let q = first("--text|red ball|--negatives|blue ball,thing");
    // cos(red, thing) = 0.707: 1 / (1 + exp(10 (0.7071 - 1))).
    assert!((q["score"].as_f64().unwrap() - 1.0 / (1.0 + (-2.928_932_f64).exp())).abs() < 1e-5, "{q}");
    fs::write(f.table(), r#"{"ball": [0, 1], "a ball": [1, 0], "the ball": [1, 0.2]}"#).unwrap();
    assert_eq!(first("--text|ball")["selected"], serde_json::json!([1]));
    assert_eq!(first("--text|ball|--template|a <>|--template|the <>")["selected"], serde_json::json!([0]));
    // Features (0 0 1), (1 1 1), (2 4 1): angles between red and blue 54.7 degrees, so unit distance 0.919.
    let join = |d: &str| first(&format!("--text|ball|--join|{d}|--features|{{}}/run/features.safetensors"));
    assert_eq!(join("0.9")["selected"].as_array().unwrap()[0], 1);
    assert!(!join("0.9")["selected"].to_string().contains('0'), "{}", join("0.9")["selected"]);
    assert!(join("0.93")["selected"].to_string().contains('0'));
    let bad = |rest: &str| f.bad("query", &format!("{TABLE}|--text|ball|{rest}"));
    assert!(bad("--negatives|stuff").contains("no such text in the table"));
    assert!(bad("--template|a photo").contains("no place for the text; expected {} in it"));
    assert!(
        bad("--join|0|--features|{}/run/features.safetensors").contains("'--join <DISTANCE>': expected more than 0")
    );
    assert!(bad("--join|1|--features|{}/run/none").contains("none"));
}

#[test]
fn an_interactive_query_reads_texts_from_a_pipe() {
    use std::io::Write;
    let f = Fixture::new(2);
    let ask = |rest: &[&str], input: &str| {
        let mut c = std::process::Command::new(env!("CARGO_BIN_EXE_eval"));
        c.arg("query").arg("--instances").arg(f.instances()).arg("--geometry").arg(f.geometry());
        c.arg("--scene").arg(f.scene()).arg("--text-features").arg(f.table()).arg("--interactive").args(rest);
        c.stdin(std::process::Stdio::piped()).stdout(std::process::Stdio::piped()).stderr(std::process::Stdio::piped());
        let mut child = c.spawn().unwrap();
        child.stdin.take().unwrap().write_all(input.as_bytes()).unwrap();
        child.wait_with_output().unwrap()
    };
    let o = ask(&[], "red ball\n\nreed ball\nblue ball\n:quit\nthing\n");
    assert!(o.status.success());
    let (said, printed) = (String::from_utf8_lossy(&o.stderr), String::from_utf8_lossy(&o.stdout));
    assert!(said.contains("no such text in the table") && said.contains("\"reed ball\""), "{said}");
    assert!(printed.contains("\"red ball\" (1 Gaussians") && printed.contains("\"blue ball\""), "{printed}");
    assert!(!printed.contains("\"thing\"") && printed.contains("ms query"), "nothing after :quit: {printed}");
    let out = f.path().join("live");
    let o = ask(&["--json", "--out", out.to_str().unwrap(), "--views", "frame_00002"], "red ball\nblue ball");
    let lines: Vec<serde_json::Value> = String::from_utf8_lossy(&o.stdout)
        .lines()
        .filter_map(|l| serde_json::from_str(l).ok())
        .filter(|v: &serde_json::Value| v["ranking"].is_array())
        .collect();
    assert_eq!(lines.len(), 2);
    assert_eq!(lines[1]["selected"], serde_json::json!([1]));
    assert!(out.join("01-red-ball/01-red-ball.ply").exists() && out.join("02-blue-ball/query.json").exists());
}

#[test]
fn a_limit_that_nothing_is_held_against_is_refused() {
    let f = Fixture::new(2);
    let limited = |arguments: &[&str]| {
        let mut c = std::process::Command::new(env!("CARGO_BIN_EXE_eval"));
        let o =
            c.current_dir(f.path()).args(arguments).args(["--memory-limit", "1M", "--out", "out"]).output().unwrap();
        let said = String::from_utf8_lossy(&o.stderr).into_owned();
        assert!(o.status.code() == Some(2) && !f.path().join("out").exists(), "{arguments:?}: {said}");
        said
    };
    let labels = f.scene().join("label").to_string_lossy().into_owned();
    let said = limited(&["lerf", "--predictions", "none", "--labels", &labels]);
    assert!(said.contains("--memory-limit: the run needs more memory than it may take"), "{said}");
    for arguments in [&["table", "none"][..], &["masks", "--masks", "none"]] {
        assert!(limited(arguments).contains("--memory-limit: this command does not forecast its memory; leave it out"));
    }
}

#[test]
#[cfg(target_os = "linux")]
fn a_full_standard_output_is_an_error() {
    let f = Fixture::new(2);
    let query = |rest: &[&str]| {
        let mut c = std::process::Command::new(env!("CARGO_BIN_EXE_eval"));
        c.arg("query").arg("--instances").arg(f.instances()).arg("--geometry").arg(f.geometry());
        c.arg("--scene").arg(f.scene()).arg("--text-features").arg(f.table()).args(rest);
        let texts = f.path().join("texts");
        fs::write(&texts, "red ball\n").unwrap();
        c.stdin(fs::File::open(&texts).unwrap());
        let o = c.stdout(fs::File::options().write(true).open("/dev/full").unwrap()).output().unwrap();
        let said = String::from_utf8_lossy(&o.stderr).into_owned();
        assert!(o.status.code() == Some(2) && said.contains("standard output: cannot write: No space left"), "{said}");
    };
    query(&["--interactive"]);
    query(&["--interactive", "--json"]);
    query(&["--text", "red ball", "--out", &f.path().join("full").to_string_lossy()]);
}

#[test]
fn odd_instances_are_answered_with_a_line() {
    let f = Fixture::new(2);
    let warned = |command: &str, rest: &str| f.warned(command, rest);
    let query = format!("{TABLE}|--text|red ball|--views|frame_00002");
    let lerf = "--text-features|{}/text.json|--out|{}/lerf";
    // The instance of the best descriptor holds no Gaussian.
    f.write_instances(2, |g| if g == 0 { 1 } else { g as i32 });
    assert!(warned("query", &query).contains("hold no Gaussian: nothing to show"));
    assert!(warned("lerf", lerf).contains("score 0 because no Gaussian is selected"));
    // All noise.
    f.write_instances(2, |_| -1);
    assert!(warned("query", &query).contains("all Gaussians are noise"));
    assert!(warned("lerf", lerf).contains("all Gaussians are noise"));
    assert_eq!(f.json("lerf/metrics.json")["figures"]["miou"], 0.0);
    let said = warned("score", "--text-features|{}/text.json|--out|{}/score.json");
    assert!(said.contains("all Gaussians are noise: every score is 0"), "{said}");
    assert!(said.contains("nothing is selected for \"red ball\": it counts as IoU 0"), "{said}");
    assert_eq!(
        (&f.json("score.json")["instance_miou"], &f.json("score.json")["query_miou"]),
        (&0.0.into(), &0.0.into())
    );
    // One instance: it answers everything.
    f.write_instances(2, |_| 0);
    warned("query", &query);
    assert_eq!(f.json("out/query.json")["queries"][0]["gaussians"], 83);
    // Nothing reaches the threshold.
    assert!(
        warned("query", &format!("{TABLE}|--text|thing|--views|frame_00002|--threshold|0.9"))
            .contains("nothing is selected")
    );
    // A view that no label names, an unknown category, labels of another shape.
    f.write_instances(2, |g| g as i32);
    f.write_label(4, &[("red ball", 0), ("green ball", 1)], (fixture::WIDTH, fixture::HEIGHT));
    fs::rename(f.scene().join("label/frame_00001.json"), f.scene().join("label/frame_09999.json")).unwrap();
    let said = warned("lerf", lerf);
    assert!(said.contains("it has no text feature: green ball in frame_00004"), "{said}");
    assert!(said.contains("2 of 4 pairs score 0 because the frame is no view of the scene"), "{said}");
    let table = fs::read_to_string(f.path().join("lerf/table.md")).unwrap();
    assert!(table.contains("green ball in frame_00004") && table.contains("selected rendering above 0.7"), "{table}");
    f.write_label(4, &[("red ball", 0)], (100, 100));
    assert!(f.bad("lerf", lerf).contains("another shape than the photograph; found 100x100"));
    fs::remove_dir_all(f.scene().join("label")).unwrap();
    assert!(f.bad("lerf", lerf).contains("the scene has no labels"));
    f.write_instances(0, |g| g as i32);
    fs::create_dir(f.scene().join("label")).unwrap();
    assert!(f.bad("lerf", lerf).contains("no language features"));
}

#[test]
fn views_without_masks_leave_instances_without_words() {
    let f = Fixture::new(2);
    let warned = |command: &str, rest: &str| f.warned(command, rest);
    let query = format!("{TABLE}|--text|red ball|--views|frame_00002");
    let (score, lerf) =
        ("--text-features|{}/text.json|--out|{}/score.json", "--text-features|{}/text.json|--out|{}/lerf");
    let report = "--run-dir|{}/run|--scene|{}/balls|--out|{}/report.html|--views|frame_00000,frame_00001,frame_00002";
    // One view has an id map without a mask, another none: the rest speaks for the instances.
    let masks = f.scene().join("language_features");
    let n = (fixture::WIDTH * fixture::HEIGHT) as usize;
    let empty =
        artifacts::MaskMaps { width: fixture::WIDTH as usize, height: fixture::HEIGHT as usize, ids: vec![-1; 4 * n] };
    empty.write(artifacts::maps_path(&masks, &stem(0))).unwrap();
    fs::remove_file(artifacts::maps_path(&masks, &stem(1))).unwrap();
    f.change_instances(|i| i.matches.retain(|m| m.view > 1));
    warned("query", &query);
    assert_eq!(f.json("out/query.json")["queries"][0]["selected"], serde_json::json!([0]));
    warned("score", score);
    assert_eq!(f.json("score.json")["query_macc25"], 1.0);
    warned("lerf", lerf);
    assert_eq!(f.json("lerf/metrics.json")["figures"]["macc25"], 1.0);
    warned("report", report);
    let html = fs::read_to_string(f.path().join("report.html")).unwrap();
    assert!(html.contains("frame_00000: 0 masks") && html.contains("frame_00002: 2 masks"));
    assert!(!html.contains("frame_00001: 0 masks"), "a view without an id map is not shown as one without masks");
    // No view has masks: nothing was matched, so no instance has a descriptor. Zeros, each with a line.
    for i in 0..fixture::VIEWS {
        empty.write(artifacts::maps_path(&masks, &stem(i))).unwrap();
    }
    f.change_instances(|i| {
        i.matches.clear();
        i.support.fill(0);
        i.descriptor.fill(0.0);
    });
    assert!(warned("query", &query).contains("no instance passes for \"red ball\""));
    assert!(f.good("query", &query).contains("no instance has a descriptor"));
    let said = warned("score", score);
    assert!(said.contains("nothing is selected for \"blue ball\": it counts as IoU 0"), "{said}");
    assert_eq!(
        (&f.json("score.json")["query_miou"], &f.json("score.json")["instance_miou"]),
        (&0.0.into(), &1.0.into())
    );
    let said = warned("lerf", lerf);
    assert!(said.contains("4 of 4 pairs score 0 because no Gaussian is selected"), "{said}");
    warned("report", report);
}

#[test]
fn damaged_gaussians_are_left_out_and_said_to_be() {
    let f = Fixture::new(2);
    let selected = |extra: &str| {
        f.good("query", &format!("{TABLE}|--text|red ball|--text|blue ball|--segment|--views|frame_00002{extra}"));
        fs::read(f.path().join("out/01-red-ball.frame_00002.mask.png")).unwrap()
    };
    let before = selected("");
    let mut g = gs_scene::ply::read_gaussians(f.geometry()).unwrap();
    (g.means[50][0], g.log_scales[60][1]) = (f32::NAN, f32::INFINITY);
    gs_scene::ply::write_gaussians(f.geometry(), &g, &[]).unwrap();
    // cluster-match gives them no instance.
    f.change_instances(|i| (i.label[50], i.label[60]) = (-1, -1));
    assert!(before == selected(""), "the ball looks as before");
    assert_eq!(gs_scene::ply::read_gaussians(f.path().join("out/segmentation.ply")).unwrap().len(), 83);
    for (command, rest) in [
        ("query", "--text-features|{}/text.json|--text|red ball|--out|{}/out"),
        ("score", "--text-features|{}/text.json|--out|{}/score.json"),
        ("lerf", "--text-features|{}/text.json|--out|{}/lerf"),
    ] {
        let said = f.warned(command, rest);
        assert!(said.contains("skipped 2 of 83 Gaussians: damaged") && said.contains("vertex 50"), "{command}: {said}");
    }
    assert_eq!(f.json("score.json")["instance_miou"], 1.0);
    fs::remove_file(f.run().join("features.safetensors")).unwrap();
    let printed = f.good("report", "--run-dir|{}/run|--scene|{}/balls|--out|{}/report.html");
    assert!(printed.contains("2 of 83 Gaussians: damaged"), "{printed}");
}

#[test]
fn a_geometry_learnt_with_the_filter_is_shown_with_it() {
    let f = Fixture::new(2);
    let mut g = gs_scene::ply::read_gaussians(f.geometry()).unwrap();
    g.log_scales[0] = [-4.2; 3]; // about a pixel
    let camera = &fixture::cameras()[2];
    let mut pixels = Vec::new();
    for antialias in [false, true] {
        let geometry = gs_scene::Geometry { gaussians: g.clone(), antialias, ..Default::default() };
        gs_scene::ply::write_gaussians(f.geometry(), &g, &geometry.comments(Vec::new())).unwrap();
        f.change_instances(|_| {});
        f.good("query", &format!("{TABLE}|--text|red ball|--views|frame_00002|--silhouette|selected|--alpha|0.4"));
        let options = gs_raster::RasterOptions { antialias, ..Default::default() };
        let alpha = gs_raster::render(&g.select(&[0]), camera, &options).alpha;
        let expected = alpha.iter().filter(|&&a| a > 0.4).count();
        assert_eq!(f.json("out/query.json")["queries"][0]["views"][0]["pixels"], expected);
        assert_eq!(gs_scene::ply::is_antialiased(f.path().join("out/01-red-ball.ply")).unwrap(), antialias);
        pixels.push(expected);
    }
    assert!(pixels[1] < pixels[0], "{pixels:?}");
}

#[test]
fn an_answer_may_be_coarser_or_finer() {
    let f = Fixture::new(2);
    let edge = |parent, child, instance| artifacts::TreeEdge { parent, child, lambda: 1.0, size: 2, instance };
    f.change_instances(|i| {
        // Both balls are parts of 84; the floor (85) falls into two halves.
        i.tree = vec![
            edge(83, 84, -1),
            edge(83, 85, 2),
            edge(84, 86, 0),
            edge(84, 87, 1),
            edge(85, 88, -1),
            edge(85, 89, -1),
        ];
        i.node = (0..83).map(|g| if g < 2 { 86 + g } else { 88 + g % 2 }).collect();
    });
    let ask = |text: &str, granularity: &str| {
        let asked = format!("{TABLE}|--text|{text}|--views|frame_00002|--granularity|{granularity}");
        let said = f.warned("query", &asked);
        (f.json("out/query.json")["queries"].clone(), said)
    };
    let (q, _) = ask("blue ball", "parent");
    assert_eq!((&q[0]["selected"], &q[0]["gaussians"]), (&serde_json::json!([1, 0]), &2.into()));
    assert_eq!(gs_scene::ply::read_gaussians(f.path().join("out/01-blue-ball.ply")).unwrap().len(), 2);
    fs::write(f.table(), r#"{"floor": [-0.6, -0.8], "blue ball": [0, 1]}"#).unwrap();
    let (q, _) = ask("floor", "parts");
    let sizes: Vec<u64> = q.as_array().unwrap().iter().map(|q| q["gaussians"].as_u64().unwrap()).collect();
    assert_eq!((sizes, &q[2]["kind"], &q[2]["text"]), (vec![81, 41, 40], &"part".into(), &"floor, part 2 of 2".into()));
    assert_eq!(gs_scene::ply::read_gaussians(f.path().join("out/03-floor-part-2-of-2.ply")).unwrap().len(), 40);
    assert!(f.path().join("out/02-floor-part-1-of-2.frame_00002.mask.png").exists());
    let (q, said) = ask("floor", "parent");
    assert!(q[0]["gaussians"] == 81 && said.contains("no parent but the whole scene"), "{said}");
    let (q, said) = ask("blue ball", "parts");
    assert!(q.as_array().unwrap().len() == 1 && said.contains("instance 1 has no parts"), "{said}");
}
