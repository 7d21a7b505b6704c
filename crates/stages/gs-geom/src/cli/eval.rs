//! `gs-geom eval`.

use super::{GeometryArgs, MaskArgs, SceneArgs, bytes, largest_file, most_pixels};
use crate::memory;
use crate::metrics::{Means, ViewMetrics, measure};
use artifacts::role;
use gs_io::{Error, Result, hash_file, write_bytes};
use gs_scene::dataset::{Split, View};
use serde_json::json;
use stage::Stage;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Arguments of `gs-geom eval`.
#[derive(Debug, clap::Args)]
pub(super) struct EvalArgs {
    #[command(flatten)]
    scene: SceneArgs,
    #[command(flatten)]
    masks: MaskArgs,
    #[command(flatten)]
    geometry: GeometryArgs,
    /// Where to write the figures, as JSON
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

impl EvalArgs {
    pub(super) fn run(&self, stage: &Stage) -> Result<()> {
        let dataset = self.scene.load(stage)?;
        let (width, size) = (dataset.views.iter().map(|v| u64::from(v.camera.width)).max(), largest_file(&dataset)?);
        let geometry = bytes(&self.geometry.geometry)?;
        let needed = memory::of_figures(geometry, most_pixels(&dataset), width.unwrap_or(0), size);
        stage.forecast(needed, "give a smaller --geometry or --resolution")?;
        let (gaussians, options) = self.geometry.read(self.scene.background, stage)?;
        let (alpha, masks) = (self.masks.alpha(), self.masks.load(&dataset, stage)?);
        let reads = dataset.files.iter().cloned().chain(masks.files()).chain([self.geometry.geometry.clone()]);
        let mut claim = stage.outputs(&self.out).file(&self.out).reads(reads).claim()?;
        let mut split = Split::Test;
        let mut views: Vec<&View> = dataset.views_of(split).collect();
        if views.is_empty() {
            stage.warn("no view is held out: measuring on the training views, which says little of other views");
            split = Split::Train;
            views = dataset.views_of(split).collect();
        }
        let mut progress = stage.progress("view", views.len() as u64);
        let mut figures: Vec<ViewMetrics> = Vec::new();
        for view in &views {
            if stage.interrupted() {
                return Err(Error::new("interrupted"));
            }
            figures.push(measure(&gaussians, view, &options, alpha, &masks)?);
            progress.step();
        }
        let Means { psnr, ssim, uncounted } = Means::of(figures.iter().map(|f| (f.name.as_str(), f.psnr.zip(f.ssim))));
        uncounted.iter().for_each(|why| stage.skipped(why));
        progress.finish(&[("psnr", psnr.unwrap_or(0.0)), ("ssim", ssim.unwrap_or(0.0))]);
        let heldout = split == Split::Test;
        let if_heldout = |v: Option<f64>| v.filter(|_| heldout);
        let metrics = json!({
            "split": if heldout { "test" } else { "train" },
            "psnr_heldout": if_heldout(psnr),
            "ssim_heldout": if_heldout(ssim),
            "psnr_train": psnr.filter(|_| !heldout),
            "ssim_train": ssim.filter(|_| !heldout),
            "gaussians": gaussians.len(),
            "views": figures,
        });
        let text = serde_json::to_vec_pretty(&metrics).map_err(|e| Error::new(e.to_string()).file(&self.out))?;
        write_bytes(&self.out, &text)?;
        let parameters = json!({
            "resolution": self.scene.resolution.to_string(),
            "holdout": self.scene.holdout,
            "background": self.scene.background.color(),
            "alpha": alpha,
            "antialias": options.antialias,
        });
        let mut inputs = BTreeMap::from([
            (role::DATASET.to_string(), dataset.hash()?),
            (role::GEOMETRY.to_string(), hash_file(&self.geometry.geometry)?),
        ]);
        if let Some(hash) = masks.hash()? {
            inputs.insert("photograph_masks".into(), hash);
        }
        let summary = json!({
            "split": metrics["split"],
            "psnr": psnr,
            "ssim": ssim,
            "views": figures.len(),
            "gaussians": gaussians.len(),
        });
        stage.record(&mut claim, parameters, inputs, summary)
    }
}
