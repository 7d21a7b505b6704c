//! `eval` as people run it.

mod fixture;
mod names;
mod protocols;

use artifacts::{Descriptors, Instances, flat};
use fixture::{Fixture, HEIGHT, SCORE, TABLE, VIEWS, WIDTH, failed, stem};
use gs_io::Provenance;
use gs_scene::Learnt;
use gs_scene::dataset::{self, LoadOptions};
use ndarray::{Array2, Array3, arr3};
use serde_json::{Value, json};
use std::fs;
use std::process::Stdio;

const REPORT: &str = "--run-dir|{}/run|--scene|{}/balls|--out|{}/report.html";
const LERF: &str = "--text-features|{}/text.json|--out|{}/lerf";
const CLIP: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../../lib/onnx-models/testdata/clip");

#[test]
fn a_query_writes_the_selection_in_every_form() {
    let f = Fixture::new(2);
    let printed =
        f.good("query", &format!("{TABLE}|--text|red ball|--text|blue ball|--views|frame_00002,frame_00004.png"));
    assert!(printed.contains("\"red ball\" (1 Gaussians selected)"), "{printed}");
    let q = f.json("out/query.json");
    assert_eq!((&q["instances"], &q["dimension"]), (&json!(3), &json!(2)));
    let red = &q["queries"][0];
    assert_eq!((&red["selected"], &red["ranking"][2]["instance"]), (&json!([0]), &json!(2)));
    assert!((red["score"].as_f64().unwrap() - 1.0).abs() < 1e-6);
    assert_eq!(red["views"][0]["view"], "frame_00002");
    let all = gs_scene::ply::read_gaussians(f.geometry()).unwrap();
    let selected = gs_scene::ply::read_gaussians(f.path().join("out/01-red-ball.ply")).unwrap();
    assert_eq!(selected, all.select(&[0]));
    let mask = image::open(f.path().join("out/01-red-ball.frame_00002.mask.png")).unwrap().to_luma8();
    assert_eq!(mask.dimensions(), (WIDTH, HEIGHT));
    assert_eq!(red["views"][0]["pixels"], mask.pixels().filter(|p| p.0 == [255]).count());
    let (x, y, _) = fixture::cameras()[2].project(glam::DVec3::from_array(fixture::CENTRES[0]));
    assert_eq!(mask[(x as u32, y as u32)].0, [255]);
    assert!(f.path().join("out/02-blue-ball.frame_00004.overlay.png").exists());
    assert!(f.path().join("out/query.json.run.json").exists());
}

#[test]
fn pictures_are_of_views_where_the_selection_was_matched() {
    let q = Fixture::new(2).query("--text|red ball");
    let views: Vec<&str> = q[0]["views"].as_array().unwrap().iter().map(|v| v["view"].as_str().unwrap()).collect();
    assert_eq!(views, [stem(1), stem(5)]);
}

#[test]
fn options_say_which_instances_are_selected() {
    let f = Fixture::new(2);
    for (options, selected) in [
        ("", json!([0])),
        ("--top-k|2", json!([0, 1])),
        ("--threshold|0.5", json!([0, 1])),
        ("--threshold|-1", json!([0, 1, 2])),
        ("--threshold|0.9", json!([])),
        ("--threshold|0.5|--top-k|1", json!([0])),
        ("--threshold|-1|--min-support|4", json!([0, 1])),
    ] {
        let q = f.query(&format!("--text|thing|--views|frame_00002|{options}"));
        assert_eq!(q[0]["selected"], selected, "{options}");
    }
}

#[test]
fn a_text_no_better_than_by_chance_selects_nothing() {
    let f = Fixture::new(2);
    let plain = f.query("--text|thing|--views|frame_00002");
    assert_eq!((&plain[0]["selected"], &plain[0]["verdict"]), (&json!([0]), &Value::Null), "no unrelated texts");
    let mut table = f.json("text.json");
    query::Unrelated::texts().for_each(|t| table[t] = json!([0.6, 0.8]));
    fs::write(f.table(), table.to_string()).unwrap();
    let asked = "--text|thing|--text|red ball|--views|frame_00002";
    let q = f.query(asked);
    let verdict = |q: &Value| {
        let v = &q["verdict"];
        (v["matches"].clone(), [&v["best"], &v["by_chance"]].map(|s| (s.as_f64().unwrap() * 1e3).round()))
    };
    assert_eq!((&q[0]["selected"], &q[0]["gaussians"], &q[0]["score"]), (&json!([]), &json!(0), &Value::Null));
    assert_eq!(verdict(&q[0]), (json!(false), [707.0, 800.0]));
    assert_eq!((verdict(&q[1]), &q[1]["selected"]), ((json!(true), [1000.0, 800.0]), &json!([0])));
    assert_eq!(q[0]["ranking"][0]["instance"], 0, "what comes nearest is still said");
    let printed = f.good("query", &format!("{TABLE}|{asked}"));
    assert!(printed.contains("nothing matches: the best score is 0.7071, unrelated texts reach 0.8000"), "{printed}");
    f.warned("query", &format!("{TABLE}|{asked}|--quiet"), &["nothing matches \"thing\"", "--top-k 1"]);
    for (options, selected) in [("--top-k|1", json!([0])), ("--threshold|0.5", json!([0, 1]))] {
        let q = f.query(&format!("--text|thing|--views|frame_00002|{options}"));
        assert_eq!((&q[0]["selected"], &q[0]["verdict"]["matches"]), (&selected, &json!(false)), "{options}");
    }
    // Scores ask for the best, whatever it is.
    assert_eq!(f.score("")["query_pairs"], 4);
    f.bad("query", &format!("{TABLE}|{asked}|--negatives|lerf"), &["no such text in the table", "\"object\""]);
}

#[test]
fn a_text_encoder_takes_any_words() {
    let f = Fixture::new(2);
    let encoder = onnx_models::ClipText::open(CLIP, &onnx_models::EngineOptions::default()).unwrap();
    let words = "a round thing, nowhere in a table";
    f.write_found(encoder.encode(&[words]).unwrap());
    let ask = format!("--clip|{CLIP}|--text|{words}|--views|frame_00002|--out|{{}}/out");
    f.good("query", &ask);
    let q = f.json("out/query.json");
    assert_eq!(q["text_source"], "CLIP text encoder test-clip");
    assert_eq!(q["queries"][0]["selected"], json!([1]));
    assert!((q["queries"][0]["score"].as_f64().unwrap() - 1.0).abs() < 1e-6);
    assert_eq!(q["queries"][0]["ranking"].as_array().unwrap().len(), 2, "a zero descriptor has no cosine");
    f.good("score", &format!("--clip|{CLIP}|--out|{{}}/score.json"));
    assert_eq!(f.json("score.json")["query_pairs"], 4);
    f.write_instances(2, |g| g as i32);
    f.bad("query", &ask, &["found dimension 2, expected 4 (CLIP text encoder test-clip)"]);
}

