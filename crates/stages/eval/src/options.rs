//! The options of every command: defaults, ranges and help. The record of a run has them all as `parameters`.

use crate::silhouette::{Rendering, Silhouette};
use clap::builder::{PossibleValuesParser, TypedValueParser};
use gs_io::{Error, Result};
use gs_scene::dataset::Resolution;
use query::{CLIP_TEMPLATES, LERF_NEGATIVES, Share, TextOptions};
use serde::Serialize;
use std::path::PathBuf;

/// The scene and what was found in it.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct Inputs {
    /// Dataset folder (COLMAP, transforms.json, ScanNet or 7-Scenes)
    #[arg(long, value_name = "DIR")]
    pub scene: PathBuf,
    /// The geometry.ply that the instances were made from
    #[arg(long, value_name = "FILE")]
    pub geometry: PathBuf,
    /// instances.safetensors of cluster-match
    #[arg(long, value_name = "FILE")]
    pub instances: PathBuf,
    /// instances.edits.json of explore: what a person corrected and named
    #[arg(long, value_name = "FILE")]
    pub edits: Option<PathBuf>,
}

/// What words are put into.
#[derive(Debug, Clone, Default, clap::Args, Serialize)]
pub struct Templates {
    /// Put every text or name into this template, such as "a photo of a {}"; several templates are averaged; clip for the seven
    /// of CLIP's authors
    #[arg(long, value_name = "TEMPLATE", value_parser = template)]
    template: Vec<String>,
}

impl Templates {
    /// The templates, with those of a named set in its place.
    pub fn all(&self) -> Vec<String> {
        self.template.iter().flat_map(|t| named(t, "clip", &CLIP_TEMPLATES)).collect()
    }
}

/// Which instances answer a text.
#[derive(Debug, Clone, Default, clap::Args, Serialize)]
pub struct Choice {
    /// Select at most this many instances, best first [default: 1, or all with --threshold]
    #[arg(long, value_name = "COUNT", value_parser = stage::at_least(1u32))]
    pub top_k: Option<u32>,
    /// Select only instances whose score is at least this, -1 to 1: the cosine, or with --negatives the relevancy
    #[arg(long, value_name = "SCORE", allow_negative_numbers = true, value_parser = stage::within(-1.0f32..=1.0))]
    pub threshold: Option<f32>,
    /// Score by LERF's relevancy against these texts, with commas between; lerf for its own: object,things,stuff,texture
    #[arg(long, value_delimiter = ',', value_name = "TEXTS", value_parser = words)]
    pub negatives: Vec<String>,
    #[command(flatten)]
    #[serde(flatten)]
    pub templates: Templates,
    /// Also select those of the ten best instances whose mean feature is within this distance of the best one's, as
    /// OpenGaussian does with 0.9
    #[arg(long, value_name = "DISTANCE", requires = "features", value_parser = stage::positive::<f32>)]
    pub join: Option<f32>,
    /// features.safetensors that the instances were clustered from, for --join and in lerf for the rule of OpenGaussian
    #[arg(long, value_name = "FILE")]
    pub features: Option<PathBuf>,
}

impl Choice {
    /// The negatives, with the texts of a named set in its place.
    pub fn negatives(&self) -> Vec<String> {
        self.negatives.iter().flat_map(|n| named(n, "lerf", &LERF_NEGATIVES)).collect()
    }

    /// Whether people say how many instances or which scores are selected.
    pub fn is_decided(&self) -> bool {
        self.top_k.is_some() || self.threshold.is_some()
    }

    /// What differs from "the instance of the highest cosine", in words, for the rule of a score.
    pub fn describe(&self, min_support: Option<u32>) -> String {
        let parts = [
            self.top_k.map(|k| format!("top {k}")),
            self.threshold.map(|t| format!("score at least {t}")),
            min_support.map(|n| format!("matched in at least {n} views")),
            (!self.negatives.is_empty()).then(|| format!("relevancy against {}", self.negatives.join(", "))),
            (!self.templates.template.is_empty()).then(|| format!("templates {}", self.templates.template.join(", "))),
            self.join.map(|d| format!("look-alikes within {d} joined")),
        ];
        parts.into_iter().flatten().map(|part| format!("; {part}")).collect()
    }
}

