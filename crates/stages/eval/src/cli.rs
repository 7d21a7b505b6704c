//! The command line of `eval`.

mod ablation;
mod masks;
mod protocols;
mod query;

use crate::ask::Asker;
use crate::labels;
use crate::lerf::Rendering;
use crate::memory::{self, Sizes};
use crate::ranking::{Index, Join, Scoring, Selection};
use crate::report::{self, ReportOptions};
use crate::scene::LabelledScene;
use crate::score::{self, Scores};
use crate::silhouette::Silhouette;
use crate::text::TextSource;
use artifacts::{Features, role};
use clap::{Parser, Subcommand};
use gs_io::{Error, Result, Watched, write_bytes};
use gs_scene::dataset::{self, Dataset, LoadOptions, Resolution, View};
use onnx_models::{ClipImage, EngineOptions};
use serde_json::{Value, json};
use stage::{CommonArgs, Program, Stage};
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
    Query(query::QueryArgs),
    /// Score a scene of LERF-OVS: objects selected in 3D by their names
    Lerf(protocols::LerfArgs),
    /// Score a ScanNet scan: classes of its vertices, class-agnostic instances
    Scannet(protocols::ScannetArgs),
    /// Bring the metrics of several scenes together in the paper's table
    Table(protocols::TableArgs),
    /// Score instances and text queries against the truth of the scene
    Score(ScoreArgs),
    /// Measure id maps: how many, how large, and how often one view splits or merges what another shows
    Masks(masks::MasksArgs),
    /// Make one self-contained HTML page of a run, and metrics.json beside it
    Report(ReportArgs),
    /// Bring the scores of an ablation together: tables as JSON, Markdown and HTML
    Ablation(ablation::AblationArgs),
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

impl SceneArgs {
    /// The files that are read of this scene and of a model of texts.
    fn files(&self, dataset: &Dataset, language: &LanguageArgs) -> impl Iterator<Item = PathBuf> {
        let own = [self.instances.clone(), self.geometry.clone()];
        let texts = [&language.text_features, &language.features].into_iter().flatten().cloned().collect::<Vec<_>>();
        dataset.files.iter().cloned().chain(own).chain(texts)
    }

    /// What is known of the memory that this scene takes, before it is read.
    fn sizes(&self, language: &LanguageArgs, views: &[View]) -> Sizes {
        Sizes {
            geometry: memory::bytes(&self.geometry),
            language: memory::language(language.clip.as_deref(), language.text_features.as_deref()),
            pixels: memory::pixels(views),
            ..Sizes::default()
        }
    }
}

/// The value of an option that takes a text: CLIP has a feature for no words, too, and it resembles anything.
fn words(text: &str) -> Result<String> {
    if text.trim().is_empty() {
        return Err(Error::new("an empty text").expected("words").hint("leave the option out, or give it words"));
    }
    Ok(text.into())
}

/// What takes less memory.
const SMALLER: &str = "give a smaller geometry (gs-geom train --max-gaussians) or smaller pictures";

/// Where text features come from, and which instances they select.
#[derive(Debug, clap::Args)]
struct LanguageArgs {
    /// CLIP folder with text.onnx: the other half of the model that encoded the masks
    #[arg(long, value_name = "DIR")]
    clip: Option<PathBuf>,
    /// Table of name -> text feature, JSON or npz, instead of --clip
    #[arg(long, value_name = "FILE", conflicts_with = "clip")]
    text_features: Option<PathBuf>,
    /// Take another CLIP model than the one that encoded the masks, if its features have the same dimension
    #[arg(long, requires = "clip")]
    any_model: bool,
    /// Run ONNX models with this ONNX Runtime library instead of the built-in engine
    #[arg(long, value_name = "FILE")]
    onnx_runtime: Option<PathBuf>,
    /// Select at most this many instances, best first [default: 1, or all with --threshold]
    #[arg(long, value_name = "COUNT")]
    top_k: Option<usize>,
    /// Select only instances whose score is at least this: the cosine, or with --negatives the relevancy
    #[arg(long, value_name = "SCORE", allow_negative_numbers = true)]
    threshold: Option<f32>,
    /// Select only instances that were matched with masks in at least this many views [default: 1; scannet: 2]
    #[arg(long, value_name = "VIEWS")]
    min_support: Option<u32>,
    /// Score by LERF's relevancy against these texts, with commas between, such as object,things,stuff,texture
    #[arg(long, value_delimiter = ',', value_name = "TEXTS", value_parser = words)]
    negatives: Vec<String>,
    /// Put every text into this template, such as "a photo of a {}"; several are averaged
    #[arg(long, value_name = "TEMPLATE")]
    template: Vec<String>,
    /// Select look-alikes too: of the ten best those whose mean feature is within this of the best's (OpenGaussian: 0.9)
    #[arg(long, value_name = "DISTANCE", requires = "features")]
    join: Option<f32>,
    /// Join only instances that lie below one parent in the tree of clusters, as OpenGaussian does below a coarse cluster
    #[arg(long, requires = "join")]
    join_siblings: bool,
    /// features.safetensors that the instances were clustered from, for --join
    #[arg(long, value_name = "FILE")]
    features: Option<PathBuf>,
}

