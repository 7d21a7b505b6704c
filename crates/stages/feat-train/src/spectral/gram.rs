//! CᵀC, masks by masks: which masks share Gaussians, and how much.
//!
//! The smaller the masks, the sparser it is: for a million Gaussians and 300 views it has a twelfth of the entries that a product
//! with C and its transpose needs.
//! A block of Gaussians knows a few hundred masks; products of its rows are summed in a dense square that stays in
//! cache, and the squares of all blocks are then added up mask by mask, in the order of blocks.

use super::sparse::{BATCH, Block, Matrix};
use gs_io::Result;
use multiversion::multiversion;
use rayon::prelude::*;

/// Columns of a panel.
pub const WIDTH: usize = 32;
/// Some columns of a matrix with a row per mask, row after row.
pub type Panel = Vec<[f32; WIDTH]>;
/// CᵀC is formed where that takes at most this many entries for each entry of C, plus this many; else C is applied twice.
pub const GRAM_ENTRIES: (usize, usize) = (4, 1 << 24);
/// Entries of a square that are summed at a time.
const SQUARE: usize = 1 << 23;
/// Masks whose pairs are counted for the forecast, about.
const SAMPLED: usize = 256;
/// Terms of a row's product before they go to the outer sum.
const TERMS: usize = 128;

/// Bytes that forming CᵀC takes, from the masks that each block knows (`masks_of_blocks`), of `masks` in all, and the entries that
/// they have. Fitted to 15 runs.
pub fn bytes(known: &[Vec<u32>], masks: usize, entries: u64) -> u64 {
    let all: u64 = known.iter().map(|k| (k.len() * k.len()) as u64).sum();
    // Of a block's pairs of masks three in ten share a Gaussian, counted once. Above a number the sums end before they are a matrix.
    let (found, most) = (3 * all / 10, GRAM_ENTRIES.0 as u64 * entries + GRAM_ENTRIES.1 as u64);
    let sums = if found > most { 14 * most } else { 36 * found.min(pairs(known, masks)) };
    sums + (14 * entries + 3 * all).min(BATCH.1 as u64)
}

/// Pairs of masks that some block knows, about: from what a few masks meet.
fn pairs(known: &[Vec<u32>], masks: usize) -> u64 {
    let every = masks.div_ceil(SAMPLED).max(1);
    let met = |mask: usize| {
        let mut met = vec![false; masks];
        for block in known.iter().filter(|k| k.binary_search(&(mask as u32)).is_ok()) {
            block.iter().for_each(|&k| met[k as usize] = true);
        }
        met.iter().filter(|m| **m).count() as u64
    };
    let sum: u64 = (0..masks).into_par_iter().step_by(every).map(met).sum();
    sum * every as u64 / 2
}

/// CᵀC by rows.
#[derive(Debug, Clone, PartialEq)]
pub struct Gram {
    start: Vec<usize>,
    mask: Vec<u32>,
    value: Vec<f32>,
}

/// Entries on and above the diagonal, by rows.
#[derive(Debug, Default)]
struct Upper {
    start: Vec<usize>,
    other: Vec<u32>,
    value: Vec<f32>,
}

impl Upper {
    /// From a block, by its own numbers of masks.
    fn of(block: &Block) -> Self {
        let m = block.masks.len();
        let mut out = Self { start: vec![0], ..Self::default() };
        let band = (SQUARE / m.max(1)).clamp(1, m.max(1));
        let mut square = vec![0.0f32; band * m];
        for first in (0..m).step_by(band) {
            let last = (first + band).min(m);
            // New memory is zero already, and half of it is then never touched.
            if first > 0 {
                square.fill(0.0);
            }
            add_products(block, first as u32..last as u32, &mut square);
            let upper = |a: usize| {
                square[(a - first) * m + a..(a - first + 1) * m].iter().enumerate().filter(|(_, v)| **v != 0.0)
            };
            // No more room than they need: the products of all blocks are most of the memory.
            let count = (first..last).map(|a| upper(a).count()).sum();
            out.other.reserve_exact(count);
            out.value.reserve_exact(count);
            for a in first..last {
                for (b, &v) in upper(a) {
                    out.other.push((a + b) as u32);
                    out.value.push(v);
                }
                out.start.push(out.other.len());
            }
        }
        out
    }
}

/// Adds the products of each row's entries in `band` with themselves and the entries after them.
fn add_products(block: &Block, band: std::ops::Range<u32>, square: &mut [f32]) {
    let m = block.masks.len();
    for row in 0..block.gaussians.len() {
        let (masks, values) = (&block.mask[block.row(row)], &block.value[block.row(row)]);
        let from = masks.partition_point(|&k| k < band.start);
        let to = masks.partition_point(|&k| k < band.end);
        for a in from..to {
            let v = values[a];
            let at = (masks[a] - band.start) as usize * m;
            let sums = &mut square[at..at + m];
            for (&k, &w) in masks[a..].iter().zip(&values[a..]) {
                sums[k as usize] += v * w;
            }
        }
    }
}

/// A row of CᵀC from its diagonal on, as a sum over blocks.
#[derive(Debug, Default)]
struct Sums {
    /// The masks, ascending.
    other: Vec<u32>,
    value: Vec<f64>,
}

