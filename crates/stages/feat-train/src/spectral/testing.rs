//! Random evidence.

use super::evidence::{MOST, matrix};
use super::sparse::Matrix;
use artifacts::{Footprints, FootprintsBuilder, Row};
use gs_io::Provenance;
use ndarray::Array2;
use rand::{RngExt, SeedableRng};
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
pub fn line(n: usize) -> Array2<u32> {
    let inside = |i: i64, j: i64| if (0..n as i64).contains(&j) { j as u32 } else { i as u32 };
    (0..n as i64).map(|i| [i - 1, i + 1, i + 2].map(|j| inside(i, j))).collect::<Vec<_>>().into()
}

/// A random matrix of `n` Gaussians and `masks` masks.
pub fn random(n: usize, masks: usize) -> Matrix {
    random_in_groups(n, masks, MOST)
}

/// The same, made from groups of `most` entries.
pub fn random_in_groups(n: usize, masks: usize, most: usize) -> Matrix {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("footprints.safetensors");
    let mut builder = FootprintsBuilder { kept: (0..n as u32).collect(), ..FootprintsBuilder::default() };
    builder.views.push("view".into());
    for (gaussians, weights) in columns(n, masks) {
        builder.push(Row::default(), gaussians.into_iter().zip(weights));
    }
    builder.write(&file, Provenance::default()).unwrap();
    matrix(&Footprints::read(&file).unwrap(), (0..masks as u32).collect(), &line(n), most, &file).unwrap()
}

/// The matrix itself, by columns (masks).
pub fn dense(matrix: &Matrix) -> Vec<Vec<f64>> {
    let mut out = vec![vec![0.0; matrix.gaussians]; matrix.masks.len()];
    for block in matrix.batches().flatten().map(|b| matrix.block(b).unwrap()) {
        for (row, &i) in block.gaussians.iter().enumerate() {
            for at in block.row(row) {
                out[block.masks[block.mask[at] as usize] as usize][i as usize] = f64::from(block.value[at]);
            }
        }
    }
    out
}
