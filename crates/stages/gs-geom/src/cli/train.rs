//! `gs-geom train`.

mod finish;
mod forecast;
mod start;

use self::finish::spent_since;
use super::budget::plan_path;
use super::{Background, MaskArgs, SceneArgs};
use crate::checkpoint::{self, State};
use crate::content::{self, Gain};
use crate::densify::{DensifyOptions, Strategy};
use crate::init;
use crate::masks::Masks;
use crate::mcmc::McmcOptions;
use crate::photographs::{Photographs, full_share};
use crate::schedule::{LearningRates, Schedule};
use crate::train::{TrainOptions, Trainer};
use artifacts::role;
use clap::ValueEnum;
use gs_io::{Claim, Error, Provenance, Result, Watched, hash_file, with_suffix};
use gs_scene::dataset::{Dataset, Split, View};
use gs_scene::{Camera, Gaussians, ply};
use serde_json::{Value, json};
use stage::{Bytes, Stage};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::str::FromStr;
use std::time::Instant;

/// Arguments of `gs-geom train`.
#[derive(Debug, Clone, clap::Args)]
pub(super) struct TrainArgs {
    #[command(flatten)]
    pub(super) scene: SceneArgs,
    #[command(flatten)]
    pub(super) masks: MaskArgs,
    /// Where to write the Gaussians, as a 3DGS PLY; checkpoint, training curve and record of the run lie beside it
    #[arg(long, value_name = "FILE")]
    pub(super) out: PathBuf,
    /// Steps of the optimiser, one view each; with --time-budget at most
    #[arg(long, value_name = "COUNT", default_value_t = 30_000)]
    pub(super) iterations: u32,
    /// Plan iterations, picture size and --max-gaussians so as to end within this time, such as 90s, 10m or 1h. The plan
    /// depends on the machine's speed; it is said as options that give the same bytes anywhere
    #[arg(long, value_name = "TIME", value_parser = super::budget::seconds)]
    pub(super) time_budget: Option<f64>,
    /// Degree of the spherical harmonics, 0 to 3
    #[arg(long, value_name = "DEGREE", default_value_t = 3, value_parser = clap::value_parser!(u8).range(0..=3))]
    sh_degree: u8,
    /// What to start from: the dataset's points (random ones where it has none), random points in front of the cameras, or
    /// a PLY of Gaussians or of points
    #[arg(long, value_name = "points|random|FILE.ply", default_value = "points")]
    init: Init,
    /// How many random points to start from, at most 1e9
    #[arg(long, value_name = "COUNT", default_value_t = 20_000)]
    init_points: usize,
    /// Keep number, order and positions of the points: Gaussian i is point i (ScanNet protocol)
    #[arg(long)]
    pub(super) fixed_points: bool,
    /// Keep Gaussians too faint to be drawn from anywhere
    #[arg(long)]
    no_skip: bool,
    /// How the number of Gaussians grows
    #[arg(long, value_enum, default_value_t = Strategy::default())]
    densify: Strategy,
    /// Most Gaussians there may be; with --densify mcmc how many there will be, if the iterations suffice [one for
    /// 100 pixels of the training photographs, but at least 10,000 and twice as many as there are at the start]
    #[arg(long, value_name = "COUNT")]
    pub(super) max_gaussians: Option<usize>,
    /// Keep the light of Gaussians smaller than a pixel (the 2D filter of Mip-Splatting), so that renders at other sizes
    /// than the photographs' are neither thick nor dark. The PLY says so, and render and eval do as it says
    #[arg(long)]
    antialias: bool,
    /// Learn an affine map of colours for each training photograph, for cameras that chose exposure or white balance by
    /// themselves; held-out views are rendered at the photographs' mean
    #[arg(long)]
    exposure: bool,
    /// Weight of 1 - SSIM in the loss, 0 to 1
    #[arg(long, value_name = "WEIGHT", default_value_t = 0.2)]
    dssim: f32,
    /// Clone or split Gaussians whose projection is pulled harder than this, on average [0.0002; absgrad 0.0004]
    #[arg(long, value_name = "GRADIENT")]
    densify_gradient: Option<f32>,
    /// Densify after this iteration [a twentieth of the iterations, at most 500]
    #[arg(long, value_name = "ITERATION")]
    densify_from: Option<u32>,
    /// Densify and reset opacities before this iteration [half the iterations; more in runs below 15,000; mcmc 5/6]
    #[arg(long, value_name = "ITERATION")]
    densify_until: Option<u32>,
    /// Iterations between densifications [a thirtieth of the iterations, 50 to 100]
    #[arg(long, value_name = "COUNT")]
    densify_every: Option<u32>,
    /// Iterations between opacity resets, 0 for none [3000]
    #[arg(long, value_name = "COUNT")]
    opacity_reset_every: Option<u32>,
    /// Remove Gaussians larger than this share of the scene's extent at each densification; 3DGS has 0.1, which tears holes
    /// into plain walls and tables [none]
    #[arg(long, value_name = "SHARE")]
    max_scale: Option<f32>,
    /// Iterations after which the spherical harmonics gain a degree [a tenth of the iterations, at most 1000]
    #[arg(long, value_name = "COUNT")]
    sh_every: Option<u32>,
    /// Learning rate of the opacities; 3DGS had 0.05 first and 0.025 later
    #[arg(long, value_name = "RATE", default_value_t = LearningRates::default().opacity)]
    opacity_rate: f64,
    /// Learning rate of the positions at the start, per unit of the scene's extent; a hundredth of it at the end
    #[arg(long, value_name = "RATE", default_value_t = LearningRates::default().position)]
    position_rate: f64,
    /// Picture sizes to begin with
    #[arg(long, value_enum, default_value_t = Sizes::Coarse)]
    schedule: Sizes,
    /// Which Gaussians a step moves
    #[arg(long, value_enum, default_value_t = Moves::Dense)]
    adam: Moves,
    /// Memory for decoded photographs, such as 512M or 2G; the rest is decoded anew each time. 0 keeps none
    #[arg(long, value_name = "BYTES", default_value_t = Bytes(2 << 30))]
    image_cache: Bytes,
    /// Write a checkpoint every so many iterations (500) or seconds (60s); a run that finds one goes on from it
    #[arg(long, value_name = "COUNT|SECONDS", default_value = "60s")]
    checkpoint_every: Every,
    /// Keep the checkpoint at the end, so that the same command with more --iterations can go on from it: what was done
    /// stays, and from there on the longer run's schedule holds (rates, densification, degree)
    #[arg(long)]
    keep_state: bool,
    /// Ignore a checkpoint and begin anew
    #[arg(long)]
    pub(super) no_resume: bool,
    /// Stop after this iteration with a checkpoint and <out>.partial.ply, as an interruption would
    #[arg(long, value_name = "ITERATION")]
    stop_after: Option<u32>,
}

