//! MaskClustering (Yan et al., CVPR 2024, arXiv 2401.07745): masks of all views are clustered by how many views agree.
//!
//! A mask is a set of points. A mask is seen in a frame where enough of its points lie in masks of that frame, and one of these
//! contains it where it has most of those points. The observers of two masks are the frames that see both; its supporters are
//! the masks that contain both. Masks are merged where supporters / observers is high, those of most observers first. A mask
//! that many frames split is under-segmented: it is dropped, and its frame is no observer of what it contains.
//!
//! Settings are those of the public code for ScanNet. Here the points are the Gaussians. The code takes the points of the scene
//! within 3 cm of a mask's depth pixels; here a Gaussian is a point of the mask that has at least 0.8 of its weight in a view, if
//! the view shows a fifth or more of what the best view shows of it. The code leaves points that lie in two masks of a frame out
//! of its counts, in all frames; here a Gaussian without such a mask is left out in that frame only, for with splats nearly all
//! would go. At the end a Gaussian that is no point of an object joins the one whose masks give it most weight, for the code's
//! points within 3 cm of a mask take those in too.
//!
//! The paper has one map of masks for each frame. With several levels each is clustered by itself, and objects of different
//! levels meet in the code's last step, which drops an object that lies in another. Objects of the code may overlap; here a
//! Gaussian belongs to the one whose masks give it most weight. DBSCAN (0.1 m, 4 points) is replaced by parts of the graph of
//! neighbours with edges up to a multiple of the usual distance, of at least 4 Gaussians.

use crate::cli::Peer;
use crate::product::{Grouping, Product};
use crate::union::root;
use crate::vectors::unit;
use crate::world::{Inputs, World};
use artifacts::{Graph, Match};
use gs_io::Result;
use ndarray::ArrayView1;
use rayon::prelude::*;
use serde::Serialize;
use stage::Stage;
use std::collections::BTreeMap;

/// Fewest points of a part of an object (the code's DBSCAN).
const MIN_POINTS: usize = 4;
/// A mask is also seen where this many of its points are (the code), however small their share.
const MANY_POINTS: u32 = 500;
/// Fewest masks of an object (the code).
const MIN_MASKS: usize = 2;
/// Percentiles of the observers, from the first to the last step (the code): 95, 90, ... 0.
const PERCENTILES: std::ops::RangeInclusive<u32> = 0..=19;
/// Masks whose mean feature describes an object, those that cover most of it (the code).
const TOP_MASKS: usize = 5;
/// An object is dropped of which another holds more than this share (the code).
const OVERLAP: f64 = 0.8;
/// Longest edge inside an object, in median distances of nearest neighbours.
const REACH: f32 = 10.0;
/// A mask is seen in a frame from this share of its points (the code).
const VISIBLE: f64 = 0.3;

/// Settings.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct Options {
    #[command(flatten)]
    #[serde(flatten)]
    inputs: Inputs,
    #[command(flatten)]
    #[serde(flatten)]
    rules: Rules,
}

/// The system's thresholds.
#[derive(Debug, Clone, Copy, clap::Args, Serialize)]
struct Rules {
    /// A Gaussian is a point of a mask from this share of its weight in the view, 0.5 to 1
    #[arg(long, value_name = "SHARE", default_value_t = 0.8, value_parser = stage::within(0.5f32..=1.0))]
    point_share: f32,
    /// Least weight of a point in a view, as a share of the largest that the Gaussian has in a view, 0 to 1
    #[arg(long, value_name = "SHARE", default_value_t = 0.2, value_parser = stage::within(0.0f32..=1.0))]
    point_weight: f32,
    /// A mask contains another that has more than this share of its seen points in it, 0 to 1
    #[arg(long, value_name = "SHARE", default_value_t = 0.8, value_parser = stage::within(0.0..=1.0))]
    contained: f64,
    /// A mask is dropped that more than this share of the frames splits, 0 to 1
    #[arg(long, value_name = "SHARE", default_value_t = 0.3, value_parser = stage::within(0.0..=1.0))]
    undersegmented: f64,
    /// Masks are merged from this view consensus rate, 0 to 1
    #[arg(long, value_name = "RATE", default_value_t = 0.9, value_parser = stage::within(0.0..=1.0))]
    consensus: f64,
    /// A point stays in an object whose masks hold it in more than this share of the frames, 0 to 1
    #[arg(long, value_name = "SHARE", default_value_t = 0.5, value_parser = stage::within(0.0..=1.0))]
    detection: f64,
}

