//! Warnings about the result: one instance that holds too much of the scene, or masks that do not fit the instances.

use crate::join::mask_weights;
use artifacts::{Footprints, Instances, Level};
use stage::Stage;

/// The user is warned when one instance holds more than this share of all Gaussians.
const TOO_LARGE: f64 = 1.0 / 3.0;
/// Below this purity the user is warned.
const IMPURE: f64 = 0.7;

/// How far masks and instances agree.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Health {
    /// Share of the labelled Gaussians in the largest instance, 0 to 1.
    pub largest: f64,
    /// Purity of the masks: the share of a mask's weight that lies in one instance, mean over masks by their weight. It is an
    /// estimate: all views made the instances, so a mask that most views contradict shows here as impure. None without
    /// masks.
    pub purity: Option<f64>,
}

impl Health {
    /// The health of `instances`; `kept` are the original indices of the Gaussians in the footprints.
    pub fn of(instances: &Instances, footprints: &Footprints, kept: &[u32], levels: &[Level]) -> Self {
        let labelled: usize = instances.count.iter().map(|&c| c as usize).sum();
        let largest = instances.count.iter().max().map_or(0.0, |&c| f64::from(c) / labelled.max(1) as f64);
        let labels: Vec<i32> = kept.iter().map(|&i| instances.label[i as usize]).collect();
        let (mut inside, mut all) = (0.0, 0.0);
        for (_, of) in mask_weights(&labels, footprints, levels) {
            inside += of.values().copied().fold(0.0, f64::max);
            all += of.values().sum::<f64>();
        }
        Self { largest, purity: (all > 0.0).then(|| inside / all) }
    }

    /// A line for the user, and a warning where something looks wrong.
    pub fn say(&self, stage: &Stage) {
        let percent = |v: f64| format!("{:.0} %", 100.0 * v);
        let purity = self.purity.map_or("no masks".into(), |p| format!("masks lie in one instance by {}", percent(p)));
        stage.info(&format!("the largest instance holds {} of the Gaussians; {purity}", percent(self.largest)));
        if self.largest > TOO_LARGE {
            stage.warn(&format!(
                "one instance holds {} of the Gaussians; if it is more than floor or walls, try --level small, or feat-train \
                 --levels small",
                percent(self.largest)
            ));
        }
        if self.purity.is_some_and(|p| p < IMPURE) {
            stage.warn(
                "the masks of the views contradict each other; look at the masks in the report, and try feat-train --levels \
                 small",
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use artifacts::{FootprintsBuilder, Row};
    use gs_io::Provenance;

    #[test]
    fn it_counts_the_largest_instance_and_what_masks_hold_of_one() {
        // Instance 0 holds Gaussians 0 to 5, instance 1 holds 6 and 7. One mask fits, one holds 3 and 1.
        let kept: Vec<u32> = (0..8).collect();
        let (views, of_all) = (vec!["a".into()], kept.clone());
        let mut b = FootprintsBuilder { views, kept: of_all, ..FootprintsBuilder::default() };
        for (mask, gaussians) in [&[0u32, 1][..], &[3, 4, 5, 6]].into_iter().enumerate() {
            let pixels = gaussians.len() as u32;
            let row = Row { view: 0, level: 3, mask: mask as u32, pixels, gated: pixels, alpha: 1.0 };
            b.push(row, gaussians.iter().map(|&i| (i, 1.0)));
        }
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("f.safetensors");
        b.write(&path, Provenance::default()).unwrap();
        let footprints = Footprints::read(&path).unwrap();
        let instances = Instances { label: vec![0, 0, 0, 0, 0, 0, 1, 1], count: vec![6, 2], ..Instances::default() };
        let health = Health::of(&instances, &footprints, &kept, &[Level::Large]);
        assert_eq!(health, Health { largest: 0.75, purity: Some(5.0 / 6.0) });
        assert_eq!(Health::of(&instances, &footprints, &kept, &[Level::Small]).purity, None);
    }
}
