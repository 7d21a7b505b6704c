//! `eval lerf`: a scene of LERF-OVS, or any scene with such labels.

use super::pairs::{Figures, Pair, object_figures};
use super::predict::{self, Answer, Answers};
use super::published;
use crate::memory::{self, SMALLER, Sizes};
use crate::options::{Inputs, LerfOptions, Truth};
use crate::query::ask::Asker;
use crate::query::text::TextSource;
use crate::scene::{LabelledScene, folder_name, load};
use crate::score::labels::{self, FrameLabels};
use crate::silhouette::Silhouette;
use artifacts::{LerfScene, role};
use gs_io::{Error, Outputs, Result, write_bytes, write_json};
use gs_scene::dataset::{Dataset, LoadOptions};
use report::sheet::Sheet;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use stage::Stage;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

pub(crate) fn run(o: &LerfOptions, parameters: Value, stage: &Stage) -> Result<String> {
    let scene = o.inputs.as_ref().map(|i| i.scene.as_path());
    let folder = labels_folder(o.labels.labels.as_deref(), scene)?;
    let name = o.name.clone().unwrap_or_else(|| folder_name(scene.unwrap_or(&folder)));
    let dataset = scene.map(|scene| load(scene, &LoadOptions::default(), stage)).transpose()?;
    let read = o.inputs.iter().zip(&dataset).flat_map(|(inputs, dataset)| inputs.files(dataset));
    let outputs = o.save_predictions.iter().fold(outputs(&o.out.out, stage), Outputs::folder);
    let mut claim = outputs.reads(read.chain(&o.texts.text_features).chain(&o.choice.features)).claim()?;
    let benchmark = LerfScene::named(&name);
    let (frames, mut notes) = labelled_frames(o.truth, &folder, benchmark)?;
    let labels = frames.iter().flat_map(|f| f.categories.values()).map(|m| m.bits.len() as u64).sum();
    let sizes = Sizes { labels, ..Sizes::default() };
    let mut features = BTreeMap::from([("labels".to_string(), folder_name(&folder))]);
    let asked = match o.inputs.as_ref().zip(dataset) {
        Some((inputs, dataset)) => {
            let sizes = Sizes { labels, ..Sizes::new(inputs, &o.texts, &dataset.views) };
            stage.forecast(memory::of_scores(&sizes), SMALLER)?;
            Some(ask(o, inputs, dataset, &frames, benchmark, &mut features, stage)?)
        }
        None => {
            stage.forecast(memory::of_scores(&sizes), "give fewer or smaller labels")?;
            features.extend(o.predictions.as_ref().map(|saved| ("masks".to_string(), folder_name(saved))));
            None
        }
    };
    if asked.as_ref().is_some_and(|a| a.scene.all_noise()) {
        notes.push("all Gaussians are noise: every query selects nothing".into());
    }
    let pairs = score(o, &frames, &folder, asked.as_ref(), stage)?;
    let answers = asked.as_ref().map_or_else(Answers::new, |a| a.answers.clone());
    let metrics = LerfMetrics::new(name, rule(o, benchmark.is_some()), features, pairs, &answers, notes);
    metrics.notes.iter().for_each(|n| stage.warn(n));
    metrics.write(&o.out.out)?;
    let zeros = metrics.pairs.iter().filter(|p| p.zero.is_some()).count();
    let inputs = asked.map_or_else(BTreeMap::new, |a| a.scene.inputs);
    stage.record(&mut claim, parameters, inputs, json!({"figures": metrics.figures, "zeros": zeros}))?;
    Ok(sheet(&[metrics]).markdown())
}

/// `metrics.json` of a protocol, whose record lies beside it, and `table.md` in the same folder.
pub(super) fn outputs(folder: &Path, stage: &Stage) -> Outputs {
    let metrics = folder.join("metrics.json");
    stage.outputs(&metrics).file(&metrics).file(folder.join("table.md"))
}

/// Where the labels of a scene lie.
fn labels_folder(given: Option<&Path>, scene: Option<&Path>) -> Result<PathBuf> {
    if let Some(given) = given {
        if given.is_dir() {
            return Ok(given.to_path_buf());
        }
        return Err(Error::new("no such folder").file(given).field("--labels").hint("check the path"));
    }
    let scene = scene.unwrap_or(Path::new("."));
    let inside = scene.join("label");
    let beside = scene.canonicalize().ok().and_then(|s| Some(s.parent()?.join("label").join(s.file_name()?)));
    [Some(inside.clone()), beside].into_iter().flatten().find(|f| f.is_dir()).ok_or_else(|| {
        Error::new("the scene has no labels").file(&inside).expected("a folder of <frame>.json").hint("give --labels")
    })
}

/// The labelled frames that are scored, and what is odd about them.
fn labelled_frames(
    truth: Truth,
    folder: &Path,
    benchmark: Option<&LerfScene>,
) -> Result<(Vec<FrameLabels>, Vec<String>)> {
    let mut frames = match truth {
        Truth::Polygons => labels::read_folder(folder)?,
        Truth::Pictures => labels::read_pictures(folder.join("gt"))?,
    };
    let mut notes = Vec::new();
    if let Some(b) = benchmark {
        let before = frames.len();
        frames.retain(|f| b.scores_frame(&f.frame));
        let left_out = before - frames.len();
        if left_out > 0 {
            notes.push(format!("{left_out} labelled frames are not in the benchmark and are not scored"));
        }
        let pairs: usize = frames.iter().map(|f| f.categories.len()).sum();
        if pairs != b.pairs {
            let published = b.pairs;
            notes.push(format!(
                "the labels hold {pairs} (frame, category) pairs where the published numbers have {published}"
            ));
        }
    }
    Ok((frames, notes))
}

