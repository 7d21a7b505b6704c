//! Masks of everything in a photograph: SAM asked at a grid of points.
//!
//! The points of the grid are asked from coarse to fine. A point is not asked when it lies within a small-level mask
//! found in an earlier round, because the answer would be much the same three masks; unless no whole thing (level large)
//! has been found there yet and the small mask has not been asked often. The rounds are fixed by the grid, so that the
//! result does not depend on the number of threads.

use crate::logits::{Grid, Logits};
use crate::nms::{GOOD, Pixels, Rated, box_nms, mask_nms, merges_things};
use crate::options::Choice;
use crate::sam::{Candidates, Embedded, Sam};
use artifacts::Level;
use gs_io::Result;
use onnx_models::parallel_map;

/// Levels of SAM's masks.
pub const SAM_LEVELS: usize = Level::SAM.len();
/// Distance of the two thresholds of the stability score from 0, as in SAM.
const STABILITY_OFFSET: f32 = 1.0;
/// How often a small mask is asked in the hope of the whole thing that it is part of.
const ASK_UNTIL_WHOLE: usize = 5;

/// Largest part of the photograph that a mask may cover: what is larger is no thing but most of the room.
const MAX_AREA: f64 = 0.6;
/// Of masks whose boxes overlap by more than this (IoU) the best stays: as in SAM's own script.
const BOX_NMS: f64 = 0.7;

/// One mask of one prompt, good enough to be considered.
#[derive(Debug, Clone)]
pub struct Proposal {
    /// Level by SAM's own order: 1 small, 2 medium, 3 large.
    pub level: usize,
    /// Predicted IoU.
    pub quality: f32,
    /// Predicted IoU x stability.
    pub score: f32,
    /// Its pixels in the decoder's resolution, those of `Grid`.
    pub pixels: Pixels,
    /// How sure it is of them.
    pub logits: Logits,
}

/// Considered masks of a photograph.
pub struct Proposals {
    /// Pixels that they are given in.
    pub grid: Grid,
    /// In the order of the prompts.
    pub masks: Vec<Proposal>,
    /// Points asked.
    pub asked: usize,
    /// Points of the grid.
    pub points: usize,
}

/// The grid's points in the order of rounds: every fourth of a row of every fourth row, every second of every second,
/// then between them. Coordinates in 0..1 of width and height.
pub fn rounds(points_per_side: usize, aspect: f64) -> [Vec<[f64; 2]>; 5] {
    let n = points_per_side.max(1);
    let short = |ratio: f64| ((n as f64 * ratio).round() as usize).max(1);
    let (nx, ny) = if aspect >= 1.0 { (n, short(1.0 / aspect)) } else { (short(aspect), n) };
    let mut rounds: [Vec<[f64; 2]>; 5] = Default::default();
    for j in 0..ny {
        for i in 0..nx {
            let round = match (i % 4, j % 4) {
                (1, 1) => 0,
                (1 | 3, 1 | 3) => 1,
                (0 | 2, 0 | 2) => 2,
                (0 | 2, _) => 3,
                _ => 4,
            };
            rounds[round].push([(i as f64 + 0.5) / nx as f64, (j as f64 + 0.5) / ny as f64]);
        }
    }
    rounds
}

/// Asks SAM at the points of the grid and keeps what passes the filters.
///
/// # Errors
/// When the decoder fails.
pub fn propose(sam: &Sam, embedded: &Embedded, choice: &Choice) -> Result<Proposals> {
    let grid = Grid::of(embedded);
    let mut masks: Vec<Proposal> = Vec::new();
    let mut asked: Vec<[f64; 2]> = Vec::new();
    let mut points = 0;
    for round in rounds(choice.points_per_side, embedded.aspect) {
        points += round.len();
        let at_level = |l: usize| masks.iter().filter(move |m| m.level == l);
        let times = |p: &Pixels| asked.iter().filter(|&&a| p.contains(grid.index(a))).count();
        let small: Vec<(&Pixels, usize)> = at_level(1).map(|m| (&m.pixels, times(&m.pixels))).collect();
        let good = at_level(SAM_LEVELS - 1).filter(|m| m.score > GOOD);
        let whole: Vec<&Pixels> = good.map(|m| &m.pixels).collect();
        let known = |point: [f64; 2]| {
            let i = grid.index(point);
            let is_whole = whole.iter().any(|w| w.contains(i));
            small.iter().any(|(s, times)| s.contains(i) && (is_whole || *times >= ASK_UNTIL_WHOLE))
        };
        let ask: Vec<[f64; 2]> = round.into_iter().filter(|&p| choice.no_skip || !known(p)).collect();
        let found = parallel_map(ask.len(), |i| {
            Ok(consider(&sam.decode(embedded, ask[i], choice.pred_iou as f32)?, &grid, choice))
        })?;
        masks.extend(found.into_iter().flatten());
        asked.extend(ask);
    }
    Ok(Proposals { grid, masks, asked: asked.len(), points })
}

