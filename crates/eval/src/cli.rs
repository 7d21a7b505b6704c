//! The command line of `eval`.

use crate::query::{self, QueryOptions};
use crate::ranking::Selection;
use crate::report::{self, ReportOptions};
use crate::scene::LabelledScene;
use crate::score::{self, Scores};
use crate::silhouette::Silhouette;
use crate::text::TextSource;
use clap::{Parser, Subcommand};
use gs_io::{Error, Result, write_bytes};
use gs_scene::dataset::{self, Dataset, LoadOptions, Resolution};
use onnx_models::EngineOptions;
use serde_json::{Value, json};
use stage::{CommonArgs, Program, Stage};
use std::io::Write;
use std::path::{Path, PathBuf};

/// Text queries, evaluation protocols and the report
#[derive(Debug, Parser)]
#[command(name = "eval", version)]
pub struct Args {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    common: CommonArgs,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Find what a text means: ranked instances, a PLY of the selection, pictures, JSON
    Query(QueryArgs),
    /// Score instances and text queries against the truth of the scene
    Score(ScoreArgs),
    /// Make one self-contained HTML page of a run, and metrics.json beside it
    Report(ReportArgs),
}

/// The scene and what was found in it.
#[derive(Debug, clap::Args)]
struct SceneArgs {
    /// instances.safetensors of cluster-match
    #[arg(long, value_name = "FILE")]
    instances: PathBuf,
    /// The geometry.ply that the instances were made from
    #[arg(long, value_name = "FILE")]
    geometry: PathBuf,
    /// Dataset folder (COLMAP, transforms.json or ScanNet)
    #[arg(long, value_name = "DIR")]
    scene: PathBuf,
}

/// Where text features come from, and which instances they select.
#[derive(Debug, clap::Args)]
struct LanguageArgs {
    /// CLIP folder with text.onnx: the other half of the model that encoded the masks
    #[arg(long, value_name = "DIR")]
    clip: Option<PathBuf>,
    /// JSON table of name -> text feature, instead of --clip
    #[arg(long, value_name = "FILE", conflicts_with = "clip")]
    text_features: Option<PathBuf>,
    /// Run ONNX models with this ONNX Runtime library instead of the built-in engine
    #[arg(long, value_name = "FILE")]
    onnx_runtime: Option<PathBuf>,
    /// Select at most this many instances, best first [default: 1, or all with --threshold]
    #[arg(long, value_name = "COUNT")]
    top_k: Option<usize>,
    /// Select only instances whose cosine with the text is at least this
    #[arg(long, value_name = "COSINE", allow_negative_numbers = true)]
    threshold: Option<f32>,
    /// Select only instances that were matched with masks in at least this many views
    #[arg(long, value_name = "VIEWS", default_value_t = 1)]
    min_support: u32,
}

impl LanguageArgs {
    fn selection(&self) -> Result<Selection> {
        if self.top_k == Some(0) {
            return Err(Error::new("selects nothing").field("--top-k").found(0).expected("at least 1"));
        }
        if self.threshold.is_some_and(|t| !t.is_finite()) {
            return Err(Error::new("not a cosine").field("--threshold").expected("a number from -1 to 1"));
        }
        Ok(Selection::new(self.top_k, self.threshold, self.min_support))
    }

    fn source(&self) -> Result<TextSource> {
        let engine = EngineOptions { onnx_runtime: self.onnx_runtime.clone(), ..EngineOptions::default() };
        TextSource::open(self.clip.as_deref(), self.text_features.as_deref(), &engine)
    }
}

