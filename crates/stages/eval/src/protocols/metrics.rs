//! What the protocols of all benchmarks write for a scene.

use super::made::Made;
use artifacts::role;
use gs_io::{Outputs, Result, write_bytes, write_json};
use query::{LabelledScene, TextSource};
use report::sheet::Sheet;
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use stage::Stage;
use std::collections::BTreeMap;
use std::path::Path;

/// `metrics.json` of a scene, with the figures of a protocol.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Metrics<F> {
    /// Name of the protocol.
    pub protocol: String,
    /// Name of the scene.
    pub scene: String,
    /// The rule that the numbers follow, in words.
    pub rule: String,
    /// How the instances were made; none where another program's masks or labels were scored.
    #[serde(default)]
    pub made: Option<Made>,
    /// Files and models that the numbers come from.
    pub features: BTreeMap<String, String>,
    /// What was measured.
    #[serde(flatten)]
    pub figures: F,
    /// What is odd: zeros with their reasons, what was left out.
    pub notes: Vec<String>,
}

/// The figures of a scene by a protocol.
pub trait Protocol: Serialize + DeserializeOwned {
    /// The protocol's name in the file.
    const NAME: &str;

    /// Whether figures that were read from a file fit together.
    fn is_sound(&self) -> bool {
        true
    }

    /// Whether the table of these scenes has published rows.
    fn is_published(_scenes: &[Metrics<Self>]) -> bool {
        true
    }

    /// Figures by another rule, in words.
    fn remark(&self) -> Option<String> {
        None
    }

    /// The paper's table with these scenes; what was measured has rows that begin with [`row`].
    fn sheet(scenes: &[Metrics<Self>], notes: Vec<String>) -> Sheet;

    /// What `metrics.json` says of these scenes together.
    fn summary(scenes: &[Metrics<Self>]) -> Value;
}

impl<F: Protocol> Metrics<F> {
    /// Writes `metrics.json` and `table.md` into a folder; gives the table.
    pub fn write(&self, out: &Path, stage: &Stage) -> Result<String> {
        self.notes.iter().for_each(|n| stage.warn(n));
        let table = sheet(std::slice::from_ref(self)).markdown();
        write_bytes(out.join("table.md"), table.as_bytes())?;
        write_json(out.join("metrics.json"), self)?;
        Ok(table)
    }
}

/// The paper's table with the scenes given, and notes that name rule and feature files.
pub fn sheet<F: Protocol>(scenes: &[Metrics<F>]) -> Sheet {
    let published = "Published rows: percent, as printed in the source named; the authors' feature files.";
    let mut notes: Vec<String> = F::is_published(scenes).then(|| published.into()).into_iter().collect();
    for s in scenes {
        let features: Vec<String> = s.features.iter().map(|(k, v)| format!("{k} {v}")).collect();
        notes.push(format!("{}: {}. From {}.", s.scene, s.rule, features.join("; ")));
        let stand_ins = s.made.iter().flat_map(Made::notes);
        notes.extend(
            s.figures
                .remark()
                .into_iter()
                .chain(stand_ins)
                .chain(s.notes.clone())
                .map(|n| format!("{}: {n}.", s.scene)),
        );
    }
    F::sheet(scenes, notes)
}

/// What a row of these scenes begins with: how their instances were made, or `another` where another program made what was
/// scored.
pub fn row<F>(scenes: &[&Metrics<F>], another: &str) -> String {
    let made: Vec<&Made> = scenes.iter().filter_map(|s| s.made.as_ref()).collect();
    if made.is_empty() { another.into() } else { Made::common(made).describe() }
}

/// `metrics.json` of a protocol, whose record lies beside it, and `table.md` in the same folder.
pub fn outputs(folder: &Path, stage: &Stage) -> Outputs {
    let metrics = folder.join("metrics.json");
    stage.outputs(&metrics).file(&metrics).file(folder.join("table.md"))
}

/// What the answers of a scene come from, with the first digits of the hashes.
pub fn sources(scene: &LabelledScene, texts: Option<&TextSource>) -> Result<BTreeMap<String, String>> {
    let mut features = BTreeMap::from([("instances".to_string(), format!("{:.12}", scene.artifact.hash()))]);
    if let Some(source) = texts {
        features.insert("text features".into(), format!("{} ({:.12})", source.describe(), source.hash()?));
    }
    if let Some(edits) = scene.inputs.get(role::EDITS) {
        features.insert("edits".into(), format!("{edits:.12}"));
    }
    if let Some(masks) = scene.artifact.provenance().inputs.get(role::MASK_FEATURES) {
        features.insert("mask features".into(), format!("{masks:.12}"));
    }
    Ok(features)
}
