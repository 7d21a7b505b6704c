//! A kd-tree, and core distances from it.

use rayon::prelude::*;
use std::cmp::Ordering;

/// Points of a leaf.
const LEAF: usize = 16;

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

#[derive(Debug, Clone, Copy)]
pub(crate) struct Node {
    /// Range of the node's points in tree order.
    pub start: u32,
    pub end: u32,
    /// The right child; the left child follows its parent. 0 for a leaf.
    pub right: u32,
}

/// A kd-tree over distinct points.
pub(crate) struct KdTree {
    pub dim: usize,
    pub nodes: Vec<Node>,
    /// Bounding box of each node: lower corner, upper corner, `[nodes][2][dim]`.
    boxes: Vec<f32>,
    /// Original index of each point in tree order.
    pub order: Vec<u32>,
    /// Coordinates in tree order.
    pub coords: Vec<f32>,
}

impl KdTree {
    pub fn new(points: &[f32], dim: usize) -> Self {
        let n = points.len() / dim;
        let mut tree =
            Self { dim, nodes: Vec::new(), boxes: Vec::new(), order: (0..n as u32).collect(), coords: Vec::new() };
        let mut order = std::mem::take(&mut tree.order);
        if n > 0 {
            tree.build(points, &mut order, 0);
        }
        tree.coords = order.iter().flat_map(|&i| &points[i as usize * dim..(i as usize + 1) * dim]).copied().collect();
        tree.order = order;
        tree
    }

    fn build(&mut self, points: &[f32], order: &mut [u32], start: usize) {
        let dim = self.dim;
        let (mut low, mut high) = (vec![f32::INFINITY; dim], vec![f32::NEG_INFINITY; dim]);
        for &i in order.iter() {
            for (k, &v) in points[i as usize * dim..(i as usize + 1) * dim].iter().enumerate() {
                low[k] = low[k].min(v);
                high[k] = high[k].max(v);
            }
        }
        let at = self.nodes.len();
        self.nodes.push(Node { start: start as u32, end: (start + order.len()) as u32, right: 0 });
        let axis =
            (0..dim).max_by(|&a, &b| (high[a] - low[a]).total_cmp(&(high[b] - low[b])).then(b.cmp(&a))).unwrap_or(0);
        self.boxes.extend(low.iter().chain(&high));
        if order.len() <= LEAF {
            return;
        }
        let middle = order.len() / 2;
        let key = |i: u32| points[i as usize * dim + axis];
        order.select_nth_unstable_by(middle, |&a, &b| key(a).total_cmp(&key(b)).then(a.cmp(&b)));
        let (left, right) = order.split_at_mut(middle);
        self.build(points, left, start);
        self.nodes[at].right = self.nodes.len() as u32;
        self.build(points, right, start + middle);
    }

    /// Squared distance from a point to a node's box. Never more than [`squared`] of a point inside gives: every step
    /// (difference, square, sum in the same order) is rounded from a smaller or equal value, and rounding is monotone.
    #[inline]
    pub fn distance_to(&self, node: usize, p: &[f32]) -> f64 {
        let b = &self.boxes[node * 2 * self.dim..(node + 1) * 2 * self.dim];
        let (low, high) = b.split_at(self.dim);
        let mut sum = 0.0f64;
        for k in 0..self.dim {
            let v = f64::from(p[k]);
            let d = (f64::from(low[k]) - v).max(v - f64::from(high[k])).max(0.0);
            sum += d * d;
        }
        sum
    }

    #[inline]
    pub fn point(&self, at: usize) -> &[f32] {
        &self.coords[at * self.dim..(at + 1) * self.dim]
    }
}

/// Core distance of each distinct point: the distance within which `min_samples` points lie, itself and its duplicates
/// counted. The distance to the farthest point where there are fewer.
pub(crate) fn core_distances_of(unique: &Unique, dim: usize, min_samples: usize) -> Vec<f64> {
    let tree = KdTree::new(&unique.points, dim);
    let m = unique.weights.len();
    let mut core = vec![0.0; m];
    // Queries in tree order touch the same nodes one after the other.
    let found: Vec<f64> = (0..m)
        .into_par_iter()
        .with_min_len(128)
        .map_init(
            || (Vec::new(), Vec::new()),
            |(best, stack), at| core_of(&tree, &unique.weights, at, min_samples, best, stack),
        )
        .collect();
    for (at, c) in found.into_iter().enumerate() {
        core[tree.order[at] as usize] = c.sqrt();
    }
    core
}

/// Core distances of points `[n][dim]`; see [`crate::Options::min_samples`].
pub fn core_distances(points: &[f32], dim: usize, min_samples: usize) -> Vec<f64> {
    let unique = Unique::new(points, dim);
    let core = core_distances_of(&unique, dim, min_samples);
    unique.of_point.iter().map(|&u| core[u as usize]).collect()
}

fn core_of(
    tree: &KdTree,
    weights: &[u32],
    at: usize,
    min_samples: usize,
    best: &mut Vec<(f64, u32)>,
    stack: &mut Vec<(f64, u32)>,
) -> f64 {
    let p = tree.point(at);
    // Squared distances with weights, ascending, just enough of them to hold min_samples points.
    best.clear();
    let mut held = 0u64;
    stack.clear();
    stack.push((0.0, 0));
    while let Some((bound, node)) = stack.pop() {
        let full = held >= min_samples as u64;
        if full && best.last().is_some_and(|b| bound > b.0) {
            continue;
        }
        let n = tree.nodes[node as usize];
        if n.right == 0 {
            for q in n.start..n.end {
                let d = squared(p, tree.point(q as usize));
                if held >= min_samples as u64 && best.last().is_some_and(|b| d >= b.0) {
                    continue;
                }
                let w = weights[tree.order[q as usize] as usize];
                let to = best.partition_point(|b| b.0 <= d);
                best.insert(to, (d, w));
                held += u64::from(w);
                while let Some(last) = best.last() {
                    if held - u64::from(last.1) < min_samples as u64 {
                        break;
                    }
                    held -= u64::from(last.1);
                    best.pop();
                }
            }
        } else {
            let (left, right) = (node + 1, n.right);
            let (l, r) = (tree.distance_to(left as usize, p), tree.distance_to(right as usize, p));
            // The nearer child is looked at first.
            if l <= r {
                stack.push((r, right));
                stack.push((l, left));
            } else {
                stack.push((l, left));
                stack.push((r, right));
            }
        }
    }
    best.last().map_or(0.0, |b| b.0)
}
