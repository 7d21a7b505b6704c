//! What the result says of itself: whether one instance holds too much of the scene, masks contradict each other, or
//! instances share their masks.

use crate::profile::units;
use artifacts::{Footprints, Health, Instances, SHARED, SharedMasks};
use rayon::prelude::*;
use stage::Stage;
use std::collections::{BTreeMap, BTreeSet};

/// Fewest views and levels that must show both of a pair.
const LEAST_SEEN: usize = 3;
/// Least ratio of the Gaussians of the two.
const LEAST_RATIO: f64 = 0.1;
/// Pairs that are kept: there may be thousands where a floor falls into pieces.
const KEPT: usize = 20;

/// What a view sees of an instance at one level.
struct Seen {
    /// View and level, as [`units`] counts them.
    unit: u32,
    /// Weight there, as a share of the instance's weight in all of them.
    share: f64,
    /// The mask that holds more than half of it.
    main: Option<u32>,
}

/// The health of `instances`, from the weight of each in the masks (rows of the footprints).
pub fn measure(instances: &Instances, footprints: &Footprints, weights: &[(u32, BTreeMap<u32, f64>)]) -> Health {
    let labelled: usize = instances.count.iter().map(|&c| c as usize).sum();
    let largest = instances.count.iter().max().map_or(0.0, |&c| f64::from(c) / labelled.max(1) as f64);
    let (mut inside, mut all) = (0.0, 0.0);
    for (_, of) in weights {
        inside += of.values().copied().fold(0.0, f64::max);
        all += of.values().sum::<f64>();
    }
    let mut shared = shared(&seen(weights, &units(footprints), instances.len()));
    // What stands on a shelf is in the shelf's masks.
    let size = |k: u32| f64::from(instances.count[k as usize]);
    shared.retain(|s| {
        let [a, b] = s.instances.map(size);
        a.min(b) >= LEAST_RATIO * a.max(b)
    });
    let sharing: BTreeSet<u32> = shared.iter().flat_map(|s| s.instances).collect();
    let sharing: usize = sharing.into_iter().map(|k| instances.count[k as usize] as usize).sum();
    // Of equals the first; the sort is stable.
    shared.sort_by(|a, b| b.share.total_cmp(&a.share));
    let pairs = shared.len();
    shared.truncate(KEPT);
    let (sharing, purity) = (sharing as f64 / labelled.max(1) as f64, (all > 0.0).then(|| inside / all));
    Health { largest, purity, sharing, pairs, shared }
}

/// A line for the user, and a warning where something looks wrong.
pub fn say(health: &Health, stage: &Stage) {
    let findings = health.findings();
    let line: Vec<String> = findings.iter().map(|f| format!("{} {}", f.found, f.name)).collect();
    stage.info(&line.join("; "));
    findings.iter().filter_map(|f| f.advice.as_ref()).for_each(|a| stage.warn(a));
}

/// What each view sees of each instance, by instance and ascending unit. `unit_of` is that of each mask.
fn seen(weights: &[(u32, BTreeMap<u32, f64>)], unit_of: &[u32], instances: usize) -> Vec<Vec<Seen>> {
    // By instance and unit: the weight, and the largest in one mask.
    let mut all: BTreeMap<(u32, u32), (f64, f64, u32)> = BTreeMap::new();
    for (mask, of) in weights {
        for (&k, &w) in of.iter().filter(|(_, w)| **w > 0.0) {
            let (sum, most, main) = all.entry((k, unit_of[*mask as usize])).or_default();
            *sum += w;
            if w > *most {
                (*most, *main) = (w, *mask);
            }
        }
    }
    let mut total = vec![0.0; instances];
    all.iter().for_each(|((k, _), (sum, ..))| total[*k as usize] += sum);
    let mut out: Vec<Vec<Seen>> = (0..instances).map(|_| Vec::new()).collect();
    for ((k, unit), (sum, most, mask)) in all {
        let main = (2.0 * most > sum).then_some(mask);
        out[k as usize].push(Seen { unit, share: sum / total[k as usize], main });
    }
    out
}

