//! What every system reads: the scene with its geometry, masks, their features and their footprints.

#![allow(rustdoc::invalid_html_tags, reason = "help texts name files as <view>_s.npy")]

use crate::cli::Peer;
use crate::silhouettes::{FeatureTable, matches, overlaps};
use artifacts::{
    Descriptors, Features, Footprints, Graph, Level, MaskFeatures, MaskFolder, MaskMaps, Match, Row, features_path,
    flat, hash_folder, role,
};
use gs_io::{Claim, Error, Result, Watched, hash_file};
use gs_raster::{RasterOptions, TileWeights, tile_weights};
use gs_scene::dataset::{self, Dataset, LoadOptions, Resolution, View};
use gs_scene::{Camera, Geometry};
use ndarray::{Array3, Axis, concatenate};
use serde::Serialize;
use stage::Stage;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Files of one scene, and the masks to use.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct Inputs {
    /// Dataset folder (COLMAP, transforms.json, ScanNet or 7-Scenes)
    #[arg(long, value_name = "DIR")]
    #[serde(skip)]
    pub scene: PathBuf,
    /// The Gaussians, as a 3DGS PLY
    #[arg(long, value_name = "FILE")]
    #[serde(skip)]
    pub geometry: PathBuf,
    /// graph.safetensors of graph-precompute
    #[arg(long, value_name = "FILE")]
    #[serde(skip)]
    pub graph: PathBuf,
    /// footprints.safetensors of graph-precompute
    #[arg(long, value_name = "FILE")]
    #[serde(skip)]
    pub footprints: PathBuf,
    /// Folder with id maps (<view>_s.npy) and mask features (<view>_f.npy)
    #[arg(long, value_name = "DIR")]
    #[serde(skip)]
    pub masks: PathBuf,
    /// Output file: instances, or descriptors
    #[arg(long, value_name = "FILE")]
    #[serde(skip)]
    pub out: PathBuf,
    /// Levels of the masks that are used, with commas between: default, small, medium, large, classes, concepts
    #[arg(long, value_name = "LEVELS", value_delimiter = ',', default_value = "large")]
    pub levels: Vec<Level>,
}

/// The same, and learned features.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct LearnedInputs {
    #[command(flatten)]
    #[serde(flatten)]
    pub inputs: Inputs,
    /// features.safetensors of feat-train
    #[arg(long, value_name = "FILE")]
    #[serde(skip)]
    pub features: PathBuf,
}

impl Inputs {
    /// The right to write the output of a system.
    pub fn claim(&self, peer: &dyn Peer, stage: &Stage) -> Result<Claim> {
        let mut maps = Vec::new();
        for suffix in ["_s.npy", "_f.npy"] {
            maps.extend(artifacts::folder_files(&self.masks, suffix)?);
        }
        let outputs = stage.outputs(&self.out).reads([&self.geometry, &self.graph, &self.footprints]).reads(maps);
        let outputs = outputs.reads(peer.features());
        let outputs = outputs.artifact(&self.out, peer.format());
        let outputs = peer.descriptors().iter().fold(outputs, |o, path| o.artifact(path, Descriptors::FORMAT));
        outputs.drop_stale().claim()
    }
}

/// A scene as a system sees it.
#[derive(Debug)]
pub struct World {
    /// All Gaussians; N.
    pub geometry: Geometry,
    /// How to render them.
    pub raster: RasterOptions,
    /// Neighbours of the kept Gaussians.
    pub graph: Graph,
    /// Which kept Gaussians make up which mask, over all levels.
    pub footprints: Footprints,
    /// The views that the footprints know, in their order.
    pub views: Vec<View>,
    /// Mask features by view index, of unit length; empty where the masks have none.
    pub features: BTreeMap<u32, MaskFeatures>,
    /// Levels of the masks that are used.
    pub levels: Vec<Level>,
    /// Features of feat-train, of 1 dimension or more for the kept Gaussians; without any where the system reads none.
    pub learned: Features,
    /// Content hashes, by role.
    pub hashes: BTreeMap<String, String>,
    masks: MaskFolder,
    watched: Watched,
}

