//! `eval report`: everything about a run on one self-contained page, and its figures in `metrics.json`.
//!
//! Only the scene and the geometry have to be there. Whatever else a run did not make leaves its section out, with a
//! line that says why. `material` reads what there is, `sections` writes the page, with the records of the stages
//! (`runs`).

mod material;
mod metrics;
mod runs;
mod sections;

use self::material::{Material, optional_json};
use self::metrics::{Metrics, QueryFigure};
use self::runs::{Run, grouped};
use crate::memory::{self, Sizes};
use crate::options::ReportOptions;
use crate::scene::{VIEWS, folder_name, load};
use gs_io::{Error, Result, write_bytes, write_json};
use gs_scene::HoldOut;
use gs_scene::dataset::LoadOptions;
use report::html::Page;
use serde_json::{Value, json};
use stage::Stage;
use std::path::{Path, PathBuf};

/// Where explore serves a run unless it is told otherwise.
const EXPLORE: &str = "http://127.0.0.1:7007/";

pub(crate) fn run(o: &ReportOptions, mut parameters: Value, stage: &Stage) -> Result<String> {
    if !o.run_dir.is_dir() {
        return Err(Error::new("no such folder").field("--run-dir").file(&o.run_dir).expected("OUT of a run"));
    }
    let held = HoldOut::of(&o.geometry, o.held.holdout)?;
    parameters["holdout"] = json!(held.every);
    let load_options = LoadOptions { resolution: o.views.resolution, holdout: held.every };
    let mut dataset = load(&o.scene, &load_options, stage)?;
    held.differs(&dataset).iter().for_each(|what| stage.warn(what));
    let sizes = Sizes {
        geometry: memory::bytes_as_ply(&o.geometry),
        features: memory::bytes(&o.run_dir.join("features.safetensors")),
        pixels: memory::pixels(&dataset.views),
        shown: if o.views.views.is_empty() { VIEWS } else { o.views.views.len() } as u64,
        ..Sizes::default()
    };
    stage.forecast(memory::of_report(&sizes), "give a smaller --resolution")?;
    let (out, figures) = (&o.out, o.out.with_file_name("metrics.json"));
    let outputs = stage.outputs(out).file(out).file(&figures);
    let mut claim = outputs.reads(&dataset.files).reads(files(&o.run_dir).chain([o.geometry.clone()])).claim()?;
    let mut metrics = Metrics::default();
    let material = Material::read(&mut dataset, o, &held, masks(o), &mut metrics)?;
    write_bytes(out, write(&material, &mut metrics)?.as_bytes())?;
    write_json(&figures, &metrics)?;
    stage.record(&mut claim, parameters, material.inputs, json!({"left_out": metrics.skipped.len()}))?;
    stage.info(&format!("wrote {}", out.display()));
    Ok(metrics.table())
}

/// The folder of id maps, if there is one.
fn masks(o: &ReportOptions) -> Option<PathBuf> {
    let in_place = [o.run_dir.join("masks"), o.scene.join("language_features")];
    o.masks.clone().or_else(|| in_place.into_iter().find(|m| m.is_dir()))
}

/// Writes the page; gives its text, with the figures in `metrics`.
fn write(material: &Material, metrics: &mut Metrics) -> Result<String> {
    let (dataset, gaussians) = (material.dataset, material.geometry.gaussians.len());
    let records = run_records(material)?;
    metrics.gaussians = gaussians;
    metrics.instances = material.found.as_ref().map(|(instances, _)| instances.len());
    geometry_figures(material, metrics)?;
    metrics.seconds = runs::seconds(&records);
    for r in &records {
        if let Some(bytes) = r.record.peak_rss_bytes {
            let peak = metrics.peak_bytes.entry(r.name()).or_default();
            *peak = bytes.max(*peak);
        }
    }

    let mut page = Page::default();
    page.tiles(&sections::tiles(metrics, dataset));
    if metrics.instances.is_some() {
        let command = format!("explore serve --run-dir {}", material.options.run_dir.display());
        page.link(&format!("To turn the scene, click on things and ask in words, run {command} and open"), EXPLORE);
    }
    sections::photographs(material, &mut page)?;
    sections::id_maps(material, &mut page, metrics)?;
    sections::features(material, &mut page, metrics)?;
    sections::instances(material, &mut page, metrics)?;
    sections::soundness(material, &mut page, metrics)?;
    sections::names(material, &mut page, metrics);
    sections::queries(material, &mut page, metrics)?;
    sections::score_tables(material, &mut page);
    sections::training(material, &mut page, metrics)?;
    sections::stages(&records, &mut page);
    sections::left_out(&records, &mut page, metrics);

    let (width, height) = dataset.views.first().map_or((0, 0), |v| (v.camera.width, v.camera.height));
    let unseen = material.unseen.as_ref().map(|unseen| format!(" ({} held out)", unseen.len()));
    let subtitle = format!(
        "{} photographs{} of {width}x{height} pixels, {} Gaussians",
        dataset.views.len(),
        unseen.unwrap_or_default(),
        grouped(&gaussians.to_string()),
    );
    Ok(page.finish(&folder_name(&material.options.run_dir), &subtitle))
}

/// The files of a run that the page tells of.
fn files(run_dir: &Path) -> impl Iterator<Item = PathBuf> {
    let names = [
        "geometry.ply",
        "geom_metrics.json",
        "geometry.ply.curve.jsonl",
        "graph.safetensors",
        "footprints.safetensors",
        "features.safetensors",
        "features.safetensors.curve.jsonl",
        "instances.safetensors",
        "score.json",
        "names.json",
        "query/query.json",
    ];
    names.map(|name| run_dir.join(name)).into_iter()
}

fn run_records(m: &Material) -> Result<Vec<Run>> {
    let mut folders: Vec<&Path> = vec![&m.options.run_dir, &m.dataset.root];
    folders.extend(m.masks.as_deref());
    runs::read_all(&folders, &m.options.out)
}

/// PSNR and SSIM from `geom_metrics.json`, the output of gs-geom eval.
fn geometry_figures(m: &Material, metrics: &mut Metrics) -> Result<()> {
    match optional_json::<Value>(&m.file("geom_metrics.json"))? {
        Some(v) => {
            let number = |name: &str| v.get(name).and_then(Value::as_f64);
            (metrics.psnr_heldout, metrics.ssim_heldout) = (number("psnr_heldout"), number("ssim_heldout"));
            if metrics.psnr_heldout.is_none() {
                let why = "PSNR and SSIM of held-out views: geom_metrics.json is of views that training saw, or may have seen";
                metrics.skipped.push(why.into());
            }
        }
        None => metrics.skipped.push("PSNR and SSIM: the run has no geom_metrics.json (gs-geom eval makes it)".into()),
    }
    if let Some(s) = &m.scores {
        (metrics.instance_miou, metrics.object_miou) = (s.instance_miou, s.object_miou);
        (metrics.query_miou, metrics.query_miou_visible) = (s.query_miou, s.query_miou_visible);
        metrics.query_macc25 = s.query_macc25;
        metrics.query_count = s.queries.len();
        let figure = |q: &crate::score::QueryScore| QueryFigure { text: q.text.clone(), iou: q.iou, score: q.score };
        metrics.queries = s.queries.iter().map(figure).collect();
    }
    Ok(())
}
