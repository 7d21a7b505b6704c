//! VALA (arXiv 2509.05515): only Gaussians that a view shows well take its features, and a streaming median replaces
//! the mean.
//!
//! As in Occam's LGS a Gaussian is seen at the pixel of its projected centre, with its blending weight w there. Of the
//! Gaussians of a view these pass:
//!
//! 1. By mass: the fewest with the largest weights that hold a share (0.75) of all weight of the view.
//! 2. By the floor: weights of at least 0.13.
//! 3. By the quantile: weights above the 0.85 quantile of the view. In the code a fixed bound, 0.15, replaces it where
//!    more Gaussians pass that. Never more than half of a view's Gaussians pass. Where steps 1 and 2 leave none, the
//!    Gaussian with the largest weight takes their place.
//!
//! The paper speaks of rays, but defines its sets by view (equations 10 to 13), and so does the code. The paper gives a
//! share of 0.5 to 0.75; the code has 0.75 and a floor of 0.13 (LERF-OVS), 0.9 and 0.01 (ScanNet), and an older version
//! of it 0.5 and 0.1.
//!
//! The median is one of cosines on the unit sphere, in one pass (algorithm 1). An estimate z with the weight W so far
//! takes a feature f of weight w as z := unit(z + w / (W + w) (f - (f z) z)), W := W + w; the first feature is the
//! first z. Views come in their order. Equation 16 has another factor w that algorithm 1 and the code lack; it is left
//! out here.
//!
//! The code then removes Gaussians whose W is less than 1 % of the median W. Here they have no descriptor, so no text
//! selects them. Scenes with few and large Gaussians lose much by that; `--fill` gives them their nearest neighbour's
//! descriptor.
//!
//! The text's other reading is `--by ray`: at every pixel of every mask, steps 1 and 2 among the Gaussians along its
//! ray, of which the largest always passes. Remarks in the code name its settings, a share of 0.9 to 0.95 and a floor
//! of 0.02 to 0.05. The median then steps once for every view and mask, in that order.
//!
//! Its query smooths the relevancy of a Gaussian, half its own and half the mean of the nearest 10 (itself among them).
//! The query is the scorer's work here, so `--smooth 10` smooths descriptors with the same weights instead: cosines of
//! a mean are means of cosines, but for its length. It is off by default. The query then scales relevancies to the
//! scene's range and takes those above 0.8 of it (0.6 after a second scaling), at the level with the highest peak.

use super::{Centre, Finish, PIXELS, Shares, by_pixels, centres, described, give_centres, positions, slots};
use crate::cli::Peer;
use crate::product::Product;
use crate::vectors::normalised;
use crate::world::{Inputs, World};
use artifacts::Descriptors;
use gs_io::Result;
use serde::Serialize;
use stage::Stage;

/// A Gaussian without observations has this weight in the median of weights (the code's start value).
const START: f64 = 1e-10;
/// Gaussians with less weight than this are removed in any case.
const LEAST: f64 = 1e-5;
/// So are Gaussians with less than this share of the median weight.
const LEAST_SHARE: f64 = 0.01;

/// Settings of VALA.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct ValaOptions {
    #[command(flatten)]
    #[serde(flatten)]
    inputs: Inputs,
    #[command(flatten)]
    #[serde(flatten)]
    gate: Gate,
    /// Whose weights are gated
    #[arg(long, value_enum, default_value_t = By::View)]
    by: By,
    #[command(flatten)]
    #[serde(flatten)]
    finish: Finish,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, Serialize)]
#[serde(rename_all = "kebab-case")]
enum By {
    /// Of a view's Gaussians, each at the pixel of its centre, as in the code
    View,
    /// Of the Gaussians along the ray of a pixel, at all pixels
    Ray,
}

/// Which Gaussians take features.
#[derive(Debug, Clone, Copy, clap::Args, Serialize)]
struct Gate {
    /// Share of a view's blending weight that passes, of the largest weights; 0 to 1
    #[arg(long, value_name = "SHARE", default_value_t = 0.75, value_parser = stage::within(0.0..=1.0))]
    mass: f64,
    /// Least blending weight that passes, 0 to 1
    #[arg(long, value_name = "WEIGHT", default_value_t = 0.13, value_parser = stage::within(0.0..=1.0))]
    floor: f64,
    /// Quantile of a view's blending weights above which weights pass, 0 to 1
    #[arg(skip = 0.85)]
    quantile: f64,
    /// Blending weight that replaces the quantile where more Gaussians exceed it, 0 to 1 (1: never)
    #[arg(skip = 0.15)]
    bound: f64,
    /// Share of a view's Gaussians that passes at most, 0 to 1
    #[arg(skip = 0.5)]
    most: f64,
}

impl Peer for ValaOptions {
    fn inputs(&self) -> &Inputs {
        &self.inputs
    }

