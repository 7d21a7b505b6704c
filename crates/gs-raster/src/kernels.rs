//! The inner loops: one tile, all its Gaussians front to back, sixteen pixels (a row) at a time.

use crate::single::project::{ALPHA_MIN, Splat, SplatGradient};
use crate::tiles::{PIXELS, TILE};
use multiversion::multiversion;

/// Largest alpha of a Gaussian at a pixel.
pub(crate) const ALPHA_MAX: f32 = 0.99;
/// Compositing stops before the Gaussian that would bring the transmittance to this or less.
const TRANSMITTANCE_MIN: f32 = 1e-4;

type Row = [f32; TILE];

/// e^-x for 0 <= x <= 80 with a relative error below 3e-7, in a form that compilers vectorise.
#[inline(always)]
pub(crate) fn exp_neg(x: f32) -> f32 {
    // 2^y with y = -x log2(e), split into a whole number and a rest in [-1/2, 1/2].
    let y = x * -std::f32::consts::LOG2_E;
    let y = if y > -120.0 { y } else { -120.0 };
    const ROUND: f32 = 12_582_912.0;
    let shifted = y + ROUND;
    let f = y - (shifted - ROUND);
    let mut p = 1.535_336_2e-4;
    p = p * f + 1.339_887_5e-3;
    p = p * f + 9.618_437e-3;
    p = p * f + 5.550_332_5e-2;
    p = p * f + 2.402_264_8e-1;
    p = p * f + 6.931_472e-1;
    p = p * f + 1.0;
    f32::from_bits(p.to_bits().wrapping_add(shifted.to_bits() << 23))
}

/// Rows of the tile that a splat can reach.
#[inline(always)]
fn rows_of(s: &Splat, y0: usize, height: usize) -> std::ops::Range<usize> {
    let low = (s.mean[1] - s.extent[1] - y0 as f32 - 0.5).floor().max(0.0) as usize;
    let high = (s.mean[1] + s.extent[1] - y0 as f32 + 0.5).ceil().clamp(0.0, height as f32) as usize;
    low..high
}

/// Alpha of a splat along a row of pixels; 0 where it falls below 1/255.
#[inline(always)]
fn alpha_row(s: &Splat, x0: f32, y: f32) -> (Row, Row, f32) {
    let dy = y - s.mean[1];
    let [a, b, c] = s.conic;
    let (half_a, b_dy, cy) = (0.5 * a, b * dy, 0.5 * c * dy * dy);
    let (mut alpha, mut raw) = ([0.0; TILE], [0.0; TILE]);
    for l in 0..TILE {
        let dx = x0 + l as f32 - s.mean[0];
        let sigma = dx * (half_a * dx + b_dy) + cy;
        let e = s.opacity * exp_neg(sigma);
        // A negative sigma comes from rounding of needle-like conics; such a pixel is skipped as gsplat does.
        let keep = (sigma >= 0.0) & (e >= ALPHA_MIN);
        raw[l] = if keep { e } else { 0.0 };
        alpha[l] = if raw[l] < ALPHA_MAX { raw[l] } else { ALPHA_MAX };
    }
    (alpha, raw, dy)
}

/// What a tile's pixels have gathered.
pub(crate) struct TilePixels {
    pub rgb: [[f32; PIXELS]; 3],
    pub depth: [f32; PIXELS],
    pub transmittance: [f32; PIXELS],
}

