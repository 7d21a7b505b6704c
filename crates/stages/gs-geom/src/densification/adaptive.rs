//! Adaptive density control: Gaussians whose projected centre has a large gradient are cloned (small ones) or split (large
//! ones); faint ones are removed, on request huge ones too (Kerbl et al. 2023, section 5.2).

use super::rules::{Densify, Moment, Report};
use crate::training::checkpoint::{ScreenGradients, State};
use crate::training::optimiser::Adam;
use crate::training::schedule::{Purpose, generator};
use glam::{Quat, Vec3};
use gs_raster::Workspace;
use gs_scene::{Camera, Gaussians, logit};
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

/// The halves of a split Gaussian are smaller by this factor.
const SPLIT_SHRINK: f32 = 1.6;
/// Opacity that a reset leaves at most.
const RESET_OPACITY: f32 = 0.01;
/// From this divisor of the picture size on, gradients say nothing about where Gaussians are missing.
const TOO_COARSE: u32 = 4;

/// Hyper-parameters of adaptive density control.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Adaptive {
    /// Mean length of d loss / d projected centre, in units of half the picture's width and height, above which a
    /// Gaussian is cloned or split.
    pub gradient: f32,
    /// Fainter Gaussians are removed.
    pub min_opacity: f32,
    /// Gaussians up to this share of the scene's extent are cloned, larger ones split.
    pub clone_scale: f32,
    /// Gaussians beyond this share of the scene's extent are removed after the first reset of opacities, if there is one.
    /// 3DGS has 0.1; here there is none, because that tears holes into plain walls and tables (docs/geometry.md).
    pub max_scale: Option<f32>,
    /// The halves of a split Gaussian lie within so many of its standard deviations along each of its axes. 3DGS draws them
    /// anywhere; a half far from the surface may hang as haze before a camera (docs/results/geometry.md).
    pub split_reach: Option<f32>,
    /// Iterations between opacity resets; 0 for none. Short runs keep the period of 3DGS: they have no time to recover from
    /// one.
    pub reset_every: u32,
}

impl Adaptive {
    /// Whether views count at this iteration: before the end of densification, and not with small pictures. Their gradients
    /// come from blur and hide what is missing: to wait cost nothing and gave up to 0.4 dB.
    fn observes(at: Moment<'_>) -> bool {
        at.iteration < at.growth.until && at.schedule.divisor(at.iteration) < TOO_COARSE
    }

    /// Clones, splits and removes; afterwards nothing is seen. New Gaussians follow the old ones and have no moments.
    pub fn densify(&self, state: &mut State, max_gaussians: usize, extent: f32, rng: &mut ChaCha8Rng) -> Report {
        let State { gaussians: g, adam, seen, .. } = state;
        let n = g.len();
        let mut chosen: Vec<u32> = (0..n as u32).filter(|&i| seen.mean(i as usize) >= self.gradient).collect();
        // Each adds one. Too many: the largest gradients, the first among equals.
        chosen.sort_by(|&a, &b| seen.mean(b as usize).total_cmp(&seen.mean(a as usize)).then(a.cmp(&b)));
        chosen.truncate(max_gaussians.saturating_sub(n));
        chosen.sort_unstable();
        let (clone, split): (Vec<u32>, Vec<u32>) =
            chosen.into_iter().partition(|&i| largest_scale(g, i as usize) <= self.clone_scale * extent);

        let mut sources: Vec<u32> = (0..n as u32).filter(|i| split.binary_search(i).is_err()).collect();
        let fresh = sources.len();
        sources.extend(&clone);
        let halves = sources.len();
        sources.extend(split.iter().flat_map(|&i| [i, i]));
        *g = g.select(&sources);
        let reach = self.split_reach.unwrap_or(f32::INFINITY);
        (halves..g.len()).for_each(|i| halve(g, i, reach, rng));
        adam.select(&sources, fresh);

        let huge = |i: usize| self.max_scale.is_some_and(|most| largest_scale(g, i) > most * extent);
        let kept = |i: &u32| g.opacity(*i as usize) >= self.min_opacity && !huge(*i as usize);
        let kept: Vec<u32> = (0..g.len() as u32).filter(kept).collect();
        // Something is always left.
        let removed = if kept.is_empty() { 0 } else { g.len() - kept.len() };
        if removed > 0 {
            *g = g.select(&kept);
            adam.select(&kept, kept.len());
        }
        *seen = ScreenGradients::new(g.len());
        Report { cloned: clone.len(), split: split.len(), removed, relocated: 0 }
    }
}

impl Default for Adaptive {
    fn default() -> Self {
        Self {
            gradient: 2e-4,
            min_opacity: 0.005,
            clone_scale: 0.01,
            max_scale: None,
            split_reach: Some(1.0),
            reset_every: 3000,
        }
    }
}

