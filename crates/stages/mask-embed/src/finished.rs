//! What is done already: beside each output of a view lies a small JSON file, its note, which says what the output was made
//! from. A view whose note says the same as this run would, and whose output is as it was written, is not made again.

use gs_io::{Error, ErrorKind, IoContext, Result, hash_bytes, hash_file, write_json};
use gs_scene::dataset::View;
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use serde_json::{Value, json};
use stage::{Progress, Stage};
use std::path::{Path, PathBuf};

/// The note beside an output.
#[derive(Serialize, Deserialize)]
struct Note<T> {
    /// Hash of everything that shaped the output: program, parameters, models, photograph.
    made_from: String,
    /// Content hash of the output.
    hash: String,
    /// Facts of the output for the manifest.
    facts: T,
    /// Whether the output is being written anew, and may be that already.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    begun: bool,
}

/// One hash for all that shapes an output.
pub(crate) fn made_from(parts: &[&str]) -> String {
    let program = concat!("mask-embed ", env!("CARGO_PKG_VERSION"));
    hash_bytes(format!("{program}\n{}", parts.join("\n")).as_bytes())
}

/// Where the note of an output lies.
pub(crate) fn note_path(output: &Path) -> PathBuf {
    output.with_extension("json")
}

/// The note of an output, whatever the output is now.
fn any<T: DeserializeOwned>(output: &Path) -> Option<Note<T>> {
    serde_json::from_slice(&std::fs::read(note_path(output)).ok()?).ok()
}

/// The note of an output that is as it was written.
fn read<T: DeserializeOwned>(output: &Path) -> Option<Note<T>> {
    any(output).filter(|note: &Note<T>| hash_file(output).is_ok_and(|hash| hash == note.hash))
}

/// The note of an output that need not be made again.
fn find<T: DeserializeOwned>(output: &Path, made_from: &str) -> Option<Note<T>> {
    read(output).filter(|note| note.made_from == made_from)
}

/// Whether an output, or a note, is of this program: a note says so of an output that is as it was written, is being written, or is
/// gone.
pub(crate) fn is_own(path: &Path) -> bool {
    let output = path.with_extension("npy");
    let of = |note: Note<Value>| note.begun || !output.exists() || hash_file(&output).is_ok_and(|h| h == note.hash);
    any(path).is_some_and(of)
}

/// The facts of an output that is as it was written, whatever it was made from.
pub(crate) fn facts<T: DeserializeOwned>(output: &Path) -> Option<T> {
    read(output).map(|note| note.facts)
}

/// Whether an output need not be made again.
pub(crate) fn is_done(output: &Path, made_from: &str) -> bool {
    find::<Value>(output, made_from).is_some()
}

/// Writes the note of an output that has just been written.
fn write<T: Serialize>(output: &Path, made_from: &str, facts: T) -> Result<Note<T>> {
    let note = Note { made_from: made_from.to_string(), hash: hash_file(output)?, facts, begun: false };
    write_json(note_path(output), &note)?;
    Ok(note)
}

/// The views of a scene, one after the other.
pub(crate) struct Views<'a> {
    stage: &'a Stage,
    progress: Progress<'a>,
    /// Hash and facts of each view's output, for the manifest.
    pub listed: serde_json::Map<String, Value>,
    /// Views whose outputs were there already.
    kept: usize,
}

impl<'a> Views<'a> {
    pub fn new(stage: &'a Stage, count: usize) -> Self {
        let progress = stage.progress("views", count as u64);
        Self { stage, progress, listed: serde_json::Map::new(), kept: 0 }
    }

    /// The facts of a view's output, which `make` writes unless it is done already.
    pub fn next<T: Serialize + DeserializeOwned>(
        &mut self,
        view: &View,
        output: &Path,
        made_from: &str,
        make: impl FnOnce() -> Result<T>,
    ) -> Result<T> {
        if self.stage.interrupted() {
            let what = "interrupted; the finished views stay, and the same command continues with the next";
            return Err(Error::of(ErrorKind::Interrupted, what));
        }
        let done = find::<T>(output, made_from);
        self.kept += usize::from(done.is_some());
        let note = done.map_or_else(|| write(output, made_from, make()?), Ok)?;
        self.listed.insert(view.stem().to_string(), json!({ "hash": note.hash, "facts": note.facts }));
        self.progress.step();
        Ok(note.facts)
    }

    /// Ends the progress; says of how many views the outputs, called `what`, were there already.
    pub fn finish(self, what: &str) -> serde_json::Map<String, Value> {
        self.progress.finish(&[]);
        if self.kept > 0 {
            self.stage.skipped(&format!("{} of {} views: their {what} are done already", self.kept, self.listed.len()));
        }
        self.listed
    }
}

/// Comes right before an output is written: removes the manifest that describes it, and notes whose the output is.
pub(crate) fn begin(manifest: &Path, output: &Path) -> Result<()> {
    remove_manifest(manifest)?;
    let none = Note { made_from: String::new(), hash: String::new(), facts: Value::Null, begun: true };
    // What is there stays good until it is replaced.
    write_json(note_path(output), &any(output).map_or(none, |note| Note { begun: true, ..note }))
}

/// Removes the manifest before an output that it describes changes; it is written again last of all.
pub(crate) fn remove_manifest(path: &Path) -> Result<()> {
    match std::fs::remove_file(path) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(e).at("replace", path),
        _ => Ok(()),
    }
}