/// How a selection becomes a mask.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct Masking {
    /// Render the selected Gaussians alone (opacity above 0.7), as OpenGaussian and CAGS score, or count only what is visible of them (half)
    /// [default: visible in query, selected in score and lerf]
    #[arg(long, value_enum)]
    pub silhouette: Option<Silhouette>,
}

impl Masking {
    /// The rule, where `default` is the command's silhouette.
    pub fn rendering(&self, default: Silhouette) -> Rendering {
        match self.silhouette.unwrap_or(default) {
            Silhouette::Selected => Rendering::SELECTED,
            Silhouette::Visible => Rendering::SEEN,
        }
    }
}

/// What pictures show.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct Views {
    /// Views to show, by name, with commas between [default: three; query: in which the selection is seen well; report: of
    /// the held-out ones]
    #[arg(long, value_delimiter = ',', value_name = "NAMES")]
    pub views: Vec<String>,
    /// Size of the pictures: a divisor of the photographs' size, a width such as 640px, or auto for 1600px
    #[arg(long, default_value = "auto")]
    pub resolution: Resolution,
}

/// How coarse the answer to a text or a picture is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Granularity {
    /// The part, the thing or the group of things that fits best; with --top-k, --threshold or --join instances
    Any,
    /// The best instance
    Instance,
    /// What the best instance is a part of: its parent in the tree, with its siblings
    Parent,
    /// The parts of the best instance, each an answer of its own beside it
    Parts,
}

/// The granularities that can be scored: one answer to each text.
fn of_scores() -> impl TypedValueParser<Value = Granularity> {
    let instance = |name: String| if name == "instance" { Granularity::Instance } else { Granularity::Any };
    PossibleValuesParser::new(["any", "instance"]).map(instance)
}

/// `eval query`.
#[derive(Debug, Clone, clap::Args, Serialize)]
#[command(group(clap::ArgGroup::new("asked").required(true).multiple(true).args(["text", "image", "pixel", "point", "interactive"])))]
pub struct QueryOptions {
    #[command(flatten)]
    #[serde(flatten)]
    pub inputs: Inputs,
    #[command(flatten)]
    #[serde(flatten)]
    pub texts: TextOptions,
    #[command(flatten)]
    #[serde(flatten)]
    pub choice: Choice,
    /// What to look for, in words; may be given several times
    #[arg(long, value_name = "WORDS", value_parser = words)]
    pub text: Vec<String>,
    /// A picture of what to look for (needs image.onnx in the --clip folder); may be given several times
    #[arg(long, value_name = "FILE")]
    pub image: Vec<PathBuf>,
    /// What is at this pixel of this view? May be given several times
    #[arg(long, value_name = "VIEW:X,Y")]
    pub pixel: Vec<String>,
    /// What is at this point of the world? May be given several times
    #[arg(long, value_name = "X,Y,Z", allow_hyphen_values = true)]
    pub point: Vec<String>,
    /// What answers a text or a picture
    #[arg(long, value_enum, default_value = "any")]
    pub granularity: Granularity,
    /// Divide all Gaussians among the texts: labels.npy and segmentation.ply
    #[arg(long)]
    pub segment: bool,
    /// Keep everything loaded and read texts from standard input, one a line; with --out each gets a folder in it
    #[arg(long, conflicts_with_all = ["text", "image", "pixel", "point", "segment"])]
    pub interactive: bool,
    #[command(flatten)]
    #[serde(flatten)]
    pub views: Views,
    #[command(flatten)]
    #[serde(flatten)]
    pub masking: Masking,
    /// Output folder
    #[arg(long, value_name = "DIR", required_unless_present = "interactive")]
    pub out: Option<PathBuf>,
}

