//! The matrix of Gaussians and masks: how much each mask says about each Gaussian, spread over neighbours.
//!
//! C = D_r^-1/2 S B D_c^-1/2, with B the evidence (Gaussians x masks), S the average over a Gaussian and its spatial
//! neighbours, and D the sums of rows and columns of S B. It is formed in [`Block`]s of Gaussians that lie together and so
//! know the same few hundred masks: what is summed over a block's masks stays in cache.

use super::sparse::{Block, Blocks, Matrix};
use artifacts::{Entries, Footprints, Graph, Level};
use gs_io::Result;
use ndarray::Array2;
use rayon::prelude::*;
use std::collections::VecDeque;
use std::path::Path;

/// Gaussians of a block.
const BLOCK: usize = 2048;
/// Footprint entries of the Gaussians whose blocks are made at a time: the footprints are read once for every so many.
pub(super) const MOST: usize = 1 << 24;
/// Gaussians whose evidence is collected by one task.
const CHUNK: usize = 4096;

/// Collects the evidence of all masks at `levels`, spread over spatial neighbours: blending weights summed over the mask's
/// pixels, so that a view counts as much as it sees. The matrix lies in a scratch file in the folder of `output`.
pub fn collect(footprints: &Footprints, graph: &Graph, levels: &[Level], output: &Path) -> Result<Matrix> {
    let used = |&r: &u32| footprints.rows[r as usize].is_of(levels) && footprints.entries_of(r as usize) > 0;
    let masks: Vec<u32> = (0..footprints.rows.len() as u32).filter(used).collect();
    matrix(footprints, masks, &graph.gaussian_knn, MOST, output)
}

/// The block of [`collect`]'s matrix that each Gaussian will be in, and the number of blocks.
pub fn blocks(graph: &Graph) -> (Vec<u32>, usize) {
    let n = graph.kept.len();
    let parts = patches(n, &graph.gaussian_knn);
    let mut block = vec![0u32; n];
    for (b, part) in parts.iter().enumerate() {
        part.iter().for_each(|&i| block[i as usize] = b as u32);
    }
    (block, parts.len())
}

/// The masks at `levels`, by their place among these, that each of the [`blocks`] will know, but for those that its
/// neighbourhood adds.
///
/// # Errors
/// When the footprints can't be read.
pub fn masks_of_blocks(
    footprints: &Footprints,
    (block, count): &(Vec<u32>, usize),
    levels: &[Level],
) -> Result<Vec<Vec<u32>>> {
    let mut known: Vec<Vec<u32>> = vec![Vec::new(); *count];
    let rows: Vec<u32> =
        (0..footprints.rows.len() as u32).filter(|&r| footprints.rows[r as usize].is_of(levels)).collect();
    let mut mask = 0;
    footprints.in_batches(&rows, |_, batch| {
        for entries in batch {
            for &i in &entries.gaussians {
                let known = &mut known[block[i as usize] as usize];
                if known.last() != Some(&mask) {
                    known.push(mask);
                }
            }
            mask += 1;
        }
    })?;
    Ok(known)
}

/// Bytes that blocks take while they are made, of so many footprint entries: the average over neighbours gives them two thirds more.
pub fn bytes(entries: u64) -> u64 {
    22 * entries.min(MOST as u64)
}

/// The spatial neighbours of a Gaussian; rows are padded with itself.
fn neighbours(knn: &Array2<u32>, i: usize) -> impl Iterator<Item = usize> + '_ {
    knn.row(i).into_iter().map(|&j| j as usize).filter(move |&j| j != i)
}

/// Evidence of some Gaussians, a row each; masks ascend within a row.
struct Rows {
    /// The Gaussians, ascending.
    gaussians: Vec<u32>,
    start: Vec<usize>,
    mask: Vec<u32>,
    value: Vec<f32>,
}

