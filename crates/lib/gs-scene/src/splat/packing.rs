//! Gaussians in 16 bytes each, as PlayCanvas's compressed PLY and the page of `explore` have them.

use super::compressed_ply::CHUNK;
use crate::Gaussians;
use rayon::prelude::*;

/// Numbers of a chunk: least xyz and most xyz of position, then of the logarithm of scale, then of colour.
pub const CHUNK_FLOATS: usize = 18;
/// Logarithms of scales beyond this are cut.
const LARGEST_LOG_SCALE: f32 = 20.0;

/// Packed Gaussians.
pub struct Packed {
    /// Position 11-10-11 bits, rotation 2-10-10-10, scale 11-10-11, colour and opacity 8-8-8-8.
    pub words: Vec<[u32; 4]>,
    /// The ranges of each chunk of 256.
    pub chunks: Vec<[f32; CHUNK_FLOATS]>,
}

/// Packs the Gaussians of `order`, one after the other. The nearer the 256 of a chunk are to each other, the finer its steps.
pub fn pack(g: &Gaussians, order: &[u32]) -> Packed {
    let chunks: Vec<_> = order.par_chunks(CHUNK).map(|some| ranges(g, some)).collect();
    let words = order.par_iter().enumerate().map(|(at, &i)| words_of(g, i as usize, &chunks[at / CHUNK])).collect();
    Packed { words, chunks }
}

/// Puts Gaussians along a curve that keeps neighbours together (Morton's).
pub fn along_a_curve(g: &Gaussians, some: &[u32]) -> Vec<u32> {
    // A few floaters far away must not take all the resolution.
    let bounds = [0, 1, 2].map(|k| {
        let mut along: Vec<f32> = some.iter().map(|&i| g.means[i as usize][k]).collect();
        along.sort_unstable_by(f32::total_cmp);
        let at = |share: usize| along.get(along.len().saturating_sub(1) * share / 100).copied().unwrap_or(0.0);
        (at(1), at(99))
    });
    let key = |&i: &u32| {
        let cells =
            [0, 1, 2].map(|k| u64::from(fraction(g.means[i as usize][k], bounds[k].0, bounds[k].1, (1 << 20) - 1)));
        (0..20).fold(0u64, |key, bit| (0..3).fold(key, |key, k| key | (cells[k] >> bit & 1) << (3 * bit + k)))
    };
    let mut keyed: Vec<(u64, u32)> = some.par_iter().map(|i| (key(i), *i)).collect();
    keyed.par_sort_unstable();
    keyed.into_iter().map(|(_, i)| i).collect()
}

/// Position, logarithm of scale and colour of a Gaussian.
fn numbers(g: &Gaussians, i: usize) -> [[f32; 3]; 3] {
    let scale = g.log_scales[i].map(|s| s.clamp(-LARGEST_LOG_SCALE, LARGEST_LOG_SCALE));
    [g.means[i], scale, g.base_color(i)]
}

fn ranges(g: &Gaussians, some: &[u32]) -> [f32; CHUNK_FLOATS] {
    let mut out = [0.0; CHUNK_FLOATS];
    for group in 0..3 {
        for k in 0..3 {
            let values = || some.iter().map(|&i| numbers(g, i as usize)[group][k]);
            out[6 * group + k] = values().fold(f32::INFINITY, f32::min);
            out[6 * group + 3 + k] = values().fold(f32::NEG_INFINITY, f32::max);
        }
    }
    out
}

/// Where `v` lies between `low` and `high`, in steps of 0 to `most`.
pub fn fraction(v: f32, low: f32, high: f32, most: u32) -> u32 {
    let range = f64::from(high) - f64::from(low);
    let share = if range > 0.0 { (f64::from(v) - f64::from(low)) / range } else { 0.0 };
    (share.clamp(0.0, 1.0) * f64::from(most)).round() as u32
}

fn words_of(g: &Gaussians, i: usize, chunk: &[f32; CHUNK_FLOATS]) -> [u32; 4] {
    let [position, scale, color] = numbers(g, i);
    let within = |v: [f32; 3], group: usize, most: [u32; 3]| {
        [0, 1, 2].map(|k| fraction(v[k], chunk[6 * group + k], chunk[6 * group + 3 + k], most[k]))
    };
    let three = |[x, y, z]: [u32; 3]| x << 21 | y << 11 | z;
    let [r, green, b] = within(color, 2, [255; 3]);
    let opacity = fraction(g.opacity(i), 0.0, 1.0, 255);
    [
        three(within(position, 0, [2047, 1023, 2047])),
        rotation(g.rotations[i]),
        three(within(scale, 1, [2047, 1023, 2047])),
        r << 24 | green << 16 | b << 8 | opacity,
    ]
}

/// A quaternion's largest part, and the three smaller ones at length 1 with the sign that makes the largest positive. Of length
/// zero it is that of no rotation.
pub(crate) fn smallest_three(q: [f32; 4]) -> (usize, [f32; 3]) {
    let norm = q.iter().map(|v| v * v).sum::<f32>().sqrt();
    let largest = (0..4).max_by(|&a, &b| q[a].abs().total_cmp(&q[b].abs()).then(b.cmp(&a))).unwrap_or(0);
    let unit = if norm > 0.0 { 1.0 / norm } else { 0.0 };
    let sign = if q[largest] < 0.0 { -unit } else { unit };
    (largest, std::array::from_fn(|k| q[if k < largest { k } else { k + 1 }] * sign))
}

/// A quaternion w x y z by its three smaller parts, of the sign that makes the largest positive.
fn rotation(q: [f32; 4]) -> u32 {
    let most = std::f32::consts::FRAC_1_SQRT_2;
    let (largest, small) = smallest_three(q);
    small.into_iter().fold(largest as u32, |word, v| word << 10 | fraction(v, -most, most, 1023))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_largest_part_of_a_rotation_may_be_any() {
        for q in [[1.0, 0.0, 0.0, 0.0], [0.0, -2.0, 0.0, 0.0], [0.5, 0.5, -0.5, 0.5], [0.1, 0.2, 0.3, -0.9]] {
            let word = rotation(q);
            let small = [20, 10, 0].map(|s| ((word >> s & 1023) as f32 / 1023.0 * 2.0 - 1.0) / 2f32.sqrt());
            let mut back = small.to_vec();
            back.insert((word >> 30) as usize, (1.0 - small.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt());
            let norm = q.iter().map(|v: &f32| v * v).sum::<f32>().sqrt();
            let dot: f32 = (0..4).map(|k| back[k] * q[k] / norm).sum();
            assert!(dot.abs() > 0.99999, "{q:?} {back:?}");
        }
    }
}