#[test]
fn a_picture_is_a_query() {
    let f = Fixture::new(2);
    let picture = f.scene().join("images/frame_00002.png");
    let encoder = onnx_models::ClipImage::open(CLIP, &onnx_models::EngineOptions::default()).unwrap();
    let image = gs_scene::Image::read(&picture).unwrap();
    let (width, height) = (image.width as usize, image.height as usize);
    let whole = onnx_models::RgbImage { width, height, pixels: image.to_rgb8() };
    let map = onnx_models::LabelMap { width, height, ids: &vec![0; width * height] };
    let bounds = onnx_models::Bounds { x0: 0, y0: 0, x1: width, y1: height };
    f.write_found(
        encoder
            .encode(&onnx_models::crop_mask(&whole, &map, 0, bounds, encoder.size(), onnx_models::Crop::Black, [0; 3]))
            .unwrap(),
    );
    let image = format!("--image|{}|--views|frame_00002", picture.display());
    let ask = format!("--clip|{CLIP}|{image}|--out|{{}}/out");
    f.good("query", &ask);
    let q = &f.json("out/query.json")["queries"][0];
    assert_eq!((&q["kind"], &q["text"], &q["selected"]), (&"image".into(), &"frame_00002".into(), &json!([1])));
    assert!((q["score"].as_f64().unwrap() - 1.0).abs() < 1e-6);
    f.bad("query", &format!("{TABLE}|{image}"), &["pictures need an image encoder"]);
    f.write_instances(2, |g| g as i32);
    f.bad("query", &ask, &["found dimension 2, expected 4"]);
}

