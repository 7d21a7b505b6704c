//! The command line of `synth-scene`.

use crate::cameras::Path as CameraPath;
use crate::masks::Faults;
use crate::write::{self, Options};
use clap::{Parser, ValueEnum};
use gs_io::{Error, Result};
use stage::{CommonArgs, Program, Stage};
use std::path::PathBuf;

/// Make a room with things in it: photographs, poses, id maps, and the truth about all of them
///
/// The output is a COLMAP scene (images, sparse/0) with id maps of masks at four levels (language_features), truth per
/// point, view and mask (truth), and polygon labels (label). truth/scene.json is written last: where it stands, the
/// scene is complete. The same options and seed give the same bytes.
#[derive(Debug, Parser)]
#[command(name = "synth-scene", version)]
pub struct Args {
    /// Folder to write; an earlier synthetic scene in it is replaced
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Sizes that the options below default to
    #[arg(long, value_enum, default_value_t = Size::Demo)]
    size: Size,
    /// Things besides floor, walls and tables, 1 to 60 [tiny 8, demo 10, large 40]
    #[arg(long, value_name = "COUNT")]
    objects: Option<usize>,
    /// Photographs, 1 to 2000 [tiny 8, demo 30, large 120]
    #[arg(long, value_name = "COUNT")]
    views: Option<usize>,
    /// Width of the photographs in pixels, 32 to 4096 [tiny 160, demo 480, large 640]
    #[arg(long, value_name = "PIXELS")]
    width: Option<u32>,
    /// Height of the photographs in pixels, 32 to 4096 [tiny 120, demo 360, large 480]
    #[arg(long, value_name = "PIXELS")]
    height: Option<u32>,
    /// Points of the sparse cloud, 1 to 10000000 [tiny 1500, demo 9000, large 40000]
    #[arg(long, value_name = "COUNT")]
    points: Option<usize>,
    /// Where the camera goes [a ring for one table, a walk for several]
    #[arg(long, value_enum)]
    cameras: Option<CameraPath>,
    /// Probability that a mask level of a view shows a thing at another granularity: split into parts, or merged with
    /// a neighbour. 0 is perfect; 0.3 resembles automatic masks of cluttered tables
    #[arg(long, value_name = "PROBABILITY", default_value_t = 0.3)]
    granularity_p: f64,
    /// Largest growth or shrinkage of a mask, 0 to 16
    #[arg(long, value_name = "PIXELS", default_value_t = 1)]
    boundary_noise: u32,
    /// Probability that a mask is missing
    #[arg(long, value_name = "PROBABILITY", default_value_t = 0.05)]
    missing: f64,
    /// Every how many views get polygon labels, from the first; 0 for none. Held-out views are every eighth
    #[arg(long, value_name = "COUNT", default_value_t = 4)]
    label_every: usize,
    #[command(flatten)]
    common: CommonArgs,
}

/// Sizes of scenes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Size {
    /// For tests: seconds for the whole pipeline.
    Tiny,
    /// For the demo: minutes.
    Demo,
    /// For benchmarks.
    Large,
}

impl Args {
    fn options(&self, seed: u64) -> Result<Options> {
        let (objects, views, width, height, points) = match self.size {
            Size::Tiny => (8, 8, 160, 120, 1_500),
            Size::Demo => (10, 30, 480, 360, 9_000),
            Size::Large => (40, 120, 640, 480, 40_000),
        };
        Ok(Options {
            seed,
            objects: within("--objects", self.objects.unwrap_or(objects), 1, 60)?,
            views: within("--views", self.views.unwrap_or(views), 1, 2000)?,
            width: within("--width", self.width.unwrap_or(width), 32, 4096)?,
            height: within("--height", self.height.unwrap_or(height), 32, 4096)?,
            points: within("--points", self.points.unwrap_or(points), 1, 10_000_000)?,
            cameras: self.cameras,
            faults: Faults {
                granularity: within("--granularity-p", self.granularity_p, 0.0, 1.0)?,
                boundary: within("--boundary-noise", self.boundary_noise, 0, 16)?,
                missing: within("--missing", self.missing, 0.0, 1.0)?,
            },
            label_every: self.label_every,
        })
    }
}

/// The value, if it lies in its range; NaN does not.
fn within<T: PartialOrd + std::fmt::Display>(option: &str, value: T, low: T, high: T) -> Result<T> {
    if value >= low && value <= high {
        return Ok(value);
    }
    Err(Error::new("out of range").field(option).found(value).expected(format!("{low} to {high}")))
}

impl Program for Args {
    const NAME: &'static str = "synth-scene";

    fn common(&self) -> &CommonArgs {
        &self.common
    }

    fn run(self, stage: &Stage) -> Result<()> {
        let options = self.options(stage.seed())?;
        write::run(stage, &self.out, &options)
    }
}
