//! `eval scannet`: semantic classes and class-agnostic instances of a ScanNet scan, by [`crate::protocol::scannet`] and
//! [`crate::protocol::instances`].

use crate::protocol::instances::{self, InstanceFigures};
use crate::protocol::published::{self, SetRow};
use crate::protocol::scannet::{self, Association, Confusion};
use crate::ranking::{Index, Scoring};
use crate::scene::LabelledScene;
use gs_io::{Error, IoContext, Result, write_bytes};
use report::sheet::{Row, Sheet, Table};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Opacity below which the rule leaves a Gaussian out.
pub const FAINT: f32 = 0.1;
/// How far a Gaussian may lie from the vertex of its number, in metres, for the two to be one.
const FROZEN: f32 = 1e-3;

/// What becomes of Gaussians whose instance has no descriptor (too few views matched it), and of noise.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Undescribed {
    /// The first class of the set, "wall": the argmax of all-zero similarities in the published scorer
    First,
    /// No class: they count as missed
    None,
}

/// How a scan is scored.
#[derive(Debug, Clone, PartialEq)]
pub struct ScanOptions {
    /// How Gaussians and vertices are brought together.
    pub association: Association,
    /// Whether Gaussians of opacity below 0.1 leave the evaluation (OpenGaussian's rule).
    pub opacity_rule: bool,
    /// What becomes of Gaussians without a descriptor.
    pub undescribed: Undescribed,
    /// Instances matched in fewer views have no descriptor (OpenGaussian: 2).
    pub min_support: u32,
}