impl LanguageArgs {
    fn selection(&self) -> Result<Selection> {
        if self.top_k == Some(0) {
            return Err(Error::new("selects nothing").field("--top-k").found(0).expected("at least 1"));
        }
        if self.threshold.is_some_and(|t| !t.is_finite()) {
            return Err(Error::new("not a score").field("--threshold").expected("a number from -1 to 1"));
        }
        if self.join.is_some_and(|d| !(d.is_finite() && d > 0.0)) {
            return Err(Error::new("not a distance").field("--join").expected("a number above 0, such as 0.9"));
        }
        if let Some(t) = self.template.iter().find(|t| !t.contains("{}")) {
            return Err(Error::new("no place for the text").field("--template").found(t).expected("{} in it"));
        }
        Ok(Selection::new(self.top_k, self.threshold, self.min_support.unwrap_or(1)))
    }

    /// Whether nothing but the source and the support is chosen.
    fn is_plain(&self) -> bool {
        let selects = self.top_k.is_some() || self.threshold.is_some() || self.join.is_some();
        !selects && self.negatives.is_empty() && self.template.is_empty()
    }

    fn engine(&self) -> EngineOptions {
        EngineOptions { onnx_runtime: self.onnx_runtime.clone(), ..EngineOptions::default() }
    }

    fn source(&self) -> Result<TextSource> {
        TextSource::open(self.clip.as_deref(), self.text_features.as_deref(), &self.engine())
    }

    /// The source, which must fit the descriptors of a scene.
    fn source_for(&self, scene: &LabelledScene) -> Result<TextSource> {
        let source = self.source()?;
        self.check_fits(&source, scene)?;
        Ok(source)
    }

    /// Checks that a source has the descriptors' dimension, and that a CLIP pair is the one whose other half encoded the masks,
    /// as far as the instances know it.
    fn check_fits(&self, source: &TextSource, scene: &LabelledScene) -> Result<()> {
        source.check_dim(scene.instances.dim, scene.path())?;
        let Some(clip) = self.clip.as_deref().filter(|_| !self.any_model) else { return Ok(()) };
        let made_with = |role: &str| scene.artifact.provenance().inputs.get(role).cloned();
        let (image, text) = (made_with(role::CLIP), made_with(role::CLIP_TEXT));
        let unknown = image.is_none() && text.is_none();
        // The text encoder is open, and has its hash already; the image encoder is read only where that does not tell.
        if unknown || text == Some(source.hash()?) || image.is_some() && image == ClipImage::hash_in(clip) {
            return Ok(());
        }
        Err(Error::new("another CLIP model than the one that encoded the masks")
            .file(clip)
            .field("--clip")
            .expected(format!("the model that {} was made with", scene.path().display()))
            .hint("give that model, run mask-embed embed and cluster-match with this one, or take it as it is with --any-model"))
    }

