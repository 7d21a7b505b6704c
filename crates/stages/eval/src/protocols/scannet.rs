//! `eval scannet`: semantic classes and class-agnostic instances of a ScanNet scan.

use super::classes::{self, Confusion, SETS};
use super::instances::{self, InstanceFigures};
use super::made::Made;
use super::metrics::{self as all, Metrics, Protocol, outputs, sources};
use super::published::{self, SetRow};
use super::vertex_labels;
use crate::memory::{self, SMALLER, Sizes};
use crate::options::{Association, Inputs, ScannetOptions};
use crate::scene::{folder_name, load};
use crate::score::labels::list;
use crate::score::metrics;
use gs_io::{Error, Result, hash_file};
use gs_scene::dataset::LoadOptions;
use query::{Index, LabelledScene, MIN_OPACITY, TextSource, nearest};
use report::sheet::{Row, Sheet, Table};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use stage::Stage;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// How far a Gaussian may lie from the vertex of its number, in metres, for the two to be one.
const FROZEN: f32 = 1e-3;
/// Views that must have matched an instance for it to have a descriptor, where nothing else is asked for (OpenGaussian).
const MIN_SUPPORT: u32 = 2;

/// The files of a scan that hold its truth.
#[derive(Debug, Clone, PartialEq)]
pub struct ScanFiles {
    /// `<scan>_vh_clean_2.labels.ply`.
    pub labels: PathBuf,
    /// `<scan>_vh_clean_2.0.010000.segs.json` and `<scan>.aggregation.json`, where both are there.
    pub instances: Option<(PathBuf, PathBuf)>,
}

impl ScanFiles {
    /// Finds the truth in a scan's folder. The segments are those of the same mesh as the labels: the finer
    /// `*_vh_clean.segs.json` and its aggregation belong to another mesh.
    pub fn find(folder: &Path) -> Result<Self> {
        let files = list(folder)?;
        let with = |end: &str, without: &str| {
            let ends = |p: &PathBuf, end: &str| p.as_os_str().as_encoded_bytes().ends_with(end.as_bytes());
            let fits = |p: &&PathBuf| ends(p, end) && (without.is_empty() || !ends(p, without));
            files.iter().filter(fits).cloned().collect::<Vec<_>>()
        };
        let labels = with(".labels.ply", "");
        let [labels] = &labels[..] else {
            return Err(Error::new("not one file of labelled vertices")
                .file(folder)
                .field("*.labels.ply")
                .found(labels.len())
                .expected("<scan>_vh_clean_2.labels.ply")
                .hint("give a ScanNet scan's folder"));
        };
        let segs = with(".segs.json", "_vh_clean.segs.json");
        let aggregation = with(".aggregation.json", "_vh_clean.aggregation.json");
        let instances = segs.first().cloned().zip(aggregation.first().cloned());
        Ok(Self { labels: labels.clone(), instances })
    }
}

/// Score of a class.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ClassFigures {
    /// NYU40 id.
    pub id: u32,
    /// Its name, the text asked.
    pub name: String,
    /// Number of its true points.
    pub truth: f64,
    /// IoU; none where the truth has none of it.
    pub iou: Option<f64>,
    /// Recall; none likewise.
    pub recall: Option<f64>,
}

/// Score of a class set.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SetFigures {
    /// Classes in the set: 19, 15 or 10.
    pub size: usize,
    /// Mean IoU over the classes present in the truth; none when none is.
    pub miou: Option<f64>,
    /// Mean recall over them.
    pub macc: Option<f64>,
    /// Every class.
    pub classes: Vec<ClassFigures>,
    /// True against predicted class; pooled scores come from sums of it.
    pub confusion: Confusion,
}