/// `eval names`.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct NamesOptions {
    /// The geometry.ply that the instances were made from
    #[arg(long, value_name = "FILE")]
    pub geometry: PathBuf,
    /// instances.safetensors of cluster-match
    #[arg(long, value_name = "FILE")]
    pub instances: PathBuf,
    /// instances.edits.json of explore: what a person corrected and named; for the printed table only
    #[arg(long, value_name = "FILE")]
    pub edits: Option<PathBuf>,
    #[command(flatten)]
    #[serde(flatten)]
    pub texts: TextOptions,
    /// Names that things may have: text, one a line, # begins a comment [default: about 1,200 everyday things; with --text-features all
    /// names of the table]
    #[arg(long, value_name = "FILE")]
    pub vocabulary: Option<PathBuf>,
    #[command(flatten)]
    #[serde(flatten)]
    pub templates: Templates,
    /// Output JSON [default: names.json beside the instances, where all programs look for it]
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
}

/// Where labels lie.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct Labels {
    /// Folder of LERF-OVS labels [default: label/ in the scene, or label/<scene>/ beside it]
    #[arg(long, value_name = "DIR")]
    pub labels: Option<PathBuf>,
}

/// `eval score`.
#[derive(Debug, Clone, clap::Args, Serialize)]
#[command(group(clap::ArgGroup::new("scored").required(true).multiple(true).args(["instances", "descriptors"])))]
pub struct ScoreOptions {
    /// Dataset folder (COLMAP, transforms.json, ScanNet or 7-Scenes)
    #[arg(long, value_name = "DIR")]
    pub scene: PathBuf,
    /// The geometry.ply that instances or descriptors were made from
    #[arg(long, value_name = "FILE")]
    pub geometry: PathBuf,
    /// instances.safetensors of cluster-match
    #[arg(long, value_name = "FILE")]
    pub instances: Option<PathBuf>,
    /// instances.edits.json of explore: what a person corrected and named
    #[arg(long, value_name = "FILE", requires = "instances")]
    pub edits: Option<PathBuf>,
    /// Descriptors of single Gaussians (descriptors.safetensors), which then answer the texts: those of at least the --threshold, the
    /// --top-k best, or without both each Gaussian the text that it is most like
    #[arg(long, value_name = "FILE", conflicts_with_all = ["join", "min_support"])]
    pub descriptors: Option<PathBuf>,
    #[command(flatten)]
    #[serde(flatten)]
    pub texts: TextOptions,
    #[command(flatten)]
    #[serde(flatten)]
    pub choice: Choice,
    /// What answers a text
    #[arg(long, value_enum, default_value = "any", value_parser = of_scores())]
    pub granularity: Granularity,
    #[command(flatten)]
    #[serde(flatten)]
    pub labels: Labels,
    #[command(flatten)]
    #[serde(flatten)]
    pub masking: Masking,
    /// Output JSON
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
}

impl ScoreOptions {
    /// The instances with their scene, where there are some.
    pub fn inputs(&self) -> Option<Inputs> {
        let Self { scene, geometry, instances, edits, .. } = self;
        let (scene, geometry, edits) = (scene.clone(), geometry.clone(), edits.clone());
        Some(Inputs { scene, geometry, instances: instances.clone()?, edits })
    }

    /// Which Gaussians with a descriptor answer a text.
    pub fn share(&self) -> Share {
        match (self.choice.threshold, self.choice.top_k) {
            (Some(least), _) => Share::Threshold(least),
            (None, Some(count)) => Share::Most(count as usize),
            (None, None) => Share::MostAlike,
        }
    }
}

/// Where the true masks of labels come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Truth {
    /// Fill the labels' polygons as OpenCV does, corners truncated
    Polygons,
    /// Pictures that LangSplat's scorer made, gt/<frame>/<category>.jpg, above grey level 10
    Pictures,
}

/// Which Gaussians a text selects and which of them are rendered.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Rule {
    /// All Gaussians of the best instance, or of those that the other options choose
    #[value(name = "top1")]
    Top1,
    /// As OpenGaussian's render_lerf_by_text.py: support of 5 views, look-alikes joined, large Gaussians and outliers left
    /// out, nothing where fewer than 100 are left
    #[value(name = "opengaussian")]
    OpenGaussian,
}

impl Rule {
    /// The name it has on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Top1 => "top1",
            Self::OpenGaussian => "opengaussian",
        }
    }
}

