//! The command line of `synth-scene`.

#![allow(rustdoc::invalid_html_tags, reason = "help texts name files as <view>_s.npy")]

use crate::scene::Family;
use crate::scene::cameras::Path as CameraPath;
use crate::truth::benchmark::{Layout, LayoutName};
use crate::truth::language::Speech;
use crate::truth::masks::Faults;
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
    #[arg(long, value_name = "DIR", required_unless_present = "masks_to")]
    out: Option<PathBuf>,
    /// Write only the masks of the scene that the other options describe, without photographs: <view>_s.npy (and
    /// <view>_f.npy and text_features.json with --features) and masks.json, what each mask shows. So one scene's
    /// photographs and geometry serve masks with many faults, which never move a thing or a camera
    #[arg(long, value_name = "DIR", conflicts_with = "out")]
    masks_to: Option<PathBuf>,
    /// Where files lie and what they are called: as COLMAP leaves them, or as a miniature of a benchmark
    #[arg(long, value_enum, default_value = "colmap", conflicts_with = "masks_to")]
    layout: LayoutName,
    /// What kind of scene
    #[arg(long, value_enum, default_value_t = Family::Studio)]
    family: Family,
    /// Sizes that the options below default to
    #[arg(long, value_enum, default_value_t = Size::Demo)]
    size: Size,
    /// Things besides floor, walls, tables and counters, 1 to 60 (studio) or 250 (others) [tiny 8, demo 10, large 40]
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
    /// Points of the sparse cloud, or vertices of a scan, 1 to 10000000 [tiny 1500, demo 9000, large 40000]
    #[arg(long, value_name = "COUNT")]
    points: Option<usize>,
    /// Where the camera goes [a ring for one table, a walk for several, kitchens and rooms]
    #[arg(long, value_enum)]
    cameras: Option<CameraPath>,
    /// What the faults below default to
    #[arg(long, value_enum, default_value_t = Corruption::Mild)]
    corruption: Corruption,
    /// Probability that a mask level of a view shows a thing at another granularity: split into parts, or merged with
    /// a neighbour [exact 0, mild 0.3, sam 0.5]
    #[arg(long, value_name = "PROBABILITY")]
    granularity_p: Option<f64>,
    /// Largest growth or shrinkage of a mask, 0 to 16 [exact 0, mild 1, sam 1]
    #[arg(long, value_name = "PIXELS")]
    boundary_noise: Option<u32>,
    /// Probability that a mask is missing [exact 0, mild 0.05, sam 0.05]
    #[arg(long, value_name = "PROBABILITY")]
    missing: Option<f64>,
    /// Spurious masks per mask of a level, 0 to 1: patches that are no thing [exact 0, mild 0, sam 0.15]
    #[arg(long, value_name = "SHARE")]
    spurious: Option<f64>,
    /// Noise of the poses in sparse/0, 0 to 10: standard deviation in degrees about each axis, and in centimetres along
    /// it. Photographs and truth keep the exact ones, which truth/sparse then holds [0]
    #[arg(long, value_name = "SIZE")]
    pose_noise: Option<f64>,
    /// Give each mask a CLIP-like feature (<view>_f.npy) and write a table of text features for eval --text-features:
    /// text_features.json in truth, or beside the masks
    #[arg(long)]
    features: bool,
    /// Weight of what lies beside a mask in the crop that its feature means, 0 to 1 [exact 0, mild 0, sam 0.1]
    #[arg(long, value_name = "SHARE", requires = "features")]
    leaking: Option<f64>,
    /// Expected length of the noise added to a mask's unit feature, 0 to 10 [exact 0, mild 0, sam 0.5]
    #[arg(long, value_name = "SIZE", requires = "features")]
    feature_noise: Option<f64>,
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

/// Settings of all faults together; docs/granularity.md says where they come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Corruption {
    /// No faults.
    Exact,
    /// A few faults of granularity, edges a pixel off, some masks missing.
    Mild,
    /// As inconsistent from view to view as SAM's masks of a real desk.
    Sam,
}

/// What a [`Corruption`] sets.
struct Knobs {
    faults: Faults,
    speech: Speech,
    pose_noise: f64,
}

impl Corruption {
    fn knobs(self) -> Knobs {
        let exact = Knobs { faults: Faults::default(), speech: Speech::default(), pose_noise: 0.0 };
        match self {
            Self::Exact => exact,
            Self::Mild => {
                Knobs { faults: Faults { granularity: 0.3, boundary: 1, missing: 0.05, spurious: 0.0 }, ..exact }
            }
            Self::Sam => Knobs {
                faults: Faults { granularity: 0.5, boundary: 1, missing: 0.05, spurious: 0.15 },
                speech: Speech { leaking: 0.1, noise: 0.5 },
                ..exact
            },
        }
    }
}

/// Most things of a studio, which names them by class and colour, and of other families.
const MOST_STUDIO: usize = 60;
const MOST: usize = 250;

impl Args {
    fn options(&self, seed: u64) -> Result<Options> {
        let (objects, views, width, height, points) = match self.size {
            Size::Tiny => (8, 8, 160, 120, 1_500),
            Size::Demo => (10, 30, 480, 360, 9_000),
            Size::Large => (40, 120, 640, 480, 40_000),
        };
        let most = if self.family == Family::Studio { MOST_STUDIO } else { MOST };
        let Knobs { faults, speech, pose_noise } = self.corruption.knobs();
        let share = |option: &str, given: Option<f64>, preset: f64| within(option, given.unwrap_or(preset), 0.0, 1.0);
        let speech = Speech {
            leaking: share("--leaking", self.leaking, speech.leaking)?,
            noise: within("--feature-noise", self.feature_noise.unwrap_or(speech.noise), 0.0, 10.0)?,
        };
        Ok(Options {
            seed,
            family: self.family,
            objects: within("--objects", self.objects.unwrap_or(objects), 1, most)?,
            views: within("--views", self.views.unwrap_or(views), 1, 2000)?,
            width: within("--width", self.width.unwrap_or(width), 32, 4096)?,
            height: within("--height", self.height.unwrap_or(height), 32, 4096)?,
            points: within("--points", self.points.unwrap_or(points), 1, 10_000_000)?,
            cameras: self.cameras,
            faults: Faults {
                granularity: share("--granularity-p", self.granularity_p, faults.granularity)?,
                boundary: within("--boundary-noise", self.boundary_noise.unwrap_or(faults.boundary), 0, 16)?,
                missing: share("--missing", self.missing, faults.missing)?,
                spurious: share("--spurious", self.spurious, faults.spurious)?,
            },
            speech: self.features.then_some(speech),
            pose_noise: within("--pose-noise", self.pose_noise.unwrap_or(pose_noise), 0.0, 10.0)?,
            label_every: self.label_every,
            layout: self.out.as_deref().map_or(Ok(Layout::Colmap), |out| Layout::new(self.layout, out))?,
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

    fn check(&self) -> Result<()> {
        self.options(self.common.seed).map(drop)
    }

    fn run(self, stage: &Stage) -> Result<()> {
        let options = self.options(stage.seed())?;
        match (&self.out, &self.masks_to) {
            (_, Some(folder)) => write::run_masks(stage, folder, &options),
            (Some(out), None) => write::run(stage, out, &options),
            (None, None) => Err(Error::new("nowhere to write").field("--out")),
        }
    }
}
