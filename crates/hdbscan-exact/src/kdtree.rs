//! A kd-tree, and core distances from it.
//!
//! What decides is computed in f64. What only tells whether something need be looked at is computed in f32, many points at
//! a time, and lowered by more than f32 can be wrong ([`surely`]): nothing that matters is ever passed over.

use multiversion::multiversion;
use rayon::prelude::*;
use std::cmp::Ordering;

/// Points of a leaf, at most.
pub(crate) const LEAF: usize = 16;
/// Coordinates of boxes are padded to a multiple of this.
const LANES: usize = 8;
/// Subtrees smaller than this are built by one thread.
const PARALLEL_BUILD: usize = 8192;
/// Most neighbours that are remembered of a point.
const MOST_NEIGHBOURS: usize = 32;
/// No neighbour.
pub(crate) const NONE: u32 = u32::MAX;

/// Points without duplicates, numbered in the lexicographic order of their coordinates: where edges of equal weight are
/// ordered by these numbers, the result does not depend on the order in which the caller names the points.
pub(crate) struct Unique {
    /// Coordinates of the distinct points, `[m][dim]`.
    pub points: Vec<f32>,
    /// How many points each stands for.
    pub weights: Vec<u32>,
    /// The distinct point of every original point.
    pub of_point: Vec<u32>,
}

impl Unique {
    pub fn new(points: &[f32], dim: usize) -> Self {
        let n = points.len() / dim;
        let row = |i: u32| &points[i as usize * dim..(i as usize + 1) * dim];
        // Adding zero turns -0 into 0, which are the same place.
        let compare = |a: u32, b: u32| {
            let by_value = row(a).iter().zip(row(b)).map(|(x, y)| (x + 0.0).total_cmp(&(y + 0.0)));
            by_value.fold(Ordering::Equal, Ordering::then)
        };
        let mut order: Vec<u32> = (0..n as u32).collect();
        order.par_sort_unstable_by(|&a, &b| compare(a, b).then(a.cmp(&b)));
        let mut out = Self { points: Vec::new(), weights: Vec::new(), of_point: vec![0; n] };
        for (at, &i) in order.iter().enumerate() {
            if at == 0 || compare(order[at - 1], i).is_ne() {
                out.points.extend(row(i));
                out.weights.push(0);
            }
            let last = out.weights.len() - 1;
            out.weights[last] += 1;
            out.of_point[i as usize] = last as u32;
        }
        out
    }
}

/// Squared Euclidean distance in f64, summed in the order of the coordinates.
#[inline]
pub(crate) fn squared(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(x, y)| (f64::from(*x) - f64::from(*y)).powi(2)).sum()
}

/// A squared distance that the one computed in f32 cannot be below. A sum of up to 64 squares of differences, in any order,
/// is off by less than 70 roundings of 6e-8 each; below the normal numbers by less than 1e-37. What overflowed tells
/// nothing.
#[inline(always)]
pub(crate) fn surely(distance: f32) -> f64 {
    if distance < f32::INFINITY { f64::from(distance) * (1.0 - 1e-5) - 1e-37 } else { 0.0 }
}

#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Node {
    /// Range of the node's points in tree order.
    pub start: u32,
    pub end: u32,
    /// The right child; the left child follows its parent. 0 for a leaf.
    pub right: u32,
    /// Where a leaf's points lie among the leaves' blocks.
    block: u32,
}

/// A kd-tree over distinct points.
pub(crate) struct KdTree {
    pub dim: usize,
    pub nodes: Vec<Node>,
    /// Original index of each point in tree order.
    pub order: Vec<u32>,
    /// Coordinates in tree order, `[n][dim]`.
    pub coords: Vec<f32>,
    /// `dim` rounded up to whole lanes.
    padded: usize,
    /// Bounding box of each node: lower corner, upper corner, `[nodes][2][padded]`; infinite in the padding.
    boxes: Vec<f32>,
    /// The points of each leaf coordinate by coordinate, `[leaves][dim][LEAF]`.
    blocks: Vec<f32>,
}

/// Nodes and leaves of a tree over `n` points.
fn counts(n: usize) -> (usize, usize) {
    if n <= LEAF {
        return (1, 1);
    }
    let (l, r) = (counts(n / 2), counts(n - n / 2));
    (1 + l.0 + r.0, l.1 + r.1)
}

/// What of the tree a subtree fills, and where it begins in the whole.
struct Part<'a> {
    order: &'a mut [u32],
    nodes: &'a mut [Node],
    boxes: &'a mut [f32],
    first: [usize; 3],
}