/// Composites a tile. `list` holds positions in `splats`.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(crate) fn forward_tile(splats: &[Splat], list: &[u32], x0: usize, y0: usize, height: usize) -> Box<TilePixels> {
    let mut out = Box::new(TilePixels { rgb: [[0.0; PIXELS]; 3], depth: [0.0; PIXELS], transmittance: [1.0; PIXELS] });
    let mut live = [1.0f32; PIXELS];
    let mut row_live = [true; TILE];
    let mut rows_left = height;
    for &entry in list {
        let s = &splats[entry as usize];
        for r in rows_of(s, y0, height) {
            if !row_live[r] {
                continue;
            }
            let (alpha, _, _) = alpha_row(s, x0 as f32 + 0.5, (y0 + r) as f32 + 0.5);
            let at = r * TILE;
            let t: &mut Row = (&mut out.transmittance[at..at + TILE]).try_into().expect("a row");
            let lv: &mut Row = (&mut live[at..at + TILE]).try_into().expect("a row");
            let mut w = [0.0; TILE];
            for l in 0..TILE {
                let next = t[l] * (1.0 - alpha[l]);
                lv[l] = if next > TRANSMITTANCE_MIN { lv[l] } else { 0.0 };
                w[l] = t[l] * alpha[l] * lv[l];
                t[l] = if lv[l] > 0.0 { next } else { t[l] };
            }
            for c in 0..3 {
                let o: &mut Row = (&mut out.rgb[c][at..at + TILE]).try_into().expect("a row");
                for l in 0..TILE {
                    o[l] += w[l] * s.color[c];
                }
            }
            let o: &mut Row = (&mut out.depth[at..at + TILE]).try_into().expect("a row");
            for l in 0..TILE {
                o[l] += w[l] * s.depth;
            }
            if lv.iter().sum::<f32>() == 0.0 {
                row_live[r] = false;
                rows_left -= 1;
            }
        }
        if rows_left == 0 {
            break;
        }
    }
    out
}

/// Gradients of a tile's pixels with respect to what was composited.
pub(crate) struct TileGradients {
    /// d loss / d rgb.
    pub rgb: [[f32; PIXELS]; 3],
    /// d loss / d depth.
    pub depth: [f32; PIXELS],
    /// d loss / d accumulated alpha, the background's part included.
    pub alpha: [f32; PIXELS],
    /// Sum over the pixel's Gaussians of weight times (colour . d rgb + z d depth + d alpha).
    pub total: [f32; PIXELS],
}

/// d loss / d splat for every Gaussian of a tile, in the order of `list`.
///
/// Goes front to back like the forward pass: with s_i = c_i . d rgb + z_i d depth + d alpha, the gradient of alpha_i is
/// T_i s_i - (sum of w_j s_j behind i) / (1 - alpha_i), and the sum behind is the total less what came before.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(crate) fn backward_tile(
    splats: &[Splat],
    list: &[u32],
    x0: usize,
    y0: usize,
    height: usize,
    d: &TileGradients,
    out: &mut [SplatGradient],
) {
    let mut transmittance = [1.0f32; PIXELS];
    let mut live = [1.0f32; PIXELS];
    let mut before = [0.0f32; PIXELS];
    let mut row_live = [true; TILE];
    let mut rows_left = height;
    for (&entry, out) in list.iter().zip(out) {
        let s = &splats[entry as usize];
        let [ca, cb, cc] = s.conic;
        let mut sums = [[0.0f32; TILE]; 12];
        for r in rows_of(s, y0, height) {
            if !row_live[r] {
                continue;
            }
            let (alpha, raw, dy) = alpha_row(s, x0 as f32 + 0.5, (y0 + r) as f32 + 0.5);
            let at = r * TILE;
            let t: &mut Row = (&mut transmittance[at..at + TILE]).try_into().expect("a row");
            let lv: &mut Row = (&mut live[at..at + TILE]).try_into().expect("a row");
            let bf: &mut Row = (&mut before[at..at + TILE]).try_into().expect("a row");
            let row = |v: &[f32; PIXELS]| -> Row { v[at..at + TILE].try_into().expect("a row") };
            let (d_r, d_g, d_b) = (row(&d.rgb[0]), row(&d.rgb[1]), row(&d.rgb[2]));
            let (d_depth, d_alpha, total) = (row(&d.depth), row(&d.alpha), row(&d.total));
            for l in 0..TILE {
                let next = t[l] * (1.0 - alpha[l]);
                lv[l] = if next > TRANSMITTANCE_MIN { lv[l] } else { 0.0 };
                let t_here = t[l] * lv[l];
                let w = t_here * alpha[l];
                t[l] = if lv[l] > 0.0 { next } else { t[l] };
                let value =
                    s.color[0] * d_r[l] + s.color[1] * d_g[l] + s.color[2] * d_b[l] + s.depth * d_depth[l] + d_alpha[l];
                bf[l] += w * value;
                let behind = (total[l] - bf[l]) / (1.0 - alpha[l]);
                let active = if (raw[l] > 0.0) & (raw[l] < ALPHA_MAX) { lv[l] } else { 0.0 };
                let d_raw = (t_here * value - behind) * active;
                let d_sigma = -raw[l] * d_raw;
                let dx = x0 as f32 + 0.5 + l as f32 - s.mean[0];
                let (gx, gy) = (-(ca * dx + cb * dy) * d_sigma, -(cb * dx + cc * dy) * d_sigma);
                sums[0][l] += gx;
                sums[1][l] += gy;
                sums[2][l] += gx.abs();
                sums[3][l] += gy.abs();
                sums[4][l] += 0.5 * dx * dx * d_sigma;
                sums[5][l] += dx * dy * d_sigma;
                sums[6][l] += 0.5 * dy * dy * d_sigma;
                sums[7][l] += raw[l] * d_raw;
                sums[8][l] += w * d_depth[l];
                sums[9][l] += w * d_r[l];
                sums[10][l] += w * d_g[l];
                sums[11][l] += w * d_b[l];
            }
            if lv.iter().sum::<f32>() == 0.0 {
                row_live[r] = false;
                rows_left -= 1;
            }
        }
        let sum = |k: usize| sums[k].iter().sum::<f32>();
        *out = SplatGradient {
            mean: [sum(0), sum(1)],
            mean_abs: [sum(2), sum(3)],
            conic: [sum(4), sum(5), sum(6)],
            opacity: sum(7) / s.opacity,
            depth: sum(8),
            color: [sum(9), sum(10), sum(11)],
        };
        if rows_left == 0 {
            break;
        }
    }
}

