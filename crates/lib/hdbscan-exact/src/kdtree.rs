//! A kd-tree in any dimension, and walks over it for a group of points at a time. docs/architecture.md says which tree of
//! the workspace is for what.
//!
//! Decisions are made in f64. What may be skipped is decided in f32, many points at a time, against limits raised by more
//! than f32 can be wrong ([`rough_limit`]): nothing that matters is ever skipped.

use rayon::prelude::*;
use std::cmp::Ordering;

/// Points of a leaf, at most.
pub(crate) const LEAF: usize = 16;
/// Coordinates of boxes are padded to a multiple of this.
const LANES: usize = 8;
/// Core distances count this many times what coordinates do when it is decided what to split by (measured).
const CORE_AXIS: f64 = 1.0;
/// Subtrees smaller than this are built by one thread.
const PARALLEL_BUILD: usize = 8192;

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

/// Squared distances in f32 beyond this are surely beyond `limit` in truth. A sum of up to 64 squares of differences, in any
/// order, is off by less than 70 roundings of 6e-8 each; below the normal numbers by less than 1e-37. One that overflowed is
/// beyond every limit that does not overflow with it.
#[inline(always)]
pub(crate) fn rough_limit(limit: f64) -> f32 {
    ((limit + 1e-37) * (1.0 + 2e-5)) as f32
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
        Self::by_density(points, dim, &[])
    }

    /// A tree that also separates dense and scattered points: where `core` (one for each point) tells how far apart they are, it
    /// is split by like another coordinate. Then few scattered points do not make the boxes of many dense ones wide, and
    /// nodes are alike in core distance and in component.
    pub fn by_density(points: &[f32], dim: usize, core: &[f64]) -> Self {
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
            build(points, dim, core, part);
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

    /// The leaves below a node, in tree order.
    pub fn leaves(&self, root: u32) -> impl Iterator<Item = u32> + use<'_> {
        // A subtree's nodes follow its root, as its points follow each other.
        let end = self.nodes.get(root as usize).map_or(0, |n| n.end);
        (root..self.nodes.len() as u32)
            .take_while(move |&i| self.nodes[i as usize].start < end)
            .filter(|&i| self.nodes[i as usize].right == 0)
    }

    /// Lower and upper corner of a node's box, padded.
    #[inline(always)]
    fn box_of(&self, node: u32) -> (&[f32], &[f32]) {
        self.boxes[node as usize * 2 * self.padded..][..2 * self.padded].split_at(self.padded)
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

/// How far apart the core distances of points are; 0 where none are known.
fn core_range(core: &[f64], order: &[u32]) -> f64 {
    if core.is_empty() {
        return 0.0;
    }
    let (low, high) =
        order.iter().map(|&i| core[i as usize]).fold((f64::INFINITY, 0.0f64), |(l, h), c| (l.min(c), h.max(c)));
    high - low
}

fn build(points: &[f32], dim: usize, core: &[f64], part: Part<'_>) {
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
    let extent = f64::from(high[axis]) - f64::from(low[axis]);
    if core_range(core, order) * CORE_AXIS > extent {
        order.select_nth_unstable_by(middle, |&a, &b| core[a as usize].total_cmp(&core[b as usize]).then(a.cmp(&b)));
    } else {
        let key = |i: u32| points[i as usize * dim + axis];
        order.select_nth_unstable_by(middle, |&a, &b| key(a).total_cmp(&key(b)).then(a.cmp(&b)));
    }
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
        rayon::join(|| build(points, dim, core, left), || build(points, dim, core, right));
    } else {
        build(points, dim, core, left);
        build(points, dim, core, right);
    }
}

/// Up to [`LEAF`] points that walk over a tree together, theirs or another of the same dimension.
#[derive(Default)]
pub(crate) struct Group {
    /// Their places in the tree that they were gathered from.
    pub places: Vec<u32>,
    /// Their coordinates, `[places][dim]`.
    points: Vec<f32>,
    /// Their coordinates, `[dim][LEAF]`; lanes without a point repeat the first one.
    lanes: Vec<f32>,
    /// Lower and upper corner of the box around them, padded as those of nodes.
    low: Vec<f32>,
    high: Vec<f32>,
    /// Nodes still to visit, with their squared distances in f32.
    stack: Vec<(f32, u32)>,
}

