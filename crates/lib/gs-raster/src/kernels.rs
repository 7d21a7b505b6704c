//! The inner loops: one tile, all its Gaussians front to back, one vector of pixels at a time.
//!
//! The vectors are as wide as the processor's (AVX-512, AVX2 with FMA, NEON, or one float), chosen at run time. Pixels do not
//! depend on the width, and sums over pixels are taken column by column and folded in a fixed order, so all processors with
//! fused multiply-add give the same bits; those without differ in the last ones.
//!
//! A transmittance is kept with its sign set once its pixel has stopped: such a pixel fails the test for going on by itself.

use crate::project::{Splat, SplatGradient};
use crate::tiles::{PIXELS, Rectangle, TILE, Tile};
use pulp::{Arch, Simd, WithSimd};

/// Largest alpha of a Gaussian at a pixel.
pub(crate) const ALPHA_MAX: f32 = 0.99;
/// log2 of the smallest alpha that is not skipped, 1/255.
const LOG2_ALPHA_MIN: f32 = -7.994_353_4;
/// Compositing stops before the Gaussian that would bring the transmittance to this or less.
const TRANSMITTANCE_MIN: f32 = 1e-4;
/// Gaussians that a tile takes at a time: before each batch it looks which of its rows still go on, and brings the batch's
/// splats near, so that their cache misses overlap.
const BATCH: usize = 16;
/// Bits of a tile's rows, as floats.
const POWERS: Row = {
    let mut powers = [1.0; TILE];
    let mut r = 1;
    while r < TILE {
        powers[r] = 2.0 * powers[r - 1];
        r += 1;
    }
    powers
};

type Row = [f32; TILE];

/// 2^q for -100 <= q <= 100, with a relative error below 5e-7: 2^round(q) by the exponent's bits, the rest by a polynomial
/// through 1 at 0 and Chebyshev nodes of [-1/2, 1/2].
#[inline(always)]
fn exp2<S: Simd>(simd: S, q: S::f32s) -> S::f32s {
    const COEFFICIENTS: [f32; 5] = [std::f32::consts::LN_2, 0.240_223_5, 0.055_503_81, 0.009_666_368, 0.001_338_130_2];
    // Adding this leaves the nearest whole number in the lowest bits.
    let round = simd.splat_f32s(12_582_912.0);
    let shifted = simd.add_f32s(q, round);
    let f = simd.sub_f32s(q, simd.sub_f32s(shifted, round));
    let mut p = simd.splat_f32s(COEFFICIENTS[4]);
    for k in (0..4).rev() {
        p = simd.mul_add_e_f32s(p, f, simd.splat_f32s(COEFFICIENTS[k]));
    }
    p = simd.mul_add_e_f32s(p, f, simd.splat_f32s(1.0));
    let exponent = simd.wrapping_dyn_shl_u32s(simd.transmute_u32s_f32s(shifted), simd.splat_u32s(23));
    simd.transmute_f32s_u32s(simd.add_u32s(simd.transmute_u32s_f32s(p), exponent))
}

/// A tile's pixel centres: x by column, y by row.
struct Grid {
    x: Row,
    y: Row,
    /// Rows within the image, as bits.
    inside: u32,
}

impl Grid {
    #[inline(always)]
    fn new((x0, y0, _, height): Rectangle) -> Self {
        let centers = |first: usize| std::array::from_fn(|l| (first + l) as f32 + 0.5);
        Self { x: centers(x0), y: centers(y0), inside: (1 << height) - 1 }
    }
}

/// A splat's alpha over a tile, as the exponent of 2: q = peak + (xx dx + xy dy) dx + yy dy^2 at offset (dx, dy) from its
/// centre.
struct Falloff<S: Simd> {
    mean_x: S::f32s,
    xx: S::f32s,
    peak: S::f32s,
    /// By row: dy, xy dy, peak + yy dy^2.
    dy: Row,
    linear: Row,
    constant: Row,
    /// By vector of columns: rows, as bits, that the ellipse alpha = 1/255 reaches.
    rows: [u32; TILE],
}

