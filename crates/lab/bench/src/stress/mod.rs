//! Numerical stress: hostile scenes and settings through every stage, and changes of a scene that must not change the result.

mod cases;
mod oracle;
mod world;

use crate::chain::{Files, Options, Programs, STAGES, Stage, command, words};
use crate::tradeoff::inherit;
use artifacts::{Features, Footprints, Instances};
use cases::{Case, From, cases, options};
use gs_io::Result;
use gs_scene::ply;
use hdbscan_exact::adjusted_rand;
use oracle::render_error;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::Path;
use world::World;

#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    pub scene: String,
    /// The stage, or `render`: the renderer alone against its f64 reference.
    pub stage: String,
    /// How far off: of `render` the largest difference of a pixel; of the geometry decibels lost against the undisturbed
    /// scene; of the graph the relative change of the footprints (L1); of instances 1 - adjusted Rand index. None where only
    /// survival is asked.
    pub error: Option<f64>,
    pub tolerance: Option<f64>,
    /// Whether a number of the output is not finite.
    pub non_finite: bool,
    /// What was asked, and what the stage said if it refused.
    pub note: String,
    /// Within the tolerance, finite, and not crashed.
    pub good: bool,
}

impl Case {
    fn row(&self, stage: &str, error: Option<f64>, tolerance: Option<f64>, ended: Outcome) -> Row {
        let (non_finite, note) = match ended {
            Ok(non_finite) => (non_finite, self.note.to_string()),
            Err((crashed, said)) => {
                (crashed, format!("{}; {}: {said}", self.note, if crashed { "crashed" } else { "refused" }))
            }
        };
        let within = tolerance.is_none_or(|most| error.is_some_and(|e| e <= most));
        let (scene, stage, good) = (self.name.into(), stage.into(), within && !non_finite);
        Row { scene, stage, error, tolerance, non_finite, note, good }
    }

    /// The renderer against its reference, on two views.
    fn rendered(&self) -> Row {
        let World { shots, gaussians, .. } = &self.world;
        let seen = shots.iter().step_by(shots.len().div_ceil(2)).map(|s| render_error(gaussians, &s.camera));
        let (error, non_finite) = seen.fold((0.0f64, false), |(e, b), (error, bad)| (e.max(error), b | bad));
        self.row("render", Some(error), self.tolerances.render, Ok(non_finite))
    }
}

/// Runs the matrix on a tiny synthetic scene in `folder`: the scenes whose name contains one of `only`, or all.
pub fn run(programs: &Programs, folder: &Path, only: &[String], said: &dyn Fn(&str)) -> Result<Vec<Row>> {
    let files = Files::of(&folder.join("base"));
    let scene = words("synth-scene --size tiny --views 12 --objects 6 --corruption mild");
    programs.run(&[scene, command(&[], &[("--out", &files.scene)])].concat())?;
    files.run(programs, Stage::Geometry, &Options::of(Stage::Geometry, GEOMETRY))?;
    let world = World::read(&files.scene, &files.masks, &files.geometry)?;
    let base = Base::new(programs, &world, &folder.join("undisturbed"))?;
    let mut rows = Vec::new();
    for case in
        cases(&world).into_iter().filter(|c| only.is_empty() || only.iter().any(|o| c.name.contains(o.as_str())))
    {
        said(case.name);
        rows.extend(base.rows(programs, &case, &folder.join(case.name.replace(' ', "-")))?);
    }
    Ok(rows)
}

/// Geometry of the undisturbed scene.
const GEOMETRY: &str = "--iterations 250 --sh-degree 0 --max-gaussians 4000 --holdout 0";

struct Base {
    files: Files,
    /// None where nothing is held out.
    psnr: Option<f64>,
    labels: Vec<i32>,
    footprints: BTreeMap<u32, f64>,
}

/// Sum of weights of each Gaussian over all masks, by its number in the whole scene.
fn weights(path: &Path) -> Result<BTreeMap<u32, f64>> {
    let f = Footprints::read(path)?;
    let mut sums = BTreeMap::new();
    for row in 0..f.rows.len() {
        for (c, v) in f.entries(row)?.iter() {
            *sums.entry(f.kept[c as usize]).or_insert(0.0) += f64::from(v);
        }
    }
    Ok(sums)
}

fn files_of(folder: &Path) -> Files {
    Files::of(folder).within(&folder.join("out"))
}

impl Base {
    fn new(programs: &Programs, world: &World, folder: &Path) -> Result<Self> {
        world.write(folder)?;
        let files = files_of(folder);
        let options = options("");
        for stage in STAGES.into_iter().skip(1) {
            files.run(programs, stage, &options)?;
        }
        let trained = Files { geometry: folder.join("trained.ply"), ..files.clone() };
        trained.run(programs, Stage::Geometry, &options)?;
        Ok(Self {
            psnr: trained_psnr(&trained.geometry),
            labels: Instances::read(&files.instances)?.0.label,
            footprints: weights(&files.footprints)?,
            files,
        })
    }

