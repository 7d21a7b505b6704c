//! The matrix of Gaussians and masks: how much each mask says about each Gaussian, spread over neighbours.
//!
//! C = D_r^-1/2 S B D_c^-1/2, with B the evidence (Gaussians x masks), S the average over a Gaussian and its spatial
//! neighbours, and D the sums of rows and columns of S B. It is formed in [`Block`]s of Gaussians that lie together and so
//! know the same few hundred masks: what is summed over a block's masks stays in cache.

use super::sparse::{Block, Matrix};
use artifacts::{Footprints, Graph, Level};
use rayon::prelude::*;
use std::collections::VecDeque;

/// Gaussians of a block.
const BLOCK: usize = 2048;
/// Gaussians whose evidence is collected by one task.
const CHUNK: usize = 16384;

/// Collects the evidence of all masks at `levels`, spread over spatial neighbours: blending weights summed over the mask's
/// pixels, so that a view counts as much as it sees.
pub fn collect(footprints: &Footprints, graph: &Graph, levels: &[Level]) -> Matrix {
    let (start, gaussians, weights) = footprints.csr();
    let range = |r: usize| start[r] as usize..start[r + 1] as usize;
    let masks: Vec<u32> = (0..footprints.rows.len() as u32)
        .filter(|&r| footprints.rows[r as usize].is_of(levels))
        .filter(|&r| !range(r as usize).is_empty())
        .collect();
    let columns: Vec<(&[u32], &[f32])> =
        masks.iter().map(|&r| (&gaussians[range(r as usize)], &weights[range(r as usize)])).collect();
    let rows = by_gaussian(graph.kept.len(), &columns);
    matrix(masks, rows, &Neighbours { k: graph.gaussian_k, items: &graph.gaussian_knn })
}

/// The block of [`collect`]'s matrix that each Gaussian will be in, and the number of blocks.
pub fn blocks(graph: &Graph) -> (Vec<u32>, usize) {
    let n = graph.kept.len();
    let parts = patches(n, &Neighbours { k: graph.gaussian_k, items: &graph.gaussian_knn });
    let mut block = vec![0u32; n];
    for (b, part) in parts.iter().enumerate() {
        part.iter().for_each(|&i| block[i as usize] = b as u32);
    }
    (block, parts.len())
}

/// How many masks at `levels` each of the [`blocks`] will know, but for those that its neighbourhood adds.
pub fn masks_of_blocks(footprints: &Footprints, (block, count): &(Vec<u32>, usize), levels: &[Level]) -> Vec<usize> {
    let used = |r: &usize| footprints.rows[*r].is_of(levels);
    // The last mask that a block was seen to know.
    let (mut last, mut known) = (vec![usize::MAX; *count], vec![0; *count]);
    for r in (0..footprints.rows.len()).filter(used) {
        for &i in footprints.entries(r).0 {
            let b = block[i as usize] as usize;
            if last[b] != r {
                (last[b], known[b]) = (r, known[b] + 1);
            }
        }
    }
    known
}

/// Spatial neighbours of every Gaussian, padded with itself.
pub(super) struct Neighbours<'a> {
    pub(super) k: usize,
    pub(super) items: &'a [u32],
}

impl Neighbours<'_> {
    fn of(&self, i: usize) -> impl Iterator<Item = usize> + '_ {
        self.items[i * self.k..(i + 1) * self.k].iter().map(|&j| j as usize).filter(move |&j| j != i)
    }
}

/// Evidence of [`CHUNK`] consecutive Gaussians, a row each; masks ascend within a row.
#[derive(Debug, Default)]
pub(super) struct Rows {
    start: Vec<u32>,
    mask: Vec<u32>,
    value: Vec<f32>,
}

fn row_of(rows: &[Rows], i: usize) -> (&[u32], &[f32]) {
    let (rows, i) = (&rows[i / CHUNK], i % CHUNK);
    let range = rows.start[i] as usize..rows.start[i + 1] as usize;
    (&rows.mask[range.clone()], &rows.value[range])
}

/// The same entries by Gaussian that `columns` has by mask, with Gaussians ascending.
pub(super) fn by_gaussian(n: usize, columns: &[(&[u32], &[f32])]) -> Vec<Rows> {
    let chunk = |c: usize| {
        let (first, last) = ((c * CHUNK) as u32, ((c + 1) * CHUNK).min(n) as u32);
        let ranges: Vec<(usize, usize)> = columns
            .iter()
            .map(|(g, _)| {
                let from = g.partition_point(|&g| g < first);
                (from, from + g[from..].partition_point(|&g| g < last))
            })
            .collect();
        let mut start = vec![0u32; (last - first) as usize + 1];
        for ((g, _), &(from, to)) in columns.iter().zip(&ranges) {
            g[from..to].iter().for_each(|&g| start[(g - first) as usize + 1] += 1);
        }
        (1..start.len()).for_each(|i| start[i] += start[i - 1]);
        let mut next = start.clone();
        let count = start[start.len() - 1] as usize;
        let (mut mask, mut value) = (vec![0u32; count], vec![0.0f32; count]);
        for (k, ((g, w), &(from, to))) in columns.iter().zip(&ranges).enumerate() {
            for (&g, &w) in g[from..to].iter().zip(&w[from..to]) {
                let at = &mut next[(g - first) as usize];
                mask[*at as usize] = k as u32;
                value[*at as usize] = w;
                *at += 1;
            }
        }
        Rows { start, mask, value }
    };
    (0..n.div_ceil(CHUNK)).into_par_iter().map(chunk).collect()
}

