//! Arguments of the programs.

#![allow(rustdoc::invalid_html_tags, reason = "help texts name files as <view>_s.npy")]

use crate::automatic::Choice;
use crate::nms::MaskNms;
use gs_io::{Error, Result};
use gs_scene::dataset::Resolution;
use onnx_models::EngineOptions;
use std::path::PathBuf;

/// Which photographs.
#[derive(Debug, Clone, clap::Args)]
pub struct SceneArgs {
    /// Scene: COLMAP, transforms.json or ScanNet
    #[arg(long, value_name = "FOLDER")]
    pub scene: PathBuf,
    /// Size of the photographs: a divisor, a width that wider ones are shrunk to such as 640px, or auto for 1600px
    #[arg(long, default_value = "auto", value_name = "auto|WIDTHpx|DIVISOR")]
    pub resolution: Resolution,
}

/// Which engine runs the models.
#[derive(Debug, Clone, clap::Args)]
pub struct EngineArgs {
    /// Run the models with ONNX Runtime instead of the built-in engine: path of libonnxruntime.so, 1.20 or later.
    /// Needs ORT_DISABLE_TELEMETRY=1 in the environment
    #[arg(long, value_name = "LIBRARY")]
    pub onnx_runtime: Option<PathBuf>,
}

impl EngineArgs {
    /// Options for [`onnx_models::open`].
    pub fn options(&self) -> EngineOptions {
        EngineOptions { onnx_runtime: self.onnx_runtime.clone(), threads_per_run: 1 }
    }
}

/// Id maps from photographs with SAM.
#[derive(Debug, Clone, clap::Args)]
pub struct MasksArgs {
    #[command(flatten)]
    pub(crate) scene: SceneArgs,
    #[command(flatten)]
    pub(crate) engine: EngineArgs,
    /// Folder with SAM's encoder.onnx and sam.onnx, as `make models` fetches them
    #[arg(long, default_value = "models", value_name = "FOLDER")]
    pub(crate) sam: PathBuf,
    /// Folder for <view>_s.npy and, last of all, masks.json
    #[arg(long, value_name = "FOLDER")]
    pub(crate) out: PathBuf,
    /// Longest side of the id maps in pixels; 0 for the photograph's own size
    #[arg(long, default_value_t = 800, value_name = "PIXELS")]
    pub(crate) map_size: usize,
    /// Smaller masks, islands and holes than this go, in pixels of the photograph
    #[arg(long, default_value_t = 200, value_name = "PIXELS")]
    pub(crate) min_area: usize,
    /// Also write a picture of each view's masks into this folder
    #[arg(long, value_name = "FOLDER")]
    pub(crate) preview: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) choice: ChoiceArgs,
}

/// How masks are asked for and chosen.
#[derive(Debug, Clone, clap::Args)]
#[command(next_help_heading = "Choice of masks")]
pub struct ChoiceArgs {
    /// Points asked along the longer side of a photograph
    #[arg(long, default_value_t = 32, value_name = "COUNT", value_parser = clap::value_parser!(u16).range(1..=256))]
    points_per_side: u16,
    /// Least IoU that SAM predicts for a mask
    #[arg(long, default_value_t = 0.7, value_name = "0..1", value_parser = unit)]
    pred_iou: f64,
    /// Least stability: IoU of the mask cut a little tighter and a little looser. SAM's script has 0.85; MobileSAM's
    /// edges are softer
    #[arg(long, default_value_t = 0.7, value_name = "0..1", value_parser = unit)]
    stability: f64,
    /// Largest part of the photograph that a mask may cover
    #[arg(long, default_value_t = 0.6, value_name = "0..1", value_parser = unit)]
    max_area: f64,
    /// Of masks whose boxes overlap by more than this (IoU) the best stays
    #[arg(long, default_value_t = 0.7, value_name = "0..1", value_parser = unit)]
    box_nms: f64,
    /// Within a level, of masks that overlap by more than this (IoU) the best stays
    #[arg(long, default_value_t = 0.8, value_name = "0..1", value_parser = unit)]
    nms_iou: f64,
    /// Within a level, masks of a lower score (predicted IoU x stability) go
    #[arg(long, default_value_t = 0.6, value_name = "0..1", value_parser = unit)]
    nms_score: f64,
    /// Within a level, fragments of a larger mask go; lower keeps more of them, 0 all
    #[arg(long, default_value_t = 0.5, value_name = "0..1", value_parser = unit)]
    nms_inner: f64,
    /// Points within a small mask already found with at least this score need not be asked; 2 asks all
    #[arg(long, default_value_t = 0.8, value_name = "0..2", value_parser = up_to_two)]
    skip_score: f64,
    /// Leave a level empty where SAM finds nothing good at it, instead of taking masks of the other levels there
    #[arg(long)]
    no_fill: bool,
}

