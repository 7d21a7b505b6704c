//! LEGaussians (Shi et al., CVPR 2024): features become entries of a codebook, and every Gaussian learns a code of eight numbers
//! whose rendering a small net turns into the entry of each pixel. docs/peers.md says what was taken from where.
//!
//! The authors' dense features are those of CLIP and DINO at several scales. There is no DINO among our inputs; the feature of a
//! pixel is that of its mask, with several levels their mean. Uncertainty and smoothing are as the authors have them; smoothing
//! takes a sample of the Gaussians each time. The run is much shorter than theirs, so the rates of the codes and the nets are higher. Two things
//! are other than theirs: the codebook is found by k-means, which has the cosine loss of their gradient descent but needs no
//! balancing of loads to keep entries alive; and geometry stands still, so that the loss of colours is left out.

use crate::cli::Peer;
use crate::langsplat::{Adam, Batches, Net, ViewPixels, products, sample, seen, through_unit, unit_rows};
use crate::product::{Product, Table};
use crate::world::{Inputs, World};
use artifacts::Descriptors;
use gs_io::{Error, Result};
use rand::seq::index;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;
use stage::Stage;
use std::collections::BTreeMap;

/// Numbers in a code (the paper; arguments/__init__.py of the authors' repository).
const CODE: usize = 8;
/// Hidden sizes of the decoder from codes to entries (scene/index_decoder.py).
const DECODER: [usize; 2] = [128, 256];
/// Sizes of the net from positions to codes, which smooths (scene/index_decoder.py).
const SMOOTHER: [usize; 6] = [3, 128, 128, 128, 128, CODE];
/// AdamW's decay for the nets (train.py).
const DECAY: f32 = 1e-5;
/// Adam's epsilon: PyTorch's default for the nets, that of 3DGS for what Gaussians hold.
const EPSILON: [f32; 2] = [1e-8, 1e-15];
/// Learning rate and start of the uncertainties (arguments/__init__.py, scene/gaussian_model.py).
const UNCERTAINTY: [f32; 2] = [0.05, 0.01];
/// Smoothing happens every so many steps (train.py), on so many Gaussians (theirs: all).
const SMOOTH: [usize; 2] = [10, 512];
/// What a Gaussian without uncertainty counts for in smoothing (arguments/__init__.py).
const SMOOTH_LEAST: f32 = 0.1;
/// Rounds of k-means at most.
const ROUNDS: usize = 50;
/// Learning rate of the codes. The authors' is 0.001.
const RATE: f32 = 0.05;
/// Learning rate of the nets. The authors' is 0.001.
const DECODER_RATE: f32 = 0.003;
/// Pixels sampled of each view.
const PIXELS: usize = 16384;

/// Settings.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct Options {
    #[command(flatten)]
    #[serde(flatten)]
    inputs: Inputs,
    /// Entries of the codebook, 1 to 65536
    #[arg(long, value_name = "COUNT", default_value_t = 128, value_parser = stage::within(1..=65536usize))]
    codebook: usize,
    /// Steps, each of one view, 1 or more. The authors take 30000, of whole views
    #[arg(long, value_name = "COUNT", default_value_t = 4000, value_parser = stage::within(1..=10_000_000usize))]
    iterations: usize,
    /// Weight of the smoothing, 0 or more
    #[arg(long, value_name = "WEIGHT", default_value_t = 1.0, value_parser = stage::at_least::<f32>(0.0))]
    smooth: f32,
    /// Pixels in a step, 1 or more
    #[arg(long, value_name = "COUNT", default_value_t = 64, value_parser = stage::within(1..=100_000_000usize))]
    batch: usize,
    /// Describe a Gaussian by its likeliest entry alone, not by the mean of all entries by their probabilities
    #[arg(long)]
    argmax: bool,
}

impl Peer for Options {
    fn inputs(&self) -> &Inputs {
        &self.inputs
    }

