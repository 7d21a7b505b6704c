//! Which Gaussian belongs to which instance, from the clustering to the last correction.

use crate::group::tree;
use crate::linkage::Linkage;
use crate::plane::Place;
use crate::profile::{Profile, units, with_rest};
use crate::vote::by_votes;
use artifacts::{Footprints, Graph, Level, TreeEdge};
use gs_io::{Error, Result};
use gs_scene::Gaussians;
use hdbscan_exact::Clustering;
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet, HashSet};
use std::num::NonZero;

/// Least share of a part that lies in an instance for it to be that instance's.
const INSIDE: f64 = 0.7;
/// A part is a thing of its own where large masks hold it and the rest less often than medium masks do, by this probability.
const APART: f64 = 0.2;

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
    clusters: Vec<u32>,
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
    pub fn fill_from_nearest(&mut self, means: &[[f32; 3]], wanted: impl Fn(usize) -> bool + Sync) -> Result<()> {
        let finite = |p: &[f32; 3]| p.iter().all(|v| v.is_finite());
        // The first Gaussian of each place: the tree cannot split heaps of coincident points. Adding zero makes -0 to 0.
        let mut places = HashSet::new();
        let known: Vec<u32> = (0..means.len() as u32)
            .filter(|&i| self.labels[i as usize] >= 0 && finite(&means[i as usize]))
            .filter(|&i| places.insert(means[i as usize].map(|v| (v + 0.0).to_bits())))
            .collect();
        let Some(&first) = known.first() else { return Ok(()) };
        // Centred, so that far-away scenes keep their digits.
        let origin = means[first as usize];
        let shift = |p: [f32; 3]| [0, 1, 2].map(|k| p[k] - origin[k]);
        let places: Vec<[f32; 3]> = known.iter().map(|&i| shift(means[i as usize])).collect();
        let tree = ImmutableKdTree::<f32, 3>::new_from_slice(&places)
            .map_err(|e| Error::new(format!("cannot index the centres of the Gaussians: {e:?}")))?;
        let some = NonZero::new(4.min(places.len())).expect("there is one");
        let found: Vec<(usize, usize)> = (0..means.len())
            .into_par_iter()
            .filter(|&i| wanted(i) && finite(&means[i]))
            .filter_map(|i| {
                let near = tree.query(&shift(means[i])).nearest_n::<SquaredEuclidean<f32>>(some).execute();
                let near = near.iter().map(|n| (n.distance, n.item));
                let best = near.min_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
                best.map(|(_, item)| (i, known[item as usize] as usize))
            })
            .collect();
        for (i, near) in found {
            (self.labels[i], self.nodes[i]) = (self.labels[near], self.nodes[near]);
        }
        Ok(())
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

    /// Pairs of an instance and one of `parts` in it that the large masks set apart: the probability that one of them holds the part and
    /// the rest of the instance is lower, by [`APART`], than that of the medium masks. SAM's largest mask of a place is the whole thing
    /// there. Where either level says nothing of a part, it is not apart.
    ///
    /// # Errors
    /// When the footprints can't be read.
    pub fn apart(&self, parts: &Self, kept: &[u32], footprints: &Footprints) -> Result<BTreeSet<(i32, i32)>> {
        let pair = |i: &u32| (self.labels[*i as usize], parts.labels[*i as usize]);
        let pairs: BTreeSet<(i32, i32)> = kept.iter().map(pair).filter(|p| p.0 >= 0).collect();
        let number: BTreeMap<(i32, i32), i32> = pairs.iter().copied().zip(0..).collect();
        let labels: Vec<i32> = kept.iter().map(|i| number.get(&pair(i)).copied().unwrap_or(-1)).collect();
        let wholes: Vec<i32> = pairs.iter().map(|p| p.0).collect();
        let agreements = |level| with_rest(&labels, &wholes, footprints, &[level]);
        let both = agreements(Level::Medium)?.into_iter().zip(agreements(Level::Large)?);
        let leaves = |medium: Option<f64>, large: Option<f64>| medium.zip(large).is_some_and(|(m, l)| m - l >= APART);
        let apart = pairs.into_iter().zip(both).filter(|&(pair, (medium, large))| pair.1 >= 0 && leaves(medium, large));
        Ok(apart.map(|(p, _)| p).collect())
    }

    /// Makes instances of those of `parts` that lie in a larger instance: at least [`INSIDE`] of their Gaussians, and at most
    /// `share` of its own, or a half for those that are `apart`. An instance of which more than half would leave stays as it is. In the tree
    /// such a part hangs below the cluster of that instance. Returns how many there are.
    pub fn split(&mut self, parts: &Self, share: f64, apart: &BTreeSet<(i32, i32)>) -> usize {
        let mut common: BTreeMap<(i32, i32), usize> = BTreeMap::new();
        let (mut sizes, mut part_sizes) = (vec![0usize; self.instances], vec![0usize; parts.instances]);
        for (&whole, &part) in self.labels.iter().zip(&parts.labels) {
            if let (Ok(w), Ok(p)) = (usize::try_from(whole), usize::try_from(part)) {
                *common.entry((whole, part)).or_default() += 1;
                sizes[w] += 1;
                part_sizes[p] += 1;
            }
        }
        let small = |&((whole, part), n): &((i32, i32), usize)| {
            let (size, part_size) = (sizes[whole as usize] as f64, part_sizes[part as usize] as f64);
            let share = if apart.contains(&(whole, part)) { 0.5 } else { share };
            n as f64 >= INSIDE * part_size && part_size <= share * size
        };
        let mut found: BTreeMap<i32, Vec<(i32, usize)>> = BTreeMap::new();
        for ((whole, part), n) in common.into_iter().filter(small) {
            found.entry(whole).or_default().push((part, n));
        }
        found.retain(|&whole, parts| 2 * parts.iter().map(|(_, n)| n).sum::<usize>() <= sizes[whole as usize]);
        let before = self.instances;
        let mut new = BTreeMap::new();
        let mut child = self.tree.iter().map(|e| e.child).max().unwrap_or(0);
        for (whole, parts) in found {
            // Of a joined instance the first cluster; the whole scene is no cluster of the tree.
            let above = self.tree.iter().find(|e| e.instance == whole).copied();
            for (part, n) in parts {
                let node = above.map(|e| {
                    child += 1;
                    let instance = self.instances as i32;
                    // The features of wholes do not part them at any distance.
                    let lambda = f32::MAX;
                    self.tree.push(TreeEdge { parent: e.child, child, lambda, size: n as u32, instance });
                    child as i32
                });
                new.insert((whole, part), (self.instances as i32, node));
                self.instances += 1;
            }
        }
        for (i, &part) in parts.labels.iter().enumerate() {
            if let Some(&(instance, node)) = new.get(&(self.labels[i], part)) {
                self.labels[i] = instance;
                self.nodes[i] = node.unwrap_or(self.nodes[i]);
            }
        }
        self.instances - before
    }

    fn of_kept(&self, kept: &[u32]) -> Vec<i32> {
        kept.iter().map(|&i| self.labels[i as usize]).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::footprints_of;

    #[test]
    fn parts_much_smaller_than_their_instance_leave_it() {
        let of = |labels: Vec<i32>, instances, tree: Vec<TreeEdge>| Assignment {
            nodes: vec![5; labels.len()],
            labels,
            instances,
            tree,
            clusters: Vec::new(),
        };
        let (none, last) = (BTreeSet::new(), (0..120).map(|i| if i < 90 { -1 } else { 0 }).collect::<Vec<i32>>());
        let edge = TreeEdge { parent: 4, child: 5, lambda: 2.0, size: 100, instance: 0 };
        let wholes: Vec<i32> = (0..120).map(|i| i32::from(i >= 100)).collect();
        // Part 0 is most of instance 0; 1 is small and lies in it; 2 lies half in either; 3 is half of instance 1.
        let part = |i| match i {
            0..90 => 0,
            90..96 => 1,
            96..104 => 2,
            _ => 3,
        };
        let parts = of((0..120).map(part).collect(), 4, Vec::new());
        let mut a = of(wholes.clone(), 2, vec![edge]);
        assert_eq!((a.split(&parts, 0.1, &none), a.instances), (1, 3));
        let expected: Vec<i32> = (0..120).map(|i| if (90..96).contains(&i) { 2 } else { wholes[i] }).collect();
        assert_eq!(a.labels, expected);
        // It hangs below the instance's cluster.
        assert_eq!(a.tree[1], TreeEdge { parent: 5, child: 6, lambda: f32::MAX, size: 6, instance: 2 });
        assert!(a.nodes[90..96].iter().all(|&n| n == 6) && a.nodes.iter().filter(|&&n| n == 6).count() == 6);
        // Nothing is small enough; or the instance would fall apart.
        assert_eq!(of(wholes.clone(), 2, vec![edge]).split(&parts, 0.05, &none), 0);
        let crumbs = of((0..120).map(|i| i / 6).collect(), 20, Vec::new());
        assert_eq!(of(wholes, 2, vec![edge]).split(&crumbs, 0.1, &none), 0);
        // What is apart may be larger.
        assert_eq!(of(last.clone(), 1, vec![edge]).split(&parts, 0.1, &none), 0);
        assert_eq!(of(last, 1, vec![edge]).split(&parts, 0.1, &BTreeSet::from([(0, 2)])), 1);
    }

    #[test]
    fn parts_are_apart_that_large_masks_separate_more_often_than_medium_ones() {
        let of = |labels: [i32; 8], instances| Assignment {
            nodes: vec![5; 8],
            labels: labels.to_vec(),
            instances,
            tree: Vec::new(),
            clusters: Vec::new(),
        };
        // A mouse on its pad; the last two Gaussians are another instance.
        let (whole, parts) = (of([0, 0, 0, 0, 0, 0, 1, 1], 2), of([0, 0, 1, 1, 1, 1, 2, 2], 3));
        let together: [&[&[u32]]; 2] = [&[&[0, 1, 2, 3, 4, 5], &[6, 7]]; 2];
        let once: [&[&[u32]]; 2] = [together[0], &[&[0, 1], &[2, 3, 4, 5], &[6, 7]]];
        let unseen: [&[&[u32]]; 2] = [&[&[6, 7]]; 2];
        let apart = |medium, large| {
            let footprints = footprints_of(&[(Level::Medium, medium), (Level::Large, large)]);
            whole.apart(&parts, &[0, 1, 2, 3, 4, 5, 6, 7], &footprints).unwrap()
        };
        assert_eq!(apart(&together, &once), BTreeSet::from([(0, 0), (0, 1)]));
        for (medium, large) in [(&together, &together), (&once, &together), (&once, &once), (&together, &unseen)] {
            assert!(apart(medium, large).is_empty(), "{medium:?} {large:?}");
        }
    }

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
        a.fill_from_nearest(&means, |i| (2..4).contains(&i)).unwrap();
        assert_eq!((a.labels, a.nodes), (vec![0, 1, 0, 1, -1], vec![8, 9, 8, 9, 7]));
        let mut none = of(&[-1; 5], &[7; 5]);
        none.fill_from_nearest(&means, |_| true).unwrap();
        assert_eq!(none.labels, [-1; 5]);
        let mut heap = of(&[3, 3, -1], &[5; 3]);
        heap.fill_from_nearest(&[[1.0; 3]; 3], |i| i == 2).unwrap();
        assert_eq!(heap.labels, [3, 3, 3]);
    }
}
