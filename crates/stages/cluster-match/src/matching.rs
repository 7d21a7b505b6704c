//! Which mask of a view shows which instance (paper, "Instance Clustering and Semantic Matching").
//!
//! Both are measured by blending weight, which the footprints hold: nothing is rendered again. Rendering is linear, so the mean
//! rendered feature of a mask is the mean of its Gaussians' features, each by its weight.

use crate::granules::Shown;
use artifacts::{Features, Footprints, Level, Match, flat};
use gs_io::Result;

/// Least score of a match.
const LEAST: f64 = 0.2;

/// The matches of all instances by what masks show of them: the best mask of each view, where its score exceeds 0.2.
pub(crate) fn matches(shown: &[Vec<Shown>], footprints: &Footprints) -> Vec<Match> {
    let of_one = |(instance, shown): (usize, &Vec<Shown>)| -> Vec<Match> {
        let of = |s: &Shown| {
            let row = &footprints.rows[s.row as usize];
            let (view, mask) = (row.view, row.mask);
            Match { instance: instance as u32, view, mask, score: s.fit as f32, visible: s.seen as f32 }
        };
        shown.iter().filter(|s| s.fit > LEAST).map(of).collect()
    };
    shown.iter().enumerate().flat_map(of_one).collect()
}

/// Mean features of instances and of masks, as rendered.
pub(crate) struct Likeness {
    instances: Vec<Vec<f64>>,
    masks: Vec<Vec<f64>>,
}

impl Likeness {
    /// Those of `count` instances, over all views, and of the masks at `levels`. `labels` are instances of the kept Gaussians, -1 for none.
    ///
    /// # Errors
    /// When the footprints can't be read.
    pub fn new(
        labels: &[i32],
        count: usize,
        features: &Features,
        footprints: &Footprints,
        levels: &[Level],
    ) -> Result<Self> {
        let dim = features.dim();
        let mut all = Self { instances: vec![vec![0.0; dim]; count], masks: vec![Vec::new(); footprints.rows.len()] };
        if dim == 0 {
            return Ok(all);
        }
        let add = |sum: &mut [f64], weight: f64, i: usize| {
            sum.iter_mut().zip(flat(features.row(i))).for_each(|(s, f)| *s += weight * f64::from(*f));
        };
        let mut seen = vec![0.0; labels.len()];
        for row in (0..footprints.rows.len()).filter(|&r| footprints.rows[r].is_of(levels)) {
            let mut mask = vec![0.0; dim];
            for (i, w) in footprints.entries(row)?.iter() {
                seen[i as usize] += f64::from(w);
                add(&mut mask, f64::from(w), i as usize);
            }
            all.masks[row] = mask;
        }
        for (i, (&label, &weight)) in labels.iter().zip(&seen).enumerate().filter(|(_, (label, _))| **label >= 0) {
            add(&mut all.instances[label as usize], weight, i);
        }
        Ok(all)
    }

    /// The cosine of an instance and a mask, a row of the footprints; 0 where it is negative or one has no direction, 1 where features
    /// have no dimension.
    pub fn of(&self, instance: u32, row: u32) -> f64 {
        let (a, b) = (&self.instances[instance as usize], &self.masks[row as usize]);
        if a.is_empty() {
            return 1.0;
        }
        let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
        let length = (dot(a, a) * dot(b, b)).sqrt();
        if length > 1e-30 { (dot(a, b) / length).max(0.0) } else { 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::footprints;
    use ndarray::Array2;

    #[test]
    fn the_mask_of_each_view_matches_where_it_fits() {
        let views: [&[&[u32]]; 2] = [&[&[0, 1]], &[&[2, 3], &[4, 5]]];
        let footprints = footprints(&views);
        let shown = |row, fit| Shown { row, fit, seen: 7.0 };
        let found = matches(&[vec![], vec![shown(0, 0.2), shown(2, 0.5)]], &footprints);
        assert_eq!(found, [Match { instance: 1, view: 1, mask: 1, score: 0.5, visible: 7.0 }]);
    }

    #[test]
    fn likeness_is_the_cosine_of_mean_features_by_weight() {
        // Instance 0 is seen in two masks of one feature and in one of another, so often by each of its Gaussians.
        let footprints = footprints(&[&[&[0, 1], &[2, 3]], &[&[0, 1]]]);
        let values = Array2::from_shape_fn((8, 2), |(i, c)| if i < 2 { [3.0, 0.0][c] } else { [0.0, 1.0][c] });
        let features = Features { kept: (0..8).collect(), values };
        let likeness = Likeness::new(&[0, 0, 0, -1, 1, 1, 1, 1], 2, &features, &footprints, &[Level::LARGE]).unwrap();
        // 4 times (3, 0) and once (0, 1).
        let length = (12.0f64 * 12.0 + 1.0).sqrt();
        let of = |instance| [0, 1, 2].map(|row| likeness.of(instance, row));
        of(0).into_iter().zip([12.0, 1.0, 12.0]).for_each(|(a, b)| assert!((a - b / length).abs() < 1e-12));
        assert_eq!(of(1), [0.0; 3], "seen by no view");
    }
}
