//! Joining instances that the masks show as one.
//!
//! Clustering on the graph of spatial neighbours cannot join what does not touch: a table top falls into pieces around what
//! stands on it, a wall behind a lamp, and a rim with few Gaussians is no bridge. The masks still tell: two pieces of one
//! thing mostly lie in the same mask of a view, two things only where a view merges them.

use crate::plane::Place;
use artifacts::{Footprints, Level};
use gs_io::Result;
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Fewest views that must see both.
const LEAST_VIEWS: usize = 2;
/// Least share of their weight that lies in views that see both.
const LEAST_COMMON: f64 = 0.05;
/// Pieces that lie in one plane need this share of the agreement of others: a floor or a wall is seldom seen whole, and what hides
/// its middle parts its masks.
const IN_PLANE: f64 = 0.75;

/// An instance as the masks see it.
#[derive(Debug, Clone, Default)]
struct Profile {
    /// Mask (by its row in the footprints) and the weight in it, ascending.
    masks: Vec<(u32, f64)>,
    /// Weight in all masks of each view and level.
    units: Vec<f64>,
    /// Sum of those.
    total: f64,
    place: Place,
}

impl Profile {
    fn new(masks: Vec<(u32, f64)>, unit_of: &[u32], units: usize, place: Place) -> Self {
        let mut out = Self { units: vec![0.0; units], place, ..Self::default() };
        for &(k, w) in &masks {
            out.units[unit_of[k as usize] as usize] += w;
        }
        out.total = out.units.iter().sum();
        out.masks = masks;
        out
    }

    /// Masks that hold more than half of what the view sees of the instance.
    fn main_masks<'a>(&'a self, unit_of: &'a [u32]) -> impl Iterator<Item = u32> + 'a {
        self.masks.iter().filter(|(k, w)| 2.0 * w > self.units[unit_of[*k as usize] as usize]).map(|(k, _)| *k)
    }

    fn joined(&self, other: &Self, unit_of: &[u32]) -> Self {
        let mut masks: BTreeMap<u32, f64> = self.masks.iter().copied().collect();
        for &(k, w) in &other.masks {
            *masks.entry(k).or_default() += w;
        }
        let place = self.place.joined(&other.place);
        Self::new(masks.into_iter().collect(), unit_of, self.units.len(), place)
    }
}

/// The probability that a random part of `a` and a random part of `b` lie in the same mask, averaged over the views that see
/// both. A view counts by the smaller of the two shares of weight that lie in it. None where too few views see both.
fn agreement(a: &Profile, b: &Profile, unit_of: &[u32]) -> Option<f64> {
    let common = |u: usize| (a.units[u] / a.total).min(b.units[u] / b.total);
    let both: Vec<f64> = (0..a.units.len()).map(common).filter(|w| *w > 0.0).collect();
    let weight: f64 = both.iter().sum();
    if both.len() < LEAST_VIEWS || weight < LEAST_COMMON {
        return None;
    }
    let (mut sum, mut at) = (0.0, 0);
    for &(k, w) in &a.masks {
        at += b.masks[at..].iter().take_while(|m| m.0 < k).count();
        if let Some(&(_, other)) = b.masks.get(at).filter(|m| m.0 == k) {
            let u = unit_of[k as usize] as usize;
            sum += common(u) * (w / a.units[u]) * (other / b.units[u]);
        }
    }
    Some(sum / weight)
}

/// How much each piece agrees with the rest of its instance ([`agreement`]), by the masks at `levels`. `labels` are the pieces of the
/// kept Gaussians, -1 for none; `wholes` has the instance of each piece.
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
    let units = footprints.views.len() * artifacts::LEVELS;
    let pieces = masks_of(labels, wholes.len(), footprints, levels)?;
    let mut instances: BTreeMap<i32, BTreeMap<u32, f64>> = BTreeMap::new();
    for (piece, whole) in pieces.iter().zip(wholes) {
        let sums = instances.entry(*whole).or_default();
        piece.iter().for_each(|&(k, w)| *sums.entry(k).or_default() += w);
    }
    let profile = |masks| Profile::new(masks, &unit_of, units, Place::default());
    let agreement_of = |(piece, whole): (Vec<(u32, f64)>, &i32)| {
        let own: BTreeMap<u32, f64> = piece.iter().copied().collect();
        let others = instances[whole].iter().map(|(k, w)| (*k, w - own.get(k).unwrap_or(&0.0), *w));
        // What is left of nothing but rounding is nothing.
        let rest = others.filter(|(_, left, w)| *left > 1e-9 * w).map(|(k, left, _)| (k, left)).collect();
        agreement(&profile(piece), &profile(rest), &unit_of)
    };
    Ok(pieces.into_par_iter().zip(wholes).map(agreement_of).collect())
}

