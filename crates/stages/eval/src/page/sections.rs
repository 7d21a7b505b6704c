//! The sections of a report, in their order on the page.

use super::material::{Material, Shown, is_of, optional_json};
use super::metrics::Metrics;
use super::runs::{self, Run, grouped};
use crate::names::counts;
use crate::query::show::QueryResults;
use crate::score::{QueryScore, ThingScore};
use artifacts::{
    Features, Health, InstanceNames, Level, MaskFolder, NOISE_COLOR, Naming, ScoredName, flat, hash_folder,
    instance_color, maps_path, role,
};
use gs_io::{Error, IoContext, Result};
use gs_scene::dataset::{Dataset, View};
use query::{Verdict, check_features};
use report::curve;
use report::feature_colors;
use report::html::{Figure, Page};
use report::picture::Picture;
use std::collections::BTreeSet;
use std::path::{Component, Path, PathBuf};

/// Width of pictures on the page, two or three beside each other.
const WIDTH_OF: [usize; 4] = [900, 900, 640, 440];
const QUALITY: u8 = 86;
/// Pictures of features and instances are rendered at most this wide: the page shows them smaller.
const MAX_RENDER: u32 = 960;
/// What is behind Gaussians in rendered pictures.
const BACKDROP: [f32; 3] = [0.08, 0.09, 0.1];

pub(super) fn tiles(metrics: &Metrics, dataset: &Dataset) -> Vec<(String, String)> {
    let mut tiles = Vec::new();
    let mut tile = |name: &str, value: Option<String>| {
        if let Some(value) = value {
            tiles.push((name.to_string(), value));
        }
    };
    tile("PSNR, held-out views", metrics.psnr_heldout.map(|v| format!("{v:.2} dB")));
    tile("SSIM, held-out views", metrics.ssim_heldout.map(|v| format!("{v:.3}")));
    tile("instance mIoU", metrics.instance_miou.map(|v| format!("{v:.3}")));
    tile("query mIoU", metrics.query_miou.map(|v| format!("{v:.3}")));
    tile("photographs", Some(dataset.views.len().to_string()));
    tile("Gaussians", Some(grouped(&metrics.gaussians.to_string())));
    tile("instances", metrics.instances.map(|n| n.to_string()));
    let total: f64 = metrics.seconds.values().sum();
    tile("all stages", (total > 0.0).then(|| duration(total)));
    tiles
}

/// Seconds for people.
fn duration(seconds: f64) -> String {
    if seconds < 60.0 {
        format!("{seconds:.1} s")
    } else {
        let whole = seconds.round() as u64;
        format!("{} min {:02} s", whole / 60, whole % 60)
    }
}

fn figure(picture: &Picture, columns: usize, caption: String) -> Result<Figure> {
    Ok(Figure { jpeg: picture.jpeg(WIDTH_OF[columns.min(3)], QUALITY)?, caption })
}

pub(super) fn photographs(m: &Material, page: &mut Page) -> Result<()> {
    page.section("photographs", "Photographs and renders");
    let what = "Left the photograph, right the 3D Gaussians rendered from the same place.";
    page.paragraph(&format!("{what} {}", whether_seen(m)));
    let mut figures = Vec::new();
    for s in &m.shown {
        figures.push(figure(&s.photo, 2, format!("{}: photograph", s.view.stem()))?);
        figures.push(figure(&s.render, 2, format!("{}: render, {:.2} dB", s.view.stem(), s.psnr))?);
    }
    page.figures(2, &figures);
    Ok(())
}

/// Whether training saw the views that are shown.
fn whether_seen(m: &Material) -> String {
    let Some(unseen) = &m.unseen else {
        return "The Gaussians do not say which of these views training saw.".into();
    };
    let seen: Vec<&str> = m.shown.iter().filter(|s| !unseen.contains(&*s.view.name)).map(|s| s.view.stem()).collect();
    match seen.len() {
        0 => "These views were held out: training never saw them.".into(),
        n if n == m.shown.len() => "Training saw these views.".into(),
        _ => format!("Training saw {}; the other views were held out.", seen.join(", ")),
    }
}

