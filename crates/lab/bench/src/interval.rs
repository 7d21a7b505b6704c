//! Mean and 95% interval of a few values.

use serde::Serialize;

/// A mean with its 95% interval.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Interval {
    pub mean: f64,
    /// Half the width of the 95% interval of the mean by Student's t distribution; none for a single value.
    pub half: Option<f64>,
    pub n: usize,
}

impl Interval {
    /// Of independent values; none of no values.
    pub fn of(values: &[f64]) -> Option<Self> {
        let n = values.len();
        if n == 0 {
            return None;
        }
        let mean = values.iter().sum::<f64>() / n as f64;
        let half = (n > 1).then(|| {
            let variance = values.iter().map(|v| (v - mean) * (v - mean)).sum::<f64>() / (n - 1) as f64;
            student(n - 1) * (variance / n as f64).sqrt()
        });
        Some(Self { mean, half, n })
    }
}

/// Exact to four decimals up to ten degrees of freedom, from standard tables.
const FEW: [f64; 10] = [12.7062, 4.3027, 3.1824, 2.7764, 2.5706, 2.4469, 2.3646, 2.3060, 2.2622, 2.2281];

/// The value that Student's t with `freedom` degrees of freedom (at least 1) stays below with probability 0.975: from a
/// table, then by the Cornish-Fisher expansion (Abramowitz and Stegun, 26.7.5), which is right to four decimals there.
pub fn student(freedom: usize) -> f64 {
    if let Some(t) = FEW.get(freedom - 1) {
        return *t;
    }
    let (z, v) = (1.959_963_984_540_054_f64, freedom as f64);
    let g1 = (z.powi(3) + z) / 4.0;
    let g2 = (5.0 * z.powi(5) + 16.0 * z.powi(3) + 3.0 * z) / 96.0;
    let g3 = (3.0 * z.powi(7) + 19.0 * z.powi(5) + 17.0 * z.powi(3) - 15.0 * z) / 384.0;
    z + g1 / v + g2 / (v * v) + g3 / v.powi(3)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_are_those_of_tables() {
        for (freedom, t) in [(1, 12.7062), (2, 4.3027), (10, 2.2281), (11, 2.2010), (15, 2.1314), (30, 2.0423)] {
            assert!((student(freedom) - t).abs() < 2e-4, "{freedom}: {}", student(freedom));
        }
        assert!((student(1_000_000) - 1.95997).abs() < 1e-5);
        assert!((1..100).all(|v| student(v) > student(v + 1)));
    }

    #[test]
    fn an_interval_by_hand() {
        // Deviation 1, three values: 4.3027 / sqrt(3).
        let i = Interval::of(&[1.0, 2.0, 3.0]).unwrap();
        assert!((i.mean - 2.0).abs() < 1e-12 && (i.half.unwrap() - 4.3027 / 3f64.sqrt()).abs() < 1e-12 && i.n == 3);
        assert_eq!(Interval::of(&[5.0]), Some(Interval { mean: 5.0, half: None, n: 1 }));
        assert_eq!(Interval::of(&[]), None);
    }
}
