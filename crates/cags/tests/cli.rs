//! `cags` as people run it, installed alone: from another folder, with nothing of the repository there.

use std::path::Path;
use std::process::{Command, Output};

/// Runs `cags` in a folder.
fn cags(folder: &Path, arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_cags")).args(arguments).current_dir(folder).output().unwrap()
}

/// What it says, where it ends well.
fn said(folder: &Path, arguments: &[&str]) -> String {
    let output = cags(folder, arguments);
    let text = String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned();
    assert!(output.status.success(), "{arguments:?}: {text}");
    text
}

/// What it says, where it refuses.
fn refused(folder: &Path, arguments: &[&str]) -> String {
    let output = cags(folder, arguments);
    let text = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(2), "{arguments:?}: {text}");
    text
}

#[test]
fn a_program_is_found_by_its_name_and_by_short_words() {
    let dir = tempfile::tempdir().unwrap();
    let here = dir.path();
    let long = said(here, &["gs-geom", "train", "--help"]);
    assert!(long.contains("--iterations") && long == said(here, &["train", "--help"]));
    assert_eq!(said(here, &["graph-precompute", "--help"]), said(here, &["graph", "--help"]));
    let help = said(here, &["--help"]);
    for word in ["run", "train", "query", "cluster-match", "models"] {
        assert!(help.lines().any(|l| l.trim_start().starts_with(&format!("{word} "))), "{word}: {help}");
    }
    assert!(refused(here, &["nonsense"]).contains("unrecognized subcommand"));
    said(here, &["--generate", "bash", "."]);
    let completions = std::fs::read_to_string(here.join("cags.bash")).unwrap();
    assert!(completions.contains("--iterations") && completions.contains("synth-scene"));
}

#[test]
fn settings_are_checked_first() {
    let dir = tempfile::tempdir().unwrap();
    let here = dir.path();
    assert!(refused(here, &["run", "none", "-o", "out"]).contains("none: no such file or folder"));
    std::fs::create_dir(here.join("photographs")).unwrap();
    assert!(refused(here, &["run", "photographs", "-o", "out", "QUALTY=fast"]).contains("QUALITY"));
    assert!(!here.join("out").exists());
    assert!(refused(here, &["run", "photographs", "-o", "out"]).contains("models: no SAM model"));
}

#[test]
fn photographs_become_answers_with_one_program() {
    let dir = tempfile::tempdir().unwrap();
    let here = dir.path();
    let clip = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../testdata/clip-tiny");
    let clip = clip.canonicalize().unwrap().display().to_string();
    let clip = clip.as_str();
    said(here, &["synth-scene", "--out", "photos", "--size", "tiny", "--quiet"]);
    let clip_setting = format!("CLIP={clip}");
    let run =
        ["run", "photos", "-o", "out", "ITERATIONS=60", "MASKS=photos/language_features", &clip_setting, "--quiet"];
    said(here, &run);
    assert!(here.join("out/report.html").is_file() && !here.join("out/features.safetensors").exists());
    assert!(here.join("out/instances.ply").is_file());
    // Nothing is made twice.
    let made = |file: &str| std::fs::metadata(here.join("out").join(file)).unwrap().modified().unwrap();
    let before = (made("geometry.ply"), made("report.html"));
    said(here, &run);
    assert_eq!(before, (made("geometry.ply"), made("report.html")));
    // The run knows its scene, its Gaussians and its words.
    let answer = said(here, &["query", "--run-dir", "out", "--text", "red mug", "--out", "mug"]);
    assert!(answer.contains("--scene") && answer.contains("--clip"), "{answer}");
    assert!(here.join("mug/query.json").is_file());
    // Everything has a name: the everyday words, and then those of a list.
    assert!(here.join("out/names.json").is_file());
    std::fs::write(here.join("words.txt"), "mug\nfloor\nwall\n").unwrap();
    let there = said(here, &["inventory", "--run-dir", "out", "--vocabulary", "words.txt", "--out", "few.json"]);
    assert!(there.contains("things by 3 names") && there.contains(" x "), "{there}");
    said(here, &["features", "--run-dir", "out", "--out", "out/features.safetensors", "--quiet"]);
    let again = said(here, &["cluster", "--run-dir", "out", "--cluster", "free", "--out", "free.safetensors"]);
    assert!(again.contains("from out: --scene") && again.contains("--features out/features.safetensors"), "{again}");
    said(here, &["report", "--run-dir", "out", "--holdout", "0", "--out", "page.html", "--quiet"]);
    // A splat of any format instead of stage 1, up to the objects taken from it.
    for format in ["spz", "compressed.ply", "splat", "glb"] {
        let (splat, out) = (format!("mine.{format}"), format!("out-{format}"));
        said(here, &["convert", "out/geometry.ply", &splat, "--quiet"]);
        let setting = format!("GEOMETRY={splat}");
        said(here, &["run", "photos", "-o", &out, &setting, "MASKS=photos/language_features", "--quiet"]);
        said(
            here,
            &["export", "objects", "--run-dir", &out, "--only", "0", "--out", &format!("objects-{format}"), "--quiet"],
        );
        let inspected = said(here, &["inspect", &format!("{out}/instances.ply")]);
        assert!(inspected.contains("gaussians") && here.join(&out).join("report.html").is_file(), "{inspected}");
    }
    let tables = said(here, &["export", "objects", "--run-dir", "out", "--format", "spz", "--out", "objects"]);
    assert!(tables.contains("--instances out/instances.safetensors"), "{tables}");
}
