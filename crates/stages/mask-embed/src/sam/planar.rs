//! Loops over pixels for SAM's encoder and decoder, compiled for the processor at hand. The decoder's arrays are planar:
//! `[channels][pixels]`, so that pixels lie side by side. The encoder's are `[pixels][channels]`.

use multiversion::multiversion;

/// Pixels that are worked on together, so that all channels of them stay in the cache.
const BLOCK: usize = 256;

/// e^x, relative error below 2e-7; below -87 as at -87.
#[inline(always)]
fn exp(x: f32) -> f32 {
    /// Adding this rounds to a whole number, which then stands in the lowest bits.
    const ROUND: f32 = 12_582_912.0;
    let x = x.clamp(-87.0, 88.0);
    let shifted = x * std::f32::consts::LOG2_E + ROUND;
    let whole = shifted - ROUND;
    // ln 2 in two parts, the first exact in few bits.
    let r = (x - whole * 0.693_359_4) + whole * 2.121_944_4e-4;
    // Taylor's series to the seventh power: |r| <= ln 2 / 2.
    let p = 1.0 / 5040.0;
    let p = p * r + 1.0 / 720.0;
    let p = p * r + 1.0 / 120.0;
    let p = p * r + 1.0 / 24.0;
    let p = p * r + 1.0 / 6.0;
    let p = p * r + 0.5;
    let p = p * r + 1.0;
    let p = p * r + 1.0;
    f32::from_bits(p.to_bits().wrapping_add(shifted.to_bits() << 23))
}

/// x times the normal distribution's integral up to x. The error function is formula 7.1.26 of Abramowitz and Stegun's
/// handbook, off by at most 1.5e-7.
#[inline(always)]
fn gelu(x: f32) -> f32 {
    let z = x.abs() * std::f32::consts::FRAC_1_SQRT_2;
    let t = 1.0 / (1.0 + 0.327_591_1 * z);
    let p = 1.061_405_4 * t - 1.453_152;
    let p = p * t + 1.421_413_7;
    let p = p * t - 0.284_496_74;
    let p = p * t + 0.254_829_6;
    let rest = 0.5 * p * t * exp(-z * z);
    // The integral up to -|x| is `rest`.
    x * if x < 0.0 { rest } else { 1.0 - rest }
}

/// GELU of every value, after a bias.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub(super) fn biased_gelu(values: &mut [f32], bias: f32) {
    for v in values {
        *v = gelu(*v + bias);
    }
}

/// Scores of a head's tokens: `out[t][pixel]` = sum over the head's channels of `query[t][c] * keys[c][pixel]`.
/// `query` has `stride` values for each token, `keys` `pixels` for each channel.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub(super) fn head_scores(query: &[f32], stride: usize, keys: &[f32], pixels: usize, out: &mut [f32]) {
    for (query, out) in query.chunks(stride).zip(out.chunks_exact_mut(pixels)) {
        for from in (0..pixels).step_by(BLOCK) {
            let to = (from + BLOCK).min(pixels);
            let out = &mut out[from..to];
            out.fill(0.0);
            for (q, keys) in query.iter().zip(keys.chunks_exact(pixels)) {
                for (o, k) in out.iter_mut().zip(&keys[from..to]) {
                    *o += q * k;
                }
            }
        }
    }
}

/// Sum of `a[i] * b[i]`.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub(super) fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut lanes = [0.0f32; 64];
    let ((a, rest_a), (b, rest_b)) = (a.as_chunks::<64>(), b.as_chunks::<64>());
    for (a, b) in a.iter().zip(b) {
        for l in 0..64 {
            lanes[l] += a[l] * b[l];
        }
    }
    lanes.iter().sum::<f32>() + rest_a.iter().zip(rest_b).map(|(a, b)| a * b).sum::<f32>()
}

/// Softmax of each row of `[tiles][rows][width]`, over all its tiles.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub(super) fn softmax_rows(values: &mut [f32], rows: usize, width: usize) {
    for row in 0..rows {
        let mut most = [f32::NEG_INFINITY; 64];
        for block in values.chunks_exact(width).skip(row).step_by(rows).flat_map(|part| part.chunks(64)) {
            block.iter().zip(&mut most).for_each(|(v, m)| *m = m.max(*v));
        }
        let most = most.into_iter().fold(f32::NEG_INFINITY, f32::max);
        let mut sums = [0.0f32; 64];
        for part in values.chunks_exact_mut(width).skip(row).step_by(rows) {
            for block in part.chunks_mut(64) {
                for (v, sum) in block.iter_mut().zip(&mut sums) {
                    *v = exp(*v - most);
                    *sum += *v;
                }
            }
        }
        let scale = 1.0 / sums.iter().sum::<f32>();
        for part in values.chunks_exact_mut(width).skip(row).step_by(rows) {
            part.iter_mut().for_each(|v| *v *= scale);
        }
    }
}