    fn format(&self) -> &'static str {
        Descriptors::FORMAT
    }

    fn make(&self, world: &World, stage: &Stage) -> Result<Product> {
        let mut rng = ChaCha8Rng::seed_from_u64(stage.seed());
        let (n, dim) = (world.kept(), world.dim());
        let views = sample(world, &world.levels, PIXELS, &mut rng)?;
        if views.is_empty() {
            return Err(Error::new("no mask with a feature").hint("choose other --levels"));
        }
        let points = Points::of(&views, world);
        let codebook = k_means(&points.features, &points.pixels, dim, self.codebook, &mut rng);
        let entry = nearest(&points.features, &codebook, dim);
        let cosine: f64 = entry.iter().zip(&points.pixels).map(|((_, c), p)| f64::from(c * p)).sum();
        let all: f64 = points.pixels.iter().map(|&p| f64::from(p)).sum();
        stage.info(&format!("codebook of {}: mean cosine {:.3}", codebook.len() / dim, cosine / all));
        let goals: Vec<Vec<usize>> =
            points.of_pixel.iter().map(|v| v.iter().map(|&p| entry[p as usize].0).collect()).collect();
        let means = &world.geometry.gaussians.means;
        let positions = centred(world.footprints.kept.iter().map(|&i| means[i as usize]).collect());
        let mut learner = Learner::new(n, codebook.len() / dim, &mut rng);
        let loss = learner.learn(&views, &goals, &positions, self, &mut rng);
        stage.info(&format!("codes: mean cross-entropy {loss:.3}"));
        let mut values = learner.describe(&codebook, dim, self.argmax);
        let seen = seen(&views, n);
        values.chunks_exact_mut(dim).zip(seen).filter(|(_, seen)| !seen).for_each(|(v, _)| v.fill(0.0));
        Ok(Product::Descriptors(Table { rows: Vec::new(), slots: 1, dim, values }))
    }
}

/// Different features of pixels: pixels in the same masks have the same.
struct Points {
    /// Of unit length, `[points][dim]`.
    features: Vec<f32>,
    /// Pixels that have each.
    pixels: Vec<f32>,
    /// Point of each pixel of each view.
    of_pixel: Vec<Vec<u32>>,
}

impl Points {
    fn of(views: &[ViewPixels], world: &World) -> Self {
        let dim = world.dim();
        let mut all = Self { features: Vec::new(), pixels: Vec::new(), of_pixel: Vec::new() };
        for view in views {
            let mut known = BTreeMap::new();
            let features = &world.features[&view.view];
            let of_pixel = view.masks.chunks_exact(world.levels.len().max(1)).map(|masks| {
                let point = *known.entry(masks).or_insert_with(|| {
                    let mut sum = vec![0.0; dim];
                    for feature in masks.iter().filter_map(|&id| features.row(usize::try_from(id).ok()?)) {
                        sum.iter_mut().zip(feature).for_each(|(s, f)| *s += f);
                    }
                    unit_rows(&mut sum, dim);
                    all.features.extend(sum);
                    all.pixels.push(0.0);
                    all.pixels.len() as u32 - 1
                });
                all.pixels[point as usize] += 1.0;
                point
            });
            all.of_pixel.push(of_pixel.collect());
        }
        all
    }
}

/// The centre of unit `codebook` that has the largest cosine with each unit point, and that cosine; of equals the first.
fn nearest(points: &[f32], codebook: &[f32], dim: usize) -> Vec<(usize, f32)> {
    let best = |row: &[f32]| {
        let better = |best: (usize, f32), (k, &c): (usize, &f32)| if c > best.1 { (k, c) } else { best };
        row.iter().enumerate().fold((0, f32::NEG_INFINITY), better)
    };
    products(points, codebook, dim).chunks_exact(codebook.len() / dim).map(best).collect()
}