/// The view and level of each mask, as one number.
pub fn units(footprints: &Footprints) -> Vec<u32> {
    footprints.rows.iter().map(|r| r.view * artifacts::LEVELS as u32 + r.level).collect()
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
        .map(|r| {
            let mut of: BTreeMap<u32, f64> = BTreeMap::new();
            for (i, w) in footprints.entries(r as usize)?.iter() {
                if let Ok(k) = u32::try_from(labels[i as usize]) {
                    *of.entry(k).or_default() += f64::from(w);
                }
            }
            Ok((r, of))
        })
        .collect()
}

/// The masks at `levels` that hold each of `instances` instances, as rows of the footprints, ascending, with its weight in them.
fn masks_of(
    labels: &[i32],
    instances: usize,
    footprints: &Footprints,
    levels: &[Level],
) -> Result<Vec<Vec<(u32, f64)>>> {
    let mut masks = vec![Vec::new(); instances];
    for (r, of) in mask_weights(labels, footprints, levels)? {
        of.into_iter().filter(|(_, w)| *w > 0.0).for_each(|(k, w)| masks[k as usize].push((r, w)));
    }
    Ok(masks)
}

/// Joins instances, those that agree most first, until no two agree by `least` (more than a half) or more, or by [`IN_PLANE`] of it
/// where their `places` lie in one plane. `labels` are those of the kept Gaussians, -1 for none. Returns the new number of each
/// instance; numbers stay in order.
pub fn by_masks(
    labels: &[i32],
    instances: usize,
    footprints: &Footprints,
    levels: &[Level],
    least: f64,
    places: Vec<Place>,
) -> Result<Vec<u32>> {
    let unit_of = units(footprints);
    let units = footprints.views.len() * artifacts::LEVELS;
    let masks = masks_of(labels, instances, footprints, levels)?;
    let of_instance = |(masks, place)| Profile::new(masks, &unit_of, units, place);
    let mut profiles: Vec<Profile> = masks.into_iter().zip(places).map(of_instance).collect();
    Ok(join(&mut profiles, &unit_of, least))
}

