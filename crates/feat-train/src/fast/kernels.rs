//! The inner loops, compiled for the processor at hand. Products and sums are never fused or reordered, so that every
//! processor gives the same bits.
//!
//! `D` is the number of channels of a feature where it is known at compile time, or 0: the same loop, its length read
//! from the argument `d`. `O` is a row's width, a multiple of [`LANES`].

use crate::adam::Rates;
use multiversion::multiversion;

/// Rows that are computed with are padded to multiples of this.
pub const LANES: usize = 8;
/// Anchors that share a pass over the weights.
const BLOCK: usize = 4;
/// Rows whose sums are kept apart: together they fill vectors whatever the number of channels.
const APART: usize = 16;
/// Sums go from f32 to f64 after so many terms.
const TERMS: usize = 32;

/// Calls a kernel with the number of channels as a constant where there is a version for it, else what is said.
macro_rules! for_width {
    ($d:expr, $kernel:ident ( $($argument:expr),* $(,)? ), else $other:expr) => {
        match $d {
            2 => $kernel::<2>($($argument),*),
            3 => $kernel::<3>($($argument),*),
            4 => $kernel::<4>($($argument),*),
            5 => $kernel::<5>($($argument),*),
            6 => $kernel::<6>($($argument),*),
            7 => $kernel::<7>($($argument),*),
            8 => $kernel::<8>($($argument),*),
            9 => $kernel::<9>($($argument),*),
            10 => $kernel::<10>($($argument),*),
            11 => $kernel::<11>($($argument),*),
            12 => $kernel::<12>($($argument),*),
            13 => $kernel::<13>($($argument),*),
            14 => $kernel::<14>($($argument),*),
            15 => $kernel::<15>($($argument),*),
            16 => $kernel::<16>($($argument),*),
            _ => $other,
        }
    };
    ($d:expr, $kernel:ident ( $($argument:expr),* $(,)? )) => {
        for_width!($d, $kernel($($argument),*), else $kernel::<0>($($argument),*))
    };
}
pub(super) use for_width;

/// Calls a kernel with a row's width as a constant; widths are at most 64.
macro_rules! for_pitch {
    ($o:expr, $kernel:ident ( $($argument:expr),* $(,)? )) => {
        match $o {
            8 => $kernel::<8>($($argument),*),
            16 => $kernel::<16>($($argument),*),
            24 => $kernel::<24>($($argument),*),
            32 => $kernel::<32>($($argument),*),
            40 => $kernel::<40>($($argument),*),
            48 => $kernel::<48>($($argument),*),
            56 => $kernel::<56>($($argument),*),
            _ => $kernel::<64>($($argument),*),
        }
    };
}
pub(super) use for_pitch;

/// Whether an entry belongs to the half of its mask that is the positive.
pub type Half<'a> = &'a (dyn Fn(usize) -> bool + Sync);

#[inline(always)]
const fn width<const D: usize>(d: usize) -> usize {
    if D == 0 { d } else { D }
}

#[inline(always)]
fn row<T>(values: &[T], i: usize, width: usize) -> &[T] {
    &values[i * width..(i + 1) * width]
}

/// Adds (f - mean) of the features at `places` to the first channels of `out`, then scales them.
#[inline(always)]
fn add_standardised(features: &[f32], places: &[u32], mean: &[f32], inverse: &[f32], d: usize, out: &mut [f32]) {
    let out = &mut out[..d];
    let (mean, inverse) = (&mean[..d], &inverse[..d]);
    for &place in places {
        let f = row(features, place as usize, d);
        for c in 0..d {
            out[c] += f[c] - mean[c];
        }
    }
    for c in 0..d {
        out[c] *= inverse[c];
    }
}

/// Standardised inputs of some anchors: rows of `h` and `sums`, `pitch` wide, whose first `d` channels are zero and
/// the others, of colour, done.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub fn inputs<const D: usize>(
    d: usize,
    features: &[f32],
    own: &[u32],
    neighbours: &[u32],
    start: &[u32],
    mean: &[f32],
    inverse: &[f32],
    pitch: usize,
    h: &mut [f32],
    sums: &mut [f32],
) {
    let d = width::<D>(d);
    for (a, h) in h.chunks_exact_mut(pitch).enumerate() {
        h[..d].fill(0.0);
        add_standardised(features, &own[a..=a], mean, inverse, d, h);
    }
    for (sum, bounds) in sums.chunks_exact_mut(pitch).zip(start.windows(2)) {
        sum[..d].fill(0.0);
        let places = &neighbours[bounds[0] as usize..bounds[1] as usize];
        add_standardised(features, places, mean, inverse, d, sum);
    }
}

/// Sums of rows `O` wide over lists of them: `start[i]..start[i + 1]` of `list` for the i-th row of `sums`.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub fn sum_rows<const O: usize>(rows: &[f32], list: &[u32], start: &[u32], sums: &mut [f32]) {
    for (sum, bounds) in sums.as_chunks_mut::<O>().0.iter_mut().zip(start.windows(2)) {
        let mut total = [0.0f32; O];
        for &n in &list[bounds[0] as usize..bounds[1] as usize] {
            let x = row(rows, n as usize, O);
            for c in 0..O {
                total[c] += x[c];
            }
        }
        *sum = total;
    }
}

