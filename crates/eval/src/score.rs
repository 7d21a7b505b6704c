//! `eval score`: instances and text queries against the truth of a scene.

use crate::Mask;
use crate::labels::{self, FrameLabels};
use crate::metrics::{self, InstanceScore};
use crate::ranking::{self, Selection};
use crate::scene::LabelledScene;
use crate::silhouette::Silhouette;
use crate::text::TextSource;
use artifacts::{TruePoints, TrueScene};
use gs_io::{Error, Result};
use gs_scene::dataset::Dataset;
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Gaussians fainter than this do not speak for a surface (methods.md 4.2).
const MIN_OPACITY: f32 = 0.1;
/// How far width / height of a labelled image and of its photograph may differ, relatively.
const ASPECT_TOLERANCE: f64 = 0.02;

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
    /// Each true thing.
    pub things: Vec<ThingScore>,
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
    let InstanceScore { miou, macc25, macc50, fragmented, merging, objects, .. } =
        metrics::score_instances(&truth.instance, &predicted);
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
    Ok(())
}

/// Label of the nearest labelled Gaussian of sufficient opacity for each point; -1 when there is none at all.
fn nearest_labels(scene: &LabelledScene, points: &[[f32; 3]]) -> Vec<i32> {
    let (g, label) = (&scene.gaussians, &scene.instances.label);
    let speakers: Vec<usize> = (0..g.len()).filter(|&i| label[i] >= 0 && g.opacity(i) >= MIN_OPACITY).collect();
    let positions: Vec<[f32; 3]> = speakers.iter().map(|&i| g.means[i]).collect();
    let Some(tree) =
        (!positions.is_empty()).then(|| ImmutableKdTree::<f32, 3>::new_from_slice(&positions).ok()).flatten()
    else {
        return vec![-1; points.len()];
    };
    let nearest = |p: &[f32; 3]| {
        let found = tree.query(p).nearest_one::<SquaredEuclidean<f32>>().execute();
        label[speakers[found.item as usize]]
    };
    points.par_iter().map(nearest).collect()
}

/// Scores text queries against `label/*.json` of the scene, by the protocol of methods.md 4.1: one IoU per (frame,
/// category), zero where a prediction is missing; the mean over all of them. `silhouette` and `threshold` say how a
/// selection becomes a mask. Masks are rendered in the size of the labelled image.
///
/// # Errors
/// When labels are damaged or of another size, or text features do not fit the instances.
pub fn score_queries(
    scene: &LabelledScene,
    dataset: &Dataset,
    folder: &Path,
    source: &TextSource,
    selection: &Selection,
    silhouette: Silhouette,
    threshold: f32,
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
    source.check_dim(scene.instances.dim, scene.path())?;
    let mut answers = BTreeMap::new();
    for (text, feature) in texts.iter().zip(source.encode(&texts)?) {
        let Some(feature) = feature else {
            warn(&format!("no text feature of the category {text:?}: it counts as IoU 0"));
            continue;
        };
        let ranking = ranking::rank(&scene.instances, &feature);
        let selected = selection.choose(&ranking);
        let score = ranking.iter().find(|r| selected.first() == Some(&r.instance)).map(|r| r.score);
        let members = ranking::members(&scene.instances, &selected);
        answers.insert(text.as_str(), (members, selected, score));
    }
    let mut frame_ious: BTreeMap<&str, Vec<(String, f64)>> = BTreeMap::new();
    let mut visible = Vec::new();
    for frame in &frames {
        for pair in score_frame(scene, dataset, frame, &answers, silhouette, threshold, folder, warn)? {
            frame_ious.entry(pair.category).or_default().push((frame.frame.clone(), pair.iou));
            visible.push(pair.visible_iou);
        }
    }
    let all: Vec<f64> = frame_ious.values().flatten().map(|f| f.1).collect();
    scores.query_miou = Some(metrics::mean(&all));
    scores.query_macc25 = Some(metrics::fraction_above(&all, 0.25));
    scores.query_macc50 = Some(metrics::fraction_above(&all, 0.5));
    scores.query_miou_visible = Some(metrics::mean(&visible));
    scores.query_pairs = all.len();
    let name = match silhouette {
        Silhouette::Selected => "selected",
        Silhouette::Visible => "visible",
    };
    scores.silhouette = Some((name.into(), threshold));
    scores.queries = frame_ious
        .into_iter()
        .map(|(text, frames)| QueryScore {
            iou: metrics::mean(&frames.iter().map(|f| f.1).collect::<Vec<_>>()),
            selected: answers.get(text).map_or_else(Vec::new, |a| a.1.clone()),
            score: answers.get(text).and_then(|a| a.2),
            text: text.into(),
            frames,
        })
        .collect();
    Ok(())
}