impl<S: Simd> Falloff<S> {
    #[inline(always)]
    fn new(simd: S, s: &Splat, grid: &Grid) -> Self {
        use std::f32::consts::LOG2_E;
        let [a, b, c] = s.conic;
        let splat = |v| simd.splat_f32s(v);
        let (mean_x, peak) = (splat(s.mean[0]), splat(s.log2_opacity));
        let mut out = Self {
            mean_x,
            xx: splat(-0.5 * LOG2_E * a),
            peak,
            dy: [0.0; TILE],
            linear: [0.0; TILE],
            constant: [0.0; TILE],
            rows: [0; TILE],
        };
        let (x, y) = (vectors::<S>(&grid.x), vectors::<S>(&grid.y));
        let (dy, linear, constant) =
            (vectors_mut::<S>(&mut out.dy), vectors_mut::<S>(&mut out.linear), vectors_mut::<S>(&mut out.constant));
        // In row y, the ellipse spans x = (-b y -+ sqrt(2 sigma a - y^2 det)) / a. Margins for the rounding of this against
        // that of the pixels' own; both passes take the same rows.
        let sigma = s.sigma_max * 1.0001 + 1e-5;
        let square = splat(2.0 * sigma * a);
        let inverse = splat(1.0 / a);
        let margin = 1e-3 + 1e-4 * s.extent[0];
        let mut bits = [splat(0.0); TILE];
        for k in 0..y.len() {
            let v = simd.sub_f32s(y[k], splat(s.mean[1]));
            dy[k] = v;
            linear[k] = simd.mul_f32s(splat(-LOG2_E * b), v);
            constant[k] = simd.mul_add_e_f32s(simd.mul_f32s(splat(-0.5 * LOG2_E * c), v), v, peak);
            // Not a number, and so in no column, above and below the ellipse.
            let discriminant = simd.negate_mul_add_e_f32s(simd.mul_f32s(v, v), splat(s.conic_det), square);
            let half = simd.mul_add_e_f32s(simd.sqrt_f32s(discriminant), inverse, splat(margin));
            let middle = simd.negate_mul_add_e_f32s(simd.mul_f32s(splat(b), v), inverse, mean_x);
            let (low, high) = (simd.sub_f32s(middle, half), simd.add_f32s(middle, half));
            let place = vectors::<S>(&POWERS)[k];
            for (block, bits) in bits[..x.len()].iter_mut().enumerate() {
                let (first, last) = (grid.x[block * S::F32_LANES], grid.x[(block + 1) * S::F32_LANES - 1]);
                let left = simd.less_than_or_equal_f32s(low, splat(last));
                let right = simd.greater_than_or_equal_f32s(high, splat(first));
                let zero = splat(0.0);
                let place = simd.select_f32s(left, simd.select_f32s(right, place, zero), zero);
                *bits = simd.add_f32s(*bits, place);
            }
        }
        for block in 0..x.len() {
            // Sums of different powers of two below 2^16 are exact.
            out.rows[block] = simd.reduce_sum_f32s(bits[block]) as u32 & grid.inside;
        }
        out
    }

    /// Opacity times the exponential in row `r`, and alpha: capped, and 0 where it is skipped.
    #[inline(always)]
    fn alpha(&self, simd: S, dx: S::f32s, r: usize) -> (S::f32s, S::f32s) {
        let linear = simd.mul_add_e_f32s(self.xx, dx, simd.splat_f32s(self.linear[r]));
        let q = simd.mul_add_e_f32s(linear, dx, simd.splat_f32s(self.constant[r]));
        // Needle-like forms may round to above their peak.
        let q = simd.min_f32s(q, self.peak);
        let raw = exp2(simd, q);
        let keep = simd.greater_than_or_equal_f32s(q, simd.splat_f32s(LOG2_ALPHA_MIN));
        let capped = simd.min_f32s(raw, simd.splat_f32s(ALPHA_MAX));
        (raw, simd.select_f32s(keep, capped, simd.splat_f32s(0.0)))
    }
}

/// One vector's step: given the transmittance before a Gaussian, which pixels take it and the transmittance after it.
#[inline(always)]
fn advance<S: Simd>(simd: S, t: S::f32s, alpha: S::f32s) -> (S::m32s, S::f32s) {
    let next = simd.negate_mul_add_e_f32s(t, alpha, t);
    let takes = simd.greater_than_f32s(next, simd.splat_f32s(TRANSMITTANCE_MIN));
    let sign = simd.splat_u32s(1 << 31);
    let stopped = simd.transmute_f32s_u32s(simd.or_u32s(simd.transmute_u32s_f32s(t), sign));
    (takes, simd.select_f32s(takes, next, stopped))
}

