//! The options of `feat-train`, with their defaults and ranges. [`Options`] goes into the provenance of the features.

#![allow(rustdoc::invalid_html_tags, reason = "help texts name files as <FILE>.curve.svg")]

use artifacts::Level;
use clap::{Parser, ValueEnum};
use gs_io::{Error, Result};
use serde::Serialize;
use serde_json::{Value, json};
use stage::{CommonArgs, at_least, within};
use std::path::PathBuf;

/// Computes a feature for every Gaussian from the masks of all views
#[derive(Debug, Parser)]
#[command(name = "feat-train", version)]
pub struct Args {
    /// Gaussians: a PLY of 3DGS, or another format of docs/splats.md
    #[arg(long, value_name = "FILE")]
    pub(crate) geometry: PathBuf,
    /// The graph.safetensors of graph-precompute
    #[arg(long, value_name = "FILE")]
    pub(crate) graph: PathBuf,
    /// The footprints.safetensors of graph-precompute
    #[arg(long, value_name = "FILE")]
    pub(crate) footprints: PathBuf,
    /// Output: the features. Their curve goes to <FILE>.curve.jsonl and, as a picture, to <FILE>.curve.svg
    #[arg(long, value_name = "FILE")]
    pub(crate) out: PathBuf,
    #[command(flatten)]
    pub(crate) options: Options,
    #[command(flatten)]
    pub(crate) common: CommonArgs,
}

/// What shapes the features.
#[derive(Debug, Clone, PartialEq, clap::Args, Serialize)]
pub struct Options {
    /// Train the features with the paper's method instead of computing them in closed form. The options under "Paper" change
    /// it; where the two presets differ, their help says so
    #[arg(long, value_enum)]
    pub preset: Option<Preset>,
    /// Mask levels to use, separated by commas: default, small, medium, large, classes, concepts, classes-2 and so on [default: all; large with --preset]
    #[arg(long, value_name = "LEVELS", value_delimiter = ',')]
    pub levels: Vec<Level>,
    /// Dimension of the features, 1 to 512, or 2 to 64 with --preset [default: 6 with --preset; else as many as there are
    /// singular values above 0.6, at most 256, and from 262,144 Gaussians on fewer, down to 64]
    #[arg(long, value_name = "COUNT", value_parser = within(1usize..=512))]
    pub dim: Option<usize>,
    /// What only the paper's method reads.
    #[command(flatten)]
    pub contrastive: Contrastive,
}

/// A set of defaults.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Preset {
    /// The paper as printed: contextual propagation and contrastive learning.
    Literal,
    /// The reading of the paper that does best, among those that its text allows (docs/results/paper.md).
    Paper,
}

/// Options of the paper's method, and what only the preset says.
#[derive(Debug, Clone, PartialEq, clap::Args, Serialize)]
#[command(next_help_heading = "Paper (with --preset)")]
#[group(requires = "preset")]
pub struct Contrastive {
    /// Training iterations, one random view each
    #[arg(long, value_name = "COUNT", default_value_t = 10_000)]
    pub iterations: u64,
    /// Layers of the graph network, 0 to 4; 0 trains the features without context
    #[arg(long, value_name = "COUNT", default_value_t = 2, value_parser = within(0usize..=4))]
    pub layers: usize,
    /// Loss on the masks of a view; with --preset paper the default is gaussian
    #[arg(long, value_enum, default_value = "printed", default_value_if("preset", "paper", "gaussian"))]
    pub loss: Loss,
    /// Pixels of each mask that a loss of pixels looks at, drawn anew in every iteration from those that graph-precompute
    /// --pixel-samples kept; 0 takes all of them
    #[arg(long, value_name = "COUNT", default_value_t = 0)]
    pub pixels: usize,
    /// Weight of the cohesion loss, 0 or more: the mean distance of a mask's sampled pixels from its centroid. Needs
    /// graph-precompute --pixel-samples
    #[arg(long, value_name = "WEIGHT", default_value_t = 0.0, value_parser = at_least(0.0))]
    pub cohesion: f64,
    /// Add the output of the graph network to the anchors only, not to all Gaussians
    #[arg(long)]
    pub no_propagation: bool,
    /// When the feature of each Gaussian is brought to unit length.
    #[arg(skip = UnitLength::Never)]
    pub unit_length: UnitLength,
    /// Values that share a mean and a standard deviation in the graph network.
    #[arg(skip = Axis::Channel)]
    pub norm_axis: Axis,
    /// Initial features.
    #[arg(skip = Init::Uniform)]
    pub init: Init,
    /// Temperature of the loss.
    #[arg(skip = 0.1)]
    pub tau: f64,
    /// Learning rate of the features.
    #[arg(skip = 0.001)]
    pub lr: f64,
}

/// When the feature of a Gaussian is brought to unit length.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum UnitLength {
    /// Never: as printed in the paper.
    Never,
    /// After context was added to it.
    After,
}

/// Values that are standardised together.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Axis {
    /// Each channel over all Gaussians.
    Channel,
    /// Each Gaussian over its channels.
    Gaussian,
}

