//! The command line of `feat-train`.

#![allow(rustdoc::invalid_html_tags, reason = "help texts name files as <view>_s.npy")]

use crate::checkpoint;
use crate::evidence::{Evidence, collect};
use crate::fast::{Engine, Shortcuts};
use crate::loss::Loss;
use crate::memory;
use crate::model::{AnchorStart, CohesionOf, Init, Settings};
use crate::normalize::Axis;
use crate::real::{Half, Weight};
use crate::scene::{Context, Neighbours, mask_sets};
use crate::spectral::{SpectralOptions, spectral};
use crate::train::{CurvePoint, TrainOptions, train};
use artifacts::{Features, Footprints, Graph, Level, Row, role};
use clap::ValueEnum;
use gs_io::{Error, Result, Watched, hash_file, with_suffix, write_bytes};
use gs_scene::{Geometry, SH_C0};
use report::curve::{self, Panel};
use serde_json::{Value, json};
use stage::{CommonArgs, Program, Stage};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// A feature vector for every Gaussian, from the masks of all views
#[derive(Debug, clap::Parser)]
#[command(name = "feat-train", version)]
pub struct Args {
    /// Gaussians, as a 3DGS PLY
    #[arg(long, value_name = "FILE")]
    geometry: PathBuf,
    /// graph.safetensors of graph-precompute
    #[arg(long, value_name = "FILE")]
    graph: PathBuf,
    /// footprints.safetensors of graph-precompute
    #[arg(long, value_name = "FILE")]
    footprints: PathBuf,
    /// Where to write the features; the curve goes to <FILE>.curve.jsonl, as a picture to <FILE>.curve.svg
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// How features come about
    #[arg(long, value_enum, default_value_t = Method::Spectral)]
    method: Method,
    /// Levels of the masks to learn from: default, small, medium or large, with commas between [default: all for
    /// spectral; large for contrastive, as the paper]
    #[arg(long, value_name = "LEVELS", value_delimiter = ',')]
    levels: Vec<Level>,
    /// Dimension of the features [default: 6 for contrastive; for spectral as many as the cutoff keeps, at most 256, and
    /// fewer from 262,144 Gaussians on, but at least 64]
    #[arg(long, value_name = "COUNT")]
    dim: Option<usize>,
    #[command(flatten)]
    contrastive: Contrastive,
    #[command(flatten)]
    spectral: Spectral,
    #[command(flatten)]
    common: CommonArgs,
}

/// How features come about.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Method {
    /// The paper's: contextual propagation and mask-aware contrastive learning.
    Contrastive,
    /// Closed form: leading singular vectors of the matrix of Gaussians and masks.
    Spectral,
}

/// A set of defaults.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum Preset {
    /// The paper read literally.
    Paper,
}