/// `y = bias + x W1 + s W2` for some anchors, with rows of `y`, of both matrices and of the bias `O` wide. `x` and `s`
/// have rows of their own pitch; as many channels of them are used as their matrix has rows.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub fn dense<const O: usize>(
    (x, x_pitch, w1): (&[f32], usize, &[f32]),
    (s, s_pitch, w2): (&[f32], usize, &[f32]),
    bias: &[f32],
    relu: bool,
    y: &mut [f32],
) {
    let bias: [f32; O] = std::array::from_fn(|o| bias[o]);
    let (w1, w2) = (w1.as_chunks::<O>().0, w2.as_chunks::<O>().0);
    for (block, y) in y.chunks_mut(BLOCK * O).enumerate() {
        let first = block * BLOCK;
        let mut sums = [bias; BLOCK];
        // The last block repeats its last anchor.
        let last = y.len() / O - 1;
        let anchors: [usize; BLOCK] = std::array::from_fn(|j| first + j.min(last));
        for (from, pitch, w) in [(x, x_pitch, w1), (s, s_pitch, w2)] {
            let rows = anchors.map(|a| if w.is_empty() { from } else { &from[a * pitch..a * pitch + w.len()] });
            for (i, w) in w.iter().enumerate() {
                for j in 0..BLOCK {
                    let v = rows[j][i];
                    for o in 0..O {
                        sums[j][o] += v * w[o];
                    }
                }
            }
        }
        for (y, sum) in y.as_chunks_mut::<O>().0.iter_mut().zip(&sums) {
            for o in 0..O {
                y[o] = if relu && sum[o] < 0.0 { 0.0 } else { sum[o] };
            }
        }
    }
}

/// Adds xᵀ g over some anchors to `total` `[channels][O]`.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub fn outer<const O: usize>(x: &[f32], pitch: usize, channels: usize, g: &[f32], total: &mut [f32]) {
    let g = g.as_chunks::<O>().0;
    let total = &mut total.as_chunks_mut::<O>().0[..channels];
    let (blocks, rest) = g.as_chunks::<BLOCK>();
    for (b, g) in blocks.iter().enumerate() {
        let rows: [&[f32]; BLOCK] =
            std::array::from_fn(|j| &x[(b * BLOCK + j) * pitch..(b * BLOCK + j) * pitch + channels]);
        for (i, total) in total.iter_mut().enumerate() {
            for o in 0..O {
                let pair = rows[0][i] * g[0][o] + rows[1][i] * g[1][o];
                total[o] += pair + (rows[2][i] * g[2][o] + rows[3][i] * g[3][o]);
            }
        }
    }
    for (g, x) in rest.iter().zip(x[blocks.len() * BLOCK * pitch..].chunks(pitch)) {
        for (i, total) in total.iter_mut().enumerate() {
            for o in 0..O {
                total[o] += x[i] * g[o];
            }
        }
    }
}

/// What the columns of a view are read from and what a piece of them is.
#[derive(Clone, Copy)]
pub struct Piece<'a> {
    /// Places of the columns.
    pub columns: &'a [u32],
    /// Where the entries of each begin, and where the last ends.
    pub start: &'a [u32],
    /// Masks of all entries of the view.
    pub mask: &'a [u16],
    /// Weights of all entries of the view.
    pub weight: &'a [f32],
    /// Anchor of every place.
    pub source: &'a [u32],
}

