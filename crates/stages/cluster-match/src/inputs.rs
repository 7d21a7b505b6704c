//! Reading the inputs, and checking that they belong together.

use crate::options::{Args, Space};
use artifacts::{Features, Footprints, Graph, Level, MaskMaps, hash_folder, maps_path, role};
use gs_io::{Error, IoContext, Provenance, Result, hash_file};
use gs_scene::Geometry;
use gs_scene::dataset::{self, Dataset, LoadOptions, Resolution, View};
use stage::Stage;
use std::collections::BTreeMap;
use std::path::Path;

/// The inputs, checked against each other.
pub(crate) struct Inputs {
    pub geometry: Geometry,
    pub graph: Graph,
    pub footprints: Footprints,
    /// Those that are clustered; of no dimension where the masks are.
    pub features: Features,
    /// The views whose masks the footprints hold.
    pub views: Vec<View>,
    /// Content hash of each input, by role.
    pub hashes: BTreeMap<String, String>,
}

impl Inputs {
    pub fn read(a: &Args, stage: &Stage) -> Result<Self> {
        let mut geometry = Geometry::read(&a.geometry)?;
        // Only plain colours are looked at.
        geometry.gaussians = std::mem::take(&mut geometry.gaussians).with_degree(0);
        if let Some(damage) = geometry.damage() {
            stage.skipped(&damage);
        }
        let geometry_hash = hash_file(&a.geometry)?;
        let (graph, graph_file) = Graph::read(&a.graph)?;
        let footprints = Footprints::read(&a.footprints)?;
        let masks = hash_folder(&a.masks, "_s.npy")?;
        let mut dataset = dataset::load(&a.scene, &LoadOptions { resolution: Resolution::Divisor(1.0), holdout: 0 })?;
        dataset.warnings.iter().for_each(|w| stage.warn(w));
        dataset.follow(&geometry.gaussians, &a.geometry)?;
        let dataset_hash = dataset.hash()?;
        graph_file.expect_input(role::GEOMETRY, &geometry_hash)?;
        footprints.artifact().expect_input(role::GEOMETRY, &geometry_hash)?;
        footprints.artifact().expect_input(role::MASKS, &masks)?;
        graph_file.expect_input(role::DATASET, &dataset_hash)?;
        footprints.artifact().expect_input(role::DATASET, &dataset_hash)?;
        check_kept(a, &graph, &footprints, geometry.gaussians.len())?;
        let (features, features_file) = match &a.features {
            Some(path) if a.settings.cluster != Space::Masks => {
                let (features, file) = Features::read(path)?;
                file.expect_input(role::GRAPH, graph_file.hash())?;
                file.expect_input(role::FOOTPRINTS, footprints.artifact().hash())?;
                check_features(path, &features, &graph)?;
                (features, Some(file))
            }
            given => {
                if given.is_some() {
                    stage.skipped("--features: clustering by the masks does not read them");
                }
                (Features::none(&graph.kept), None)
            }
        };
        let views = matched_views(a, &dataset, &footprints, stage)?;
        let mut hashes = BTreeMap::from([
            (role::GEOMETRY.into(), geometry_hash),
            (role::DATASET.into(), dataset_hash),
            (role::GRAPH.into(), graph_file.hash().into()),
            (role::FOOTPRINTS.into(), footprints.artifact().hash().into()),
            (role::MASK_FEATURES.into(), hash_folder(&a.masks, "_f.npy")?),
        ]);
        // A model that names what it sees may have seen nothing.
        let has_names =
            |view: &String| MaskMaps::read(maps_path(&a.masks, view)).is_ok_and(|m| m.levels() != Level::SAM);
        if footprints.rows.iter().any(|row| !row.is_of(&Level::SAM)) || footprints.views.first().is_some_and(has_names)
        {
            hashes.insert(role::MASK_NAMES.into(), hash_folder(&a.masks, "_s.json")?);
        }
        hashes.extend(features_file.map(|file| (role::FEATURES.into(), file.hash().into())));
        hashes.extend(clip_of_features(&a.masks, &masks)?);
        hashes.insert(role::MASKS.into(), masks);
        Ok(Self { geometry, graph, footprints, features, views, hashes })
    }
}

fn check_kept(a: &Args, graph: &Graph, footprints: &Footprints, gaussians: usize) -> Result<()> {
    if graph.seen_views.len() == gaussians && graph.kept == footprints.kept {
        return Ok(());
    }
    let e = Error::new("the graph belongs to other Gaussians than the footprints").file(&a.graph).field("kept");
    Err(e.hint("run graph-precompute again"))
}

fn check_features(path: &Path, features: &Features, graph: &Graph) -> Result<()> {
    let wrong = |what: &str, field: &str| {
        Err(Error::new(what).file(path).field(field).hint("run feat-train again with this --graph"))
    };
    if graph.kept != features.kept {
        return wrong("the features belong to other Gaussians than the graph", "kept");
    }
    if features.dim() == 0 {
        return wrong("the features have no dimension", "features");
    }
    Ok(())
}

/// The views that the footprints know, in their order.
fn matched_views(a: &Args, dataset: &Dataset, footprints: &Footprints, stage: &Stage) -> Result<Vec<View>> {
    let without: Vec<&str> =
        dataset.views.iter().map(View::stem).filter(|s| !footprints.views.iter().any(|v| v == s)).collect();
    if !without.is_empty() {
        const SHOWN: usize = 5;
        let more = if without.len() > SHOWN { ", ..." } else { "" };
        stage.skipped(&format!(
            "{} of {} views in matching: held out, or without masks ({}{more})",
            without.len(),
            dataset.views.len(),
            without[..without.len().min(SHOWN)].join(", ")
        ));
    }
    let view = |stem: &String| {
        dataset.views.iter().find(|v| v.stem() == stem).cloned().ok_or_else(|| {
            Error::new("a view of the footprints is not in the dataset")
                .file(&a.scene)
                .field("views")
                .found(stem)
                .hint("give the dataset that graph-precompute was given")
        })
    };
    footprints.views.iter().map(view).collect()
}

/// Hashes of the CLIP model that made the mask features, as far as `features.json` of mask-embed names it.
fn clip_of_features(folder: &Path, masks: &str) -> Result<BTreeMap<String, String>> {
    let manifest = folder.join("features.json");
    // Features of another program come without one.
    if !manifest.exists() {
        return Ok(BTreeMap::new());
    }
    let bytes = std::fs::read(&manifest).at("read", &manifest)?;
    let known: Provenance = serde_json::from_slice(&bytes).map_err(|e| {
        Error::new(format!("not a manifest of mask features: {e}")).file(&manifest).hint("run mask-embed embed again")
    })?;
    if known.inputs.get(role::MASKS).is_some_and(|m| m != masks) {
        return Err(Error::new("the id maps were changed after their features were made")
            .file(&manifest)
            .field("inputs.masks")
            .hint("run mask-embed embed again"));
    }
    Ok(known.inputs.into_iter().filter(|(role, _)| [role::CLIP, role::CLIP_TEXT].contains(&role.as_str())).collect())
}
