//! The minimum spanning tree of mutual reachability distances, by Boruvka's algorithm on a kd-tree.
//!
//! In each round every component needs its cheapest edge to another one. A point remembers the best edge it found; that
//! edge stays its best as long as its other end is in another component, and its weight bounds what the point can find
//! later, because components only grow. So most points are never searched again.

use crate::kdtree::{KdTree, squared};
use crate::linkage::{Edge, UnionFind};
use rayon::prelude::*;

/// The spanning tree of points `[n][dim]` under mutual reachability max(core a, core b, distance), n - 1 edges in ascending
/// order.
pub fn spanning_tree(points: &[f32], dim: usize, core: &[f64]) -> Vec<Edge> {
    spanning_tree_of(points, dim, core)
}

const MIXED: u32 = u32::MAX;

pub(crate) fn spanning_tree_of(points: &[f32], dim: usize, core: &[f64]) -> Vec<Edge> {
    let n = core.len();
    if n < 2 {
        return Vec::new();
    }
    let tree = KdTree::new(points, dim);
    let core: Vec<f64> = tree.order.iter().map(|&i| core[i as usize]).collect();
    let mut least_core = vec![f64::INFINITY; tree.nodes.len()];
    for (node, least) in tree.nodes.iter().zip(&mut least_core) {
        *least = core[node.start as usize..node.end as usize].iter().copied().fold(f64::INFINITY, f64::min);
    }
    let mut sets = UnionFind::new(n);
    // In tree order: component of each point, best edge so far (other end in tree order).
    let mut component: Vec<u32> = (0..n as u32).collect();
    let mut best: Vec<Option<(Edge, u32)>> = vec![None; n];
    let mut floor: Vec<f64> = core.clone();
    let mut of_node = vec![MIXED; tree.nodes.len()];
    let mut out: Vec<Edge> = Vec::with_capacity(n - 1);
    while out.len() < n - 1 {
        // What components know already.
        let mut cheapest: Vec<Option<Edge>> = vec![None; n];
        for i in 0..n {
            match best[i] {
                Some((edge, q)) if component[q as usize] != component[i] => {
                    keep_less(&mut cheapest[component[i] as usize], edge);
                }
                _ => best[i] = None,
            }
        }
        // Search for the points that may know something cheaper.
        let found: Vec<Option<(Edge, u32)>> = (0..n)
            .into_par_iter()
            .with_min_len(256)
            .map_init(Vec::new, |stack, i| {
                let bound = cheapest[component[i] as usize];
                if best[i].is_some() || bound.is_some_and(|b| floor[i] > b.weight) {
                    return None;
                }
                search(&tree, &core, &least_core, &component, &of_node, i, bound, stack)
            })
            .collect();
        for (i, f) in found.into_iter().enumerate() {
            if let Some((edge, q)) = f {
                best[i] = Some((edge, q));
                floor[i] = floor[i].max(edge.weight);
                keep_less(&mut cheapest[component[i] as usize], edge);
            }
        }
        // Every component's edge joins; with one total order these edges hold no cycle.
        let mut chosen: Vec<Edge> = cheapest.into_iter().flatten().collect();
        chosen.sort_unstable_by(Edge::order);
        chosen.dedup_by(|a, b| a.order(b).is_eq());
        for edge in chosen {
            if sets.join(edge.a, edge.b) {
                out.push(edge);
            }
        }
        for (i, c) in component.iter_mut().enumerate() {
            *c = sets.find(tree.order[i]);
        }
        for at in (0..tree.nodes.len()).rev() {
            let node = tree.nodes[at];
            of_node[at] = if node.right == 0 {
                let first = component[node.start as usize];
                let same = component[node.start as usize..node.end as usize].iter().all(|&c| c == first);
                if same { first } else { MIXED }
            } else {
                let (l, r) = (of_node[at + 1], of_node[node.right as usize]);
                if l == r { l } else { MIXED }
            };
        }
    }
    out.sort_unstable_by(Edge::order);
    out
}

fn keep_less(slot: &mut Option<Edge>, edge: Edge) {
    if slot.is_none_or(|old| edge.order(&old).is_lt()) {
        *slot = Some(edge);
    }
}

/// The cheapest edge from point `i` (tree order) to another component that is cheaper than `bound`.
fn search(
    tree: &KdTree,
    core: &[f64],
    least_core: &[f64],
    component: &[u32],
    of_node: &[u32],
    i: usize,
    bound: Option<Edge>,
    stack: &mut Vec<(f64, u32)>,
) -> Option<(Edge, u32)> {
    let p = tree.point(i);
    let own = component[i];
    let mut limit = bound;
    let mut found = None;
    // A lower bound of mutual reachability into a node.
    let reach = |node: u32| tree.distance_to(node as usize, p).sqrt().max(core[i]).max(least_core[node as usize]);
    stack.clear();
    stack.push((0.0, 0));
    while let Some((low, node)) = stack.pop() {
        // Edges of equal weight still matter: the order of indices decides among them.
        if limit.is_some_and(|l| low > l.weight) || of_node[node as usize] == own {
            continue;
        }
        let n = tree.nodes[node as usize];
        if n.right == 0 {
            for q in n.start as usize..n.end as usize {
                if component[q] == own {
                    continue;
                }
                let weight = squared(p, tree.point(q)).sqrt().max(core[i]).max(core[q]);
                let edge = Edge::new(tree.order[i], tree.order[q], weight);
                if limit.is_none_or(|l| edge.order(&l).is_lt()) {
                    limit = Some(edge);
                    found = Some((edge, q as u32));
                }
            }
        } else {
            let (left, right) = (node + 1, n.right);
            let (l, r) = (reach(left), reach(right));
            if l <= r {
                stack.push((r, right));
                stack.push((l, left));
            } else {
                stack.push((l, left));
                stack.push((r, right));
            }
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core_distances;
    use crate::kdtree::Unique;
    use proptest::prelude::*;

    /// Prim's algorithm over all pairs.
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

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(60))]
        #[test]
        fn weights_equal_prims(
            dim in 1usize..6,
            grid in prop::sample::select(vec![0.0f32, 0.25, 1.0]),
            values in prop::collection::vec(-3.0f32..3.0, 12..1200),
            min_samples in 1usize..12,
        ) {
            let n = values.len() / dim;
            let points: Vec<f32> = values[..n * dim].iter().map(|v| if grid > 0.0 { (v / grid).round() * grid } else { *v }).collect();
            let unique = Unique::new(&points, dim);
            let all_core = core_distances(&points, dim, min_samples);
            let m = unique.weights.len();
            let mut core = vec![0.0; m];
            for (i, &u) in unique.of_point.iter().enumerate() { core[u as usize] = all_core[i]; }
            // Core distances by brute force.
            for i in 0..n {
                let mut d: Vec<f64> = (0..n).map(|j| squared(&points[i * dim..(i + 1) * dim], &points[j * dim..(j + 1) * dim])).collect();
                d.sort_by(f64::total_cmp);
                prop_assert_eq!(all_core[i], d[(min_samples - 1).min(n - 1)].sqrt());
            }
            let ours: Vec<f64> = spanning_tree(&unique.points, dim, &core).iter().map(|e| e.weight).collect();
            prop_assert_eq!(ours, prim(&unique.points, dim, &core));
        }
    }
}