/// 1 inside the image; columns beyond its edge have stopped from the start.
#[inline(always)]
fn fresh(width: usize) -> [f32; PIXELS] {
    let mut t = [1.0f32; PIXELS];
    for row in t.chunks_exact_mut(TILE) {
        row[width..].fill(-1.0);
    }
    t
}

/// By vector of columns: rows, as bits and among those `inside`, in which some pixel goes on; whether there is one.
#[inline(always)]
fn some_go_on<S: Simd>(simd: S, t: &[S::f32s], inside: u32, live: &mut [u32]) -> bool {
    let blocks = live.len();
    for (b, rows) in live.iter_mut().enumerate() {
        let live = |r: usize| u32::from(simd.reduce_max_f32s(t[r * blocks + b]) > 0.0) << r;
        *rows = (0..TILE).map(live).sum::<u32>() & inside;
    }
    live.iter().any(|rows| *rows != 0)
}

#[inline(always)]
fn vectors<S: Simd>(values: &[f32]) -> &[S::f32s] {
    S::as_simd_f32s(values).0
}

#[inline(always)]
fn vectors_mut<S: Simd>(values: &mut [f32]) -> &mut [S::f32s] {
    S::as_mut_simd_f32s(values).0
}

/// What a tile's pixels have gathered.
pub(crate) struct TilePixels {
    pub rgb: [[f32; PIXELS]; 3],
    pub depth: [f32; PIXELS],
    pub transmittance: [f32; PIXELS],
    /// Pixel-Gaussian pairs that were looked at.
    pub evaluated: usize,
}

/// Composites a tile; without `depth` that stays zero.
pub(crate) fn forward_tile(tile: Tile<'_>, depth: bool) -> Box<TilePixels> {
    match depth {
        true => Arch::new().dispatch(ForwardTile::<true>(tile)),
        false => Arch::new().dispatch(ForwardTile::<false>(tile)),
    }
}

struct ForwardTile<'a, const DEPTH: bool>(Tile<'a>);

impl<const DEPTH: bool> WithSimd for ForwardTile<'_, DEPTH> {
    type Output = Box<TilePixels>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Box<TilePixels> {
        let Tile { splats, list, rectangle } = self.0;
        let (_, _, width, _) = rectangle;
        let lanes = S::F32_LANES.min(TILE);
        let blocks = TILE / lanes;
        let mut out = Box::new(TilePixels {
            rgb: [[0.0; PIXELS]; 3],
            depth: [0.0; PIXELS],
            transmittance: fresh(width),
            evaluated: 0,
        });
        let TilePixels { rgb: [red, green, blue], depth, transmittance, evaluated } = &mut *out;
        let [red, green, blue] = [red, green, blue].map(|v| vectors_mut::<S>(v));
        let depth = vectors_mut::<S>(depth);
        let grid = Grid::new(rectangle);
        let mut live = [grid.inside; TILE];
        let mut near = [Splat::default(); BATCH];
        for (n, list) in list.chunks(BATCH).enumerate() {
            let t = vectors_mut::<S>(transmittance);
            if n > 0 && !some_go_on(simd, t, grid.inside, &mut live[..blocks]) {
                break;
            }
            for (near, &entry) in near.iter_mut().zip(list) {
                *near = splats[entry as usize];
            }
            for s in &near[..list.len()] {
                let falloff = Falloff::new(simd, s, &grid);
                let color = s.color.map(|c| simd.splat_f32s(c));
                let z = simd.splat_f32s(s.depth);
                for b in 0..blocks {
                    let mut rows = falloff.rows[b] & live[b];
                    *evaluated += rows.count_ones() as usize * lanes;
                    let dx = simd.sub_f32s(vectors::<S>(&grid.x)[b], falloff.mean_x);
                    while rows != 0 {
                        let r = rows.trailing_zeros() as usize % TILE;
                        rows &= rows - 1;
                        let at = r * blocks + b;
                        let (_, alpha) = falloff.alpha(simd, dx, r);
                        let before = t[at];
                        let (takes, after) = advance(simd, before, alpha);
                        t[at] = after;
                        let w = simd.select_f32s(takes, simd.mul_f32s(before, alpha), simd.splat_f32s(0.0));
                        red[at] = simd.mul_add_e_f32s(w, color[0], red[at]);
                        green[at] = simd.mul_add_e_f32s(w, color[1], green[at]);
                        blue[at] = simd.mul_add_e_f32s(w, color[2], blue[at]);
                        if DEPTH {
                            depth[at] = simd.mul_add_e_f32s(w, z, depth[at]);
                        }
                    }
                }
            }
        }
        for t in transmittance {
            *t = t.abs();
        }
        out
    }
}

