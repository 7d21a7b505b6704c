//! Adaptive density control: Gaussians whose projection is pulled hard are cloned (small ones) or split (large ones);
//! faint and huge ones are removed (Kerbl et al. 2023, section 5.2). How hard is measured as there, or without letting
//! the pulls of a Gaussian's pixels cancel (AbsGS, Ye et al. 2024). The other way to densify is in [`crate::mcmc`].

use crate::optimiser::Adam;
use clap::ValueEnum;
use glam::{Quat, Vec3};
use gs_scene::Gaussians;
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;

/// The halves of a split Gaussian are smaller by this factor.
const SPLIT_SHRINK: f32 = 1.6;
/// Opacity that a reset leaves at most.
const RESET_OPACITY: f32 = 0.01;
/// Fainter Gaussians are never drawn.
const LEAST_ALPHA: f32 = 1.0 / 255.0;

/// How the number of Gaussians grows.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Strategy {
    /// Clone and split what is pulled hard on average, as 3DGS does
    #[default]
    Adaptive,
    /// The same with pulls that cannot cancel within a Gaussian, so that large blurred ones are split (AbsGS)
    Absgrad,
    /// Move dead Gaussians to opaque ones, grow by 5% a round up to --max-gaussians, explore by noise (3DGS-MCMC)
    Mcmc,
}

impl Strategy {
    /// The usual threshold on the pull.
    pub fn gradient(self) -> f32 {
        match self {
            Self::Adaptive | Self::Mcmc => 2e-4,
            // AbsGS, section 4.1.
            Self::Absgrad => 4e-4,
        }
    }
}

/// Thresholds of densification and pruning.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct DensifyOptions {
    /// How.
    pub strategy: Strategy,
    /// Mean length of d loss / d projected centre, in units of half the picture's width and height, above which a
    /// Gaussian is cloned or split.
    pub gradient: f32,
    /// Fainter Gaussians are removed.
    pub min_opacity: f32,
    /// Gaussians up to this share of the scene's extent are cloned, larger ones split.
    pub clone_scale: f32,
    /// Gaussians beyond this share of the scene's extent are removed, if there is one.
    pub max_scale: Option<f32>,
    /// Most Gaussians there may be; those pulled hardest come first.
    pub max_gaussians: usize,
}

impl DensifyOptions {
    /// The usual thresholds of a strategy.
    pub fn of(strategy: Strategy) -> Self {
        Self {
            strategy,
            gradient: strategy.gradient(),
            min_opacity: 0.005,
            clone_scale: 0.01,
            max_scale: None,
            max_gaussians: 1_000_000,
        }
    }
}

impl Default for DensifyOptions {
    fn default() -> Self {
        Self::of(Strategy::default())
    }
}

/// How hard each Gaussian was pulled since the last densification.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Pull {
    /// Sum over views of the length of d loss / d projected centre, N.
    pub sum: Vec<f32>,
    /// In how many views it was drawn, N.
    pub views: Vec<u32>,
}

impl Pull {
    /// Nothing seen yet.
    pub fn new(count: usize) -> Self {
        Self { sum: vec![0.0; count], views: vec![0; count] }
    }

    /// Counts a view that drew the Gaussians `visible` at `width` x `height` pixels.
    /// `mean2d` is the gradient of the projected centres: [`gs_raster::Gradients::mean2d`] or its `mean2d_abs`.
    pub fn observe(&mut self, visible: &[u32], mean2d: &[[f32; 2]], width: u32, height: u32) {
        // Pixels to half widths and half heights: the loss's slope by x / (width / 2).
        let (x, y) = (0.5 * width as f32, 0.5 * height as f32);
        for &i in visible {
            let i = i as usize;
            let [gx, gy] = mean2d[i];
            self.sum[i] += (gx * x).hypot(gy * y);
            self.views[i] += 1;
        }
    }

    fn mean(&self, i: usize) -> f32 {
        if self.views[i] == 0 { 0.0 } else { self.sum[i] / self.views[i] as f32 }
    }
}

/// What a densification did.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Report {
    /// Gaussians that got a twin.
    pub cloned: usize,
    /// Gaussians replaced by two smaller ones.
    pub split: usize,
    /// Gaussians removed.
    pub removed: usize,
    /// Dead Gaussians moved elsewhere.
    pub relocated: usize,
}

/// Clones, splits and removes; afterwards `pull` starts from nothing. New Gaussians follow the old ones and have no
/// moments.
pub fn densify(
    g: &mut Gaussians,
    adam: &mut Adam,
    pull: &mut Pull,
    options: &DensifyOptions,
    extent: f32,
    rng: &mut ChaCha8Rng,
) -> Report {
    let n = g.len();
    let mut chosen: Vec<u32> = (0..n as u32).filter(|&i| pull.mean(i as usize) >= options.gradient).collect();
    // Each adds one. Too many: the hardest pulled, the first among equals.
    chosen.sort_by(|&a, &b| pull.mean(b as usize).total_cmp(&pull.mean(a as usize)).then(a.cmp(&b)));
    chosen.truncate(options.max_gaussians.saturating_sub(n));
    chosen.sort_unstable();
    let (clone, split): (Vec<u32>, Vec<u32>) =
        chosen.into_iter().partition(|&i| largest_scale(g, i as usize) <= options.clone_scale * extent);

    let mut is_split = vec![false; n];
    split.iter().for_each(|&i| is_split[i as usize] = true);
    let mut sources: Vec<u32> = (0..n as u32).filter(|&i| !is_split[i as usize]).collect();
    let fresh = sources.len();
    sources.extend(&clone);
    let halves = sources.len();
    sources.extend(split.iter().flat_map(|&i| [i, i]));
    *g = g.select(&sources);
    for i in halves..g.len() {
        halve(g, i, rng);
    }
    adam.select(&sources, fresh);

    let huge = |g: &Gaussians, i: usize| options.max_scale.is_some_and(|most| largest_scale(g, i) > most * extent);
    let kept = |g: &Gaussians, i: usize| g.opacity(i) >= options.min_opacity && !huge(g, i);
    let removed = keep(g, adam, kept);
    *pull = Pull::new(g.len());
    Report { cloned: clone.len(), split: split.len(), removed, relocated: 0 }
}

