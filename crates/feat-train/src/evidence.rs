//! The matrix of Gaussians and masks: how much each mask says about each Gaussian, spread over neighbours.
//!
//! C = D_r^-1/2 S B D_c^-1/2, with B the evidence (Gaussians x masks), S the average over a Gaussian and its spatial
//! neighbours, and D the sums of rows and columns of S B. It is never formed: only its products with a few vectors are.

use artifacts::{Footprints, Graph, Level};
use rayon::prelude::*;

/// Gaussians worked on at a time.
const BLOCK: usize = 2048;

/// What an entry of the evidence is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Evidence {
    /// Blending weight summed over the mask's pixels: a view counts as much as it sees.
    Weight,
    /// Square root of that.
    Root,
    /// Share of the Gaussian's weight in the view that falls into the mask: all views count the same.
    Share,
}

/// The matrix C.
pub struct Matrix {
    /// Gaussians, n.
    pub gaussians: usize,
    /// Row of the footprints artifact of each mask; R.
    pub masks: Vec<u32>,
    /// Evidence by mask: where its entries begin, Gaussians (ascending), values.
    start: Vec<usize>,
    gaussian: Vec<u32>,
    value: Vec<f32>,
    /// Neighbours of each Gaussian, without padding; empty lists without smoothing.
    neighbour_start: Vec<u32>,
    neighbours: Vec<u32>,
    /// The same, the other way round.
    reverse_start: Vec<u32>,
    reverse: Vec<u32>,
    /// D_r^-1/2, 0 for Gaussians without evidence; n.
    row_scale: Vec<f32>,
    /// D_c^-1/2; R.
    column_scale: Vec<f32>,
}

impl Matrix {
    /// Collects the evidence of all masks at `levels`; with `smooth`, spread over spatial neighbours.
    pub fn new(footprints: &Footprints, graph: &Graph, levels: &[Level], evidence: Evidence, smooth: bool) -> Self {
        let n = graph.kept.len();
        let chosen: Vec<u32> = (0..footprints.rows.len() as u32)
            .filter(|&r| levels.iter().any(|&l| l as u32 == footprints.rows[r as usize].level))
            .filter(|&r| !footprints.entries(r as usize).0.is_empty())
            .collect();
        let entries = chosen.iter().map(|&r| {
            let (gaussians, weights) = footprints.entries(r as usize);
            (gaussians.to_vec(), weights.to_vec())
        });
        let mut rows: Vec<(Vec<u32>, Vec<f32>)> = entries.collect();
        let view_of = |i: usize| {
            let row = footprints.rows[chosen[i] as usize];
            (row.view, row.level)
        };
        match evidence {
            Evidence::Weight => {}
            Evidence::Root => rows.iter_mut().flat_map(|r| &mut r.1).for_each(|w| *w = w.sqrt()),
            Evidence::Share => shares(&mut rows, n, view_of),
        }
        let (neighbour_start, neighbours) = if smooth { neighbour_lists(graph) } else { (vec![0; n + 1], Vec::new()) };
        Self::from_parts(n, chosen, &rows, neighbour_start, neighbours)
    }

    fn from_parts(
        n: usize,
        masks: Vec<u32>,
        rows: &[(Vec<u32>, Vec<f32>)],
        neighbour_start: Vec<u32>,
        neighbours: Vec<u32>,
    ) -> Self {
        let mut start = vec![0];
        for row in rows {
            start.push(start[start.len() - 1] + row.0.len());
        }
        let (reverse_start, reverse) = transpose(&neighbour_start, &neighbours);
        let mut matrix = Self {
            gaussians: n,
            gaussian: rows.iter().flat_map(|r| r.0.iter().copied()).collect(),
            value: rows.iter().flat_map(|r| r.1.iter().copied()).collect(),
            start,
            neighbour_start,
            neighbours,
            reverse_start,
            reverse,
            row_scale: vec![1.0; n],
            column_scale: vec![1.0; masks.len()],
            masks,
        };
        // With the scales still 1, products with ones are the sums of rows and columns.
        let inverse_root = |v: f32| if v > 0.0 { 1.0 / v.sqrt() } else { 0.0 };
        let rows: Vec<f32> = matrix.apply(&vec![1.0; matrix.masks.len()], 1).into_iter().map(inverse_root).collect();
        let columns = matrix.apply_transposed(vec![1.0; n], 1);
        matrix.column_scale = columns.into_iter().map(|v| inverse_root(v as f32)).collect();
        matrix.row_scale = rows;
        matrix
    }