#[test]
fn bad_queries_are_one_line_and_leave_no_output() {
    let f = Fixture::new(2);
    let table = "--text-features|{}/text.json|--text";
    let bad = |arguments: &str, parts: &[&str]| f.bad("query", &format!("{arguments}|--out|{{}}/out"), parts);
    bad(&format!("{table}|red bal"), &["no such text in the table", "\"red ball\""]);
    bad(&format!("{table}|red ball|--views|frame_7"), &["--views: no such view; found frame_7"]);
    bad("--text-features|{}/none.json|--text|red ball", &["none.json: cannot read"]);
    bad("--clip|{}/no-model|--text|red ball", &["no-model"]);
    bad("--text|red ball", &["expected --clip or --text-features"]);
    bad(&format!("{table}|red ball|--segment"), &["--segment: nothing to choose between"]);
    bad("", &["required arguments were not provided"]);
    // CLIP has a feature for no words, too.
    for (empty, option) in [("--text=", "--text <"), ("--negatives=thing, ,stuff", "--negatives <")] {
        bad(&format!("{table}|red ball|{empty}"), &[option, "': an empty text; expected words"]);
    }
    fs::write(f.table(), r#"{"red ball": [1, 0, 0]}"#).unwrap();
    bad(&format!("{table}|red ball"), &["another model", "found dimension 2, expected 3"]);
    f.write_instances(0, |g| g as i32);
    bad(&format!("{table}|red ball"), &["no language features", "mask-embed"]);
    assert!(!f.path().join("out").exists());
}

#[test]
fn artifacts_of_another_scene_are_refused() {
    let f = Fixture::new(2);
    let mut g = gs_scene::ply::read_gaussians(f.geometry()).unwrap();
    g.means[0][0] += 0.25;
    gs_scene::ply::write_gaussians(f.geometry(), &g, &[]).unwrap();
    let query = format!("{TABLE}|--text|red ball");
    for (command, arguments) in [("query", &query[..]), ("score", SCORE), ("report", REPORT)] {
        f.bad(command, arguments, &["instances.safetensors: inputs.geometry: made from another geometry"]);
    }
    let f = Fixture::new(2);
    let transforms = f.scene().join("transforms.json");
    for i in 0..VIEWS {
        let other = format!("images/other_{i}.png");
        fs::rename(f.scene().join(format!("images/{}.png", stem(i))), f.scene().join(&other)).unwrap();
        let text = fs::read_to_string(&transforms).unwrap();
        fs::write(&transforms, text.replace(&format!("images/{}.png", stem(i)), &other)).unwrap();
    }
    f.bad("score", SCORE, &["instances.safetensors: inputs.dataset: made from another dataset"]);
    fs::remove_file(f.geometry()).unwrap();
    f.bad("score", SCORE, &["geometry.ply: cannot open"]);
    fs::write(f.instances(), b"short").unwrap();
    f.bad("score", SCORE, &["instances.safetensors: not a safetensors artifact"]);
    assert!(!f.path().join("score.json").exists());
}

#[test]
fn a_perfect_run_scores_high() {
    let f = Fixture::new(2);
    let s = f.score("");
    assert_eq!((&s["instance_miou"], &s["object_miou"]), (&json!(1.0), &json!(1.0)));
    assert_eq!((&s["fragmented"], &s["merging"]), (&json!(0), &json!(0)));
    assert!(s["query_miou"].as_f64().unwrap() > 0.8, "{s}");
    assert_eq!((&s["query_macc25"], &s["query_pairs"]), (&json!(1.0), &json!(4)));
    assert_eq!(s["queries"][1]["text"], "red ball");
    let floor = &s["things"][2];
    assert_eq!((&floor["name"], &floor["background"], &floor["iou"]), (&"floor".into(), &true.into(), &1.0.into()));
    // The best instance for a label is the one that its text selects.
    let labels = s["labels"].as_array().unwrap();
    assert_eq!((&s["label_miou"], labels.len()), (&s["query_miou_visible"], 4));
    assert_eq!((&labels[0]["category"], &labels[0]["instance"]), (&json!("blue ball"), &json!(1)));
    let v = f.score("--silhouette|visible");
    assert_eq!((&v["silhouette"][0], &v["query_miou"]), (&json!("visible"), &s["query_miou_visible"]));
    // Where each text means the other ball, the one that fits the labels is second.
    let ranks = |s: &Value| [0, 1].map(|i| s["queries"][i]["rank"].as_u64());
    let mut table: serde_json::Map<String, Value> = serde_json::from_slice(&fs::read(f.table()).unwrap()).unwrap();
    let [red, blue] = ["red ball", "blue ball"].map(|name| table[name].clone());
    table.extend([("red ball".into(), blue), ("blue ball".into(), red)]);
    fs::write(f.table(), json!(table).to_string()).unwrap();
    assert_eq!((ranks(&s), ranks(&f.score(""))), ([Some(1); 2], [Some(2); 2]));
}

#[test]
fn names_of_none_one_and_several_things_are_scored_with_what_matches_nothing() {
    let f = Fixture::new(2);
    let plain = f.score("");
    assert!(plain.get("counted").is_none(), "{plain}");
    let mut table = f.json("text.json");
    query::Unrelated::texts().for_each(|t| table[t] = json!([0.6, 0.8]));
    table["teapot"] = json!([0.7, 0.7]);
    table["blue teapot"] = json!([0.1, 1.0]);
    table["ball"] = json!([1.0, 0.1]);
    fs::write(f.table(), table.to_string()).unwrap();
    let label = f.scene().join("label");
    let frame = stem(1);
    let file = format!("{frame}.json");
    let one: Value = fixture::read_json(&label.join(&file));
    let write = |kind: &str, objects: Vec<Value>| {
        fs::create_dir_all(label.join(kind)).unwrap();
        let labels = json!({"info": one["info"], "objects": objects});
        fs::write(label.join(kind).join(&file), labels.to_string()).unwrap();
    };
    let none = |category: &str| json!({"category": category, "segmentation": []});
    write("absent", vec![none("teapot"), none("blue teapot")]);
    let both = one["objects"]
        .as_array()
        .unwrap()
        .iter()
        .map(|o| json!({"category": "ball", "segmentation": o["segmentation"]}));
    write("several", both.collect());
    let s = f.score("");
    assert_eq!(s["query_miou"], plain["query_miou"]);
    let c = &s["counted"];
    // A teapot is less like a ball than what has nothing to do with the scene; a blue one is more.
    assert_eq!(c["absent"], json!({"texts": 2, "believed": 1, "pairs": 2, "giou": 0.5}));
    assert_eq!((&c["one"]["believed"], &c["one"]["giou"]), (&json!(2), &s["query_miou_visible"]));
    // One of the two balls is found.
    let giou = c["several"]["giou"].as_f64().unwrap();
    assert!(giou > 0.3 && giou < 0.7, "{c}");
    let of = |kind: &str, field: &str| c[kind][field].as_f64().unwrap();
    let [pairs, sum] = ["absent", "one", "several"]
        .iter()
        .fold([0.0, 0.0], |[n, sum], kind| [n + of(kind, "pairs"), sum + of(kind, "pairs") * of(kind, "giou")]);
    assert!((c["giou"].as_f64().unwrap() - sum / pairs).abs() < 1e-12);
}

#[test]
fn gaussians_with_descriptors_of_their_own_answer_texts() {
    let f = Fixture::new(2);
    // The balls' Gaussians, a little off; the floor has none.
    let values = arr3(&[[[0.8, 0.6]], [[0.28, 0.96]]]);
    let mut d = Descriptors { kept: vec![0, 1], row: vec![0, 1], values };
    let path = f.path().join("descriptors.safetensors");
    d.write(&path, f.provenance()).unwrap();
    let whole = f.score("");
    let own = |more: &str| f.score(&format!("--descriptors|{{}}/descriptors.safetensors|{more}"));
    let alike = own("");
    assert_eq!((&alike["query_miou"], &alike["instance_miou"]), (&whole["query_miou"], &json!(1.0)));
    assert_eq!(alike["queries"][1]["rank"], Value::Null, "instances were not asked");
    assert_eq!((&alike["queries"][1]["text"], &alike["queries"][1]["selected"]), (&json!("red ball"), &json!([])));
    assert!((alike["queries"][1]["score"].as_f64().unwrap() - 0.8).abs() < 1e-6);
    // At 0.7 the blue ball's text takes its own alone, at 0.5 both.
    assert_eq!(own("--threshold|0.7")["queries"][0]["iou"], whole["queries"][0]["iou"]);
    assert!(own("--threshold|0.5")["queries"][0]["iou"].as_f64() < whole["queries"][0]["iou"].as_f64());
    assert_eq!(own("--top-k|1")["query_miou"], whole["query_miou"]);
    assert_eq!(own("--threshold|0.9")["query_miou"], whole["queries"][0]["iou"].as_f64().unwrap() / 2.0);
    // Without instances only the queries are scored.
    let mut alone = f.command("score", false);
    alone.arg("--scene").arg(f.scene()).arg("--geometry").arg(f.geometry()).arg("--out").arg("score.json");
    alone.arg("--text-features").arg(f.table());
    let refused = alone.output().unwrap();
    let said = String::from_utf8_lossy(&refused.stderr);
    assert!(refused.status.code() == Some(2) && said.contains("--instances <FILE>|--descriptors <FILE>"), "{said}");
    assert!(alone.arg("--descriptors").arg(&path).output().unwrap().status.success());
    let alone = f.json("score.json");
    assert_eq!((&alone["query_miou"], &alone["instance_miou"]), (&whole["query_miou"], &Value::Null));
    assert!(alone["skipped"][0].as_str().unwrap().contains("no --instances were given"), "{alone}");
    d.kept[1] = 99;
    d.write(&path, f.provenance()).unwrap();
    let wrong = format!("{SCORE}|--descriptors|{{}}/descriptors.safetensors");
    f.bad("score", &wrong, &["a Gaussian that the geometry lacks", "found 99"]);
    d.write(&path, Provenance::default()).unwrap();
    f.bad("score", &wrong, &["descriptors.safetensors", "geometry"]);
}

#[test]
fn labels_at_another_scale_are_scored_at_their_own() {
    let f = Fixture::new(2);
    for i in [1, 4] {
        f.write_label(i, &[("red ball", 0), ("blue ball", 1)], (4 * WIDTH, 4 * HEIGHT));
    }
    assert!(f.score("")["query_miou"].as_f64().unwrap() > 0.9);
    f.write_label(1, &[("red ball", 0)], (100, 100));
    let another = "frame_00001.json: info: the labelled image has another shape";
    f.bad("score", SCORE, &[another, "found 100x100"]);
    f.bad("lerf", LERF, &[another, "found 100x100"]);
}

#[test]
fn missing_predictions_count_as_zero_and_say_so() {
    let f = Fixture::new(2);
    f.write_label(4, &[("red ball", 0), ("green ball", 1)], (WIDTH, HEIGHT));
    fs::rename(f.scene().join("label/frame_00001.json"), f.scene().join("label/frame_09999.json")).unwrap();
    f.warned("score", SCORE, &["no text feature of the category \"green ball\"", "frame_09999 is no view"]);
    let s = f.json("score.json");
    assert_eq!((&s["query_pairs"], &s["query_macc25"]), (&json!(4), &json!(0.25)), "one of four is found");
    let no_feature = "it has no text feature: green ball in frame_00004";
    f.warned("lerf", LERF, &[no_feature, "2 of 4 pairs score 0 because the frame is no view of the scene"]);
    let m = f.json("lerf/metrics.json");
    let [red, green] = ["red ball", "green ball"].map(|name| &m["objects"][name]);
    assert!(red["instances"] == json!([0]) && red["score"] == 1.0, "{red}");
    assert!(green["instances"] == json!([]) && green["score"].is_null() && green["miou"] == 0.0, "{green}");
    let table = fs::read_to_string(f.path().join("lerf/table.md")).unwrap();
    assert!(table.contains("green ball in frame_00004") && table.contains("selected rendering above 0.7"), "{table}");
}

#[test]
fn id_maps_are_measured() {
    let f = Fixture::new(0);
    let printed = f.good("masks", "--masks|{}/balls/language_features|--out|{}/stats.json");
    assert!(printed.contains("| large |"), "{printed}");
    let stats = f.json("stats.json");
    assert_eq!(stats["views"], VIEWS);
    assert!(stats["levels"][3]["masks"][0].as_f64().unwrap() >= 1.0 && stats["levels"][3]["split"].is_null());
    f.bad("masks", "--masks|{}/balls/label|--out|{}/none.json", &["no id maps"]);
}

#[test]
fn what_has_no_truth_is_skipped_with_a_reason() {
    let f = Fixture::new(0);
    fs::remove_dir_all(f.scene().join("truth")).unwrap();
    let printed = f.good("score", SCORE);
    assert!(printed.contains("no language features") && printed.contains("truth/points.safetensors"), "{printed}");
    let s = f.json("score.json");
    assert!(s["label_miou"].as_f64().unwrap() > 0.5, "labels need no language");
    assert!(s["instance_miou"].is_null() && s["query_miou"].is_null());
    assert_eq!(s["skipped"].as_array().unwrap().len(), 2);
    f.bad("lerf", LERF, &["no language features"]);
    fs::remove_dir_all(f.scene().join("label")).unwrap();
    assert!(f.good("score", SCORE).contains("the scene has no"));
    f.bad("score", &format!("{SCORE}|--labels|{{}}/none"), &["--labels: no such folder"]);
    f.bad("lerf", LERF, &["the scene has no labels"]);
}

#[test]
fn more_memory_than_there_may_be_is_refused_at_the_start() {
    let f = Fixture::new(2);
    let needs_more = "--memory-limit: the run needs more memory than it may take";
    for (command, arguments, part) in [
        ("score", SCORE, needs_more),
        ("query", &format!("{TABLE}|--text|red ball"), needs_more),
        ("lerf", "--predictions|none|--labels|{}/balls/label|--out|{}/out", needs_more),
        ("table", "none|--out|{}/out", "--memory-limit: this command does not forecast its memory; leave it out"),
        ("masks", "--masks|none|--out|{}/out", "--memory-limit: this command does not forecast"),
    ] {
        f.bad(command, &format!("{arguments}|--memory-limit|1M"), &[part]);
    }
    assert!(!f.path().join("out").exists() && !f.path().join("score.json").exists());
    // What is forecast is near what is taken, also where the program itself takes most.
    f.score("");
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
    f.good("query", "--text-features|{}/text.json|--text|red ball|--out|{}/run/query");
    f.good("score", "--text-features|{}/text.json|--out|{}/run/score.json");
    fs::write(f.run().join("geom_metrics.json"), r#"{"psnr_heldout": 31.5, "ssim_heldout": 0.95}"#).unwrap();
    let curve = "{\"iteration\":1,\"loss\":0.5}\n{\"iteration\":2,\"loss\":0.4}\n";
    fs::write(f.run().join("geometry.ply.curve.jsonl"), curve).unwrap();
    let printed = f.good("report", REPORT);
    assert!(printed.contains("psnr_heldout     31.50 dB"), "{printed}");
    let html = fs::read_to_string(f.path().join("report.html")).unwrap();
    let link = "href=\"http://127.0.0.1:7007/\">http://127.0.0.1:7007/</a>";
    assert!(html.contains("explore serve --run-dir") && html.contains(link));
    let html = html.replace(link, "");
    let ids = ["photographs", "id-maps", "features", "instances", "queries", "instance-scores", "query-scores"];
    for id in ids.into_iter().chain(["training", "stages"]) {
        assert!(html.contains(&format!("<h2 id=\"{id}\"")), "{id}");
    }
    for outside in ["http:", "https:", "<script", "<link", "url(", "@import", "src=\"/"] {
        assert!(!html.contains(outside), "{outside}");
    }
    assert!(html.contains("eval score") && html.contains("<polyline"));
    let m = f.json("metrics.json");
    assert_eq!((&m["psnr_heldout"], &m["gaussians"], &m["instances"]), (&json!(31.5), &json!(83), &json!(3)));
    assert_eq!((&m["query_count"], &m["queries"][1]["text"]), (&json!(2), &json!("red ball")));
    assert!(m["seconds"]["eval score"].as_f64().unwrap() > 0.0);
    assert_eq!(m["skipped"].as_array().unwrap().len(), 2, "the instances' health, and names: {}", m["skipped"]);
}

#[test]
fn a_report_calls_unseen_what_training_held_out() {
    let f = Fixture::new(0);
    [f.instances(), f.run().join("features.safetensors")].iter().for_each(|file| fs::remove_file(file).unwrap());
    let dataset = dataset::load(&f.scene(), &LoadOptions::default()).unwrap();
    let g = gs_scene::ply::read_gaussians(f.geometry()).unwrap();
    let page = |every: Option<usize>, more: &str| {
        let views = |n| vec![format!("holdout {n}"), format!("learnt_views \"{}\"", Learnt::hash(&dataset, n))];
        gs_scene::ply::write_gaussians(f.geometry(), &g, &every.map_or(Vec::new(), views)).unwrap();
        f.good("report", &format!("{REPORT}{more}"));
        fs::read_to_string(f.path().join("report.html")).unwrap()
    };
    let (never, all) = ("These views were held out: training never saw them.", "Training saw these views.");
    // Nine views: training held out the first, fourth and seventh, whatever the default is.
    let html = page(Some(3), "");
    assert!(html.contains(never) && html.contains("9 photographs (3 held out)"));
    let html = page(Some(0), "");
    assert!(html.contains(all) && html.contains("(0 held out)") && !html.contains("never saw"));
    // What is shown is asked for, or held out only here.
    let html = page(Some(3), "|--holdout|8");
    let seen = stem(8);
    assert!(html.contains(&format!("Training saw {seen}; the other views were held out.")), "{html}");
    assert!(page(Some(3), &format!("|--views|{seen}")).contains(all));
    assert!(page(Some(3), &format!("|--views|{}", stem(6))).contains(never));
    // From elsewhere.
    for more in ["", "|--holdout|8"] {
        let html = page(None, more);
        assert!(html.contains("do not say which of these views training saw") && !html.contains("never saw"));
        assert!(!html.contains("held out)"));
    }
    // Figures of views that training may have seen are not those of held-out ones.
    fs::write(f.run().join("geom_metrics.json"), r#"{"split": "unknown", "psnr": 31.5, "psnr_heldout": null}"#)
        .unwrap();
    assert!(!page(None, "").contains("31.50"));
    assert!(f.json("metrics.json")["psnr_heldout"].is_null());
}

#[test]
fn a_report_says_how_far_masks_and_instances_agree() {
    let f = Fixture::new(0);
    let section = "<h2 id=\"soundness\">Masks and instances: how far they agree";
    let health = json!({"largest": 0.25, "purity": 0.9});
    let (instances, _) = Instances::read(f.instances()).unwrap();
    instances.write(f.instances(), Provenance { extra: json!({ "health": health }), ..f.provenance() }).unwrap();
    f.good("report", REPORT);
    assert_eq!(f.json("metrics.json")["health"], health);
    let html = fs::read_to_string(f.path().join("report.html")).unwrap();
    assert!(html.contains(section) && html.contains("<b>25 %</b>") && html.contains("<b>90 %</b>"), "{html}");
    assert!(html.contains("no figure tells how many instances are one whole thing"), "{html}");
    // Of an older program.
    f.change_instances(|_| ());
    f.good("report", REPORT);
    assert!(!fs::read_to_string(f.path().join("report.html")).unwrap().contains(section));
    assert!(f.json("metrics.json")["skipped"].to_string().contains("an older cluster-match"));
}

#[test]
fn a_report_of_geometry_alone_says_what_is_left_out() {
    let f = Fixture::new(0);
    for name in ["instances.safetensors", "features.safetensors"] {
        fs::remove_file(f.run().join(name)).unwrap();
    }
    fs::remove_dir_all(f.scene().join("language_features")).unwrap();
    f.good("report", REPORT);
    let html = fs::read_to_string(f.path().join("report.html")).unwrap();
    assert!(html.contains("<title>run</title>") && html.contains("The Gaussians do not say which of these views"));
    let m = f.json("metrics.json");
    let skipped = m["skipped"].to_string();
    for part in ["instances", "features", "id maps", "scores", "text queries", "PSNR"] {
        assert!(skipped.contains(part), "{part}: {skipped}");
    }
    assert!(m["instance_miou"].is_null());
    // Gaussians that somebody else trained do not lie in the run.
    fs::rename(f.run().join("geometry.ply"), f.path().join("mine.ply")).unwrap();
    f.good("report", &format!("{REPORT}|--geometry|{{}}/mine.ply"));
    f.bad("report", "--scene|{}/balls|--geometry|{}/mine.ply|--out|{}/r.html", &["--run-dir"]);
    f.bad("report", "--run-dir|{}/none|--scene|{}/balls|--out|{}/r/r.html", &["--run-dir", "no such folder"]);
    f.bad("report", "--run-dir|{}/run|--scene|{}/none|--geometry|{}/mine.ply|--out|{}/r/r.html", &["none"]);
}

#[test]
fn threads_do_not_change_a_byte() {
    let f = Fixture::new(2);
    for n in ["1", "2"] {
        let at = format!("--threads|{n}|--out|{{}}/q{n}");
        f.good("query", &format!("--text-features|{{}}/text.json|--text|red ball|{at}"));
        f.good("score", &format!("--text-features|{{}}/text.json|{at}/score.json"));
        f.good("report", &format!("--run-dir|{{}}/run|--scene|{{}}/balls|{at}/report.html"));
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
    for (command, arguments) in [
        ("query", "--text-features|{}/text.json|--text|red ball|--out|{}/file/out"),
        ("score", "--out|{}/file/score.json"),
        ("report", "--run-dir|{}/run|--scene|{}/balls|--out|{}/file/r.html"),
    ] {
        f.bad(command, arguments, &["cannot create the folder", "/file"]);
    }
}

#[test]
fn places_say_what_is_there() {
    let f = Fixture::new(2);
    let (x, y, _) = fixture::cameras()[2].project(glam::DVec3::from_array(fixture::CENTRES[1]));
    let pixel = format!("--pixel|frame_00002:{},{}", x as u32, y as u32);
    let printed = f.good("query", &format!("{TABLE}|{pixel}|--point|-0.6,0.1,0.5|--pixel|frame_00002.png:48, 1"));
    assert!(printed.contains("blue ball") && printed.contains("nothing is there"), "{printed}");
    let q = f.json("out/query.json");
    let [blue, sky, red] = [0, 1, 2].map(|i| &q["queries"][i]);
    assert_eq!((&blue["kind"], &blue["selected"]), (&json!("pixel"), &json!([1])));
    assert_eq!(blue["place"]["names"][0][0], "blue ball");
    assert!(blue["score"].as_f64().unwrap() > 0.9 && blue["place"]["alpha_or_distance"].as_f64().unwrap() > 0.9);
    let shown = blue["views"].as_array().unwrap();
    assert!(shown.iter().any(|v| v["view"] == "frame_00002"), "the view that was asked about is shown");
    assert!(sky["selected"] == json!([]) && sky["ply"].is_null(), "{sky}");
    assert_eq!((&red["kind"], &red["selected"]), (&json!("point"), &json!([0])));
    assert!((red["place"]["alpha_or_distance"].as_f64().unwrap() - 0.1).abs() < 1e-6);
    // Without language nothing has a name, but it is still there.
    let f = Fixture::new(0);
    f.good("query", &format!("--out|{{}}/out|{pixel}"));
    assert_eq!(f.json("out/query.json")["queries"][0]["selected"], json!([1]));
    let bad = |place: &str, part: &str| f.bad("query", &format!("--out|{{}}/out|{place}"), &[part]);
    bad("--pixel|frame_00002:96,1", "--pixel: the pixel lies outside the view; found 96,1");
    for wrong in ["frame_00002", "frame_00002:", "frame_00002:3,", "frame_00002:3,4,5", "frame_00002:-1,2"] {
        bad(&format!("--pixel|{wrong}"), "--pixel: not understood; found ");
    }
    bad("--point|1,x,2", "--point: not understood; found 1,x,2, expected 3 numbers");
    bad("--point|1,2,inf", "--point: not a point");
}

#[test]
fn points_outside_the_scene_are_refused() {
    let f = Fixture::new(2);
    for (point, found) in [("1e30,0,0", "[1e30, 0.0, 0.0], 1.0000e30 from"), ("0,-60,0", "[0.0, -60.0, 0.0], ")] {
        let outside = "--point: the point lies outside the scene; found ";
        f.bad("query", &format!("{TABLE}|--point|0,0,0.5|--point|{point}"), &[outside, found]);
        assert!(!f.path().join("out").exists());
    }
    f.bad("query", &format!("{TABLE}|--point|1e300,0,0"), &["--point: not a point"]);
    // Somewhat beside the scene there is still something nearest.
    f.query("--point|0,-6,0");
}

#[test]
fn a_report_shows_no_picture_from_outside_the_run() {
    let f = Fixture::new(2);
    f.query("--text|red ball|--views|frame_00002");
    fs::rename(f.path().join("out"), f.run().join("query")).unwrap();
    let file = f.run().join("query/query.json");
    let written = fs::read_to_string(&file).unwrap();
    let picture = f.scene().join("images/frame_00001.png");
    let name = "01-red-ball.frame_00002.overlay.png";
    assert!(written.contains(name));
    for outside in ["../../balls/images/frame_00001.png", picture.to_str().unwrap(), "./../../x.png", ""] {
        fs::write(&file, written.replace(name, outside)).unwrap();
        let found = format!("query.json: overlay: a picture outside the run; found {outside}");
        f.bad("report", REPORT, &[&found]);
        assert!(!f.path().join("report.html").exists());
    }
    fs::write(&file, written).unwrap();
    f.good("report", REPORT);
}

#[test]
fn several_texts_divide_the_cloud() {
    let f = Fixture::new(2);
    let at = "--text|blue ball|--text|red ball|--segment|--views|frame_00002";
    let printed = f.good("query", &format!("{TABLE}|{at}|--threshold|0"));
    assert!(printed.contains("segmentation (81 Gaussians without a text)"), "{printed}");
    let labels = gs_io::npy::read_f32(f.path().join("out/labels.npy")).unwrap();
    assert_eq!((labels.shape(), &flat(labels.view())[..4]), (&[83][..], &[1.0, 0.0, -1.0, -1.0][..]));
    let s = &f.json("out/query.json")["segmentation"];
    assert_eq!((&s["segments"][0]["text"], &s["segments"][0]["gaussians"]), (&"blue ball".into(), &1.into()));
    let g = gs_scene::ply::read_gaussians(f.path().join("out/segmentation.ply")).unwrap();
    assert_eq!(g.len(), 83);
    assert!(g.base_color(0) != g.base_color(1) && g.base_color(2) == g.base_color(3));
    assert!(f.path().join("out/segmentation.frame_00002.png").exists());
}

#[test]
fn negatives_templates_and_joining_change_the_answer() {
    let f = Fixture::new(2);
    let first = |rest: &str| f.query(&format!("--views|frame_00002|{rest}"))[0].clone();
    let q = first("--text|red ball|--negatives|blue ball,thing");
    // cos(red, thing) = 0.707: 1 / (1 + exp(10 (0.7071 - 1))).
    assert!((q["score"].as_f64().unwrap() - 1.0 / (1.0 + (-2.928_932_f64).exp())).abs() < 1e-5, "{q}");
    fs::write(f.table(), r#"{"ball": [0, 1], "a ball": [1, 0], "the ball": [1, 0.2]}"#).unwrap();
    assert_eq!(first("--text|ball")["selected"], json!([1]));
    assert_eq!(first("--text|ball|--template|a <>|--template|the <>")["selected"], json!([0]));
    // Features (0 0 1), (1 1 1), (2 4 1): angles between red and blue 54.7 degrees, so unit distance 0.919.
    let join = |d: &str| first(&format!("--text|ball|--join|{d}|--features|{{}}/run/features.safetensors"));
    let [apart, joined] = ["0.9", "0.93"].map(|d| join(d)["selected"].clone());
    assert!(apart[0] == 1 && !apart.to_string().contains('0') && joined.to_string().contains('0'), "{apart} {joined}");
    let bad = |rest: &str, part: &str| f.bad("query", &format!("{TABLE}|--text|ball|{rest}"), &[part]);
    bad("--negatives|stuff", "no such text in the table");
    bad("--template|a photo", "no place for the text; expected {} in it");
    bad("--template=", "no place for the text");
    bad("--join|0|--features|{}/run/features.safetensors", "'--join <DISTANCE>': expected more than 0");
    bad("--join|1|--features|{}/run/none", "none");
}

#[test]
fn an_interactive_query_reads_texts_from_a_pipe() {
    use std::io::Write;
    let f = Fixture::new(2);
    let ask = |rest: &[&str], input: &str| {
        let mut c = f.command("query", true);
        c.arg("--text-features").arg(f.table()).arg("--interactive").args(rest);
        let mut child = c.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
        child.stdin.take().unwrap().write_all(input.as_bytes()).unwrap();
        let o = child.wait_with_output().unwrap();
        assert!(o.status.success());
        [o.stderr, o.stdout].map(|said| String::from_utf8(said).unwrap())
    };
    let [said, printed] = ask(&[], "red ball\n\nreed ball\nblue ball\n:quit\nthing\n");
    assert!(said.contains("no such text in the table") && said.contains("\"reed ball\""), "{said}");
    assert!(printed.contains("\"red ball\" (1 Gaussians") && printed.contains("\"blue ball\""), "{printed}");
    assert!(!printed.contains("\"thing\"") && printed.contains("ms query"), "nothing after :quit: {printed}");
    let [_, printed] = ask(&["--json", "--out", "live", "--views", "frame_00002"], "red ball\nblue ball");
    let lines = printed.lines().filter_map(|l| serde_json::from_str(l).ok());
    let lines: Vec<Value> = lines.filter(|v: &Value| v["ranking"].is_array()).collect();
    assert_eq!((lines.len(), &lines[1]["selected"]), (2, &json!([1])));
    let out = f.path().join("live");
    assert!(out.join("01-red-ball/01-red-ball.ply").exists() && out.join("02-blue-ball/query.json").exists());
}

#[test]
#[cfg(target_os = "linux")]
fn a_full_standard_output_is_an_error() {
    let f = Fixture::new(2);
    fs::write(f.path().join("texts"), "red ball\n").unwrap();
    for rest in [&["--interactive"][..], &["--interactive", "--json"], &["--text", "red ball", "--out", "full"]] {
        let mut c = f.command("query", true);
        c.arg("--text-features").arg(f.table()).args(rest).stdin(fs::File::open(f.path().join("texts")).unwrap());
        let o = c.stdout(fs::File::options().write(true).open("/dev/full").unwrap()).output().unwrap();
        failed(&o, &["standard output: cannot write: No space left"]);
    }
}

#[test]
fn odd_instances_are_answered_with_a_line() {
    let f = Fixture::new(2);
    let query = format!("{TABLE}|--text|red ball|--views|frame_00002");
    // The instance of the best descriptor holds no Gaussian.
    f.write_instances(2, |g| if g == 0 { 1 } else { g as i32 });
    f.warned("query", &query, &["hold no Gaussian: nothing to show"]);
    f.warned("lerf", LERF, &["score 0 because no Gaussian is selected"]);
    // All noise.
    f.write_instances(2, |_| -1);
    f.warned("query", &query, &["all Gaussians are noise"]);
    f.warned("lerf", LERF, &["all Gaussians are noise"]);
    assert_eq!(f.json("lerf/metrics.json")["figures"]["miou"], 0.0);
    let nothing = "nothing is selected for \"red ball\": it counts as IoU 0";
    f.warned("score", SCORE, &["all Gaussians are noise: every score is 0", nothing]);
    let s = f.json("score.json");
    assert_eq!((&s["instance_miou"], &s["query_miou"]), (&json!(0.0), &json!(0.0)));
    // One instance: it answers everything.
    f.write_instances(2, |_| 0);
    assert_eq!(f.query("--text|red ball|--views|frame_00002")[0]["gaussians"], 83);
    // Nothing reaches the threshold.
    f.warned("query", &format!("{TABLE}|--text|thing|--threshold|0.9"), &["nothing is selected"]);
}

#[test]
fn views_without_masks_leave_instances_without_words() {
    let f = Fixture::new(2);
    let report = format!("{REPORT}|--views|frame_00000,frame_00001,frame_00002");
    // One view has an id map without a mask, another none: the rest speaks for the instances.
    let masks = f.scene().join("language_features");
    let empty = artifacts::MaskMaps { ids: Array3::from_elem((4, HEIGHT as usize, WIDTH as usize), -1) };
    empty.write(artifacts::maps_path(&masks, &stem(0))).unwrap();
    fs::remove_file(artifacts::maps_path(&masks, &stem(1))).unwrap();
    f.change_instances(|i| i.matches.retain(|m| m.view > 1));
    assert_eq!(f.query("--text|red ball|--views|frame_00002")[0]["selected"], json!([0]));
    assert_eq!(f.score("")["query_macc25"], 1.0);
    f.good("lerf", LERF);
    assert_eq!(f.json("lerf/metrics.json")["figures"]["macc25"], 1.0);
    f.good("report", &report);
    let html = fs::read_to_string(f.path().join("report.html")).unwrap();
    assert!(html.contains("frame_00000: 0 masks") && html.contains("frame_00002: 2 masks"));
    assert!(!html.contains("frame_00001: 0 masks"), "a view without an id map is not shown as one without masks");
    // No view has masks: nothing was matched, so no instance has a descriptor. Zeros, each with a line.
    for i in 0..VIEWS {
        empty.write(artifacts::maps_path(&masks, &stem(i))).unwrap();
    }
    f.change_instances(|i| {
        i.matches.clear();
        i.support.fill(0);
        i.descriptor.fill(0.0);
    });
    let query = format!("{TABLE}|--text|red ball|--views|frame_00002");
    f.warned("query", &query, &["no instance passes for \"red ball\""]);
    assert!(f.good("query", &query).contains("no instance has a descriptor"));
    f.warned("score", SCORE, &["nothing is selected for \"blue ball\": it counts as IoU 0"]);
    let s = f.json("score.json");
    assert_eq!((&s["query_miou"], &s["instance_miou"]), (&json!(0.0), &json!(1.0)));
    f.warned("lerf", LERF, &["4 of 4 pairs score 0 because no Gaussian is selected"]);
    f.good("report", &report);
}

#[test]
fn damaged_gaussians_are_left_out_and_said_to_be() {
    let f = Fixture::new(2);
    let query = format!("{TABLE}|--text|red ball|--text|blue ball|--segment|--views|frame_00002");
    let mask = || fs::read(f.path().join("out/01-red-ball.frame_00002.mask.png")).unwrap();
    f.good("query", &query);
    let before = mask();
    let mut g = gs_scene::ply::read_gaussians(f.geometry()).unwrap();
    (g.means[50][0], g.log_scales[60][1]) = (f32::NAN, f32::INFINITY);
    gs_scene::ply::write_gaussians(f.geometry(), &g, &[]).unwrap();
    // cluster-match gives them no instance.
    f.change_instances(|i| (i.label[50], i.label[60]) = (-1, -1));
    for (command, arguments) in [("query", &query[..]), ("score", SCORE), ("lerf", LERF)] {
        f.warned(command, arguments, &["skipped 2 of 83 Gaussians: damaged", "vertex 50"]);
    }
    assert!(before == mask(), "the ball looks as before");
    assert_eq!(gs_scene::ply::read_gaussians(f.path().join("out/segmentation.ply")).unwrap().len(), 83);
    assert_eq!(f.json("score.json")["instance_miou"], 1.0);
    let printed = f.good("report", REPORT);
    assert!(printed.contains("2 of 83 Gaussians: damaged"), "{printed}");
    // Features of the geometry before stay in the folder where nothing reads them.
    let skipped = f.json("metrics.json")["skipped"].to_string();
    assert!(skipped.contains("features: ") && skipped.contains("made from another geometry"), "{skipped}");
}

#[test]
fn a_geometry_learnt_with_the_filter_is_shown_with_it() {
    let f = Fixture::new(2);
    let mut g = gs_scene::ply::read_gaussians(f.geometry()).unwrap();
    g.log_scales[0] = [-4.2; 3]; // about a pixel
    let camera = &fixture::cameras()[2];
    let pixels = [false, true].map(|antialias| {
        let geometry = gs_scene::Geometry { gaussians: g.clone(), antialias, ..Default::default() };
        gs_scene::ply::write_gaussians(f.geometry(), &g, &geometry.comments(Vec::new())).unwrap();
        f.change_instances(|_| {});
        let q = f.query("--text|red ball|--views|frame_00002|--silhouette|selected");
        let options = gs_raster::RasterOptions { antialias, ..Default::default() };
        let alpha = gs_raster::render(&g.select(&[0]), camera, &options).alpha;
        let expected = alpha.iter().filter(|&&a| a > 0.7).count();
        assert_eq!(q[0]["views"][0]["pixels"], expected);
        assert_eq!(gs_scene::ply::is_antialiased(f.path().join("out/01-red-ball.ply")).unwrap(), antialias);
        expected
    });
    assert!(pixels[1] < pixels[0], "{pixels:?}");
}

#[test]
fn an_answer_may_be_coarser_or_finer() {
    let f = Fixture::new(2);
    let edge = |parent, child, instance| artifacts::TreeEdge { parent, child, lambda: 1.0, size: 2, instance };
    f.change_instances(|i| {
        // Both balls are parts of 84; the floor (85) falls into two halves.
        let whole = [edge(83, 84, -1), edge(83, 85, 2), edge(84, 86, 0), edge(84, 87, 1)];
        i.tree = [&whole[..], &[edge(85, 88, -1), edge(85, 89, -1)]].concat();
        i.node = (0..83).map(|g| if g < 2 { 86 + g } else { 88 + g % 2 }).collect();
    });
    let ask = |text: &str, granularity: &str, said: &[&str]| {
        let asked = format!("{TABLE}|--text|{text}|--views|frame_00002|--granularity|{granularity}");
        f.warned("query", &asked, said);
        f.json("out/query.json")["queries"].clone()
    };
    let gaussians = |file: &str| gs_scene::ply::read_gaussians(f.path().join("out").join(file)).unwrap().len();
    let q = ask("blue ball", "parent", &[]);
    assert_eq!((&q[0]["selected"], &q[0]["gaussians"]), (&json!([1, 0]), &json!(2)));
    assert_eq!(gaussians("01-blue-ball.ply"), 2);
    fs::write(f.table(), r#"{"floor": [-0.6, -0.8], "blue ball": [0, 1]}"#).unwrap();
    let q = ask("floor", "parts", &[]);
    let sizes: Vec<u64> = q.as_array().unwrap().iter().map(|q| q["gaussians"].as_u64().unwrap()).collect();
    assert_eq!((sizes, &q[1]["selected"]), (vec![81, 41, 40], &json!([2])));
    assert_eq!((&q[2]["kind"], &q[2]["text"]), (&json!("part"), &json!("floor, part 2 of 2")));
    assert_eq!(gaussians("03-floor-part-2-of-2.ply"), 40);
    assert!(f.path().join("out/02-floor-part-1-of-2.frame_00002.mask.png").exists());
    assert_eq!(ask("floor", "parent", &["no parent but the whole scene"])[0]["gaussians"], 81);
    assert_eq!(ask("blue ball", "parts", &["instance 1 has no parts"]).as_array().unwrap().len(), 1);
}

#[test]
fn a_scene_of_a_benchmark_is_checked_before_anything_runs() {
    let f = Fixture::new(2);
    let (scene, masks) = (f.scene(), f.scene().join("language_features"));
    let run = || {
        let mut c = f.command("check", false);
        c.args(["--benchmark", "lerf-ovs", "--scene"]).arg(&scene).arg("--masks").arg(&masks);
        c.arg("--text-features").arg(f.table()).output().unwrap()
    };
    let good = |parts: &[&str]| {
        let o = run();
        let said = [o.stdout, o.stderr].map(|s| String::from_utf8(s).unwrap()).concat();
        assert!(o.status.success() && parts.iter().all(|part| said.contains(part)), "{said}");
    };
    let bad = |parts: &[&str]| failed(&run(), parts);
    let map = masks.join(format!("{}_s.npy", stem(0)));
    good(&[
        "labels of 2 frames, 4 objects, 2 texts asked",
        "text features of all 2 texts",
        "_s.npy: 96x72 pixels, 8 masks",
    ]);
    // Texts.
    let table = fs::read(f.table()).unwrap();
    fs::write(f.table(), r#"{"red ball": [1, 0]}"#).unwrap();
    bad(&["text.json", "texts that will be asked have no feature", "1 of 2 without, such as blue ball"]);
    fs::write(f.table(), table).unwrap();
    // Labels.
    let label = scene.join(format!("label/{}.json", stem(4)));
    let whole = fs::read_to_string(&label).unwrap();
    fs::write(&label, &whole[..whole.len() / 2]).unwrap();
    bad(&[&stem(4), "not a label file"]);
    fs::write(&label, whole.replace("blue ball", " ")).unwrap();
    bad(&[&stem(4), "a category without a name"]);
    fs::write(&label, r#"{"info":{"width":96,"height":40},"objects":[]}"#).unwrap();
    bad(&[&stem(4), "another shape than the photograph"]);
    let empty = r#"{"info":{"width":96,"height":72},"objects":[{"category":"red ball","segmentation":[]}]}"#;
    fs::write(&label, empty).unwrap();
    good(&["red ball: its polygons hold no pixel"]);
    fs::write(&label, &whole).unwrap();
    fs::copy(&label, scene.join("label/frame_99999.json")).unwrap();
    good(&["frame_99999.json: no photograph of this name"]);
    // Masks: of another shape, of another dtype or blended, of other photographs; features of another run or model.
    gs_io::npy::write_f32(&map, &Array3::<f32>::zeros((4, 40, 96))).unwrap();
    bad(&[&format!("{}_s.npy", stem(0)), "another shape than the photograph; found 96x40, expected 96x72"]);
    gs_io::npy::write_f32(&map, &Array3::from_elem((4, 72, 96), 0.5)).unwrap();
    bad(&["not a mask id; found 0.5"]);
    gs_io::npy::write_f32(&map, &Array3::<f32>::ones((4, 72, 96))).unwrap();
    let features = |rows: usize, dim: usize| {
        let file = masks.join(format!("{}_f.npy", stem(0)));
        gs_io::npy::write_f32(file, &Array2::from_elem((rows, dim), 0.5)).unwrap();
    };
    features(1, 2);
    bad(&["fewer features than masks; found 1, expected at least 2"]);
    features(2, 3);
    bad(&["features of different models; found 3, expected 2"]);
    features(2, 2);
    good(&["2 masks, features of dimension 2"]);
    // All that is wrong is said at once.
    fs::write(&label, "{").unwrap();
    fs::remove_dir_all(&masks).unwrap();
    gs_io::npy::write_f32(masks.join("other_s.npy"), &Array2::<f32>::zeros((1, 1))).unwrap();
    let said = String::from_utf8(run().stderr).unwrap();
    assert!(said.contains("not a label file") && said.contains("no id map is of a photograph"), "{said}");
    assert!(said.contains("1 such as other_s.npy"), "{said}");
}

#[test]
fn what_a_person_changed_of_the_instances_counts() {
    let f = Fixture::new(2);
    let file = f.path().join("instances.edits.json");
    let hash = |f: &Fixture| gs_io::hash_file(f.instances()).unwrap();
    let edits = json!([
        {"op": "rename", "instance": 1, "name": "marble"},
        {"op": "merge", "instances": [1, 0]},
    ]);
    let write = |instances: &str, edits: &Value| {
        let all = json!({"format": "instances.edits", "version": 1, "instances": instances, "edits": edits});
        fs::write(&file, all.to_string()).unwrap();
    };
    write(&hash(&f), &edits);
    let question = format!("{TABLE}|--text|red ball|--edits|{{}}/instances.edits.json");
    let printed = f.good("query", &question);
    assert!(printed.contains("(2 Gaussians selected)") && printed.contains("  selected  marble"), "{printed}");
    let ranking = &f.json("out/query.json")["queries"][0]["ranking"];
    assert_eq!((&ranking[0]["instance"], &ranking[0]["name"]), (&json!(1), &json!("marble")));
    assert!(ranking[1]["instance"] == 2 && ranking[1].get("name").is_none(), "{ranking}");
    assert_eq!(f.json("out/query.json.run.json")["inputs"]["edits"], json!(gs_io::hash_file(&file).unwrap()));
    // Scores count them too, and the report, which shows the instances as they were found, leaves such scores out.
    f.good("score", &format!("{SCORE}|--edits|{{}}/instances.edits.json"));
    fs::rename(f.path().join("score.json"), f.run().join("score.json")).unwrap();
    fs::rename(f.path().join("score.json.run.json"), f.run().join("score.json.run.json")).unwrap();
    f.good("report", REPORT);
    assert!(f.json("metrics.json")["skipped"].to_string().contains("score.json is of other instances"));

    write(&hash(&f), &json!([{"op": "split", "instance": 2}]));
    f.bad("query", &question, &["instances.edits.json: edits[0].instance: the instance has no parts; found 2"]);
    write("0123456789abcdef", &edits);
    let e = "instances.edits.json: instances: edits of other instances; found 0123456789ab, expected ";
    f.bad("query", &question, &[e, "make them again in explore"]);
}
