//! `gs-geom eval`.

use crate::memory::{self, Pictures};
use crate::metrics::{Means, ViewMetrics, measure};
use crate::options::{Eval, bytes};
use crate::training::loss::Derivatives;
use artifacts::role;
use gs_io::{Result, hash_file, write_json};
use gs_scene::dataset::{Split, View};
use serde_json::json;
use stage::Stage;
use std::collections::BTreeMap;

impl Eval {
    pub(crate) fn run(&self, stage: &Stage) -> Result<()> {
        let dataset = self.scene.load(stage)?;
        let needed = memory::of_figures(bytes(&self.geometry.geometry)?, &Pictures::of(&dataset)?);
        stage.forecast(needed, "give a smaller --geometry or --resolution")?;
        let (gaussians, options) = self.geometry.read(self.scene.background, stage)?;
        let masks = self.masks.load(&dataset, stage)?;
        let alpha = masks.alpha();
        let reads = dataset.files.iter().cloned().chain(masks.files()).chain([self.geometry.geometry.clone()]);
        let mut claim = stage.outputs(&self.out).file(&self.out).reads(reads).claim()?;
        let mut split = Split::Test;
        let mut views: Vec<&View> = dataset.views_of(split).collect();
        if views.is_empty() {
            stage.warn("no view is held out: measuring on the training views, which says little about other views");
            split = Split::Train;
            views = dataset.views_of(split).collect();
        }
        let mut progress = stage.progress("view", views.len() as u64);
        let (mut figures, mut room): (Vec<ViewMetrics>, _) = (Vec::new(), Derivatives::default());
        for view in &views {
            stage.go_on()?;
            figures.push(measure(&gaussians, view, &options, alpha, &masks, &mut room)?);
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
        write_json(&self.out, &metrics)?;
        let mut parameters = json!(self);
        parameters["alpha"] = json!(alpha);
        parameters["antialias"] = json!(options.antialias);
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
