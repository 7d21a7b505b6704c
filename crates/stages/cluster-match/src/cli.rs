//! The command line of `cluster-match`.

#![allow(rustdoc::invalid_html_tags, reason = "help texts name files as <view>_s.npy")]

use crate::associate::{FeatureTable, Silhouette, matches, overlaps};
use crate::describe::{Aggregate, describe};
use crate::extend::from_nearest;
use crate::group::{Distance, Space, group, group_sample, tree};
use crate::health::Health;
use crate::join::by_masks;
use crate::vote::by_votes;
use artifacts::{
    Features, Footprints, Graph, Instances, Level, MaskFeatures, MaskMaps, Match, NOISE_COLOR, TreeEdge, features_path,
    instance_color, maps_path, role,
};
use clap::Parser;
use gs_io::{Claim, Error, IoContext, Outputs, Provenance, Result, Watched, hash_file, write_bytes};
use gs_raster::RasterOptions;
use gs_scene::dataset::{self, LoadOptions, Resolution, View};
use gs_scene::{Gaussians, Geometry, SH_C0, ply};
use hdbscan_exact::{Options, Selection};
use serde_json::{Value, json};
use stage::{CommonArgs, Program, Stage};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Stage 3: 3D instances, the masks they are seen as, and a language descriptor for each
#[derive(Debug, Parser)]
#[command(name = "cluster-match", version)]
pub struct Args {
    /// Dataset folder (COLMAP, transforms.json or ScanNet)
    #[arg(long, value_name = "DIR")]
    scene: PathBuf,
    /// The Gaussians, as a 3DGS PLY
    #[arg(long, value_name = "FILE")]
    geometry: PathBuf,
    /// graph.safetensors of graph-precompute
    #[arg(long, value_name = "FILE")]
    graph: PathBuf,
    /// footprints.safetensors of graph-precompute
    #[arg(long, value_name = "FILE")]
    footprints: PathBuf,
    /// features.safetensors of feat-train
    #[arg(long, value_name = "FILE")]
    features: PathBuf,
    /// Folder of id maps (*_s.npy) and, for language, mask features (*_f.npy)
    #[arg(long, value_name = "DIR")]
    masks: PathBuf,
    /// Output; beside it go <name>.ply (the Gaussians in the colours of their instances), <name>.labels.npy (an i32 for
    /// every Gaussian, -1 for none) and <name>.json (the same to read)
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Also write one PLY per instance into this folder
    #[arg(long, value_name = "DIR")]
    per_instance_plys: Option<PathBuf>,
    #[command(flatten)]
    clustering: ClusteringArgs,
    #[command(flatten)]
    matching: MatchingArgs,
    #[command(flatten)]
    common: CommonArgs,
}

#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Clustering")]
struct ClusteringArgs {
    /// Cluster free points in feature space (the paper), or on the graph of spatial neighbours
    #[arg(long, value_enum, default_value_t = Space::Graph)]
    cluster: Space,
    /// Distance of features on the graph; free points have Euclidean distances of standardised features
    #[arg(long, value_enum, default_value_t = Distance::Chord)]
    distance: Distance,
    /// Average features over each Gaussian's spatial neighbours this many times first
    #[arg(long, default_value_t = 0, value_name = "ROUNDS")]
    smooth: usize,
    /// Cluster this many free points, chosen by --seed, and give the others the clusters they fall into
    #[arg(long, value_name = "COUNT")]
    sample: Option<usize>,
    /// Fewest Gaussians of an instance [default: 30; on the graph a thousandth of those that are seen, but 10 to 30]
    #[arg(long, value_name = "COUNT")]
    min_cluster_size: Option<usize>,
    /// Fewest Gaussians of an instance as a share of those that are seen, if that is more
    #[arg(long, default_value_t = 0.0, value_name = "SHARE")]
    min_cluster_share: f64,
    /// Neighbours, itself included, whose distance is a Gaussian's core distance [default: 30, or 10 on the graph]
    #[arg(long, value_name = "COUNT")]
    min_samples: Option<usize>,
    /// Instances born below this feature distance are joined [default: 0.1, or 0.15 for chords on the graph, 0.011 for
    /// cosines]
    #[arg(long, value_name = "DISTANCE")]
    epsilon: Option<f64>,
    /// Choose the finest clusters instead of the most stable ones
    #[arg(long)]
    leaf: bool,
    /// Let all Gaussians be one instance where nothing divides them
    #[arg(long)]
    allow_single_cluster: bool,
    /// Gaussians in no cluster get the instance of the nearest one in space that has one, or none
    #[arg(long, value_enum, default_value_t = Noise::Nearest)]
    noise: Noise,
    /// Join instances that the masks show as one with at least this probability, more than 0.5; 0 joins none [default:
    /// 0.6 on the graph, 0 for free points]
    #[arg(long, value_name = "PROBABILITY")]
    join: Option<f64>,
    /// Rounds in which Gaussians move to the instance around them whose masks show them [default: 3 on the graph, 0 for
    /// free points]
    #[arg(long, value_name = "ROUNDS")]
    votes: Option<usize>,
}

