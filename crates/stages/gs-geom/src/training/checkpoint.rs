//! Checkpoints: everything a run needs to go on to the bytes of an undisturbed one.

use super::exposure::{Exposures, NUMBERS};
use super::optimiser::Adam;
use super::poses::{NUMBERS as POSE, Poses};
use gs_io::{Artifact, ArtifactWriter, Error, Provenance, Result};
use gs_scene::{Gaussians, sh_coefficients};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Format name of the artifact.
pub const FORMAT: &str = "gs-geom-checkpoint";
/// Version of the format.
pub const VERSION: u32 = 5;

/// State of an optimisation after some iterations. Random numbers are drawn from the seed and the iteration (see
/// [`super::schedule::generator`]), so no generator is part of it.
#[derive(Debug, Clone, PartialEq)]
pub struct State {
    pub gaussians: Gaussians,
    pub adam: Adam,
    pub seen: ScreenGradients,
    pub exposures: Exposures,
    pub poses: Poses,
    pub progress: ProgressState,
}

/// The gradients of each Gaussian's projected centre since the last densification.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ScreenGradients {
    /// Sum over views of the length of d loss / d projected centre, N.
    pub sum: Vec<f32>,
    /// In how many views it was drawn, N.
    pub views: Vec<u32>,
}

impl ScreenGradients {
    /// Nothing seen yet.
    pub fn new(count: usize) -> Self {
        Self { sum: vec![0.0; count], views: vec![0; count] }
    }

    /// Mean over the views that drew it.
    pub fn mean(&self, i: usize) -> f32 {
        if self.views[i] == 0 { 0.0 } else { self.sum[i] / self.views[i] as f32 }
    }
}

/// Counters and the training curve.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct ProgressState {
    pub iteration: u32,
    /// Gradients of Gaussians that were not finite and so not used.
    pub dropped: u64,
    /// Most Gaussians in an iteration that could not be drawn: not finite; degenerate (see [`gs_raster::Dropped`]).
    pub undrawn: [u64; 2],
    /// Gaussians cloned, split, removed and relocated so far.
    pub densified: [u64; 4],
    /// Sums of loss, L1 and SSIM, and their number, since the last line of the curve.
    pub window: ([f64; 3], u32),
    pub curve: Vec<String>,
}

#[derive(Serialize, Deserialize)]
struct Extra {
    steps: u64,
    sh_degree: u8,
    progress: ProgressState,
}

/// Where the checkpoint of an output lies: `<output>.checkpoint`.
pub fn path_of(output: &Path) -> PathBuf {
    gs_io::with_suffix(output, ".checkpoint")
}

/// The state before the first iteration; `exposures` is the number of views with an exposure map, `poses` are the cameras to refine, if any.
pub fn start(gaussians: Gaussians, exposures: usize, poses: Poses) -> State {
    let (adam, seen) = (Adam::new(&gaussians), ScreenGradients::new(gaussians.len()));
    State { gaussians, adam, seen, exposures: Exposures::new(exposures), poses, progress: ProgressState::default() }
}

/// Writes a checkpoint; `provenance` is that of the run.
pub fn write(path: &Path, state: &State, provenance: Provenance) -> Result<()> {
    let extra =
        Extra { steps: state.adam.steps, sh_degree: state.gaussians.sh_degree, progress: state.progress.clone() };
    let extra = serde_json::to_value(&extra).map_err(|e| Error::new(e.to_string()).file(path))?;
    let (n, e) = (state.gaussians.len(), &state.exposures);
    let exposures = [e.maps.len(), NUMBERS];
    let p = &state.poses;
    let (views, lenses) = (p.views.len(), p.zooms.len());
    let mut writer = ArtifactWriter::new(Provenance { extra, ..provenance })
        .tensor("gradient_sum", &[n], &state.seen.sum)
        .tensor("gradient_views", &[n], &state.seen.views)
        .tensor("exposure_maps", &exposures, e.maps.as_flattened())
        .tensor("exposure_first", &exposures, e.first.as_flattened())
        .tensor("exposure_second", &exposures, e.second.as_flattened())
        .tensor("exposure_steps", &exposures[..1], &e.steps)
        .tensor("poses", &[views, POSE], p.views.as_flattened())
        .tensor("pose_first", &[views, 6], p.first.as_flattened())
        .tensor("pose_second", &[views, 6], p.second.as_flattened())
        .tensor("zooms", &[lenses], &p.zooms)
        .tensor("zoom_moments", &[lenses, 2], p.of_zooms.as_flattened())
        .tensor("pose_steps", &[views + lenses], &p.steps);
    for (prefix, g) in [("", &state.gaussians), ("first_", &state.adam.first), ("second_", &state.adam.second)] {
        writer = writer
            .tensor(&format!("{prefix}means"), &[n, 3], g.means.as_flattened())
            .tensor(&format!("{prefix}log_scales"), &[n, 3], g.log_scales.as_flattened())
            .tensor(&format!("{prefix}rotations"), &[n, 4], g.rotations.as_flattened())
            .tensor(&format!("{prefix}opacity_logits"), &[n], &g.opacity_logits)
            .tensor(&format!("{prefix}sh"), &[n, g.sh_stride()], &g.sh);
    }
    writer.write(path)
}

