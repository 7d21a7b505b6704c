//! Principal components of feature vectors, to look at them as colours.

/// Leading principal components.
#[derive(Debug, Clone, PartialEq)]
pub struct Pca {
    /// Mean of the rows; d.
    pub mean: Vec<f64>,
    /// Components by falling variance, unit length, largest entry positive; at most d of them.
    pub components: Vec<Vec<f64>>,
    /// Variance along each component.
    pub variance: Vec<f64>,
}

/// The `count` leading principal components of `rows` (`[n][dim]`), by Jacobi rotations of the covariance in f64.
///
/// # Panics
/// When `dim` is 0 or does not divide the number of values.
pub fn pca(rows: &[f32], dim: usize, count: usize) -> Pca {
    assert!(dim > 0 && rows.len().is_multiple_of(dim));
    let n = (rows.len() / dim).max(1) as f64;
    let mut mean = vec![0.0; dim];
    for row in rows.chunks_exact(dim) {
        for (m, &v) in mean.iter_mut().zip(row) {
            *m += f64::from(v);
        }
    }
    mean.iter_mut().for_each(|m| *m /= n);
    let mut covariance = vec![0.0; dim * dim];
    let mut centred = vec![0.0; dim];
    for row in rows.chunks_exact(dim) {
        for (c, (&v, m)) in centred.iter_mut().zip(row.iter().zip(&mean)) {
            *c = f64::from(v) - m;
        }
        for i in 0..dim {
            for j in i..dim {
                covariance[i * dim + j] += centred[i] * centred[j] / n;
            }
        }
    }
    for i in 0..dim {
        for j in 0..i {
            covariance[i * dim + j] = covariance[j * dim + i];
        }
    }
    let (values, vectors) = symmetric_eigen(covariance, dim);
    let mut order: Vec<usize> = (0..dim).collect();
    order.sort_by(|&a, &b| values[b].total_cmp(&values[a]).then(a.cmp(&b)));
    order.truncate(count);
    let components = order.iter().map(|&k| {
        let mut v: Vec<f64> = (0..dim).map(|i| vectors[i * dim + k]).collect();
        // A component's sign is free: fix it, so that the same features give the same colours.
        let largest = v.iter().copied().fold(0.0f64, |m, x| if x.abs() > m.abs() { x } else { m });
        if largest < 0.0 {
            v.iter_mut().for_each(|x| *x = -*x);
        }
        v
    });
    Pca { components: components.collect(), variance: order.iter().map(|&k| values[k].max(0.0)).collect(), mean }
}

impl Pca {
    /// Coordinates of a row along the components.
    pub fn project(&self, row: &[f32]) -> Vec<f64> {
        let centred: Vec<f64> = row.iter().zip(&self.mean).map(|(&v, m)| f64::from(v) - m).collect();
        self.components.iter().map(|c| c.iter().zip(&centred).map(|(a, b)| a * b).sum()).collect()
    }

    /// Colours of rows (`[n][dim]`): three components, two standard deviations to either side spread over 0 to 1.
    /// Missing components and components without variance give 0.5.
    pub fn colors(&self, rows: &[f32]) -> Vec<[f32; 3]> {
        let dim = self.mean.len();
        let tint = |row: &[f32]| {
            let p = self.project(row);
            [0, 1, 2].map(|k| match (p.get(k), self.variance.get(k)) {
                (Some(&x), Some(&v)) if v > 1e-20 => (0.5 + 0.25 * x / v.sqrt()).clamp(0.0, 1.0) as f32,
                _ => 0.5,
            })
        };
        rows.chunks_exact(dim).map(tint).collect()
    }
}

