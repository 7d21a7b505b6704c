//! Scores: class-agnostic 3D instances (docs/protocols.md) and object selection (the same).

use std::collections::{BTreeMap, BTreeSet};

/// How one true object was found.
#[derive(Debug, Clone, PartialEq)]
pub struct ObjectScore {
    /// Id of the true object.
    pub id: i32,
    /// Its points.
    pub points: usize,
    /// Best intersection over union with any predicted instance.
    pub iou: f64,
    /// The predicted instance that gives it; none when nothing overlaps.
    pub best: Option<i32>,
    /// Predicted instances that each hold at least [`FRAGMENT`] of the object's points.
    pub fragments: usize,
}

/// Class-agnostic score of predicted instances against true objects.
#[derive(Debug, Clone, PartialEq)]
pub struct InstanceScore {
    /// Mean over true objects of the best IoU.
    pub miou: f64,
    /// Fraction of true objects with best IoU above 0.25.
    pub macc25: f64,
    /// Fraction of true objects with best IoU above 0.5.
    pub macc50: f64,
    /// True objects in more than one fragment.
    pub fragmented: usize,
    /// Predicted instances that hold at least half of two or more true objects.
    pub merging: usize,
    /// Fragmentation: predicted instances per true object, in the mean. An instance and an object belong together when they
    /// share at least [`FRAGMENT`] of the points of either. 1 is perfect; less means that objects have none.
    pub instances_per_object: f64,
    /// Merging: true objects per predicted instance that belongs to any, in the mean. 1 is perfect; 0 without such an
    /// instance.
    pub objects_per_instance: f64,
    /// Points that count.
    pub points: usize,
    /// Each true object, by id.
    pub objects: Vec<ObjectScore>,
}

/// Share of an object's points from which an instance counts as one of its fragments.
pub const FRAGMENT: f64 = 0.1;

/// Scores labels of points: `truth` and `predicted` hold an id per point, negative for none. Points without a true
/// object do not count; points without a prediction count against their object.
pub fn score_instances(truth: &[i32], predicted: &[i32]) -> InstanceScore {
    assert_eq!(truth.len(), predicted.len());
    let mut pairs: Vec<(i32, i32)> =
        truth.iter().copied().zip(predicted.iter().copied()).filter(|p| p.0 >= 0).collect();
    pairs.sort_unstable();
    let true_size = counts(pairs.iter().map(|p| p.0));
    let predicted_size = counts(pairs.iter().map(|p| p.1));
    let mut objects: Vec<ObjectScore> =
        true_size.iter().map(|(&id, &points)| ObjectScore { id, points, iou: 0.0, best: None, fragments: 0 }).collect();
    let mut held = BTreeMap::<i32, usize>::new();
    let (mut together, mut belonging) = (0usize, BTreeSet::new());
    for run in pairs.chunk_by(|a, b| a == b) {
        let ((id, instance), both) = (run[0], run.len());
        if instance < 0 {
            continue;
        }
        let at = objects.partition_point(|o| o.id < id);
        let object = &mut objects[at];
        let iou = both as f64 / (object.points + predicted_size[&instance] - both) as f64;
        if iou > object.iou {
            (object.iou, object.best) = (iou, Some(instance));
        }
        let share = both as f64 / object.points as f64;
        object.fragments += usize::from(share >= FRAGMENT);
        if share.max(both as f64 / predicted_size[&instance] as f64) >= FRAGMENT {
            together += 1;
            belonging.insert(instance);
        }
        if share >= 0.5 {
            *held.entry(instance).or_default() += 1;
        }
    }
    let ious: Vec<f64> = objects.iter().map(|o| o.iou).collect();
    InstanceScore {
        miou: mean(&ious),
        macc25: fraction_above(&ious, 0.25),
        macc50: fraction_above(&ious, 0.5),
        fragmented: objects.iter().filter(|o| o.fragments > 1).count(),
        merging: held.values().filter(|&&n| n > 1).count(),
        instances_per_object: together as f64 / objects.len().max(1) as f64,
        objects_per_instance: together as f64 / belonging.len().max(1) as f64,
        points: pairs.len(),
        objects,
    }
}