/// Points of a mask with their weights.
type Points = Vec<(u32, f32)>;

/// The masks of one level.
#[derive(Debug, Clone, Default, PartialEq)]
struct Masks {
    /// Number of frames.
    frames: usize,
    /// Row of each mask in the footprints.
    row: Vec<u32>,
    /// Frame of each mask.
    frame: Vec<u32>,
    /// Points of each mask, ascending.
    points: Vec<Points>,
    /// Where the masks of each point begin in `of_point`.
    ptr: Vec<usize>,
    /// Masks that hold each point, one of each frame at most, by frame.
    of_point: Vec<u32>,
}

/// Some masks as one: what sees them and what contains them.
#[derive(Debug, Clone, Default, PartialEq)]
struct Node {
    masks: Vec<u32>,
    /// A bit for each frame.
    seen: Vec<u64>,
    /// Masks that contain it, ascending.
    inside: Vec<u32>,
}

/// An object.
#[derive(Debug, Clone, Default, PartialEq)]
struct Object {
    /// Its Gaussians, ascending.
    points: Vec<u32>,
    /// Its masks, as rows of the footprints, with the share of the object that they cover.
    masks: Vec<(u32, f32)>,
    /// Weight of each point over the masks.
    weights: Vec<f64>,
}

impl Peer for Options {
    fn inputs(&self) -> &Inputs {
        &self.inputs
    }

    fn make(&self, world: &World, stage: &Stage) -> Result<Product> {
        let reach = edge_limit(&world.graph, &world.geometry.gaussians.means, REACH);
        let mut objects = Vec::new();
        for &level in &world.levels {
            let masks = read(world, level.index() as u32, &self.rules)?;
            let (nodes, thresholds, dropped) = nodes(&masks, &self.rules);
            stage.info(&format!("level {level}: {} masks, {dropped} of them under-segmented", masks.row.len()));
            let nodes = cluster(nodes, masks.row.len(), &thresholds, self.rules.consensus);
            let near = |a: u32, b: u32| reach.is_none_or(|most| distance(world, a, b) <= most);
            for node in nodes.iter().filter(|node| node.masks.len() >= MIN_MASKS) {
                let all = union(&masks, node);
                let parts = if reach.is_some() { parts(&all, &world.graph, near) } else { vec![all] };
                objects.extend(refine(&masks, node, parts, self.rules.detection));
            }
        }
        let objects = drop_inside(objects, world.kept(), OVERLAP);
        let (mut labels, kept) = exclusive(&objects, world.kept());
        let objects: Vec<&Object> = kept.iter().map(|&o| &objects[o]).collect();
        fill(&mut labels, &claims(world, &objects)?);
        Ok(Product::Instances(self.grouping(world, &objects, &labels)))
    }
}

impl Options {
    /// Labels, matches and descriptors of the objects.
    fn grouping(&self, world: &World, objects: &[&Object], labels: &[i32]) -> Grouping {
        let dim = world.dim();
        let (mut matches, mut descriptors) = (Vec::new(), vec![0.0; objects.len() * dim]);
        for (k, object) in objects.iter().enumerate() {
            let mut masks = object.masks.clone();
            masks.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
            let mut views = BTreeMap::new();
            for &(r, score) in &masks {
                let row = &world.footprints.rows[r as usize];
                let (instance, view, mask) = (k as u32, row.view, row.mask);
                let visible = row.pixels as f32 * row.alpha;
                views.entry(view).or_insert(Match { instance, view, mask, score, visible });
            }
            matches.extend(views.into_values());
            let mut sum = vec![0.0f64; dim];
            for &(r, _) in masks.iter().take(TOP_MASKS) {
                let feature = world.feature(&world.footprints.rows[r as usize]).unwrap_or_default();
                let mut feature = feature.to_vec();
                unit(&mut feature);
                sum.iter_mut().zip(&feature).for_each(|(s, &f)| *s += f64::from(f));
            }
            descriptors[k * dim..(k + 1) * dim].iter_mut().zip(&sum).for_each(|(d, &s)| *d = s as f32);
        }
        let labels = world.spread(labels);
        Grouping { labels, instances: objects.len(), matches, descriptors, scores: Vec::new() }
    }
}

