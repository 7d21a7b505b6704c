//! `gs-geom train --time-budget`: measures the speed, plans, and prints the plan as options.

pub mod plan;

use crate::densification::Strategy;
use crate::densification::adaptive::Adaptive;
use crate::densification::rules::Growth;
use crate::options::Train;
use crate::photographs::Photographs;
use crate::photographs::masks::Masks;
use crate::run::forecast::{cache_bytes, forecast_start, most_gaussians};
use crate::run::init;
use crate::run::outputs::plan_path;
use crate::start;
use crate::training::poses::Poses;
use crate::training::schedule::{Purpose, Schedule, generator};
use crate::training::{Recipe, Trainer, checkpoint};
use gs_io::{Result, Watched, write_json};
use gs_scene::dataset::{Dataset, Resolution, View};
use gs_scene::{Camera, Gaussians};
use plan::{Limits, Plan, Speed, plan};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use stage::Stage;
use std::time::Instant;

/// Photographs that the speed is measured on, evenly spread.
const VIEWS: usize = 6;
/// Iterations with small pictures before the measurements: new Gaussians are fainter than those of most of a run.
const WARM_UP: u32 = 30;
/// Divisor of the picture size for the warm-up and one of the measurements.
const SMALL: u32 = 4;
/// Share of the time to plan with; the rest is for what the plan does not see.
const SHARE: f64 = 0.86;
/// Narrower pictures are not planned, pixels.
const LEAST_WIDTH: f64 = 160.0;

/// What is kept of a plan until its run is done: a run that goes on after an interruption does not plan anew.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Kept {
    /// The time that was given, seconds.
    budget: f64,
    /// As `--resolution` says it.
    resolution: String,
    plan: Plan,
    /// What the plan rests on.
    speed: Speed,
}

/// The options with a plan for `budget` seconds since the program began in place of the budget, and the plan for the record.
pub(crate) fn plan_for(
    options: &Train,
    budget: f64,
    dataset: &Dataset,
    masks: &Masks,
    stage: &Stage,
) -> Result<(Train, Value)> {
    let kept = match kept(options, budget) {
        Some(kept) => kept,
        None => measured(options, budget, dataset, masks, stage)?,
    };
    let Plan { iterations, gaussians, seconds, .. } = kept.plan;
    let mut planned = options.clone();
    planned.iterations = iterations;
    planned.max_gaussians = Some(gaussians);
    planned.scene.resolution = kept.resolution.parse()?;
    let said = format!("--iterations {iterations} --max-gaussians {gaussians} --resolution {}", kept.resolution);
    stage.info(&format!("planned for {budget} s, to take {seconds:.0} s; the same in place of --time-budget: {said}"));
    write_json(plan_path(&options.out), &kept)?;
    Ok((planned, json!({"options": said, "made": kept})))
}

/// The plan of an unfinished run with this budget.
fn kept(options: &Train, budget: f64) -> Option<Kept> {
    if !checkpoint::path_of(&options.out).exists() {
        return None;
    }
    let kept: Kept = serde_json::from_slice(&std::fs::read(plan_path(&options.out)).ok()?).ok()?;
    let plausible = kept.plan.iterations > 0 && kept.plan.gaussians > 0;
    (plausible && kept.budget == budget && kept.resolution.parse::<Resolution>().is_ok()).then_some(kept)
}

/// Measures the speed and plans.
fn measured(options: &Train, budget: f64, dataset: &Dataset, masks: &Masks, stage: &Stage) -> Result<Kept> {
    // The run does again what was done until here, and reads all photographs instead of some.
    let mut again = stage.elapsed().as_secs_f64();
    let most = most_gaussians(options, dataset);
    let recipe = options.recipe(most, stage.seed(), masks.alpha());
    let (train, heldout) = init::split(options, dataset)?;
    let cameras: Vec<&Camera> = train.iter().map(|v| &v.camera).collect();
    let width = cameras.iter().map(|c| c.width).max().unwrap_or(1);
    let extent = start::extent(&cameras, &dataset.points.positions);
    forecast_start(options, dataset, masks, &recipe.growth, stage)?;
    let start = Instant::now();
    let gaussians = init::gaussians(options, dataset, &cameras, extent, stage)?;
    again += start.elapsed().as_secs_f64();
    let some = train.len().min(VIEWS);
    let views: Vec<&View> = (0..some).map(|i| train[i * train.len() / some]).collect();
    let watched = Watched::default();
    let start = Instant::now();
    let photographs = Photographs::load(views, masks.clone(), cache_bytes(options), &watched)?;
    again += start.elapsed().as_secs_f64() * dataset.views.len() as f64 / some as f64;
    let count = gaussians.len();
    let none = Photographs::load(Vec::new(), Masks::default(), 0, &watched)?;
    let speed = probe(recipe, extent, photographs, none, gaussians)?;

    let limits = Limits {
        seconds: (SHARE * budget - stage.elapsed().as_secs_f64() - again).max(0.0),
        iterations: options.iterations,
        start: count,
        gaussians: if options.densify == Strategy::Fixed { count } else { most.max(count) },
        divisor: (f64::from(width) / LEAST_WIDTH).max(1.0),
        heldout: heldout.len(),
    };
    let plan = plan(&speed, &limits, |iterations| {
        let recipe = Train { iterations, ..options.clone() }.recipe(most, stage.seed(), masks.alpha());
        (recipe.schedule, recipe.growth)
    });
    let resolution = match plan.divisor > 1.0 {
        true => Resolution::Width((f64::from(width) / plan.divisor).round().max(1.0) as u32),
        false => options.scene.resolution,
    };
    if plan.seconds > limits.seconds {
        stage.warn(&format!("{budget} s are too few for this scene"));
    }
    Ok(Kept { budget, resolution: resolution.to_string(), plan, speed })
}

/// Times iterations on a copy of the start: after a warm-up with small pictures, with full ones, and with twice the
/// Gaussians.
fn probe<'a>(
    recipe: Recipe,
    extent: f64,
    photographs: Photographs<'a>,
    heldout: Photographs<'a>,
    start: Gaussians,
) -> Result<Speed> {
    let count = start.len();
    let views = photographs.len() as u32;
    let warm = WARM_UP.max(views);
    // Iterations after the last are not run; the rates and the degree of the harmonics are those of a run's middle.
    let schedule =
        Schedule { iterations: warm + 3 * views, sh_every: (warm / 4).max(1), coarse: vec![(warm + views, SMALL)] };
    let growth = Growth { until: 0, ..recipe.growth };
    let exposures = if recipe.exposure { photographs.len() } else { 0 };
    let state = checkpoint::start(start, exposures, Poses::default());
    let recipe = Recipe { schedule, growth, poses: None, ..recipe };
    let mut trainer = Trainer::new(recipe, extent, photographs, heldout, state);
    let time = |trainer: &mut Trainer<'_>, iterations: u32| -> Result<f64> {
        let begun = Instant::now();
        (0..iterations).try_for_each(|_| trainer.step())?;
        Ok(begun.elapsed().as_secs_f64() / f64::from(iterations))
    };
    time(&mut trainer, warm)?;
    let small = time(&mut trainer, views)?;
    let full = time(&mut trainer, views)?;
    let all = Adaptive { gradient: 0.0, clone_scale: 0.0, ..Adaptive::default() };
    all.densify(&mut trainer.state, usize::MAX, extent as f32, &mut generator(0, Purpose::Split, 0));
    let doubled = time(&mut trainer, views)?;
    Ok(Speed::fit(count, full, (1.0 / f64::from(SMALL * SMALL), small), doubled))
}
