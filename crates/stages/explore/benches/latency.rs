//! What a click and a text take at a million Gaussians, of one client and of eight, and how large the page is: `cargo bench -p explore --bench latency --
//! RUN OUT [GAUSSIANS]`. RUN is a finished run of the demo, whose Gaussians are cut into smaller ones until they are a million,
//! or so many.

use artifacts::{Instances, role};
use gs_io::{Provenance, hash_file, write_json};
use gs_scene::dataset::{self, LoadOptions};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Instant;

/// Gaussians of the large scene, where nothing else is said.
const GAUSSIANS: usize = 1_000_000;
const CLICKS: usize = 201;
const TEXTS: [&str; 5] = ["green kettle", "pink coffee set", "black laptop", "yellow toy car", "table"];

fn main() {
    let mut arguments = std::env::args().skip(1).filter(|a| a != "--bench").map(PathBuf::from);
    let (Some(run), Some(out)) = (arguments.next(), arguments.next()) else {
        eprintln!("usage: latency RUN OUT [GAUSSIANS]");
        std::process::exit(2);
    };
    let scene = run.join("scene");
    let folder = out.parent().unwrap_or(Path::new(".")).join("explore");
    std::fs::create_dir_all(&folder).unwrap();
    let count = arguments.next().and_then(|a| a.to_str()?.parse().ok()).unwrap_or(GAUSSIANS);
    let large = enlarged(&run, &scene, &folder, count);
    let mut results = Vec::new();
    for run in [run.as_path(), &folder] {
        results.push(measured(run, &scene));
    }
    eprintln!("{large} Gaussians from those of {}", run.display());
    write_json(&out, &results).unwrap();
    eprintln!("{}", serde_json::to_string_pretty(&results).unwrap());
}

/// Cuts every Gaussian into smaller ones near its place, which belong to the same instance.
fn enlarged(run: &Path, scene: &Path, folder: &Path, count: usize) -> usize {
    let mut g = gs_scene::ply::read_gaussians(run.join("geometry.ply")).unwrap();
    let mut instances = Instances::read(run.join("instances.safetensors")).unwrap().0;
    let parts = count.div_ceil(g.len());
    let rows: Vec<u32> = (0..g.len() as u32).flat_map(|i| vec![i; parts]).take(count).collect();
    g = g.select(&rows);
    let mut random = ChaCha8Rng::seed_from_u64(0);
    let smaller = (parts as f32).ln() / 3.0;
    for i in 0..g.len() {
        for k in 0..3 {
            g.means[i][k] += g.log_scales[i][k].exp() * random.random_range(-1.0f32..1.0);
            g.log_scales[i][k] -= smaller;
        }
    }
    instances.label = rows.iter().map(|&i| instances.label[i as usize]).collect();
    instances.node = rows.iter().map(|&i| instances.node[i as usize]).collect();
    let geometry = folder.join("geometry.ply");
    gs_scene::ply::write_gaussians(&geometry, &g, &[]).unwrap();
    let dataset = dataset::load(scene, &LoadOptions::default()).unwrap().hash().unwrap();
    let inputs = [(role::GEOMETRY.to_string(), hash_file(&geometry).unwrap()), (role::DATASET.to_string(), dataset)];
    let provenance = Provenance { inputs: BTreeMap::from(inputs), ..Provenance::default() };
    instances.write(folder.join("instances.safetensors"), provenance).unwrap();
    g.len()
}

