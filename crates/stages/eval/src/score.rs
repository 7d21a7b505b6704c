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

use self::labels::FrameLabels;
use crate::memory::{self, SMALLER, Sizes};
use crate::options::ScoreOptions;
use crate::protocols::pairs::{Figures, object_figures};
use crate::protocols::predict::{self, Answer};
use crate::query::ask::Asker;
use crate::query::text::TextSource;
use crate::scene::{LabelledScene, load};
use crate::silhouette::{Rendering, Silhouette};
use gs_io::{Error, Result, write_json};
use gs_scene::dataset::{Dataset, LoadOptions};
use serde_json::{Value, json};
use stage::Stage;
use std::collections::BTreeSet;
use std::path::Path;

pub(crate) fn run(o: &ScoreOptions, parameters: Value, stage: &Stage) -> Result<String> {
    let dataset = load(&o.inputs.scene, &LoadOptions::default(), stage)?;
    let labels = o.labels.labels.clone().unwrap_or_else(|| dataset.root.join("label"));
    let out = &o.out.out;
    let tables = o.texts.text_features.iter().chain(&o.choice.features);
    let mut claim = stage.outputs(out).file(out).reads(o.inputs.files(&dataset).chain(tables)).claim()?;
    let sizes = Sizes {
        truth: memory::bytes(&dataset.root.join("truth/points.safetensors")),
        labels: labels::pixels(&labels),
        ..Sizes::new(&o.inputs, &o.texts, &dataset.views)
    };
    stage.forecast(memory::of_scores(&sizes), SMALLER)?;
    let scene = o.inputs.read(&dataset, stage)?;
    if scene.all_noise() {
        stage.warn("all Gaussians are noise: every score is 0");
    }
    let mut scores = Scores::default();
    truth::score_instances(&scene, &dataset.root, &mut scores)?;
    if labels.is_dir() {
        let frames = labels::read_folder(&labels)?;
        score_labels(&scene, &dataset, &labels, &frames, &mut scores)?;
        if scene.instances.dim == 0 {
            let why = "query scores: the instances have no language features, because the masks were not encoded with a \
                       CLIP model (mask-embed embed --clip)";
            scores.skipped.push(why.into());
        } else if !o.texts.given() {
            scores.skipped.push("query scores: neither --clip nor --text-features was given".into());
        } else {
            let source = TextSource::open_for(&scene, &o.texts)?;
            let asker = Asker::new(&scene, Some(source), &o.choice, o.texts.min_support)?;
            let rendering = o.masking.rendering(Silhouette::Selected);
            score_queries(&scene, &dataset, &labels, &frames, &asker, rendering, &mut scores, stage)?;
        }
    } else if o.labels.labels.is_some() {
        return Err(Error::new("no such folder").file(&labels).field("--labels").hint("check the path"));
    } else {
        scores.skipped.push(format!("label and query scores: the scene has no {}", labels.display()));
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
    scores.labels = label_iou::score(scene, dataset, frames, folder)?;
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

/// Scores text queries against `label/*.json` of the scene, by the protocol of [`crate::protocols::pairs`] with every
/// category of the labels asked for. `rendering` says how a selection becomes a mask.
fn score_queries(
    scene: &LabelledScene,
    dataset: &Dataset,
    folder: &Path,
    frames: &[FrameLabels],
    asker: &Asker<'_>,
    rendering: Rendering,
    scores: &mut Scores,
    stage: &Stage,
) -> Result<()> {
    let texts: BTreeSet<String> = frames.iter().flat_map(|f| f.categories.keys().cloned()).collect();
    let texts: Vec<String> = texts.into_iter().collect();
    if texts.is_empty() {
        scores.skipped.push(format!("query scores: {} holds no labelled object", folder.display()));
        return Ok(());
    }
    let answers = predict::ask(asker, &texts)?;
    for (text, _) in answers.iter().filter(|(_, a)| matches!(a, Answer::Unasked(_))) {
        stage.warn(&format!("no text feature of the category {text:?}: it counts as IoU 0"));
    }
    let empty = |a: &Answer| matches!(a, Answer::Selected { gaussians, .. } if gaussians.is_empty());
    for (text, _) in answers.iter().filter(|(_, a)| empty(a)) {
        stage.warn(&format!("nothing is selected for {text:?}: it counts as IoU 0"));
    }
    let seen = Rendering { silhouette: Silhouette::Visible, threshold: Silhouette::Visible.default_threshold() };
    let (mut pairs, mut visible) = (Vec::new(), Vec::new());
    for frame in frames {
        if !dataset.views.iter().any(|v| v.stem() == frame.frame) {
            let name = &frame.frame;
            stage.warn(&format!("the labelled frame {name} is no view of the scene: its objects count as IoU 0"));
        }
        for (rendering, all) in [(rendering, &mut pairs), (seen, &mut visible)] {
            let predictions = predict::predict(scene, dataset, frame, &answers, rendering, folder)?;
            all.extend(predict::pairs(frame, &predictions));
        }
    }
    let figures = Figures::of_pairs(&pairs);
    (scores.query_miou, scores.query_pairs) = (Some(figures.miou), figures.pairs);
    (scores.query_macc25, scores.query_macc50) = (Some(figures.macc25), Some(figures.macc50));
    scores.query_miou_visible = Some(Figures::of_pairs(&visible).miou);
    scores.silhouette = Some((rendering.silhouette, rendering.threshold));
    scores.queries = object_figures(&pairs)
        .into_iter()
        .map(|(text, figures)| {
            let (selected, score) = match answers.get(&text) {
                Some(Answer::Selected { instances, score, .. }) => (instances.clone(), *score),
                _ => (Vec::new(), None),
            };
            let mine = pairs.iter().filter(|p| p.category == text);
            QueryScore {
                frames: mine.map(|p| (p.frame.clone(), p.iou)).collect(),
                iou: figures.miou,
                selected,
                score,
                text,
            }
        })
        .collect();
    Ok(())
}
