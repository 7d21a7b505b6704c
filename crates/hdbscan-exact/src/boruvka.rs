//! The minimum spanning tree of mutual reachability distances, by Boruvka's algorithm on a kd-tree.
//!
//! In each round every component needs its cheapest edge to another one. A point remembers the cheapest edge it found; it
//! stays the cheapest as long as its other end is in another component. It also remembers a floor that no later edge of it
//! can be below, because components only grow. So most points are not searched again in most rounds.

use crate::kdtree::{KdTree, squared};
use crate::linkage::{Edge, UnionFind};
use rayon::prelude::*;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

/// The component of a node whose points belong to several.
const MIXED: u32 = u32::MAX;

/// Weights of the cheapest edges that components are known to have, shared by the threads of a round. They only tell what
/// need not be looked at (edges of greater weight, never equal), so the tree does not depend on who writes first. Weights
/// are not negative, so their bits order as they do.
struct Caps(Vec<AtomicU64>);

impl Caps {
    fn new(n: usize) -> Self {
        Self((0..n).map(|_| AtomicU64::new(f64::INFINITY.to_bits())).collect())
    }

    fn get(&self, component: u32) -> f64 {
        f64::from_bits(self.0[component as usize].load(Relaxed))
    }

    fn lower(&self, component: u32, weight: f64) {
        self.0[component as usize].fetch_min(weight.to_bits(), Relaxed);
    }

    fn reset(&mut self) {
        self.0.iter_mut().for_each(|c| *c.get_mut() = f64::INFINITY.to_bits());
    }
}

/// The points in tree order, with what is known of their components.
struct Search<'a> {
    tree: &'a KdTree,
    /// Core distance of each point, and the least of each node.
    core: Vec<f64>,
    least_core: Vec<f64>,
    /// Component of each point, and of each node ([`MIXED`] where there are several).
    component: Vec<u32>,
    of_node: Vec<u32>,
}

/// An edge of a point, and its other end in tree order.
type Found = Option<(Edge, u32)>;

/// The spanning tree of points `[n][dim]` under mutual reachability max(core a, core b, distance), n - 1 edges in ascending
/// order. It is the minimum one of the total order of [`Edge::order`], which is unique.
///
/// # Panics
/// When `core` does not hold a number for every point.
pub fn spanning_tree(points: &[f32], dim: usize, core: &[f64]) -> Vec<Edge> {
    assert_eq!(points.len(), core.len() * dim, "one core distance a point");
    let n = core.len();
    if n < 2 {
        return Vec::new();
    }
    let tree = KdTree::new(points, dim);
    let mut search = Search::new(&tree, core);
    let mut sets = UnionFind::new(n);
    let mut best: Vec<Found> = vec![None; n];
    let mut floor = search.core.clone();
    let mut caps = Caps::new(n);
    let mut out: Vec<Edge> = Vec::with_capacity(n - 1);
    while out.len() < n - 1 {
        // What components know already.
        caps.reset();
        for (i, known) in best.iter_mut().enumerate() {
            match known {
                Some((edge, q)) if search.component[*q as usize] != search.component[i] => {
                    caps.lower(search.component[i], edge.weight);
                }
                _ => *known = None,
            }
        }
        // Points that may know something cheaper look for it.
        best.par_iter_mut().zip(&mut floor).enumerate().with_min_len(256).for_each_init(
            Vec::new,
            |stack, (i, (known, floor))| {
                if known.is_none() && *floor <= caps.get(search.component[i]) {
                    let (found, least) = search.cheapest_edge(i, &caps, stack);
                    (*known, *floor) = (found, floor.max(least));
                }
            },
        );
        // Every component's cheapest edge joins; in one total order these edges close no cycle.
        let mut cheapest: Vec<Option<Edge>> = vec![None; n];
        for (i, known) in best.iter().enumerate() {
            if let Some((edge, _)) = known {
                keep_less(&mut cheapest[search.component[i] as usize], *edge);
            }
        }
        out.extend(cheapest.into_iter().flatten().filter(|e| sets.join(e.a, e.b)));
        search.update(&mut sets);
    }
    out.sort_unstable_by(Edge::order);
    out
}

fn keep_less(slot: &mut Option<Edge>, edge: Edge) {
    if slot.is_none_or(|old| edge.order(&old).is_lt()) {
        *slot = Some(edge);
    }
}

