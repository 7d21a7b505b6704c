//! The optimisation loop: [`Trainer::step`] renders a view, takes the gradient of the loss, updates and densifies.

pub mod checkpoint;
pub mod exposure;
pub mod loss;
pub mod optimiser;
pub mod poses;
pub mod schedule;
#[cfg(test)]
mod tests;

use crate::densification::rules::{Growth, Moment};
use crate::densification::{Strategy, Way};
use crate::metrics::{self, Means};
use crate::photographs::masks::{Alpha, multiply};
use crate::photographs::{Photographs, Target};
use checkpoint::State;
use gs_io::Result;
use gs_raster::{PixelGradients, RasterOptions, Workspace, camera_gradient, near_plane};
use gs_scene::{Camera, morton_order};
use gs_sfm::corners::lenses;
use loss::{Derivatives, Loss, Pair, l1_dssim};
use optimiser::drop_bad_gradients;
use poses::{Moment as PoseMoment, PoseRates};
use rand::RngExt;
use schedule::{LearningRates, Purpose, Schedule, ViewOrder, generator};
use serde::Serialize;
use serde_json::{Value, json};
use std::borrow::Cow;
use std::time::{Duration, Instant};

/// Weight of 1 - SSIM in the loss, as 3DGS has it.
const DSSIM_WEIGHT: f32 = 0.2;

/// Every hyper-parameter that shapes the result.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Recipe {
    /// Seed of the views' order and of densification.
    pub seed: u64,
    pub schedule: Schedule,
    pub rates: LearningRates,
    /// How the number of Gaussians changes; none where it stays.
    pub densification: Option<Way>,
    /// When it changes, and how far.
    pub growth: Growth,
    /// Colour behind the scene.
    pub background: [f32; 3],
    /// Train with another colour behind the scene in every iteration, so that what is transparent must be so;
    /// `background` is then for held-out views alone.
    pub random_background: bool,
    /// What transparent pixels of the photographs mean.
    pub alpha: Alpha,
    /// Keep the light of Gaussians smaller than a pixel (the 2D filter of Mip-Splatting, Yu et al. 2024).
    pub antialias: bool,
    /// Whether to train an affine map of colours for each training photograph.
    pub exposure: bool,
    /// How fast poses and focal lengths are refined, where the state has poses; none where they stay.
    pub poses: Option<PoseRates>,
}

impl Recipe {
    /// The defaults of a strategy for a number of iterations.
    pub fn new(strategy: Strategy, iterations: u32) -> Self {
        Self {
            seed: 0,
            schedule: Schedule::for_iterations(iterations),
            rates: strategy.rates(LearningRates::for_iterations(iterations)),
            densification: strategy.way(),
            growth: strategy.growth(iterations),
            background: [0.0; 3],
            random_background: false,
            alpha: Alpha::default(),
            antialias: false,
            exposure: false,
            poses: None,
        }
    }
}

/// How the cameras of held-out views are aligned before they are measured, in the course of the run and at its end: divisor of the pictures,
/// steps, and the first and last of their rates, in radians and extents. Small pictures also bring back what is far off, and cost little.
const ALIGN: [(u32, u32, [f64; 2]); 1] = [(2, 3, [5e-4, 1e-4])];
const ALIGN_LAST: [(u32, u32, [f64; 2]); 3] = [(4, 40, [4e-3, 1e-3]), (2, 40, [2e-3, 4e-4]), (1, 20, [1e-3, 2e-5])];

/// Where the time of an optimisation went.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Timings {
    pub forward: Duration,
    pub loss: Duration,
    pub backward: Duration,
    pub adam: Duration,
    /// Densification, held-out views, photographs.
    pub rest: Duration,
}

/// A view to learn from in one iteration.
struct Frame {
    iteration: u32,
    view: usize,
    camera: Camera,
    target: Target,
    raster: RasterOptions,
}

/// An optimisation under way.
pub struct Trainer<'a> {
    recipe: Recipe,
    extent: f64,
    pub train: Photographs<'a>,
    heldout: Photographs<'a>,
    order: ViewOrder,
    /// The lens of each view, of those to learn from and then of those held out.
    lenses: Vec<usize>,
    pub state: State,
    workspace: Workspace,
    /// d loss / d rendered colour.
    gradient: Vec<f32>,
    /// The render through its view's exposure.
    exposed: Vec<f32>,
    derivatives: Derivatives,
    /// Loss of the last iteration's view.
    pub last: Loss,
    /// PSNR of the last held-out check, dB.
    pub last_heldout: Option<f64>,
    pub timings: Timings,
    clock: Instant,
}