/// Alphas and blending weights of every Gaussian at every pixel of a tile, `[list][TILE * TILE]`. With `early_stop` a pixel
/// takes nothing more once its transmittance is spent; without, alphas go on to the last Gaussian.
/// Returns the accumulated alpha.
#[multiversion(targets("x86_64+avx512f+avx512vl+avx512bw+avx512dq+avx2+fma", "x86_64+avx2+fma", "aarch64+neon"))]
pub(crate) fn weights_tile(
    splats: &[Splat],
    list: &[u32],
    x0: usize,
    y0: usize,
    height: usize,
    early_stop: bool,
    alphas: &mut [f32],
    weights: &mut [f32],
) -> [f32; PIXELS] {
    let mut transmittance = [1.0f32; PIXELS];
    let mut live = [1.0f32; PIXELS];
    let mut accumulated = [0.0f32; PIXELS];
    for ((&entry, alphas), weights) in
        list.iter().zip(alphas.chunks_exact_mut(PIXELS)).zip(weights.chunks_exact_mut(PIXELS))
    {
        let s = &splats[entry as usize];
        for r in rows_of(s, y0, height) {
            let (alpha, _, _) = alpha_row(s, x0 as f32 + 0.5, (y0 + r) as f32 + 0.5);
            let at = r * TILE;
            for l in 0..TILE {
                let i = at + l;
                let next = transmittance[i] * (1.0 - alpha[l]);
                if early_stop && next <= TRANSMITTANCE_MIN {
                    live[i] = 0.0;
                }
                alphas[i] = alpha[l] * live[i];
                weights[i] = transmittance[i] * alphas[i];
                accumulated[i] += weights[i];
                if live[i] > 0.0 {
                    transmittance[i] = next;
                }
            }
        }
    }
    accumulated
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_fast_exponential_keeps_its_bound() {
        let mut worst = 0f64;
        for i in 0..=800_000 {
            let x = i as f32 * 1e-4;
            let exact = (-f64::from(x)).exp();
            worst = worst.max((f64::from(exp_neg(x)) / exact - 1.0).abs() / (1.0 + f64::from(x)));
        }
        // x log2(e) is rounded once, so the relative error grows with x.
        assert!(worst < 3e-7, "{worst:e}");
        assert_eq!(exp_neg(0.0), 1.0);
        assert!(exp_neg(1e30) < 1e-30);
    }
}