impl KdTree {
    pub fn new(points: &[f32], dim: usize) -> Self {
        let n = points.len() / dim;
        let padded = dim.next_multiple_of(LANES);
        let (nodes, leaves) = if n == 0 { (0, 0) } else { counts(n) };
        let mut order: Vec<u32> = (0..n as u32).collect();
        let mut tree = Self {
            dim,
            nodes: vec![Node::default(); nodes],
            order: Vec::new(),
            coords: Vec::new(),
            padded,
            boxes: vec![0.0; nodes * 2 * padded],
            blocks: vec![f32::INFINITY; leaves * dim * LEAF],
        };
        if n > 0 {
            let part = Part { order: &mut order, nodes: &mut tree.nodes, boxes: &mut tree.boxes, first: [0, 0, 0] };
            build(points, dim, part);
        }
        tree.coords = order.iter().flat_map(|&i| &points[i as usize * dim..(i as usize + 1) * dim]).copied().collect();
        for node in tree.nodes.iter().filter(|n| n.right == 0) {
            let block = &mut tree.blocks[node.block as usize * dim * LEAF..][..dim * LEAF];
            for (lane, at) in (node.start..node.end).enumerate() {
                for k in 0..dim {
                    block[k * LEAF + lane] = tree.coords[at as usize * dim + k];
                }
            }
        }
        tree.order = order;
        tree
    }

    #[inline(always)]
    pub fn point(&self, at: usize) -> &[f32] {
        &self.coords[at * self.dim..(at + 1) * self.dim]
    }

    /// The point at a place with zeros up to whole lanes, as [`Self::to_box`] wants it.
    #[inline(always)]
    pub fn pad(&self, at: usize, into: &mut Vec<f32>) {
        into.clear();
        into.extend(self.point(at));
        into.resize(self.padded, 0.0);
    }

    /// Squared distance in f32 from a padded point to a node's box.
    #[inline(always)]
    pub fn to_box(&self, node: u32, p: &[f32]) -> f32 {
        let (low, high) = self.boxes[node as usize * 2 * self.padded..][..2 * self.padded].split_at(self.padded);
        let mut sums = [0.0f32; LANES];
        for ((p, low), high) in p.chunks_exact(LANES).zip(low.chunks_exact(LANES)).zip(high.chunks_exact(LANES)) {
            for l in 0..LANES {
                let (below, above) = (low[l] - p[l], p[l] - high[l]);
                let d = if below > above { below } else { above };
                let d = if d > 0.0 { d } else { 0.0 };
                sums[l] += d * d;
            }
        }
        ((sums[0] + sums[4]) + (sums[1] + sums[5])) + ((sums[2] + sums[6]) + (sums[3] + sums[7]))
    }

    /// Squared distances in f32 from a point to those of a leaf; infinite beyond them.
    #[inline(always)]
    pub fn to_leaf(&self, node: &Node, p: &[f32]) -> [f32; LEAF] {
        let block = &self.blocks[node.block as usize * self.dim * LEAF..][..self.dim * LEAF];
        let mut out = [0.0f32; LEAF];
        for (row, &v) in block.chunks_exact(LEAF).zip(p) {
            for (o, &c) in out.iter_mut().zip(row) {
                *o += (c - v) * (c - v);
            }
        }
        out
    }
}

fn build(points: &[f32], dim: usize, part: Part<'_>) {
    let Part { order, nodes, boxes, first: [first_slot, first_node, first_leaf] } = part;
    let padded = dim.next_multiple_of(LANES);
    let (own_box, rest_boxes) = boxes.split_at_mut(2 * padded);
    let (low, high) = own_box.split_at_mut(padded);
    // Beyond the coordinates a box reaches everywhere.
    low[dim..].fill(f32::NEG_INFINITY);
    high[dim..].fill(f32::INFINITY);
    low[..dim].fill(f32::INFINITY);
    high[..dim].fill(f32::NEG_INFINITY);
    for &i in order.iter() {
        for (k, &v) in points[i as usize * dim..(i as usize + 1) * dim].iter().enumerate() {
            low[k] = if v < low[k] { v } else { low[k] };
            high[k] = if v > high[k] { v } else { high[k] };
        }
    }
    let n = order.len();
    nodes[0] = Node { start: first_slot as u32, end: (first_slot + n) as u32, right: 0, block: first_leaf as u32 };
    if n <= LEAF {
        return;
    }
    let axis = (0..dim).max_by(|&a, &b| (high[a] - low[a]).total_cmp(&(high[b] - low[b])).then(b.cmp(&a))).unwrap_or(0);
    let middle = n / 2;
    let key = |i: u32| points[i as usize * dim + axis];
    order.select_nth_unstable_by(middle, |&a, &b| key(a).total_cmp(&key(b)).then(a.cmp(&b)));
    let (left_nodes, left_leaves) = counts(middle);
    nodes[0].right = (first_node + 1 + left_nodes) as u32;
    let (left, right) = order.split_at_mut(middle);
    let (left_tree, right_tree) = nodes[1..].split_at_mut(left_nodes);
    let (left_boxes, right_boxes) = rest_boxes.split_at_mut(left_nodes * 2 * padded);
    let left =
        Part { order: left, nodes: left_tree, boxes: left_boxes, first: [first_slot, first_node + 1, first_leaf] };
    let right = Part {
        order: right,
        nodes: right_tree,
        boxes: right_boxes,
        first: [first_slot + middle, first_node + 1 + left_nodes, first_leaf + left_leaves],
    };
    if n >= PARALLEL_BUILD {
        rayon::join(|| build(points, dim, left), || build(points, dim, right));
    } else {
        build(points, dim, left);
        build(points, dim, right);
    }
}

