//! Instances with the geometry that they were made from.

use crate::nearest::nearest;
use artifacts::{Edits, Features, Instances, Remarks, role};
use gs_io::{Artifact, Error, IoContext, Result, Watched, hash_bytes, hash_file};
use gs_raster::RasterOptions;
use gs_scene::dataset::Dataset;
use gs_scene::{Gaussians, Geometry};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Gaussians of less opacity are not taken for a surface.
pub const MIN_OPACITY: f32 = 0.1;

/// Instances with the Gaussians they label.
pub struct LabelledScene {
    /// The geometry with all its Gaussians; N.
    pub geometry: Geometry,
    /// The file of the geometry.
    pub geometry_path: PathBuf,
    /// How to render them.
    pub raster: RasterOptions,
    /// The instances, edits included; labels are as many as Gaussians.
    pub instances: Instances,
    /// What the edits say beyond them.
    pub remarks: Remarks,
    /// The file of the instances.
    pub artifact: Artifact,
    /// Content hashes, by role.
    pub inputs: BTreeMap<String, String>,
}

impl LabelledScene {
    /// Reads `instances.safetensors` and the geometry it was made from, and changes the instances by the edits, if there are
    /// any ([`Edits::apply`]).
    ///
    /// # Errors
    /// When a file is damaged, the geometry or the edits are of other instances, or an edit does not fit them.
    pub fn read(instances: &Path, geometry: &Path, edits: Option<&Path>) -> Result<Self> {
        let (mut labelled, artifact) = Instances::read(instances)?;
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
        let mut inputs =
            BTreeMap::from([(role::GEOMETRY.into(), geometry_hash), ("instances".into(), artifact.hash().into())]);
        let mut remarks = Remarks::default();
        if let Some(path) = edits {
            let (edits, hash) = read_edits(path, &artifact)?;
            remarks = edits.apply(&mut labelled, &geometry.gaussians.means).map_err(|e| e.file(path))?;
            inputs.insert(role::EDITS.into(), hash);
        }
        let raster = RasterOptions::of(&geometry);
        Ok(Self { geometry, geometry_path: path.to_path_buf(), raster, instances: labelled, remarks, artifact, inputs })
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

    /// Checks that the dataset is the one that the instances were made from, and brings its cameras to where the Gaussians are.
    pub fn check_dataset(&self, dataset: &mut Dataset) -> Result<()> {
        dataset.follow(self.gaussians(), &self.geometry_path)?;
        self.artifact.expect_input(role::DATASET, &dataset.hash()?).map_err(|e| {
            e.expected(format!("the photographs, cameras and points of {}", dataset.root.display()))
                .hint("give the scene that the instances were made from, or run make again if it was edited")
        })
    }
}

/// Reads edits of these instances, with their content hash.
fn read_edits(path: &Path, instances: &Artifact) -> Result<(Edits, String)> {
    let bytes = std::fs::read(path).at("read", path)?;
    let edits = Edits::parse(&bytes).map_err(|e| e.file(path))?;
    if edits.instances != instances.hash() {
        return Err(Error::new("edits of other instances")
            .file(path)
            .field("instances")
            .found(format!("{:.12}", edits.instances))
            .expected(format!("{:.12} ({})", instances.hash(), instances.path().display()))
            .hint("give the instances that were edited, or leave the edits out and make them again in explore"));
    }
    Ok((edits, hash_bytes(&bytes)))
}

/// The nearest Gaussian for each point, of those of opacity at least 0.1 for which `counts` holds.
pub fn nearest_solid(g: &Gaussians, points: &[[f32; 3]], counts: impl Fn(usize) -> bool) -> Vec<Option<u32>> {
    let solid = |&i: &u32| counts(i as usize) && g.opacity(i as usize) >= MIN_OPACITY;
    let candidates: Vec<u32> = (0..g.len() as u32).filter(solid).collect();
    nearest(g, &candidates, points)
}

/// Reads the features of some of `gaussians` Gaussians of a geometry.
pub fn read_features(path: &Path, geometry_hash: &str, gaussians: usize) -> Result<Features> {
    let (features, file) = Features::read(path)?;
    check_features(&features, &file, geometry_hash, gaussians)?;
    Ok(features)
}

/// Checks that features are of this geometry of `gaussians` Gaussians.
///
/// # Errors
/// When they are of another one.
pub fn check_features(features: &Features, file: &Artifact, geometry_hash: &str, gaussians: usize) -> Result<()> {
    file.expect_input(role::GEOMETRY, geometry_hash)?;
    if features.kept.last().is_some_and(|&last| last as usize >= gaussians) {
        let e = Error::new("index out of range").file(file.path()).field("kept");
        return Err(e.hint("run feat-train again"));
    }
    Ok(())
}
