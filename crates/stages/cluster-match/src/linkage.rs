//! Clustering by how far the masks agree that Gaussians belong together: average linkage.
//!
//! A Gaussian at a rim lies in two masks of a view, and many masks are wrong. What many Gaussians have in common is firm. So
//! neighbours are joined from the bottom up, those that agree most first, and what is joined has the masks of all its Gaussians.

use crate::doubt::Doubt;
use crate::inputs::Inputs;
use crate::options::Settings;
use crate::plane::Place;
use crate::profile::{Pieces, Profile, some_views, units};
use crate::surface::{Points, Touch};
use artifacts::{Footprints, Graph, Level};
use gs_io::Result;
use hdbscan_exact::{Clustering, Edge, Options, Selection, cluster_graph};
use rayon::prelude::*;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

/// A cluster joins one more than this many times as large that it agrees with most, though that one agrees more with another: it hardly
/// changes it. Else a floor would take its Gaussians one a round.
const TIMES: usize = 16;
/// Pieces that lie in one plane need this share of the agreement of others: a floor or a wall is seldom seen whole, and what hides
/// its middle parts its masks.
const IN_PLANE: f64 = 0.75;
/// Pairs that are compared at once: their agreements are held beside the lists.
const AT_ONCE: usize = 1 << 20;
/// The distance of two that agree fully: distances of 0 would make the tree's lambdas infinite.
const FLOOR: f64 = 0.1;
/// Least difference between distances within instances and between them.
const APART: f64 = 1e-6;
/// Agreement of two of which hardly any view shows both in one mask.
const NONE: f64 = 1e-9;

/// Entries of footprints that single Gaussians have at most, 8 bytes each. Where all views show most of a large scene there are more.
pub const MOST_ENTRIES: u64 = 1 << 27;
/// Gaussians that agree by this are one piece. Where there are more entries, they become one by some of the views before the others are
/// read.
const FIRM: f64 = 0.7;

/// Clusters the kept Gaussians by the masks at `levels`: neighbours that agree by `least`, then pieces that do not touch and agree by
/// `join`; 0 joins none of those. The tree above goes on to where nothing agrees. `points` are those of the inputs, once somebody needed
/// them.
///
/// # Errors
/// When the footprints can't be read.
pub fn cluster<'a>(
    inputs: &'a Inputs,
    points: &mut Option<Points<'a>>,
    settings: &Settings,
    levels: &[Level],
    (least, join): (f64, f64),
) -> Result<Clustering> {
    let (graph, n) = (&inputs.graph, inputs.graph.kept.len());
    let unit_of = units(&inputs.footprints);
    let hdbscan = settings.hdbscan();
    // Two distances that nothing else has part what is one instance from what is not.
    let cut = distance(least);
    let (within, above) = ((0.0, cut), (cut + 2.0 * APART, f64::MAX));
    let mut linkage = firm(graph, &inputs.footprints, levels, &unit_of, (FIRM.max(least), within))?;
    let points = match points {
        Some(points) => points,
        none => none.insert(Points::of(inputs)?),
    };
    linkage.start_to_doubt(&points.rims(&linkage.labels().0));
    linkage.join(least, usize::MAX, within);
    linkage.doubt = None;
    linkage.join(NONE, hdbscan.min_cluster_size, within);
    if join > 0.0 {
        let (labels, count) = linkage.labels();
        linkage.meet(Place::of_instances(&inputs.geometry.gaussians, &graph.kept, &labels, count));
        linkage.join(join.max(least), usize::MAX, within);
    }
    // The root of the tree is no cluster, but where the masks show all as one.
    let allow_single_cluster =
        hdbscan.allow_single_cluster || (n >= hdbscan.min_cluster_size && linkage.labels().1 == 1);
    linkage.join(NONE, usize::MAX, above);
    let options = Options { epsilon: cut + APART, selection: Selection::Leaf, allow_single_cluster, ..hdbscan };
    Ok(cluster_graph(n, linkage.edges, &options))
}