/// By default there is at most one Gaussian for so many pixels of the training photographs (docs/geometry.md).
const PIXELS_PER_GAUSSIAN: usize = 100;
/// The budget is never less by itself.
const LEAST_BUDGET: usize = 10_000;

/// What lies beside the output: the training curve and its plot, the photographs' exposures, and the Gaussians of an
/// unfinished run.
const CURVE: &str = ".curve.jsonl";
const PLOT: &str = ".curve.svg";
const EXPOSURES: &str = ".exposures.json";
const PARTIAL: &str = ".partial.ply";

/// What to start from.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Init {
    Points,
    Random,
    File(PathBuf),
}

impl FromStr for Init {
    type Err = std::convert::Infallible;

    fn from_str(s: &str) -> std::result::Result<Self, Self::Err> {
        Ok(match s {
            "points" => Self::Points,
            "random" => Self::Random,
            file => Self::File(file.into()),
        })
    }
}

/// Picture sizes in the course of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Sizes {
    /// From an eighth up, each for as long as the photographs' content allows (DashGaussian)
    Content,
    /// A quarter, from a sixth of the iterations half, from a third full; at the latest from the 500th and the 1,000th
    Coarse,
    /// Full from the start
    Full,
}

/// Which Gaussians a step of Adam moves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Moves {
    /// Those that the view draws
    Sparse,
    /// All
    Dense,
}

