//! The state of an unfinished run: `<out>.checkpoint`.

use crate::train::CurvePoint;
use gs_io::{Artifact, ArtifactWriter, Error, Provenance, Result};
use std::path::{Path, PathBuf};

pub(crate) const FORMAT: &str = "feat-train-checkpoint";
const VERSION: u32 = 2;
const NAMES: [&str; 6] = ["features", "weights", "mean", "square", "weights_mean", "weights_square"];

/// All that training needs to go on as if it had never stopped.
#[derive(Debug, Clone, PartialEq)]
pub struct Checkpoint {
    /// Iterations done.
    pub iteration: u64,
    /// Sums since the last point of the curve: loss, separation, count.
    pub window: [f64; 3],
    /// Lowest loss of held-out views, and looks since.
    pub settled: [f64; 2],
    /// The curve so far.
    pub curve: Vec<CurvePoint>,
    /// Means and deviations in use, which may be older than the parameters; see `Engine::statistics`.
    pub statistics: Vec<f64>,
    /// Features, network weights, and the optimiser's means and squares of the features and of the weights.
    pub parameters: [Vec<f32>; 6],
}

/// Where the checkpoint of `output` lies.
pub fn path(output: &Path) -> PathBuf {
    gs_io::with_suffix(output, ".checkpoint")
}

/// Writes a checkpoint; `provenance` says which run it is of.
///
/// # Errors
/// When the file cannot be written.
pub fn write(path: &Path, provenance: &Provenance, checkpoint: &Checkpoint) -> Result<()> {
    let curve: Vec<f64> =
        checkpoint.curve.iter().flat_map(|p| [p.iteration as f64, p.loss, p.alignment, p.separation, p.rate]).collect();
    let provenance = Provenance { format: FORMAT.into(), version: VERSION, ..provenance.clone() };
    let iteration = [checkpoint.iteration];
    let mut writer = ArtifactWriter::new(provenance)
        .tensor("iteration", &[1], &iteration)
        .tensor("window", &[3], &checkpoint.window)
        .tensor("settled", &[2], &checkpoint.settled)
        .tensor("curve", &[checkpoint.curve.len(), 5], &curve)
        .tensor("statistics", &[checkpoint.statistics.len()], &checkpoint.statistics);
    for (name, values) in NAMES.iter().zip(&checkpoint.parameters) {
        writer = writer.tensor(name, &[values.len()], values);
    }
    writer.write(path)
}

/// Reads a checkpoint of the run that `provenance` says; `lengths` are those of the parameters.
///
/// # Errors
/// When the file is damaged or of another run.
pub fn read(path: &Path, provenance: &Provenance, lengths: [usize; 6]) -> Result<Checkpoint> {
    let a = Artifact::open(path, FORMAT, VERSION)?;
    let p = a.provenance();
    if (&p.parameters, &p.inputs, &p.program) != (&provenance.parameters, &provenance.inputs, &provenance.program) {
        return Err(Error::new("of other parameters or inputs").file(path));
    }
    let curve = a.tensor::<f64>("curve", &[None, Some(5)])?;
    let settled = a.tensor::<f64>("settled", &[Some(2)])?;
    let window = a.tensor::<f64>("window", &[Some(3)])?;
    let mut parameters: [Vec<f32>; 6] = Default::default();
    for ((to, name), length) in parameters.iter_mut().zip(NAMES).zip(lengths) {
        *to = a.tensor::<f32>(name, &[Some(length)])?.to_vec();
        if to.iter().any(|v| !v.is_finite()) {
            return Err(Error::new("not a finite number").file(path).field(name));
        }
    }
    Ok(Checkpoint {
        iteration: a.tensor::<u64>("iteration", &[Some(1)])?[0],
        window: [window[0], window[1], window[2]],
        settled: [settled[0], settled[1]],
        curve: curve
            .chunks_exact(5)
            .map(|p| CurvePoint { iteration: p[0] as u64, loss: p[1], alignment: p[2], separation: p[3], rate: p[4] })
            .collect(),
        statistics: a.tensor::<f64>("statistics", &[None])?.to_vec(),
        parameters,
    })
}