/// Softmax over the tokens of a head, pixel by pixel: `scores[t][pixel] + shift[t]` becomes the weight of token t.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub(super) fn softmax_tokens(scores: &mut [f32], pixels: usize, shift: &[f32]) {
    let (mut most, mut sum) = ([0.0f32; BLOCK], [0.0f32; BLOCK]);
    for from in (0..pixels).step_by(BLOCK) {
        let to = (from + BLOCK).min(pixels);
        most.fill(f32::NEG_INFINITY);
        sum.fill(0.0);
        for (row, shift) in scores.chunks_exact(pixels).zip(shift) {
            for (m, s) in most.iter_mut().zip(&row[from..to]) {
                *m = m.max(*s + shift);
            }
        }
        for (row, shift) in scores.chunks_exact_mut(pixels).zip(shift) {
            for ((s, m), sum) in row[from..to].iter_mut().zip(&most).zip(&mut sum) {
                *s = exp(*s + shift - m);
                *sum += *s;
            }
        }
        sum.iter_mut().for_each(|s| *s = 1.0 / *s);
        for row in scores.chunks_exact_mut(pixels) {
            for (s, inverse) in row[from..to].iter_mut().zip(&sum) {
                *s *= inverse;
            }
        }
    }
}

/// A row of a 3 x 3 convolution of each channel by itself. `rows` are those above, at and below it, `[pixels + 2][channels]`; it has
/// every `step`-th pixel. `weights` `[3][3][channels]`.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub(super) fn depthwise(rows: [&[f32]; 3], step: usize, weights: &[f32], bias: &[f32], out: &mut [f32]) {
    const LANES: usize = 32;
    let channels = bias.len();
    for (u, out) in out.chunks_exact_mut(channels).enumerate() {
        let around = rows.map(|row| &row[u * step * channels..][..3 * channels]);
        for (i, out) in out.chunks_mut(LANES).enumerate() {
            let from = i * LANES;
            let mut sums = [0.0f32; LANES];
            if let Ok(out) = <&mut [f32; LANES]>::try_from(&mut *out) {
                sums.copy_from_slice(&bias[from..][..LANES]);
                for (y, row) in around.iter().enumerate() {
                    for x in 0..3 {
                        let pixel: &[f32; LANES] =
                            row[x * channels + from..].first_chunk().expect("a block of channels");
                        let weights =
                            weights[(3 * y + x) * channels + from..].first_chunk::<LANES>().expect("as many weights");
                        for l in 0..LANES {
                            sums[l] += pixel[l] * weights[l];
                        }
                    }
                }
                *out = sums;
            } else {
                for (c, out) in (from..).zip(out) {
                    let place = |i: usize| around[i / 3][i % 3 * channels + c] * weights[i * channels + c];
                    *out = bias[c] + (0..9).map(place).sum::<f32>();
                }
            }
        }
    }
}

/// Layer norm of every row, over its values.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub(super) fn norm_rows(values: &mut [f32], epsilon: f32, scale: &[f32], shift: &[f32]) {
    const LANES: usize = 32;
    let share = 1.0 / scale.len() as f32;
    for row in values.chunks_exact_mut(scale.len()) {
        let mut sums = [0.0f32; LANES];
        for block in row.chunks(LANES) {
            block.iter().zip(&mut sums).for_each(|(v, sum)| *sum += v);
        }
        let mean = sums.iter().sum::<f32>() * share;
        sums.fill(0.0);
        for block in row.chunks(LANES) {
            block.iter().zip(&mut sums).for_each(|(v, sum)| *sum += (v - mean) * (v - mean));
        }
        let inverse = 1.0 / (sums.iter().sum::<f32>() * share + epsilon).sqrt();
        for ((v, scale), shift) in row.iter_mut().zip(scale).zip(shift) {
            *v = (*v - mean) * inverse * scale + shift;
        }
    }
}