/// How often to write a checkpoint.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Every {
    Iterations(u32),
    Seconds(f64),
}

impl FromStr for Every {
    type Err = Error;

    fn from_str(s: &str) -> Result<Self> {
        let wrong = || Error::new("not a period").found(s).expected("iterations such as 500, or seconds such as 60s");
        match s.strip_suffix('s') {
            Some(t) => t.parse().ok().filter(|t: &f64| *t >= 0.0).map(Self::Seconds).ok_or_else(wrong),
            None => s.parse().ok().filter(|n: &u32| *n > 0).map(Self::Iterations).ok_or_else(wrong),
        }
    }
}

impl TrainArgs {
    pub(super) fn options(&self, seed: u64) -> Result<TrainOptions> {
        let positive = |field: &str, value: f64, most: f64| {
            if value > 0.0 && value <= most {
                return Ok(());
            }
            Err(Error::new("out of range").field(field).found(value).expected(format!("more than 0, at most {most}")))
        };
        positive("--iterations", f64::from(self.iterations), 1e8)?;
        let gradient = self.densify_gradient.unwrap_or(self.densify.gradient());
        positive("--densify-gradient", f64::from(gradient), 1e9)?;
        positive("--opacity-rate", self.opacity_rate, 10.0)?;
        positive("--position-rate", self.position_rate, 10.0)?;
        positive("--init-points", self.init_points as f64, 1e9)?;
        if let Some(most) = self.max_gaussians {
            positive("--max-gaussians", most as f64, 1e9)?;
        }
        if let Some(scale) = self.max_scale {
            positive("--max-scale", f64::from(scale), 1e9)?;
        }
        if !(0.0..=1.0).contains(&self.dssim) {
            return Err(Error::new("out of range").field("--dssim").found(self.dssim).expected("0 to 1"));
        }
        let mut schedule = Schedule::for_iterations(self.iterations);
        if self.densify == Strategy::Mcmc {
            // It moves Gaussians where they are of use, to which there is no harm late.
            schedule.densify_until = self.iterations - self.iterations / 6;
        }
        let set = |to: &mut u32, from: Option<u32>, least: u32| *to = from.map_or(*to, |v| v.max(least));
        set(&mut schedule.densify_from, self.densify_from, 0);
        set(&mut schedule.densify_until, self.densify_until, 0);
        set(&mut schedule.densify_every, self.densify_every, 1);
        set(&mut schedule.opacity_reset_every, self.opacity_reset_every, 0);
        set(&mut schedule.sh_every, self.sh_every, 1);
        Ok(TrainOptions {
            seed,
            schedule,
            rates: LearningRates {
                opacity: self.opacity_rate,
                position: self.position_rate,
                position_end: self.position_rate / 100.0,
                ..LearningRates::default()
            },
            densify: DensifyOptions {
                gradient,
                max_gaussians: self.max_gaussians.unwrap_or(usize::MAX),
                max_scale: self.max_scale,
                ..DensifyOptions::of(self.densify)
            },
            mcmc: McmcOptions::default(),
            sparse_adam: self.adam == Moves::Sparse,
            dssim_weight: self.dssim,
            background: self.scene.background.color(),
            random_background: self.scene.background == Background::Random,
            alpha: self.masks.alpha(),
            antialias: self.antialias,
            exposure: self.exposure,
            fixed_points: self.fixed_points,
        })
    }

    pub(super) fn run(&self, stage: &Stage) -> Result<()> {
        // From here on a signal ends the run with a checkpoint.
        stage.interrupted();
        let dataset = self.scene.load(stage)?;
        let masks = self.masks.load(&dataset, stage)?;
        let mut claim = self.claim(&dataset, &masks, stage)?;
        match self.time_budget {
            Some(seconds) => {
                let (planned, plan) = self.plan(seconds, &dataset, &masks, stage)?;
                let dataset = planned.scene.load_quietly()?;
                planned.train(plan, &dataset, masks, &mut claim, stage)
            }
            None => self.train(Value::Null, &dataset, masks, &mut claim, stage),
        }
    }

