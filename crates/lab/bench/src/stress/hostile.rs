//! The matrix of hostile scenes and stages.

use super::oracle::{geometry_is_damaged, render_error};
use super::world::World;
use crate::chain::{Files, Options, Programs, STAGES, Stage, command, words};
use crate::tradeoff::inherit;
use artifacts::{Features, Footprints, Instances};
use glam::{DQuat, DVec3};
use gs_io::Result;
use gs_scene::Gaussians;
use hdbscan_exact::adjusted_rand;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use serde::Serialize;
use std::path::Path;

/// A cell of the matrix.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    /// The hostile scene.
    pub scene: String,
    /// The stage, or `render`: the renderer alone against its f64 reference.
    pub stage: String,
    /// How far off: of `render` the largest difference of a pixel; of the geometry decibels lost against the undisturbed
    /// scene; of the graph the relative change of the footprints (L1); of instances 1 - adjusted Rand index. None where only
    /// survival is asked.
    pub error: Option<f64>,
    /// What it may be.
    pub tolerance: Option<f64>,
    /// Whether a number of the output is not finite.
    pub non_finite: bool,
    /// What was asked, and what the stage said if it refused.
    pub note: String,
    /// Within the tolerance, finite, and not crashed.
    pub good: bool,
}

/// What may change, by stage; None: it need only survive.
#[derive(Debug, Clone, Copy, Default)]
struct Tolerances {
    render: Option<f64>,
    geometry: Option<f64>,
    graph: Option<f64>,
    instances: Option<f64>,
}

/// Nothing but rounding may change.
const ROUNDING: Tolerances =
    Tolerances { render: Some(1e-4), geometry: Some(1.0), graph: Some(1e-3), instances: Some(0.05) };
/// The result may be another, but the renderer must be right.
const SURVIVE: Tolerances = Tolerances { render: Some(1e-4), geometry: None, graph: None, instances: None };

struct Case {
    name: &'static str,
    note: &'static str,
    world: World,
    /// Gaussian of the undisturbed world that each one is.
    origin: Option<Vec<u32>>,
    tolerances: Tolerances,
    options: Options,
    from: From,
}

/// Where a case begins.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum From {
    /// Stage 1 learns from the world's points.
    Points,
    /// Stage 1 goes on from the world's Gaussians, which are what is hostile.
    Gaussians,
    /// Training of features, on what was made of the undisturbed world.
    Features,
}

impl Case {
    fn row(&self, stage: &str, error: Option<f64>, tolerance: Option<f64>, ended: Outcome) -> Row {
        let (non_finite, note) = match ended {
            Outcome::Finished { non_finite } => (non_finite, self.note.to_string()),
            Outcome::Refused(said) => (false, format!("{}; refused: {said}", self.note)),
            Outcome::Crashed(said) => (true, format!("{}; crashed: {said}", self.note)),
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
        self.row("render", Some(error), self.tolerances.render, Outcome::Finished { non_finite })
    }
}

/// Runs the matrix on a tiny synthetic scene in `folder`: the scenes whose name contains one of `only`, or all.
///
/// # Errors
/// When the undisturbed scene cannot be made; what a hostile one does is a row.
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
/// Of a hostile one: enough to see whether it learns.
const SHORT: &str = "geometry: --iterations 80 --sh-degree 0 --max-gaussians 3000 --densify-every 20 --opacity-reset-every 30; graph: --holdout 0 --min-mask-pixels 10";

struct Base {
    files: Files,
    /// None where nothing is held out.
    psnr: Option<f64>,
    labels: Vec<i32>,
    footprints: Vec<(u32, f32)>,
}

/// Sum of weights of each Gaussian over all masks, by its number in the whole scene.
fn weights(path: &Path) -> Result<Vec<(u32, f32)>> {
    let f = Footprints::read(path)?;
    let (_, columns, values) = f.csr();
    let mut sums = std::collections::BTreeMap::<u32, f64>::new();
    for (c, v) in columns.iter().zip(values) {
        *sums.entry(f.kept[*c as usize]).or_default() += f64::from(*v);
    }
    Ok(sums.into_iter().map(|(i, s)| (i, s as f32)).collect())
}

fn files_of(folder: &Path) -> Files {
    Files::of(folder).within(&folder.join("out"))
}

impl Base {
    fn new(programs: &Programs, world: &World, folder: &Path) -> Result<Self> {
        world.write(folder)?;
        let files = files_of(folder);
        let options = Options::parse(SHORT)?;
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
            let ended = outcome(own.run(programs, stage, &case.options), || is_damaged(&own, stage));
            let finished = matches!(ended, Outcome::Finished { .. });
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
        let ended = outcome(trained.run(programs, Stage::Geometry, &options), || is_damaged(&trained, Stage::Geometry));
        let tolerance = case.tolerances.geometry;
        let lost = self.psnr.zip(trained_psnr(&trained.geometry)).map(|(before, after)| (before - after).max(0.0));
        case.row("geometry", tolerance.and(lost), tolerance, ended)
    }

