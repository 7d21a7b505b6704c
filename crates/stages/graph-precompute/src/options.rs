//! The command line of `graph-precompute`: every option with its default and range.

#![allow(rustdoc::invalid_html_tags, reason = "help texts name files as <view>_s.npy")]

use artifacts::Level;
use serde::Serialize;
use stage::CommonArgs;
use std::path::PathBuf;

/// Footprints of masks, anchors and neighbours of frozen Gaussians
#[derive(Debug, clap::Parser)]
#[command(name = "graph-precompute", version)]
pub struct Args {
    /// Dataset folder (COLMAP, transforms.json, ScanNet or 7-Scenes)
    #[arg(long, value_name = "DIR")]
    pub(crate) scene: PathBuf,
    /// Gaussians: a PLY of 3DGS, or another format of docs/splats.md
    #[arg(long, value_name = "FILE")]
    pub(crate) geometry: PathBuf,
    /// Folder with id maps (<view>_s.npy)
    #[arg(long, value_name = "DIR")]
    pub(crate) masks: PathBuf,
    /// Output file of the footprints
    #[arg(long, value_name = "FILE")]
    pub(crate) footprints: PathBuf,
    /// Output file of the graph (written last)
    #[arg(long, value_name = "FILE")]
    pub(crate) graph: PathBuf,
    #[command(flatten)]
    pub(crate) settings: Settings,
    #[command(flatten)]
    pub(crate) common: CommonArgs,
}

/// What shapes the result. The provenance of both artifacts holds all of it.
#[derive(Debug, Clone, PartialEq, clap::Args, Serialize)]
pub(crate) struct Settings {
    /// Views whose masks are used; the protocols learn from training views only
    #[arg(long, value_enum, default_value_t = Views::Train)]
    pub views: Views,
    #[command(flatten)]
    #[serde(flatten)]
    pub held: stage::HoldoutArgs,
    /// Share of the Gaussians that become anchors; at least one does
    #[arg(long, value_name = "SHARE", default_value_t = 0.1, value_parser = stage::within(1e-9..=1.0))]
    pub anchor_ratio: f64,
    /// Neighbours per anchor
    #[arg(long, value_name = "COUNT", default_value_t = 16, value_parser = stage::within(1usize..=1024))]
    pub k: usize,
    /// Levels of the masks, with commas between: default, small, medium, large, classes, concepts, classes-2 and so on. The files
    /// hold no others, so the later stages can use no others [default: all]
    #[arg(long, value_name = "LEVELS", value_delimiter = ',')]
    pub levels: Vec<Level>,
    /// Shrink id maps by this factor, 1 to 64, before footprints are measured: every N-th pixel of every N-th row stays, as in
    /// OpenGaussian with -r N (2 on ScanNet)
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = stage::within(1usize..=64))]
    #[serde(skip_serializing_if = "is_one")]
    pub mask_divisor: usize,
    /// A pixel counts where its accumulated alpha exceeds this; with --preset literal the default is 0
    #[arg(long, value_name = "ALPHA", value_parser = stage::within(0.0..=0.999), default_value = "0.7",
        default_value_if("preset", "literal", "0"))]
    pub gate: f64,
    /// Leave out masks of fewer pixels, counted in an image of 986 x 728 and scaled down for smaller id maps; with --preset
    /// literal the default is 0
    #[arg(long, value_name = "PIXELS", value_parser = stage::within(0.0..=1e9), default_value = "50",
        default_value_if("preset", "literal", "0"))]
    pub min_mask_pixels: f64,
    /// Drop footprint entries below this share of their mask; 0 keeps all. The largest change is reported
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, value_parser = stage::within(0.0..=0.999))]
    pub cut: f64,
    /// Also keep this many random pixels of each mask, for the losses of feat-train that look at single pixels
    #[arg(long, value_name = "COUNT", default_value_t = 0, value_parser = stage::within(0usize..=4096))]
    pub pixel_samples: usize,
    /// What is skipped.
    #[command(flatten)]
    #[serde(flatten)]
    pub skip: stage::SkipArgs,
    /// Options that go together [default: none]
    #[arg(long, value_enum)]
    pub preset: Option<Preset>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Views {
    /// Training views
    Train,
    /// Training views and held-out views
    All,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
pub(crate) enum Preset {
    /// The paper as printed: anchors are sampled among all Gaussians, seen or not, and every pixel of every mask counts
    Literal,
}

/// Whether id maps stay as they are: the provenance names a divisor only where there is one.
fn is_one(divisor: &usize) -> bool {
    *divisor == 1
}

impl Settings {
    /// Whether Gaussians that no view sees take part.
    pub fn keep_unseen(&self) -> bool {
        self.skip.no_skip || self.preset == Some(Preset::Literal)
    }
}
