//! `eval score`: instances and text queries against the truth of a scene.
//!
//! `truth` scores instances against true surfaces, `label_iou` against polygons (`labels`, filled as `polygon` says),
//! both by `metrics`; `scores` is what comes out.

mod label_iou;
pub mod labels;
pub mod metrics;
mod polygon;
mod scores;
mod truth;

pub use self::scores::{QueryScore, Scores, ThingScore};
pub use self::truth::{true_confidence, true_labels};

use self::labels::FrameLabels;
use crate::memory::{self, SMALLER, Sizes};
use crate::options::{Rule, ScoreOptions};
use crate::protocols::pairs::{Figures, object_figures};
use crate::protocols::predict;
use crate::query::ask::Asker;
use crate::scene::load;
use crate::silhouette::{Rendering, Silhouette};
use gs_io::{Result, write_json};
use gs_scene::dataset::{Dataset, LoadOptions};
use query::{LabelledScene, TextSource};
use serde_json::{Value, json};
use stage::Stage;
use std::collections::BTreeSet;
use std::path::Path;

pub(crate) fn run(o: &ScoreOptions, parameters: Value, stage: &Stage) -> Result<String> {
    let dataset = load(&o.inputs.scene, &LoadOptions::default(), stage)?;
    let labels = labels::folder(o.labels.labels.as_deref(), &dataset.root)?;
    let out = &o.out;
    let tables = o.texts.text_features.iter().chain(&o.choice.features);
    let mut claim = stage.outputs(out).file(out).reads(o.inputs.files(&dataset).chain(tables)).claim()?;
    let sizes = Sizes {
        truth: memory::bytes(&dataset.root.join("truth/points.safetensors")),
        labels: labels.as_deref().map_or(0, labels::pixels),
        ..Sizes::new(&o.inputs, &o.texts, &dataset.views)
    };
    stage.forecast(memory::of_scores(&sizes), SMALLER)?;
    let scene = o.inputs.read(&dataset, stage)?;
    if scene.all_noise() {
        stage.warn("all Gaussians are noise: every score is 0");
    }
    let mut scores = Scores::default();
    truth::score_instances(&scene, &dataset.root, &mut scores)?;
    if let Some(labels) = &labels {
        let frames = labels::read_folder(labels)?;
        score_labels(&scene, &dataset, labels, &frames, &mut scores)?;
        if scene.instances.dim == 0 {
            let why = "query scores: the instances have no language features, because the masks were not encoded with a \
                       CLIP model (mask-embed embed --clip)";
            scores.skipped.push(why.into());
        } else if !o.texts.given() {
            scores.skipped.push("query scores: neither --clip nor --text-features was given".into());
        } else {
            let source = TextSource::open_for(&scene, &o.texts)?;
            let asker = Asker::new(&scene, Some(source), &o.choice, o.texts.min_support)?;
            score_queries(o, &scene, &dataset, &frames, &asker, &mut scores, stage)?;
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
    stage.record(&mut claim, parameters, scene.inputs.clone(), summary)?;
    Ok(scores.table())
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

/// Scores text queries against the labels, by the protocol of [`crate::protocols::pairs`] with every category of the labels
/// asked for.
fn score_queries(
    o: &ScoreOptions,
    scene: &LabelledScene,
    dataset: &Dataset,
    frames: &[FrameLabels],
    asker: &Asker<'_>,
    scores: &mut Scores,
    stage: &Stage,
) -> Result<()> {
    let texts: BTreeSet<&String> = frames.iter().flat_map(|f| f.categories.keys()).collect();
    if texts.is_empty() {
        scores.skipped.push("query scores: the labels hold no labelled object".into());
        return Ok(());
    }
    let answers = predict::ask(asker, &texts.into_iter().cloned().collect::<Vec<_>>())?;
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
            let predictions = predict::predict(scene, dataset, frame, &answers, rendering, Rule::Top1)?;
            all.extend(predict::pairs(frame, &predictions));
        }
    }
    let figures = Figures::of_pairs(&pairs);
    (scores.query_miou, scores.query_pairs) = (Some(figures.miou), figures.pairs);
    (scores.query_macc25, scores.query_macc50) = (Some(figures.macc25), Some(figures.macc50));
    scores.query_miou_visible = Some(Figures::of_pairs(&visible).miou);
    scores.silhouette = Some((rendering.silhouette, rendering.threshold));
    let query = |(text, figures): (String, Figures)| {
        let (selected, score) = predict::chosen(&answers, &text);
        let mine = pairs.iter().filter(|p| p.category == text);
        let frames = mine.map(|p| (p.frame.clone(), p.iou)).collect();
        QueryScore { text, iou: figures.miou, selected, score, frames }
    };
    scores.queries = object_figures(&pairs).into_iter().map(query).collect();
    Ok(())
}
