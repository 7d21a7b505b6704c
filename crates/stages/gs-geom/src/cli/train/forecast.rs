//! How much memory a run will take, from its photographs and the Gaussians it starts from.

use super::{Init, TrainArgs};
use crate::cli::{bytes, largest_file, most_pixels};
use crate::masks::Masks;
use crate::memory::{self, Forecast};
use crate::photographs::{bytes_per_pixel, full_share};
use crate::schedule::Schedule;
use gs_io::Result;
use gs_raster::{RasterOptions, TILE, forward};
use gs_scene::Gaussians;
use gs_scene::dataset::{Dataset, Split, View};
use stage::{Bytes, Stage};

/// Views on which the tiles' share of the memory is tried.
const FORECAST_VIEWS: usize = 4;

/// Bytes of a point before it is a Gaussian.
const PER_POINT: u64 = 15;
/// What takes less memory.
const LESS: &str = "give fewer --init-points or --max-gaussians, a smaller --resolution or --image-cache";

impl TrainArgs {
    /// What is known of the memory before photographs and Gaussians are there. A start that cannot fit is refused.
    pub(in crate::cli) fn forecast_start(
        &self,
        dataset: &Dataset,
        masks: &Masks,
        schedule: &Schedule,
        stage: &Stage,
    ) -> Result<Forecast> {
        let pixels = |v: &View| u64::from(v.camera.width) * u64::from(v.camera.height);
        // As they are loaded: those to learn from first, then those held out in what is left.
        let whole = |split: Split| -> Result<usize> {
            dataset.views_of(split).map(|v| Ok(bytes_per_pixel(v, masks)? * pixels(v) as usize)).sum()
        };
        let whole = (whole(Split::Train)?, whole(Split::Test)?);
        let train = whole.0.min(full_share(self.cache_bytes()));
        let heldout = whole.1.min(full_share(full_share(self.cache_bytes()).saturating_sub(train)));
        let last = schedule.densify_until.min(schedule.iterations);
        let forecast = Forecast::new(&memory::Sizes {
            photographs: (train + heldout) as u64,
            pixels: most_pixels(dataset),
            width: dataset.views.iter().map(|v| u64::from(v.camera.width)).max().unwrap_or(0),
            file: largest_file(dataset)?,
            threads: rayon::current_num_threads(),
            decodes_again: (train, heldout) != whole,
            sh_degree: self.sh_degree,
            densifies: !self.fixed_points && (1..=last).any(|i| schedule.densifies(i)),
        });
        let (points, read) = match &self.init {
            Init::File(path) => (0, bytes(path)?),
            Init::Points if !dataset.points.is_empty() => (dataset.points.len(), 0),
            Init::Points | Init::Random => (self.init_points, 0),
        };
        let kept = if self.fixed_points { points } else { points.min(self.max_gaussians.unwrap_or(points)) };
        let before = PER_POINT * points as u64 + read;
        stage.needs_at_once(forecast.peak(kept).0 + before, LESS)?;
        Ok(forecast)
    }

    /// Says how much memory the run will take, with the Gaussians there are and with the most there may be.
    pub(super) fn forecast(
        &self,
        start: Forecast,
        dataset: &Dataset,
        gaussians: &Gaussians,
        stage: &Stage,
    ) -> Result<Forecast> {
        let now = gaussians.len();
        let most = if self.fixed_points { now } else { self.most_gaussians(dataset).max(now) };
        let apart = dataset.views.len().div_ceil(FORECAST_VIEWS).max(1);
        let options = RasterOptions { sh_degree: 0, antialias: self.antialias, ..RasterOptions::fit(gaussians) };
        let entries = |v: &View| forward(gaussians, &v.camera, &options).pairs() / (TILE * TILE);
        let entries = dataset.views.iter().step_by(apart).map(entries).max().unwrap_or(0) as u64;
        let forecast = start.with_tiles(entries);
        stage.info(&format!(
            "memory: about {} with {now} Gaussians, at most {} with {most} (photographs {}, pictures {}, {} bytes a Gaussian)",
            forecast.peak(now),
            forecast.peak(most),
            Bytes(forecast.photographs),
            Bytes(forecast.scratch()),
            forecast.per_gaussian
        ));
        stage.needs(forecast.peak(most).0, LESS)?;
        Ok(forecast)
    }
}
