//! What is already done: beside each output of a view lies a small JSON file that says what it was made from. A view
//! whose file says the same as this run would, and whose output is as it was written, is not made again.

use gs_io::{Error, IoContext, Result, hash_bytes, hash_file, write_bytes};
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use std::path::{Path, PathBuf};

/// The note beside an output.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct Note<T> {
    /// Hash of everything that shaped the output: program, parameters, models, photograph.
    made_from: String,
    /// Content hash of the output.
    pub(crate) hash: String,
    /// Facts of the output for the manifest.
    pub(crate) facts: T,
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

/// The note of an output that needs not be made again.
pub(crate) fn find<T: DeserializeOwned>(output: &Path, made_from: &str) -> Option<Note<T>> {
    let note: Note<T> = serde_json::from_slice(&std::fs::read(note_path(output)).ok()?).ok()?;
    let same = note.made_from == made_from && hash_file(output).ok()? == note.hash;
    same.then_some(note)
}

/// Writes the note of an output that has just been written.
pub(crate) fn write<T: Serialize>(output: &Path, made_from: &str, facts: T) -> Result<Note<T>> {
    let note = Note { made_from: made_from.to_string(), hash: hash_file(output)?, facts };
    write_json(&note_path(output), &note)?;
    Ok(note)
}

/// Writes JSON for people and programs, whole or not at all.
pub(crate) fn write_json(path: &Path, value: &impl Serialize) -> Result<()> {
    let mut bytes = serde_json::to_vec_pretty(value).map_err(|e| Error::new(e.to_string()).file(path))?;
    bytes.push(b'\n');
    write_bytes(path, &bytes)
}

/// Removes the manifest before an output that it describes changes; it is written again last of all.
pub(crate) fn remove_manifest(path: &Path) -> Result<()> {
    match std::fs::remove_file(path) {
        Err(e) if e.kind() != std::io::ErrorKind::NotFound => Err(e).at("replace", path),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_same_inputs_and_an_untouched_output_count_as_done() {
        let dir = tempfile::tempdir().unwrap();
        let out = dir.path().join("v_s.npy");
        let key = made_from(&["a", "b"]);
        assert_ne!(key, made_from(&["a", "c"]));
        std::fs::write(&out, "map").unwrap();
        assert!(find::<u32>(&out, &key).is_none());
        write(&out, &key, 7u32).unwrap();
        assert_eq!(find::<u32>(&out, &key).unwrap().facts, 7);
        assert!(find::<u32>(&out, &made_from(&["a", "c"])).is_none());
        std::fs::write(&out, "cut").unwrap();
        assert!(find::<u32>(&out, &key).is_none());
        std::fs::write(dir.path().join("v_s.json"), "{").unwrap();
        assert!(find::<u32>(&out, &key).is_none());
    }
}