/// Adds w f_final of each entry to row `mask` of `sums`, rows of `O` padded from `d`. `hat` is empty without a network.
/// Entries for which `half` holds are added to `halves` too.
#[inline(always)]
fn add_centroids(
    d: usize,
    pitch: usize,
    piece: Piece<'_>,
    features: &[f32],
    hat: &[f32],
    sums: &mut [f32],
    mut halves: Option<(&mut [f32], Half<'_>)>,
) {
    for (c, &place) in piece.columns.iter().enumerate() {
        let mut f = [0.0f32; 64];
        let f = &mut f[..d];
        f.copy_from_slice(row(features, place as usize, d));
        let source = piece.source[place as usize];
        if source != crate::scene::NONE && !hat.is_empty() {
            let hat = &hat[source as usize * pitch..source as usize * pitch + d];
            for j in 0..d {
                f[j] += hat[j];
            }
        }
        for e in piece.start[c] as usize..piece.start[c + 1] as usize {
            let (k, w) = (piece.mask[e] as usize, piece.weight[e]);
            let sum = &mut sums[k * pitch..k * pitch + d];
            for j in 0..d {
                sum[j] += w * f[j];
            }
            if let Some((sums, half)) = &mut halves
                && half(e)
            {
                let sum = &mut sums[k * pitch..k * pitch + d];
                for j in 0..d {
                    sum[j] += w * f[j];
                }
            }
        }
    }
}

/// [`add_centroids`] of a view's columns.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub fn centroids<const D: usize>(
    d: usize,
    pitch: usize,
    piece: Piece<'_>,
    features: &[f32],
    hat: &[f32],
    sums: &mut [f32],
    halves: Option<(&mut [f32], Half<'_>)>,
) {
    add_centroids(width::<D>(d), pitch, piece, features, hat, sums, halves);
}

/// Gradients of a piece of columns, given those of the masks `[K][pitch]`: of the features into `rows`, whose first is
/// that of place `first`, and added up per anchor into `anchors`, whose first is `first_anchor` (empty without network).
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub fn columns_backward<const D: usize>(
    d: usize,
    pitch: usize,
    piece: Piece<'_>,
    masks: &[f32],
    halves: Option<(&[f32], Half<'_>)>,
    (first, rows): (usize, &mut [f32]),
    (first_anchor, anchors): (usize, &mut [f32]),
) {
    let d = width::<D>(d);
    for (c, &place) in piece.columns.iter().enumerate() {
        let mut g = [0.0f32; 64];
        let g = &mut g[..d];
        for e in piece.start[c] as usize..piece.start[c + 1] as usize {
            let (k, w) = (piece.mask[e] as usize, piece.weight[e]);
            let from = &masks[k * pitch..k * pitch + d];
            for j in 0..d {
                g[j] += w * from[j];
            }
            if let Some((masks, half)) = halves
                && half(e)
            {
                let from = &masks[k * pitch..k * pitch + d];
                for j in 0..d {
                    g[j] += w * from[j];
                }
            }
        }
        let at = (place as usize - first) * d;
        rows[at..at + d].copy_from_slice(g);
        let source = piece.source[place as usize];
        if source != crate::scene::NONE && !anchors.is_empty() {
            let at = (source as usize - first_anchor) * pitch;
            let sum = &mut anchors[at..at + d];
            for j in 0..d {
                sum[j] += g[j];
            }
        }
    }
}

#[inline(always)]
fn adam_one(p: &mut f32, m: &mut f32, v: &mut f32, g: f32, r: &Rates) {
    let mean = r.b1 * *m + r.c1 * g;
    let square = r.b2 * *v + r.c2 * g * g;
    // Denormal numbers are slow, and nothing.
    let mean = if mean.abs() < r.tiny { 0.0 } else { mean };
    let square = if square < r.tiny_square { 0.0 } else { square };
    *m = mean;
    *v = square;
    *p -= r.rate * mean / (square.sqrt() * r.root + r.epsilon);
}

/// One step of Adam.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub fn adam(p: &mut [f32], m: &mut [f32], v: &mut [f32], g: &[f32], rates: &Rates) {
    for (((p, m), v), &g) in p.iter_mut().zip(m).zip(v).zip(g) {
        adam_one(p, m, v, g, rates);
    }
}

/// One step of Adam without gradient.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub fn adam_without(p: &mut [f32], m: &mut [f32], v: &mut [f32], rates: &Rates) {
    for ((p, m), v) in p.iter_mut().zip(m).zip(v) {
        adam_one(p, m, v, 0.0, rates);
    }
}

/// One step of Adam for the rows at `columns` alone; `first` is the place of the first row.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub fn adam_rows<const D: usize>(
    d: usize,
    columns: &[u32],
    first: usize,
    p: &mut [f32],
    m: &mut [f32],
    v: &mut [f32],
    g: &[f32],
    rates: &Rates,
) {
    let d = width::<D>(d);
    for &place in columns {
        let at = (place as usize - first) * d;
        let (p, m, v, g) = (&mut p[at..at + d], &mut m[at..at + d], &mut v[at..at + d], &g[at..at + d]);
        for j in 0..d {
            adam_one(&mut p[j], &mut m[j], &mut v[j], g[j], rates);
        }
    }
}

/// Per channel, the sums of (x - pivot) and of its square over rows, the pivot being the first row.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub fn channel_sums<const D: usize>(rows: &[f32], s1: &mut [f64], s2: &mut [f64]) {
    let rows = rows.as_chunks::<D>().0;
    let Some(&pivot) = rows.first() else { return };
    for some in rows.chunks(APART * TERMS) {
        let (mut a1, mut a2) = ([[0.0f32; D]; APART], [[0.0f32; D]; APART]);
        let (blocks, rest) = some.as_chunks::<APART>();
        for block in blocks.iter().map(<[[f32; D]; APART]>::as_slice).chain([rest]) {
            for ((row, a1), a2) in block.iter().zip(&mut a1).zip(&mut a2) {
                for c in 0..D {
                    let x = row[c] - pivot[c];
                    a1[c] += x;
                    a2[c] += x * x;
                }
            }
        }
        for (a1, a2) in a1.iter().zip(&a2) {
            for c in 0..D {
                s1[c] += f64::from(a1[c]);
                s2[c] += f64::from(a2[c]);
            }
        }
    }
}

/// [`channel_sums`] of rows of any width.
pub fn channel_sums_of_wide(d: usize, rows: &[f32], s1: &mut [f64], s2: &mut [f64]) {
    for row in rows.chunks_exact(d) {
        for c in 0..d {
            let x = f64::from(row[c] - rows[c]);
            s1[c] += x;
            s2[c] += x * x;
        }
    }
}