    /// Hostile settings of training, on the undisturbed graph and footprints.
    fn trained_on_the_undisturbed(&self, programs: &Programs, case: &Case, own: &Files) -> Result<Row> {
        inherit(&self.files, own, Stage::Features)?;
        let files = Files { geometry: self.files.geometry.clone(), ..own.clone() };
        let ended =
            outcome(files.run(programs, Stage::Features, &case.options), || is_damaged(&files, Stage::Features));
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
        let mut now = std::collections::BTreeMap::<u32, f64>::new();
        for (i, w) in weights(&own.footprints)? {
            *now.entry(origin.map_or(i, |o| o[i as usize])).or_default() += f64::from(w);
        }
        let total: f64 = self.footprints.iter().map(|(_, w)| f64::from(*w)).sum();
        let sum: f64 = now.values().sum();
        // Pixels may be of another size.
        let scale = total / sum.max(1e-300);
        let mut change = 0.0;
        for (i, w) in &self.footprints {
            change += (scale * now.remove(i).unwrap_or(0.0) - f64::from(*w)).abs();
        }
        Ok((change + scale * now.values().sum::<f64>()) / total)
    }
}

/// How a stage ended.
enum Outcome {
    Finished {
        non_finite: bool,
    },
    /// With a message in one line.
    Refused(String),
    /// A panic, a signal, or an output that cannot be read.
    Crashed(String),
}

fn outcome<T>(run: Result<T>, damaged: impl FnOnce() -> Result<bool>) -> Outcome {
    match run {
        Ok(_) => match damaged() {
            Ok(non_finite) => Outcome::Finished { non_finite },
            Err(e) => Outcome::Crashed(e.to_string()),
        },
        Err(e) => {
            let said = e.to_string();
            if said.contains("panicked") || said.contains("signal") {
                Outcome::Crashed(said)
            } else {
                Outcome::Refused(said)
            }
        }
    }
}

/// Whether what a stage wrote holds a number that is not finite.
fn is_damaged(files: &Files, stage: Stage) -> Result<bool> {
    let output = files.output(stage);
    Ok(match stage {
        Stage::Geometry => geometry_is_damaged(output)?,
        Stage::Graph => weights(&files.footprints)?.iter().any(|(_, w)| !w.is_finite()),
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

fn with(world: &World, change: impl FnOnce(&mut Gaussians)) -> World {
    let mut w = world.clone();
    change(&mut w.gaussians);
    w
}

fn cases(world: &World) -> Vec<Case> {
    let n = world.gaussians.len() as u32;
    let same: Vec<u32> = (0..n).collect();
    let short = || Options::parse(SHORT).unwrap_or_default();
    let case = |name, note, world, origin, tolerances| Case {
        name,
        note,
        world,
        origin,
        tolerances,
        options: short(),
        from: From::Points,
    };
    let moved = |scale: f64, turn: DQuat, shift: DVec3| world.clone().moved(scale, turn, shift);
    let (still, here) = (DQuat::IDENTITY, DVec3::ZERO);
    let turn = DQuat::from_axis_angle(DVec3::new(1.0, 2.0, -0.5).normalize(), 1.1);
    let mut shuffled = same.clone();
    shuffled.shuffle(&mut ChaCha8Rng::seed_from_u64(1));
    let loose = Tolerances { geometry: Some(1.5), graph: Some(0.02), instances: Some(0.1), ..ROUNDING };
    let mut all = vec![
        case(
            "metamorphic unit 1e-6",
            "the scene a millionth as large",
            moved(1e-6, still, here),
            Some(same.clone()),
            ROUNDING,
        ),
        case(
            "metamorphic unit 1e6",
            "the scene a million times as large",
            moved(1e6, still, here),
            Some(same.clone()),
            ROUNDING,
        ),
        case("metamorphic scaled", "the scene 3 times as large", moved(3.0, still, here), Some(same.clone()), ROUNDING),
        case("metamorphic turned", "the scene turned by 63 degrees", moved(1.0, turn, here), Some(same.clone()), loose),
        case(
            "metamorphic moved",
            "the scene moved by 30 units",
            moved(1.0, still, DVec3::new(30.0, -20.0, 5.0)),
            Some(same.clone()),
            loose,
        ),
        case(
            "origin 1e4",
            "the scene at 10,000 units from its origin: centres keep 3 digits of a unit",
            moved(1.0, still, DVec3::splat(1e4)),
            Some(same.clone()),
            Tolerances { render: Some(1e-4), ..Tolerances::default() },
        ),
        case(
            "origin 1e7",
            "the scene at 1e7 units from its origin: single precision keeps units only",
            moved(1.0, still, DVec3::new(1e7, 0.0, 0.0)),
            None,
            SURVIVE,
        ),
        case(
            "metamorphic Gaussians permuted",
            "Gaussians in another order",
            world.clone().with_gaussians(&shuffled),
            Some(shuffled.clone()),
            Tolerances { geometry: Some(0.0), ..loose },
        ),
        case(
            "metamorphic views reversed",
            "views in another order",
            world.clone().with_views_reversed(),
            Some(same.clone()),
            loose,
        ),
        case(
            "metamorphic mask ids reversed",
            "masks with other numbers",
            world.clone().with_mask_ids_reversed(),
            Some(same.clone()),
            Tolerances { geometry: Some(0.0), ..ROUNDING },
        ),
        case(
            "metamorphic twice the pixels",
            "photographs and masks of twice the size",
            world.clone().at_twice_the_size(),
            Some(same.clone()),
            Tolerances { graph: Some(0.15), instances: Some(0.25), geometry: None, ..ROUNDING },
        ),
        case(
            "metamorphic Gaussians halved",
            "each Gaussian as two half-opaque ones: of faint ones neither reaches 1/255",
            world.clone().with_gaussians_halved(),
            Some((0..n).flat_map(|i| [i, i]).collect()),
            Tolerances { geometry: Some(0.0), graph: Some(0.15), instances: Some(0.25), ..ROUNDING },
        ),
    ];
    let hostile = |name, note, world| case(name, note, world, None, SURVIVE);
    let some = |world: &World, f: fn(usize, &mut Gaussians)| with(world, |g| (0..g.len()).for_each(|i| f(i, g)));
    // Stage 1 goes on from them, all of them.
    let roomy = Options::parse(&SHORT.replace("--max-gaussians 3000", "--max-gaussians 9000")).unwrap_or_default();
    let learnt =
        |name, note, world| Case { from: From::Gaussians, options: roomy.clone(), ..hostile(name, note, world) };
    all.extend([
        learnt(
            "needles",
            "every third Gaussian a million times as long as wide",
            some(world, |i, g| {
                if i % 3 == 0 {
                    g.log_scales[i] = [0.0, -13.8, -13.8];
                }
            }),
        ),
        learnt(
            "huge and tiny scales",
            "scales from 1e-8 to 1e4",
            some(world, |i, g| {
                if i % 50 == 0 {
                    g.log_scales[i] = [[-18.4; 3], [9.2; 3]][(i / 50) % 2];
                }
            }),
        ),
        learnt(
            "denormals",
            "scales and colours below the smallest normal number",
            some(world, |i, g| {
                if i % 4 == 0 {
                    g.log_scales[i] = [-95.0; 3];
                    g.sh[3 * i..3 * i + 3].fill(1e-40);
                }
            }),
        ),
        learnt(
            "duplicates",
            "every Gaussian where one of ten is",
            with(world, |g| {
                for i in 0..g.len() {
                    g.means[i] = g.means[i % 10];
                }
            }),
        ),
        learnt("a plane", "all centres in a plane", with(world, |g| g.means.iter_mut().for_each(|m| m[2] = 0.1))),
        learnt(
            "a line",
            "all centres on a line",
            with(world, |g| g.means.iter_mut().for_each(|m| (m[1], m[2]) = (0.0, 0.1))),
        ),
        learnt("a point", "all centres in a point", with(world, |g| g.means.fill([0.0, 0.0, 0.1]))),
        learnt("transparent", "all opacities 0", with(world, |g| g.opacity_logits.fill(-50.0))),
        learnt("opaque", "all opacities 1", with(world, |g| g.opacity_logits.fill(50.0))),
        learnt("one Gaussian", "nothing but one", with(world, |g| *g = g.select(&[0]))),
        learnt(
            "zero quaternions",
            "every fifth rotation zero",
            some(world, |i, g| {
                if i % 5 == 0 {
                    g.rotations[i] = [0.0; 4];
                }
            }),
        ),
    ]);
    let pictures = |f: &dyn Fn(&mut super::world::Shot)| {
        let mut w = world.clone();
        w.shots.iter_mut().for_each(f);
        w
    };
    let one_view = World { shots: world.shots[..1].to_vec(), ..world.clone() };
    let alone = Options::parse(&SHORT.replace("geometry:", "geometry: --holdout 0")).unwrap_or_default();
    all.extend([
        hostile("black photographs", "every pixel 0", pictures(&|s| s.image.rgb.fill(0.0))),
        hostile("white photographs", "every pixel 1", pictures(&|s| s.image.rgb.fill(1.0))),
        Case { options: alone, ..hostile("one view", "a single photograph", one_view) },
        hostile("one mask", "the same single mask everywhere", pictures(&|s| s.masks.ids.fill(0))),
        hostile("no masks", "no mask anywhere", pictures(&|s| s.masks.ids.fill(-1))),
        hostile(
            "thousands of masks",
            "every four by four pixels a mask of their own",
            pictures(&|s| {
                let (w, n) = (s.masks.width, s.masks.width * s.masks.height);
                let tiles = w.div_ceil(4);
                for (i, id) in s.masks.ids.iter_mut().enumerate() {
                    let p = i % n;
                    *id = (i / n * (n.div_ceil(4)) + p / w / 4 * tiles + p % w / 4) as i32;
                }
            }),
        ),
        hostile(
            "camera inside a thing",
            "every camera at the middle of the Gaussians",
            pictures(&|s| {
                let middle = DVec3::from(world.gaussians.means[0].map(f64::from));
                s.camera.translation = -(s.camera.rotation * middle);
            }),
        ),
        hostile(
            "focal length 1",
            "cameras that see half the world",
            pictures(&|s| (s.camera.fx, s.camera.fy) = (1.0, 1.0)),
        ),
        hostile(
            "focal length 1e5",
            "cameras that see a few points",
            pictures(&|s| (s.camera.fx, s.camera.fy) = (1e5, 1e5)),
        ),
    ]);
    let settings = [
        ("tau 1e-4", "temperature 0.0001", "features: --method contrastive --iterations 300 --tau 0.0001"),
        ("tau 10", "temperature 10", "features: --method contrastive --iterations 300 --tau 10"),
        (
            "learning rates x 100",
            "features and weights",
            "features: --method contrastive --iterations 300 --lr 0.1 --weight-lr 0.1",
        ),
        (
            "100,000 iterations",
            "contrastive training, ten times the paper's",
            "features: --method contrastive --iterations 100000 --checkpoint-every 0",
        ),
        (
            "one number a feature",
            "contrastive features of dimension 1",
            "features: --method contrastive --iterations 300 --dim 1",
        ),
    ];
    for (name, note, options) in settings {
        let options = Options::parse(options).unwrap_or_default();
        let (world, tolerances) = (world.clone(), Tolerances::default());
        all.push(Case { name, note, world, origin: None, tolerances, options, from: From::Features });
    }
    let fast = "geometry: --iterations 80 --sh-degree 0 --opacity-rate 5 --position-rate 0.016";
    let options = Options::parse(fast).unwrap_or_default();
    let name = "learning rates of the geometry x 100";
    all.push(Case { options, ..case(name, "opacities and positions", world.clone(), None, SURVIVE) });
    all
}
