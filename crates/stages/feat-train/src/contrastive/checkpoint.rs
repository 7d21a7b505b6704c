//! The state of an unfinished run: `<out>.checkpoint`.

use super::state::{CurvePoint, State, Window};
use gs_io::{Artifact, ArtifactWriter, Error, Provenance, Result};
use stage::Stage;
use std::path::{Path, PathBuf};

/// Kind of the file.
pub const FORMAT: &str = "feat-train-checkpoint";
const VERSION: u32 = 4;

/// Where the checkpoint of `output` lies.
pub fn path(output: &Path) -> PathBuf {
    gs_io::with_suffix(output, ".checkpoint")
}

/// Writes all that training needs to go on as if it had never stopped; `provenance` says which run it is of.
pub fn write(path: &Path, provenance: &Provenance, state: &mut State) -> Result<()> {
    let curve: Vec<f64> =
        state.curve.iter().flat_map(|p| [p.iteration as f64, p.loss, p.alignment, p.separation, p.rate]).collect();
    let (iteration, window) = ([state.iteration], [state.window.loss, state.window.separation, state.window.count]);
    let provenance = Provenance { format: FORMAT.into(), version: VERSION, ..provenance.clone() };
    let mut writer = ArtifactWriter::new(provenance)
        .tensor("iteration", &[1], &iteration)
        .tensor("window", &[3], &window)
        .tensor("curve", &[curve.len() / 5, 5], &curve);
    for (name, values) in state.arrays() {
        writer = writer.tensor(&name, &[values.len()], values);
    }
    writer.write(path)
}

/// Continues from the checkpoint at `path` if it is of this very run and not past its end; else leaves `state` as it is.
pub fn resume(state: &mut State, path: &Path, provenance: &Provenance, iterations: u64, stage: &Stage) {
    if !path.exists() {
        return;
    }
    match read(path, provenance, iterations, state) {
        Ok(()) => stage.info(&format!("continuing from iteration {}", state.iteration)),
        Err(e) => stage.info(&format!("the checkpoint is not of this run, starting anew ({e})")),
    }
}

fn read(path: &Path, provenance: &Provenance, iterations: u64, state: &mut State) -> Result<()> {
    let a = Artifact::open(path, FORMAT, VERSION)?;
    let p = a.provenance();
    if (&p.parameters, &p.inputs, &p.program) != (&provenance.parameters, &provenance.inputs, &provenance.program) {
        return Err(Error::new("made with other options or inputs").file(path));
    }
    let iteration = a.tensor::<u64>("iteration", &[Some(1)])?[0];
    if iteration > iterations {
        return Err(Error::new("past the last iteration").file(path).found(iteration).expected(iterations));
    }
    let curve = a.tensor::<f64>("curve", &[None, Some(5)])?;
    let window = a.tensor::<f64>("window", &[Some(3)])?;
    let mut arrays: Vec<Vec<f32>> = Vec::new();
    for (name, values) in state.arrays() {
        let found = a.tensor::<f32>(&name, &[Some(values.len())])?;
        if found.iter().any(|v| !v.is_finite()) {
            return Err(Error::new("not a finite number").file(path).field(name));
        }
        arrays.push(found.to_vec());
    }
    state.arrays().into_iter().zip(arrays).for_each(|((_, values), found)| *values = found);
    state.iteration = iteration;
    state.window = Window { loss: window[0], separation: window[1], count: window[2] };
    let point =
        |p: &[f64]| CurvePoint { iteration: p[0] as u64, loss: p[1], alignment: p[2], separation: p[3], rate: p[4] };
    state.curve = curve.chunks_exact(5).map(point).collect();
    Ok(())
}