/// The masks of a level with their points.
fn read(world: &World, level: u32, rules: &Rules) -> Result<Masks> {
    let footprints = &world.footprints;
    let rows: Vec<u32> = (0..footprints.rows.len() as u32).collect();
    let rows: Vec<u32> = rows.into_iter().filter(|&r| footprints.rows[r as usize].level == level).collect();
    let view = |r: u32| footprints.rows[r as usize].view;
    let n = world.kept();
    let frames: Vec<&[u32]> = rows.chunk_by(|&a, &b| view(a) == view(b)).collect();
    let read = |frame: &&[u32]| -> Result<Vec<Points>> {
        frame.iter().map(|&r| Ok(footprints.entries(r as usize)?.iter().collect())).collect()
    };
    let mut least = vec![0.0f64; n];
    for frame in &frames {
        let total = totals(&read(frame)?, n);
        least.iter_mut().zip(total).for_each(|(l, t)| *l = l.max(f64::from(rules.point_weight) * t));
    }
    let mut points = Vec::new();
    for frame in &frames {
        points.extend(points_of(&read(frame)?, rules.point_share, &least));
    }
    let frame = rows.iter().map(|&r| view(r)).collect();
    Ok(Masks::new(n, world.views.len(), rows, frame, points))
}

/// Weight of each of `n` Gaussians in a frame.
fn totals(masks: &[Points], n: usize) -> Vec<f64> {
    let mut total = vec![0.0f64; n];
    masks.iter().flatten().for_each(|&(i, w)| total[i as usize] += f64::from(w));
    total
}

/// The points of the masks of one frame: those of at least `share` of a Gaussian's weight in it, if that is its `least` or more.
fn points_of(masks: &[Points], share: f32, least: &[f64]) -> Vec<Points> {
    let total = totals(masks, least.len());
    // From exactly half of the weight two masks may hold a point: the first one does.
    let mut taken = vec![false; least.len()];
    let mut points = |mask: &Points| -> Points {
        let holds = |&&(i, w): &&(u32, f32)| {
            let all = total[i as usize];
            w > 0.0 && all >= least[i as usize] && f64::from(w) >= f64::from(share) * all
        };
        let found = mask.iter().filter(holds).copied();
        found.filter(|&(i, _)| !std::mem::replace(&mut taken[i as usize], true)).collect()
    };
    masks.iter().map(&mut points).collect()
}

impl Masks {
    /// Masks of `frames` frames over `n` points, in the order of their frames.
    fn new(n: usize, frames: usize, row: Vec<u32>, frame: Vec<u32>, points: Vec<Points>) -> Self {
        let mut ptr = vec![0; n + 1];
        points.iter().flatten().for_each(|&(i, _)| ptr[i as usize + 1] += 1);
        (0..n).for_each(|i| ptr[i + 1] += ptr[i]);
        let (mut next, mut of_point) = (ptr.clone(), vec![0; ptr[n]]);
        for (m, points) in points.iter().enumerate() {
            for &(i, _) in points {
                of_point[next[i as usize]] = m as u32;
                next[i as usize] += 1;
            }
        }
        Self { frames, row, frame, points, ptr, of_point }
    }

    /// The masks that hold a point.
    fn holding(&self, point: u32) -> &[u32] {
        &self.of_point[self.ptr[point as usize]..self.ptr[point as usize + 1]]
    }

