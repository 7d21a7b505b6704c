//! The Gaussians that a page draws, as `gs_scene::splat::packing` has them (docs/explore.md), and the first band of their harmonics.

use gs_scene::Gaussians;
pub use gs_scene::splat::compressed_ply::CHUNK;
use gs_scene::splat::packing::{self, along_a_curve, fraction};
use rayon::prelude::*;

/// Numbers of a chunk: those of `packing`, and two for alignment.
pub const CHUNK_FLOATS: usize = packing::CHUNK_FLOATS + 2;
/// Fainter than this a Gaussian is never drawn.
const FAINTEST: f32 = 1.0 / 255.0;

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
    let seen: Vec<u32> = (0..g.len() as u32).filter(|&i| g.opacity(i as usize) >= FAINTEST).collect();
    let order = along_a_curve(g, &seen);
    let degree = degree.min(g.sh_degree);
    let packing::Packed { words, chunks } = packing::pack(g, &order);
    let aligned = |chunk: [f32; packing::CHUNK_FLOATS]| std::array::from_fn(|i| chunk.get(i).copied().unwrap_or(0.0));
    let band = |i: &u32| &g.sh_of(*i as usize)[3..12];
    let harmonics_range = match degree {
        0 => 0.0,
        _ => order.iter().flat_map(band).fold(0.0f32, |most, v| most.max(v.abs())),
    };
    let ten = |v: f32| fraction(v, -harmonics_range, harmonics_range, 1023);
    let three = |c: &[f32]| ten(c[0]) << 20 | ten(c[1]) << 10 | ten(c[2]);
    let harmonics = match degree {
        0 => Vec::new(),
        _ => order.par_iter().map(band).map(|b| [three(b), three(&b[3..]), three(&b[6..])]).collect(),
    };
    Packed { order, words, chunks: chunks.into_iter().map(aligned).collect(), harmonics, harmonics_range }
}

#[cfg(test)]
pub mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};

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
            g.opacity_logits.push(gs_scene::logit(opacity).min(50.0));
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
}
