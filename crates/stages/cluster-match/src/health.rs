//! How far masks and instances agree.

use artifacts::{Health, Instances};
use std::collections::BTreeMap;

/// The health of `instances`, from the weight of each in the masks (rows of the footprints).
pub fn measure(instances: &Instances, weights: &[(u32, BTreeMap<u32, f64>)]) -> Health {
    let labelled: usize = instances.count.iter().map(|&c| c as usize).sum();
    let largest = instances.count.iter().max().map_or(0.0, |&c| f64::from(c) / labelled.max(1) as f64);
    let (mut inside, mut all) = (0.0, 0.0);
    for (_, of) in weights {
        inside += of.values().copied().fold(0.0, f64::max);
        all += of.values().sum::<f64>();
    }
    Health { largest, purity: (all > 0.0).then(|| inside / all) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::profile::mask_weights;
    use crate::testing::{footprints, instances};
    use artifacts::{Footprints, Level};

    fn health(instances: &Instances, footprints: &Footprints, level: Level) -> Health {
        measure(instances, &mask_weights(&instances.label, footprints, &[level]).unwrap())
    }

    #[test]
    fn it_counts_the_largest_instance_and_what_masks_hold_of_one() {
        // Instance 0 holds Gaussians 0 to 5, instance 1 holds 6 and 7. One mask fits, one holds 3 and 1.
        let footprints = footprints(&[&[&[0, 1], &[3, 4, 5, 6]]]);
        let instances = instances([0, 0, 0, 0, 0, 0, 1, 1]);
        let found = health(&instances, &footprints, Level::Large);
        assert_eq!(found, Health { largest: 0.75, purity: Some(5.0 / 6.0) });
        assert_eq!(health(&instances, &footprints, Level::Small).purity, None);
    }
}
