//! The program on artifacts on disk: both methods, the same bytes for any thread count and after a kill, bad input.

use artifacts::{Features, FootprintsBuilder, Graph, PixelSamples, Row, role};
use gs_io::{Provenance, hash_file};
use gs_scene::{Gaussians, ply};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

/// Gaussians on a line: three things of 40 each; every view shows three masks, the middle thing sometimes in halves.
const N: usize = 120;
const VIEWS: usize = 12;

fn gaussians() -> Gaussians {
    Gaussians {
        means: (0..N).map(|i| [i as f32, 0.0, 0.0]).collect(),
        log_scales: vec![[0.0; 3]; N],
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; N],
        opacity_logits: vec![2.0; N],
        sh: (0..3 * N).map(|i| ((i * 7) % 5) as f32 * 0.2).collect(),
        sh_degree: 0,
        ..Gaussians::default()
    }
}

fn write(dir: &Path, gaussians: &Gaussians, graph: &Graph) {
    write_with(dir, gaussians, graph, footprints());
}

fn write_with(dir: &Path, gaussians: &Gaussians, graph: &Graph, footprints: FootprintsBuilder) {
    let geometry = dir.join("geometry.ply");
    ply::write_gaussians(&geometry, gaussians, &[]).unwrap();
    let inputs = BTreeMap::from([
        (role::GEOMETRY.to_string(), hash_file(&geometry).unwrap()),
        (role::MASKS.to_string(), "ab".repeat(32)),
    ]);
    let provenance = Provenance { inputs, ..Provenance::default() };
    graph.write(dir.join("graph.safetensors"), provenance.clone()).unwrap();
    footprints.write(dir.join("footprints.safetensors"), provenance).unwrap();
}

fn graph() -> Graph {
    let near = |i: usize, of: &[usize]| -> [u32; 4] {
        let mut all: Vec<usize> = (0..of.len()).filter(|&j| of[j] != i).collect();
        all.sort_by_key(|&j| (of[j].abs_diff(i), j));
        std::array::from_fn(|k| all[k] as u32)
    };
    let everyone: Vec<usize> = (0..N).collect();
    let anchors: Vec<usize> = (0..N).step_by(8).collect();
    Graph {
        kept: (0..N as u32).collect(),
        anchors: anchors.iter().map(|&a| a as u32).collect(),
        knn: anchors.iter().map(|&a| near(a, &everyone)).collect::<Vec<_>>().into(),
        anchor_knn: anchors.iter().map(|&a| near(a, &anchors)).collect::<Vec<_>>().into(),
        nearest_anchor: (0..N).map(|i| (((i + 3) / 8) as u32).min(anchors.len() as u32 - 1)).collect(),
        gaussian_knn: everyone.iter().map(|&i| near(i, &everyone)).collect::<Vec<_>>().into(),
        seen_views: vec![1; N],
        seen_weight: vec![1.0; N],
    }
}

fn footprints() -> FootprintsBuilder {
    let pixels = PixelSamples { ptr: vec![0], ..PixelSamples::default() };
    let mut f = FootprintsBuilder { kept: (0..N as u32).collect(), pixels, ..FootprintsBuilder::default() };
    for v in 0..VIEWS {
        f.views.push(format!("v{v}"));
        let cuts: &[u32] = if v % 3 == 0 { &[0, 40, 60, 80, 120] } else { &[0, 40, 80, 120] };
        for (k, w) in cuts.windows(2).enumerate() {
            // Four pixels of each mask, each showing three Gaussians.
            for first in (w[0]..w[1] - 3).step_by(((w[1] - w[0]) / 4) as usize).take(4) {
                f.pixels.row.push(f.rows.len() as u32);
                f.pixels.col.extend(first..first + 3);
                f.pixels.weight.extend([0.5, 0.2, 0.1]);
                f.pixels.ptr.push(f.pixels.col.len() as u64);
            }
            let row = Row { view: v as u32, level: 3, mask: k as u32, pixels: 100, gated: 90, alpha: 0.9 };
            f.push(row, (w[0]..w[1]).map(|i| (i, 1.0 + (i % 3) as f32)));
        }
    }
    f
}

fn command(dir: &Path, out: &Path, extra: &[&str]) -> Command {
    let mut c = Command::new(env!("CARGO_BIN_EXE_feat-train"));
    for name in ["geometry.ply", "graph.safetensors", "footprints.safetensors"] {
        let option = format!("--{}", name.split('.').next().unwrap());
        c.arg(option).arg(dir.join(name));
    }
    c.arg("--out").arg(out).args(extra);
    c
}

fn run(dir: &Path, out: &Path, extra: &[&str]) -> Output {
    command(dir, out, extra).output().unwrap()
}

fn succeed(dir: &Path, out: &Path, extra: &[&str]) -> Vec<u8> {
    let output = run(dir, out, extra);
    assert!(output.status.success(), "{extra:?}: {}", String::from_utf8_lossy(&output.stderr));
    std::fs::read(out).unwrap()
}

fn beside(out: &Path, suffix: &str) -> PathBuf {
    PathBuf::from(format!("{}{suffix}", out.display()))
}