/// Layer norm over the channels of every pixel, after a bias per channel: `(x - mean) / deviation * scale + shift`.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
pub(super) fn norm(values: &mut [f32], pixels: usize, epsilon: f32, bias: &[f32], scale: &[f32], shift: &[f32]) {
    let share = 1.0 / bias.len() as f32;
    let (mut mean, mut inverse) = ([0.0f32; BLOCK], [0.0f32; BLOCK]);
    for from in (0..pixels).step_by(BLOCK) {
        let to = (from + BLOCK).min(pixels);
        mean.fill(0.0);
        for (row, bias) in values.chunks_exact_mut(pixels).zip(bias) {
            for (v, m) in row[from..to].iter_mut().zip(&mut mean) {
                *v += bias;
                *m += *v;
            }
        }
        mean.iter_mut().for_each(|m| *m *= share);
        inverse.fill(0.0);
        for row in values.chunks_exact(pixels) {
            for ((v, m), s) in row[from..to].iter().zip(&mean).zip(&mut inverse) {
                *s += (v - m) * (v - m);
            }
        }
        inverse.iter_mut().for_each(|s| *s = 1.0 / (*s * share + epsilon).sqrt());
        for ((row, scale), shift) in values.chunks_exact_mut(pixels).zip(scale).zip(shift) {
            for ((v, m), i) in row[from..to].iter_mut().zip(&mean).zip(&inverse) {
                *v = (*v - m) * i * scale + shift;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn exponential_and_gelu_keep_their_bounds() {
        for i in -8600..8700 {
            let x = i as f32 * 0.01;
            let want = f64::from(x).exp();
            assert!((f64::from(exp(x)) / want - 1.0).abs() < 2e-7, "{x}: {}", exp(x));
        }
        // Values of x Phi(x) from tables of the normal distribution.
        for (x, phi) in [(0.0, 0.5), (1.0, 0.841_344_7), (-1.0, 0.158_655_3), (2.5, 0.993_790_3), (-3.0, 0.001_349_9)] {
            assert!((gelu(x) - x * phi).abs() < 3e-7 * x.abs().max(1.0), "{x}: {}", gelu(x));
        }
        assert!(gelu(-40.0).abs() < 1e-30 && gelu(40.0) == 40.0);
    }

    #[test]
    fn rows_are_convolved_and_normalised_as_their_formulas_say() {
        // Whole blocks of channels and some more, with steps of one and of two.
        for (channels, step) in [(40, 1), (64, 2)] {
            let number = |i: usize| (i as f32 * 0.7).sin();
            let rows: Vec<Vec<f32>> = (0..3).map(|y| (0..7 * channels).map(|i| number(i + 31 * y)).collect()).collect();
            let (weights, bias): (Vec<f32>, Vec<f32>) =
                ((0..9 * channels).map(|i| number(i + 5)).collect(), (0..channels).map(number).collect());
            let width = 5usize.div_ceil(step);
            let mut out = vec![0.0; width * channels];
            depthwise([&rows[0], &rows[1], &rows[2]], step, &weights, &bias, &mut out);
            for (i, out) in out.iter().enumerate() {
                let (u, c) = (i / channels, i % channels);
                let one = |k: usize| rows[k / 3][(u * step + k % 3) * channels + c] * weights[k * channels + c];
                assert!((out - bias[c] - (0..9).map(one).sum::<f32>()).abs() < 1e-5);
            }
            let mut normed = out.clone();
            norm_rows(&mut normed, 0.0, &vec![2.0; channels], &vec![1.0; channels]);
            for row in normed.chunks_exact(channels) {
                let moment =
                    |power: i32| row.iter().map(|v| ((v - 1.0) / 2.0).powi(power)).sum::<f32>() / channels as f32;
                assert!(moment(1).abs() < 1e-5 && (moment(2) - 1.0).abs() < 1e-4);
            }
        }
    }

    #[test]
    fn softmax_over_pixels_and_over_tokens_agree() {
        let (tokens, pixels) = (3, 300);
        let scores: Vec<f32> = (0..tokens * pixels).map(|i| (i as f32 * 0.37).sin() * 20.0).collect();
        let mut by_pixel = scores.clone();
        softmax_tokens(&mut by_pixel, pixels, &[0.5, 0.0, -0.5]);
        for p in 0..pixels {
            let mut row: Vec<f32> = (0..tokens).map(|t| scores[t * pixels + p] + 0.5 - 0.5 * t as f32).collect();
            softmax_rows(&mut row, 1, tokens);
            for t in 0..tokens {
                assert!((row[t] - by_pixel[t * pixels + p]).abs() < 1e-6);
            }
        }
    }

    #[test]
    fn scores_sums_and_norms_are_those_of_their_formulas() {
        let pixels = 300;
        let keys: Vec<f32> = (0..2 * pixels).map(|i| (i as f32 * 0.1).cos()).collect();
        let mut out = vec![9.0; 2 * pixels];
        head_scores(&[1.0, 2.0, 7.0, -1.0, 0.5, 7.0], 3, &keys, pixels, &mut out);
        for p in 0..pixels {
            assert!((out[p] - (keys[p] + 2.0 * keys[pixels + p])).abs() < 1e-6);
            assert!((out[pixels + p] - (0.5 * keys[pixels + p] - keys[p])).abs() < 1e-6);
        }
        assert!((dot(&keys, &keys) - keys.iter().map(|k| k * k).sum::<f32>()).abs() < 1e-3);
        let mut values = keys.clone();
        norm(&mut values, pixels, 0.0, &[1.0, 0.0], &[1.0, 2.0], &[0.0, 3.0]);
        for p in 0..pixels {
            // Of two numbers the one is a deviation above the mean, the other one below.
            let sign = (keys[p] + 1.0 - keys[pixels + p]).signum();
            assert!((values[p] - sign).abs() < 1e-3 && (values[pixels + p] - (3.0 - 2.0 * sign)).abs() < 1e-3);
        }
    }
}