/// The first merge: what agrees by `least`.
fn firm<'a>(
    graph: &Graph,
    footprints: &Footprints,
    levels: &[Level],
    unit_of: &'a [u32],
    (least, within): (f64, (f64, f64)),
) -> Result<Linkage<'a>> {
    let views = some_views(footprints, levels, MOST_ENTRIES);
    let own: Vec<i32> = (0..graph.kept.len() as i32).collect();
    let pieces = Pieces::of(&own, own.len(), footprints, levels, &views)?;
    let mut linkage = Linkage::new(pieces.profiles(), &neighbours(graph), unit_of);
    if !views.contains(&false) {
        linkage.join(least, usize::MAX, within);
        return Ok(linkage.into_owned(unit_of));
    }
    linkage.join(FIRM, usize::MAX, within);
    linkage.profiles.fill(Profile::default());
    let mut linkage: Linkage<'_> = linkage.into_owned(unit_of);
    drop(pieces);
    let (labels, count) = linkage.labels();
    let pieces = Pieces::of(&labels, count, footprints, levels, &vec![true; views.len()])?;
    // Some may have had no view in common before.
    linkage.see(pieces.profiles(), neighbours(graph));
    linkage.join(least, usize::MAX, within);
    Ok(linkage.into_owned(unit_of))
}

/// Pairs of spatial neighbours, each once.
fn neighbours(graph: &Graph) -> Vec<(u32, u32)> {
    let row = |i: u32| graph.gaussian_knn.row(i as usize);
    // By the first of both, where that knows the second. Rows are padded with the Gaussian itself.
    let own = |i: u32| {
        let others = row(i).into_iter().filter(move |&&j| i < j || (j < i && !row(j).iter().any(|&k| k == i)));
        others.map(move |&j| (i.min(j), i.max(j)))
    };
    let mut pairs: Vec<(u32, u32)> = (0..graph.kept.len() as u32).into_par_iter().flat_map_iter(own).collect();
    pairs.par_sort_unstable();
    pairs
}

/// Each of these once. `seen` is all false, before and after.
fn once(all: impl Iterator<Item = u32>, seen: &mut [bool]) -> Vec<u32> {
    let out: Vec<u32> = all.filter(|&i| !std::mem::replace(&mut seen[i as usize], true)).collect();
    out.iter().for_each(|&i| seen[i as usize] = false);
    out
}

/// The distance of two with this agreement, 0.1 to 1.1.
fn distance(agreement: f64) -> f64 {
    FLOOR + 1.0 - agreement
}

/// A cluster that another may join, and how far they agree. Packed: with the masks of single Gaussians these have most of the memory.
#[derive(Clone, Copy)]
#[repr(Rust, packed(4))]
struct Near(u32, f64);

/// Clusters that are joined step by step.
pub struct Linkage<'a> {
    unit_of: &'a [u32],
    profiles: Vec<Profile<'a>>,
    /// Members of each cluster; 0 for one that has joined another.
    sizes: Vec<usize>,
    /// How much more two must agree because of their size and shape, while that counts ([`Linkage::start_to_doubt`]).
    doubt: Option<Doubt>,
    /// Those that each cluster may join, and its agreement with them.
    near: Vec<Vec<Near>>,
    /// Where clusters lie, once those that don't touch may join ([`Linkage::meet`]).
    places: Vec<Place>,
    /// The cluster that each joined, or itself.
    into: Vec<u32>,
    /// What was joined, by a member of each side and the distance.
    edges: Vec<Edge>,
    /// The largest distance within each cluster: those above it are no smaller.
    heights: Vec<f64>,
}

impl<'a> Linkage<'a> {
    /// Clusters of one each, of which these `pairs` may join.
    pub fn new(profiles: Vec<Profile<'a>>, pairs: &[(u32, u32)], unit_of: &'a [u32]) -> Self {
        let n = profiles.len();
        // Lists that grow take up to twice their memory.
        let mut counts = vec![0; n];
        pairs.iter().for_each(|&(a, b)| [a, b].into_iter().for_each(|i| counts[i as usize] += 1));
        let mut out = Self {
            unit_of,
            profiles,
            sizes: vec![1; n],
            doubt: None,
            near: counts.into_iter().map(Vec::with_capacity).collect(),
            places: Vec::new(),
            into: (0..n as u32).collect(),
            edges: Vec::new(),
            heights: vec![0.0; n],
        };
        out.compare(pairs);
        out
    }

