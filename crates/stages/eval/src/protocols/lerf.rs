//! `eval lerf`: a scene of LERF-OVS, or any scene with such labels.

use super::made::Made;
use super::metrics::{self, Metrics, Protocol, outputs, sources};
use super::opengaussian;
use super::pairs::{Figures, Pair, object_figures};
use super::predict::{self, Answers};
use super::published;
use crate::memory::{self, SMALLER, Sizes};
use crate::options::{Choice, Inputs, LerfOptions, Rule, Truth};
use crate::query::ask::Asker;
use crate::scene::{folder_name, load};
use crate::score::labels::{self, FrameLabels};
use crate::silhouette::{Rendering, Silhouette};
use artifacts::LerfScene;
use gs_io::{Error, Outputs, Result};
use gs_scene::dataset::{Dataset, LoadOptions};
use query::{LabelledScene, TextSource};
use report::sheet::Sheet;
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use stage::Stage;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

pub(crate) fn run(o: &LerfOptions, parameters: Value, stage: &Stage) -> Result<String> {
    let scene = o.inputs.as_ref().map(|i| i.scene.as_path());
    let none = || {
        let e = Error::new("the scene has no labels").file(scene.unwrap_or(Path::new(".")).join("label"));
        e.expected("a folder of <frame>.json").hint("give --labels")
    };
    let folder = labels::folder(o.labels.labels.as_deref(), scene.unwrap_or(Path::new(".")))?.ok_or_else(none)?;
    let name = folder_name(scene.unwrap_or(&folder));
    let dataset = scene.map(|scene| load(scene, &LoadOptions::default(), stage)).transpose()?;
    let read = o.inputs.iter().zip(&dataset).flat_map(|(inputs, dataset)| inputs.files(dataset));
    let outputs = o.save_predictions.iter().fold(outputs(&o.out, stage), Outputs::folder);
    let mut claim = outputs.reads(read.chain(&o.texts.text_features).chain(&o.choice.features)).claim()?;
    let benchmark = LerfScene::named(&name);
    let (mut frames, mut notes) = labelled_frames(o.truth, &folder, benchmark)?;
    // Where there is a scene, predictions are of its cameras, saved ones too.
    labels::straighten(&mut frames, dataset.as_ref().map_or(&[], |d| &d.views));
    let labels = frames.iter().flat_map(|f| f.categories.values()).map(|m| m.bits.len() as u64).sum();
    let read = o.choice.features.as_deref().map_or(0, memory::bytes);
    let sizes = o.inputs.as_ref().zip(dataset.as_ref());
    let sizes = sizes.map(|(i, d)| Sizes { features: read, ..Sizes::new(&i.geometry, &o.texts, &d.views) });
    let smaller = if o.predictions.is_some() { "give fewer or smaller labels" } else { SMALLER };
    stage.forecast(memory::of_scores(&Sizes { labels, ..sizes.unwrap_or_default() }), smaller)?;
    let mut features = BTreeMap::from([("labels".to_string(), folder_name(&folder))]);
    features.extend(o.predictions.as_ref().map(|saved| ("masks".to_string(), folder_name(saved))));
    let asked = o.inputs.as_ref().zip(dataset);
    let asked = asked.map(|(i, d)| ask(o, i, d, &frames, benchmark, &mut features, stage)).transpose()?;
    if asked.as_ref().is_some_and(|a| a.scene.all_noise()) {
        notes.push("all Gaussians are noise: every query selects nothing".into());
    }
    let mut figures = None;
    for (at, &of) in rules(o).iter().enumerate() {
        let pairs = score(o, &frames, asked.as_ref(), at, stage)?;
        let named = RuleFigures::new(of, rule(o, of, benchmark.is_some()), &pairs);
        let answers = asked.as_ref().map(|a| &a.answers[at].1);
        let main = figures.get_or_insert_with(|| LerfFigures::new(pairs, answers.unwrap_or(&Answers::new())));
        if asked.is_some() {
            main.rules.push(named);
        }
    }
    let figures = figures.expect("there is a rule");
    let zeros = figures.pairs.iter().filter(|p| p.zero.is_some()).count();
    let made = asked.as_ref().map(|a| Made::of(&a.scene));
    let inputs = asked.map_or_else(Default::default, |a| a.scene.inputs);
    notes.extend(figures.zeros());
    let (protocol, rule) = (LerfFigures::NAME.into(), rule(o, o.protocol, benchmark.is_some()));
    let metrics = Metrics { protocol, scene: name, rule, made, features, figures, notes };
    let table = metrics.write(&o.out, stage)?;
    stage.record(&mut claim, parameters, inputs, json!({"figures": metrics.figures.figures, "zeros": zeros}))?;
    Ok(table)
}