    fn format(&self) -> &'static str {
        Descriptors::FORMAT
    }

    fn make(&self, world: &World, stage: &Stage) -> Result<Product> {
        let slots = slots(&world.levels).len();
        let mut shares = match self.by {
            By::View => self.by_view(world, stage)?,
            By::Ray => by_pixels(world, stage, |weights| self.gate.keep(weights, PIXELS))?,
        };
        for slot in 0..slots as u32 {
            forget_weak(&mut shares, slot);
        }
        let table = described(world, slots, &shares, median);
        Ok(self.finish.applied(table, world))
    }
}

impl ValaOptions {
    /// What the masks at their centres give to the Gaussians that pass the gate of their view.
    fn by_view(&self, world: &World, stage: &Stage) -> Result<Shares> {
        let (slots, positions) = (slots(&world.levels), positions(world));
        let mut shares: Shares = vec![Vec::new(); world.kept()];
        for view in 0..world.views.len() {
            stage.go_on()?;
            let (maps, camera) = world.maps(view)?;
            let seen = centres(world, &camera, &positions);
            let weights: Vec<f64> = seen.iter().map(|c| c.weight).collect();
            let passes = self.gate.passes(&weights);
            let seen: Vec<Centre> =
                seen.into_iter().zip(passes).filter(|(_, passes)| *passes).map(|(c, _)| c).collect();
            give_centres(&mut shares, view as u32, &seen, &maps, &slots);
        }
        Ok(shares)
    }
}

impl Gate {
    /// Leaves of the weights at each of some pixels, `[Gaussian][pixel]`, the fewest and largest that hold the share of
    /// the pixel's weight, of these those above the floor; always the largest.
    fn keep(&self, weights: &mut [f32], pixels: usize) {
        let mut found: Vec<(f32, usize)> = Vec::new();
        for pixel in 0..pixels {
            found.clear();
            let at = (pixel..weights.len()).step_by(pixels);
            found.extend(at.map(|at| (weights[at], at)).filter(|(w, _)| *w > 0.0));
            found.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
            let enough = self.mass * found.iter().map(|(w, _)| f64::from(*w)).sum::<f64>();
            let mut sum = 0.0;
            for (rank, &(weight, at)) in found.iter().enumerate() {
                if rank > 0 && (sum >= enough || f64::from(weight) < self.floor) {
                    weights[at] = 0.0;
                }
                sum += f64::from(weight);
            }
        }
    }

    /// Which of a view's Gaussians pass, by their weights.
    fn passes(&self, weights: &[f64]) -> Vec<bool> {
        let mut order: Vec<usize> = (0..weights.len()).collect();
        order.sort_by(|&a, &b| weights[b].total_cmp(&weights[a]));
        let enough = self.mass * weights.iter().sum::<f64>();
        let before = order.iter().scan(0.0, |sum, &i| Some(std::mem::replace(sum, *sum + weights[i])));
        // The one that makes it enough still passes.
        let by_mass = before.take_while(|&before| before < enough).count();
        let above_floor = order.iter().take_while(|&&i| weights[i] >= self.floor).count();
        let most = (self.most * weights.len() as f64) as usize;
        let first = by_mass.min(above_floor).min(most).max(1);
        let count = |bound: f64| order.iter().take_while(|&&i| weights[i] > bound).count();
        let second = count(self.bound).max(count(quantile(&order, weights, self.quantile)));
        let mut passes = vec![false; weights.len()];
        order.iter().take(first.min(second)).for_each(|&i| passes[i] = true);
        passes
    }
}

/// The quantile of weights, linear between two of them; `order` are their indices, largest first.
fn quantile(order: &[usize], weights: &[f64], share: f64) -> f64 {
    if order.is_empty() {
        return 0.0;
    }
    let at = share * (order.len() - 1) as f64;
    let of = |rank: usize| weights[order[order.len() - 1 - rank.min(order.len() - 1)]];
    let (below, above) = (of(at as usize), of(at as usize + 1));
    below + at.fract() * (above - below)
}

/// Takes the shares in a slot from Gaussians that have little weight beside others.
fn forget_weak(shares: &mut Shares, slot: u32) {
    let sum = |own: &Vec<super::Share>| own.iter().filter(|s| s.slot == slot).map(|s| s.weight).sum::<f64>();
    let weights: Vec<f64> = shares.iter().map(|own| START + sum(own)).collect();
    let mut sorted = weights.clone();
    sorted.sort_by(f64::total_cmp);
    let median = sorted.get(sorted.len().saturating_sub(1) / 2).copied().unwrap_or(0.0);
    let least = (LEAST_SHARE * median).max(LEAST);
    for (own, weight) in shares.iter_mut().zip(weights) {
        if weight < least {
            own.retain(|s| s.slot != slot);
        }
    }
}

