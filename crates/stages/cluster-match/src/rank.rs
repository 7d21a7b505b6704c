//! How sure it is that an instance is one whole thing: what average precision ranks by.

use artifacts::{Footprints, Instances, LEVELS};
use std::collections::BTreeMap;

/// Of two that fit their masks as well, the smaller one is more often a mere part: a power of the number of Gaussians. This
/// and the two numbers below were chosen on four scenes with real masks; they matter little nearby.
const SIZE: f64 = 0.2;
/// A mask swallows what it shows half of and is so many times as large as.
const TIMES: f64 = 2.0;
/// How much less sure it is of an instance that is swallowed wherever it is seen.
const SWALLOWED: f64 = 0.8;

/// The confidence of each instance, 0 to 1, from the weight of each instance in the masks (rows of the footprints):
///
/// (count / largest count)^0.2 · mean of the association score · (1 - 0.8 · share of the views that swallow it)
///
/// where a view without a match has a score of 0, and each view counts by the square root of what it shows of the instance.
pub fn confidence(instances: &Instances, footprints: &Footprints, weights: &[(u32, BTreeMap<u32, f64>)]) -> Vec<f32> {
    let seen = seen(footprints, weights);
    let mut swallowed = vec![vec![false; footprints.views.len()]; instances.len()];
    for (row, of) in weights {
        let (view, size) = (footprints.rows[*row as usize].view, of.values().sum::<f64>());
        for (&k, &w) in of {
            // Nothing is seen of what has no weight.
            let Some(&shown) = seen.get(&(k, view)) else { continue };
            swallowed[k as usize][view as usize] |= 2.0 * w > shown && size > TIMES * shown;
        }
    }
    let score: BTreeMap<(u32, u32), f32> = instances.matches.iter().map(|m| ((m.instance, m.view), m.score)).collect();
    let mut sums = vec![[0.0f64; 3]; instances.len()];
    for (&(k, view), &shown) in &seen {
        let root = shown.sqrt();
        let fit = score.get(&(k, view)).map_or(0.0, |&s| f64::from(s));
        let inside = f64::from(u8::from(swallowed[k as usize][view as usize]));
        sums[k as usize].iter_mut().zip([1.0, fit, inside]).for_each(|(s, v)| *s += root * v);
    }
    let largest = f64::from(instances.count.iter().copied().max().unwrap_or(0).max(1));
    let sure = |(&count, [all, fit, inside]): (&u32, [f64; 3])| {
        if all == 0.0 {
            return 0.0;
        }
        let size = (f64::from(count) / largest).powf(SIZE);
        (size * fit / all * (1.0 - SWALLOWED * inside / all)) as f32
    };
    instances.count.iter().zip(sums).map(sure).collect()
}

/// What each view shows of each instance, in the masks of the level that shows most of it; only where it shows some.
fn seen(footprints: &Footprints, weights: &[(u32, BTreeMap<u32, f64>)]) -> BTreeMap<(u32, u32), f64> {
    let mut levels: BTreeMap<(u32, u32), [f64; LEVELS]> = BTreeMap::new();
    for (row, of) in weights {
        let row = &footprints.rows[*row as usize];
        for (&k, w) in of {
            levels.entry((k, row.view)).or_default()[row.level as usize] += w;
        }
    }
    levels.into_iter().map(|(key, of)| (key, of.into_iter().fold(0.0, f64::max))).filter(|(_, w)| *w > 0.0).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::profile::mask_weights;
    use crate::testing::{footprints, instances};
    use artifacts::{Level, Match};

    /// Confidence of instances 0 (Gaussians 0 and 1), 1 (2 and 3) and 2 (4 to 7), each matched by a score of 0.8 in `matched` views.
    fn of(views: &[&[&[u32]]], matched: [u32; 3]) -> Vec<f32> {
        let (footprints, mut instances) = (footprints(views), instances([0, 0, 1, 1, 2, 2, 2, 2]));
        let m = |instance, view| Match { instance, view, mask: 0, score: 0.8, visible: 1.0 };
        instances.matches = (0..3).flat_map(|k| (0..matched[k as usize]).map(move |view| m(k, view))).collect();
        let labels = instances.label.clone();
        confidence(&instances, &footprints, &mask_weights(&labels, &footprints, &[Level::Large]).unwrap())
    }

    #[test]
    fn size_support_and_larger_masks_tell_wholes_from_parts() {
        let alone: &[&[u32]] = &[&[0, 1], &[2, 3], &[4, 5, 6, 7]];
        let near = |a: f32, b: f64| assert!((f64::from(a) - b).abs() < 1e-6, "{a} {b}");
        // All are seen alone and matched in both views: the smaller ones come after the larger one.
        let found = of(&[alone, alone], [2, 2, 2]);
        near(found[2], 0.8);
        near(found[0], 0.8 * 0.5f64.powf(0.2));
        // Matched in one view of two: half as sure. Never matched: not at all.
        let found = of(&[alone, alone], [1, 2, 0]);
        near(found[0], 0.4 * 0.5f64.powf(0.2));
        assert_eq!(found[2], 0.0);
        // One view in two shows it in a mask of three times its size.
        let found = of(&[alone, &[&[0, 1, 4, 5, 6, 7], &[2, 3]]], [2, 2, 2]);
        near(found[0], 0.8 * 0.5f64.powf(0.2) * 0.6);
        near(found[1], 0.8 * 0.5f64.powf(0.2));
        near(found[2], 0.8);
        // What no mask shows is not sure at all.
        assert_eq!(of(&[&[&[0, 1]]], [1, 1, 1])[1..], [0.0, 0.0]);
    }
}