/// How often each value comes.
pub fn counts<T: Ord>(values: impl Iterator<Item = T>) -> BTreeMap<T, usize> {
    let mut counts = BTreeMap::new();
    values.for_each(|v| *counts.entry(v).or_default() += 1);
    counts
}

/// Mean; 0 of nothing.
pub fn mean(values: &[f64]) -> f64 {
    if values.is_empty() { 0.0 } else { values.iter().sum::<f64>() / values.len() as f64 }
}

/// Fraction of the values above `threshold` (strictly); 0 of nothing.
pub fn fraction_above(values: &[f64], threshold: f64) -> f64 {
    mean(&values.iter().map(|&v| f64::from(u8::from(v > threshold))).collect::<Vec<_>>())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_perfect_prediction_under_other_names() {
        let s = score_instances(&[0, 0, 1, 1, 1, 4], &[7, 7, 2, 2, 2, 0]);
        assert_eq!((s.miou, s.macc25, s.macc50, s.fragmented, s.merging, s.points), (1.0, 1.0, 1.0, 0, 0, 6));
        assert_eq!(s.objects[2], ObjectScore { id: 4, points: 1, iou: 1.0, best: Some(0), fragments: 1 });
    }

    #[test]
    fn fragments_and_merging_by_hand() {
        // Object 0 (10 points) falls into 6 + 3 and one point without a label; objects 1 and 2 (5 each) are one
        // instance, which also takes a point without a true object: that one does not count.
        let truth = [vec![0; 10], vec![1; 5], vec![2; 5], vec![-1; 3]].concat();
        let predicted = [vec![0; 6], vec![1; 3], vec![-1], vec![2; 10], vec![2, 3, -1]].concat();
        let s = score_instances(&truth, &predicted);
        assert_eq!(s.objects.iter().map(|o| o.iou).collect::<Vec<_>>(), [0.6, 0.5, 0.5]);
        assert!((s.miou - 1.6 / 3.0).abs() < 1e-12);
        assert_eq!((s.macc25, s.fragmented, s.merging, s.points), (1.0, 1, 1, 20));
        assert_eq!(s.macc50, 1.0 / 3.0, "exactly 0.5 does not pass");
        assert_eq!(s.objects[0].fragments, 2);
        assert_eq!((s.instances_per_object, s.objects_per_instance), (4.0 / 3.0, 4.0 / 3.0), "0-0, 0-1, 1-2, 2-2");
    }

    #[test]
    fn fragmentation_and_merging_count_what_belongs_together() {
        let all = |truth: &[i32], predicted: &[i32]| {
            let s = score_instances(truth, predicted);
            (s.instances_per_object, s.objects_per_instance)
        };
        let truth: Vec<i32> = (0..400).map(|i| i / 100).collect();
        let pieces: Vec<i32> = (0..400).map(|i| i / 5).collect();
        assert_eq!(all(&truth, &truth), (1.0, 1.0));
        assert_eq!(all(&truth, &pieces), (20.0, 1.0), "each holds a twentieth of its object, and nothing else");
        assert_eq!(all(&truth, &[7; 400]), (1.0, 4.0), "one instance for all four");
        let spilled: Vec<i32> = (0..400).map(|i| (i + 5) / 100).collect();
        let (fragments, merged) = all(&truth, &spilled);
        assert!(
            (fragments - 1.25).abs() < 1e-12 && merged == 1.0,
            "the last spills 5 of its 100 into one of their own"
        );
    }

    #[test]
    fn all_noise_scores_zero() {
        let s = score_instances(&[0, 1, 1], &[-1, -1, -1]);
        assert_eq!((s.miou, s.macc25, s.fragmented, s.merging), (0.0, 0.0, 0, 0));
        assert_eq!((s.instances_per_object, s.objects_per_instance), (0.0, 0.0));
        assert_eq!(s.objects[1].best, None);
        assert_eq!(score_instances(&[], &[]).miou, 0.0);
    }
}
