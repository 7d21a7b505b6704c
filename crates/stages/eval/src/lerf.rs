//! `eval lerf`: a scene of LERF-OVS, or any scene with such labels, by [`crate::protocol::lerf`].

use crate::ask::{Answered, Asker};
use crate::labels::{self, FrameLabels};
use crate::protocol::lerf::{self, Averaging, Figures, Pair, Predicted};
use crate::protocol::published;
use crate::scene::LabelledScene;
use crate::silhouette::{self, Silhouette};
use gs_io::{Error, Result, write_bytes};
use gs_scene::Camera;
use gs_scene::dataset::{Dataset, View};
use report::sheet::Sheet;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// How far width / height of a labelled image and of its photograph may differ, relatively.
const ASPECT_TOLERANCE: f64 = 0.02;

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
        /// Relevancy of every instance, 0 to 1, for localisation.
        relevancy: Vec<f32>,
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
                let relevancy = if localise { asker.relevancy(&f) } else { Vec::new() };
                let Answered { selected, score, gaussians, .. } = asker.answer(&f);
                Answer::Selected { instances: selected, score, gaussians, relevancy }
            },
        );
        (text.clone(), answer)
    };
    Ok(texts.iter().zip(asker.features(texts)?).map(one).collect())
}

/// How selections become masks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rendering {
    /// Rendered alone, or as far as visible.
    pub silhouette: Silhouette,
    /// The value above which a pixel belongs.
    pub threshold: f32,
}

/// Mask and, where wanted, relevancy map of one (frame, category).
pub struct Prediction {
    /// The category.
    pub category: String,
    /// Its mask.
    pub mask: Predicted,
    /// Relevancy of every pixel, `[height][width]`.
    pub relevancy: Option<Vec<f32>>,
}

/// The camera of a view in the size of its labelled image.
///
/// # Errors
/// When the labelled image has another shape than the photograph; `labels` names the folder.
pub fn labelled_camera(view: &View, frame: &FrameLabels, labels: &Path) -> Result<Camera> {
    let (w, h) = (frame.width, frame.height);
    let aspect = |w: u32, h: u32| f64::from(w) / f64::from(h);
    let ratio = aspect(w, h) / aspect(view.camera.width, view.camera.height);
    if (ratio - 1.0).abs() > ASPECT_TOLERANCE {
        return Err(Error::new("the labelled image has another shape than the photograph")
            .file(labels.join(format!("{}.json", frame.frame)))
            .field("info")
            .found(format!("{w}x{h}"))
            .expected(format!("{}x{} or a multiple", view.camera.width, view.camera.height))
            .hint("use the labels of this scene"));
    }
    Ok(view.camera.resized(w, h))
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
    localise: bool,
    labels: &Path,
) -> Result<Vec<Prediction>> {
    let nothing = |why: &str| Predicted::Nothing(why.into());
    let categories = || frame.categories.keys().cloned();
    let Some(view) = dataset.views.iter().find(|v| v.stem() == frame.frame) else {
        let mask = nothing("the frame is no view of the scene");
        return Ok(categories().map(|category| Prediction { category, mask: mask.clone(), relevancy: None }).collect());
    };
    let camera = labelled_camera(view, frame, labels)?;
    let asked: Vec<(String, &[u32], &[f32])> = categories()
        .filter_map(|c| match answers.get(&c) {
            Some(Answer::Selected { gaussians, relevancy, .. }) => Some((c, &gaussians[..], &relevancy[..])),
            _ => None,
        })
        .collect();
    let selections: Vec<&[u32]> = asked.iter().map(|a| a.1).collect();
    let masks = rendering.silhouette.masks(scene.gaussians(), &scene.raster, &selections, &camera, rendering.threshold);
    let maps: Vec<Option<Vec<f32>>> = if localise {
        let relevancies: Vec<&[f32]> = asked.iter().map(|a| a.2).collect();
        let maps =
            silhouette::relevancy_maps(scene.gaussians(), &scene.raster, &scene.instances.label, &relevancies, &camera);
        maps.into_iter().map(Some).collect()
    } else {
        vec![None; asked.len()]
    };
    let mut found: BTreeMap<String, Prediction> = asked
        .iter()
        .zip(masks.into_iter().zip(maps))
        .map(|((category, selection, _), (mask, relevancy))| {
            let mask = if selection.is_empty() { nothing("no Gaussian is selected") } else { Predicted::Pixels(mask) };
            (category.clone(), Prediction { category: category.clone(), mask, relevancy })
        })
        .collect();
    let unasked = |category: &String| match answers.get(category) {
        Some(Answer::Unasked(why)) => nothing(why),
        _ => nothing("the category was not asked for"),
    };
    let one = |category: String| {
        let mask = unasked(&category);
        found.remove(&category).unwrap_or(Prediction { category, mask, relevancy: None })
    };
    Ok(categories().map(one).collect())
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
            let mask = Predicted::Nothing("there is no picture of it".into());
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
        Ok(Prediction { category: category.clone(), mask: Predicted::Pixels(mask), relevancy: None })
    };
    frame.categories.keys().map(one).collect()
}