impl SetFigures {
    fn new(set: &[(u32, &str)], confusion: Confusion) -> Self {
        let means = confusion.means();
        let class = |(c, &(id, name)): (usize, &(u32, &str))| {
            let figures = confusion.class(c);
            let (iou, recall) = (figures.map(|f| f.0), figures.map(|f| f.1));
            ClassFigures { id, name: name.into(), truth: confusion.truth(c), iou, recall }
        };
        let classes = set.iter().enumerate().map(class).collect();
        Self { size: set.len(), miou: means.map(|m| m.0), macc: means.map(|m| m.1), classes, confusion }
    }
}

/// The figures of a scan, in `metrics.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ScanFigures {
    /// Score of each class set.
    pub sets: Vec<SetFigures>,
    /// Class-agnostic instances, where the scan has segs and aggregation.
    pub instances: Option<InstanceFigures>,
}

/// The Gaussian of each vertex of the scan.
struct Matched {
    /// None where there is no Gaussian at all.
    gaussian: Vec<Option<u32>>,
    /// Whether a vertex takes part.
    counts: Vec<bool>,
}

/// Brings vertices and Gaussians together. Faint Gaussians leave the evaluation, by OpenGaussian's rule, and so do damaged ones.
fn matched(scene: &LabelledScene, vertices: &[[f32; 3]], association: Association, labels: &Path) -> Result<Matched> {
    let g = scene.gaussians();
    let seen = seen(scene);
    if association == Association::Nearest {
        let candidates: Vec<u32> = (0..g.len() as u32).filter(|&i| seen[i as usize]).collect();
        return Ok(Matched { gaussian: nearest(g, &candidates, vertices), counts: vec![true; vertices.len()] });
    }
    let hint = "the geometry was densified, pruned or moved: use --association nearest";
    if g.len() != vertices.len() {
        return Err(Error::new("not a Gaussian per vertex")
            .file(labels)
            .field("vertices")
            .found(vertices.len())
            .expected(format!("{}, as many as Gaussians", g.len()))
            .hint(hint));
    }
    let whole = scene.geometry.whole();
    let apart = |i: &usize| whole[*i] && (0..3).any(|k| (g.means[*i][k] - vertices[*i][k]).abs() > FROZEN);
    if let Some(i) = (0..g.len()).find(apart) {
        return Err(Error::new("the Gaussian of this number lies elsewhere")
            .file(labels)
            .field(format!("vertex {i}"))
            .found(format!("{:?}", vertices[i]))
            .expected(format!("{:?}", g.means[i]))
            .hint(hint));
    }
    Ok(Matched { gaussian: (0..g.len() as u32).map(Some).collect(), counts: seen })
}

/// Which Gaussians are neither faint nor damaged.
fn seen(scene: &LabelledScene) -> Vec<bool> {
    let g = scene.gaussians();
    scene.geometry.whole().iter().enumerate().map(|(i, whole)| *whole && g.opacity(i) >= MIN_OPACITY).collect()
}

pub(crate) fn run(o: &ScannetOptions, parameters: Value, stage: &Stage) -> Result<String> {
    let (scene, truth) = (o.inputs.as_ref().map(|i| i.scene.as_path()), o.labels.as_deref());
    let folder = truth.or(scene).unwrap_or(Path::new("."));
    let files = ScanFiles::find(folder)?;
    match (&o.inputs, &o.predictions) {
        (_, Some(labels)) => of_labels(o, labels, folder, &files, parameters, stage),
        (Some(inputs), None) => of_instances(o, inputs, &files, parameters, stage),
        (None, None) => Err(Error::new("nothing to score").field("--scene").expected("--scene or --predictions")),
    }
}

