//! Adam with a learning rate per kind of parameter.

use super::schedule::LearningRates;
use gs_raster::Gradients;
use gs_scene::{Gaussians, sh_coefficients};
use multiversion::multiversion;
use rayon::prelude::*;

/// Decay of the first moment.
const BETA1: f64 = 0.9;
/// Decay of the second moment.
const BETA2: f64 = 0.999;
/// Added to the denominator; 3DGS's choice, small because the parameters' gradients are.
const EPSILON: f32 = 1e-15;
/// Gradients beyond this would overflow the second moment.
const LARGEST_GRADIENT: f32 = 1e18;
/// Gaussians per piece of parallel work.
const CHUNK: usize = 2048;

/// Adam's state.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Adam {
    /// First moments, in the layout of the parameters.
    pub first: Gaussians,
    /// Second moments, in the layout of the parameters.
    pub second: Gaussians,
    pub steps: u64,
}

/// Gaussians whose every parameter is zero, such as moments before the first step.
pub fn zeros(count: usize, sh_degree: u8) -> Gaussians {
    Gaussians {
        means: vec![[0.0; 3]; count],
        log_scales: vec![[0.0; 3]; count],
        rotations: vec![[0.0; 4]; count],
        opacity_logits: vec![0.0; count],
        sh: vec![0.0; count * 3 * sh_coefficients(sh_degree)],
        sh_degree,
        ..Gaussians::default()
    }
}

/// The bias corrections of a step.
#[derive(Clone, Copy)]
struct Step {
    /// 1 / (1 - beta1^t).
    correction1: f32,
    /// 1 / sqrt(1 - beta2^t).
    correction2: f32,
    /// See [`LearningRates::selective`].
    selective: bool,
}

impl Adam {
    /// No steps yet.
    pub fn new(gaussians: &Gaussians) -> Self {
        let zero = || zeros(gaussians.len(), gaussians.sh_degree);
        Self { first: zero(), second: zero(), steps: 0 }
    }

    /// Updates the parameters by one step (Kingma and Ba 2015, with bias correction by the number of steps). `centres` is the
    /// rate of the centres, world units; 0 freezes them. Spherical harmonics above `active_degree` have neither gradient nor
    /// moments yet and stay as they are.
    pub fn step(&mut self, g: &mut Gaussians, d: &Gradients, centres: f32, rates: &LearningRates, active_degree: u8) {
        assert!(d.means.len() == g.len() && d.sh.len() == g.sh.len() && self.first.len() == g.len());
        self.steps += 1;
        let t = i32::try_from(self.steps).unwrap_or(i32::MAX);
        let step = Step {
            correction1: (1.0 / (1.0 - BETA1.powi(t))) as f32,
            correction2: (1.0 / (1.0 - BETA2.powi(t)).sqrt()) as f32,
            selective: rates.selective,
        };
        let (m, v) = (&mut self.first, &mut self.second);
        // Rows of `stride` values, the first `rate.len()` of which move.
        let rows = |p: &mut [f32], m: &mut [f32], v: &mut [f32], d: &[f32], rate: &[f32], stride: usize| {
            if rate.iter().all(|&r| r == 0.0) {
                return;
            }
            let size = CHUNK * stride;
            let moments = m.par_chunks_mut(size).zip(v.par_chunks_mut(size));
            let all = p.par_chunks_mut(size).zip(moments).zip(d.par_chunks(size));
            all.for_each(|((p, (m, v)), d)| match rate.len() == stride && rate.iter().all(|&r| r == rate[0]) {
                true => update_flat(p, m, v, d, rate[0], step),
                false => update_rows(p, m, v, d, rate, stride, step),
            });
        };
        macro_rules! group {
            ($field:ident, $width:literal, $rate:expr) => {
                rows(
                    g.$field.as_flattened_mut(),
                    m.$field.as_flattened_mut(),
                    v.$field.as_flattened_mut(),
                    d.$field.as_flattened(),
                    &[$rate; $width],
                    $width,
                )
            };
        }
        group!(means, 3, centres);
        group!(log_scales, 3, rates.scaling as f32);
        group!(rotations, 4, rates.rotation as f32);
        let opacity = (&mut m.opacity_logits, &mut v.opacity_logits);
        rows(&mut g.opacity_logits, opacity.0, opacity.1, &d.opacity_logits, &[rates.opacity as f32], 1);

        let stride = g.sh_stride();
        let mut rate = vec![(rates.feature / 20.0) as f32; 3 * sh_coefficients(active_degree.min(g.sh_degree))];
        rate[..3].fill(rates.feature as f32);
        rows(&mut g.sh, &mut m.sh, &mut v.sh, &d.sh, &rate, stride);
    }

    /// Keeps the moments of the Gaussians at `sources`, in that order; from position `fresh` on they start from zero.
    pub fn select(&mut self, sources: &[u32], fresh: usize) {
        for moments in [&mut self.first, &mut self.second] {
            *moments = moments.select(sources);
        }
        self.forget(fresh as u32..sources.len() as u32);
    }