/// The labelled frames that are scored, and what is odd about them.
fn labelled_frames(
    truth: Truth,
    folder: &Path,
    benchmark: Option<&LerfScene>,
) -> Result<(Vec<FrameLabels>, Vec<String>)> {
    let mut frames = match truth {
        Truth::Polygons => labels::read_folder(folder)?,
        Truth::Pictures => labels::read_pictures(&folder.join("gt"))?,
    };
    let mut notes = Vec::new();
    if let Some(b) = benchmark {
        let before = frames.len();
        frames.retain(|f| b.scores_frame(&f.frame));
        let left_out = before - frames.len();
        if left_out > 0 {
            notes.push(format!("{left_out} labelled frames are not in the benchmark and are not scored"));
        }
        let pairs: usize = frames.iter().map(|f| f.categories.len()).sum();
        if pairs != b.pairs {
            let published = b.pairs;
            notes.push(format!(
                "the labels hold {pairs} (frame, category) pairs where the published numbers have {published}"
            ));
        }
    }
    Ok((frames, notes))
}

/// The rules that are scored, that of the figures first: the other one where the features that OpenGaussian's needs are given.
fn rules(o: &LerfOptions) -> Vec<Rule> {
    match (o.protocol, &o.choice.features) {
        (Rule::OpenGaussian, _) => vec![Rule::OpenGaussian, Rule::Top1],
        (Rule::Top1, Some(_)) if o.predictions.is_none() => vec![Rule::Top1, Rule::OpenGaussian],
        (Rule::Top1, _) => vec![Rule::Top1],
    }
}

/// A rule's choice among the instances, and the views that must have matched an instance.
fn choice(o: &LerfOptions, rule: Rule) -> (Choice, Option<u32>) {
    match rule {
        Rule::Top1 => (o.choice.clone(), o.texts.min_support),
        Rule::OpenGaussian => (opengaussian::choice(o), Some(opengaussian::MIN_SUPPORT)),
    }
}

/// How a rule renders a selection.
fn rendering(o: &LerfOptions, rule: Rule) -> Rendering {
    match rule {
        Rule::Top1 => o.masking.rendering(Silhouette::Selected),
        Rule::OpenGaussian => Rendering::SELECTED,
    }
}

/// A scene whose instances were asked for the categories of the labels.
struct AskedScene {
    dataset: Dataset,
    scene: LabelledScene,
    /// By each rule that is scored.
    answers: Vec<(Rule, Answers)>,
}

/// Asks for the benchmark's texts, or for the labels' categories. `features` gains what the answers come from.
fn ask(
    o: &LerfOptions,
    inputs: &Inputs,
    mut dataset: Dataset,
    frames: &[FrameLabels],
    benchmark: Option<&LerfScene>,
    features: &mut BTreeMap<String, String>,
    stage: &Stage,
) -> Result<AskedScene> {
    let scene = inputs.read(&mut dataset, stage)?;
    let source = TextSource::open_for(&scene.artifact, scene.instances.dim(), &o.texts)?;
    features.extend(sources(&scene, Some(&source))?);
    let categories: BTreeSet<&String> = frames.iter().flat_map(|f| f.categories.keys()).collect();
    let texts: Vec<String> = match benchmark {
        Some(b) => b.queries.iter().map(|q| (*q).to_string()).collect(),
        None => categories.iter().map(|c| (*c).clone()).collect(),
    };
    let encoded = source.encode_in(&o.choice.templates.all(), &texts)?;
    let mut source = Some(source);
    let mut answers = Vec::new();
    for rule in rules(o) {
        let (choice, support) = choice(o, rule);
        // The rule of OpenGaussian has no negatives, so it needs no more features of texts.
        let negatives = if rule == Rule::Top1 { source.take() } else { None };
        let mut of =
            predict::answers(&Asker::new(&scene, negatives, &choice, support, o.granularity)?, &texts, &encoded);
        for category in categories.iter().filter(|c| !texts.contains(c)) {
            let why = "the category is not in the benchmark's table of queries";
            of.insert((*category).clone(), Err(why.into()));
        }
        answers.push((rule, of));
    }
    Ok(AskedScene { dataset, scene, answers })
}

