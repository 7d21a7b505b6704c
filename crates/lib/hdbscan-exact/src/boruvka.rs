//! The minimum spanning tree of mutual reachability distances, by Boruvka's algorithm on a kd-tree.
//!
//! In each round every component needs its cheapest edge to another one. A point remembers the cheapest edge it found; it
//! stays the cheapest as long as its other end is in another component. It also remembers a floor that no later edge of it
//! can be below, because components only grow. So most points are not searched again in most rounds. The neighbours that the
//! core distances were found with are candidates: they tell at once how cheap an edge a component has at least, and an edge
//! that is no heavier than the point's own core distance cannot be beaten.

use crate::kdtree::{Group, KdTree, LEAF, Visitor, rough_limit, squared};
use crate::linkage::{Edge, UnionFind};
use crate::neighbours::{NONE, Neighbours, density_tree, neighbours};
use multiversion::multiversion;
use rayon::prelude::*;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};

/// The component of a node whose points belong to several.
const MIXED: u32 = u32::MAX;

/// Weights of the cheapest edges that components are known to have, shared by the threads of a round. They only tell what
/// can be skipped (edges of greater weight, never equal), so the tree does not depend on who writes first. Weights
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
    core: &'a [f64],
    least_core: Vec<f64>,
    /// Component of each point, and of each node ([`MIXED`] where there are several).
    component: Vec<u32>,
    of_node: Vec<u32>,
}

/// An edge of a point, and its other end in tree order.
type Found = Option<(Edge, u32)>;

/// What is known of a point's edges.
#[derive(Debug, Clone, Copy)]
struct Known {
    /// Its cheapest edge to another component.
    best: Found,
    /// No edge of it to another component is below this weight.
    floor: f64,
    /// The next of its candidates that may be in another component.
    next: u32,
}

/// Neighbours of a point in the order of their edges.
struct Candidates<'a> {
    of: &'a Neighbours,
    /// Places in the tree, `[n][kept]`.
    places: Vec<u32>,
}

impl<'a> Candidates<'a> {
    fn new(search: &Search<'_>, of: &'a Neighbours) -> Self {
        let mut places = of.near.clone();
        places.par_chunks_mut(of.kept).enumerate().with_min_len(256).for_each(|(i, row)| {
            let count = row.iter().position(|&q| q == NONE).unwrap_or(row.len());
            let mut edges: Vec<(Edge, u32)> = row[..count].iter().map(|&q| (search.edge(i, q as usize), q)).collect();
            edges.sort_unstable_by(|a, b| a.0.order(&b.0));
            row.iter_mut().zip(edges).for_each(|(r, (_, q))| *r = q);
        });
        Self { of, places }
    }

    /// The first candidate of point `i` from `next` on that is in another component.
    fn first(&self, search: &Search<'_>, i: usize, next: &mut u32) -> Found {
        let row = &self.places[i * self.of.kept..(i + 1) * self.of.kept];
        while let Some(&q) = row.get(*next as usize).filter(|q| **q != NONE) {
            if search.component[q as usize] != search.component[i] {
                return Some((search.edge(i, q as usize), q));
            }
            *next += 1;
        }
        None
    }
}

/// The spanning tree of points `[n][dim]` under mutual reachability max(core a, core b, distance), n - 1 edges in ascending
/// order, and the core distances it is made with. It is the minimum one of the total order of [`Edge::order`], which is
/// unique. `weights` are how many points each stands for; see [`crate::Options::min_samples`]. None when `stop` is set meanwhile.
pub(crate) fn spanning_tree(
    points: &[f32],
    dim: usize,
    weights: &[u32],
    min_samples: usize,
    stop: &AtomicBool,
) -> Option<(Vec<Edge>, Vec<f64>)> {
    let n = weights.len();
    let tree = density_tree(points, dim, weights, min_samples, stop)?;
    let near = neighbours(&tree, weights, min_samples, stop)?;
    let mut core = vec![0.0; n];
    for (&i, &c) in tree.order.iter().zip(&near.core) {
        core[i as usize] = c;
    }
    if n < 2 {
        return Some((Vec::new(), core));
    }
    let mut search = Search::new(&tree, &near.core);
    let candidates = Candidates::new(&search, &near);
    let mut sets = UnionFind::new(n);
    let mut known: Vec<Known> = near.core.iter().map(|&floor| Known { best: None, floor, next: 0 }).collect();
    let mut caps = Caps::new(n);
    let leaves: Vec<u32> = tree.leaves(0).collect();
    let mut out: Vec<Edge> = Vec::with_capacity(n - 1);
    while out.len() < n - 1 {
        caps.reset();
        recall(&search, &candidates, &caps, &mut known);
        search_more(&search, &leaves, &caps, &mut known, stop);
        if stop.load(Relaxed) {
            return None;
        }
        // Every component's cheapest edge joins; in one total order these edges close no cycle.
        let mut cheapest: Vec<Option<Edge>> = vec![None; n];
        for (i, k) in known.iter().enumerate() {
            if let Some((edge, _)) = k.best {
                keep_less(&mut cheapest[search.component[i] as usize], edge);
            }
        }
        out.extend(cheapest.into_iter().flatten().filter(|e| sets.join(e.a, e.b)));
        search.update(&sets);
    }
    out.par_sort_unstable_by(Edge::order);
    Some((out, core))
}

