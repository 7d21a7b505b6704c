//! The frozen context graph, in the order of training.
//!
//! Anchors lie along a space-filling curve and Gaussians in the order of their nearest anchor, so that everything an
//! anchor serves lies together: sums over an anchor's Gaussians are sums over a range, no two threads ever add to the same
//! place, and what a view sees or an anchor sums is mostly close in memory too.

use artifacts::Graph;
use gs_scene::morton_order;

/// No anchor.
pub const NONE: u32 = u32::MAX;

/// The frozen graph, with Gaussians in the order of training.
#[derive(Debug, Clone)]
pub struct Context {
    /// Position in `kept` of the Gaussian at each place of the training order; n.
    pub order: Vec<u32>,
    /// Colour of each Gaussian, training order; n.
    pub colors: Vec<[f32; 3]>,
    /// Place of each anchor's Gaussian in the training order; M, in the order of the curve.
    pub anchors: Vec<u32>,
    /// The anchor whose output each Gaussian receives, or [`NONE`]; n, ascending but for those.
    pub source: Vec<u32>,
    /// How many Gaussians receive each anchor's output; M.
    pub served: Vec<u32>,
    /// Where the neighbours of each anchor begin in `neighbours`; M + 1. Padding is left out.
    pub neighbour_start: Vec<u32>,
    /// The neighbours: places in the training order.
    pub neighbours: Vec<u32>,
}

impl Context {
    /// Prepares the graph; `colors` and `positions` are those of the kept Gaussians. Without `propagate` an anchor's output
    /// goes to the anchor's own Gaussian alone.
    pub fn new(graph: &Graph, colors: &[[f32; 3]], positions: &[[f32; 3]], propagate: bool) -> Self {
        let (n, m, k) = (graph.kept.len(), graph.anchors.len(), graph.knn.ncols());
        // Anchors of the graph in the order of the curve, and the other way round.
        let at: Vec<[f32; 3]> = graph.anchors.iter().map(|&a| positions[a as usize]).collect();
        let curve = morton_order(&at);
        let rank = inverse(&curve);
        let mut group: Vec<u32> = graph.nearest_anchor.iter().map(|&a| rank[a as usize]).collect();
        for (&a, &rank) in graph.anchors.iter().zip(&rank) {
            // Its own nearest, but for another anchor at the same position.
            group[a as usize] = if propagate { group[a as usize] } else { rank };
        }
        let mut order: Vec<u32> = (0..n as u32).collect();
        order.sort_by_key(|&i| group[i as usize]);
        let place = inverse(&order);
        let anchors: Vec<u32> = curve.iter().map(|&a| place[graph.anchors[a as usize] as usize]).collect();
        let mut source = vec![NONE; n];
        if propagate {
            for (s, &i) in source.iter_mut().zip(&order) {
                *s = group[i as usize];
            }
        } else {
            for (a, &p) in anchors.iter().enumerate() {
                source[p as usize] = a as u32;
            }
        }
        let mut served = vec![0u32; m];
        for &s in source.iter().filter(|s| **s != NONE) {
            served[s as usize] += 1;
        }
        let (mut neighbour_start, mut neighbours) = (vec![0u32], Vec::with_capacity(m * k));
        for &a in &curve {
            let a = a as usize;
            // Rows are padded with the anchor itself, which is not its own neighbour.
            let others = graph.knn.row(a).into_iter().filter(|&&i| i != graph.anchors[a]);
            neighbours.extend(others.map(|&i| place[i as usize]));
            neighbour_start.push(neighbours.len() as u32);
        }
        let colors = order.iter().map(|&i| colors[i as usize]).collect();
        Self { order, colors, anchors, source, served, neighbour_start, neighbours }
    }

    #[inline]
    pub fn neighbours_of(&self, a: usize) -> &[u32] {
        &self.neighbours[self.neighbour_start[a] as usize..self.neighbour_start[a + 1] as usize]
    }

    /// Whether two places that follow each other receive the output of different anchors.
    pub fn parts(&self, before: u32, after: u32) -> bool {
        let source = self.source[before as usize];
        source != self.source[after as usize] || source == NONE
    }
}

/// The inverse of a permutation.
pub fn inverse(permutation: &[u32]) -> Vec<u32> {
    let mut out = vec![0u32; permutation.len()];
    for (to, &from) in permutation.iter().enumerate() {
        out[from as usize] = to as u32;
    }
    out
}
