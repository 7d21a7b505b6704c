//! A sparse matrix of Gaussians and masks in blocks of rows, which lie in a scratch file, and its products.

use artifacts::Scratch;
use gs_io::Result;
use multiversion::multiversion;
use rayon::prelude::*;
use std::ops::Range;
use std::path::Path;

/// Blocks that are held at a time: at most so many, and of at most so many bytes, their products with themselves included.
pub const BATCH: (usize, usize) = (64, 1 << 27);

/// Rows of some Gaussians.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Block {
    /// The Gaussian of each row.
    pub gaussians: Vec<u32>,
    /// Masks with entries here, ascending.
    pub masks: Vec<u32>,
    /// Where the entries of each row begin; one more than rows.
    pub start: Vec<u32>,
    /// Mask of each entry, as an index into `masks`, ascending within a row.
    pub mask: Vec<u32>,
    pub value: Vec<f32>,
}

impl Block {
    /// Where the entries of a row lie.
    pub fn row(&self, row: usize) -> Range<usize> {
        self.start[row] as usize..self.start[row + 1] as usize
    }

    /// Multiplies rows by `row_scale` of their Gaussians and columns by `column_scale` of their masks.
    pub fn scale(&mut self, row_scale: &[f32], column_scale: &[f32]) {
        for (row, &i) in self.gaussians.iter().enumerate() {
            let range = self.row(row);
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
        let range = block.row(row);
        for (&k, &v) in block.mask[range.clone()].iter().zip(&block.value[range]) {
            out.iter_mut().zip(&x[k as usize * p..(k as usize + 1) * p]).for_each(|(o, x)| *o += v * x);
        }
    }
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
fn transposed_times(block: &Block, y: &[f32], p: usize, out: &mut [f32]) {
    for (row, y) in y.chunks_exact(p).enumerate() {
        let range = block.row(row);
        for (&k, &v) in block.mask[range.clone()].iter().zip(&block.value[range]) {
            out[k as usize * p..(k as usize + 1) * p].iter_mut().zip(y).for_each(|(o, y)| *o += v * y);
        }
    }
}

/// The matrix C of `evidence`.
#[derive(Debug)]
pub struct Matrix {
    /// Gaussians, n.
    pub gaussians: usize,
    /// Row of the footprints artifact of each mask; R.
    pub masks: Vec<u32>,
    /// D_r^-1/2, 0 for Gaussians without evidence; n.
    pub row_scale: Vec<f32>,
    /// D_c^-1/2; R.
    pub column_scale: Vec<f32>,
    /// All rows, without these scales; every Gaussian has one.
    pub blocks: Blocks,
}

/// Blocks in a scratch file.
#[derive(Debug)]
pub struct Blocks {
    file: Scratch,
    places: Vec<Place>,
}

/// Where a block lies, and how many of what it has.
#[derive(Debug, Clone, Copy)]
struct Place {
    at: u64,
    gaussians: usize,
    masks: usize,
    entries: usize,
}

impl Blocks {
    /// None yet, in a file in the folder of `output`.
    pub fn beside(output: &Path) -> Result<Self> {
        Ok(Self { file: Scratch::beside(output)?, places: Vec::new() })
    }

    pub fn push(&mut self, block: &Block) -> Result<()> {
        let at = self.file.push(&block.gaussians)?;
        for more in [&block.masks, &block.start, &block.mask] {
            self.file.push(more)?;
        }
        self.file.push(&block.value)?;
        let (gaussians, masks, entries) = (block.gaussians.len(), block.masks.len(), block.mask.len());
        self.places.push(Place { at, gaussians, masks, entries });
        Ok(())
    }

    fn read(&self, b: usize) -> Result<Block> {
        let p = self.places[b];
        let words: Vec<u32> = self.file.read(p.at, 2 * p.gaussians + 1 + p.masks + 2 * p.entries)?;
        let (gaussians, rest) = words.split_at(p.gaussians);
        let (masks, rest) = rest.split_at(p.masks);
        let (start, rest) = rest.split_at(p.gaussians + 1);
        let (mask, value) = rest.split_at(p.entries);
        let [gaussians, masks, start, mask] = [gaussians, masks, start, mask].map(<[u32]>::to_vec);
        Ok(Block { gaussians, masks, start, mask, value: value.iter().map(|&v| f32::from_bits(v)).collect() })
    }
}

impl Matrix {
    pub fn entries(&self) -> usize {
        self.blocks.places.iter().map(|p| p.entries).sum()
    }

    /// The blocks in their order, in batches that fit into memory.
    pub fn batches(&self) -> impl Iterator<Item = Range<usize>> + '_ {
        let places = &self.blocks.places;
        let mut from = 0;
        std::iter::from_fn(move || {
            let mut bytes = 0;
            let more = places[from..].iter().take(BATCH.0).take_while(|p| {
                bytes += 8 * p.entries + 3 * p.masks * p.masks;
                bytes <= BATCH.1
            });
            let batch = from..(from + more.count().max(1)).min(places.len());
            from = batch.end;
            (!batch.is_empty()).then_some(batch)
        })
    }

    /// A block of C.
    pub fn block(&self, b: usize) -> Result<Block> {
        let mut block = self.blocks.read(b)?;
        block.scale(&self.row_scale, &self.column_scale);
        Ok(block)
    }

    /// What `of` makes of each block of a batch.
    pub fn of_batch<T: Send>(&self, batch: Range<usize>, of: impl Fn(Block) -> T + Sync) -> Result<Vec<T>> {
        batch.into_par_iter().map(|b| Ok(of(self.block(b)?))).collect()
    }

    /// C X for X `[R][p]`: `[n][p]`.
    pub fn apply(&self, x: &[f32], p: usize) -> Result<Vec<f32>> {
        let mut out = vec![0.0f32; self.gaussians * p];
        for batch in self.batches() {
            for (part, gaussians) in self.of_batch(batch, |b| (b.apply(x, p), b.gaussians))? {
                for (&i, row) in gaussians.iter().zip(part.chunks_exact(p)) {
                    out[i as usize * p..(i as usize + 1) * p].copy_from_slice(row);
                }
            }
        }
        Ok(out)
    }

    /// CᵀC X for X `[R][p]`: `[R][p]`, summed in f64 over blocks.
    pub fn normal(&self, x: &[f32], p: usize) -> Result<Vec<f64>> {
        let mut out = vec![0.0f64; self.masks.len() * p];
        for batch in self.batches() {
            for (part, masks) in self.of_batch(batch, |b| (b.normal(x, p), b.masks))? {
                for (&k, row) in masks.iter().zip(part.chunks_exact(p)) {
                    let sums = &mut out[k as usize * p..(k as usize + 1) * p];
                    sums.iter_mut().zip(row).for_each(|(s, v)| *s += f64::from(*v));
                }
            }
        }
        Ok(out)
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
            let (found, squared) = (m.apply(&rows, 3).unwrap(), m.normal(&rows, 3).unwrap());
            assert!((0..5000).all(|i| (f64::from(found[i * 3 + j]) - applied[j][i]).abs() < 1e-5));
            assert!((0..12).all(|k| (squared[k * 3 + j] - normal[j][k]).abs() < 1e-4));
        }
        // D^1/2 1 is the leading pair of vectors, with singular value 1.
        let right: Vec<f32> = m.column_scale.iter().map(|s| if *s > 0.0 { 1.0 / s } else { 0.0 }).collect();
        for (y, s) in m.apply(&right, 1).unwrap().iter().zip(&m.row_scale) {
            assert!((y * s - f32::from(u8::from(*s > 0.0))).abs() < 1e-5, "{y} {s}");
        }
    }
}
