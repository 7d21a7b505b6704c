//! The loss (1 - w) L1 + w (1 - SSIM) and its gradient.
//!
//! SSIM as Wang et al. 2004 and 3DGS define it: 11 x 11 Gaussian window with standard deviation 1.5, pixels beyond the
//! border count as zero, mean over pixels and channels. Work is cut into bands of rows of a fixed size, so the result
//! does not depend on the number of threads.

use multiversion::multiversion;
use rayon::prelude::*;

/// Half width of the window.
const RADIUS: usize = 5;
/// Taps of the separable window, exp(-d^2 / (2 * 1.5^2)) normalised, from the far end to the centre.
const TAPS: [f32; RADIUS + 1] = [0.001_028_38, 0.007_598_758, 0.036_000_773, 0.109_360_695, 0.213_005_54, 0.266_011_72];
/// (0.01)^2 for values from 0 to 1.
const C1: f32 = 1e-4;
/// (0.03)^2 for values from 0 to 1.
const C2: f32 = 9e-4;
/// Rows per band.
const BAND: usize = 24;
/// Values summed in f32 before they go into an f64 sum: few enough to lose nothing that matters, enough to vectorise.
const RUN: usize = 64;

/// The parts of the loss of one picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Loss {
    /// Mean absolute difference.
    pub l1: f64,
    /// Structural similarity, -1 to 1.
    pub ssim: f64,
    /// (1 - w) L1 + w (1 - SSIM).
    pub total: f64,
}

/// Two pictures of the same size, `[height][width][rgb]`.
#[derive(Debug, Clone, Copy)]
pub struct Pair<'a> {
    /// What was rendered.
    pub render: &'a [f32],
    /// What it should be.
    pub target: &'a [f32],
    /// Width in pixels.
    pub width: usize,
}

/// Derivatives of the SSIM map by the three blurred maps that depend on the rendered picture. Kept between iterations, so
/// that large pictures do not ask the system for fresh memory each time.
#[derive(Debug, Default)]
pub struct Derivatives {
    mean: Vec<f32>,
    square: Vec<f32>,
    product: Vec<f32>,
}

/// Loss of `pair.render` against `pair.target`, and d loss / d render into `gradient` (resized to fit); `d` is room to work
/// in, whatever it held before.
pub fn l1_dssim(pair: Pair<'_>, dssim_weight: f32, gradient: &mut Vec<f32>, d: &mut Derivatives) -> Loss {
    let (n, row) = pair.check();
    let ssim = ssim(pair, d);
    let (l1_scale, ssim_scale) = ((1.0 - dssim_weight) / n as f32, -dssim_weight / n as f32);
    gradient.resize(n, 0.0);
    let l1: Vec<f64> = gradient
        .par_chunks_mut(BAND * row)
        .enumerate()
        .map_init(Scratch::default, |scratch, (band, out)| {
            let (y0, y1) = (band * BAND, band * BAND + out.len() / row);
            let (x, y) = (&pair.render[y0 * row..y1 * row], &pair.target[y0 * row..y1 * row]);
            chain(x, y, scratch.blur([&d.mean, &d.square, &d.product], row, y0, y1), ssim_scale, out);
            add_l1(x, y, l1_scale, out)
        })
        .collect();
    let l1 = l1.iter().sum::<f64>() / n as f64;
    let w = f64::from(dssim_weight);
    Loss { l1, ssim, total: (1.0 - w) * l1 + w * (1.0 - ssim) }
}

impl Pair<'_> {
    /// Number of values, and values per row.
    fn check(&self) -> (usize, usize) {
        let row = 3 * self.width;
        assert!(row > 0 && self.render.len() == self.target.len() && self.render.len().is_multiple_of(row));
        (self.render.len(), row)
    }
}

/// Mean SSIM of two pictures, and the derivatives of its map.
pub fn ssim(pair: Pair<'_>, d: &mut Derivatives) -> f64 {
    let (n, row) = pair.check();
    for map in [&mut d.mean, &mut d.square, &mut d.product] {
        map.resize(n, 0.0);
    }
    let sums: Vec<f64> = d
        .mean
        .par_chunks_mut(BAND * row)
        .zip(d.square.par_chunks_mut(BAND * row))
        .zip(d.product.par_chunks_mut(BAND * row))
        .enumerate()
        .map_init(Scratch::default, |scratch, (band, ((mean, square), product))| {
            let (y0, y1) = (band * BAND, band * BAND + mean.len() / row);
            ssim_with_derivatives(scratch.blur_statistics(pair, row, y0, y1), mean, square, product)
        })
        .collect();
    sums.iter().sum::<f64>() / n as f64
}

