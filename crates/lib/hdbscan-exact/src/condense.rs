//! From a spanning tree to the condensed tree: the hierarchy of clusters of at least `min_cluster_size` points.

use crate::linkage::{Edge, UnionFind};

/// An edge of the condensed tree.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CondensedEdge {
    /// The cluster that is left.
    pub parent: u32,
    /// What leaves it: a (distinct) point, below [`CondensedTree::points`], or a cluster, from there on.
    pub child: u32,
    /// 1 / distance at which it leaves.
    pub lambda: f64,
    /// Points that leave.
    pub size: u32,
}

/// The condensed tree. Clusters are numbered from `points` (the root) on, parents before children.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct CondensedTree {
    /// Number of distinct points.
    pub points: u32,
    /// Number of clusters, the root included.
    pub clusters: u32,
    /// All edges, by parent.
    pub edges: Vec<CondensedEdge>,
}

/// A node of the dendrogram: two children (points, or nodes from `m` on) joined at a distance.
struct Merge {
    children: [u32; 2],
    distance: f64,
    size: u32,
}

/// `edges` is a spanning tree over distinct points in ascending order; `weights` and `core` are theirs.
pub(crate) fn condense(edges: &[Edge], weights: &[u32], core: &[f64], min_cluster_size: usize) -> CondensedTree {
    let m = weights.len();
    let mut tree = CondensedTree { points: m as u32, clusters: 1, edges: Vec::new() };
    if m == 0 {
        return tree;
    }
    let mut sets = UnionFind::new(m);
    let mut top: Vec<u32> = (0..m as u32).collect();
    let mut merges: Vec<Merge> = Vec::with_capacity(edges.len());
    for e in edges {
        let (ra, rb) = (sets.find(e.a), sets.find(e.b));
        let children = [top[ra as usize], top[rb as usize]];
        let size = children.iter().map(|&c| size_of(c, weights, &merges)).sum();
        sets.join(ra, rb);
        top[ra.min(rb) as usize] = (m + merges.len()) as u32;
        merges.push(Merge { children, distance: e.weight, size });
    }
    let lambda_of = |distance: f64| if distance > 0.0 { 1.0 / distance } else { f64::INFINITY };
    let root = top[sets.find(0) as usize];
    // (node of the dendrogram, cluster it belongs to)
    let mut open = vec![(root, m as u32)];
    while let Some((node, cluster)) = open.pop() {
        if (node as usize) < m {
            // A point with duplicates that is a cluster by itself: it dissolves at its core distance.
            drop_all(node, cluster, lambda_of(core[node as usize]), weights, &merges, &mut tree.edges);
            continue;
        }
        let merge = &merges[node as usize - m];
        let lambda = lambda_of(merge.distance);
        let sizes = merge.children.map(|c| size_of(c, weights, &merges));
        let large = sizes.map(|s| s as usize >= min_cluster_size);
        for ((child, size), is_large) in merge.children.into_iter().zip(sizes).zip(large) {
            if large == [true, true] {
                let new = m as u32 + tree.clusters;
                tree.clusters += 1;
                tree.edges.push(CondensedEdge { parent: cluster, child: new, lambda, size });
                open.push((child, new));
            } else if is_large {
                open.push((child, cluster));
            } else {
                drop_all(child, cluster, lambda, weights, &merges, &mut tree.edges);
            }
        }
    }
    tree.edges.sort_by_key(|e| (e.parent, e.child));
    tree
}

fn size_of(node: u32, weights: &[u32], merges: &[Merge]) -> u32 {
    let m = weights.len();
    if (node as usize) < m { weights[node as usize] } else { merges[node as usize - m].size }
}

/// All points below a node leave the cluster at once.
fn drop_all(node: u32, cluster: u32, lambda: f64, weights: &[u32], merges: &[Merge], out: &mut Vec<CondensedEdge>) {
    let m = weights.len();
    let mut open = vec![node];
    while let Some(node) = open.pop() {
        if (node as usize) < m {
            out.push(CondensedEdge { parent: cluster, child: node, lambda, size: weights[node as usize] });
        } else {
            open.extend(merges[node as usize - m].children);
        }
    }
}