/// Gradients of a tile's pixels with respect to what was composited.
pub(crate) struct TileGradients {
    /// d loss / d rgb.
    pub rgb: [[f32; PIXELS]; 3],
    /// d loss / d depth.
    pub depth: [f32; PIXELS],
    /// d loss / d accumulated alpha, the background's part included.
    pub alpha: [f32; PIXELS],
    /// Sum over the pixel's Gaussians of weight times (colour . d rgb + z d depth + d alpha); the kernel takes from it what
    /// lies in front.
    pub behind: [f32; PIXELS],
}

/// d loss / d splat for every Gaussian of a tile, in the order of its list.
///
/// Goes front to back like the forward pass: with s_i = c_i . d rgb + z_i d depth + d alpha, the gradient of alpha_i is
/// T_i s_i - (sum of w_j s_j behind i) / (1 - alpha_i), and the sum behind is the total less what came before.
///
/// `depth` says whether the gradients of depth are wanted; else they stay zero and leave registers to the rest.
pub(crate) fn backward_tile(tile: Tile<'_>, depth: bool, d: &mut TileGradients, out: &mut [SplatGradient]) {
    match depth {
        false => Arch::new().dispatch(BackwardTile::<false> { tile, d, out }),
        true => Arch::new().dispatch(BackwardTile::<true> { tile, d, out }),
    }
}

struct BackwardTile<'a, const DEPTH: bool> {
    tile: Tile<'a>,
    d: &'a mut TileGradients,
    out: &'a mut [SplatGradient],
}

impl<const DEPTH: bool> WithSimd for BackwardTile<'_, DEPTH> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Tile { splats, list, rectangle } = self.tile;
        let (_, _, width, _) = rectangle;
        let lanes = S::F32_LANES.min(TILE);
        let blocks = TILE / lanes;
        let TileGradients { rgb: [d_red, d_green, d_blue], depth, alpha, behind } = self.d;
        let [d_red, d_green, d_blue, d_depth, d_alpha] =
            [d_red, d_green, d_blue, depth, alpha].map(|v| vectors::<S>(v));
        let behind = vectors_mut::<S>(behind);
        let mut transmittance = fresh(width);
        let grid = Grid::new(rectangle);
        let mut live = [grid.inside; TILE];
        let mut near = [Splat::default(); BATCH];
        for (n, (list, out)) in list.chunks(BATCH).zip(self.out.chunks_mut(BATCH)).enumerate() {
            let t = vectors_mut::<S>(&mut transmittance);
            if n > 0 && !some_go_on(simd, t, grid.inside, &mut live[..blocks]) {
                break;
            }
            for (near, &entry) in near.iter_mut().zip(list) {
                *near = splats[entry as usize];
            }
            for (s, out) in near.iter().zip(out) {
                let falloff = Falloff::new(simd, s, &grid);
                let color = s.color.map(|c| simd.splat_f32s(c));
                let z = simd.splat_f32s(s.depth);
                let mut sums = [[0.0f32; TILE]; 7];
                for b in 0..blocks {
                    let mut rows = falloff.rows[b] & live[b];
                    if rows == 0 {
                        continue;
                    }
                    let dx = simd.sub_f32s(vectors::<S>(&grid.x)[b], falloff.mean_x);
                    let mut sum = [simd.splat_f32s(0.0); 7];
                    while rows != 0 {
                        let r = rows.trailing_zeros() as usize % TILE;
                        rows &= rows - 1;
                        let at = r * blocks + b;
                        let dy = falloff.dy[r];
                        let (raw, alpha) = falloff.alpha(simd, dx, r);
                        let before = t[at];
                        let (takes, after) = advance(simd, before, alpha);
                        t[at] = after;
                        let zero = simd.splat_f32s(0.0);
                        let alpha = simd.select_f32s(takes, alpha, zero);
                        let w = simd.mul_f32s(before, alpha);
                        let value = simd.mul_add_e_f32s(color[0], d_red[at], d_alpha[at]);
                        let value = simd.mul_add_e_f32s(color[1], d_green[at], value);
                        let value = simd.mul_add_e_f32s(color[2], d_blue[at], value);
                        let value = if DEPTH { simd.mul_add_e_f32s(z, d_depth[at], value) } else { value };
                        let own = simd.mul_f32s(w, value);
                        let rest = simd.sub_f32s(behind[at], own);
                        behind[at] = rest;
                        // alpha d loss / d alpha = - d loss / d sigma, none where alpha is capped.
                        let odds = simd.div_f32s(alpha, simd.sub_f32s(simd.splat_f32s(1.0), alpha));
                        let g = simd.negate_mul_add_e_f32s(odds, rest, own);
                        let free = simd.less_than_f32s(raw, simd.splat_f32s(ALPHA_MAX));
                        let g = simd.select_f32s(free, g, zero);
                        sum[0] = simd.add_f32s(g, sum[0]);
                        sum[1] = simd.mul_add_e_f32s(g, simd.splat_f32s(dy), sum[1]);
                        sum[2] = simd.mul_add_e_f32s(g, simd.splat_f32s(dy * dy), sum[2]);
                        sum[3] = simd.mul_add_e_f32s(w, d_red[at], sum[3]);
                        sum[4] = simd.mul_add_e_f32s(w, d_green[at], sum[4]);
                        sum[5] = simd.mul_add_e_f32s(w, d_blue[at], sum[5]);
                        if DEPTH {
                            sum[6] = simd.mul_add_e_f32s(w, d_depth[at], sum[6]);
                        }
                    }
                    for (sums, sum) in sums.iter_mut().zip(sum) {
                        vectors_mut::<S>(sums)[b] = sum;
                    }
                }
                *out = splat_gradient::<DEPTH>(s, &grid.x, &sums);
            }
        }
    }
}

