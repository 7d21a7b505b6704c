//! The cameras of a dataset as a training refined them, in a file that stands for the dataset: photographs, points and names are
//! the dataset's own.

use super::{Dataset, RawDataset};
use crate::Camera;
use glam::{DMat3, DQuat, DVec3};
use gs_io::{Error, IoContext, Result, write_json};
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// What the file says that it is.
const FORMAT: &str = "refined cameras";
const AGAIN: &str = "train the geometry again with --refine-poses";

/// Writes the cameras of `dataset`, in the order of its views, as they were refined at the size of the views: poses, and focal
/// lengths by their factor. The dataset's folder is named relative to the file where it lies below that, so that both can be moved
/// together, and else from the root.
pub fn write(path: &Path, dataset: &Dataset, cameras: &[Camera]) -> Result<()> {
    assert_eq!(cameras.len(), dataset.views.len());
    let full = |p: &Path| std::fs::canonicalize(p).at("find", p);
    let root = full(&dataset.root)?;
    let beside = path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let scene = root.strip_prefix(full(beside)?).ok().filter(|p| !p.as_os_str().is_empty()).unwrap_or(&root);
    let scene = scene.to_str().ok_or_else(|| {
        Error::new("the dataset's folder has no name in Unicode").file(&root).hint("rename it, or give a link to it")
    })?;
    let views: BTreeMap<&str, Value> = dataset
        .views
        .iter()
        .zip(cameras)
        .map(|(v, c)| {
            let q = DQuat::from_mat3(&c.rotation);
            let translation = c.translation - c.rotation * DVec3::from(dataset.shift);
            let pose = json!({
                "rotation": [q.w, q.x, q.y, q.z],
                "translation": translation.to_array(),
                "focal": c.fx / v.camera.fx,
            });
            (v.name.as_str(), pose)
        })
        .collect();
    write_json(path, &json!({"format": FORMAT, "dataset": scene, "views": views}))
}

/// The dataset that a file of refined cameras is of, and the cameras; none where the JSON is something else.
pub(super) fn read(path: &Path, json: &Value) -> Result<Option<(PathBuf, Refined)>> {
    if json["format"] != FORMAT {
        return Ok(None);
    }
    let wrong = |field: &str| Error::new("damaged file of refined cameras").file(path).field(field).hint(AGAIN);
    let scene = json["dataset"].as_str().filter(|s| !s.is_empty()).ok_or_else(|| wrong("dataset"))?;
    let scene = path.parent().unwrap_or(Path::new("")).join(scene);
    if !scene.exists() {
        return Err(wrong("dataset").found(scene.display()).expected("the folder of the photographs"));
    }
    let mut views = BTreeMap::new();
    for (name, view) in json["views"].as_object().ok_or_else(|| wrong("views"))? {
        let numbers = |key: &str, count: usize| {
            let all = view[key].as_array().map(|a| a.iter().filter_map(Value::as_f64).collect::<Vec<f64>>());
            all.filter(|a| a.len() == count).ok_or_else(|| wrong(&format!("{name}.{key}")))
        };
        let (q, t) = (numbers("rotation", 4)?, numbers("translation", 3)?);
        let q = DQuat::from_xyzw(q[1], q[2], q[3], q[0]);
        if (q.length() - 1.0).abs() > 1e-6 {
            return Err(wrong(&format!("{name}.rotation")).found(q).expected("a quaternion of length 1"));
        }
        let focal = view["focal"]
            .as_f64()
            .filter(|f| (0.1..10.0).contains(f))
            .ok_or_else(|| wrong(&format!("{name}.focal")))?;
        let pose = (DMat3::from_quat(q.normalize()), DVec3::from_slice(&t), focal);
        views.insert(name.clone(), pose);
    }
    Ok(Some((scene, Refined { path: path.to_path_buf(), views })))
}

/// Refined cameras by the names of their views: rotation and translation, factor of the focal lengths.
pub(super) struct Refined {
    path: PathBuf,
    views: BTreeMap<String, (DMat3, DVec3, f64)>,
}

impl Refined {
    /// Puts them in the places of the dataset's own.
    pub fn apply(&self, raw: &mut RawDataset) -> Result<()> {
        for v in &mut raw.views {
            let Some(&(rotation, translation, focal)) = self.views.get(&v.name) else {
                return Err(Error::new("a photograph has no refined camera")
                    .file(&self.path)
                    .field(&v.name)
                    .hint(AGAIN));
            };
            (v.rotation, v.translation) = (rotation, translation);
            v.lens = v.lens.zoomed(focal);
        }
        raw.files.push(self.path.clone());
        Ok(())
    }
}