impl<'a> Trainer<'a> {
    /// Goes on from a checkpoint, or from [`checkpoint::start`]. `extent` is the scene's size (see [`crate::start::extent`]);
    /// `heldout` may be empty.
    pub fn new(recipe: Recipe, extent: f64, train: Photographs<'a>, heldout: Photographs<'a>, state: State) -> Self {
        assert_eq!(state.exposures.maps.len(), if recipe.exposure { train.len() } else { 0 });
        let cameras = |p: &Photographs<'_>| (0..p.len()).map(|i| p.camera(i).clone()).collect::<Vec<Camera>>();
        let cameras = [cameras(&train), cameras(&heldout)].concat();
        assert!(
            [0, cameras.len()].contains(&state.poses.views.len())
                && (recipe.poses.is_some() || state.poses.views.is_empty())
        );
        Self {
            order: ViewOrder::new(recipe.seed, train.len()),
            lenses: lenses(&cameras),
            last_heldout: state.progress.curve.iter().rev().find_map(|line| parsed(line)?["psnr_heldout"].as_f64()),
            recipe,
            extent,
            train,
            heldout,
            state,
            workspace: Workspace::default(),
            gradient: Vec::new(),
            exposed: Vec::new(),
            derivatives: Derivatives::default(),
            last: Loss { l1: 0.0, ssim: 0.0, total: 0.0 },
            timings: Timings::default(),
            clock: Instant::now(),
        }
    }

    /// Whether all iterations are done.
    pub fn is_done(&self) -> bool {
        self.state.progress.iteration >= self.recipe.schedule.iterations
    }

    /// One iteration. Where a photograph cannot be decoded again, the state is still good for a checkpoint.
    pub fn step(&mut self) -> Result<()> {
        self.complete_curve()?;
        self.clock = Instant::now();
        let frame = self.frame()?;
        self.render(&frame);
        self.last = self.gradient(&frame);
        self.refine(&frame);
        self.update(&frame);
        self.densify(&frame);
        // Room for the held-out views.
        drop(frame);
        self.note()?;
        lap(&mut self.clock, &mut self.timings.rest);
        Ok(())
    }

    /// The view of the next iteration.
    fn frame(&mut self) -> Result<Frame> {
        let Recipe { schedule, alpha, seed, .. } = &self.recipe;
        let iteration = self.state.progress.iteration + 1;
        self.train.set_divisor(schedule.divisor(iteration))?;
        let view = self.order.at(iteration);
        let background = match self.recipe.random_background {
            true => generator(*seed, Purpose::Background, u64::from(iteration)).random(),
            false => self.recipe.background,
        };
        let raster = RasterOptions {
            background,
            sh_degree: schedule.sh_degree(iteration, self.state.gaussians.sh_degree),
            antialias: self.recipe.antialias,
            near: near_plane(self.extent),
            depth: false,
        };
        let target = self.train.target(view, metrics::behind(*alpha, background))?;
        let camera = self.camera(view, self.train.camera(view));
        lap(&mut self.clock, &mut self.timings.rest);
        Ok(Frame { iteration, view, camera, target, raster })
    }

    fn render(&mut self, frame: &Frame) {
        let State { gaussians, adam, progress, .. } = &mut self.state;
        if let Some(way) = &self.recipe.densification {
            way.rules().before(gaussians, adam, moment(&self.recipe, self.extent, frame.iteration));
        }
        let undrawn = self.workspace.forward(gaussians, &frame.camera, &frame.raster).dropped();
        for (most, now) in progress.undrawn.iter_mut().zip([undrawn.not_finite, undrawn.degenerate]) {
            *most = (*most).max(now as u64);
        }
        lap(&mut self.clock, &mut self.timings.forward);
    }

    /// Compares the render with the photograph: the loss, and its gradient by every parameter.
    fn gradient(&mut self, frame: &Frame) -> Loss {
        let rgb = &self.workspace.forward.rendered.rgb;
        let State { gaussians, exposures, .. } = &mut self.state;
        // What the photograph would show, and which of its pixels count.
        let map = exposures.maps.get(frame.view).copied();
        let mut shown = match &map {
            Some(map) => {
                exposure::apply(map, rgb, &mut self.exposed);
                Cow::Borrowed(&self.exposed[..])
            }
            None => Cow::Borrowed(&rgb[..]),
        };
        let counts = frame.target.alpha.as_ref().filter(|_| self.recipe.alpha == Alpha::Ignore);
        if let Some(counts) = counts {
            multiply(shown.to_mut(), counts);
        }
        let pair = Pair { render: &shown, target: &frame.target.rgb, width: frame.camera.width as usize };
        let loss = l1_dssim(pair, DSSIM_WEIGHT, &mut self.gradient, &mut self.derivatives);
        drop(shown);
        if let Some(counts) = counts {
            multiply(&mut self.gradient, counts);
        }
        if let Some(map) = &map {
            let gradient = exposure::backward(map, rgb, &mut self.gradient);
            exposures.step(frame.view, &gradient, self.recipe.schedule.share(frame.iteration));
        }
        let pixels = PixelGradients { rgb: &self.gradient, alpha: None, depth: None };
        lap(&mut self.clock, &mut self.timings.loss);
        self.workspace.backward(gaussians, &frame.camera, &frame.raster, pixels);
        lap(&mut self.clock, &mut self.timings.backward);
        loss
    }