/// From the kernel's sums per column (g, g dy, g dy^2, colour, depth, with g = - d loss / d sigma) to
/// the splat.
#[inline(always)]
fn splat_gradient<const DEPTH: bool>(s: &Splat, x: &Row, sums: &[Row; 7]) -> SplatGradient {
    // g dx, g dx^2 and g dx dy follow from the columns' sums.
    let mut moments = [[0.0f32; TILE]; 3];
    for l in 0..TILE {
        let dx = x[l] - s.mean[0];
        moments[0][l] = sums[0][l] * dx;
        moments[1][l] = moments[0][l] * dx;
        moments[2][l] = sums[1][l] * dx;
    }
    // One by one: a closure would be compiled without the processor's vectors.
    let (g, g_y, g_yy) = (folded(&sums[0]), folded(&sums[1]), folded(&sums[2]));
    let color = [folded(&sums[3]), folded(&sums[4]), folded(&sums[5])];
    let (g_x, g_xx, g_xy) = (folded(&moments[0]), folded(&moments[1]), folded(&moments[2]));
    let [xx, xy, yy] = s.conic;
    SplatGradient {
        mean: [xx * g_x + xy * g_y, xy * g_x + yy * g_y],
        conic: [-0.5 * g_xx, -g_xy, -0.5 * g_yy],
        opacity: g / s.opacity,
        depth: if DEPTH { folded(&sums[6]) } else { 0.0 },
        color,
    }
}

/// The sum of a row's columns, halves added to halves: the same order for any width of vectors. (Loops of constant length
/// become vectors; one over the halves does not.)
#[inline(always)]
fn folded(row: &Row) -> f32 {
    let mut quarter = [0.0f32; 4];
    for l in 0..4 {
        quarter[l] = (row[l] + row[l + 8]) + (row[l + 4] + row[l + 12]);
    }
    (quarter[0] + quarter[2]) + (quarter[1] + quarter[3])
}

