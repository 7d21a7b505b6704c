//! Densification as sampling: dead Gaussians move onto opaque ones, the number grows by a share per round up to an exact
//! budget, noise explores, and opacity and size have a penalty (3DGS-MCMC, Kheradmand et al. 2024).

use super::rules::{Densify, Moment, Report};
use crate::training::checkpoint::{ScreenGradients, State};
use crate::training::optimiser::Adam;
use crate::training::schedule::{Purpose, drawn, generator};
use glam::{Quat, Vec3};
use gs_raster::Gradients;
use gs_scene::Gaussians;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use serde::Serialize;

/// Most copies that the correction of a relocation accounts for.
const MOST_COPIES: usize = 51;
/// Opacity that a relocation leaves at least.
const LEAST_OPACITY: f64 = 0.005;
/// Opacity that a relocation leaves at most.
const MOST_OPACITY: f64 = 1.0 - f32::EPSILON as f64;
/// Steepness of the noise's fall with opacity.
const NOISE_STEEPNESS: f32 = 100.0;
/// Opacity at which half the noise is left.
const NOISE_OPACITY: f32 = 0.005;
/// Noise below this share is not drawn: it would move a Gaussian by far less than its size.
const LEAST_NOISE: f32 = 1e-6;
/// Gaussians per piece of parallel work.
const CHUNK: usize = 2048;
/// The increment of SplitMix64 (Steele et al. 2014): its states can be jumped to.
const INCREMENT: u64 = 0x9e37_79b9_7f4a_7c15;

/// Hyper-parameters of the sampling.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Mcmc {
    /// Size of the noise on the centres, times their learning rate.
    pub noise: f32,
    /// Weight of the mean opacity in the loss.
    pub opacity_weight: f32,
    /// Weight of the mean scale in the loss.
    pub scale_weight: f32,
    /// Share by which the number grows per round.
    pub growth: f64,
    /// Gaussians up to this opacity are dead.
    pub dead_opacity: f32,
}

impl Default for Mcmc {
    fn default() -> Self {
        Self { noise: 5e5, opacity_weight: 0.01, scale_weight: 0.01, growth: 0.05, dead_opacity: 0.005 }
    }
}

impl Densify for Mcmc {
    /// Adds the gradients of the penalties on opacity and scale.
    fn regularise(&self, g: &Gaussians, d: &mut Gradients) {
        let n = g.len().max(1) as f32;
        let (opacity, scale) = (self.opacity_weight / n, self.scale_weight / (3.0 * n));
        let rows = d.opacity_logits.par_iter_mut().zip(&mut d.log_scales).with_min_len(CHUNK);
        rows.enumerate().for_each(|(i, (d_opacity, d_scales))| {
            let o = g.opacity(i);
            *d_opacity += opacity * o * (1.0 - o);
            for (d, s) in d_scales.iter_mut().zip(g.log_scales[i]) {
                *d += scale * s.exp();
            }
        });
    }

    fn explore(&self, gaussians: &mut Gaussians, rate: f32, at: Moment<'_>) {
        explore(gaussians, self, rate, at.seed, at.iteration);
    }

    fn round(&self, state: &mut State, at: Moment<'_>) -> Option<Report> {
        let mut rng = generator(at.seed, Purpose::Split, u64::from(at.iteration));
        let report = round(&mut state.gaussians, &mut state.adam, self, at.growth.max_gaussians, &mut rng);
        state.seen = ScreenGradients::new(state.gaussians.len());
        Some(report)
    }
}

