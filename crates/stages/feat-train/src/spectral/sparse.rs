//! A sparse matrix of Gaussians and masks in blocks of rows, and its products.

use multiversion::multiversion;
use rayon::prelude::*;

/// Blocks whose results are held at a time.
const BATCH: usize = 64;

/// Rows of some Gaussians.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Block {
    /// The Gaussian of each row.
    pub gaussians: Vec<u32>,
    /// Masks with entries here, ascending.
    pub masks: Vec<u32>,
    /// Where the entries of each row begin; one more than rows.
    pub start: Vec<usize>,
    /// Mask of each entry, as an index into `masks`, ascending within a row.
    pub mask: Vec<u32>,
    pub value: Vec<f32>,
}

impl Block {
    /// Multiplies rows by `row_scale` of their Gaussians and columns by `column_scale` of their masks.
    pub fn scale(&mut self, row_scale: &[f32], column_scale: &[f32]) {
        for (row, &i) in self.gaussians.iter().enumerate() {
            let range = self.start[row]..self.start[row + 1];
            for (v, &k) in self.value[range.clone()].iter_mut().zip(&self.mask[range]) {
                *v *= row_scale[i as usize] * column_scale[self.masks[k as usize] as usize];
            }
        }
    }

    /// The rows of X `[R][p]` that belong to the block's masks.
    fn gather(&self, x: &[f32], p: usize) -> Vec<f32> {
        self.masks.iter().flat_map(|&k| x[k as usize * p..(k as usize + 1) * p].iter().copied()).collect()
    }

    /// The block times X, `[rows][p]`.
    fn apply(&self, x: &[f32], p: usize) -> Vec<f32> {
        let mut out = vec![0.0; self.gaussians.len() * p];
        rows_times(self, &self.gather(x, p), p, &mut out);
        out
    }

    /// The transposed block times the block times X, `[masks][p]`.
    fn normal(&self, x: &[f32], p: usize) -> Vec<f32> {
        let y = self.apply(x, p);
        let mut out = vec![0.0; self.masks.len() * p];
        transposed_times(self, &y, p, &mut out);
        out
    }
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
fn rows_times(block: &Block, x: &[f32], p: usize, out: &mut [f32]) {
    for (row, out) in out.chunks_exact_mut(p).enumerate() {
        let range = block.start[row]..block.start[row + 1];
        for (&k, &v) in block.mask[range.clone()].iter().zip(&block.value[range]) {
            out.iter_mut().zip(&x[k as usize * p..(k as usize + 1) * p]).for_each(|(o, x)| *o += v * x);
        }
    }
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
fn transposed_times(block: &Block, y: &[f32], p: usize, out: &mut [f32]) {
    for (row, y) in y.chunks_exact(p).enumerate() {
        let range = block.start[row]..block.start[row + 1];
        for (&k, &v) in block.mask[range.clone()].iter().zip(&block.value[range]) {
            out[k as usize * p..(k as usize + 1) * p].iter_mut().zip(y).for_each(|(o, y)| *o += v * y);
        }
    }
}

/// The matrix C of `evidence`.
#[derive(Debug, Clone, PartialEq)]
pub struct Matrix {
    /// Gaussians, n.
    pub gaussians: usize,
    /// Row of the footprints artifact of each mask; R.
    pub masks: Vec<u32>,
    /// All rows; every Gaussian has one.
    pub blocks: Vec<Block>,
    /// D_r^-1/2, 0 for Gaussians without evidence; n.
    pub row_scale: Vec<f32>,
    /// D_c^-1/2; R.
    pub column_scale: Vec<f32>,
}

impl Matrix {
    pub fn entries(&self) -> usize {
        self.blocks.iter().map(|b| b.mask.len()).sum()
    }

    /// C X for X `[R][p]`: `[n][p]`.
    pub fn apply(&self, x: &[f32], p: usize) -> Vec<f32> {
        let mut out = vec![0.0f32; self.gaussians * p];
        for batch in self.blocks.chunks(BATCH) {
            let parts: Vec<Vec<f32>> = batch.par_iter().map(|b| b.apply(x, p)).collect();
            for (block, part) in batch.iter().zip(parts) {
                for (&i, row) in block.gaussians.iter().zip(part.chunks_exact(p)) {
                    out[i as usize * p..(i as usize + 1) * p].copy_from_slice(row);
                }
            }
        }
        out
    }

    /// CᵀC X for X `[R][p]`: `[R][p]`, summed in f64 over blocks.
    pub fn normal(&self, x: &[f32], p: usize) -> Vec<f64> {
        let mut out = vec![0.0f64; self.masks.len() * p];
        for batch in self.blocks.chunks(BATCH) {
            let parts: Vec<Vec<f32>> = batch.par_iter().map(|b| b.normal(x, p)).collect();
            for (block, part) in batch.iter().zip(parts) {
                for (&k, row) in block.masks.iter().zip(part.chunks_exact(p)) {
                    let sums = &mut out[k as usize * p..(k as usize + 1) * p];
                    sums.iter_mut().zip(row).for_each(|(s, v)| *s += f64::from(*v));
                }
            }
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use crate::spectral::linalg::{cross, multiply};
    use crate::spectral::testing::{dense, random};

    #[test]
    fn products_are_those_of_the_dense_matrix_whose_largest_singular_value_is_one() {
        let m = random(5000, 12);
        let c = dense(&m);
        let x: Vec<Vec<f64>> = (0..3).map(|j| (0..12).map(|k| f64::from((k * 7 + j * 5) % 11)).collect()).collect();
        let rows: Vec<f32> = (0..12).flat_map(|k| x.iter().map(move |c| c[k] as f32)).collect();
        let (applied, normal) = (multiply(&c, &x), multiply(&cross(&c, &c), &x));
        for j in 0..3 {
            let (found, squared) = (m.apply(&rows, 3), m.normal(&rows, 3));
            assert!((0..5000).all(|i| (f64::from(found[i * 3 + j]) - applied[j][i]).abs() < 1e-5));
            assert!((0..12).all(|k| (squared[k * 3 + j] - normal[j][k]).abs() < 1e-4));
        }
        // D^1/2 1 is the leading pair of vectors, with singular value 1.
        let right: Vec<f32> = m.column_scale.iter().map(|s| if *s > 0.0 { 1.0 / s } else { 0.0 }).collect();
        for (y, s) in m.apply(&right, 1).iter().zip(&m.row_scale) {
            assert!((y * s - f32::from(u8::from(*s > 0.0))).abs() < 1e-5, "{y} {s}");
        }
    }
}
