//! `gs-geom train --time-budget`: measures the speed, plans, and says the plan as options.

use super::train::TrainArgs;
use crate::densify::{DensifyOptions, densify};
use crate::init;
use crate::masks::Masks;
use crate::photographs::Photographs;
use crate::plan::{Limits, Plan, Speed, plan};
use crate::schedule::{Purpose, Schedule, generator};
use crate::train::{TrainOptions, Trainer};
use gs_io::{Error, Result, Watched, with_suffix, write_bytes};
use gs_scene::dataset::{Dataset, Resolution, Split, View};
use gs_scene::{Camera, Gaussians};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use stage::Stage;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Photographs that the speed is measured on, evenly spread.
const VIEWS: usize = 6;
/// Iterations with small pictures before the measurements: new Gaussians are fainter than those of most of a run.
const WARM_UP: u32 = 30;
/// Divisor of the picture size for the warm-up and one of the measurements.
const SMALL: u32 = 4;
/// Share of the time to plan with; the rest is for what the plan does not see.
const SHARE: f64 = 0.92;
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

/// Where the plan of an output lies while its run is unfinished.
pub(super) fn plan_path(output: &Path) -> PathBuf {
    with_suffix(output, ".plan.json")
}

/// Reads `90`, `90s`, `10m` or `1.5h` as seconds.
pub(super) fn seconds(text: &str) -> Result<f64> {
    let units = [("s", 1.0), ("m", 60.0), ("h", 3600.0)];
    let (number, unit) =
        units.iter().find_map(|(suffix, unit)| Some((text.strip_suffix(suffix)?, *unit))).unwrap_or((text, 1.0));
    let seconds = number.parse::<f64>().ok().map(|n| n * unit).filter(|s| *s > 0.0 && s.is_finite());
    seconds.ok_or_else(|| Error::new("not a time").found(text).expected("a time such as 90s, 10m or 1.5h"))
}

impl TrainArgs {
    /// These arguments with a plan for `budget` seconds in place of the budget, and the plan for the record.
    pub(super) fn plan(&self, budget: f64, dataset: &Dataset, masks: &Masks, stage: &Stage) -> Result<(Self, Value)> {
        let kept = match self.kept(budget) {
            Some(kept) => kept,
            None => self.measured(budget, dataset, masks, stage)?,
        };
        let Plan { iterations, gaussians, seconds, .. } = kept.plan;
        let mut planned = self.clone();
        planned.iterations = iterations;
        planned.max_gaussians = Some(gaussians);
        planned.scene.resolution = kept.resolution.parse()?;
        let options = format!("--iterations {iterations} --max-gaussians {gaussians} --resolution {}", kept.resolution);
        stage.info(&format!("planned for {budget} s, to take {seconds:.0} s; the same without a budget:"));
        let typed = std::env::args_os().map(|a| a.to_string_lossy().into_owned()).collect();
        stage.info(&command(typed, &options));
        let text = serde_json::to_vec_pretty(&kept).map_err(|e| Error::new(e.to_string()))?;
        write_bytes(plan_path(&self.out), &text)?;
        Ok((planned, json!({"options": options, "made": kept})))
    }

    /// The plan of an unfinished run with this budget.
    fn kept(&self, budget: f64) -> Option<Kept> {
        if self.no_resume || !crate::checkpoint::path_of(&self.out).exists() {
            return None;
        }
        let kept: Kept = serde_json::from_slice(&std::fs::read(plan_path(&self.out)).ok()?).ok()?;
        let plausible = kept.plan.iterations > 0 && kept.plan.gaussians > 0;
        (plausible && kept.budget == budget && kept.resolution.parse::<Resolution>().is_ok()).then_some(kept)
    }