    /// The same with profiles of its own.
    fn into_owned(self, unit_of: &[u32]) -> Linkage<'_> {
        let Self { profiles, sizes, doubt, near, places, into, edges, heights, .. } = self;
        let profiles = profiles.into_iter().map(Profile::into_owned).collect();
        Linkage { unit_of, profiles, sizes, doubt, near, places, into, edges, heights }
    }

    /// Finds the agreement of pairs that are in nobody's list.
    fn compare(&mut self, pairs: &[(u32, u32)]) {
        let mut near = std::mem::take(&mut self.near);
        let agreement = |&(a, b): &(u32, u32)| {
            let (a, b) = (a as usize, b as usize);
            let agreement = self.profiles[a].agreement(&self.profiles[b], self.unit_of)?;
            if self.places.is_empty() {
                return Some(agreement.value);
            }
            let eased = self.places[a].in_plane_of(&self.places[b]);
            agreement.firm.then_some(if eased { (agreement.value / IN_PLANE).min(1.0) } else { agreement.value })
        };
        for pairs in pairs.chunks(AT_ONCE) {
            let values: Vec<Option<f64>> = pairs.par_iter().map(agreement).collect();
            for (&(a, b), value) in pairs.iter().zip(values) {
                if let Some(value) = value {
                    near[a as usize].push(Near(b, value));
                    near[b as usize].push(Near(a, value));
                }
            }
        }
        self.near = near;
    }

    /// The clusters, ascending, as [`Linkage::labels`] numbers them.
    fn left(&self) -> Vec<u32> {
        (0..self.sizes.len() as u32).filter(|&i| self.sizes[i as usize] > 0).collect()
    }

    /// Pairs that may join, each once.
    fn touching(&self) -> impl Iterator<Item = (u32, u32)> {
        let of = |a: u32| self.near[a as usize].iter().map(move |&Near(b, _)| (a, b));
        (0..self.near.len() as u32).flat_map(of).filter(|(a, b)| a < b)
    }

    /// Finds the agreement of these pairs anew; no others may join.
    fn compare_only(&mut self, pairs: &[(u32, u32)]) {
        self.near.iter_mut().for_each(Vec::clear);
        self.compare(pairs);
    }

    /// From now on the clusters have these profiles, and those may join that hold one of these `pairs` of members.
    pub fn see(&mut self, profiles: Vec<Profile<'a>>, mut pairs: Vec<(u32, u32)>) {
        let left = self.left();
        left.iter().zip(profiles).for_each(|(&i, profile)| self.profiles[i as usize] = profile);
        let cluster: Vec<u32> = self.labels().0.into_iter().map(|label| left[label as usize]).collect();
        pairs.par_iter_mut().for_each(|(a, b)| {
            let ends = (cluster[*a as usize], cluster[*b as usize]);
            (*a, *b) = (ends.0.min(ends.1), ends.0.max(ends.1));
        });
        pairs.retain(|(a, b)| a < b);
        pairs.par_sort_unstable();
        pairs.dedup();
        self.compare_only(&pairs);
    }

    /// From now on clusters may also join that do not touch, but lie mostly in the same mask of some view, and no two that too few views
    /// show both of. `places` are those of the clusters, as [`Linkage::labels`] numbers them.
    pub fn meet(&mut self, places: Vec<Place>) {
        let left = self.left();
        self.places = vec![Place::default(); self.sizes.len()];
        left.iter().zip(places).for_each(|(&i, place)| self.places[i as usize] = place);
        let mut mainly: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
        for &i in &left {
            self.profiles[i as usize].main_masks(self.unit_of).for_each(|k| mainly.entry(k).or_default().push(i));
        }
        let mut pairs: BTreeSet<(u32, u32)> = self.touching().collect();
        // The same pairs meet in many masks.
        for of in mainly.into_values() {
            // Ascending, so a < b.
            pairs.extend(of.iter().enumerate().flat_map(|(k, &a)| of[k + 1..].iter().map(move |&b| (a, b))));
        }
        self.compare_only(&pairs.into_iter().collect::<Vec<_>>());
    }

    /// From now on large clusters must agree more to join, and so must two of which one rises above the other in another colour. `touches` has
    /// the rims of all that touch, as [`Linkage::labels`] numbers them.
    fn start_to_doubt(&mut self, touches: &[Touch]) {
        let left = self.left();
        let named = touches.iter().map(|&((a, b), rim)| ((left[a as usize], left[b as usize]), rim));
        self.doubt = Some(Doubt::new(&self.sizes, named));
    }

    /// The cluster near `i` that it agrees with most, by `least` or more.
    fn best(&self, i: u32, least: f64) -> Option<(u32, f64)> {
        let more = |j: u32| {
            let size = self.sizes[i as usize].max(self.sizes[j as usize]);
            self.doubt.as_ref().map_or(0.0, |doubt| doubt.of(i, j, size))
        };
        let eased = self.near[i as usize].iter().map(|&Near(j, value)| (j, (value - more(j)).min(1.0)));
        // Of equals the first.
        eased.filter(|b| b.1 >= least).max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0)))
    }

    /// The cluster that `i` joins, given the best of each, and how far it agrees with it.
    fn joins(&self, i: u32, best: &[Option<(u32, f64)>], below: usize) -> Option<(u32, f64)> {
        let rank = |i: u32| (self.sizes[i as usize], Reverse(i));
        let other = best[i as usize].filter(|_| self.sizes[i as usize] < below)?;
        let (own, size) = (self.sizes[i as usize], self.sizes[other.0 as usize]);
        let mutual = best[other.0 as usize].is_some_and(|(c, _)| c == i);
        let small = below < usize::MAX && size >= below;
        (if mutual { rank(i) < rank(other.0) } else { small || own * TIMES < size }).then_some(other)
    }

    /// Joins clusters that agree by `least` or more; only such as have fewer than `below` members join others. Their distances are
    /// kept between `low` and `high`.
    pub fn join(&mut self, least: f64, below: usize, (low, high): (f64, f64)) {
        let n = self.sizes.len();
        let (mut best, mut target): (Vec<_>, Vec<u32>) = (vec![None; n], (0..n as u32).collect());
        let seen = &mut vec![false; n];
        // Those that the last round changed. No others have another best, and only they and those near them may join.
        let mut news = self.left();
        loop {
            let found: Vec<_> = news.par_iter().map(|&i| self.best(i, least)).collect();
            news.iter().zip(found).for_each(|(&i, found)| best[i as usize] = found);
            let near = |&i: &u32| self.near[i as usize].iter().map(|&Near(j, _)| j).chain([i]);
            let asked = once(news.iter().flat_map(near), seen);
            let join = |&i: &u32| self.joins(i, &best, below).map(|other| (i, other));
            let joins: Vec<(u32, (u32, f64))> = asked.par_iter().filter_map(join).collect();
            if joins.is_empty() {
                return;
            }
            joins.iter().for_each(|&(i, (other, _))| target[i as usize] = other);
            let root = |mut i: u32| {
                while target[i as usize] != i {
                    i = target[i as usize];
                }
                i
            };
            let mut joins: Vec<(u32, u32, (u32, f64))> = joins.iter().map(|&(i, other)| (root(i), i, other)).collect();
            joins.sort_unstable_by_key(|&(to, i, _)| (to, i));
            joins.iter().for_each(|&(to, i, other)| self.join_one(i, other, to, (low, high)));
            let changed = once(joins.iter().flat_map(|&(to, i, _)| [to, i]), seen);
            let mut pairs = Vec::new();
            for &i in &changed {
                let (to, near) = (root(i), std::mem::take(&mut self.near[i as usize]));
                pairs.extend(
                    near.into_iter().map(|Near(c, _)| root(c)).filter(|&c| c != to).map(|c| (to.min(c), to.max(c))),
                );
            }
            pairs.par_sort_unstable();
            pairs.dedup();
            let ends = once(pairs.iter().flat_map(|&(a, b)| [a, b]), seen);
            changed.iter().for_each(|&i| seen[i as usize] = true);
            ends.iter().for_each(|&i| self.near[i as usize].retain(|&Near(c, _)| !seen[c as usize]));
            changed.iter().for_each(|&i| seen[i as usize] = false);
            news = once(joins.iter().map(|j| j.0).chain(ends), seen);
            joins.iter().for_each(|&(_, i, _)| target[i as usize] = i);
            self.compare(&pairs);
        }
    }

    /// Cluster `i` becomes one of `to`, because it agrees with `other`.
    fn join_one(&mut self, i: u32, (other, agreement): (u32, f64), to: u32, (low, high): (f64, f64)) {
        let (a, b) = (to as usize, i as usize);
        let height = distance(agreement).max(self.heights[a]).max(self.heights[b]).clamp(low, high);
        self.heights[a] = height;
        self.edges.push(Edge::new(i, other, height));
        let own = std::mem::take(&mut self.profiles[b]);
        self.profiles[a] = self.profiles[a].joined(&own);
        self.sizes[a] += std::mem::take(&mut self.sizes[b]);
        if !self.places.is_empty() {
            self.places[a] = self.places[a].joined(&self.places[b]);
        }
        if let Some(doubt) = &mut self.doubt {
            doubt.join(i, to);
        }
        self.into[b] = to;
    }

    /// The cluster of each member, and the number of clusters. Clusters are numbered by the member whose name they keep.
    pub fn labels(&self) -> (Vec<i32>, usize) {
        let mut number = vec![0; self.into.len()];
        let mut count = 0;
        for i in (0..self.into.len()).filter(|&i| self.into[i] as usize == i) {
            number[i] = count;
            count += 1;
        }
        let root = |mut i: usize| {
            while self.into[i] as usize != i {
                i = self.into[i] as usize;
            }
            number[i]
        };
        ((0..self.into.len()).map(root).collect(), count as usize)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plane::testing::{board, places};
    use crate::surface::Rim;
    use artifacts::LEVELS;

    /// Two masks a view; a member has the given share in the first, in views where it is seen at all.
    fn profile(firsts: &[Option<f32>]) -> Profile<'static> {
        let masks = firsts.iter().zip((0..).step_by(2)).filter_map(|(f, mask)| f.map(|f| (mask, f)));
        let masks = masks.flat_map(|(mask, f)| [(mask, f), (mask + 1, 1.0 - f)]).filter(|(_, w)| *w > 0.0);
        Profile::new(masks.collect())
    }

    /// Level default of ten views.
    const UNIT_OF: [u32; 20] = {
        let mut units = [0; 20];
        let mut mask = 0;
        while mask < units.len() {
            units[mask] = (mask / 2 * LEVELS) as u32;
            mask += 1;
        }
        units
    };
    const ONE: Option<f32> = Some(1.0);
    const TWO: Option<f32> = Some(0.0);
    const ALL: (f64, f64) = (0.0, f64::MAX);

    fn labels(linkage: &Linkage<'_>) -> Vec<i32> {
        linkage.labels().0
    }

    #[test]
    fn what_agrees_most_is_joined_first_and_then_counts_as_one() {
        // 0 and 1 agree in 4 views of 4, 2 with either in 3, 3 with 2 in 2 and with 0 and 1 in 1.
        let profiles = || {
            let views = [[ONE; 4], [ONE; 4], [ONE, ONE, ONE, TWO], [ONE, TWO, TWO, TWO]];
            views.iter().map(|v| profile(v)).collect::<Vec<_>>()
        };
        let pairs = [(0, 1), (1, 2), (2, 3)];
        let join = |least| {
            let mut linkage = Linkage::new(profiles(), &pairs, &UNIT_OF);
            linkage.join(least, usize::MAX, ALL);
            (labels(&linkage), linkage.edges.iter().map(|e| (e.a, e.b, (100.0 * e.weight).round())).collect::<Vec<_>>())
        };
        assert_eq!(join(0.8), (vec![0, 0, 1, 2], vec![(0, 1, 10.0)]));
        // With 2 the third view speaks for a half only: (1 + 0 + 0 + 1/3) / 4.
        assert_eq!(join(0.4).0, [0, 0, 0, 1]);
        let (all, edges) = join(0.3);
        assert_eq!((all, edges), (vec![0; 4], vec![(0, 1, 10.0), (0, 2, 35.0), (0, 3, 77.0)]));
    }

    #[test]
    fn only_small_clusters_join_against_the_masks_and_heights_keep_their_range() {
        let views: Vec<Profile<'_>> =
            [[ONE; 4], [ONE; 4], [ONE, TWO, TWO, TWO], [TWO; 4]].iter().map(|v| profile(v)).collect();
        let mut linkage = Linkage::new(views, &[(0, 1), (1, 2), (2, 3)], &UNIT_OF);
        linkage.join(0.9, usize::MAX, (0.0, 0.5));
        linkage.join(1e-9, 2, (0.0, 0.5));
        // 2 agrees with 3 more than with the pair; both are small, so they join, and the two pairs do not.
        assert_eq!(labels(&linkage), [0, 0, 1, 1]);
        linkage.join(1e-9, usize::MAX, (0.6, 9.0));
        let heights: Vec<f64> = linkage.edges.iter().map(|e| e.weight).collect();
        assert!(
            labels(&linkage) == [0; 4] && heights[..2].iter().all(|h| *h <= 0.5) && heights[2] >= 0.6,
            "{heights:?}"
        );
    }

    #[test]
    fn a_floor_takes_its_crumbs_in_few_rounds() {
        // The floor agrees more with the first crumb than with the others, these most with the floor.
        let share = |i: usize| Some(1.0 - 0.001 * i as f32);
        let mut views = vec![profile(&[ONE; 6])];
        views.extend((0..40).map(|i| profile(&[share(i); 6])));
        let pairs: Vec<(u32, u32)> = (1..41).map(|i| (0, i)).collect();
        let mut linkage = Linkage::new(views, &pairs, &UNIT_OF);
        linkage.sizes[0] = 1000;
        let best: Vec<_> = (0..41).map(|i| linkage.best(i, 0.5)).collect();
        let joins = |i| linkage.joins(i, &best, usize::MAX).map(|(other, _)| other);
        assert!((1..41).all(|i| joins(i) == Some(0)) && joins(0).is_none());
        linkage.join(0.5, usize::MAX, ALL);
        assert_eq!(labels(&linkage), [0; 41]);
    }

    #[test]
    fn doubt_keeps_apart_what_rises_and_lets_crumbs_in() {
        // 0 and 1 agree in half of the views, 2 and 3 in three of ten.
        let together = |n: usize| [[ONE; 10], std::array::from_fn(|v| if v < n { ONE } else { TWO })];
        let views: Vec<Profile<'_>> = together(5).iter().chain(&together(3)).map(|v| profile(v)).collect();
        let join = |steps: Option<u32>| {
            let mut linkage = Linkage::new(views.clone(), &[(0, 1), (2, 3)], &UNIT_OF);
            linkage.sizes = vec![100, 100, 1, 1];
            if let Some(steps) = steps {
                linkage.start_to_doubt(&[((0, 1), Rim { pairs: 100, steps }), ((2, 3), Rim { pairs: 100, steps: 0 })]);
            }
            linkage.join(0.4, usize::MAX, ALL);
            labels(&linkage)
        };
        assert_eq!(join(None), [0, 0, 1, 2]);
        assert_eq!(join(Some(0)), [0, 0, 1, 1]);
        assert_eq!(join(Some(100)), [0, 1, 2, 2]);
    }

    #[test]
    fn large_pieces_must_agree_more_and_small_ones_less() {
        // 0 and 1 agree in half of the views, 2 and 3 in three of ten. Pieces have 100 members commonly.
        let together = |n: usize| [[ONE; 10], std::array::from_fn(|v| if v < n { ONE } else { TWO })];
        let views: Vec<Profile<'_>> = together(5).iter().chain(&together(3)).map(|v| profile(v)).collect();
        let join = |sizes: [usize; 4], count: bool| {
            let mut linkage = Linkage::new(views.clone(), &[(0, 1), (2, 3)], &UNIT_OF);
            linkage.sizes = sizes.to_vec();
            linkage.doubt = count.then(|| Doubt::new(&[100; 4], []));
            linkage.join(0.4, usize::MAX, ALL);
            labels(&linkage)
        };
        assert_eq!(join([10000, 1, 1, 1], false), [0, 0, 1, 2]);
        assert_eq!(join([10000, 1, 1, 1], true), [0, 1, 2, 2]);
        assert_eq!(join([100; 4], true), [0, 0, 1, 2]);
    }

    #[test]
    fn clusters_of_some_views_are_judged_by_all() {
        // In the first view all are one; the others show that only 0 and 1 are, and 2 and 3.
        let first: Vec<Profile<'_>> = (0..4).map(|_| profile(&[ONE])).collect();
        let mut linkage = Linkage::new(first, &[(0, 1), (1, 2), (2, 3)], &UNIT_OF);
        linkage.join(0.7, 2, ALL);
        assert_eq!(labels(&linkage), [0, 0, 1, 1]);
        linkage.see(vec![profile(&[ONE; 4]), profile(&[ONE, TWO, TWO, TWO])], vec![(0, 1), (1, 2), (2, 3)]);
        linkage.join(0.4, usize::MAX, ALL);
        assert_eq!(labels(&linkage), [0, 0, 1, 1]);
        linkage.join(0.2, usize::MAX, ALL);
        assert_eq!(labels(&linkage), [0; 4]);
    }

    #[test]
    fn neighbours_that_no_view_showed_together_are_compared_by_all_views() {
        let pairs = vec![(0, 1), (1, 2)];
        let mut linkage = Linkage::new([ONE, None, None].map(|m| profile(&[m])).to_vec(), &pairs, &UNIT_OF);
        linkage.join(0.7, usize::MAX, ALL);
        linkage.see([[ONE, ONE], [None, ONE], [None, TWO]].map(|m| profile(&m)).to_vec(), pairs);
        linkage.join(0.7, usize::MAX, ALL);
        assert_eq!(labels(&linkage), [0, 0, 1]);
    }

    #[test]
    fn pieces_that_do_not_touch_meet_in_masks() {
        // 0 and 2 share masks in three views of four; 1 is merged with them in one view; 3 is seen in one view only.
        let views = || {
            vec![
                profile(&[ONE; 4]),
                profile(&[ONE, TWO, TWO, TWO]),
                profile(&[ONE, ONE, ONE, TWO]),
                profile(&[ONE, None]),
            ]
        };
        let join = |least| {
            let mut linkage = Linkage::new(views(), &[], &UNIT_OF);
            linkage.join(0.1, usize::MAX, ALL);
            assert_eq!(labels(&linkage), [0, 1, 2, 3], "no two touch");
            linkage.meet(vec![Place::default(); 4]);
            linkage.join(least, usize::MAX, ALL);
            labels(&linkage)
        };
        assert_eq!(join(0.6), [0, 1, 0, 2]);
        assert_eq!(join(0.8), [0, 1, 2, 3]);
    }

    #[test]
    fn pieces_of_one_plane_need_less_agreement() {
        let join = |second: Vec<[f32; 3]>| {
            // The same mask in five views of nine.
            let views = vec![profile(&[ONE; 9]), profile(&[ONE, ONE, ONE, ONE, ONE, TWO, TWO, TWO, TWO])];
            let mut linkage = Linkage::new(views, &[], &UNIT_OF);
            linkage.meet(places(&[board([0.0; 3], 0, 1), second]));
            linkage.join(0.6, usize::MAX, ALL);
            labels(&linkage)
        };
        assert_eq!(join(board([2.0, 0.0, 0.0], 0, 1)), [0, 0]);
        assert_eq!(join(board([2.0, 0.0, 0.0], 1, 2)), [0, 1]);
    }
}
