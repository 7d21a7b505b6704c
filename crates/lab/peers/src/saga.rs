//! SAGA (Segment Any 3D Gaussians, arXiv 2312.00860; public code): features that bring together what lies in the same masks,
//! smoothed over the nearest neighbours; HDBSCAN of a sample of them; everything else goes to the nearest centre.
//!
//! The features are learned by `feat-train` (`--features`). From the authors' code are: the mean of 16 unit features, a
//! Gaussian's own and those of its 15 nearest; a sample of 2 %, clusters of at least 10 by their 10th neighbour, epsilon
//! 0.01; centres of unit length, compared by cosine. Points that are noise in the sample have no centre, as in the authors'
//! notebook (their viewer gives them one together).
//!
//! Left out: the learned gate that turns a feature into those of any size. Masks of one level teach one size, and the gate
//! at a size is no more than a weight of every number of the feature, which features learned at that size need not have.
//! Text is asked there of clusters of the masks of all views, by relevancy, and finds Gaussians by their features; here a
//! cluster's descriptor is the mean of the masks that it is matched with, the one of the largest IoU in each view, above 0.2.

use crate::cli::Peer;
use crate::product::{Grouping, Product};
use crate::vectors::{group_means, most_alike, smoothed, unit};
use crate::world::{Inputs, LearnedInputs, World};
use artifacts::flat;
use gs_io::Result;
use hdbscan_exact::{Options as Hdbscan, cluster};
use rand::SeedableRng;
use rand::seq::index::sample;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::Serialize;
use stage::Stage;
use std::path::Path;
/// Fewest Gaussians that are clustered, where there are as many: 2 % of a small scene are too few.
const LEAST: usize = 2000;
/// Least IoU of a cluster with a mask that describes it.
const LEAST_IOU: f32 = 0.2;

/// Settings.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct Options {
    #[command(flatten)]
    #[serde(flatten)]
    learned: LearnedInputs,
    /// Features that are averaged, those of a Gaussian and of its nearest neighbours, 1 to 16; as many as the graph has
    #[arg(long, value_name = "COUNT", default_value_t = 16, value_parser = stage::within(1..=16usize))]
    neighbours: usize,
    /// Share of the Gaussians that are clustered, above 0, at most 1
    #[arg(long, value_name = "SHARE", default_value_t = 0.02, value_parser = stage::within(1e-6..=1.0f64))]
    share: f64,
    /// Fewest Gaussians of a cluster of the sample, 2 or more
    #[arg(long, value_name = "COUNT", default_value_t = 10, value_parser = stage::within(2..=1_000_000usize))]
    min_cluster_size: usize,
    /// Join clusters that were born below this distance
    #[arg(long, value_name = "DISTANCE", default_value_t = 0.01, value_parser = stage::at_least(0.0f64))]
    epsilon: f64,
}

impl Peer for Options {
    fn inputs(&self) -> &Inputs {
        &self.learned.inputs
    }

    fn features(&self) -> Option<&Path> {
        Some(&self.learned.features)
    }

    fn make(&self, world: &World, stage: &Stage) -> Result<Product> {
        let dim = world.learned.dim();
        let mut features = flat(world.learned.values.view()).to_vec();
        features.par_chunks_exact_mut(dim).for_each(unit);
        let features = smoothed(&features, dim, &world.graph.gaussian_knn, self.neighbours);
        let count = ((world.kept() as f64 * self.share).ceil() as usize).max(LEAST).min(world.kept());
        let mut rng = ChaCha8Rng::seed_from_u64(stage.seed());
        let mut chosen = sample(&mut rng, world.kept(), count).into_vec();
        chosen.sort_unstable();
        let (labels, instances) = clusters(&features, dim, &chosen, self);
        let labels = world.spread(&labels);
        let matches = world.matches(&labels, LEAST_IOU)?;
        Ok(Product::Instances(Grouping { labels, instances, matches, ..Grouping::default() }))
    }
}

/// The cluster of every Gaussian, and their number: HDBSCAN of the `chosen`, and the cluster with the nearest centre for all;
/// -1 for all where there is no cluster.
fn clusters(features: &[f32], dim: usize, chosen: &[usize], o: &Options) -> (Vec<i32>, usize) {
    let row = |i: usize| &features[i * dim..(i + 1) * dim];
    let points: Vec<f32> = chosen.iter().flat_map(|&i| row(i)).copied().collect();
    let settings = Hdbscan {
        min_cluster_size: o.min_cluster_size,
        // Their library does not count the point itself.
        min_samples: o.min_cluster_size + 1,
        epsilon: o.epsilon,
        ..Hdbscan::default()
    };
    let found = cluster(&points, dim, &settings);
    let count = found.selected.len();
    let centres = group_means(found.labels.iter().copied().zip(chosen.iter().map(|&i| row(i))), dim, count);
    (most_alike(features, dim, &centres, -1.0), count)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::options;

    #[test]
    fn those_outside_the_sample_join_the_nearest_centre() {
        // Two bundles of 20 directions, of which the even ones are the sample.
        let angle = |i: usize| if i < 20 { 0.01 * i as f32 } else { 1.5 + 0.01 * (i - 20) as f32 };
        let features: Vec<f32> = (0..40).flat_map(|i| [angle(i).cos(), angle(i).sin()]).collect();
        let chosen: Vec<usize> = (0..40).step_by(2).collect();
        let (labels, count) = clusters(&features, 2, &chosen, &options("--min-cluster-size 4"));
        assert_eq!(count, 2);
        assert!(labels[..20].iter().all(|&l| l == labels[0]) && labels[20..].iter().all(|&l| l == 1 - labels[0]));
        assert_eq!(clusters(&features, 2, &[0], &options("")), (vec![-1; 40], 0), "one point is no cluster");
    }
}
