//! The optimisation loop.

use crate::checkpoint::{State, start};
use crate::densify::{DensifyOptions, Pull, Strategy, densify, reset_opacities};
use crate::exposure;
use crate::loss::{Derivatives, Loss, Pair, l1_dssim};
use crate::masks::{Alpha, alpha_loss, multiply};
use crate::mcmc::{self, McmcOptions};
use crate::metrics::{self, Means};
use crate::optimiser::{Adam, drop_bad_gradients};
use crate::photographs::Photographs;
use crate::schedule::{LearningRates, Purpose, Schedule, ViewOrder, generator};
use gs_io::Result;
use gs_raster::{PixelGradients, RasterOptions, Workspace, near_plane};
use gs_scene::{Gaussians, morton_order};
use rand::Rng;
use serde::Serialize;
use serde_json::{Value, json};
use std::borrow::Cow;
use std::time::{Duration, Instant};

/// Weight of the difference of alpha in the loss, for [`Alpha::Match`].
const ALPHA_WEIGHT: f32 = 0.1;

/// Every parameter that shapes the result.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TrainOptions {
    /// Seed of the views' order and of splits.
    pub seed: u64,
    /// When what happens.
    pub schedule: Schedule,
    /// Learning rates.
    pub rates: LearningRates,
    /// Thresholds of densification.
    pub densify: DensifyOptions,
    /// Parameters of densification as sampling; of use only with [`Strategy::Mcmc`].
    pub mcmc: McmcOptions,
    /// Leave alone, in each step, the Gaussians that its view does not draw.
    pub sparse_adam: bool,
    /// Weight of 1 - SSIM in the loss, 0 to 1.
    pub dssim_weight: f32,
    /// Colour behind the scene.
    pub background: [f32; 3],
    /// Learn with another colour behind the scene in every iteration, so that what is transparent must be so;
    /// `background` is then for held-out views alone.
    pub random_background: bool,
    /// What transparent pixels of the photographs mean.
    pub alpha: Alpha,
    /// Keep the light of Gaussians smaller than a pixel (the 2D filter of Mip-Splatting, Yu et al. 2024).
    pub antialias: bool,
    /// Learn an affine map of colours for each training photograph.
    pub exposure: bool,
    /// Keep number, order and positions of the Gaussians: Gaussian i is point i (ScanNet protocol).
    pub fixed_points: bool,
}

impl TrainOptions {
    /// The defaults for a number of iterations.
    pub fn new(iterations: u32) -> Self {
        Self {
            seed: 0,
            schedule: Schedule::for_iterations(iterations),
            rates: LearningRates::default(),
            densify: DensifyOptions::default(),
            mcmc: McmcOptions::default(),
            sparse_adam: false,
            dssim_weight: 0.2,
            background: [0.0; 3],
            random_background: false,
            alpha: Alpha::default(),
            antialias: false,
            exposure: false,
            fixed_points: false,
        }
    }
}

/// Where the time of an optimisation went.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Timings {
    /// Rendering.
    pub forward: Duration,
    /// Loss and its gradient.
    pub loss: Duration,
    /// Gradients of the parameters.
    pub backward: Duration,
    /// Adam.
    pub adam: Duration,
    /// Densification, held-out views, photographs.
    pub rest: Duration,
}

/// An optimisation under way.
pub struct Trainer<'a> {
    options: TrainOptions,
    extent: f64,
    train: Photographs<'a>,
    heldout: Photographs<'a>,
    order: ViewOrder,
    state: State,
    workspace: Workspace,
    gradient: Vec<f32>,
    alpha_gradient: Vec<f32>,
    /// The render through its view's exposure.
    exposed: Vec<f32>,
    derivatives: Derivatives,
    /// Which Gaussians the last view drew.
    drawn: Vec<bool>,
    last: Loss,
    last_heldout: Option<f64>,
    timings: Timings,
}