    /// C X for X `[R][p]`: `[n][p]`.
    pub fn apply(&self, x: &[f32], p: usize) -> Vec<f32> {
        let scaled: Vec<f32> =
            x.chunks_exact(p).zip(&self.column_scale).flat_map(|(row, s)| row.iter().map(move |v| v * s)).collect();
        let mut plain = vec![0.0f32; self.gaussians * p];
        plain.par_chunks_mut(BLOCK * p).enumerate().for_each(|(block, out)| {
            let first = (block * BLOCK) as u32;
            let last = first + (out.len() / p) as u32;
            for r in 0..self.masks.len() {
                let mine = &self.gaussian[self.start[r]..self.start[r + 1]];
                let from = mine.partition_point(|&g| g < first);
                let to = from + mine[from..].partition_point(|&g| g < last);
                let values = &self.value[self.start[r] + from..self.start[r] + to];
                let x = &scaled[r * p..(r + 1) * p];
                for (&g, &v) in mine[from..to].iter().zip(values) {
                    let at = (g - first) as usize * p;
                    out[at..at + p].iter_mut().zip(x).for_each(|(o, x)| *o += v * x);
                }
            }
        });
        let mut out = if self.neighbours.is_empty() { plain } else { self.smoothed(&plain, p) };
        out.par_chunks_mut(p).zip(&self.row_scale).with_min_len(BLOCK).for_each(|(row, s)| {
            row.iter_mut().for_each(|v| *v *= s);
        });
        out
    }

    /// S Y.
    fn smoothed(&self, y: &[f32], p: usize) -> Vec<f32> {
        let mut out = vec![0.0f32; y.len()];
        out.par_chunks_mut(p).enumerate().with_min_len(BLOCK).for_each(|(i, row)| {
            row.copy_from_slice(&y[i * p..(i + 1) * p]);
            let mine = list(&self.neighbour_start, &self.neighbours, i);
            for &j in mine {
                let other = &y[j as usize * p..(j as usize + 1) * p];
                row.iter_mut().zip(other).for_each(|(r, o)| *r += o);
            }
            let share = 1.0 / (1 + mine.len()) as f32;
            row.iter_mut().for_each(|r| *r *= share);
        });
        out
    }

    /// Sᵀ Y.
    fn smoothed_transposed(&self, y: &[f32], p: usize) -> Vec<f32> {
        let share = |i: usize| 1.0 / (1 + list(&self.neighbour_start, &self.neighbours, i).len()) as f32;
        let mut out = vec![0.0f32; y.len()];
        out.par_chunks_mut(p).enumerate().with_min_len(BLOCK).for_each(|(i, row)| {
            let mut add = |j: usize| {
                let s = share(j);
                row.iter_mut().zip(&y[j * p..(j + 1) * p]).for_each(|(r, o)| *r += s * o);
            };
            add(i);
            list(&self.reverse_start, &self.reverse, i).iter().for_each(|&j| add(j as usize));
        });
        out
    }

    /// Cᵀ Y for Y `[n][p]`: `[R][p]`, summed in f64.
    pub fn apply_transposed(&self, mut y: Vec<f32>, p: usize) -> Vec<f64> {
        y.par_chunks_mut(p).zip(&self.row_scale).with_min_len(BLOCK).for_each(|(row, s)| {
            row.iter_mut().for_each(|v| *v *= s);
        });
        let y = if self.neighbours.is_empty() { y } else { self.smoothed_transposed(&y, p) };
        let mut out = vec![0.0f64; self.masks.len() * p];
        out.par_chunks_mut(p).enumerate().for_each(|(r, sums)| {
            let range = self.start[r]..self.start[r + 1];
            for (&g, &v) in self.gaussian[range.clone()].iter().zip(&self.value[range]) {
                let row = &y[g as usize * p..(g as usize + 1) * p];
                sums.iter_mut().zip(row).for_each(|(s, y)| *s += f64::from(v * y));
            }
            let scale = f64::from(self.column_scale[r]);
            sums.iter_mut().for_each(|s| *s *= scale);
        });
        out
    }
}

fn list<'a>(start: &[u32], items: &'a [u32], i: usize) -> &'a [u32] {
    &items[start[i] as usize..start[i + 1] as usize]
}