fn join(profiles: &mut [Profile], unit_of: &[u32], least: f64) -> Vec<u32> {
    // Two that agree by more than a half lie mostly in the same mask of some view.
    let mut mainly: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
    for (i, p) in profiles.iter().enumerate() {
        p.main_masks(unit_of).for_each(|k| mainly.entry(k).or_default().push(i as u32));
    }
    let mut pairs: Vec<(u32, u32)> =
        mainly.values().flat_map(|v| v.iter().flat_map(|&a| v.iter().map(move |&b| (a, b)))).collect();
    pairs.retain(|(a, b)| a < b);
    pairs.sort_unstable();
    pairs.dedup();
    let of = |profiles: &[Profile], (a, b): (u32, u32)| {
        let (one, other) = (&profiles[a as usize], &profiles[b as usize]);
        let agreement = agreement(one, other, unit_of).unwrap_or(0.0);
        let eased = agreement >= IN_PLANE * least && one.place.in_plane_of(&other.place);
        ((a, b), if eased { agreement / IN_PLANE } else { agreement })
    };
    let mut agreements: BTreeMap<(u32, u32), f64> = pairs.into_par_iter().map(|pair| of(profiles, pair)).collect();
    let mut into: Vec<u32> = (0..profiles.len() as u32).collect();
    // Of equals the first.
    while let Some((&(a, b), _)) = agreements
        .iter()
        .filter(|(_, v)| **v >= least)
        .reduce(|best, other| if other.1 > best.1 { other } else { best })
    {
        profiles[a as usize] = profiles[a as usize].joined(&profiles[b as usize], unit_of);
        profiles[b as usize] = Profile::default();
        into.iter_mut().filter(|i| **i == b).for_each(|i| *i = a);
        let others: Vec<u32> = agreements
            .keys()
            .filter_map(|&(x, y)| if x == a || x == b { Some(y) } else { (y == a || y == b).then_some(x) })
            .filter(|&other| other != a && other != b)
            .collect();
        agreements.retain(|&(x, y), _| ![x, y].contains(&a) && ![x, y].contains(&b));
        agreements.extend(others.into_iter().map(|other| of(profiles, (a.min(other), a.max(other)))));
    }
    let mut left: Vec<u32> = into.clone();
    left.sort_unstable();
    left.dedup();
    into.iter().map(|i| left.binary_search(i).expect("one that is left") as u32).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plane::testing::{board, places};
    use crate::testing::footprints;

    /// Two masks a view; an instance has the given shares in the first, in views where it is seen at all.
    fn profile(firsts: &[Option<f64>]) -> Profile {
        let masks = firsts.iter().enumerate().filter_map(|(v, f)| f.map(|f| (v as u32, f)));
        let masks = masks.flat_map(|(v, f)| [(2 * v, f), (2 * v + 1, 1.0 - f)]).filter(|(_, w)| *w > 0.0);
        let unit_of = unit_of(firsts.len());
        Profile::new(masks.collect(), &unit_of, firsts.len(), Place::default())
    }

    fn unit_of(views: usize) -> Vec<u32> {
        (0..2 * views as u32).map(|k| k / 2).collect()
    }

    #[test]
    fn agreement_is_the_probability_of_one_mask() {
        let (a, b) = (profile(&[Some(1.0), Some(1.0), None]), profile(&[Some(0.75), Some(0.0), Some(1.0)]));
        // Views 0 and 1 count a third of b and half of a: equally.
        assert!((agreement(&a, &b, &unit_of(3)).unwrap() - 0.375).abs() < 1e-12);
        let seen_once = profile(&[Some(1.0), None, None]);
        assert_eq!(agreement(&a, &seen_once, &unit_of(3)), None);
    }

    #[test]
    fn a_piece_agrees_with_the_rest_as_far_as_masks_hold_both() {
        // Of instance 0 the pieces 0 and 1, in one mask in the first view alone; piece 2 is all of instance 1.
        let views: [&[&[u32]]; 2] = [&[&[0, 1, 2, 3, 4]], &[&[0, 1, 4, 5], &[2, 3, 6, 7]]];
        let footprints = footprints(&views);
        let agreements = |levels| with_rest(&[0, 0, 1, 1, -1, -1, 2, 2], &[0, 0, 1], &footprints, levels).unwrap();
        let half = |agreement: Option<f64>| (agreement.unwrap() - 0.5).abs() < 1e-12;
        let [a, b, alone] = agreements(&[Level::Large])[..] else { panic!("one for each piece") };
        assert!(half(a) && half(b) && alone.is_none(), "{a:?} {b:?} {alone:?}");
        assert_eq!(agreements(&[Level::Medium]), [None; 3], "no masks");
    }

    #[test]
    fn pieces_are_joined_and_neighbours_stay_apart() {
        // 0 and 2 share masks but in one view of four; 1 is merged with them in one view; 3 is seen in one view only.
        let (one, two) = (Some(1.0), Some(0.0));
        let mut profiles = [
            profile(&[one, one, one, one]),
            profile(&[one, two, two, two]),
            profile(&[one, one, one, two]),
            profile(&[one, None, None, None]),
        ];
        assert_eq!(join(&mut profiles.clone(), &unit_of(4), 0.6), [0, 1, 0, 2]);
        assert_eq!(join(&mut profiles, &unit_of(4), 0.8), [0, 1, 2, 3]);
    }

    #[test]
    fn pieces_of_one_plane_need_less_agreement() {
        let (one, two) = (Some(1.0), Some(0.0));
        let join_of = |second: Vec<[f32; 3]>| {
            // The same mask in five views of nine.
            let views = [profile(&[one; 9]), profile(&[one, one, one, one, one, two, two, two, two])];
            let places = places(&[board([0.0; 3], 0, 1), second]);
            let of = views.into_iter().zip(places).map(|(profile, place)| Profile { place, ..profile });
            join(&mut of.collect::<Vec<_>>(), &unit_of(9), 0.6)
        };
        assert_eq!(join_of(board([2.0, 0.0, 0.0], 0, 1)), [0, 0]);
        assert_eq!(join_of(board([2.0, 0.0, 0.0], 1, 2)), [0, 1]);
    }
}