/// Scores labels that another program gave the vertices.
fn of_labels(
    o: &ScannetOptions,
    labels: &Path,
    folder: &Path,
    files: &ScanFiles,
    parameters: Value,
    stage: &Stage,
) -> Result<String> {
    let mut claim = outputs(&o.out, stage).reads([files.labels.as_path(), labels]).claim()?;
    let truth = [files.labels.as_path(), labels].into_iter().map(memory::bytes).sum();
    stage.forecast(memory::of_scan(&Sizes { truth, ..Sizes::default() }), SMALLER)?;
    let (vertices, truth) = gs_scene::ply::read_labels(&files.labels, "label", [0.0; 3])?;
    let said = vertex_labels::read(labels, vertices.len())?;
    let mut notes = vec!["no instance score: these are labels of classes".into()];
    let sets = SETS.map(|size| label_figures(size, &truth, &said, &mut notes)).into();
    let hash = hash_file(labels)?;
    let file = labels.file_name().unwrap_or_default().to_string_lossy();
    let features = BTreeMap::from([("vertex labels".to_string(), format!("{file} ({hash:.12})"))]);
    let rule = "labels of another program, vertex by vertex; no vertex left out, one without a class of the set missed; means over \
                the classes present";
    let (protocol, figures) = (ScanFigures::NAME.into(), ScanFigures { sets, instances: None });
    let metrics =
        Metrics { protocol, scene: folder_name(folder), rule: rule.into(), made: None, features, figures, notes };
    let table = metrics.write(&o.out, stage)?;
    let summary = json!({"rows": metrics.figures.row()});
    stage.record(&mut claim, parameters, BTreeMap::from([("vertex labels".into(), hash)]), summary)?;
    Ok(table)
}

/// Scores the classes of a set by the vertices' true labels and those of another program.
fn label_figures(size: usize, truth: &[u32], said: &[u32], notes: &mut Vec<String>) -> SetFigures {
    let set = classes::class_set(size);
    let points: Vec<_> =
        classes::truth_classes(truth, &set).into_iter().zip(classes::truth_classes(said, &set)).collect();
    let missed = points.iter().filter(|(truth, said)| truth.is_some() && said.is_none()).count();
    if missed > 0 {
        notes.push(format!(
            "{size} classes: {missed} labelled points are given no class of the set and count as missed"
        ));
    }
    let confusion = Confusion::of(set.len(), points);
    unscored(size, &confusion, notes);
    SetFigures::new(&set, confusion)
}

/// Says of a set that no point has a class of it, where that is so.
fn unscored(size: usize, confusion: &Confusion, notes: &mut Vec<String>) {
    if confusion.means().is_none() {
        notes.push(format!("{size} classes: no labelled point takes part, so there is no score"));
    }
}

/// Scores the instances of a scene.
fn of_instances(
    o: &ScannetOptions,
    inputs: &Inputs,
    files: &ScanFiles,
    parameters: Value,
    stage: &Stage,
) -> Result<String> {
    let folder = &inputs.scene;
    let parts = files.instances.iter().flat_map(|(segments, objects)| [segments, objects]).chain([&files.labels]);
    let mut claim = outputs(&o.out, stage)
        .reads(parts.clone())
        .reads([&inputs.instances, &inputs.geometry].into_iter().chain(&o.texts.text_features))
        .claim()?;
    let truth = parts.map(|p| memory::bytes(p)).sum();
    stage.forecast(memory::of_scan(&Sizes { truth, ..Sizes::new(&inputs.geometry, &o.texts, &[]) }), SMALLER)?;
    let scene = inputs.read(&mut load(folder, &LoadOptions::default(), stage)?, stage)?;
    let mut notes = Vec::new();
    let why = without_classes(&scene, o);
    let source = if why.is_none() {
        Some(TextSource::open_for(&scene.artifact, scene.instances.dim(), &o.texts)?)
    } else {
        None
    };
    notes.extend(why.map(|why| format!("no class scores: {why}")));
    let features = sources(&scene, source.as_ref())?;
    let (vertices, labels) = gs_scene::ply::read_labels(&files.labels, "label", scene.gaussians().shift)?;
    let matched = matched(&scene, &vertices, o.association, &files.labels)?;
    if scene.all_noise() {
        notes.push("all Gaussians are noise: no vertex has an instance".into());
    }
    let out = matched.counts.iter().filter(|c| !**c).count();
    if out > 0 {
        let all = vertices.len();
        notes.push(format!("{out} of {all} vertices leave the evaluation: their Gaussian is faint or damaged"));
    }
    let min_support = o.texts.min_support.unwrap_or(MIN_SUPPORT);
    let mut sets = Vec::new();
    if let Some(source) = source {
        let names: Vec<String> = artifacts::NYU40.iter().map(|c| c.1.to_string()).collect();
        let texts = source.known(&[], &names, "--text-features")?;
        for size in SETS {
            sets.push(set_figures(&scene, &labels, &matched, size, &texts, min_support, &mut notes));
        }
    }
    let instances = instance_figures(&scene, files, &matched, vertices.len(), &mut notes)?;
    let rule = rule(o.association, min_support, !sets.is_empty());
    let (protocol, figures) = (ScanFigures::NAME.into(), ScanFigures { sets, instances });
    let made = Some(Made::of(&scene));
    let metrics = Metrics { protocol, scene: folder_name(folder), rule, made, features, figures, notes };
    let table = metrics.write(&o.out, stage)?;
    let summary = json!({"rows": metrics.figures.row(), "instances": metrics.figures.instances});
    stage.record(&mut claim, parameters, scene.inputs.clone(), summary)?;
    Ok(table)
}

