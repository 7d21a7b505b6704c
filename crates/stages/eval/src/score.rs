//! `eval score`: instances and text queries against the truth of a scene.

use crate::ask::Asker;
use crate::label_iou::{self, LabelScore};
use crate::labels;
use crate::lerf::{self, Answer, Rendering};
use crate::metrics::{self, InstanceScore};
use crate::protocol::instances::{MIN_POINTS, average_precision};
use crate::protocol::lerf::{Averaging, object_figures, scene_figures};
use crate::protocol::scannet;
use crate::scene::LabelledScene;
use crate::silhouette::Silhouette;
use artifacts::{TruePoints, TrueScene};
use gs_io::Result;
use gs_scene::dataset::Dataset;
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::path::Path;

/// Gaussians fainter than this do not speak for a surface (docs/protocols.md).
const MIN_OPACITY: f32 = 0.1;
/// True and predicted instances of fewer Gaussians take no part in average precision over Gaussians.
pub const MIN_GAUSSIANS: usize = 10;

/// `score.json`. Fields are null where the scene has no truth for them; `skipped` says why.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Scores {
    /// Mean over all true things of the best IoU with any instance.
    pub instance_miou: Option<f64>,
    /// The same over objects only, without floor, walls and other background.
    pub object_miou: Option<f64>,
    /// Fraction of true things with best IoU above 0.25.
    pub instance_macc25: Option<f64>,
    /// Fraction of true things with best IoU above 0.5.
    pub instance_macc50: Option<f64>,
    /// True things that fell into several instances.
    pub fragmented: Option<usize>,
    /// Instances that hold several true things.
    pub merging: Option<usize>,
    /// Fragmentation: instances per true thing (see [`InstanceScore`]).
    pub instances_per_thing: Option<f64>,
    /// Merging: true things per instance.
    pub things_per_instance: Option<f64>,
    /// Average precision at IoU 0.25 over surface points, by ScanNet's matching
    /// ([`average_precision`]), of instances of at least [`MIN_POINTS`] points.
    pub ap25: Option<f64>,
    /// The same at IoU 0.5.
    pub ap50: Option<f64>,
    /// The same scores over Gaussians instead of surface points.
    pub gaussians: Option<GaussianScores>,
    /// Each true thing.
    pub things: Vec<ThingScore>,
    /// Mean over all labelled objects of all labelled views of the best IoU with any instance's visible pixels.
    #[serde(default)]
    pub label_miou: Option<f64>,
    /// Fraction of them with best IoU above 0.25.
    #[serde(default)]
    pub label_macc25: Option<f64>,
    /// Fraction of them with best IoU above 0.5.
    #[serde(default)]
    pub label_macc50: Option<f64>,
    /// Each labelled object of each labelled view.
    #[serde(default)]
    pub labels: Vec<LabelScore>,
    /// Mean IoU over all (frame, category) pairs.
    pub query_miou: Option<f64>,
    /// Fraction of pairs with IoU above 0.25.
    pub query_macc25: Option<f64>,
    /// Fraction of pairs with IoU above 0.5.
    pub query_macc50: Option<f64>,
    /// Mean IoU over all pairs when only what the view shows of the selection counts (occlusion-aware, share above 0.5),
    /// whatever `silhouette` says. Labels outline what is seen, so hidden objects cost `query_miou` but not this.
    pub query_miou_visible: Option<f64>,
    /// Number of (frame, category) pairs.
    pub query_pairs: usize,
    /// Each query with its mean IoU.
    pub queries: Vec<QueryScore>,
    /// How selections became masks, `selected` or `visible`, and above which value.
    pub silhouette: Option<(String, f32)>,
    /// What was left out, and why.
    pub skipped: Vec<String>,
}

