//! `instances.safetensors`: the 3D instances with their descriptors, boxes and matches.

use crate::checks::{below, check, check_labels, column, table, view_names};
use crate::flat;
use crate::granules::{self, Granule, Members};
use gs_io::{Artifact, ArtifactWriter, Provenance, Result};
use ndarray::{Array2, ArrayView1};
use serde_json::json;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// An instance matched with a mask of a view.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Match {
    /// Index of the instance.
    pub instance: u32,
    /// Index of the view in [`Instances::views`].
    pub view: u32,
    /// Id of the mask in the view's `*_s.npy`.
    pub mask: u32,
    /// Association score, IoU x similarity of mean features (paper, S_kj), 0 to 1.
    pub score: f32,
    /// How much is seen of the instance: blending weight of its Gaussians summed over pixels in masks.
    pub visible: f32,
}

/// An edge of the condensed tree of the clustering.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct TreeEdge {
    /// The parent cluster; the root is the number of clustered points, as in scikit-learn.
    pub parent: u32,
    /// The child cluster.
    pub child: u32,
    /// 1 / distance at which the child leaves its parent.
    pub lambda: f32,
    /// Gaussians in the child.
    pub size: u32,
    /// Index of the instance that was selected at the child, or -1.
    pub instance: i32,
}

/// A box around an instance along its principal axes.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct OrientedBox {
    /// Middle of the box.
    pub center: [f32; 3],
    /// Unit axes, right-handed, the longest side first.
    pub axes: [[f32; 3]; 3],
    /// Half the sides, along the axes.
    pub half_size: [f32; 3],
}

/// All instances of a scene; K of them.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Instances {
    /// Instance of every Gaussian, -1 for noise; N.
    pub label: Vec<i32>,
    /// Language descriptors, of unit length or zero; `[K][dim]`.
    pub descriptor: Array2<f32>,
    /// Views in which the instance was matched with a mask; K.
    pub support: Vec<u32>,
    /// Confidence that this is one whole thing, 0 to 1, to rank instances by: (count / largest count)^0.2 times how well masks fit it, as
    /// [`Granule::fit`](crate::Granule); K.
    pub score: Vec<f32>,
    /// Number of Gaussians; K.
    pub count: Vec<u32>,
    /// Mean of their centres; K.
    pub centroid: Vec<[f32; 3]>,
    /// Lower corner of the axis-aligned box around their centres; K.
    pub bbox_min: Vec<[f32; 3]>,
    /// Upper corner of that box; K.
    pub bbox_max: Vec<[f32; 3]>,
    /// Box around their centres along their principal axes; K.
    pub oriented: Vec<OrientedBox>,
    /// Names of the views (file stems) of the matches.
    pub views: Vec<String>,
    /// All matches, ordered by instance, view.
    pub matches: Vec<Match>,
    /// Condensed tree of the clustering (cluster-to-cluster edges only), so that a query can choose the granularity.
    pub tree: Vec<TreeEdge>,
    /// The smallest cluster of the tree that holds each Gaussian, -1 for one that is in none; N.
    pub node: Vec<i32>,
    /// What texts may ask for: parts, things and groups, those that many masks show well first; Q.
    pub granules: Vec<Granule>,
    /// Their language descriptors, of unit length or zero; `[Q][dim]`.
    pub granule_descriptor: Array2<f32>,
}

/// The place of an instance in the tree of clusters.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Family {
    /// Its own cluster; several where it was joined from pieces.
    pub own: Vec<u32>,
    /// The cluster that it and its siblings are parts of. None where that is the whole scene or a heap of things that
    /// nothing connects.
    pub parent: Option<u32>,
    /// The clusters that it consists of: the pieces it was joined from, or those below its own.
    pub parts: Vec<u32>,
}

impl Instances {
    /// Format name in the file.
    pub const FORMAT: &str = "instances";
    const VERSION: u32 = 1;