type Answer = (Vec<u32>, Vec<u32>, Option<f32>);

/// A category in one frame.
struct Pair<'f> {
    category: &'f str,
    iou: f64,
    visible_iou: f64,
}

/// IoU of every category of one frame.
fn score_frame<'f>(
    scene: &LabelledScene,
    dataset: &Dataset,
    frame: &'f FrameLabels,
    answers: &BTreeMap<&str, Answer>,
    silhouette: Silhouette,
    threshold: f32,
    folder: &Path,
    warn: &mut dyn FnMut(&str),
) -> Result<Vec<Pair<'f>>> {
    let categories = || frame.categories.iter().map(|(c, m)| (c.as_str(), m));
    let Some(view) = dataset.views.iter().find(|v| v.stem() == frame.frame) else {
        warn(&format!("the labelled frame {} is no view of the scene: its objects count as IoU 0", frame.frame));
        return Ok(categories().map(|(category, _)| Pair { category, iou: 0.0, visible_iou: 0.0 }).collect());
    };
    let (w, h) = (frame.width, frame.height);
    let aspect = |w: u32, h: u32| f64::from(w) / f64::from(h);
    let ratio = aspect(w, h) / aspect(view.camera.width, view.camera.height);
    if (ratio - 1.0).abs() > ASPECT_TOLERANCE {
        return Err(Error::new("the labelled image has another shape than the photograph")
            .file(folder.join(format!("{}.json", frame.frame)))
            .field("info")
            .found(format!("{w}x{h}"))
            .expected(format!("{}x{} or a multiple", view.camera.width, view.camera.height))
            .hint("use the labels of this scene"));
    }
    let camera = view.camera.resized(w, h);
    let none: &[u32] = &[];
    let selections: Vec<&[u32]> = categories().map(|(c, _)| answers.get(c).map_or(none, |a| &a.0)).collect();
    let masks = silhouette.masks(&scene.gaussians, &selections, &camera, threshold);
    let visible = Silhouette::Visible;
    let seen = visible.masks(&scene.gaussians, &selections, &camera, visible.default_threshold());
    let pair = |((category, truth), (mask, seen)): ((&'f str, &Mask), (&Mask, &Mask))| Pair {
        category,
        iou: truth.iou(mask),
        visible_iou: truth.iou(seen),
    };
    Ok(categories().zip(masks.iter().zip(&seen)).map(pair).collect())
}

/// The scores of each thing and of each (frame, category) as CSV: two tables.
pub fn csv(scores: &Scores) -> (String, String) {
    let quote = |s: &str| format!("\"{}\"", s.replace('"', "\"\""));
    let mut things = String::from("id,name,background,points,iou,instance,fragments\n");
    for t in &scores.things {
        let instance = t.instance.map_or(String::new(), |i| i.to_string());
        things += &format!(
            "{},{},{},{},{:.6},{instance},{}\n",
            t.id,
            quote(&t.name),
            t.background,
            t.points,
            t.iou,
            t.fragments
        );
    }
    let mut queries = String::from("frame,category,iou\n");
    for q in &scores.queries {
        for (frame, iou) in &q.frames {
            queries += &format!("{},{},{iou:.6}\n", quote(frame), quote(&q.text));
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