/// Scores over Gaussians of opacity at least 0.1, each belonging to the thing of the nearest surface point.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GaussianScores {
    /// Gaussians that count.
    pub count: usize,
    /// Mean over true things of the best IoU with any instance.
    pub instance_miou: f64,
    /// Average precision at IoU 0.25, of instances of at least [`MIN_GAUSSIANS`] Gaussians.
    pub ap25: Option<f64>,
    /// The same at IoU 0.5.
    pub ap50: Option<f64>,
}

/// How one true thing was found.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ThingScore {
    /// Id of the thing.
    pub id: i32,
    /// Its name, where the truth has one.
    pub name: String,
    /// Whether it is background.
    pub background: bool,
    /// Points of its surface.
    pub points: usize,
    /// Best IoU with any instance.
    pub iou: f64,
    /// The instance that gives it.
    pub instance: Option<i32>,
    /// Instances that hold at least a tenth of it.
    pub fragments: usize,
}

/// How one query was answered.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct QueryScore {
    /// The category of the labels, which is the text.
    pub text: String,
    /// Mean IoU over its frames.
    pub iou: f64,
    /// Selected instances, best first.
    pub selected: Vec<u32>,
    /// Cosine of the best.
    pub score: Option<f32>,
    /// Stem and IoU of each labelled frame.
    pub frames: Vec<(String, f64)>,
}

/// Scores the instances against `truth/points.safetensors` of the scene: each surface point takes the label of the
/// nearest labelled Gaussian of opacity at least 0.1; then per true thing the best IoU over instances. Without that
/// file, `scores.skipped` says so.
///
/// # Errors
/// When the truth is damaged.
pub fn score_instances(scene: &LabelledScene, root: &Path, scores: &mut Scores) -> Result<()> {
    let path = root.join("truth/points.safetensors");
    if !path.exists() {
        scores.skipped.push(format!("instance scores: the scene has no {}", path.display()));
        return Ok(());
    }
    let truth = TruePoints::read(&path)?;
    let names = root.join("truth/scene.json");
    let things = if names.exists() { TrueScene::read(&names)?.objects } else { Vec::new() };
    let predicted = nearest_labels(scene, &truth.position);
    let InstanceScore {
        miou,
        macc25,
        macc50,
        fragmented,
        merging,
        objects,
        instances_per_object,
        objects_per_instance,
        ..
    } = metrics::score_instances(&truth.instance, &predicted);
    if objects.is_empty() {
        scores.skipped.push(format!("instance scores: {} holds no point of a thing", path.display()));
        return Ok(());
    }
    scores.things = objects
        .iter()
        .map(|o| {
            let thing = usize::try_from(o.id).ok().and_then(|i| things.get(i));
            ThingScore {
                id: o.id,
                name: thing.map_or_else(|| format!("thing {}", o.id), |t| t.name.clone()),
                background: thing.is_some_and(|t| t.background),
                points: o.points,
                iou: o.iou,
                instance: o.best,
                fragments: o.fragments,
            }
        })
        .collect();
    let object_ious: Vec<f64> = scores.things.iter().filter(|t| !t.background).map(|t| t.iou).collect();
    scores.object_miou = (!object_ious.is_empty()).then(|| metrics::mean(&object_ious));
    (scores.instance_miou, scores.instance_macc25, scores.instance_macc50) = (Some(miou), Some(macc25), Some(macc50));
    (scores.fragmented, scores.merging) = (Some(fragmented), Some(merging));
    (scores.instances_per_thing, scores.things_per_instance) = (Some(instances_per_object), Some(objects_per_instance));
    let confidence = &scene.instances.score;
    let ap = |threshold| average_precision(&truth.instance, &predicted, confidence, MIN_POINTS, threshold);
    (scores.ap25, scores.ap50) = (ap(0.25), ap(0.5));
    scores.gaussians = Some(score_gaussians(scene, &truth));
    Ok(())
}

