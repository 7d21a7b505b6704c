//! The cells of a plan's tables: a score for every scene, seed, granularity, features and clustering. What several cells need
//! is made once.

use crate::chain::{Files, Programs, Stage, command, read_json, words};
use crate::plan::{NAMED_MASKS, Plan, Product, Row, Scene};
use crate::task::{Task, Tasks};
use gs_io::Result;
use serde_json::Value;
use stage::RunRecord;
use std::path::{Path, PathBuf};

/// A number that each cell gives.
#[derive(Debug, Clone, Copy)]
pub struct Metric {
    pub name: &'static str,
    pub title: &'static str,
    /// Whether it is a share, shown in percent.
    pub share: bool,
    /// Where it stands in `score.json`.
    at: &'static str,
}

const fn metric(name: &'static str, title: &'static str, share: bool, at: &'static str) -> Metric {
    Metric { name, title, share, at }
}

/// All metrics, in the order of tables.
pub const METRICS: [Metric; 13] = [
    metric("instance_miou", "instance mIoU", true, "/instance_miou"),
    metric("ap25", "AP25", true, "/ap25"),
    metric("ap50", "AP50", true, "/ap50"),
    metric("gaussian_miou", "mIoU of Gaussians", true, "/gaussians/instance_miou"),
    metric("gaussian_ap25", "their AP25", true, "/gaussians/ap25"),
    metric("gaussian_ap50", "their AP50", true, "/gaussians/ap50"),
    metric("query_miou", "query mIoU", true, "/query_miou"),
    metric("query_macc25", "query mAcc@0.25", true, "/query_macc25"),
    metric("query_miou_visible", "query mIoU, visible", true, "/query_miou_visible"),
    metric("query_miou_parts", "of parts", true, "/parts/query_miou"),
    metric("query_miou_groups", "of groups", true, "/groups/query_miou"),
    metric("fragmentation", "fragmentation", false, "/instances_per_thing"),
    metric("merging", "merging", false, "/things_per_instance"),
];

/// What came of a cell.
#[derive(Debug, Clone, PartialEq)]
pub struct Cell {
    /// `scene-seed`.
    pub scene: String,
    /// A value for each of [`METRICS`].
    pub values: Vec<Option<f64>>,
    /// Processor seconds of the features and of the clustering.
    pub seconds: Option<f64>,
    /// Peak memory of both in bytes.
    pub peak: Option<u64>,
    /// Mean cosine of a mask's Gaussians with its centroid in the last view trained on; none for closed forms.
    pub alignment: Option<f64>,
    /// Bytes of the graph network per Gaussian.
    pub network: Option<f64>,
}

const INSTANCES: &str = "instances.safetensors";
const DESCRIPTORS: &str = "descriptors.safetensors";

/// Where a cell's files lie; a clustering that makes descriptors alone has them in the place of its instances.
pub fn files(plan: &Plan, folder: &Path, scene: &str, p: &str, row: &Row) -> Files {
    let (scene, own) = (folder.join(scene), folder.join(scene).join(format!("p{p}")));
    let footprints = plan.footprints_of.get(&row.features).map_or("", String::as_str);
    let file = |name: &str, kind: &str| own.join(format!("{name}.{kind}"));
    Files {
        masks: own.join("masks"),
        texts: own.join("masks/text_features.json"),
        geometry: scene.join("geometry.ply"),
        graph: file(footprints, "graph.safetensors"),
        footprints: file(footprints, "footprints.safetensors"),
        features: file(&row.features, "features.safetensors"),
        instances: file(
            &row.id(),
            if plan.product(&row.clustering) == Product::Descriptors { DESCRIPTORS } else { INSTANCES },
        ),
        score: file(&row.id(), "score.json"),
        scene: scene.join("scene"),
    }
}

/// Every scene with every seed, and its name.
fn scenes(plan: &Plan) -> impl Iterator<Item = (&Scene, u64, String)> {
    plan.scenes.iter().flat_map(|s| plan.seeds.iter().map(move |&seed| (s, seed, format!("{}-{seed}", s.name))))
}