/// Gives points the edges that they know already, for sure or as candidates, and lowers the caps of their components.
fn recall(search: &Search<'_>, candidates: &Candidates<'_>, caps: &Caps, known: &mut [Known]) {
    known.par_iter_mut().enumerate().with_min_len(1024).for_each(|(i, k)| {
        let own = search.component[i];
        if k.best.is_none_or(|(_, q)| search.component[q as usize] == own) {
            // A candidate is the cheapest for sure when it costs no more than any edge of this point must, and no
            // other point as near was left out of the candidates.
            let first = candidates.first(search, i, &mut k.next);
            let certain = |(e, _): &(Edge, u32)| e.weight == search.core[i] && candidates.of.complete[i];
            k.best = first.filter(certain);
            if let Some((edge, _)) = first {
                caps.lower(own, edge.weight);
            }
        }
        if let Some((edge, _)) = k.best {
            caps.lower(own, edge.weight);
        }
    });
}

/// Lets the points search that may have a cheaper edge than their component knows, leaf by leaf.
fn search_more(search: &Search<'_>, leaves: &[u32], caps: &Caps, known: &mut [Known], stop: &AtomicBool) {
    let nodes = &search.tree.nodes;
    let mut rest = known;
    let mut of_leaf: Vec<&mut [Known]> = Vec::with_capacity(leaves.len());
    for &leaf in leaves {
        let node = &nodes[leaf as usize];
        let (own, others) = rest.split_at_mut((node.end - node.start) as usize);
        of_leaf.push(own);
        rest = others;
    }
    of_leaf.into_par_iter().zip(leaves).with_min_len(8).for_each_init(
        || (Group::default(), Vec::new()),
        |(group, asking), (known, &leaf)| {
            if stop.load(Relaxed) {
                return;
            }
            let start = nodes[leaf as usize].start;
            asking.clear();
            for (lane, k) in known.iter().enumerate() {
                let own = search.component[start as usize + lane];
                if k.best.is_none() && k.floor <= caps.get(own) {
                    asking.push((own, start + lane as u32));
                }
            }
            // Points of one component ask together.
            asking.sort_unstable();
            for points in asking.chunk_by(|a, b| a.0 == b.0) {
                let (found, least) = cheapest_edges(search, points, caps, group);
                for (&(_, at), found) in points.iter().zip(found) {
                    let k = &mut known[(at - start) as usize];
                    (k.best, k.floor) = (found, k.floor.max(least));
                }
            }
        },
    );
}

fn keep_less(slot: &mut Option<Edge>, edge: Edge) {
    if slot.is_none_or(|old| edge.order(&old).is_lt()) {
        *slot = Some(edge);
    }
}

impl<'a> Search<'a> {
    fn new(tree: &'a KdTree, core: &'a [f64]) -> Self {
        let least = |points: &[f64]| points.iter().copied().fold(f64::INFINITY, f64::min);
        Self {
            least_core: tree.nodes.iter().map(|n| least(&core[n.start as usize..n.end as usize])).collect(),
            component: tree.order.clone(),
            of_node: vec![MIXED; tree.nodes.len()],
            core,
            tree,
        }
    }

    /// The edge between two places.
    #[inline(always)]
    fn edge(&self, i: usize, q: usize) -> Edge {
        let distance = squared(self.tree.point(i), self.tree.point(q)).sqrt();
        let weight = distance.max(self.core[i]).max(self.core[q]);
        Edge::new(self.tree.order[i], self.tree.order[q], weight)
    }

    /// Takes over the components of `sets`.
    fn update(&mut self, sets: &UnionFind) {
        self.component.par_iter_mut().zip(&self.tree.order).with_min_len(4096).for_each(|(c, &i)| *c = sets.root(i));
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
}

/// A search for the cheapest edges of points of one component.
struct Cheapest<'a> {
    search: &'a Search<'a>,
    caps: &'a Caps,
    own: u32,
    /// No edge of greater weight matters; and its square in f32, with more than the rounding of root and square can take away.
    cap: f64,
    reach: f32,
    found: [Found; LEAF],
}

impl Cheapest<'_> {
    #[inline(always)]
    fn lower(&mut self, cap: f64) {
        if cap < self.cap {
            self.cap = cap;
            self.reach = rough_limit(cap * cap * (1.0 + 1e-12));
        }
    }
}

