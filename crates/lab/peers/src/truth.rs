//! No rival: what the truth of a synthetic scene allows, so that each point that is lost has an owner.
//!
//! * `labels`: the true thing of every Gaussian. What geometry and metric allow.
//! * `clustering`: the given features, with the best clustering that leaves them alone: every Gaussian takes the thing whose mean
//!   feature is most like its own. What the clustering loses is the way from here to the instances of these features.
//! * `features`: features that are alike within a thing and at right angles between things, for `cluster-match`. What it loses
//!   of these, the clustering loses.

use crate::cli::Peer;
use crate::product::{Grouping, Product};
use crate::vectors::{group_means, most_alike, unit};
use crate::world::{Inputs, World};
use artifacts::{Features, Instances, TruePoints, flat};
use gs_io::{Error, Result};
use ndarray::Array2;
use serde::Serialize;
use stage::Stage;
use std::path::{Path, PathBuf};

/// Matches of less IoU show something else.
const MATCHED: f32 = 0.2;

/// Settings.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct Options {
    #[command(flatten)]
    #[serde(flatten)]
    inputs: Inputs,
    /// What is true
    #[arg(long, value_enum)]
    of: Truth,
    /// features.safetensors of feat-train, for --of clustering
    #[arg(long, value_name = "FILE", required_if_eq("of", "clustering"))]
    #[serde(skip)]
    features: Option<PathBuf>,
}

/// What comes from the truth.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, Serialize)]
#[serde(rename_all = "lowercase")]
enum Truth {
    /// The instance of every Gaussian
    Labels,
    /// The clustering of the given features
    Clustering,
    /// Features for cluster-match
    Features,
}

impl Peer for Options {
    fn inputs(&self) -> &Inputs {
        &self.inputs
    }

    fn features(&self) -> Option<&Path> {
        self.features.as_deref().filter(|_| self.of == Truth::Clustering)
    }

    fn format(&self) -> &'static str {
        if self.of == Truth::Features { Features::FORMAT } else { Instances::FORMAT }
    }

    fn make(&self, world: &World, _stage: &Stage) -> Result<Product> {
        let path = self.inputs.scene.join("truth/points.safetensors");
        if !path.exists() {
            return Err(Error::new("the scene has no truth").file(&path).hint("give --scene a scene of synth-scene"));
        }
        let points = TruePoints::read(&path)?;
        let truth = eval::true_labels(&world.geometry, &points);
        let things = truth.iter().max().map_or(0, |&most| (most + 1) as usize);
        let kept: Vec<i32> = world.footprints.kept.iter().map(|&i| truth[i as usize]).collect();
        let learned = &world.learned;
        let labels = match self.of {
            Truth::Labels => truth,
            Truth::Clustering => world.spread(&nearest_mean(flat(learned.values.view()), learned.dim(), &kept, things)),
            Truth::Features => return Ok(Product::Features(one_hot(&world.footprints.kept, &kept, things))),
        };
        let scores = eval::true_confidence(&world.geometry, &labels, things, &points);
        let matches = world.matches(&labels, MATCHED)?;
        Ok(Product::Instances(Grouping { labels, instances: things, matches, scores, ..Grouping::default() }))
    }
}

/// The thing of each Gaussian by its feature, `[n][dim]`: the one whose mean unit feature it is most like. `truth` says whose means
/// they are.
fn nearest_mean(features: &[f32], dim: usize, truth: &[i32], things: usize) -> Vec<i32> {
    let mut rows = features.to_vec();
    rows.chunks_exact_mut(dim).for_each(unit);
    let means = group_means(truth.iter().copied().zip(rows.chunks_exact(dim)), dim, things);
    most_alike(&rows, dim, &means, -1.0)
}

/// A dimension for each thing; Gaussians of none have a zero.
fn one_hot(kept: &[u32], truth: &[i32], things: usize) -> Features {
    let value = |(i, thing)| if truth[i] == thing as i32 { 1.0 } else { 0.0 };
    let values = Array2::from_shape_fn((kept.len(), things.max(1)), value);
    Features { kept: kept.to_vec(), values }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_gaussian_takes_the_thing_with_the_nearest_mean() {
        // Two of thing 0 along x, two of thing 2 along y; one of thing 0 lies among those of thing 2, one is nobody's.
        let features = [3.0, 0.0, 1.0, 0.1, 0.0, 2.0, 0.1, 1.0, 0.2, 1.0, 0.9, 1.0];
        assert_eq!(nearest_mean(&features, 2, &[0, 0, 2, 2, 0, -1], 3), [0, 0, 2, 2, 2, 0]);
        assert_eq!(nearest_mean(&features, 2, &[-1; 6], 0), [-1; 6]);
    }

    #[test]
    fn true_features_are_alike_within_a_thing_and_at_right_angles_between() {
        let f = one_hot(&[4, 6, 7], &[1, -1, 0], 2);
        assert_eq!(f.values, ndarray::arr2(&[[0.0, 1.0], [0.0, 0.0], [1.0, 0.0]]));
    }
}