pub(super) fn id_maps(m: &Material, page: &mut Page, metrics: &mut Metrics) -> Result<()> {
    let Some(folder) = m.masks.as_deref().filter(|f| f.is_dir()) else {
        metrics.skipped.push("id maps: no folder of masks was given".into());
        return Ok(());
    };
    if let Some((_, a)) = m.found.as_ref().filter(|(_, a)| a.provenance().inputs.contains_key(role::MASKS)) {
        a.expect_input(role::MASKS, &hash_folder(folder, "_s.npy")?)?;
    }
    let mut figures = Vec::new();
    for s in &m.shown {
        if !maps_path(folder, s.view.stem()).exists() {
            continue;
        }
        let maps = MaskFolder::open(folder).read(s.view)?;
        let any = |level: &Level| maps.levels().contains(level) && maps.level(*level).iter().any(|&id| id >= 0);
        let level = maps.level(Some(Level::CLASSES).filter(any).unwrap_or(Level::LARGE));
        let distinct: BTreeSet<i32> = level.iter().copied().filter(|&id| id >= 0).collect();
        let (w, h) = (s.photo.width, s.photo.height);
        // Ids of a level begin after those of the others; only their differences matter for colours.
        let color = |i: usize| {
            let (x, y) = (i % w * maps.width() / w, i / w * maps.height() / h);
            u32::try_from(level[[y, x]]).map_or(NOISE_COLOR, instance_color)
        };
        let overlay: Vec<[f32; 3]> = (0..w * h).map(color).collect();
        let caption = format!("{}: {} masks", s.view.stem(), distinct.len());
        figures.push(figure(&s.photo.overlaid(&overlay, 0.6), 3, caption)?);
    }
    if figures.is_empty() {
        metrics.skipped.push(format!("id maps: none of the views shown has one in {}", folder.display()));
        return Ok(());
    }
    page.section("id-maps", "Masks");
    page.paragraph(
        "The 2D masks of the level \u{201c}large\u{201d}, or of classes where there are any, a colour per mask, grey where there is none. Every view is \
         segmented on its own: colours do not correspond between views, and neither need the extents of masks.",
    );
    page.figures(3, &figures);
    Ok(())
}

pub(super) fn features(m: &Material, page: &mut Page, metrics: &mut Metrics) -> Result<()> {
    let path = m.file("features.safetensors");
    if !path.exists() {
        metrics
            .skipped
            .push("features: the run has no features.safetensors (the masks do without; FEAT_ARGS makes it)".into());
        return Ok(());
    }
    let (features, file) = Features::read(&path)?;
    // A run makes no new ones where nothing reads them: old ones stay.
    if let Err(e) = check_features(&features, &file, &m.inputs[role::GEOMETRY], m.geometry.gaussians.len()) {
        metrics.skipped.push(format!("features: {e}"));
        return Ok(());
    }
    if features.dim() == 0 || features.kept.is_empty() {
        metrics.skipped.push("features: no Gaussian has one".into());
        return Ok(());
    }
    let mut colors = vec![None; m.geometry.gaussians.len()];
    for (&i, c) in features.kept.iter().zip(feature_colors(flat(features.values.view()), features.dim())) {
        colors[i as usize] = Some(c);
    }
    page.section("features", "Features");
    page.paragraph(&format!(
        "The feature of every Gaussian, of dimension {}, as a colour: the three leading principal components are red, green \
         and blue.",
        features.dim()
    ));
    let colored = |s: &Shown| figure(&render_colors(m, &colors, s.view), 3, s.view.stem().to_string());
    page.figures(3, &m.shown.iter().map(colored).collect::<Result<Vec<_>>>()?);
    Ok(())
}

/// Renders a colour per Gaussian; Gaussians without one are left out of the mixture.
fn render_colors(m: &Material, colors: &[Option<[f32; 3]>], view: &View) -> Picture {
    let width = view.camera.width.min(MAX_RENDER);
    let height = (f64::from(view.camera.height) * f64::from(width) / f64::from(view.camera.width)).round() as u32;
    let camera = view.camera.resized(width, height.max(1));
    let channels: Vec<f32> = colors.iter().flat_map(|c| c.map_or([0.0; 4], |[r, g, b]| [r, g, b, 1.0])).collect();
    let out = gs_raster::render_features(&m.geometry.gaussians, &channels, 4, &camera, &m.raster);
    let over = |p: &[f32]| [0, 1, 2].map(|k| p[k] + (1.0 - p[3]).max(0.0) * BACKDROP[k]);
    let rgb: Vec<f32> = out.chunks_exact(4).flat_map(over).collect();
    Picture::new(camera.width, camera.height, &rgb)
}