    /// The budget of Gaussians. A scene of many or large photographs shows more than one of few or small ones.
    pub(super) fn most_gaussians(&self, dataset: &Dataset) -> usize {
        let pixels = |v: &View| v.camera.width as usize * v.camera.height as usize;
        let shown = dataset.views_of(Split::Train).map(pixels).sum::<usize>() / PIXELS_PER_GAUSSIAN;
        self.max_gaussians.unwrap_or(shown.max(2 * dataset.points.len()).max(LEAST_BUDGET))
    }

    pub(super) fn cache_bytes(&self) -> usize {
        usize::try_from(self.image_cache.0).unwrap_or(usize::MAX)
    }

    /// Where the picture sizes come from for [`Self::coarse`].
    pub(super) fn gains(&self, photographs: &Photographs<'_>) -> Result<Vec<Gain>> {
        if self.schedule == Sizes::Content { content::measure(photographs) } else { Ok(Vec::new()) }
    }

    /// Picture sizes before the full one.
    pub(super) fn coarse(&self, gains: &[Gain], iterations: u32) -> Vec<(u32, u32)> {
        match self.schedule {
            Sizes::Content => content::stages(gains, iterations),
            Sizes::Coarse => vec![((iterations / 6).min(500), 4), ((iterations / 3).min(1000), 2)],
            Sizes::Full => Vec::new(),
        }
    }

    /// The run itself; `plan` is how its options came about, for the record.
    fn train(&self, plan: Value, dataset: &Dataset, masks: Masks, claim: &mut Claim, stage: &Stage) -> Result<()> {
        let mut options = self.options(stage.seed())?;
        options.densify.max_gaussians = self.most_gaussians(dataset);
        let of = |split: Split| dataset.views_of(split).collect::<Vec<&View>>();
        let (train, heldout) = (of(Split::Train), of(Split::Test));
        if train.is_empty() {
            return Err(Error::new("every view is held out")
                .file(&self.scene.scene)
                .found(format!("{} views", dataset.views.len()))
                .expected("at least one view to learn from")
                .hint("give --holdout 0, or more photographs"));
        }
        let watched = self.watched(dataset, &masks);
        let forecast = self.forecast_start(dataset, &masks, &options.schedule, stage)?;
        let photographs = Photographs::load(train.clone(), masks.clone(), self.cache_bytes(), &watched)?;
        options.schedule.coarse = self.coarse(&self.gains(&photographs)?, self.iterations);

        let mut inputs = BTreeMap::from([(role::DATASET.to_string(), dataset.hash()?)]);
        if let Init::File(init) = &self.init {
            inputs.insert("init".into(), hash_file(init)?);
        }
        if let Some(hash) = masks.hash()? {
            inputs.insert("photograph_masks".into(), hash);
        }
        let parameters = json!({
            "resolution": self.scene.resolution.to_string(),
            "holdout": self.scene.holdout,
            "sh_degree": self.sh_degree,
            "init": match &self.init {
                Init::Points => "points",
                Init::Random => "random",
                Init::File(_) => "file",
            },
            "init_points": self.init_points,
            "no_skip": self.no_skip,
            "options": options,
        });
        let run = stage.provenance(checkpoint::FORMAT, checkpoint::VERSION, parameters, inputs);

        let cameras: Vec<&Camera> = train.iter().map(|v| &v.camera).collect();
        let extent = init::extent(&cameras, &dataset.points.positions);
        let saved = self.saved(&run, stage);
        let state = match saved {
            Some(state) => state,
            None => {
                let exposures = if self.exposure { train.len() } else { 0 };
                checkpoint::start(self.start(dataset, &cameras, extent, stage)?, exposures)
            }
        };
        self.check_finite(&state.gaussians, state.progress.iteration)?;
        stage.info(&format!(
            "{} training views and {} held out, {}x{} pixels; {} Gaussians; extent {extent:.3}",
            train.len(),
            heldout.len(),
            cameras[0].width,
            cameras[0].height,
            state.gaussians.len()
        ));
        if !options.schedule.coarse.is_empty() {
            let sizes = options.schedule.coarse.iter().map(|(last, divisor)| format!("1/{divisor} until {last}"));
            stage.info(&format!("picture sizes: {}, then full", sizes.collect::<Vec<_>>().join(", ")));
        }
        let forecast = self.forecast(forecast, dataset, &state.gaussians, stage)?;
        // The training views' smaller pictures are not there yet.
        let left = full_share(self.cache_bytes()).saturating_sub(photographs.kept_bytes());
        let heldout = Photographs::load(heldout, masks, left, &watched)?;
        let mut trainer = Trainer::resume(options, extent, photographs, heldout, state);
        let before = stage::cpu_seconds();
        let done = self.optimise(&mut trainer, &run, &watched, stage).and_then(|done| match done {
            true => watched
                .check()
                .and_then(|()| self.finish(&mut trainer, &run, &forecast, (plan, spent_since(before)), claim, stage)),
            false => Ok(()),
        });
        done.inspect_err(|_| self.rescue(&trainer, &run, stage))
    }

