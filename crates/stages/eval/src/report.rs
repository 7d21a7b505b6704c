//! `eval report`: everything about a run on one self-contained page, and its figures in `metrics.json`.
//!
//! Only the scene and the geometry have to be there. Whatever else a run did not make leaves its section out, with a
//! line that says why.

mod material;
mod sections;

use self::material::{Material, optional_json};
use crate::ablation::{self, Table};
use crate::runs::{self, Run, grouped};
use ::report::html::Page;
use gs_io::{Error, Result, write_bytes};
use gs_scene::dataset::{Dataset, Split};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Where a run lies, and what its report is called.
pub struct ReportOptions {
    /// Folder of the run's artifacts, under their usual names.
    pub run_dir: PathBuf,
    /// The Gaussians, which may lie elsewhere.
    pub geometry: PathBuf,
    /// Folder of id maps, if there are any.
    pub masks: Option<PathBuf>,
    /// Title of the page.
    pub title: String,
    /// The page.
    pub out: PathBuf,
    /// Names of views to show; empty: a few held-out ones.
    pub views: Vec<String>,
    /// Folder of an ablation's tables, to show them too.
    pub ablation: Option<PathBuf>,
}

/// `metrics.json`: the figures of a run in one place. Null where the run has none.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Metrics {
    /// Mean PSNR over held-out views, dB.
    pub psnr_heldout: Option<f64>,
    /// Mean SSIM over held-out views.
    pub ssim_heldout: Option<f64>,
    /// Class-agnostic instance mIoU over all true things.
    pub instance_miou: Option<f64>,
    /// The same over objects only.
    pub object_miou: Option<f64>,
    /// Mean IoU of text queries over (frame, category) pairs.
    pub query_miou: Option<f64>,
    /// The same when only what a view shows of a selection counts (occlusion-aware).
    pub query_miou_visible: Option<f64>,
    /// Fraction of those pairs above IoU 0.25.
    pub query_macc25: Option<f64>,
    /// Number of different queries that were scored.
    pub query_count: usize,
    /// Each scored query, its mean IoU over frames and the cosine of its best instance.
    pub queries: Vec<QueryFigure>,
    /// Number of Gaussians.
    pub gaussians: usize,
    /// Number of instances.
    pub instances: Option<usize>,
    /// Wall-clock seconds by stage.
    pub seconds: BTreeMap<String, f64>,
    /// Peak memory in bytes by stage, where the system tells.
    pub peak_bytes: BTreeMap<String, u64>,
    /// What was left out, and why.
    pub skipped: Vec<String>,
}

/// A scored query in `metrics.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct QueryFigure {
    /// The text.
    pub text: String,
    /// Mean IoU over labelled frames.
    pub iou: f64,
    /// Cosine of the best instance.
    pub score: Option<f32>,
}

/// Makes the page and `metrics.json` beside it.
///
/// # Errors
/// When the geometry is missing, something that is there is damaged or belongs to another scene, or an output cannot be
/// written.
pub fn run(dataset: &Dataset, options: &ReportOptions, inputs: &mut BTreeMap<String, String>) -> Result<Metrics> {
    let mut metrics = Metrics::default();
    let material = Material::read(dataset, options, &mut metrics, inputs)?;
    let records = run_records(&material)?;
    metrics.gaussians = material.gaussians().len();
    metrics.instances = material.labelled().map(|l| l.instances.len());
    geometry_figures(&material, &mut metrics)?;
    metrics.seconds = runs::seconds(&records);
    for r in &records {
        if let Some(bytes) = r.record.peak_rss_bytes {
            let peak = metrics.peak_bytes.entry(r.name()).or_default();
            *peak = bytes.max(*peak);
        }
    }

    let mut page = Page::default();
    page.tiles(&sections::tiles(&metrics, dataset));
    sections::photographs(&material, &mut page)?;
    sections::id_maps(&material, &mut page, &mut metrics)?;
    sections::features(&material, &mut page, &mut metrics)?;
    sections::instances(&material, &mut page, &mut metrics)?;
    sections::queries(&material, &mut page, &mut metrics)?;
    sections::score_tables(&material, &mut page);
    if let Some(folder) = &options.ablation {
        ablation::sections(&mut page, &Table::read_all(folder)?);
    }
    sections::training(&material, &mut page, &mut metrics)?;
    sections::stages(&records, &mut page);
    sections::left_out(&records, &mut page, &metrics);

    let subtitle = format!(
        "{} photographs ({} held out) of {}x{} pixels, {} Gaussians",
        dataset.views.len(),
        dataset.views.iter().filter(|v| v.split == Split::Test).count(),
        dataset.views.first().map_or(0, |v| v.camera.width),
        dataset.views.first().map_or(0, |v| v.camera.height),
        grouped(&material.gaussians().len().to_string()),
    );
    let path = metrics_path(options);
    let json = serde_json::to_vec_pretty(&metrics).map_err(|e| Error::new(e.to_string()).file(&path))?;
    write_bytes(&options.out, page.finish(&options.title, &subtitle).as_bytes())?;
    write_bytes(&path, &json)?;
    Ok(metrics)
}

/// The files of a run that the page tells of.
pub fn files(run_dir: &Path) -> impl Iterator<Item = PathBuf> {
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
        "query/query.json",
    ];
    names.map(|name| run_dir.join(name)).into_iter()
}

/// `metrics.json` beside the page.
pub fn metrics_path(options: &ReportOptions) -> PathBuf {
    options.out.with_file_name("metrics.json")
}

fn run_records(m: &Material) -> Result<Vec<Run>> {
    let mut folders: Vec<&Path> = vec![&m.options.run_dir, &m.dataset.root];
    folders.extend(m.options.masks.as_deref());
    runs::read_all(&folders, &m.options.out)
}

/// PSNR and SSIM from `geom_metrics.json`, the output of gs-geom eval.
fn geometry_figures(m: &Material, metrics: &mut Metrics) -> Result<()> {
    match optional_json::<Value>(&m.file("geom_metrics.json"))? {
        Some(v) => {
            let number = |names: [&str; 2]| names.iter().find_map(|n| v.get(n).and_then(Value::as_f64));
            metrics.psnr_heldout = number(["psnr_heldout", "psnr"]);
            metrics.ssim_heldout = number(["ssim_heldout", "ssim"]);
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

/// The figures as a table for the terminal.
pub fn table(metrics: &Metrics) -> String {
    let mut s = String::new();
    let mut line = |name: &str, value: Option<String>| {
        s += &format!("{name:<16} {}\n", value.unwrap_or_else(|| "–".into()));
    };
    let number = |v: Option<f64>| v.map(|v| format!("{v:.4}"));
    line("psnr_heldout", metrics.psnr_heldout.map(|v| format!("{v:.2} dB")));
    line("ssim_heldout", number(metrics.ssim_heldout));
    line("instance_miou", number(metrics.instance_miou));
    line("query_miou", number(metrics.query_miou));
    line("  visible only", number(metrics.query_miou_visible));
    line("queries scored", Some(metrics.query_count.to_string()));
    line("gaussians", Some(metrics.gaussians.to_string()));
    line("instances", metrics.instances.map(|n| n.to_string()));
    for (stage, seconds) in &metrics.seconds {
        line(stage, Some(format!("{seconds:.1} s")));
    }
    for reason in &metrics.skipped {
        s += &format!("left out         {reason}\n");
    }
    s
}