/// k-means of unit points with the cosine, weighted, from centres drawn as k-means++ draws them. Unit centres, at most `count`,
/// fewer where fewer points differ.
fn k_means(points: &[f32], weights: &[f32], dim: usize, count: usize, rng: &mut impl RngExt) -> Vec<f32> {
    let mut centres: Vec<f32> = Vec::new();
    // What each point is away from the nearest centre: half its squared distance.
    let mut away = vec![1.0f32; weights.len()];
    while centres.len() < count * dim {
        let chances: Vec<f64> = away.iter().zip(weights).map(|(a, w)| f64::from(a * w)).collect();
        let total: f64 = chances.iter().sum();
        if total <= 0.0 {
            break;
        }
        let mut left = rng.random_range(0.0..total);
        let drawn = chances.iter().position(|c| {
            left -= c;
            left < 0.0
        });
        // Rounding may leave a little at the end.
        let Some(drawn) = drawn.or_else(|| chances.iter().rposition(|&c| c > 0.0)) else { break };
        let centre = &points[drawn * dim..(drawn + 1) * dim];
        for (away, cosine) in away.iter_mut().zip(products(points, centre, dim)) {
            // A point as good as at a centre adds none.
            let new = if 1.0 - cosine > 1e-5 { 1.0 - cosine } else { 0.0 };
            *away = away.min(new);
        }
        away[drawn] = 0.0;
        centres.extend_from_slice(centre);
    }
    let mut before = Vec::new();
    for _ in 0..ROUNDS {
        let entry: Vec<usize> = nearest(points, &centres, dim).iter().map(|e| e.0).collect();
        if entry == before {
            break;
        }
        let mut sums = vec![0.0f32; centres.len()];
        for ((point, &k), w) in points.chunks_exact(dim).zip(&entry).zip(weights) {
            sums[k * dim..(k + 1) * dim].iter_mut().zip(point).for_each(|(s, p)| *s += w * p);
        }
        unit_rows(&mut sums, dim);
        for (centre, sum) in centres.chunks_exact_mut(dim).zip(sums.chunks_exact(dim)) {
            if sum.iter().any(|&v| v != 0.0) {
                centre.copy_from_slice(sum);
            }
        }
        before = entry;
    }
    centres
}

/// Positions about their mean, in units of their mean distance from it: the authors take them as they are, whose unit is any.
fn centred(mut positions: Vec<[f32; 3]>) -> Vec<[f32; 3]> {
    let n = positions.len().max(1) as f64;
    let mean: [f64; 3] = std::array::from_fn(|c| positions.iter().map(|p| f64::from(p[c])).sum::<f64>() / n);
    let distance = |p: &[f32; 3]| (0..3).map(|c| (f64::from(p[c]) - mean[c]).powi(2)).sum::<f64>().sqrt();
    let spread = (positions.iter().map(distance).sum::<f64>() / n).max(1e-12);
    for p in &mut positions {
        *p = std::array::from_fn(|c| ((f64::from(p[c]) - mean[c]) / spread) as f32);
    }
    positions
}

/// Turns rows of logits into probabilities.
fn softmax(logits: &mut [f32], count: usize) {
    for row in logits.chunks_exact_mut(count) {
        let most = row.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        row.iter_mut().for_each(|v| *v = (*v - most).exp());
        let sum: f32 = row.iter().sum();
        row.iter_mut().for_each(|v| *v /= sum);
    }
}

/// What is learned.
struct Learner {
    codes: Vec<f32>,
    /// Logits of the uncertainties.
    doubts: Vec<f32>,
    decoder: Net,
    smoother: Net,
    entries: usize,
}

impl Learner {
    fn new(gaussians: usize, entries: usize, rng: &mut impl RngExt) -> Self {
        // Normally distributed: two uniform numbers of Box and Muller.
        let normal = |rng: &mut dyn rand::Rng| {
            let (a, b): (f32, f32) = (rng.random_range(f32::MIN_POSITIVE..1.0), rng.random_range(0.0..1.0));
            (-2.0 * a.ln()).sqrt() * (std::f32::consts::TAU * b).cos()
        };
        Self {
            codes: (0..gaussians * CODE).map(|_| normal(rng)).collect(),
            doubts: vec![(UNCERTAINTY[1] / (1.0 - UNCERTAINTY[1])).ln(); gaussians],
            decoder: Net::new(&[&[CODE], &DECODER[..], &[entries]].concat(), false, rng),
            smoother: Net::new(&SMOOTHER, false, rng),
            entries,
        }
    }