/// Masks of one answer that pass the filters.
fn consider(answer: &Candidates, grid: &Grid, choice: &Choice) -> Vec<Proposal> {
    let mut good = Vec::new();
    for (&(m, quality), square) in answer.masks.iter().zip(answer.logits.chunks_exact(Sam::MASK_SIDE * Sam::MASK_SIDE))
    {
        let row = |y: usize| &square[y * Sam::MASK_SIDE..y * Sam::MASK_SIDE + grid.width];
        let above = |t: f32| (0..grid.height).map(|y| row(y).iter().filter(|&&l| l > t).count()).sum::<usize>();
        let stability = above(STABILITY_OFFSET) as f32 / above(-STABILITY_OFFSET).max(1) as f32;
        let inside: Vec<bool> = (0..grid.height).flat_map(|y| row(y).iter().map(|&l| l > 0.0)).collect();
        let pixels = Pixels::new(grid.width, inside.into_iter());
        let most = (MAX_AREA * grid.extent[0] * grid.extent[1]) as usize;
        if stability < choice.stability as f32 || pixels.area == 0 || pixels.area > most {
            continue;
        }
        let logits = Logits::new(row, grid, pixels.bounds);
        good.push(Proposal { level: m + 1, quality, score: quality * stability, pixels, logits });
    }
    good
}

/// The masks of each level (default, small, medium, large) as indices into `masks`: those that merge several
/// things go ([`merges_things`]), then box suppression, then LangSplat's.
///
/// Levels are SAM's own three masks per prompt; default is all of them together. Then [`fill`].
pub fn levels(masks: &[Proposal]) -> [Vec<usize>; SAM_LEVELS] {
    let by_boxes = |c: Vec<usize>| -> Vec<usize> {
        let rated: Vec<Rated> = c.iter().map(|&i| (&masks[i].pixels, masks[i].quality)).collect();
        box_nms(&rated, BOX_NMS).into_iter().map(|k| c[k]).collect()
    };
    let by_masks = |c: Vec<usize>| -> Vec<usize> {
        let rated: Vec<Rated> = c.iter().map(|&i| (&masks[i].pixels, masks[i].score)).collect();
        mask_nms(&rated).into_iter().map(|k| c[k]).collect()
    };
    // Masks of level large are whole things; a mask around several of them is none itself.
    let things: Vec<Rated> = masks.iter().filter(|m| m.level == SAM_LEVELS - 1).map(|m| (&m.pixels, m.score)).collect();
    let single: Vec<usize> =
        (0..masks.len()).filter(|&i| !merges_things(&masks[i].pixels, masks[i].score, &things)).collect();
    let mut chosen: [Vec<usize>; SAM_LEVELS] = Default::default();
    for (level, slot) in chosen.iter_mut().enumerate().skip(1) {
        *slot = by_masks(by_boxes(single.iter().copied().filter(|&i| masks[i].level == level).collect()));
    }
    chosen[0] = by_masks(by_boxes(single));
    fill(masks, &chosen)
}

/// Part of a mask that a level must not cover yet for the level to take it.
const FILL_FREE: f64 = 0.7;