/// Scores the instances against the polygons of `folder`, without asking for anything: [`label_iou::score`].
///
/// # Errors
/// When labels are damaged.
pub fn score_labels(scene: &LabelledScene, dataset: &Dataset, folder: &Path, scores: &mut Scores) -> Result<()> {
    scores.labels = label_iou::score(scene, dataset, &labels::read_folder(folder)?, folder)?;
    let ious: Vec<f64> = scores.labels.iter().map(|l| l.iou).collect();
    if ious.is_empty() {
        scores.skipped.push(format!("label scores: {} labels no object of a view", folder.display()));
        return Ok(());
    }
    let above = |t: f64| Some(ious.iter().filter(|&&i| i > t).count() as f64 / ious.len() as f64);
    scores.label_miou = Some(metrics::mean(&ious));
    (scores.label_macc25, scores.label_macc50) = (above(0.25), above(0.5));
    Ok(())
}

/// Scores the labels of Gaussians themselves.
fn score_gaussians(scene: &LabelledScene, points: &TruePoints) -> GaussianScores {
    let (g, whole) = (scene.gaussians(), scene.geometry.whole());
    let counted: Vec<usize> = (0..g.len()).filter(|&i| whole[i] && g.opacity(i) >= MIN_OPACITY).collect();
    let means: Vec<[f32; 3]> = counted.iter().map(|&i| g.means[i]).collect();
    let truth: Vec<i32> = scannet::nearest_of(&points.position, &means)
        .into_iter()
        .map(|p| p.map_or(-1, |p| points.instance[p as usize]))
        .collect();
    let predicted: Vec<i32> = counted.iter().map(|&i| scene.instances.label[i]).collect();
    let confidence = &scene.instances.score;
    let ap = |threshold| average_precision(&truth, &predicted, confidence, MIN_GAUSSIANS, threshold);
    GaussianScores {
        count: counted.len(),
        instance_miou: metrics::score_instances(&truth, &predicted).miou,
        ap25: ap(0.25),
        ap50: ap(0.5),
    }
}

/// Label of the nearest labelled Gaussian of sufficient opacity for each point; -1 when there is none at all.
fn nearest_labels(scene: &LabelledScene, points: &[[f32; 3]]) -> Vec<i32> {
    let (g, label) = (scene.gaussians(), &scene.instances.label);
    let speaks = |&i: &u32| label[i as usize] >= 0 && g.opacity(i as usize) >= MIN_OPACITY;
    let speakers: Vec<u32> = (0..g.len() as u32).filter(speaks).collect();
    let nearest = scannet::nearest(g, &speakers, points);
    nearest.into_iter().map(|i| i.map_or(-1, |i| label[i as usize])).collect()
}