impl Rows {
    /// Those of `gaussians`, whose numbers of entries `counts` has. `place` has the place of each Gaussian among them, `u32::MAX`
    /// for others.
    fn read(
        footprints: &Footprints,
        masks: &[u32],
        counts: &[u32],
        gaussians: Vec<u32>,
        place: &[u32],
    ) -> Result<Self> {
        let mut start = vec![0usize];
        gaussians.iter().for_each(|&i| start.push(start[start.len() - 1] + counts[i as usize] as usize));
        let count = start[gaussians.len()];
        let (mut mask, mut value) = (vec![0u32; count], vec![0.0f32; count]);
        let mut parts: Vec<Part<'_>> = Vec::new();
        let (mut mask_left, mut value_left) = (&mut mask[..], &mut value[..]);
        for (c, some) in gaussians.chunks(CHUNK).enumerate() {
            let next = start[c * CHUNK..c * CHUNK + some.len()].to_vec();
            let (first, end) = (next[0], start[c * CHUNK + some.len()]);
            let mask;
            let value;
            (mask, mask_left) = mask_left.split_at_mut(end - first);
            (value, value_left) = value_left.split_at_mut(end - first);
            parts.push(Part { within: some[0]..some[some.len() - 1] + 1, chunk: c * CHUNK, first, next, mask, value });
        }
        let mut number = 0;
        footprints.in_batches(masks, |_, batch| {
            parts.par_iter_mut().for_each(|part| part.take(number, batch, place));
            number += batch.len() as u32;
        })?;
        Ok(Self { gaussians, start, mask, value })
    }

    fn row(&self, at: u32) -> (&[u32], &[f32]) {
        let range = self.start[at as usize]..self.start[at as usize + 1];
        (&self.mask[range.clone()], &self.value[range])
    }
}

/// The rows of [`CHUNK`] Gaussians while they fill up.
struct Part<'a> {
    /// From the first to the last of them; others may lie between.
    within: std::ops::Range<u32>,
    /// Place of the first one.
    chunk: usize,
    /// Where the entries begin, and where the next one of each Gaussian goes.
    first: usize,
    next: Vec<usize>,
    mask: &'a mut [u32],
    value: &'a mut [f32],
}

impl Part<'_> {
    /// Takes the entries of the masks from `number` on.
    fn take(&mut self, number: u32, batch: &[Entries], place: &[u32]) {
        for (k, entries) in (number..).zip(batch) {
            for (i, w) in entries.within(self.within.clone()) {
                let at = place[i as usize];
                if at != u32::MAX {
                    let next = &mut self.next[at as usize - self.chunk];
                    self.mask[*next - self.first] = k;
                    self.value[*next - self.first] = w;
                    *next += 1;
                }
            }
        }
    }
}

/// Parts the Gaussians into patches of [`BLOCK`], each grown over the neighbours of its first, which lies at the rim of
/// those before.
fn patches(n: usize, knn: &Array2<u32>) -> Vec<Vec<u32>> {
    let mut out = Vec::with_capacity(n.div_ceil(BLOCK));
    let mut taken = vec![false; n];
    let (mut rim, mut lowest) = (VecDeque::<u32>::new(), 0);
    let mut left = n;
    while left > 0 {
        let size = BLOCK.min(left);
        let mut patch: Vec<u32> = Vec::with_capacity(size);
        let mut at = 0;
        while patch.len() < size {
            if at == patch.len() {
                let seed = loop {
                    match rim.pop_front() {
                        Some(i) if taken[i as usize] => {}
                        Some(i) => break i as usize,
                        None => {
                            lowest += taken[lowest..].iter().take_while(|t| **t).count();
                            break lowest;
                        }
                    }
                };
                taken[seed] = true;
                patch.push(seed as u32);
            } else {
                for j in neighbours(knn, patch[at] as usize) {
                    if patch.len() < size && !taken[j] {
                        taken[j] = true;
                        patch.push(j as u32);
                    }
                }
                at += 1;
            }
        }
        for &i in &patch[at.saturating_sub(1)..] {
            rim.extend(neighbours(knn, i as usize).filter(|&j| !taken[j]).map(|j| j as u32));
        }
        left -= size;
        out.push(patch);
    }
    out
}

/// A block without scales, with its sums over rows, in the order of its Gaussians, and over its masks.
type Sums = (Block, Vec<f64>, Vec<f64>);

