//! The command line of `mask-embed`: every option with its default and range.

#![allow(rustdoc::invalid_html_tags, reason = "help texts name files as <view>_s.npy")]

use gs_scene::dataset::Resolution;
use onnx_models::{Crop, EngineArgs};
use serde::{Serialize, Serializer};
use stage::CommonArgs;
use std::path::PathBuf;

/// Id maps and CLIP features of photographs, in LangSplat's files.
#[derive(Debug, Clone, clap::Parser)]
#[command(name = "mask-embed", version)]
pub struct Args {
    #[command(flatten)]
    pub(crate) common: CommonArgs,
    #[command(subcommand)]
    pub(crate) task: Task,
}

#[derive(Debug, Clone, clap::Subcommand)]
pub(crate) enum Task {
    /// Make id maps of photographs with SAM
    Masks(Box<MasksArgs>),
    /// Make CLIP features of the masks of existing id maps
    Embed(EmbedArgs),
    /// Make id maps from label pictures
    Import(ImportArgs),
    /// Write the pictures of all masks into one file, for training an encoder
    Crops(CropsArgs),
    /// Check that the two halves of a CLIP model can be run and fit together
    Check(CheckArgs),
}

/// Which photographs.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub(crate) struct SceneArgs {
    /// Scene folder: COLMAP, transforms.json, ScanNet or 7-Scenes
    #[arg(long, value_name = "FOLDER")]
    #[serde(skip)]
    pub scene: PathBuf,
    /// Size of the photographs: a divisor, a width that wider ones are shrunk to such as 640px, or auto for 1600px
    #[arg(long, default_value = "auto", value_name = "auto|WIDTHpx|DIVISOR")]
    pub resolution: Resolution,
}

/// What CLIP is shown of a mask.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub(crate) struct ShowArgs {
    /// What is beside the mask: black; the photograph's mean colour; or the photograph, in the mask's box with N % of its width
    /// and height more on each side. Of several, with commas between, embed takes the unit mean of the unit features
    #[arg(long, default_value = "black", value_name = "black|mean|boxN", value_delimiter = ',')]
    #[serde(serialize_with = "as_listed")]
    pub crop: Vec<Crop>,
}

fn as_listed<S: Serializer>(crops: &[Crop], serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(&crops.iter().map(Crop::to_string).collect::<Vec<_>>().join(","))
}

/// Id maps from photographs with SAM.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub(crate) struct MasksArgs {
    #[command(flatten)]
    #[serde(flatten)]
    pub scene: SceneArgs,
    #[command(flatten)]
    #[serde(flatten)]
    pub engine: EngineArgs,
    /// Output folder for id maps (<view>_s.npy) and, written last, masks.json
    #[arg(long, value_name = "FOLDER")]
    #[serde(skip)]
    pub out: PathBuf,
    /// Folder with SAM's encoder.onnx and sam.onnx, as `make models` fetches them, or other exports with a model.json
    /// (docs/masks.md)
    #[arg(long, default_value = "models", value_name = "FOLDER")]
    #[serde(skip)]
    pub sam: PathBuf,
    /// Folder of a panoptic model, which adds level classes with names: model.onnx, config.json and preprocessor_config.json as
    /// the hub has them (docs/masks.md). Up to six; the second adds classes-2 [default: none]
    #[arg(long, value_name = "FOLDER")]
    #[serde(skip)]
    pub panoptic: Vec<PathBuf>,
    /// Folder of a model that is asked for nouns, which adds level concepts with names: the three graphs of SAM 3 as samexporter
    /// exports them, or others with a model.json (docs/masks.md). Up to six; the second adds concepts-2 [default: none]
    #[arg(long, value_name = "FOLDER")]
    #[serde(skip)]
    pub concepts: Vec<PathBuf>,
    /// What to look for with --concepts: a text file, a noun a line. With SAM 3 each noun takes about 13 processor seconds a photograph
    /// [default: about 1,200 everyday things, the vocabulary of eval names]
    #[arg(long, value_name = "FILE", requires = "concepts")]
    #[serde(skip)]
    pub nouns: Option<PathBuf>,
    /// Longest side of the id maps in pixels; 0 for the size of the photograph
    #[arg(long, default_value_t = 800, value_name = "PIXELS")]
    pub map_size: usize,
    /// Masks, islands and holes of fewer pixels of the photograph are removed
    #[arg(long, default_value_t = 200, value_name = "PIXELS")]
    pub min_area: usize,
    #[command(flatten)]
    #[serde(flatten)]
    pub choice: Choice,
}

