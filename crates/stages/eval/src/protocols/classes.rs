//! ScanNet: semantic classes of the scan's vertices (docs/protocols.md).

use artifacts::NYU40;
use serde::{Deserialize, Serialize};

/// Scenes of the benchmark.
pub const SCENES: usize = 10;
/// Sizes of the class sets.
pub const SETS: [usize; 3] = [19, 15, 10];

/// The classes of a set by its size (19, 15 or 10), ascending by NYU40 id: 15 leaves out picture, refrigerator,
/// showercurtain and bathtub, 10 keeps 1, 2, 4 to 10 and 33.
pub fn class_set(size: usize) -> Vec<(u32, &'static str)> {
    let keep = |id: u32| match size {
        15 => ![11, 24, 28, 36].contains(&id),
        10 => id <= 10 && id != 3 || id == 33,
        _ => true,
    };
    NYU40.into_iter().filter(|&(id, _)| keep(id)).collect()
}

/// Counts of points by true and predicted class.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Confusion {
    /// Classes; C.
    pub classes: usize,
    /// `[C][C + 1]`: row = true class, column = predicted class, the last one for none.
    pub weights: Vec<f64>,
}

impl Confusion {
    /// No points yet.
    pub fn new(classes: usize) -> Self {
        Self { classes, weights: vec![0.0; classes * (classes + 1)] }
    }

    /// The confusion of points by their truth and predicted class. Points without a true class are no part of the evaluation:
    /// whatever is predicted for them costs nothing.
    pub fn of(classes: usize, points: impl IntoIterator<Item = (Option<usize>, Option<usize>)>) -> Self {
        let mut confusion = Self::new(classes);
        for (truth, predicted) in points {
            if let Some(truth) = truth {
                confusion.weights[truth * (classes + 1) + predicted.unwrap_or(classes)] += 1.0;
            }
        }
        confusion
    }

    /// Adds the points of another scene: pooled scores come from the sum.
    pub fn merge(&mut self, other: &Self) {
        assert_eq!(self.classes, other.classes);
        self.weights.iter_mut().zip(&other.weights).for_each(|(a, b)| *a += b);
    }

    /// Whether sizes and values can be: for confusions read from a file.
    pub fn is_sound(&self) -> bool {
        self.weights.len() == self.classes * (self.classes + 1)
            && self.weights.iter().all(|w| w.is_finite() && *w >= 0.0)
    }

    /// Weight of true points of a class.
    pub fn truth(&self, class: usize) -> f64 {
        self.weights[class * (self.classes + 1)..(class + 1) * (self.classes + 1)].iter().sum()
    }

    /// IoU and recall of a class; none when the truth has no point of it.
    pub fn class(&self, class: usize) -> Option<(f64, f64)> {
        let at = |t: usize| self.weights[t * (self.classes + 1) + class];
        let (hit, truth) = (at(class), self.truth(class));
        let predicted: f64 = (0..self.classes).map(at).sum();
        (truth > 0.0).then(|| (hit / (truth + predicted - hit), hit / truth))
    }

    /// mIoU and mAcc: means over the classes present in the truth; none when there is none.
    pub fn means(&self) -> Option<(f64, f64)> {
        let present: Vec<(f64, f64)> = (0..self.classes).filter_map(|c| self.class(c)).collect();
        let n = present.len() as f64;
        let sum = present.iter().fold((0.0, 0.0), |s, c| (s.0 + c.0, s.1 + c.1));
        (!present.is_empty()).then_some((sum.0 / n, sum.1 / n))
    }
}

/// Index in the set of each NYU40 label; none for labels outside it (0 is unlabelled, and ids may exceed 40).
pub fn truth_classes(labels: &[u32], set: &[(u32, &str)]) -> Vec<Option<usize>> {
    labels.iter().map(|l| set.iter().position(|c| c.0 == *l)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sets_are_the_published_ones() {
        let ids = |n: usize| class_set(n).iter().map(|c| c.0).collect::<Vec<_>>();
        assert_eq!(ids(19), [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 14, 16, 24, 28, 33, 34, 36]);
        assert_eq!(ids(15), [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 12, 14, 16, 33, 34]);
        assert_eq!(ids(10), [1, 2, 4, 5, 6, 7, 8, 9, 10, 33]);
        let set = class_set(10);
        let t = truth_classes(&[0, 1, 3, 33, 40, 65535], &set);
        assert_eq!(t, [None, Some(0), None, Some(9), None, None], "unlabelled, outside the set, and ids beyond 40");
    }

    fn confusion(classes: usize, truth: &[Option<usize>], predicted: &[Option<usize>]) -> Confusion {
        Confusion::of(classes, truth.iter().copied().zip(predicted.iter().copied()))
    }

    #[test]
    fn only_classes_of_the_truth_count_and_points_without_truth_cost_nothing() {
        // Class 0: 3 points, 2 found. Class 1: 1 point, found, but one of class 0 is taken for it. Class 2 is absent from
        // the truth, and what is predicted for an unlabelled point is free.
        let truth = [Some(0), Some(0), Some(0), Some(1), None];
        let c = confusion(3, &truth, &[Some(0), Some(0), Some(1), Some(1), Some(0)]);
        assert_eq!(c.class(0), Some((2.0 / 3.0, 2.0 / 3.0)));
        assert_eq!((c.class(1), c.class(2)), (Some((0.5, 1.0)), None));
        assert_eq!(c.means(), Some(((2.0 / 3.0 + 0.5) / 2.0, (2.0 / 3.0 + 1.0) / 2.0)));
        assert_eq!(confusion(3, &truth, &[None; 5]).means(), Some((0.0, 0.0)));
        assert_eq!(Confusion::new(3).means(), None);
    }

    #[test]
    fn pooled_is_not_the_mean_over_scenes() {
        let scene = |hits: usize, misses: usize| {
            Confusion::of(1, [vec![(Some(0), Some(0)); hits], vec![(Some(0), None); misses]].concat())
        };
        let (a, b) = (scene(90, 10), scene(1, 9));
        let mean = (a.means().unwrap().0 + b.means().unwrap().0) / 2.0;
        let mut pooled = a;
        pooled.merge(&b);
        assert_eq!((mean, pooled.means().unwrap().0), (0.5, 91.0 / 110.0));
    }
}