/// Buffers of one worker.
#[derive(Default)]
struct Scratch {
    /// A row with a window's half width of zero pixels on both sides.
    padded: Vec<f32>,
    /// A row of zeros.
    zeros: Vec<f32>,
    /// Rows after the horizontal pass, `[map][row]`, the band's and its neighbours'.
    rows: Vec<f32>,
    /// The band after both passes, `[map][row]`.
    out: Vec<f32>,
}

impl Scratch {
    /// Blurs three maps over rows y0 to y1.
    fn blur(&mut self, maps: [&[f32]; 3], row: usize, y0: usize, y1: usize) -> [&[f32]; 3] {
        let height = maps[0].len() / row;
        self.run(row, height, y0, y1, |map, y, line| line.copy_from_slice(&maps[map][y * row..(y + 1) * row]))
    }

    /// Blurs x, y, x^2, y^2 and x y over rows y0 to y1.
    fn blur_statistics(&mut self, pair: Pair<'_>, row: usize, y0: usize, y1: usize) -> [&[f32]; 5] {
        let height = pair.render.len() / row;
        self.run(row, height, y0, y1, |map, y, line| {
            let (a, b) = (&pair.render[y * row..(y + 1) * row], &pair.target[y * row..(y + 1) * row]);
            let (a, b) = match map {
                0 => return line.copy_from_slice(a),
                1 => return line.copy_from_slice(b),
                2 => (a, a),
                3 => (b, b),
                _ => (a, b),
            };
            for ((l, a), b) in line.iter_mut().zip(a).zip(b) {
                *l = a * b;
            }
        })
    }

    /// Blurs maps whose rows `fill(map, y, line)` gives over rows y0 to y1.
    fn run<const MAPS: usize>(
        &mut self,
        row: usize,
        height: usize,
        y0: usize,
        y1: usize,
        fill: impl Fn(usize, usize, &mut [f32]),
    ) -> [&[f32]; MAPS] {
        let (first, last) = (y0.saturating_sub(RADIUS), (y1 + RADIUS).min(height));
        let (have, want) = (last - first, y1 - y0);
        self.padded.clear();
        self.padded.resize(row + 6 * RADIUS, 0.0);
        self.zeros.resize(row, 0.0);
        self.rows.resize(MAPS * have * row, 0.0);
        self.out.resize(MAPS * want * row, 0.0);
        for map in 0..MAPS {
            let rows = &mut self.rows[map * have * row..(map + 1) * have * row];
            for (y, blurred) in (first..last).zip(rows.chunks_exact_mut(row)) {
                fill(map, y, &mut self.padded[3 * RADIUS..3 * RADIUS + row]);
                blur_row(&self.padded, blurred);
            }
            let out = &mut self.out[map * want * row..(map + 1) * want * row];
            for (y, out) in (y0..y1).zip(out.chunks_exact_mut(row)) {
                blur_column(rows, &self.zeros, y - first, out);
            }
        }
        std::array::from_fn(|map| &self.out[map * want * row..(map + 1) * want * row])
    }
}

/// Horizontal pass: `padded` holds `3 * RADIUS` zeros before and after the row of RGB pixels.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
fn blur_row(padded: &[f32], out: &mut [f32]) {
    let n = out.len();
    weigh(
        &padded[3 * RADIUS..][..n],
        std::array::from_fn(|k| [&padded[3 * k..][..n], &padded[6 * RADIUS - 3 * k..][..n]]),
        out,
    );
}

/// Vertical pass around row `centre` of `rows`; rows beyond either end are `zeros`.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
fn blur_column(rows: &[f32], zeros: &[f32], centre: usize, out: &mut [f32]) {
    let n = out.len();
    let at = |y: Option<usize>| y.and_then(|y| rows.get(y * n..(y + 1) * n)).unwrap_or(&zeros[..n]);
    let pair = |k: usize| [at(centre.checked_sub(RADIUS - k)), at(Some(centre + RADIUS - k))];
    weigh(at(Some(centre)), std::array::from_fn(pair), out);
}