    /// Learns to tell the entry `goals` of each pixel of each view. Returns the mean cross-entropy of the last steps.
    fn learn(
        &mut self,
        views: &[ViewPixels],
        goals: &[Vec<usize>],
        positions: &[[f32; 3]],
        options: &Options,
        rng: &mut impl RngExt,
    ) -> f64 {
        let mut of_codes = Adam::new(self.codes.len(), RATE, EPSILON[1], 0.0);
        let mut of_doubts = Adam::new(self.doubts.len(), UNCERTAINTY[0], EPSILON[1], 0.0);
        let of_net = |net: &Net| Adam::new(net.parameters.len(), DECODER_RATE, EPSILON[0], DECAY);
        let (mut of_decoder, mut of_smoother) = (of_net(&self.decoder), of_net(&self.smoother));
        let mut by_net = vec![0.0; self.decoder.parameters.len().max(self.smoother.parameters.len())];
        let mut batches = Batches::default();
        let (mut loss, last) = (0.0, options.iterations.min(100));
        for iteration in 0..options.iterations {
            let Some((view, range)) = batches.draw(views, options.batch, rng) else { break };
            let mut by_code = vec![0.0; self.codes.len()];
            let mut by_doubt = vec![0.0; self.doubts.len()];
            let goals = &goals[view][range.clone()];
            let by_decoder = &mut by_net[..self.decoder.parameters.len()];
            let entropy = self.gradients(&views[view], range, goals, &mut by_code, &mut by_doubt, by_decoder);
            of_decoder.step(&mut self.decoder.parameters, by_decoder);
            if iteration % SMOOTH[0] == 0 && options.smooth > 0.0 {
                let chosen = index::sample(rng, positions.len(), SMOOTH[1].min(positions.len())).into_vec();
                let by_smoother = &mut by_net[..self.smoother.parameters.len()];
                self.smooth(&chosen, positions, options.smooth, &mut by_code, by_smoother);
                of_smoother.step(&mut self.smoother.parameters, by_smoother);
            }
            of_codes.step(&mut self.codes, &by_code);
            of_doubts.step(&mut self.doubts, &by_doubt);
            if iteration + last >= options.iterations {
                loss += entropy / last as f64;
            }
        }
        loss
    }

    /// The mean cross-entropy of pixels. The derivatives of the loss, which trusts uncertain pixels less, are added to those by
    /// codes and doubts and written to those by the decoder's parameters.
    fn gradients(
        &self,
        pixels: &ViewPixels,
        range: std::ops::Range<usize>,
        goals: &[usize],
        by_code: &mut [f32],
        by_doubt: &mut [f32],
        by_decoder: &mut [f32],
    ) -> f64 {
        let count = goals.len().max(1) as f32;
        let uncertain: Vec<f32> = self.doubts.iter().map(|d| 1.0 / (1.0 + (-d).exp())).collect();
        let doubts = pixels.render(range.clone(), &uncertain, 1);
        let mut units = pixels.render(range.clone(), &self.codes, CODE);
        let lengths = unit_rows(&mut units, CODE);
        let trace = self.decoder.forward(&units, true);
        let mut g = trace.output().to_vec();
        softmax(&mut g, self.entries);
        let mut sum = 0.0;
        let mut by_pixel = Vec::with_capacity(goals.len());
        for ((row, &goal), doubt) in g.chunks_exact_mut(self.entries).zip(goals).zip(doubts) {
            let entropy = -row[goal].max(f32::MIN_POSITIVE).ln();
            sum += f64::from(entropy);
            // The loss of a pixel is (1 - u) entropy - ln(1 - u).
            let trust = (1.0 - doubt).max(1e-3);
            by_pixel.push((1.0 / trust - entropy) / count);
            row[goal] -= 1.0;
            row.iter_mut().for_each(|v| *v *= trust / count);
        }
        let mut by_unit = self.decoder.backward(&trace, g, by_decoder);
        through_unit(&mut by_unit, &units, &lengths, CODE);
        pixels.render_back(range.clone(), &by_unit, CODE, by_code);
        let mut by_uncertain = vec![0.0; self.doubts.len()];
        pixels.render_back(range, &by_pixel, 1, &mut by_uncertain);
        for ((d, u), g) in by_doubt.iter_mut().zip(&uncertain).zip(by_uncertain) {
            *d += g * u * (1.0 - u);
        }
        sum / f64::from(count)
    }