/// One round: moves dead Gaussians onto others, then adds some, up to `most` in all. Both are drawn in proportion to
/// opacity, and what they land on is thinned so that the picture stays nearly the same.
fn round(g: &mut Gaussians, adam: &mut Adam, options: &Mcmc, most: usize, rng: &mut ChaCha8Rng) -> Report {
    let n = g.len();
    let alive = |g: &Gaussians, i: usize| g.opacity(i) > options.dead_opacity;
    let dead: Vec<u32> = (0..n as u32).filter(|&i| !alive(g, i as usize)).collect();
    let sources = draw(g, dead.len(), |i| alive(g, i), rng);
    let relocated = sources.len();
    if relocated > 0 {
        share(g, &sources);
        let mut from: Vec<u32> = (0..n as u32).collect();
        for (&to, &source) in dead.iter().zip(&sources) {
            from[to as usize] = source;
        }
        *g = g.select(&from);
        adam.forget(dead.iter().chain(&sources).copied());
    }

    let target = ((n as f64 * (1.0 + options.growth)).ceil() as usize).min(most);
    let sources = draw(g, target.saturating_sub(n), |_| true, rng);
    let cloned = sources.len();
    if cloned > 0 {
        share(g, &sources);
        adam.forget(sources.iter().copied());
        let all: Vec<u32> = (0..n as u32).chain(sources).collect();
        *g = g.select(&all);
        adam.select(&all, n);
    }
    Report { cloned, relocated, ..Report::default() }
}

/// `count` Gaussians among those that `may` be drawn, with replacement, in proportion to opacity; none where all are
/// transparent.
fn draw(g: &Gaussians, count: usize, may: impl Fn(usize) -> bool, rng: &mut ChaCha8Rng) -> Vec<u32> {
    let weights = (0..g.len()).map(|i| if may(i) { f64::from(g.opacity(i)) } else { 0.0 });
    drawn(weights, count, rng).into_iter().map(|i| i as u32).collect()
}

/// Makes each Gaussian in `sources` share its place with as many copies as it is named there.
fn share(g: &mut Gaussians, sources: &[u32]) {
    let mut copies = vec![0usize; g.len()];
    sources.iter().for_each(|&i| copies[i as usize] += 1);
    for (i, &copies) in copies.iter().enumerate().filter(|(_, c)| **c > 0) {
        let (opacity, scale) = thinned(f64::from(g.opacity(i)), copies + 1);
        g.opacity_logits[i] = (opacity / (1.0 - opacity)).ln() as f32;
        let shift = scale.ln() as f32;
        if shift.is_finite() {
            g.log_scales[i] = g.log_scales[i].map(|s| s + shift);
        }
    }
}

/// Opacity, and factor on the scale, of `n` coinciding Gaussians that together look like one of the given opacity: their
/// opacities compose to it, and the integral over a line through the centre stays (3DGS-MCMC, equation 9; its double sum
/// is one over binomials).
fn thinned(opacity: f64, n: usize) -> (f64, f64) {
    let n = n.min(MOST_COPIES);
    let each = 1.0 - (1.0 - opacity.min(MOST_OPACITY)).powf(1.0 / n as f64);
    let (mut sum, mut binomial, mut power) = (0.0, 1.0, -1.0);
    for k in 1..=n {
        binomial *= (n - k + 1) as f64 / k as f64;
        power *= -each;
        sum += binomial * power / (k as f64).sqrt();
    }
    (each.clamp(LEAST_OPACITY, MOST_OPACITY), opacity / sum)
}

/// Moves the centres by noise of the Gaussians' own shapes, all the more the fainter they are (3DGS-MCMC, equation 8).
/// `rate` is the centres' learning rate. The noise of a Gaussian depends on seed, iteration and its index alone.
fn explore(g: &mut Gaussians, options: &Mcmc, rate: f32, seed: u64, iteration: u32) {
    let key = mixed(seed ^ mixed(u64::from(iteration)));
    let (scales, rotations, opacities) = (&g.log_scales, &g.rotations, &g.opacity_logits);
    g.means.par_iter_mut().enumerate().with_min_len(CHUNK).for_each(|(i, mean)| {
        let opacity = 1.0 / (1.0 + (-opacities[i]).exp());
        let share = 1.0 / (1.0 + (NOISE_STEEPNESS * (opacity - NOISE_OPACITY)).exp());
        let [w, x, y, z] = rotations[i];
        let q = Quat::from_xyzw(x, y, z, w);
        if share < LEAST_NOISE || q.length_squared() == 0.0 {
            return;
        }
        let q = q.normalize();
        let variances = Vec3::from(scales[i].map(|s| (2.0 * s).exp()));
        let step = q * (variances * (q.inverse() * normals(key, i as u64)));
        let moved = Vec3::from(*mean) + share * options.noise * rate * step;
        if moved.is_finite() {
            *mean = moved.into();
        }
    });
}

