//! The command line of `cluster-match`.

use crate::associate::{Silhouette, matches, overlaps};
use crate::describe::{Aggregate, describe};
use crate::extend::from_nearest;
use crate::group::{Space, group, tree};
use artifacts::{
    Features, Footprints, Graph, Instances, Level, MaskFeatures, MaskMaps, Match, NOISE_COLOR, features_path,
    instance_color, maps_path, role,
};
use clap::Parser;
use gs_io::{Error, Result, hash_file, write_bytes};
use gs_scene::dataset::{self, LoadOptions, Resolution};
use gs_scene::{Gaussians, SH_C0, ply};
use hdbscan_exact::{Options, Selection};
use serde_json::{Value, json};
use stage::{CommonArgs, Program, Stage};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

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
    /// Output; beside it go <name>.ply (instances in colours), <name>.labels.npy and <name>.json
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
    /// Average features over each Gaussian's spatial neighbours this many times first
    #[arg(long, default_value_t = 0, value_name = "ROUNDS")]
    smooth: usize,
    /// Fewest Gaussians of an instance
    #[arg(long, default_value_t = 30, value_name = "COUNT")]
    min_cluster_size: usize,
    /// Neighbours, itself included, whose distance is a Gaussian's core distance [default: 30, or 5 on the graph]
    #[arg(long, value_name = "COUNT")]
    min_samples: Option<usize>,
    /// Instances born below this feature distance are joined [default: 0.1, or 0 on the graph]
    #[arg(long, value_name = "DISTANCE")]
    epsilon: Option<f64>,
    /// Choose the finest clusters instead of the most stable ones
    #[arg(long)]
    leaf: bool,
    /// Leave noise without an instance instead of giving it the nearest one's
    #[arg(long)]
    keep_noise: bool,
}

#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Matching")]
struct MatchingArgs {
    /// Level of the masks: default, small, medium or large
    #[arg(long, default_value = "large")]
    level: Level,
    /// Silhouettes of instances rendered alone, or as far as visible
    #[arg(long, value_enum, default_value_t = Silhouette::Selected)]
    silhouette: Silhouette,
    /// Least association score of a match, IoU x similarity of features
    #[arg(long, default_value_t = 0.2, value_name = "SCORE")]
    threshold: f32,
    /// How the features of an instance's masks become its descriptor
    #[arg(long, value_enum, default_value_t = Aggregate::Mean)]
    aggregate: Aggregate,
}

impl Program for Args {
    const NAME: &'static str = "cluster-match";

    fn common(&self) -> &CommonArgs {
        &self.common
    }

    fn run(self, stage: &Stage) -> Result<()> {
        run(&self, stage)
    }
}

/// The inputs, checked against each other.
struct Inputs {
    gaussians: Gaussians,
    graph: Graph,
    features: Features,
    views: Vec<String>,
    hashes: BTreeMap<String, String>,
}

fn read_inputs(a: &Args) -> Result<Inputs> {
    let gaussians = ply::read_gaussians(&a.geometry)?;
    let geometry = hash_file(&a.geometry)?;
    let (graph, graph_file) = Graph::read(&a.graph)?;
    let footprints = Footprints::read(&a.footprints)?;
    let (features, features_file) = Features::read(&a.features)?;
    let masks = artifacts::hash_folder(&a.masks, "_s.npy")?;
    graph_file.expect_input(role::GEOMETRY, &geometry)?;
    footprints.artifact().expect_input(role::GEOMETRY, &geometry)?;
    footprints.artifact().expect_input(role::MASKS, &masks)?;
    features_file.expect_input(role::GRAPH, graph_file.hash())?;
    features_file.expect_input(role::FOOTPRINTS, footprints.artifact().hash())?;
    if graph.seen_views.len() != gaussians.len() || graph.kept != features.kept {
        return Err(Error::new("another number of Gaussians than in the graph")
            .file(&a.features)
            .field("kept")
            .found(features.kept.len())
            .expected(graph.kept.len())
            .hint("run feat-train again"));
    }
    if features.dim == 0 {
        return Err(Error::new("features have no channels")
            .file(&a.features)
            .field("features")
            .hint("run feat-train again"));
    }
    let hashes = BTreeMap::from([
        (role::GEOMETRY.into(), geometry),
        (role::GRAPH.into(), graph_file.hash().into()),
        (role::FOOTPRINTS.into(), footprints.artifact().hash().into()),
        (role::FEATURES.into(), features_file.hash().into()),
        (role::MASKS.into(), masks),
        (role::MASK_FEATURES.into(), artifacts::hash_folder(&a.masks, "_f.npy")?),
    ]);
    Ok(Inputs { gaussians, graph, features, views: footprints.views, hashes })
}

