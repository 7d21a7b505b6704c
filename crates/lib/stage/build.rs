//! Finds the git revision that the programs are built from.

use std::process::Command;

/// What git says, if this source is in a git repository of its own.
fn git(arguments: &[&str]) -> Option<String> {
    let output = Command::new("git").args(arguments).stderr(std::process::Stdio::null()).output().ok()?;
    let text = String::from_utf8(output.stdout).ok()?;
    output.status.success().then(|| text.trim().to_string()).filter(|t| !t.is_empty())
}

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-env-changed=CAGS_REVISION");
    let given = std::env::var("CAGS_REVISION").ok().filter(|r| !r.is_empty());
    // A source archive unpacked within another project has that project's git around it, which does not know this file.
    let ours = || git(&["ls-files", "--error-unmatch", "build.rs"]);
    let revision = given.or_else(|| ours().and_then(|_| git(&["rev-parse", "--short=12", "HEAD"])));
    // Not with every commit, which would compile every program again: a build of a clean checkout has its own commit, one that
    // goes on has that of the last change to this crate, and the hash of the program tells the rest.
    println!("cargo::rustc-env=CAGS_REVISION={}", revision.as_deref().unwrap_or("unknown"));
}