    /// What sees and contains mask `m`, and whether frames do not split it.
    fn look(&self, m: usize, rules: &Rules) -> (Node, bool) {
        let mut counts = BTreeMap::<(u32, u32), u32>::new();
        for &(i, _) in &self.points[m] {
            for &other in self.holding(i) {
                *counts.entry((self.frame[other as usize], other)).or_default() += 1;
            }
        }
        let mut node = Node { masks: vec![m as u32], seen: vec![0; self.frames.div_ceil(64)], inside: Vec::new() };
        let (mut visible, mut split) = (0u32, 0u32);
        let counts: Vec<_> = counts.into_iter().collect();
        for frame in counts.chunk_by(|a, b| a.0.0 == b.0.0) {
            let all: u32 = frame.iter().map(|c| c.1).sum();
            if f64::from(all) < VISIBLE * self.points[m].len() as f64 && all < MANY_POINTS {
                continue;
            }
            visible += 1;
            let most = frame.iter().map(|c| c.1).max().unwrap_or(0);
            if f64::from(most) > rules.contained * f64::from(all) {
                let at = frame[0].0.0 as usize;
                node.seen[at / 64] |= 1 << (at % 64);
                node.inside.extend(frame.iter().find(|c| c.1 == most).map(|c| c.0.1));
            } else {
                split += 1;
            }
        }
        node.inside.sort_unstable();
        (node, visible > 0 && f64::from(split) <= rules.undersegmented * f64::from(visible))
    }
}

/// A node for each mask that is not under-segmented, the steps' numbers of observers, and how many masks were dropped.
fn nodes(masks: &Masks, rules: &Rules) -> (Vec<Node>, Vec<f64>, usize) {
    let mut all: Vec<(Node, bool)> = (0..masks.points.len()).into_par_iter().map(|m| masks.look(m, rules)).collect();
    let good: Vec<bool> = all.iter().map(|a| a.1).collect();
    // What an under-segmented mask contains may be two things: it counts for none of them.
    for (node, _) in &mut all {
        let Node { seen, inside, .. } = node;
        inside.retain(|&m| {
            let at = masks.frame[m as usize] as usize;
            if !good[m as usize] {
                seen[at / 64] &= !(1 << (at % 64));
            }
            good[m as usize]
        });
    }
    let thresholds = steps(&observers(&all.iter().map(|a| a.0.seen.as_slice()).collect::<Vec<_>>(), masks.frames));
    let dropped = good.iter().filter(|&&g| !g).count();
    (all.into_iter().filter(|a| a.1).map(|a| a.0).collect(), thresholds, dropped)
}

/// Frames that see both.
fn common(a: &[u64], b: &[u64]) -> u32 {
    a.iter().zip(b).map(|(a, b)| (a & b).count_ones()).sum()
}

/// How many ordered pairs of masks, each with itself too, have how many observers.
fn observers(seen: &[&[u64]], frames: usize) -> Vec<u64> {
    let count = |i: usize| {
        let mut counts = vec![0u64; frames + 1];
        seen[i + 1..].iter().for_each(|other| counts[common(seen[i], other) as usize] += 2);
        counts[common(seen[i], seen[i]) as usize] += 1;
        counts
    };
    let add = |mut a: Vec<u64>, b: Vec<u64>| {
        a.iter_mut().zip(b).for_each(|(a, b)| *a += b);
        a
    };
    (0..seen.len()).into_par_iter().map(count).reduce(|| vec![0; frames + 1], add)
}

/// Least observers of each step: percentiles of the pairs that have any. A step of one observer or less is the last from the
/// middle on.
fn steps(counts: &[u64]) -> Vec<f64> {
    let pairs: u64 = counts.iter().skip(1).sum();
    let value = |rank: u64| {
        let mut left = rank;
        let at = counts.iter().enumerate().skip(1).find(|&(_, &c)| {
            let here = left < c;
            left = left.saturating_sub(c);
            here
        });
        at.map_or(0.0, |(v, _)| v as f64)
    };
    let mut out = Vec::new();
    for percentile in PERCENTILES.rev().map(|step| 5 * step) {
        if pairs == 0 {
            break;
        }
        let rank = f64::from(percentile) / 100.0 * (pairs - 1) as f64;
        let (low, high) = (value(rank as u64), value(rank.ceil() as u64));
        let observers = low + (high - low) * rank.fract();
        if observers <= 1.0 && percentile < 50 {
            break;
        }
        out.push(observers.max(1.0));
    }
    out
}