/// Reads the checkpoint at `path`, if there is one of the same run: same program, parameters and inputs. An error says why it
/// cannot be used.
pub fn read(path: &Path, run: &Provenance) -> Result<Option<State>> {
    if !path.exists() {
        return Ok(None);
    }
    let a = Artifact::open(path, FORMAT, VERSION)?;
    let p = a.provenance();
    let same = [
        ("program", p.program == run.program),
        ("parameters", p.parameters == run.parameters),
        ("inputs", p.inputs == run.inputs),
    ];
    if let Some((field, _)) = same.iter().find(|(_, same)| !same) {
        return Err(Error::new("the checkpoint is of another run").file(path).field(*field));
    }
    let extra: Extra = serde_json::from_value(p.extra.clone())
        .map_err(|e| Error::new(format!("damaged checkpoint: {e}")).file(path).field("extra"))?;
    if extra.sh_degree > 3 {
        return Err(Error::new("damaged checkpoint").file(path).field("sh_degree").found(extra.sh_degree));
    }
    let n = a.tensor::<u32>("gradient_views", &[None])?.len();
    let group = |prefix: &str| -> Result<Gaussians> {
        let flat = |name: &str, width: usize| a.tensor::<f32>(&format!("{prefix}{name}"), &[Some(n), Some(width)]);
        Ok(Gaussians {
            means: flat("means", 3)?.as_chunks().0.to_vec(),
            log_scales: flat("log_scales", 3)?.as_chunks().0.to_vec(),
            rotations: flat("rotations", 4)?.as_chunks().0.to_vec(),
            opacity_logits: a.tensor::<f32>(&format!("{prefix}opacity_logits"), &[Some(n)])?.to_vec(),
            sh: flat("sh", 3 * sh_coefficients(extra.sh_degree))?.to_vec(),
            sh_degree: extra.sh_degree,
            ..Gaussians::default()
        })
    };
    let steps = a.tensor::<u32>("exposure_steps", &[None])?.to_vec();
    let exposure = |name: &str| -> Result<Vec<[f32; NUMBERS]>> {
        Ok(a.tensor::<f32>(name, &[Some(steps.len()), Some(NUMBERS)])?.as_chunks().0.to_vec())
    };
    let poses = a.tensor::<f64>("poses", &[None, Some(POSE)])?.as_chunks().0.to_vec();
    let zooms = a.tensor::<f64>("zooms", &[None])?.to_vec();
    let (views, lenses) = (poses.len(), zooms.len());
    let moves = |name: &str| -> Result<Vec<[f64; 6]>> {
        Ok(a.tensor::<f64>(name, &[Some(views), Some(6)])?.as_chunks().0.to_vec())
    };
    Ok(Some(State {
        poses: Poses {
            first: moves("pose_first")?,
            second: moves("pose_second")?,
            of_zooms: a.tensor::<f64>("zoom_moments", &[Some(lenses), Some(2)])?.as_chunks().0.to_vec(),
            steps: a.tensor::<u32>("pose_steps", &[Some(views + lenses)])?.to_vec(),
            views: poses,
            zooms,
        },
        exposures: Exposures {
            maps: exposure("exposure_maps")?,
            first: exposure("exposure_first")?,
            second: exposure("exposure_second")?,
            steps: steps.clone(),
        },
        gaussians: group("")?,
        adam: Adam { first: group("first_")?, second: group("second_")?, steps: extra.steps },
        seen: ScreenGradients {
            sum: a.tensor::<f32>("gradient_sum", &[Some(n)])?.to_vec(),
            views: a.tensor::<u32>("gradient_views", &[Some(n)])?.to_vec(),
        },
        progress: extra.progress,
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::training::optimiser::zeros;
    use glam::DVec3;
    use gs_scene::Camera;

    fn provenance(seed: u64) -> Provenance {
        let parameters = serde_json::json!({"seed": seed, "rate": 0.2f32});
        Provenance { format: FORMAT.into(), version: VERSION, parameters, ..Provenance::default() }
    }

    #[test]
    fn a_checkpoint_reads_back_bit_for_bit_and_only_for_its_run() {
        let dir = tempfile::tempdir().unwrap();
        let path = path_of(&dir.path().join("g.ply"));
        assert_eq!(read(&path, &provenance(1)).unwrap(), None);
        let mut g = zeros(5, 2);
        let fill = |v: &mut [f32], at: f32| v.iter_mut().enumerate().for_each(|(i, v)| *v = at + (i as f32).sin());
        fill(g.means.as_flattened_mut(), 1.0);
        fill(&mut g.sh, 2.0);
        let cameras = [0.0, 1.0].map(|x| Camera::look_at(DVec3::new(x, 3.0, 1.0), DVec3::ZERO, DVec3::Z, 64, 48, 1.0));
        let mut state = start(g, 3, Poses::new(&cameras, &cameras, &[0, 1]));
        fill(&mut state.adam.first.sh, 3.0);
        fill(state.adam.second.rotations.as_flattened_mut(), 4.0);
        fill(&mut state.seen.sum, 5.0);
        fill(state.exposures.maps.as_flattened_mut(), 6.0);
        fill(state.exposures.second.as_flattened_mut(), 7.0);
        state.exposures.steps = vec![3, 1, 4];
        state.poses.steps = vec![1, 5, 9, 2];
        state.poses.first[1] = [0.1, -0.2, 1.0 / 3.0, 0.4, 5e-300, 0.6];
        state.poses.zooms[1] = 0.01;
        state.adam.steps = 12;
        state.progress = ProgressState {
            iteration: 12,
            dropped: 3,
            undrawn: [5, 6],
            densified: [1, 2, 3, 4],
            window: ([0.1, 1.0 / 3.0, f64::MIN_POSITIVE], 7),
            curve: vec!["{\"iteration\":10}".into()],
        };
        write(&path, &state, provenance(1)).unwrap();
        assert_eq!(read(&path, &provenance(1)).unwrap().unwrap(), state);
        let e = read(&path, &provenance(2)).unwrap_err().to_string();
        assert!(e.contains("parameters: the checkpoint is of another run"), "{e}");
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, &bytes[..bytes.len() - 9]).unwrap();
        assert!(read(&path, &provenance(1)).is_err());
    }
}
