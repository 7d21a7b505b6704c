//! The files that a training reads and writes.

use super::init::has_depths;
use crate::options::Train;
use crate::photographs::masks::Masks;
use crate::training::checkpoint::{self, State};
use gs_io::{Claim, Error, Result, Watched, with_suffix};
use gs_scene::dataset::{Dataset, View};
use gs_sfm::Refine;
use stage::Stage;
use std::path::{Path, PathBuf};

/// What lies beside the output: the training curve and its plot, the photographs' exposures, the refined cameras, and the Gaussians of an
/// unfinished run.
pub(super) const CURVE: &str = ".curve.jsonl";
pub(super) const PLOT: &str = ".curve.svg";
pub(super) const EXPOSURES: &str = ".exposures.json";
pub(super) const CAMERAS: &str = ".cameras.json";
pub(super) const PARTIAL: &str = ".partial.ply";

/// Where the plan of an output lies while its run is unfinished.
pub(crate) fn plan_path(output: &Path) -> PathBuf {
    with_suffix(output, ".plan.json")
}

/// The right to write everything that a run may leave.
pub(super) fn claim(options: &Train, dataset: &Dataset, masks: &Masks, stage: &Stage) -> Result<Claim> {
    let out = &options.out;
    let exposures = Some(EXPOSURES).filter(|_| options.exposure);
    let cameras = Some(CAMERAS).filter(|_| options.refine_poses != Refine::Off);
    let beside =
        [CURVE, PLOT, PARTIAL].into_iter().chain(exposures).chain(cameras).map(|suffix| with_suffix(out, suffix));
    let outputs = stage.outputs(out).file(out).files(beside).file(plan_path(out));
    let outputs = outputs.artifact(checkpoint::path_of(out), checkpoint::FORMAT);
    let init = options.init.file().map(Path::to_path_buf);
    outputs.reads(dataset.files.iter().cloned().chain(masks.files()).chain(init)).drop_stale().claim()
}

/// The files that are hashed at one time and read at another.
pub(super) fn watched(options: &Train, dataset: &Dataset, masks: &Masks) -> Watched {
    let masks = dataset.views.iter().filter_map(|v| masks.of(v));
    let depths = dataset.views.iter().filter_map(View::depth_path).filter(|_| has_depths(options, dataset));
    let photographs = dataset.views.iter().map(|v| &*v.image_path);
    Watched::by_content(photographs.chain(masks).chain(depths).chain(options.init.file()))
}

/// Refuses Gaussians that are not finite: no stage can use them, and no later step makes them finite.
pub(super) fn check_finite(options: &Train, state: &State) -> Result<()> {
    let g = &state.gaussians;
    let bad: Vec<usize> = (0..g.len()).filter(|&i| !g.is_finite(i)).collect();
    match bad.first() {
        None => Ok(()),
        Some(first) => Err(Error::new("Gaussians are not finite; nothing is written")
            .file(&options.out)
            .field(format!("iteration {}", state.progress.iteration))
            .found(format!("{} of {}, the first is {first}", bad.len(), g.len()))
            .expected("finite numbers in all")
            .hint("check the scene's points and poses")),
    }
}