    /// What answers queries about a scene.
    fn asker<'a>(&self, scene: &'a LabelledScene, source: Option<TextSource>) -> Result<Asker<'a>> {
        let selection = self.selection()?;
        let join = match (&self.features, self.join) {
            (Some(path), Some(distance)) => {
                let (features, artifact) = Features::read(path)?;
                let geometry = scene.inputs.get(role::GEOMETRY).map_or("", |h| h);
                artifact.expect_input(role::GEOMETRY, geometry)?;
                if features.kept.last().is_some_and(|&last| last as usize >= scene.instances.label.len()) {
                    return Err(Error::new("the features are of other Gaussians").file(path).field("kept"));
                }
                Some(Join::new(&scene.instances, &features, distance, self.join_siblings))
            }
            _ => None,
        };
        let negatives = match &source {
            Some(source) => {
                let known =
                    |(f, n): (Option<Vec<f32>>, &String)| f.ok_or_else(|| source.unknown(n).field("--negatives"));
                source.encode(&self.negatives)?.into_iter().zip(&self.negatives).map(known).collect::<Result<_>>()?
            }
            None => Vec::new(),
        };
        let (index, templates) = (Index::new(&scene.instances), self.template.clone());
        Ok(Asker { index, source, templates, scoring: Scoring { negatives }, selection, join })
    }

    fn parameters(&self) -> Value {
        json!({
            "top_k": self.top_k, "threshold": self.threshold, "min_support": self.min_support.unwrap_or(1),
            "negatives": self.negatives, "templates": self.template, "join": self.join, "join_siblings": self.join_siblings,
        })
    }

    /// What deviates from "the instance of the best cosine", in words, for the rule of a score.
    fn describe(&self) -> String {
        let mut s = String::new();
        if let Some(k) = self.top_k {
            s += &format!("; top {k}");
        }
        if let Some(t) = self.threshold {
            s += &format!("; score at least {t}");
        }
        if let Some(n) = self.min_support {
            s += &format!("; matched in at least {n} views");
        }
        if !self.negatives.is_empty() {
            s += &format!("; relevancy against {}", self.negatives.join(", "));
        }
        if !self.template.is_empty() {
            s += &format!("; templates {}", self.template.join(", "));
        }
        if let Some(d) = self.join {
            s += &format!(
                "; look-alikes within {d} joined{}",
                if self.join_siblings { " below one parent" } else { "" }
            );
        }
        s
    }
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
    /// The Gaussians, where they are not in the run [default: geometry.ply there]
    #[arg(long, value_name = "FILE")]
    geometry: Option<PathBuf>,
    /// Dataset folder
    #[arg(long, value_name = "DIR")]
    scene: PathBuf,
    /// Folder of id maps (*_s.npy) [default: masks/ in the run, or language_features/ in the scene]
    #[arg(long, value_name = "DIR")]
    masks: Option<PathBuf>,
    /// Title of the page [default: the scene's folder name]
    #[arg(long, value_parser = words)]
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
    /// Show the tables of an ablation too: the output folder of eval ablation
    #[arg(long, value_name = "DIR")]
    ablation: Option<PathBuf>,
    /// The page; metrics.json is written beside it
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
}

impl Program for Args {
    const NAME: &'static str = "eval";

    fn common(&self) -> &CommonArgs {
        &self.common
    }

    fn forecasts(&self) -> bool {
        !matches!(self.command, Command::Table(_) | Command::Masks(_) | Command::Ablation(_))
    }

    fn check(&self) -> Result<()> {
        match &self.command {
            Command::Query(a) => query::check(a),
            Command::Lerf(a) => protocols::check_lerf(a),
            Command::Scannet(a) => protocols::check_scannet(a),
            Command::Score(a) => {
                mask_threshold(a.alpha, a.silhouette)?;
                a.language.selection().map(drop)
            }
            Command::Table(_) | Command::Masks(_) | Command::Report(_) | Command::Ablation(_) => Ok(()),
        }
    }

    fn run(self, stage: &Stage) -> Result<()> {
        let text = match &self.command {
            Command::Query(a) => query::run(a, stage, self.common.json)?,
            Command::Lerf(a) => protocols::run_lerf(a, stage)?,
            Command::Scannet(a) => protocols::run_scannet(a, stage)?,
            Command::Table(a) => protocols::run_table(a, stage)?,
            Command::Score(a) => run_score(a, stage)?,
            Command::Masks(a) => masks::run(a, stage)?,
            Command::Report(a) => run_report(a, stage)?,
            Command::Ablation(a) => ablation::run(a, stage)?,
        };
        if !self.common.quiet && !self.common.json {
            stage.print(&text)?;
        }
        Ok(())
    }
}

fn load(scene: &Path, options: &LoadOptions, stage: &Stage) -> Result<Dataset> {
    let dataset = dataset::load(scene, options)?;
    dataset.warnings.iter().for_each(|w| stage.warn(w));
    Ok(dataset)
}

/// Reads instances and geometry; damaged Gaussians are said.
fn read_scene(instances: &Path, geometry: &Path, stage: &Stage) -> Result<LabelledScene> {
    let scene = LabelledScene::read(instances, geometry)?;
    if let Some(damage) = scene.geometry.damage() {
        stage.skipped(&damage);
    }
    Ok(scene)
}

fn mask_threshold(alpha: Option<f32>, silhouette: Silhouette) -> Result<f32> {
    let value = alpha.unwrap_or(silhouette.default_threshold());
    if (0.0..1.0).contains(&value) {
        return Ok(value);
    }
    Err(Error::new("not an opacity").field("--alpha").found(value).expected("0 to below 1"))
}

