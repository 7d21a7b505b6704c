//! Gaussians in 16 bytes each, for a page: the layout of PlayCanvas's compressed PLY (docs/explore.md). Gaussians that are
//! near each other lie together, 256 to a chunk, and each number is a fraction of its chunk's range.

use gs_scene::Gaussians;
use rayon::prelude::*;

/// Gaussians of a chunk.
pub const CHUNK: usize = 256;
/// Numbers of a chunk: least and most of position, logarithm of scale and colour, xyz each; two are for alignment.
pub const CHUNK_FLOATS: usize = 20;
/// Fainter than this a Gaussian is never drawn.
const FAINTEST: f32 = 1.0 / 255.0;
/// Logarithms of scales beyond this are cut.
const LARGEST_LOG_SCALE: f32 = 20.0;

/// The Gaussians of a scene as the page gets them; n of N.
pub struct Packed {
    /// Index in the geometry of each, n.
    pub order: Vec<u32>,
    /// Position 11-10-11 bits, rotation 2-10-10-10, scale 11-10-11, colour and opacity 8-8-8-8; n.
    pub words: Vec<[u32; 4]>,
    /// Ranges of the chunks, `ceil(n / 256)`: least xyz, most xyz of position, then of scale, then of colour.
    pub chunks: Vec<[f32; CHUNK_FLOATS]>,
    /// The first band of harmonics, three words of three 10-bit numbers each (word = coefficient y z x, number = rgb); n, or
    /// none where the page draws no band.
    pub harmonics: Vec<[u32; 3]>,
    /// Largest coefficient of that band: the 10-bit numbers are fractions of -this to this.
    pub harmonics_range: f32,
}

/// Packs what is ever drawn. `degree` is 0 or 1.
pub fn pack(g: &Gaussians, degree: u8) -> Packed {
    let order = nearby(g);
    let degree = degree.min(g.sh_degree);
    let chunks: Vec<[f32; CHUNK_FLOATS]> = order.par_chunks(CHUNK).map(|some| ranges(g, some)).collect();
    let words: Vec<[u32; 4]> =
        order.par_iter().enumerate().map(|(at, &i)| words_of(g, i as usize, &chunks[at / CHUNK])).collect();
    let band = |i: &u32| &g.sh_of(*i as usize)[3..12];
    let harmonics_range = match degree {
        0 => 0.0,
        _ => order.iter().flat_map(band).fold(0.0f32, |most, v| most.max(v.abs())),
    };
    let ten = |v: f32| fraction(v, -harmonics_range, harmonics_range, 1023);
    let three = |c: &[f32]| ten(c[0]) << 20 | ten(c[1]) << 10 | ten(c[2]);
    let harmonics = match degree {
        0 => Vec::new(),
        _ => order.iter().map(band).map(|b| [three(b), three(&b[3..]), three(&b[6..])]).collect(),
    };
    Packed { order, words, chunks, harmonics, harmonics_range }
}