/// The name of a saved prediction. A category's slashes become hyphens: it is one file in one folder.
pub fn prediction_name(frame: &str, category: &str, extension: &str) -> String {
    format!("{}_{}.{extension}", frame, category.replace(['/', '\\'], "-"))
}

/// Writes what [`read_predictions`] reads, and relevancy maps as `<frame>_<category>.npy` beside them.
///
/// # Errors
/// When a file cannot be written.
pub fn save_predictions(folder: &Path, frame: &FrameLabels, predictions: &[Prediction]) -> Result<()> {
    for p in predictions {
        let path = |extension: &str| folder.join(prediction_name(&frame.frame, &p.category, extension));
        if let Predicted::Pixels(mask) = &p.mask {
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
            let localised = p.relevancy.as_ref().map(|map| lerf::localised(map, w, h, boxes));
            Pair::new(&frame.frame, &p.category, &frame.categories[&p.category], &p.mask, localised)
        })
        .collect()
}

/// `metrics.json` of `eval lerf`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LerfMetrics {
    /// `lerf-ovs`.
    pub protocol: String,
    /// Name of the scene.
    pub scene: String,
    /// The rule that the numbers follow, in words.
    pub rule: String,
    /// How pairs were averaged.
    pub averaging: Averaging,
    /// Files and models that the numbers come from.
    pub features: BTreeMap<String, String>,
    /// The scene's figures.
    pub figures: Figures,
    /// The figures of each category.
    pub objects: BTreeMap<String, ObjectFigures>,
    /// Every (frame, category).
    pub pairs: Vec<Pair>,
    /// What is odd: zeros with their reasons, files that were left out.
    pub notes: Vec<String>,
}

/// The figures of a category with the answer to it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ObjectFigures {
    /// The figures over its frames.
    #[serde(flatten)]
    pub figures: Figures,
    /// Selected instances, best first.
    pub instances: Vec<u32>,
    /// Score of the best.
    pub score: Option<f32>,
}

impl LerfMetrics {
    /// The protocol's name in the file.
    pub const PROTOCOL: &str = "lerf-ovs";

    /// Puts the figures of a scene together; `notes` gains a line for every reason of a zero.
    pub fn new(
        scene: String,
        rule: String,
        averaging: Averaging,
        features: BTreeMap<String, String>,
        pairs: Vec<Pair>,
        answers: &Answers,
        mut notes: Vec<String>,
    ) -> Self {
        let mut zeros = BTreeMap::<&str, Vec<String>>::new();
        for p in &pairs {
            if let Some(why) = &p.zero {
                zeros.entry(why).or_default().push(format!("{} in {}", p.category, p.frame));
            }
        }
        notes.extend(zeros.into_iter().map(|(why, of)| {
            let some = of.iter().take(3).cloned().collect::<Vec<_>>().join(", ");
            let more = if of.len() > 3 { ", …" } else { "" };
            format!("{} of {} pairs score 0 because {why}: {some}{more}", of.len(), pairs.len())
        }));
        if pairs.is_empty() {
            notes.push("no labelled object was scored: all figures are 0 for want of pairs".into());
        }
        let objects = lerf::object_figures(&pairs)
            .into_iter()
            .map(|(category, figures)| {
                let (instances, score) = match answers.get(&category) {
                    Some(Answer::Selected { instances, score, .. }) => (instances.clone(), *score),
                    _ => (Vec::new(), None),
                };
                (category, ObjectFigures { figures, instances, score })
            })
            .collect();
        let figures = lerf::scene_figures(&pairs, averaging);
        Self { protocol: Self::PROTOCOL.into(), scene, rule, averaging, features, figures, objects, pairs, notes }
    }

