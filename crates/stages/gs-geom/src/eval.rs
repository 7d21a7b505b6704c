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
        let (scene, held) = self.scene.for_geometry(&self.geometry)?;
        let mut dataset = scene.load(stage)?;
        held.differs(&dataset).iter().for_each(|what| stage.warn(what));
        let needed = memory::of_figures(bytes(&self.geometry.geometry)?, &Pictures::of(&dataset)?);
        stage.forecast(needed, "give a smaller --geometry or --resolution")?;
        let (gaussians, options) = self.geometry.read(self.scene.background, stage)?;
        dataset.follow(&gaussians, &self.geometry.geometry)?;
        let masks = self.masks.load(&dataset, stage)?;
        let alpha = masks.alpha();
        let reads = dataset.files.iter().cloned().chain(masks.files()).chain([self.geometry.geometry.clone()]);
        let mut claim = stage.outputs(&self.out).file(&self.out).reads(reads).claim()?;
        let mut views: Vec<&View> = dataset.views_of(Split::Test).collect();
        let mut split = if held.is_trusted(&dataset) { "test" } else { "unknown" };
        if views.is_empty() {
            stage.warn("no view is held out: measuring on the training views, which says little about other views");
            split = "train";
            views = dataset.views_of(Split::Train).collect();
        } else if split == "unknown" {
            stage.warn(
                "the Gaussians do not say which of these views training saw: the figures are not of held-out views, unless you know so \
                 and give --holdout",
            );
        }
        let mut progress = stage.progress("view", views.len() as u64);
        let (mut figures, mut room): (Vec<ViewMetrics>, _) = (Vec::new(), Derivatives::default());
        for view in &views {
            stage.go_on()?;
            let figure = measure(&gaussians, view, &options, alpha, &masks, &mut room)?;
            figures.push(ViewMetrics { split, ..figure });
            progress.step();
        }
        let Means { psnr, ssim, uncounted } = Means::of(figures.iter().map(|f| (f.name.as_str(), f.psnr.zip(f.ssim))));
        uncounted.iter().for_each(|why| stage.skipped(why));
        progress.finish(&[("psnr", psnr.unwrap_or(0.0)), ("ssim", ssim.unwrap_or(0.0))]);
        let of = |wanted: &str, v: Option<f64>| v.filter(|_| split == wanted);
        let metrics = json!({
            "split": split,
            "seen_by_training": held.seen(&dataset),
            "psnr": psnr,
            "ssim": ssim,
            "psnr_fitted": Means::of(figures.iter().map(|f| (f.name.as_str(), f.psnr_fitted.zip(f.ssim)))).psnr,
            "psnr_heldout": of("test", psnr),
            "ssim_heldout": of("test", ssim),
            "psnr_train": of("train", psnr),
            "ssim_train": of("train", ssim),
            "gaussians": gaussians.len(),
            "views": figures,
        });
        write_json(&self.out, &metrics)?;
        let mut parameters = json!(self);
        parameters["holdout"] = json!(held.every);
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
