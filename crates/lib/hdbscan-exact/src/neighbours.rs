//! Core distances, and the neighbours they were found with.

use crate::NEVER;
use crate::kdtree::{Group, KdTree, LEAF, Unique, Visitor, rough_limit, squared};
use multiversion::multiversion;
use rayon::prelude::*;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};

/// Most neighbours that are remembered of a point.
const MOST: usize = 32;
/// No neighbour.
pub(crate) const NONE: u32 = u32::MAX;
/// Points among which core distances are first guessed, at least.
const GUESS_AMONG: usize = 64;

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

/// A tree over distinct `points` `[n][dim]` that parts dense points from scattered ones, by what core distances would be if
/// there were only the points in the same small part of a first tree.
pub(crate) fn density_tree(
    points: &[f32],
    dim: usize,
    weights: &[u32],
    min_samples: usize,
    stop: &AtomicBool,
) -> Option<KdTree> {
    let first = KdTree::new(points, dim);
    let among = GUESS_AMONG.max(2 * min_samples);
    let small = |node: usize| (first.nodes[node].end - first.nodes[node].start) as usize <= among;
    // The lowest nodes with more points, or all points.
    let roots = (0..first.nodes.len()).filter(|&i| {
        let n = &first.nodes[i];
        (i == 0 || !small(i)) && (n.right == 0 || (small(i + 1) && small(n.right as usize)))
    });
    let roots: Vec<u32> = roots.map(|i| i as u32).collect();
    let weights = in_tree_order(&first, weights);
    let guesses: Vec<Vec<f64>> = roots
        .par_iter()
        .map_init(Search::default, |search, &root| {
            let mut out = Vec::new();
            for leaf in first.leaves(root).take_while(|_| !stop.load(Relaxed)) {
                search_leaf(&first, &weights, &first, leaf, root, min_samples, search);
                out.extend(search.found.iter().take(search.count).map(|f| f.last().map_or(0.0, |b| b.0).sqrt()));
            }
            out
        })
        .collect();
    if stop.load(Relaxed) {
        return None;
    }
    let mut core = vec![0.0; weights.len()];
    for (&root, guesses) in roots.iter().zip(guesses) {
        let start = first.nodes[root as usize].start as usize;
        for (&i, guess) in first.order[start..].iter().zip(guesses) {
            core[i as usize] = guess;
        }
    }
    // In many dimensions a tree is most of the memory.
    drop(first);
    Some(KdTree::by_density(points, dim, &core))
}

fn in_tree_order(tree: &KdTree, weights: &[u32]) -> Vec<u32> {
    tree.order.iter().map(|&i| weights[i as usize]).collect()
}

/// Of each point of a leaf its core distance and whether its neighbours are complete; and their rows of neighbours.
type OfLeaf = (Vec<(f64, bool)>, Vec<u32>);

/// Core distances and nearest neighbours of the tree's points; `weights` are how many points each stands for. None when
/// `stop` is set meanwhile.
pub(crate) fn neighbours(tree: &KdTree, weights: &[u32], min_samples: usize, stop: &AtomicBool) -> Option<Neighbours> {
    let n = tree.order.len();
    let kept = min_samples.saturating_sub(1).clamp(1, MOST);
    let weights = in_tree_order(tree, weights);
    let leaves: Vec<u32> = tree.leaves(0).collect();
    // Leaves are in tree order; so are their points, one after the other.
    let found: Vec<OfLeaf> = leaves
        .par_iter()
        .with_min_len(8)
        .map_init(Search::default, |search, &leaf| {
            if stop.load(Relaxed) {
                return OfLeaf::default();
            }
            search_leaf(tree, &weights, tree, leaf, 0, min_samples, search);
            let start = tree.nodes[leaf as usize].start;
            let mut near = vec![NONE; search.count * kept];
            let rows = (start..).zip(&search.found[..search.count]).zip(near.chunks_exact_mut(kept));
            let core = rows.zip(&search.gone).map(|(((at, found), row), gone)| {
                let others = found.iter().filter(|b| b.1 != at);
                row.iter_mut().zip(others).for_each(|(r, b)| *r = b.1);
                let core = found.last().map_or(0.0, |b| b.0);
                (core.sqrt(), *gone > core && found.len() <= kept + 1)
            });
            (core.collect(), near)
        })
        .collect();
    let mut out = Neighbours {
        core: Vec::with_capacity(n),
        near: Vec::with_capacity(n * kept),
        kept,
        complete: Vec::with_capacity(n),
    };
    for (core, near) in found {
        out.core.extend(core.iter().map(|c| c.0));
        out.complete.extend(core.iter().map(|c| c.1));
        out.near.extend(near);
    }
    (!stop.load(Relaxed)).then_some(out)
}

/// Core distances of points `[n][dim]`; see [`crate::Options::min_samples`].
///
/// # Panics
/// When `dim` is 0 or does not divide the number of values.
pub fn core_distances(points: &[f32], dim: usize, min_samples: usize) -> Vec<f64> {
    let unique = Unique::new(points, dim);
    let tree = density_tree(&unique.points, dim, &unique.weights, min_samples, &NEVER).expect("nothing stops it");
    let found = neighbours(&tree, &unique.weights, min_samples, &NEVER).expect("nothing stops it");
    let mut core = vec![0.0; unique.weights.len()];
    for (&i, c) in tree.order.iter().zip(found.core) {
        core[i as usize] = c;
    }
    unique.of_point.iter().map(|&u| core[u as usize]).collect()
}

