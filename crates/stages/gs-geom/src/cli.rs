//! The command line of `gs-geom`.

mod budget;
mod convert;
mod eval;
mod inspect;
mod render;
mod train;

use crate::masks::{Alpha, Masks};
use clap::{Parser, Subcommand, ValueEnum};
use gs_io::{Error, IoContext, Result};
use gs_raster::RasterOptions;
use gs_scene::dataset::{self, Dataset, LoadOptions, Resolution};
use gs_scene::{Gaussians, Geometry, image_size};
use stage::{CommonArgs, Program, Stage};
use std::path::{Path, PathBuf};

/// Optimise 3D Gaussians from posed photographs, render them, measure them
#[derive(Debug, Parser)]
#[command(name = "gs-geom", version)]
pub struct Args {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    common: CommonArgs,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Optimise Gaussians until they look like the photographs
    Train(Box<train::TrainArgs>),
    /// Render views of a dataset as PNG, and as EXR with alpha and depth on request
    Render(render::RenderArgs),
    /// PSNR and SSIM on held-out views
    Eval(eval::EvalArgs),
    /// Tell what is in a file of Gaussians (counts, bounds, histograms, faults), or of which files a dataset consists
    Inspect(inspect::InspectArgs),
    /// Drop, crop, trim and re-order the Gaussians of a file
    Convert(convert::ConvertArgs),
}

impl Program for Args {
    const NAME: &'static str = "gs-geom";

    fn common(&self) -> &CommonArgs {
        &self.common
    }

    fn check(&self) -> Result<()> {
        match &self.command {
            Command::Train(args) => args.options(self.common.seed).map(drop),
            _ => Ok(()),
        }
    }

    fn run(self, stage: &Stage) -> Result<()> {
        match self.command {
            Command::Train(args) => args.run(stage),
            Command::Render(args) => args.run(stage),
            Command::Eval(args) => args.run(stage),
            Command::Inspect(args) => args.run(self.common.json, stage),
            Command::Convert(args) => args.run(stage),
        }
    }
}

/// Which photographs, and at which size.
#[derive(Debug, Clone, clap::Args)]
struct SceneArgs {
    /// Dataset folder (COLMAP, transforms.json or ScanNet)
    #[arg(long, value_name = "DIR")]
    scene: PathBuf,
    /// Size of the photographs: a divisor, a width that wider ones are shrunk to such as 640px, or auto for 1600px
    #[arg(long, value_name = "auto|WIDTHpx|DIVISOR", default_value = "auto")]
    resolution: Resolution,
    /// Hold out every n-th view, from the first; 0 holds none out
    #[arg(long, value_name = "N", default_value_t = 8)]
    holdout: usize,
    /// Colour behind the scene, and behind transparent pixels of the photographs
    #[arg(long, value_enum, default_value_t = Background::Black)]
    background: Background,
}

/// Which pixels of the photographs count.
#[derive(Debug, Clone, clap::Args)]
struct MaskArgs {
    /// What transparent pixels of the photographs (alpha below 1) mean [background; with --masks ignore]
    #[arg(long, value_enum)]
    alpha: Option<Alpha>,
    /// Folder of masks, called as the photographs: what is black there is transparent
    #[arg(long, value_name = "DIR")]
    masks: Option<PathBuf>,
}

impl MaskArgs {
    fn alpha(&self) -> Alpha {
        let default = if self.masks.is_some() { Alpha::Ignore } else { Alpha::default() };
        self.alpha.unwrap_or(default)
    }

    fn load(&self, dataset: &Dataset, stage: &Stage) -> Result<Masks> {
        let Some(folder) = &self.masks else { return Ok(Masks::default()) };
        let masks = Masks::find(folder, &dataset.views)?;
        let views = dataset.views.len();
        if masks.len() < views {
            stage.warn(&format!("{} of {views} photographs have no mask and count wholly", views - masks.len()));
        }
        Ok(masks)
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Background {
    Black,
    White,
    /// Training only: another colour in every iteration; renders are over black
    Random,
}

impl Background {
    fn color(self) -> [f32; 3] {
        match self {
            Self::Black | Self::Random => [0.0; 3],
            Self::White => [1.0; 3],
        }
    }
}

/// Warnings of a dataset that are said one by one.
const WARNINGS_SAID: usize = 5;

impl SceneArgs {
    /// The dataset without a word about its warnings.
    fn load_quietly(&self) -> Result<Dataset> {
        dataset::load(&self.scene, &LoadOptions { resolution: self.resolution, holdout: self.holdout })
    }

    fn load(&self, stage: &Stage) -> Result<Dataset> {
        let dataset = self.load_quietly()?;
        for warning in dataset.warnings.iter().take(WARNINGS_SAID) {
            stage.warn(warning);
        }
        if dataset.warnings.len() > WARNINGS_SAID {
            stage.warn(&format!("{} more warnings about the dataset", dataset.warnings.len() - WARNINGS_SAID));
        }
        Ok(dataset)
    }
}

fn check_some(gaussians: &Gaussians, path: &Path) -> Result<()> {
    if gaussians.is_empty() {
        return Err(Error::new("no Gaussians").file(path).field("element vertex").hint("train the geometry again"));
    }
    Ok(())
}

/// Pixels of the largest view.
fn most_pixels(dataset: &Dataset) -> u64 {
    dataset.views.iter().map(|v| u64::from(v.camera.width) * u64::from(v.camera.height)).max().unwrap_or(0)
}

/// Width and height of the largest photograph's file.
fn largest_file(dataset: &Dataset) -> Result<(u32, u32)> {
    dataset.views.iter().try_fold((0, 0), |(width, height), view| {
        let (w, h) = image_size(&view.image_path)?;
        Ok((w.max(width), h.max(height)))
    })
}

/// Bytes of a file.
fn bytes(path: &Path) -> Result<u64> {
    Ok(std::fs::metadata(path).at("read", path)?.len())
}

/// Gaussians to draw.
#[derive(Debug, Clone, clap::Args)]
struct GeometryArgs {
    /// Gaussians, as a 3DGS PLY
    #[arg(long, value_name = "FILE")]
    geometry: PathBuf,
    /// Evaluate bands of spherical harmonics that are zero too: the same pictures, more slowly
    #[arg(long)]
    no_skip: bool,
}

impl GeometryArgs {
    /// The Gaussians, and how they are drawn over `background`.
    fn read(&self, background: Background, stage: &Stage) -> Result<(Gaussians, RasterOptions)> {
        let geometry = Geometry::read(&self.geometry)?;
        if let Some(damage) = geometry.damage() {
            stage.skipped(&damage);
        }
        let fitting = RasterOptions::of(&geometry);
        let gaussians = geometry.gaussians;
        check_some(&gaussians, &self.geometry)?;
        let (used, degree) = (fitting.sh_degree, gaussians.sh_degree);
        if used < degree && !self.no_skip {
            stage.skipped(&format!("spherical harmonics of degrees {} to {degree}: zero in every Gaussian", used + 1));
        }
        let options = RasterOptions {
            sh_degree: if self.no_skip { degree } else { used },
            background: background.color(),
            ..fitting
        };
        Ok((gaussians, options))
    }
}