impl ScanOptions {
    /// The rule in words.
    pub fn describe(&self) -> String {
        let association = match self.association {
            Association::OneToOne => "Gaussian i is vertex i",
            Association::Nearest => "every vertex takes its nearest Gaussian",
            Association::Volume => "volume-aware pseudo-truth per Gaussian",
        };
        let faint = if self.opacity_rule { "left out" } else { "kept" };
        let undescribed = match self.undescribed {
            Undescribed::First => "the first class",
            Undescribed::None => "no class",
        };
        format!(
            "{association}; Gaussians of opacity below {FAINT} {faint}; instances matched in fewer than {} views and noise \
             get {undescribed}; argmax of the cosine over the set's names; means over the classes present",
            self.min_support
        )
    }
}

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
    ///
    /// # Errors
    /// When the folder cannot be read or holds no `*.labels.ply`, or several.
    pub fn find(folder: &Path) -> Result<Self> {
        let mut names = Vec::new();
        for entry in std::fs::read_dir(folder).at("list", folder)? {
            names.push(entry.at("list", folder)?.file_name().to_string_lossy().into_owned());
        }
        names.sort();
        let with = |end: &str, without: &str| {
            let fits = |n: &&String| n.ends_with(end) && (without.is_empty() || !n.ends_with(without));
            names.iter().filter(fits).map(|n| folder.join(n)).collect::<Vec<_>>()
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
    /// Weight of its true points: their number, or volume.
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

/// `metrics.json` of `eval scannet`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ScanMetrics {
    /// `scannet`.
    pub protocol: String,
    /// Name of the scan.
    pub scene: String,
    /// The rule in words.
    pub rule: String,
    /// Files and models that the numbers come from.
    pub features: BTreeMap<String, String>,
    /// Score of each class set.
    pub sets: Vec<SetFigures>,
    /// Class-agnostic instances, where the scan has segs and aggregation.
    pub instances: Option<InstanceFigures>,
    /// What is odd: points without a prediction, what was left out.
    pub notes: Vec<String>,
}

/// What the scan's vertices, or its Gaussians, are compared with.
struct Matched {
    /// Gaussian of every vertex; none where none speaks.
    gaussian: Vec<Option<u32>>,
    /// Whether a vertex takes part.
    counts: Vec<bool>,
}

fn matched(scene: &LabelledScene, vertices: &[[f32; 3]], options: &ScanOptions, labels: &Path) -> Result<Matched> {
    let g = scene.gaussians();
    let whole = scene.geometry.whole();
    let faint = |i: usize| !whole[i] || options.opacity_rule && g.opacity(i) < FAINT;
    if options.association != Association::OneToOne {
        let speakers: Vec<u32> = (0..g.len() as u32).filter(|&i| !faint(i as usize)).collect();
        let gaussian = scannet::nearest(g, &speakers, vertices);
        return Ok(Matched { gaussian, counts: vec![true; vertices.len()] });
    }
    let hint = "the geometry was densified, pruned or moved: use --association nearest or volume";
    if g.len() != vertices.len() {
        return Err(Error::new("not a Gaussian per vertex")
            .file(labels)
            .field("vertices")
            .found(vertices.len())
            .expected(format!("{}, as many as Gaussians", g.len()))
            .hint(hint));
    }
    let apart = |i: &usize| whole[*i] && (0..3).any(|k| (g.means[*i][k] - vertices[*i][k]).abs() > FROZEN);
    if let Some(i) = (0..g.len()).find(apart) {
        return Err(Error::new("the Gaussian of this number lies elsewhere")
            .file(labels)
            .field(format!("vertex {i}"))
            .found(format!("{:?}", vertices[i]))
            .expected(format!("{:?}", g.means[i]))
            .hint(hint));
    }
    let counts = (0..g.len()).map(|i| !faint(i)).collect();
    Ok(Matched { gaussian: (0..g.len() as u32).map(Some).collect(), counts })
}

/// Scores a scan. `texts` are the features of the names of [`artifacts::NYU40`], in that order; `sizes` the class sets.
///
/// # Errors
/// When the truth is damaged or does not fit the Gaussians.
///
/// # Panics
/// When a size is none of [`scannet::SETS`] or `texts` are not as many as names, or of another dimension.
pub fn score(
    scene: &LabelledScene,
    files: &ScanFiles,
    texts: Option<&[Vec<f32>]>,
    sizes: &[usize],
    options: &ScanOptions,
    without: &[String],
) -> Result<(Vec<SetFigures>, Option<InstanceFigures>, Vec<String>)> {
    let (vertices, labels) = gs_scene::ply::read_labels(&files.labels, "label")?;
    let g = scene.gaussians();
    let matched = matched(scene, &vertices, options, &files.labels)?;
    let mut notes = Vec::new();
    let mut sets = Vec::new();
    let label = &scene.instances.label;
    if label.iter().all(|&l| l < 0) {
        notes.push("all Gaussians are noise: no vertex has an instance".into());
    }
    let out = matched.counts.iter().filter(|c| !**c).count();
    if out > 0 {
        notes.push(format!(
            "{out} of {} vertices leave the evaluation: their Gaussian is faint or damaged",
            vertices.len()
        ));
    }
    if let Some(texts) = texts {
        assert_eq!(texts.len(), artifacts::NYU40.len());
        let index = Index::new(&scene.instances);
        let by_name: Vec<Vec<Option<f32>>> = texts.iter().map(|t| index.scores(t, &Scoring::default())).collect();
        for &size in sizes {
            let set = scannet::class_set(size).expect("a known size");
            let names: Vec<usize> = (0..texts.len()).filter(|&n| set.contains(&artifacts::NYU40[n])).collect();
            let of_instance = |k: usize| {
                let mut best: Option<(usize, f32)> = None;
                if scene.instances.support[k] >= options.min_support {
                    for (c, &n) in names.iter().enumerate() {
                        if let Some(s) = by_name[n][k].filter(|s| best.is_none_or(|b| *s > b.1)) {
                            best = Some((c, s));
                        }
                    }
                }
                best.map(|b| b.0)
            };
            let of_instances: Vec<Option<usize>> = (0..scene.instances.len()).map(of_instance).collect();
            let described: Vec<Option<usize>> =
                label.iter().map(|&l| usize::try_from(l).ok().and_then(|l| of_instances[l])).collect();
            let fallback = (options.undescribed == Undescribed::First).then_some(0);
            let class: Vec<Option<usize>> = described.iter().map(|c| c.or(fallback)).collect();
            let truth = scannet::truth_classes(&labels, &set);
            let (confusion, lost) = if options.association == Association::Volume {
                let truth = scannet::volume_truth(g, &vertices, &truth, set.len());
                let whole = scene.geometry.whole();
                let counts = |i: usize| whole[i] && (!options.opacity_rule || g.opacity(i) >= FAINT);
                let counts: Vec<bool> = (0..g.len()).map(counts).collect();
                let lost =
                    (0..g.len()).filter(|&i| counts[i] && truth[i].0.is_some() && described[i].is_none()).count();
                (scannet::score_volumes(&truth, &class, &counts, set.len()), lost)
            } else {
                let of = |from: &[Option<usize>], i: Option<u32>| i.and_then(|i| from[i as usize]);
                let predicted: Vec<Option<usize>> = matched.gaussian.iter().map(|&i| of(&class, i)).collect();
                let lost = (0..vertices.len()).filter(|&v| {
                    matched.counts[v] && truth[v].is_some() && of(&described, matched.gaussian[v]).is_none()
                });
                let lost = lost.count();
                (scannet::score_vertices(&truth, &predicted, &matched.counts, set.len()), lost)
            };
            if lost > 0 {
                let get = if fallback.is_some() { format!("{:?}", set[0].1) } else { "no class".into() };
                notes.push(format!("{size} classes: {lost} labelled points have no descriptor and get {get}"));
            }
            if confusion.means().is_none() {
                notes.push(format!("{size} classes: no labelled point takes part, so there is no score"));
            }
            sets.push(SetFigures::new(&set, confusion));
        }
    }
    let instances = match &files.instances {
        None => {
            notes.push("no instance score: the scan has no segs.json with its aggregation.json".into());
            None
        }
        Some((segs, aggregation)) => {
            let mut truth = instances::read_truth(segs, aggregation, vertices.len(), without)?;
            for (t, _) in truth.iter_mut().zip(&matched.counts).filter(|(_, counts)| !**counts) {
                *t = -1;
            }
            let predicted: Vec<i32> = matched.gaussian.iter().map(|i| i.map_or(-1, |i| label[i as usize])).collect();
            Some(instances::score(&truth, &predicted, &scene.instances.score, instances::MIN_POINTS))
        }
    };
    Ok((sets, instances, notes))
}

impl ScanMetrics {
    /// The protocol's name in the file.
    pub const PROTOCOL: &str = "scannet";

    /// mIoU and mAcc of the sets of 19, 15 and 10 classes.
    pub fn row(&self) -> SetRow {
        scannet::SETS.map(|size| {
            let set = self.sets.iter().find(|s| s.size == size)?;
            set.miou.zip(set.macc)
        })
    }

    /// Writes `metrics.json`, `table.md` and `objects.csv` (one row per class and set) into a folder.
    ///
    /// # Errors
    /// When a file cannot be written.
    pub fn write(&self, out: &Path) -> Result<PathBuf> {
        let mut csv = String::from("set,id,class,truth,iou,recall\n");
        let figure = |v: Option<f64>| v.map_or(String::new(), |v| format!("{v:.6}"));
        for s in &self.sets {
            for c in &s.classes {
                csv += &format!("{},{},{},{},{},{}\n", s.size, c.id, c.name, c.truth, figure(c.iou), figure(c.recall));
            }
        }
        write_bytes(out.join("objects.csv"), csv.as_bytes())?;
        write_bytes(out.join("table.md"), sheet(std::slice::from_ref(self)).markdown().as_bytes())?;
        let path = out.join("metrics.json");
        let json = serde_json::to_vec_pretty(self).map_err(|e| Error::new(e.to_string()).file(&path))?;
        write_bytes(&path, &json)?;
        Ok(path)
    }
}

/// Both ways of bringing scans together: the mean of the scans' means, and the means of the pooled points.
pub fn summary(scans: &[ScanMetrics]) -> [(&'static str, SetRow); 2] {
    let mut mean = [None; 3];
    let mut pooled = [None; 3];
    for (at, size) in scannet::SETS.into_iter().enumerate() {
        let rows: Vec<(f64, f64)> = scans.iter().filter_map(|s| s.row()[at]).collect();
        let n = rows.len() as f64;
        let sum = rows.iter().fold((0.0, 0.0), |s, r| (s.0 + r.0, s.1 + r.1));
        mean[at] = (!rows.is_empty()).then_some((sum.0 / n, sum.1 / n));
        let mut all = Confusion::new(size);
        scans.iter().flat_map(|s| &s.sets).filter(|s| s.size == size).for_each(|s| all.merge(&s.confusion));
        pooled[at] = all.means();
    }
    [("ours, mean over scenes", mean), ("ours, points pooled", pooled)]
}

/// The paper's table with the scans given, the scans one by one, and notes that name rule and feature files.
pub fn sheet(scans: &[ScanMetrics]) -> Sheet {
    let rows = summary(scans).map(|(name, row)| (name.to_string(), row));
    let mut notes =
        vec!["Published rows: percent, as printed in the source named; the authors' feature files.".to_string()];
    for s in scans {
        let features: Vec<String> = s.features.iter().map(|(k, v)| format!("{k} {v}")).collect();
        notes.push(format!("{}: {}. From {}.", s.scene, s.rule, features.join("; ")));
        notes.extend(s.notes.iter().map(|n| format!("{}: {n}.", s.scene)));
    }
    let mut sheet = published::scannet_sheet(&rows, scans.len(), notes);
    let instance = ["instance mIoU", "@25", "@50", "AP25", "AP50"].map(String::from);
    let row = |s: &ScanMetrics| {
        let i = s.instances.as_ref();
        let figures =
            [i.map(|i| i.miou), i.map(|i| i.acc25), i.map(|i| i.acc50), i.and_then(|i| i.ap25), i.and_then(|i| i.ap50)];
        let mut cells = published::set_cells(s.row());
        cells.extend(figures.map(|v| v.map(|v| 100.0 * v)));
        Row::measured(&s.scene, cells)
    };
    sheet.more.push(Table {
        title: "Scans one by one".into(),
        head: "Scan".into(),
        columns: published::set_columns().into_iter().chain(instance).collect(),
        rows: scans.iter().map(row).collect(),
        sources: false,
    });
    sheet
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