/// What the points of the curve say of `key`.
fn curve(out: &Path, key: &str) -> Vec<f64> {
    let text = std::fs::read_to_string(beside(out, ".curve.jsonl")).unwrap();
    let point = |line: &str| serde_json::from_str::<serde_json::Value>(line).unwrap()[key].as_f64().unwrap();
    text.lines().map(point).collect()
}

fn setup() -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path(), &gaussians(), &graph());
    let out = dir.path().join("features.safetensors");
    (dir, out)
}

/// graph-precompute leaves damaged Gaussians out; this stage says so, and what it makes of the others is the same.
#[test]
fn damaged_gaussians_change_nothing() {
    let (dir, out) = setup();
    let options = ["--preset", "literal", "--iterations", "100"];
    succeed(dir.path(), &out, &options);
    let values = || Features::read(&out).unwrap().0.values;
    let before = values();
    let rows: Vec<u32> = (0..N as u32).chain([0, 1]).collect();
    let mut g = gaussians().select(&rows);
    (g.sh[3 * N], g.means[N + 1][2]) = (f32::NAN, f32::INFINITY);
    write(dir.path(), &g, &Graph { seen_views: vec![1; N + 2], seen_weight: vec![1.0; N + 2], ..graph() });
    let output = run(dir.path(), &out, &options);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && said.contains("skipped 2 of 122 Gaussians: damaged"), "{said}");
    assert_eq!(values(), before);
}

#[test]
fn the_closed_form_tells_things_apart_and_not_their_halves() {
    let (dir, out) = setup();
    let first = succeed(dir.path(), &out, &["--threads", "1"]);
    assert!(first == succeed(dir.path(), &out, &["--threads", "2"]));
    let (f, _) = Features::read(&out).unwrap();
    let cosine = |a: usize, b: usize| f.row(a).iter().zip(f.row(b)).map(|(a, b)| a * b).sum::<f32>();
    assert!(cosine(5, 35) > 0.95 && cosine(85, 115) > 0.95, "{} {}", cosine(5, 35), cosine(85, 115));
    assert!(cosine(45, 75) > 0.8, "the halves of a thing stay together: {}", cosine(45, 75));
    assert!(cosine(5, 60) < 0.3 && cosine(60, 115) < 0.3 && cosine(5, 115) < 0.3);
    assert!(curve(&out, "iteration")[0] == 1.0 && curve(&out, "singular_value")[0] > 0.9);
}

#[test]
fn training_separates_masks_and_does_not_depend_on_threads() {
    let (dir, out) = setup();
    for variant in [
        &["literal"][..],
        &["literal", "--loss", "gaussian"],
        &["paper", "--layers", "0"],
        &["paper", "--loss", "pixel", "--cohesion", "0.1"],
    ] {
        let with = |threads| {
            let args = ["--iterations", "300", "--seed", "4", "--threads", threads, "--preset"];
            succeed(dir.path(), &out, &[&args[..], variant].concat())
        };
        assert!(with("1") == with("2"), "{variant:?}");
        let [loss, separation] = ["loss", "separation"].map(|key| curve(&out, key));
        assert_eq!(loss.len(), 6);
        assert!(loss[5] < loss[0], "{variant:?} {loss:?}");
        assert!(separation[5] > separation[0], "{variant:?} {separation:?}");
        assert!(!beside(&out, ".checkpoint").exists());
        let picture = std::fs::read_to_string(beside(&out, ".curve.svg")).unwrap();
        assert_eq!(picture.matches("<polyline").count(), 4, "loss, alignment, separation, rate: {picture}");
    }
}

/// docs/method.md says which command line makes each row of the paper's ablation tables: all of them train.
#[test]
fn every_row_of_the_ablation_tables_trains() {
    let (dir, out) = setup();
    let docs = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../docs/method.md")).unwrap();
    let section = docs.split("## The paper's ablation tables").nth(1).unwrap().split("\n## ").next().unwrap();
    let rows: Vec<&str> = section.lines().filter_map(|l| l.split("`--").nth(1)).collect();
    assert_eq!(rows.len(), 5 + 4 + 1, "{section}");
    let lines = rows.iter().map(|row| format!("--{}", row.split('`').next().unwrap()));
    let (layers, mut lines): (Vec<String>, Vec<String>) = lines.partition(|l| l.ends_with("COUNT"));
    lines.extend((0..=4).map(|count: u32| layers[0].replace("COUNT", &count.to_string())));
    let mut outputs = BTreeMap::new();
    for line in lines {
        let args: Vec<&str> = line.split(' ').chain(["--iterations", "200"]).collect();
        succeed(dir.path(), &out, &args);
        let losses = curve(&out, "loss");
        assert!(losses[losses.len() - 1] < losses[0], "{line}: {losses:?}");
        let values: Vec<u32> = Features::read(&out).unwrap().0.values.iter().map(|v| v.to_bits()).collect();
        outputs.insert(line, values);
    }
    // The full method has two names; all else differs.
    let distinct: BTreeSet<_> = outputs.values().collect();
    assert_eq!((outputs.len(), distinct.len()), (13, 13 - 1));
}

