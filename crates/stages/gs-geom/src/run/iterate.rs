//! The iterations of a training, with checkpoints.

use super::outputs::{PARTIAL, check_finite};
use crate::options::{Every, Train};
use crate::training::Trainer;
use crate::training::checkpoint::{self, State};
use gs_io::{Error, ErrorKind, Provenance, Result, Watched, with_suffix};
use gs_scene::ply;
use stage::Stage;

/// Where checkpoints come by the clock, seconds between them for each second that the last one took.
const SPARING: f64 = 20.0;
/// Weight of the last loss in the mean that the progress shows.
const SMOOTHING: f64 = 0.02;

/// The state of an interrupted run of the same parameters and inputs.
pub(super) fn saved(options: &Train, run: &Provenance, stage: &Stage) -> Option<State> {
    let read = checkpoint::read(&checkpoint::path_of(&options.out), run);
    let state = read.inspect_err(|e| stage.warn(&format!("beginning anew: {e}"))).ok().flatten()?;
    stage.info(&format!("going on after iteration {}", state.progress.iteration));
    Some(state)
}

/// Runs the iterations that are left.
pub(super) fn iterate(
    options: &Train,
    trainer: &mut Trainer<'_>,
    run: &Provenance,
    watched: &Watched,
    stage: &Stage,
) -> Result<()> {
    let first = trainer.state.progress.iteration;
    let mut progress = stage.progress("iteration", options.iterations.into()).resumed_at(first.into());
    // From the start of the program: what came before the first iteration is saved with it.
    let seconds = || stage.elapsed().as_secs_f64();
    let (mut last_save, mut cost) = (0.0, 0.0);
    let mut smooth: Option<f64> = None;
    trainer.complete_curve()?;
    while !trainer.is_done() {
        if stage.interrupted() {
            return stop(options, trainer, run, stage);
        }
        trainer.step()?;
        let iteration = trainer.state.progress.iteration;
        let loss = trainer.last.total;
        let s = smooth.get_or_insert(loss);
        *s += SMOOTHING * (loss - *s);
        let mut fields = vec![("loss", *s), ("Gaussians", trainer.state.gaussians.len() as f64)];
        fields.extend(trainer.last_heldout.map(|psnr| ("psnr", psnr)));
        progress.set(iteration.into(), &fields);
        let due = match options.checkpoint_every {
            Every::Iterations(n) => iteration.is_multiple_of(n),
            Every::Seconds(s) => seconds() - last_save >= s.max(SPARING * cost),
        };
        if due && !trainer.is_done() {
            // Photographs kept in memory are not read again, but a run that cannot be repeated should end here.
            watched.check_those_left()?;
            let before = seconds();
            save(options, trainer, run)?;
            last_save = seconds();
            cost = last_save - before;
        }
    }
    progress.finish(&[("loss", smooth.unwrap_or(0.0))]);
    Ok(())
}

/// Ends an interrupted run with a checkpoint and the Gaussians so far.
fn stop(options: &Train, trainer: &Trainer<'_>, run: &Provenance, stage: &Stage) -> Result<()> {
    save(options, trainer, run)?;
    let iteration = trainer.state.progress.iteration;
    let partial = with_suffix(&options.out, PARTIAL);
    let note = format!("unfinished: {iteration} of {} iterations", options.iterations);
    ply::write_gaussians(&partial, &trainer.state.gaussians, &[note])?;
    stage.info(&format!(
        "stopped after iteration {iteration}; the same command goes on from here. The Gaussians so far: {}",
        partial.display()
    ));
    Err(Error::of(ErrorKind::Interrupted, "interrupted"))
}

/// Saves what a failing run has done. An interrupted one has done so already. Where a photograph has changed, it is what the
/// old one taught: no photograph is used that is not as it was.
pub(super) fn rescue(options: &Train, trainer: &Trainer<'_>, run: &Provenance, stage: &Stage) {
    let iteration = trainer.state.progress.iteration;
    // What is not finite stays so: there is nothing to save.
    if stage.interrupted() || check_finite(options, &trainer.state).is_err() {
        return;
    }
    match save(options, trainer, run) {
        Ok(()) => stage.warn(&format!(
            "saved a checkpoint after iteration {iteration}; fix the error below, and the same command goes on from it"
        )),
        Err(e) => stage.warn(&format!("no checkpoint after iteration {iteration} could be saved: {e}")),
    }
}

fn save(options: &Train, trainer: &Trainer<'_>, run: &Provenance) -> Result<()> {
    check_finite(options, &trainer.state)?;
    checkpoint::write(&checkpoint::path_of(&options.out), &trainer.state, run.clone())
}