/// Options of `--method contrastive`.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Contrastive learning")]
struct Contrastive {
    /// The paper read literally: --method contrastive with the defaults below, which other options may still change
    #[arg(long, value_enum)]
    preset: Option<Preset>,
    /// Iterations, one random view each
    #[arg(long, value_name = "COUNT", default_value_t = 10_000)]
    iterations: u64,
    /// Layers of the graph network, 0 to 4
    #[arg(long, value_name = "COUNT", default_value_t = 2)]
    layers: usize,
    /// Whom an anchor aggregates
    #[arg(long, value_enum, default_value_t = Neighbours::Gaussians)]
    neighbours: Neighbours,
    /// What an anchor's own feature is before the first layer
    #[arg(long, value_enum, default_value_t = AnchorStart::Inputs)]
    anchor_start: AnchorStart,
    /// Let negative values through the last layer
    #[arg(long)]
    no_last_relu: bool,
    /// Bring the features of each Gaussian to unit length before they are rendered
    #[arg(long)]
    unit_length: bool,
    /// What is standardised together
    #[arg(long, value_enum, default_value_t = Axis::Channel)]
    norm_axis: Axis,
    /// Loss on the masks of a view
    #[arg(long, value_enum, default_value_t = Loss::Printed)]
    loss: Loss,
    /// How features start
    #[arg(long, value_enum, default_value_t = Init::Uniform)]
    init: Init,
    /// Temperature of the loss
    #[arg(long, value_name = "TAU", default_value_t = 0.1)]
    tau: f64,
    /// Learning rate of features
    #[arg(long, value_name = "RATE", default_value_t = 1e-3)]
    lr: f64,
    /// Learning rate of the graph network
    #[arg(long, value_name = "RATE", default_value_t = 1e-3)]
    weight_lr: f64,
    /// Weight of a term that pulls Gaussians to the centroids of their masks (the paper found that it hurts)
    #[arg(long, value_name = "WEIGHT", default_value_t = 0.0)]
    cohesion: f64,
    /// Of what this is the distance to the centroid
    #[arg(long, value_enum, default_value_t = CohesionOf::Gaussians)]
    cohesion_of: CohesionOf,
    /// Give what anchors aggregate to the anchors alone
    #[arg(long)]
    no_propagation: bool,
    /// Iterations between checkpoints; 0 for none
    #[arg(long, value_name = "COUNT", default_value_t = 1000)]
    checkpoint_every: u64,
    /// Take means and deviations anew only every so many iterations: an approximation
    #[arg(long, value_name = "COUNT", default_value_t = 1)]
    stats_every: u64,
    /// Leave Gaussians that the view does not see, and their momentum, as they are: an approximation
    #[arg(long)]
    lazy_adam: bool,
    /// Keep footprint weights in 16 bits, each within 0.02% of what it was: an approximation
    #[arg(long)]
    half_weights: bool,
    /// Hold out every tenth view from training, and stop when their loss has settled
    #[arg(long)]
    early_stop: bool,
    /// Take turns at views with a single mask too, which teach nothing: it has no other to be told from
    #[arg(long)]
    no_skip: bool,
    /// Iterations between points of the curve
    #[arg(long, value_name = "COUNT", default_value_t = 50)]
    curve_every: u64,
}

/// Options of `--method spectral`.
#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Closed form")]
struct Spectral {
    /// Singular value below which vectors fade out: low shows parts, high shows whole things. A vector separates what it
    /// does the better the nearer its singular value is to 1
    #[arg(long, value_name = "VALUE", default_value_t = 0.6)]
    cutoff: f64,
    /// How steeply they fade out there
    #[arg(long, value_name = "POWER", default_value_t = 16.0)]
    power: f64,
    /// What a mask says about a Gaussian
    #[arg(long, value_enum, default_value_t = Evidence::Weight)]
    evidence: Evidence,
    /// Do not spread evidence over spatial neighbours
    #[arg(long)]
    no_smoothing: bool,
}

/// Dimension of the closed form where `--dim` is not given: within these bounds as many as features of so many numbers in
/// all allow (256 MB).
const MOST_VECTORS: usize = 256;
const LEAST_VECTORS: usize = 64;
const MOST_NUMBERS: usize = 1 << 26;

fn name_of(value: &impl ValueEnum) -> String {
    value.to_possible_value().map_or_else(String::new, |v| v.get_name().to_string())
}

impl Args {
    fn method(&self) -> Method {
        if self.contrastive.preset.is_some() { Method::Contrastive } else { self.method }
    }

    fn levels(&self) -> Vec<Level> {
        match (&self.levels[..], self.method()) {
            ([], Method::Spectral) => Level::ALL.to_vec(),
            ([], Method::Contrastive) => vec![Level::Large],
            (given, _) => given.to_vec(),
        }
    }

    /// Vectors of the closed form that are kept at most, where `--dim` is not given.
    fn most_vectors(&self, gaussians: usize) -> usize {
        self.dim.unwrap_or((MOST_NUMBERS / gaussians.max(1)).clamp(LEAST_VECTORS, MOST_VECTORS))
    }

