//! The inner loops, compiled for the processor at hand. Products and sums are never fused or reordered, so that every
//! processor gives the same bits.
//!
//! `D` is the number of channels of a feature where it is known at compile time, or 0: the same loop, its length read
//! from the argument `d`. The network works on blocks of anchors, a [`Lanes`] per channel.

use crate::contrastive::adam::Rates;
use crate::contrastive::context::NONE;
use multiversion::multiversion;

/// Anchors of a block.
pub const BLOCK: usize = 256;
/// One channel of a block of anchors.
pub type Lanes = [f32; BLOCK];
/// Partial sums of a scalar product.
const PARTIAL: usize = 16;
/// Rows whose sums are kept apart: together they fill vectors whatever the number of channels.
const APART: usize = 16;
/// Sums go from f32 to f64 after so many terms.
const TERMS: usize = 32;

/// Calls a kernel with the number of channels as a constant where there is a version for it.
macro_rules! for_width {
    ($d:expr, $kernel:ident $arguments:tt) => {
        for_width!(@ $d, $kernel, $arguments, 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16)
    };
    (@ $d:expr, $kernel:ident, $arguments:tt, $($width:literal)*) => {
        match $d {
            $($width => for_width!(@ $kernel, $width, $arguments),)*
            _ => for_width!(@ $kernel, 0, $arguments),
        }
    };
    (@ $kernel:ident, $width:literal, ( $($argument:expr),* $(,)? )) => {
        $kernel::<$width>($($argument),*)
    };
}
pub(super) use for_width;

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

/// Sum of (f - mean) over the features at `places`, scaled, into lane `a` of the first `d` channels.
#[inline(always)]
fn standardised(features: &[f32], places: &[u32], mean: &[f32], inverse: &[f32], d: usize, a: usize, to: &mut [Lanes]) {
    let mut sum = [0.0f32; 64];
    let sum = &mut sum[..d];
    let (mean, inverse) = (&mean[..d], &inverse[..d]);
    for &place in places {
        let f = row(features, place as usize, d);
        for c in 0..d {
            sum[c] += f[c] - mean[c];
        }
    }
    for c in 0..d {
        to[c][a] = sum[c] * inverse[c];
    }
}

/// Standardised features of a block's anchors, at the places `own`, into the first `d` channels of `h`, and their sums
/// over neighbours into those of `sums`, unless that is empty.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub fn inputs<const D: usize>(
    d: usize,
    features: &[f32],
    own: &[u32],
    neighbours: &[u32],
    start: &[u32],
    mean: &[f32],
    inverse: &[f32],
    h: &mut [Lanes],
    sums: &mut [Lanes],
) {
    let d = width::<D>(d);
    for a in 0..own.len() {
        standardised(features, &own[a..=a], mean, inverse, d, a, h);
        if !sums.is_empty() {
            let places = &neighbours[start[a] as usize..start[a + 1] as usize];
            standardised(features, places, mean, inverse, d, a, sums);
        }
    }
}

/// Sums of rows over lists of them, one for each anchor of a block: `start[a]..start[a + 1]` of `list`.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub fn sum_rows(rows: &[f32], list: &[u32], start: &[u32], sums: &mut [Lanes]) {
    let width = sums.len();
    let mut total = vec![0.0f32; width];
    for (a, bounds) in start.windows(2).enumerate() {
        total.fill(0.0);
        for &n in &list[bounds[0] as usize..bounds[1] as usize] {
            for (t, x) in total.iter_mut().zip(row(rows, n as usize, width)) {
                *t += x;
            }
        }
        for (sum, t) in sums.iter_mut().zip(&total) {
            sum[a] = *t;
        }
    }
}

/// y += x W for a block, with W `[channels of x][channels of y]`.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub fn dense(x: &[Lanes], w: &[f32], y: &mut [Lanes]) {
    let width = y.len();
    let (fours, rest) = x.as_chunks::<4>();
    for (o, y) in y.iter_mut().enumerate() {
        for (i, [x0, x1, x2, x3]) in fours.iter().enumerate() {
            let [w0, w1, w2, w3]: [f32; 4] = std::array::from_fn(|j| w[(4 * i + j) * width + o]);
            for a in 0..BLOCK {
                y[a] += (w0 * x0[a] + w1 * x1[a]) + (w2 * x2[a] + w3 * x3[a]);
            }
        }
        for (i, x) in rest.iter().enumerate() {
            let w = w[(4 * fours.len() + i) * width + o];
            for a in 0..BLOCK {
                y[a] += w * x[a];
            }
        }
    }
}

/// `v` where `y` is positive, else 0. By bits: a choice becomes a masked store, which some processors are slow at.
#[inline(always)]
fn where_positive(y: f32, v: f32) -> f32 {
    f32::from_bits(v.to_bits() & u32::from(y > 0.0).wrapping_neg())
}

/// Negative values become zero.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub fn relu(y: &mut [Lanes]) {
    for v in y.as_flattened_mut() {
        *v = where_positive(*v, *v);
    }
}