impl Densify for Adaptive {
    fn before(&self, gaussians: &mut Gaussians, adam: &mut Adam, at: Moment<'_>) {
        // Not at the end of the last iteration, so that held-out views are measured before.
        let last = at.iteration - 1;
        if self.reset_every > 0 && (1..at.growth.until).contains(&last) && last.is_multiple_of(self.reset_every) {
            reset_opacities(gaussians, adam);
        }
    }

    fn observe(&self, seen: &mut ScreenGradients, view: &Workspace, camera: &Camera, at: Moment<'_>) {
        if !Self::observes(at) {
            return;
        }
        // Pixels to half widths and half heights: the loss's slope by x / (width / 2).
        let (x, y) = (0.5 * camera.width as f32, 0.5 * camera.height as f32);
        for i in view.forward.visible().iter().map(|&i| i as usize) {
            let [gx, gy] = view.gradients.mean2d[i];
            seen.sum[i] += (gx * x).hypot(gy * y);
            seen.views[i] += 1;
        }
    }

    fn round(&self, state: &mut State, at: Moment<'_>) -> Option<Report> {
        let mut rng = generator(at.seed, Purpose::Split, u64::from(at.iteration));
        let way = Self { max_scale: self.max_scale.filter(|_| at.iteration > self.reset_every), ..*self };
        Self::observes(at).then(|| way.densify(state, at.growth.max_gaussians, at.extent as f32, &mut rng))
    }
}

/// Lowers every opacity to at most 0.01, and forgets their moments: what is needed comes back, floaters do not.
fn reset_opacities(g: &mut Gaussians, adam: &mut Adam) {
    let most = logit(RESET_OPACITY);
    g.opacity_logits.iter_mut().for_each(|o| *o = o.min(most));
    for moments in [&mut adam.first, &mut adam.second] {
        moments.opacity_logits.fill(0.0);
    }
}

fn largest_scale(g: &Gaussians, i: usize) -> f32 {
    g.log_scales[i].iter().copied().fold(f32::NEG_INFINITY, f32::max).exp()
}

/// Moves Gaussian `i` to a draw from itself, at most `reach` standard deviations away along each axis, and shrinks it.
fn halve(g: &mut Gaussians, i: usize, reach: f32, rng: &mut ChaCha8Rng) {
    let [w, x, y, z] = g.rotations[i];
    let q = Quat::from_xyzw(x, y, z, w);
    let q = if q.length_squared() > 0.0 { q.normalize() } else { Quat::IDENTITY };
    let local = Vec3::from(g.log_scales[i].map(|s| s.exp() * normal(rng).clamp(-reach, reach)));
    let moved = Vec3::from(g.means[i]) + q * local;
    if moved.is_finite() {
        g.means[i] = moved.into();
    }
    g.log_scales[i] = g.log_scales[i].map(|s| s - SPLIT_SHRINK.ln());
}