/// Killed at once, or interrupted, after which it writes a last checkpoint.
#[test]
fn a_stopped_run_continues_to_the_same_bytes() {
    let (dir, out) = setup();
    let args = ["--preset", "literal", "--iterations", "6000"];
    let whole = succeed(dir.path(), &out, &args);
    let curve = std::fs::read(beside(&out, ".curve.jsonl")).unwrap();
    let checkpoint = beside(&out, ".checkpoint");
    let says = |word: &str| {
        let output = run(dir.path(), &out, &args);
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(said.contains(word), "{said}");
        assert!(whole == std::fs::read(&out).unwrap());
        assert!(curve == std::fs::read(beside(&out, ".curve.jsonl")).unwrap());
    };
    let mut unfinished = Vec::new();
    for (signal, code) in [("-KILL", None), ("-TERM", Some(130))] {
        std::fs::remove_file(&out).unwrap();
        let mut child = command(dir.path(), &out, &args).stderr(Stdio::null()).spawn().unwrap();
        let started = Instant::now();
        while !checkpoint.exists() {
            assert!(started.elapsed() < Duration::from_secs(60), "no checkpoint comes");
            std::thread::sleep(Duration::from_millis(2));
        }
        assert!(Command::new("kill").args([signal, &child.id().to_string()]).status().unwrap().success());
        assert_eq!(child.wait().unwrap().code(), code);
        assert!(!out.exists(), "the run ended before it could be stopped");
        unfinished = std::fs::read(&checkpoint).unwrap();
        says("continuing from iteration");
    }
    // A damaged checkpoint is not used.
    let middle = unfinished.len() / 2;
    unfinished[middle] ^= 1;
    std::fs::write(&checkpoint, &unfinished).unwrap();
    says("starting anew");
}

#[test]
fn bad_input_is_one_line_and_leaves_the_output_alone() {
    let (dir, out) = setup();
    std::fs::write(&out, "good").unwrap();
    let fail = |extra: &[&str], needles: &[&str]| {
        let output = run(dir.path(), &out, &[extra, &["--overwrite"]].concat());
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(2), "{said}");
        for needle in needles {
            assert!(said.contains(needle), "{needle:?} is not in {said:?}");
        }
        assert!(!said.contains("panicked"), "{said}");
        assert_eq!(std::fs::read(&out).unwrap(), b"good");
    };
    fail(&["--preset", "paper", "--layers", "5"], &["--layers", "'5'", "0 to 4"]);
    fail(&["--cohesion=-1"], &["--cohesion"]);
    fail(&["--preset", "paper", "--dim", "65"], &["--dim", "65"]);
    fail(&["--loss", "pixel"], &["--preset"]);
    // The same without a file to read.
    let nowhere = dir.path().join("nowhere");
    let check = |extra: &[&str]| run(&nowhere, &out, &[extra, &["--check"]].concat());
    for (wrong, needle) in [
        (&["--cohesion=-1"][..], "--cohesion"),
        (&["--preset", "paper", "--dim", "65"], "2 to 64"),
        (&["--levles", "small"], "--levles"),
    ] {
        let output = check(wrong);
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.code() == Some(2) && said.contains(needle), "{said}");
    }
    let output = check(&["--levels", "small"]);
    assert!(output.status.success() && output.stderr.is_empty() && std::fs::read(&out).unwrap() == b"good");
    fail(&["--levels", "small"], &["footprints.safetensors", "no mask has a footprint"]);
    fail(&["--preset", "paper", "--levels", "small"], &["footprints.safetensors", "two masks"]);
    // Footprints of another run: one Gaussian less.
    let (_, graph_file) = Graph::read(dir.path().join("graph.safetensors")).unwrap();
    let provenance = || Provenance { inputs: graph_file.provenance().inputs.clone(), ..Provenance::default() };
    let path = dir.path().join("footprints.safetensors");
    let without = FootprintsBuilder { pixels: PixelSamples::default(), ..footprints() };
    without.write(&path, provenance()).unwrap();
    fail(&["--preset", "paper", "--loss", "pixel"], &["footprints.safetensors", "pixel_row", "--pixel-samples"]);
    let mut other = footprints();
    other.kept.push(N as u32);
    other.write(&path, provenance()).unwrap();
    fail(&[], &["footprints.safetensors", "kept", "found 121 Gaussians", "expected 120"]);
    other.kept.remove(N - 1);
    other.write(&path, provenance()).unwrap();
    fail(&[], &["footprints.safetensors", "kept", "found Gaussian 120", "expected 119"]);
    let mut foreign = provenance();
    foreign.inputs.insert(role::MASKS.into(), "cd".repeat(32));
    footprints().write(&path, foreign).unwrap();
    fail(&[], &["footprints.safetensors", "another masks"]);
    let bytes = std::fs::read(&path).unwrap();
    std::fs::write(&path, &bytes[..bytes.len() - 9]).unwrap();
    fail(&[], &["footprints.safetensors"]);
    std::fs::write(dir.path().join("geometry.ply"), "ply\n").unwrap();
    fail(&[], &["graph.safetensors", "another geometry"]);
}
