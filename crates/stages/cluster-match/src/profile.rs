//! What the masks show of a Gaussian or of several, and how far that makes them one thing.

use artifacts::{Footprints, LEVELS, Level, Row};
use gs_io::Result;
use rayon::prelude::*;
use std::borrow::Cow;
use std::cmp::Ordering;
use std::collections::BTreeMap;

/// How much the agreement of each of SAM's levels counts. Two that share small masks are one thing more surely than two that share large
/// ones, and the medium level adds next to nothing. Chosen on scenes for tuning with three kinds of masks (docs/results/real-masks.md).
const COUNTS: [f64; Level::SAM.len()] = [0.4, 1.0, 0.05, 0.6];
/// The same of levels whose masks have names: fitted for classes on seven scenes (docs/results/scans.md), and taken for concepts.
const NAMED: f64 = 1.5;
/// Fewest views and levels that must show both, and least share of their weight in these, for their masks to tell.
const LEAST_COMMON: (usize, f64) = (2, 0.05);

/// The view and level of each mask, as one number; ascending.
pub fn units(footprints: &Footprints) -> Vec<u32> {
    footprints.rows.iter().map(|r| r.view * LEVELS as u32 + r.level).collect()
}

/// Views, evenly spread, whose masks at `levels` have about `most` entries at most.
pub fn some_views(footprints: &Footprints, levels: &[Level], most: u64) -> Vec<bool> {
    let share = (most as f64 / footprints.total_at(levels).max(1) as f64).min(1.0);
    let read = |views: usize| (views as f64 * share).floor();
    (0..footprints.views.len()).map(|v| read(v + 1) > read(v)).collect()
}

/// What the masks show of a Gaussian or of several.
#[derive(Debug, Clone, Default)]
pub struct Profile<'a> {
    /// Mask (by its row in the footprints) and the weight in it, ascending. f32 because single Gaussians have most of the memory.
    masks: Cow<'a, [(u32, f32)]>,
    /// Weight in all masks.
    total: f64,
}

/// How far two belong together.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Agreement {
    /// The probability that a bit of each lies in the same mask, 0 to 1: of each level the mean over the views that show both, by the root
    /// of the product of their weights; of the levels the mean by [`COUNTS`] and [`NAMED`].
    pub value: f64,
    /// Whether enough views show both.
    pub firm: bool,
}

/// The masks of many small pieces, one after the other: the system takes one large block back, but hardly a million small ones.
pub struct Pieces {
    masks: Vec<(u32, f32)>,
    /// Where those of each piece end.
    ends: Vec<usize>,
}

impl Pieces {
    /// Those of `count` pieces in the masks at `levels` of the `views` that hold. `labels` are those of the kept Gaussians. Unlike
    /// [`Profile::of_instances`] it sums in f32 and holds nothing beside the profiles: pieces are many, and their sums short.
    ///
    /// # Errors
    /// When the footprints can't be read.
    pub fn of(labels: &[i32], count: usize, footprints: &Footprints, levels: &[Level], views: &[bool]) -> Result<Self> {
        let is_read = |r: &Row| r.is_of(levels) && views[r.view as usize];
        let rows = (0..footprints.rows.len() as u32).filter(|&r| is_read(&footprints.rows[r as usize]));
        let rows: Vec<u32> = rows.collect();
        let each = |take: &mut dyn FnMut(usize, u32, f32)| {
            footprints.in_batches(&rows, |rows, batch| {
                for (&row, entries) in rows.iter().zip(batch) {
                    let shown = entries.iter().filter(|(_, w)| *w > 0.0);
                    shown.for_each(|(i, w)| take(labels[i as usize] as usize, row, w));
                }
            })
        };
        // Read twice: first how many there are.
        let (mut ends, mut last) = (vec![0; count], vec![u32::MAX; count]);
        each(&mut |k, row, _| ends[k] += usize::from(std::mem::replace(&mut last[k], row) != row))?;
        let mut all = 0;
        ends.iter_mut().for_each(|end| all += std::mem::replace(end, all));
        let mut masks = vec![(0, 0.0); all];
        last.fill(u32::MAX);
        each(&mut |k, row, w| {
            if std::mem::replace(&mut last[k], row) != row {
                masks[ends[k]] = (row, 0.0);
                ends[k] += 1;
            }
            masks[ends[k] - 1].1 += w;
        })?;
        Ok(Self { masks, ends })
    }