/// Scores every (frame, category): masks of the scene that was asked by the rule at this place, or saved ones. The masks of the
/// first rule are saved, where that is asked for.
fn score(
    o: &LerfOptions,
    frames: &[FrameLabels],
    asked: Option<&AskedScene>,
    at: usize,
    stage: &Stage,
) -> Result<Vec<Pair>> {
    let mut pairs = Vec::new();
    let mut progress = stage.progress("frames", frames.len() as u64);
    for frame in frames {
        let predictions = match (asked, &o.predictions) {
            (Some(a), _) => {
                let (rule, answers) = &a.answers[at];
                predict::predict(&a.scene.geometry, &a.dataset, frame, answers, rendering(o, *rule), *rule)?
            }
            (None, Some(saved)) => predict::read_predictions(saved, frame)?,
            (None, None) => predict::Predictions::new(),
        };
        if let Some(save) = o.save_predictions.as_ref().filter(|_| at == 0) {
            predict::save_predictions(save, frame, &predictions)?;
        }
        pairs.extend(predict::pairs(frame, &predictions));
        progress.step();
    }
    progress.finish(&[]);
    Ok(pairs)
}

/// The rule that the numbers follow, in words.
fn rule(o: &LerfOptions, rule: Rule, benchmark: bool) -> String {
    let rendering = rendering(o, rule);
    let (masks, asked) = match (&o.predictions, benchmark) {
        (Some(_), _) => ("saved masks above grey level 10".to_string(), ""),
        (None, own) => (
            format!("{} rendering above {}", rendering.silhouette.name(), rendering.threshold),
            if own { "; the benchmark's queries" } else { "; the labels' categories as queries" },
        ),
    };
    let truth = match o.truth {
        Truth::Polygons => "polygons filled as cv2.fillPoly does, corners truncated",
        Truth::Pictures => "truth pictures above grey level 10",
    };
    let (choice, support) = choice(o, rule);
    let choice =
        choice.describe(support) + &if rule == Rule::OpenGaussian { opengaussian::describe() } else { String::new() };
    format!("{masks}; {truth}; mean over (frame, category) pairs, missing = 0{asked}{choice}")
}

/// The figures of a scene, in `metrics.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LerfFigures {
    /// The mean over pairs.
    pub figures: Figures,
    /// The mean over the categories of a frame, then over frames.
    pub frame_figures: Figures,
    /// The figures of each category.
    pub objects: BTreeMap<String, ObjectFigures>,
    /// Every (frame, category).
    pub pairs: Vec<Pair>,
    /// Every rule that was scored, that of all the above first; empty for another program's masks.
    #[serde(default)]
    pub rules: Vec<RuleFigures>,
}

/// The figures of a scene by one rule.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RuleFigures {
    /// Its name: `top1` or `opengaussian`.
    pub name: String,
    /// What it is, in words.
    pub rule: String,
    /// The mean over pairs.
    pub figures: Figures,
    /// The mean over the categories of a frame, then over frames.
    pub frame_figures: Figures,
    /// Pairs that score 0, by the reason.
    pub zeros: BTreeMap<String, usize>,
}

impl RuleFigures {
    fn new(rule: Rule, words: String, pairs: &[Pair]) -> Self {
        let mut zeros = BTreeMap::new();
        pairs.iter().filter_map(|p| p.zero.clone()).for_each(|why| *zeros.entry(why).or_default() += 1);
        let (figures, frame_figures) = (Figures::of_pairs(pairs), Figures::of_frames(pairs));
        Self { name: rule.name().into(), rule: words, figures, frame_figures, zeros }
    }
}

/// The figures of a category with the answer to it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ObjectFigures {
    /// The figures over its frames.
    #[serde(flatten)]
    pub figures: Figures,
    /// Selected instances, best first.
    pub instances: Vec<u32>,
    /// Score of the best.
    pub score: Option<f32>,
}

