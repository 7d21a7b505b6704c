//! The rule of OpenGaussian's `render_lerf_by_text.py`: which instances answer a text, and which of their Gaussians are
//! rendered in a view (docs/protocols.md).

use crate::options::{Choice, LerfOptions};
use gs_scene::{Gaussians, points::KdTree};
use rayon::prelude::*;

/// Views that must have matched an instance for it to have a score.
pub const MIN_SUPPORT: u32 = 5;
/// Distance of mean features below which one of the ten best joins the best.
const JOIN: f32 = 0.9;
/// Gaussians with a scale of this or more are left out, in units of the scene.
const LARGE: f32 = 0.1;
/// Fewer Gaussians in view that are not large are no object.
const FEWEST: usize = 100;
/// Nor are fewer than these without the outliers.
const FEWEST_INLIERS: usize = 10;

/// The rule's choice among the instances; templates are those of the command.
pub fn choice(o: &LerfOptions) -> Choice {
    let (features, templates) = (o.choice.features.clone(), o.choice.templates.clone());
    Choice { join: Some(JOIN), features, templates, ..Choice::default() }
}

/// What the rule does beyond its choice, in words.
pub fn describe() -> String {
    format!(
        "; Gaussians of a scale of {LARGE} or more and outliers by neighbours left out, views with fewer than {FEWEST} missing"
    )
}

/// The Gaussians of a selection (ascending indices) that are rendered in a view: those that it draws (`in_view`, for every
/// Gaussian), that are not large, and that are no outliers ([`distances`]).
///
/// # Errors
/// In words, when too few are left: the view then has no mask.
pub fn shown(g: &Gaussians, selection: &[u32], in_view: &[bool]) -> Result<Vec<u32>, String> {
    let small = |i: usize| g.log_scales[i].iter().all(|s| s.exp() < LARGE);
    let mut left: Vec<u32> = selection.to_vec();
    left.retain(|&i| in_view[i as usize] && small(i as usize));
    if left.len() < FEWEST {
        return Err(format!("fewer than {FEWEST} of its Gaussians are in view and of a scale below {LARGE}"));
    }
    let points: Vec<[f32; 3]> = left.iter().map(|&i| g.means[i as usize]).collect();
    let (means, bound) = distances(&points);
    let mut near = means.iter().map(|&mean| mean < bound);
    left.retain(|_| near.next() == Some(true));
    if left.len() < FEWEST_INLIERS {
        return Err(format!("fewer than {FEWEST_INLIERS} of its Gaussians are no outliers"));
    }
    Ok(left)
}

/// For each point the mean of the squared distances to its nearest floor(sqrt(n)) points, itself among them; and the bound
/// that outliers reach: mean plus standard deviation (n - 1 in the denominator) of all these distances of all points.
fn distances(points: &[[f32; 3]]) -> (Vec<f64>, f64) {
    let (tree, count) = (KdTree::new(points), points.len().isqrt());
    if points.is_empty() {
        return (Vec::new(), 0.0);
    }
    // Of each point the mean, and the sum of squares.
    let of = |near: &mut Vec<(f32, u32)>, &p: &[f32; 3]| {
        tree.nearest(p, count, near);
        let d = || near.iter().map(|n| f64::from(n.0));
        (d().sum::<f64>() / count as f64, d().map(|d| d * d).sum::<f64>())
    };
    let rows: Vec<(f64, f64)> = points.par_iter().map_init(Vec::new, of).collect();
    let all = (points.len() * count) as f64;
    let mean = rows.iter().map(|r| r.0).sum::<f64>() / points.len() as f64;
    let squares: f64 = rows.iter().map(|r| r.1).sum();
    let variance = (squares - all * mean * mean).max(0.0) / (all - 1.0).max(1.0);
    (rows.into_iter().map(|r| r.0).collect(), mean + variance.sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bound_of_outliers_by_hand() {
        // Four points, so two neighbours each, the point itself first: 0 and 1, 0 and 1, 0 and 1, 0 and 64.
        let (means, bound) = distances(&[0.0, 1.0, 2.0, 10.0].map(|x| [x, 0.0, 0.0]));
        assert_eq!(means, [0.5, 0.5, 0.5, 32.0]);
        let mean: f64 = 67.0 / 8.0;
        let deviation = ((3.0 + 64.0 * 64.0 - 8.0 * mean * mean) / 7.0).sqrt();
        assert!((bound - mean - deviation).abs() < 1e-9 && bound < 32.0, "{bound}");
        assert_eq!(distances(&[]), (Vec::new(), 0.0));
    }

    /// Gaussians of a scale of 0.05 at 0, 1, 2, ... along x.
    fn row(n: usize) -> Gaussians {
        let mut g = Gaussians::default();
        for i in 0..n {
            g.means.push([i as f32, 0.0, 0.0]);
            g.log_scales.push([0.05f32.ln(); 3]);
        }
        g
    }

    #[test]
    fn large_hidden_and_lone_gaussians_are_left_out() {
        let mut g = row(104);
        g.means[7] = [5000.0, 0.0, 0.0];
        g.log_scales[20][1] = 0.2f32.ln();
        let mut in_view = vec![true; 104];
        in_view[3] = false;
        let all: Vec<u32> = (0..104).filter(|i| *i != 50).collect();
        let left = shown(&g, &all, &in_view).unwrap();
        let expected: Vec<u32> = (0..104).filter(|i| ![3, 7, 20, 50].contains(i)).collect();
        assert_eq!(left, expected, "one is far, one large, one out of view, one not selected");
        in_view[100] = false;
        in_view[101] = false;
        let why = shown(&g, &all, &in_view).unwrap_err();
        assert!(why.starts_with("fewer than 100 of its Gaussians are in view"), "99 are left: {why}");
    }

    #[test]
    fn points_in_one_place_are_all_outliers() {
        // No mean is below a bound of 0.
        let mut g = row(100);
        g.means.fill([1.0; 3]);
        let all: Vec<u32> = (0..100).collect();
        assert!(shown(&g, &all, &[true; 100]).unwrap_err().contains("no outliers"));
    }
}