/// The search for the neighbours of the points of one leaf.
#[derive(Default)]
struct Search {
    group: Group,
    count: usize,
    /// Squared distances with places, ascending, of each point just enough to hold min_samples points.
    found: Vec<Vec<(f64, u32)>>,
    /// How many points these stand for.
    held: [u64; LEAF],
    /// The squared distance that a point must not reach to matter, exactly and in f32.
    limit: [f64; LEAF],
    rough: [f32; LEAF],
    /// The least squared distance of a point that had to go.
    gone: [f64; LEAF],
}

/// [`Search`] on its walk.
struct Nearest<'a> {
    tree: &'a KdTree,
    weights: &'a [u32],
    wanted: u64,
    own: u32,
    of: &'a mut Search,
    reach: f32,
}

/// Finds the nearest points in `tree`, below `root`, of each point of a leaf of `from`: the same tree, or another.
#[multiversion(targets("x86_64+avx2+fma", "aarch64+neon"))]
fn search_leaf(
    tree: &KdTree,
    weights: &[u32],
    from: &KdTree,
    leaf: u32,
    root: u32,
    min_samples: usize,
    search: &mut Search,
) {
    let node = &from.nodes[leaf as usize];
    let mut group = std::mem::take(&mut search.group);
    group.gather(from, node.start..node.end);
    search.start(group.places.len());
    let wanted = min_samples as u64;
    let mut nearest = Nearest { tree, weights, wanted, own: NONE, of: search, reach: f32::INFINITY };
    if std::ptr::eq(tree, from) {
        // The own leaf first: it holds the nearest points, more often than not.
        nearest.leaf(&group, leaf);
        nearest.own = leaf;
    }
    group.walk(tree, root, &mut nearest);
    search.group = group;
}

/// For every one of `queries` `[m][dim]`, that need not be in the tree, the nearest distinct points that stand for at least
/// `wanted` points, or all there are: (distance, place in the tree), ascending.
pub(crate) fn nearest(tree: &KdTree, weights: &[u32], queries: &[f32], wanted: usize) -> Vec<Vec<(f64, u32)>> {
    let weights = in_tree_order(tree, weights);
    // Queries that are near each other walk together.
    let from = KdTree::new(queries, tree.dim);
    let leaves: Vec<u32> = from.leaves(0).collect();
    let rows: Vec<Vec<Vec<(f64, u32)>>> = leaves
        .par_iter()
        .map_init(Search::default, |search, &leaf| {
            search_leaf(tree, &weights, &from, leaf, 0, wanted, search);
            let rows = search.found[..search.count].iter();
            rows.map(|row| row.iter().map(|&(d, q)| (d.sqrt(), q)).collect()).collect()
        })
        .collect();
    let mut out = vec![Vec::new(); from.order.len()];
    for (&i, row) in from.order.iter().zip(rows.into_iter().flatten()) {
        out[i as usize] = row;
    }
    out
}

impl Search {
    fn start(&mut self, count: usize) {
        self.count = count;
        self.found.resize_with(LEAF, Vec::new);
        self.found.iter_mut().for_each(Vec::clear);
        self.held = [0; LEAF];
        (self.limit, self.gone) = ([f64::INFINITY; LEAF], [f64::INFINITY; LEAF]);
        // Lanes without a point reach nothing.
        self.rough = [-1.0; LEAF];
        self.rough[..count].fill(f32::INFINITY);
    }
}

impl Visitor for Nearest<'_> {
    #[inline(always)]
    fn wants(&self, node: u32) -> bool {
        node != self.own
    }

    #[inline(always)]
    fn reach(&self) -> f32 {
        self.reach
    }

    #[inline(always)]
    fn reaches(&self, distances: &[f32; LEAF]) -> bool {
        distances.iter().zip(&self.of.rough).map(|(d, r)| u32::from(d <= r)).sum::<u32>() > 0
    }

    #[inline(always)]
    fn leaf(&mut self, group: &Group, node: u32) {
        let n = &self.tree.nodes[node as usize];
        let to_box = group.each_to_node(self.tree, node);
        let mut closer = false;
        for lane in 0..group.places.len() {
            if to_box[lane] > self.of.rough[lane] {
                continue;
            }
            let p = group.point(lane, self.tree.dim);
            let roughly = self.tree.to_leaf(n, p);
            for (q, &rough) in (n.start..n.end).zip(&roughly) {
                if rough <= self.of.rough[lane] {
                    closer |= self.offer(lane, squared(p, self.tree.point(q as usize)), q);
                }
            }
        }
        if closer {
            self.reach = self.of.rough[..self.of.count].iter().copied().fold(0.0, f32::max);
        }
    }
}

impl Nearest<'_> {
    /// Takes a point at squared distance `d` up if it is near enough; whether the limit fell.
    #[inline(always)]
    fn offer(&mut self, lane: usize, d: f64, q: u32) -> bool {
        let s = &mut *self.of;
        if d >= s.limit[lane] {
            s.gone[lane] = s.gone[lane].min(d);
            return false;
        }
        let best = &mut s.found[lane];
        let mut to = best.len();
        while to > 0 && best[to - 1].0 > d {
            to -= 1;
        }
        best.insert(to, (d, q));
        s.held[lane] += u64::from(self.weights[q as usize]);
        while let Some(&(d, last)) = best.last() {
            let w = u64::from(self.weights[last as usize]);
            if s.held[lane] - w < self.wanted {
                break;
            }
            s.held[lane] -= w;
            s.gone[lane] = s.gone[lane].min(d);
            best.pop();
        }
        if s.held[lane] < self.wanted {
            return false;
        }
        s.limit[lane] = best.last().map_or(f64::INFINITY, |b| b.0);
        s.rough[lane] = rough_limit(s.limit[lane]);
        true
    }
}