/// The streaming median of unit features with weights, in their order.
fn median(features: &[(&[f32], f64)]) -> Option<Vec<f32>> {
    let (mut z, mut total) = (vec![0.0; features.first()?.0.len()], 0.0);
    for (feature, weight) in features {
        let dot: f64 = z.iter().zip(*feature).map(|(z, &f)| z * f64::from(f)).sum();
        total += weight;
        let step = weight / total;
        z.iter_mut().zip(*feature).for_each(|(z, &f)| *z += step * (f64::from(f) - dot * *z));
        // The first feature has all the weight so far, so it becomes the estimate. Later steps are at right angles to
        // it and only make it longer.
        let length = z.iter().map(|z| z * z).sum::<f64>().sqrt().max(f64::MIN_POSITIVE);
        z.iter_mut().for_each(|z| *z /= length);
    }
    normalised(&z)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::uplift::Share;

    const OPEN: Gate = Gate { mass: 1.0, floor: 0.0, quantile: 0.0, bound: 0.0, most: 0.5 };

    #[test]
    fn the_gate_takes_mass_floor_and_quantile_in_turn() {
        let weights = [0.1, 0.4, 0.05, 0.3, 0.15, 0.0];
        // In order 0.4, 0.3, 0.15, 0.1, 0.05, 0; sum 1. No more than 3 of 6 pass.
        assert_eq!(OPEN.passes(&weights), [false, true, false, true, true, false]);
        // 0.4 + 0.3 reach 0.7; 0.4 + 0.3 + 0.15 reach 0.71.
        assert_eq!(Gate { mass: 0.69, ..OPEN }.passes(&weights), [false, true, false, true, false, false]);
        assert_eq!(Gate { mass: 0.71, ..OPEN }.passes(&weights), [false, true, false, true, true, false]);
        assert_eq!(Gate { floor: 0.3, ..OPEN }.passes(&weights), [false, true, false, true, false, false]);
        // Rank 0.85 * 5 = 4.25 from below: 0.3 + 0.25 * 0.1 = 0.325.
        let strict = Gate { quantile: 0.85, bound: 1.0, ..OPEN };
        assert_eq!(strict.passes(&weights), [false, true, false, false, false, false]);
        // The bound lets two pass, which is more.
        assert_eq!(Gate { bound: 0.2, ..strict }.passes(&weights), [false, true, false, true, false, false]);
        // None above the floor: the largest.
        assert_eq!(Gate { floor: 0.9, ..OPEN }.passes(&weights), [false, true, false, false, false, false]);
        assert!(OPEN.passes(&[]).is_empty());
    }

    #[test]
    fn the_gate_of_rays_takes_the_largest_of_each_pixel() {
        // Three Gaussians at two pixels.
        let weights = [0.2, 0.1, 0.5, 0.01, 0.1, 0.0];
        let kept = |gate: Gate| {
            let mut kept = weights.to_vec();
            gate.keep(&mut kept, 2);
            kept
        };
        // 0.5 of 0.8 in the first pixel is less than 0.7 of it, 0.5 + 0.2 is more.
        assert_eq!(kept(Gate { mass: 0.7, ..OPEN }), [0.2, 0.1, 0.5, 0.0, 0.0, 0.0]);
        assert_eq!(kept(Gate { mass: 0.6, ..OPEN }), [0.0, 0.1, 0.5, 0.0, 0.0, 0.0]);
        assert_eq!(kept(Gate { floor: 0.15, ..OPEN }), [0.2, 0.1, 0.5, 0.0, 0.0, 0.0], "the largest always stays");
        assert_eq!(kept(OPEN), weights);
    }

    #[test]
    fn the_median_steps_along_the_sphere() {
        let (x, y) = ([1.0, 0.0], [0.0, 1.0]);
        // x, then y with step 1 / (1 + 1): (1, 0.5), of length sqrt(1.25).
        let made = median(&[(&x, 1.0), (&y, 1.0)]).unwrap();
        let length = 1.25f32.sqrt();
        assert!((made[0] - 1.0 / length).abs() < 1e-6 && (made[1] - 0.5 / length).abs() < 1e-6, "{made:?}");
        // A view in a hundred does little to the others.
        let mut many = vec![(&x[..], 1.0); 99];
        many.push((&y, 1.0));
        assert!(median(&many).unwrap()[0] > 0.9999);
        assert_eq!(median(&[(&y, 0.2)]), Some(vec![0.0, 1.0]));
        assert_eq!(median(&[]), None);
    }

    #[test]
    fn gaussians_of_little_weight_are_forgotten() {
        let share = |slot, weight| Share { view: 0, mask: 0, slot, weight };
        let mut shares = vec![vec![share(0, 1.0)], vec![share(0, 0.02), share(1, 0.5)], vec![share(0, 4.0)], vec![]];
        // Sorted about 0, 0.02, 1, 4: the lower median is 0.02, 1 % of which are 0.0002.
        forget_weak(&mut shares, 0);
        assert_eq!(shares[1].len(), 2);
        shares[3].push(share(0, 0.005));
        shares[1][0].weight = 3.0;
        // Sorted 0.005, 1, 3, 4: the median is 1.
        forget_weak(&mut shares, 0);
        assert!(shares[3].is_empty());
        assert_eq!(shares[1], [share(0, 3.0), share(1, 0.5)]);
    }
}