    /// The right to write everything that a run may leave.
    fn claim(&self, dataset: &Dataset, masks: &Masks, stage: &Stage) -> Result<Claim> {
        let exposures = Some(EXPOSURES).filter(|_| self.exposure);
        let beside = [CURVE, PLOT, PARTIAL].into_iter().chain(exposures).map(|suffix| with_suffix(&self.out, suffix));
        let outputs = stage.outputs(&self.out).file(&self.out).files(beside).file(plan_path(&self.out));
        let outputs = outputs.artifact(checkpoint::path_of(&self.out), checkpoint::FORMAT);
        let init = match &self.init {
            Init::File(path) => Some(path.clone()),
            _ => None,
        };
        outputs.reads(dataset.files.iter().cloned().chain(masks.files()).chain(init)).drop_stale().claim()
    }

    /// The files that are hashed at one time and read at another.
    fn watched(&self, dataset: &Dataset, masks: &Masks) -> Watched {
        let init = match &self.init {
            Init::File(path) => Some(path),
            _ => None,
        };
        let masks = dataset.views.iter().filter_map(|v| masks.of(v));
        Watched::by_content(dataset.views.iter().map(|v| &*v.image_path).chain(masks).chain(init.map(|i| &**i)))
    }

    /// Saves what a failing run has done. An interrupted one has done so already. Where a photograph has changed it is what the
    /// old one taught: none is used that is not as it was.
    fn rescue(&self, trainer: &Trainer<'_>, run: &Provenance, stage: &Stage) {
        let iteration = trainer.state().progress.iteration;
        // What is not finite stays so: there is nothing to save.
        if stage.interrupted() || self.check_finite(&trainer.state().gaussians, iteration).is_err() {
            return;
        }
        match self.save(trainer, run) {
            Ok(()) => stage.warn(&format!(
                "saved a checkpoint after iteration {iteration}; mend the error below, and the same command goes on from it"
            )),
            Err(e) => stage.warn(&format!("no checkpoint after iteration {iteration} could be saved: {e}")),
        }
    }

    /// Refuses Gaussians that are not finite: no stage can use them, and no later step makes them finite.
    pub(super) fn check_finite(&self, gaussians: &Gaussians, iteration: u32) -> Result<()> {
        let bad: Vec<usize> = (0..gaussians.len()).filter(|&i| !gaussians.is_finite(i)).collect();
        match bad.first() {
            None => Ok(()),
            Some(first) => Err(Error::new("Gaussians are not finite; nothing is written")
                .file(&self.out)
                .field(format!("iteration {iteration}"))
                .found(format!("{} of {}, the first is {first}", bad.len(), gaussians.len()))
                .expected("finite numbers in all")
                .hint("check the scene's points and poses, or give a lower --position-rate")),
        }
    }

