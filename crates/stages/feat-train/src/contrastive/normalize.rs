//! Standardisation to mean 0 and deviation 1, forward and backward.
//!
//! The deviation is the unbiased one, and the paper's epsilon of 1e-10 is added to it. A deviation as small as rounding noise
//! counts as zero and gives zeros: a scene of one colour must not become amplified noise.

use super::real::Real;
use rayon::prelude::*;

/// Added to deviations (paper, "Neighborhood Feature Aggregation").
const EPSILON: f64 = 1e-10;
/// Deviations below this share of the mean's size are rounding noise.
const NOISE: f64 = 1e-6;
/// Rows summed at a time.
const CHUNK: usize = 8192;

/// Mean, deviation and its inverse.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Moments {
    pub mean: f64,
    /// Unbiased standard deviation.
    pub deviation: f64,
    /// 1 / (deviation + epsilon), or 0 where the deviation is noise.
    pub inverse: f64,
    /// How many values, in all.
    pub count: f64,
}

impl Moments {
    /// From the sums of (x - pivot) and of its square.
    pub fn from_sums(pivot: f64, s1: f64, s2: f64, count: f64) -> Self {
        if count < 2.0 {
            return Self { mean: pivot + s1, deviation: 0.0, inverse: 0.0, count };
        }
        let mean = pivot + s1 / count;
        let deviation = ((s2 - s1 * s1 / count).max(0.0) / (count - 1.0)).sqrt();
        let noise = deviation <= NOISE * mean.abs() || deviation <= EPSILON;
        Self { mean, deviation, inverse: if noise { 0.0 } else { 1.0 / (deviation + EPSILON) }, count }
    }

    #[inline]
    pub fn apply(&self, v: f64) -> f64 {
        (v - self.mean) * self.inverse
    }

    /// The gradient with respect to a value that counts `weight` times, given: the gradient `g` of its standardised
    /// value `y` (already summed over the `weight` copies), and the sums of g and of g y over everything.
    #[inline]
    pub fn backward(&self, weight: f64, g: f64, y: f64, sum_g: f64, sum_gy: f64) -> f64 {
        if self.inverse == 0.0 {
            return 0.0;
        }
        self.inverse * (g - weight * sum_g / self.count) - weight * y * sum_gy / ((self.count - 1.0) * self.deviation)
    }
}

/// Moments of each of the `d` channels of `values` `[rows][d]`, row r counting `weights[r]` times (or once).
pub fn channel_moments<T: Real>(values: &[T], d: usize, weights: Option<&[u32]>) -> Vec<Moments> {
    let Some(pivot) = values.get(..d) else { return vec![Moments::default(); d] };
    let pivot: Vec<f64> = pivot.iter().map(|v| v.get()).collect();
    // f64 in pieces of fixed size, added up in order.
    let parts: Vec<(f64, Vec<f64>)> = values
        .par_chunks(CHUNK * d)
        .enumerate()
        .map(|(chunk, rows)| {
            let mut sums = vec![0.0; 2 * d];
            let mut count = 0.0;
            for (r, row) in rows.chunks_exact(d).enumerate() {
                let w = weights.map_or(1.0, |w| f64::from(w[chunk * CHUNK + r]));
                count += w;
                for c in 0..d {
                    let x = row[c].get() - pivot[c];
                    sums[c] += w * x;
                    sums[d + c] += w * x * x;
                }
            }
            (count, sums)
        })
        .collect();
    let mut sums = vec![0.0; 2 * d];
    let mut count = 0.0;
    for (n, part) in parts {
        count += n;
        sums.iter_mut().zip(part).for_each(|(s, p)| *s += p);
    }
    (0..d).map(|c| Moments::from_sums(pivot[c], sums[c], sums[d + c], count)).collect()
}

/// Moments of one Gaussian's channels.
pub fn row_moments<T: Real>(row: &[T]) -> Moments {
    let pivot = row.first().map_or(0.0, |v| v.get());
    let s1: f64 = row.iter().map(|v| v.get() - pivot).sum();
    let s2: f64 = row.iter().map(|v| (v.get() - pivot) * (v.get() - pivot)).sum();
    Moments::from_sums(pivot, s1, s2, row.len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn moments_are_exact_far_from_zero_and_constants_become_zeros() {
        let values: Vec<f32> = (0..1_000_000).flat_map(|i| [1000.0 + (i % 2) as f32, 0.1]).collect();
        let m = channel_moments(&values, 2, None);
        assert!((m[0].mean - 1000.5).abs() < 1e-12 && (m[0].deviation - 0.5).abs() < 1e-6);
        assert_eq!(m[1].inverse, 0.0);
        assert_eq!(m[1].apply(f64::from(0.1f32)), 0.0);
        assert_eq!(channel_moments(&[5.0f64], 1, None)[0].apply(5.0), 0.0);
        assert_eq!(channel_moments::<f32>(&[], 3, None).len(), 3);
        // Weights count copies.
        let copies = channel_moments(&[1.0f64, 1.0, 1.0, 4.0], 1, None)[0];
        let weighted = channel_moments(&[1.0f64, 4.0], 1, Some(&[3, 1]))[0];
        assert!((copies.mean - weighted.mean).abs() < 1e-15 && (copies.deviation - weighted.deviation).abs() < 1e-15);
    }
}
