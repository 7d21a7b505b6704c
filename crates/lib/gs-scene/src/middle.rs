//! An origin near the points.

/// The median of each coordinate, the larger of two; zeros where there are no points. Unlike the mean and the bounding box, a few points far
/// away do not move it. Coordinates are ordered as [`f64::total_cmp`] orders them, so keep NaN out.
pub fn middle(points: impl Iterator<Item = [f64; 3]> + Clone) -> [f64; 3] {
    [0, 1, 2].map(|axis| {
        let mut values: Vec<f64> = points.clone().map(|p| p[axis]).collect();
        let half = values.len() / 2;
        if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(half, f64::total_cmp).1 }
    })
}

#[cfg(test)]
mod tests {
    use super::middle;

    #[test]
    fn the_middle_is_the_median_of_each_coordinate() {
        let points = [[1.0, 5.0, -1.0], [2.0, 4.0, -1.0], [1e15, 3.0, 7.0], [0.0, -1e15, 7.0]];
        assert_eq!(middle(points.into_iter()), [2.0, 4.0, 7.0]);
        assert_eq!(middle(points[..3].iter().copied()), [2.0, 4.0, -1.0]);
        assert_eq!(middle(std::iter::empty()), [0.0; 3]);
    }
}