impl ChoiceArgs {
    /// The same in the library's terms.
    pub fn choice(&self) -> Choice {
        Choice {
            points_per_side: usize::from(self.points_per_side),
            predicted_iou: self.pred_iou as f32,
            stability: self.stability as f32,
            max_area: self.max_area,
            box_nms: self.box_nms,
            mask_nms: MaskNms { iou: self.nms_iou, score: self.nms_score as f32, inner: self.nms_inner },
            skip_score: self.skip_score as f32,
            fill: !self.no_fill,
        }
    }

    /// The same for provenance.
    pub fn json(&self) -> serde_json::Value {
        serde_json::json!({
            "points_per_side": self.points_per_side, "pred_iou": self.pred_iou, "stability": self.stability,
            "max_area": self.max_area,
            "box_nms": self.box_nms, "nms_iou": self.nms_iou, "nms_score": self.nms_score,
            "nms_inner": self.nms_inner, "skip_score": self.skip_score, "fill": !self.no_fill,
        })
    }
}

fn within(text: &str, most: f64) -> Result<f64> {
    let wrong = || Error::new("not in range").found(text).expected(format!("a number from 0 to {most}"));
    text.parse().ok().filter(|v| (0.0..=most).contains(v)).ok_or_else(wrong)
}

fn unit(text: &str) -> Result<f64> {
    within(text, 1.0)
}

fn up_to_two(text: &str) -> Result<f64> {
    within(text, 2.0)
}

/// CLIP features of existing id maps.
#[derive(Debug, Clone, clap::Args)]
pub struct EmbedArgs {
    #[command(flatten)]
    pub(crate) scene: SceneArgs,
    #[command(flatten)]
    pub(crate) engine: EngineArgs,
    /// Folder with <view>_s.npy
    #[arg(long, value_name = "FOLDER")]
    pub(crate) masks: PathBuf,
    /// Folder with CLIP's image.onnx and clip.json
    #[arg(long, value_name = "FOLDER")]
    pub(crate) clip: PathBuf,
    /// Folder for <view>_f.npy and, last of all, features.json; the masks folder if not given
    #[arg(long, value_name = "FOLDER")]
    pub(crate) out: Option<PathBuf>,
}

/// Id maps from label pictures.
#[derive(Debug, Clone, clap::Args)]
pub struct ImportArgs {
    /// Folder with PNGs of 8 or 16 bits of grey, 0 for no mask: <view>.png for all levels, or <view>_default.png,
    /// <view>_small.png, <view>_medium.png and <view>_large.png
    #[arg(long, value_name = "FOLDER")]
    pub(crate) labels: PathBuf,
    /// Folder for <view>_s.npy and, last of all, masks.json
    #[arg(long, value_name = "FOLDER")]
    pub(crate) out: PathBuf,
}

/// Crops of all masks in one file.
#[derive(Debug, Clone, clap::Args)]
pub struct CropsArgs {
    #[command(flatten)]
    pub(crate) scene: SceneArgs,
    /// Folder with <view>_s.npy
    #[arg(long, value_name = "FOLDER")]
    pub(crate) masks: PathBuf,
    /// Output, safetensors: pixels u8 [n, 3, S, S], view u32 [n], mask u32 [n], names of views in the metadata
    #[arg(long, value_name = "FILE")]
    pub(crate) out: PathBuf,
    /// Side S of the crops in pixels
    #[arg(long, default_value_t = 64, value_name = "PIXELS", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub(crate) size: u16,
}

/// Token ids of the captions of synthetic scenes.
#[derive(Debug, Clone, clap::Args)]
pub struct TokenizeArgs {
    /// Folder under which scenes with truth/scene.json and truth/masks.json lie
    #[arg(long, value_name = "FOLDER")]
    pub(crate) truth: PathBuf,
    /// Output: JSON, text -> CLIP's token ids without marks of start and end
    #[arg(long, value_name = "FILE")]
    pub(crate) out: PathBuf,
}