/// What a walk does at the nodes that it reaches.
pub(crate) trait Visitor {
    /// Whether a node may hold something of interest at all.
    fn wants(&self, node: u32) -> bool;
    /// The squared distance in f32 beyond which nothing is of interest to any point of the group.
    fn reach(&self) -> f32;
    /// Whether any point reaches as far as its squared distance, `[LEAF]`.
    fn reaches(&self, distances: &[f32; LEAF]) -> bool;
    /// Looks at a leaf.
    fn leaf(&mut self, group: &Group, node: u32);
}

impl Group {
    /// Takes other points. `places` has at least one and at most [`LEAF`].
    #[inline(always)]
    pub fn gather(&mut self, tree: &KdTree, places: impl Iterator<Item = u32>) {
        self.places.clear();
        self.places.extend(places);
        self.points.clear();
        for &at in &self.places {
            self.points.extend(tree.point(at as usize));
        }
        self.lanes.resize(tree.dim * LEAF, 0.0);
        self.low.clear();
        self.low.extend(tree.point(self.places[0] as usize));
        self.high.clear();
        self.high.extend_from_slice(&self.low);
        for k in 0..tree.dim {
            let row = &mut self.lanes[k * LEAF..(k + 1) * LEAF];
            row.fill(self.low[k]);
            for (r, point) in row.iter_mut().zip(self.points.chunks_exact(tree.dim)) {
                *r = point[k];
            }
            for &v in row.iter() {
                self.low[k] = if v < self.low[k] { v } else { self.low[k] };
                self.high[k] = if v > self.high[k] { v } else { self.high[k] };
            }
        }
        self.low.resize(tree.padded, 0.0);
        self.high.resize(tree.padded, 0.0);
    }

    /// The coordinates of one of the points.
    #[inline(always)]
    pub fn point(&self, lane: usize, dim: usize) -> &[f32] {
        &self.points[lane * dim..(lane + 1) * dim]
    }

    /// Squared distance in f32 between the box around the points and that of a node.
    #[inline(always)]
    fn to_node(&self, tree: &KdTree, node: u32) -> f32 {
        let (low, high) = tree.box_of(node);
        let mut sums = [0.0f32; LANES];
        for (at, (low, high)) in low.chunks_exact(LANES).zip(high.chunks_exact(LANES)).enumerate() {
            let own = at * LANES..(at + 1) * LANES;
            let (own_low, own_high) = (&self.low[own.clone()], &self.high[own]);
            for l in 0..LANES {
                let (below, above) = (low[l] - own_high[l], own_low[l] - high[l]);
                let d = if below > above { below } else { above };
                let d = if d > 0.0 { d } else { 0.0 };
                sums[l] += d * d;
            }
        }
        ((sums[0] + sums[4]) + (sums[1] + sums[5])) + ((sums[2] + sums[6]) + (sums[3] + sums[7]))
    }

    /// Squared distances in f32 of the points to the box of a node, [`LEAF`] of them.
    #[inline(always)]
    pub fn each_to_node(&self, tree: &KdTree, node: u32) -> [f32; LEAF] {
        let (low, high) = tree.box_of(node);
        let mut out = [0.0f32; LEAF];
        for ((row, &low), &high) in self.lanes.chunks_exact(LEAF).zip(low).zip(high) {
            for (o, &v) in out.iter_mut().zip(row) {
                let (below, above) = (low - v, v - high);
                let d = if below > above { below } else { above };
                let d = if d > 0.0 { d } else { 0.0 };
                *o += d * d;
            }
        }
        out
    }

    /// Shows the visitor all leaves below `root` that are within reach of the group, near ones first.
    #[inline(always)]
    pub fn walk(&mut self, tree: &KdTree, root: u32, visitor: &mut impl Visitor) {
        let mut stack = std::mem::take(&mut self.stack);
        stack.clear();
        stack.push((0.0, root));
        while let Some((bound, node)) = stack.pop() {
            if bound > visitor.reach() || !visitor.wants(node) {
                continue;
            }
            let n = &tree.nodes[node as usize];
            if n.right == 0 {
                visitor.leaf(self, node);
                continue;
            }
            // The box around the points may be near although none of them is.
            if !visitor.reaches(&self.each_to_node(tree, node)) {
                continue;
            }
            // The nearer child is looked at first.
            let (left, right) = ((self.to_node(tree, node + 1), node + 1), (self.to_node(tree, n.right), n.right));
            let (near, far) = if left.0 <= right.0 { (left, right) } else { (right, left) };
            let reach = visitor.reach();
            for child in [far, near] {
                if child.0 <= reach {
                    stack.push(child);
                }
            }
        }
        self.stack = stack;
    }
}