    /// The profile of each.
    pub fn profiles(&self) -> Vec<Profile<'_>> {
        let of = |k: usize| {
            let masks = &self.masks[k.checked_sub(1).map_or(0, |before| self.ends[before])..self.ends[k]];
            Profile { masks: masks.into(), total: weight(masks) }
        };
        (0..self.ends.len()).into_par_iter().map(of).collect()
    }
}

impl Profile<'_> {
    /// From masks and weights, ascending.
    pub fn new(masks: Vec<(u32, f32)>) -> Self {
        let total = weight(&masks);
        Self { masks: masks.into(), total }
    }

    /// The same on its own.
    pub fn into_owned(self) -> Profile<'static> {
        Profile { masks: self.masks.into_owned().into(), total: self.total }
    }

    /// Those of `instances` instances in the masks at `levels`. `labels` are those of the kept Gaussians, -1 for none.
    ///
    /// # Errors
    /// When the footprints can't be read.
    pub fn of_instances(
        labels: &[i32],
        instances: usize,
        footprints: &Footprints,
        levels: &[Level],
    ) -> Result<Vec<Self>> {
        let mut masks = vec![Vec::new(); instances];
        for (row, of) in mask_weights(labels, footprints, levels)? {
            of.into_iter().filter(|(_, w)| *w > 0.0).for_each(|(k, w)| masks[k as usize].push((row, w as f32)));
        }
        Ok(masks.into_iter().map(Self::new).collect())
    }

    /// Of both together.
    pub fn joined(&self, other: &Profile<'_>) -> Profile<'static> {
        let (mut a, mut b) = (&self.masks[..], &other.masks[..]);
        let mut masks = Vec::with_capacity(a.len() + b.len());
        while let (Some(&x), Some(&y)) = (a.first(), b.first()) {
            let order = x.0.cmp(&y.0);
            masks.push((x.0.min(y.0), if order.is_le() { x.1 } else { 0.0 } + if order.is_ge() { y.1 } else { 0.0 }));
            a = &a[usize::from(order.is_le())..];
            b = &b[usize::from(order.is_ge())..];
        }
        masks.extend_from_slice(a);
        masks.extend_from_slice(b);
        masks.shrink_to_fit();
        Profile::new(masks)
    }

    /// Without the part `other`.
    pub fn without(&self, other: &Profile<'_>) -> Profile<'static> {
        let part: BTreeMap<u32, f32> = other.masks.iter().copied().collect();
        let left = self.masks.iter().map(|&(k, w)| (k, w - part.get(&k).unwrap_or(&0.0), w));
        // What is left of nothing but rounding is nothing.
        Profile::new(left.filter(|(_, left, w)| *left > 1e-5 * w).map(|(k, left, _)| (k, left)).collect())
    }

    /// The masks that hold more than half of what their view and level show. `unit_of` has the view and level of each mask ([`units`]).
    pub fn main_masks<'a>(&'a self, unit_of: &'a [u32]) -> impl Iterator<Item = u32> + 'a {
        self.masks.chunk_by(|x, y| unit_of[x.0 as usize] == unit_of[y.0 as usize]).flat_map(|masks| {
            let all = weight(masks);
            masks.iter().filter(move |m| 2.0 * f64::from(m.1) > all).map(|m| m.0)
        })
    }

    /// How far two belong together; None where no view shows both. `unit_of` has the view and level of each mask ([`units`]).
    pub fn agreement(&self, other: &Profile<'_>, unit_of: &[u32]) -> Option<Agreement> {
        let mut levels = [[0.0; 2]; LEVELS];
        let (mut seen, mut share) = (0, 0.0);
        let (mut own, mut others) = (&self.masks[..], &other.masks[..]);
        while let (Some(x), Some(y)) = (own.first(), others.first()) {
            let (unit, other_unit) = (unit_of[x.0 as usize], unit_of[y.0 as usize]);
            if unit < other_unit {
                own = &own[1..];
            } else if other_unit < unit {
                others = &others[1..];
            } else {
                let (a, b) = (take(&mut own, unit, unit_of), take(&mut others, unit, unit_of));
                let (wx, wy) = (weight(a), weight(b));
                let [same, all] = &mut levels[unit as usize % LEVELS];
                let root = (wx * wy).sqrt();
                *same += common(a, b) / root;
                *all += root;
                seen += 1;
                share += (wx / self.total).min(wy / other.total);
            }
        }
        let counts = || COUNTS.into_iter().chain(std::iter::repeat(NAMED));
        let counted = || levels.iter().zip(counts()).filter(|([_, all], _)| *all > 0.0);
        let all: f64 = counted().map(|(_, count)| count).sum();
        let sum: f64 = counted().map(|([same, all], count)| count * same / all).sum();
        let firm = seen >= LEAST_COMMON.0 && share >= LEAST_COMMON.1;
        (seen > 0).then(|| Agreement { value: sum / all, firm })
    }
}

/// Takes those at the start of `masks` that are of `unit`.
fn take<'a>(masks: &mut &'a [(u32, f32)], unit: u32, unit_of: &[u32]) -> &'a [(u32, f32)] {
    let count = masks.iter().take_while(|m| unit_of[m.0 as usize] == unit).count();
    let (taken, rest) = masks.split_at(count);
    *masks = rest;
    taken
}

