//! Masks of labelled categories: from the instances that their names select, or from files.

use super::opengaussian;
use super::pairs::Pair;
use crate::Mask;
use crate::options::Rule;
use crate::query::ask::{Answered, Asker};
use crate::score::labels::{self, FrameLabels};
use crate::silhouette::Rendering;
use gs_io::{Error, Result, write_bytes};
use gs_raster::RasterOptions;
use gs_scene::Geometry;
use gs_scene::dataset::Dataset;
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The answer to each category; or why it could not be asked.
pub type Answers = BTreeMap<String, std::result::Result<Answered, String>>;

/// Asks for texts.
pub fn ask(asker: &Asker<'_>, texts: &[String]) -> Result<Answers> {
    let source = asker.source.as_ref().expect("a source of text features");
    Ok(answers(asker, texts, &source.encode_in(&asker.templates, texts)?))
}

/// Answers texts by their features.
pub fn answers(asker: &Asker<'_>, texts: &[String], features: &[Option<Vec<f32>>]) -> Answers {
    let answer = |f: &Option<Vec<f32>>| match f {
        Some(f) => Ok(asker.answer_text(f)),
        None => Err("it has no text feature".into()),
    };
    texts.iter().cloned().zip(features.iter().map(answer)).collect()
}

/// The instances that a category selects, best first, and the score of the best.
pub fn chosen(answers: &Answers, category: &str) -> (Vec<u32>, Option<f32>) {
    let answer = answers.get(category).and_then(|a| a.as_ref().ok());
    answer.map_or((Vec::new(), None), |a| (a.selected.clone(), a.score))
}

/// The mask of each category of a frame, in the size of the labels; or why there is none.
pub type Predictions = BTreeMap<String, std::result::Result<Mask, String>>;

/// Renders the answers to every category of a labelled frame, in the size of the labelled image: all Gaussians that they
/// select, or with [`Rule::OpenGaussian`] those that it leaves.
pub fn predict(
    geometry: &Geometry,
    dataset: &Dataset,
    frame: &FrameLabels,
    answers: &Answers,
    rendering: Rendering,
    rule: Rule,
) -> Result<Predictions> {
    let categories = frame.categories.keys().cloned();
    let Some(view) = dataset.views.iter().find(|v| v.stem() == frame.frame) else {
        return Ok(categories.map(|c| (c, Err("the frame is no view of the scene".into()))).collect());
    };
    let (g, raster, camera) = (&geometry.gaussians, RasterOptions::of(geometry), frame.camera(view)?);
    let in_view = (rule == Rule::OpenGaussian).then(|| {
        let mut in_view = vec![false; g.len()];
        gs_raster::drawn(g, &camera, &raster).into_iter().for_each(|i| in_view[i as usize] = true);
        in_view
    });
    let shown = |category: &String| -> std::result::Result<Cow<'_, [u32]>, String> {
        let selected = &answers[category].as_ref().map_err(Clone::clone)?.gaussians;
        match &in_view {
            _ if selected.is_empty() => Err("no Gaussian is selected".into()),
            None => Ok(selected.into()),
            Some(in_view) => opengaussian::shown(g, selected, in_view).map(Cow::Owned),
        }
    };
    let shown: Vec<_> = frame.categories.keys().map(shown).collect();
    let selections: Vec<&[u32]> = shown.iter().map(|s| s.as_ref().map_or(&[][..], |s| s)).collect();
    let masks = rendering.masks(g, &raster, &selections, &camera);
    Ok(categories.zip(shown.iter().zip(masks).map(|(s, mask)| s.clone().map(|_| mask))).collect())
}

/// Reads predictions that a program saved as pictures, `<folder>/<frame>_<category>.png`, pixels above grey level 10: the
/// layout of OpenGaussian's `renders_cluster_silhouette`. A missing file is a missing prediction.
pub fn read_predictions(folder: &Path, frame: &FrameLabels) -> Result<Predictions> {
    let one = |category: &String| {
        let path = picture(folder, frame, category);
        if !path.exists() {
            return Ok((category.clone(), Err("there is no picture of it".into())));
        }
        let mask = labels::read_mask(&path)?;
        if (mask.width, mask.height) != (frame.width as usize, frame.height as usize) {
            return Err(Error::new("the predicted mask has another size than the labels")
                .file(&path)
                .found(format!("{}x{}", mask.width, mask.height))
                .expected(format!("{}x{}", frame.width, frame.height))
                .hint("render it in the size of the labelled image"));
        }
        Ok((category.clone(), Ok(mask)))
    };
    frame.categories.keys().map(one).collect()
}

/// The file of a saved prediction. A category's slashes become hyphens: it is one file in one folder.
fn picture(folder: &Path, frame: &FrameLabels, category: &str) -> PathBuf {
    folder.join(format!("{}_{}.png", frame.frame, category.replace(['/', '\\'], "-")))
}

/// Writes what [`read_predictions`] reads.
pub fn save_predictions(folder: &Path, frame: &FrameLabels, predictions: &Predictions) -> Result<()> {
    for (category, mask) in predictions {
        if let Ok(mask) = mask {
            let png = report::picture::mask_png(mask.width, mask.height, &mask.bits)?;
            write_bytes(picture(folder, frame, category), &png)?;
        }
    }
    Ok(())
}

/// Scores the predictions of a frame.
pub fn pairs(frame: &FrameLabels, predictions: &Predictions) -> Vec<Pair> {
    let one = |(category, mask): (&String, &_)| Pair::new(&frame.frame, category, &frame.categories[category], mask);
    predictions.iter().map(one).collect()
}