/// Why no class can be scored, where that is so; instances without classes are scored all the same.
fn without_classes(scene: &LabelledScene, o: &ScannetOptions) -> Option<&'static str> {
    if !o.texts.given() {
        return Some("neither --clip nor --text-features was given");
    }
    let undescribed = "the instances have no language features, because the masks were not encoded with a CLIP model \
                       (mask-embed embed --clip)";
    (scene.instances.dim() == 0).then_some(undescribed)
}

/// The rule in words; that of classes where they are scored.
fn rule(association: Association, min_support: u32, classes: bool) -> String {
    let association = match association {
        Association::OneToOne => "Gaussian i is vertex i",
        Association::Nearest => "every vertex takes its nearest Gaussian",
    };
    let of_classes = format!(
        "; instances matched in fewer than {min_support} views and noise get the first class; argmax of the cosine over the \
         set's names; means over the classes present"
    );
    let of_classes = if classes { of_classes } else { String::new() };
    format!("{association}; Gaussians of opacity below {MIN_OPACITY} left out{of_classes}")
}

/// Scores the classes of a set. `texts` are the features of the names of [`artifacts::NYU40`], in that order. Gaussians
/// whose instance has no descriptor, and noise, get the first class of the set, "wall": the argmax of all-zero
/// similarities in the published scorer.
fn set_figures(
    scene: &LabelledScene,
    labels: &[u32],
    matched: &Matched,
    size: usize,
    texts: &[Vec<f32>],
    min_support: u32,
    notes: &mut Vec<String>,
) -> SetFigures {
    let set = classes::class_set(size);
    let class = gaussian_classes(scene, &set, texts, min_support);
    let truth = classes::truth_classes(labels, &set);
    let counted = || (0..truth.len()).filter(|&v| matched.counts[v]);
    let of = |v: usize| matched.gaussian[v].and_then(|i| class[i as usize]);
    let lost = counted().filter(|&v| truth[v].is_some() && of(v).is_none()).count();
    if lost > 0 {
        notes.push(format!("{size} classes: {lost} labelled points have no descriptor and get {:?}", set[0].1));
    }
    let points = counted().map(|v| (truth[v], matched.gaussian[v].map(|_| of(v).unwrap_or(0))));
    let confusion = Confusion::of(set.len(), points);
    unscored(size, &confusion, notes);
    SetFigures::new(&set, confusion)
}