    /// Forgets the moments of some Gaussians, for when they are set to something else.
    pub fn forget(&mut self, gaussians: impl Iterator<Item = u32> + Clone) {
        for moments in [&mut self.first, &mut self.second] {
            let stride = moments.sh_stride();
            for i in gaussians.clone() {
                let i = i as usize;
                moments.means[i] = [0.0; 3];
                moments.log_scales[i] = [0.0; 3];
                moments.rotations[i] = [0.0; 4];
                moments.opacity_logits[i] = 0.0;
                moments.sh[i * stride..(i + 1) * stride].fill(0.0);
            }
        }
    }
}

#[inline(always)]
fn update_one(p: &mut f32, m: &mut f32, v: &mut f32, d: f32, rate: f32, s: Step) {
    const B1: f32 = BETA1 as f32;
    const B2: f32 = BETA2 as f32;
    let first = B1 * *m + (1.0 - BETA1) as f32 * d;
    let second = B2 * *v + (1.0 - BETA2) as f32 * d * d;
    let moved = *p - rate * s.correction1 * first / (second.sqrt() * s.correction2 + EPSILON);
    // Chosen without a branch, for SIMD.
    let stays = s.selective && d == 0.0;
    *m = if stays { *m } else { first };
    *v = if stays { *v } else { second };
    *p = if stays { *p } else { moved };
}

#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
fn update_flat(p: &mut [f32], m: &mut [f32], v: &mut [f32], d: &[f32], rate: f32, s: Step) {
    for (((p, m), v), &d) in p.iter_mut().zip(m).zip(v).zip(d) {
        update_one(p, m, v, d, rate, s);
    }
}

/// Updates the first `rates.len()` values of each row of `stride` values.
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2"))]
fn update_rows(p: &mut [f32], m: &mut [f32], v: &mut [f32], d: &[f32], rates: &[f32], stride: usize, s: Step) {
    let rows = p.chunks_exact_mut(stride).zip(m.chunks_exact_mut(stride)).zip(v.chunks_exact_mut(stride));
    for (((p, m), v), d) in rows.zip(d.chunks_exact(stride)) {
        for ((((p, m), v), &d), &rate) in p.iter_mut().zip(m).zip(v).zip(d).zip(rates) {
            update_one(p, m, v, d, rate, s);
        }
    }
}

