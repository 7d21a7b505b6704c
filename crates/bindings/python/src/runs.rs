//! Finished runs: their files, what they label, and questions in words.

use crate::work::run;
use artifacts::{InstanceNames, called};
use gs_io::{Artifact, Error};
use gs_scene::dataset::{self, LoadOptions};
use numpy::{IntoPyArray, PyArray1};
use objects::Up;
use pyo3::exceptions::{PyOSError, PyValueError};
use pyo3::prelude::*;
use query::{Granules, Index, LabelledScene, TextOptions, TextSource, Unrelated, Verdict, different};
use std::path::PathBuf;

/// What is wrong with a file.
fn failed(e: &Error) -> PyErr {
    PyValueError::new_err(e.to_string())
}

/// The file or folder that a run was made from, or wrote, for an option of the programs such as `geometry`.
#[pyfunction]
pub fn input_of_run(folder: PathBuf, option: &str) -> PyResult<Option<PathBuf>> {
    if !folder.is_dir() {
        return Err(PyOSError::new_err(format!("{}: no such folder", folder.display())));
    }
    Ok(stage::input_of_run(&folder, option))
}

/// Checks an artifact's checksum, format and version; what its provenance says, as JSON.
#[pyfunction]
pub fn check_artifact(py: Python<'_>, path: PathBuf, format: &str, version: u32) -> PyResult<String> {
    let artifact = run(py, 1, |_| Artifact::open(&path, format, version))?.map_err(|e| failed(&e))?;
    serde_json::to_string(artifact.provenance()).map_err(|e| PyValueError::new_err(e.to_string()))
}

/// Instances with their Gaussians, a person's edits included.
#[pyclass(frozen)]
pub struct Labelled {
    scene: LabelledScene,
}

#[pymethods]
impl Labelled {
    #[new]
    fn new(py: Python<'_>, instances: PathBuf, geometry: PathBuf, edits: Option<PathBuf>) -> PyResult<Self> {
        let read = run(py, 0, |_| LabelledScene::read(&instances, &geometry, edits.as_deref()))?;
        Ok(Self { scene: read.map_err(|e| failed(&e))? })
    }

    /// Instance of every Gaussian, -1 for none.
    fn labels<'py>(&self, py: Python<'py>) -> Bound<'py, PyArray1<i32>> {
        self.scene.instances.label.clone().into_pyarray(py)
    }

    /// Fit, views and Gaussians of what masks show as one, by falling fit, without those that share `overlap` with a better one.
    fn proposals<'py>(&self, py: Python<'py>, overlap: f64) -> Vec<(f32, u32, Bound<'py, PyArray1<u32>>)> {
        let instances = &self.scene.instances;
        let mut sets: Vec<_> = instances.granules.iter().map(|g| (g.fit, g.gaussians(instances))).collect();
        let kept = different(&sets, instances.label.len(), overlap);
        let of = |k: usize| (sets[k].0, instances.granules[k].support, std::mem::take(&mut sets[k].1).into_pyarray(py));
        kept.into_iter().map(of).collect()
    }

    /// `scene.json`; boxes are upright where a dataset says what is up. `names` is a names.json about these instances.
    fn objects(&self, py: Python<'_>, scene: Option<PathBuf>, names: Option<PathBuf>) -> PyResult<String> {
        let described = run(py, 0, |_| {
            let dataset = scene.map(|path| dataset::load(&path, &LoadOptions::default())).transpose()?;
            let up = dataset.and_then(|d| Up::of_cameras(d.views.iter().map(|v| &v.camera)));
            let s = &self.scene;
            let names = names.map(|path| InstanceNames::read(path, s.artifact.hash())).transpose()?;
            let names = called(names.as_ref(), &s.remarks).into_iter().map(|(k, c)| (k, c.into())).collect();
            Ok(objects::describe(&s.instances, s.gaussians(), &s.remarks, &names, up, s.inputs.clone()))
        })?;
        let described = described.map_err(|e: Error| failed(&e))?;
        serde_json::to_string(&described).map_err(|e| PyValueError::new_err(e.to_string()))
    }
}

/// A language model or a table of text features that fits the instances.
#[pyclass(frozen)]
pub struct Words {
    source: TextSource,
    unrelated: Option<Unrelated>,
}

/// Instances with their scores, and whether any matches, by which score and which one by chance.
type Answer = (Vec<(u32, f32)>, Option<(bool, f32, f32)>);

#[pymethods]
impl Words {
    #[new]
    fn new(
        py: Python<'_>,
        labelled: &Labelled,
        clip: Option<PathBuf>,
        text_features: Option<PathBuf>,
    ) -> PyResult<Self> {
        let scene = &labelled.scene;
        let options = TextOptions { clip, text_features, ..TextOptions::default() };
        let opened = run(py, 0, |_| {
            let source = TextSource::open_for(&scene.artifact, scene.instances.dim(), &options)?;
            let unrelated = Unrelated::encode(&source, &[])?;
            Ok(Self { source, unrelated })
        })?;
        opened.map_err(|e: Error| failed(&e))
    }

    /// Instances by falling cosine of their descriptors with the text, and whether it matches anything.
    fn rank(&self, py: Python<'_>, labelled: &Labelled, text: &str) -> PyResult<Answer> {
        let ranked = run(py, 0, |_| {
            let feature = self.source.known(&[], &[text.to_string()], "text")?.remove(0);
            let instances = &labelled.scene.instances;
            let (index, granules) = (Index::new(instances), Granules::new(instances));
            let by_chance = self.unrelated.as_ref().and_then(|u| u.chance(&index, &granules, &[], 1));
            let verdict = by_chance.and_then(|chance| Verdict::on(&feature, chance, &index, &granules, &[], 1));
            let ranking = index.rank(&feature, &[]).into_iter().map(|r| (r.instance, r.score)).collect();
            Ok((ranking, verdict.map(|v| (v.matches, v.best, v.by_chance))))
        })?;
        ranked.map_err(|e: Error| failed(&e))
    }
}
