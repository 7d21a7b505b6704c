//! The command line of `graph-precompute`.

#![allow(rustdoc::invalid_html_tags, reason = "help texts name files as <view>_s.npy")]

use crate::graph::{GraphOptions, Space};
use crate::precompute::{Options, precompute};
use artifacts::{Footprints, Graph, ScratchEntries, role};
use gs_io::{Error, Result, Watched, hash_file};
use gs_scene::Geometry;
use gs_scene::dataset::{self, LoadOptions, Resolution, Split, View};
use serde_json::{Value, json};
use stage::{CommonArgs, Program, Stage};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Footprints of masks, anchors and neighbours of frozen Gaussians
#[derive(Debug, clap::Parser)]
#[command(name = "graph-precompute", version)]
pub struct Args {
    /// Dataset folder (COLMAP, transforms.json or ScanNet)
    #[arg(long, value_name = "DIR")]
    scene: PathBuf,
    /// Gaussians, as a 3DGS PLY
    #[arg(long, value_name = "FILE")]
    geometry: PathBuf,
    /// Folder of id maps (<photograph>_s.npy)
    #[arg(long, value_name = "DIR")]
    masks: PathBuf,
    /// Where to write the footprints
    #[arg(long, value_name = "FILE")]
    footprints: PathBuf,
    /// Where to write the graph (written last)
    #[arg(long, value_name = "FILE")]
    graph: PathBuf,
    /// Which views' masks to use; the protocols learn from training views only
    #[arg(long, value_enum, default_value_t = Views::Train)]
    views: Views,
    /// Hold out every n-th view; 0 holds none out
    #[arg(long, value_name = "N", default_value_t = 8)]
    holdout: usize,
    /// Share of the Gaussians that become anchors; at least one does
    #[arg(long, value_name = "SHARE", default_value_t = 0.1)]
    anchor_ratio: f64,
    /// In which space anchors are spread evenly. Far background Gaussians take most anchors of a scene that has them,
    /// unless the space is contracted
    #[arg(long, value_enum, default_value_t = Space::World)]
    sample_space: Space,
    /// Neighbours per anchor
    #[arg(long, value_name = "COUNT", default_value_t = 16)]
    k: usize,
    /// Spatial neighbours per Gaussian
    #[arg(long, value_name = "COUNT", default_value_t = 16)]
    gaussian_k: usize,
    /// A pixel counts where its accumulated alpha exceeds this
    #[arg(long, value_name = "ALPHA", default_value_t = 0.7)]
    gate: f32,
    /// Leave out smaller masks: pixels of a 986 x 728 image, scaled down for smaller id maps
    #[arg(long, value_name = "PIXELS", default_value_t = 50.0)]
    min_mask_pixels: f64,
    /// Drop footprint entries below this share of their mask; 0 keeps all. The largest change is reported
    #[arg(long, value_name = "SHARE", default_value_t = 0.0)]
    cut: f64,
    /// Keep so many random pixels of each mask too, for the losses of feat-train that look at single pixels
    #[arg(long, value_name = "COUNT", default_value_t = 0)]
    pixel_samples: usize,
    /// Keep Gaussians that no view sees
    #[arg(long)]
    no_skip: bool,
    /// The paper read literally: anchors sampled in the world among all Gaussians, seen or not
    #[arg(long, value_enum)]
    preset: Option<Preset>,
    #[command(flatten)]
    common: CommonArgs,
}

/// Which views' masks to use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Views {
    /// Training views.
    Train,
    /// Held-out views too.
    All,
}

/// Options that go together.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Preset {
    /// The paper read literally.
    Paper,
}

impl Args {
    fn keep_unseen(&self) -> bool {
        self.no_skip || self.preset == Some(Preset::Paper)
    }

    fn space(&self) -> Space {
        if self.preset == Some(Preset::Paper) { Space::World } else { self.sample_space }
    }

    fn options(&self) -> Result<Options> {
        let bad = |field: &str, found: String, expected: &str| {
            Err(Error::new("out of range").field(field).found(found).expected(expected))
        };
        if !(self.anchor_ratio > 0.0 && self.anchor_ratio <= 1.0) {
            return bad("--anchor-ratio", self.anchor_ratio.to_string(), "more than 0, at most 1");
        }
        for (field, k) in [("--k", self.k), ("--gaussian-k", self.gaussian_k)] {
            if !(1..=1024).contains(&k) {
                return bad(field, k.to_string(), "1 to 1024");
            }
        }
        if !(0.0..1.0).contains(&self.gate) {
            return bad("--gate", self.gate.to_string(), "at least 0, below 1");
        }
        if !(0.0..1e9).contains(&self.min_mask_pixels) {
            return bad("--min-mask-pixels", self.min_mask_pixels.to_string(), "0 or more");
        }
        if !(0.0..1.0).contains(&self.cut) {
            return bad("--cut", self.cut.to_string(), "at least 0, below 1");
        }
        if self.pixel_samples > 4096 {
            return bad("--pixel-samples", self.pixel_samples.to_string(), "0 to 4096");
        }
        Ok(Options {
            graph: GraphOptions {
                anchor_ratio: self.anchor_ratio,
                k: self.k,
                gaussian_k: self.gaussian_k,
                space: self.space(),
                seed: self.common.seed,
            },
            gate: self.gate,
            min_mask_pixels: self.min_mask_pixels,
            cut: self.cut,
            keep_unseen: self.keep_unseen(),
            pixel_samples: self.pixel_samples,
        })
    }

