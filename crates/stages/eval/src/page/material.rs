//! What the sections of a report draw from.

use super::metrics::Metrics;
use crate::options::ReportOptions;
use crate::scene::views_to_show;
use crate::score::Scores;
use artifacts::{Instances, role};
use gs_io::{Artifact, Error, IoContext, Result, hash_file};
use gs_raster::RasterOptions;
use gs_scene::dataset::{Dataset, Split, View};
use gs_scene::{Geometry, HoldOut};
use query::LabelledScene;
use report::picture::Picture;
use stage::RunRecord;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Everything the sections draw from.
pub(super) struct Material<'a> {
    pub(super) options: &'a ReportOptions,
    pub(super) dataset: &'a Dataset,
    /// The views that training did not see, where that is known.
    pub(super) unseen: Option<BTreeSet<&'a str>>,
    /// Folder of id maps, if there is one.
    pub(super) masks: Option<PathBuf>,
    pub(super) geometry: Geometry,
    pub(super) raster: RasterOptions,
    /// The instances with their file, where the run has some.
    pub(super) found: Option<(Instances, Artifact)>,
    /// Content hashes, by role.
    pub(super) inputs: BTreeMap<String, String>,
    pub(super) scores: Option<Scores>,
    /// The views shown, with photograph and render.
    pub(super) shown: Vec<Shown<'a>>,
}

/// A view with what is shown of it.
pub(super) struct Shown<'a> {
    pub(super) view: &'a View,
    pub(super) photo: Picture,
    pub(super) render: Picture,
    pub(super) psnr: f64,
}

impl<'a> Material<'a> {
    pub(super) fn read(
        dataset: &'a mut Dataset,
        options: &'a ReportOptions,
        held: &HoldOut,
        masks: Option<PathBuf>,
        metrics: &mut Metrics,
    ) -> Result<Self> {
        let geometry = &options.geometry;
        let path = options.run_dir.join("instances.safetensors");
        let (geometry, found, inputs) = if path.exists() {
            let labelled = LabelledScene::read(&path, geometry, None)?;
            labelled.check_dataset(dataset)?;
            let LabelledScene { geometry, instances, artifact, inputs, .. } = labelled;
            (geometry, Some((instances, artifact)), inputs)
        } else {
            metrics.skipped.push("instances: the run has no instances.safetensors (cluster-match makes it)".into());
            let inputs = BTreeMap::from([(role::GEOMETRY.into(), hash_file(geometry)?)]);
            let read = Geometry::read(geometry)?;
            dataset.follow(&read.gaussians, geometry)?;
            (read, None, inputs)
        };
        let dataset: &'a Dataset = dataset;
        metrics.skipped.extend(geometry.damage());
        let raster = RasterOptions::of(&geometry);
        let path = options.run_dir.join("score.json");
        let scores = if is_of(&path, &inputs) { optional_json::<Scores>(&path)? } else { None };
        match &scores {
            Some(s) => metrics.skipped.extend(s.skipped.iter().cloned()),
            None if path.exists() => {
                metrics.skipped.push("scores: score.json is of other instances (run eval score)".into());
            }
            None => metrics.skipped.push("scores: the run has no score.json (eval score makes it)".into()),
        }
        let mut shown = Vec::new();
        for view in views_to_show(dataset, &options.views.views, |v| v.split == Split::Test)? {
            let photo = view.load_image()?;
            let photo = Picture::new(photo.width, photo.height, &photo.rgb);
            let rendered = gs_raster::render(&geometry.gaussians, &view.camera, &raster);
            let render = Picture::new(rendered.width, rendered.height, &rendered.rgb);
            let psnr = psnr(&photo, &render);
            shown.push(Shown { view, photo, render, psnr });
        }
        let unseen = held.unseen(dataset).map(|unseen| {
            let views = dataset.views.iter().zip(unseen);
            views.filter(|(_, unseen)| *unseen).map(|(v, _)| v.name.as_str()).collect()
        });
        Ok(Self { options, dataset, unseen, masks, geometry, raster, found, inputs, scores, shown })
    }

    pub(super) fn file(&self, name: &str) -> PathBuf {
        self.options.run_dir.join(name)
    }
}

fn psnr(a: &Picture, b: &Picture) -> f64 {
    let squares =
        a.pixels.iter().zip(&b.pixels).flat_map(|(x, y)| x.iter().zip(y)).map(|(x, y)| f64::from(x - y).powi(2));
    let mse = squares.sum::<f64>() / (3 * a.pixels.len()).max(1) as f64;
    -10.0 * mse.max(1e-20).log10()
}

/// Whether the record of an output of eval, if it has one, names the instances of this run, as they are without edits.
pub(super) fn is_of(output: &Path, inputs: &BTreeMap<String, String>) -> bool {
    let same = |record: RunRecord| ["instances", role::EDITS].iter().all(|&r| record.inputs.get(r) == inputs.get(r));
    RunRecord::read(output).map_or(true, same)
}

/// Reads a JSON file that need not exist.
pub(super) fn optional_json<T: serde::de::DeserializeOwned>(path: &Path) -> Result<Option<T>> {
    if !path.exists() {
        return Ok(None);
    }
    let bytes = std::fs::read(path).at("read", path)?;
    serde_json::from_slice(&bytes).map(Some).map_err(|e| {
        Error::new(format!("not the JSON expected: {e}")).file(path).hint("run the stage that makes it again")
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn psnr_of_a_known_error() {
        let a = Picture::new(2, 1, &[0.5; 6]);
        let b = Picture::new(2, 1, &[0.6; 6]);
        assert!((psnr(&a, &b) - 20.0).abs() < 1e-4);
        assert_eq!(psnr(&a, &a), 200.0);
    }
}
