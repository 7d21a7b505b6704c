//! Principal components of feature vectors, to look at them as colours.

/// Rows that principal components are computed from; more change no colour that one would see.
const ROWS: usize = 100_000;

/// Feature vectors (`[n][dim]`) as colours of 0 to 1: their three leading principal components are red, green and blue, two
/// standard deviations to either side. Missing components give 0.5.
pub fn feature_colors(values: &[f32], dim: usize) -> Vec<[f32; 3]> {
    if dim == 0 || values.is_empty() {
        return Vec::new();
    }
    let step = (values.len() / dim).div_ceil(ROWS);
    let rows: Vec<f32> = values.chunks_exact(dim).step_by(step).flatten().copied().collect();
    pca(&rows, dim, 3).colors(values)
}

/// Leading principal components.
struct Pca {
    mean: Vec<f64>,
    /// Unit vectors by falling variance, largest entry positive.
    components: Vec<Vec<f64>>,
    /// Variance along each component.
    variance: Vec<f64>,
}

/// Steps of the power iteration: colours change no more after them.
const STEPS: usize = 200;

/// The `count` leading principal components of `rows` (`[n][dim]`), fewer where the rows vary along fewer, by power iteration
/// on the covariance in f64.
fn pca(rows: &[f32], dim: usize, count: usize) -> Pca {
    assert!(dim > 0 && rows.len().is_multiple_of(dim));
    let n = (rows.len() / dim).max(1) as f64;
    let mut mean = vec![0.0; dim];
    for row in rows.chunks_exact(dim) {
        mean.iter_mut().zip(row).for_each(|(m, &v)| *m += f64::from(v) / n);
    }
    let mut covariance = vec![0.0; dim * dim];
    for row in rows.chunks_exact(dim) {
        let centred: Vec<f64> = row.iter().zip(&mean).map(|(&v, m)| f64::from(v) - m).collect();
        for (i, a) in centred.iter().enumerate() {
            covariance[i * dim..][..dim].iter_mut().zip(&centred).for_each(|(c, b)| *c += a * b / n);
        }
    }
    let total: f64 = (0..dim).map(|i| covariance[i * dim + i]).sum();
    let (mut components, mut variance) = (Vec::<Vec<f64>>::new(), Vec::new());
    while components.len() < count.min(dim) {
        let (v, along) = leading(&covariance, &components, dim);
        if along <= 1e-12 * total {
            break;
        }
        components.push(v);
        variance.push(along);
    }
    Pca { mean, components, variance }
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

/// The direction of most variance at right angles to those `found`, and the variance along it.
fn leading(covariance: &[f64], found: &[Vec<f64>], dim: usize) -> (Vec<f64>, f64) {
    // Any start will do that is at right angles to no direction by chance.
    let mut v: Vec<f64> = (0..dim).map(|i| 1.0 + (i as f64).sin()).collect();
    let mut along = 0.0;
    for _ in 0..STEPS {
        for f in found {
            let share = dot(&v, f);
            v.iter_mut().zip(f).for_each(|(x, y)| *x -= share * y);
        }
        let length = dot(&v, &v).sqrt();
        if length == 0.0 {
            return (v, 0.0);
        }
        v.iter_mut().for_each(|x| *x /= length);
        let next: Vec<f64> = covariance.chunks_exact(dim).map(|row| dot(row, &v)).collect();
        along = dot(&next, &v);
        if along <= 0.0 {
            return (v, 0.0);
        }
        if dot(&next, &next).sqrt() - along <= 1e-15 * along {
            break;
        }
        v = next;
    }
    let length = dot(&v, &v).sqrt();
    // A direction's sign is free: fix it, so that the same features give the same colours.
    let largest = v.iter().copied().fold(0.0f64, |m, x| if x.abs() > m.abs() { x } else { m });
    v.iter_mut().for_each(|x| *x /= length * largest.signum());
    (v, along)
}

impl Pca {
    /// Colours of rows (`[n][dim]`): three components, two standard deviations to either side spread over 0 to 1.
    /// Missing components give 0.5.
    fn colors(&self, rows: &[f32]) -> Vec<[f32; 3]> {
        let tint = |row: &[f32]| {
            let centred: Vec<f64> = row.iter().zip(&self.mean).map(|(&v, m)| f64::from(v) - m).collect();
            [0, 1, 2].map(|k| match self.components.get(k) {
                Some(c) => (0.5 + 0.25 * dot(c, &centred) / self.variance[k].sqrt()).clamp(0.0, 1.0) as f32,
                None => 0.5,
            })
        };
        rows.chunks_exact(self.mean.len()).map(tint).collect()
    }
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
                rows.extend(axis.iter().zip([5.0, -2.0, 7.0]).map(|(c, centre)| (centre + sign * length * c) as f32));
            }
        }
        let p = pca(&rows, 3, 3);
        for (k, (axis, variance)) in axes.iter().zip([9.0 / 3.0, 4.0 / 3.0, 1.0 / 3.0]).enumerate() {
            assert!((p.variance[k] - variance).abs() < 1e-5, "{:?}", p.variance);
            assert!((dot(&p.components[k], axis).abs() - 1.0).abs() < 1e-6, "{:?}", p.components);
        }
    }

    #[test]
    fn equal_features_are_grey_and_two_dimensions_do() {
        assert_eq!(pca(&[0.3; 12], 4, 3).colors(&[0.3; 8]), [[0.5; 3]; 2]);
        assert_eq!(pca(&[], 2, 3).colors(&[]), Vec::<[f32; 3]>::new());
        let c = pca(&[0.0, 1.0, 1.0, 0.0], 2, 3).colors(&[0.0, 1.0]);
        assert!((c[0][0] - 0.5).abs() > 0.1 && c[0][2] == 0.5);
    }
}
