//! How much memory a training will take, from its photographs and the Gaussians it starts from.

use super::init;
use crate::densification::Strategy;
use crate::densification::rules::Growth;
use crate::memory::{self, Forecast};
use crate::options::{Init, Preset, Train, bytes};
use crate::photographs::masks::Masks;
use crate::photographs::{bytes_per_pixel, full_share};
use gs_io::Result;
use gs_raster::{RasterOptions, TILE, forward};
use gs_scene::Gaussians;
use gs_scene::dataset::{Dataset, Split, View};
use gs_sfm::corners;
use stage::{Bytes, Stage};

/// Pixels of the training photographs for each Gaussian, by default (docs/geometry.md).
const PIXELS_PER_GAUSSIAN: usize = 100;
/// The default of --max-gaussians is never less.
const LEAST_GAUSSIANS: usize = 10_000;
/// Views on which the tiles' share of the memory is measured.
const FORECAST_VIEWS: usize = 4;
/// Bytes of a point before it is a Gaussian.
const PER_POINT: u64 = 15;
/// What takes less memory.
const LESS: &str = "give fewer --init-points or --max-gaussians, a smaller --resolution or --image-cache";

/// The most Gaussians there may be. A scene of many or large photographs shows more than one of few or small ones.
pub(crate) fn most_gaussians(options: &Train, dataset: &Dataset) -> usize {
    let pixels = |v: &View| v.camera.width as usize * v.camera.height as usize;
    let shown = dataset.views_of(Split::Train).map(pixels).sum::<usize>() / PIXELS_PER_GAUSSIAN;
    let usual = match options.preset {
        Some(Preset::Stock) if options.densify == Strategy::Adaptive => usize::MAX,
        _ => shown.max(2 * dataset.points.len()).max(LEAST_GAUSSIANS),
    };
    options.max_gaussians.unwrap_or(usual)
}

/// Bytes for decoded photographs.
pub(crate) fn cache_bytes(options: &Train) -> usize {
    usize::try_from(options.image_cache.0).unwrap_or(usize::MAX)
}

/// What is known of the memory before photographs and Gaussians are there. A start that cannot fit is refused.
pub(crate) fn forecast_start(
    options: &Train,
    dataset: &Dataset,
    masks: &Masks,
    growth: &Growth,
    stage: &Stage,
) -> Result<Forecast> {
    let pixels = |v: &View| u64::from(v.camera.width) * u64::from(v.camera.height);
    // As they are loaded: those to learn from first, then those held out in what is left.
    let whole = |split: Split| -> Result<usize> {
        dataset.views_of(split).map(|v| Ok(bytes_per_pixel(v, masks)? * pixels(v) as usize)).sum()
    };
    let whole = (whole(Split::Train)?, whole(Split::Test)?);
    let share = full_share(cache_bytes(options));
    let train = whole.0.min(share);
    let heldout = whole.1.min(full_share(share.saturating_sub(train)));
    let pictures = memory::Pictures::of(dataset)?;
    let densifies = (1..=growth.until.min(options.iterations)).any(|i| growth.is_due(i));
    let forecast = Forecast {
        photographs: (train + heldout) as u64,
        decoding: rayon::current_num_threads() as u64 * pictures.decoding(),
        decodes_again: (train, heldout) != whole,
        pictures: memory::PER_PIXEL * pictures.pixels,
        tiles: 0,
        per_gaussian: memory::per_gaussian(options.sh_degree, densifies),
    };
    let (points, read) = match &options.init {
        Init::File(path) => (0, bytes(path)?),
        Init::Points if !dataset.points.is_empty() => (dataset.points.len(), 0),
        Init::Points | Init::Random => (options.init_points, 0),
    };
    let fixed = options.densify == Strategy::Fixed;
    let kept = if fixed { points } else { points.min(options.max_gaussians.unwrap_or(points)) };
    let before = PER_POINT * points as u64 + read;
    // The corners are found before there is anything else.
    let corners = match init::needs_corners(options, dataset) {
        true => {
            let views: Vec<&View> = dataset.views.iter().collect();
            corners::bytes(&views, rayon::current_num_threads() as u64)? + forecast.decoding
        }
        false => 0,
    };
    stage.needs_at_once((forecast.peak(kept).0 + before).max(corners), LESS)?;
    Ok(forecast)
}

/// Prints how much memory the run will take, with the Gaussians there are and with the most there may be.
pub(super) fn forecast(
    options: &Train,
    mut forecast: Forecast,
    dataset: &Dataset,
    gaussians: &Gaussians,
    stage: &Stage,
) -> Result<Forecast> {
    let now = gaussians.len();
    let stays = options.densify == Strategy::Fixed;
    let most = if stays { now } else { most_gaussians(options, dataset).max(now) };
    let apart = dataset.views.len().div_ceil(FORECAST_VIEWS).max(1);
    let raster = RasterOptions { sh_degree: 0, antialias: options.antialias, ..RasterOptions::fit(gaussians) };
    let entries = |v: &View| forward(gaussians, &v.camera, &raster).pairs() / (TILE * TILE);
    let entries = dataset.views.iter().step_by(apart).map(entries).max().unwrap_or(0) as u64;
    forecast.tiles = memory::PER_TILE * entries;
    // Without a limit nobody knows how many there will be: those there are must fit.
    let (most, limit) = match most {
        usize::MAX => (now, "no limit to their number".to_string()),
        most => (most, format!("at most {} with {most}", forecast.peak(most))),
    };
    stage.info(&format!(
        "memory: about {} with {now} Gaussians, {limit} (photographs {}, pictures {}, {} bytes a Gaussian)",
        forecast.peak(now),
        Bytes(forecast.photographs),
        Bytes(forecast.scratch()),
        forecast.per_gaussian
    ));
    stage.needs(forecast.peak(most).0, LESS)?;
    Ok(forecast)
}