/// Removes the Gaussians that `kept` refuses, unless none would be left; gives their number.
fn keep(g: &mut Gaussians, adam: &mut Adam, kept: impl Fn(&Gaussians, usize) -> bool) -> usize {
    let sources: Vec<u32> = (0..g.len() as u32).filter(|&i| kept(g, i as usize)).collect();
    let removed = g.len() - sources.len();
    if removed == 0 || sources.is_empty() {
        return 0;
    }
    *g = g.select(&sources);
    adam.select(&sources, sources.len());
    removed
}

/// The Gaussians that can be drawn: their opacity reaches 1/255 somewhere. All of them, where none can.
pub fn drawable(g: &Gaussians) -> Vec<u32> {
    let all = 0..g.len() as u32;
    let rows: Vec<u32> = all.clone().filter(|&i| g.opacity(i as usize) >= LEAST_ALPHA).collect();
    if rows.is_empty() { all.collect() } else { rows }
}

/// Lowers every opacity to at most 0.01, and forgets their moments: what is needed comes back, floaters do not.
pub fn reset_opacities(g: &mut Gaussians, adam: &mut Adam) {
    let most = (RESET_OPACITY / (1.0 - RESET_OPACITY)).ln();
    g.opacity_logits.iter_mut().for_each(|o| *o = o.min(most));
    adam.forget_opacities();
}

fn largest_scale(g: &Gaussians, i: usize) -> f32 {
    g.log_scales[i].iter().copied().fold(f32::NEG_INFINITY, f32::max).exp()
}

/// Moves Gaussian `i` to a draw from itself and shrinks it.
fn halve(g: &mut Gaussians, i: usize, rng: &mut ChaCha8Rng) {
    let [w, x, y, z] = g.rotations[i];
    let q = Quat::from_xyzw(x, y, z, w);
    let q = if q.length_squared() > 0.0 { q.normalize() } else { Quat::IDENTITY };
    let local = Vec3::from(g.log_scales[i].map(|s| s.exp() * normal(rng)));
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
    use crate::optimiser::zeros;
    use crate::schedule::{Purpose, generator};
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

    fn run(g: &mut Gaussians, pulls: &[f32], options: &DensifyOptions) -> (Adam, Report) {
        let mut adam = Adam::new(g);
        adam.first.means.iter_mut().enumerate().for_each(|(i, m)| m[0] = 1.0 + i as f32);
        let mut pull = Pull { sum: pulls.iter().map(|p| 3.0 * p).collect(), views: vec![3; pulls.len()] };
        let report = densify(g, &mut adam, &mut pull, options, 10.0, &mut generator(0, Purpose::Split, 1));
        assert_eq!(pull, Pull::new(g.len()));
        assert!(g.check().is_ok() && adam.first.check().is_ok() && adam.first.len() == g.len());
        (adam, report)
    }

    #[test]
    fn small_ones_are_cloned_large_ones_split_faint_and_huge_ones_removed() {
        let small = 0.05f32.ln();
        let mut g = row(&[small, small, 0.5f32.ln(), small, 2.0f32.ln(), 0.5f32.ln()]);
        g.opacity_logits[3] = -9.0;
        let before = g.clone();
        let keeping = DensifyOptions::of(super::Strategy::Adaptive);
        let removing = DensifyOptions { max_scale: Some(0.1), ..keeping };
        let (adam, report) = run(&mut g, &[1e-3, 0.0, 1e-3, 1e-3, 0.0, 1e-4], &removing);
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
        assert_eq!(run(&mut before.clone(), &[0.0; 6], &keeping).1.removed, 1);
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
        let mut rng = generator(1, Purpose::Split, 0);
        (0..g.len()).for_each(|i| halve(&mut g, i, &mut rng));
        let along = Vec3::new(angle.cos(), angle.sin(), 0.0);
        let offsets: Vec<Vec3> = g.means.iter().map(|&m| Vec3::from(m) - Vec3::new(1.0, 2.0, 3.0)).collect();
        let spread = |axis: Vec3| (offsets.iter().map(|o| o.dot(axis).powi(2)).sum::<f32>() / 20_000.0).sqrt();
        assert!((spread(along) / 0.5f32.exp() - 1.0).abs() < 0.03);
        assert!((spread(Vec3::Z) / (-3.0f32).exp() - 1.0).abs() < 0.03);
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
            pulls in prop::collection::vec(0.0f32..4e-4, 1..60),
            cap in 1usize..100,
            seed in 0u64..50,
        ) {
            let n = pulls.len();
            let log_scales: Vec<f32> = (0..n).map(|i| ((seed as usize + 7 * i) % 5) as f32 - 4.0).collect();
            let mut g = row(&log_scales);
            let options = DensifyOptions { max_gaussians: cap, ..DensifyOptions::of(super::Strategy::Adaptive) };
            let (_, report) = run(&mut g, &pulls, &options);
            prop_assert_eq!(g.len(), n + report.cloned + report.split - report.removed);
            prop_assert!(g.len() <= n.max(cap));
            let wanted = pulls.iter().filter(|&&p| 3.0 * p / 3.0 >= 2e-4).count();
            prop_assert_eq!(report.cloned + report.split, wanted.min(cap.saturating_sub(n)));
        }
    }
}
