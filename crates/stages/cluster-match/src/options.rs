//! The command line of `cluster-match`: every option with its default and range.

#![allow(rustdoc::invalid_html_tags, reason = "help texts name files as <view>_s.npy")]

use artifacts::{Footprints, Level, LevelKind};
use clap::Parser;
use hdbscan_exact::{Metric, Selection};
use serde::Serialize;
use stage::CommonArgs;
use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

/// Stage 3: 3D instances, the masks they are seen as, and a language descriptor for each
#[derive(Debug, Parser)]
#[command(name = "cluster-match", version)]
pub struct Args {
    /// Dataset folder (COLMAP, transforms.json, ScanNet or 7-Scenes)
    #[arg(long, value_name = "DIR")]
    pub(crate) scene: PathBuf,
    /// The Gaussians: a PLY of 3DGS, or another format of docs/splats.md
    #[arg(long, value_name = "FILE")]
    pub(crate) geometry: PathBuf,
    /// graph.safetensors of graph-precompute
    #[arg(long, value_name = "FILE")]
    pub(crate) graph: PathBuf,
    /// footprints.safetensors of graph-precompute
    #[arg(long, value_name = "FILE")]
    pub(crate) footprints: PathBuf,
    /// features.safetensors of feat-train, to cluster by features; the masks do without
    #[arg(long, value_name = "FILE", required_if_eq_any = [("cluster", "graph"), ("cluster", "free")])]
    pub(crate) features: Option<PathBuf>,
    /// Folder with id maps (<view>_s.npy) and, for language, mask features (<view>_f.npy)
    #[arg(long, value_name = "DIR")]
    pub(crate) masks: PathBuf,
    /// Output file. Beside it are written <name>.ply (the Gaussians, each with its instance), <name>.labels.npy
    /// (an i32 for every Gaussian, -1 for none) and <name>.json (the instances as text)
    #[arg(long, value_name = "FILE")]
    pub(crate) out: PathBuf,
    /// Stop before language: write the instances without descriptors, and the masks whose features these will read, into this file,
    /// and nothing else. Then `mask-embed embed --only FILE`, then this command again with --from FILE in place of --draft FILE
    #[arg(long, value_name = "FILE", conflicts_with = "from")]
    pub(crate) draft: Option<PathBuf>,
    /// Go on from a file of --draft, made with the same inputs and options
    #[arg(long, value_name = "FILE")]
    pub(crate) from: Option<PathBuf>,
    #[command(flatten)]
    pub(crate) settings: Settings,
    #[command(flatten)]
    pub(crate) common: CommonArgs,
}