/// S B of the Gaussians of a patch. `place` has the place of each Gaussian among the rows; room is needed for where each row is
/// in the block's copy, and for each mask's number within the block, `u32::MAX` outside it.
fn smoothed(
    patch: &[u32],
    rows: &Rows,
    knn: &Array2<u32>,
    place: &[u32],
    (copy, local): &mut (Vec<u32>, Vec<u32>),
) -> Sums {
    // Whose evidence counts: the patch and what surrounds it.
    let around = with_neighbours(patch, knn);
    let mut masks: Vec<u32> = Vec::new();
    for &i in &around {
        for &k in rows.row(place[i as usize]).0 {
            if local[k as usize] == u32::MAX {
                local[k as usize] = 0;
                masks.push(k);
            }
        }
    }
    masks.sort_unstable();
    for (at, &k) in masks.iter().enumerate() {
        local[k as usize] = at as u32;
    }
    // Their rows by the block's numbers.
    let (mut start, mut mask, mut value) = (vec![0], Vec::<u32>::new(), Vec::<f32>::new());
    for (at, &i) in around.iter().enumerate() {
        copy[place[i as usize] as usize] = at as u32;
        let (k, v) = rows.row(place[i as usize]);
        mask.extend(k.iter().map(|&k| local[k as usize]));
        value.extend_from_slice(v);
        start.push(mask.len());
    }
    masks.iter().for_each(|&k| local[k as usize] = u32::MAX);

    let mut block = Block { start: vec![0], ..Block::default() };
    let (mut row_sums, mut column_sums) = (Vec::with_capacity(patch.len()), vec![0.0f64; masks.len()]);
    let mut sum = vec![0.0f32; masks.len()];
    for &i in patch {
        let mut count = 0;
        let mut add = |j: usize| {
            let at = copy[place[j] as usize] as usize;
            let range = start[at]..start[at + 1];
            mask[range.clone()].iter().zip(&value[range]).for_each(|(&k, v)| sum[k as usize] += v);
            count += 1;
        };
        add(i as usize);
        neighbours(knn, i as usize).for_each(add);
        let share = 1.0 / count as f32;
        let mut total = 0.0;
        for (k, s) in sum.iter_mut().enumerate().filter(|(_, s)| **s > 0.0) {
            let v = *s * share;
            *s = 0.0;
            total += f64::from(v);
            column_sums[k] += f64::from(v);
            block.mask.push(k as u32);
            block.value.push(v);
        }
        row_sums.push(total);
        block.start.push(block.mask.len() as u32);
    }
    (block.gaussians, block.masks) = (patch.to_vec(), masks);
    block.mask.shrink_to_fit();
    block.value.shrink_to_fit();
    (block, row_sums, column_sums)
}

/// Gaussians and their neighbours, ascending.
fn with_neighbours(gaussians: &[u32], knn: &Array2<u32>) -> Vec<u32> {
    let mut all = gaussians.to_vec();
    all.extend(gaussians.iter().flat_map(|&i| neighbours(knn, i as usize)).map(|j| j as u32));
    all.sort_unstable();
    all.dedup();
    all
}

