//! ScanNet: semantic classes of the scan's vertices (docs/protocols.md).

use artifacts::NYU40;
use glam::{DMat3, DQuat, DVec3, DVec4, Vec3};
use gs_scene::Gaussians;
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::num::NonZeroUsize;

/// The 10 benchmark scenes.
pub const SCENES: [&str; 10] = [
    "scene0000_00",
    "scene0062_00",
    "scene0070_00",
    "scene0097_00",
    "scene0140_00",
    "scene0200_00",
    "scene0347_00",
    "scene0400_00",
    "scene0590_00",
    "scene0645_00",
];
/// Sizes of the class sets.
pub const SETS: [usize; 3] = [19, 15, 10];

/// The classes of a set by its size (19, 15 or 10), ascending by NYU40 id: 15 leaves out picture, refrigerator,
/// showercurtain and bathtub, 10 keeps 1, 2, 4 to 10 and 33. None for another size.
pub fn class_set(size: usize) -> Option<Vec<(u32, &'static str)>> {
    let keep = |id: u32| match size {
        19 => true,
        15 => ![11, 24, 28, 36].contains(&id),
        10 => id <= 10 && id != 3 || id == 33,
        _ => false,
    };
    SETS.contains(&size).then(|| NYU40.into_iter().filter(|&(id, _)| keep(id)).collect())
}

/// The true class of a point, as an index into the set, and its weight; none for a point that no label tells.
pub type Truth = (Option<usize>, f64);

/// Counts (or weights) of points by true and predicted class.
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
    pub fn of(classes: usize, points: impl IntoIterator<Item = (Truth, Option<usize>)>) -> Self {
        let mut confusion = Self::new(classes);
        for ((truth, weight), predicted) in points {
            if let Some(truth) = truth {
                confusion.weights[truth * (classes + 1) + predicted.unwrap_or(classes)] += weight;
            }
        }
        confusion
    }

    /// Adds the points of another scene: pooled scores come from the sum.
    ///
    /// # Panics
    /// When the two are of different sets.
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

/// How far labelled vertices speak for a Gaussian, in its largest scales.
const REACH: f32 = 5.0;
/// Most vertices that speak for one.
const MOST: usize = 1000;

/// The volume-aware truth (Dr. Splat): per Gaussian the class whose labelled vertices have the largest summed density
/// exp(-m/2), m the squared Mahalanobis distance to the Gaussian, among at most 1,000 nearest vertices within 5 of its
/// largest scale; ties go to the lowest class; none where no vertex is near. With it the Gaussian's weight, opacity times
/// the product of its scales. `truth` holds the class of each vertex; vertices without one do not speak.
pub fn volume_truth(
    gaussians: &Gaussians,
    vertices: &[[f32; 3]],
    truth: &[Option<usize>],
    classes: usize,
) -> Vec<Truth> {
    let labelled: Vec<usize> = (0..vertices.len()).filter(|&v| truth[v].is_some()).collect();
    let positions: Vec<[f32; 3]> = labelled.iter().map(|&v| vertices[v]).collect();
    let tree = (!positions.is_empty()).then(|| ImmutableKdTree::<f32, 3>::new_from_slice(&positions).ok()).flatten();
    let most = NonZeroUsize::new(MOST).expect("not zero");
    let one = |i: usize| {
        let scales = gaussians.log_scales[i].map(|s| f64::from(s).exp());
        let weight = f64::from(gaussians.opacity(i)) * scales.iter().product::<f64>();
        let Some(tree) = &tree else { return (None, weight) };
        let reach = REACH * scales.iter().copied().fold(0.0, f64::max) as f32;
        if !reach.is_finite() {
            return (None, weight);
        }
        let mean = gaussians.means[i];
        let near = tree.query(&mean).nearest_n::<SquaredEuclidean<f32>>(most).within(reach * reach).execute();
        let [w, x, y, z] = gaussians.rotations[i].map(f64::from);
        let unit = DVec4::new(x, y, z, w).try_normalize().unwrap_or(DVec4::W);
        let to_own = DMat3::from_quat(DQuat::from_vec4(unit)).transpose();
        let mut votes = vec![0.0f64; classes];
        for found in near {
            let v = labelled[found.item as usize];
            let d = Vec3::from(vertices[v]).as_dvec3() - Vec3::from(mean).as_dvec3();
            let m = (to_own * d / DVec3::from(scales)).length_squared();
            votes[truth[v].expect("labelled")] += (-0.5 * m).exp();
        }
        let best = (0..classes).filter(|&c| votes[c] > 0.0).fold(None, |best: Option<usize>, c| match best {
            Some(b) if votes[b] >= votes[c] => Some(b),
            _ => Some(c),
        });
        (best, weight)
    };
    (0..gaussians.len()).into_par_iter().map(one).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sets_are_the_published_ones() {
        let ids = |n: usize| class_set(n).unwrap().iter().map(|c| c.0).collect::<Vec<_>>();
        assert_eq!(ids(19), [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 14, 16, 24, 28, 33, 34, 36]);
        assert_eq!(ids(15), [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 12, 14, 16, 33, 34]);
        assert_eq!(ids(10), [1, 2, 4, 5, 6, 7, 8, 9, 10, 33]);
        assert_eq!(class_set(20), None);
        let set = class_set(10).unwrap();
        let t = truth_classes(&[0, 1, 3, 33, 40, 65535], &set);
        assert_eq!(t, [None, Some(0), None, Some(9), None, None], "unlabelled, outside the set, and ids beyond 40");
    }

    fn confusion(classes: usize, truth: &[Option<usize>], predicted: &[Option<usize>]) -> Confusion {
        Confusion::of(classes, truth.iter().zip(predicted).map(|(&t, &p)| ((t, 1.0), p)))
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
        let scene = |hits: f64, misses: f64| Confusion::of(1, [((Some(0), hits), Some(0)), ((Some(0), misses), None)]);
        let (a, b) = (scene(90.0, 10.0), scene(1.0, 9.0));
        let mean = (a.means().unwrap().0 + b.means().unwrap().0) / 2.0;
        let mut pooled = a;
        pooled.merge(&b);
        assert_eq!((mean, pooled.means().unwrap().0), (0.5, 91.0 / 110.0));
    }

    fn one_gaussian() -> Gaussians {
        Gaussians {
            means: vec![[0.0; 3]],
            log_scales: vec![[1.0f32.ln(), 0.1f32.ln(), 0.1f32.ln()]],
            // A quarter turn about z: the long axis lies along y.
            rotations: vec![[1.0, 0.0, 0.0, 1.0]],
            opacity_logits: vec![0.0],
            sh: vec![0.0; 3],
            sh_degree: 0,
        }
    }

    #[test]
    fn volumes_vote_by_density_along_the_gaussians_axes() {
        let g = one_gaussian();
        // Nearer in space but across the short axis, against farther along the long one.
        let vertices = [[0.5, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 9.0, 0.0]];
        let truth = [Some(0), Some(1), Some(0)];
        let v = volume_truth(&g, &vertices, &truth, 2);
        assert_eq!(v[0].0, Some(1));
        assert!((v[0].1 - 0.5 * 0.01).abs() < 1e-8, "opacity times the product of scales");
        assert_eq!(volume_truth(&g, &vertices, &[None, None, Some(0)], 2)[0].0, None, "out of reach");
        assert_eq!(volume_truth(&g, &[], &[], 2)[0].0, None);
        assert_eq!(Confusion::of(2, [(v[0], Some(1))]).class(1), Some((1.0, 1.0)));
    }
}