/// Weight in all of them.
fn weight(masks: &[(u32, f32)]) -> f64 {
    masks.iter().map(|m| f64::from(m.1)).sum()
}

/// Sum of the products of weights in common masks.
fn common(mut a: &[(u32, f32)], mut b: &[(u32, f32)]) -> f64 {
    let mut sum = 0.0;
    while let (Some(x), Some(y)) = (a.first(), b.first()) {
        let order = x.0.cmp(&y.0);
        if order == Ordering::Equal {
            sum += f64::from(x.1) * f64::from(y.1);
        }
        a = &a[usize::from(order.is_le())..];
        b = &b[usize::from(order.is_ge())..];
    }
    sum
}

/// How far each piece agrees with the rest of its instance, by the masks at `levels`. `labels` are the pieces of the
/// kept Gaussians, -1 for none; `wholes` has the instance of each piece. None where too few views show both.
///
/// # Errors
/// When the footprints can't be read.
pub fn with_rest(
    labels: &[i32],
    wholes: &[i32],
    footprints: &Footprints,
    levels: &[Level],
) -> Result<Vec<Option<f64>>> {
    let unit_of = units(footprints);
    let pieces = Profile::of_instances(labels, wholes.len(), footprints, levels)?;
    let mut instances: BTreeMap<i32, Profile<'_>> = BTreeMap::new();
    for (piece, whole) in pieces.iter().zip(wholes) {
        let sum = instances.entry(*whole).or_default();
        *sum = sum.joined(piece);
    }
    let of = |(piece, whole): (&Profile<'_>, &i32)| {
        let agreement = piece.agreement(&instances[whole].without(piece), &unit_of)?;
        agreement.firm.then_some(agreement.value)
    };
    Ok(pieces.par_iter().zip(wholes).map(of).collect())
}