impl LerfFigures {
    fn new(pairs: Vec<Pair>, answers: &Answers) -> Self {
        let object = |(category, figures): (String, Figures)| {
            let (instances, score) = predict::chosen(answers, &category);
            (category, ObjectFigures { figures, instances, score })
        };
        let objects = object_figures(&pairs).into_iter().map(object).collect();
        let (figures, frame_figures) = (Figures::of_pairs(&pairs), Figures::of_frames(&pairs));
        Self { figures, frame_figures, objects, pairs, rules: Vec::new() }
    }

    /// A line for every reason of a zero.
    fn zeros(&self) -> Vec<String> {
        if self.pairs.is_empty() {
            return vec!["no labelled object was scored: all figures are 0 for want of pairs".into()];
        }
        let mut zeros = BTreeMap::<&str, Vec<String>>::new();
        for p in &self.pairs {
            if let Some(why) = &p.zero {
                zeros.entry(why).or_default().push(format!("{} in {}", p.category, p.frame));
            }
        }
        let line = |(why, of): (&str, Vec<String>)| {
            let some = of[..of.len().min(3)].join(", ");
            let more = if of.len() > 3 { ", …" } else { "" };
            format!("{} of {} pairs score 0 because {why}: {some}{more}", of.len(), self.pairs.len())
        };
        zeros.into_iter().map(line).collect()
    }
}

/// A row of the table for every rule, in the order in which scenes have them: its name, and the figures of each scene by it.
fn rows(scenes: &[Metrics<LerfFigures>]) -> Vec<(String, BTreeMap<String, Figures>)> {
    let mut rules: Vec<&str> = Vec::new();
    for rule in scenes.iter().flat_map(|s| s.figures.rules.iter()) {
        if !rules.contains(&rule.name.as_str()) {
            rules.push(&rule.name);
        }
    }
    let by_rule = |name: &str| {
        let of = |s: &Metrics<LerfFigures>| s.figures.rules.iter().find(|r| r.name == name).map(|r| r.figures);
        let by: Vec<_> = scenes.iter().filter_map(|s| Some((s, of(s)?))).collect();
        let scenes: Vec<_> = by.iter().map(|(s, _)| *s).collect();
        let figures = by.iter().map(|(s, figures)| (s.scene.clone(), *figures)).collect();
        (format!("{}, {name}", metrics::row(&scenes, "unrecorded")), figures)
    };
    let saved: BTreeMap<String, Figures> =
        scenes.iter().filter(|s| s.figures.rules.is_empty()).map(|s| (s.scene.clone(), s.figures.figures)).collect();
    let saved = (!saved.is_empty()).then(|| ("masks of another program".to_string(), saved));
    rules.into_iter().map(by_rule).chain(saved).collect()
}

impl Protocol for LerfFigures {
    const NAME: &str = "lerf-ovs";

    fn remark(&self) -> Option<String> {
        let f = self.frame_figures;
        let [miou, macc25, macc50] = [f.miou, f.macc25, f.macc50].map(|v| 100.0 * v);
        let mut remark =
            format!("mean over frames instead of pairs: mIoU {miou:.2}, mAcc@0.25 {macc25:.2}, mAcc@0.5 {macc50:.2}");
        for other in self.rules.iter().skip(1) {
            remark += &format!(". The row of {} is by another rule: {}", other.name, other.rule);
            let zeros =
                other.zeros.iter().map(|(why, n)| format!("; {n} of {} pairs score 0 because {why}", self.pairs.len()));
            remark.extend(zeros);
        }
        Some(remark)
    }

    fn sheet(scenes: &[Metrics<Self>], notes: Vec<String>) -> Sheet {
        published::lerf_sheet(&rows(scenes), notes)
    }

    fn summary(scenes: &[Metrics<Self>]) -> Value {
        let over = |f: fn(&Self) -> Figures| Figures::mean(&scenes.iter().map(|m| f(&m.figures)).collect::<Vec<_>>());
        let named: BTreeMap<&str, _> = scenes.iter().map(|m| (m.scene.as_str(), m.figures.figures)).collect();
        let rules: BTreeMap<String, _> =
            rows(scenes).into_iter().map(|(name, row)| (name, Figures::mean(row.values()))).collect();
        json!({
            "protocol": "lerf-ovs dataset", "figures": over(|f| f.figures),
            "frame_figures": over(|f| f.frame_figures), "scenes": named, "rows": rules,
        })
    }
}