/// Scores text queries against `label/*.json` of the scene, by the protocol of [`crate::protocol::lerf`] with every
/// category of the labels asked for. `rendering` says how a selection becomes a mask.
///
/// # Errors
/// When labels are damaged or of another size, or the text encoder fails.
pub fn score_queries(
    scene: &LabelledScene,
    dataset: &Dataset,
    folder: &Path,
    asker: &Asker<'_>,
    rendering: Rendering,
    scores: &mut Scores,
    warn: &mut dyn FnMut(&str),
) -> Result<()> {
    let frames = labels::read_folder(folder)?;
    let texts: BTreeSet<String> = frames.iter().flat_map(|f| f.categories.keys().cloned()).collect();
    let texts: Vec<String> = texts.into_iter().collect();
    if texts.is_empty() {
        scores.skipped.push(format!("query scores: {} holds no labelled object", folder.display()));
        return Ok(());
    }
    let answers = lerf::ask(asker, &texts, false)?;
    for (text, _) in answers.iter().filter(|(_, a)| matches!(a, Answer::Unasked(_))) {
        warn(&format!("no text feature of the category {text:?}: it counts as IoU 0"));
    }
    let empty = |a: &Answer| matches!(a, Answer::Selected { gaussians, .. } if gaussians.is_empty());
    for (text, _) in answers.iter().filter(|(_, a)| empty(a)) {
        warn(&format!("nothing is selected for {text:?}: it counts as IoU 0"));
    }
    let seen = Rendering { silhouette: Silhouette::Visible, threshold: Silhouette::Visible.default_threshold() };
    let (mut pairs, mut visible) = (Vec::new(), Vec::new());
    for frame in &frames {
        if !dataset.views.iter().any(|v| v.stem() == frame.frame) {
            let name = &frame.frame;
            warn(&format!("the labelled frame {name} is no view of the scene: its objects count as IoU 0"));
        }
        for (rendering, all) in [(rendering, &mut pairs), (seen, &mut visible)] {
            let predictions = lerf::predict(scene, dataset, frame, &answers, rendering, false, folder)?;
            all.extend(lerf::pairs(frame, &predictions));
        }
    }
    let figures = scene_figures(&pairs, Averaging::Objects);
    (scores.query_miou, scores.query_pairs) = (Some(figures.miou), figures.pairs);
    (scores.query_macc25, scores.query_macc50) = (Some(figures.macc25), Some(figures.macc50));
    scores.query_miou_visible = Some(scene_figures(&visible, Averaging::Objects).miou);
    scores.silhouette = Some((rendering.silhouette.name().into(), rendering.threshold));
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

/// A text as a field of a CSV file.
pub(crate) fn quoted(s: &str) -> String {
    format!("\"{}\"", s.replace('"', "\"\""))
}

/// The scores of each thing and of each (frame, category) as CSV: two tables.
pub fn csv(scores: &Scores) -> (String, String) {
    let mut things = String::from("id,name,background,points,iou,instance,fragments\n");
    for t in &scores.things {
        let instance = t.instance.map_or(String::new(), |i| i.to_string());
        things += &format!(
            "{},{},{},{},{:.6},{instance},{}\n",
            t.id,
            quoted(&t.name),
            t.background,
            t.points,
            t.iou,
            t.fragments
        );
    }
    let mut queries = String::from("frame,category,iou\n");
    for q in &scores.queries {
        for (frame, iou) in &q.frames {
            queries += &format!("{},{},{iou:.6}\n", quoted(frame), quoted(&q.text));
        }
    }
    (things, queries)
}

/// The scores as a table for the terminal.
pub fn table(scores: &Scores) -> String {
    let mut s = String::new();
    let mut line = |name: &str, value: Option<String>| {
        if let Some(value) = value {
            s += &format!("{name:<16} {value}\n");
        }
    };
    let number = |v: Option<f64>| v.map(|v| format!("{v:.4}"));
    line("instance_miou", number(scores.instance_miou));
    line("object_miou", number(scores.object_miou));
    line("instance_macc25", number(scores.instance_macc25));
    line("instance_macc50", number(scores.instance_macc50));
    line("fragmented", scores.fragmented.map(|n| format!("{n} of {} things", scores.things.len())));
    line("merging", scores.merging.map(|n| format!("{n} instances")));
    line("label_miou", number(scores.label_miou));
    line("label_macc25", number(scores.label_macc25));
    line("label_macc50", number(scores.label_macc50));
    line("labels", scores.label_miou.map(|_| format!("{} objects in views", scores.labels.len())));
    line("instances/thing", number(scores.instances_per_thing));
    line("things/instance", number(scores.things_per_instance));
    line("ap25", number(scores.ap25));
    line("ap50", number(scores.ap50));
    line("per Gaussian", number(scores.gaussians.as_ref().map(|g| g.instance_miou)));
    line("  ap25", number(scores.gaussians.as_ref().and_then(|g| g.ap25)));
    line("  ap50", number(scores.gaussians.as_ref().and_then(|g| g.ap50)));
    line("query_miou", number(scores.query_miou));
    line("  visible only", number(scores.query_miou_visible));
    line("query_macc25", number(scores.query_macc25));
    line("query_macc50", number(scores.query_macc50));
    line("queries", scores.query_miou.map(|_| format!("{} in {} pairs", scores.queries.len(), scores.query_pairs)));
    for reason in &scores.skipped {
        s += &format!("skipped          {reason}\n");
    }
    s
}
