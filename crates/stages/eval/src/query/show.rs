//! The answers as files: PLYs, masks, overlays, `query.json`; and as text.

use super::ask::{Asked, Place};
use super::ranking::Ranked;
use super::segment::{self, Segment, Segmentation};
use crate::scene::{LabelledScene, find_view, numbered, slug, spread};
use crate::silhouette::Rendering;
use artifacts::instance_color;
use gs_io::{Error, Result, write_bytes};
use gs_scene::dataset::{Dataset, View};
use report::picture::{HIGHLIGHT, Picture, mask_png};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::fmt::Write;
use std::path::Path;

/// Ranked instances that `query.json` keeps for each text.
const KEPT_RANKS: usize = 20;
/// Views that show a query where none are named.
const DEFAULT_VIEWS: usize = 3;

/// How to show answers.
pub struct ShowOptions {
    /// Names of the views for pictures; empty: those in which the selected instances were matched best.
    pub views: Vec<String>,
    /// How a selection becomes a mask, and above which value a pixel belongs.
    pub rendering: Rendering,
}

/// A division of the cloud among texts, to be written.
pub struct Divided {
    /// The texts.
    pub texts: Vec<String>,
    /// Index of the text per Gaussian, -1 for none.
    pub labels: Vec<i32>,
    /// Instances of each text.
    pub instances: Vec<Vec<u32>>,
}

/// `query.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct QueryResults {
    /// Where text features came from.
    pub text_source: String,
    /// Dimension of the descriptors.
    pub dimension: usize,
    /// Instances in the scene.
    pub instances: usize,
    /// The answer to each query, in the order given.
    pub queries: Vec<QueryResult>,
    /// The cloud divided among the texts, where that was asked for.
    #[serde(default)]
    pub segmentation: Option<Segmentation>,
}

/// The answer to one text.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct QueryResult {
    /// The text, or what else was asked for.
    pub text: String,
    /// `text`, `image`, `pixel`, `point`, or `part` of what was found.
    #[serde(default)]
    pub kind: String,
    /// Where, for a pixel or a point.
    #[serde(default)]
    pub place: Option<Place>,
    /// Selected instances, best first.
    pub selected: Vec<u32>,
    /// Score of the best selected instance: cosine, relevancy, or share of a pixel.
    pub score: Option<f32>,
    /// Gaussians selected.
    pub gaussians: usize,
    /// File of the selected Gaussians, beside `query.json`; none when nothing is selected.
    pub ply: Option<String>,
    /// The best instances, selected or not.
    pub ranking: Vec<Ranked>,
    /// Pictures.
    pub views: Vec<QueryView>,
}

/// Pictures of an answer in one view.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct QueryView {
    /// Stem of the view.
    pub view: String,
    /// File of the photograph with the selection brought out, beside `query.json`.
    pub overlay: String,
    /// File of the mask (255 inside, 0 outside), beside `query.json`.
    pub mask: String,
    /// Pixels of the mask.
    pub pixels: usize,
}

