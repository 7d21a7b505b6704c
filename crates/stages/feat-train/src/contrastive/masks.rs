//! The masks of each view as sparse matrices: masks times Gaussians, and sampled pixels times Gaussians.
//!
//! Rendering is linear for a pixel as well as for a mask: the feature of pixel p is the row w[p,.] times the features.
//! graph-precompute keeps the rows of some pixels of each mask (`--pixel-samples`), so losses of pixels need no rasteriser.

use super::context::{Context, inverse};
use artifacts::{Footprints, Level, PixelSamples};
use gs_io::{Error, Result, mixed};
use std::rc::Rc;

/// Most masks of a view at a level: their numbers have 16 bits.
const MOST_MASKS: usize = 1 << 16;
/// Approximate number of columns that one task works on.
const PIECE: usize = 2048;

/// The masks of one view at one level: the matrix A of docs/method.md, by columns (Gaussians).
#[derive(Debug, Clone, Default)]
pub struct MaskSet {
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
    pub weight: Vec<f32>,
    /// Bounds of the pieces of columns that tasks work on; the Gaussians of an anchor are in one piece.
    pub pieces: Vec<u32>,
    /// Single pixels of the masks; empty where the footprints have none.
    pub sampled: Pixels,
}

impl MaskSet {
    /// Entries of the column at position `c`: masks and weights.
    #[inline]
    pub fn entries(&self, c: usize) -> (&[u16], &[f32]) {
        let range = self.start[c] as usize..self.start[c + 1] as usize;
        (&self.mask[range.clone()], &self.weight[range])
    }

    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// What it takes in memory, about.
    fn bytes(&self) -> usize {
        6 * self.mask.len() + 8 * self.columns.len() + 8 * self.sampled.column.len()
    }
}

/// The mask sets of all views at the given levels, those with at least `least` masks that have a footprint. A set is made when
/// it is asked for, and kept where there is room.
pub struct MaskSets<'a> {
    footprints: &'a Footprints,
    context: &'a Context,
    /// Place in the training order of each kept Gaussian.
    place: Vec<u32>,
    /// Rows of the footprints artifact of each set.
    rows: Vec<Vec<u32>>,
    kept: Vec<Option<Rc<MaskSet>>>,
    /// Bytes that sets may still take.
    room: usize,
}

impl<'a> MaskSets<'a> {
    /// Bytes of sets that are kept.
    pub const MOST: usize = 1 << 29;

    pub fn new(footprints: &'a Footprints, context: &'a Context, levels: &[Level], least: usize) -> Result<Self> {
        let mut sets = Vec::new();
        let mut from = 0;
        for group in footprints.rows.chunk_by(|a, b| (a.view, a.level) == (b.view, b.level)) {
            let (first, all) = (group[0], from..from + group.len());
            from = all.end;
            let shows = |&r: &usize| footprints.rows[r].gated > 0 && footprints.entries_of(r) > 0;
            let rows: Vec<u32> = all.filter(shows).map(|r| r as u32).collect();
            if first.is_of(levels) && rows.len() >= least {
                if rows.len() > MOST_MASKS {
                    return Err(Error::new("more masks than can be numbered")
                        .file(footprints.artifact().path())
                        .field(format!("view {:?}", footprints.views[first.view as usize]))
                        .found(rows.len())
                        .expected(format!("at most {MOST_MASKS}")));
                }
                sets.push(rows);
            }
        }
        let (place, kept) = (inverse(&context.order), vec![None; sets.len()]);
        Ok(Self { footprints, context, place, rows: sets, kept, room: Self::MOST })
    }

    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// Whether some mask has sampled pixels.
    pub fn have_pixels(&self) -> bool {
        self.rows.iter().flatten().any(|r| self.footprints.pixels.row.binary_search(r).is_ok())
    }

    /// The set of this number.
    ///
    /// # Errors
    /// When the footprints can't be read.
    pub fn get(&mut self, number: usize) -> Result<Rc<MaskSet>> {
        if let Some(set) = &self.kept[number] {
            return Ok(Rc::clone(set));
        }
        let set = Rc::new(mask_set(self.footprints, &self.rows[number], &self.place, self.context)?);
        if let Some(left) = self.room.checked_sub(set.bytes()) {
            self.room = left;
            self.kept[number] = Some(Rc::clone(&set));
        }
        Ok(set)
    }
}

fn mask_set(footprints: &Footprints, rows: &[u32], place: &[u32], context: &Context) -> Result<MaskSet> {
    let count = rows.iter().map(|&r| footprints.entries_of(r as usize)).sum();
    let mut entries: Vec<(u32, u16, f32)> = Vec::with_capacity(count);
    for (k, &r) in rows.iter().enumerate() {
        let gated = footprints.rows[r as usize].gated as f32;
        entries.extend(footprints.entries(r as usize)?.iter().map(|(i, w)| (place[i as usize], k as u16, w / gated)));
    }
    let pixels = rows.iter().map(|&r| f64::from(footprints.rows[r as usize].gated)).collect();
    let mut set = MaskSet::from_entries(rows.to_vec(), pixels, entries, context);
    set.sampled = Pixels::of_masks(&footprints.pixels, rows, |col| {
        set.columns.binary_search(&place[col as usize]).ok().map(|c| c as u32)
    });
    Ok(set)
}

impl MaskSet {
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
            weight: entries.iter().map(|t| t.2).collect(),
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
        set.pieces = pieces(&set.columns, context);
        set
    }
}