/// Loss on the masks of a view.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Loss {
    /// As printed in the paper: the positive is the mask itself, a constant; the other masks are in the denominator.
    Printed,
    /// Per Gaussian: each Gaussian against the centroids of all masks. Its positives are its own masks, by their weight.
    Gaussian,
    /// Per pixel: each sampled pixel against the centroids of all masks. Its positive is its own mask.
    Pixel,
    /// OpenGaussian's: centroids of different masks push each other apart, the nearest the most. Its other half is --cohesion
    /// 0.1.
    Separation,
}

/// Initial features.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Init {
    /// Uniform in 0 to 1, as in OpenGaussian.
    Uniform,
    /// Normal, with a standard deviation of 0.01.
    NormalSmall,
}

impl Default for Contrastive {
    /// The paper as printed.
    fn default() -> Self {
        #[derive(Parser)]
        struct Alone {
            #[arg(hide = true)]
            preset: Option<String>,
            #[command(flatten)]
            options: Contrastive,
        }
        Alone::parse_from(["feat-train"]).options
    }
}

impl Contrastive {
    /// Whether the loss reads sampled pixels.
    pub fn needs_pixels(&self) -> bool {
        self.loss == Loss::Pixel || self.cohesion > 0.0
    }
}

/// Dimension of the features with `--preset`, where `--dim` is not given.
const PAPER_DIM: usize = 6;
/// Dimension of the closed form where `--dim` is not given: between these, as long as all features together have at most
/// so many values (256 MB).
const MOST_VECTORS: usize = 256;
const LEAST_VECTORS: usize = 64;
const MOST_VALUES: usize = 1 << 26;

impl Options {
    /// Refuses what the ranges of single options let pass.
    pub(crate) fn check(&self) -> Result<()> {
        match self.dim {
            Some(dim) if self.preset.is_some() && !(2..=64).contains(&dim) => {
                Err(Error::new("out of range").field("--dim").found(dim).expected("2 to 64 with --preset"))
            }
            _ => Ok(()),
        }
    }

    /// Levels of the masks that count.
    pub(crate) fn levels(&self) -> Vec<Level> {
        match (&self.levels[..], self.preset) {
            ([], None) => Level::ALL.to_vec(),
            ([], Some(_)) => vec![Level::LARGE],
            (given, _) => given.to_vec(),
        }
    }

    /// The paper's method as the preset has it, and the options that were given.
    pub(crate) fn method(&self) -> Contrastive {
        let given = self.contrastive.clone();
        if self.preset != Some(Preset::Paper) {
            return given;
        }
        let (unit_length, norm_axis, init) = (UnitLength::After, Axis::Gaussian, Init::NormalSmall);
        Contrastive { unit_length, norm_axis, init, tau: 0.2, lr: 0.01, ..given }
    }

    /// Dimension of trained features.
    pub(crate) fn trained_dim(&self) -> usize {
        self.dim.unwrap_or(PAPER_DIM)
    }

    /// Vectors that the closed form keeps, at most.
    pub(crate) fn most_vectors(&self, gaussians: usize) -> usize {
        self.dim.unwrap_or((MOST_VALUES / gaussians.max(1)).clamp(LEAST_VECTORS, MOST_VECTORS))
    }

    /// All of them and the seed, with what depends on the preset filled in and without the options of the paper's method where it is not used.
    pub(crate) fn parameters(&self, seed: u64) -> Value {
        let trained = self.preset.is_some();
        let dim = if trained { Some(self.trained_dim()) } else { self.dim };
        let levels = if trained { self.levels() } else { self.levels.clone() };
        let mut parameters = json!(Self { levels, dim, contrastive: self.method(), ..self.clone() });
        parameters["seed"] = json!(seed);
        if !trained {
            parameters.as_object_mut().expect("a struct is an object").remove("contrastive");
        }
        parameters
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parameters_are_all_options_of_the_method_with_its_defaults() {
        let of = |arguments: &[&str]| {
            let files = ["feat-train", "--geometry", "g", "--graph", "g", "--footprints", "f", "--out", "o"];
            Args::parse_from([&files, arguments].concat()).options.parameters(3)
        };
        let closed = json!({ "preset": null, "levels": [], "dim": null, "seed": 3 });
        assert_eq!(of(&[]), closed);
        let literal = of(&["--preset", "literal", "--loss", "separation"]);
        assert_eq!(
            (&literal["preset"], &literal["levels"], &literal["dim"]),
            (&json!("literal"), &json!(["large"]), &json!(6))
        );
        assert_eq!(literal["contrastive"], json!(Contrastive { loss: Loss::Separation, ..Contrastive::default() }));
        assert_eq!(literal["contrastive"].as_object().map(serde_json::Map::len), Some(11));
        let best = Contrastive {
            init: Init::NormalSmall,
            unit_length: UnitLength::After,
            norm_axis: Axis::Gaussian,
            tau: 0.2,
            lr: 0.01,
            pixels: 9,
            loss: Loss::Gaussian,
            ..Contrastive::default()
        };
        assert_eq!(of(&["--preset", "paper", "--pixels", "9"])["contrastive"], json!(best), "what is given wins");
    }
}