/// The class of each Gaussian: that of the highest cosine with its instance's descriptor; none without a descriptor.
fn gaussian_classes(
    scene: &LabelledScene,
    set: &[(u32, &str)],
    texts: &[Vec<f32>],
    min_support: u32,
) -> Vec<Option<usize>> {
    let index = Index::new(&scene.instances);
    let names = (0..texts.len()).filter(|&n| set.contains(&artifacts::NYU40[n]));
    let scores: Vec<Vec<Option<f32>>> = names.map(|n| index.scores(&texts[n], &[])).collect();
    let best = |k: usize| {
        let described = scene.instances.support[k] >= min_support;
        let scored = scores.iter().enumerate().filter_map(|(c, of)| Some((c, of[k]?))).filter(|_| described);
        scored.fold(None, |best: Option<(usize, f32)>, s| if best.is_none_or(|b| s.1 > b.1) { Some(s) } else { best })
    };
    let of_instance: Vec<Option<usize>> = (0..scene.instances.len()).map(|k| best(k).map(|b| b.0)).collect();
    let label = &scene.instances.label;
    label.iter().map(|&l| usize::try_from(l).ok().and_then(|l| of_instance[l])).collect()
}

/// Scores instances without classes, where the scan has segments and objects.
fn instance_figures(
    scene: &LabelledScene,
    files: &ScanFiles,
    matched: &Matched,
    vertices: usize,
    notes: &mut Vec<String>,
) -> Result<Option<InstanceFigures>> {
    let Some((segs, aggregation)) = &files.instances else {
        notes.push("no instance score: the scan has no segs.json with its aggregation.json".into());
        return Ok(None);
    };
    let mut truth = instances::read_truth(segs, aggregation, vertices)?;
    let label = &scene.instances.label;
    let mut predicted: Vec<i32> = matched.gaussian.iter().map(|i| i.map_or(-1, |i| label[i as usize])).collect();
    // A vertex that leaves does so from both sides: else it makes instances too large.
    for (v, _) in matched.counts.iter().enumerate().filter(|(_, counts)| !**counts) {
        (truth[v], predicted[v]) = (-1, -1);
    }
    Ok(Some(instances::score(&truth, &predicted, &scene.instances.score, instances::MIN_POINTS)))
}

impl ScanFigures {
    /// Columns of [`Self::instance_cells`].
    const INSTANCES: [&str; 5] = ["instance mIoU", "@25", "@50", "AP25", "AP50"];

    /// Scores of instances without classes, in percent.
    fn instance_cells(&self) -> [Option<f64>; 5] {
        let i = self.instances.as_ref();
        let figures = i.map_or([None; 5], |i| [Some(i.miou), Some(i.acc25), Some(i.acc50), i.ap25, i.ap50]);
        figures.map(|v| v.map(|v| 100.0 * v))
    }

    /// mIoU and mAcc of the sets of 19, 15 and 10 classes.
    fn row(&self) -> SetRow {
        SETS.map(|size| {
            let set = self.sets.iter().find(|s| s.size == size)?;
            set.miou.zip(set.macc)
        })
    }
}

/// Means over scans of [`ScanFigures::instance_cells`], each over the scans that have it.
fn instance_means(scans: &[Metrics<ScanFigures>]) -> [Option<f64>; 5] {
    let rows: Vec<_> = scans.iter().map(|s| s.figures.instance_cells()).collect();
    std::array::from_fn(|c| {
        let column: Vec<f64> = rows.iter().filter_map(|r| r[c]).collect();
        (!column.is_empty()).then(|| metrics::mean(&column))
    })
}

/// Both ways of bringing scans together: the mean of the scans' means, and the means of the pooled points.
fn means(scans: &[Metrics<ScanFigures>]) -> [SetRow; 2] {
    let mean = |at: usize| {
        let rows: Vec<(f64, f64)> = scans.iter().filter_map(|s| s.figures.row()[at]).collect();
        let over = |f: fn(&(f64, f64)) -> f64| metrics::mean(&rows.iter().map(f).collect::<Vec<_>>());
        (!rows.is_empty()).then(|| (over(|r| r.0), over(|r| r.1)))
    };
    let pooled = |size: usize| {
        let mut all = Confusion::new(size);
        let sets = scans.iter().flat_map(|s| &s.figures.sets).filter(|s| s.size == size);
        sets.for_each(|s| all.merge(&s.confusion));
        all.means()
    };
    [[0, 1, 2].map(mean), SETS.map(pooled)]
}