/// Cuts columns into pieces of about `PIECE`, only between the Gaussians of different anchors.
fn pieces(columns: &[u32], context: &Context) -> Vec<u32> {
    let mut cuts = vec![0u32];
    for c in 1..columns.len() {
        if c - *cuts.last().expect("begins with 0") as usize >= PIECE && context.parts(columns[c - 1], columns[c]) {
            cuts.push(c as u32);
        }
    }
    cuts.push(columns.len() as u32);
    cuts
}

/// Pixels of the masks of one view: a sparse matrix of pixels and columns of the [`MaskSet`].
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Pixels {
    /// Mask of each pixel, below K, ascending; P.
    pub mask: Vec<u16>,
    /// Where the entries of each pixel begin; P + 1, or empty.
    pub start: Vec<u32>,
    /// Column of each entry, as a position in [`MaskSet::columns`].
    pub column: Vec<u32>,
    /// Blending weight of each entry.
    pub weight: Vec<f32>,
}

impl Pixels {
    /// Those of the masks `rows` (ascending rows of the footprints). `column` gives the position of a kept Gaussian among
    /// the columns; entries without one, which a cut of the footprints may leave, are dropped.
    pub fn of_masks(samples: &PixelSamples, rows: &[u32], column: impl Fn(u32) -> Option<u32>) -> Self {
        let mut out = Self { start: vec![0], ..Self::default() };
        for (k, &row) in rows.iter().enumerate() {
            let from = samples.row.partition_point(|&r| r < row);
            let to = from + samples.row[from..].partition_point(|&r| r == row);
            for p in from..to {
                for e in samples.ptr[p] as usize..samples.ptr[p + 1] as usize {
                    if let Some(c) = column(samples.col[e]) {
                        out.column.push(c);
                        out.weight.push(samples.weight[e]);
                    }
                }
                out.mask.push(k as u16);
                out.start.push(out.column.len() as u32);
            }
        }
        out
    }

    /// `count` pixels of each mask, chosen by `noise`, ascending; all pixels where `count` is 0.
    pub fn drawn(&self, count: usize, noise: u64) -> Vec<usize> {
        let mut all: Vec<usize> = (0..self.mask.len()).collect();
        if count == 0 {
            return all;
        }
        let mut chosen = Vec::new();
        for of_mask in all.chunk_by_mut(|&a, &b| self.mask[a] == self.mask[b]) {
            of_mask.sort_unstable_by_key(|&p| (mixed(noise ^ p as u64), p));
            let (few, _) = of_mask.split_at_mut(count.min(of_mask.len()));
            few.sort_unstable();
            chosen.extend_from_slice(few);
        }
        chosen
    }

    pub fn entries(&self, p: usize) -> impl Iterator<Item = (usize, f64)> + '_ {
        let range = self.start[p] as usize..self.start[p + 1] as usize;
        self.column[range.clone()].iter().zip(&self.weight[range]).map(|(&c, &w)| (c as usize, f64::from(w)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::contrastive::testing;
    use artifacts::{FootprintsBuilder, Row};
    use gs_io::Provenance;

    #[test]
    fn sets_that_are_not_kept_are_made_again() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("footprints.safetensors");
        let views = vec!["a".into(), "b".into()];
        let mut builder = FootprintsBuilder { views, kept: (0..40).collect(), ..FootprintsBuilder::default() };
        for (view, mask) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
            let row = Row { view, mask, gated: 4, pixels: 4, ..Row::default() };
            builder.push(row, (0..40).filter(|i| i % 2 == mask).map(|i| (i, 1.0)));
        }
        builder.write(&file, Provenance::default()).unwrap();
        let footprints = Footprints::read(&file).unwrap();
        let context = testing::context(40, true);
        let mut sets = MaskSets::new(&footprints, &context, &[Level::DEFAULT], 2).unwrap();
        let kept = sets.get(1).unwrap();
        assert!(sets.len() == 2 && Rc::ptr_eq(&kept, &sets.get(1).unwrap()));
        sets.room = 0;
        let made = sets.get(0).unwrap();
        let again = sets.get(0).unwrap();
        assert!(!Rc::ptr_eq(&made, &again));
        assert_eq!((&made.columns, &made.mask, &made.weight), (&again.columns, &again.mask, &again.weight));
        assert_eq!((made.columns.len(), made.weight[0]), (40, 0.25));
    }

    #[test]
    fn pixels_follow_their_masks_and_cut_entries_are_dropped() {
        let samples = PixelSamples {
            row: vec![3, 5, 5, 9],
            ptr: vec![0, 1, 3, 4, 5],
            col: vec![0, 1, 2, 1, 7],
            weight: vec![0.1, 0.2, 0.3, 0.4, 0.5],
        };
        let p = Pixels::of_masks(&samples, &[4, 5, 9], |c| (c != 2).then_some(c + 10));
        let want = Pixels {
            mask: vec![1, 1, 2],
            start: vec![0, 1, 2, 3],
            column: vec![11, 11, 17],
            weight: vec![0.2, 0.4, 0.5],
        };
        assert_eq!(p, want);
        assert!(Pixels::of_masks(&PixelSamples::default(), &[1, 2], Some).mask.is_empty());
    }

    #[test]
    fn pixels_are_drawn_anew_but_as_many_of_every_mask() {
        let pixels = Pixels { mask: [vec![0; 20], vec![3; 2], vec![4; 20]].concat(), ..Pixels::default() };
        assert_eq!(pixels.drawn(0, 1), (0..42).collect::<Vec<_>>());
        let (first, second) = (pixels.drawn(5, 1), pixels.drawn(5, 2));
        for drawn in [&first, &second] {
            assert_eq!([0, 3, 4].map(|k| drawn.iter().filter(|&&p| pixels.mask[p] == k).count()), [5, 2, 5]);
            assert!(drawn.is_sorted());
        }
        assert_ne!(first, second);
    }
}