/// The masks at `levels`, as rows of the footprints, and the weight of each instance in them. `labels` are those of the kept
/// Gaussians, -1 for none.
///
/// # Errors
/// When the footprints can't be read.
pub fn mask_weights(
    labels: &[i32],
    footprints: &Footprints,
    levels: &[Level],
) -> Result<Vec<(u32, BTreeMap<u32, f64>)>> {
    (0..footprints.rows.len() as u32)
        .into_par_iter()
        .filter(|&r| footprints.rows[r as usize].is_of(levels))
        .map_init(Sums::default, |sums, r| {
            footprints.entries(r as usize)?.iter().for_each(|(i, w)| sums.add(labels[i as usize], f64::from(w)));
            Ok((r, sums.take().collect()))
        })
        .collect()
}

/// What a view shows of each instance: what the masks of a level hold of it, of that level which holds most. `masks` are those of the
/// view: their level, and the weights of instances in them.
pub(crate) fn shown_of<W: Iterator<Item = (u32, f64)>>(masks: impl Iterator<Item = (u32, W)>) -> BTreeMap<u32, f64> {
    let mut levels: BTreeMap<u32, [f64; LEVELS]> = BTreeMap::new();
    for (level, of) in masks {
        of.for_each(|(k, w)| levels.entry(k).or_default()[level as usize] += w);
    }
    levels.into_iter().map(|(k, levels)| (k, levels.into_iter().fold(0.0, f64::max))).collect()
}

/// Sums of weights by number, for numbers that are few but come often.
#[derive(Default)]
pub(crate) struct Sums {
    of: Vec<f64>,
    there: Vec<u32>,
}

impl Sums {
    /// Adds to the sum of a number; one below 0 is nobody's.
    pub fn add(&mut self, of: i32, weight: f64) {
        let Ok(at) = usize::try_from(of) else { return };
        if at >= self.of.len() {
            self.of.resize(at + 1, f64::NAN);
        }
        if self.of[at].is_nan() {
            self.of[at] = 0.0;
            self.there.push(of as u32);
        }
        self.of[at] += weight;
    }