/// A draw from the standard normal distribution (Box and Muller 1958).
fn normal(rng: &mut ChaCha8Rng) -> f32 {
    let radius = (-2.0 * (1.0 - rng.random::<f64>()).ln()).sqrt();
    (radius * (std::f64::consts::TAU * rng.random::<f64>()).cos()) as f32
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::densification::drawable;
    use crate::training::checkpoint;
    use crate::training::optimiser::zeros;
    use crate::training::poses::Poses;
    use proptest::prelude::*;

    /// Gaussians in a row: scale e^(-s), opacity 0.5.
    fn row(log_scales: &[f32]) -> Gaussians {
        let mut g = zeros(log_scales.len(), 1);
        for (i, &s) in log_scales.iter().enumerate() {
            g.means[i] = [i as f32, 0.0, 0.0];
            g.log_scales[i] = [s, s - 1.0, s - 2.0];
            g.rotations[i] = [1.0, 0.0, 0.0, 0.0];
        }
        g
    }

    fn run(g: &mut Gaussians, gradients: &[f32], options: &Adaptive, most: usize) -> (Adam, Report) {
        let mut state = checkpoint::start(g.clone(), 0, Poses::default());
        state.adam.first.means.iter_mut().enumerate().for_each(|(i, m)| m[0] = 1.0 + i as f32);
        let sum = gradients.iter().map(|p| 3.0 * p).collect();
        state.seen = ScreenGradients { sum, views: vec![3; gradients.len()] };
        let report = options.densify(&mut state, most, 10.0, &mut generator(0, Purpose::Split, 1));
        assert_eq!(state.seen, ScreenGradients::new(state.gaussians.len()));
        *g = state.gaussians;
        assert!(g.check().is_ok() && state.adam.first.check().is_ok() && state.adam.first.len() == g.len());
        (state.adam, report)
    }

    #[test]
    fn small_ones_are_cloned_large_ones_split_faint_and_huge_ones_removed() {
        let small = 0.05f32.ln();
        let mut g = row(&[small, small, 0.5f32.ln(), small, 2.0f32.ln(), 0.5f32.ln()]);
        g.opacity_logits[3] = -9.0;
        let before = g.clone();
        let keeping = Adaptive::default();
        let removing = Adaptive { max_scale: Some(0.1), ..keeping };
        let (adam, report) = run(&mut g, &[1e-3, 0.0, 1e-3, 1e-3, 0.0, 1e-4], &removing, usize::MAX);
        // 0 and 3 are cloned, but 3 is faint: it and its twin go, as does 4, which is huge. 2 is split.
        assert_eq!(report, Report { cloned: 2, split: 1, removed: 3, relocated: 0 });
        let xs: Vec<f32> = g.means.iter().map(|m| m[0]).collect();
        assert_eq!(xs[..4], [0.0, 1.0, 5.0, 0.0]);
        assert_eq!(adam.first.means.iter().map(|m| m[0]).collect::<Vec<_>>(), [1.0, 2.0, 6.0, 0.0, 0.0, 0.0]);
        for half in 4..6 {
            assert!((g.log_scales[half][0] - before.log_scales[2][0] + 1.6f32.ln()).abs() < 1e-6);
            assert!((g.means[half][0] - 2.0).abs() < 2.5, "within five standard deviations");
        }
        assert_ne!(g.means[4], g.means[5]);
        assert_eq!(run(&mut before.clone(), &[0.0; 6], &keeping, usize::MAX).1.removed, 1);
    }

    #[test]
    fn halves_are_drawn_from_their_whole() {
        let mut g = zeros(20_000, 0);
        let angle = 0.7f32;
        for i in 0..g.len() {
            g.means[i] = [1.0, 2.0, 3.0];
            g.log_scales[i] = [0.5, -1.0, -3.0];
            g.rotations[i] = [2.0 * (angle / 2.0).cos(), 0.0, 0.0, 2.0 * (angle / 2.0).sin()];
        }
        let along = Vec3::new(angle.cos(), angle.sin(), 0.0);
        let offsets = |reach: f32| -> Vec<Vec3> {
            let (mut halves, mut rng) = (g.clone(), generator(1, Purpose::Split, 0));
            (0..g.len()).for_each(|i| halve(&mut halves, i, reach, &mut rng));
            halves.means.iter().map(|&m| Vec3::from(m) - Vec3::new(1.0, 2.0, 3.0)).collect()
        };
        let anywhere = offsets(f32::INFINITY);
        let spread = |axis: Vec3| (anywhere.iter().map(|o| o.dot(axis).powi(2)).sum::<f32>() / 20_000.0).sqrt();
        assert!((spread(along) / 0.5f32.exp() - 1.0).abs() < 0.03);
        assert!((spread(Vec3::Z) / (-3.0f32).exp() - 1.0).abs() < 0.03);
        let near = offsets(1.0);
        let farthest = |axis: Vec3| near.iter().map(|o| o.dot(axis).abs()).fold(0.0, f32::max);
        assert!((farthest(along) / 0.5f32.exp() - 1.0).abs() < 1e-4);
        assert!((farthest(Vec3::Z) / (-3.0f32).exp() - 1.0).abs() < 1e-4);
    }

    #[test]
    fn resets_keep_faint_ones() {
        let mut g = row(&[0.0, 0.0]);
        g.opacity_logits = vec![3.0, -8.0];
        let mut adam = Adam::new(&g);
        adam.second.opacity_logits.fill(1.0);
        reset_opacities(&mut g, &mut adam);
        assert!((g.opacity(0) - 0.01).abs() < 1e-6 && g.opacity_logits[1] == -8.0);
        assert_eq!(adam.second.opacity_logits, [0.0; 2]);
        assert_eq!(drawable(&g), [0]);
        g.opacity_logits[0] = -9.0;
        assert_eq!(drawable(&g), [0, 1], "something is always left");
    }

    proptest! {
        #[test]
        fn counts_add_up_and_the_cap_holds(
            gradients in prop::collection::vec(0.0f32..4e-4, 1..60),
            cap in 1usize..100,
            seed in 0u64..50,
        ) {
            let n = gradients.len();
            let log_scales: Vec<f32> = (0..n).map(|i| ((seed as usize + 7 * i) % 5) as f32 - 4.0).collect();
            let mut g = row(&log_scales);
            let (_, report) = run(&mut g, &gradients, &Adaptive::default(), cap);
            prop_assert_eq!(g.len(), n + report.cloned + report.split - report.removed);
            prop_assert!(g.len() <= n.max(cap));
            let wanted = gradients.iter().filter(|&&p| 3.0 * p / 3.0 >= 2e-4).count();
            prop_assert_eq!(report.cloned + report.split, wanted.min(cap.saturating_sub(n)));
        }
    }
}