fn run_score(a: &ScoreArgs, stage: &Stage) -> Result<String> {
    let threshold = mask_threshold(a.alpha, a.silhouette)?;
    let dataset = load(&a.scene.scene, &LoadOptions::default(), stage)?;
    let labels = a.labels.clone().unwrap_or_else(|| dataset.root.join("label"));
    let mut claim = stage
        .outputs(&a.out)
        .files([a.out.clone(), a.out.with_extension("things.csv"), a.out.with_extension("queries.csv")])
        .reads(a.scene.files(&dataset, &a.language))
        .claim()?;
    let sizes = Sizes {
        truth: memory::bytes(&dataset.root.join("truth/points.safetensors")),
        labels: labels::pixels(&labels),
        ..a.scene.sizes(&a.language, &dataset.views)
    };
    stage.forecast(memory::of_scores(&sizes), SMALLER)?;
    let scene = read_scene(&a.scene.instances, &a.scene.geometry, stage)?;
    if scene.instances.label.iter().all(|&l| l < 0) {
        stage.warn("all Gaussians are noise: every score is 0");
    }
    let mut scores = Scores::default();
    scene.check_dataset(&dataset)?;
    score::score_instances(&scene, &dataset.root, &mut scores)?;
    let watched = if labels.is_dir() { labels::watch_folder(&labels)? } else { Watched::default() };
    let no_source = a.language.clip.is_none() && a.language.text_features.is_none();
    if !labels.is_dir() {
        if a.labels.is_some() {
            return Err(Error::new("no such folder").file(&labels).field("--labels").hint("check the path"));
        }
        scores.skipped.push(format!("label and query scores: the scene has no {}", labels.display()));
    } else {
        score::score_labels(&scene, &dataset, &labels, &mut scores)?;
    }
    if !labels.is_dir() {
        // Said above.
    } else if scene.instances.dim == 0 {
        let why = "query scores: the instances have no language features, because the masks were not encoded with a \
                   CLIP model (mask-embed embed --clip)";
        scores.skipped.push(why.into());
    } else if no_source {
        scores.skipped.push("query scores: neither --clip nor --text-features was given".into());
    } else {
        let source = a.language.source_for(&scene)?;
        let asker = a.language.asker(&scene, Some(source))?;
        let rendering = Rendering { silhouette: a.silhouette, threshold };
        score::score_queries(&scene, &dataset, &labels, &asker, rendering, &mut scores, &mut |w| stage.warn(w))?;
    }
    watched.check()?;
    scores.skipped.iter().for_each(|s| stage.skipped(s));
    let json = serde_json::to_vec_pretty(&scores).map_err(|e| Error::new(e.to_string()).file(&a.out))?;
    let (things, queries) = score::csv(&scores);
    let beside = |suffix: &str| a.out.with_extension(suffix);
    write_bytes(beside("things.csv"), things.as_bytes())?;
    write_bytes(beside("queries.csv"), queries.as_bytes())?;
    write_bytes(&a.out, &json)?;
    let mut parameters = a.language.parameters();
    parameters["command"] = json!("score");
    parameters["alpha"] = json!(threshold);
    let figure = |v: Option<f64>| v.map_or(Value::Null, Value::from);
    let summary = json!({
        "instance_miou": figure(scores.instance_miou), "label_miou": figure(scores.label_miou), "query_miou": figure(scores.query_miou),
        "query_pairs": scores.query_pairs,
    });
    stage.record(&mut claim, parameters, scene.inputs.clone(), summary)?;
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
        geometry: a.geometry.clone().unwrap_or_else(|| a.run_dir.join("geometry.ply")),
        masks,
        title: a.title.clone().unwrap_or_else(name),
        out: a.out.clone(),
        views: a.views.clone(),
        ablation: a.ablation.clone(),
    };
    let sizes = Sizes {
        geometry: memory::bytes(&options.geometry),
        features: memory::bytes(&a.run_dir.join("features.safetensors")),
        pixels: memory::pixels(&dataset.views),
        ..Sizes::default()
    };
    stage.forecast(memory::of_report(&sizes), "give a smaller --resolution")?;
    let outputs = stage.outputs(&a.out).file(&a.out).file(report::metrics_path(&options));
    let reads = report::files(&a.run_dir).chain([options.geometry.clone()]);
    let mut claim = outputs.reads(&dataset.files).reads(reads).claim()?;
    let mut inputs = std::collections::BTreeMap::new();
    let metrics = report::run(&dataset, &options, &mut inputs)?;
    stage.record(&mut claim, json!({"command": "report"}), inputs, json!({"left_out": metrics.skipped.len()}))?;
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