/// Sets the gradients of every Gaussian that has a gradient which is not finite (or absurdly large) to zero, and gives
/// the number of such Gaussians: such a value must not enter a parameter or a moment.
pub fn drop_bad_gradients(d: &mut Gradients) -> u64 {
    let n = d.means.len();
    let stride = d.sh.len() / n.max(1);
    let seen = &*d;
    let bad = |values: &[f32]| !values.iter().fold(true, |ok, v| ok & (v.abs() < LARGEST_GRADIENT));
    // Whether any of the Gaussians a to b has one.
    let any = |a: usize, b: usize| {
        bad(seen.means[a..b].as_flattened())
            || bad(seen.log_scales[a..b].as_flattened())
            || bad(seen.rotations[a..b].as_flattened())
            || bad(&seen.opacity_logits[a..b])
            || bad(&seen.sh[a * stride..b * stride])
            || bad(seen.mean2d[a..b].as_flattened())
    };
    let of_chunk = |c: usize| {
        let (a, b) = (c * CHUNK, ((c + 1) * CHUNK).min(n));
        if any(a, b) { (a..b).filter(|&i| any(i, i + 1)).collect() } else { Vec::new() }
    };
    let chunks: Vec<Vec<usize>> = (0..n.div_ceil(CHUNK)).into_par_iter().map(of_chunk).collect();
    let mut dropped = 0;
    for i in chunks.into_iter().flatten() {
        d.means[i] = [0.0; 3];
        d.log_scales[i] = [0.0; 3];
        d.rotations[i] = [0.0; 4];
        d.opacity_logits[i] = 0.0;
        d.sh[i * stride..(i + 1) * stride].fill(0.0);
        d.mean2d[i] = [0.0; 2];
        dropped += 1;
    }
    dropped
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rates(rate: f64) -> LearningRates {
        LearningRates { feature: rate, opacity: rate, scaling: rate, rotation: rate, ..LearningRates::default() }
    }

    fn gradients(n: usize, stride: usize, value: impl Fn(usize) -> f32) -> Gradients {
        Gradients {
            means: (0..n).map(|i| [value(i), -value(i), 0.0]).collect(),
            log_scales: vec![[value(0); 3]; n],
            rotations: vec![[value(0); 4]; n],
            opacity_logits: (0..n).map(&value).collect(),
            sh: (0..n * stride).map(|i| value(i / stride)).collect(),
            mean2d: vec![[0.0; 2]; n],
            overflowed: 0,
        }
    }

    /// Adam by the paper, in f64.
    fn oracle(gradients: &[f64], rate: f64) -> f64 {
        let (mut m, mut v, mut p) = (0.0, 0.0, 0.0);
        for (t, g) in gradients.iter().enumerate() {
            m = 0.9 * m + 0.1 * g;
            v = 0.999 * v + 0.001 * g * g;
            let t = t as i32 + 1;
            p -= rate * (m / (1.0 - 0.9f64.powi(t))) / ((v / (1.0 - 0.999f64.powi(t))).sqrt() + 1e-15);
        }
        p
    }

    #[test]
    fn steps_are_those_of_the_paper() {
        for degree in 0..=3 {
            let n = CHUNK + 3;
            let mut g = zeros(n, degree);
            let mut adam = Adam::new(&g);
            let sequence = [0.5, -0.25, 3.0, 1e-9, 0.7];
            for s in sequence {
                let d = gradients(n, g.sh_stride(), |i| s * (i + 1) as f32);
                adam.step(&mut g, &d, 0.01, &rates(0.01), degree);
            }
            for i in [0, 1, n - 1] {
                let own: Vec<f64> = sequence.iter().map(|&s| f64::from(s) * (i + 1) as f64).collect();
                let close = |a: f32, b: f64| (f64::from(a) - b).abs() < 1e-5 * b.abs();
                assert!(close(g.means[i][0], oracle(&own, 0.01)) && close(g.means[i][1], -oracle(&own, 0.01)));
                assert_eq!(g.means[i][2], 0.0, "no gradient, no step");
                assert!(close(g.opacity_logits[i], oracle(&own, 0.01)));
                let sh = g.sh_of(i);
                assert!(close(sh[2], oracle(&own, 0.01)));
                assert!(sh[3..].iter().all(|&v| close(v, oracle(&own, 0.0005))));
            }
        }
    }

    #[test]
    fn without_a_gradient_a_parameter_stays_or_follows_its_moments() {
        let after = |selective: bool| {
            let mut g = zeros(2, 1);
            let mut adam = Adam::new(&g);
            let rates = LearningRates { selective, ..rates(0.1) };
            adam.step(&mut g, &gradients(2, 12, |_| 1.0), 0.1, &rates, 1);
            let before = (g.clone(), adam.first.clone(), adam.second.clone());
            adam.step(&mut g, &gradients(2, 12, |i| i as f32), 0.1, &rates, 1);
            (before, (g, adam.first, adam.second))
        };
        let (before, now) = after(true);
        let of_first = |all: &(Gaussians, Gaussians, Gaussians)| [&all.0, &all.1, &all.2].map(|g| g.select(&[0]));
        assert_eq!(of_first(&now), of_first(&before), "no gradient");
        assert!(now.0.means[1][0] < before.0.means[1][0] && now.0.sh_of(1)[11] < before.0.sh_of(1)[11]);
        let (before, now) = after(false);
        assert!(now.0.means[0][0] < before.0.means[0][0] && now.1.means[0][0] < before.1.means[0][0]);
    }

    #[test]
    fn a_rate_of_zero_and_inactive_bands_stay() {
        let mut g = zeros(5, 3);
        let mut adam = Adam::new(&g);
        let d = gradients(5, g.sh_stride(), |_| 1.0);
        adam.step(&mut g, &d, 0.0, &rates(0.1), 1);
        assert!(g.means.iter().flatten().all(|&v| v == 0.0));
        assert!(g.sh_of(4)[..12].iter().all(|&v| v < 0.0) && g.sh_of(4)[12..].iter().all(|&v| v == 0.0));
    }

    #[test]
    fn bad_gradients_are_dropped_and_counted() {
        let n = CHUNK + 2;
        let mut d = gradients(n, 12, |_| 1.0);
        d.means[1][2] = f32::NAN;
        d.sh[12 * (n - 1) + 7] = f32::INFINITY;
        d.mean2d[5][0] = f32::NEG_INFINITY;
        d.opacity_logits[5] = 1e30;
        assert_eq!(drop_bad_gradients(&mut d), 3);
        assert_eq!((d.means[1], d.opacity_logits[5], d.mean2d[5]), ([0.0; 3], 0.0, [0.0; 2]));
        assert_eq!((d.sh[12 * (n - 1)], d.means[0][0]), (0.0, 1.0));
        assert_eq!(drop_bad_gradients(&mut d), 0);
        assert_eq!(drop_bad_gradients(&mut Gradients::default()), 0);
    }

    #[test]
    fn selected_moments_follow_their_gaussians() {
        let mut g = zeros(3, 1);
        let mut adam = Adam::new(&g);
        adam.step(&mut g, &gradients(3, 12, |i| i as f32), 0.1, &rates(0.1), 1);
        let before = adam.first.clone();
        adam.select(&[2, 0, 2], 2);
        assert_eq!(adam.first.means[0], before.means[2]);
        assert_eq!(adam.first.sh_of(1), before.sh_of(0));
        assert_eq!(adam.first.sh_of(2), [0.0; 12]);
        assert!(adam.first.check().is_ok() && adam.second.check().is_ok());
    }
}