/// How masks are asked for and chosen.
#[derive(Debug, Clone, Copy, PartialEq, clap::Args, Serialize)]
#[command(next_help_heading = "Choice of masks")]
pub struct Choice {
    /// Points asked along the longer side of a photograph; along the shorter as many as fit the same distance
    #[arg(long, default_value_t = 32, value_name = "COUNT", value_parser = stage::within(1usize..=256))]
    pub points_per_side: usize,
    /// Least IoU that SAM predicts for a mask, 0 to 1
    #[arg(long, default_value_t = 0.7, value_name = "IOU", value_parser = stage::within(0.0..=1.0))]
    pub pred_iou: f64,
    /// Least stability of a mask, 0 to 1: IoU of the mask cut a little tighter and a little looser. SAM's own script has
    /// 0.85; the edges of MobileSAM are softer
    #[arg(long, default_value_t = 0.7, value_name = "IOU", value_parser = stage::within(0.0..=1.0))]
    pub stability: f64,
    /// Skip nothing: run the encoder's graph, and the decoder's whole graph for every point of the grid (docs/performance.md)
    #[arg(long)]
    pub no_skip: bool,
}

/// CLIP features of existing id maps.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub(crate) struct EmbedArgs {
    #[command(flatten)]
    #[serde(flatten)]
    pub scene: SceneArgs,
    #[command(flatten)]
    #[serde(flatten)]
    pub engine: EngineArgs,
    #[command(flatten)]
    #[serde(flatten)]
    pub show: ShowArgs,
    /// Folder with id maps (<view>_s.npy)
    #[arg(long, value_name = "FOLDER")]
    #[serde(skip)]
    pub masks: PathBuf,
    /// Folder with CLIP's image.onnx and clip.json
    #[arg(long, value_name = "FOLDER")]
    #[serde(skip)]
    pub clip: PathBuf,
    /// Encode only the masks that the instances of this file (cluster-match --draft) are described by; the features of others are zeros
    /// [default: all masks]
    #[arg(long, value_name = "FILE")]
    #[serde(skip)]
    pub only: Option<PathBuf>,
    /// Output folder for <view>_f.npy and, written last, features.json [default: the folder of the id maps]
    #[arg(long, value_name = "FOLDER")]
    #[serde(skip)]
    pub out: Option<PathBuf>,
}

/// A CLIP model.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct CheckArgs {
    #[command(flatten)]
    pub engine: EngineArgs,
    /// Folder with CLIP's image.onnx, text.onnx and clip.json
    #[arg(long, value_name = "FOLDER")]
    pub clip: PathBuf,
}

/// Id maps from label pictures.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct ImportArgs {
    /// Folder with grey PNGs of 8 or 16 bits, 0 for no mask: <view>.png for all levels, or <view>_default.png,
    /// <view>_small.png, <view>_medium.png and <view>_large.png
    #[arg(long, value_name = "FOLDER")]
    pub labels: PathBuf,
    /// Output folder for id maps (<view>_s.npy) and, written last, masks.json
    #[arg(long, value_name = "FOLDER")]
    pub out: PathBuf,
}

/// Crops of all masks in one file.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub(crate) struct CropsArgs {
    #[command(flatten)]
    #[serde(flatten)]
    pub scene: SceneArgs,
    #[command(flatten)]
    #[serde(flatten)]
    pub show: ShowArgs,
    /// Folder with id maps (<view>_s.npy)
    #[arg(long, value_name = "FOLDER")]
    #[serde(skip)]
    pub masks: PathBuf,
    /// Output file (safetensors): pixels u8 [n, 3, S, S], view u32 [n], mask u32 [n], the crops of a mask one after the
    /// other; in the metadata the names of the
    /// views and, of a synthetic scene, the token ids of every caption
    #[arg(long, value_name = "FILE")]
    #[serde(skip)]
    pub out: PathBuf,
    /// Side S of the crops in pixels
    #[arg(long, default_value_t = 64, value_name = "PIXELS", value_parser = stage::within(1usize..=1024))]
    pub size: usize,
}
