//! How the instances of a scene were made, for the rows and notes of tables: read from their provenance and from the records of
//! the runs before them.

use artifacts::role;
use gs_io::Provenance;
use query::LabelledScene;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use stage::RunRecord;
use std::path::{Path, PathBuf};

/// How instances were made; what no file says is none.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Made {
    /// `closed form`, or the preset of feat-train.
    pub method: Option<String>,
    /// Iterations of training; none in closed form.
    pub iterations: Option<u64>,
    /// `graph` or `free`.
    pub clustering: Option<String>,
    /// `given`: LangSplat's or other files; `SAM`: of mask-embed; `imported`: label pictures that mask-embed turned into id maps.
    pub masks: Option<String>,
    /// Of the masks: `given`, `CLIP` of mask-embed, or `none`.
    pub features: Option<String>,
}

/// What stands where scenes differ.
const MIXED: &str = "mixed";

impl Made {
    /// How the instances of a scene were made. What is not where the record of their run says, or is not what they were made
    /// from, is not known.
    pub fn of(scene: &LabelledScene) -> Self {
        let provenance = scene.artifact.provenance();
        let text = |v: &Value| v.as_str().map(String::from);
        let mut made = Self { clustering: text(&provenance.parameters["cluster"]), ..Self::default() };
        let Some(record) = RunRecord::read(scene.path()).ok().filter(|r| r.inputs == provenance.inputs) else {
            return made;
        };
        let given = |option: &str| files(&record.arguments, option, scene.path());
        if made.clustering.as_deref() == Some("masks") {
            made.method = Some("no training".into());
        }
        if let Some(trained) = given("--features").iter().find_map(|path| trained(path, provenance)) {
            made.method = Some(text(&trained["preset"]).unwrap_or_else(|| "closed form".into()));
            made.iterations = trained["contrastive"]["iterations"].as_u64();
        }
        if let Some(folder) = given("--masks").into_iter().find(|folder| folder.is_dir()) {
            let masks = manifest(&folder.join("masks.json"));
            let from = |role: &str| masks.as_ref().is_some_and(|m| m.inputs.contains_key(role));
            made.masks = Some(
                if from("sam") {
                    "SAM"
                } else if from("labels") {
                    "imported"
                } else {
                    "given"
                }
                .into(),
            );
            let own = manifest(&folder.join("features.json"))
                .is_some_and(|m| m.inputs.get(role::MASKS) == provenance.inputs.get(role::MASKS));
            let features = if own { "CLIP" } else { "given" };
            made.features = Some(if scene.instances.dim() == 0 { "none" } else { features }.into());
        }
        made
    }

    /// What is the same for all scenes; `mixed` where they differ.
    pub fn common<'a>(all: impl IntoIterator<Item = &'a Self>) -> Self {
        let mut all = all.into_iter();
        let mut common = all.next().cloned().unwrap_or_default();
        for made in all {
            // Iterations of several numbers are none that could be named.
            if made.method != common.method || made.iterations != common.iterations {
                (common.method, common.iterations) = (Some(MIXED.into()), None);
            }
            for (ours, theirs) in [
                (&mut common.clustering, &made.clustering),
                (&mut common.masks, &made.masks),
                (&mut common.features, &made.features),
            ] {
                if ours != theirs {
                    *ours = Some(MIXED.into());
                }
            }
        }
        common
    }

    /// The name of a row: method with its iterations, clustering, where masks and their features came from.
    pub fn describe(&self) -> String {
        let or = |v: &Option<String>| v.clone().unwrap_or_else(|| "unrecorded".into());
        let iterations = self.iterations.map_or(String::new(), |n| format!(" ({n} iterations)"));
        let method = self.method.clone().unwrap_or_else(|| "unrecorded method".into());
        let (clustering, masks, features) = (or(&self.clustering), or(&self.masks), or(&self.features));
        format!("{method}{iterations}, {clustering} clustering, {masks} masks, {features} features")
    }

    /// What a table must say of data that stand in for others.
    pub fn notes(&self) -> Vec<String> {
        let is = |v: &Option<String>, name: &str| v.as_deref() == Some(name);
        let masks = is(&self.masks, "SAM").then_some(
            "there are no masks of LangSplat; those of SAM, made here by mask-embed, stand in their place: published rows \
             are of other masks",
        );
        let features = is(&self.features, "CLIP").then_some(
            "the masks have no features of LangSplat; CLIP's, made here by mask-embed, stand in their place",
        );
        [masks, features].into_iter().flatten().map(String::from).collect()
    }
}

/// Where the file or folder of an option may lie now: as the run was told, or beside the instances.
fn files(arguments: &[String], option: &str, instances: &Path) -> Vec<PathBuf> {
    let next =
        arguments.iter().zip(arguments.iter().skip(1)).find(|(a, _)| *a == option).map(|(_, value)| value.as_str());
    let joined = arguments.iter().find_map(|a| a.strip_prefix(option)?.strip_prefix('='));
    let Some(told) = next.or(joined).map(PathBuf::from) else { return Vec::new() };
    let beside = told.file_name().and_then(|name| Some(instances.parent()?.join(name)));
    [told].into_iter().chain(beside).collect()
}

/// The parameters of the run that made the features at `path`, if the instances are of these.
fn trained(path: &Path, instances: &Provenance) -> Option<Value> {
    let (record, hash) = (RunRecord::read(path).ok()?, instances.inputs.get(role::FEATURES)?);
    let made = record.written.files.values().flatten().any(|h| h == hash);
    made.then_some(record.parameters)
}

/// What mask-embed says of a folder of masks; none where another program made them.
fn manifest(path: &Path) -> Option<Provenance> {
    serde_json::from_slice(&std::fs::read(path).ok()?).ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn made(method: &str, iterations: Option<u64>, masks: &str) -> Made {
        let some = |text: &str| Some(text.to_string());
        Made { method: some(method), iterations, clustering: some("free"), masks: some(masks), features: some("given") }
    }

    #[test]
    fn a_row_says_how_its_scenes_were_made() {
        let paper = made("paper", Some(10_000), "given");
        let row = "paper (10000 iterations), free clustering, given masks, given features";
        assert_eq!((paper.describe().as_str(), Made::common([&paper, &paper])), (row, paper.clone()));
        let closed = made("closed form", None, "SAM");
        let row = "mixed, free clustering, mixed masks, given features";
        assert_eq!(Made::common([&paper, &closed]).describe(), row);
        assert_eq!(Made::common([&paper, &made("paper", Some(5), "given")]).iterations, None, "they differ");
        let row = "unrecorded method, unrecorded clustering, unrecorded masks, unrecorded features";
        assert_eq!(Made::common([]).describe(), row);
    }

    #[test]
    fn what_stands_in_for_langsplats_files_is_said() {
        assert!(made("paper", None, "given").notes().is_empty());
        let notes = Made { features: Some("CLIP".into()), ..made("paper", None, "SAM") }.notes();
        assert!(
            notes[0].contains("no masks of LangSplat") && notes[1].contains("no features of LangSplat"),
            "{notes:?}"
        );
    }

    #[test]
    fn a_file_is_looked_for_where_it_was_and_beside_the_instances() {
        let arguments = ["--features", "a/f.safetensors", "--masks=b/masks"].map(String::from);
        let of = |option: &str| files(&arguments, option, Path::new("c/instances.safetensors"));
        assert_eq!(of("--features"), [Path::new("a/f.safetensors"), Path::new("c/f.safetensors")]);
        assert_eq!(of("--masks"), [Path::new("b/masks"), Path::new("c/masks")]);
        assert!(of("--graph").is_empty());
    }
}
