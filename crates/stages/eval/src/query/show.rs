//! The answers as files: PLYs, masks, overlays, `query.json`; and as text.

use super::ask::{Asked, Asker, Found, QueryResult, QueryView};
use super::segment::Segmentation;
use crate::options::QueryOptions;
use crate::scene::{find_view, numbered, view_name, views_to_show};
use crate::silhouette::Silhouette;
use gs_io::{Result, write_bytes, write_json};
use gs_scene::dataset::{Dataset, View};
use query::{Kind, LabelledScene, TextSource, Verdict};
use report::picture::{Picture, mask_png};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::fmt::Write;
use std::path::Path;

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
    pub segmentation: Option<Segmentation>,
}

/// Writes the answers' PLYs, pictures and `query.json` into `out`.
pub fn write(
    o: &QueryOptions,
    scene: &LabelledScene,
    dataset: &Dataset,
    asker: &Asker<'_>,
    mut asked: Vec<Asked>,
    segmentation: Option<Segmentation>,
    out: &Path,
) -> Result<QueryResults> {
    let mut shown = Vec::new();
    for (number, Asked { result, gaussians }) in (1..).zip(&mut asked) {
        let name = numbered(number, &result.text);
        let mut views = views_of(o, scene, dataset, &result.selected)?;
        let own = result.place.as_ref().and_then(|p| find_view(dataset, p.view.as_deref()?).ok());
        if let Some(own) = own.filter(|o| !views.iter().any(|v| v.name == o.name)) {
            views.insert(0, own);
        }
        if !gaussians.is_empty() {
            let ply = format!("{name}.ply");
            let ids: Vec<String> = result.selected.iter().map(u32::to_string).collect();
            let text: String = result.text.chars().map(|c| if gs_io::is_control(c) { ' ' } else { c }).collect();
            let own = vec![format!("cags query: {text}"), format!("cags instances: {}", ids.join(" "))];
            let comments = scene.geometry.comments(own);
            gs_scene::ply::write_gaussians(out.join(&ply), &scene.gaussians().select(gaussians), &comments)?;
            result.ply = Some(ply);
        }
        shown.push((name, views));
    }
    let rendering = o.masking.rendering(Silhouette::Visible);
    for view in &dataset.views {
        let here: Vec<usize> = (0..shown.len()).filter(|&q| shown[q].1.iter().any(|v| v.name == view.name)).collect();
        if here.is_empty() {
            continue;
        }
        let photo = view.load_image()?;
        let photo = Picture::new(photo.width, photo.height, &photo.rgb);
        let selections: Vec<&[u32]> = here.iter().map(|&q| &asked[q].gaussians[..]).collect();
        let masks = rendering.masks(scene.gaussians(), &scene.raster, &selections, &view.camera);
        for (q, mask) in here.into_iter().zip(&masks) {
            let stem = format!("{}.{}", shown[q].0, view_name(dataset, view));
            let (overlay, mask_file) = (format!("{stem}.overlay.png"), format!("{stem}.mask.png"));
            write_bytes(out.join(&overlay), &photo.highlighted(&mask.bits).png()?)?;
            write_bytes(out.join(&mask_file), &mask_png(mask.width, mask.height, &mask.bits)?)?;
            let picture = QueryView { view: view.stem().into(), overlay, mask: mask_file, pixels: mask.count() };
            asked[q].result.views.push(picture);
        }
    }
    let results = QueryResults {
        text_source: asker.source.as_ref().map_or("none".into(), TextSource::describe),
        dimension: scene.instances.dim(),
        instances: scene.instances.len(),
        queries: asked.into_iter().map(|a| a.result).collect(),
        segmentation,
    };
    write_json(out.join("query.json"), &results)?;
    Ok(results)
}

impl QueryResults {
    /// A warning for each query that selects nothing.
    pub fn warnings(&self) -> impl Iterator<Item = String> {
        self.queries.iter().filter(|q| q.gaussians == 0).map(|q| {
            if q.verdict.is_some_and(|v| !v.matches) {
                format!("nothing matches {:?}, so nothing is selected; --top-k 1 selects the best all the same", q.text)
            } else if q.selected.is_empty() {
                format!("no instance passes for {:?}: nothing is selected", q.text)
            } else {
                format!("the instances selected for {:?} hold no Gaussian: nothing to show", q.text)
            }
        })
    }
}

/// The views named; else, of those in which the selected instances were matched with at least half of the best score, a few
/// that lie apart; without matches, a few of all views.
fn views_of<'a>(
    o: &QueryOptions,
    scene: &LabelledScene,
    dataset: &'a Dataset,
    selected: &[u32],
) -> Result<Vec<&'a View>> {
    let matches = || scene.instances.matches.iter().filter(|m| selected.contains(&m.instance));
    let best = matches().map(|m| m.score).fold(0.0, f32::max);
    let good: BTreeSet<&str> =
        matches().filter(|m| m.score >= 0.5 * best).map(|m| scene.instances.views[m.view as usize].as_str()).collect();
    views_to_show(dataset, &o.views.views, |v| good.contains(v.stem()))
}

/// Rows of a printed ranking.
const ROWS: usize = 5;

/// The rankings as a table for the terminal.
pub fn table(results: &QueryResults) -> String {
    let mut s: String = results.queries.iter().map(answer_table).collect();
    if let Some(d) = &results.segmentation {
        let _ = writeln!(s, "segmentation ({} Gaussians without a text)", d.unlabelled);
        for part in &d.segments {
            let (gaussians, instances) = (part.gaussians, part.instances.len());
            let _ = writeln!(s, "  {gaussians:>10} Gaussians {instances:>4} instances  {}", part.text);
        }
    }
    s
}

/// One ranking as a table for the terminal.
pub fn answer_table(q: &QueryResult) -> String {
    let mut s = String::new();
    let _ = writeln!(s, "{:?} ({} Gaussians selected)", q.text, q.gaussians);
    if let Some(Verdict { best, by_chance, .. }) = q.verdict.filter(|v| !v.matches) {
        let _ = writeln!(s, "  nothing matches: the best score is {best:.4}, unrelated texts reach {by_chance:.4}");
    }
    if let Some(Found { kind, support, fit, .. }) = q.granule {
        let what = match kind {
            Kind::Part => "a part of an instance",
            Kind::Thing => "a thing",
            Kind::Group => "a group of instances",
        };
        let _ = writeln!(s, "  {what}: masks of {support} views show it, mean IoU {fit:.2}");
    }
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
    for (i, entry) in q.ranking.iter().take(ROWS).enumerate() {
        let r = &entry.ranked;
        let mark = if q.selected.contains(&r.instance) { "  selected" } else { "" };
        let name = entry.name.as_ref().map_or(String::new(), |name| format!("  {name}"));
        let (rank, instance, views) = (i + 1, r.instance, r.support);
        let _ = writeln!(s, "  {rank:>4} {instance:>9} {:>8.4} {views:>6} {:>10}{mark}{name}", r.score, r.gaussians);
    }
    if q.ranking.is_empty() {
        s += if q.place.is_some() { "  nothing is there\n" } else { "  no instance has a descriptor\n" };
    }
    s
}
