//! `eval score`: instances, or descriptors of Gaussians, and text queries against the truth of a scene.
//!
//! `truth` scores instances against true surfaces, `label_iou` against polygons (`labels`, filled as `polygon` says),
//! both by `metrics`; `scores` is what comes out.

mod label_iou;
pub mod labels;
pub mod metrics;
mod polygon;
mod scores;
mod truth;

use self::scores::{Counted, CountedScore, FinerScore};
pub use self::scores::{QueryScore, Scores, ThingScore};
pub use self::truth::{true_confidence, true_labels};

use self::label_iou::LabelScore;
use self::labels::FrameLabels;
use crate::memory::{self, SMALLER, Sizes};
use crate::options::{Rule, ScoreOptions};
use crate::protocols::pairs::{Figures, Pair, object_figures};
use crate::protocols::predict::{self, Answers};
use crate::query::ask::{Answered, Asker};
use crate::scene::load;
use crate::silhouette::{Rendering, Silhouette};
use artifacts::role;
use gs_io::{Result, Watched, hash_file, write_json};
use gs_scene::Geometry;
use gs_scene::dataset::{Dataset, LoadOptions};
use query::{Chosen, DescribedGaussians, LabelledScene, TextSource};
use serde_json::{Value, json};
use stage::Stage;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

pub(crate) fn run(o: &ScoreOptions, parameters: Value, stage: &Stage) -> Result<String> {
    let mut dataset = load(&o.scene, &LoadOptions::default(), stage)?;
    let labels = labels::folder(o.labels.labels.as_deref(), &dataset.root)?;
    let out = &o.out;
    let own = [&o.instances, &o.edits, &o.descriptors, &o.texts.text_features, &o.choice.features];
    let outputs = stage.outputs(out).file(out).reads(&dataset.files).reads([&o.geometry]);
    let mut claim = outputs.reads(own.into_iter().flatten()).claim()?;
    let sizes = Sizes {
        truth: memory::bytes(&dataset.root.join("truth/points.safetensors")),
        labels: labels.as_deref().map_or(0, labels::pixels),
        features: o.descriptors.as_deref().map_or(0, memory::bytes),
        ..Sizes::new(&o.geometry, &o.texts, &dataset.views)
    };
    stage.forecast(memory::of_scores(&sizes), SMALLER)?;
    let mut found = Found::read(o, &mut dataset, stage)?;
    let mut scores = Scores::default();
    match &found.instances {
        Some(scene) if scene.all_noise() => stage.warn("all Gaussians are noise: every score is 0"),
        Some(_) => {}
        None => scores.skipped.push("instance and label scores: no --instances were given".into()),
    }
    if let Some(scene) = &found.instances {
        truth::score_instances(scene, &dataset.root, &mut scores)?;
    }
    if let Some(labels) = &labels {
        let read = |folder: &Path| {
            let mut frames = labels::read_folder(folder)?;
            labels::straighten(&mut frames, &dataset.views);
            Ok(frames)
        };
        let frames = read(labels)?;
        if let Some(scene) = &found.instances {
            score_labels(scene, &dataset, labels, &frames, &mut scores)?;
        }
        if found.dim() == 0 {
            let why = "query scores: the instances have no language features, because the masks were not encoded with a \
                       CLIP model (mask-embed embed --clip)";
            scores.skipped.push(why.into());
        } else if !o.texts.given() {
            scores.skipped.push("query scores: neither --clip nor --text-features was given".into());
        } else {
            let of = |kind: &str| {
                let folder = labels.join(kind);
                if folder.is_dir() { read(&folder) } else { Ok(Vec::new()) }
            };
            let (absent, several) = (of("absent")?, of("several")?);
            found.judges = !absent.is_empty() || !several.is_empty();
            let one = score_queries(o, &found, &dataset, &frames, &mut scores, stage)?;
            let asked = |frames: &[FrameLabels]| ask(o, &found, &dataset, frames, stage);
            scores.parts = asked(&of("parts")?)?.map(|a| a.finer());
            scores.groups = asked(&of("groups")?)?.map(|a| a.finer());
            if found.judges {
                scores.counted = CountedScore::of([asked(&absent)?, one, asked(&several)?].map(|a| a?.counted()));
            }
        }
    } else {
        let place = dataset.root.join("label");
        scores.skipped.push(format!("label and query scores: the scene has no {}", place.display()));
    }
    scores.skipped.iter().for_each(|s| stage.skipped(s));
    write_json(out, &scores)?;
    let summary = json!({
        "instance_miou": scores.instance_miou, "label_miou": scores.label_miou, "query_miou": scores.query_miou,
        "query_pairs": scores.query_pairs,
    });
    stage.record(&mut claim, parameters, found.inputs, summary)?;
    Ok(scores.table())
}