/// Writes the answers' PLYs, pictures and `query.json` into `out`.
pub fn write(
    scene: &LabelledScene,
    dataset: &Dataset,
    source: String,
    asked: Vec<Asked>,
    divided: Option<Divided>,
    options: &ShowOptions,
    out: &Path,
) -> Result<QueryResults> {
    let named: Vec<&View> = options.views.iter().map(|v| find_view(dataset, v)).collect::<Result<_>>()?;
    let mut shown = Vec::new();
    for (number, asked) in (1..).zip(asked) {
        let file = numbered(number, &asked.name);
        let own = asked.place.as_ref().and_then(|p| p.view.as_deref()).and_then(|v| find_view(dataset, v).ok());
        let mut views =
            if named.is_empty() { best_views(scene, dataset, &asked.answer.selected) } else { named.clone() };
        if let Some(own) = own.filter(|o| !views.iter().any(|v| v.name == o.name)) {
            views.insert(0, own);
        }
        shown.push(Shown { asked, file, views });
    }
    for (asked, ply) in shown.iter().filter_map(|s| Some((&s.asked, s.ply()?))) {
        let ids: Vec<String> = asked.answer.selected.iter().map(u32::to_string).collect();
        let text: String = asked.name.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
        let own = vec![format!("cags query: {text}"), format!("cags instances: {}", ids.join(" "))];
        let comments = scene.geometry.comments(own);
        gs_scene::ply::write_gaussians(out.join(ply), &scene.gaussians().select(&asked.answer.gaussians), &comments)?;
    }
    let segmentation = divided.map(|d| write_segmentation(scene, dataset, &named, d, out)).transpose()?;
    let mut pictures: Vec<Vec<QueryView>> = vec![Vec::new(); shown.len()];
    for view in &dataset.views {
        let here: Vec<usize> =
            (0..shown.len()).filter(|&q| shown[q].views.iter().any(|v| v.name == view.name)).collect();
        if here.is_empty() {
            continue;
        }
        let photo = view.load_image()?;
        let photo = Picture::new(photo.width as usize, photo.height as usize, &photo.rgb);
        let selections: Vec<&[u32]> = here.iter().map(|&q| &shown[q].asked.answer.gaussians[..]).collect();
        let masks = options.rendering.masks(scene.gaussians(), &scene.raster, &selections, &view.camera);
        for (&q, mask) in here.iter().zip(&masks) {
            let stem = format!("{}.{}", shown[q].file, view_name(dataset, view));
            let (overlay, mask_file) = (format!("{stem}.overlay.png"), format!("{stem}.mask.png"));
            write_bytes(out.join(&overlay), &photo.highlighted(&mask.bits, HIGHLIGHT).png()?)?;
            write_bytes(out.join(&mask_file), &mask_png(mask.width, mask.height, &mask.bits)?)?;
            pictures[q].push(QueryView { view: view.stem().into(), overlay, mask: mask_file, pixels: mask.count() });
        }
    }
    let results = QueryResults {
        text_source: source,
        dimension: scene.instances.dim,
        instances: scene.instances.len(),
        queries: shown.iter().zip(pictures).map(|(s, views)| s.asked.result(s.ply(), views)).collect(),
        segmentation,
    };
    let path = out.join("query.json");
    let json = serde_json::to_vec_pretty(&results).map_err(|e| Error::new(e.to_string()).file(&path))?;
    write_bytes(&path, &json)?;
    Ok(results)
}

/// Writes `labels.npy`, `segmentation.ply` and renders of it.
fn write_segmentation(
    scene: &LabelledScene,
    dataset: &Dataset,
    named: &[&View],
    divided: Divided,
    out: &Path,
) -> Result<Segmentation> {
    let Divided { texts, labels, instances } = divided;
    let coloured = segment::coloured(scene.gaussians(), &labels);
    let (npy, ply) = ("labels.npy", "segmentation.ply");
    gs_io::npy::write_i32(out.join(npy), &[labels.len()], &labels)?;
    let comments: Vec<String> = texts.iter().enumerate().map(|(t, text)| format!("cags label {t}: {text}")).collect();
    gs_scene::ply::write_gaussians(out.join(ply), &coloured, &scene.geometry.comments(comments))?;
    let all: Vec<&View> = dataset.views.iter().collect();
    for view in if named.is_empty() { spread(&all, DEFAULT_VIEWS) } else { named.to_vec() } {
        let image = gs_raster::render(&coloured, &view.camera, &scene.raster);
        let picture = Picture::new(image.width as usize, image.height as usize, &image.rgb);
        write_bytes(out.join(format!("segmentation.{}.png", view_name(dataset, view))), &picture.png()?)?;
    }
    let segments = texts.into_iter().zip(instances).enumerate().map(|(t, (text, instances))| Segment {
        gaussians: labels.iter().filter(|&&l| l == t as i32).count(),
        color: instance_color(t as u32),
        text,
        instances,
    });
    let segments = segments.collect();
    let unlabelled = labels.iter().filter(|&&l| l < 0).count();
    Ok(Segmentation { segments, unlabelled, labels: npy.into(), ply: ply.into() })
}

struct Shown<'a> {
    asked: Asked,
    file: String,
    views: Vec<&'a View>,
}

impl Shown<'_> {
    /// Name of the file of the selected Gaussians; none without any.
    fn ply(&self) -> Option<String> {
        (!self.asked.answer.gaussians.is_empty()).then(|| format!("{}.ply", self.file))
    }
}