impl Protocol for ScanFigures {
    const NAME: &str = "scannet";

    fn is_sound(&self) -> bool {
        let sound = |s: &SetFigures| s.confusion.classes == s.size && s.confusion.is_sound();
        self.sets.iter().all(|s| SETS.contains(&s.size) && sound(s))
    }

    fn is_published(scans: &[Metrics<Self>]) -> bool {
        scans.iter().any(|s| !s.figures.sets.is_empty())
    }

    fn sheet(scans: &[Metrics<Self>], notes: Vec<String>) -> Sheet {
        let columns = Self::INSTANCES.map(String::from);
        let each = |title: &str, columns, rows| {
            let (title, head) = (title.into(), "Scan".into());
            Table { title, head, columns, rows, sources: false }
        };
        if !Self::is_published(scans) {
            let row = |s: &Metrics<Self>| Row::measured(&s.scene, s.figures.instance_cells().to_vec());
            let mut rows: Vec<Row> = scans.iter().map(row).collect();
            if scans.len() > 1 {
                rows.push(Row::measured("mean over scenes", instance_means(scans).to_vec()));
            }
            let table = each("Instances without classes", columns.to_vec(), rows);
            return Sheet { title: "ScanNet".into(), table, remarks: Vec::new(), notes, more: Vec::new() };
        }
        let [mean, pooled] = means(scans);
        let name = all::row(&scans.iter().collect::<Vec<_>>(), "labels of another program");
        let rows = [(format!("{name}, mean over scenes"), mean), (format!("{name}, points pooled"), pooled)];
        let mut sheet = published::scannet_sheet(&rows, scans.len(), notes);
        let row = |s: &Metrics<Self>| {
            let mut cells = published::set_cells(s.figures.row());
            cells.extend(s.figures.instance_cells());
            Row::measured(&s.scene, cells)
        };
        let columns = published::set_columns().into_iter().chain(columns).collect();
        sheet.more.push(each("Scans one by one", columns, scans.iter().map(row).collect()));
        sheet
    }

    fn summary(scans: &[Metrics<Self>]) -> Value {
        let sized = |row: SetRow| -> Value {
            let cell = |r: Option<(f64, f64)>| json!({"miou": r.map(|r| r.0), "macc": r.map(|r| r.1)});
            Value::Object(SETS.iter().zip(row).map(|(size, r)| (size.to_string(), cell(r))).collect())
        };
        let [mean, pooled] = means(scans).map(sized);
        let scenes: Vec<&str> = scans.iter().map(|m| m.scene.as_str()).collect();
        let columns = ScanFigures::INSTANCES.iter().map(ToString::to_string);
        let instances: serde_json::Map<String, Value> = columns.zip(instance_means(scans).map(|v| json!(v))).collect();
        json!({"protocol": "scannet dataset", "scenes": scenes, "mean_over_scenes": mean, "pooled": pooled,
            "instances_percent": instances})
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_files_of_the_same_mesh_are_found() {
        let dir = tempfile::tempdir().unwrap();
        assert!(ScanFiles::find(dir.path()).unwrap_err().to_string().contains("*.labels.ply: not one file"));
        let touch = |name: &str| std::fs::write(dir.path().join(name), "").unwrap();
        touch("scene0000_00_vh_clean_2.labels.ply");
        touch("scene0000_00_vh_clean.segs.json");
        touch("scene0000_00_vh_clean.aggregation.json");
        assert_eq!(ScanFiles::find(dir.path()).unwrap().instances, None);
        touch("scene0000_00_vh_clean_2.0.010000.segs.json");
        touch("scene0000_00.aggregation.json");
        let (segs, aggregation) = ScanFiles::find(dir.path()).unwrap().instances.unwrap();
        assert!(segs.ends_with("scene0000_00_vh_clean_2.0.010000.segs.json"));
        assert!(aggregation.ends_with("scene0000_00.aggregation.json"));
        touch("other.labels.ply");
        assert!(ScanFiles::find(dir.path()).is_err());
    }
}
