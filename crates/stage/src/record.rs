//! The record of a run, beside its output.

use gs_io::{Error, IoContext, Result, write_bytes};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// What `<output>.run.json` says.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunRecord {
    /// The program's name.
    pub program: String,
    /// The program's version.
    pub version: String,
    /// Parameters of the run.
    pub parameters: Value,
    /// Content hashes of the inputs, by role.
    pub inputs: BTreeMap<String, String>,
    /// Seed of every random choice.
    pub seed: u64,
    /// Worker threads used.
    pub threads: usize,
    /// Wall-clock seconds from start to record.
    pub wall_seconds: f64,
    /// Peak resident memory in bytes, where the system tells.
    pub peak_rss_bytes: Option<u64>,
    /// What was skipped because the scene does not need it.
    pub skipped: Vec<String>,
    /// Figures of the result, such as the number of Gaussians.
    pub summary: Value,
}

impl RunRecord {
    /// Where the record of `output` lies: `<output>.run.json`.
    pub fn path(output: impl AsRef<Path>) -> PathBuf {
        let mut name = output.as_ref().as_os_str().to_owned();
        name.push(".run.json");
        name.into()
    }

    /// Reads the record of `output`.
    ///
    /// # Errors
    /// When it is missing or not such a record.
    pub fn read(output: impl AsRef<Path>) -> Result<Self> {
        let path = Self::path(output);
        let bytes = std::fs::read(&path).at("read", &path)?;
        serde_json::from_slice(&bytes).map_err(|e| Error::new(format!("not a record of a run: {e}")).file(&path))
    }

    pub(crate) fn write(&self, output: impl AsRef<Path>) -> Result<()> {
        let path = Self::path(output);
        let json = serde_json::to_vec_pretty(self).map_err(|e| Error::new(e.to_string()).file(&path))?;
        write_bytes(path, &json)
    }
}

/// Processor time of this process so far in seconds, where the system tells (Linux, with its 100 ticks a second).
pub fn cpu_seconds() -> Option<f64> {
    ticks(11)
}

/// The same of those that this process started and that have ended.
pub fn children_cpu_seconds() -> Option<f64> {
    ticks(13)
}

/// Seconds of user and system time from two fields of the process's state, counted after its name in parentheses, which may
/// hold anything.
fn ticks(user: usize) -> Option<f64> {
    let stat = std::fs::read_to_string("/proc/self/stat").ok()?;
    let fields: Vec<f64> = stat.rsplit(')').next()?.split_whitespace().map(|f| f.parse().unwrap_or(0.0)).collect();
    Some((fields.get(user)? + fields.get(user + 1)?) / 100.0)
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

    #[test]
    fn a_record_reads_back() {
        let dir = tempfile::tempdir().unwrap();
        let out = dir.path().join("a.ply");
        let stage = Stage::silent("gs-geom");
        stage.skipped("3 of 10 Gaussians: never seen");
        stage.record(&out, serde_json::json!({"k": 1}), BTreeMap::new(), serde_json::json!({"gaussians": 7})).unwrap();
        let r = RunRecord::read(&out).unwrap();
        assert_eq!(r.program, "gs-geom");
        assert_eq!(r.skipped, ["3 of 10 Gaussians: never seen"]);
        assert!(r.wall_seconds >= 0.0 && r.peak_rss_bytes.is_none_or(|b| b > 1 << 18));
        assert!(RunRecord::read(dir.path().join("b")).is_err());
    }
}