pub(super) fn instances(m: &Material, page: &mut Page, metrics: &mut Metrics) -> Result<()> {
    let Some((inst, _)) = &m.found else { return Ok(()) };
    page.section("instances", "Instances");
    if inst.is_empty() {
        page.note("The clustering found no instance: all Gaussians are noise.");
        metrics.skipped.push("instance pictures: there is no instance".into());
        return Ok(());
    }
    let noise = inst.label.iter().filter(|&&l| l < 0).count();
    page.paragraph(&format!(
        "{} instances, a colour each, the same in every view and in the coloured PLY; {} Gaussians belong to none (grey).",
        inst.len(),
        grouped(&noise.to_string())
    ));
    let color = |&l: &i32| Some(u32::try_from(l).map_or(NOISE_COLOR, instance_color));
    let colors: Vec<Option<[f32; 3]>> = inst.label.iter().map(color).collect();
    let mut figures = Vec::new();
    for s in &m.shown {
        figures.push(figure(&s.photo, 2, format!("{}: photograph", s.view.stem()))?);
        figures.push(figure(&render_colors(m, &colors, s.view), 2, format!("{}: instances", s.view.stem()))?);
    }
    page.figures(2, &figures);
    Ok(())
}

/// What to expect of instances, for no figure of a scene without truth tells: `whole` of `eval score` on six scenes with truth (docs/results/real-masks.md).
const WHOLE: &str = "Without truth no figure tells how many instances are one whole thing. On six scenes with truth and a real SAM's masks 25 to 61 % \
    were, 40 % on average: two of three in the half with the higher confidence, one of seven in the other half. The rest were cut, or merged with \
    others. Look at the instances beside the photographs; explore merges and splits them. More views, a better SAM or other --levels of \
    cluster-match may help.";

/// How far masks and instances agree, and what to expect of instances.
pub(super) fn soundness(m: &Material, page: &mut Page, metrics: &mut Metrics) -> Result<()> {
    let Some((_, artifact)) = m.found.as_ref().filter(|(instances, _)| !instances.is_empty()) else { return Ok(()) };
    metrics.health = Health::of(artifact)?;
    let Some(health) = &metrics.health else {
        metrics
            .skipped
            .push("masks and instances: an older cluster-match made the instances, without their health".into());
        return Ok(());
    };
    page.section("soundness", "Masks and instances: how far they agree");
    page.tiles(&health.figures());
    page.paragraph(WHOLE);
    Ok(())
}

pub(super) fn queries(m: &Material, page: &mut Page, metrics: &mut Metrics) -> Result<()> {
    let folder = m.file("query");
    let path = folder.join("query.json");
    let current = m.found.is_none() || is_of(&path, &m.inputs);
    let results = if current { optional_json::<QueryResults>(&path)? } else { None };
    let Some(results) = results.filter(|r| !r.queries.is_empty()) else {
        let without_language = m.found.as_ref().is_some_and(|(instances, _)| instances.dim() == 0);
        metrics.skipped.push(if without_language {
            "text queries: the instances have no language features, because the masks were not encoded with a CLIP \
             model (mask-embed embed --clip)"
                .into()
        } else if !current {
            "text queries: query/query.json is of other instances (run eval query)".into()
        } else {
            "text queries: the run has no query/query.json (eval query makes it)".into()
        });
        return Ok(());
    };
    page.section("queries", "Text queries");
    page.paragraph(&format!(
        "Answers by cosine similarity between a text and the instances\u{2019} descriptors ({}). The photographs show the \
         selected 3D Gaussians.",
        results.text_source
    ));
    let scored = |text: &str| m.scores.as_ref().and_then(|s| s.queries.iter().find(|q| q.text == text));
    for q in &results.queries {
        let mut facts = Vec::new();
        match q.selected.len() {
            0 => facts.push("nothing selected".into()),
            1 => facts.push(format!("instance {}", q.selected[0])),
            n => facts.push(format!("{n} instances")),
        }
        let chance = |v: Verdict| format!("nothing matches: cosine {:.3}, unrelated texts {:.3}", v.best, v.by_chance);
        facts.extend(q.verdict.filter(|v| !v.matches).map(chance));
        facts.extend(q.score.map(|s| format!("cosine {s:.3}")));
        facts.extend(scored(&q.text).map(|s| format!("IoU {:.3}", s.iou)));
        let mut figures = Vec::new();
        for v in &q.views {
            let path = beside(&folder, &v.overlay)?;
            let picture = gs_scene::Image::read(&path)?;
            let picture = Picture::new(picture.width, picture.height, &picture.rgb);
            figures.push(figure(&picture, 3, v.view.clone())?);
        }
        page.heading(&format!("\u{201c}{}\u{201d}", q.text), &facts.join(", "));
        page.figures(3, &figures);
    }
    Ok(())
}

