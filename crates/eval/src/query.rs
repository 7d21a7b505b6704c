//! `eval query`: from a text to the Gaussians it means.

use crate::picture::{HIGHLIGHT, Picture, mask_png};
use crate::ranking::{self, Ranked, Selection};
use crate::scene::{LabelledScene, find_view, slug, spread};
use crate::silhouette::Silhouette;
use crate::text::TextSource;
use gs_io::{Error, Result, write_bytes};
use gs_scene::dataset::{Dataset, View};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::fmt::Write;
use std::path::Path;

/// Ranked instances that `query.json` keeps for each text.
const KEPT_RANKS: usize = 20;
/// Views that show a query where none are named.
const DEFAULT_VIEWS: usize = 3;

/// How to answer queries.
pub struct QueryOptions {
    /// The texts.
    pub texts: Vec<String>,
    /// Which instances of the ranking are selected.
    pub selection: Selection,
    /// Names of the views for pictures; empty: those in which the selected instances were matched best.
    pub views: Vec<String>,
    /// How a selection becomes a mask.
    pub silhouette: Silhouette,
    /// The value above which a pixel belongs to the mask.
    pub threshold: f32,
}

/// `query.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct QueryResults {
    /// Where text features came from.
    pub text_source: String,
    /// Numbers per descriptor.
    pub dimension: usize,
    /// Instances in the scene.
    pub instances: usize,
    /// The answer to each text, in the order given.
    pub queries: Vec<QueryResult>,
}

/// The answer to one text.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct QueryResult {
    /// The text.
    pub text: String,
    /// Selected instances, best first.
    pub selected: Vec<u32>,
    /// Cosine of the best selected instance.
    pub score: Option<f32>,
    /// Gaussians selected.
    pub gaussians: usize,
    /// File of the selected Gaussians, beside `query.json`; none when nothing is selected.
    pub ply: Option<String>,
    /// The best instances by cosine, selected or not.
    pub ranking: Vec<RankedInstance>,
    /// Pictures.
    pub views: Vec<QueryView>,
}

/// An instance in `query.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RankedInstance {
    /// Index of the instance.
    pub instance: u32,
    /// Cosine with the text.
    pub score: f32,
    /// Views that support its descriptor.
    pub support: u32,
    /// Its Gaussians.
    pub gaussians: u32,
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

/// Answers the queries and writes PLYs, pictures and `query.json` into `out`.
///
/// # Errors
/// When the text features do not fit the instances, a text or view is unknown, or a file cannot be read or written.
pub fn run(
    scene: &LabelledScene,
    dataset: &Dataset,
    source: &TextSource,
    options: &QueryOptions,
    out: &Path,
) -> Result<QueryResults> {
    let features = encode_all(scene, source, &options.texts)?;
    let named: Vec<&View> = options.views.iter().map(|v| find_view(dataset, v)).collect::<Result<_>>()?;
    let mut names = BTreeSet::new();
    let mut answers = Vec::new();
    for (text, feature) in options.texts.iter().zip(&features) {
        let ranking = ranking::rank(&scene.instances, feature);
        let selected = options.selection.choose(&ranking);
        let members = ranking::members(&scene.instances, &selected);
        let base = slug(text);
        let file =
            (1..).map(|i| if i == 1 { base.clone() } else { format!("{base}-{i}") }).find(|n| names.insert(n.clone()));
        let file = file.unwrap_or(base);
        let views = if named.is_empty() { best_views(scene, dataset, &selected) } else { named.clone() };
        answers.push(Answer { text, ranking, selected, members, file, views });
    }
    gs_io::create_dir(out)?;
    for a in answers.iter().filter(|a| !a.members.is_empty()) {
        let ids: Vec<String> = a.selected.iter().map(u32::to_string).collect();
        let text: String = a.text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
        let comments = [format!("cags query: {text}"), format!("cags instances: {}", ids.join(" "))];
        let path = out.join(format!("{}.ply", a.file));
        gs_scene::ply::write_gaussians(&path, &scene.gaussians.select(&a.members), &comments)?;
    }
    let mut pictures: Vec<Vec<QueryView>> = vec![Vec::new(); answers.len()];
    for view in &dataset.views {
        let here: Vec<usize> =
            (0..answers.len()).filter(|&q| answers[q].views.iter().any(|v| v.name == view.name)).collect();
        if here.is_empty() {
            continue;
        }
        let photo = view.load_image()?;
        let photo = Picture::new(photo.width as usize, photo.height as usize, &photo.rgb);
        let selections: Vec<&[u32]> = here.iter().map(|&q| &answers[q].members[..]).collect();
        let masks = options.silhouette.masks(&scene.gaussians, &selections, &view.camera, options.threshold);
        for (&q, mask) in here.iter().zip(&masks) {
            let stem = format!("{}.{}", answers[q].file, slug_of_view(view));
            let (overlay, mask_file) = (format!("{stem}.overlay.png"), format!("{stem}.mask.png"));
            write_bytes(out.join(&overlay), &photo.highlighted(mask, HIGHLIGHT).png()?)?;
            write_bytes(out.join(&mask_file), &mask_png(mask)?)?;
            pictures[q].push(QueryView { view: view.stem().into(), overlay, mask: mask_file, pixels: mask.count() });
        }
    }
    let results = QueryResults {
        text_source: source.describe(),
        dimension: scene.instances.dim,
        instances: scene.instances.len(),
        queries: answers.into_iter().zip(pictures).map(|(a, views)| a.result(views)).collect(),
    };
    let path = out.join("query.json");
    let json = serde_json::to_vec_pretty(&results).map_err(|e| Error::new(e.to_string()).file(&path))?;
    write_bytes(&path, &json)?;
    Ok(results)
}

