//! The stage from its inputs to its outputs.

use crate::options::{Args, Views};
use crate::precompute::{Summary, precompute};
use artifacts::{Footprints, Graph, MaskMaps, ScratchEntries, hash_folder, maps_path, role, watch_folder};
use gs_io::{Error, Result, Watched, hash_file};
use gs_raster::{Photographs, tile_bytes};
use gs_scene::dataset::{self, LoadOptions, Resolution, Split, View};
use gs_scene::{Geometry, HoldOut, splat};
use serde_json::json;
use stage::{CommonArgs, Program, Stage};
use std::collections::BTreeMap;

impl Program for Args {
    const NAME: &'static str = "graph-precompute";
    const OUTPUTS: &'static [&'static str] = &["graph", "footprints"];

    fn common(&self) -> &CommonArgs {
        &self.common
    }

    /// Reads geometry and views, computes footprints and graph, and writes them.
    fn run(mut self, stage: &Stage) -> Result<()> {
        let held = HoldOut::of(&self.geometry, self.settings.held.holdout)?;
        self.settings.held.holdout = Some(held.every);
        // The size of the id maps decides the resolution, so photographs count at full size.
        let load = LoadOptions { resolution: Resolution::Divisor(1.0), holdout: held.every };
        let mut dataset = dataset::load(&self.scene, &load)?;
        let maps = dataset.views.iter().map(|v| maps_path(&self.masks, v.stem()));
        let mut claim = stage
            .outputs(&self.graph)
            .main(&self.footprints)
            .artifact(&self.graph, Graph::FORMAT)
            .artifact(&self.footprints, Footprints::FORMAT)
            .reads(dataset.files.iter().cloned().chain(maps).chain([self.geometry.clone()]))
            .claim()?;
        let watched = Watched::new([&self.geometry]).and(watch_folder(&self.masks, "_s.npy")?);
        dataset.warnings.iter().chain(&held.differs(&dataset)).for_each(|w| stage.warn(w));
        // A packed file may hold a thousand times its size: what its Gaussians will take is known before.
        stage.needs_at_once(BASE + PER_GAUSSIAN * splat::count(&self.geometry)?, SMALLER)?;
        let mut geometry = Geometry::read(&self.geometry)?;
        dataset.follow(&geometry.gaussians, &self.geometry)?;
        let wanted = |v: &&View| self.settings.views == Views::All || v.split == Split::Train;
        let views: Vec<&View> = dataset.views.iter().filter(wanted).collect();
        if views.is_empty() {
            let e = Error::new("all views are held out").file(&self.scene);
            return Err(e.hint("give --views all or --holdout 0"));
        }
        if geometry.gaussians.is_empty() {
            return Err(Error::new("no Gaussians").file(&self.geometry).hint("train the geometry first"));
        }
        forecast(&self, &geometry, &views, stage)?;
        let likeness = Photographs::of(&views)?.likeness(&geometry.gaussians, geometry.antialias, &views);
        if likeness.is_drawn() {
            likeness.expect_same(&self.geometry, &likeness.to_string())?;
        }
        // Nothing is coloured from here on.
        geometry.gaussians = std::mem::take(&mut geometry.gaussians).with_degree(0);
        let inputs = BTreeMap::from([
            (role::GEOMETRY.to_string(), hash_file(&self.geometry)?),
            (role::DATASET.to_string(), dataset.hash()?),
            (role::MASKS.to_string(), hash_folder(&self.masks, "_s.npy")?),
        ]);
        let mut parameters = json!(self.settings);
        parameters["seed"] = json!(self.common.seed);

        let mut entries = ScratchEntries::beside(&self.footprints)?;
        let (footprints, graph, summary) =
            precompute(&geometry, &views, &self.masks, &self.settings, self.common.seed, stage, &mut entries)?;
        watched.check()?;
        let provenance = || stage.provenance("", 0, parameters.clone(), inputs.clone());
        footprints.write_with(entries, &self.footprints, provenance())?;
        graph.write(&self.graph, provenance())?;
        say(&summary, stage);
        stage.record(&mut claim, parameters, inputs, json!(summary))
    }
}

/// Bytes that a run takes, and for each Gaussian.
const BASE: u64 = 19_400_000;
const PER_GAUSSIAN: u64 = 500;
/// What takes less memory.
const SMALLER: &str = "give a smaller geometry, smaller id maps or fewer --pixel-samples";

/// Says how much memory the run will take. The figures are fitted to 15 runs of 5,000 to 80,000 Gaussians, 12 to 108 views and
/// 10,800 to 172,800 pixels, within 15 % (docs/performance.md).
fn forecast(a: &Args, geometry: &Geometry, views: &[&View], stage: &Stage) -> Result<()> {
    const PER_PIXEL: u64 = 157;
    const PER_VIEW: u64 = 20_400;
    /// Of a sampled pixel, which shows some 54 Gaussians. Footprints wait on disk, sampled pixels in memory.
    const PER_SAMPLE: u64 = 330;
    // The first view's masks speak for all, their size too; a damaged file is an error later on.
    let samples = a.settings.pixel_samples;
    let first = views.iter().filter_map(|v| MaskMaps::read(maps_path(&a.masks, v.stem())).ok()).next();
    let (masks, pixels) = first.map_or((0, 0), |m| (m.id_count(), (m.width() * m.height()) as u64));
    let of_views = views.len() as u64 * (PER_VIEW + PER_SAMPLE * (samples * masks) as u64);
    let gaussians = geometry.gaussians.len() as u64;
    let needed = BASE + PER_GAUSSIAN * gaussians + PER_PIXEL * pixels + of_views + tile_bytes(gaussians, pixels);
    stage.forecast(needed, SMALLER)
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
