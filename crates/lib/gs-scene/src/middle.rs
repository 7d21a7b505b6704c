//! An origin near the points, for single precision has 24 bits and georeferenced scenes need more.

/// The median of each coordinate, the larger of two; zeros where there are no points. Unlike the mean and the bounding box, a few points far
/// away do not move it. Coordinates are ordered as [`f64::total_cmp`] orders them, so keep NaN out.
pub fn middle(points: impl Iterator<Item = [f64; 3]> + Clone) -> [f64; 3] {
    [0, 1, 2].map(|axis| {
        let mut values: Vec<f64> = points.clone().map(|p| p[axis]).collect();
        median(&mut values)
    })
}

fn median(values: &mut [f64]) -> f64 {
    let half = values.len() / 2;
    if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(half, f64::total_cmp).1 }
}

/// What is far: a middle of more units than this, and of more than [`SPREADS`] times the spread.
const FAR: f64 = 1_000.0;
const SPREADS: f64 = 16.0;

/// What to subtract from points so that single precision holds them: zeros unless their [`middle`] lies more than 1,000 units and more than 16
/// times their spread from the origin. The spread is the median distance from the middle. A shift is the middle in whole steps of a power of two
/// about as large as the spread, so that it is written in few digits. Points that are not finite do not count.
pub(crate) fn shift_of(points: impl Iterator<Item = [f64; 3]> + Clone) -> [f64; 3] {
    let points = points.filter(|p| p.iter().all(|v| v.is_finite()));
    // Nearly every scene is near, which counting tells without a copy.
    let (mut all, mut beyond) = (0, [[0; 2]; 3]);
    for p in points.clone() {
        all += 1;
        for (counts, v) in beyond.iter_mut().zip(p) {
            counts[0] += usize::from(v > FAR);
            counts[1] += usize::from(v < -FAR);
        }
    }
    if all == 0 || beyond.as_flattened().iter().all(|n| 2 * n < all) {
        return [0.0; 3];
    }
    let middle = middle(points.clone());
    let far = middle.iter().fold(0.0f64, |most, v| most.max(v.abs()));
    let from_middle = |p: [f64; 3]| (0..3).map(|c| (p[c] - middle[c]).powi(2)).sum::<f64>().sqrt();
    let spread = median(&mut points.map(from_middle).collect::<Vec<f64>>());
    if far <= FAR.max(SPREADS * spread) {
        return [0.0; 3];
    }
    let step = if spread > 0.0 { spread.log2().ceil().exp2() } else { 1.0 };
    middle.map(|v| (v / step).round() * step)
}

/// Points less their shift, which comes first.
pub(crate) fn shifted(points: &[[f64; 3]]) -> ([f64; 3], Vec<[f32; 3]>) {
    let shift = shift_of(points.iter().copied());
    (shift, points.iter().map(|p| less(*p, shift)).collect())
}

/// A point less a shift.
pub(crate) fn less(p: [f64; 3], shift: [f64; 3]) -> [f32; 3] {
    [0, 1, 2].map(|c| (p[c] - shift[c]) as f32)
}

/// A shift as people read it.
pub fn say(shift: [f64; 3]) -> String {
    shift.map(|v| v.to_string()).join(" ")
}

#[cfg(test)]
mod tests {
    use super::{middle, shift_of, shifted};

    #[test]
    fn the_middle_is_the_median_of_each_coordinate() {
        let points = [[1.0, 5.0, -1.0], [2.0, 4.0, -1.0], [1e15, 3.0, 7.0], [0.0, -1e15, 7.0]];
        assert_eq!(middle(points.into_iter()), [2.0, 4.0, 7.0]);
        assert_eq!(middle(points[..3].iter().copied()), [2.0, 4.0, -1.0]);
        assert_eq!(middle(std::iter::empty()), [0.0; 3]);
    }

    /// A line of 101 points of this length about a place.
    fn line(at: [f64; 3], length: f64) -> Vec<[f64; 3]> {
        (-50..=50).map(|i| [at[0] + length * f64::from(i) / 100.0, at[1], at[2]]).collect()
    }

    #[test]
    fn only_what_is_far_is_shifted() {
        let shift = |at, length| shift_of(line(at, length).into_iter());
        assert_eq!(shift([448_262.4, 5_411_932.7, 114.0], 12.0), [448_264.0, 5_411_932.0, 116.0], "in steps of 4");
        // Ordinary scenes: near, or as wide as they are far.
        for (at, length) in [([0.0; 3], 1.0), ([900.0, 0.0, -3.0], 0.1), ([20_000.0, 0.0, 0.0], 9_000.0)] {
            assert_eq!(shift(at, length), [0.0; 3], "{at:?} {length}");
        }
        // A few points far away are no scene far away, and hide none.
        let mut floaters = line([0.0; 3], 2.0);
        floaters.extend([[1e7; 3]; 20]);
        assert_eq!(shift_of(floaters.into_iter()), [0.0; 3]);
        let mut hidden = line([-5e5, 4e6, 0.0], 2.0);
        hidden.extend([[f64::NAN; 3], [0.0; 3], [1e12, 0.0, f64::INFINITY]]);
        assert_eq!(shift_of(hidden.into_iter()), [-5e5, 4e6, 0.0]);
        assert_eq!(shift_of([[4e6, 0.25, 0.0]; 3].into_iter()), [4e6, 0.0, 0.0], "all in one place");
        assert_eq!(shift_of(std::iter::empty()), [0.0; 3]);
    }

    #[test]
    fn shifted_points_keep_the_digits_of_doubles() {
        let points = line([448_262.4, 5_411_932.7, 114.0], 3.0);
        let (shift, near) = shifted(&points);
        for (p, near) in points.iter().zip(near) {
            assert!((0..3).all(|c| (shift[c] + f64::from(near[c]) - p[c]).abs() < 1e-6), "{p:?} {near:?}");
        }
    }
}