impl Sums {
    /// Adds terms, in their order. There is room for a zero for each mask, and for the masks of the row.
    fn add(&mut self, terms: impl Iterator<Item = (u32, f32)>, (sums, masks): &mut (Vec<f64>, Vec<u32>)) {
        masks.clear();
        masks.extend(&self.other);
        self.other.iter().zip(&self.value).for_each(|(&k, &v)| sums[k as usize] = v);
        for (k, v) in terms {
            if sums[k as usize] == 0.0 {
                masks.push(k);
            }
            sums[k as usize] += f64::from(v);
        }
        masks.sort_unstable();
        // No more room than they need: the rows are most of the memory.
        self.other = masks.clone();
        self.value = masks.iter().map(|&k| std::mem::take(&mut sums[k as usize])).collect();
    }
}

impl Gram {
    /// The product, or nothing where forming it takes more than `most` entries.
    pub fn new(matrix: &Matrix, most: usize) -> Result<Option<Self>> {
        let r = matrix.masks.len();
        let mut sums: Vec<Sums> = (0..r).map(|_| Sums::default()).collect();
        let mut entries = 0;
        for batch in matrix.batches() {
            let uppers = matrix.of_batch(batch, |b| (Upper::of(&b), b.masks))?;
            entries += uppers.iter().map(|(u, _)| u.other.len()).sum::<usize>();
            if entries > most {
                return Ok(None);
            }
            // Which blocks know a mask, and under which number.
            let mut known: Vec<Vec<(u32, u32)>> = vec![Vec::new(); r];
            for (b, (_, masks)) in uppers.iter().enumerate() {
                masks.iter().enumerate().for_each(|(at, &k)| known[k as usize].push((b as u32, at as u32)));
            }
            let add_up = |room: &mut (Vec<f64>, Vec<u32>), (sums, known): (&mut Sums, &Vec<(u32, u32)>)| {
                let of = |&(b, at): &(u32, u32)| {
                    let (upper, masks) = &uppers[b as usize];
                    let range = upper.start[at as usize]..upper.start[at as usize + 1];
                    let others = upper.other[range.clone()].iter().map(|&other| masks[other as usize]);
                    others.zip(upper.value[range].iter().copied())
                };
                sums.add(known.iter().flat_map(of), room);
            };
            sums.par_iter_mut().zip(&known).with_min_len(256).for_each_init(|| (vec![0.0; r], Vec::new()), add_up);
        }
        Ok(Some(Self::from_upper(sums)))
    }

    /// The whole matrix from its entries on and above the diagonal.
    fn from_upper(rows: Vec<Sums>) -> Self {
        let mut start = vec![0usize; rows.len() + 1];
        for (a, row) in rows.iter().enumerate() {
            for &b in &row.other {
                start[a + 1] += 1;
                start[b as usize + 1] += usize::from(b as usize != a);
            }
        }
        (1..start.len()).for_each(|i| start[i] += start[i - 1]);
        let mut next = start.clone();
        let (mut mask, mut value) = (vec![0; start[rows.len()]], vec![0.0; start[rows.len()]]);
        let mut put = |row: usize, other: u32, v: f32| {
            mask[next[row]] = other;
            value[next[row]] = v;
            next[row] += 1;
        };
        for (a, row) in rows.into_iter().enumerate() {
            for (&b, &v) in row.other.iter().zip(&row.value) {
                let v = v as f32;
                put(a, b, v);
                if b as usize != a {
                    put(b as usize, a as u32, v);
                }
            }
        }
        Self { start, mask, value }
    }

    pub fn entries(&self) -> usize {
        self.mask.len()
    }

    /// CᵀC X.
    pub fn apply(&self, x: &Panel) -> Panel {
        let row = |r: usize| {
            let range = self.start[r]..self.start[r + 1];
            row_times(&self.mask[range.clone()], &self.value[range], x)
        };
        (0..x.len()).into_par_iter().with_min_len(64).map(row).collect()
    }
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
fn row_times(masks: &[u32], values: &[f32], x: &[[f32; WIDTH]]) -> [f32; WIDTH] {
    let mut out = [0.0f32; WIDTH];
    for (masks, values) in masks.chunks(TERMS).zip(values.chunks(TERMS)) {
        let mut sum = [0.0f32; WIDTH];
        for (&k, &v) in masks.iter().zip(values) {
            let x = &x[k as usize];
            for c in 0..WIDTH {
                sum[c] += v * x[c];
            }
        }
        for c in 0..WIDTH {
            out[c] += sum[c];
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::spectral::linalg::cross;
    use crate::spectral::testing::{dense, random};

    #[test]
    fn is_the_product_and_refuses_to_grow() {
        let m = random(5000, 40);
        let c = dense(&m);
        let product = cross(&c, &c);
        let gram = Gram::new(&m, usize::MAX).unwrap().unwrap();
        assert_eq!(gram.entries(), 1600);
        for first in [0usize, 20] {
            // Columns of the identity give columns of the matrix.
            let unit: Panel =
                (0..40).map(|k| std::array::from_fn(|c| f32::from(u8::from(k == first + c && c < 20)))).collect();
            for (a, row) in gram.apply(&unit).iter().enumerate() {
                for b in 0..20 {
                    let expected = product[first + b][a];
                    assert!((f64::from(row[b]) - expected).abs() < 1e-6, "{a} {b}: {} {expected}", row[b]);
                }
            }
        }
        assert!(Gram::new(&m, 100).unwrap().is_none());
    }

    #[test]
    fn squares_in_bands_are_the_same() {
        let m = random(300, 30);
        let block = &m.block(0).unwrap();
        let k = block.masks.len();
        let mut whole = vec![0.0; k * k];
        add_products(block, 0..k as u32, &mut whole);
        for first in (0..k).step_by(7) {
            let last = (first + 7).min(k);
            let mut band = vec![0.0; (last - first) * k];
            add_products(block, first as u32..last as u32, &mut band);
            assert_eq!(band, whole[first * k..last * k]);
        }
    }
}