impl<'a> Trainer<'a> {
    /// Begins with `gaussians`. `extent` is the scene's size (see [`crate::init::extent`]); `heldout` may be empty.
    pub fn new(
        options: TrainOptions,
        extent: f64,
        train: Photographs<'a>,
        heldout: Photographs<'a>,
        gaussians: Gaussians,
    ) -> Self {
        let exposures = if options.exposure { train.len() } else { 0 };
        Self::resume(options, extent, train, heldout, start(gaussians, exposures))
    }

    /// Goes on from a checkpoint.
    ///
    /// # Panics
    /// When the state has exposures of another number of views.
    pub fn resume(
        options: TrainOptions,
        extent: f64,
        train: Photographs<'a>,
        heldout: Photographs<'a>,
        state: State,
    ) -> Self {
        let order = ViewOrder::new(options.seed, train.len());
        assert_eq!(state.exposures.maps.len(), if options.exposure { train.len() } else { 0 });
        let last = Loss { l1: 0.0, ssim: 0.0, total: 0.0 };
        let (gradient, derivatives, drawn) = (Vec::new(), Derivatives::default(), Vec::new());
        let timings = Timings::default();
        let last_heldout = state.progress.curve.iter().rev().find_map(|line| heldout_of(line));
        Self {
            options,
            extent,
            train,
            heldout,
            order,
            state,
            workspace: Workspace::default(),
            gradient,
            alpha_gradient: Vec::new(),
            exposed: Vec::new(),
            derivatives,
            drawn,
            last,
            last_heldout,
            timings,
        }
    }

    /// Names of the training photographs, in the order of the exposures.
    pub fn train_names(&self) -> impl Iterator<Item = &str> {
        self.train.names()
    }

    /// The state, for a checkpoint.
    pub fn state(&self) -> &State {
        &self.state
    }

    /// The state, at the end.
    pub fn into_state(self) -> State {
        self.state
    }

    /// Changes the Gaussians, with moments and pulls to follow them.
    pub fn change(&mut self, change: impl FnOnce(&mut Gaussians, &mut Adam, &mut Pull)) {
        change(&mut self.state.gaussians, &mut self.state.adam, &mut self.state.pull);
    }

    /// Loss of the last iteration's view.
    pub fn last_loss(&self) -> Loss {
        self.last
    }

    /// PSNR of the last held-out check, dB.
    pub fn last_heldout(&self) -> Option<f64> {
        self.last_heldout
    }

    /// Where the time went.
    pub fn timings(&self) -> Timings {
        self.timings
    }

    /// Whether all iterations are done.
    pub fn is_done(&self) -> bool {
        self.state.progress.iteration >= self.options.schedule.iterations
    }

