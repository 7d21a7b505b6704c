//! Random evidence.

use super::evidence::{Neighbours, by_gaussian, matrix};
use super::sparse::Matrix;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Evidence of `masks` random masks on `n` Gaussians, by mask.
pub fn columns(n: usize, masks: usize) -> Vec<(Vec<u32>, Vec<f32>)> {
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    (0..masks)
        .map(|_| {
            let g: Vec<u32> = (0..n as u32).filter(|_| rng.random_range(0.0..1.0) < 0.3).collect();
            let w = g.iter().map(|_| rng.random_range(0.1..3.0)).collect();
            (g, w)
        })
        .collect()
}

/// Every Gaussian's neighbours on a line: before, behind, and two behind.
pub fn line(n: usize) -> Vec<u32> {
    let inside = |i: i64, j: i64| if (0..n as i64).contains(&j) { j as u32 } else { i as u32 };
    (0..n as i64).flat_map(|i| [i - 1, i + 1, i + 2].map(|j| inside(i, j))).collect()
}

/// A random matrix of `n` Gaussians and `masks` masks.
pub fn random(n: usize, masks: usize) -> Matrix {
    let columns = columns(n, masks);
    let slices: Vec<(&[u32], &[f32])> = columns.iter().map(|(g, w)| (&g[..], &w[..])).collect();
    let items = line(n);
    matrix((0..masks as u32).collect(), by_gaussian(n, &slices), &Neighbours { k: 3, items: &items })
}

/// The matrix itself, by columns (masks).
pub fn dense(matrix: &Matrix) -> Vec<Vec<f64>> {
    let mut out = vec![vec![0.0; matrix.gaussians]; matrix.masks.len()];
    for block in &matrix.blocks {
        for (row, &i) in block.gaussians.iter().enumerate() {
            for at in block.start[row]..block.start[row + 1] {
                out[block.masks[block.mask[at] as usize] as usize][i as usize] = f64::from(block.value[at]);
            }
        }
    }
    out
}