    /// Writes `metrics.json`, `table.md`, `objects.csv` and `pairs.csv` into a folder.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn write(&self, out: &Path) -> Result<PathBuf> {
        let (objects, pairs) = self.csv();
        write_bytes(out.join("objects.csv"), objects.as_bytes())?;
        write_bytes(out.join("pairs.csv"), pairs.as_bytes())?;
        write_bytes(out.join("table.md"), sheet(std::slice::from_ref(self)).markdown().as_bytes())?;
        let path = out.join("metrics.json");
        let json = serde_json::to_vec_pretty(self).map_err(|e| Error::new(e.to_string()).file(&path))?;
        write_bytes(&path, &json)?;
        Ok(path)
    }

    fn csv(&self) -> (String, String) {
        let mut objects = String::from("category,frames,miou,macc25,macc50,localisation,instances,score\n");
        for (category, o) in &self.objects {
            let ids: Vec<String> = o.instances.iter().map(u32::to_string).collect();
            let f = o.figures;
            objects += &format!(
                "{},{},{:.6},{:.6},{:.6},{},{},{}\n",
                crate::score::quoted(category),
                f.pairs,
                f.miou,
                f.macc25,
                f.macc50,
                f.localisation.map_or(String::new(), |l| format!("{l:.6}")),
                ids.join(" "),
                o.score.map_or(String::new(), |s| format!("{s:.6}")),
            );
        }
        let mut pairs = String::from("frame,category,iou,truth_pixels,predicted_pixels,localised,zero\n");
        for p in &self.pairs {
            pairs += &format!(
                "{},{},{:.6},{},{},{},{}\n",
                crate::score::quoted(&p.frame),
                crate::score::quoted(&p.category),
                p.iou,
                p.truth_pixels,
                p.predicted_pixels,
                p.localised.map_or(String::new(), |l| l.to_string()),
                p.zero.as_deref().map_or(String::new(), crate::score::quoted),
            );
        }
        (objects, pairs)
    }
}

/// The paper's table with the scenes given, and notes that name rule and feature files.
pub fn sheet(scenes: &[LerfMetrics]) -> Sheet {
    let figures: Vec<(String, Figures)> = scenes.iter().map(|s| (s.scene.clone(), s.figures)).collect();
    let mut notes =
        vec!["Published rows: percent, as printed in the source named; the authors' feature files.".to_string()];
    for s in scenes {
        let features: Vec<String> = s.features.iter().map(|(k, v)| format!("{k} {v}")).collect();
        notes.push(format!("{}: {}. From {}.", s.scene, s.rule, features.join("; ")));
        notes.extend(s.notes.iter().map(|n| format!("{}: {n}.", s.scene)));
    }
    published::lerf_sheet(&figures, notes)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Mask;

    #[test]
    fn zeros_are_counted_by_reason() {
        let mut truth = Mask::new(4, 1);
        truth.bits[0] = true;
        let pair = |c: &str, p: Predicted| Pair::new("frame_00001", c, &truth, &p, None);
        let why = || Predicted::Nothing("no Gaussian is selected".into());
        let pairs = vec![pair("a,\"b\"", Predicted::Pixels(truth.clone())), pair("c", why()), pair("d", why())];
        let answer = Answer::Selected { instances: vec![4, 2], score: Some(0.5), gaussians: vec![], relevancy: vec![] };
        let answers = Answers::from([("c".to_string(), answer)]);
        let m = LerfMetrics::new("s".into(), "r".into(), Averaging::Objects, BTreeMap::new(), pairs, &answers, vec![]);
        assert_eq!(
            m.notes,
            ["2 of 3 pairs score 0 because no Gaussian is selected: c in frame_00001, d in frame_00001"]
        );
        let (objects, csv) = m.csv();
        assert!(objects.contains("\"c\",1,0.000000,0.000000,0.000000,,4 2,0.500000"), "{objects}");
        assert!(csv.contains("\"frame_00001\",\"a,\"\"b\"\"\",1.000000,1,1,,\n"), "{csv}");
        let none =
            LerfMetrics::new("s".into(), "r".into(), Averaging::Objects, BTreeMap::new(), vec![], &answers, vec![]);
        assert!(none.notes[0].contains("no labelled object"));
    }
}
