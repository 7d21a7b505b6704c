//! A kd-tree whose answers have one defined order: by distance, then by index.
//!
//! Distances are squared Euclidean, in f32, summed as (dx² + dy²) + dz². The distance to a bounding box is computed with
//! the same operations, and f32 rounding is monotone, so a box is never farther than a point inside it: pruning is exact,
//! bit for bit what brute force gives. Every node knows its smallest index, which keeps thousands of coinciding points
//! from being compared with each other.

use rayon::prelude::*;

/// Points in a leaf, at most.
const LEAF: usize = 24;
/// Queries answered together.
const CHUNK: usize = 1024;
/// Subtrees smaller than this are built by one thread.
const PARALLEL_BUILD: usize = 16_384;

/// A balanced kd-tree over points in space.
#[derive(Debug, Clone)]
pub struct KdTree {
    /// In preorder: the left child of an inner node follows it.
    pub(crate) nodes: Vec<Node>,
    /// Index of the point in each slot; a leaf is a range of slots.
    pub(crate) index: Vec<u32>,
    /// Coordinates by slot, an array per axis.
    pub(crate) axes: [Vec<f32>; 3],
}

#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Node {
    lo: [f32; 3],
    hi: [f32; 3],
    pub(crate) start: u32,
    pub(crate) end: u32,
    /// Smallest index of a point inside.
    min_index: u32,
    /// Right child; 0 for a leaf.
    pub(crate) right: u32,
}

impl Node {
    /// Squared distance from `q` to the box; 0 inside.
    #[inline]
    pub(crate) fn distance(&self, q: [f32; 3]) -> f32 {
        let d = |a: usize| (self.lo[a] - q[a]).max(q[a] - self.hi[a]).max(0.0);
        let [x, y, z] = [d(0), d(1), d(2)];
        x * x + y * y + z * z
    }
}

/// Squared distance as this crate computes it everywhere.
#[inline]
pub fn distance(a: [f32; 3], b: [f32; 3]) -> f32 {
    let [x, y, z] = [b[0] - a[0], b[1] - a[1], b[2] - a[2]];
    x * x + y * y + z * z
}

/// Nodes of a tree over `n` points.
fn node_count(n: usize) -> usize {
    if n <= LEAF { 1 } else { 1 + node_count(n / 2) + node_count(n - n / 2) }
}

impl KdTree {
    /// Builds the tree over finite `points`; their indices are their positions in the slice.
    pub fn new(points: &[[f32; 3]]) -> Self {
        let mut index: Vec<u32> = (0..points.len() as u32).collect();
        let mut nodes = vec![Node::default(); if points.is_empty() { 0 } else { node_count(points.len()) }];
        if !points.is_empty() {
            build(points, &mut index, &mut nodes, 0, 0);
        }
        let axes = [0, 1, 2].map(|a| index.iter().map(|&i| points[i as usize][a]).collect());
        Self { nodes, index, axes }
    }

    /// The point in a slot.
    #[inline]
    pub(crate) fn at(&self, slot: usize) -> [f32; 3] {
        [self.axes[0][slot], self.axes[1][slot], self.axes[2][slot]]
    }

    /// The `k` points nearest to `q`, nearest first, ties by index, without the point `except`; `found` is scratch and
    /// result: (squared distance, index).
    pub fn nearest(&self, q: [f32; 3], k: usize, except: Option<u32>, found: &mut Vec<(f32, u32)>) {
        found.clear();
        if k == 0 || self.nodes.is_empty() {
            return;
        }
        // Preorder of a balanced tree: the stack holds one node per level.
        let mut stack = [(0.0f32, 0u32); 64];
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let (box_distance, mut id) = stack[depth];
            let beaten = |d: f32, min_index: u32, found: &[(f32, u32)]| {
                found.len() == k && found.last().is_some_and(|&(fd, fi)| (d, min_index) > (fd, fi))
            };
            if beaten(box_distance, self.nodes[id as usize].min_index, found) {
                continue;
            }
            loop {
                let node = &self.nodes[id as usize];
                if node.right == 0 {
                    self.scan(node, q, k, except, found);
                    break;
                }
                let (left, right) = (id + 1, node.right);
                let (l, r) = (&self.nodes[left as usize], &self.nodes[right as usize]);
                let (dl, dr) = (l.distance(q), r.distance(q));
                let left_first = (dl, l.min_index) < (dr, r.min_index);
                let (near, far, d_far) = if left_first { (left, right, dr) } else { (right, left, dl) };
                if !beaten(d_far, self.nodes[far as usize].min_index, found) {
                    stack[depth] = (d_far, far);
                    depth += 1;
                }
                id = near;
            }
        }
    }

    fn scan(&self, node: &Node, q: [f32; 3], k: usize, except: Option<u32>, found: &mut Vec<(f32, u32)>) {
        let (start, end) = (node.start as usize, node.end as usize);
        let mut distances = [0.0f32; LEAF];
        let [x, y, z] = [0, 1, 2].map(|a| &self.axes[a][start..end]);
        for (i, d) in distances[..end - start].iter_mut().enumerate() {
            *d = distance(q, [x[i], y[i], z[i]]);
        }
        for (&d, &i) in distances.iter().zip(&self.index[start..end]) {
            let full = found.len() == k;
            if Some(i) == except || (full && (d, i) > found[k - 1]) {
                continue;
            }
            if full {
                found.pop();
            }
            let at = found.partition_point(|&f| f < (d, i));
            found.insert(at, (d, i));
        }
    }

    /// For each query point (with the index to leave out, if any): its `k` nearest points as in [`Self::nearest`],
    /// `[queries][k]`. Where there are fewer than `k`, rows are filled up with `pad(query)`.
    pub fn nearest_many(
        &self,
        queries: &[([f32; 3], Option<u32>)],
        k: usize,
        pad: impl Fn(usize) -> u32 + Sync,
    ) -> Vec<u32> {
        let mut out = vec![0u32; queries.len() * k];
        out.par_chunks_mut((CHUNK * k).max(1)).enumerate().for_each(|(chunk, rows)| {
            let mut found = Vec::with_capacity(k + 1);
            for (i, row) in rows.chunks_exact_mut(k).enumerate() {
                let query = chunk * CHUNK + i;
                let (q, except) = queries[query];
                self.nearest(q, k, except, &mut found);
                for (o, &(_, index)) in row.iter_mut().zip(&found) {
                    *o = index;
                }
                row[found.len()..].fill(pad(query));
            }
        });
        out
    }

    /// The `k` nearest other points of every point, `[points][k]` by index; filled up with the point itself.
    pub fn all_nearest(&self, k: usize) -> Vec<u32> {
        // In slot order, so that one query's leaves are still in the cache for the next.
        let queries: Vec<_> = (0..self.index.len()).map(|s| (self.at(s), Some(self.index[s]))).collect();
        let by_slot = self.nearest_many(&queries, k, |s| self.index[s]);
        let mut out = vec![0u32; by_slot.len()];
        for (row, &i) in by_slot.chunks_exact(k.max(1)).zip(&self.index) {
            out[i as usize * k..(i as usize + 1) * k].copy_from_slice(row);
        }
        out
    }
}

