//! What the tests share: running the program, and a small scene.
#![allow(dead_code, reason = "every test file uses another part")]

pub mod world;

use serde_json::Value;
use std::fs;
use std::path::PathBuf;
use std::process::{Command, Output, Stdio};
use std::time::Duration;

pub fn program(arguments: &[&str]) -> Command {
    let mut c = Command::new(env!("CARGO_BIN_EXE_gs-geom"));
    c.args(arguments);
    c
}

pub fn run(arguments: &[&str]) -> Output {
    program(arguments).output().unwrap()
}

/// Runs to exit code 0; what it printed to standard error.
pub fn succeeds(arguments: &[&str]) -> String {
    let o = run(arguments);
    let said = String::from_utf8_lossy(&o.stderr).into_owned();
    assert!(o.status.success(), "{arguments:?}: {said}");
    said
}

/// Runs to exit code 2 and a single error; what it printed to standard error.
pub fn refused(arguments: &[&str]) -> String {
    let o = run(arguments);
    let said = String::from_utf8_lossy(&o.stderr).into_owned();
    assert_eq!((o.status.code(), said.matches("error: ").count()), (Some(2), 1), "{arguments:?}: {said}");
    assert!(!said.contains("panicked"), "{said}");
    said
}

/// Arguments of a short training that densifies.
pub fn training<'a>(scene: &'a str, out: &'a str, iterations: &'a str, more: &[&'a str]) -> Vec<&'a str> {
    let all = ["train", "--scene", scene, "--out", out, "--iterations", iterations, "--densify-every", "20"];
    [&all, more].concat()
}

/// Starts a training, waits for its first checkpoint, does something to its files, and gives how it ended.
pub fn disturbed(arguments: &[&str], out: &str, disturb: impl FnOnce(&mut std::process::Child)) -> Output {
    let mut child = program(arguments).stderr(Stdio::piped()).spawn().unwrap();
    let checkpoint = PathBuf::from(format!("{out}.checkpoint"));
    for _ in 0..5000 {
        if checkpoint.exists() || child.try_wait().unwrap().is_some() {
            break;
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    disturb(&mut child);
    child.wait_with_output().unwrap()
}

/// Kills a training after its first checkpoint, of those that it makes `every` so many iterations or seconds.
pub fn killed(arguments: &[&str], out: &str, every: &str) {
    disturbed(&[arguments, &["--checkpoint-every", every]].concat(), out, |child| child.kill().unwrap());
    let there = |suffix: &str| PathBuf::from(format!("{out}{suffix}")).exists();
    assert!(there(".checkpoint") && !there(""), "--checkpoint-every {every}: a checkpoint before the end");
}

pub fn json(path: &str) -> Value {
    serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
}

/// The record of a run, beside its output.
pub fn record(out: &str) -> Value {
    json(&format!("{out}.run.json"))
}

pub struct Folder(tempfile::TempDir);

impl Folder {
    pub fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    pub fn path(&self, name: &str) -> String {
        self.0.path().join(name).to_string_lossy().into_owned()
    }

    pub fn names(&self) -> Vec<String> {
        let names = fs::read_dir(self.0.path()).unwrap().map(|e| e.unwrap().file_name().to_string_lossy().into_owned());
        let mut names: Vec<String> = names.collect();
        names.sort();
        names
    }
}