/// Merges nodes step by step: those that share supporters and have enough observers.
fn cluster(mut nodes: Vec<Node>, masks: usize, thresholds: &[f64], consensus: f64) -> Vec<Node> {
    for &least in thresholds {
        let mut containing = vec![Vec::new(); masks];
        for (n, node) in nodes.iter().enumerate() {
            node.inside.iter().for_each(|&m| containing[m as usize].push(n as u32));
        }
        let partners = |(i, node): (usize, &Node)| -> Vec<u32> {
            let mut supporters = BTreeMap::<u32, u32>::new();
            for &m in &node.inside {
                let later = containing[m as usize].partition_point(|&j| j as usize <= i);
                containing[m as usize][later..].iter().for_each(|&j| *supporters.entry(j).or_default() += 1);
            }
            let agree = |&(j, count): &(u32, u32)| {
                let observers = f64::from(common(&node.seen, &nodes[j as usize].seen));
                observers >= least && f64::from(count) / (observers + 1e-7) >= consensus
            };
            supporters.into_iter().filter(agree).map(|s| s.0).collect()
        };
        let edges: Vec<Vec<u32>> = nodes.par_iter().enumerate().map(partners).collect();
        let group =
            connected(nodes.len(), edges.iter().enumerate().flat_map(|(i, e)| e.iter().map(move |&j| (i as u32, j))));
        let mut merged: BTreeMap<u32, Node> = BTreeMap::new();
        for (node, group) in nodes.into_iter().zip(group) {
            let to = merged.entry(group).or_insert_with(|| Node { seen: vec![0; node.seen.len()], ..Node::default() });
            to.masks.extend(node.masks);
            to.seen.iter_mut().zip(node.seen).for_each(|(a, b)| *a |= b);
            to.inside.extend(node.inside);
        }
        nodes = merged.into_values().collect();
        for node in &mut nodes {
            node.masks.sort_unstable();
            node.inside.sort_unstable();
            node.inside.dedup();
        }
    }
    nodes
}

/// The smallest member of each one's connected part.
fn connected(n: usize, edges: impl IntoIterator<Item = (u32, u32)>) -> Vec<u32> {
    let mut parent: Vec<u32> = (0..n as u32).collect();
    for (a, b) in edges {
        let (a, b) = (root(&mut parent, a), root(&mut parent, b));
        parent[a.max(b) as usize] = a.min(b);
    }
    (0..n as u32).map(|i| root(&mut parent, i)).collect()
}

/// All points of a node, ascending.
fn union(masks: &Masks, node: &Node) -> Vec<u32> {
    let points = node.masks.iter().flat_map(|&m| masks.points[m as usize].iter().map(|p| p.0));
    let mut points: Vec<u32> = points.collect();
    points.sort_unstable();
    points.dedup();
    points
}

fn distance(world: &World, a: u32, b: u32) -> f32 {
    let mean = |i: u32| glam::Vec3::from(world.geometry.gaussians.means[world.footprints.kept[i as usize] as usize]);
    mean(a).distance(mean(b))
}