impl Asked {
    /// The answer as `query.json` has it, with the file of its Gaussians and its pictures.
    pub(super) fn result(&self, ply: Option<String>, views: Vec<QueryView>) -> QueryResult {
        QueryResult {
            text: self.name.clone(),
            kind: self.kind.into(),
            place: self.place.clone(),
            score: self.answer.score,
            gaussians: self.answer.gaussians.len(),
            ply,
            ranking: self.answer.ranking.iter().take(KEPT_RANKS).copied().collect(),
            selected: self.answer.selected.clone(),
            views,
        }
    }
}

impl QueryResults {
    /// A warning for each query that selects nothing.
    pub fn warnings(&self) -> impl Iterator<Item = String> {
        self.queries.iter().filter(|q| q.gaussians == 0).map(|q| {
            if q.selected.is_empty() {
                format!("no instance passes for {:?}: nothing is selected", q.text)
            } else {
                format!("the instances selected for {:?} hold no Gaussian: nothing to show", q.text)
            }
        })
    }
}

/// A view's stem as part of a file name (names of views may hold folders), with its number where two would be the same.
fn view_name(dataset: &Dataset, view: &View) -> String {
    let name = |v: &View| slug(v.stem(), "_.");
    let own = name(view);
    let twins = dataset.views.iter().filter(|v| name(v) == own).count();
    let number = dataset.views.iter().position(|v| v.name == view.name).unwrap_or(0);
    if twins > 1 { format!("{number:04}-{own}") } else { own }
}

/// Views to show a selection in: of those in which its instances were matched with at least half of the best score, a
/// few that lie apart; without matches, a few of all views.
fn best_views<'a>(scene: &LabelledScene, dataset: &'a Dataset, selected: &[u32]) -> Vec<&'a View> {
    let matches = || scene.instances.matches.iter().filter(|m| selected.contains(&m.instance));
    let best = matches().map(|m| m.score).fold(0.0, f32::max);
    let good: BTreeSet<&str> =
        matches().filter(|m| m.score >= 0.5 * best).map(|m| scene.instances.views[m.view as usize].as_str()).collect();
    let candidates: Vec<&View> = dataset.views.iter().filter(|v| good.contains(v.stem())).collect();
    let all: Vec<&View> = dataset.views.iter().collect();
    spread(if candidates.is_empty() { &all } else { &candidates }, DEFAULT_VIEWS)
}

/// Rows of a printed ranking.
const ROWS: usize = 5;

/// The rankings as a table for the terminal.
pub fn table(results: &QueryResults) -> String {
    let mut s: String = results.queries.iter().map(answer_table).collect();
    if let Some(d) = &results.segmentation {
        let _ = writeln!(s, "segmentation ({} Gaussians without a text)", d.unlabelled);
        for segment in &d.segments {
            let _ = writeln!(
                s,
                "  {:>10} Gaussians {:>4} instances  {}",
                segment.gaussians,
                segment.instances.len(),
                segment.text
            );
        }
    }
    s
}

/// One ranking as a table for the terminal.
pub fn answer_table(q: &QueryResult) -> String {
    let mut s = String::new();
    let _ = writeln!(s, "{:?} ({} Gaussians selected)", q.text, q.gaussians);
    if let Some(place) = &q.place {
        if let Some([x, y, z]) = place.position {
            let _ = writeln!(s, "  at {x:.4} {y:.4} {z:.4}");
        }
        for (name, score) in &place.names {
            let _ = writeln!(s, "  {score:>8.4} {name}");
        }
    }
    if q.kind == "part" {
        return s;
    }
    let _ = writeln!(s, "  {:>4} {:>9} {:>8} {:>6} {:>10}", "rank", "instance", "score", "views", "Gaussians");
    for (i, r) in q.ranking.iter().take(ROWS).enumerate() {
        let mark = if q.selected.contains(&r.instance) { "  selected" } else { "" };
        let _ =
            writeln!(s, "  {:>4} {:>9} {:>8.4} {:>6} {:>10}{mark}", i + 1, r.instance, r.score, r.support, r.gaussians);
    }
    if q.ranking.is_empty() {
        let _ =
            writeln!(s, "  {}", if q.place.is_some() { "nothing is there" } else { "no instance has a descriptor" });
    }
    s
}