    /// Measures the speed and plans.
    fn measured(&self, budget: f64, dataset: &Dataset, masks: &Masks, stage: &Stage) -> Result<Kept> {
        let begun = Instant::now();
        let options = self.options(stage.seed())?;
        let train: Vec<&View> = dataset.views_of(Split::Train).collect();
        let cameras: Vec<&Camera> = train.iter().map(|v| &v.camera).collect();
        let Some(width) = cameras.iter().map(|c| c.width).max() else {
            return Err(Error::new("every view is held out").file(&self.scene.scene).hint("give --holdout 0"));
        };
        let extent = init::extent(&cameras, &dataset.points.positions);
        self.forecast_start(dataset, masks, &options.schedule, stage)?;
        let start = self.start(dataset, &cameras, extent, stage)?;
        let some = train.len().min(VIEWS);
        let views: Vec<&View> = (0..some).map(|i| train[i * train.len() / some]).collect();
        let watched = Watched::default();
        let photographs = Photographs::load(views, masks.clone(), self.cache_bytes(), &watched)?;
        let gains = self.gains(&photographs)?;
        let count = start.len();
        let speed = probe(options.clone(), extent, photographs, start)?;

        let schedule = |iterations: u32| {
            let mut planned = self.clone();
            planned.iterations = iterations;
            let options = planned.options(stage.seed());
            let schedule = options.map_or_else(|_| Schedule::for_iterations(iterations), |o| o.schedule);
            Schedule { coarse: self.coarse(&gains, iterations), ..schedule }
        };
        let limits = Limits {
            seconds: (SHARE * budget - begun.elapsed().as_secs_f64()).max(0.0),
            iterations: self.iterations,
            start: count,
            gaussians: if self.fixed_points { count } else { self.most_gaussians(dataset).max(count) },
            divisor: (f64::from(width) / LEAST_WIDTH).max(1.0),
            heldout: dataset.views_of(Split::Test).count(),
        };
        let plan = plan(&speed, &limits, schedule);
        let resolution = match plan.divisor > 1.0 {
            true => Resolution::Width((f64::from(width) / plan.divisor).round().max(1.0) as u32),
            false => self.scene.resolution,
        };
        if plan.seconds > limits.seconds {
            stage.warn(&format!("{budget} s are too few for this scene"));
        }
        Ok(Kept { budget, resolution: resolution.to_string(), plan, speed })
    }
}

/// Times iterations on a copy of the start: after a warm-up with small pictures, with full ones, and with twice the
/// Gaussians.
fn probe(options: TrainOptions, extent: f64, photographs: Photographs<'_>, start: Gaussians) -> Result<Speed> {
    let count = start.len();
    let views = photographs.len() as u32;
    let warm = WARM_UP.max(views);
    let mut schedule = Schedule { densify_until: 0, ..Schedule::for_iterations(warm + 3 * views) };
    // Iterations after the last are not run; the rates and the degree of the harmonics are those of a run's middle.
    schedule.sh_every = (warm / 4).max(1);
    schedule.coarse = vec![(warm + views, SMALL)];
    let split = options.densify;
    let mut trainer =
        Trainer::new(TrainOptions { schedule, ..options }, extent, photographs, Photographs::none(), start);
    let time = |trainer: &mut Trainer<'_>, iterations: u32| -> Result<f64> {
        let begun = Instant::now();
        (0..iterations).try_for_each(|_| trainer.step())?;
        Ok(begun.elapsed().as_secs_f64() / f64::from(iterations))
    };
    time(&mut trainer, warm)?;
    let small = time(&mut trainer, views)?;
    let full = time(&mut trainer, views)?;
    trainer.change(|g, adam, pull| {
        let all =
            DensifyOptions { gradient: 0.0, clone_scale: 0.0, max_gaussians: usize::MAX, max_scale: None, ..split };
        let mut rng = generator(0, Purpose::Split, 0);
        densify(g, adam, pull, &all, extent as f32, &mut rng);
    });
    let doubled = time(&mut trainer, views)?;
    Ok(Speed::fit(count, full, (1.0 / f64::from(SMALL * SMALL), small), doubled))
}

/// The command line with `options` in place of the budget and of what they say.
fn command(arguments: Vec<String>, options: &str) -> String {
    let replaced = ["--time-budget", "--iterations", "--max-gaussians", "--resolution"];
    let mut out: Vec<String> = Vec::new();
    let mut skip = false;
    for argument in arguments {
        let name = argument.split('=').next().unwrap_or_default();
        if std::mem::take(&mut skip) {
            continue;
        }
        if replaced.contains(&name) {
            skip = !argument.contains('=');
        } else if argument.chars().all(|c| c.is_ascii_alphanumeric() || "-_./=:,+".contains(c)) && !argument.is_empty()
        {
            out.push(argument);
        } else {
            out.push(format!("'{}'", argument.replace('\'', r"'\''")));
        }
    }
    out.push(options.into());
    out.join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_read() {
        for (text, wanted) in [("90", 90.0), ("90s", 90.0), ("10m", 600.0), ("1.5h", 5400.0)] {
            assert_eq!(seconds(text).unwrap(), wanted);
        }
        for wrong in ["", "m", "-1s", "0", "1d", "infs"] {
            assert!(seconds(wrong).is_err(), "{wrong}");
        }
    }

    #[test]
    fn the_command_line_says_the_plan() {
        let typed = "gs-geom train --scene a/b --time-budget 10m --iterations=5 --out".split(' ').map(String::from);
        let typed: Vec<String> = typed.chain(["it's here".into()]).collect();
        assert_eq!(command(typed, "--iterations 7"), r"gs-geom train --scene a/b --out 'it'\''s here' --iterations 7");
    }
}