    /// The camera of a view at the size of the dataset's camera `given`, refined where cameras are.
    fn camera(&self, view: usize, given: &Camera) -> Camera {
        match self.state.poses.views.is_empty() {
            false => self.state.poses.camera(view, self.lenses[view], given),
            true => given.clone(),
        }
    }

    /// The cameras in use, of the views to learn from and then of those held out.
    pub fn cameras(&mut self) -> Result<Vec<Camera>> {
        self.train.set_divisor(1)?;
        let own = (0..self.train.len()).map(|i| self.train.camera(i));
        let all = own.chain((0..self.heldout.len()).map(|i| self.heldout.camera(i)));
        Ok(all.enumerate().map(|(view, given)| self.camera(view, given)).collect())
    }

    /// A step of the cameras.
    fn refine(&mut self, frame: &Frame) {
        let Some(rates) = self.recipe.poses.as_ref().filter(|_| !self.state.poses.views.is_empty()) else { return };
        let g = camera_gradient(&self.state.gaussians, &self.workspace.gradients, &frame.camera, &frame.raster);
        let t = self.recipe.schedule.share(frame.iteration);
        self.state.poses.step(frame.view, self.lenses[frame.view], &g, rates, t, self.extent);
        lap(&mut self.clock, &mut self.timings.backward);
    }

    /// Brings the held-out views' cameras to where the scene as it is shows their photographs best: the scene holds the poses of
    /// the views that it learnt from, and others are off by as much as those were.
    fn align(&mut self, divisor: u32, steps: u32, rates: [f64; 2]) -> Result<()> {
        if self.state.poses.views.is_empty() {
            return Ok(());
        }
        let Recipe { alpha, background, .. } = self.recipe;
        let options = self.heldout_options();
        self.heldout.set_divisor(divisor)?;
        for i in 0..self.heldout.len() {
            let view = self.train.len() + i;
            let target = self.heldout.target(i, metrics::behind(alpha, background))?;
            let counts = target.alpha.as_ref().filter(|_| alpha == Alpha::Ignore);
            let mut moment = PoseMoment::default();
            for step in 0..steps {
                let camera = self.camera(view, self.heldout.camera(i));
                let gaussians = &self.state.gaussians;
                self.workspace.forward(gaussians, &camera, &options);
                let rgb = &mut self.workspace.forward.rendered.rgb;
                let mut shown = Cow::Borrowed(&rgb[..]);
                if let Some(counts) = counts {
                    multiply(shown.to_mut(), counts);
                }
                let pair = Pair { render: &shown, target: &target.rgb, width: camera.width as usize };
                l1_dssim(pair, DSSIM_WEIGHT, &mut self.gradient, &mut self.derivatives);
                drop(shown);
                if let Some(counts) = counts {
                    multiply(&mut self.gradient, counts);
                }
                let pixels = PixelGradients { rgb: &self.gradient, alpha: None, depth: None };
                self.workspace.backward(gaussians, &camera, &options, pixels);
                let g = camera_gradient(gaussians, &self.workspace.gradients, &camera, &options);
                if g.is_finite() {
                    let rate = rates[0] * (rates[1] / rates[0]).powf(f64::from(step) / f64::from(steps));
                    let pose = &mut self.state.poses.views[view];
                    *pose = moment.step(pose, &g, rate, self.extent);
                }
            }
        }
        Ok(())
    }

    /// A step of Adam.
    fn update(&mut self, frame: &Frame) {
        let State { gaussians, adam, progress, .. } = &mut self.state;
        let gradients = &mut self.workspace.gradients;
        let rules = self.recipe.densification.as_ref().map(Way::rules);
        let rates = &self.recipe.rates;
        let centres = self.recipe.schedule.rate_of_centres(rates, frame.iteration, self.extent);
        let rates = &rates.at(self.recipe.schedule.share(frame.iteration));
        if let Some(rules) = rules {
            rules.regularise(gaussians, gradients);
        }
        progress.dropped += gradients.overflowed as u64 + drop_bad_gradients(gradients);
        adam.step(gaussians, gradients, centres, rates, frame.raster.sh_degree);
        if let Some(rules) = rules {
            rules.explore(gaussians, centres, moment(&self.recipe, self.extent, frame.iteration));
        }
        lap(&mut self.clock, &mut self.timings.adam);
    }

