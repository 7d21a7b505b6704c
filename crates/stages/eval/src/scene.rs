//! What every command loads: instances with their geometry, and the views of the scene.

use crate::nearest::nearest;
use crate::options::Inputs;
use artifacts::{Features, Instances, role};
use gs_io::{Artifact, Error, Result, Watched, hash_file};
use gs_raster::RasterOptions;
use gs_scene::dataset::{self, Dataset, LoadOptions, View};
use gs_scene::{Gaussians, Geometry};
use stage::Stage;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Gaussians of less opacity are not taken for a surface.
pub const MIN_OPACITY: f32 = 0.1;

/// Loads a dataset and passes on its warnings.
pub fn load(folder: &Path, options: &LoadOptions, stage: &Stage) -> Result<Dataset> {
    let dataset = dataset::load(folder, options)?;
    dataset.warnings.iter().for_each(|w| stage.warn(w));
    Ok(dataset)
}

impl Inputs {
    /// The files of the scene, its geometry and its instances.
    pub fn files<'a>(&'a self, dataset: &'a Dataset) -> impl Iterator<Item = &'a PathBuf> {
        dataset.files.iter().chain([&self.instances, &self.geometry])
    }

    /// Reads instances and geometry, which must be those of the dataset. Damaged Gaussians are reported.
    pub fn read(&self, dataset: &Dataset, stage: &Stage) -> Result<LabelledScene> {
        let scene = LabelledScene::read(&self.instances, &self.geometry)?;
        if let Some(damage) = scene.geometry.damage() {
            stage.skipped(&damage);
        }
        scene.check_dataset(dataset)?;
        Ok(scene)
    }
}

/// A folder with all the folders above it as they were given: a link keeps its own name, because it is how people call
/// what it leads to. Only of `..` at the end the name is asked from the file system.
pub fn full_path(path: &Path) -> PathBuf {
    let full = std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf());
    if full.file_name().is_some() { full } else { path.canonicalize().unwrap_or(full) }
}

/// The name of a folder, also of `.`; a link's own.
pub fn folder_name(path: &Path) -> String {
    full_path(path).file_name().map_or("scene".into(), |n| n.to_string_lossy().into_owned())
}

/// Instances with the Gaussians they label.
pub struct LabelledScene {
    /// The geometry with all its Gaussians; N.
    pub geometry: Geometry,
    /// How to render them.
    pub raster: RasterOptions,
    /// The instances; labels are as many as Gaussians.
    pub instances: Instances,
    /// The file of the instances.
    pub artifact: Artifact,
    /// Content hashes, by role.
    pub inputs: BTreeMap<String, String>,
}

impl LabelledScene {
    /// Reads `instances.safetensors` and the geometry it was made from.
    pub fn read(instances: &Path, geometry: &Path) -> Result<Self> {
        let (labelled, artifact) = Instances::read(instances)?;
        let watched = Watched::new([geometry]);
        let geometry_hash = hash_file(geometry)?;
        artifact.expect_input(role::GEOMETRY, &geometry_hash)?;
        let path = geometry;
        let geometry = Geometry::read(path)?;
        watched.check()?;
        if labelled.label.len() != geometry.gaussians.len() {
            return Err(Error::new("not a label per Gaussian")
                .file(instances)
                .field("label")
                .found(labelled.label.len())
                .expected(format!("{} ({})", geometry.gaussians.len(), path.display()))
                .hint("run cluster-match again"));
        }
        let inputs =
            BTreeMap::from([(role::GEOMETRY.into(), geometry_hash), ("instances".into(), artifact.hash().into())]);
        let raster = RasterOptions::of(&geometry);
        Ok(Self { geometry, raster, instances: labelled, artifact, inputs })
    }

    /// Whether no Gaussian belongs to an instance.
    pub fn all_noise(&self) -> bool {
        self.instances.label.iter().all(|&l| l < 0)
    }

    /// The nearest Gaussian for each point, of those with an instance and an opacity of at least 0.1: fainter ones are no
    /// surface (docs/protocols.md). None where there is no such Gaussian.
    pub fn nearest_labelled(&self, points: &[[f32; 3]]) -> Vec<Option<u32>> {
        nearest_solid(self.gaussians(), points, |i| self.instances.label[i] >= 0)
    }

    /// All Gaussians.
    pub fn gaussians(&self) -> &Gaussians {
        &self.geometry.gaussians
    }

    /// Where the instances were read from.
    pub fn path(&self) -> &Path {
        self.artifact.path()
    }

    /// Checks that the dataset is the one that the instances were made from.
    pub fn check_dataset(&self, dataset: &Dataset) -> Result<()> {
        self.artifact.expect_input(role::DATASET, &dataset.hash()?).map_err(|e| {
            e.expected(format!("the photographs, cameras and points of {}", dataset.root.display()))
                .hint("give the scene that the instances were made from, or run make again if it was edited")
        })
    }
}

