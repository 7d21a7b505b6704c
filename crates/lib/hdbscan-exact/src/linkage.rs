//! Edges, union-find, and spanning forests of given graphs.

use rayon::prelude::*;
use std::cmp::Ordering;

/// An edge between two points.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Edge {
    /// The smaller index.
    pub a: u32,
    /// The larger index.
    pub b: u32,
    /// Distance; not NaN, not negative, infinite where parts of a graph are joined.
    pub weight: f64,
}

impl Edge {
    /// An edge with its ends in order.
    pub fn new(a: u32, b: u32, weight: f64) -> Self {
        Self { a: a.min(b), b: a.max(b), weight }
    }

    /// The one total order: weight, then smaller index, then larger index.
    pub fn order(&self, other: &Self) -> Ordering {
        self.weight.total_cmp(&other.weight).then(self.a.cmp(&other.a)).then(self.b.cmp(&other.b))
    }
}

/// Sets of points that only grow together.
pub(crate) struct UnionFind {
    parent: Vec<u32>,
}

impl UnionFind {
    pub fn new(n: usize) -> Self {
        Self { parent: (0..n as u32).collect() }
    }

    pub fn find(&mut self, mut i: u32) -> u32 {
        while self.parent[i as usize] != i {
            let up = self.parent[self.parent[i as usize] as usize];
            self.parent[i as usize] = up;
            i = up;
        }
        i
    }

    /// The root of a set, for many readers at a time.
    pub fn root(&self, mut i: u32) -> u32 {
        while self.parent[i as usize] != i {
            i = self.parent[i as usize];
        }
        i
    }

    /// Joins two sets under the smaller root; false when they are one already.
    pub fn join(&mut self, a: u32, b: u32) -> bool {
        let (a, b) = (self.find(a), self.find(b));
        if a == b {
            return false;
        }
        self.parent[a.max(b) as usize] = a.min(b);
        true
    }
}

/// The minimum spanning tree of a graph over `n` points (Kruskal), n - 1 edges in ascending order; parts that are not
/// connected are joined, lowest index first, by edges of infinite weight.
pub(crate) fn spanning_forest(n: usize, edges: impl Into<Vec<Edge>>) -> Vec<Edge> {
    let mut sorted: Vec<Edge> = edges.into();
    assert!(sorted.par_iter().all(|e| (e.b as usize) < n && e.weight >= 0.0), "edges lie within the points");
    sorted.par_sort_unstable_by(Edge::order);
    let mut sets = UnionFind::new(n);
    let mut out = Vec::with_capacity(n.saturating_sub(1));
    out.extend(sorted.into_iter().filter(|e| sets.join(e.a, e.b)));
    for i in 1..n as u32 {
        if sets.join(0, i) {
            out.push(Edge::new(0, i, f64::INFINITY));
        }
    }
    out
}