#[derive(Debug, clap::Args)]
struct QueryArgs {
    #[command(flatten)]
    scene: SceneArgs,
    #[command(flatten)]
    language: LanguageArgs,
    /// What to look for, in words; may be given several times
    #[arg(long, required = true, value_name = "WORDS")]
    text: Vec<String>,
    /// Views for the pictures, by name, with commas between [default: three in which the selection is seen well]
    #[arg(long, value_delimiter = ',', value_name = "NAMES")]
    views: Vec<String>,
    /// Show the selection as far as it is visible, or rendered alone
    #[arg(long, value_enum, default_value = "visible")]
    silhouette: Silhouette,
    /// A pixel belongs to the mask above this [default: 0.7 for selected, 0.5 for visible]
    #[arg(long, value_name = "VALUE")]
    alpha: Option<f32>,
    /// Size of the pictures: a divisor of the photographs', a width such as 640px, or auto for 1600px
    #[arg(long, default_value = "auto")]
    resolution: Resolution,
    /// Output folder
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

#[derive(Debug, clap::Args)]
struct ScoreArgs {
    #[command(flatten)]
    scene: SceneArgs,
    #[command(flatten)]
    language: LanguageArgs,
    /// Folder of LERF-OVS labels [default: label/ in the scene]
    #[arg(long, value_name = "DIR")]
    labels: Option<PathBuf>,
    /// Masks of selections rendered alone (as OpenGaussian and CAGS score), or as far as visible
    #[arg(long, value_enum, default_value = "selected")]
    silhouette: Silhouette,
    /// A pixel belongs to the mask above this [default: 0.7 for selected, 0.5 for visible]
    #[arg(long, value_name = "VALUE")]
    alpha: Option<f32>,
    /// Output JSON; <out>.things.csv and <out>.queries.csv are written beside it
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

#[derive(Debug, clap::Args)]
struct ReportArgs {
    /// Folder of the run: geometry.ply and whatever else there is under its usual name
    #[arg(long, value_name = "DIR")]
    run_dir: PathBuf,
    /// Dataset folder
    #[arg(long, value_name = "DIR")]
    scene: PathBuf,
    /// Folder of id maps (*_s.npy) [default: masks/ in the run, or language_features/ in the scene]
    #[arg(long, value_name = "DIR")]
    masks: Option<PathBuf>,
    /// Title of the page [default: the scene's folder name]
    #[arg(long)]
    title: Option<String>,
    /// Views to show, by name, with commas between [default: three held-out ones]
    #[arg(long, value_delimiter = ',', value_name = "NAMES")]
    views: Vec<String>,
    /// Size of renders: a divisor of the photographs', a width such as 640px, or auto for 1600px
    #[arg(long, default_value = "auto")]
    resolution: Resolution,
    /// Every which view is held out; 0 for none
    #[arg(long, default_value_t = 8, value_name = "N")]
    holdout: usize,
    /// The page; metrics.json is written beside it
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

impl Program for Args {
    const NAME: &'static str = "eval";

    fn common(&self) -> &CommonArgs {
        &self.common
    }

