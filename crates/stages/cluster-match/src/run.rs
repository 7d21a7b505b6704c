//! The stage from its inputs to its outputs.

use crate::assignment::Assignment;
use crate::describe::{Witnesses, descriptors, gather};
use crate::granules::{self, Candidates};
use crate::group::{free, on_graph};
use crate::inputs::Inputs;
use crate::matching::{Likeness, matches};
use crate::options::{Args, Settings, Space, classes};
use crate::outputs::{self, Found};
use crate::parts::split;
use crate::profile::mask_weights;
use crate::rank::confidence;
use crate::surface::Points;
use crate::{health, linkage, memory};
use artifacts::{Draft, Health, Instances, Level, MaskFeatures, MaskFolder, Row};
use gs_io::{Error, Result, Watched};
use gs_scene::splat;
use ndarray::Array2;
use stage::{CommonArgs, Program, Stage};
use std::collections::BTreeMap;
use std::time::Instant;

/// What takes less memory.
const SMALLER: &str = "give a smaller geometry, or drop small footprint entries: graph-precompute --cut 0.001";
/// How far the masks of level small must agree that two are one part.
const PARTS: f64 = 0.6;

impl Program for Args {
    const NAME: &'static str = "cluster-match";

    fn common(&self) -> &CommonArgs {
        &self.common
    }

    fn check(&self) -> Result<()> {
        match outputs::SIDE_FILES.iter().find(|e| self.out.with_extension(e) == self.out) {
            Some(taken) => Err(Error::new("another output has this name")
                .file(&self.out)
                .field("--out")
                .found(format!(".{taken}"))
                .expected("a name such as instances.safetensors")),
            None => Ok(()),
        }
    }

    /// Reads the inputs, finds the instances, matches them with masks, describes them by the masks' features, and writes them.
    fn run(self, stage: &Stage) -> Result<()> {
        let a = &self;
        let mut claim = outputs::claim(a, stage)?;
        let mut watched = Watched::new([&a.geometry, &a.footprints]);
        for suffix in ["_s.npy", "_f.npy", "_s.json"] {
            watched = watched.and(artifacts::watch_folder(&a.masks, suffix)?);
        }
        // A packed file may hold a thousand times its size.
        stage.needs_at_once(memory::least(splat::count(&a.geometry)?), SMALLER)?;
        let inputs = Inputs::read(a, stage)?;
        let settings = a.settings.for_scene(inputs.graph.kept.len(), &inputs.footprints);
        let mut found = match &a.from {
            Some(path) => outputs::read_draft(path, &inputs, &settings)?,
            None => find(a, &settings, &inputs, stage)?,
        };
        watched.check()?;
        if let Some(path) = &a.draft {
            return outputs::write_draft(path, stage, &inputs, &found, &settings, &mut claim);
        }
        let features = mask_features(a, &found.draft, stage)?;
        let Draft { instances, of_instances, of_granules, .. } = &mut found.draft;
        instances.descriptor = descriptors(instances.len(), of_instances, &features);
        instances.granule_descriptor = descriptors(instances.granules.len(), of_granules, &features);
        watched.check()?;
        outputs::write(a, stage, &inputs, &found, &settings, &mut claim)
    }
}

/// Finds the instances and what there is to say of them without language.
fn find(a: &Args, settings: &Settings, inputs: &Inputs, stage: &Stage) -> Result<Found> {
    stage.forecast(memory::forecast(inputs, settings), SMALLER)?;
    let start = Instant::now();
    // Made after the first merge, which takes most memory.
    let mut points = None;
    let clustering = match settings.cluster {
        Space::Masks => {
            linkage::cluster(inputs, &mut points, settings, &settings.levels, (settings.agreement(), settings.join))?
        }
        Space::Graph => on_graph(&inputs.features.values, &inputs.graph, &settings.hdbscan()),
        Space::Free => free(&inputs.features.values, &settings.hdbscan()),
    };
    let noise = clustering.labels.iter().filter(|&&l| l < 0).count();
    let clustering_seconds = start.elapsed().as_secs_f64();
    let found = Assignment::new(&clustering, &inputs.graph.kept, inputs.geometry.gaussians.len());
    drop(clustering);
    stage.info(&format!("{} instances among {} Gaussians, {noise} noise", found.instances, inputs.graph.kept.len()));
    if found.instances == 0 {
        stage.warn(
            "everything is noise: no instance was found; give a smaller --min-cluster-size, or --allow-single-cluster \
             where the scene is one thing",
        );
    }
    let found = correct(found, inputs, points, settings, stage)?;

    let footprints = &inputs.footprints;
    let labels: Vec<i32> = inputs.graph.kept.iter().map(|&i| found.labels[i as usize]).collect();
    let weights = mask_weights(&labels, footprints, &Level::ALL)?;
    let nodes: Vec<i32> = inputs.graph.kept.iter().map(|&i| found.nodes[i as usize]).collect();
    let parents =
        if settings.granules > 0 { found.tree.iter().map(|e| (e.child, e.parent)).collect() } else { BTreeMap::new() };
    let candidates = Candidates::new(&labels, found.instances, &nodes, &parents);
    let (granules, of_instances) = granules::find(&candidates, &labels, &nodes, footprints, settings.granules)?;
    let (fits, mut shown): (Vec<f32>, Vec<_>) = of_instances.into_iter().unzip();
    let levels = &settings.levels;
    if inputs.features.dim() > 0 || !footprints.rows.iter().all(|r| r.is_of(levels)) {
        let likeness = Likeness::new(&labels, found.instances, &inputs.features, footprints, levels)?;
        shown = granules::best_at(levels, &labels, found.instances, footprints, &likeness)?;
    }
    let mut chosen = Witnesses::default();
    let of_granules = granules::witnesses(&granules, footprints, settings.describe_views, &mut chosen);
    let views = inputs.views.iter().map(|v| v.stem().to_string()).collect();
    let gathered = gather(&inputs.geometry.gaussians.means, found.labels, found.instances, matches(&shown, footprints));
    let of_instances = chosen.of_instances(&gathered.matches, settings.describe_views);
    let granules = granules.into_iter().map(|(granule, _)| granule).collect::<Vec<_>>();
    let granule_descriptor = Array2::zeros((granules.len(), 0));
    let mut instances =
        Instances { views, tree: found.tree, node: found.nodes, granules, granule_descriptor, ..gathered };
    instances.score = confidence(&instances.count, &fits);
    let names = health::names(&weights, footprints, &a.masks)?;
    let of_levels: Vec<_> = weights.into_iter().filter(|(r, _)| footprints.rows[*r as usize].is_of(levels)).collect();
    let health = Health { names, ..health::measure(&instances, &of_levels) };
    let draft = Draft { instances, of_instances, of_granules, masks: mask_counts(a, inputs)? };
    Ok(Found { draft, health, noise, clustering_seconds })
}