/// The window's sum: its centre, and pairs of rows as far from it on both sides, from the far end.
#[inline(always)]
fn weigh(centre: &[f32], pairs: [[&[f32]; 2]; RADIUS], out: &mut [f32]) {
    let n = out.len();
    let centre = &centre[..n];
    let [[a0, a1], [b0, b1], [c0, c1], [d0, d1], [e0, e1]] = pairs;
    let [a0, a1, b0, b1, c0] = [&a0[..n], &a1[..n], &b0[..n], &b1[..n], &c0[..n]];
    let [c1, d0, d1, e0, e1] = [&c1[..n], &d0[..n], &d1[..n], &e0[..n], &e1[..n]];
    // One loop without another in it becomes vectors, whose sums stay in registers.
    for i in 0..n {
        let sum = TAPS[RADIUS] * centre[i];
        let sum = sum + TAPS[0] * (a0[i] + a1[i]);
        let sum = sum + TAPS[1] * (b0[i] + b1[i]);
        let sum = sum + TAPS[2] * (c0[i] + c1[i]);
        let sum = sum + TAPS[3] * (d0[i] + d1[i]);
        out[i] = sum + TAPS[4] * (e0[i] + e1[i]);
    }
}

/// Sum of SSIM over a band from its blurred maps (means of x, y, x^2, y^2, x y), with derivatives by the means of x, x^2
/// and x y.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
fn ssim_with_derivatives(maps: [&[f32]; 5], d_mean: &mut [f32], d_square: &mut [f32], d_product: &mut [f32]) -> f64 {
    let n = d_mean.len();
    let [mx, my, xx, yy, xy] = maps.map(|m| &m[..n]);
    let (d_square, d_product) = (&mut d_square[..n], &mut d_product[..n]);
    let mut total = 0.0;
    let mut values = [0.0f32; RUN];
    for start in (0..n).step_by(RUN) {
        let end = (start + RUN).min(n);
        for (i, value) in (start..end).zip(&mut values) {
            let (mx, my) = (mx[i], my[i]);
            let (var_x, var_y, cov) = (xx[i] - mx * mx, yy[i] - my * my, xy[i] - mx * my);
            let (a1, a2) = (2.0 * mx * my + C1, 2.0 * cov + C2);
            let (b1, b2) = (mx * mx + my * my + C1, var_x + var_y + C2);
            let inverse = 1.0 / (b1 * b2);
            let s = a1 * a2 * inverse;
            *value = s;
            // By the quotient rule, with var_x = E[x^2] - mx^2 and cov = E[xy] - mx my.
            d_square[i] = -s * b1 * inverse;
            d_product[i] = 2.0 * a1 * inverse;
            d_mean[i] = 2.0 * inverse * (my * (a2 - a1) + s * mx * (b1 - b2));
        }
        total += values[..end - start].iter().map(|&v| f64::from(v)).sum::<f64>();
    }
    total
}

/// d SSIM / d x = blur(d mean) + 2 x blur(d E[x^2]) + y blur(d E[xy]): the window is symmetric, so the blur is its own
/// adjoint.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
fn chain(x: &[f32], y: &[f32], blurred: [&[f32]; 3], scale: f32, out: &mut [f32]) {
    let n = out.len();
    let [d_mean, d_square, d_product] = blurred.map(|m| &m[..n]);
    let (x, y) = (&x[..n], &y[..n]);
    for i in 0..n {
        out[i] = scale * (d_mean[i] + 2.0 * x[i] * d_square[i] + y[i] * d_product[i]);
    }
}

