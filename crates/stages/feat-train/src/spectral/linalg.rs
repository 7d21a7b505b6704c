//! Small dense linear algebra in f64, on columns. Work on columns is spread over threads; each sum has one order.

use nalgebra::{DMatrix, SymmetricEigen};
use rayon::prelude::*;

/// A matrix as columns of equal length.
pub type Columns = Vec<Vec<f64>>;

/// Combinations of unit columns whose squared length is below this share of the longest one's are rounding errors.
const DEPENDENT: f64 = 1e-12;
/// Partial sums of a scalar product.
const PARTIAL: usize = 8;

fn dot(a: &[f64], b: &[f64]) -> f64 {
    let mut sums = [0.0; PARTIAL];
    let (mut a, mut b) = (a.chunks_exact(PARTIAL), b.chunks_exact(PARTIAL));
    for (a, b) in a.by_ref().zip(b.by_ref()) {
        for c in 0..PARTIAL {
            sums[c] += a[c] * b[c];
        }
    }
    let rest: f64 = a.remainder().iter().zip(b.remainder()).map(|(a, b)| a * b).sum();
    sums.iter().sum::<f64>() + rest
}

/// Makes the columns orthonormal by the eigenvectors of their scalar products, twice (Stathopoulos and Wu 2002); columns
/// that depend on others are dropped.
pub fn orthonormalise(columns: &mut Columns) {
    for _ in 0..2 {
        columns.retain_mut(|column| {
            let length = dot(column, column).sqrt();
            column.iter_mut().for_each(|c| *c /= length);
            length > f64::MIN_POSITIVE
        });
        let (values, mut vectors) = symmetric_eigen(&cross(columns, columns));
        let independent = values.iter().take_while(|&&v| v > DEPENDENT * values[0]).count();
        vectors.truncate(independent);
        for (vector, value) in vectors.iter_mut().zip(&values) {
            vector.iter_mut().for_each(|v| *v /= value.sqrt());
        }
        *columns = multiply(columns, &vectors);
    }
}

/// Aᵀ B.
pub fn cross(a: &Columns, b: &Columns) -> Columns {
    b.par_iter().map(|b| a.iter().map(|a| dot(a, b)).collect()).collect()
}

/// A M.
pub fn multiply(a: &Columns, m: &Columns) -> Columns {
    let rows = a.first().map_or(0, Vec::len);
    m.par_iter()
        .map(|weights| {
            let mut out = vec![0.0; rows];
            for (a, &w) in a.iter().zip(weights) {
                out.iter_mut().zip(a).for_each(|(o, a)| *o += w * a);
            }
            out
        })
        .collect()
}

/// Eigenvalues, descending, and eigenvectors of a symmetric matrix of finite numbers.
pub fn symmetric_eigen(matrix: &Columns) -> (Vec<f64>, Columns) {
    let n = matrix.len();
    let symmetric = DMatrix::from_fn(n, n, |i, j| 0.5 * (matrix[i][j] + matrix[j][i]));
    let found = SymmetricEigen::new(symmetric);
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|&i, &j| found.eigenvalues[j].total_cmp(&found.eigenvalues[i]).then(i.cmp(&j)));
    let vector = |&i: &usize| found.eigenvectors.column(i).iter().copied().collect();
    (order.iter().map(|&i| found.eigenvalues[i]).collect(), order.iter().map(vector).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn eigenvectors_rebuild_the_matrix() {
        let (n, mut rng) = (6, ChaCha8Rng::seed_from_u64(1));
        for case in 0..40 {
            let v: Columns = (0..n).map(|_| (0..n).map(|_| rng.random_range(-2.0..2.0)).collect()).collect();
            let mut m: Columns = (0..n).map(|i| (0..n).map(|j| v[i][j] + v[j][i]).collect()).collect();
            if case % 2 == 1 {
                // Of lower rank.
                let repeated = vec![m[0].clone(), m[0].clone(), m[1].clone()];
                m = cross(&repeated, &repeated);
            }
            let (values, vectors) = symmetric_eigen(&m);
            assert!(values.windows(2).all(|w| w[0] >= w[1]));
            for i in 0..m.len() {
                for j in 0..m.len() {
                    let rebuilt: f64 = (0..m.len()).map(|k| vectors[k][i] * values[k] * vectors[k][j]).sum();
                    assert!((rebuilt - m[i][j]).abs() < 1e-9 * (1.0 + m[i][j].abs()), "case {case}");
                }
            }
        }
    }

    #[test]
    fn dependent_columns_are_dropped() {
        let mut c = vec![vec![1.0, 1.0, 0.0], vec![2.0, 2.0, 0.0], vec![0.0, 0.0, 0.0], vec![1.0, 0.0, 1.0]];
        orthonormalise(&mut c);
        assert_eq!(c.len(), 2);
        let g = cross(&c, &c);
        assert!((g[0][0] - 1.0).abs() < 1e-12 && g[0][1].abs() < 1e-12 && (g[1][1] - 1.0).abs() < 1e-12);
    }
}