    fn parameters(&self) -> Value {
        json!({
            "views": if self.views == Views::All { "all" } else { "train" },
            "holdout": self.holdout,
            "anchor_ratio": self.anchor_ratio,
            "k": self.k,
            "gaussian_k": self.gaussian_k,
            "gate": self.gate,
            "min_mask_pixels": self.min_mask_pixels,
            "cut": self.cut,
            "pixel_samples": self.pixel_samples,
            "no_skip": self.keep_unseen(),
            "sample_space": if self.space() == Space::World { "world" } else { "contracted" },
            "seed": self.common.seed,
        })
    }
}

impl Program for Args {
    const NAME: &'static str = "graph-precompute";

    fn common(&self) -> &CommonArgs {
        &self.common
    }

    fn check(&self) -> Result<()> {
        self.options().map(drop)
    }

    fn run(self, stage: &Stage) -> Result<()> {
        let options = self.options()?;
        // The id maps' own size decides the resolution, so photographs count at full size.
        let load = LoadOptions { resolution: Resolution::Divisor(1.0), holdout: self.holdout };
        let dataset = dataset::load(&self.scene, &load)?;
        let masks = dataset.views.iter().map(|v| artifacts::maps_path(&self.masks, v.stem()));
        let mut claim = stage
            .outputs(&self.graph)
            .main(&self.footprints)
            .artifact(&self.graph, Graph::FORMAT)
            .artifact(&self.footprints, Footprints::FORMAT)
            .reads(dataset.files.iter().cloned().chain(masks).chain([self.geometry.clone()]))
            .claim()?;
        let watched = Watched::new([&self.geometry]).and(artifacts::watch_folder(&self.masks, "_s.npy")?);
        for warning in &dataset.warnings {
            stage.warn(warning);
        }
        let views: Vec<&View> =
            dataset.views.iter().filter(|v| self.views == Views::All || v.split == Split::Train).collect();
        let geometry = Geometry::read(&self.geometry)?;
        if geometry.gaussians.is_empty() {
            return Err(Error::new("no Gaussians").file(&self.geometry).hint("train the geometry first"));
        }
        let pixels = views.iter().map(|v| u64::from(v.camera.width) * u64::from(v.camera.height)).max().unwrap_or(0);
        // The first view's masks speak for all; a damaged file is an error later on.
        let first =
            views.iter().filter(|_| self.pixel_samples > 0).map(|v| artifacts::maps_path(&self.masks, v.stem()));
        let masks = first.filter_map(|p| artifacts::MaskMaps::read(p).ok()).next().map_or(0, |m| m.id_count());
        let samples = self.pixel_samples * masks;
        let needed = crate::memory::forecast(geometry.gaussians.len(), views.len(), pixels, samples);
        stage.forecast(needed, "give smaller id maps or fewer --pixel-samples")?;
        let inputs = BTreeMap::from([
            (role::GEOMETRY.to_string(), hash_file(&self.geometry)?),
            (role::DATASET.to_string(), dataset.hash()?),
            (role::MASKS.to_string(), artifacts::hash_folder(&self.masks, "_s.npy")?),
        ]);
        let mut entries = ScratchEntries::beside(&self.footprints)?;
        let (footprints, graph, summary) = precompute(&geometry, &views, &self.masks, &options, stage, &mut entries)
            .map_err(|e| match views.is_empty() {
                true => Error::new("all views are held out").file(&self.scene).hint("give --views all or --holdout 0"),
                false => e,
            })?;
        watched.check()?;
        let provenance = || stage.provenance("", 0, self.parameters(), inputs.clone());
        footprints.write_with(entries, &self.footprints, provenance())?;
        graph.write(&self.graph, provenance())?;
        stage.info(&format!(
            "{} anchors among {} Gaussians; {} masks in {} views, {} footprint entries",
            summary.anchors, summary.kept, summary.masks, summary.views, summary.entries
        ));
        let d = summary.anchor_distance;
        stage.info(&format!(
            "distance to the anchor: median {:.4}, 90% within {:.4}, 99% within {:.4}, largest {:.4}",
            d.median, d.p90, d.p99, d.largest
        ));
        let m = summary.middle;
        stage.info(&format!(
            "the half of the Gaussians nearest to the middle has {:.1}% of the anchors; distance median {:.4}, 99% within {:.4}",
            100.0 * m.share, m.distance.median, m.distance.p99
        ));
        if self.cut > 0.0 {
            stage.info(&format!(
                "the cut dropped at most {:.3e} of a mask: no centroid moves by more than that times the longest feature",
                summary.largest_cut
            ));
        }
        stage.record(&mut claim, self.parameters(), inputs, json!(summary))
    }
}