/// A scene whose instances were asked for the categories of the labels.
struct AskedScene {
    dataset: Dataset,
    scene: LabelledScene,
    answers: Answers,
}

/// Asks for the benchmark's texts, or for the labels' categories. `features` gains what the answers come from.
fn ask(
    o: &LerfOptions,
    inputs: &Inputs,
    dataset: Dataset,
    frames: &[FrameLabels],
    benchmark: Option<&LerfScene>,
    features: &mut BTreeMap<String, String>,
    stage: &Stage,
) -> Result<AskedScene> {
    let scene = inputs.read(&dataset, stage)?;
    let source = TextSource::open_for(&scene, &o.texts)?;
    features.extend(sources(&scene, Some(&source))?);
    let asker = Asker::new(&scene, Some(source), &o.choice, o.texts.min_support)?;
    let categories: BTreeSet<&String> = frames.iter().flat_map(|f| f.categories.keys()).collect();
    let texts: Vec<String> = match benchmark {
        Some(b) => b.queries.iter().map(|q| (*q).to_string()).collect(),
        None => categories.iter().map(|c| (*c).clone()).collect(),
    };
    let mut answers = predict::ask(&asker, &texts)?;
    drop(asker);
    for category in categories.into_iter().filter(|c| !texts.contains(c)) {
        let why = "the category is not in the benchmark's table of queries";
        answers.insert(category.clone(), Answer::Unasked(why.into()));
    }
    Ok(AskedScene { dataset, scene, answers })
}

/// What the answers of a scene come from, with the first digits of the hashes.
pub(super) fn sources(scene: &LabelledScene, texts: Option<&TextSource>) -> Result<BTreeMap<String, String>> {
    let mut features = BTreeMap::from([("instances".to_string(), format!("{:.12}", scene.artifact.hash()))]);
    if let Some(source) = texts {
        features.insert("text features".into(), format!("{} ({:.12})", source.describe(), source.hash()?));
    }
    if let Some(masks) = scene.artifact.provenance().inputs.get(role::MASK_FEATURES) {
        features.insert("mask features".into(), format!("{masks:.12}"));
    }
    Ok(features)
}

/// Scores every (frame, category): masks of the scene that was asked, or saved ones.
fn score(
    o: &LerfOptions,
    frames: &[FrameLabels],
    folder: &Path,
    asked: Option<&AskedScene>,
    stage: &Stage,
) -> Result<Vec<Pair>> {
    let rendering = o.masking.rendering(Silhouette::Selected);
    let mut pairs = Vec::new();
    let mut progress = stage.progress("frames", frames.len() as u64);
    for frame in frames {
        let predictions = match (asked, &o.predictions) {
            (Some(a), _) => predict::predict(&a.scene, &a.dataset, frame, &a.answers, rendering, folder)?,
            (None, Some(saved)) => predict::read_predictions(saved, frame)?,
            (None, None) => predict::Predictions::new(),
        };
        if let Some(save) = &o.save_predictions {
            predict::save_predictions(save, frame, &predictions)?;
        }
        pairs.extend(predict::pairs(frame, &predictions));
        progress.step();
    }
    progress.finish(&[]);
    Ok(pairs)
}

/// The rule that the numbers follow, in words.
fn rule(o: &LerfOptions, benchmark: bool) -> String {
    let rendering = o.masking.rendering(Silhouette::Selected);
    let (masks, asked) = match (&o.predictions, benchmark) {
        (Some(_), _) => ("saved masks above grey level 10".to_string(), ""),
        (None, own) => (
            format!("{} rendering above {}", rendering.silhouette.name(), rendering.threshold),
            if own { "; the benchmark's queries" } else { "; the labels' categories as queries" },
        ),
    };
    let truth = match o.truth {
        Truth::Polygons => "polygons filled as cv2.fillPoly does, corners truncated",
        Truth::Pictures => "truth pictures above grey level 10",
    };
    let choice = o.choice.describe(o.texts.min_support);
    format!("{masks}; {truth}; mean over (frame, category) pairs, missing = 0{asked}{choice}")
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
    /// Files and models that the numbers come from.
    pub features: BTreeMap<String, String>,
    /// The scene's figures: the mean over pairs.
    pub figures: Figures,
    /// The mean over the categories of a frame, then over frames.
    pub frame_figures: Figures,
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
        let objects = object_figures(&pairs)
            .into_iter()
            .map(|(category, figures)| {
                let (instances, score) = match answers.get(&category) {
                    Some(Answer::Selected { instances, score, .. }) => (instances.clone(), *score),
                    _ => (Vec::new(), None),
                };
                (category, ObjectFigures { figures, instances, score })
            })
            .collect();
        let (figures, frame_figures) = (Figures::of_pairs(&pairs), Figures::of_frames(&pairs));
        let protocol = Self::PROTOCOL.into();
        Self { protocol, scene, rule, features, figures, frame_figures, objects, pairs, notes }
    }

    /// Writes `metrics.json` and `table.md` into a folder.
    pub fn write(&self, out: &Path) -> Result<()> {
        write_bytes(out.join("table.md"), sheet(std::slice::from_ref(self)).markdown().as_bytes())?;
        write_json(out.join("metrics.json"), self)
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
        let f = s.frame_figures;
        let [miou, macc25, macc50] = [f.miou, f.macc25, f.macc50].map(|v| 100.0 * v);
        notes.push(format!(
            "{}: mean over frames instead of pairs: mIoU {miou:.2}, mAcc@0.25 {macc25:.2}, mAcc@0.5 {macc50:.2}.",
            s.scene
        ));
        notes.extend(s.notes.iter().map(|n| format!("{}: {n}.", s.scene)));
    }
    published::lerf_sheet(&figures, notes)
}