/// Alphas and blending weights of a tile's Gaussians at every pixel, `[G][TILE * TILE]`, both empty on entry. With
/// `early_stop` a pixel takes nothing more once its transmittance is spent, and G ends where no pixel takes more; without,
/// alphas go on to the last Gaussian. Returns the accumulated alpha.
pub(crate) fn weights_tile(
    tile: Tile<'_>,
    early_stop: bool,
    alphas: &mut Vec<f32>,
    weights: &mut Vec<f32>,
) -> [f32; PIXELS] {
    Arch::new().dispatch(WeightsTile { tile, early_stop, alphas, weights })
}

struct WeightsTile<'a> {
    tile: Tile<'a>,
    early_stop: bool,
    alphas: &'a mut Vec<f32>,
    weights: &'a mut Vec<f32>,
}

impl WithSimd for WeightsTile<'_> {
    type Output = [f32; PIXELS];

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> [f32; PIXELS] {
        let Tile { splats, list, rectangle } = self.tile;
        let (_, _, width, _) = rectangle;
        let lanes = S::F32_LANES.min(TILE);
        let blocks = TILE / lanes;
        let mut transmittance = fresh(if self.early_stop { width } else { TILE });
        let mut accumulated = [0.0f32; PIXELS];
        let grid = Grid::new(rectangle);
        // Columns beyond the image's right edge are no pixels, though without a stop they have a transmittance.
        let inside: Row = std::array::from_fn(|l| if l < width { 1.0 } else { 0.0 });
        let mut live = [grid.inside; TILE];
        for (n, &entry) in list.iter().enumerate() {
            let s = &splats[entry as usize];
            let [t, accumulated] = [&mut transmittance, &mut accumulated].map(|v| vectors_mut::<S>(v));
            if self.early_stop && n % BATCH == 0 && n > 0 && !some_go_on(simd, t, grid.inside, &mut live[..blocks]) {
                break;
            }
            let [alphas, weights] = [&mut *self.alphas, &mut *self.weights].map(|layers| {
                layers.resize((n + 1) * PIXELS, 0.0);
                vectors_mut::<S>(&mut layers[n * PIXELS..])
            });
            let falloff = Falloff::new(simd, s, &grid);
            for b in 0..blocks {
                let mut rows = falloff.rows[b] & live[b];
                let dx = simd.sub_f32s(vectors::<S>(&grid.x)[b], falloff.mean_x);
                while rows != 0 {
                    let r = rows.trailing_zeros() as usize % TILE;
                    rows &= rows - 1;
                    let at = r * blocks + b;
                    let (_, alpha) = falloff.alpha(simd, dx, r);
                    let before = t[at];
                    let (alpha, w) = if self.early_stop {
                        let (takes, after) = advance(simd, before, alpha);
                        t[at] = after;
                        let only = |v| simd.select_f32s(takes, v, simd.splat_f32s(0.0));
                        (only(alpha), only(simd.mul_f32s(before, alpha)))
                    } else {
                        t[at] = simd.negate_mul_add_e_f32s(before, alpha, before);
                        let alpha = simd.mul_f32s(alpha, vectors::<S>(&inside)[b]);
                        (alpha, simd.mul_f32s(before, alpha))
                    };
                    alphas[at] = alpha;
                    weights[at] = w;
                    accumulated[at] = simd.add_f32s(accumulated[at], w);
                }
            }
        }
        accumulated
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Exp2<'a>(&'a mut [f32]);

    impl WithSimd for Exp2<'_> {
        type Output = ();

        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) {
            for v in vectors_mut::<S>(self.0) {
                *v = exp2(simd, *v);
            }
        }
    }

    #[test]
    fn the_fast_exponential_keeps_its_bound() {
        let steps: Vec<f32> = (-1_600_000..=1_600_000).map(|i| i as f32 * 6.25e-5).collect();
        let steps = &steps[..steps.len() / 16 * 16];
        let mut fast = steps.to_vec();
        Arch::new().dispatch(Exp2(&mut fast));
        let mut worst = 0f64;
        for (q, v) in steps.iter().zip(&fast) {
            worst = worst.max((f64::from(*v) / f64::from(*q).exp2() - 1.0).abs());
        }
        eprintln!("largest relative error {worst:e}");
        assert!(worst < 5e-7, "{worst:e}");
        // Without vectors as well.
        Exp2(&mut fast[..0]).with_simd(pulp::Scalar);
        for q in [-7.99f32, -3.3, -0.5, 0.0, 0.49] {
            let exact = f64::from(q).exp2();
            assert!((f64::from(exp2(pulp::Scalar, q)) / exact - 1.0).abs() < 5e-7);
        }
        assert_eq!(exp2(pulp::Scalar, 0.0), 1.0);
    }

    /// Splats over the first tile: of all sizes and shapes, some too faint to see, some that stop it early.
    fn splats(n: usize) -> Vec<Splat> {
        let mut state = 1u32;
        let mut roll = move |low: f32, high: f32| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            low + (high - low) * (state >> 8) as f32 / 16_777_216.0
        };
        let one = |_| {
            let (sx, sy, rho) = (roll(0.6, 9.0), roll(0.6, 9.0), roll(-0.95, 0.95));
            let conic_det = 1.0 / (sx * sx * sy * sy * (1.0 - rho * rho));
            let opacity = roll(0.01, 1.0);
            let sigma_max = (255.0 * opacity).ln();
            let color = [roll(0.0, 1.0), roll(0.0, 1.0), roll(0.0, 1.0)];
            Splat {
                mean: [roll(-6.0, 22.0), roll(-6.0, 22.0)],
                conic: [sy * sy * conic_det, -rho * sx * sy * conic_det, sx * sx * conic_det],
                conic_det,
                extent: [sx, sy].map(|s| s * (2.0 * sigma_max).sqrt()),
                sigma_max,
                opacity,
                log2_opacity: opacity.log2(),
                depth: roll(1.0, 5.0),
                color,
                clamped: [false; 3],
            }
        };
        (0..n).map(one).collect()
    }

    /// All that the kernels put out for a tile.
    fn everything<S: Simd>(simd: S, splats: &[Splat], rectangle: Rectangle) -> Vec<f32> {
        let list: Vec<u32> = (0..splats.len() as u32).collect();
        let tile = Tile { splats, list: &list, rectangle };
        let p = ForwardTile::<true>(tile).with_simd(simd);
        let mut all = [p.rgb.as_flattened(), &p.depth, &p.transmittance].concat();
        let wave = |k: usize| std::array::from_fn(|i| ((k * PIXELS + i) as f32 * 0.3).sin());
        let mut d =
            TileGradients { rgb: [wave(0), wave(1), wave(2)], depth: wave(3), alpha: wave(4), behind: [0.0; PIXELS] };
        let mut out = vec![SplatGradient::default(); splats.len()];
        BackwardTile::<true> { tile, d: &mut d, out: &mut out }.with_simd(simd);
        for o in &out {
            all.extend([&o.mean[..], &o.conic, &[o.opacity, o.depth], &o.color].concat());
        }
        for early_stop in [true, false] {
            let (mut alphas, mut weights) = (vec![0.0; PIXELS * splats.len()], vec![0.0; PIXELS * splats.len()]);
            let tile = WeightsTile { tile, early_stop, alphas: &mut alphas, weights: &mut weights };
            all.extend(tile.with_simd(simd));
            all.extend(alphas);
            all.extend(weights);
        }
        all
    }

    struct Everything<'a>(&'a [Splat], Rectangle);

    impl WithSimd for Everything<'_> {
        type Output = Vec<f32>;

        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) -> Vec<f32> {
            everything(simd, self.0, self.1)
        }
    }

    #[test]
    fn the_width_of_vectors_does_not_show() {
        let splats = splats(150);
        for rectangle in [(0, 0, 16, 16), (0, 0, 11, 16), (0, 0, 16, 5), (0, 0, 1, 1)] {
            // These fuse multiplications and additions in software.
            let four = everything(pulp::Scalar128b, &splats, rectangle);
            assert!(four == everything(pulp::Scalar256b, &splats, rectangle));
            assert!(four == everything(pulp::Scalar512b, &splats, rectangle));
            let here = Arch::new().dispatch(Everything(&splats, rectangle));
            if !matches!(Arch::new(), Arch::Scalar) {
                assert!(four == here, "this processor's vectors");
            }
            // One float at a time, not fused: the last bits may differ.
            let norm = |v: &[f32]| v.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
            let one = everything(pulp::Scalar, &splats, rectangle);
            let difference: Vec<f32> = one.iter().zip(&four).map(|(a, b)| a - b).collect();
            assert!(norm(&difference) < 1e-5 * norm(&four), "{:e}", norm(&difference) / norm(&four));
        }
    }
}