/// `eval lerf`.
#[derive(Debug, Clone, clap::Args, Serialize)]
#[command(mut_args(unless_predicted))]
pub struct LerfOptions {
    #[command(flatten)]
    #[serde(flatten)]
    pub inputs: Option<Inputs>,
    /// Score masks that another program saved, <frame>_<category>.png above grey level 10, instead of instances
    #[arg(long, value_name = "DIR", conflicts_with_all = ["scene", "geometry", "instances", "edits"], requires = "labels")]
    pub predictions: Option<PathBuf>,
    /// The rule of the figures. With --features the table has the figures of both
    #[arg(long, value_enum, default_value = "top1", conflicts_with = "predictions")]
    pub protocol: Rule,
    #[command(flatten)]
    #[serde(flatten)]
    pub texts: TextOptions,
    #[command(flatten)]
    #[serde(flatten)]
    pub choice: Choice,
    /// What answers a text by the rule top1
    #[arg(long, value_enum, default_value = "any", value_parser = of_scores())]
    pub granularity: Granularity,
    #[command(flatten)]
    #[serde(flatten)]
    pub labels: Labels,
    /// Where the true masks come from
    #[arg(long, value_enum, default_value = "polygons")]
    pub truth: Truth,
    #[command(flatten)]
    #[serde(flatten)]
    pub masking: Masking,
    /// Save the masks that were scored
    #[arg(long, value_name = "DIR")]
    pub save_predictions: Option<PathBuf>,
    /// Output folder: metrics.json, table.md
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
}

impl LerfOptions {
    /// Refuses what the rule of OpenGaussian fixes, and a want of the features that it needs.
    pub fn check(&self) -> Result<()> {
        if self.protocol == Rule::Top1 {
            return Ok(());
        }
        let (choice, masking) = (&self.choice, &self.masking);
        let fixed = [
            ("--min-support", self.texts.min_support.is_some()),
            ("--top-k", choice.top_k.is_some()),
            ("--threshold", choice.threshold.is_some()),
            ("--negatives", !choice.negatives.is_empty()),
            ("--join", choice.join.is_some()),
            ("--silhouette", masking.silhouette.is_some()),
        ];
        let e = |what: &str, field: &str| Error::new(what).field(field);
        if let Some((option, _)) = fixed.iter().find(|(_, given)| *given) {
            let e = e("--protocol opengaussian fixes it", option);
            return Err(e.hint("leave it out, or use --protocol top1"));
        }
        match self.choice.features {
            None => Err(e("--protocol opengaussian joins look-alikes by their features", "--features")
                .found("none")
                .expected("features.safetensors that the instances were clustered from")),
            Some(_) => Ok(()),
        }
    }
}

/// The inputs are required unless masks or labels of another program are scored.
fn unless_predicted(argument: clap::Arg) -> clap::Arg {
    match argument.get_id().as_str() {
        "scene" | "geometry" | "instances" => argument.required(false).required_unless_present("predictions"),
        _ => argument,
    }
}

/// How Gaussians and the scan's vertices are brought together.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Association {
    /// Gaussian i is vertex i: positions were frozen, nothing was added or removed (OpenGaussian, CAGS)
    OneToOne,
    /// Every vertex takes the class of its nearest Gaussian (GaussianWorld, Split&Splat)
    Nearest,
}

/// `eval scannet`.
#[derive(Debug, Clone, clap::Args, Serialize)]
#[command(mut_args(unless_predicted))]
pub struct ScannetOptions {
    #[command(flatten)]
    #[serde(flatten)]
    pub inputs: Option<Inputs>,
    /// Score labels that another program gave the vertices, instead of instances: a file of one NYU40 id a vertex, .npy or text, 0
    /// for none
    #[arg(long, value_name = "FILE", conflicts_with_all = ["scene", "geometry", "instances", "edits"], requires = "labels")]
    pub predictions: Option<PathBuf>,
    /// Folder of the scan's truth, such as <scan>_vh_clean_2.labels.ply [default: the scene]
    #[arg(long, value_name = "DIR")]
    pub labels: Option<PathBuf>,
    #[command(flatten)]
    #[serde(flatten)]
    pub texts: TextOptions,
    /// How Gaussians and vertices are brought together
    #[arg(long, value_enum, default_value = "one-to-one", conflicts_with = "predictions")]
    pub association: Association,
    /// Output folder: metrics.json, table.md
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
}