/// Where [`relu`] gave zero the gradient becomes zero.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub fn relu_backward(y: &[Lanes], g: &mut [Lanes]) {
    for (g, &y) in g.as_flattened_mut().iter_mut().zip(y.as_flattened()) {
        *g = where_positive(y, *g);
    }
}

/// total `[channels of x][channels of g]` += xᵀ g over a block.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub fn outer(x: &[Lanes], g: &[Lanes], total: &mut [f32]) {
    for (x, total) in x.iter().zip(total.chunks_exact_mut(g.len())) {
        for (g, total) in g.iter().zip(total) {
            let mut sums = [0.0f32; PARTIAL];
            for (x, g) in x.as_chunks::<PARTIAL>().0.iter().zip(g.as_chunks::<PARTIAL>().0) {
                for j in 0..PARTIAL {
                    sums[j] += x[j] * g[j];
                }
            }
            *total += added(&sums);
        }
    }
}

/// total `[channels]` += the sum of g over a block.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub fn sum_lanes(g: &[Lanes], total: &mut [f32]) {
    for (g, total) in g.iter().zip(total) {
        let mut sums = [0.0f32; PARTIAL];
        for g in g.as_chunks::<PARTIAL>().0 {
            for j in 0..PARTIAL {
                sums[j] += g[j];
            }
        }
        *total += added(&sums);
    }
}

/// The sum, halves first. Not inlined: its tree would have the compiler keep the partial sums in pairs.
#[inline(never)]
fn added(sums: &[f32; PARTIAL]) -> f32 {
    let eight: [f32; 8] = std::array::from_fn(|j| sums[j] + sums[j + 8]);
    let four: [f32; 4] = std::array::from_fn(|j| eight[j] + eight[j + 4]);
    (four[0] + four[2]) + (four[1] + four[3])
}

/// A piece of the columns of a view, and the arrays that they refer to.
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

/// Adds w f_final of each entry of a view's columns to row `mask` of `sums`, rows of `pitch` padded from `d`. `hat` is empty
/// without a network. Entries that are in the positive half of their mask are added to `halves` too.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub fn centroids<const D: usize>(
    d: usize,
    pitch: usize,
    piece: Piece<'_>,
    features: &[f32],
    hat: &[f32],
    sums: &mut [f32],
    mut halves: Option<(&mut [f32], Half<'_>)>,
) {
    let d = width::<D>(d);
    for (c, &place) in piece.columns.iter().enumerate() {
        let mut f = [0.0f32; 64];
        let f = &mut f[..d];
        f.copy_from_slice(row(features, place as usize, d));
        let source = piece.source[place as usize];
        if source != NONE && !hat.is_empty() {
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

/// Gradients of a piece of columns, given those of the masks `[K][pitch]`: of the features into `rows`, whose first is
/// that of place `first`, and added up per anchor into `anchors`, whose first is `first_anchor` (empty without network).
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub fn columns_backward<const D: usize>(
    d: usize,
    pitch: usize,
    piece: Piece<'_>,
    masks: &[f32],
    halves: Option<(&[f32], Half<'_>)>,
    first: usize,
    rows: &mut [f32],
    first_anchor: usize,
    anchors: &mut [f32],
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
        if source != NONE && !anchors.is_empty() {
            let at = (source as usize - first_anchor) * pitch;
            let sum = &mut anchors[at..at + d];
            for j in 0..d {
                sum[j] += g[j];
            }
        }
    }
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub fn adam(p: &mut [f32], m: &mut [f32], v: &mut [f32], g: &[f32], rates: &Rates) {
    for (((p, m), v), &g) in p.iter_mut().zip(m).zip(v).zip(g) {
        rates.update(p, m, v, g);
    }
}

/// One step of Adam without gradient.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub fn adam_without(p: &mut [f32], m: &mut [f32], v: &mut [f32], rates: &Rates) {
    for ((p, m), v) in p.iter_mut().zip(m).zip(v) {
        rates.update(p, m, v, 0.0);
    }
}

/// Per channel, the sums of (x - pivot) and of its square over rows, the pivot being the first row.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub fn channel_sums(d: usize, rows: &[f32], s1: &mut [f64], s2: &mut [f64]) {
    // Some rows side by side are one long row of independent sums: the loop does not depend on the number of channels.
    let width = APART * d;
    let pivots: Vec<f32> = rows.iter().take(d).copied().cycle().take(width).collect();
    let (mut a1, mut a2) = (vec![0.0f32; width], vec![0.0f32; width]);
    for some in rows.chunks(width * TERMS) {
        a1.fill(0.0);
        a2.fill(0.0);
        for block in some.chunks(width) {
            for (((x, p), a1), a2) in block.iter().zip(&pivots).zip(&mut a1).zip(&mut a2) {
                let x = x - p;
                *a1 += x;
                *a2 += x * x;
            }
        }
        for (a1, a2) in a1.chunks_exact(d).zip(a2.chunks_exact(d)) {
            for c in 0..d {
                s1[c] += f64::from(a1[c]);
                s2[c] += f64::from(a2[c]);
            }
        }
    }
}