/// How many of each are there, and what every instance may be.
pub(super) fn names(m: &Material, page: &mut Page, metrics: &mut Metrics) {
    let Some((instances, artifact)) = &m.found else { return };
    let path = InstanceNames::path_beside(artifact.path());
    if !path.exists() {
        metrics.skipped.push("names: the run has no names.json (eval names makes it)".into());
        return;
    }
    let names = match InstanceNames::read(&path, artifact.hash()) {
        Ok(names) => names,
        Err(e) => return metrics.skipped.push(format!("names: {e}")),
    };
    page.section("names", "What is there");
    let mut how = format!("The best of {} names for each instance ({}).", names.words, names.source);
    if let Some(chance) = names.by_chance {
        how += &format!(
            " By the cosine of descriptor and name; a name is sure where its lead over the best name of another meaning is above \
             {chance:.3}, what it may be by chance."
        );
    }
    page.paragraph(&how);
    let counts = counts(names.named.iter().filter_map(|n| names.best(n.instance)).map(|c| (c.name, c.sure)));
    let rows: Vec<Vec<String>> = counts.iter().map(|c| vec![c.name.clone(), c.describe()]).collect();
    page.table(&["name", "count"], &rows);
    let row = |n: &Naming| {
        let scored = |s: &ScoredName| format!("{} ({:.3})", s.name, s.score);
        let others = n.names.iter().skip(1).map(scored).collect::<Vec<_>>().join(", ");
        let gaussians = grouped(&instances.count[n.instance as usize].to_string());
        let best = n.names.first().map_or(String::new(), scored);
        let sure = if n.sure { "yes" } else { "no" };
        vec![n.instance.to_string(), gaussians, best, format!("{:.3}", n.margin), sure.into(), others]
    };
    let there = names.named.iter().filter(|n| (n.instance as usize) < instances.len());
    let rows: Vec<Vec<String>> = there.map(row).collect();
    page.table(&["instance", "Gaussians", "name (score)", "margin", "sure", "or"], &rows);
}

/// The path of a picture that `query.json` names: it lies in that file's folder, and no other file is shown.
fn beside(folder: &Path, name: &str) -> Result<PathBuf> {
    let inside = !name.is_empty() && Path::new(name).components().all(|c| matches!(c, Component::Normal(_)));
    if inside {
        return Ok(folder.join(name));
    }
    Err(Error::new("a picture outside the run")
        .file(folder.join("query.json"))
        .field("overlay")
        .found(name)
        .expected("the name of a picture in this folder")
        .hint("run eval query again"))
}