/// `eval table`.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct TableOptions {
    /// Folders (or metrics.json files) that eval lerf or eval scannet wrote, one a scene
    #[arg(required = true, value_name = "DIR")]
    pub scenes: Vec<PathBuf>,
    /// Output folder: metrics.json, table.md and table.html of the dataset
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
}

/// How a scene will be scored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Benchmark {
    /// By polygons of LERF-OVS (eval lerf)
    LerfOvs,
    /// By the labelled vertices of a scan (eval scannet)
    Scannet,
}

/// `eval check`.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct CheckOptions {
    /// Dataset folder (COLMAP, transforms.json, ScanNet or 7-Scenes)
    #[arg(long, value_name = "DIR")]
    pub scene: PathBuf,
    /// How the scene will be scored
    #[arg(long, value_enum)]
    pub benchmark: Benchmark,
    /// Folder of id maps (*_s.npy); those of one view are read
    #[arg(long, value_name = "DIR")]
    pub masks: Option<PathBuf>,
    /// Table of text features that will be asked; a CLIP model needs no check, for it takes any words
    #[arg(long, value_name = "FILE")]
    pub text_features: Option<PathBuf>,
    #[command(flatten)]
    #[serde(flatten)]
    pub labels: Labels,
}

/// `eval masks`.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct MasksOptions {
    /// Folder of id maps (*_s.npy)
    #[arg(long, value_name = "DIR")]
    pub masks: PathBuf,
    /// footprints.safetensors of graph-precompute for these masks: also say how many masks are split or merged in the
    /// view that shares most Gaussians
    #[arg(long, value_name = "FILE")]
    pub footprints: Option<PathBuf>,
    /// Output JSON
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
}

/// `eval report`.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct ReportOptions {
    /// Dataset folder (COLMAP, transforms.json, ScanNet or 7-Scenes)
    #[arg(long, value_name = "DIR")]
    pub scene: PathBuf,
    /// Folder of the run, of the common options.
    #[arg(skip)]
    pub run_dir: PathBuf,
    /// The Gaussians of the run
    #[arg(long, value_name = "FILE")]
    pub geometry: PathBuf,
    /// Folder of id maps (*_s.npy) [default: masks/ in the run, or language_features/ in the scene]
    #[arg(long, value_name = "DIR")]
    pub masks: Option<PathBuf>,
    #[command(flatten)]
    #[serde(flatten)]
    pub views: Views,
    #[command(flatten)]
    #[serde(flatten)]
    pub held: stage::HoldoutArgs,
    /// The page; metrics.json is written beside it
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
}

/// A text of an option: CLIP has a feature for no words, too, and it resembles anything.
fn words(text: &str) -> Result<String> {
    if text.trim().is_empty() {
        return Err(Error::new("an empty text").expected("words").hint("leave the option out, or give it words"));
    }
    Ok(text.into())
}

fn template(text: &str) -> Result<String> {
    if text.contains("{}") || text == "clip" {
        return Ok(text.into());
    }
    Err(Error::new("no place for the text").expected("{} in it, or clip"))
}

/// The texts of a set where it is named, else the text itself.
fn named(text: &str, name: &str, set: &[&str]) -> Vec<String> {
    if text == name { set.iter().map(|t| (*t).into()).collect() } else { vec![text.into()] }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_sets_stand_for_their_texts() {
        let negatives = vec!["lerf".into(), "wall".into()];
        let templates = Templates { template: vec!["a {}".into(), "clip".into()] };
        let choice = Choice { negatives, templates, ..Choice::default() };
        assert_eq!(choice.negatives(), ["object", "things", "stuff", "texture", "wall"]);
        let templates = choice.templates.all();
        assert!(templates.len() == 8 && templates.iter().all(|t| template(t).is_ok()));
        assert!(template("clip").is_ok() && template("clips").is_err());
    }
}