    /// Number of instances.
    pub fn len(&self) -> usize {
        self.count.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.count.is_empty()
    }

    /// Dimension of a descriptor; 0 when the scene has no language features.
    pub fn dim(&self) -> usize {
        self.descriptor.ncols()
    }

    /// Descriptor of an instance.
    pub fn descriptor_of(&self, instance: usize) -> ArrayView1<'_, f32> {
        self.descriptor.row(instance)
    }

    /// The place of an instance in the tree; `None` for one that is not in it, because it is the root.
    pub fn family(&self, instance: usize) -> Option<Family> {
        let own: Vec<u32> = self.tree.iter().filter(|e| e.instance == instance as i32).map(|e| e.child).collect();
        let (&first, others) = own.split_first()?;
        let root = self.tree.iter().map(|e| e.parent).min();
        let above: BTreeMap<u32, &TreeEdge> = self.tree.iter().map(|e| (e.child, e)).collect();
        // The nearest cluster above all of it: parents have smaller numbers than their children.
        let mut top = above[&first].parent;
        for &other in others {
            let mut at = other;
            while at != top {
                let lower = if at > top { &mut at } else { &mut top };
                *lower = above.get(lower)?.parent;
            }
        }
        let mut edge = above[&first];
        while edge.parent != top {
            edge = above[&edge.parent];
        }
        // What was split at lambda 0 is infinitely far apart.
        let parent = Some(edge.parent).filter(|&p| Some(p) != root && edge.lambda > 0.0);
        let below = self.tree.iter().filter(|e| e.parent == first).map(|e| e.child);
        let parts = if others.is_empty() { below.collect() } else { own.clone() };
        Some(Family { own, parent, parts })
    }

    /// The cluster `top` and all below it.
    fn within(&self, top: u32) -> BTreeSet<u32> {
        let mut within = BTreeSet::from([top]);
        let mut edges: Vec<&TreeEdge> = self.tree.iter().collect();
        edges.sort_by_key(|e| e.parent);
        // Parents have smaller numbers than their children.
        for e in edges {
            if within.contains(&e.parent) {
                within.insert(e.child);
            }
        }
        within
    }

    /// The Gaussians of a cluster of the tree, ascending.
    pub fn gaussians_of_cluster(&self, cluster: u32) -> Vec<u32> {
        let within = self.within(cluster);
        let own = |node: i32| u32::try_from(node).is_ok_and(|n| within.contains(&n));
        (0..self.node.len() as u32).filter(|&i| own(self.node[i as usize])).collect()
    }

    /// Gaussians of every cluster of the tree, those of the clusters below it among them; what noise and unseen Gaussians
    /// were given to is in it, so it may be more than [`TreeEdge::size`].
    pub fn cluster_sizes(&self) -> BTreeMap<u32, u32> {
        let mut sizes = BTreeMap::new();
        self.node.iter().filter_map(|&n| u32::try_from(n).ok()).for_each(|n| *sizes.entry(n).or_default() += 1);
        let mut edges: Vec<&TreeEdge> = self.tree.iter().collect();
        edges.sort_by_key(|e| std::cmp::Reverse(e.child));
        for e in edges {
            *sizes.entry(e.parent).or_default() += sizes.get(&e.child).copied().unwrap_or(0);
        }
        sizes
    }

    /// The instances that were selected at a cluster of the tree or below it, ascending.
    pub fn instances_of_cluster(&self, cluster: u32) -> Vec<u32> {
        let within = self.within(cluster);
        let own = |e: &&TreeEdge| e.instance >= 0 && within.contains(&e.child);
        let mut instances: Vec<u32> = self.tree.iter().filter(own).map(|e| e.instance as u32).collect();
        instances.sort_unstable();
        instances
    }

    /// Writes the artifact. The names of views join what `provenance.extra` holds, such as [`Health`](crate::Health).
    pub fn write(&self, path: impl AsRef<Path>, mut provenance: Provenance) -> Result<()> {
        provenance.format = Self::FORMAT.into();
        provenance.version = Self::VERSION;
        self.write_into(ArtifactWriter::new(self.provenance(provenance)), path)
    }

    /// A provenance with the names of the views.
    pub(crate) fn provenance(&self, mut provenance: Provenance) -> Provenance {
        provenance.extra["views"] = json!(self.views);
        provenance
    }

    /// Writes an artifact of these tensors and those that `writer` has already.
    pub(crate) fn write_into<'a>(&'a self, writer: ArtifactWriter<'a>, path: impl AsRef<Path>) -> Result<()> {
        let (k, m, t) = (self.len(), self.matches.len(), self.tree.len());
        let center = column(&self.oriented, |b| b.center);
        let axes = column(&self.oriented, |b| b.axes);
        let half = column(&self.oriented, |b| b.half_size);
        let (granules, q) = (&self.granules, self.granules.len());
        let members = |g: &Granule| match g.members {
            Members::Instance(k) => (k as i32, 0),
            Members::Cluster(c) => (-1, c),
        };
        writer
            .tensor("granule_instance", &[q], &column(granules, |g| members(g).0))
            .tensor("granule_cluster", &[q], &column(granules, |g| members(g).1))
            .tensor("granule_support", &[q], &column(granules, |g| g.support))
            .tensor("granule_fit", &[q], &column(granules, |g| g.fit))
            .tensor("granule_descriptor", &[q, self.dim()], flat(self.granule_descriptor.view()))
            .tensor("obb_center", &[k, 3], center.as_flattened())
            .tensor("obb_axes", &[k, 3, 3], axes.as_flattened().as_flattened())
            .tensor("obb_half_size", &[k, 3], half.as_flattened())
            .tensor("node", &[self.node.len()], &self.node)
            .tensor("label", &[self.label.len()], &self.label)
            .tensor("descriptor", &[k, self.dim()], flat(self.descriptor.view()))
            .tensor("support", &[k], &self.support)
            .tensor("score", &[k], &self.score)
            .tensor("count", &[k], &self.count)
            .tensor("centroid", &[k, 3], self.centroid.as_flattened())
            .tensor("bbox_min", &[k, 3], self.bbox_min.as_flattened())
            .tensor("bbox_max", &[k, 3], self.bbox_max.as_flattened())
            .tensor("match_instance", &[m], &column(&self.matches, |x| x.instance))
            .tensor("match_view", &[m], &column(&self.matches, |x| x.view))
            .tensor("match_mask", &[m], &column(&self.matches, |x| x.mask))
            .tensor("match_score", &[m], &column(&self.matches, |x| x.score))
            .tensor("match_visible", &[m], &column(&self.matches, |x| x.visible))
            .tensor("tree_parent", &[t], &column(&self.tree, |x| x.parent))
            .tensor("tree_child", &[t], &column(&self.tree, |x| x.child))
            .tensor("tree_lambda", &[t], &column(&self.tree, |x| x.lambda))
            .tensor("tree_size", &[t], &column(&self.tree, |x| x.size))
            .tensor("tree_instance", &[t], &column(&self.tree, |x| x.instance))
            .write(path)
    }

    /// Reads and checks the artifact.
    ///
    /// # Errors
    /// When the file is damaged, tensors do not fit together, or an index is out of range.
    pub fn read(path: impl AsRef<Path>) -> Result<(Self, Artifact)> {
        let a = Artifact::open(path, Self::FORMAT, Self::VERSION)?;
        Ok((Self::from_artifact(&a)?, a))
    }

    /// The instances that an artifact holds, checked.
    pub(crate) fn from_artifact(a: &Artifact) -> Result<Self> {
        let count = a.tensor::<u32>("count", &[None])?.to_vec();
        let k = count.len();
        let descriptor = table(a, "descriptor", [Some(k), None])?;
        let views = view_names(a)?;
        let triples = |name: &str| -> Result<Vec<[f32; 3]>> {
            Ok(a.tensor::<f32>(name, &[Some(k), Some(3)])?.as_chunks::<3>().0.to_vec())
        };
        let label = a.tensor::<i32>("label", &[None])?.to_vec();
        check_labels(a, "label", &label, k)?;
        let (center, half) = (triples("obb_center")?, triples("obb_half_size")?);
        let tree = read_tree(a, k)?;
        let granules = granules::read(a, k, &tree)?;
        let axes = a.tensor::<f32>("obb_axes", &[Some(k), Some(3), Some(3)])?.as_chunks::<3>().0.as_chunks::<3>().0;
        Ok(Self {
            oriented: (0..k).map(|i| OrientedBox { center: center[i], axes: axes[i], half_size: half[i] }).collect(),
            node: a.tensor("node", &[Some(label.len())])?.to_vec(),
            label,
            support: a.tensor("support", &[Some(k)])?.to_vec(),
            score: a.tensor("score", &[Some(k)])?.to_vec(),
            centroid: triples("centroid")?,
            bbox_min: triples("bbox_min")?,
            bbox_max: triples("bbox_max")?,
            count,
            matches: read_matches(a, k, views.len())?,
            tree,
            views,
            granule_descriptor: match granules.is_empty() {
                true => Array2::default((0, descriptor.ncols())),
                false => table(a, "granule_descriptor", [Some(granules.len()), Some(descriptor.ncols())])?,
            },
            descriptor,
            granules,
        })
    }
}