/// Adds the gradient of `scale` * sum |x - y| to `out`; gives the unscaled sum.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
fn add_l1(x: &[f32], y: &[f32], scale: f32, out: &mut [f32]) -> f64 {
    let mut total = 0.0;
    for ((x, y), out) in x.chunks(RUN).zip(y.chunks(RUN)).zip(out.chunks_mut(RUN)) {
        let mut parts = [0.0f32; 16];
        for ((x, y), out) in x.chunks(16).zip(y.chunks(16)).zip(out.chunks_mut(16)) {
            for (((&x, &y), o), part) in x.iter().zip(y).zip(out).zip(&mut parts) {
                let d = x - y;
                let sign = f32::from(u8::from(d > 0.0)) - f32::from(u8::from(d < 0.0));
                *o += scale * sign;
                *part += d.abs();
            }
        }
        total += f64::from(parts.iter().sum::<f32>());
    }
    total
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use rand::RngExt;
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::SeedableRng;

    fn noise(n: usize, seed: u64) -> Vec<f32> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        (0..n).map(|_| rng.random_range(0.0..1.0)).collect()
    }

    /// SSIM and loss by the textbook, in f64: a 2D window at every pixel.
    fn oracle(x: &[f64], y: &[f64], width: usize, weight: f64) -> (f64, f64) {
        let height = x.len() / (3 * width);
        let line: Vec<f64> = (-5i32..=5).map(|d| (-f64::from(d * d) / 4.5).exp()).collect();
        let total: f64 = line.iter().sum();
        let mut sum = 0.0;
        for (py, px, c) in (0..height).flat_map(|py| (0..width).flat_map(move |px| (0..3).map(move |c| (py, px, c)))) {
            let mut m = [0.0; 5];
            for (dy, dx) in (0..11usize).flat_map(|dy| (0..11usize).map(move |dx| (dy, dx))) {
                let (qy, qx) = ((py + dy).wrapping_sub(5), (px + dx).wrapping_sub(5));
                if qy < height && qx < width {
                    let w = line[dy] * line[dx] / (total * total);
                    let i = 3 * (qy * width + qx) + c;
                    for (m, v) in m.iter_mut().zip([x[i], y[i], x[i] * x[i], y[i] * y[i], x[i] * y[i]]) {
                        *m += w * v;
                    }
                }
            }
            let [mx, my, xx, yy, xy] = m;
            sum += (2.0 * mx * my + 1e-4) * (2.0 * (xy - mx * my) + 9e-4)
                / ((mx * mx + my * my + 1e-4) * (xx - mx * mx + yy - my * my + 9e-4));
        }
        let n = x.len() as f64;
        let l1 = x.iter().zip(y).map(|(x, y)| (x - y).abs()).sum::<f64>() / n;
        (sum / n, (1.0 - weight) * l1 + weight * (1.0 - sum / n))
    }

    fn wide(v: &[f32]) -> Vec<f64> {
        v.iter().map(|&v| f64::from(v)).collect()
    }

    #[test]
    fn the_taps_are_the_window() {
        let g: Vec<f64> = (-5i32..=5).map(|d| (-f64::from(d * d) / 4.5).exp()).collect();
        let sum: f64 = g.iter().sum();
        for (k, &tap) in TAPS.iter().enumerate() {
            assert!((f64::from(tap) - g[k] / sum).abs() < 1e-8, "{k}: {}", g[k] / sum);
        }
    }

    #[test]
    fn value_and_gradient_are_those_of_the_textbook() {
        // Higher than two bands, narrower than the window.
        let (w, h) = (9, 2 * BAND + 7);
        let (x, y) = (noise(3 * w * h, 1), noise(3 * w * h, 2));
        for weight in [0.2, 0.0] {
            let mut gradient = Vec::new();
            let mut d = Derivatives { mean: vec![7.0; 5], square: vec![f32::NAN; 4 * w * h], product: vec![] };
            let loss = l1_dssim(Pair { render: &x, target: &y, width: w }, weight, &mut gradient, &mut d);
            let weight = f64::from(weight);
            let (ssim_true, total) = oracle(&wide(&x), &wide(&y), w, weight);
            assert!((loss.total - total).abs() < 1e-6, "{loss:?} {total}");
            assert!((loss.ssim - ssim_true).abs() < 1e-6);
            for i in (0..x.len()).step_by(97) {
                let at = |d: f64| {
                    let mut x = wide(&x);
                    x[i] += d;
                    oracle(&x, &wide(&y), w, weight).1
                };
                let numeric = (at(1e-6) - at(-1e-6)) / 2e-6;
                let error = (f64::from(gradient[i]) - numeric).abs();
                assert!(error < 1e-3 * numeric.abs() + 1e-8, "{i}: {} {numeric}", gradient[i]);
            }
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        #[test]
        fn equal_pictures_have_no_loss(w in 1usize..40, h in 1usize..70, seed in 0u64..99) {
            let x = noise(3 * w * h, seed);
            let mut gradient = Vec::new();
            let loss = l1_dssim(Pair { render: &x, target: &x, width: w }, 0.2, &mut gradient, &mut Derivatives::default());
            prop_assert!(loss.total.abs() < 1e-5 && (loss.ssim - 1.0).abs() < 1e-5, "{:?}", loss);
            // A maximum of SSIM has no slope; what is left is rounding.
            prop_assert!(gradient.iter().all(|g| g.abs() < 1e-4 / (w * h) as f32));
        }
    }
}