    /// The cells of a case: its stages until one refuses.
    fn rows(&self, programs: &Programs, case: &Case, folder: &Path) -> Result<Vec<Row>> {
        case.world.write(folder)?;
        let own = files_of(folder);
        if case.from == From::Features {
            return self.trained_on_the_undisturbed(programs, case, &own).map(|row| vec![row]);
        }
        let mut rows = vec![case.rendered(), self.geometry(programs, case, folder)];
        let t = case.tolerances;
        for (stage, tolerance) in [(Stage::Graph, t.graph), (Stage::Features, None), (Stage::Instances, t.instances)] {
            let ended = outcome(own.run(programs, stage, &case.options), &own, stage);
            let finished = ended.is_ok();
            let error = match stage {
                Stage::Graph if finished && tolerance.is_some() => {
                    Some(self.footprint_change(&own, case.origin.as_deref())?)
                }
                Stage::Instances if finished && tolerance.is_some() => self.disagreement(&own, case)?,
                _ => None,
            };
            rows.push(case.row(stage.name(), error, tolerance, ended));
            if !finished {
                break;
            }
        }
        Ok(rows)
    }

    /// Stage 1 on the case's photographs, from its points or its Gaussians.
    fn geometry(&self, programs: &Programs, case: &Case, folder: &Path) -> Row {
        let own = files_of(folder);
        let trained = Files { geometry: folder.join("trained.ply"), ..own.clone() };
        let mut options = case.options.get(Stage::Geometry).to_vec();
        if case.from == From::Gaussians {
            options.extend(["--init".into(), own.geometry.to_string_lossy().into_owned()]);
        }
        let options = case.options.clone().with(Stage::Geometry, options);
        let ended = outcome(trained.run(programs, Stage::Geometry, &options), &trained, Stage::Geometry);
        let tolerance = case.tolerances.geometry;
        let lost = self.psnr.zip(trained_psnr(&trained.geometry)).map(|(before, after)| (before - after).max(0.0));
        case.row("geometry", tolerance.and(lost), tolerance, ended)
    }

    /// Hostile settings of training, on the undisturbed graph and footprints.
    fn trained_on_the_undisturbed(&self, programs: &Programs, case: &Case, own: &Files) -> Result<Row> {
        inherit(&self.files, own, Stage::Features)?;
        let files = Files { geometry: self.files.geometry.clone(), ..own.clone() };
        let ended = outcome(files.run(programs, Stage::Features, &case.options), &files, Stage::Features);
        Ok(case.row("features", None, None, ended))
    }

    /// 1 - adjusted Rand index with the undisturbed instances, where it is known which Gaussian is which.
    fn disagreement(&self, own: &Files, case: &Case) -> Result<Option<f64>> {
        let Some(origin) = &case.origin else { return Ok(None) };
        let labels = Instances::read(&own.instances)?.0.label;
        let before: Vec<i32> = origin.iter().map(|&o| self.labels[o as usize]).collect();
        Ok(Some(1.0 - adjusted_rand(&labels, &before)))
    }

    /// Sum of absolute changes of the Gaussians' weights over their sum; of each one's share where it was divided.
    fn footprint_change(&self, own: &Files, origin: Option<&[u32]>) -> Result<f64> {
        let mut now = BTreeMap::new();
        for (i, w) in weights(&own.footprints)? {
            *now.entry(origin.map_or(i, |o| o[i as usize])).or_insert(0.0) += w;
        }
        let total: f64 = self.footprints.values().sum();
        let sum: f64 = now.values().sum();
        // Pixels may be of another size.
        let scale = total / sum.max(1e-300);
        let mut change = 0.0;
        for (i, w) in &self.footprints {
            change += (scale * now.remove(i).unwrap_or(0.0) - w).abs();
        }
        Ok((change + scale * now.values().sum::<f64>()) / total)
    }
}

/// How a stage ended: whether what it wrote holds a number that is not finite; or whether it crashed, by a panic, a signal or
/// an output that cannot be read, rather than refused, and what it said.
type Outcome = std::result::Result<bool, (bool, String)>;

fn outcome<T>(run: Result<T>, files: &Files, stage: Stage) -> Outcome {
    let said = run.err().map(|e| e.to_string());
    match said {
        None => is_damaged(files, stage).map_err(|e| (true, e.to_string())),
        Some(said) => Err((said.contains("panicked") || said.contains("signal"), said)),
    }
}

/// Whether what a stage wrote holds a number that is not finite.
fn is_damaged(files: &Files, stage: Stage) -> Result<bool> {
    let output = files.output(stage);
    Ok(match stage {
        Stage::Geometry => {
            let g = ply::read_gaussians_as_they_are(output)?;
            (0..g.len()).any(|i| !g.is_whole(i))
        }
        Stage::Graph => weights(&files.footprints)?.values().any(|w| !w.is_finite()),
        Stage::Features => Features::read(output)?.0.values.iter().any(|v| !v.is_finite()),
        Stage::Instances => {
            let i = Instances::read(output)?.0;
            i.score.iter().chain(&i.descriptor).any(|v| !v.is_finite())
        }
    })
}

/// PSNR of the held-out views, if the training ended and had some.
fn trained_psnr(geometry: &Path) -> Option<f64> {
    stage::RunRecord::read(geometry).ok()?.summary["psnr_heldout"].as_f64()
}