/// Levels small, medium and large with masks of the other two added where they have none: what has no larger whole is
/// itself whole, what has no parts is its own part. From the best score down, a mask is taken when the level covers at
/// most 30% of it. Without this a thing for which SAM finds no good mask at a level is absent from it, as most small
/// things are from level large.
pub fn fill(masks: &[Proposal], chosen: &[Vec<usize>; SAM_LEVELS]) -> [Vec<usize>; SAM_LEVELS] {
    let mut filled = chosen.clone();
    for (level, slot) in filled.iter_mut().enumerate().skip(1) {
        let mut others: Vec<usize> =
            (1..SAM_LEVELS).filter(|&l| l != level).flat_map(|l| chosen[l].iter().copied()).collect();
        others.sort_by(|&a, &b| masks[b].score.total_cmp(&masks[a].score).then(a.cmp(&b)));
        let mut covered = slot.iter().fold(Pixels::default(), |all, &i| all.union(&masks[i].pixels));
        for i in others {
            let mask = &masks[i].pixels;
            if (mask.area - covered.overlap(mask)) as f64 >= FILL_FREE * mask.area as f64 {
                covered = covered.union(mask);
                slot.push(i);
            }
        }
    }
    filled
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeSet;

    proptest! {
        #[test]
        fn rounds_are_the_whole_grid(n in 1usize..40, aspect in 0.2f64..5.0) {
            let all: Vec<[f64; 2]> = rounds(n, aspect).concat();
            let long = if aspect >= 1.0 { 0 } else { 1 };
            let distinct = |axis: usize| all.iter().map(|p| p[axis].to_bits()).collect::<BTreeSet<_>>().len();
            prop_assert_eq!(distinct(long), n);
            prop_assert_eq!(all.len(), n * distinct(1 - long));
            prop_assert!(all.iter().flatten().all(|&c| c > 0.0 && c < 1.0));
        }
    }

    const CHOICE: Choice = Choice { points_per_side: 4, pred_iou: 0.7, stability: 0.7, no_skip: false };

    #[test]
    fn filters_see_the_stability_of_the_photograph_part_only() {
        let side = Sam::MASK_SIDE;
        let grid = Grid { width: side, height: 2, extent: [side as f64, 2.0] };
        // Row 0 is inside by a wide margin; row 1 is undecided in mask 1; below the photograph all is inside.
        let mask = |row1: f32| (0..side * side).map(move |i| if i / side == 1 { row1 } else { 9.0 });
        let logits: Vec<f32> = mask(-9.0).chain(mask(0.5)).collect();
        let answer = Candidates { masks: vec![(0, 0.9), (1, 0.9)], logits };
        let good = consider(&answer, &grid, &CHOICE);
        // Mask 0: stability 1; mask 1: 1/2, not stable.
        assert_eq!(good.iter().map(|p| (p.level, p.pixels.area)).collect::<Vec<_>>(), [(1, side)]);
        assert!((good[0].score - 0.9).abs() < 1e-6);
        // A mask of everything.
        let all = Candidates { masks: vec![(0, 0.9)], logits: vec![9.0; side * side] };
        assert!(consider(&all, &grid, &CHOICE).is_empty());
    }

    #[test]
    fn levels_take_masks_of_others_where_they_have_none() {
        let rect = |x0: usize, x1: usize, level: usize| Proposal {
            level,
            quality: 0.9,
            score: 0.85,
            pixels: Pixels::new(20, (0..200).map(|i| (x0..x1).contains(&(i % 20)))),
            logits: Logits::new(|_| &[], &Grid { width: 0, height: 0, extent: [0.0; 2] }, [0; 4]),
        };
        let sorted = |v: &[usize]| BTreeSet::from_iter(v.to_vec()).into_iter().collect::<Vec<_>>();
        // A thing of two parts, and a thing alone.
        let own = [rect(0, 10, 3), rect(0, 6, 1), rect(6, 10, 2), rect(12, 20, 3)];
        let l = levels(&own);
        // The part that lies in no whole of level small is taken there, the whole is not; the lone thing is taken everywhere.
        assert_eq!((sorted(&l[1]), sorted(&l[2]), sorted(&l[3])), (vec![1, 2, 3], vec![1, 2, 3], vec![0, 3]));
        assert!(levels(&[]).iter().all(Vec::is_empty));
    }
}
