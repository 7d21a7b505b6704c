//! The options of `synth-scene`, and the description of a scene that they come to.

#![allow(rustdoc::invalid_html_tags, reason = "help texts name files as <view>_s.npy")]

use crate::scene::Family;
use crate::truth::benchmark::{Layout, LayoutName};
use crate::truth::language::{Speech, Tongue};
use crate::truth::masks::Faults;
use clap::{Parser, ValueEnum};
use gs_io::{Error, Result};
use serde::Serialize;
use stage::{CommonArgs, within};
use std::path::PathBuf;

/// Make a room with things in it: photographs, poses, id maps, and the truth about all of them
///
/// The output is a COLMAP scene (images, sparse/0) with id maps of masks at four levels (language_features), the truth of
/// each point, view and mask (truth), and polygon labels (label). truth/scene.json is written last: where it stands, the
/// scene is complete. The same options and seed give the same bytes.
#[derive(Debug, Parser)]
#[command(name = "synth-scene", version)]
pub struct Args {
    /// Folder to write; an earlier synthetic scene in it is replaced
    #[arg(long, value_name = "DIR", required_unless_present = "masks_to")]
    pub(crate) out: Option<PathBuf>,
    /// Write only the masks of the scene, without photographs, into this folder: <view>_s.npy (and <view>_f.npy and
    /// text_features.json with --features), and masks.json, which says what each mask shows. Things and cameras do not
    /// depend on the faults, so the photographs of one scene serve many sets of masks
    #[arg(long, value_name = "DIR", conflicts_with = "out")]
    pub(crate) masks_to: Option<PathBuf>,
    /// Names and places of the files: as COLMAP writes them, or as in a benchmark
    #[arg(long, value_enum, default_value = "colmap", conflicts_with = "masks_to")]
    layout: LayoutName,
    /// Kind of scene
    #[arg(long, value_enum, default_value_t = Family::Studio)]
    family: Family,
    /// Defaults of the five options below
    #[arg(long, value_enum, default_value_t = Size::Demo)]
    size: Size,
    /// Things besides floor, walls, tables, counters and what is built into a workshop, 1 to 250, in a studio 1 to 60
    /// [tiny 8, demo 10, large 40]
    #[arg(long, value_name = "COUNT", value_parser = within(1usize..=MOST_OBJECTS))]
    objects: Option<usize>,
    /// Photographs, 1 to 2000 [tiny 8, demo 30, large 120]
    #[arg(long, value_name = "COUNT", value_parser = within(1usize..=2000))]
    views: Option<usize>,
    /// Width of the photographs in pixels, 32 to 4096 [tiny 160, demo 480, large 640]
    #[arg(long, value_name = "PIXELS", value_parser = within(32u32..=4096))]
    width: Option<u32>,
    /// Height of the photographs in pixels, 32 to 4096 [tiny 120, demo 360, large 480]
    #[arg(long, value_name = "PIXELS", value_parser = within(32u32..=4096))]
    height: Option<u32>,
    /// Points of the sparse cloud, or vertices of a scan, 1 to 10000000 [tiny 1500, demo 9000, large 40000]
    #[arg(long, value_name = "COUNT", value_parser = within(1usize..=10_000_000))]
    points: Option<usize>,
    /// Defaults of the three options of faults below, and all other faults of the masks and their features (docs/granularity.md)
    #[arg(long, value_enum, default_value_t = Corruption::Mild)]
    corruption: Corruption,
    /// Probability that a mask level of a view shows a thing at another granularity: split into parts, or merged with
    /// a neighbour [exact 0, mild 0.3, sam 0.1]
    #[arg(long, value_name = "PROBABILITY", value_parser = within(0.0..=1.0))]
    granularity_p: Option<f64>,
    /// Most pixels that a mask grows or shrinks by, 0 to 16 [exact 0, mild 1, sam 2]
    #[arg(long, value_name = "PIXELS", value_parser = within(0u32..=16))]
    boundary_noise: Option<u32>,
    /// Probability that a mask is missing [exact 0, mild 0.05, sam 0.05]
    #[arg(long, value_name = "PROBABILITY", value_parser = within(0.0..=1.0))]
    missing: Option<f64>,
    /// Noise of the poses in sparse/0, 0 to 10: standard deviation in degrees about each axis, and in centimetres along
    /// each axis. Photographs and truth keep the exact poses, which truth/sparse then holds
    #[arg(long, value_name = "SIZE", default_value_t = 0.0, value_parser = within(0.0..=10.0))]
    pose_noise: f64,
    /// Fine marks on all surfaces, 0 to 1: without them rooms are too plain for structure from
    /// motion, and 0.3 is enough
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, value_parser = within(0.0..=1.0))]
    detail: f64,
    /// Write a feature like CLIP's for each mask (<view>_f.npy), and a table of text features for eval --text-features:
    /// text_features.json in truth, or beside the masks
    #[arg(long)]
    features: bool,
    /// Geometry of the features: words at right angles, whose crops are their texts; or that of CLIP's ViT-B/16, with texts near
    /// each other, images apart from them, noise and confusions
    #[arg(long, value_enum, value_name = "NAME", default_value_t = Tongue::Words, requires = "features")]
    language: Tongue,
    #[command(flatten)]
    pub(crate) common: CommonArgs,
}

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
    /// As MobileSAM's masks of ray-traced rooms: torn, swallowing, and so in most views alike.
    Sam,
}