/// What shapes the result. The provenance of the instances holds all of it.
#[derive(Debug, Clone, clap::Args, Serialize)]
#[command(next_help_heading = "Clustering")]
pub(crate) struct Settings {
    /// What decides which Gaussians are one instance: how far their masks agree, their features on the graph of spatial neighbours, or their
    /// features as free points (the paper)
    #[arg(long, value_enum, default_value_t = Space::Masks)]
    pub cluster: Space,
    /// How far the masks of neighbouring pieces must agree that both are one instance, 0 to 1: a lower value joins more. Two of which one
    /// rises above the other in another colour must agree by up to 0.28 more, large pieces by a little more, small ones by a little less.
    /// Only with masks [default: 0.18; 0.6 where the masks have one level, and that is not small or medium]
    #[arg(long, value_name = "AGREEMENT", value_parser = stage::within(0.0..=1.0))]
    pub agreement: Option<f64>,
    /// Fewest Gaussians of an instance [default: 8 with masks, 30 with free points; on the graph a thousandth of the Gaussians that are
    /// seen, at least 10 and at most 30, because small scenes have small things]
    #[arg(long, value_name = "COUNT", value_parser = stage::within(2usize..=MOST))]
    pub min_cluster_size: Option<usize>,
    /// Neighbours, the Gaussian itself included, that set its core distance. Only with features
    #[arg(long, value_name = "COUNT", value_parser = stage::within(1usize..=MOST), default_value_t = 10)]
    pub min_samples: usize,
    /// Join clusters that were born below this feature distance; for free points the default is 0. Only with features
    // Free points: of 0 to 0.3 none is better (docs/results/paper.md). On the graph 0.1 to 0.2 give the same mIoU within 0.01 on synthetic scenes
    // of mixed granularity; 0 gives hundreds of fragments, because near-equal features have lambdas without bound.
    #[arg(long, value_name = "DISTANCE", value_parser = stage::at_least(0.0f64), default_value = "0.15",
        default_value_if("cluster", "free", "0"))]
    pub epsilon: f64,
    /// Allow one instance of all Gaussians where nothing divides them
    #[arg(long)]
    pub allow_single_cluster: bool,
    /// How far the masks of pieces that do not touch must agree that both are one instance, 0 to 1, but no less than --agreement; 0 joins
    /// none; for free points the default is 0
    #[arg(long, value_name = "AGREEMENT", value_parser = stage::within(0.0..=1.0), default_value = "0.5",
        default_value_if("cluster", "free", "0"))]
    pub join: f64,
    /// Most rounds in which a Gaussian may change to the neighbouring instance that its masks show; on the graph the
    /// default is 8
    #[arg(long, value_name = "ROUNDS", default_value = "0", default_value_if("cluster", "graph", "8"))]
    pub votes: usize,
    /// Let small parts leave their instance and become instances: what stands on a shelf is no shelf. The largest share of the
    /// instance's Gaussians that such a part may have, 0 to 0.5; 0 lets none leave. A part that is
    /// alone in large masks more often than in medium ones may have up to 0.5. The masks of level small make the parts, and one leaves
    /// only where some mask shows it as one; for free points the default is 0
    #[arg(long, value_name = "SHARE", value_parser = stage::within(0.0..=0.5), default_value = "0.03",
        default_value_if("cluster", "free", "0"))]
    pub split: f64,
    /// Levels of the masks that vote, join and match: default, small, medium, large, classes, concepts, classes-2 and so on
    /// [default: all, but large where there are classes; for free points large, as in the paper]
    #[arg(
        long,
        value_delimiter = ',',
        value_name = "LEVELS",
        default_value_if("cluster", "free", "large"),
        help_heading = "Matching"
    )]
    pub levels: Vec<Level>,
    /// Look for parts, things and groups that texts may ask for, which masks of this many views show; 0 looks for none; for free
    /// points the default is 0
    #[arg(
        long,
        value_name = "VIEWS",
        default_value = "2",
        default_value_if("cluster", "free", "0"),
        help_heading = "Matching"
    )]
    pub granules: usize,
    /// Views whose masks say what an instance, a part or a group means, those that fit best (docs/results/queries.md); 0 for all that show
    /// it; for free points the default is 0, as in the paper
    #[arg(
        long,
        value_name = "VIEWS",
        default_value = "4",
        default_value_if("cluster", "free", "0"),
        help_heading = "Matching"
    )]
    pub describe_views: usize,
}

/// Those of the `levels` that show classes.
pub fn classes(levels: &[Level]) -> Vec<Level> {
    levels.iter().copied().filter(|level| level.kind() == LevelKind::Classes).collect()
}

/// How far masks of several levels must agree that two pieces are one, chosen on scenes for tuning.
const OF_LEVELS: f64 = 0.18;
/// The same of one level of whole things: fitted on drawn scenes of four families by pipelines/one-level.plan; five scans gain
/// (docs/results/scans.md).
const OF_ONE_LEVEL: f64 = 0.6;

/// Whether the masks have one level of whole things. A map of one level counts as four that are alike: so in every view the same levels have
/// the same masks.
fn is_one_level(footprints: &Footprints, levels: &[Level]) -> bool {
    let mut views: BTreeMap<u32, BTreeMap<u32, Vec<u32>>> = BTreeMap::new();
    for row in footprints.rows.iter().filter(|row| row.is_of(levels)) {
        views.entry(row.view).or_default().entry(row.level).or_default().push(row.mask);
    }
    let Some(first) = views.values().next() else { return false };
    let part = |level: &u32| [Level::SMALL, Level::MEDIUM].iter().any(|part| part.index() == *level as usize);
    let one = |of: &BTreeMap<u32, Vec<u32>>| of.values().all(|masks| Some(masks) == of.values().next());
    !first.keys().all(part) && views.values().all(|of| of.keys().eq(first.keys()) && one(of))
}

/// Largest count that an option takes: as many as there can be Gaussians.
const MOST: usize = u32::MAX as usize;

/// Which pairs of Gaussians the hierarchy may join.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Space {
    /// Average linkage of spatial neighbours by how far their masks agree
    Masks,
    /// Any two: HDBSCAN of standardised features as free points (the paper)
    Free,
    /// Spatial neighbours only: HDBSCAN on the graph of neighbours
    Graph,
}