    /// One iteration: render a view, compare, step, and whatever the schedule says.
    ///
    /// # Errors
    /// When a photograph has to be decoded and cannot be; the state is then good for a checkpoint.
    pub fn step(&mut self) -> Result<()> {
        self.complete_curve()?;
        let mut clock = Instant::now();
        let mut lap = |spent: &mut Duration| {
            let now = Instant::now();
            *spent += now - clock;
            clock = now;
        };
        let schedule = &self.options.schedule;
        let iteration = self.state.progress.iteration + 1;
        self.train.set_divisor(schedule.divisor(iteration))?;
        let view = self.order.at(iteration);
        let background = match self.options.random_background {
            true => generator(self.options.seed, Purpose::Background, u64::from(iteration)).random(),
            false => self.options.background,
        };
        let target = self.train.target(view, metrics::behind(self.options.alpha, background))?;
        let camera = self.train.camera(view);
        lap(&mut self.timings.rest);

        let State { gaussians, adam, pull, exposures, progress } = &mut self.state;
        let sampling = self.options.densify.strategy == Strategy::Mcmc && !self.options.fixed_points;
        // Not at the end of the last step, so that held-out views are measured before.
        if schedule.resets_opacity(iteration - 1) && iteration > 1 && !sampling && !self.options.fixed_points {
            reset_opacities(gaussians, adam);
        }
        let degree = schedule.sh_degree(iteration, gaussians.sh_degree);
        let raster = RasterOptions {
            background,
            sh_degree: degree,
            antialias: self.options.antialias,
            near: near_plane(self.extent),
            depth: false,
            absolute_pulls: self.options.densify.strategy == Strategy::Absgrad,
        };
        let rendered = self.workspace.forward(gaussians, camera, &raster);
        let undrawn = rendered.dropped();
        for (most, now) in progress.undrawn.iter_mut().zip([undrawn.not_finite, undrawn.degenerate]) {
            *most = (*most).max(now as u64);
        }
        lap(&mut self.timings.forward);
        // What the photograph would show, and which of its pixels count.
        let rgb = &rendered.rendered.rgb;
        let map = exposures.maps.get(view).copied();
        let mut shown = match &map {
            Some(map) => {
                exposure::apply(map, rgb, &mut self.exposed);
                Cow::Borrowed(&self.exposed[..])
            }
            None => Cow::Borrowed(&rgb[..]),
        };
        let counts = target.alpha.as_ref().filter(|_| self.options.alpha == Alpha::Ignore);
        if let Some(alpha) = counts {
            multiply(shown.to_mut(), alpha);
        }
        let pair = Pair { render: &shown, target: &target.rgb, width: camera.width as usize };
        let mut loss = l1_dssim(pair, self.options.dssim_weight, &mut self.gradient, &mut self.derivatives);
        drop(shown);
        if let Some(alpha) = counts {
            multiply(&mut self.gradient, alpha);
        }
        if let Some(map) = &map {
            let gradient = exposure::backward(map, rgb, &mut self.gradient);
            exposures.step(view, &gradient, f64::from(iteration) / f64::from(schedule.iterations.max(1)));
        }
        let mut pixels = PixelGradients { rgb: &self.gradient, alpha: None, depth: None };
        if let Some(alpha) = target.alpha.as_ref().filter(|_| self.options.alpha == Alpha::Match) {
            loss.total += alpha_loss(&rendered.rendered.alpha, alpha, ALPHA_WEIGHT, &mut self.alpha_gradient);
            pixels.alpha = Some(&self.alpha_gradient);
        }
        lap(&mut self.timings.loss);
        self.workspace.backward(gaussians, camera, &raster, pixels);
        let Workspace { forward: rendered, gradients, .. } = &mut self.workspace;
        lap(&mut self.timings.backward);
        let mut rates = schedule.rates(&self.options.rates, iteration, self.extent);
        if self.options.fixed_points {
            rates.means = 0.0;
        }
        let drawn = self.options.sparse_adam.then(|| {
            self.drawn.clear();
            self.drawn.resize(gaussians.len(), false);
            rendered.visible().iter().for_each(|&i| self.drawn[i as usize] = true);
            &self.drawn[..]
        });
        if sampling {
            mcmc::regularise(gaussians, gradients, &self.options.mcmc, drawn);
        }
        progress.dropped += gradients.overflowed as u64 + drop_bad_gradients(gradients);
        adam.step(gaussians, gradients, &rates, degree, drawn);
        if sampling {
            mcmc::explore(gaussians, &self.options.mcmc, rates.means, self.options.seed, iteration);
        }
        lap(&mut self.timings.adam);

        if !self.options.fixed_points {
            let options = &self.options.densify;
            let pulls = match options.strategy {
                Strategy::Adaptive => Some(&gradients.mean2d),
                Strategy::Absgrad => Some(&gradients.mean2d_abs),
                Strategy::Mcmc => None,
            };
            if let Some(pulls) = pulls.filter(|_| schedule.observes(iteration)) {
                pull.observe(rendered.visible(), pulls, camera.width, camera.height);
            }
            if schedule.densifies(iteration) && (sampling || schedule.observes(iteration)) {
                let mut rng = generator(self.options.seed, Purpose::Split, u64::from(iteration));
                let report = if sampling {
                    let report = mcmc::round(gaussians, adam, &self.options.mcmc, options.max_gaussians, &mut rng);
                    *pull = Pull::new(gaussians.len());
                    report
                } else {
                    densify(gaussians, adam, pull, options, self.extent as f32, &mut rng)
                };
                let counts = [report.cloned, report.split, report.removed, report.relocated];
                progress.densified.iter_mut().zip(counts).for_each(|(sum, n)| *sum += n as u64);
                // What lies together is drawn together.
                let order = morton_order(&gaussians.means);
                *gaussians = gaussians.select(&order);
                adam.select(&order, order.len());
            }
        }
        progress.iteration = iteration;
        self.last = loss;
        // Room for the held-out views.
        drop(target);
        self.note(loss)?;
        lap(&mut self.timings.rest);
        Ok(())
    }