    /// Draws codes of chosen Gaussians to what a net makes of their positions, uncertain ones more, and the net to the codes.
    fn smooth(
        &self,
        chosen: &[usize],
        positions: &[[f32; 3]],
        weight: f32,
        by_code: &mut [f32],
        by_smoother: &mut [f32],
    ) {
        let input: Vec<f32> = chosen.iter().flat_map(|&i| positions[i]).collect();
        let trace = self.smoother.forward(&input, true);
        let mut g = trace.output().to_vec();
        let scale = 2.0 / (chosen.len().max(1) * CODE) as f32;
        for (g, &i) in g.chunks_exact_mut(CODE).zip(chosen) {
            let uncertain = 1.0 / (1.0 + (-self.doubts[i]).exp());
            let pull = weight * (SMOOTH_LEAST + (1.0 - SMOOTH_LEAST) * uncertain);
            for (c, g) in g.iter_mut().enumerate() {
                *g = scale * (*g - self.codes[i * CODE + c]);
                by_code[i * CODE + c] -= pull * *g;
            }
        }
        self.smoother.backward(&trace, g, by_smoother);
    }

    /// A feature of each Gaussian from its code; `[gaussians][dim]`.
    fn describe(&self, codebook: &[f32], dim: usize, argmax: bool) -> Vec<f32> {
        let mut units = self.codes.clone();
        unit_rows(&mut units, CODE);
        let mut all = Vec::with_capacity(units.len() / CODE * dim);
        // In parts, because the net keeps all its layers.
        for part in units.chunks(1024 * CODE) {
            let mut probability = self.decoder.forward(part, false).output().to_vec();
            softmax(&mut probability, self.entries);
            for row in probability.chunks_exact(self.entries) {
                let likeliest = row.iter().enumerate().fold(0, |best, (k, &p)| if p > row[best] { k } else { best });
                let mut sum = vec![0.0; dim];
                for (k, &p) in row.iter().enumerate() {
                    let p = if argmax { f32::from(u8::from(k == likeliest)) } else { p };
                    // What is as good as zero costs time alone.
                    if p > 1e-6 {
                        sum.iter_mut().zip(&codebook[k * dim..(k + 1) * dim]).for_each(|(s, c)| *s += p * c);
                    }
                }
                all.extend(sum);
            }
        }
        unit_rows(&mut all, dim);
        all
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn learner(gaussians: usize, entries: usize) -> Learner {
        Learner::new(gaussians, entries, &mut ChaCha8Rng::seed_from_u64(5))
    }

    /// One pixel of two Gaussians.
    fn pixel() -> ViewPixels {
        ViewPixels { view: 0, masks: vec![0], ptr: vec![0, 2], gaussian: vec![0, 1], weight: vec![0.5, 0.25] }
    }

    #[test]
    fn k_means_finds_directions_by_weight_and_no_more_than_there_are() {
        let h = 0.5f32.sqrt();
        // (1, 0) three times as heavy as (h, h): their centre is (3 + h, h) / |.| = (3.707, 0.707) / 3.774 = (0.982, 0.187).
        let points = [1.0, 0.0, h, h, -1.0, 0.0];
        let mut rng = ChaCha8Rng::seed_from_u64(0);
        let two = k_means(&points, &[3.0, 1.0, 1.0], 2, 2, &mut rng);
        let entry: Vec<usize> = nearest(&points, &two, 2).iter().map(|e| e.0).collect();
        assert!(entry[0] != entry[2], "{two:?}");
        if entry[0] == entry[1] {
            let c = &two[entry[0] * 2..][..2];
            assert!((c[0] - 0.982).abs() < 1e-3 && (c[1] - 0.187).abs() < 1e-3, "{two:?}");
        }
        assert_eq!(k_means(&points, &[3.0, 1.0, 1.0], 2, 128, &mut rng).len(), 3 * 2);
    }

    #[test]
    fn softmax_of_logits_worked_out_by_hand() {
        // exp(ln 3) : exp(0) = 3 : 1, also far from zero.
        let mut p = [3f32.ln(), 0.0, 200.0 + 3f32.ln(), 200.0];
        softmax(&mut p, 2);
        assert!(p.iter().zip([0.75, 0.25, 0.75, 0.25]).all(|(a, b)| (a - b).abs() < 1e-4), "{p:?}");
    }

    #[test]
    fn positions_do_not_depend_on_the_unit() {
        let one = centred(vec![[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]]);
        assert_eq!(one, [[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]);
        assert_eq!(centred(vec![[10.0, 5.0, 5.0], [30.0, 5.0, 5.0]]), one);
        assert_eq!(centred(vec![[3.0; 3]]), [[0.0; 3]]);
    }

    #[test]
    fn gradients_are_finite_differences() {
        let mut all = learner(2, 3);
        all.doubts = vec![-1.0, 0.5];
        // The loss of the one pixel: (1 - u) entropy - ln(1 - u), u = 0.5 s(-1) + 0.25 s(0.5).
        let loss = |all: &Learner| {
            let entropy = all.gradients(&pixel(), 0..1, &[2], &mut [0.0; 16], &mut [0.0; 2], &mut zeros(all));
            let u: f64 =
                [(0, 0.5), (1, 0.25)].iter().map(|&(i, w)| w / (1.0 + (-f64::from(all.doubts[i])).exp())).sum();
            (1.0 - u) * entropy - (1.0 - u).ln()
        };
        let (mut by_code, mut by_doubt) = ([0.0; 16], [0.0; 2]);
        all.gradients(&pixel(), 0..1, &[2], &mut by_code, &mut by_doubt, &mut zeros(&all));
        let step = 1e-2;
        for at in 0..18 {
            let [up, down] = [step, -step].map(|s| {
                let mut moved = learner(2, 3);
                moved.doubts.clone_from(&all.doubts);
                if at < 16 {
                    moved.codes[at] += s;
                } else {
                    moved.doubts[at - 16] += s;
                }
                loss(&moved)
            });
            let found = f64::from(if at < 16 { by_code[at] } else { by_doubt[at - 16] });
            assert!((found - (up - down) / f64::from(2.0 * step)).abs() < 2e-3, "{at}: {found} {}", (up - down) / 0.02);
        }
    }

    fn zeros(all: &Learner) -> Vec<f32> {
        vec![0.0; all.decoder.parameters.len()]
    }

    #[test]
    fn smoothing_draws_codes_to_what_the_net_says() {
        let all = learner(1, 2);
        let (mut by_code, mut by_net) = ([0.0; CODE], vec![0.0; all.smoother.parameters.len()]);
        all.smooth(&[0], &[[0.1, 0.2, 0.3]], 1.0, &mut by_code, &mut by_net);
        let said = all.smoother.forward(&[0.1, 0.2, 0.3], false).output().to_vec();
        for c in 0..CODE {
            // At doubt 0.01 the pull is 0.1 + 0.9 * 0.01 = 0.109, and the mean over 8 numbers makes 2 / 8 of the difference.
            let expected = 0.109 * 0.25 * (all.codes[c] - said[c]);
            assert!((by_code[c] - expected).abs() < 1e-5, "{by_code:?}");
        }
    }

    #[test]
    fn a_gaussian_is_described_by_its_likeliest_entry_or_by_the_mean() {
        let mut all = learner(1, 2);
        // Only the last biases count: logits ln 3 and 0, so probabilities 3/4 and 1/4.
        all.decoder.parameters.fill(0.0);
        let at = all.decoder.parameters.len() - 2;
        all.decoder.parameters[at] = 3f32.ln();
        assert_eq!(all.describe(&[1.0, 0.0, 0.0, 1.0], 2, true), [1.0, 0.0]);
        // (3, 1) / sqrt(10).
        let mean = all.describe(&[1.0, 0.0, 0.0, 1.0], 2, false);
        assert!((mean[0] - 0.9487).abs() < 1e-3 && (mean[1] - 0.3162).abs() < 1e-3, "{mean:?}");
    }
}
