//! What training reads of a scene: the frozen context graph, and the footprints of the masks of each view.
//!
//! Anchors are put along a space-filling curve and Gaussians in the order of their nearest anchor, so that everything an
//! anchor serves lies together: sums over an anchor's Gaussians are sums over a range, no two threads ever add to the same
//! place, and what a view sees, or an anchor aggregates, is mostly near in memory too.

use crate::pixels::Pixels;
use crate::real::Weight;
use artifacts::{Footprints, Graph, Level};
use gs_io::{Error, Result};
use gs_scene::morton_order;

/// No anchor.
pub const NONE: u32 = u32::MAX;
/// Masks of a view at a level, at most: what 16 bits can number.
const MOST_MASKS: usize = 1 << 16;
/// Columns in a piece of work, about.
const PIECE: usize = 2048;

/// Which neighbours an anchor aggregates.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Neighbours {
    /// Its nearest Gaussians, whose inputs do not change from layer to layer (the paper's formula).
    Gaussians,
    /// Its nearest anchors, with their features of the layer before (the paper's text: "distance between anchors").
    Anchors,
    /// Its nearest anchors, with their inputs at every layer: the formula's shared input over the text's neighbours.
    AnchorInputs,
}

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
    /// Places in the training order, or anchors, as asked for.
    pub neighbours: Vec<u32>,
    /// Of which kind they are.
    pub kind: Neighbours,
    /// The graph of anchors backwards, for gradients: where the anchors begin that have anchor a as a neighbour.
    pub reverse_start: Vec<u32>,
    /// Those anchors.
    pub reverse: Vec<u32>,
}

impl Context {
    /// Prepares the graph; `colors` and `positions` are those of the kept Gaussians. Without `propagate` an anchor's output
    /// goes to the anchor's own Gaussian alone.
    pub fn new(graph: &Graph, colors: &[[f32; 3]], positions: &[[f32; 3]], kind: Neighbours, propagate: bool) -> Self {
        let (n, m, k) = (graph.kept.len(), graph.anchors.len(), graph.k);
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
            let row = a * k..(a + 1) * k;
            // Rows are padded with the anchor itself, which is not its own neighbour.
            let others = graph.anchor_knn[row.clone()].iter().map(|&b| b as usize).filter(|&b| b != a);
            match kind {
                Neighbours::Gaussians => neighbours
                    .extend(graph.knn[row].iter().filter(|&&i| i != graph.anchors[a]).map(|&i| place[i as usize])),
                Neighbours::AnchorInputs => neighbours.extend(others.map(|b| place[graph.anchors[b] as usize])),
                Neighbours::Anchors => neighbours.extend(others.map(|b| rank[b])),
            }
            neighbour_start.push(neighbours.len() as u32);
        }
        let (reverse_start, reverse) = match kind {
            Neighbours::Anchors => transpose(&neighbour_start, &neighbours, m),
            Neighbours::Gaussians | Neighbours::AnchorInputs => (vec![0; m + 1], Vec::new()),
        };
        let colors = order.iter().map(|&i| colors[i as usize]).collect();
        Self { order, colors, anchors, source, served, neighbour_start, neighbours, kind, reverse_start, reverse }
    }

    /// Neighbours of anchor `a`.
    #[inline]
    pub fn neighbours_of(&self, a: usize) -> &[u32] {
        &self.neighbours[self.neighbour_start[a] as usize..self.neighbour_start[a + 1] as usize]
    }

    /// Anchors that have anchor `a` as a neighbour.
    #[inline]
    pub fn reverse_of(&self, a: usize) -> &[u32] {
        &self.reverse[self.reverse_start[a] as usize..self.reverse_start[a + 1] as usize]
    }
}

/// Whether the neighbours of this kind are places in the training order.
pub fn inputs_are_of_gaussians(kind: Neighbours) -> bool {
    kind != Neighbours::Anchors
}

/// The inverse of a permutation.
fn inverse(permutation: &[u32]) -> Vec<u32> {
    let mut out = vec![0u32; permutation.len()];
    for (to, &from) in permutation.iter().enumerate() {
        out[from as usize] = to as u32;
    }
    out
}

/// Adjacency lists the other way round; sources ascend.
fn transpose(start: &[u32], targets: &[u32], m: usize) -> (Vec<u32>, Vec<u32>) {
    let mut out_start = vec![0u32; m + 1];
    for &t in targets {
        out_start[t as usize + 1] += 1;
    }
    for i in 0..m {
        out_start[i + 1] += out_start[i];
    }
    let mut next = out_start.clone();
    let mut out = vec![0u32; targets.len()];
    for a in 0..m {
        for &t in &targets[start[a] as usize..start[a + 1] as usize] {
            out[next[t as usize] as usize] = a as u32;
            next[t as usize] += 1;
        }
    }
    (out_start, out)
}

/// The masks of one view at one level: the matrix A of docs/method.md, by columns (Gaussians).
#[derive(Debug, Clone)]
pub struct MaskSet<W = f32> {
    /// Rows of the footprints artifact; K.
    pub rows: Vec<u32>,
    /// Gated pixels of each mask; K.
    pub pixels: Vec<f64>,
    /// Places in the training order, ascending; v.
    pub columns: Vec<u32>,
    /// Where the entries of each column begin; v + 1.
    pub start: Vec<u32>,
    /// Mask of each entry, below K, ascending within a column.
    pub mask: Vec<u16>,
    /// A[mask, column]: summed blending weight over gated pixels.
    pub weight: Vec<W>,
    /// Bounds of the pieces in which columns are worked on; the Gaussians of an anchor are never parted.
    pub pieces: Vec<u32>,
    /// Single pixels of the masks; empty where the footprints have none.
    pub sampled: Pixels,
}