/// Eigenvalues and eigenvectors (columns) of a symmetric matrix, by cyclic Jacobi rotations.
fn symmetric_eigen(mut a: Vec<f64>, n: usize) -> (Vec<f64>, Vec<f64>) {
    let mut v = vec![0.0; n * n];
    for i in 0..n {
        v[i * n + i] = 1.0;
    }
    let scale: f64 = a.iter().map(|x| x * x).sum();
    for _ in 0..64 {
        let off: f64 = (0..n).flat_map(|i| (0..i).map(move |j| (i, j))).map(|(i, j)| a[i * n + j].powi(2)).sum();
        if off <= 1e-28 * scale {
            break;
        }
        for p in 0..n {
            for q in p + 1..n {
                let apq = a[p * n + q];
                if apq == 0.0 {
                    continue;
                }
                let theta = (a[q * n + q] - a[p * n + p]) / (2.0 * apq);
                let t = theta.signum() / (theta.abs() + theta.hypot(1.0));
                let c = 1.0 / t.hypot(1.0);
                let s = t * c;
                for k in 0..n {
                    let (x, y) = (a[k * n + p], a[k * n + q]);
                    (a[k * n + p], a[k * n + q]) = (c * x - s * y, s * x + c * y);
                }
                for k in 0..n {
                    let (x, y) = (a[p * n + k], a[q * n + k]);
                    (a[p * n + k], a[q * n + k]) = (c * x - s * y, s * x + c * y);
                }
                for k in 0..n {
                    let (x, y) = (v[k * n + p], v[k * n + q]);
                    (v[k * n + p], v[k * n + q]) = (c * x - s * y, s * x + c * y);
                }
            }
        }
    }
    ((0..n).map(|i| a[i * n + i]).collect(), v)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_the_axes_of_a_known_cloud() {
        // Points at +-3 along (1, 1, 0)/sqrt 2, +-2 along (0, 0, 1), +-1 along (1, -1, 0)/sqrt 2, about (5, -2, 7).
        let r = std::f64::consts::FRAC_1_SQRT_2;
        let axes = [[r, r, 0.0], [0.0, 0.0, 1.0], [r, -r, 0.0]];
        let mut rows = Vec::new();
        for (axis, length) in axes.iter().zip([3.0, 2.0, 1.0]) {
            for sign in [-1.0, 1.0] {
                for (c, centre) in axis.iter().zip([5.0, -2.0, 7.0]) {
                    rows.push((centre + sign * length * c) as f32);
                }
            }
        }
        let p = pca(&rows, 3, 3);
        for (k, (axis, variance)) in axes.iter().zip([9.0 / 3.0, 4.0 / 3.0, 1.0 / 3.0]).enumerate() {
            assert!((p.variance[k] - variance).abs() < 1e-5, "{:?}", p.variance);
            let dot: f64 = p.components[k].iter().zip(axis).map(|(a, b)| a * b).sum();
            assert!((dot.abs() - 1.0).abs() < 1e-6, "{:?}", p.components);
        }
        assert!((p.project(&[5.0, -2.0, 9.0])[1] - 2.0).abs() < 1e-5);
    }

    #[test]
    fn components_are_orthonormal_and_explain_the_whole() {
        let dim = 12;
        let mut state = 1u32;
        let rows: Vec<f32> = (0..dim * 400)
            .map(|i| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                (state >> 8) as f32 / 1e7 * (1 + i % dim) as f32
            })
            .collect();
        let p = pca(&rows, dim, dim);
        for i in 0..dim {
            for j in 0..dim {
                let dot: f64 = p.components[i].iter().zip(&p.components[j]).map(|(a, b)| a * b).sum();
                assert!((dot - f64::from(u8::from(i == j))).abs() < 1e-10);
            }
        }
        let total: f64 = rows
            .chunks_exact(dim)
            .flat_map(|r| r.iter().zip(&p.mean).map(|(&v, m)| (f64::from(v) - m).powi(2)))
            .sum::<f64>()
            / 400.0;
        assert!((p.variance.iter().sum::<f64>() / total - 1.0).abs() < 1e-10);
    }

    #[test]
    fn equal_features_are_grey_and_two_dimensions_do() {
        assert_eq!(pca(&[0.3; 12], 4, 3).colors(&[0.3; 8]), [[0.5; 3]; 2]);
        assert_eq!(pca(&[], 2, 3).colors(&[]), Vec::<[f32; 3]>::new());
        let c = pca(&[0.0, 1.0, 1.0, 0.0], 2, 3).colors(&[0.0, 1.0]);
        assert!((c[0][0] - 0.5).abs() > 0.1 && c[0][2] == 0.5);
    }
}