    fn check_ranges(&self) -> Result<()> {
        let c = &self.contrastive;
        let dims = match self.method() {
            Method::Contrastive => 2..=64,
            Method::Spectral => 1..=512,
        };
        let positive = |v: f64| v > 0.0 && v.is_finite();
        let checks = [
            ("--dim", self.dim.is_none_or(|d| dims.contains(&d)), format!("{:?}", self.dim), format!("{dims:?}")),
            ("--layers", c.layers <= 4, c.layers.to_string(), "0 to 4".into()),
            ("--tau", (1e-6..=1e6).contains(&c.tau), c.tau.to_string(), "1e-6 to 1e6".into()),
            ("--lr", positive(c.lr), c.lr.to_string(), "more than 0".into()),
            ("--weight-lr", positive(c.weight_lr), c.weight_lr.to_string(), "more than 0".into()),
            ("--cohesion", c.cohesion >= 0.0 && c.cohesion.is_finite(), c.cohesion.to_string(), "0 or more".into()),
            ("--cutoff", positive(self.spectral.cutoff), self.spectral.cutoff.to_string(), "more than 0".into()),
            ("--stats-every", c.stats_every > 0, "0".into(), "at least 1".into()),
            ("--curve-every", c.curve_every > 0, "0".into(), "at least 1".into()),
            (
                "--power",
                (0.0..=1000.0).contains(&self.spectral.power),
                self.spectral.power.to_string(),
                "0 to 1000".into(),
            ),
        ];
        match checks.into_iter().find(|c| !c.1) {
            Some((field, _, found, expected)) => {
                Err(Error::new("out of range").field(field).found(found).expected(expected))
            }
            None => Ok(()),
        }
    }

    /// Everything that shapes the features but the number of iterations.
    fn parameters(&self) -> serde_json::Map<String, Value> {
        let levels: Vec<String> = self.levels().iter().map(ToString::to_string).collect();
        let mut p = serde_json::Map::from_iter([
            ("method".to_string(), json!(name_of(&self.method()))),
            ("levels".to_string(), json!(levels)),
            ("seed".to_string(), json!(self.common.seed)),
        ]);
        let c = &self.contrastive;
        let more = match self.method() {
            Method::Contrastive => json!({
                "dim": self.dim.unwrap_or(6),
                "layers": c.layers,
                "neighbours": name_of(&c.neighbours),
                "anchor_start": name_of(&c.anchor_start),
                "last_relu": !c.no_last_relu,
                "unit_length": c.unit_length,
                "norm_axis": name_of(&c.norm_axis),
                "loss": name_of(&c.loss),
                "init": name_of(&c.init),
                "tau": c.tau,
                "lr": c.lr,
                "weight_lr": c.weight_lr,
                "cohesion": c.cohesion,
                "cohesion_of": name_of(&c.cohesion_of),
                "propagation": !c.no_propagation,
                "curve_every": c.curve_every,
                "stats_every": c.stats_every,
                "lazy_adam": c.lazy_adam,
                "half_weights": c.half_weights,
                "no_skip": c.no_skip,
                "early_stop": c.early_stop,
            }),
            Method::Spectral => json!({
                "dim": self.dim.map_or(json!("auto"), |d| json!(d)),
                "cutoff": self.spectral.cutoff,
                "power": self.spectral.power,
                "evidence": name_of(&self.spectral.evidence),
                "smoothing": !self.spectral.no_smoothing,
            }),
        };
        p.extend(more.as_object().into_iter().flatten().map(|(k, v)| (k.clone(), v.clone())));
        p
    }
}

/// The inputs, read and checked against each other.
struct Inputs {
    graph: Graph,
    footprints: Footprints,
    hashes: BTreeMap<String, String>,
}

