//! What a run was made from: the records beside its outputs tell.

use crate::options::Source;
use gs_io::{Error, Result};
use query::TextOptions;
use stage::RunRecord;
use std::path::{Path, PathBuf};

/// The files of a run.
pub struct RunFolder {
    /// The folder itself.
    pub dir: PathBuf,
    /// The dataset.
    pub scene: PathBuf,
    /// The Gaussians.
    pub geometry: PathBuf,
    /// The instances.
    pub instances: PathBuf,
    /// The features that the instances were clustered from, where they are still there.
    pub features: Option<PathBuf>,
    /// What a person changed of the instances; need not be there.
    pub edits: PathBuf,
    /// Where text features come from.
    pub texts: TextOptions,
}

impl RunFolder {
    /// Finds the files of a run: what the options name, else what the records of the run name.
    ///
    /// # Errors
    /// When the run is not finished, or a record names a path that is not there any more.
    pub fn find(o: &Source) -> Result<Self> {
        let dir = o.run_dir.clone();
        let instances = dir.join("instances.safetensors");
        if !instances.is_file() {
            let there = ["features.safetensors", "graph.safetensors", "geometry.ply"];
            let last = there.iter().find(|f| dir.join(f).is_file());
            return Err(Error::new("the run is not finished")
                .file(&dir)
                .found(last.map_or("no file of a run".into(), |f| format!("{f}, but no instances.safetensors")))
                .expected("a folder with instances.safetensors")
                .hint("run make again with this OUT: it goes on where it was"));
        }
        let of_instances = arguments(&instances);
        let asked = ["score.json", "protocol/metrics.json", "query/query.json"].map(|f| arguments(&dir.join(f)));
        let features = dir.join("features.safetensors");
        let (clip, text_features) = (o.clip.clone(), o.text_features.clone());
        let mut texts = TextOptions { clip, text_features, any_model: false, min_support: None };
        if !texts.given() {
            let there = |option: &str| asked.iter().find_map(|a| existing(&path(a, option)?, &dir));
            (texts.clip, texts.text_features) = (there("--clip"), there("--text-features"));
        }
        Ok(Self {
            scene: given(o.scene.as_deref(), &of_instances, "--scene", &instances, &dir)?,
            geometry: given(o.geometry.as_deref(), &of_instances, "--geometry", &instances, &dir)?,
            features: Some(features).filter(|f| f.is_file()),
            edits: dir.join("instances.edits.json"),
            texts,
            instances,
            dir,
        })
    }

    /// All files that are read but those of the dataset.
    pub fn files(&self) -> impl Iterator<Item = &PathBuf> {
        [&self.instances, &self.geometry].into_iter().chain(&self.features)
    }
}

/// The command line that wrote a file; empty where there is no record.
fn arguments(output: &Path) -> Vec<String> {
    RunRecord::read(output).map_or(Vec::new(), |r| r.arguments)
}

/// The value of an option in a command line.
fn path(arguments: &[String], option: &str) -> Option<PathBuf> {
    let joined = arguments.iter().find_map(|a| a.strip_prefix(option)?.strip_prefix('='));
    let next = || arguments.iter().skip_while(|a| *a != option).nth(1).map(String::as_str);
    joined.or_else(next).map(PathBuf::from)
}

/// A recorded path: as it stands, or from one of the folders above the run, where make may have been called.
fn existing(recorded: &Path, run: &Path) -> Option<PathBuf> {
    let run = run.canonicalize().ok()?;
    let places = run.ancestors().map(|folder| folder.join(recorded));
    std::iter::once(recorded.to_path_buf()).chain(places).find(|p| p.exists())
}

/// The path that an option names, else the one that the command line of `output` named.
fn given(option: Option<&Path>, arguments: &[String], flag: &str, output: &Path, run: &Path) -> Result<PathBuf> {
    if let Some(path) = option {
        return Ok(path.to_path_buf());
    }
    let record = RunRecord::path(output);
    let e = |what: &str| Error::new(what).file(&record).field(flag).hint(format!("give it with {flag}"));
    let recorded = path(arguments, flag).ok_or_else(|| e("the record of the run does not name it"))?;
    let found = existing(&recorded, run);
    found.ok_or_else(|| e("what the run was made from is not there").found(recorded.display()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_are_found_in_a_command_line() {
        let line = ["--scene", "a b", "--geometry=c=d", "--clip"].map(String::from);
        let at = |option: &str| path(&line, option).map(|p| p.to_string_lossy().into_owned());
        assert_eq!(at("--scene").as_deref(), Some("a b"));
        assert_eq!(at("--geometry").as_deref(), Some("c=d"));
        assert_eq!((at("--clip"), at("--masks")), (None, None));
    }

    #[test]
    fn a_run_half_finished_is_said() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("geometry.ply"), "ply").unwrap();
        let o =
            Source { run_dir: dir.path().into(), scene: None, geometry: None, clip: None, text_features: None, sh: 0 };
        let e = RunFolder::find(&o).err().unwrap().to_string();
        assert!(e.contains("not finished; found geometry.ply, but no instances.safetensors"), "{e}");
        std::fs::write(dir.path().join("instances.safetensors"), "").unwrap();
        let e = RunFolder::find(&o).err().unwrap().to_string();
        assert!(e.contains("give it with --scene"), "{e}");
    }
}
