//! The optimisation loop.

use crate::checkpoint::{State, start};
use crate::densify::{DensifyOptions, densify, reset_opacities};
use crate::loss::{Loss, Pair, l1_dssim};
use crate::metrics;
use crate::optimiser::drop_bad_gradients;
use crate::photographs::Photographs;
use crate::schedule::{LearningRates, Purpose, Schedule, ViewOrder, generator};
use gs_io::Result;
use gs_raster::{PixelGradients, RasterOptions, backward, forward};
use gs_scene::Gaussians;
use serde::Serialize;
use serde_json::{Value, json};
use std::time::{Duration, Instant};

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
    /// Weight of 1 - SSIM in the loss, 0 to 1.
    pub dssim_weight: f32,
    /// Colour behind the scene.
    pub background: [f32; 3],
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
            dssim_weight: 0.2,
            background: [0.0; 3],
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
    gradient: Vec<f32>,
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
        Self::resume(options, extent, train, heldout, start(gaussians))
    }

    /// Goes on from a checkpoint.
    pub fn resume(
        options: TrainOptions,
        extent: f64,
        train: Photographs<'a>,
        heldout: Photographs<'a>,
        state: State,
    ) -> Self {
        let order = ViewOrder::new(options.seed, train.len());
        let last = Loss { l1: 0.0, ssim: 0.0, total: 0.0 };
        let (gradient, timings) = (Vec::new(), Timings::default());
        let last_heldout = state.progress.curve.iter().rev().find_map(|line| heldout_of(line));
        Self { options, extent, train, heldout, order, state, gradient, last, last_heldout, timings }
    }

    /// The state, for a checkpoint.
    pub fn state(&self) -> &State {
        &self.state
    }

    /// The state, at the end.
    pub fn into_state(self) -> State {
        self.state
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
        let target = self.train.target(view)?;
        let camera = self.train.camera(view);
        lap(&mut self.timings.rest);

        let State { gaussians, adam, pull, progress } = &mut self.state;
        let degree = schedule.sh_degree(iteration, gaussians.sh_degree);
        let raster =
            RasterOptions { background: self.options.background, sh_degree: degree, ..RasterOptions::default() };
        let rendered = forward(gaussians, camera, &raster);
        lap(&mut self.timings.forward);
        let pair = Pair { render: &rendered.rendered.rgb, target: &target, width: camera.width as usize };
        let loss = l1_dssim(pair, self.options.dssim_weight, &mut self.gradient);
        lap(&mut self.timings.loss);
        let pixels = PixelGradients { rgb: &self.gradient, alpha: None, depth: None };
        let mut gradients = backward(gaussians, camera, &raster, &rendered, pixels);
        progress.dropped += drop_bad_gradients(&mut gradients);
        lap(&mut self.timings.backward);
        let mut rates = schedule.rates(&self.options.rates, iteration, self.extent);
        if self.options.fixed_points {
            rates.means = 0.0;
        }
        adam.step(gaussians, &gradients, &rates, degree);
        lap(&mut self.timings.adam);

        if !self.options.fixed_points {
            if schedule.observes(iteration) {
                pull.observe(rendered.visible(), &gradients, camera.width, camera.height);
            }
            if schedule.densifies(iteration) {
                let mut rng = generator(self.options.seed, Purpose::Split, u64::from(iteration));
                let remove_huge = iteration > schedule.opacity_reset_every;
                let options = &self.options.densify;
                let report = densify(gaussians, adam, pull, options, self.extent as f32, remove_huge, &mut rng);
                for (sum, n) in progress.densified.iter_mut().zip([report.cloned, report.split, report.removed]) {
                    *sum += n as u64;
                }
            }
            if schedule.resets_opacity(iteration) {
                reset_opacities(gaussians, adam);
            }
        }
        progress.iteration = iteration;
        self.last = loss;
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
        if let Some(psnr) = self.heldout_psnr()? {
            self.last_heldout = Some(psnr);
            line["psnr_heldout"] = json!(psnr);
            self.state.progress.curve.pop();
            self.state.progress.curve.push(line.to_string());
        }
        Ok(())
    }

    /// Mean PSNR over the held-out views with the spherical harmonics in use; none without such views.
    ///
    /// # Errors
    /// When a photograph has to be decoded and cannot be.
    pub fn heldout_psnr(&self) -> Result<Option<f64>> {
        let g = &self.state.gaussians;
        let options = RasterOptions { background: self.options.background, ..RasterOptions::default() };
        let mut all = Vec::new();
        for i in 0..self.heldout.len() {
            all.push(metrics::compare(g, self.heldout.camera(i), &options, &self.heldout.target(i)?).0);
        }
        Ok(metrics::mean(all.into_iter()))
    }
}

/// The held-out PSNR that a line of the curve tells.
fn heldout_of(line: &str) -> Option<f64> {
    serde_json::from_str::<Value>(line).ok()?["psnr_heldout"].as_f64()
}
