//! What a run learns from, and the Gaussians that `--init` says to start from.

use super::forecast::most_gaussians;
use crate::densification::Strategy;
use crate::options::{Init, Train, check_some};
use crate::start;
use crate::training::poses::Poses;
use crate::training::schedule::{Purpose, drawn, generator};
use gs_io::{Error, Result};
use gs_scene::dataset::{Dataset, Format, Split, View};
use gs_scene::{Camera, Gaussians, PointCloud, ply, splat};
use gs_sfm::corners::{self, Found};
use gs_sfm::{Refine, sweep};
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

/// Whether the Gaussians are to start from points that the dataset lacks.
pub(crate) fn is_bare(options: &Train, dataset: &Dataset) -> bool {
    options.init == Init::Points && dataset.points.is_empty()
}

/// Whether the Gaussians start from depth images: where there are no points, but some of these.
pub(crate) fn has_depths(options: &Train, dataset: &Dataset) -> bool {
    is_bare(options, dataset) && dataset.views_of(Split::Train).any(|v| v.depth_path().is_some())
}

/// Whether the photographs are asked for other poses. Those of COLMAP that come with points were found so already.
fn refine(options: &Train, dataset: &Dataset) -> Refine {
    match options.refine_poses {
        Refine::Auto if dataset.format == Format::Colmap && !dataset.points.is_empty() => Refine::Off,
        choice => choice,
    }
}

/// Whether corners of the photographs are found before there are Gaussians.
pub(crate) fn needs_corners(options: &Train, dataset: &Dataset) -> bool {
    refine(options, dataset) != Refine::Off || is_bare(options, dataset) && !has_depths(options, dataset)
}

/// The Gaussians before the first iteration, and the cameras where these are refined. `cameras` are those of the views to learn from.
pub(crate) fn start(
    options: &Train,
    dataset: &Dataset,
    cameras: &[&Camera],
    extent: f64,
    stage: &Stage,
) -> Result<(Gaussians, Poses)> {
    let of = |split: Split| dataset.views_of(split);
    let views: Vec<&View> = of(Split::Train).chain(of(Split::Test)).collect();
    let given: Vec<Camera> = views.iter().map(|v| v.camera.clone()).collect();
    let bare = is_bare(options, dataset) && options.densify != Strategy::Fixed;
    let deep = has_depths(options, dataset);
    let mut found = Found { cameras: given.clone(), ..Found::default() };
    let sweeps = bare && !deep;
    let refine = refine(options, dataset);
    if refine != options.refine_poses {
        stage.info("--refine-poses auto: COLMAP found the poses in the photographs: they stay as they are given");
    }
    if refine != Refine::Off || sweeps {
        found = corners::find(&views, refine, sweeps.then_some(sweep::small), stage)?;
    }
    let refined = found.refined.then(|| Poses::new(&found.cameras, &given, &corners::lenses(&given)));
    let refined = refined.unwrap_or_default();
    let learnt = &found.cameras[..cameras.len()];
    let mut corners = found.points;
    let say = |from: String| stage.info(&format!("the dataset has no points: starting from {from}"));
    let gaussians = if deep {
        let views: Vec<_> = views.into_iter().zip(learnt).collect();
        let points = start::depths::points(&views, options.init_points, stage)?;
        let images = views.iter().filter(|(v, _)| v.depth_path().is_some()).count();
        say(format!("{} of {images} depth images", points.len()));
        from_points(options, &points, extent, stage)
    } else if sweeps && corners.len() >= sweep::FEWEST_CORNERS {
        // Half are left to grow.
        let most = most_gaussians(options, dataset);
        if options.max_gaussians.is_some() {
            corners = start::some_points(&corners, most.div_ceil(2), stage.seed());
        }
        let known = corners.len();
        let (most, rng) = (options.init_points.min(most / 2), &mut generator(stage.seed(), Purpose::Start, 2));
        let draw = |weights: &[f64]| drawn(weights.iter().copied(), most, rng);
        let swept = sweep::points(found.pictures, learnt, corners, draw, stage)?;
        let pixels = swept.points.len() - known;
        say(format!("{known} of corners and {pixels} of depths by plane sweep"));
        start::from_sweep(&swept, options.sh_degree, extent)
    } else {
        if bare {
            let found = corners.len();
            stage.warn(&format!("the photographs have only {found} points in common: starting from random ones"));
        }
        return Ok((gaussians(options, dataset, cameras, extent, stage)?, refined));
    };
    Ok((gaussians.map_err(|e| e.file(&options.scene.scene))?, refined))
}

/// The Gaussians that `--init` says to start from.
pub(crate) fn gaussians(
    options: &Train,
    dataset: &Dataset,
    cameras: &[&Camera],
    extent: f64,
    stage: &Stage,
) -> Result<Gaussians> {
    if let Some(path) = options.init.file() {
        if splat::holds_gaussians(path)? {
            return from_gaussians(options, dataset, path, stage);
        }
        let mut read = ply::read_points(path)?;
        read.shift_to(dataset.shift);
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
fn from_gaussians(options: &Train, dataset: &Dataset, path: &Path, stage: &Stage) -> Result<Gaussians> {
    let mut g = splat::read_whole(path)?.gaussians;
    check_some(&g, path)?;
    g.shift_to(dataset.shift);
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