fn options(c: &ClusteringArgs) -> Result<Options> {
    let (min_samples, epsilon) = match c.cluster {
        Space::Free => (c.min_samples.unwrap_or(30), c.epsilon.unwrap_or(0.1)),
        Space::Graph => (c.min_samples.unwrap_or(5), c.epsilon.unwrap_or(0.0)),
    };
    if c.min_cluster_size < 2 || min_samples < 1 || !(0.0..f64::INFINITY).contains(&epsilon) {
        return Err(Error::new("impossible option")
            .field("--min-cluster-size, --min-samples, --epsilon")
            .found(format!("{}, {min_samples}, {epsilon}", c.min_cluster_size))
            .expected("at least 2, at least 1, at least 0"));
    }
    Ok(Options {
        min_cluster_size: c.min_cluster_size,
        min_samples,
        epsilon,
        selection: if c.leaf { Selection::Leaf } else { Selection::ExcessOfMass },
        allow_single_cluster: false,
    })
}

fn run(a: &Args, stage: &Stage) -> Result<()> {
    let options = options(&a.clustering)?;
    let inputs = read_inputs(a)?;
    let (n_all, n) = (inputs.gaussians.len(), inputs.graph.kept.len());
    let c = &a.clustering;

    let clustering = group(&inputs.features, &inputs.graph, c.cluster, c.smooth, &options);
    let instances = clustering.selected.len();
    let noise = clustering.labels.iter().filter(|&&l| l < 0).count();
    stage.info(&format!("{instances} instances among {n} Gaussians, {noise} noise"));
    if instances == 0 {
        stage.warn("everything is noise: no instance was found; try a smaller --min-cluster-size");
    }
    let mut labels = vec![-1i32; n_all];
    let mut kept = vec![false; n_all];
    for (&i, &l) in inputs.graph.kept.iter().zip(&clustering.labels) {
        labels[i as usize] = l;
        kept[i as usize] = true;
    }
    if !c.keep_noise {
        let noisy: Vec<bool> = labels.iter().zip(&kept).map(|(&l, &k)| k && l < 0).collect();
        from_nearest(&inputs.gaussians.means, &mut labels, |i| noisy[i])?;
    }
    if n < n_all {
        stage.skipped(&format!(
            "{} of {n_all} Gaussians in clustering: never seen; labelled from their nearest neighbour",
            n_all - n
        ));
        from_nearest(&inputs.gaussians.means, &mut labels, |i| !kept[i])?;
    }

    let (matches, features) = associate(a, stage, &inputs, &labels)?;
    if features.is_empty() {
        stage.skipped("language descriptors: the masks have no features (*_f.npy; mask-embed embed makes them)");
    }
    let m = &a.matching;
    let instances = describe(
        &inputs.gaussians.means,
        labels,
        instances,
        matches,
        inputs.views.clone(),
        &features,
        m.aggregate,
        tree(&clustering),
    );
    write_outputs(a, stage, &inputs, &instances, &options)
}

