//! A kd-tree in space whose answers have one defined order: by distance, then by index.
//!
//! Distances are squared Euclidean, in f32, summed as (dx² + dy²) + dz². The distance to a bounding box is computed with
//! the same operations, and f32 rounding is monotone, so a box is never farther than a point inside it: pruning is exact,
//! bit for bit what brute force gives. Every node knows its smallest index, which keeps thousands of coinciding points
//! from being compared with each other.

use multiversion::multiversion;
use ndarray::Array2;
use rayon::prelude::*;

/// Points that are worked on side by side; leaves hold multiples of it, but for the last.
pub(super) const LANES: usize = 8;
/// Points in a leaf, at most.
const LEAF: usize = 32;
/// Queries answered together.
const CHUNK: usize = 1024;
/// Subtrees smaller than this are built by one thread.
const PARALLEL_BUILD: usize = 16_384;

/// A balanced kd-tree over points in space.
#[derive(Debug, Clone)]
pub struct KdTree {
    /// In preorder: the left child of an inner node follows it.
    pub(super) nodes: Vec<Node>,
    /// Index of the point in each slot; a leaf is a range of slots.
    pub(super) index: Vec<u32>,
    /// Coordinates by slot, an array per axis.
    pub(super) axes: [Vec<f32>; 3],
}

#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Node {
    lo: [f32; 3],
    hi: [f32; 3],
    pub(super) start: u32,
    pub(super) end: u32,
    /// Smallest index of a point inside.
    min_index: u32,
    /// Right child; 0 for a leaf.
    pub(super) right: u32,
}

impl Node {
    /// Squared distance from `q` to the box; 0 inside.
    #[inline(always)]
    pub(super) fn distance(&self, q: [f32; 3]) -> f32 {
        let d = |a: usize| (self.lo[a] - q[a]).max(q[a] - self.hi[a]).max(0.0);
        let [x, y, z] = [d(0), d(1), d(2)];
        x * x + y * y + z * z
    }
}

/// Squared distance as the tree computes it.
#[inline(always)]
pub fn distance(a: [f32; 3], b: [f32; 3]) -> f32 {
    let [x, y, z] = [b[0] - a[0], b[1] - a[1], b[2] - a[2]];
    x * x + y * y + z * z
}

/// Points of the left child of a node of `n` points: half, rounded to whole lanes.
fn left_count(n: usize) -> usize {
    (n / 2).next_multiple_of(LANES)
}

/// Nodes of a tree over `n` points.
fn node_count(n: usize) -> usize {
    if n <= LEAF { 1 } else { 1 + node_count(left_count(n)) + node_count(n - left_count(n)) }
}

impl KdTree {
    /// Builds the tree over finite `points`; their indices are their positions in the slice.
    pub fn new(points: &[[f32; 3]]) -> Self {
        // Points and indices side by side: the build moves them together and never jumps in memory.
        let mut items: Vec<Item> = points.iter().enumerate().map(|(i, &p)| Item { p, index: i as u32 }).collect();
        let mut nodes = vec![Node::default(); if points.is_empty() { 0 } else { node_count(points.len()) }];
        if !points.is_empty() {
            build(&mut items, &mut nodes, 0, 0);
        }
        let axes = [0, 1, 2].map(|a| items.iter().map(|item| item.p[a]).collect());
        Self { nodes, index: items.iter().map(|item| item.index).collect(), axes }
    }

    /// The point in a slot.
    #[inline]
    pub(super) fn at(&self, slot: usize) -> [f32; 3] {
        [self.axes[0][slot], self.axes[1][slot], self.axes[2][slot]]
    }

    /// The `k` points nearest to `q`, nearest first, ties by index: `found` becomes (squared distance, index). Fewer where there
    /// are fewer; points that are not finite are never found.
    pub fn nearest(&self, q: [f32; 3], k: usize, found: &mut Vec<(f32, u32)>) {
        found.clear();
        if k > 0 && !self.nodes.is_empty() {
            search(self, q, k, None, found);
        }
    }

    /// The `k` nearest other points of the points `of`, each of which is there once: `[of][k]`, nearest first, ties by index;
    /// filled up with the point itself.
    pub fn nearest_to(&self, of: &[u32], k: usize) -> Array2<u32> {
        const NONE: u32 = u32::MAX;
        let mut row_of = vec![NONE; self.index.len()];
        of.iter().enumerate().for_each(|(row, &i)| row_of[i as usize] = row as u32);
        // In slot order, so that one query's leaves are still in the cache for the next.
        let slots: Vec<u32> =
            (0..self.index.len() as u32).filter(|&s| row_of[self.index[s as usize] as usize] != NONE).collect();
        let mut by_slot = vec![0u32; of.len() * k];
        by_slot.par_chunks_mut((CHUNK * k).max(1)).zip(slots.par_chunks(CHUNK)).for_each(|(rows, slots)| {
            let mut found = Vec::with_capacity(k + 1);
            for (row, &slot) in rows.chunks_exact_mut(k).zip(slots) {
                let i = self.index[slot as usize];
                search(self, self.at(slot as usize), k, Some(i), &mut found);
                row.fill(i);
                row.iter_mut().zip(&found).for_each(|(o, &(_, index))| *o = index);
            }
        });
        let mut out = vec![0u32; by_slot.len()];
        for (row, &slot) in by_slot.chunks_exact(k.max(1)).zip(&slots) {
            let at = row_of[self.index[slot as usize] as usize] as usize;
            out[at * k..(at + 1) * k].copy_from_slice(row);
        }
        Array2::from_shape_vec((of.len(), k), out).expect("k of each")
    }