impl<'a> Search<'a> {
    fn new(tree: &'a KdTree, core: &[f64]) -> Self {
        let core: Vec<f64> = tree.order.iter().map(|&i| core[i as usize]).collect();
        let least = |points: &[f64]| points.iter().copied().fold(f64::INFINITY, f64::min);
        Self {
            least_core: tree.nodes.iter().map(|n| least(&core[n.start as usize..n.end as usize])).collect(),
            component: (0..core.len() as u32).collect(),
            of_node: vec![MIXED; tree.nodes.len()],
            core,
            tree,
        }
    }

    /// Takes over the components of `sets`.
    fn update(&mut self, sets: &mut UnionFind) {
        for (c, &i) in self.component.iter_mut().zip(&self.tree.order) {
            *c = sets.find(i);
        }
        // Children come after their parents.
        for (at, node) in self.tree.nodes.iter().enumerate().rev() {
            self.of_node[at] = if node.right == 0 {
                let own = &self.component[node.start as usize..node.end as usize];
                if own.iter().all(|&c| c == own[0]) { own[0] } else { MIXED }
            } else {
                let (l, r) = (self.of_node[at + 1], self.of_node[node.right as usize]);
                if l == r { l } else { MIXED }
            };
        }
    }

    /// The cheapest edge from point `i` to another component, if its component knows none of less weight; and a weight that
    /// no edge from `i` to another component is below.
    fn cheapest_edge(&self, i: usize, caps: &Caps, stack: &mut Vec<(f64, u32)>) -> (Found, f64) {
        let (p, own) = (self.tree.point(i), self.component[i]);
        let mut found: Found = None;
        let mut cap = caps.get(own);
        // A lower bound of mutual reachability into a node.
        let reach = |node: u32| {
            let distance = self.tree.distance_to(node as usize, p).sqrt();
            distance.max(self.core[i]).max(self.least_core[node as usize])
        };
        stack.clear();
        stack.push((0.0, 0));
        while let Some((low, node)) = stack.pop() {
            // Edges of equal weight still matter: the order of indices decides among them.
            if low > cap || self.of_node[node as usize] == own {
                continue;
            }
            let n = self.tree.nodes[node as usize];
            if n.right == 0 {
                cap = cap.min(caps.get(own));
                for q in n.start as usize..n.end as usize {
                    if self.component[q] == own {
                        continue;
                    }
                    let weight = squared(p, self.tree.point(q)).sqrt().max(self.core[i]).max(self.core[q]);
                    if weight > cap {
                        continue;
                    }
                    let edge = Edge::new(self.tree.order[i], self.tree.order[q], weight);
                    if found.is_none_or(|(f, _)| edge.order(&f).is_lt()) {
                        found = Some((edge, q as u32));
                        cap = weight;
                        caps.lower(own, weight);
                    }
                }
            } else {
                // The nearer child is looked at first.
                let (left, right) = (node + 1, n.right);
                let (l, r) = (reach(left), reach(right));
                let (near, far) = if l <= r { ((l, left), (r, right)) } else { ((r, right), (l, left)) };
                stack.extend([far, near]);
            }
        }
        // An edge above the cap need not be the point's cheapest: cheaper ones may have been passed over.
        (found.filter(|(f, _)| f.weight <= cap), cap)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core_distances;
    use crate::kdtree::Unique;
    use crate::spanning_forest;
    use proptest::prelude::*;

    /// The spanning tree from all pairs in order.
    fn kruskal(points: &[f32], dim: usize, core: &[f64]) -> Vec<Edge> {
        let row = |i: u32| &points[i as usize * dim..(i as usize + 1) * dim];
        let n = core.len() as u32;
        let weight = |a: u32, b: u32| squared(row(a), row(b)).sqrt().max(core[a as usize]).max(core[b as usize]);
        let pairs = (0..n).flat_map(|a| (a + 1..n).map(move |b| (a, b)));
        spanning_forest(n as usize, &pairs.map(|(a, b)| Edge::new(a, b, weight(a, b))).collect::<Vec<_>>())
    }

    /// Sorted weights of a minimum spanning tree by Prim's algorithm over all pairs.
    fn prim(points: &[f32], dim: usize, core: &[f64]) -> Vec<f64> {
        let n = core.len();
        let row = |i: usize| &points[i * dim..(i + 1) * dim];
        let (mut distance, mut done) = (vec![f64::INFINITY; n], vec![false; n]);
        let mut at = 0;
        let mut out = Vec::new();
        for _ in 1..n {
            done[at] = true;
            for j in 0..n {
                let w = squared(row(at), row(j)).sqrt().max(core[at]).max(core[j]);
                if !done[j] && w < distance[j] {
                    distance[j] = w;
                }
            }
            at = (0..n).filter(|&j| !done[j]).min_by(|&a, &b| distance[a].total_cmp(&distance[b])).unwrap();
            out.push(distance[at]);
        }
        out.sort_by(f64::total_cmp);
        out
    }

    fn weights(edges: &[Edge]) -> Vec<f64> {
        edges.iter().map(|e| e.weight).collect()
    }

    #[test]
    fn a_line_is_spanned_by_its_gaps() {
        let points = [7.0f32, 0.0, 1.0, 3.5];
        let edges = spanning_tree(&points, 1, &[0.0; 4]);
        assert_eq!(edges, [Edge::new(1, 2, 1.0), Edge::new(2, 3, 2.5), Edge::new(0, 3, 3.5)]);
        // A core distance lifts every edge of its point.
        assert_eq!(weights(&spanning_tree(&points, 1, &[0.0, 0.0, 3.0, 0.0])), [3.0, 3.0, 3.5]);
        assert!(spanning_tree(&[1.0, 2.0], 2, &[0.0]).is_empty());
    }

    #[test]
    fn a_scene_of_many_leaves_is_spanned_by_the_same_edges_for_any_number_of_threads() {
        // Three clouds of different density and a ring of outliers, on a grid fine enough to tie here and there.
        let points: Vec<f32> = (0..3000u32)
            .flat_map(|i| {
                let h = f64::from(i.wrapping_mul(2_654_435_761)) / 4_294_967_296.0;
                let (angle, radius) = (h * 917.0, (h * 31.0).fract() * f64::from(1 + i % 3));
                let far = if i % 100 == 0 { 30.0 } else { f64::from(i % 3) * 4.0 };
                [angle.cos() * radius + far, angle.sin() * radius, (h * 77.0).fract() * 0.1]
            })
            .map(|v| ((v * 64.0).round() / 64.0) as f32)
            .collect();
        let unique = Unique::new(&points, 3);
        let core = core_distances(&unique.points, 3, 8);
        let expected = kruskal(&unique.points, 3, &core);
        for threads in [1, 4] {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            assert_eq!(pool.install(|| spanning_tree(&unique.points, 3, &core)), expected, "{threads} threads");
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(60))]

        /// On scattered points, grids, lines and heaps of equal points.
        #[test]
        fn the_tree_is_the_minimum_one(
            dim in 1usize..6,
            grid in prop::sample::select(vec![0.0f32, 0.25, 1.0, 10.0]),
            collinear in any::<bool>(),
            values in prop::collection::vec(-3.0f32..3.0, 12..1200),
            min_samples in 1usize..12,
        ) {
            let n = values.len() / dim;
            let points: Vec<f32> = (0..n * dim)
                .map(|i| if collinear { values[i / dim] * (1 + i % dim) as f32 } else { values[i] })
                .map(|v| if grid > 0.0 { (v / grid).round() * grid } else { v })
                .collect();
            let all_core = core_distances(&points, dim, min_samples);
            for i in 0..n {
                let row = |j: usize| &points[j * dim..(j + 1) * dim];
                let mut d: Vec<f64> = (0..n).map(|j| squared(row(i), row(j))).collect();
                d.sort_by(f64::total_cmp);
                prop_assert_eq!(all_core[i], d[(min_samples - 1).min(n - 1)].sqrt());
            }
            let unique = Unique::new(&points, dim);
            let mut core = vec![0.0; unique.weights.len()];
            for (c, &u) in all_core.iter().zip(&unique.of_point) {
                core[u as usize] = *c;
            }
            let ours = spanning_tree(&unique.points, dim, &core);
            prop_assert_eq!(weights(&ours), prim(&unique.points, dim, &core));
            prop_assert_eq!(ours, kruskal(&unique.points, dim, &core));
        }
    }
}