impl Visitor for Cheapest<'_> {
    #[inline(always)]
    fn wants(&self, node: u32) -> bool {
        // Edges of equal weight still matter: the order of indices decides among them.
        self.search.of_node[node as usize] != self.own && self.search.least_core[node as usize] <= self.cap
    }

    #[inline(always)]
    fn reach(&self) -> f32 {
        self.reach
    }

    #[inline(always)]
    fn reaches(&self, distances: &[f32; LEAF]) -> bool {
        distances.iter().map(|&d| u32::from(d <= self.reach)).sum::<u32>() > 0
    }

    #[inline(always)]
    fn leaf(&mut self, group: &Group, node: u32) {
        let s = self.search;
        let n = &s.tree.nodes[node as usize];
        self.lower(self.caps.get(self.own));
        let to_box = group.each_to_node(s.tree, node);
        for (lane, &at) in group.places.iter().enumerate() {
            if to_box[lane] > self.reach {
                continue;
            }
            let roughly = s.tree.to_leaf(n, s.tree.point(at as usize));
            for (q, &rough) in (n.start as usize..n.end as usize).zip(&roughly) {
                if rough > self.reach || s.component[q] == self.own || s.core[q] > self.cap {
                    continue;
                }
                let edge = s.edge(at as usize, q);
                if edge.weight <= self.cap && self.found[lane].is_none_or(|(f, _)| edge.order(&f).is_lt()) {
                    self.found[lane] = Some((edge, q as u32));
                    self.lower(edge.weight);
                    self.caps.lower(self.own, edge.weight);
                    // It is an edge of the other component, too.
                    self.caps.lower(s.component[q], edge.weight);
                }
            }
        }
    }
}

/// The cheapest edges from points of one component, (component, place) each, to others, where the component knows none of less
/// weight; and a weight that no other edge from them to another component is below.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn cheapest_edges(search: &Search<'_>, points: &[(u32, u32)], caps: &Caps, group: &mut Group) -> ([Found; LEAF], f64) {
    let own = points[0].0;
    group.gather(search.tree, points.iter().map(|p| p.1));
    let mut walk = Cheapest { search, caps, own, cap: f64::INFINITY, reach: f32::INFINITY, found: [None; LEAF] };
    walk.lower(caps.get(own));
    group.walk(search.tree, 0, &mut walk);
    // An edge above the cap need not be the point's cheapest: cheaper ones may have been passed over.
    let cap = walk.cap;
    (walk.found.map(|f| f.filter(|(f, _)| f.weight <= cap)), cap)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::NEVER;
    use crate::core_distances;
    use crate::kdtree::Unique;
    use crate::linkage::spanning_forest;
    use proptest::prelude::*;

    /// The spanning tree from all pairs in order.
    fn kruskal(points: &[f32], dim: usize, core: &[f64]) -> Vec<Edge> {
        let row = |i: u32| &points[i as usize * dim..(i as usize + 1) * dim];
        let n = core.len() as u32;
        let weight = |a: u32, b: u32| squared(row(a), row(b)).sqrt().max(core[a as usize]).max(core[b as usize]);
        let pairs = (0..n).flat_map(|a| (a + 1..n).map(move |b| (a, b)));
        spanning_forest(n as usize, pairs.map(|(a, b)| Edge::new(a, b, weight(a, b))).collect::<Vec<_>>())
    }

    #[test]
    fn a_line_is_spanned_by_its_gaps() {
        let points = [7.0f32, 0.0, 1.0, 3.5];
        let (edges, core) = spanning_tree(&points, 1, &[1; 4], 1, &NEVER).unwrap();
        assert_eq!(edges, [Edge::new(1, 2, 1.0), Edge::new(2, 3, 2.5), Edge::new(0, 3, 3.5)]);
        assert_eq!(core, [0.0; 4]);
        // Core distances lift the edges of their points; a point that stands for three is its own neighbour.
        let (edges, core) = spanning_tree(&points, 1, &[1, 1, 3, 1], 3, &NEVER).unwrap();
        assert_eq!(core, [6.0, 1.0, 0.0, 2.5]);
        assert_eq!(edges, [Edge::new(1, 2, 1.0), Edge::new(2, 3, 2.5), Edge::new(0, 2, 6.0)]);
        assert!(spanning_tree(&[1.0, 2.0], 2, &[1], 4, &NEVER).unwrap().0.is_empty());
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
        let spanned = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| spanning_tree(&unique.points, 3, &unique.weights, 8, &NEVER).unwrap())
        };
        let (edges, core) = spanned(1);
        assert_eq!(edges, kruskal(&unique.points, 3, &core));
        assert_eq!((edges, core), spanned(4));
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(60))]

        /// On scattered points, grids, lines and heaps of equal points.
        #[test]
        fn the_tree_is_the_minimum_one(
            dim in prop_oneof![4 => 1usize..6, 1 => 6usize..33],
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
            let (ours, own_core) = spanning_tree(&unique.points, dim, &unique.weights, min_samples, &NEVER).unwrap();
            prop_assert_eq!(&own_core, &core);
            prop_assert_eq!(ours, kruskal(&unique.points, dim, &core));
        }
    }
}