impl World {
    /// Reads the files and checks that they belong together.
    ///
    /// # Errors
    /// When a file is damaged, was made from others, or some views have no mask features.
    pub fn read(peer: &dyn Peer, stage: &Stage) -> Result<Self> {
        let inputs = peer.inputs();
        let mut watched = Watched::new([&inputs.geometry, &inputs.footprints]);
        for suffix in ["_s.npy", "_f.npy"] {
            watched = watched.and(artifacts::watch_folder(&inputs.masks, suffix)?);
        }
        let geometry = Geometry::read(&inputs.geometry)?;
        if let Some(damage) = geometry.damage() {
            stage.skipped(&damage);
        }
        let (graph, graph_file) = Graph::read(&inputs.graph)?;
        let footprints = Footprints::read(&inputs.footprints)?;
        let mut dataset =
            dataset::load(&inputs.scene, &LoadOptions { resolution: Resolution::Divisor(1.0), holdout: 0 })?;
        dataset.follow(&geometry.gaussians, &inputs.geometry)?;
        let mut hashes = BTreeMap::from([
            (role::GEOMETRY.to_string(), hash_file(&inputs.geometry)?),
            (role::DATASET.to_string(), dataset.hash()?),
            (role::MASKS.to_string(), hash_folder(&inputs.masks, "_s.npy")?),
        ]);
        hashes.iter().try_for_each(|(role, hash)| footprints.artifact().expect_input(role, hash))?;
        graph_file.expect_input(role::GEOMETRY, &hashes[role::GEOMETRY])?;
        graph_file.expect_input(role::DATASET, &hashes[role::DATASET])?;
        hashes.insert(role::GRAPH.into(), graph_file.hash().into());
        hashes.insert(role::FOOTPRINTS.into(), footprints.artifact().hash().into());
        hashes.insert(role::MASK_FEATURES.into(), hash_folder(&inputs.masks, "_f.npy")?);
        if graph.kept != footprints.kept {
            return Err(Error::new("graph and footprints keep other Gaussians")
                .file(&inputs.graph)
                .field("kept")
                .hint("run graph-precompute again"));
        }
        if let Some(last) = footprints.kept.last().filter(|&&last| last as usize >= geometry.gaussians.len()) {
            return Err(Error::new("a Gaussian that the geometry lacks")
                .file(&inputs.footprints)
                .field("kept")
                .found(last)
                .expected(format!("less than {}", geometry.gaussians.len())));
        }
        let learned = match peer.features() {
            Some(path) => learned(path, &footprints, &mut hashes)?,
            None => Features::default(),
        };
        let views = views_of(&dataset, &footprints, inputs)?;
        let features = features_of(&footprints, inputs)?;
        Ok(Self {
            raster: RasterOptions::of(&geometry),
            geometry,
            graph,
            footprints,
            views,
            features,
            levels: inputs.levels.clone(),
            learned,
            hashes,
            masks: MaskFolder::open(&inputs.masks),
            watched,
        })
    }

    /// Refuses inputs that changed since they were read.
    pub fn unchanged(&self) -> Result<()> {
        self.watched.check()
    }

    /// Number of all Gaussians.
    pub fn gaussians(&self) -> usize {
        self.geometry.gaussians.len()
    }

    /// Number of Gaussians that some view sees: those of the footprints.
    pub fn kept(&self) -> usize {
        self.footprints.kept.len()
    }

    /// Dimension of the mask features.
    pub fn dim(&self) -> usize {
        self.features.values().next().map_or(0, MaskFeatures::dim)
    }

    /// Rows of the footprints whose masks are of the levels that are used, by view and mask.
    pub fn rows(&self) -> Vec<u32> {
        let rows = self.footprints.rows.iter().enumerate();
        rows.filter(|(_, row)| row.is_of(&self.levels)).map(|(r, _)| r as u32).collect()
    }

    /// The feature of a mask, of unit length; none where it is zero.
    pub fn feature(&self, row: &Row) -> Option<&[f32]> {
        let feature = flat(self.features.get(&row.view)?.row(row.mask as usize)?);
        feature.iter().any(|&v| v != 0.0).then_some(feature)
    }

