//! How much memory a run will take, from its photographs and the Gaussians it starts from.

use super::TrainArgs;
use crate::masks::Masks;
use crate::memory::{self, Forecast};
use crate::photographs::{bytes_per_pixel, full_share};
use crate::schedule::Schedule;
use gs_io::Result;
use gs_raster::{RasterOptions, TILE, forward};
use gs_scene::dataset::{Dataset, Split, View};
use gs_scene::{Gaussians, image_size};
use stage::{Bytes, Stage};

/// Views on which the tiles' share of the memory is tried.
const FORECAST_VIEWS: usize = 4;

impl TrainArgs {
    /// Says how much memory the run will take, with the Gaussians there are and with the most there may be.
    pub(super) fn forecast(
        &self,
        dataset: &Dataset,
        masks: &Masks,
        gaussians: &Gaussians,
        schedule: &Schedule,
        stage: &Stage,
    ) -> Result<Forecast> {
        let now = gaussians.len();
        let most = if self.fixed_points { now } else { self.most_gaussians(dataset).max(now) };
        let mut size = (0, 0);
        for view in &dataset.views {
            let (w, h) = image_size(&view.image_path)?;
            size = (w.max(size.0), h.max(size.1));
        }
        let pixels = |v: &View| u64::from(v.camera.width) * u64::from(v.camera.height);
        let apart = dataset.views.len().div_ceil(FORECAST_VIEWS).max(1);
        let options = RasterOptions { sh_degree: 0, antialias: self.antialias, ..RasterOptions::fit(gaussians) };
        let entries = |v: &View| forward(gaussians, &v.camera, &options).pairs() / (TILE * TILE);
        let entries = dataset.views.iter().step_by(apart).map(entries).max().unwrap_or(0) as u64;
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
            pixels: dataset.views.iter().map(pixels).max().unwrap_or(0),
            width: dataset.views.iter().map(|v| u64::from(v.camera.width)).max().unwrap_or(0),
            file: size,
            tile_entries: entries,
            threads: rayon::current_num_threads(),
            decodes_again: (train, heldout) != whole,
            sh_degree: self.sh_degree,
            densifies: !self.fixed_points && (1..=last).any(|i| schedule.densifies(i)),
        });
        stage.info(&format!(
            "memory: about {} with {now} Gaussians, at most {} with {most} (photographs {}, pictures {}, {} bytes a Gaussian)",
            forecast.peak(now),
            forecast.peak(most),
            Bytes(forecast.photographs),
            Bytes(forecast.scratch()),
            forecast.per_gaussian
        ));
        stage.needs(forecast.peak(most).0, "give fewer --max-gaussians, a smaller --resolution or --image-cache")?;
        Ok(forecast)
    }
}