/// Parts the Gaussians into patches of [`BLOCK`], each grown over the neighbours of its first, which lies at the rim of
/// those before.
fn patches(n: usize, neighbours: &Neighbours<'_>) -> Vec<Vec<u32>> {
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
                for j in neighbours.of(patch[at] as usize) {
                    if patch.len() < size && !taken[j] {
                        taken[j] = true;
                        patch.push(j as u32);
                    }
                }
                at += 1;
            }
        }
        for &i in &patch[at.saturating_sub(1)..] {
            rim.extend(neighbours.of(i as usize).filter(|&j| !taken[j]).map(|j| j as u32));
        }
        left -= size;
        out.push(patch);
    }
    out
}

/// S B of the Gaussians of a patch, with its sums over rows, in the patch's order, and over the block's masks. Room is needed
/// for where each Gaussian's row is in the block's copy, and for each mask's number within the block, `u32::MAX` outside it.
fn smoothed(
    patch: Vec<u32>,
    rows: &[Rows],
    neighbours: &Neighbours<'_>,
    place: &mut [u32],
    local: &mut [u32],
) -> (Block, Vec<f64>, Vec<f64>) {
    // Whose evidence counts: the patch and what surrounds it.
    let mut around: Vec<u32> = patch.clone();
    around.extend(patch.iter().flat_map(|&i| neighbours.of(i as usize)).map(|j| j as u32));
    around.sort_unstable();
    around.dedup();
    let mut masks: Vec<u32> = Vec::new();
    for &i in &around {
        for &k in row_of(rows, i as usize).0 {
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
        place[i as usize] = at as u32;
        let (k, v) = row_of(rows, i as usize);
        mask.extend(k.iter().map(|&k| local[k as usize]));
        value.extend_from_slice(v);
        start.push(mask.len());
    }
    masks.iter().for_each(|&k| local[k as usize] = u32::MAX);

    let mut block = Block { start: vec![0], ..Block::default() };
    let (mut row_sums, mut column_sums) = (Vec::with_capacity(patch.len()), vec![0.0f64; masks.len()]);
    let mut sum = vec![0.0f32; masks.len()];
    for &i in &patch {
        let mut count = 0;
        let mut add = |j: usize| {
            let range = start[place[j] as usize]..start[place[j] as usize + 1];
            mask[range.clone()].iter().zip(&value[range]).for_each(|(&k, v)| sum[k as usize] += v);
            count += 1;
        };
        add(i as usize);
        neighbours.of(i as usize).for_each(add);
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
        block.start.push(block.mask.len());
    }
    (block.gaussians, block.masks) = (patch, masks);
    block.mask.shrink_to_fit();
    block.value.shrink_to_fit();
    (block, row_sums, column_sums)
}

/// C from the evidence.
pub(super) fn matrix(masks: Vec<u32>, rows: Vec<Rows>, neighbours: &Neighbours<'_>) -> Matrix {
    let n = rows.iter().map(|r| r.start.len() - 1).sum();
    let room = || (vec![0; n], vec![u32::MAX; masks.len()]);
    let made: Vec<(Block, Vec<f64>, Vec<f64>)> = patches(n, neighbours)
        .into_par_iter()
        .with_min_len(16)
        .map_init(room, |(place, local), patch| smoothed(patch, &rows, neighbours, place, local))
        .collect();
    drop(rows);
    let inverse_root = |v: f64| if v > 0.0 { 1.0 / v.sqrt() } else { 0.0 };
    let (mut row_scale, mut column_sums) = (vec![0.0f32; n], vec![0.0f64; masks.len()]);
    for (block, sums, columns) in &made {
        block.gaussians.iter().zip(sums).for_each(|(&i, &s)| row_scale[i as usize] = inverse_root(s) as f32);
        block.masks.iter().zip(columns).for_each(|(&k, s)| column_sums[k as usize] += s);
    }
    let column_scale: Vec<f32> = column_sums.into_iter().map(|s| inverse_root(s) as f32).collect();
    let mut blocks: Vec<Block> = made.into_iter().map(|(block, ..)| block).collect();
    blocks.par_iter_mut().for_each(|b| b.scale(&row_scale, &column_scale));
    Matrix { gaussians: n, masks, blocks, row_scale, column_scale }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::spectral::testing::{columns, dense, line, random};

    #[test]
    fn the_matrix_is_evidence_averaged_over_neighbours_and_scaled() {
        // More Gaussians than a block and than a chunk.
        let (n, masks) = (CHUNK + 3000, 9);
        let near = line(n);
        let mut spread = vec![vec![0.0f64; n]; masks];
        for (k, (gaussians, weights)) in columns(n, masks).iter().enumerate() {
            let mut plain = vec![0.0f64; n];
            gaussians.iter().zip(weights).for_each(|(&i, &w)| plain[i as usize] = f64::from(w));
            for i in 0..n {
                let others = near[i * 3..(i + 1) * 3].iter().filter(|&&j| j as usize != i);
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
    fn patches_hold_everyone_once_and_neighbours_together() {
        let n = 3 * BLOCK + 77;
        let items = line(n);
        let neighbours = Neighbours { k: 3, items: &items };
        let parts = patches(n, &neighbours);
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