    /// The state of an interrupted run of the same parameters and inputs.
    fn saved(&self, run: &Provenance, stage: &Stage) -> Option<State> {
        let path = checkpoint::path_of(&self.out);
        if self.no_resume {
            return None;
        }
        match checkpoint::read(&path, run) {
            Ok(state) => {
                if let Some(state) = &state {
                    let from = state.progress.iteration;
                    stage.info(&format!("going on after iteration {from}"));
                    if state.progress.extended.last() == Some(&from) {
                        stage.info(&format!("from here on with the schedule of {} iterations", self.iterations));
                    }
                }
                state
            }
            Err(e) => {
                stage.warn(&format!("beginning anew: {e}"));
                None
            }
        }
    }

    /// Runs the iterations; whether all are done.
    fn optimise(&self, trainer: &mut Trainer<'_>, run: &Provenance, watched: &Watched, stage: &Stage) -> Result<bool> {
        let first = trainer.state().progress.iteration;
        let mut progress = stage.progress("iteration", self.iterations.into()).resumed_at(first.into());
        let mut saved = Instant::now();
        let mut smooth: Option<f64> = None;
        trainer.complete_curve()?;
        while !trainer.is_done() {
            let iteration = trainer.state().progress.iteration;
            let stop = self.stop_after.is_some_and(|last| iteration >= last);
            if stop || stage.interrupted() {
                self.save(trainer, run)?;
                let partial = with_suffix(&self.out, PARTIAL);
                let note = format!("unfinished: {iteration} of {} iterations", self.iterations);
                ply::write_gaussians(&partial, &trainer.state().gaussians, &[note])?;
                stage.info(&format!(
                    "stopped after iteration {iteration}; the same command goes on from here. The Gaussians so far: {}",
                    partial.display()
                ));
                return if stop { Ok(false) } else { Err(Error::new("interrupted")) };
            }
            trainer.step()?;
            let iteration = iteration + 1;
            let loss = trainer.last_loss().total;
            let s = smooth.get_or_insert(loss);
            *s += 0.02 * (loss - *s);
            let gaussians = trainer.state().gaussians.len() as f64;
            let fields = [("loss", *s), ("Gaussians", gaussians), ("psnr", trainer.last_heldout().unwrap_or(0.0))];
            let fields = if trainer.last_heldout().is_some() { &fields[..] } else { &fields[..2] };
            progress.set(iteration.into(), fields);
            let due = match self.checkpoint_every {
                Every::Iterations(n) => iteration.is_multiple_of(n),
                Every::Seconds(s) => saved.elapsed().as_secs_f64() >= s,
            };
            if due && !trainer.is_done() {
                // Those that are kept in memory are not read again: a run that nobody can repeat should end here.
                watched.check_those_left()?;
                self.save(trainer, run)?;
                saved = Instant::now();
            }
        }
        progress.finish(&[("loss", smooth.unwrap_or(0.0))]);
        Ok(true)
    }

    fn save(&self, trainer: &Trainer<'_>, run: &Provenance) -> Result<()> {
        self.check_finite(&trainer.state().gaussians, trainer.state().progress.iteration)?;
        checkpoint::write(&checkpoint::path_of(&self.out), trainer.state(), run.clone())
    }
}

pub(super) fn remove_if_there(path: &Path) {
    // What cannot be removed does no harm.
    let _ = std::fs::remove_file(path);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn processor_time_passes() {
        if let Some(before) = stage::cpu_seconds() {
            let begun = Instant::now();
            while stage::cpu_seconds().is_some_and(|t| t <= before) {
                assert!(begun.elapsed().as_secs() < 60);
            }
        }
    }

    #[test]
    fn periods_are_read() {
        assert_eq!("40".parse::<Every>().unwrap(), Every::Iterations(40));
        assert_eq!("2.5s".parse::<Every>().unwrap(), Every::Seconds(2.5));
        for wrong in ["0", "-1", "s", "x", "-3s", ""] {
            assert!(wrong.parse::<Every>().is_err(), "{wrong}");
        }
    }
}
