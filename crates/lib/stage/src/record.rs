//! The record of a run, beside its output.

use crate::Machine;
use gs_io::{Error, IoContext, Result, Written, hash_file, record_path};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::OnceLock;

/// What `<output>.run.json` says.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunRecord {
    /// The program's name.
    pub program: String,
    /// The program's version.
    pub version: String,
    /// The git revision it was built from: the commit that was checked out then, or `unknown`.
    pub revision: String,
    /// Hash of the program's file: which program it was exactly, whatever had changed since the revision.
    pub program_hash: String,
    /// The command line, without the program.
    pub arguments: Vec<String>,
    /// Parameters of the run.
    pub parameters: Value,
    /// Content hashes of the inputs, by role.
    pub inputs: BTreeMap<String, String>,
    /// Seed of every random choice.
    pub seed: u64,
    /// Worker threads used.
    pub threads: usize,
    /// The machine.
    pub machine: Machine,
    /// When the run began, in seconds since 1970.
    pub started: u64,
    /// Wall-clock seconds from start to record.
    pub wall_seconds: f64,
    /// Processor time of all threads in seconds, where the system tells.
    pub cpu_seconds: Option<f64>,
    /// Peak resident memory in bytes, where the system tells.
    pub peak_rss_bytes: Option<u64>,
    /// What it was forecast to be at the start.
    pub memory_predicted_bytes: Option<u64>,
    /// What was skipped because the scene does not need it.
    pub skipped: Vec<String>,
    /// Figures of the result, such as the number of Gaussians.
    pub summary: Value,
    /// Which files the run wrote: they may be replaced by the same command, and by no other.
    pub written: Written,
}

impl RunRecord {
    /// Where the record of `output` lies: `<output>.run.json`.
    pub fn path(output: impl AsRef<Path>) -> PathBuf {
        record_path(output)
    }

    /// Reads the record of `output`.
    pub fn read(output: impl AsRef<Path>) -> Result<Self> {
        let path = Self::path(output);
        let bytes = std::fs::read(&path).at("read", &path)?;
        serde_json::from_slice(&bytes).map_err(|e| Error::new(format!("not a record of a run: {e}")).file(&path))
    }
}

/// Hash of the running program's file; empty where it cannot be read.
pub(crate) fn program_hash() -> String {
    static HASH: OnceLock<String> = OnceLock::new();
    HASH.get_or_init(|| std::env::current_exe().ok().and_then(|p| hash_file(p).ok()).unwrap_or_default()).clone()
}

/// Processor time of this process so far in seconds, where the system tells (Linux, with its 100 ticks a second).
pub fn cpu_seconds() -> Option<f64> {
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    // After the name in parentheses, which may hold anything, user and system time are fields 12 and 13.
    let fields: Vec<f64> = stat.rsplit(')').next()?.split_whitespace().map(|f| f.parse().unwrap_or(0.0)).collect();
    Some((fields.get(11)? + fields.get(12)?) / 100.0)
}

/// Peak resident memory of this process in bytes, where the system tells (Linux).
pub fn peak_rss_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|l| l.strip_prefix("VmHWM:"))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok().map(|kb| kb * 1024)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Stage;
    use gs_io::write_bytes;

    #[test]
    fn a_record_says_what_ran_where_and_when() {
        let dir = tempfile::tempdir().unwrap();
        let out = dir.path().join("a.ply");
        let stage = Stage::silent("gs-geom");
        stage.skipped("3 of 10 Gaussians: never seen");
        let mut claim = stage.outputs(&out).file(&out).claim().unwrap();
        write_bytes(&out, b"Gaussians").unwrap();
        let summary = serde_json::json!({"gaussians": 7});
        stage.record(&mut claim, serde_json::json!({"k": 1}), BTreeMap::new(), summary).unwrap();
        let r = RunRecord::read(&out).unwrap();
        assert_eq!(r.program, "gs-geom");
        assert_eq!((r.written.by.as_str(), r.written.files.len()), ("gs-geom", 1));
        assert_eq!(r.skipped, ["3 of 10 Gaussians: never seen"]);
        assert!(r.wall_seconds >= 0.0 && r.peak_rss_bytes.is_none_or(|b| b > 1 << 18));
        assert!(RunRecord::read(dir.path().join("b")).is_err());
        assert_eq!((r.revision.as_str(), r.program_hash.len()), (crate::REVISION, 64), "{r:?}");
        assert!(crate::REVISION == "unknown" || crate::REVISION.len() >= 7);
        assert!(r.machine == Machine::here() && r.started > 1_700_000_000);
        assert_eq!(r.arguments, std::env::args().skip(1).collect::<Vec<_>>());
        assert!(r.cpu_seconds.is_some() || !cfg!(target_os = "linux"));
    }
}
