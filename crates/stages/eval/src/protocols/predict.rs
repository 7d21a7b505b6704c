//! Masks of labelled categories: from the instances that their names select, or from files.

use super::pairs::Pair;
use crate::Mask;
use crate::query::ask::{Answered, Asker};
use crate::scene::LabelledScene;
use crate::score::labels::{self, FrameLabels};
use crate::silhouette::Rendering;
use gs_io::{Error, Result, write_bytes};
use gs_scene::dataset::Dataset;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// What is known of one text.
#[derive(Debug, Clone, PartialEq)]
pub enum Answer {
    /// It was asked.
    Selected {
        /// Selected instances, best first.
        instances: Vec<u32>,
        /// Score of the best.
        score: Option<f32>,
        /// Their Gaussians, ascending.
        gaussians: Vec<u32>,
    },
    /// It could not be asked, and why.
    Unasked(String),
}

/// The answers by category.
pub type Answers = BTreeMap<String, Answer>;

/// Asks for texts; a text that a table does not hold is unasked.
pub fn ask(asker: &Asker<'_>, texts: &[String]) -> Result<Answers> {
    let one = |(text, feature): (&String, Option<Vec<f32>>)| {
        let answer = feature.map_or_else(
            || Answer::Unasked("it has no text feature".into()),
            |f| {
                let Answered { selected, score, gaussians, .. } = asker.answer(&f);
                Answer::Selected { instances: selected, score, gaussians }
            },
        );
        (text.clone(), answer)
    };
    Ok(texts.iter().zip(asker.features(texts)?).map(one).collect())
}

/// The mask of each category of a frame, in the size of the labels; or why there is none.
pub type Predictions = BTreeMap<String, std::result::Result<Mask, String>>;

/// Renders the answers to every category of a labelled frame, in the size of the labelled image.
pub fn predict(
    scene: &LabelledScene,
    dataset: &Dataset,
    frame: &FrameLabels,
    answers: &Answers,
    rendering: Rendering,
    labels: &Path,
) -> Result<Predictions> {
    let categories = frame.categories.keys();
    let Some(view) = dataset.views.iter().find(|v| v.stem() == frame.frame) else {
        return Ok(categories.map(|c| (c.clone(), Err("the frame is no view of the scene".into()))).collect());
    };
    let camera = frame.camera(view, labels)?;
    let selected = |c: &String| match answers.get(c) {
        Some(Answer::Selected { gaussians, .. }) => Some(&gaussians[..]),
        _ => None,
    };
    let selections: Vec<&[u32]> = categories.clone().filter_map(selected).collect();
    // In the order of the categories that were asked for.
    let mut masks = rendering.masks(scene.gaussians(), &scene.raster, &selections, &camera).into_iter();
    let mut one = |category: &String| match answers.get(category) {
        Some(Answer::Selected { gaussians, .. }) => {
            masks.next().filter(|_| !gaussians.is_empty()).ok_or_else(|| "no Gaussian is selected".into())
        }
        Some(Answer::Unasked(why)) => Err(why.clone()),
        None => Err("the category was not asked for".into()),
    };
    Ok(categories.map(|c| (c.clone(), one(c))).collect())
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
