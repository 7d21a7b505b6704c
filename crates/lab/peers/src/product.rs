//! What a system makes, and how it becomes a file.

use crate::cli::Peer;
use crate::vectors::unit;
use crate::world::World;
use artifacts::{Descriptors, Features, Instances, Match};
use cluster_match::{Witnesses, descriptors as mean_descriptors, gather};
use gs_io::{Claim, Result};
use ndarray::{Array2, Array3};
use serde_json::{Value, json};
use stage::Stage;

/// What a system makes.
#[derive(Debug, Clone, PartialEq)]
pub enum Product {
    /// Every Gaussian belongs to one instance or to none.
    Instances(Grouping),
    /// Every kept Gaussian has a language descriptor.
    Descriptors(Table),
    /// Instances, and descriptors that they alone do not hold.
    Both(Grouping, Table),
    /// Features for `cluster-match`.
    Features(Features),
}

/// Descriptors of the kept Gaussians.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Table {
    /// Row of each kept Gaussian of the footprints; n. Empty: Gaussian i has row i.
    pub rows: Vec<u32>,
    /// Descriptors in a row, at least 1: a text takes the best of them.
    pub slots: usize,
    /// Dimension of the mask features.
    pub dim: usize,
    /// `[rows][slots][dim]`, of any length, zero for none. Written at unit length.
    pub values: Vec<f32>,
}

/// Gaussians in instances.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Grouping {
    /// Instance of every Gaussian of the geometry, 0 to K - 1, -1 for none; N.
    pub labels: Vec<i32>,
    /// Number of instances; K.
    pub instances: usize,
    /// Which masks show which instance; they give the support and, where `descriptors` is empty, the descriptors.
    pub matches: Vec<Match>,
    /// Descriptors where the system has a rule of its own, of any length, zero for none; `[K][dim]` or empty.
    pub descriptors: Vec<f32>,
    /// Confidence of each instance, to rank by; K, or empty: then the instances with more matched views come first, of equals
    /// the larger.
    pub scores: Vec<f32>,
}

/// Writes what a system made, with the record of the run.
///
/// # Errors
/// When a file can't be written.
pub fn write(
    world: &World,
    product: Product,
    peer: &dyn Peer,
    parameters: Value,
    stage: &Stage,
    claim: &mut Claim,
) -> Result<()> {
    let (grouping, table) = match product {
        Product::Instances(grouping) => (Some(grouping), None),
        Product::Descriptors(table) => (None, Some(table)),
        Product::Both(grouping, table) => (Some(grouping), Some(table)),
        Product::Features(features) => {
            let provenance = stage.provenance(Features::FORMAT, 1, parameters.clone(), world.hashes.clone());
            stage.record(claim, parameters, world.hashes.clone(), json!({"dim": features.dim()}))?;
            return features.write(&peer.inputs().out, provenance);
        }
    };
    let instances = grouping.map(|g| g.instances(world));
    let descriptors = table.map(|t| t.descriptors(world));
    let counts = (instances.as_ref().map(Instances::len), descriptors.as_ref().map(|d| d.values.dim().0));
    stage.record(
        claim,
        parameters.clone(),
        world.hashes.clone(),
        json!({"instances": counts.0, "descriptors": counts.1}),
    )?;
    let out = &peer.inputs().out;
    if let Some(descriptors) = &descriptors {
        let path = if instances.is_some() { peer.descriptors().unwrap_or(out) } else { out };
        let provenance = stage.provenance(Descriptors::FORMAT, 1, parameters.clone(), world.hashes.clone());
        descriptors.write(path, provenance)?;
    }
    if let Some(instances) = &instances {
        instances.write(out, stage.provenance(Instances::FORMAT, 1, parameters, world.hashes.clone()))?;
    }
    stage.info(&format!("wrote {}", out.display()));
    Ok(())
}

impl Table {
    /// The artifact of the descriptors.
    fn descriptors(self, world: &World) -> Descriptors {
        let Self { rows, slots, dim, mut values } = self;
        let n = world.footprints.kept.len() as u32;
        let row = if rows.is_empty() { (0..n).collect() } else { rows };
        values.chunks_exact_mut(dim.max(1)).for_each(unit);
        let shape = (values.len() / (slots * dim).max(1), slots, dim);
        let values = Array3::from_shape_vec(shape, values).expect("whole rows");
        Descriptors { kept: world.footprints.kept.clone(), row, values }
    }
}

impl Grouping {
    /// The artifact of the instances.
    fn instances(self, world: &World) -> Instances {
        let Self { labels, instances: k, matches, mut descriptors, scores } = self;
        let nodes = vec![-1; labels.len()];
        let means = &world.geometry.gaussians.means;
        let mut all = gather(means, labels, k, matches);
        all.descriptor = mean_descriptors(k, &Witnesses::default().of_instances(&all.matches, 0), &world.features);
        if !descriptors.is_empty() {
            let dim = descriptors.len() / k.max(1);
            descriptors.chunks_exact_mut(dim.max(1)).for_each(unit);
            all.descriptor = Array2::from_shape_vec((k, dim), descriptors).expect("of each instance");
        }
        let (views, most) = (world.views.len().max(1) as f32, all.label.len().max(1) as f32);
        let confidence = |k: usize| (all.support[k] as f32 + all.count[k] as f32 / most) / (views + 1.0);
        all.score = if scores.is_empty() { (0..k).map(confidence).collect() } else { scores };
        Instances { views: world.footprints.views.clone(), node: nodes, ..all }
    }
}
