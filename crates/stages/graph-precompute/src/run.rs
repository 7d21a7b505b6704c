//! The stage from its inputs to its outputs.

use crate::options::{Args, Views};
use crate::precompute::{Summary, precompute};
use artifacts::{Footprints, Graph, MaskMaps, ScratchEntries, hash_folder, maps_path, role, watch_folder};
use gs_io::{Error, Result, Watched, hash_file};
use gs_scene::Geometry;
use gs_scene::dataset::{self, LoadOptions, Resolution, Split, View};
use serde_json::json;
use stage::{CommonArgs, Program, Stage};
use std::collections::BTreeMap;

impl Program for Args {
    const NAME: &'static str = "graph-precompute";

    fn common(&self) -> &CommonArgs {
        &self.common
    }

    fn run(self, stage: &Stage) -> Result<()> {
        run(&self, stage)
    }
}

/// Reads geometry and views, computes footprints and graph, and writes them.
fn run(a: &Args, stage: &Stage) -> Result<()> {
    // The size of the id maps decides the resolution, so photographs count at full size.
    let load = LoadOptions { resolution: Resolution::Divisor(1.0), holdout: a.settings.holdout };
    let dataset = dataset::load(&a.scene, &load)?;
    let maps = dataset.views.iter().map(|v| maps_path(&a.masks, v.stem()));
    let mut claim = stage
        .outputs(&a.graph)
        .main(&a.footprints)
        .artifact(&a.graph, Graph::FORMAT)
        .artifact(&a.footprints, Footprints::FORMAT)
        .reads(dataset.files.iter().cloned().chain(maps).chain([a.geometry.clone()]))
        .claim()?;
    let watched = Watched::new([&a.geometry]).and(watch_folder(&a.masks, "_s.npy")?);
    dataset.warnings.iter().for_each(|w| stage.warn(w));
    let wanted = |v: &&View| a.settings.views == Views::All || v.split == Split::Train;
    let views: Vec<&View> = dataset.views.iter().filter(wanted).collect();
    if views.is_empty() {
        let e = Error::new("all views are held out").file(&a.scene);
        return Err(e.hint("give --views all or --holdout 0"));
    }
    let geometry = Geometry::read(&a.geometry)?;
    if geometry.gaussians.is_empty() {
        return Err(Error::new("no Gaussians").file(&a.geometry).hint("train the geometry first"));
    }
    forecast(a, &geometry, &views, stage)?;
    let inputs = BTreeMap::from([
        (role::GEOMETRY.to_string(), hash_file(&a.geometry)?),
        (role::DATASET.to_string(), dataset.hash()?),
        (role::MASKS.to_string(), hash_folder(&a.masks, "_s.npy")?),
    ]);
    let mut parameters = json!(a.settings);
    parameters["seed"] = json!(a.common.seed);

    let mut entries = ScratchEntries::beside(&a.footprints)?;
    let (footprints, graph, summary) =
        precompute(&geometry, &views, &a.masks, &a.settings, a.common.seed, stage, &mut entries)?;
    watched.check()?;
    let provenance = || stage.provenance("", 0, parameters.clone(), inputs.clone());
    footprints.write_with(entries, &a.footprints, provenance())?;
    graph.write(&a.graph, provenance())?;
    say(&summary, stage);
    stage.record(&mut claim, parameters, inputs, json!(summary))
}

/// Says how much memory the run will take.
fn forecast(a: &Args, geometry: &Geometry, views: &[&View], stage: &Stage) -> Result<()> {
    let pixels = views.iter().map(|v| u64::from(v.camera.width) * u64::from(v.camera.height)).max().unwrap_or(0);
    // The first view's masks speak for all; a damaged file is an error later on.
    let samples = a.settings.pixel_samples;
    let first = views.iter().filter(|_| samples > 0).map(|v| maps_path(&a.masks, v.stem()));
    let masks = first.filter_map(|p| MaskMaps::read(p).ok()).next().map_or(0, |m| m.id_count());
    let needed = crate::memory::forecast(geometry.gaussians.len(), views.len(), pixels, samples * masks);
    stage.forecast(needed, "give smaller id maps or fewer --pixel-samples")
}

fn say(summary: &Summary, stage: &Stage) {
    stage.info(&format!(
        "{} anchors among {} Gaussians; {} masks in {} views, {} footprint entries",
        summary.anchors, summary.kept, summary.masks, summary.views, summary.entries
    ));
    let d = summary.anchor_distance;
    stage.info(&format!(
        "distance to the anchor: median {:.4}, 90% within {:.4}, 99% within {:.4}, largest {:.4}",
        d.median, d.p90, d.p99, d.largest
    ));
    if summary.largest_cut > 0.0 {
        stage.info(&format!(
            "the cut dropped at most {:.3e} of a mask: no centroid changes by more than that times the longest feature",
            summary.largest_cut
        ));
    }
}