    /// The same for every point, `[points][k]`.
    pub fn all_nearest(&self, k: usize) -> Array2<u32> {
        self.nearest_to(&(0..self.index.len() as u32).collect::<Vec<u32>>(), k)
    }
}

/// The `k` > 0 points nearest to `q` in a tree that is not empty, nearest first, ties by index, without the point `except`:
/// `found` becomes (squared distance, index).
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn search(tree: &KdTree, q: [f32; 3], k: usize, except: Option<u32>, found: &mut Vec<(f32, u32)>) {
    found.clear();
    // Preorder of a balanced tree: the stack holds one node per level.
    let mut stack = [(0.0f32, 0u32); 64];
    let mut depth = 1;
    let mut worst = (f32::INFINITY, u32::MAX);
    while depth > 0 {
        depth -= 1;
        let (box_distance, mut id) = stack[depth];
        if (box_distance, tree.nodes[id as usize].min_index) > worst {
            continue;
        }
        loop {
            let node = &tree.nodes[id as usize];
            if node.right == 0 {
                scan(tree, node, q, k, except, found, &mut worst);
                break;
            }
            let (left, right) = (id + 1, node.right);
            let (l, r) = (&tree.nodes[left as usize], &tree.nodes[right as usize]);
            let (dl, dr) = (l.distance(q), r.distance(q));
            let left_first = (dl, l.min_index) < (dr, r.min_index);
            let (near, far, d_far) = if left_first { (left, right, dr) } else { (right, left, dl) };
            if (d_far, tree.nodes[far as usize].min_index) <= worst {
                stack[depth] = (d_far, far);
                depth += 1;
            }
            id = near;
        }
    }
}

/// Takes a leaf's points into `found`. `worst` is the last that a better one may push out, or infinity while there is room.
#[inline(always)]
fn scan(
    tree: &KdTree,
    node: &Node,
    q: [f32; 3],
    k: usize,
    except: Option<u32>,
    found: &mut Vec<(f32, u32)>,
    worst: &mut (f32, u32),
) {
    let (start, end) = (node.start as usize, node.end as usize);
    let mut distances = [0.0f32; LEAF];
    let distances = &mut distances[..end - start];
    let [x, y, z] = [0, 1, 2].map(|a| &tree.axes[a][start..end]);
    for (((d, &x), &y), &z) in distances.iter_mut().zip(x).zip(y).zip(z) {
        *d = distance(q, [x, y, z]);
    }
    for (&d, &i) in distances.iter().zip(&tree.index[start..end]) {
        // What is no number is no neighbour.
        if d > worst.0 || (d, i) > *worst || Some(i) == except || d.is_nan() {
            continue;
        }
        if found.len() == k {
            found.pop();
        }
        // From the end: most that come in do so near it.
        let mut at = found.len();
        while at > 0 && found[at - 1] > (d, i) {
            at -= 1;
        }
        found.insert(at, (d, i));
        if found.len() == k {
            *worst = found[k - 1];
        }
    }
}

#[derive(Debug, Clone, Copy)]
struct Item {
    p: [f32; 3],
    index: u32,
}

/// Builds the subtree over `items` into `nodes`; `first_slot` and `first_node` are where the two begin in the tree.
fn build(items: &mut [Item], nodes: &mut [Node], first_slot: usize, first_node: usize) {
    let (mut lo, mut hi, mut min_index) = ([f32::INFINITY; 3], [f32::NEG_INFINITY; 3], u32::MAX);
    for item in items.iter() {
        for a in 0..3 {
            lo[a] = if item.p[a] < lo[a] { item.p[a] } else { lo[a] };
            hi[a] = if item.p[a] > hi[a] { item.p[a] } else { hi[a] };
        }
        min_index = min_index.min(item.index);
    }
    let n = items.len();
    let mut node = Node { lo, hi, start: first_slot as u32, end: (first_slot + n) as u32, min_index, right: 0 };
    if n <= LEAF {
        items.sort_unstable_by_key(|item| item.index);
        nodes[0] = node;
        return;
    }
    let axis = (0..3).fold(0, |best, a| if hi[a] - lo[a] > hi[best] - lo[best] { a } else { best });
    // The index breaks ties, so the tree is one and the same however often it is built.
    let middle = left_count(n);
    items.select_nth_unstable_by(middle, |a, b| a.p[axis].total_cmp(&b.p[axis]).then(a.index.cmp(&b.index)));
    let left_nodes = node_count(middle);
    node.right = (first_node + 1 + left_nodes) as u32;
    nodes[0] = node;
    let (left, right) = items.split_at_mut(middle);
    let (left_tree, right_tree) = nodes[1..].split_at_mut(left_nodes);
    let mut build_left = || build(left, left_tree, first_slot, first_node + 1);
    let mut build_right = || build(right, right_tree, first_slot + middle, first_node + 1 + left_nodes);
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
    use crate::points::testing::points;
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
            tree.nearest(q, k, &mut found);
            prop_assert_eq!(&found, &brute(&p, q, k, None));
            let all = tree.all_nearest(k);
            for (i, row) in all.rows().into_iter().enumerate() {
                let mut want: Vec<u32> = brute(&p, p[i], k, Some(i as u32)).iter().map(|f| f.1).collect();
                want.resize(k, i as u32);
                prop_assert_eq!(row.to_vec(), want);
            }
        }
    }

    #[test]
    fn coinciding_points_cost_no_more_than_others() {
        // A tree that compares them all with each other needs 4e10 distances here.
        let tree = KdTree::new(&vec![[1.0, 2.0, 3.0]; 200_000]);
        let all = tree.all_nearest(3);
        assert_eq!([0, 1, 150_000].map(|i| all.row(i).to_vec()), [[1, 2, 3], [0, 2, 3], [0, 1, 2]]);
    }
}