/// The Gaussians that can be seen, along a curve that keeps neighbours together (Morton's).
fn nearby(g: &Gaussians) -> Vec<u32> {
    let seen: Vec<u32> = (0..g.len() as u32).filter(|&i| g.opacity(i as usize) >= FAINTEST).collect();
    // A few floaters far away must not take all the resolution.
    let bounds = [0, 1, 2].map(|k| {
        let mut along: Vec<f32> = seen.iter().map(|&i| g.means[i as usize][k]).collect();
        along.sort_unstable_by(f32::total_cmp);
        let at = |share: usize| along.get(along.len().saturating_sub(1) * share / 100).copied().unwrap_or(0.0);
        (at(1), at(99))
    });
    let key = |&i: &u32| {
        let cells =
            [0, 1, 2].map(|k| u64::from(fraction(g.means[i as usize][k], bounds[k].0, bounds[k].1, (1 << 20) - 1)));
        (0..20).fold(0u64, |key, bit| (0..3).fold(key, |key, k| key | (cells[k] >> bit & 1) << (3 * bit + k)))
    };
    let mut keyed: Vec<(u64, u32)> = seen.par_iter().map(|i| (key(i), *i)).collect();
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
fn fraction(v: f32, low: f32, high: f32, most: u32) -> u32 {
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

/// A quaternion w x y z by its three smaller parts, of the sign that makes the largest positive.
fn rotation(q: [f32; 4]) -> u32 {
    let norm = q.iter().map(|v| v * v).sum::<f32>().sqrt();
    let largest = (0..4).max_by(|&a, &b| q[a].abs().total_cmp(&q[b].abs()).then(b.cmp(&a))).unwrap_or(0);
    let sign = if q[largest] < 0.0 { -norm } else { norm };
    let most = std::f32::consts::FRAC_1_SQRT_2;
    let part = |k: usize| fraction(q[k] / sign, -most, most, 1023);
    (0..4).filter(|&k| k != largest).fold(largest as u32, |word, k| word << 10 | part(k))
}

#[cfg(test)]
pub mod tests {
    use super::*;
    use rand::{Rng, SeedableRng};

    /// What a page reads: the inverse of [`pack`], written out plainly.
    pub fn unpack(p: &Packed) -> Gaussians {
        let mut g = Gaussians { sh_degree: u8::from(!p.harmonics.is_empty()), ..Gaussians::default() };
        for (at, &[position, rotation, scale, color]) in p.words.iter().enumerate() {
            let chunk = p.chunks[at / CHUNK];
            let from = |v: [u32; 3], most: [f32; 3], group: usize| {
                [0, 1, 2].map(|k| {
                    let (low, high) = (chunk[6 * group + k], chunk[6 * group + 3 + k]);
                    low + v[k] as f32 / most[k] * (high - low)
                })
            };
            let three = |w: u32| [w >> 21, w >> 11 & 1023, w & 2047];
            g.means.push(from(three(position), [2047.0, 1023.0, 2047.0], 0));
            g.log_scales.push(from(three(scale), [2047.0, 1023.0, 2047.0], 1));
            let small = [20, 10, 0].map(|s| ((rotation >> s & 1023) as f32 / 1023.0 * 2.0 - 1.0) / 2f32.sqrt());
            let mut q = small.to_vec();
            q.insert((rotation >> 30) as usize, (1.0 - small.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt());
            g.rotations.push([q[0], q[1], q[2], q[3]]);
            let opacity = (color & 255) as f32 / 255.0;
            g.opacity_logits.push((opacity / (1.0 - opacity)).ln().min(50.0));
            let rgb = from([color >> 24, color >> 16 & 255, color >> 8 & 255], [255.0; 3], 2);
            g.sh.extend(rgb.map(|c| (c - 0.5) / gs_scene::SH_C0));
            for word in p.harmonics.get(at).into_iter().flatten() {
                g.sh.extend([20, 10, 0].map(|s| ((word >> s & 1023) as f32 / 1023.0 * 2.0 - 1.0) * p.harmonics_range));
            }
        }
        g
    }

    /// A cloud with all that is awkward: floaters, invisible ones, needles.
    pub fn cloud(n: usize) -> Gaussians {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(3);
        let mut g = Gaussians { sh_degree: 1, ..Gaussians::default() };
        for i in 0..n {
            let far = if i % 97 == 0 { 1000.0 } else { 1.0 };
            g.means.push([(); 3].map(|()| random.random_range(-1.0f32..1.0) * far));
            g.log_scales.push([(); 3].map(|()| random.random_range(-6.0f32..-2.0)));
            g.rotations.push([(); 4].map(|()| random.random_range(-1.0f32..1.0)));
            g.opacity_logits.push(if i % 10 == 3 { -20.0 } else { random.random_range(-2.0f32..4.0) });
            g.sh.extend((0..12).map(|_| random.random_range(-0.5f32..0.5)));
        }
        g
    }

    #[test]
    fn what_is_packed_reads_back_within_a_step() {
        let g = cloud(3000);
        for degree in [0, 1] {
            let p = pack(&g, degree);
            assert_eq!(p.order.len(), 2700, "what is never drawn is left out");
            let mut once = p.order.clone();
            once.sort_unstable();
            once.dedup();
            assert_eq!(once.len(), 2700);
            let back = unpack(&p);
            for (at, &i) in p.order.iter().enumerate() {
                let (i, chunk) = (i as usize, p.chunks[at / CHUNK]);
                for k in 0..3 {
                    let step = |group: usize, most: f32| (chunk[6 * group + 3 + k] - chunk[6 * group + k]) / most;
                    assert!((back.means[at][k] - g.means[i][k]).abs() <= 0.51 * step(0, 1023.0) + 1e-4);
                    assert!((back.log_scales[at][k] - g.log_scales[i][k]).abs() <= 0.51 * step(1, 1023.0) + 1e-5);
                    assert!((back.base_color(at)[k] - g.base_color(i)[k]).abs() <= 0.51 * step(2, 255.0) + 1e-5);
                }
                let norm = g.rotations[i].iter().map(|v| v * v).sum::<f32>().sqrt();
                let dot: f32 = (0..4).map(|k| back.rotations[at][k] * g.rotations[i][k] / norm).sum();
                assert!(dot.abs() > 1.0 - 3e-6, "{dot}");
                assert!((back.opacity(at) - g.opacity(i)).abs() < 0.002);
                if degree == 1 {
                    for k in 0..9 {
                        assert!((back.sh_of(at)[3 + k] - g.sh_of(i)[3 + k]).abs() <= p.harmonics_range / 1000.0);
                    }
                }
            }
        }
    }

    #[test]
    fn nothing_packs_to_nothing() {
        let p = pack(&Gaussians::default(), 1);
        assert!(p.order.is_empty() && p.words.is_empty() && p.chunks.is_empty());
    }

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