impl Args {
    fn read_inputs(&self) -> Result<Inputs> {
        let geometry = hash_file(&self.geometry)?;
        let (graph, graph_file) = Graph::read(&self.graph)?;
        graph_file.expect_input(role::GEOMETRY, &geometry)?;
        let footprints = Footprints::read(&self.footprints)?;
        // Made in one run: same parents, same parameters, same kept Gaussians.
        let mut hashes = graph_file.provenance().inputs.clone();
        for (role, hash) in &hashes {
            footprints.artifact().expect_input(role, hash)?;
        }
        if footprints.kept != graph.kept {
            return Err(Error::new("of other Gaussians than the graph")
                .file(&self.footprints)
                .field("kept")
                .found(format!("{} Gaussians", footprints.kept.len()))
                .expected(format!("the {} of the graph", graph.kept.len()))
                .hint("give graph and footprints of one run of graph-precompute"));
        }
        hashes.insert(role::GRAPH.into(), graph_file.hash().into());
        hashes.insert(role::FOOTPRINTS.into(), footprints.artifact().hash().into());
        Ok(Inputs { graph, footprints, hashes })
    }

    /// What contrastive learning is told.
    fn train_options(&self) -> TrainOptions {
        let c = &self.contrastive;
        TrainOptions {
            settings: Settings {
                dim: self.dim.unwrap_or(6),
                layers: c.layers,
                anchor_start: c.anchor_start,
                last_relu: !c.no_last_relu,
                unit_length: c.unit_length,
                norm_axis: c.norm_axis,
                loss: c.loss,
                tau: c.tau,
                cohesion: c.cohesion,
                cohesion_of: c.cohesion_of,
                init: c.init,
            },
            iterations: c.iterations,
            rate: c.lr,
            weight_rate: c.weight_lr,
            seed: self.common.seed,
            checkpoint_every: c.checkpoint_every,
            curve_every: c.curve_every,
            shortcuts: Shortcuts { stats_every: c.stats_every, lazy_adam: c.lazy_adam },
            early_stop: c.early_stop,
        }
    }

    fn contrastive<W: Weight>(&self, inputs: &Inputs, stage: &Stage) -> Result<(usize, Vec<f32>, Value)> {
        let c = &self.contrastive;
        // Damaged Gaussians are no kept ones: graph-precompute left them out.
        let geometry = Geometry::read(&self.geometry)?;
        if let Some(damage) = geometry.damage() {
            stage.skipped(&damage);
        }
        let gaussians = geometry.gaussians;
        if let Some(&last) = inputs.graph.kept.last().filter(|l| **l as usize >= gaussians.len()) {
            return Err(Error::new("the graph speaks of Gaussians that the geometry lacks")
                .file(&self.graph)
                .field("kept")
                .found(last)
                .expected(format!("below {}", gaussians.len())));
        }
        let colors: Vec<[f32; 3]> = inputs
            .graph
            .kept
            .iter()
            .map(|&i| [0, 1, 2].map(|ch| 0.5 + SH_C0 * gaussians.sh_of(i as usize)[ch]))
            .collect();
        let positions: Vec<[f32; 3]> = inputs.graph.kept.iter().map(|&i| gaussians.means[i as usize]).collect();
        drop(gaussians);
        let context = Context::new(&inputs.graph, &colors, &positions, c.neighbours, !c.no_propagation);
        // A lone mask has none to be told from, but it can be drawn together.
        let least = if c.no_skip || c.cohesion > 0.0 { 1 } else { 2 };
        let sets = mask_sets::<W>(&inputs.footprints, &context, &self.levels(), least)?;
        let units = inputs.footprints.views.len() * self.levels().len();
        if sets.len() < units {
            let why = if least == 1 { "no mask" } else { "fewer than two masks" };
            stage.skipped(&format!("{} of {units} views and levels: {why}", units - sets.len()));
        }
        if sets.is_empty() {
            let what = if least == 1 { "no view has a mask" } else { "no view has two masks to tell apart" };
            return Err(Error::new(what)
                .file(&self.footprints)
                .field(format!("levels {:?}", self.levels()))
                .hint("choose other --levels, or make masks with more than one segment a view"));
        }
        let options = self.train_options();
        if options.settings.needs_pixels() && sets.iter().all(|s| s.sampled.is_empty()) {
            return Err(Error::new("no sampled pixels, which this loss looks at")
                .file(&self.footprints)
                .field("pixel_row")
                .hint("run graph-precompute with --pixel-samples 16"));
        }
        // A checkpoint serves runs of any number of iterations, as long as everything else is equal.
        let provenance = stage.provenance("", 0, Value::Object(self.parameters()), inputs.hashes.clone());
        let path = checkpoint::path(&self.out);
        let on_curve = |curve: &[CurvePoint]| write_curve(&self.out, curve.iter().map(|p| json!(p)), &TRAINING);
        let trained = train(&context, &sets, &options, Some((&path, &provenance)), stage, on_curve)?;
        let last = trained.curve.last().copied().unwrap_or_default();
        let summary = json!({ "views": sets.len(), "last": last, "resumed_at": trained.resumed_at,
            "iterations": trained.iterations, "gaussians": inputs.graph.kept.len(),
            "network_bytes": trained.network_bytes });
        Ok((options.settings.dim, trained.features, summary))
    }