/// Most things of a scene, and of a studio, which names them by class and colour alone.
const MOST_OBJECTS: usize = 250;
const MOST_IN_STUDIO: usize = 60;
/// Every how many views have polygon labels, from the first, so that half of the held-out views, every eighth, do.
const LABEL_EVERY: usize = 4;

impl Corruption {
    /// The faults of masks and of features.
    fn faults(self) -> (Faults, Speech) {
        let mild = Faults { granularity: 0.3, boundary: 1, missing: 0.05, ..Faults::default() };
        match self {
            Self::Exact => (Faults::default(), Speech::default()),
            Self::Mild => (mild, Speech::default()),
            Self::Sam => {
                let masks = Faults { granularity: 0.1, boundary: 2, spurious: 0.15, torn: 1.0, swallow: 0.35, ..mild };
                (masks, Speech { leaking: 0.1, noise: 0.5, ..Speech::default() })
            }
        }
    }
}

/// What shapes a scene: the options, with the defaults where none was given. It is written whole into truth/scene.json.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Options {
    /// Seed of every random choice.
    pub seed: u64,
    /// What kind of scene.
    pub family: Family,
    /// Things besides floor, walls, tables, counters and what is built into a workshop; 1 to 60 in the studio, to 250 elsewhere.
    pub objects: usize,
    /// Number of photographs, at least 1.
    pub views: usize,
    /// Pixels of their width.
    pub width: u32,
    /// Pixels of their height.
    pub height: u32,
    /// Points of the sparse cloud; fewer where the views show fewer.
    pub points: usize,
    /// Faults of the id maps.
    #[serde(flatten)]
    pub faults: Faults,
    /// CLIP-like features of the masks, where asked for.
    #[serde(rename = "features")]
    pub speech: Option<Speech>,
    /// Noise of the poses in `sparse/0`, in degrees about and centimetres along each axis.
    pub pose_noise: f64,
    /// Strength of fine marks on all surfaces, 0 to 1.
    pub detail: f64,
    /// Every how many views get polygon labels; 0 for none.
    pub label_every: usize,
    /// Where the files lie, and what they are called.
    pub layout: Layout,
}

impl Default for Options {
    /// The demo's scene with perfect masks.
    fn default() -> Self {
        Size::Demo.options()
    }
}

impl Size {
    /// A studio of this size with perfect masks.
    fn options(self) -> Options {
        let (objects, views, width, height, points) = match self {
            Self::Tiny => (8, 8, 160, 120, 1_500),
            Self::Demo => (10, 30, 480, 360, 9_000),
            Self::Large => (40, 120, 640, 480, 40_000),
        };
        let (family, faults, layout) = (Family::Studio, Faults::default(), Layout::Colmap);
        let (seed, speech, pose_noise, detail, label_every) = (0, None, 0.0, 0.0, LABEL_EVERY);
        Options {
            seed,
            family,
            objects,
            views,
            width,
            height,
            points,
            faults,
            speech,
            pose_noise,
            detail,
            label_every,
            layout,
        }
    }
}

impl Args {
    /// The scene that the options describe.
    pub(crate) fn options(&self, seed: u64) -> Result<Options> {
        let size = self.size.options();
        let objects = self.objects.unwrap_or(size.objects);
        if self.family == Family::Studio && objects > MOST_IN_STUDIO {
            return Err(Error::new("too many things for a studio")
                .field("--objects")
                .found(objects)
                .expected(format!("1 to {MOST_IN_STUDIO}"))
                .hint("choose another --family"));
        }
        let (faults, speech) = self.corruption.faults();
        Ok(Options {
            seed,
            family: self.family,
            objects,
            views: self.views.unwrap_or(size.views),
            width: self.width.unwrap_or(size.width),
            height: self.height.unwrap_or(size.height),
            points: self.points.unwrap_or(size.points),
            faults: Faults {
                granularity: self.granularity_p.unwrap_or(faults.granularity),
                boundary: self.boundary_noise.unwrap_or(faults.boundary),
                missing: self.missing.unwrap_or(faults.missing),
                ..faults
            },
            speech: self.features.then_some(match self.language {
                Tongue::Words => speech,
                // It has noise of its own.
                language => Speech { language, noise: 0.0, ..speech },
            }),
            pose_noise: self.pose_noise,
            detail: self.detail,
            layout: self.out.as_deref().map_or(Ok(Layout::Colmap), |out| Layout::new(self.layout, out))?,
            ..size
        })
    }
}