/// C from the footprints of `masks`: its blocks in groups of `most` entries or little more, each from a reading of the footprints.
pub(super) fn matrix(
    footprints: &Footprints,
    masks: Vec<u32>,
    knn: &Array2<u32>,
    most: usize,
    output: &Path,
) -> Result<Matrix> {
    let n = footprints.kept.len();
    let mut counts = vec![0u32; n];
    footprints.in_batches(&masks, |_, batch| {
        batch.iter().flat_map(|e| &e.gaussians).for_each(|&i| counts[i as usize] += 1);
    })?;
    let mut blocks = Blocks::beside(output)?;
    let inverse_root = |v: f64| if v > 0.0 { 1.0 / v.sqrt() } else { 0.0 };
    let (mut row_scale, mut column_sums) = (vec![0.0f32; n], vec![0.0f64; masks.len()]);
    let mut place = vec![u32::MAX; n];
    let patches = patches(n, knn);
    let mut left = &patches[..];
    while !left.is_empty() {
        let mut entries = 0;
        let fits = |patch: &&Vec<u32>| {
            entries += patch.iter().map(|&i| counts[i as usize] as usize).sum::<usize>();
            entries <= most
        };
        let (group, later) = left.split_at(left.iter().take_while(fits).count().max(1));
        left = later;
        let around = with_neighbours(&group.concat(), knn);
        around.iter().zip(0..).for_each(|(&i, at)| place[i as usize] = at);
        let rows = Rows::read(footprints, &masks, &counts, around, &place)?;
        let room = || (vec![0; rows.gaussians.len()], vec![u32::MAX; masks.len()]);
        let made: Vec<Sums> = group
            .par_iter()
            .with_min_len(4)
            .map_init(room, |room, patch| smoothed(patch, &rows, knn, &place, room))
            .collect();
        rows.gaussians.iter().for_each(|&i| place[i as usize] = u32::MAX);
        drop(rows);
        for (block, sums, columns) in made {
            block.gaussians.iter().zip(sums).for_each(|(&i, s)| row_scale[i as usize] = inverse_root(s) as f32);
            block.masks.iter().zip(columns).for_each(|(&k, s)| column_sums[k as usize] += s);
            blocks.push(&block)?;
        }
    }
    let column_scale: Vec<f32> = column_sums.into_iter().map(|s| inverse_root(s) as f32).collect();
    Ok(Matrix { gaussians: n, masks, row_scale, column_scale, blocks })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::spectral::testing::{columns, dense, line, random, random_in_groups};

    #[test]
    fn the_matrix_is_evidence_averaged_over_neighbours_and_scaled() {
        // More Gaussians than a block and than a chunk.
        let (n, masks) = (3 * CHUNK + 3000, 9);
        let near = line(n);
        let mut spread = vec![vec![0.0f64; n]; masks];
        for (k, (gaussians, weights)) in columns(n, masks).iter().enumerate() {
            let mut plain = vec![0.0f64; n];
            gaussians.iter().zip(weights).for_each(|(&i, &w)| plain[i as usize] = f64::from(w));
            for i in 0..n {
                let others = near.row(i).into_iter().filter(|&&j| j as usize != i);
                let around: Vec<f64> = others.map(|&j| plain[j as usize]).collect();
                spread[k][i] = (plain[i] + around.iter().sum::<f64>()) / (1 + around.len()) as f64;
            }
        }
        let row_sums: Vec<f64> = (0..n).map(|i| spread.iter().map(|c| c[i]).sum()).collect();
        for (k, column) in dense(&random(n, masks)).iter().enumerate() {
            let column_sum: f64 = spread[k].iter().sum();
            for i in (0..n).step_by(7) {
                let expected = spread[k][i] / (row_sums[i] * column_sum).sqrt().max(1e-300);
                assert!((column[i] - expected).abs() < 1e-6, "{k} {i}: {} {expected}", column[i]);
            }
        }
    }

    #[test]
    fn blocks_in_many_groups_are_the_same() {
        let whole = random(9000, 20);
        for most in [1, 20_000] {
            let parts = random_in_groups(9000, 20, most);
            assert!(parts.row_scale == whole.row_scale && parts.column_scale == whole.column_scale);
            assert!(whole.batches().flatten().all(|b| parts.block(b).unwrap() == whole.block(b).unwrap()));
        }
    }

    #[test]
    fn patches_hold_everyone_once_and_neighbours_together() {
        let n = 3 * BLOCK + 77;
        let parts = patches(n, &line(n));
        assert_eq!(parts.len(), 4);
        let mut all: Vec<u32> = parts.concat();
        all.sort_unstable();
        assert!(all.iter().enumerate().all(|(i, &j)| i as u32 == j));
        // On a line a patch is a stretch.
        for part in &parts {
            let (low, high) = (part.iter().min().unwrap(), part.iter().max().unwrap());
            assert_eq!((high - low) as usize + 1, part.len());
        }
    }
}