/// What is scored: instances, Gaussians with descriptors of their own, or both; then these answer the texts.
struct Found {
    instances: Option<LabelledScene>,
    /// With the geometry that they belong to, where there are no instances.
    described: Option<(DescribedGaussians, Option<Geometry>)>,
    /// Content hashes, by role.
    inputs: BTreeMap<String, String>,
    /// Whether it is judged if a text matches anything.
    judges: bool,
}

impl Found {
    fn read(o: &ScoreOptions, dataset: &mut Dataset, stage: &Stage) -> Result<Self> {
        let instances = o.inputs().map(|inputs| inputs.read(dataset, stage)).transpose()?;
        let mut inputs = instances.as_ref().map_or_else(BTreeMap::new, |scene| scene.inputs.clone());
        let Some(path) = &o.descriptors else { return Ok(Self { instances, described: None, inputs, judges: false }) };
        let watched = Watched::new([&o.geometry]);
        let hash = hash_file(&o.geometry)?;
        let own = if instances.is_none() { Some(Geometry::read(&o.geometry)?) } else { None };
        watched.check()?;
        let geometry = own.as_ref().or(instances.as_ref().map(|scene| &scene.geometry)).expect("one of both was read");
        if let Some(damage) = own.as_ref().and_then(Geometry::damage) {
            stage.skipped(&damage);
        }
        dataset.follow(&geometry.gaussians, &o.geometry)?;
        let described = DescribedGaussians::read(path, &hash, geometry.gaussians.len())?;
        described.artifact.expect_input(role::DATASET, &dataset.hash()?)?;
        inputs.extend([(role::GEOMETRY.into(), hash), ("descriptors".into(), described.artifact.hash().into())]);
        Ok(Self { instances, described: Some((described, own)), inputs, judges: false })
    }

    fn geometry(&self) -> &Geometry {
        let own = self.described.as_ref().and_then(|d| d.1.as_ref());
        own.or(self.instances.as_ref().map(|scene| &scene.geometry)).expect("instances or descriptors were given")
    }

    /// Dimension of the descriptors that answer; 0 where there are none.
    fn dim(&self) -> usize {
        match (&self.described, &self.instances) {
            (Some((described, _)), _) => described.descriptors.dim(),
            (None, Some(scene)) => scene.instances.dim(),
            (None, None) => 0,
        }
    }

    /// The answers to texts: something is selected whether a text matches or not.
    fn answers(&self, o: &ScoreOptions, texts: &[String]) -> Result<Answers> {
        if let Some((described, _)) = &self.described {
            let source = TextSource::open_for(&described.artifact, self.dim(), &o.texts)?;
            let negatives = source.known(&[], &o.choice.negatives(), "--negatives")?;
            let features = source.encode_in(&o.choice.templates.all(), texts)?;
            let chosen = described.choose(&features, &negatives, o.share()).into_iter().zip(&features);
            let answer = |(Chosen { gaussians, score }, feature): (_, &Option<_>)| match feature {
                Some(_) => Ok(Answered { gaussians, score, ..Answered::default() }),
                None => Err("it has no text feature".into()),
            };
            return Ok(texts.iter().cloned().zip(chosen.map(answer)).collect());
        }
        let scene = self.instances.as_ref().expect("instances or descriptors were given");
        let source = TextSource::open_for(&scene.artifact, self.dim(), &o.texts)?;
        let mut asker = Asker::new(scene, Some(source), &o.choice, o.texts.min_support, o.granularity)?;
        if self.judges {
            asker.judge()?;
        }
        asker.always = true;
        predict::ask(&asker, texts)
    }
}

/// Scores the instances against the polygons of `folder`, without asking for anything: [`label_iou::score`].
fn score_labels(
    scene: &LabelledScene,
    dataset: &Dataset,
    folder: &Path,
    frames: &[FrameLabels],
    scores: &mut Scores,
) -> Result<()> {
    scores.labels = label_iou::score(scene, dataset, frames)?;
    let ious: Vec<f64> = scores.labels.iter().map(|l| l.iou).collect();
    if ious.is_empty() {
        scores.skipped.push(format!("label scores: {} labels no object of a view", folder.display()));
        return Ok(());
    }
    scores.label_miou = Some(metrics::mean(&ious));
    scores.label_macc25 = Some(metrics::fraction_above(&ious, 0.25));
    scores.label_macc50 = Some(metrics::fraction_above(&ious, 0.5));
    Ok(())
}

/// The IoU of every labelled category of every frame, by the rule that was asked for and where only what is visible counts.
struct Asked {
    answers: Answers,
    rendering: Rendering,
    pairs: Vec<Pair>,
    visible: Vec<Pair>,
}

impl Asked {
    /// The figures of names of parts or of groups.
    fn finer(&self) -> FinerScore {
        let Figures { miou, macc25, pairs, .. } = Figures::of_pairs(&self.pairs);
        let query_miou_visible = Figures::of_pairs(&self.visible).miou;
        FinerScore { query_miou: miou, query_macc25: macc25, query_miou_visible, query_pairs: pairs }
    }