/// The longest edge: `factor` median distances of nearest neighbours. None: there is no limit.
fn edge_limit(graph: &Graph, means: &[[f32; 3]], factor: f32) -> Option<f32> {
    let mean = |i: usize| glam::Vec3::from(means[graph.kept[i] as usize]);
    let nearest = graph.gaussian_knn.rows().into_iter().enumerate();
    let length = |(i, near): (usize, ArrayView1<'_, u32>)| Some(mean(i).distance(mean(*near.first()? as usize)));
    let mut lengths: Vec<f32> = nearest.filter_map(length).collect();
    lengths.sort_unstable_by(f32::total_cmp);
    (factor > 0.0 && !lengths.is_empty()).then(|| factor * lengths[lengths.len() / 2])
}

/// The connected parts of some Gaussians, those of enough Gaussians.
fn parts(points: &[u32], graph: &Graph, near: impl Fn(u32, u32) -> bool) -> Vec<Vec<u32>> {
    let edges = points.iter().enumerate().flat_map(|(a, &i)| {
        let neighbours = graph.gaussian_knn.row(i as usize).into_iter();
        let near = &near;
        let inside = neighbours.filter_map(move |&j| Some((points.binary_search(&j).ok()?, j)));
        inside.filter(move |&(_, j)| near(i, j)).map(move |(b, _)| (a as u32, b as u32))
    });
    let mut parts = BTreeMap::<u32, Vec<u32>>::new();
    for (part, &i) in connected(points.len(), edges).into_iter().zip(points) {
        parts.entry(part).or_default().push(i);
    }
    parts.into_values().filter(|p| p.len() >= MIN_POINTS).collect()
}

/// The objects of a node's parts: each mask goes to the part that it shares most points with; points go that too few of the
/// frames show in a mask of the node.
fn refine(masks: &Masks, node: &Node, parts: Vec<Vec<u32>>, detection: f64) -> Vec<Object> {
    let seen = |m: u32| {
        let at = masks.frame[m as usize] as usize;
        node.seen[at / 64] >> (at % 64) & 1 == 1
    };
    let own = |m: u32| node.masks.binary_search(&m).is_ok();
    let mut of_mask = vec![(0, 0u32); node.masks.len()];
    for (p, part) in parts.iter().enumerate() {
        for (m, most) in node.masks.iter().zip(&mut of_mask) {
            let shared = masks.points[*m as usize].iter().filter(|q| part.binary_search(&q.0).is_ok()).count() as u32;
            *most = if shared > most.1 { (p, shared) } else { *most };
        }
    }
    let mut out = Vec::new();
    for (p, part) in parts.into_iter().enumerate() {
        let mine = node.masks.iter().zip(&of_mask).filter(|(_, most)| most.0 == p && most.1 > 0);
        let of_object = mine.map(|(&m, most)| (masks.row[m as usize], most.1 as f32 / part.len() as f32)).collect();
        let stays = |&i: &u32| {
            let frames = masks.holding(i).iter().filter(|&&m| seen(m));
            // A frame has one mask of a point at most.
            let (all, inside) = frames.fold((0u32, 0u32), |(a, b), &m| (a + 1, b + u32::from(own(m))));
            f64::from(inside) / (f64::from(all) + 1e-6) > detection
        };
        let points: Vec<u32> = part.into_iter().filter(stays).collect();
        let mut weights = vec![0.0; points.len()];
        for &(i, w) in node.masks.iter().flat_map(|&m| &masks.points[m as usize]) {
            if let Ok(at) = points.binary_search(&i) {
                weights[at] += f64::from(w);
            }
        }
        if !points.is_empty() {
            out.push(Object { points, masks: of_object, weights });
        }
    }
    out
}

/// Drops objects that lie in another, in the order of the objects; of two that lie in each other the first goes.
fn drop_inside(objects: Vec<Object>, n: usize, overlap: f64) -> Vec<Object> {
    let mut of_point = vec![Vec::new(); n];
    for (o, object) in objects.iter().enumerate() {
        object.points.iter().for_each(|&i| of_point[i as usize].push(o as u32));
    }
    let mut gone = vec![false; objects.len()];
    for i in 0..objects.len() {
        let mut shared = BTreeMap::<usize, usize>::new();
        for &p in &objects[i].points {
            let others = of_point[p as usize].iter().filter(|&&j| j as usize > i);
            others.for_each(|&j| *shared.entry(j as usize).or_default() += 1);
        }
        for (j, shared) in shared {
            if gone[i] {
                break;
            }
            let inside = |o: &Object| shared as f64 > overlap * o.points.len() as f64;
            if !gone[j] && inside(&objects[i]) {
                gone[i] = true;
            } else if !gone[j] && inside(&objects[j]) {
                gone[j] = true;
            }
        }
    }
    objects.into_iter().zip(gone).filter(|(_, gone)| !gone).map(|(o, _)| o).collect()
}

/// Labels of `n` points, each of the object that weighs most there, and which object each label stands for.
fn exclusive(objects: &[Object], n: usize) -> (Vec<i32>, Vec<usize>) {
    let mut best = vec![(-1i32, 0.0f64); n];
    for (o, object) in objects.iter().enumerate() {
        for (&i, &w) in object.points.iter().zip(&object.weights) {
            let to = &mut best[i as usize];
            *to = if w > to.1 { (o as i32, w) } else { *to };
        }
    }
    let mut number = vec![-1; objects.len()];
    best.iter().filter(|b| b.0 >= 0).for_each(|b| number[b.0 as usize] = 0);
    let kept: Vec<usize> = (0..objects.len()).filter(|&o| number[o] == 0).collect();
    kept.iter().enumerate().for_each(|(k, &o)| number[o] = k as i32);
    (best.iter().map(|b| usize::try_from(b.0).map_or(-1, |o| number[o])).collect(), kept)
}

/// Which objects' masks give weight to which Gaussians: object, Gaussian, weight.
fn claims(world: &World, objects: &[&Object]) -> Result<Vec<(u32, u32, f32)>> {
    let mut object = vec![None; world.footprints.rows.len()];
    for (o, found) in objects.iter().enumerate() {
        found.masks.iter().for_each(|m| object[m.0 as usize] = Some(o as u32));
    }
    let mut out = Vec::new();
    for (row, object) in object.iter().enumerate() {
        let Some(o) = object else { continue };
        out.extend(world.footprints.entries(row)?.iter().map(|(i, w)| (*o, i, w)));
    }
    Ok(out)
}

/// Gives those without a label that of the object with the largest sum of claims, of equals the first.
fn fill(labels: &mut [i32], claims: &[(u32, u32, f32)]) {
    let mut sums = BTreeMap::<(u32, u32), f64>::new();
    for &(object, point, weight) in claims.iter().filter(|c| labels[c.1 as usize] < 0) {
        *sums.entry((point, object)).or_default() += f64::from(weight);
    }
    let sums: Vec<_> = sums.into_iter().collect();
    for of_point in sums.chunk_by(|a, b| a.0.0 == b.0.0) {
        let best = of_point.iter().fold(of_point[0], |a, &b| if b.1 > a.1 { b } else { a });
        if best.1 > 0.0 {
            labels[best.0.0 as usize] = best.0.1 as i32;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RULES: Rules = Rules {
        point_share: 0.5,
        point_weight: 0.5,
        contained: 0.8,
        undersegmented: 0.3,
        consensus: 0.9,
        detection: 0.5,
    };

    /// Two things of ten points each. Frames 0 to 3 see each as a mask; frame 4, if `joined`, sees both as one.
    fn world(joined: bool) -> Masks {
        let things = [0..10u32, 10..20];
        let points = |range: std::ops::Range<u32>| range.map(|i| (i, 1.0)).collect::<Points>();
        let mut all: Vec<(u32, Points)> = (0..4).flat_map(|f| things.clone().map(|t| (f, points(t)))).collect();
        if joined {
            all.push((4, points(0..20)));
        }
        let (frame, points): (Vec<u32>, Vec<Points>) = all.into_iter().unzip();
        Masks::new(20, 5, (0..frame.len() as u32).collect(), frame, points)
    }

    #[test]
    fn a_point_belongs_to_the_mask_of_most_of_its_weight() {
        // Point 0: 3 of 4. Point 1: half and half, so the first. Point 2: 0.4 in all, too little. Point 3: 6 of 10 is less than a
        // share of 0.7.
        let masks = vec![vec![(0, 3.0), (1, 1.0), (2, 0.4), (3, 6.0)], vec![(0, 1.0), (1, 1.0), (3, 4.0)]];
        assert_eq!(points_of(&masks, 0.5, &[0.5; 4]), [vec![(0, 3.0), (1, 1.0), (3, 6.0)], vec![]]);
        assert_eq!(points_of(&masks, 0.7, &[0.5; 4]), [vec![(0, 3.0)], vec![]]);
    }

    #[test]
    fn a_mask_that_frames_split_is_dropped_and_observes_nothing() {
        let masks = world(true);
        // The joined mask: of 5 frames that show it 4 split it in halves, more than 0.3.
        let (node, good) = masks.look(8, &RULES);
        assert_eq!((node.seen[0], node.inside, good), (0b10000, vec![8], false));
        let (node, good) = masks.look(0, &RULES);
        assert_eq!((node.seen[0], node.inside, good), (0b11111, vec![0, 2, 4, 6, 8], true));
        let (nodes, _, dropped) = nodes(&masks, &RULES);
        assert_eq!((nodes.len(), dropped), (8, 1));
        assert!(nodes.iter().all(|n| n.seen[0] == 0b1111 && n.inside.len() == 4));
        // Tolerated, it is kept, and frame 4 then supports that both things are one: 1 supporter of 5 observers is not enough.
        let lax = Rules { undersegmented: 0.8, ..RULES };
        let (nodes, steps, dropped) = super::nodes(&masks, &lax);
        assert_eq!((nodes.len(), dropped), (9, 0));
        let clusters = cluster(nodes, 9, &steps, 0.9);
        let members: Vec<_> = clusters.iter().map(|c| c.masks.clone()).collect();
        assert_eq!(members, [vec![0, 2, 4, 6], vec![1, 3, 5, 7], vec![8]]);
    }

    #[test]
    fn steps_are_percentiles_of_the_observers() {
        // Pairs: 4 of one observer, 6 of three; those of none do not count. Ranks 0 to 9: 1 1 1 1 3 3 3 3 3 3. The 40th
        // percentile has rank 3.6: 1 + 0.6 x 2; the 35th has rank 3.15: 1 + 0.15 x 2; the 30th has rank 2.7: 1, the end.
        let steps = steps(&[7, 4, 0, 6]);
        assert_eq!(steps.len(), 13);
        assert!(steps[..11].iter().all(|&s| s == 3.0));
        assert!((steps[11] - 2.2).abs() < 1e-9 && (steps[12] - 1.3).abs() < 1e-9);
        assert_eq!(super::steps(&[3, 0, 0]), Vec::<f64>::new());
        // One observer everywhere: 95 down to 50.
        assert_eq!(super::steps(&[0, 5]), vec![1.0; 10]);
    }

    #[test]
    fn pairs_are_counted_in_both_orders_and_with_themselves() {
        // 0b11 and 0b01: with themselves 2 and 1, together 1 twice.
        assert_eq!(observers(&[&[0b11], &[0b01]], 2), [0, 3, 1]);
    }

    #[test]
    fn points_stay_that_the_masks_of_the_object_hold_and_the_largest_cover_first() {
        let masks = world(false);
        let (nodes, steps, _) = nodes(&masks, &RULES);
        let nodes = cluster(nodes, 8, &steps, 0.9);
        assert_eq!(nodes.len(), 2);
        let parts = vec![vec![0, 1, 2, 3], (4..10).collect()];
        let objects = refine(&masks, &nodes[0], parts, 0.5);
        // All masks have 6 points in the second part, 4 in the first: the first has no masks, but its points.
        assert_eq!((objects[0].masks.len(), objects[0].points.len()), (0, 4));
        assert_eq!(objects[1].masks, [0, 2, 4, 6].map(|r| (r, 1.0)));
        assert_eq!(objects[1].weights, [4.0; 6]);
        // A node of one mask alone that sees four frames: each point is in it in one of them.
        let one = Node { masks: vec![0], ..nodes[0].clone() };
        assert!(refine(&masks, &one, vec![union(&masks, &one)], 0.5).is_empty());
    }

    #[test]
    fn an_object_in_another_goes_and_points_have_one_label() {
        let object = |points: Vec<u32>, w: f64| Object { weights: vec![w; points.len()], points, masks: Vec::new() };
        // The first lies in the second; the third shares a point with it and weighs more there.
        let objects = vec![object(vec![0, 1], 9.0), object(vec![0, 1, 2, 3], 1.0), object(vec![3, 4], 2.0)];
        let left = drop_inside(objects, 6, 0.8);
        assert_eq!(left.len(), 2);
        assert_eq!(exclusive(&left, 6), (vec![0, 0, 0, 1, 1, -1], vec![0, 1]));
        // Those without a label take the object of most weight: 1.5 against 1. One that has a label keeps it.
        let mut labels = vec![-1, 0, -1];
        fill(&mut labels, &[(0, 0, 1.0), (1, 0, 1.0), (1, 0, 0.5), (1, 1, 9.0), (0, 2, 0.0)]);
        assert_eq!(labels, [1, 0, -1]);
        // One whose points all go to others has no label.
        let hidden = [object(vec![0], 1.0), object(vec![0, 1], 2.0)];
        assert_eq!(exclusive(&hidden, 2), (vec![0, 0], vec![1]));
    }

    #[test]
    fn parts_are_connected_and_of_four_points() {
        // A chain 0-1-2-3, a chain 4-5; the edge 3-4 leads out of reach.
        let gaussian_knn = ndarray::arr2(&[[1], [2], [3], [4], [5], [4]]);
        let graph = Graph { kept: (0..6).collect(), gaussian_knn, ..Graph::default() };
        let points: Vec<u32> = (0..6).collect();
        assert_eq!(parts(&points, &graph, |a, b| (a, b) != (3, 4)), [vec![0, 1, 2, 3]]);
        assert_eq!(parts(&points, &graph, |_, _| true), [points]);
    }
}