/// Corrects the clustering by where Gaussians lie and by the masks of each view.
fn correct<'a>(
    mut found: Assignment,
    inputs: &'a Inputs,
    mut points: Option<Points<'a>>,
    settings: &Settings,
    stage: &Stage,
) -> Result<Assignment> {
    let (means, graph, footprints) = (&inputs.geometry.gaussians.means, &inputs.graph, &inputs.footprints);
    let mut kept = vec![false; means.len()];
    graph.kept.iter().for_each(|&i| kept[i as usize] = true);
    let noise: Vec<bool> = kept.iter().zip(&found.labels).map(|(&kept, &label)| kept && label < 0).collect();
    found.fill_from_nearest(means, |i| noise[i]);
    if settings.votes > 0 {
        let changed = found.vote(graph, footprints, &settings.levels, settings.votes)?;
        stage.info(&format!("votes of the masks changed the instance of {changed} Gaussians"));
    }
    // Clustering by the masks has joined them already.
    if settings.cluster != Space::Masks && settings.join > 0.0 {
        let before = found.instances;
        found.join(&inputs.geometry.gaussians, &graph.kept, footprints, &settings.levels, settings.join)?;
        if found.instances < before {
            stage.info(&format!("{} instances after joining pieces that the masks show as one", found.instances));
        }
    }
    let small = |row: &Row| row.is_of(&[Level::SMALL]);
    if settings.split > 0.0 && settings.levels.contains(&Level::SMALL) && footprints.rows.iter().any(small) {
        let clustering = linkage::cluster(inputs, &mut points, settings, &[Level::SMALL], (PARTS, 0.0))?;
        let parts = Assignment::new(&clustering, &graph.kept, means.len());
        let classes = classes(&settings.levels);
        let large = if classes.is_empty() { &[Level::LARGE][..] } else { &classes };
        let split = split(&mut found, &parts, &graph.kept, footprints, large, settings.split)?;
        if split > 0 {
            stage.info(&format!("{split} small things within others are instances of their own"));
        }
    }
    // Damaged Gaussians have no place, so they are nobody's neighbour and stay without an instance.
    let whole = inputs.geometry.whole();
    let unseen = (0..means.len()).filter(|&i| !kept[i] && whole[i]).count();
    if unseen > 0 {
        let n = means.len();
        stage.skipped(&format!(
            "{unseen} of {n} Gaussians in clustering: never seen; labelled from their nearest neighbour"
        ));
        found.fill_from_nearest(means, |i| !kept[i] && whole[i]);
    }
    Ok(found)
}

/// The number of mask ids of each view.
fn mask_counts(a: &Args, inputs: &Inputs) -> Result<Vec<u32>> {
    let folder = MaskFolder::open(&a.masks);
    // One at a time: a map of a large photograph takes much memory.
    inputs.views.iter().map(|view| Ok(folder.read(view)?.id_count() as u32)).collect()
}

/// The features of the masks that the descriptors read, by view index.
fn mask_features(a: &Args, draft: &Draft, stage: &Stage) -> Result<BTreeMap<u32, MaskFeatures>> {
    let mut features: BTreeMap<u32, MaskFeatures> = BTreeMap::new();
    let (mut all, mut missing) = (0, 0);
    for (stem, wanted) in draft.wanted() {
        let index = draft.instances.views.iter().position(|v| v == stem).expect("a view of the draft");
        let dim = features.values().next().map(MaskFeatures::dim);
        let of_view = MaskFeatures::of_view(&a.masks, stem, draft.masks[index] as usize, dim)?;
        let there = |mask: &&u32| {
            of_view.as_ref().and_then(|f| f.row(**mask as usize)).is_some_and(|row| row.iter().any(|&v| v != 0.0))
        };
        all += wanted.len();
        missing += wanted.len() - wanted.iter().filter(there).count();
        features.extend(of_view.map(|f| (index as u32, f)));
    }
    if features.is_empty() && !draft.instances.is_empty() {
        stage.skipped("language descriptors: the masks have no features (*_f.npy; mask-embed embed makes them)");
    } else if missing > 0 {
        stage.warn(&format!(
            "{missing} of {all} masks that say what instances mean have no feature, and count for nothing: run this with --draft FILE, \
             mask-embed embed with --only FILE, then this with --from FILE"
        ));
    }
    Ok(features)
}