impl<W> Default for MaskSet<W> {
    fn default() -> Self {
        Self {
            rows: Vec::new(),
            pixels: Vec::new(),
            columns: Vec::new(),
            start: Vec::new(),
            mask: Vec::new(),
            weight: Vec::new(),
            pieces: Vec::new(),
            sampled: Pixels::default(),
        }
    }
}

impl<W: Weight> MaskSet<W> {
    /// Entries of the column at position `c`: masks and weights.
    #[inline]
    pub fn entries(&self, c: usize) -> (&[u16], &[W]) {
        let range = self.start[c] as usize..self.start[c + 1] as usize;
        (&self.mask[range.clone()], &self.weight[range])
    }

    /// Number of masks.
    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// Whether there is no mask.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }
}

/// The mask sets of all views at the given levels, those with at least `least` masks that have a footprint.
///
/// # Errors
/// When a view has more masks than 16 bits can number.
pub fn mask_sets<W: Weight>(
    footprints: &Footprints,
    context: &Context,
    levels: &[Level],
    least: usize,
) -> Result<Vec<MaskSet<W>>> {
    let place = inverse(&context.order);
    let mut sets = Vec::new();
    let mut from = 0;
    while from < footprints.rows.len() {
        let first = footprints.rows[from];
        let same = |r: &artifacts::Row| (r.view, r.level) == (first.view, first.level);
        let to = from + footprints.rows[from..].iter().take_while(|r| same(r)).count();
        let rows: Vec<u32> = (from..to)
            .filter(|&r| footprints.rows[r].gated > 0 && !footprints.entries(r).0.is_empty())
            .map(|r| r as u32)
            .collect();
        if levels.iter().any(|&l| l as u32 == first.level) && rows.len() >= least {
            if rows.len() > MOST_MASKS {
                return Err(Error::new("more masks than can be numbered")
                    .file(footprints.artifact().path())
                    .field(format!("view {:?}", footprints.views[first.view as usize]))
                    .found(rows.len())
                    .expected(format!("at most {MOST_MASKS}")));
            }
            sets.push(mask_set(footprints, &rows, &place, context));
        }
        from = to;
    }
    Ok(sets)
}

impl Context {
    /// Whether the Gaussian at a place begins another anchor's run.
    fn source_group(&self) -> impl Fn(u32, u32) -> bool + '_ {
        |a, b| self.source[a as usize] != self.source[b as usize] || self.source[a as usize] == NONE
    }
}

fn mask_set<W: Weight>(footprints: &Footprints, rows: &[u32], place: &[u32], context: &Context) -> MaskSet<W> {
    let count = rows.iter().map(|&r| footprints.entries(r as usize).0.len()).sum();
    let mut entries: Vec<(u32, u16, f32)> = Vec::with_capacity(count);
    for (k, &r) in rows.iter().enumerate() {
        let (col, weight) = footprints.entries(r as usize);
        let gated = footprints.rows[r as usize].gated as f32;
        entries.extend(col.iter().zip(weight).map(|(&c, &w)| (place[c as usize], k as u16, w / gated)));
    }
    let pixels = rows.iter().map(|&r| f64::from(footprints.rows[r as usize].gated)).collect();
    let mut set = MaskSet::from_entries(rows.to_vec(), pixels, entries, context);
    set.sampled = Pixels::of_masks(&footprints.pixels, rows, |col| {
        set.columns.binary_search(&place[col as usize]).ok().map(|c| c as u32)
    });
    set
}

impl<W: Weight> MaskSet<W> {
    /// From entries (place in the training order, mask, weight), in any order.
    pub fn from_entries(
        rows: Vec<u32>,
        pixels: Vec<f64>,
        mut entries: Vec<(u32, u16, f32)>,
        context: &Context,
    ) -> Self {
        entries.sort_unstable_by_key(|t| (t.0, t.1));
        let mut set = Self {
            rows,
            pixels,
            mask: entries.iter().map(|t| t.1).collect(),
            weight: entries.iter().map(|t| W::of(t.2)).collect(),
            ..Self::default()
        };
        let columns = 1 + entries.windows(2).filter(|w| w[0].0 != w[1].0).count();
        set.columns.reserve_exact(columns);
        set.start.reserve_exact(columns + 1);
        for (e, t) in entries.iter().enumerate() {
            if set.columns.last() != Some(&t.0) {
                set.columns.push(t.0);
                set.start.push(e as u32);
            }
        }
        set.start.push(entries.len() as u32);
        set.pieces = pieces(&set.columns, &context.source_group());
        set
    }
}

/// Cuts columns into pieces of about `PIECE`, only where `parted(before, after)` allows.
pub fn pieces(columns: &[u32], parted: &impl Fn(u32, u32) -> bool) -> Vec<u32> {
    let mut cuts = vec![0u32];
    for c in 1..columns.len() {
        if c - *cuts.last().expect("begins with 0") as usize >= PIECE && parted(columns[c - 1], columns[c]) {
            cuts.push(c as u32);
        }
    }
    cuts.push(columns.len() as u32);
    cuts
}