    fn run(self, stage: &Stage) -> Result<()> {
        let text = match &self.command {
            Command::Query(a) => run_query(a, stage)?,
            Command::Score(a) => run_score(a, stage)?,
            Command::Report(a) => run_report(a, stage)?,
        };
        if !self.common.quiet && !self.common.json {
            // A closed pipe is the reader's choice.
            let _ = std::io::stdout().lock().write_all(text.as_bytes());
        }
        Ok(())
    }
}

fn load(scene: &Path, options: &LoadOptions, stage: &Stage) -> Result<Dataset> {
    let dataset = dataset::load(scene, options)?;
    dataset.warnings.iter().for_each(|w| stage.warn(w));
    Ok(dataset)
}

fn mask_threshold(alpha: Option<f32>, silhouette: Silhouette) -> Result<f32> {
    let value = alpha.unwrap_or(silhouette.default_threshold());
    if (0.0..1.0).contains(&value) {
        return Ok(value);
    }
    Err(Error::new("not an opacity").field("--alpha").found(value).expected("0 to below 1"))
}

fn run_query(a: &QueryArgs, stage: &Stage) -> Result<String> {
    let options = QueryOptions {
        texts: a.text.clone(),
        selection: a.language.selection()?,
        views: a.views.clone(),
        silhouette: a.silhouette,
        threshold: mask_threshold(a.alpha, a.silhouette)?,
    };
    let scene = LabelledScene::read(&a.scene.instances, &a.scene.geometry)?;
    let source = a.language.source()?;
    source.check_dim(scene.instances.dim, scene.path())?;
    let dataset = load(&a.scene.scene, &LoadOptions { resolution: a.resolution, ..LoadOptions::default() }, stage)?;
    scene.check_dataset(&dataset)?;
    let results = query::run(&scene, &dataset, &source, &options, &a.out)?;
    for q in results.queries.iter().filter(|q| q.selected.is_empty()) {
        stage.warn(&format!("no instance passes for {:?}: nothing is selected", q.text));
    }
    let parameters = json!({
        "command": "query", "texts": a.text, "top_k": a.language.top_k, "threshold": a.language.threshold,
        "min_support": a.language.min_support, "alpha": options.threshold,
    });
    let summary = json!({"texts": results.queries.len(), "instances": results.instances});
    stage.record(a.out.join("query.json"), parameters, scene.inputs.clone(), summary)?;
    Ok(query::table(&results, 5))
}

fn run_score(a: &ScoreArgs, stage: &Stage) -> Result<String> {
    let selection = a.language.selection()?;
    let threshold = mask_threshold(a.alpha, a.silhouette)?;
    let scene = LabelledScene::read(&a.scene.instances, &a.scene.geometry)?;
    let mut scores = Scores::default();
    let dataset = load(&a.scene.scene, &LoadOptions::default(), stage)?;
    scene.check_dataset(&dataset)?;
    score::score_instances(&scene, &dataset.root, &mut scores)?;
    let labels = a.labels.clone().unwrap_or_else(|| dataset.root.join("label"));
    let no_source = a.language.clip.is_none() && a.language.text_features.is_none();
    if !labels.is_dir() {
        if a.labels.is_some() {
            return Err(Error::new("no such folder").file(&labels).field("--labels").hint("check the path"));
        }
        scores.skipped.push(format!("query scores: the scene has no {}", labels.display()));
    } else if scene.instances.dim == 0 {
        let why = "query scores: the instances have no language features, because the masks were not encoded with a \
                   CLIP model (mask-embed --clip)";
        scores.skipped.push(why.into());
    } else if no_source {
        scores.skipped.push("query scores: neither --clip nor --text-features was given".into());
    } else {
        let source = a.language.source()?;
        let (silhouette, mut warn) = (a.silhouette, |w: &str| stage.warn(w));
        score::score_queries(
            &scene,
            &dataset,
            &labels,
            &source,
            &selection,
            silhouette,
            threshold,
            &mut scores,
            &mut warn,
        )?;
    }
    scores.skipped.iter().for_each(|s| stage.skipped(s));
    let json = serde_json::to_vec_pretty(&scores).map_err(|e| Error::new(e.to_string()).file(&a.out))?;
    let (things, queries) = score::csv(&scores);
    let beside = |suffix: &str| a.out.with_extension(suffix);
    write_bytes(beside("things.csv"), things.as_bytes())?;
    write_bytes(beside("queries.csv"), queries.as_bytes())?;
    write_bytes(&a.out, &json)?;
    let parameters = json!({
        "command": "score", "top_k": a.language.top_k, "threshold": a.language.threshold,
        "min_support": a.language.min_support, "alpha": threshold,
    });
    let figure = |v: Option<f64>| v.map_or(Value::Null, Value::from);
    let summary = json!({
        "instance_miou": figure(scores.instance_miou), "query_miou": figure(scores.query_miou),
        "query_pairs": scores.query_pairs,
    });
    stage.record(&a.out, parameters, scene.inputs.clone(), summary)?;
    Ok(score::table(&scores))
}

fn run_report(a: &ReportArgs, stage: &Stage) -> Result<String> {
    let dataset = load(&a.scene, &LoadOptions { resolution: a.resolution, holdout: a.holdout }, stage)?;
    let in_place = [a.run_dir.join("masks"), dataset.root.join("language_features")];
    let masks = a.masks.clone().or_else(|| in_place.into_iter().find(|m| m.is_dir()));
    let name = || {
        let folder = dataset.root.canonicalize().unwrap_or_else(|_| dataset.root.clone());
        folder.file_name().map_or("scene".into(), |n| n.to_string_lossy().into_owned())
    };
    let options = ReportOptions {
        run_dir: a.run_dir.clone(),
        masks,
        title: a.title.clone().unwrap_or_else(name),
        out: a.out.clone(),
        views: a.views.clone(),
    };
    let mut inputs = std::collections::BTreeMap::new();
    let metrics = report::run(&dataset, &options, &mut inputs)?;
    stage.record(&a.out, json!({"command": "report"}), inputs, json!({"left_out": metrics.skipped.len()}))?;
    stage.info(&format!("wrote {}", a.out.display()));
    Ok(report::table(&metrics))
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_command_line_is_sound() {
        Args::command().debug_assert();
    }
}
