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

/// How Gaussians and the scan's vertices are brought together.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Association {
    /// Gaussian i is vertex i: positions were frozen, nothing was added or removed (OpenGaussian, CAGS)
    OneToOne,
    /// Every vertex takes the class of its nearest Gaussian (GaussianWorld, Split&Splat)
    Nearest,
    /// Every Gaussian gets a true class from the labelled vertices around it and counts by its volume (Dr. Splat, VALA)
    Volume,
}

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

    /// Adds a point of true class `truth` and predicted class `predicted` (indices into the set). Points without a true
    /// class are no part of the evaluation: whatever is predicted for them costs nothing.
    pub fn add(&mut self, truth: usize, predicted: Option<usize>, weight: f64) {
        self.weights[truth * (self.classes + 1) + predicted.unwrap_or(self.classes)] += weight;
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

/// Scores vertices: `truth` class and `predicted` class of each; `counts` says which take part (with the opacity rule,
/// those whose Gaussian is not faint).
///
/// # Panics
/// When lengths differ.
pub fn score_vertices(
    truth: &[Option<usize>],
    predicted: &[Option<usize>],
    counts: &[bool],
    classes: usize,
) -> Confusion {
    let truth: Vec<(Option<usize>, f64)> = truth.iter().map(|&t| (t, 1.0)).collect();
    score_volumes(&truth, predicted, counts, classes)
}

/// Index of the nearest Gaussian among `speakers` (ascending indices) for each vertex; none when there are none.
pub fn nearest(gaussians: &Gaussians, speakers: &[u32], vertices: &[[f32; 3]]) -> Vec<Option<u32>> {
    let positions: Vec<[f32; 3]> = speakers.iter().map(|&i| gaussians.means[i as usize]).collect();
    nearest_of(&positions, vertices).into_iter().map(|n| n.map(|n| speakers[n as usize])).collect()
}

/// Index of the nearest of `positions` for each point; none when there are none.
pub fn nearest_of(positions: &[[f32; 3]], points: &[[f32; 3]]) -> Vec<Option<u32>> {
    let tree = (!positions.is_empty()).then(|| ImmutableKdTree::<f32, 3>::new_from_slice(positions).ok()).flatten();
    let Some(tree) = tree else { return vec![None; points.len()] };
    let one = |p: &[f32; 3]| Some(tree.query(p).nearest_one::<SquaredEuclidean<f32>>().execute().item);
    points.par_iter().map(one).collect()
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
) -> Vec<(Option<usize>, f64)> {
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

/// Scores Gaussians against [`volume_truth`]: every Gaussian that has a true class counts with its weight.
pub fn score_volumes(
    truth: &[(Option<usize>, f64)],
    predicted: &[Option<usize>],
    counts: &[bool],
    classes: usize,
) -> Confusion {
    assert!(truth.len() == predicted.len() && truth.len() == counts.len());
    let mut confusion = Confusion::new(classes);
    for ((&(t, weight), &p), _) in truth.iter().zip(predicted).zip(counts).filter(|(_, c)| **c) {
        if let Some(t) = t {
            confusion.add(t, p, weight);
        }
    }
    confusion
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

    #[test]
    fn only_classes_of_the_truth_count_and_points_without_truth_cost_nothing() {
        // Class 0: 3 points, 2 found. Class 1: 1 point, found, but one of class 0 is taken for it. Class 2 is absent from
        // the truth though predicted once for a class-0 point... here for an unlabelled point, which is free.
        let truth = [Some(0), Some(0), Some(0), Some(1), None];
        let predicted = [Some(0), Some(0), Some(1), Some(1), Some(0)];
        let c = score_vertices(&truth, &predicted, &[true; 5], 3);
        assert_eq!(c.class(0), Some((2.0 / 3.0, 2.0 / 3.0)));
        assert_eq!(c.class(1), Some((0.5, 1.0)));
        assert_eq!(c.class(2), None);
        assert_eq!(c.means(), Some(((2.0 / 3.0 + 0.5) / 2.0, (2.0 / 3.0 + 1.0) / 2.0)));
        let none = score_vertices(&truth, &[None; 5], &[true; 5], 3);
        assert_eq!(none.means(), Some((0.0, 0.0)));
        assert_eq!(Confusion::new(3).means(), None);
    }

    #[test]
    fn the_opacity_rule_takes_points_out() {
        let truth = [Some(0), Some(0)];
        let predicted = [Some(0), Some(1)];
        assert_eq!(score_vertices(&truth, &predicted, &[true, true], 2).means().unwrap().0, 0.5);
        assert_eq!(score_vertices(&truth, &predicted, &[true, false], 2).means().unwrap().0, 1.0);
    }

    #[test]
    fn pooled_is_not_the_mean_over_scenes() {
        let scene = |hits: f64, misses: f64| {
            let mut c = Confusion::new(1);
            c.add(0, Some(0), hits);
            c.add(0, None, misses);
            c
        };
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
        let c = score_volumes(&v, &[Some(1)], &[true], 2);
        assert_eq!(c.class(1), Some((1.0, 1.0)));
    }

    #[test]
    fn the_nearest_gaussian_speaks_for_a_vertex() {
        let mut g = Gaussians::default();
        for x in [0.0, 1.0, 2.0] {
            g.means.push([x, 0.0, 0.0]);
        }
        assert_eq!(nearest(&g, &[0, 2], &[[0.9, 0.0, 0.0], [1.2, 0.0, 0.0]]), [Some(0), Some(2)]);
        assert_eq!(nearest(&g, &[], &[[0.0; 3]]), [None]);
    }
}