    /// The sums, by number, ascending; nothing is left.
    pub fn take(&mut self) -> impl Iterator<Item = (u32, f64)> + '_ {
        self.there.sort_unstable();
        let of = &mut self.of;
        self.there.drain(..).map(|k| (k, std::mem::replace(&mut of[k as usize], f64::NAN)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{footprints, footprints_of};

    /// Two views of two levels, default and small, with two masks each.
    const UNIT_OF: [u32; 8] = [0, 0, 1, 1, SECOND, SECOND, SECOND + 1, SECOND + 1];
    const SECOND: u32 = LEVELS as u32;

    fn of(masks: &[(u32, f32)]) -> Profile<'static> {
        Profile::new(masks.to_vec())
    }

    #[test]
    fn agreement_is_the_probability_of_one_mask() {
        let (a, b) = (of(&[(0, 3.0), (1, 1.0), (4, 4.0)]), of(&[(0, 2.0), (1, 2.0), (5, 16.0)]));
        // First view: 3/4 1/2 + 1/4 1/2, by the root of 4 times 4; second view: 0, by the root of 4 times 16.
        let expected = 0.5 * 4.0 / 12.0;
        assert!((a.agreement(&b, &UNIT_OF).unwrap().value - expected).abs() < 1e-12);
        assert_eq!(a.agreement(&b, &UNIT_OF), b.agreement(&a, &UNIT_OF));
        assert_eq!(a.agreement(&of(&[(2, 1.0)]), &UNIT_OF), None, "no view shows both at one level");
        // Levels count by their weights: one mask at level default, two at level small.
        let (a, b) = (of(&[(0, 1.0), (2, 1.0)]), of(&[(0, 1.0), (3, 1.0)]));
        assert!((a.agreement(&b, &UNIT_OF).unwrap().value - COUNTS[0] / (COUNTS[0] + COUNTS[1])).abs() < 1e-12);
    }

    #[test]
    fn agreement_is_firm_where_enough_views_show_both() {
        let a = of(&[(0, 1.0), (4, 1.0)]);
        assert!(a.agreement(&a, &UNIT_OF).unwrap().firm);
        assert!(!a.agreement(&of(&[(0, 1.0)]), &UNIT_OF).unwrap().firm, "one view");
        let elsewhere = of(&[(0, 0.01), (2, 10.0), (4, 0.01)]);
        assert!(!a.agreement(&elsewhere, &UNIT_OF).unwrap().firm, "seen elsewhere");
    }

    #[test]
    fn a_part_that_is_joined_can_be_taken_out_again() {
        let (a, b) = (of(&[(0, 1.0), (2, 3.0)]), of(&[(0, 2.0), (1, 4.0)]));
        let both = a.joined(&b);
        assert_eq!(both.masks[..], [(0, 3.0), (1, 4.0), (2, 3.0)]);
        assert_eq!(both.total, 10.0);
        assert_eq!(both.without(&b).masks, a.masks);
        assert_eq!(both.main_masks(&UNIT_OF).collect::<Vec<_>>(), [1, 2]);
    }

    #[test]
    fn gaussians_and_instances_have_the_same_masks() {
        let views: [&[&[u32]]; 2] = [&[&[0, 1, 2], &[4]], &[&[2, 3]]];
        let footprints = footprints_of(&[(Level::SMALL, &views), (Level::LARGE, &views)]);
        let own: Vec<i32> = (0..8).collect();
        let pieces = Pieces::of(&own, 8, &footprints, &[Level::LARGE], &[true; 2]).unwrap();
        let of_gaussians = pieces.profiles();
        let labels = [0, 0, 0, 1, -1, -1, -1, -1];
        let of_instances = Profile::of_instances(&labels, 2, &footprints, &[Level::LARGE]).unwrap();
        let sum = of_gaussians[..3].iter().fold(Profile::default(), |sum, p| sum.joined(p));
        assert_eq!((&sum.masks, &of_gaussians[3].masks), (&of_instances[0].masks, &of_instances[1].masks));
        assert!(of_gaussians[5].masks.is_empty());
    }

    #[test]
    fn some_views_are_read_where_there_are_too_many_entries() {
        let view: &[&[u32]] = &[&[0, 1], &[2]];
        let footprints = footprints(&[view; 6]);
        let views = |most| some_views(&footprints, &[Level::LARGE], most);
        assert_eq!(views(18), [true; 6]);
        assert_eq!(views(9), [false, true, false, true, false, true]);
        assert_eq!(views(12), [false, true, true, false, true, true]);
        let own = [0, 0, 1, 2, 3, 4, 5, 6];
        let pieces = Pieces::of(&own, 7, &footprints, &[Level::LARGE], &views(9)).unwrap();
        let pieces = pieces.profiles();
        assert_eq!(
            (&pieces[0].masks[..], &pieces[1].masks[..]),
            (&[(2, 2.0), (6, 2.0), (10, 2.0)][..], &[(3, 1.0), (7, 1.0), (11, 1.0)][..])
        );
        assert_eq!(pieces[2].total, 0.0);
    }

    #[test]
    fn a_piece_agrees_with_the_rest_as_far_as_masks_hold_both() {
        // Of instance 0 the pieces 0 and 1, in one mask in the first view alone; piece 2 is all of instance 1.
        let views: [&[&[u32]]; 2] = [&[&[0, 1, 2, 3, 4]], &[&[0, 1, 4, 5], &[2, 3, 6, 7]]];
        let footprints = footprints(&views);
        let agreements = |levels| with_rest(&[0, 0, 1, 1, -1, -1, 2, 2], &[0, 0, 1], &footprints, levels).unwrap();
        let half = |agreement: Option<f64>| (agreement.unwrap() - 0.5).abs() < 1e-12;
        let [a, b, alone] = agreements(&[Level::LARGE])[..] else { panic!("one for each piece") };
        assert!(half(a) && half(b) && alone.is_none(), "{a:?} {b:?} {alone:?}");
        assert_eq!(agreements(&[Level::MEDIUM]), [None; 3], "no masks");
    }
}