    /// The id maps of a view, and its camera in their size.
    pub fn maps(&self, view: usize) -> Result<(MaskMaps, Camera)> {
        let mut maps = self.masks.read(&self.views[view])?;
        let needed = self.levels.iter().map(|level| level.index() + 1).max().unwrap_or(0);
        if let missing @ 1.. = needed.saturating_sub(maps.levels().len()) {
            // Levels that are not there have no masks.
            let none = Array3::from_elem((missing, maps.height(), maps.width()), -1);
            maps.ids = concatenate![Axis(0), maps.ids, none];
        }
        let camera = self.views[view].camera.resized(maps.width() as u32, maps.height() as u32);
        Ok((maps, camera))
    }

    /// Calls `f` for every tile of a view, in parallel, and returns the results in tile order. With `early_stop` hidden Gaussians
    /// have no alpha ([`tile_weights`]).
    pub fn tiles<R: Send>(
        &self,
        camera: &Camera,
        early_stop: bool,
        f: impl Fn(&TileWeights<'_>) -> R + Sync,
    ) -> Vec<R> {
        tile_weights(&self.geometry.gaussians, camera, &self.raster, early_stop, f)
    }

    /// Labels of all Gaussians from those of the kept ones; -1 elsewhere.
    pub fn spread(&self, kept: &[i32]) -> Vec<i32> {
        let mut labels = vec![-1; self.gaussians()];
        self.footprints.kept.iter().zip(kept).for_each(|(&i, &label)| labels[i as usize] = label);
        labels
    }

    /// Matches instances with masks, for systems without a rule of their own: in each view the mask with the largest IoU, where that
    /// exceeds `threshold`. `labels` are those of all Gaussians.
    pub fn matches(&self, labels: &[i32], threshold: f32) -> Result<Vec<Match>> {
        let none = Features::none(&self.footprints.kept);
        let table = FeatureTable::new(&none, self.gaussians());
        let mut all = Vec::new();
        for view in 0..self.views.len() {
            let (maps, camera) = self.maps(view)?;
            let found = overlaps(&self.geometry.gaussians, &self.raster, labels, &table, &camera, &maps, &self.levels);
            all.extend(matches(&found, view as u32, threshold));
        }
        all.sort_by_key(|m| (m.instance, m.view));
        Ok(all)
    }
}

/// Learned features, which must be of the graph and the footprints in `hashes`; their own hash joins these.
fn learned(path: &Path, footprints: &Footprints, hashes: &mut BTreeMap<String, String>) -> Result<Features> {
    let (features, file) = Features::read(path)?;
    file.expect_input(role::GRAPH, &hashes[role::GRAPH])?;
    file.expect_input(role::FOOTPRINTS, &hashes[role::FOOTPRINTS])?;
    let wrong = |what: &str, field: &str| Error::new(what).file(path).field(field).hint("run feat-train again");
    if features.kept != footprints.kept {
        return Err(wrong("features of other Gaussians than the footprints", "kept"));
    }
    if features.dim() == 0 {
        return Err(wrong("features without numbers", "features"));
    }
    hashes.insert(role::FEATURES.into(), file.hash().into());
    Ok(features)
}

/// The views of the footprints, in their order.
fn views_of(dataset: &Dataset, footprints: &Footprints, inputs: &Inputs) -> Result<Vec<View>> {
    let view = |stem: &String| {
        let missing = || Error::new("a view of the footprints is not in the dataset").file(&inputs.scene).found(stem);
        dataset.views.iter().find(|v| v.stem() == stem).cloned().ok_or_else(missing)
    };
    footprints.views.iter().map(view).collect()
}

/// The mask features of all views; none where no view has any.
fn features_of(footprints: &Footprints, inputs: &Inputs) -> Result<BTreeMap<u32, MaskFeatures>> {
    let mut all = BTreeMap::<u32, MaskFeatures>::new();
    if artifacts::folder_files(&inputs.masks, "_f.npy")?.is_empty() {
        return Ok(all);
    }
    for (view, stem) in footprints.views.iter().enumerate() {
        let path = features_path(&inputs.masks, stem);
        let features = MaskFeatures::read(&path)?;
        let dim = features.dim();
        if let Some(other) = all.values().next().map(MaskFeatures::dim).filter(|&other| other != dim) {
            return Err(Error::new("features of different models").file(&path).found(dim).expected(other));
        }
        all.insert(view as u32, features);
    }
    Ok(all)
}