/// Matches instances with the masks of every view that has id maps.
fn associate(
    a: &Args,
    stage: &Stage,
    inputs: &Inputs,
    labels: &[i32],
) -> Result<(Vec<Match>, BTreeMap<u32, MaskFeatures>)> {
    let load = LoadOptions { resolution: Resolution::Divisor(1.0), holdout: 0 };
    let dataset = dataset::load(&a.scene, &load)?;
    dataset.warnings.iter().for_each(|w| stage.warn(w));
    // Features of all Gaussians: those that no view sees have no weight, so zeros do.
    let dim = inputs.features.dim;
    let mut all = vec![0.0f32; inputs.gaussians.len() * dim];
    for (position, &i) in inputs.features.kept.iter().enumerate() {
        all[i as usize * dim..(i as usize + 1) * dim].copy_from_slice(inputs.features.row(position));
    }
    let mut found = Vec::new();
    let mut features: BTreeMap<u32, MaskFeatures> = BTreeMap::new();
    let mut progress = stage.progress("matching views", inputs.views.len() as u64);
    for (index, stem) in inputs.views.iter().enumerate() {
        let Some(view) = dataset.views.iter().find(|v| v.stem() == stem) else {
            return Err(Error::new("a view of the footprints is not in the dataset")
                .file(&a.scene)
                .field("views")
                .found(stem)
                .hint("give the dataset that graph-precompute was given"));
        };
        let maps = MaskMaps::read(maps_path(&a.masks, stem))?;
        let camera = view.camera.resized(maps.width as u32, maps.height as u32);
        let m = &a.matching;
        let o = overlaps(&inputs.gaussians, labels, &all, dim, &camera, &maps, m.level, m.silhouette);
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
    let sh = labels
        .iter()
        .flat_map(|&l| u32::try_from(l).map_or(NOISE_COLOR, instance_color).map(|v| (v - 0.5) / SH_C0))
        .collect();
    Gaussians { sh, sh_degree: 0, ..g.clone() }
}

fn beside(out: &Path, extension: &str) -> PathBuf {
    out.with_extension(extension)
}

fn write_outputs(a: &Args, stage: &Stage, inputs: &Inputs, instances: &Instances, options: &Options) -> Result<()> {
    let (c, m) = (&a.clustering, &a.matching);
    let parameters = json!({
        "cluster": format!("{:?}", c.cluster).to_lowercase(),
        "smooth": c.smooth,
        "min_cluster_size": options.min_cluster_size,
        "min_samples": options.min_samples,
        "epsilon": options.epsilon,
        "leaf": c.leaf,
        "keep_noise": c.keep_noise,
        "level": m.level.to_string(),
        "silhouette": format!("{:?}", m.silhouette).to_lowercase(),
        "threshold": m.threshold,
        "aggregate": format!("{:?}", m.aggregate).to_lowercase(),
    });
    let comments = [format!("made by cluster-match {}", env!("CARGO_PKG_VERSION")), format!("parameters {parameters}")];
    ply::write_gaussians(beside(&a.out, "ply"), &colored(&inputs.gaussians, &instances.label), &comments)?;
    gs_io::npy::write_i32(beside(&a.out, "labels.npy"), &[instances.label.len()], &instances.label)?;
    let list: Vec<Value> = (0..instances.len())
        .map(|k| {
            json!({
                "instance": k, "gaussians": instances.count[k], "support": instances.support[k],
                "score": instances.score[k], "centroid": instances.centroid[k],
                "bbox_min": instances.bbox_min[k], "bbox_max": instances.bbox_max[k],
            })
        })
        .collect();
    let text = serde_json::to_vec_pretty(&json!({ "instances": list })).map_err(|e| Error::new(e.to_string()))?;
    write_bytes(beside(&a.out, "json"), &text)?;
    if let Some(folder) = &a.per_instance_plys {
        for k in 0..instances.len() {
            let own: Vec<u32> =
                (0..instances.label.len() as u32).filter(|&i| instances.label[i as usize] == k as i32).collect();
            ply::write_gaussians(
                folder.join(format!("instance_{k:04}.ply")),
                &inputs.gaussians.select(&own),
                &comments,
            )?;
        }
    }
    let matched = instances.support.iter().filter(|&&s| s > 0).count();
    let summary = json!({"instances": instances.len(), "matched": matched, "matches": instances.matches.len()});
    stage.record(&a.out, parameters.clone(), inputs.hashes.clone(), summary)?;
    let provenance = stage.provenance(Instances::FORMAT, 1, parameters, inputs.hashes.clone());
    instances.write(&a.out, provenance)?;
    stage.info(&format!("wrote {}: {} instances, {matched} matched with masks", a.out.display(), instances.len()));
    Ok(())
}