/// Three draws from the standard normal distribution (Box and Muller 1958), number `index` of the sequence `key`.
fn normals(key: u64, index: u64) -> Vec3 {
    let uniforms = |k: u64| {
        let bits = mixed(key.wrapping_add((2 * index + k + 1).wrapping_mul(INCREMENT)));
        [(bits >> 40) as u32, (bits >> 8) as u32 & 0xff_ffff].map(|v| (v as f32 + 0.5) / 16_777_216.0)
    };
    let ([a, b], [c, d]) = (uniforms(0), uniforms(1));
    let (r, s) = ((-2.0 * a.ln()).sqrt(), (-2.0 * c.ln()).sqrt());
    let (sin, cos) = (std::f32::consts::TAU * b).sin_cos();
    Vec3::new(r * cos, r * sin, s * (std::f32::consts::TAU * d).cos())
}

/// The output function of SplitMix64 (Steele et al. 2014), for the state `z`.
fn mixed(z: u64) -> u64 {
    gs_io::mixed(z.wrapping_sub(INCREMENT))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::training::optimiser::zeros;
    use proptest::prelude::*;

    fn logit(o: f64) -> f32 {
        (o / (1.0 - o)).ln() as f32
    }

    /// Gaussians in a row with these opacities.
    fn row(opacities: &[f64]) -> Gaussians {
        let mut g = zeros(opacities.len(), 1);
        for (i, &o) in opacities.iter().enumerate() {
            g.means[i] = [i as f32, 0.0, 0.0];
            g.rotations[i] = [1.0, 0.0, 0.0, 0.0];
            g.log_scales[i] = [-1.0; 3];
            g.opacity_logits[i] = logit(o);
        }
        g
    }

    #[test]
    fn copies_look_like_the_one_they_replace() {
        for opacity in [0.01, 0.3, 0.9, 0.999] {
            for n in [1usize, 2, 3, 10, 51] {
                let (each, scale) = thinned(opacity, n);
                if each > LEAST_OPACITY {
                    assert!((1.0 - (1.0 - each).powi(n as i32) - opacity).abs() < 1e-9);
                    // Integrals of alpha over a line, by the midpoint rule.
                    let line = |alpha: &dyn Fn(f64) -> f64| {
                        (-40_000..40_000).map(|i| alpha(f64::from(i) * 1e-3 + 5e-4)).sum::<f64>()
                    };
                    let one = line(&|x| opacity * (-0.5 * x * x).exp());
                    let many = line(&|x| 1.0 - (1.0 - each * (-0.5 * (x / scale).powi(2)).exp()).powi(n as i32));
                    assert!((many / one - 1.0).abs() < 1e-6, "{opacity} {n}: {many} {one}");
                }
            }
        }
    }

    #[test]
    fn the_dead_move_to_the_living_and_the_budget_is_exact() {
        let mut opacities = vec![0.001; 40];
        opacities.extend([0.5; 59]);
        opacities.push(0.9);
        let mut g = row(&opacities);
        let mut adam = Adam::new(&g);
        adam.first.sh.fill(1.0);
        let options = Mcmc::default();
        let report = round(&mut g, &mut adam, &options, 103, &mut generator(1, Purpose::Split, 5));
        assert_eq!((report.relocated, report.cloned, g.len()), (40, 3, 103));
        assert!((0..g.len()).all(|i| g.opacity(i) >= 0.0049 && g.means[i][0] >= 40.0));
        assert!(g.check().is_ok() && adam.first.check().is_ok() && adam.first.len() == 103);
        // Only Gaussians without copies keep their moments.
        for i in 0..103 {
            let alone = (0..103).filter(|&j| g.means[j] == g.means[i]).count() == 1;
            assert_eq!(adam.first.sh_of(i)[0], f32::from(u8::from(alone)), "{i}");
        }
        for _ in 0..5 {
            round(&mut g, &mut adam, &options, 120, &mut generator(1, Purpose::Split, 6));
        }
        assert_eq!(g.len(), 120);
        let mut none = row(&[1e-9; 4]);
        none.opacity_logits.fill(f32::NEG_INFINITY);
        let mut adam = Adam::new(&none);
        assert_eq!(round(&mut none, &mut adam, &options, 9, &mut generator(1, Purpose::Split, 7)), Report::default());
    }

    #[test]
    fn noise_has_the_gaussians_shape_and_spares_opaque_ones() {
        let n = 40_000;
        let mut g = zeros(n + 1, 0);
        let half = 0.35f32;
        for i in 0..=n {
            g.log_scales[i] = [0.4, -1.0, -2.0];
            g.rotations[i] = [3.0 * half.cos(), 0.0, 0.0, 3.0 * half.sin()];
            g.opacity_logits[i] = logit(0.005);
        }
        g.opacity_logits[n] = 2.0;
        let options = Mcmc { noise: 10.0, ..Mcmc::default() };
        let start = g.clone();
        explore(&mut g, &options, 0.02, 3, 17);
        let spread = |axis: Vec3| {
            let along: Vec<f64> = g.means[..n].iter().map(|&m| f64::from(Vec3::from(m).dot(axis))).collect();
            let mean = along.iter().sum::<f64>() / n as f64;
            assert!(mean.abs() < 0.01);
            (along.iter().map(|a| a * a).sum::<f64>() / n as f64).sqrt()
        };
        // Half of noise times rate times the variance, at half the noise's opacity.
        let axis = Vec3::new((2.0 * half).cos(), (2.0 * half).sin(), 0.0);
        assert!((spread(axis) / (0.1 * 0.8f64.exp()) - 1.0).abs() < 0.02);
        assert!((spread(Vec3::Z) / (0.1 * (-4f64).exp()) - 1.0).abs() < 0.02);
        assert_eq!(g.means[n], start.means[n]);
        let draw = |seed, iteration| {
            let mut g = start.clone();
            explore(&mut g, &options, 0.02, seed, iteration);
            g.means
        };
        assert_eq!(draw(3, 17), g.means);
        assert!(draw(3, 18)[0] != g.means[0] && draw(4, 17)[0] != g.means[0]);
    }

    #[test]
    fn penalties_have_the_gradients_of_means() {
        let mut g = row(&[0.2, 0.7]);
        g.log_scales[1] = [0.1, -0.4, 0.9];
        let penalty = |g: &Gaussians| {
            let o: f64 = g.opacity_logits.iter().map(|&l| 1.0 / (1.0 + (-f64::from(l)).exp())).sum();
            let s: f64 = g.log_scales.iter().flatten().map(|&s| f64::from(s).exp()).sum();
            0.01 * o / 2.0 + 0.01 * s / 6.0
        };
        let mut d = Gradients { opacity_logits: vec![0.0; 2], log_scales: vec![[0.0; 3]; 2], ..Gradients::default() };
        Mcmc::default().regularise(&g, &mut d);
        let slope = |change: &dyn Fn(&mut Gaussians, f32)| {
            let (mut a, mut b) = (g.clone(), g.clone());
            change(&mut a, -0.01);
            change(&mut b, 0.01);
            (penalty(&b) - penalty(&a)) / 0.02
        };
        assert!((f64::from(d.opacity_logits[1]) / slope(&|g, h| g.opacity_logits[1] += h) - 1.0).abs() < 1e-3);
        assert!((f64::from(d.log_scales[1][2]) / slope(&|g, h| g.log_scales[1][2] += h) - 1.0).abs() < 1e-3);
    }

    proptest! {
        #[test]
        fn rounds_grow_by_their_share_and_stay_finite(
            opacities in prop::collection::vec(1e-6f64..0.9999, 1..80),
            most in 1usize..120,
            seed in 0u64..50,
        ) {
            let mut g = row(&opacities);
            let mut adam = Adam::new(&g);
            let n = g.len();
            round(&mut g, &mut adam, &Mcmc::default(), most, &mut generator(seed, Purpose::Split, 1));
            prop_assert_eq!(g.len(), ((n as f64 * 1.05).ceil() as usize).min(most).max(n));
            prop_assert!(g.opacity_logits.iter().chain(g.log_scales.as_flattened()).all(|v| v.is_finite()));
        }
    }
}