impl Settings {
    /// These settings for a scene of `n` Gaussians that are seen in these masks: nothing is left open.
    pub fn for_scene(&self, n: usize, footprints: &Footprints) -> Self {
        // On the graph a thousandth gained 2.1 points of instance mIoU over 30 at 12,000 Gaussians (synthetic scenes for tuning).
        let smallest = match self.cluster {
            Space::Masks => 8,
            Space::Graph => n.div_ceil(1000).clamp(10, 30),
            Space::Free => 30,
        };
        let there = |level: &Level| Level::SAM.contains(level) || footprints.rows.iter().any(|r| r.is_of(&[*level]));
        let mut levels = self.levels.clone();
        if levels.is_empty() {
            levels = Level::ALL.into_iter().filter(there).collect();
            // A model that knows classes says better what a whole thing is than SAM, where it saw every view.
            let views = |levels: &[Level]| {
                let of_levels = footprints.rows.iter().filter(|row| row.is_of(levels));
                of_levels.map(|row| row.view).collect::<BTreeSet<u32>>()
            };
            let classes = classes(&levels);
            if !classes.is_empty() && views(&[Level::LARGE]).is_subset(&views(&classes)) {
                levels.retain(|level| *level != Level::LARGE);
            }
        }
        let whole = self.cluster == Space::Masks && is_one_level(footprints, &levels);
        Self {
            agreement: self.agreement.or(Some(if whole { OF_ONE_LEVEL } else { OF_LEVELS })),
            min_cluster_size: self.min_cluster_size.or(Some(smallest)),
            levels,
            ..self.clone()
        }
    }

    /// How far masks must agree, where [`Self::for_scene`] left nothing open.
    pub fn agreement(&self) -> f64 {
        self.agreement.unwrap_or(OF_LEVELS)
    }

    /// The options of HDBSCAN.
    pub fn hdbscan(&self) -> hdbscan_exact::Options {
        hdbscan_exact::Options {
            min_cluster_size: self.min_cluster_size.unwrap_or(30),
            min_samples: self.min_samples,
            epsilon: self.epsilon,
            selection: Selection::ExcessOfMass,
            allow_single_cluster: self.allow_single_cluster,
            metric: Metric::Euclidean,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::footprints_of;

    #[test]
    fn classes_take_the_place_of_large_masks_where_there_are_any() {
        let parse = |more: &[&str]| {
            let files =
                ["--scene", "s", "--geometry", "g", "--graph", "h", "--footprints", "f", "--masks", "m", "--out", "o"];
            Args::parse_from([&["cluster-match"], &files[..], more].concat()).settings
        };
        let view: &[&[&[u32]]] = &[&[&[0, 1]]];
        let sam = Level::SAM.map(|level| (level, view));
        let with_classes = [&sam[..], &[(Level::CLASSES, view)]].concat();
        let levels = |more: &[&str], masks: &[_]| parse(more).for_scene(8, &footprints_of(masks)).levels;
        assert_eq!(levels(&[], &sam), Level::SAM);
        assert_eq!(levels(&[], &with_classes), [Level::DEFAULT, Level::SMALL, Level::MEDIUM, Level::CLASSES]);
        let two: &[&[&[u32]]] = &[&[&[0, 1]], &[&[0, 1]]];
        let one: &[&[&[u32]]] = &[&[&[0, 1]], &[]];
        let some = levels(&[], &[(Level::LARGE, two), (Level::CLASSES, one)]);
        assert!(some.contains(&Level::LARGE) && some.contains(&Level::CLASSES), "{some:?}");
        // Two models of which each saw one view.
        let other: &[&[&[u32]]] = &[&[], &[&[0, 1]]];
        let both = levels(&[], &[(Level::LARGE, two), (Level::CLASSES, one), ("classes-2".parse().unwrap(), other)]);
        assert!(!both.contains(&Level::LARGE) && both.contains(&Level::ALL[6]), "{both:?}");
        assert_eq!(levels(&["--levels", "large,classes"], &with_classes), [Level::LARGE, Level::CLASSES]);
        assert_eq!(levels(&["--cluster", "free", "--features", "x"], &with_classes), [Level::LARGE]);
        // Whole things of one level, under one name or four.
        let agreement = |more: &[&str], masks: &[_]| parse(more).for_scene(8, &footprints_of(masks)).agreement;
        let split: &[&[&[u32]]] = &[&[&[0], &[1]]];
        assert_eq!(agreement(&[], &sam), Some(OF_ONE_LEVEL));
        assert_eq!(agreement(&[], &[(Level::LARGE, view)]), Some(OF_ONE_LEVEL));
        assert_eq!(agreement(&[], &[(Level::SMALL, view)]), Some(OF_LEVELS));
        assert_eq!(agreement(&[], &[(Level::SMALL, split), (Level::LARGE, view)]), Some(OF_LEVELS));
        assert_eq!(agreement(&["--agreement", "0.3"], &sam), Some(0.3));
    }
}
