//! The stages one after another on a scene: what each is given, and what its run took.

use gs_io::{Error, IoContext, Result, create_dir, with_suffix};
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::str::FromStr;

/// A stage of the pipeline, in order.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Stage {
    /// `gs-geom train`.
    Geometry,
    /// `graph-precompute`.
    Graph,
    /// `feat-train`.
    Features,
    /// `cluster-match`.
    Instances,
}

/// All stages, in order.
pub const STAGES: [Stage; 4] = [Stage::Geometry, Stage::Graph, Stage::Features, Stage::Instances];

impl Stage {
    /// As plans name it.
    pub fn name(self) -> &'static str {
        ["geometry", "graph", "features", "instances"][self as usize]
    }
}

impl FromStr for Stage {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        let names = STAGES.map(Self::name);
        let found = STAGES.into_iter().find(|s| s.name() == text);
        found.ok_or_else(|| Error::new("no such stage").found(text).expected(names.join(", ")))
    }
}

#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Options(BTreeMap<Stage, Vec<String>>);

impl Options {
    /// Options of one stage, with spaces between.
    pub fn of(stage: Stage, text: &str) -> Self {
        Self(BTreeMap::from([(stage, words(text))]))
    }

    /// Reads `stage: options; stage: options`.
    pub fn parse(text: &str) -> Result<Self> {
        let mut all = Self::default();
        for part in text.split(';').map(str::trim).filter(|p| !p.is_empty()) {
            let (stage, options) = part.split_once(':').ok_or_else(|| {
                Error::new("options of no stage").found(part).expected("stage: options; stage: options")
            })?;
            all.0.extend(Self::of(stage.trim().parse()?, options).0);
        }
        Ok(all)
    }

    /// The same with other options of one stage.
    pub fn with(mut self, stage: Stage, options: Vec<String>) -> Self {
        self.0.insert(stage, options);
        self
    }

    pub fn get(&self, stage: Stage) -> &[String] {
        self.0.get(&stage).map_or(&[], Vec::as_slice)
    }

    /// As [`Self::parse`] reads it.
    pub fn text(&self) -> String {
        let parts = self.0.iter().filter(|(_, o)| !o.is_empty());
        parts.map(|(s, o)| format!("{}: {}", s.name(), o.join(" "))).collect::<Vec<_>>().join("; ")
    }
}

/// What a run of a stage took, as its record says.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Cost {
    pub wall: f64,
    /// Processor seconds of all its threads.
    pub cpu: f64,
    /// Peak memory in bytes; 0 where the record of the run does not say.
    pub peak: u64,
}

/// Where the programs are, and how many threads they get.
#[derive(Debug, Clone)]
pub struct Programs {
    pub folder: PathBuf,
    pub threads: usize,
}

impl Programs {
    /// Runs a command line, the program's name first, to its end, quietly.
    pub fn run(&self, command: &[String]) -> Result<()> {
        let (program, arguments) = command.split_first().expect("a program");
        let path = self.folder.join(program);
        let output = Command::new(&path)
            .args(arguments)
            .args(["--quiet", "--threads", &self.threads.to_string()])
            .output()
            .at("run", &path)?;
        if !output.status.success() {
            let said = String::from_utf8_lossy(&output.stderr).trim().to_string();
            return Err(Error::new(format!("{program} failed ({}): {said}", output.status)).file(&path));
        }
        Ok(())
    }
}

/// The files of a scene and of what the stages make of it. Who reads and writes which of them is the pipeline.
#[derive(Debug, Clone)]
pub struct Files {
    pub scene: PathBuf,
    pub masks: PathBuf,
    /// Text features of the categories.
    pub texts: PathBuf,
    pub geometry: PathBuf,
    pub graph: PathBuf,
    /// The footprints beside it.
    pub footprints: PathBuf,
    pub features: PathBuf,
    pub instances: PathBuf,
    pub score: PathBuf,
}