    fn spectral(&self, inputs: &Inputs, stage: &Stage) -> Result<(usize, Vec<f32>, Value)> {
        let s = &self.spectral;
        let clock = Instant::now();
        let matrix = collect(&inputs.footprints, &inputs.graph, &self.levels(), s.evidence, !s.no_smoothing);
        if matrix.masks.is_empty() {
            return Err(Error::new("no mask has a footprint")
                .file(&self.footprints)
                .field(format!("levels {:?}", self.levels()))
                .hint("choose other --levels, or check that masks and geometry are of one scene"));
        }
        let evidence_seconds = clock.elapsed().as_secs_f64();
        let options = SpectralOptions {
            most: self.most_vectors(matrix.gaussians),
            auto: self.dim.is_none(),
            cutoff: s.cutoff,
            power: s.power,
            seed: self.common.seed,
        };
        let found = spectral(&matrix, &options, stage)?;
        let vectors_seconds = clock.elapsed().as_secs_f64() - evidence_seconds;
        let above = found.singular_values.iter().filter(|v| **v > s.cutoff).count();
        if above > found.dim {
            let more = if above == found.singular_values.len() { " or more" } else { "" };
            stage.warn(&format!(
                "{above}{more} singular values exceed the cutoff of {}, but only the first {} are kept: small things may run \
                 together; give a larger --dim",
                s.cutoff, found.dim
            ));
        }
        let without = found.features.chunks_exact(found.dim).filter(|f| f.iter().all(|v| *v == 0.0)).count();
        if without > 0 {
            stage.info(&format!("{without} of {} Gaussians lie in no mask: their features are zero", matrix.gaussians));
        }
        let values = found.singular_values.iter().enumerate();
        write_curve(&self.out, values.map(|(i, v)| json!({ "iteration": i + 1, "singular_value": v })), &SPECTRUM)?;
        let summary = json!({
            "masks": matrix.masks.len(), "dim": found.dim, "passes": found.passes, "residual": found.residual,
            "evidence_seconds": evidence_seconds, "vectors_seconds": vectors_seconds, "cpu_seconds": stage::cpu_seconds(),
            "without_mask": without, "entries": matrix.entries(), "gram_entries": found.gram_entries,
            "singular_values": found.singular_values,
        });
        Ok((found.dim, found.features, summary))
    }
}

/// Panels of the picture of training.
const TRAINING: [Panel; 4] = [
    ("loss", "loss", "#1f77b4"),
    ("alignment", "alignment: mean cosine of a mask's Gaussians with its centroid", "#2ca02c"),
    ("separation", "separation: 1 - mean cosine of different masks", "#d62728"),
    ("rate", "learning rate of features", "#7f7f7f"),
];
/// Panel of the picture of a closed form.
const SPECTRUM: [Panel; 1] = [("singular_value", "singular values", "#1f77b4")];

