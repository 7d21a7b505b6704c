//! From the answer of a panoptic model to segments, by the rules of `post_process_panoptic_segmentation` in transformers.
//!
//! A query is a class and a mask. A pixel goes to the query whose probability there, times the score of its class, is the
//! largest. A query that gets too little of what it claims is no segment, and its pixels belong to none.

use super::Family;
use crate::logits::{Taps, taps};
use rayon::prelude::*;
use std::iter::zip;

/// Side of the masks of Mask2Former before they are scaled to the map.
const MASK2FORMER_SIDE: usize = 384;

/// Logits beyond this are as sure as this.
const MOST_LOGIT: f32 = 100.0;

/// What a query must have to be a segment.
#[derive(Debug, Clone, Copy)]
pub(super) struct Rule {
    pub family: Family,
    /// The score of its class is larger.
    pub threshold: f32,
    /// It claims the pixels where it has at least this probability, 0 to 1.
    pub mask_threshold: f32,
    /// The pixels that it gets are more than this share of those that it claims.
    pub overlap: f64,
}

/// A query whose class is sufficiently sure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Query {
    pub index: usize,
    pub class: usize,
    pub score: f32,
}

/// Numbers `[height][width]`.
struct Plane {
    width: usize,
    height: usize,
    values: Vec<f32>,
}

impl Plane {
    /// Writes a row of the plane, scaled linearly.
    fn row(&self, (y0, y1, fy): Taps, columns: &[Taps], out: &mut Vec<f32>) {
        let row = |y: usize| &self.values[y * self.width..][..self.width];
        let line: Vec<f32> = zip(row(y0), row(y1)).map(|(a, b)| a + (b - a) * fy).collect();
        out.extend(columns.iter().map(|&(x0, x1, fx)| line[x0] + (line[x1] - line[x0]) * fx));
    }

    /// The first columns and rows, as many as `part` says, of the plane scaled to a width and height.
    fn scaled(&self, to: [usize; 2], part: [usize; 2]) -> Self {
        let columns = &taps(to[0], self.width as f64, self.width)[..part[0]];
        let mut values = Vec::with_capacity(part[0] * part[1]);
        for row in taps(to[1], self.height as f64, self.height).into_iter().take(part[1]) {
            self.row(row, columns, &mut values);
        }
        Self { width: part[0], height: part[1], values }
    }

    fn sigmoid(mut self) -> Self {
        self.values.iter_mut().for_each(|v| *v = sigmoid(*v));
        self
    }
}

pub(crate) fn sigmoid(v: f32) -> f32 {
    1.0 / (1.0 + (-v).exp())
}

/// Pixels that a query gets, that it claims, and that it gets and shows.
type Areas = [usize; 3];

impl Rule {
    /// The queries that are of some class, by logits `[queries][classes + 1]` of which the last is for none.
    pub fn sure(&self, logits: &[f32], classes: usize) -> Vec<Query> {
        let best = |(index, logits): (usize, &[f32])| {
            let (class, &top) = logits.iter().enumerate().reduce(|a, b| if b.1 > a.1 { b } else { a })?;
            let score = 1.0 / logits.iter().map(|l| (l - top).exp()).sum::<f32>();
            (class < classes && score > self.threshold).then_some(Query { index, class, score })
        };
        logits.chunks_exact(classes + 1).enumerate().filter_map(best).collect()
    }

    /// Ids `[height][width]` of `size` (width and height), -1 for none, and the query of each id.
    ///
    /// `masks` are logits `[all queries][rows][columns]`, `shape` rows and columns. They show the model's input of size
    /// `input`, of which the photograph fills `inside` from the upper left corner.
    pub fn segments(
        &self,
        queries: Vec<Query>,
        masks: &[f32],
        shape: [usize; 2],
        [inside, input]: [[usize; 2]; 2],
        size: [usize; 2],
    ) -> (Vec<i32>, Vec<Query>) {
        let planes: Vec<Plane> = queries.par_iter().map(|q| self.plane(q, masks, shape, inside, input)).collect();
        let [width, height] = size;
        let mut ids = vec![-1; width * height];
        let Some(Plane { width: w, height: h, .. }) = planes.first() else { return (ids, queries) };
        let (columns, rows) = (taps(width, *w as f64, *w), taps(height, *h as f64, *h));
        let none = || vec![Areas::default(); queries.len()];
        let areas = ids
            .par_chunks_mut(width.max(1))
            .zip(rows)
            .fold(none, |mut areas, (ids, row)| {
                self.share_row(&queries, &planes, row, &columns, ids, &mut areas);
                areas
            })
            .reduce(none, |a, b| zip(a, b).map(|(a, b)| [a[0] + b[0], a[1] + b[1], a[2] + b[2]]).collect());
        // The ratio in 32 bits against a bound in 64, as there: four fifths are more than 0.8.
        let stays = |&[got, claimed, shown]: &Areas| {
            claimed > 0 && shown > 0 && f64::from(got as f32 / claimed as f32) > self.overlap
        };
        let found: Vec<usize> = (0..queries.len()).filter(|&k| stays(&areas[k])).collect();
        let mut id_of = vec![-1; queries.len()];
        zip(0.., &found).for_each(|(id, &k)| id_of[k] = id);
        ids.iter_mut().filter(|id| **id >= 0).for_each(|id| *id = id_of[*id as usize]);
        (ids, found.into_iter().map(|k| queries[k]).collect())
    }

    /// The mask of a query as it is scaled to the map: probabilities, or logits of EoMT.
    fn plane(&self, q: &Query, masks: &[f32], [h, w]: [usize; 2], inside: [usize; 2], input: [usize; 2]) -> Plane {
        let values = &masks[q.index * w * h..][..w * h];
        let values = values.iter().map(|v| v.clamp(-MOST_LOGIT, MOST_LOGIT)).collect();
        let plane = Plane { width: w, height: h, values };
        match self.family {
            Family::Detr | Family::OneFormer => plane.sigmoid(),
            Family::Mask2Former => plane.scaled([MASK2FORMER_SIDE; 2], [MASK2FORMER_SIDE; 2]).sigmoid(),
            Family::Eomt => plane.scaled(input, inside),
        }
    }

    /// Gives the pixels of a row of the map to queries, whose numbers `ids` gets, and counts them.
    fn share_row(
        &self,
        queries: &[Query],
        planes: &[Plane],
        row: Taps,
        columns: &[Taps],
        ids: &mut [i32],
        areas: &mut [Areas],
    ) {
        let eomt = self.family == Family::Eomt;
        let mut best = vec![(f32::NEG_INFINITY, false); ids.len()];
        let mut values = Vec::with_capacity(ids.len());
        for (k, (query, plane)) in zip(queries, planes).enumerate() {
            values.clear();
            plane.row(row, columns, &mut values);
            for ((&value, best), id) in zip(&values, &mut best).zip(ids.iter_mut()) {
                let probability = if eomt { sigmoid(value) } else { value };
                let weighed = probability * query.score;
                // All but EoMT claim by the weighed probability.
                let claimed = if eomt { probability } else { weighed } >= self.mask_threshold;
                areas[k][1] += usize::from(claimed);
                if weighed > best.0 {
                    // EoMT shows only what is claimed too.
                    *best = (weighed, claimed || !eomt);
                    *id = k as i32;
                }
            }
        }
        for (id, (_, shown)) in zip(ids, best) {
            let areas = &mut areas[*id as usize];
            areas[0] += 1;
            areas[2] += usize::from(shown);
            if !shown {
                *id = -1;
            }
        }
    }
}
