//! Masks of labelled categories: from the instances that their names select, or from files.

use super::pairs::{Pair, localised};
use crate::Mask;
use crate::query::ask::{Answered, Asker};
use crate::scene::LabelledScene;
use crate::score::labels::{self, FrameLabels};
use crate::silhouette::{Rendering, relevancy_maps};
use gs_io::{Error, Result, write_bytes};
use gs_scene::dataset::Dataset;
use std::collections::BTreeMap;
use std::path::Path;

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
        /// Relevancy of every instance, 0 to 1, where localisation is asked for.
        relevancy: Option<Vec<f32>>,
    },
    /// It could not be asked, and why.
    Unasked(String),
}

/// The answers by category.
pub type Answers = BTreeMap<String, Answer>;

/// Asks for texts; a text that a table does not hold is unasked. With `localise` relevancies are kept.
///
/// # Errors
/// When the text encoder fails.
pub fn ask(asker: &Asker<'_>, texts: &[String], localise: bool) -> Result<Answers> {
    let one = |(text, feature): (&String, Option<Vec<f32>>)| {
        let answer = feature.map_or_else(
            || Answer::Unasked("it has no text feature".into()),
            |f| {
                let relevancy = localise.then(|| asker.relevancy(&f));
                let Answered { selected, score, gaussians, .. } = asker.answer(&f);
                Answer::Selected { instances: selected, score, gaussians, relevancy }
            },
        );
        (text.clone(), answer)
    };
    Ok(texts.iter().zip(asker.features(texts)?).map(one).collect())
}

/// Mask and, where wanted, relevancy map of one (frame, category).
pub struct Prediction {
    /// The category.
    pub category: String,
    /// Its mask, in the size of the labels; or why there is none.
    pub mask: std::result::Result<Mask, String>,
    /// Relevancy of every pixel, `[height][width]`.
    pub relevancy: Option<Vec<f32>>,
}

/// Renders the answers to every category of a labelled frame, in the size of the labelled image.
///
/// # Errors
/// When the labelled image has another shape than the photograph; `labels` names the folder.
pub fn predict(
    scene: &LabelledScene,
    dataset: &Dataset,
    frame: &FrameLabels,
    answers: &Answers,
    rendering: Rendering,
    labels: &Path,
) -> Result<Vec<Prediction>> {
    let nothing = |category: &String, why: &str| Prediction {
        category: category.clone(),
        mask: Err(why.into()),
        relevancy: None,
    };
    let categories = frame.categories.keys();
    let Some(view) = dataset.views.iter().find(|v| v.stem() == frame.frame) else {
        return Ok(categories.map(|c| nothing(c, "the frame is no view of the scene")).collect());
    };
    let camera = frame.camera(view, labels)?;
    let selected = |c: &String| match answers.get(c) {
        Some(Answer::Selected { gaussians, relevancy, .. }) => Some((&gaussians[..], relevancy.as_deref())),
        _ => None,
    };
    let selections: Vec<&[u32]> = categories.clone().filter_map(selected).map(|s| s.0).collect();
    let relevancies: Vec<&[f32]> = categories.clone().filter_map(selected).filter_map(|s| s.1).collect();
    // In the order of the categories that were asked for.
    let mut masks = rendering.masks(scene.gaussians(), &scene.raster, &selections, &camera).into_iter();
    let label = &scene.instances.label;
    let mut maps = relevancy_maps(scene.gaussians(), &scene.raster, label, &relevancies, &camera).into_iter();
    let one = |category: &String| match answers.get(category) {
        Some(Answer::Selected { gaussians, relevancy, .. }) => {
            let mask = masks.next().filter(|_| !gaussians.is_empty());
            Prediction {
                category: category.clone(),
                mask: mask.ok_or_else(|| "no Gaussian is selected".into()),
                relevancy: relevancy.as_ref().and_then(|_| maps.next()),
            }
        }
        Some(Answer::Unasked(why)) => nothing(category, why),
        None => nothing(category, "the category was not asked for"),
    };
    Ok(categories.map(one).collect())
}

/// Reads predictions that a program saved as pictures, `<folder>/<frame>_<category>.png`, pixels above grey level 10: the
/// layout of OpenGaussian's `renders_cluster_silhouette`. A missing file is a missing prediction.
///
/// # Errors
/// When a picture cannot be read or has another size than the labels.
pub fn read_predictions(folder: &Path, frame: &FrameLabels) -> Result<Vec<Prediction>> {
    let one = |category: &String| {
        let path = folder.join(prediction_name(&frame.frame, category, "png"));
        if !path.exists() {
            let mask = Err("there is no picture of it".into());
            return Ok(Prediction { category: category.clone(), mask, relevancy: None });
        }
        let mask = labels::read_mask(&path)?;
        if (mask.width, mask.height) != (frame.width as usize, frame.height as usize) {
            return Err(Error::new("the predicted mask has another size than the labels")
                .file(&path)
                .found(format!("{}x{}", mask.width, mask.height))
                .expected(format!("{}x{}", frame.width, frame.height))
                .hint("render it in the size of the labelled image"));
        }
        Ok(Prediction { category: category.clone(), mask: Ok(mask), relevancy: None })
    };
    frame.categories.keys().map(one).collect()
}

/// The name of a saved prediction. A category's slashes become hyphens: it is one file in one folder.
fn prediction_name(frame: &str, category: &str, extension: &str) -> String {
    format!("{}_{}.{extension}", frame, category.replace(['/', '\\'], "-"))
}

/// Writes what [`read_predictions`] reads, and relevancy maps as `<frame>_<category>.npy` beside them.
///
/// # Errors
/// When a file cannot be written.
pub fn save_predictions(folder: &Path, frame: &FrameLabels, predictions: &[Prediction]) -> Result<()> {
    for p in predictions {
        let path = |extension: &str| folder.join(prediction_name(&frame.frame, &p.category, extension));
        if let Ok(mask) = &p.mask {
            write_bytes(path("png"), &report::picture::mask_png(mask.width, mask.height, &mask.bits)?)?;
        }
        if let Some(map) = &p.relevancy {
            gs_io::npy::write_f32(path("npy"), &[frame.height as usize, frame.width as usize], map)?;
        }
    }
    Ok(())
}

/// Scores the predictions of a frame.
pub fn pairs(frame: &FrameLabels, predictions: &[Prediction]) -> Vec<Pair> {
    predictions
        .iter()
        .map(|p| {
            let (w, h) = (frame.width as usize, frame.height as usize);
            let boxes = frame.boxes.get(&p.category).map_or(&[][..], |b| b);
            let localised = p.relevancy.as_ref().map(|map| localised(map, w, h, boxes));
            Pair::new(&frame.frame, &p.category, &frame.categories[&p.category], &p.mask, localised)
        })
        .collect()
}