    /// Adds to the training curve.
    fn note(&mut self, loss: Loss) -> Result<()> {
        let total = self.options.schedule.iterations;
        let line_every = total.div_ceil(100);
        let progress = &mut self.state.progress;
        if loss.total.is_finite() {
            let (sums, count) = &mut progress.window;
            sums.iter_mut().zip([loss.total, loss.l1, loss.ssim]).for_each(|(s, v)| *s += v);
            *count += 1;
        }
        let iteration = progress.iteration;
        if !iteration.is_multiple_of(line_every) && iteration != total {
            return Ok(());
        }
        let (sums, count) = std::mem::take(&mut progress.window);
        let [loss, l1, ssim] = sums.map(|s| s / f64::from(count.max(1)));
        let gaussians = self.state.gaussians.len();
        let line = json!({"iteration": iteration, "loss": loss, "l1": l1, "ssim": ssim, "gaussians": gaussians});
        self.state.progress.curve.push(line.to_string());
        self.complete_curve()
    }

    /// Measures the held-out views where that is due and the curve's last line lacks it. A run that failed in it, because a
    /// photograph could not be read, makes up for it when it goes on.
    ///
    /// # Errors
    /// When a photograph has to be decoded and cannot be.
    pub fn complete_curve(&mut self) -> Result<()> {
        let (total, iteration) = (self.options.schedule.iterations, self.state.progress.iteration);
        let due = iteration.is_multiple_of(total.div_ceil(10).max(1)) || iteration == total;
        let Some(last) = self.state.progress.curve.last().filter(|_| due) else { return Ok(()) };
        let Ok(mut line) = serde_json::from_str::<Value>(last) else { return Ok(()) };
        if line["iteration"] != iteration || line.get("psnr_heldout").is_some() {
            return Ok(());
        }
        if let Some(psnr) = self.heldout()?.psnr {
            self.last_heldout = Some(psnr);
            line["psnr_heldout"] = json!(psnr);
            self.state.progress.curve.pop();
            self.state.progress.curve.push(line.to_string());
        }
        Ok(())
    }

    /// Mean PSNR and SSIM over the held-out views with all spherical harmonics, at the scene's own exposure; none without
    /// such views.
    ///
    /// # Errors
    /// When a photograph has to be decoded and cannot be.
    pub fn heldout(&mut self) -> Result<Means> {
        let (alpha, background) = (self.options.alpha, self.options.background);
        let (antialias, near) = (self.options.antialias, near_plane(self.extent));
        let options = RasterOptions { background, antialias, near, depth: false, ..RasterOptions::default() };
        let mut all = Vec::with_capacity(self.heldout.len());
        for i in 0..self.heldout.len() {
            let (camera, target) =
                (self.heldout.camera(i), self.heldout.target(i, metrics::behind(alpha, background))?);
            self.workspace.forward(&self.state.gaussians, camera, &options);
            let rgb = &mut self.workspace.forward.rendered.rgb;
            all.push(metrics::compare(rgb, camera.width as usize, &target, alpha));
        }
        Ok(Means::of(self.heldout.names().zip(all.iter().copied())))
    }
}

/// The held-out PSNR that a line of the curve tells.
fn heldout_of(line: &str) -> Option<f64> {
    serde_json::from_str::<Value>(line).ok()?["psnr_heldout"].as_f64()
}