pub(super) fn score_tables(m: &Material, page: &mut Page) {
    let Some(s) = &m.scores else { return };
    if !s.things.is_empty() {
        page.section("instance-scores", "Instances against the truth");
        page.paragraph(&format!(
            "Each surface point takes the instance of the nearest Gaussian. mIoU {:.3}, over objects without background \
             {}; {} of {} things fell into several instances, {} instances hold several things.",
            s.instance_miou.unwrap_or_default(),
            s.object_miou.map_or("–".into(), |v| format!("{v:.3}")),
            s.fragmented.unwrap_or_default(),
            s.things.len(),
            s.merging.unwrap_or_default(),
        ));
        let row = |t: &ThingScore| {
            let instance = t.instance.map_or("–".into(), |i| i.to_string());
            let name = if t.background { format!("{} (background)", t.name) } else { t.name.clone() };
            vec![name, grouped(&t.points.to_string()), format!("{:.3}", t.iou), instance, t.fragments.to_string()]
        };
        let rows: Vec<Vec<String>> = s.things.iter().map(row).collect();
        page.table(&["thing", "points", "best IoU", "instance", "fragments"], &rows);
    }
    if !s.queries.is_empty() {
        page.section("query-scores", "Queries against the labels");
        let how =
            s.silhouette.as_ref().map_or(String::new(), |(s, t)| format!(" Silhouettes: {}, above {t}.", s.name()));
        page.paragraph(&format!(
            "IoU of the selection with labelled polygons over {} pairs of frame and category: mIoU {:.3}, {:.0}% above \
             0.25, {:.0}% above 0.5.{how} Where other things hide part of an object, its label ends there: with the \
             selection cut likewise, mIoU is {}.",
            s.query_pairs,
            s.query_miou.unwrap_or_default(),
            100.0 * s.query_macc25.unwrap_or_default(),
            100.0 * s.query_macc50.unwrap_or_default(),
            s.query_miou_visible.map_or("–".into(), |v| format!("{v:.3}")),
        ));
        let row = |q: &QueryScore| {
            let cosine = q.score.map_or("–".into(), |c| format!("{c:.3}"));
            let ids = q.selected.iter().map(u32::to_string).collect::<Vec<_>>().join(" ");
            let ids = if ids.is_empty() { "–".into() } else { ids };
            vec![q.text.clone(), format!("{:.3}", q.iou), cosine, ids, q.frames.len().to_string()]
        };
        let rows: Vec<Vec<String>> = s.queries.iter().map(row).collect();
        page.table(&["text", "mean IoU", "cosine", "instances", "frames"], &rows);
    }
}

pub(super) fn training(m: &Material, page: &mut Page, metrics: &mut Metrics) -> Result<()> {
    let mut paths: Vec<PathBuf> = std::fs::read_dir(&m.options.run_dir)
        .at("list", &m.options.run_dir)?
        .flatten()
        .map(|e| e.path())
        .filter(|p| p.to_string_lossy().ends_with(".curve.jsonl"))
        .collect();
    paths.sort();
    let mut charts = Vec::new();
    for path in paths {
        let file = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let stage = file.trim_end_matches(".curve.jsonl");
        let stage = stage.trim_end_matches(".ply").trim_end_matches(".safetensors");
        for mut chart in curve::read(&path)? {
            chart.title = format!("{stage}: {}", chart.title.replace('_', " "));
            charts.push(chart.svg());
        }
    }
    if charts.is_empty() {
        metrics.skipped.push("training curves: the run has no *.curve.jsonl".into());
        return Ok(());
    }
    page.section("training", "Training");
    page.paragraph("Figures against iterations.");
    page.charts(&charts);
    Ok(())
}

pub(super) fn stages(records: &[Run], page: &mut Page) {
    if records.is_empty() {
        return;
    }
    page.section("stages", "Stages");
    let row = |r: &Run| {
        vec![
            r.name(),
            r.output.clone(),
            format!("{:.1}", r.record.wall_seconds),
            r.record.peak_rss_bytes.map_or("–".into(), |b| format!("{:.0}", b as f64 / 1e6)),
            r.record.threads.to_string(),
            r.figures(),
        ]
    };
    let mut rows: Vec<Vec<String>> = records.iter().map(row).collect();
    let total: f64 = runs::seconds(records).values().sum();
    let peak = records.iter().filter_map(|r| r.record.peak_rss_bytes).max();
    rows.push(vec![
        "all".into(),
        String::new(),
        format!("{total:.1}"),
        peak.map_or("–".into(), |b| format!("{:.0}", b as f64 / 1e6)),
        "–".into(),
        String::new(),
    ]);
    page.table(&["stage", "output", "seconds", "peak MB", "threads", "figures"], &rows);
}

pub(super) fn left_out(records: &[Run], page: &mut Page, metrics: &Metrics) {
    let by_stage: Vec<(String, &String)> =
        records.iter().flat_map(|r| r.record.skipped.iter().map(|s| (r.name(), s))).collect();
    if by_stage.is_empty() && metrics.skipped.is_empty() {
        return;
    }
    page.section("skipped", "Left out");
    for reason in &metrics.skipped {
        page.note(reason);
    }
    if !by_stage.is_empty() {
        page.paragraph("Work that stages did not need to do:");
        let rows: Vec<Vec<String>> = by_stage.into_iter().map(|(stage, what)| vec![stage, what.clone()]).collect();
        page.table(&["stage", "skipped"], &rows);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn durations_for_people() {
        assert_eq!(duration(5.25), "5.2 s");
        assert_eq!(duration(119.7), "2 min 00 s");
    }
}