impl Files {
    /// A synthetic scene in `folder`, with what is made of it.
    pub fn of(folder: &Path) -> Self {
        let scene = folder.join("scene");
        let own = |name: &str| folder.join("exact").join(name);
        Self {
            masks: scene.join("language_features"),
            texts: scene.join("truth/text_features.json"),
            geometry: folder.join("geometry.ply"),
            graph: own("graph.safetensors"),
            footprints: own("footprints.safetensors"),
            features: own("features.safetensors"),
            instances: own("instances.safetensors"),
            score: own("score.json"),
            scene,
        }
    }

    /// The same scene, masks and geometry; everything after them in another folder.
    pub fn within(&self, folder: &Path) -> Self {
        let own = |path: &Path| folder.join(path.file_name().unwrap_or_default());
        Self {
            graph: own(&self.graph),
            footprints: own(&self.footprints),
            features: own(&self.features),
            instances: own(&self.instances),
            score: own(&self.score),
            ..self.clone()
        }
    }

    /// The file that a stage writes; of the graph's two the graph.
    pub fn output(&self, stage: Stage) -> &Path {
        match stage {
            Stage::Geometry => &self.geometry,
            Stage::Graph => &self.graph,
            Stage::Features => &self.features,
            Stage::Instances => &self.instances,
        }
    }

    /// The command line of a stage: its program, then its arguments without further options.
    pub fn command(&self, stage: Stage) -> Vec<String> {
        let (scene, geometry) = (("--scene", &*self.scene), ("--geometry", &*self.geometry));
        let (graph, footprints) = (("--graph", &*self.graph), ("--footprints", &*self.footprints));
        let (masks, out) = (("--masks", &*self.masks), ("--out", self.output(stage)));
        match stage {
            Stage::Geometry => command(&["gs-geom", "train"], &[scene, out]),
            Stage::Graph => command(&["graph-precompute"], &[scene, geometry, masks, footprints, graph]),
            Stage::Features => command(&["feat-train"], &[geometry, graph, footprints, out]),
            Stage::Instances => {
                let features = ("--features", &*self.features);
                command(&["cluster-match"], &[scene, geometry, graph, footprints, features, masks, out])
            }
        }
    }

    /// The command line of the score.
    pub fn scoring(&self) -> Vec<String> {
        let mut files = vec![("--scene", &*self.scene), ("--geometry", &*self.geometry)];
        files.extend([("--instances", &*self.instances), ("--out", &*self.score), ("--text-features", &*self.texts)]);
        command(&["eval", "score"], &files)
    }

    pub fn run(&self, programs: &Programs, stage: Stage, options: &Options) -> Result<Cost> {
        create_dir(self.output(stage).parent().unwrap_or(Path::new(".")))?;
        // A run that goes on from the checkpoint of a killed one would seem faster than it is.
        let _ = std::fs::remove_file(with_suffix(self.output(stage), ".checkpoint"));
        programs.run(&[&self.command(stage)[..], options.get(stage)].concat())?;
        let record = stage::RunRecord::read(self.output(stage))?;
        let (cpu, peak) = (record.cpu_seconds.unwrap_or(f64::NAN), record.peak_rss_bytes.unwrap_or(0));
        Ok(Cost { wall: record.wall_seconds, cpu, peak })
    }

    /// Scores the instances: the figures of `score.json`.
    pub fn evaluate(&self, programs: &Programs) -> Result<Value> {
        programs.run(&self.scoring())?;
        read_json(&self.score)
    }
}

/// Words, then options with files.
pub fn command(words: &[&str], files: &[(&str, &Path)]) -> Vec<String> {
    let files = files.iter().flat_map(|(option, path)| [(*option).to_string(), path.to_string_lossy().into_owned()]);
    words.iter().map(|w| (*w).to_string()).chain(files).collect()
}

/// Options as they are typed, with spaces between.
pub fn words(text: &str) -> Vec<String> {
    text.split_whitespace().map(String::from).collect()
}

pub fn read_json(path: &Path) -> Result<Value> {
    let bytes = std::fs::read(path).at("read", path)?;
    serde_json::from_slice(&bytes).map_err(|e| Error::new(format!("not JSON: {e}")).file(path))
}