impl ClusteringArgs {
    /// Probability from which instances are joined, if they are.
    fn join(&self) -> Option<f64> {
        let default = if self.cluster == Space::Graph { JOIN } else { 0.0 };
        Some(self.join.unwrap_or(default)).filter(|j| *j > 0.0)
    }

    /// Rounds of votes.
    fn votes(&self) -> usize {
        self.votes.unwrap_or(if self.cluster == Space::Graph { VOTES } else { 0 })
    }
}

/// From this probability on instances on the graph are joined.
const JOIN: f64 = 0.6;
/// Rounds of votes on the graph.
const VOTES: usize = 3;

/// What becomes of Gaussians that the clustering calls noise.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
enum Noise {
    /// The instance of the nearest Gaussian in space that has one
    Nearest,
    /// No instance
    Keep,
}

#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Matching")]
struct MatchingArgs {
    /// Levels of the masks that vote, join and match: default, small, medium or large, with commas between [default: all
    /// on the graph; large for free points, as the paper]
    #[arg(long, value_delimiter = ',', value_name = "LEVELS")]
    level: Vec<Level>,
    /// Silhouettes of instances rendered alone, or as far as visible; both with a comma between: in each view the better
    #[arg(long, value_enum, default_value = "selected", value_delimiter = ',', value_name = "RULES")]
    silhouette: Vec<Silhouette>,
    /// Least association score of a match, IoU x similarity of features
    #[arg(long, default_value_t = 0.2, value_name = "SCORE")]
    threshold: f32,
    /// How the features of an instance's masks become its descriptor
    #[arg(long, value_enum, default_value_t = Aggregate::Mean)]
    aggregate: Aggregate,
}

impl Args {
    /// Levels of the masks that vote, join and match.
    fn levels(&self) -> Vec<Level> {
        match (&self.matching.level[..], self.clustering.cluster) {
            ([], Space::Graph) => Level::ALL.to_vec(),
            ([], Space::Free) => vec![Level::Large],
            (given, _) => given.to_vec(),
        }
    }
}

impl Program for Args {
    const NAME: &'static str = "cluster-match";

    fn common(&self) -> &CommonArgs {
        &self.common
    }

    fn check(&self) -> Result<()> {
        check(self)
    }

    fn run(self, stage: &Stage) -> Result<()> {
        run(&self, stage)
    }
}

/// The inputs, checked against each other.
struct Inputs {
    geometry: Geometry,
    graph: Graph,
    footprints: Footprints,
    features: Features,
    /// The views whose masks the footprints hold.
    views: Vec<View>,
    hashes: BTreeMap<String, String>,
}