/// Builds the subtree over `index` into `nodes`; `first_slot` and `first_node` are where the two begin in the tree.
fn build(points: &[[f32; 3]], index: &mut [u32], nodes: &mut [Node], first_slot: usize, first_node: usize) {
    let (mut lo, mut hi) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3]);
    for &i in index.iter() {
        for a in 0..3 {
            lo[a] = lo[a].min(points[i as usize][a]);
            hi[a] = hi[a].max(points[i as usize][a]);
        }
    }
    let n = index.len();
    let min_index = index.iter().copied().min().unwrap_or(0);
    let mut node = Node { lo, hi, start: first_slot as u32, end: (first_slot + n) as u32, min_index, right: 0 };
    if n <= LEAF {
        index.sort_unstable();
        nodes[0] = node;
        return;
    }
    let axis = (0..3).fold(0, |best, a| if hi[a] - lo[a] > hi[best] - lo[best] { a } else { best });
    let key = |i: &u32| points[*i as usize][axis];
    // The index breaks ties, so the tree is one and the same however often it is built.
    index.select_nth_unstable_by(n / 2, |a, b| key(a).total_cmp(&key(b)).then(a.cmp(b)));
    let left_nodes = node_count(n / 2);
    node.right = (first_node + 1 + left_nodes) as u32;
    nodes[0] = node;
    let (left, right) = index.split_at_mut(n / 2);
    let (left_tree, right_tree) = nodes[1..].split_at_mut(left_nodes);
    let mut build_left = || build(points, left, left_tree, first_slot, first_node + 1);
    let mut build_right = || build(points, right, right_tree, first_slot + n / 2, first_node + 1 + left_nodes);
    if n >= PARALLEL_BUILD {
        rayon::join(build_left, build_right);
    } else {
        build_left();
        build_right();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::points;
    use proptest::prelude::*;

    fn brute(points: &[[f32; 3]], q: [f32; 3], k: usize, except: Option<u32>) -> Vec<(f32, u32)> {
        let mut all: Vec<(f32, u32)> = points
            .iter()
            .enumerate()
            .map(|(i, &p)| (distance(q, p), i as u32))
            .filter(|f| Some(f.1) != except)
            .collect();
        all.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        all.truncate(k);
        all
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(150))]
        #[test]
        fn neighbours_are_those_of_brute_force(p in points(1..400), k in 1usize..20, q in prop::array::uniform3(-3f32..3.0)) {
            let tree = KdTree::new(&p);
            let mut found = Vec::new();
            tree.nearest(q, k, None, &mut found);
            prop_assert_eq!(&found, &brute(&p, q, k, None));
            let all = tree.all_nearest(k);
            for (i, row) in all.chunks_exact(k).enumerate() {
                let mut want: Vec<u32> = brute(&p, p[i], k, Some(i as u32)).iter().map(|f| f.1).collect();
                want.resize(k, i as u32);
                prop_assert_eq!(row, &want[..]);
            }
        }
    }

    #[test]
    fn coinciding_points_cost_no_more_than_others() {
        // A tree that compares them all with each other needs 4e10 distances here.
        let tree = KdTree::new(&vec![[1.0, 2.0, 3.0]; 200_000]);
        let all = tree.all_nearest(3);
        assert_eq!(all[..6], [1, 2, 3, 0, 2, 3]);
        assert_eq!(all[3 * 150_000..3 * 150_000 + 3], [0, 1, 2]);
    }
}