/// Adds the runs that make a cell, each of one thread.
fn add(tasks: &mut Tasks, plan: &Plan, files: &Files, (scene, seed): (&Scene, u64), p: &str, row: &Row) {
    let synth = |to: (&str, &Path), more: &str| {
        let options = format!("{} --seed {seed} {more}", scene.scene);
        [command(&["synth-scene"], &[to]), words(&options)].concat()
    };
    let run = |stage, options: &str| [files.command(stage), words(options)].concat();
    let photographs = Task::new(files.scene.join("truth/scene.json"), synth(("--out", &files.scene), ""), &[]);
    let photographs = tasks.add(0, photographs);
    let masks = match p {
        p if NAMED_MASKS.contains(&p) => format!("--corruption {p} --features"),
        p => format!("{} --granularity-p {p} --features", plan.options_of("masks", "")),
    };
    let masks = Task::new(files.masks.join("masks.json"), synth(("--masks-to", &files.masks), &masks), &[&photographs]);
    let masks = tasks.add(1, masks);
    let geometry = run(Stage::Geometry, &scene.geometry);
    let geometry = tasks.add(1, Task::new(files.geometry.clone(), geometry, &[&photographs]));
    let footprints = plan.footprints_of.get(&row.features).map_or("", String::as_str);
    let graph = run(Stage::Graph, plan.options_of("footprints", footprints));
    let graph = tasks.add(2, Task::new(files.graph.clone(), graph, &[&geometry, &masks]));
    let made = plan.options_of("features", &row.features);
    let base = if made == "-" {
        graph
    } else {
        let out = ("--out", &*files.features);
        let command = peer(files, made, &[out]).unwrap_or_else(|| run(Stage::Features, made));
        tasks.add(3, Task::new(files.features.clone(), command, &[&graph]))
    };
    let how = plan.options_of("clustering", &row.clustering);
    let (product, beside) = (plan.product(&row.clustering), descriptors_beside(files));
    let mut more = vec![("--out", &*files.instances)];
    if made != "-" {
        more.push(("--features", &files.features));
    }
    if product == Product::Both {
        more.push(("--descriptors", &beside));
    }
    let clustering = peer(files, how, &more).unwrap_or_else(|| run(Stage::Instances, how));
    let instances = tasks.add(4, Task::new(files.instances.clone(), clustering, &[&base]));
    let mut scoring = files.scoring();
    match product {
        Product::Instances => {}
        // The file is of another kind.
        Product::Descriptors => {
            scoring.iter_mut().filter(|w| *w == "--instances").for_each(|w| *w = "--descriptors".to_string());
        }
        Product::Both => scoring.extend(command(&[], &[("--descriptors", &beside)])),
    }
    let options = plan.options_of("scoring", &row.clustering);
    scoring.extend(words(options));
    if options.contains("--join") {
        scoring.extend(command(&[], &[("--features", &files.features)]));
    }
    tasks.add(5, Task::new(files.score.clone(), scoring, &[&instances]));
}

/// Where a clustering puts descriptors that it makes beside instances.
pub fn descriptors_beside(files: &Files) -> PathBuf {
    let name = files.instances.file_name().unwrap_or_default().to_string_lossy().replace(INSTANCES, DESCRIPTORS);
    files.instances.with_file_name(name)
}

/// The command line of a rival, where `options` are `peers SYSTEM ...`, with these files besides the inputs of all.
fn peer(files: &Files, options: &str, more: &[(&str, &Path)]) -> Option<Vec<String>> {
    let words = words(options.strip_prefix("peers ")?);
    let (system, options) = words.split_first()?;
    let inputs = [
        ("--scene", &*files.scene),
        ("--geometry", &files.geometry),
        ("--graph", &files.graph),
        ("--footprints", &files.footprints),
        ("--masks", &files.masks),
    ];
    Some([command(&["peers", system], &[&inputs, more].concat()), options.to_vec()].concat())
}

/// Runs what the plan's tables need and is not there yet.
pub fn run(programs: &Programs, plan: &Plan, folder: &Path, stage: &stage::Stage) -> Result<()> {
    let mut tasks = Tasks::default();
    for (scene, seed, name) in scenes(plan) {
        for table in &plan.tables {
            for (p, row) in table.p.iter().flat_map(|p| table.rows.iter().map(move |row| (p, row))) {
                add(&mut tasks, plan, &files(plan, folder, &name, p, row), (scene, seed), p, row);
            }
        }
    }
    let programs = Programs { threads: 1, ..programs.clone() };
    // Hundreds of coloured PLYs would fill the disk.
    tasks.run(&programs, stage, |output| {
        if output.to_string_lossy().ends_with(".instances.safetensors") {
            for side in ["ply", "labels.npy"].map(|e| output.with_extension(e)) {
                let _ = std::fs::remove_file(side);
            }
        }
    })
}

/// Cells of a row at a p, in the order of scenes and seeds.
pub fn read(plan: &Plan, folder: &Path, row: &Row, p: &str) -> Result<Vec<Cell>> {
    scenes(plan).map(|(_, _, name)| cell(plan, row, &files(plan, folder, &name, p, row), name)).collect()
}

fn cell(plan: &Plan, row: &Row, files: &Files, scene: String) -> Result<Cell> {
    let score: Value = read_json(&files.score)?;
    let instances = RunRecord::read(&files.instances).ok();
    let (features, made) = (RunRecord::read(&files.features).ok(), plan.options_of("features", &row.features) != "-");
    let features = features.filter(|_| made);
    // Without features there is nothing to add to.
    let both = |of: &dyn Fn(&RunRecord) -> Option<f64>, join: fn(f64, f64) -> f64| {
        let own = of(instances.as_ref()?)?;
        if made { Some(join(of(features.as_ref()?)?, own)) } else { Some(own) }
    };
    let number = |at: &str| features.as_ref().and_then(|r| r.summary.pointer(at)?.as_f64());
    Ok(Cell {
        scene,
        values: METRICS.iter().map(|m| score.pointer(m.at).and_then(Value::as_f64)).collect(),
        seconds: both(&|r| r.cpu_seconds, |a, b| a + b),
        peak: both(&|r| Some(r.peak_rss_bytes? as f64), f64::max).map(|bytes| bytes as u64),
        alignment: number("/last/alignment"),
        network: number("/network_bytes").zip(number("/gaussians")).filter(|n| n.1 > 0.0).map(|(b, n)| b / n),
    })
}