fn read_matches(a: &Artifact, instances: usize, views: usize) -> Result<Vec<Match>> {
    let instance = a.tensor::<u32>("match_instance", &[None])?;
    let m = Some(instance.len());
    let (view, mask) = (a.tensor::<u32>("match_view", &[m])?, a.tensor::<u32>("match_mask", &[m])?);
    let (score, visible) = (a.tensor::<f32>("match_score", &[m])?, a.tensor::<f32>("match_visible", &[m])?);
    below(a, "match_instance", instance, instances)?;
    below(a, "match_view", view, views)?;
    let at = |i| Match { instance: instance[i], view: view[i], mask: mask[i], score: score[i], visible: visible[i] };
    Ok((0..instance.len()).map(at).collect())
}

fn read_tree(a: &Artifact, instances: usize) -> Result<Vec<TreeEdge>> {
    let parent = a.tensor::<u32>("tree_parent", &[None])?;
    let t = Some(parent.len());
    let (child, size) = (a.tensor::<u32>("tree_child", &[t])?, a.tensor::<u32>("tree_size", &[t])?);
    let (lambda, instance) = (a.tensor::<f32>("tree_lambda", &[t])?, a.tensor::<i32>("tree_instance", &[t])?);
    check_labels(a, "tree_instance", instance, instances)?;
    let expected = |at: usize| format!("more than its parent {}", parent[at]);
    check(a, "tree_child", child, |at, c| c > parent[at], "the tree of clusters is damaged", expected)?;
    let edge =
        |i| TreeEdge { parent: parent[i], child: child[i], lambda: lambda[i], size: size[i], instance: instance[i] };
    Ok((0..parent.len()).map(edge).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_back_with_and_without_language() {
        let dir = tempfile::tempdir().unwrap();
        let p = dir.path().join("i.safetensors");
        for dim in [0usize, 4] {
            let i = Instances {
                label: vec![0, -1, 1, 1],
                descriptor: Array2::from_elem((2, dim), 0.5),
                support: vec![3, 0],
                score: vec![0.5, 0.0],
                count: vec![1, 2],
                centroid: vec![[0.0; 3], [1.0; 3]],
                bbox_min: vec![[0.0; 3]; 2],
                bbox_max: vec![[1.0; 3]; 2],
                oriented: vec![
                    OrientedBox { half_size: [3.0, 2.0, 1.0], axes: [[0.5; 3]; 3], ..Default::default() };
                    2
                ],
                views: vec!["a".into()],
                matches: vec![Match { instance: 0, view: 0, mask: 7, score: 0.5, visible: 12.5 }],
                tree: vec![TreeEdge { parent: 4, child: 5, lambda: 2.0, size: 2, instance: 1 }],
                node: vec![4, -1, 5, 5],
                granules: vec![
                    Granule { members: Members::Instance(1), support: 2, fit: 0.75 },
                    Granule { members: Members::Cluster(5), support: 3, fit: 1.0 },
                ],
                granule_descriptor: Array2::from_elem((2, dim), 0.5),
            };
            i.write(&p, Provenance::default()).unwrap();
            assert_eq!(Instances::read(&p).unwrap().0, i);
            assert_eq!((i.family(1), i.family(0)), (Some(Family { own: vec![5], ..Family::default() }), None));
        }
    }

    #[test]
    fn the_tree_tells_parents_parts_and_who_belongs_to_them() {
        let edge = |parent, child, instance, lambda| TreeEdge { parent, child, lambda, size: 2, instance };
        // 7 is everything: 8, a thing 9 (instance 1) apart from all, and below 8 the instances 0, of parts 12 and 13, and 2.
        let i = Instances {
            label: vec![0, 0, 0, 2, 2, 1, -1, -1],
            count: vec![3, 1, 2],
            tree: vec![
                edge(7, 8, -1, 0.5),
                edge(7, 9, 1, 0.0),
                edge(8, 10, 0, 1.0),
                edge(8, 11, 2, 1.0),
                edge(10, 12, -1, 3.0),
                edge(10, 13, -1, 3.0),
            ],
            node: vec![12, 13, 10, 11, 11, 9, 8, -1],
            ..Instances::default()
        };
        assert_eq!(i.family(0), Some(Family { own: vec![10], parent: Some(8), parts: vec![12, 13] }));
        assert_eq!(i.family(2), Some(Family { own: vec![11], parent: Some(8), parts: vec![] }));
        assert_eq!(i.family(1), Some(Family { own: vec![9], parent: None, parts: vec![] }));
        // Joined from pieces: these are its parts, and what is above all of them its parent.
        let mut joined = i.clone();
        joined.tree.iter_mut().filter(|e| e.child == 11).for_each(|e| e.instance = 0);
        assert_eq!(joined.family(0), Some(Family { own: vec![10, 11], parent: Some(8), parts: vec![10, 11] }));
        joined.tree.iter_mut().filter(|e| e.child == 9).for_each(|e| e.instance = 0);
        assert_eq!(joined.family(0).unwrap().parent, None);
        assert_eq!(i.gaussians_of_cluster(10), [0, 1, 2]);
        assert_eq!(i.gaussians_of_cluster(12), [0]);
        assert_eq!(i.gaussians_of_cluster(8), [0, 1, 2, 3, 4, 6], "with what belongs to no child");
        assert_eq!((i.instances_of_cluster(8), i.instances_of_cluster(12)), (vec![0, 2], vec![]));
        assert!(i.gaussians_of_cluster(99).is_empty());
        let sizes = i.cluster_sizes();
        for cluster in 7..=13 {
            assert_eq!(sizes[&cluster] as usize, i.gaussians_of_cluster(cluster).len(), "{cluster}");
        }
        let dir = tempfile::tempdir().unwrap();
        let p = dir.path().join("i.safetensors");
        for (parent, child) in [(8, 8), (9, 8)] {
            let ring = Instances { tree: vec![edge(parent, child, -1, 1.0)], ..Instances::default() };
            ring.write(&p, Provenance::default()).unwrap();
            assert!(
                Instances::read(&p).unwrap_err().to_string().contains("tree_child[0]: the tree of clusters is damaged")
            );
        }
    }
}