/// The pairs that share most of their masks, by their numbers.
fn shared(seen: &[Vec<Seen>]) -> Vec<SharedMasks> {
    let mut mainly: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
    for (k, of) in seen.iter().enumerate() {
        of.iter().filter_map(|s| s.main).for_each(|mask| mainly.entry(mask).or_default().push(k as u32));
    }
    let mut pairs: BTreeSet<[u32; 2]> = BTreeSet::new();
    for held in mainly.values() {
        let after = held.iter().enumerate().flat_map(|(at, &a)| held[at + 1..].iter().map(move |&b| [a, b]));
        pairs.extend(after);
    }
    let pairs: Vec<[u32; 2]> = pairs.into_iter().collect();
    pairs
        .into_par_iter()
        .filter_map(|instances| {
            let share = share(&seen[instances[0] as usize], &seen[instances[1] as usize])?;
            (share >= SHARED).then_some(SharedMasks { instances, share })
        })
        .collect()
}

/// The share of the units that see both in which they have one main mask; each unit counts by the smaller of the two shares of
/// weight that lie in it. None where too few see both.
fn share(a: &[Seen], b: &[Seen]) -> Option<f64> {
    let (mut both, mut same, mut units, mut at) = (0.0, 0.0, 0, 0);
    for s in a {
        at += b[at..].iter().take_while(|o| o.unit < s.unit).count();
        let Some(other) = b.get(at).filter(|o| o.unit == s.unit) else { continue };
        let common = s.share.min(other.share);
        both += common;
        units += 1;
        if s.main.is_some() && s.main == other.main {
            same += common;
        }
    }
    (units >= LEAST_SEEN && both > 0.0).then(|| same / both)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::profile::mask_weights;
    use crate::testing::{footprints, instances};
    use artifacts::Level;

    fn health(instances: &Instances, footprints: &Footprints, level: Level) -> Health {
        measure(instances, footprints, &mask_weights(&instances.label, footprints, &[level]).unwrap())
    }

    #[test]
    fn it_counts_the_largest_instance_and_what_masks_hold_of_one() {
        // Instance 0 holds Gaussians 0 to 5, instance 1 holds 6 and 7. One mask fits, one holds 3 and 1.
        let footprints = footprints(&[&[&[0, 1], &[3, 4, 5, 6]]]);
        let instances = instances([0, 0, 0, 0, 0, 0, 1, 1]);
        let found = health(&instances, &footprints, Level::Large);
        assert_eq!(found, Health { largest: 0.75, purity: Some(5.0 / 6.0), ..Health::default() });
        assert_eq!(health(&instances, &footprints, Level::Small).purity, None);
    }

    #[test]
    fn pieces_that_lie_in_the_same_masks_are_named() {
        let (together, apart): (&[&[u32]], &[&[u32]]) = (&[&[0, 1, 2, 3], &[4, 5, 6, 7]], &[&[0, 1], &[2, 3], &[4, 5]]);
        let instances = instances([0, 0, 1, 1, 2, 2, 3, 3]);
        // 0 and 1 lie in one mask of four views in five. 2 and 3 always do where both are seen.
        let found = health(&instances, &footprints(&[together, together, apart, together, together]), Level::Large);
        let of = |a, b, share| SharedMasks { instances: [a, b], share };
        let near = |a: &SharedMasks, b: SharedMasks| a.instances == b.instances && (a.share - b.share).abs() < 1e-12;
        assert!(found.sharing == 1.0 && found.pairs == 2 && near(&found.shared[0], of(2, 3, 1.0)), "{found:?}");
        assert!(near(&found.shared[1], of(0, 1, 0.8)), "{found:?}");
        // What is small beside the other is no piece of it.
        let mut large = instances.clone();
        (large.count[0], large.count[3]) = (100, 100);
        assert_eq!(health(&large, &footprints(&[together; 4]), Level::Large).pairs, 0);
        // Half of the views are not most, and two are too few.
        let found = health(&instances, &footprints(&[together, apart, together, apart]), Level::Large);
        assert_eq!((found.sharing, found.pairs, found.shared.len()), (0.0, 0, 0), "{found:?}");
    }
}
