//! Positions that f32 arithmetic can bear.

use gs_scene::middle;

/// Coordinates beyond this (after the shift) would overflow when squared in f32.
const LARGEST: f64 = 1e18;

/// Positions relative to a scene origin.
#[derive(Debug, Clone, PartialEq)]
pub struct Positions {
    /// The shifted positions of the usable points, in the order given.
    pub points: Vec<[f32; 3]>,
    /// Indices of the usable points, ascending.
    pub usable: Vec<u32>,
}

/// Subtracts the median of each coordinate (in f64) from every position, so that a scene at 1e6 with extents of 1e-3
/// keeps its digits in f32. The median and not the middle of the bounding box: a few far background points must not
/// move the origin away from where the points are. Points that are not finite, or beyond 1e18, are left out.
pub fn shifted(means: &[[f32; 3]]) -> Positions {
    let finite = |p: &[f32; 3]| p.iter().all(|v| v.is_finite());
    let origin = middle(means.iter().filter(|p| finite(p)).map(|p| p.map(f64::from)));
    let mut out = Positions { points: Vec::with_capacity(means.len()), usable: Vec::with_capacity(means.len()) };
    for (i, p) in means.iter().enumerate() {
        let q = [0, 1, 2].map(|a| f64::from(p[a]) - origin[a]);
        if finite(p) && q.iter().all(|v| v.abs() <= LARGEST) {
            out.points.push(q.map(|v| v as f32));
            out.usable.push(i as u32);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn far_scenes_keep_their_differences_and_odd_points_are_left_out() {
        let base = 1_048_576.0f32; // neighbouring floats are 0.125 apart
        let p = shifted(&[
            [base, 0.0, 5.0],
            [base + 0.125, 0.0, 5.0],
            [f32::NAN, 0.0, 5.0],
            [base + 0.25, 0.0, 5.0],
            [0.0, f32::INFINITY, 0.0],
            [f32::MAX, 0.0, 5.0],
        ]);
        assert_eq!(p.usable, [0, 1, 3]);
        assert_eq!(p.points[1][0] - p.points[0][0], 0.125);
        assert_eq!(p.points[2][0] - p.points[1][0], 0.125);
        assert!(shifted(&[]).points.is_empty());
    }
}
