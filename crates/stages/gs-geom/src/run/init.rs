//! What a run learns from, and the Gaussians that `--init` says to start from.

use crate::densification::Strategy;
use crate::options::{Init, Train, check_some};
use crate::start;
use gs_io::{Error, Result};
use gs_scene::dataset::{Dataset, Split, View};
use gs_scene::{Camera, Gaussians, PointCloud, ply, splat};
use stage::Stage;
use std::path::Path;

/// The views to learn from, and those held out.
pub(crate) fn split<'a>(options: &Train, dataset: &'a Dataset) -> Result<(Vec<&'a View>, Vec<&'a View>)> {
    let of = |split: Split| dataset.views_of(split).collect::<Vec<&View>>();
    let (train, heldout) = (of(Split::Train), of(Split::Test));
    if train.is_empty() {
        return Err(Error::new("every view is held out")
            .file(&options.scene.scene)
            .found(format!("{} views", dataset.views.len()))
            .expected("at least one view to learn from")
            .hint("give --holdout 0, or more photographs"));
    }
    Ok((train, heldout))
}

/// The Gaussians before the first iteration.
pub(crate) fn gaussians(
    options: &Train,
    dataset: &Dataset,
    cameras: &[&Camera],
    extent: f64,
    stage: &Stage,
) -> Result<Gaussians> {
    if let Some(path) = options.init.file() {
        if splat::holds_gaussians(path)? {
            return from_gaussians(options, path, stage);
        }
        let read = ply::read_points(path)?;
        stage.info(&format!("starting from the {} points of {}", read.len(), path.display()));
        return from_points(options, &read, extent, stage).map_err(|e| e.file(path));
    }
    let scene = &options.scene.scene;
    if options.init == Init::Points && !dataset.points.is_empty() {
        return from_points(options, &dataset.points, extent, stage).map_err(|e| e.file(scene));
    }
    if options.densify == Strategy::Fixed {
        return Err(Error::new("no points to keep")
            .file(scene)
            .field("points")
            .hint("--densify fixed needs a dataset with points, such as ScanNet's vertices, or --init with a file"));
    }
    let why = if options.init == Init::Points { "the dataset has no points: " } else { "" };
    stage.info(&format!("{why}starting from {} random points", options.init_points));
    let random = start::random_points(cameras, options.init_points, stage.seed());
    from_points(options, &random, extent, stage).map_err(|e| e.file(scene))
}

/// The most Gaussians to start from, where there are more points.
fn most(options: &Train, points: usize) -> Option<usize> {
    options.max_gaussians.filter(|&most| points > most && options.densify != Strategy::Fixed)
}

/// One Gaussian for each point, or for as many as `--max-gaussians`.
fn from_points(options: &Train, points: &PointCloud, extent: f64, stage: &Stage) -> Result<Gaussians> {
    let Some(most) = most(options, points.len()) else {
        return start::from_points(points, options.sh_degree, extent);
    };
    stage.info(&format!("starting from {most} of {} points, for --max-gaussians", points.len()));
    start::from_points(&start::some_points(points, most, stage.seed()), options.sh_degree, extent)
}

/// The Gaussians of a file, none of which may be damaged: no gradient repairs one, and `--densify fixed` keeps all.
fn from_gaussians(options: &Train, path: &Path, stage: &Stage) -> Result<Gaussians> {
    let g = splat::read_whole(path)?.gaussians;
    check_some(&g, path)?;
    let g = g.with_degree(options.sh_degree);
    if let Some(most) = most(options, g.len()) {
        return Err(Error::new("more Gaussians than --max-gaussians")
            .file(path)
            .found(g.len())
            .expected(format!("at most {most}"))
            .hint("give a larger --max-gaussians"));
    }
    let zero = g.rotations.iter().filter(|q| q.iter().all(|v| v.abs() < 1e-12)).count();
    if zero > 0 {
        stage.warn(&format!("{zero} Gaussians of --init have a quaternion of length 0 and are never drawn"));
    }
    Ok(g)
}