struct Answer<'a> {
    text: &'a str,
    ranking: Vec<Ranked>,
    selected: Vec<u32>,
    members: Vec<u32>,
    file: String,
    views: Vec<&'a View>,
}

impl Answer<'_> {
    fn result(self, views: Vec<QueryView>) -> QueryResult {
        let ranked = |r: &Ranked| RankedInstance {
            instance: r.instance,
            score: r.score,
            support: r.support,
            gaussians: r.gaussians,
        };
        let best = self.selected.first();
        QueryResult {
            score: self.ranking.iter().find(|r| Some(&r.instance) == best).map(|r| r.score),
            gaussians: self.members.len(),
            ply: (!self.members.is_empty()).then(|| format!("{}.ply", self.file)),
            ranking: self.ranking.iter().take(KEPT_RANKS).map(ranked).collect(),
            text: self.text.into(),
            selected: self.selected,
            views,
        }
    }
}

/// A view's stem as part of a file name (names of views may hold folders).
fn slug_of_view(view: &View) -> String {
    view.stem().chars().map(|c| if c.is_alphanumeric() || "_-.".contains(c) { c } else { '-' }).collect()
}

/// Text features of all texts, checked against the instances.
///
/// # Errors
/// When dimensions differ or a text has no feature.
fn encode_all(scene: &LabelledScene, source: &TextSource, texts: &[String]) -> Result<Vec<Vec<f32>>> {
    source.check_dim(scene.instances.dim, scene.path())?;
    let encoded = source.encode(texts)?;
    encoded.into_iter().zip(texts).map(|(f, t)| f.ok_or_else(|| source.unknown(t))).collect()
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

/// The rankings as a table for the terminal.
pub fn table(results: &QueryResults, rows: usize) -> String {
    let mut s = String::new();
    for q in &results.queries {
        let _ = writeln!(s, "{:?} ({} Gaussians selected)", q.text, q.gaussians);
        let _ = writeln!(s, "  {:>4} {:>9} {:>8} {:>6} {:>10}", "rank", "instance", "cosine", "views", "Gaussians");
        for (i, r) in q.ranking.iter().take(rows).enumerate() {
            let mark = if q.selected.contains(&r.instance) { "  selected" } else { "" };
            let _ = writeln!(
                s,
                "  {:>4} {:>9} {:>8.4} {:>6} {:>10}{mark}",
                i + 1,
                r.instance,
                r.score,
                r.support,
                r.gaussians
            );
        }
        if q.ranking.is_empty() {
            let _ = writeln!(s, "  no instance has a descriptor");
        }
    }
    s
}
