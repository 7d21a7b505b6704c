//! Which Gaussian belongs to which instance, from the clustering to the last correction.

use crate::group::tree;
use crate::linkage::Linkage;
use crate::plane::Place;
use crate::profile::{Profile, units};
use crate::vote::by_votes;
use artifacts::{Footprints, Graph, Level, TreeEdge};
use gs_io::Result;
use gs_scene::{Gaussians, points::KdTree};
use hdbscan_exact::Clustering;
use rayon::prelude::*;

/// The instances of all Gaussians of a scene.
pub(crate) struct Assignment {
    /// Instance of each Gaussian, -1 for none.
    pub labels: Vec<i32>,
    /// Smallest cluster of the tree that holds each Gaussian, -1 for none.
    pub nodes: Vec<i32>,
    /// Number of instances.
    pub instances: usize,
    /// Cluster-to-cluster edges of the condensed tree, with the instance selected at each child.
    pub tree: Vec<TreeEdge>,
    /// Cluster of the tree that each instance was selected at, before any were joined.
    pub clusters: Vec<u32>,
}

impl Assignment {
    /// What a clustering of the `kept` of `gaussians` Gaussians says.
    pub fn new(clustering: &Clustering, kept: &[u32], gaussians: usize) -> Self {
        let (mut labels, mut nodes) = (vec![-1; gaussians], vec![-1; gaussians]);
        for (&i, (&label, &node)) in kept.iter().zip(clustering.labels.iter().zip(&clustering.nodes)) {
            labels[i as usize] = label;
            nodes[i as usize] = node as i32;
        }
        let clusters = clustering.selected.clone();
        Self { labels, nodes, instances: clusters.len(), tree: tree(clustering), clusters }
    }

    /// Gives every Gaussian for which `wanted` holds the instance and the node of the nearest Gaussian that has an instance;
    /// ties go to the lower index. Nothing changes where no Gaussian has one.
    pub fn fill_from_nearest(&mut self, means: &[[f32; 3]], wanted: impl Fn(usize) -> bool + Sync) {
        let finite = |p: &[f32; 3]| p.iter().all(|v| v.is_finite());
        let known: Vec<u32> =
            (0..means.len() as u32).filter(|&i| self.labels[i as usize] >= 0 && finite(&means[i as usize])).collect();
        let Some(&first) = known.first() else { return };
        // Centred, so that far-away scenes keep their digits.
        let origin = means[first as usize];
        let shift = |p: [f32; 3]| [0, 1, 2].map(|k| p[k] - origin[k]);
        let places: Vec<[f32; 3]> = known.iter().map(|&i| shift(means[i as usize])).collect();
        let tree = KdTree::new(&places);
        let found: Vec<(usize, usize)> = (0..means.len())
            .into_par_iter()
            .filter(|&i| wanted(i) && finite(&means[i]))
            .map_init(Vec::new, |near, i| {
                tree.nearest(shift(means[i]), 1, near);
                near.first().map(|&(_, place)| (i, known[place as usize] as usize))
            })
            .flatten()
            .collect();
        for (i, near) in found {
            (self.labels[i], self.nodes[i]) = (self.labels[near], self.nodes[near]);
        }
    }

    /// Lets the masks vote `rounds` times ([`by_votes`]). A Gaussian that changes its instance becomes one of the new
    /// instance's cluster. Returns how many changed.
    ///
    /// # Errors
    /// When the footprints can't be read.
    pub fn vote(&mut self, graph: &Graph, footprints: &Footprints, levels: &[Level], rounds: usize) -> Result<usize> {
        let mut of_kept = self.of_kept(&graph.kept);
        let changed = by_votes(&mut of_kept, self.instances, footprints, graph, levels, rounds)?;
        for (&i, label) in graph.kept.iter().zip(of_kept) {
            if let Some(&cluster) = usize::try_from(label).ok().and_then(|l| self.clusters.get(l))
                && self.labels[i as usize] != label
            {
                self.nodes[i as usize] = cluster as i32;
                self.labels[i as usize] = label;
            }
        }
        Ok(changed)
    }

    /// Joins instances that the masks show as one with a probability of at least `least` ([`Linkage`]).
    ///
    /// # Errors
    /// When the footprints can't be read.
    pub fn join(
        &mut self,
        gaussians: &Gaussians,
        kept: &[u32],
        footprints: &Footprints,
        levels: &[Level],
        least: f64,
    ) -> Result<()> {
        let labels = self.of_kept(kept);
        let places = Place::of_instances(gaussians, kept, &labels, self.instances);
        let (profiles, unit_of) =
            (Profile::of_instances(&labels, self.instances, footprints, levels)?, units(footprints));
        let mut linkage = Linkage::new(profiles, &[], &unit_of);
        linkage.meet(places);
        linkage.join(least, usize::MAX, (0.0, f64::MAX));
        let (number, instances) = linkage.labels();
        self.instances = instances;
        let renumber = |l: &mut i32| *l = usize::try_from(*l).map_or(*l, |k| number[k]);
        self.labels.iter_mut().for_each(renumber);
        self.tree.iter_mut().for_each(|e| renumber(&mut e.instance));
        Ok(())
    }

    fn of_kept(&self, kept: &[u32]) -> Vec<i32> {
        kept.iter().map(|&i| self.labels[i as usize]).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_nearest_labelled_gaussian_decides() {
        let of = |labels: &[i32], nodes: &[i32]| Assignment {
            labels: labels.to_vec(),
            nodes: nodes.to_vec(),
            instances: 0,
            tree: Vec::new(),
            clusters: Vec::new(),
        };
        let means = [[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [4.0, 0.0, 0.0], [6.0, 0.0, 0.0], [5.0, 0.0, 0.0]];
        let mut a = of(&[0, 1, -1, -1, -1], &[8, 9, 7, 7, 7]);
        a.fill_from_nearest(&means, |i| (2..4).contains(&i));
        assert_eq!((a.labels, a.nodes), (vec![0, 1, 0, 1, -1], vec![8, 9, 8, 9, 7]));
        let mut none = of(&[-1; 5], &[7; 5]);
        none.fill_from_nearest(&means, |_| true);
        assert_eq!(none.labels, [-1; 5]);
        let mut heap = of(&[3, 3, -1], &[5; 3]);
        heap.fill_from_nearest(&[[1.0; 3]; 3], |i| i == 2);
        assert_eq!(heap.labels, [3, 3, 3]);
    }
}