    /// The figures where a text that matches nothing selects nothing (docs/protocols.md), of what a view shows; none where texts
    /// are not judged.
    fn counted(&self) -> Option<Counted> {
        let verdict = |text: &String| self.answers[text].as_ref().ok().and_then(|a| a.verdict);
        let texts: BTreeMap<&String, bool> =
            self.answers.keys().map(|text| (text, verdict(text).is_some_and(|v| v.matches))).collect();
        let giou = |p: &Pair| match (texts[&p.category], p.truth_pixels) {
            (matches, 0) => f64::from(u8::from(!matches)),
            (matches, _) => f64::from(u8::from(matches)) * p.iou,
        };
        let gious: Vec<f64> = self.visible.iter().map(giou).collect();
        let believed = texts.values().filter(|matches| **matches).count();
        let judged = self.answers.keys().any(|text| verdict(text).is_some());
        judged.then(|| Counted { texts: texts.len(), believed, pairs: gious.len(), giou: metrics::mean(&gious) })
    }
}

/// Scores text queries against the labels, by the protocol of [`crate::protocols::pairs`] with every category of the labels
/// asked for, and returns the answers.
fn score_queries(
    o: &ScoreOptions,
    found: &Found,
    dataset: &Dataset,
    frames: &[FrameLabels],
    scores: &mut Scores,
    stage: &Stage,
) -> Result<Option<Asked>> {
    let Some(asked) = ask(o, found, dataset, frames, stage)? else {
        scores.skipped.push("query scores: the labels hold no labelled object".into());
        return Ok(None);
    };
    let Asked { answers, rendering, pairs, visible } = &asked;
    let figures = Figures::of_pairs(pairs);
    (scores.query_miou, scores.query_pairs) = (Some(figures.miou), figures.pairs);
    (scores.query_macc25, scores.query_macc50) = (Some(figures.macc25), Some(figures.macc50));
    scores.query_miou_visible = Some(Figures::of_pairs(visible).miou);
    scores.silhouette = Some((rendering.silhouette, rendering.threshold));
    let query = |(text, figures): (String, Figures)| {
        let (selected, score) = predict::chosen(answers, &text);
        let mine = pairs.iter().filter(|p| p.category == text);
        let frames = mine.map(|p| (p.frame.clone(), p.iou)).collect();
        let rank = fitting(&scores.labels, &text).and_then(|instance| {
            let ranking = &answers.get(&text)?.as_ref().ok()?.ranking;
            Some(1 + ranking.iter().position(|r| r.instance as i32 == instance)?)
        });
        QueryScore { text, iou: figures.miou, selected, score, rank, frames }
    };
    scores.queries = object_figures(pairs).into_iter().map(query).collect();
    Ok(Some(asked))
}

/// The instance that fits a category best: by the sum of its IoUs over the frames where it is the best, of equals the first.
fn fitting(labels: &[LabelScore], category: &str) -> Option<i32> {
    let mut sums = BTreeMap::<i32, f64>::new();
    for label in labels.iter().filter(|l| l.category == category) {
        label.instance.into_iter().for_each(|i| *sums.entry(i).or_default() += label.iou);
    }
    sums.into_iter().max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0))).map(|best| best.0)
}

/// Asks every category of the labels and compares the answers; none where nothing is labelled.
fn ask(
    o: &ScoreOptions,
    found: &Found,
    dataset: &Dataset,
    frames: &[FrameLabels],
    stage: &Stage,
) -> Result<Option<Asked>> {
    let texts: BTreeSet<&String> = frames.iter().flat_map(|f| f.categories.keys()).collect();
    if texts.is_empty() {
        return Ok(None);
    }
    let answers = found.answers(o, &texts.into_iter().cloned().collect::<Vec<_>>())?;
    for (text, answer) in &answers {
        match answer {
            Err(_) => stage.warn(&format!("no text feature of the category {text:?}: it counts as IoU 0")),
            Ok(a) if a.gaussians.is_empty() => {
                stage.warn(&format!("nothing is selected for {text:?}: it counts as IoU 0"));
            }
            Ok(_) => {}
        }
    }
    let rendering = o.masking.rendering(Silhouette::Selected);
    let (mut pairs, mut visible) = (Vec::new(), Vec::new());
    for frame in frames {
        if !dataset.views.iter().any(|v| v.stem() == frame.frame) {
            let name = &frame.frame;
            stage.warn(&format!("the labelled frame {name} is no view of the scene: its objects count as IoU 0"));
        }
        for (rendering, all) in [(rendering, &mut pairs), (Rendering::SEEN, &mut visible)] {
            let predictions = predict::predict(found.geometry(), dataset, frame, &answers, rendering, Rule::Top1)?;
            all.extend(predict::pairs(frame, &predictions));
        }
    }
    Ok(Some(Asked { answers, rendering, pairs, visible }))
}