/// What lies beside the output: the curve, and its plot.
const CURVE: &str = ".curve.jsonl";
const PLOT: &str = ".curve.svg";

/// Writes `<out>.curve.jsonl` and its picture, `<out>.curve.svg`.
fn write_curve(out: &Path, points: impl Iterator<Item = Value>, panels: &[Panel]) -> Result<()> {
    let lines: Vec<String> = points.map(|p| p.to_string()).collect();
    let text: String = lines.iter().map(|l| format!("{l}\n")).collect();
    write_bytes(with_suffix(out, CURVE), text.as_bytes())?;
    write_bytes(with_suffix(out, PLOT), curve::svg(&lines, panels).as_bytes())
}

impl Program for Args {
    const NAME: &'static str = "feat-train";

    fn common(&self) -> &CommonArgs {
        &self.common
    }

    fn check(&self) -> Result<()> {
        self.check_ranges()?;
        let TrainOptions { settings, shortcuts, .. } = self.train_options();
        if self.method() == Method::Contrastive && !Engine::serves(&settings) && shortcuts != Shortcuts::default() {
            return Err(Error::new("not with this loss, --cohesion, --norm-axis or --unit-length")
                .field(if shortcuts.lazy_adam { "--lazy-adam" } else { "--stats-every" }));
        }
        Ok(())
    }

    fn run(self, stage: &Stage) -> Result<()> {
        let mut claim = stage
            .outputs(&self.out)
            .artifact(&self.out, Features::FORMAT)
            .artifact(checkpoint::path(&self.out), checkpoint::FORMAT)
            .files([CURVE, PLOT].map(|suffix| with_suffix(&self.out, suffix)))
            .reads([&self.geometry, &self.graph, &self.footprints])
            .claim()?;
        let watched = Watched::new([&self.geometry]);
        let inputs = self.read_inputs()?;
        let sizes = memory::Sizes {
            entries: inputs.footprints.csr().1.len(),
            samples: inputs.footprints.pixels.col.len(),
            gaussians: inputs.footprints.kept.len(),
        };
        let levels = self.levels();
        let start = inputs.footprints.csr().0;
        let entries = |r: usize| (start[r + 1] - start[r]) as usize;
        let chosen = |row: &Row| levels.iter().any(|&l| l as u32 == row.level);
        let rows = inputs.footprints.rows.iter().enumerate().filter(|(_, row)| chosen(row));
        let (masks, used) = rows.fold((0, 0), |(masks, used), (r, _)| (masks + 1, used + entries(r)));
        let needed = match self.method() {
            Method::Contrastive => memory::contrastive(sizes, self.dim.unwrap_or(6), self.contrastive.layers),
            Method::Spectral => memory::spectral(sizes, used, self.most_vectors(sizes.gaussians).min(masks)),
        };
        stage.forecast(needed, "drop small footprint entries: graph-precompute --cut 0.001")?;
        let (dim, values, summary) = match self.method() {
            Method::Contrastive if self.contrastive.half_weights => self.contrastive::<Half>(&inputs, stage)?,
            Method::Contrastive => self.contrastive::<f32>(&inputs, stage)?,
            Method::Spectral => self.spectral(&inputs, stage)?,
        };
        let mut parameters = self.parameters();
        if self.method() == Method::Contrastive {
            parameters.insert("iterations".into(), json!(self.contrastive.iterations));
        }
        let parameters = Value::Object(parameters);
        let features = Features { kept: inputs.graph.kept, dim, values };
        watched.check()?;
        features.write(&self.out, stage.provenance("", 0, parameters.clone(), inputs.hashes.clone()))?;
        // The run is done: what is left of it must not be mistaken for an unfinished one.
        let _ = std::fs::remove_file(checkpoint::path(&self.out));
        stage.info(&format!("features of {} Gaussians, {dim} dimensions", features.kept.len()));
        stage.record(&mut claim, parameters, inputs.hashes, summary)
    }
}