fn read_inputs(a: &Args, stage: &Stage) -> Result<Inputs> {
    let geometry = Geometry::read(&a.geometry)?;
    if let Some(damage) = geometry.damage() {
        stage.skipped(&damage);
    }
    let geometry_hash = hash_file(&a.geometry)?;
    let (graph, graph_file) = Graph::read(&a.graph)?;
    let footprints = Footprints::read(&a.footprints)?;
    let (features, features_file) = Features::read(&a.features)?;
    let masks = artifacts::hash_folder(&a.masks, "_s.npy")?;
    graph_file.expect_input(role::GEOMETRY, &geometry_hash)?;
    footprints.artifact().expect_input(role::GEOMETRY, &geometry_hash)?;
    footprints.artifact().expect_input(role::MASKS, &masks)?;
    let dataset = dataset::load(&a.scene, &LoadOptions { resolution: Resolution::Divisor(1.0), holdout: 0 })?;
    dataset.warnings.iter().for_each(|w| stage.warn(w));
    let dataset_hash = dataset.hash()?;
    graph_file.expect_input(role::DATASET, &dataset_hash)?;
    footprints.artifact().expect_input(role::DATASET, &dataset_hash)?;
    features_file.expect_input(role::GRAPH, graph_file.hash())?;
    features_file.expect_input(role::FOOTPRINTS, footprints.artifact().hash())?;
    if graph.seen_views.len() != geometry.gaussians.len() || graph.kept != features.kept {
        return Err(Error::new("another number of Gaussians than in the graph")
            .file(&a.features)
            .field("kept")
            .found(features.kept.len())
            .expected(graph.kept.len())
            .hint("run feat-train again"));
    }
    let (entries, samples) = (footprints.csr().1.len(), footprints.pixels.col.len());
    let needed = crate::memory::forecast(geometry.gaussians.len(), features.kept.len(), features.dim, entries, samples);
    stage.forecast(needed, "drop small footprint entries: graph-precompute --cut 0.001")?;
    if features.dim == 0 {
        return Err(Error::new("features have no channels")
            .file(&a.features)
            .field("features")
            .hint("run feat-train again"));
    }
    let without: Vec<&str> =
        dataset.views.iter().map(View::stem).filter(|s| !footprints.views.iter().any(|v| v == s)).collect();
    if !without.is_empty() {
        stage.skipped(&format!(
            "{} of {} views in matching: held out, or without masks ({})",
            without.len(),
            dataset.views.len(),
            some_of(&without)
        ));
    }
    let views = footprints.views.iter().map(|stem| {
        dataset.views.iter().find(|v| v.stem() == stem).cloned().ok_or_else(|| {
            Error::new("a view of the footprints is not in the dataset")
                .file(&a.scene)
                .field("views")
                .found(stem)
                .hint("give the dataset that graph-precompute was given")
        })
    });
    let views = views.collect::<Result<_>>()?;
    let mut hashes = BTreeMap::from([
        (role::GEOMETRY.into(), geometry_hash),
        (role::DATASET.into(), dataset_hash),
        (role::GRAPH.into(), graph_file.hash().into()),
        (role::FOOTPRINTS.into(), footprints.artifact().hash().into()),
        (role::FEATURES.into(), features_file.hash().into()),
        (role::MASKS.into(), masks),
        (role::MASK_FEATURES.into(), artifacts::hash_folder(&a.masks, "_f.npy")?),
    ]);
    hashes.extend(model_of_features(&a.masks, &hashes[role::MASKS])?);
    Ok(Inputs { geometry, graph, footprints, features, views, hashes })
}

