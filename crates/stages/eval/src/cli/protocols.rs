//! `eval lerf`, `eval scannet` and `eval table` on the command line.

use super::{LanguageArgs, SMALLER, SceneArgs, load, mask_threshold, read_scene, words};
use crate::labels;
use crate::lerf::{self, Answers, LerfMetrics, Rendering};
use crate::memory::{self, Sizes};
use crate::protocol::lerf::Averaging;
use crate::protocol::published::SetRow;
use crate::protocol::scannet::{self, Association};
use crate::scan::{self, ScanFiles, ScanMetrics, ScanOptions, Undescribed};
use crate::scene::LabelledScene;
use crate::silhouette::Silhouette;
use artifacts::LerfScene;
use gs_io::{Error, IoContext, Outputs, Result, write_bytes};
use gs_scene::dataset::{Dataset, LoadOptions};
use serde_json::{Value, json};
use stage::Stage;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Queries {
    /// The benchmark's table where the scene is one of the four, else the labels' categories
    Auto,
    /// The benchmark's table; categories that are not in it score 0
    Table,
    /// Every category of the labels
    Labels,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Truth {
    /// Fill the labels' polygons as OpenCV does, corners truncated
    Polygons,
    /// Pictures that LangSplat's scorer made, gt/<frame>/<category>.jpg, above grey level 10
    Pictures,
}

#[derive(Debug, clap::Args)]
pub(super) struct LerfArgs {
    /// instances.safetensors of cluster-match
    #[arg(long, value_name = "FILE", required_unless_present = "predictions")]
    instances: Option<PathBuf>,
    /// The geometry.ply that the instances were made from
    #[arg(long, value_name = "FILE", required_unless_present = "predictions")]
    geometry: Option<PathBuf>,
    /// Dataset folder
    #[arg(long, value_name = "DIR", required_unless_present = "predictions")]
    scene: Option<PathBuf>,
    /// Score masks that a program saved, <frame>_<category>.png above grey level 10, instead of instances
    #[arg(long, value_name = "DIR", conflicts_with_all = ["instances", "geometry", "localisation"], requires = "labels")]
    predictions: Option<PathBuf>,
    #[command(flatten)]
    language: LanguageArgs,
    /// Folder of labels [default: label/ in the scene, or label/<scene>/ beside it]
    #[arg(long, value_name = "DIR")]
    labels: Option<PathBuf>,
    /// Name of the scene [default: that of its folder]
    #[arg(long, value_parser = words)]
    name: Option<String>,
    /// Which texts are asked
    #[arg(long, value_enum, default_value = "auto")]
    queries: Queries,
    /// Where the true masks come from
    #[arg(long, value_enum, default_value = "polygons")]
    truth: Truth,
    /// How IoUs are averaged
    #[arg(long, value_enum, default_value = "objects")]
    averaging: Averaging,
    /// Masks of selections rendered alone (OpenGaussian, CAGS), or as far as visible
    #[arg(long, value_enum, default_value = "selected")]
    rendering: Silhouette,
    /// A pixel belongs to the mask above this [default: 0.7 for selected, 0.5 for visible]
    #[arg(long, value_name = "VALUE")]
    alpha: Option<f32>,
    /// Also score localisation: the most relevant pixel lies in a box of the category
    #[arg(long)]
    localisation: bool,
    /// Save the masks (and relevancy maps) that were scored
    #[arg(long, value_name = "DIR")]
    save_predictions: Option<PathBuf>,
    /// Output folder: metrics.json, table.md, objects.csv, pairs.csv
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

/// `metrics.json` of a protocol, whose record lies beside it, and more files in its folder.
fn protocol_outputs(folder: &Path, more: &[&str], stage: &Stage) -> Outputs {
    let metrics = folder.join("metrics.json");
    stage.outputs(&metrics).file(&metrics).files_in(folder, more)
}

fn folder_name(path: &Path) -> String {
    let full = path.canonicalize().unwrap_or_else(|_| path.to_path_buf());
    full.file_name().map_or("scene".into(), |n| n.to_string_lossy().into_owned())
}

/// Where the labels of a scene lie.
fn labels_folder(given: Option<&Path>, scene: Option<&Path>) -> Result<PathBuf> {
    if let Some(given) = given {
        if given.is_dir() {
            return Ok(given.to_path_buf());
        }
        return Err(Error::new("no such folder").file(given).field("--labels").hint("check the path"));
    }
    let scene = scene.unwrap_or(Path::new("."));
    let inside = scene.join("label");
    let beside = scene.canonicalize().ok().and_then(|s| Some(s.parent()?.join("label").join(s.file_name()?)));
    [Some(inside.clone()), beside].into_iter().flatten().find(|f| f.is_dir()).ok_or_else(|| {
        Error::new("the scene has no labels").file(&inside).expected("a folder of <frame>.json").hint("give --labels")
    })
}

/// A scene that is rendered, rather than read as masks.
struct Rendered {
    scene: LabelledScene,
    dataset: Dataset,
}

/// Refuses what no scene can mend.
pub(super) fn check_lerf(a: &LerfArgs) -> Result<()> {
    mask_threshold(a.alpha, a.rendering)?;
    a.language.selection().map(drop)
}

pub(super) fn run_lerf(a: &LerfArgs, stage: &Stage) -> Result<String> {
    let rendering = Rendering { silhouette: a.rendering, threshold: mask_threshold(a.alpha, a.rendering)? };
    let folder = labels_folder(a.labels.as_deref(), a.scene.as_deref())?;
    let named = a.scene.as_deref().map(folder_name).or_else(|| a.labels.as_deref().map(folder_name));
    let name = a.name.clone().or(named).unwrap_or_else(|| "scene".into());
    let scene = a.scene.as_ref().filter(|_| a.predictions.is_none());
    let dataset = scene.map(|scene| load(scene, &LoadOptions::default(), stage)).transpose()?;
    let outputs = protocol_outputs(&a.out, &["table.md", "objects.csv", "pairs.csv"], stage);
    let outputs = a.save_predictions.iter().fold(outputs, Outputs::folder);
    let mut claim = outputs
        .reads(dataset.iter().flat_map(|d| &d.files))
        .reads(a.instances.iter().chain(&a.geometry).chain(&a.language.text_features).chain(&a.language.features))
        .claim()?;
    let benchmark = LerfScene::named(&name);
    let table = match a.queries {
        Queries::Labels => None,
        Queries::Auto => benchmark,
        Queries::Table => Some(benchmark.ok_or_else(|| {
            Error::new("no benchmark scene has this name")
                .field("--name")
                .found(&name)
                .expected("waldo_kitchen, ramen, figurines or teatime")
                .hint("or --queries labels")
        })?),
    };
    let mut frames = match a.truth {
        Truth::Polygons => labels::read_folder(&folder)?,
        Truth::Pictures => labels::read_pictures(folder.join("gt"))?,
    };
    let mut notes = Vec::new();
    if let Some(b) = benchmark {
        let before = frames.len();
        frames.retain(|f| b.scores_frame(&f.frame));
        if frames.len() != before {
            notes.push(format!(
                "{} labelled frames are none of the benchmark's and are not scored",
                before - frames.len()
            ));
        }
        let pairs: usize = frames.iter().map(|f| f.categories.len()).sum();
        if pairs != b.pairs {
            notes.push(format!(
                "the labels hold {pairs} (frame, category) pairs where the published numbers have {}",
                b.pairs
            ));
        }
    }
    let categories: BTreeSet<String> = frames.iter().flat_map(|f| f.categories.keys().cloned()).collect();
    let mut features = BTreeMap::from([("labels".to_string(), folder_name(&folder))]);
    let mut inputs = BTreeMap::new();
    let mut answers = Answers::new();
    let mut rendered = None;
    let labels = frames.iter().flat_map(|f| f.categories.values()).map(|m| m.bits.len() as u64).sum();
    if let Some(dataset) = dataset {
        let part = |p: &Option<PathBuf>| p.clone().expect("clap asks for it");
        let files = SceneArgs { instances: part(&a.instances), geometry: part(&a.geometry), scene: part(&a.scene) };
        let sizes = Sizes { labels, ..files.sizes(&a.language, &dataset.views) };
        stage.forecast(memory::of_scores(&sizes), SMALLER)?;
        let scene = read_scene(&files.instances, &files.geometry, stage)?;
        let source = a.language.source_for(&scene)?;
        features.insert("text features".into(), format!("{} ({:.12})", source.describe(), source.hash()?));
        features.insert("instances".into(), format!("{:.12}", scene.artifact.hash()));
        if let Some(masks) = scene.artifact.provenance().inputs.get(artifacts::role::MASK_FEATURES) {
            features.insert("mask features".into(), format!("{masks:.12}"));
        }
        scene.check_dataset(&dataset)?;
        if scene.instances.label.iter().all(|&l| l < 0) {
            notes.push("all Gaussians are noise: every query selects nothing".into());
        }
        let asker = a.language.asker(&scene, Some(source))?;
        let texts: Vec<String> = match table {
            Some(t) => t.queries.iter().map(|q| (*q).to_string()).collect(),
            None => categories.iter().cloned().collect(),
        };
        answers = lerf::ask(&asker, &texts, a.localisation)?;
        if let Some(t) = table {
            for category in categories.iter().filter(|c| !t.queries.contains(&c.as_str())) {
                let why = "the category is not in the benchmark's table of queries";
                answers.insert(category.clone(), lerf::Answer::Unasked(why.into()));
            }
        }
        inputs.clone_from(&scene.inputs);
        rendered = Some(Rendered { scene, dataset });
    } else {
        stage.forecast(memory::of_scores(&Sizes { labels, ..Sizes::default() }), "give fewer or smaller labels")?;
    }
    let mut pairs = Vec::new();
    let mut progress = stage.progress("frames", frames.len() as u64);
    for frame in &frames {
        let predictions = match (&rendered, &a.predictions) {
            (Some(r), _) => lerf::predict(&r.scene, &r.dataset, frame, &answers, rendering, a.localisation, &folder)?,
            (None, Some(saved)) => lerf::read_predictions(saved, frame)?,
            (None, None) => Vec::new(),
        };
        if let Some(save) = &a.save_predictions {
            lerf::save_predictions(save, frame, &predictions)?;
        }
        pairs.extend(lerf::pairs(frame, &predictions));
        progress.step();
    }
    progress.finish(&[]);
    let how = match &a.predictions {
        Some(saved) => {
            features.insert("masks".into(), folder_name(saved));
            "saved masks above grey level 10".to_string()
        }
        None => format!("{} rendering above {}", rendering.silhouette.name(), rendering.threshold),
    };
    let truth = match a.truth {
        Truth::Polygons => "polygons filled as cv2.fillPoly does, corners truncated",
        Truth::Pictures => "truth pictures above grey level 10",
    };
    let averaging = match a.averaging {
        Averaging::Objects => "mean over (frame, category) pairs",
        Averaging::Frames => "mean over categories, then frames",
    };
    let asked = match (&a.predictions, table) {
        (Some(_), _) => String::new(),
        (None, Some(_)) => "; the benchmark's queries".into(),
        (None, None) => "; the labels' categories as queries".into(),
    };
    let rule = format!("{how}; {truth}; {averaging}, missing = 0{asked}{}", a.language.describe());
    let metrics = LerfMetrics::new(name, rule, a.averaging, features, pairs, &answers, notes);
    metrics.notes.iter().for_each(|n| stage.warn(n));
    metrics.write(&a.out)?;
    let mut parameters = a.language.parameters();
    parameters["command"] = json!("lerf");
    parameters["rule"] = json!(metrics.rule);
    let summary =
        json!({"figures": metrics.figures, "zeros": metrics.pairs.iter().filter(|p| p.zero.is_some()).count()});
    stage.record(&mut claim, parameters, inputs, summary)?;
    Ok(lerf::sheet(&[metrics]).markdown())
}

#[derive(Debug, clap::Args)]
pub(super) struct ScannetArgs {
    #[command(flatten)]
    scene: SceneArgs,
    #[command(flatten)]
    language: LanguageArgs,
    /// Class sets to score, with commas between
    #[arg(long, value_delimiter = ',', default_values_t = scannet::SETS)]
    classes: Vec<usize>,
    /// How Gaussians and vertices are brought together
    #[arg(long, value_enum, default_value = "one-to-one")]
    association: Association,
    /// Keep Gaussians of opacity below 0.1 in the evaluation (OpenGaussian leaves them out)
    #[arg(long)]
    keep_faint: bool,
    /// What becomes of Gaussians whose instance has no descriptor
    #[arg(long, value_enum, default_value = "first")]
    undescribed: Undescribed,
    /// Labels of true instances that count as no object, with commas between, such as wall,floor,ceiling
    #[arg(long, value_delimiter = ',', value_name = "LABELS", value_parser = words)]
    without: Vec<String>,
    /// Output folder: metrics.json, table.md, objects.csv
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

/// Refuses what no scan can mend.
pub(super) fn check_scannet(a: &ScannetArgs) -> Result<()> {
    if let Some(bad) = a.classes.iter().find(|c| !scannet::SETS.contains(c)) {
        return Err(Error::new("no such class set").field("--classes").found(bad).expected("19, 15 or 10"));
    }
    if !a.language.is_plain() {
        return Err(Error::new("the protocol is the argmax of the plain cosine")
            .field("--negatives, --template, --join, --top-k, --threshold")
            .hint("leave them out"));
    }
    Ok(())
}

pub(super) fn run_scannet(a: &ScannetArgs, stage: &Stage) -> Result<String> {
    let options = ScanOptions {
        association: a.association,
        opacity_rule: !a.keep_faint,
        undescribed: a.undescribed,
        min_support: a.language.min_support.unwrap_or(2),
    };
    let files = ScanFiles::find(&a.scene.scene)?;
    let parts = files.instances.iter().flat_map(|(segments, objects)| [segments, objects]).chain([&files.labels]);
    let mut claim = protocol_outputs(&a.out, &["table.md", "objects.csv"], stage)
        .reads(parts.clone())
        .reads([&a.scene.instances, &a.scene.geometry].into_iter().chain(&a.language.text_features))
        .claim()?;
    let truth = parts.map(|p| memory::bytes(p)).sum();
    stage.forecast(memory::of_scan(&Sizes { truth, ..a.scene.sizes(&a.language, &[]) }), SMALLER)?;
    let scene = read_scene(&a.scene.instances, &a.scene.geometry, stage)?;
    scene.check_dataset(&load(&a.scene.scene, &LoadOptions::default(), stage)?)?;
    let mut features = BTreeMap::from([("instances".to_string(), format!("{:.12}", scene.artifact.hash()))]);
    if let Some(masks) = scene.artifact.provenance().inputs.get(artifacts::role::MASK_FEATURES) {
        features.insert("mask features".into(), format!("{masks:.12}"));
    }
    let given = a.language.clip.is_some() || a.language.text_features.is_some();
    let mut notes = Vec::new();
    let texts = if given {
        let source = a.language.source_for(&scene)?;
        features.insert("text features".into(), format!("{} ({:.12})", source.describe(), source.hash()?));
        let names: Vec<String> = artifacts::NYU40.iter().map(|c| c.1.to_string()).collect();
        let found = source.encode(&names)?;
        let known = |(f, n): (Option<Vec<f32>>, &String)| f.ok_or_else(|| source.unknown(n));
        Some(found.into_iter().zip(&names).map(known).collect::<Result<Vec<_>>>()?)
    } else {
        notes.push("no class scores: neither --clip nor --text-features was given".to_string());
        None
    };
    let (sets, instances, more) = scan::score(&scene, &files, texts.as_deref(), &a.classes, &options, &a.without)?;
    notes.extend(more);
    let metrics = ScanMetrics {
        protocol: ScanMetrics::PROTOCOL.into(),
        scene: folder_name(&a.scene.scene),
        rule: options.describe(),
        features,
        sets,
        instances,
        notes,
    };
    metrics.notes.iter().for_each(|n| stage.warn(n));
    metrics.write(&a.out)?;
    let parameters = json!({"command": "scannet", "rule": metrics.rule, "without": a.without});
    let summary = json!({"rows": metrics.row(), "instances": metrics.instances});
    stage.record(&mut claim, parameters, scene.inputs.clone(), summary)?;
    Ok(scan::sheet(&[metrics]).markdown())
}

#[derive(Debug, clap::Args)]
pub(super) struct TableArgs {
    /// Folders (or metrics.json files) that eval lerf or eval scannet wrote, one a scene
    #[arg(required = true, value_name = "DIR")]
    scenes: Vec<PathBuf>,
    /// Output folder: metrics.json, table.md and table.html of the dataset
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

pub(super) fn run_table(a: &TableArgs, stage: &Stage) -> Result<String> {
    let metrics = a.scenes.iter().map(|given| if given.is_dir() { given.join("metrics.json") } else { given.clone() });
    let mut claim = protocol_outputs(&a.out, &["table.md", "table.html"], stage).reads(metrics).claim()?;
    let mut lerfs = Vec::new();
    let mut scans: Vec<ScanMetrics> = Vec::new();
    let mut names = BTreeSet::new();
    for given in &a.scenes {
        let path = if given.is_dir() { given.join("metrics.json") } else { given.clone() };
        let bytes = std::fs::read(&path).at("read", &path)?;
        let bad = |e: serde_json::Error| {
            Error::new(format!("not metrics of a protocol: {e}"))
                .file(&path)
                .hint("make it with eval lerf or eval scannet")
        };
        let value: Value = serde_json::from_slice(&bytes).map_err(bad)?;
        let scene = match value["protocol"].as_str() {
            Some(LerfMetrics::PROTOCOL) => {
                let m: LerfMetrics = serde_json::from_value(value).map_err(bad)?;
                lerfs.push(m);
                lerfs.last().map(|m| m.scene.clone())
            }
            Some(ScanMetrics::PROTOCOL) => {
                let m: ScanMetrics = serde_json::from_value(value).map_err(bad)?;
                let sound = |s: &scan::SetFigures| s.confusion.classes == s.size && s.confusion.is_sound();
                if !m.sets.iter().all(|s| scannet::SETS.contains(&s.size) && sound(s)) {
                    return Err(Error::new("a confusion matrix does not fit its classes").file(&path).field("sets"));
                }
                scans.push(m);
                scans.last().map(|m| m.scene.clone())
            }
            _ => {
                return Err(Error::new("not metrics of a protocol")
                    .file(&path)
                    .field("protocol")
                    .expected("lerf-ovs or scannet")
                    .hint("make it with eval lerf or eval scannet"));
            }
        };
        let scene = scene.unwrap_or_default();
        if !names.insert(scene.clone()) {
            return Err(Error::new("a scene is given twice").file(&path).field("scene").found(scene));
        }
    }
    if !lerfs.is_empty() && !scans.is_empty() {
        return Err(Error::new("scenes of two protocols").field("DIR").hint("make one table of each"));
    }
    let rules: BTreeSet<&str> =
        lerfs.iter().map(|m| m.rule.as_str()).chain(scans.iter().map(|m| m.rule.as_str())).collect();
    if rules.len() > 1 {
        stage.warn("the scenes were scored by different rules: their mean means little");
    }
    let (sheet, mut json) = if scans.is_empty() {
        let figures: Vec<_> = lerfs.iter().map(|m| m.figures).collect();
        let dataset = crate::protocol::lerf::dataset_figures(&figures);
        let scenes: BTreeMap<&str, _> = lerfs.iter().map(|m| (m.scene.as_str(), m.figures)).collect();
        (lerf::sheet(&lerfs), json!({"protocol": "lerf-ovs dataset", "figures": dataset, "scenes": scenes}))
    } else {
        let [mean, pooled] = scan::summary(&scans).map(|(_, row)| row);
        let sized = |row: SetRow| -> Value {
            let cells = scannet::SETS
                .iter()
                .zip(row)
                .map(|(size, r)| (size.to_string(), json!({"miou": r.map(|r| r.0), "macc": r.map(|r| r.1)})));
            Value::Object(cells.collect())
        };
        let scenes: Vec<&str> = scans.iter().map(|m| m.scene.as_str()).collect();
        let json = json!({
            "protocol": "scannet dataset", "scenes": scenes, "mean_over_scenes": sized(mean), "pooled": sized(pooled),
        });
        (scan::sheet(&scans), json)
    };
    let summary = json.clone();
    json["tables"] = sheet.json();
    let table = sheet.markdown();
    write_bytes(a.out.join("table.md"), table.as_bytes())?;
    write_bytes(a.out.join("table.html"), sheet.html().as_bytes())?;
    let path = a.out.join("metrics.json");
    let bytes = serde_json::to_vec_pretty(&json).map_err(|e| Error::new(e.to_string()).file(&path))?;
    write_bytes(&path, &bytes)?;
    stage.record(&mut claim, json!({"command": "table"}), BTreeMap::new(), summary)?;
    Ok(table)
}