    fn densify(&mut self, frame: &Frame) {
        self.state.progress.iteration = frame.iteration;
        let Some(way) = &self.recipe.densification else { return };
        let at = moment(&self.recipe, self.extent, frame.iteration);
        way.rules().observe(&mut self.state.seen, &self.workspace, &frame.camera, at);
        if !at.growth.is_due(frame.iteration) {
            return;
        }
        let Some(report) = way.rules().round(&mut self.state, at) else { return };
        let State { gaussians, adam, progress, .. } = &mut self.state;
        let counts = [report.cloned, report.split, report.removed, report.relocated];
        progress.densified.iter_mut().zip(counts).for_each(|(sum, n)| *sum += n as u64);
        // What lies together is drawn together.
        let order = morton_order(&gaussians.means);
        *gaussians = gaussians.select(&order);
        adam.select(&order, order.len());
    }

    /// Adds to the training curve.
    fn note(&mut self) -> Result<()> {
        let (total, loss) = (self.recipe.schedule.iterations, self.last);
        let progress = &mut self.state.progress;
        if loss.total.is_finite() {
            let (sums, count) = &mut progress.window;
            sums.iter_mut().zip([loss.total, loss.l1, loss.ssim]).for_each(|(s, v)| *s += v);
            *count += 1;
        }
        let iteration = progress.iteration;
        if !iteration.is_multiple_of(total.div_ceil(100)) && iteration != total {
            return Ok(());
        }
        let (sums, count) = std::mem::take(&mut progress.window);
        let [loss, l1, ssim] = sums.map(|s| s / f64::from(count.max(1)));
        let gaussians = self.state.gaussians.len();
        let line = json!({"iteration": iteration, "loss": loss, "l1": l1, "ssim": ssim, "gaussians": gaussians});
        progress.curve.push(line.to_string());
        self.complete_curve()
    }

    /// Measures the held-out views where that is due and the curve's last line lacks it. A run that failed in it, because a
    /// photograph could not be read, makes up for it when it goes on.
    pub fn complete_curve(&mut self) -> Result<()> {
        let (total, iteration) = (self.recipe.schedule.iterations, self.state.progress.iteration);
        let due = iteration.is_multiple_of(total.div_ceil(10).max(1)) || iteration == total;
        let Some(last) = self.state.progress.curve.last().filter(|_| due) else { return Ok(()) };
        let Some(mut line) = parsed(last) else { return Ok(()) };
        if line["iteration"] != iteration || line.get("psnr_heldout").is_some() {
            return Ok(());
        }
        let rounds = if iteration == total { &ALIGN_LAST[..] } else { &ALIGN };
        for &(divisor, steps, rates) in rounds {
            self.align(divisor, steps, rates)?;
        }
        self.heldout.set_divisor(1)?;
        if let Some(psnr) = self.heldout()?.psnr {
            self.last_heldout = Some(psnr);
            line["psnr_heldout"] = json!(psnr);
            self.state.progress.curve.pop();
            self.state.progress.curve.push(line.to_string());
        }
        Ok(())
    }

    fn heldout_options(&self) -> RasterOptions {
        let Recipe { background, antialias, .. } = self.recipe;
        RasterOptions { background, antialias, near: near_plane(self.extent), depth: false, ..RasterOptions::default() }
    }

    /// Mean PSNR and SSIM over the held-out views with all spherical harmonics, at the scene's own exposure; none without
    /// such views.
    pub fn heldout(&mut self) -> Result<Means> {
        let Recipe { alpha, background, .. } = self.recipe;
        let options = self.heldout_options();
        let mut all = Vec::with_capacity(self.heldout.len());
        for i in 0..self.heldout.len() {
            let target = self.heldout.target(i, metrics::behind(alpha, background))?;
            let camera = self.camera(self.train.len() + i, self.heldout.camera(i));
            self.workspace.forward(&self.state.gaussians, &camera, &options);
            let rgb = &mut self.workspace.forward.rendered.rgb;
            all.push(metrics::compare(rgb, camera.width as usize, &target, alpha, &mut self.derivatives));
        }
        Ok(Means::of(self.heldout.names().zip(all.iter().copied())))
    }
}

fn moment(recipe: &Recipe, extent: f64, iteration: u32) -> Moment<'_> {
    Moment { iteration, seed: recipe.seed, extent, schedule: &recipe.schedule, growth: &recipe.growth }
}

/// Adds the time since `clock` to `spent`, and sets the clock.
fn lap(clock: &mut Instant, spent: &mut Duration) {
    let now = Instant::now();
    *spent += now - *clock;
    *clock = now;
}

fn parsed(line: &str) -> Option<Value> {
    serde_json::from_str(line).ok()
}