/// What the search for core distances finds, in tree order.
pub(crate) struct Neighbours {
    /// Core distance of each point: the distance within which `min_samples` points lie, itself and its duplicates counted.
    /// The distance to the farthest point where there are fewer.
    pub core: Vec<f64>,
    /// Points within the core distance, as places in the tree, `[n][kept]`; [`NONE`] where there are fewer.
    pub near: Vec<u32>,
    /// Places of a row in `near`.
    pub kept: usize,
    /// Whether `near` names every other point within the core distance.
    pub complete: Vec<bool>,
}

/// Core distances and nearest neighbours of the tree's points; `weights` are how many points each stands for.
pub(crate) fn neighbours(tree: &KdTree, weights: &[u32], min_samples: usize) -> Neighbours {
    let n = tree.order.len();
    let kept = min_samples.saturating_sub(1).clamp(1, MOST_NEIGHBOURS);
    let weights: Vec<u32> = tree.order.iter().map(|&i| weights[i as usize]).collect();
    let mut near = vec![NONE; n * kept];
    // Queries in tree order touch the same nodes one after the other.
    let found: Vec<(f64, bool)> = near
        .par_chunks_mut(kept)
        .enumerate()
        .with_min_len(128)
        .map_init(Scratch::default, |scratch, (at, row)| {
            let (core, all) = search(tree, &weights, at, min_samples, scratch);
            let others = scratch.best.iter().filter(|b| b.1 != at as u32);
            let fits = scratch.best.len() <= kept + 1;
            row.iter_mut().zip(others).for_each(|(r, b)| *r = b.1);
            (core.sqrt(), all && fits)
        })
        .collect();
    let (core, complete) = found.into_iter().unzip();
    Neighbours { core, near, kept, complete }
}

/// Core distances of points `[n][dim]`; see [`crate::Options::min_samples`].
pub fn core_distances(points: &[f32], dim: usize, min_samples: usize) -> Vec<f64> {
    let unique = Unique::new(points, dim);
    let tree = KdTree::new(&unique.points, dim);
    let found = neighbours(&tree, &unique.weights, min_samples);
    let mut core = vec![0.0; unique.weights.len()];
    for (&i, c) in tree.order.iter().zip(found.core) {
        core[i as usize] = c;
    }
    unique.of_point.iter().map(|&u| core[u as usize]).collect()
}

#[derive(Default)]
struct Scratch {
    /// Squared distances with places, ascending, just enough of them to hold min_samples points.
    best: Vec<(f64, u32)>,
    stack: Vec<(f64, u32)>,
    padded: Vec<f32>,
}

/// The squared core distance of the point at a place, and whether `best` holds all points within it.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn search(tree: &KdTree, weights: &[u32], at: usize, min_samples: usize, scratch: &mut Scratch) -> (f64, bool) {
    let Scratch { best, stack, padded } = scratch;
    let p = tree.point(at);
    tree.pad(at, padded);
    let wanted = min_samples as u64;
    best.clear();
    let mut held = 0u64;
    // The distance that a point must not exceed to matter, and the least of those that had to go.
    let (mut limit, mut gone) = (f64::INFINITY, f64::INFINITY);
    stack.clear();
    stack.push((0.0, 0));
    while let Some((bound, node)) = stack.pop() {
        if bound > limit {
            continue;
        }
        let n = &tree.nodes[node as usize];
        if n.right == 0 {
            let roughly = tree.to_leaf(n, p);
            for (q, &rough) in (n.start..n.end).zip(&roughly) {
                if surely(rough) > limit {
                    continue;
                }
                let d = squared(p, tree.point(q as usize));
                if d >= limit {
                    gone = gone.min(d);
                    continue;
                }
                let mut to = best.len();
                while to > 0 && best[to - 1].0 > d {
                    to -= 1;
                }
                best.insert(to, (d, q));
                held += u64::from(weights[q as usize]);
                while let Some(&(d, last)) = best.last() {
                    let w = u64::from(weights[last as usize]);
                    if held - w < wanted {
                        break;
                    }
                    held -= w;
                    gone = gone.min(d);
                    best.pop();
                }
                if held >= wanted {
                    limit = best.last().map_or(f64::INFINITY, |b| b.0);
                }
            }
        } else {
            let (left, right) = (node + 1, n.right);
            let (l, r) = (tree.to_box(left, padded), tree.to_box(right, padded));
            // The nearer child is looked at first.
            let (near, far) = if l <= r { ((l, left), (r, right)) } else { ((r, right), (l, left)) };
            for (d, child) in [far, near] {
                if surely(d) <= limit {
                    stack.push((surely(d), child));
                }
            }
        }
    }
    let core = best.last().map_or(0.0, |b| b.0);
    (core, gone > core)
}