/// Divides the entries of each view and level by the Gaussian's sum over them.
fn shares(rows: &mut [(Vec<u32>, Vec<f32>)], n: usize, view_of: impl Fn(usize) -> (u32, u32)) {
    let mut sums = vec![0.0f32; n];
    let mut from = 0;
    while from < rows.len() {
        let to = from + (from..rows.len()).take_while(|&r| view_of(r) == view_of(from)).count();
        let view = &mut rows[from..to];
        view.iter().for_each(|(g, w)| g.iter().zip(w).for_each(|(&g, w)| sums[g as usize] += w));
        for (g, w) in view.iter_mut() {
            g.iter().zip(w).for_each(|(&g, w)| *w /= sums[g as usize].max(f32::MIN_POSITIVE));
        }
        view.iter().for_each(|(g, _)| g.iter().for_each(|&g| sums[g as usize] = 0.0));
        from = to;
    }
}

/// Spatial neighbours without the padding.
fn neighbour_lists(graph: &Graph) -> (Vec<u32>, Vec<u32>) {
    let (mut start, mut items) = (vec![0u32], Vec::with_capacity(graph.gaussian_knn.len()));
    for i in 0..graph.kept.len() {
        let row = &graph.gaussian_knn[i * graph.gaussian_k..(i + 1) * graph.gaussian_k];
        items.extend(row.iter().copied().filter(|&j| j as usize != i));
        start.push(items.len() as u32);
    }
    (start, items)
}

fn transpose(start: &[u32], items: &[u32]) -> (Vec<u32>, Vec<u32>) {
    let n = start.len() - 1;
    let mut out_start = vec![0u32; n + 1];
    items.iter().for_each(|&t| out_start[t as usize + 1] += 1);
    (0..n).for_each(|i| out_start[i + 1] += out_start[i]);
    let mut next = out_start.clone();
    let mut out = vec![0u32; items.len()];
    for i in 0..n {
        for &t in list(start, items, i) {
            out[next[t as usize] as usize] = i as u32;
            next[t as usize] += 1;
        }
    }
    (out_start, out)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::testing::graph;
    use rand::{Rng, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// A random matrix of `n` Gaussians and `masks` masks, smoothed or not.
    pub fn random(n: usize, masks: usize, smooth: bool) -> Matrix {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let rows: Vec<(Vec<u32>, Vec<f32>)> = (0..masks)
            .map(|_| {
                let g: Vec<u32> = (0..n as u32).filter(|_| rng.random_range(0.0..1.0) < 0.3).collect();
                let w = g.iter().map(|_| rng.random_range(0.1..3.0)).collect();
                (g, w)
            })
            .collect();
        let (start, items) = if smooth { neighbour_lists(&graph(n, 3)) } else { (vec![0; n + 1], Vec::new()) };
        Matrix::from_parts(n, (0..masks as u32).collect(), &rows, start, items)
    }

    /// The matrix itself, by columns (masks).
    pub fn dense(matrix: &Matrix) -> Vec<Vec<f64>> {
        (0..matrix.masks.len())
            .map(|r| {
                let mut unit = vec![0.0; matrix.masks.len()];
                unit[r] = 1.0;
                matrix.apply(&unit, 1).into_iter().map(f64::from).collect()
            })
            .collect()
    }

    #[test]
    fn both_products_are_of_one_matrix_whose_largest_singular_value_is_one() {
        for smooth in [false, true] {
            let m = random(83, 12, smooth);
            let c = dense(&m);
            for i in (0..83).step_by(5) {
                let mut unit = vec![0.0; 83];
                unit[i] = 1.0;
                let row = m.apply_transposed(unit, 1);
                for r in 0..12 {
                    assert!((row[r] - c[r][i]).abs() < 1e-6, "{smooth} {i} {r}: {} {}", row[r], c[r][i]);
                }
            }
            // D^1/2 1 is the leading pair of vectors, with singular value 1.
            let right: Vec<f32> = m.column_scale.iter().map(|s| if *s > 0.0 { 1.0 / s } else { 0.0 }).collect();
            for (y, s) in m.apply(&right, 1).iter().zip(&m.row_scale) {
                assert!((y * s - f32::from(u8::from(*s > 0.0))).abs() < 1e-5, "{y} {s}");
            }
        }
    }

    #[test]
    fn shares_sum_to_one_per_view() {
        let mut rows = vec![(vec![0, 1], vec![1.0, 2.0]), (vec![1], vec![6.0]), (vec![0, 1], vec![5.0, 5.0])];
        shares(&mut rows, 2, |r| (u32::from(r == 2), 3));
        assert_eq!(rows, [(vec![0, 1], vec![1.0, 0.25]), (vec![1], vec![0.75]), (vec![0, 1], vec![1.0, 1.0])]);
    }
}