/// Which CLIP model made the features of the masks, as far as `features.json` of mask-embed says it.
///
/// # Errors
/// When the features are of other id maps.
fn model_of_features(folder: &Path, masks: &str) -> Result<BTreeMap<String, String>> {
    let manifest = folder.join("features.json");
    // Features that another program made have none.
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

/// The first few of many names.
fn some_of(names: &[&str]) -> String {
    const SHOWN: usize = 5;
    let shown = names[..names.len().min(SHOWN)].join(", ");
    if names.len() > SHOWN { format!("{shown}, ...") } else { shown }
}

/// The clustering's options for `n` Gaussians.
fn options(c: &ClusteringArgs, n: usize) -> Result<Options> {
    // Free points: as GARField and InstaScene. On the graph: measured on synthetic scenes of mixed granularity, where 0.1 to
    // 0.2 give the same mIoU within 0.01, and 0 gives hundreds of fragments: near-equal features have lambdas without bound.
    let (min_samples, epsilon) = match (c.cluster, c.distance) {
        (Space::Free, _) => (30, 0.1),
        (Space::Graph, Distance::Chord) => (10, 0.15),
        (Space::Graph, Distance::Cosine) => (10, 0.011),
        (Space::Graph, Distance::Euclidean) => (10, 0.1),
    };
    let (min_samples, epsilon) = (c.min_samples.unwrap_or(min_samples), c.epsilon.unwrap_or(epsilon));
    let share = c.min_cluster_share;
    // Small scenes have small things; measured at 12,000 and 88,000 Gaussians (docs/accuracy.md).
    let smallest = c.min_cluster_size.unwrap_or(match c.cluster {
        Space::Free => 30,
        Space::Graph => n.div_ceil(1000).clamp(10, 30),
    });
    let check = |good: bool, field: &str, found: &dyn std::fmt::Display, expected: &str| match good {
        true => Ok(()),
        false => Err(Error::new("impossible option").field(field).found(found).expected(expected)),
    };
    check(smallest >= 2, "--min-cluster-size", &smallest, "at least 2")?;
    check((0.0..=1.0).contains(&share), "--min-cluster-share", &share, "0 to 1")?;
    check(min_samples >= 1, "--min-samples", &min_samples, "at least 1")?;
    if let Some(sample) = c.sample {
        check(sample >= 2, "--sample", &sample, "at least 2")?;
        check(
            c.cluster == Space::Free,
            "--sample",
            &sample,
            "--cluster free: a graph without most of its nodes falls apart",
        )?;
    }
    check((0.0..f64::INFINITY).contains(&epsilon), "--epsilon", &epsilon, "at least 0")?;
    if let Some(join) = c.join {
        check(join == 0.0 || join > 0.5 && join <= 1.0, "--join", &join, "0, or more than 0.5 and at most 1")?;
    }
    Ok(Options {
        min_cluster_size: smallest.max((share * n as f64).ceil() as usize),
        min_samples,
        epsilon,
        selection: if c.leaf { Selection::Leaf } else { Selection::ExcessOfMass },
        allow_single_cluster: c.allow_single_cluster,
    })
}

/// Options that no scene can mend are refused before anything is read.
fn check(a: &Args) -> Result<()> {
    options(&a.clustering, 0)?;
    let threshold = a.matching.threshold;
    if !(0.0..=1.0).contains(&threshold) {
        return Err(Error::new("impossible option").field("--threshold").found(threshold).expected("0 to 1"));
    }
    if let Some(taken) = SIDE_FILES.iter().find(|e| a.out.with_extension(e) == a.out) {
        return Err(Error::new("another output has this name")
            .file(&a.out)
            .field("--out")
            .found(format!(".{taken}"))
            .expected("a name such as instances.safetensors"));
    }
    Ok(())
}

/// The right to write the instances and what lies beside them.
fn claim(a: &Args, stage: &Stage) -> Result<Claim> {
    let mut maps = Vec::new();
    for suffix in ["_s.npy", "_f.npy"] {
        maps.extend(artifacts::folder_files(&a.masks, suffix)?);
    }
    let outputs = stage
        .outputs(&a.out)
        .artifact(&a.out, Instances::FORMAT)
        .files(SIDE_FILES.map(|extension| a.out.with_extension(extension)))
        .reads([&a.geometry, &a.graph, &a.footprints, &a.features])
        .reads(maps)
        .drop_stale();
    a.per_instance_plys.iter().fold(outputs, Outputs::folder).claim()
}

fn run(a: &Args, stage: &Stage) -> Result<()> {
    let (c, m) = (&a.clustering, &a.matching);
    let mut claim = claim(a, stage)?;
    let mut watched = Watched::new([&a.geometry]);
    for suffix in ["_s.npy", "_f.npy"] {
        watched = watched.and(artifacts::watch_folder(&a.masks, suffix)?);
    }
    let inputs = read_inputs(a, stage)?;
    let (n_all, n) = (inputs.geometry.gaussians.len(), inputs.graph.kept.len());
    let options = options(c, n)?;

    let start = Instant::now();
    let clustering = match c.sample {
        Some(sample) => {
            if sample < n {
                stage.skipped(&format!("{} of {n} Gaussians in clustering: not in the sample; predicted", n - sample));
            }
            group_sample(&inputs.features, &inputs.graph, c.smooth, sample, a.common.seed, &options)
        }
        None => group(&inputs.features, &inputs.graph, c.cluster, c.distance, c.smooth, &options),
    };
    let clustering_seconds = start.elapsed().as_secs_f64();
    let mut instances = clustering.selected.len();
    let noise = clustering.labels.iter().filter(|&&l| l < 0).count();
    stage.info(&format!("{instances} instances among {n} Gaussians, {noise} noise"));
    if instances == 0 {
        stage.warn(
            "everything is noise: no instance was found; give a smaller --min-cluster-size, or --allow-single-cluster \
             where the scene is one thing",
        );
    }
    let mut labels = vec![-1i32; n_all];
    let mut nodes = vec![-1i32; n_all];
    let mut kept = vec![false; n_all];
    for (&i, (&l, &node)) in inputs.graph.kept.iter().zip(clustering.labels.iter().zip(&clustering.nodes)) {
        labels[i as usize] = l;
        nodes[i as usize] = node as i32;
        kept[i as usize] = true;
    }
    let means = &inputs.geometry.gaussians.means;
    if c.noise == Noise::Nearest {
        let noisy: Vec<bool> = labels.iter().zip(&kept).map(|(&l, &k)| k && l < 0).collect();
        from_nearest(means, &mut labels, &mut nodes, |i| noisy[i])?;
    }
    let mut tree = tree(&clustering);
    instances = revise(a, stage, &inputs, (instances, &clustering.selected), (&mut labels, &mut nodes), &mut tree);
    // Damaged Gaussians have no place, so they are nobody's neighbour and stay without an instance.
    let whole = inputs.geometry.whole();
    let unseen = (0..n_all).filter(|&i| !kept[i] && whole[i]).count();
    if unseen > 0 {
        let what =
            format!("{unseen} of {n_all} Gaussians in clustering: never seen; labelled from their nearest neighbour");
        stage.skipped_some(&what, unseen, n, clustering_seconds);
        from_nearest(means, &mut labels, &mut nodes, |i| !kept[i] && whole[i])?;
    }

    let (matches, features) = associate(a, stage, &inputs, &labels)?;
    if features.is_empty() {
        stage.skipped("language descriptors: the masks have no features (*_f.npy; mask-embed embed makes them)");
    }
    let views = inputs.views.iter().map(|v| v.stem().to_string()).collect();
    let described = describe(means, labels, instances, matches, views, &features, m.aggregate, tree);
    let instances = Instances { node: nodes, ..described };
    watched.check()?;
    write_outputs(a, stage, &inputs, &instances, &options, (noise, clustering_seconds), &mut claim)
}

/// Moves Gaussians between instances and joins instances as the masks say. Takes the number of instances and their clusters;
/// returns how many instances there are then. A Gaussian that moves becomes one of its new instance's cluster.
fn revise(
    a: &Args,
    stage: &Stage,
    inputs: &Inputs,
    (mut instances, clusters): (usize, &[u32]),
    (labels, nodes): (&mut [i32], &mut [i32]),
    tree: &mut [TreeEdge],
) -> usize {
    let (c, levels) = (&a.clustering, &a.levels());
    let mut of_kept: Vec<i32> = inputs.graph.kept.iter().map(|&i| labels[i as usize]).collect();
    if c.votes() > 0 {
        let moved = by_votes(&mut of_kept, instances, &inputs.footprints, &inputs.graph, levels, c.votes());
        stage.info(&format!("{moved} moves of Gaussians to the instance that their masks show"));
        for (&i, &label) in inputs.graph.kept.iter().zip(&of_kept) {
            if let Some(&cluster) = usize::try_from(label).ok().and_then(|l| clusters.get(l))
                && labels[i as usize] != label
            {
                nodes[i as usize] = cluster as i32;
            }
        }
    }
    if let Some(least) = c.join() {
        let number = by_masks(&of_kept, instances, &inputs.footprints, levels, least);
        let left = number.iter().max().map_or(0, |&n| n as usize + 1);
        if left < instances {
            stage.info(&format!("{left} instances after joining pieces that the masks show as one"));
        }
        instances = left;
        let renumber = |l: &mut i32| *l = usize::try_from(*l).map_or(*l, |k| number[k] as i32);
        of_kept.iter_mut().for_each(renumber);
        tree.iter_mut().for_each(|e| renumber(&mut e.instance));
    }
    inputs.graph.kept.iter().zip(of_kept).for_each(|(&i, l)| labels[i as usize] = l);
    instances
}

/// Matches instances with the masks of every view that has id maps.
fn associate(
    a: &Args,
    stage: &Stage,
    inputs: &Inputs,
    labels: &[i32],
) -> Result<(Vec<Match>, BTreeMap<u32, MaskFeatures>)> {
    let (gaussians, raster) = (&inputs.geometry.gaussians, RasterOptions::of(&inputs.geometry));
    let table = FeatureTable::new(&inputs.features, gaussians.len());
    let mut found = Vec::new();
    let mut features: BTreeMap<u32, MaskFeatures> = BTreeMap::new();
    let mut progress = stage.progress("matching views", inputs.views.len() as u64);
    for (index, view) in inputs.views.iter().enumerate() {
        let stem = view.stem();
        let maps = MaskMaps::read(maps_path(&a.masks, stem))?;
        let camera = view.camera.resized(maps.width as u32, maps.height as u32);
        let m = &a.matching;
        let o = overlaps(gaussians, &raster, labels, &table, &camera, &maps, &a.levels(), &m.silhouette);
        found.extend(matches(&o, index as u32, m.threshold));
        let path = features_path(&a.masks, stem);
        if path.is_file() {
            let f = MaskFeatures::read(&path)?;
            if f.count < maps.id_count() {
                return Err(Error::new("fewer features than masks")
                    .file(&path)
                    .field("rows")
                    .found(f.count)
                    .expected(format!("at least {}", maps.id_count()))
                    .hint("run mask-embed embed again"));
            }
            if let Some(first) = features.values().next().filter(|first| first.dim != f.dim) {
                return Err(Error::new("features of different models")
                    .file(&path)
                    .field("columns")
                    .found(f.dim)
                    .expected(first.dim)
                    .hint("run mask-embed embed again"));
            }
            features.insert(index as u32, f);
        }
        progress.step();
    }
    progress.finish(&[("matches", found.len() as f64)]);
    if !features.is_empty() && features.len() < inputs.views.len() {
        stage.warn(&format!(
            "{} of {} views have no mask features",
            inputs.views.len() - features.len(),
            inputs.views.len()
        ));
    }
    Ok((found, features))
}

/// The geometry in the colours of its instances, as a plain 3DGS PLY that any viewer shows.
fn colored(g: &Gaussians, labels: &[i32]) -> Gaussians {
    let color = |&l: &i32| u32::try_from(l).map_or(NOISE_COLOR, instance_color).map(|v| (v - 0.5) / SH_C0);
    Gaussians {
        means: g.means.clone(),
        log_scales: g.log_scales.clone(),
        rotations: g.rotations.clone(),
        opacity_logits: g.opacity_logits.clone(),
        sh: labels.iter().flat_map(color).collect(),
        sh_degree: 0,
    }
}

/// The instances to read: where they are, how large, and as which masks they were seen.
fn readable(instances: &Instances, parameters: &Value) -> Value {
    let sizes = instances.cluster_sizes();
    let list: Vec<Value> = (0..instances.len())
        .map(|k| {
            let own = instances.matches.iter().filter(|m| m.instance as usize == k);
            let matches: Vec<Value> = own
                .map(|m| json!({"view": instances.views[m.view as usize], "mask": m.mask, "score": m.score}))
                .collect();
            let family = instances.family(k);
            let gaussians = |cluster: u32| sizes.get(&cluster).copied().unwrap_or(0);
            let parent = family.as_ref().and_then(|f| f.parent).map(
                |p| json!({"cluster": p, "gaussians": gaussians(p), "instances": instances.instances_of_cluster(p)}),
            );
            let part = |&p: &u32| json!({"cluster": p, "gaussians": gaussians(p)});
            let parts: Vec<Value> = family.iter().flat_map(|f| &f.parts).map(part).collect();
            let oriented = instances
                .oriented
                .get(k)
                .map(|b| json!({"center": b.center, "axes": b.axes, "half_size": b.half_size}));
            json!({
                "oriented_box": oriented, "clusters": family.map(|f| f.own), "parent": parent, "parts": parts,
                "instance": k, "gaussians": instances.count[k], "support": instances.support[k],
                "score": instances.score[k], "centroid": instances.centroid[k],
                "bbox_min": instances.bbox_min[k], "bbox_max": instances.bbox_max[k],
                "color": instance_color(k as u32), "matches": matches,
            })
        })
        .collect();
    let unlabelled = instances.label.iter().filter(|&&l| l < 0).count();
    json!({
        "gaussians": instances.label.len(), "without_instance": unlabelled, "descriptor_dim": instances.dim,
        "parameters": parameters, "instances": list,
    })
}

/// One PLY per instance, `instance_0000.ply` on.
fn write_instance_plys(folder: &Path, g: &Gaussians, instances: &Instances, comments: &[String]) -> Result<()> {
    let mut members = vec![Vec::new(); instances.len()];
    for (i, &label) in instances.label.iter().enumerate() {
        if let Ok(k) = usize::try_from(label) {
            members[k].push(i as u32);
        }
    }
    let path = |k: usize| folder.join(format!("instance_{k:04}.ply"));
    for (k, own) in members.iter().enumerate() {
        ply::write_gaussians(path(k), &g.select(own), comments)?;
    }
    Ok(())
}

/// What is written beside the output, by extension: coloured Gaussians, labels, and the instances to read.
const SIDE_FILES: [&str; 3] = ["ply", "labels.npy", "json"];

fn write_outputs(
    a: &Args,
    stage: &Stage,
    inputs: &Inputs,
    instances: &Instances,
    options: &Options,
    (noise, clustering_seconds): (usize, f64),
    claim: &mut Claim,
) -> Result<()> {
    let (c, m) = (&a.clustering, &a.matching);
    let lower = |v: &dyn std::fmt::Debug| format!("{v:?}").to_lowercase();
    let levels: Vec<String> = a.levels().iter().map(ToString::to_string).collect();
    let silhouettes: Vec<String> = m.silhouette.iter().map(|s| lower(s)).collect();
    let parameters = json!({
        "cluster": lower(&c.cluster),
        "distance": lower(&c.distance),
        "smooth": c.smooth,
        "sample": c.sample,
        "min_cluster_size": options.min_cluster_size,
        "min_samples": options.min_samples,
        "epsilon": options.epsilon,
        "leaf": c.leaf,
        "allow_single_cluster": options.allow_single_cluster,
        "noise": lower(&c.noise),
        "join": c.join(),
        "votes": c.votes(),
        "level": levels.join(","),
        "silhouette": silhouettes.join(","),
        "threshold": m.threshold,
        "aggregate": lower(&m.aggregate),
    });
    let own = vec![format!("made by cluster-match {}", env!("CARGO_PKG_VERSION")), format!("parameters {parameters}")];
    let (gaussians, comments) = (&inputs.geometry.gaussians, inputs.geometry.comments(own));
    let [colors, list, table] = SIDE_FILES.map(|extension| a.out.with_extension(extension));
    ply::write_gaussians(colors, &colored(gaussians, &instances.label), &comments)?;
    gs_io::npy::write_i32(list, &[instances.label.len()], &instances.label)?;
    let text = serde_json::to_vec_pretty(&readable(instances, &parameters)).map_err(|e| Error::new(e.to_string()))?;
    write_bytes(table, &text)?;
    if let Some(folder) = &a.per_instance_plys {
        write_instance_plys(folder, gaussians, instances, &comments)?;
    }
    let matched = instances.support.iter().filter(|&&s| s > 0).count();
    let health = Health::of(instances, &inputs.footprints, &inputs.graph.kept, &a.levels());
    health.say(stage);
    let summary = json!({
        "largest_share": health.largest, "mask_purity": health.purity,
        "instances": instances.len(), "noise": noise, "matched": matched, "matches": instances.matches.len(),
        "clustering_seconds": clustering_seconds,
    });
    stage.record(claim, parameters.clone(), inputs.hashes.clone(), summary)?;
    // The artifact comes last: where it is new, so is everything beside it.
    instances.write(&a.out, stage.provenance(Instances::FORMAT, 1, parameters, inputs.hashes.clone()))?;
    stage.info(&format!("wrote {}: {} instances, {matched} matched with masks", a.out.display(), instances.len()));
    Ok(())
}