/// The nearest Gaussian for each point, of those of opacity at least 0.1 for which `counts` holds.
pub fn nearest_solid(g: &Gaussians, points: &[[f32; 3]], counts: impl Fn(usize) -> bool) -> Vec<Option<u32>> {
    let solid = |&i: &u32| counts(i as usize) && g.opacity(i as usize) >= MIN_OPACITY;
    let candidates: Vec<u32> = (0..g.len() as u32).filter(solid).collect();
    nearest(g, &candidates, points)
}

/// Reads the features of some of `gaussians` Gaussians of a geometry.
pub fn read_features(path: &Path, geometry_hash: &str, gaussians: usize) -> Result<Features> {
    let (features, artifact) = Features::read(path)?;
    artifact.expect_input(role::GEOMETRY, geometry_hash)?;
    if features.kept.last().is_some_and(|&last| last as usize >= gaussians) {
        return Err(Error::new("index out of range").file(path).field("kept").hint("run feat-train again"));
    }
    Ok(features)
}

/// The view of this name: a file name, with or without its extension.
pub fn find_view<'a>(dataset: &'a Dataset, name: &str) -> Result<&'a View> {
    dataset.views.iter().find(|v| v.name == name || v.stem() == name).ok_or_else(|| {
        let some: Vec<&str> = dataset.views.iter().take(4).map(View::stem).collect();
        let expected = format!("one of {} names such as {}", dataset.views.len(), some.join(", "));
        Error::new("no such view").file(&dataset.root).field("--views").found(name).expected(expected)
    })
}

/// Views that are shown where none are named.
pub const VIEWS: usize = 3;

/// The views of these names; without names a few of those that `fit`, or of all where none does, which lie apart.
pub fn views_to_show<'a>(dataset: &'a Dataset, names: &[String], fit: impl Fn(&View) -> bool) -> Result<Vec<&'a View>> {
    if !names.is_empty() {
        return names.iter().map(|n| find_view(dataset, n)).collect();
    }
    let mut views: Vec<&View> = dataset.views.iter().filter(|v| fit(v)).collect();
    if views.is_empty() {
        views = dataset.views.iter().collect();
    }
    Ok(spread(&views, VIEWS))
}

/// At most `count` of `all`, evenly spread, in order.
fn spread<T: Copy>(all: &[T], count: usize) -> Vec<T> {
    let n = all.len();
    let k = count.min(n);
    (0..k).map(|i| all[(2 * i + 1) * n / (2 * k)]).collect()
}

/// Most bytes of a name that is made of a text.
const LONGEST_NAME: usize = 100;

/// A view's stem as part of a file name (names of views may hold folders), with its number where two would be the same.
pub fn view_name(dataset: &Dataset, view: &View) -> String {
    let name = |v: &View| slug(v.stem(), "_.");
    let own = name(view);
    let twins = dataset.views.iter().filter(|v| name(v) == own).count();
    let number = dataset.views.iter().position(|v| v.name == view.name).unwrap_or(0);
    if twins > 1 { format!("{number:04}-{own}") } else { own }
}

/// A text as part of a file name of at most 100 bytes: letters, digits and what is in `also`; everything else is
/// a hyphen.
pub fn slug(text: &str, also: &str) -> String {
    let kept = |c: char| if c.is_alphanumeric() || also.contains(c) { c } else { ' ' };
    let words: String = text.chars().map(kept).collect();
    let mut joined = words.split_whitespace().collect::<Vec<_>>().join("-");
    joined.truncate(joined.floor_char_boundary(LONGEST_NAME));
    if joined.is_empty() { "query".into() } else { joined }
}

/// The file name of the answer to a text, number first: no two are the same, and none is a name that means something else.
pub fn numbered(number: usize, text: &str) -> String {
    let mut name = format!("{number:02}-{}", slug(&text.to_lowercase(), ""));
    name.truncate(name.floor_char_boundary(LONGEST_NAME));
    name
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spreading_keeps_order_and_ends_apart() {
        assert_eq!(spread(&[0, 1, 2, 3, 4, 5, 6, 7, 8], 3), [1, 4, 7]);
        assert_eq!(spread(&[5, 6], 3), [5, 6]);
        assert_eq!(spread(&[5], 1), [5]);
        assert!(spread::<u8>(&[], 3).is_empty());
    }

    #[test]
    fn slugs_are_file_names() {
        assert_eq!(slug("Rubik's  cube/..\\x", ""), "Rubik-s-cube-x");
        assert_eq!(slug("cam0/IMG_1.a", "_."), "cam0-IMG_1.a");
        assert_eq!(slug("../", ""), "query");
        for text in ["é".repeat(200), "x".repeat(300), "日本".repeat(90)] {
            let name = numbered(1234, &text);
            assert!(name.len() <= 100 && name.len() > 96 && name.starts_with("1234-"), "{name}");
        }
        assert_eq!(numbered(1, "Coffee mug"), "01-coffee-mug");
        assert_ne!(numbered(1, "coffee mug"), numbered(2, "Coffee, mug!"));
    }
}
