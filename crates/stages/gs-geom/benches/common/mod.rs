//! What the benchmarks share: settings from the environment, runs of the program, and medians.

use serde_json::Value;
use std::path::Path;
use std::process::Command;

/// An environment variable, or a default; a list has commas.
pub fn setting(name: &str, default: &str) -> String {
    std::env::var(name).ok().filter(|v| !v.is_empty()).unwrap_or_else(|| default.into())
}

/// The numbers of [`setting`].
pub fn numbers(name: &str, default: &str) -> Result<Vec<u32>, String> {
    let text = setting(name, default);
    text.split(',').map(|v| v.trim().parse().map_err(|_| format!("{name}: not a number: {v}"))).collect()
}

/// The record of `gs-geom train` with these options: an earlier one where the output is there.
pub fn train(scene: &Path, out: &Path, options: &[&str]) -> Result<Value, String> {
    let record = out.with_extension("ply.run.json");
    if !record.exists() {
        let program = std::env::var_os("GS_GEOM").unwrap_or(env!("CARGO_BIN_EXE_gs-geom").into());
        let mut command = Command::new(program);
        command.args(["train", "--quiet", "--checkpoint-every", "100000000"]).args(options);
        let output = command.arg("--scene").arg(scene).arg("--out").arg(out).output().map_err(|e| e.to_string())?;
        if !output.status.success() {
            return Err(String::from_utf8_lossy(&output.stderr).into_owned());
        }
    }
    let bytes = std::fs::read(record).map_err(|e| e.to_string())?;
    serde_json::from_slice(&bytes).map_err(|e| e.to_string())
}

/// Least, median and greatest.
pub fn summary(mut values: Vec<f64>) -> [f64; 3] {
    values.sort_by(f64::total_cmp);
    let n = values.len();
    if n == 0 {
        return [f64::NAN; 3];
    }
    [values[0], (values[(n - 1) / 2] + values[n / 2]) / 2.0, values[n - 1]]
}

/// Writes a file and the folders above it.
pub fn write(path: &Path, text: &str) -> Result<(), String> {
    gs_io::write_bytes(path, text.as_bytes()).map_err(|e| e.to_string())
}