fn measured(run: &Path, scene: &Path) -> Value {
    let path = |p: &Path| p.display().to_string();
    let clip = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../testdata/clip-tiny");
    let source = [
        "--run-dir",
        &path(run),
        "--scene",
        &path(scene),
        "--geometry",
        &path(&run.join("geometry.ply")),
        "--clip",
        &path(&clip),
    ]
    .map(String::from);
    let explore = env!("CARGO_BIN_EXE_explore");
    let page = run.join("page.html");
    let started = Instant::now();
    let made = Command::new(explore)
        .arg("page")
        .args(&source)
        .args(["--overwrite", "--quiet", "--out", &path(&page)])
        .status();
    assert!(made.unwrap().success());
    let page_seconds = started.elapsed().as_secs_f64();

    let started = Instant::now();
    let mut server =
        Command::new(explore).arg("serve").args(&source).args(["--port", "0"]).stderr(Stdio::piped()).spawn().unwrap();
    let lines = BufReader::new(server.stderr.take().unwrap()).lines().map_while(Result::ok);
    let host = lines.into_iter().find_map(|l| Some(l.split_once("http://")?.1.split('/').next()?.to_string())).unwrap();
    let start_seconds = started.elapsed().as_secs_f64();
    let ask = |method: &str, path: &str, body: &str| {
        let started = Instant::now();
        let mut stream = TcpStream::connect(&host).unwrap();
        let length = body.len();
        write!(
            stream,
            "{method} {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\nContent-Length: {length}\r\n\r\n{body}"
        )
        .unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).unwrap();
        assert!(answer.starts_with(b"HTTP/1.1 200"), "{path}: {}", String::from_utf8_lossy(&answer));
        (started.elapsed().as_secs_f64(), answer)
    };
    let (json_seconds, answer) = ask("GET", "/scene.json", "");
    let start = answer.windows(4).position(|w| w == b"\r\n\r\n").unwrap() + 4;
    let facts: Value = serde_json::from_slice(&answer[start..]).unwrap();
    let (bytes_seconds, _) = ask("GET", "/scene.bin", "");
    let mut random = ChaCha8Rng::seed_from_u64(1);
    let cameras = facts["cameras"].as_array().unwrap();
    let mut click = || {
        // As a browser asks: the picture of a view on a canvas of 1600 pixels.
        let mut camera = cameras[random.random_range(0..cameras.len())].clone();
        let scale = 1600.0 / camera["width"].as_f64().unwrap();
        for side in ["width", "height"] {
            camera[side] = json!((camera[side].as_f64().unwrap() * scale) as u32);
        }
        for number in ["fx", "fy", "cx", "cy"] {
            camera[number] = json!(camera[number].as_f64().unwrap() * scale);
        }
        let (w, h) = (camera["width"].as_u64().unwrap() as u32, camera["height"].as_u64().unwrap() as u32);
        let at = [random.random_range(0..w), random.random_range(0..h)];
        json!({"camera": camera, "x": at[0], "y": at[1], "hidden": []}).to_string()
    };
    let clicks: Vec<String> = (0..CLICKS).map(|_| click()).collect();
    let all = || clicks.iter().map(|click| ask("POST", "/pick", click).0).collect::<Vec<f64>>();
    // Clicks a second of clients each of which asks again when it has its answer.
    let rate = |clients: usize| {
        let started = Instant::now();
        std::thread::scope(|s| (0..clients).for_each(|_| _ = s.spawn(all)));
        (clients * CLICKS) as f64 / started.elapsed().as_secs_f64()
    };
    let click_seconds = all();
    let rates = [1, 8].map(rate);
    // Clicks while the longest text is encoded, again and again.
    let long = format!("/find?text={}", "a".repeat(1000));
    let (long_seconds, beside) = std::thread::scope(|s| {
        let beside = s.spawn(all);
        let mut long_seconds = Vec::new();
        while !beside.is_finished() {
            long_seconds.push(ask("GET", &long, "").0);
        }
        (long_seconds, beside.join().unwrap())
    });
    let text = |k: usize| ask("GET", &format!("/find?text={}", TEXTS[k % TEXTS.len()].replace(' ', "%20")), "").0;
    let texts: Vec<f64> = (0..CLICKS).map(text).collect();
    server.kill().unwrap();
    server.wait().unwrap();
    let shares = |mut all: Vec<f64>| {
        all.sort_by(f64::total_cmp);
        json!({"median": all[all.len() / 2], "p95": all[all.len() * 95 / 100], "most": all.last()})
    };
    json!({
        "gaussians": facts["gaussians"],
        "instances": facts["instances"].as_array().map(Vec::len),
        "click_seconds": shares(click_seconds),
        "clicks_per_second_of_1_and_8_clients": rates,
        "long_text_seconds": shares(long_seconds),
        "click_beside_long_text_seconds": shares(beside),
        "text_seconds": shares(texts),
        "server_start_seconds": start_seconds,
        "scene_json_seconds": json_seconds,
        "scene_bin_seconds": bytes_seconds,
        "scene_bin_bytes": facts["bytes"],
        "page_file_bytes": std::fs::metadata(&page).unwrap().len(),
        "page_file_seconds": page_seconds,
    })
}
