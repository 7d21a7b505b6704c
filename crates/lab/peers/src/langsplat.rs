//! LangSplat (Qin et al., CVPR 2024): a scene's autoencoder turns mask features into codes of three numbers, and every
//! Gaussian learns the code that renders to those of the masks. docs/peers.md says what was taken from where.
//!
//! One autoencoder serves all levels, and each level that is used has codes of its own; the descriptors of all of them stand in
//! one row, so that a text takes the best level, as the authors' query does.
//!
//! The codes are learned as the authors learn them: Adam on the mean absolute difference of a view's rendered codes and its
//! masks' codes. Least squares over masks would blur what single pixels tell apart, and least squares over pixels is another
//! loss: it follows wrong masks where the absolute one takes the median. Rendering is linear and the geometry stands still, so
//! that the blending weights of sampled pixels are worked out once.

mod neural;
mod pixels;

pub use neural::{Adam, Net, products, through_unit, unit_rows};
pub use pixels::{Batches, ViewPixels, sample};

use crate::cli::Peer;
use crate::product::{Product, Table};
use crate::world::{Inputs, World};
use artifacts::{Descriptors, flat};
use gs_io::{Error, Result};
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::Serialize;
use stage::Stage;

/// Hidden sizes of the encoder (autoencoder/train.py and process.sh of the authors' repository).
const ENCODER: [usize; 4] = [256, 128, 64, 32];
/// Hidden sizes of the decoder (same).
const DECODER: [usize; 6] = [16, 32, 64, 128, 256, 256];
/// Mask features in a step of the autoencoder (same).
const BATCH: usize = 64;
/// Share of the cosine loss beside the mean squared difference (same).
const COSINE: f32 = 0.001;
/// Adam's epsilon: PyTorch's default for the autoencoder, that of 3DGS for the codes.
const EPSILON: [f32; 2] = [1e-8, 1e-15];
/// Deviation of the codes at the start. The authors start at zero, where a code has no direction to be brought to unit length.
const START: f32 = 0.01;
/// Learning rate of the autoencoder.
const AUTOENCODER_RATE: f32 = 7e-4;
/// Pixels sampled of each view.
const PIXELS: usize = 16384;
/// Pixels in a step of the codes.
const STEP_PIXELS: usize = 1024;

/// Settings.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct Options {
    #[command(flatten)]
    #[serde(flatten)]
    inputs: Inputs,
    /// Numbers in a code, 1 to 256
    #[arg(long, value_name = "COUNT", default_value_t = 3, value_parser = stage::within(1..=256usize))]
    code: usize,
    /// Steps of the autoencoder, of 64 mask features each, 1 or more. The authors take 100 rounds of all masks
    #[arg(long, value_name = "COUNT", default_value_t = 1200, value_parser = stage::within(1..=10_000_000usize))]
    autoencoder_steps: usize,
    /// Steps of the codes, each of one view, 1 or more. The authors take 30000, of whole views
    #[arg(long, value_name = "COUNT", default_value_t = 2500, value_parser = stage::within(1..=10_000_000usize))]
    iterations: usize,
    /// Learning rate of the codes, above 0
    #[arg(long, value_name = "RATE", default_value_t = 0.0025, value_parser = stage::positive::<f32>)]
    rate: f32,
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
        let (n, dim, levels) = (world.kept(), world.dim(), &world.levels);
        let rows = world.rows();
        let used = rows.iter().filter_map(|&r| world.feature(&world.footprints.rows[r as usize]));
        let features: Vec<f32> = used.flatten().copied().collect();
        let autoencoder = Autoencoder::train(&features, dim, self, &mut rng)?;
        stage.info(&format!("autoencoder: mean cosine {:.3}", autoencoder.cosine(&features)));
        let mut values = vec![0.0; n * levels.len() * dim];
        for (slot, &level) in levels.iter().enumerate() {
            let views = sample(world, &[level], PIXELS, &mut rng)?;
            if views.is_empty() {
                return Err(Error::new("no mask with a feature").field("--levels").found(level));
            }
            let goals: Vec<Vec<f32>> = views.iter().map(|v| goals(v, world, &autoencoder)).collect();
            let (codes, loss) = fit(&views, &goals, n, self, &mut rng);
            stage.info(&format!("codes of level {level}: mean difference {loss:.4}"));
            let decoded = autoencoder.decode(&codes);
            let seen = seen(&views, n);
            for ((i, row), decoded) in values.chunks_exact_mut(levels.len() * dim).enumerate().zip(decoded.chunks(dim))
            {
                if seen[i] {
                    row[slot * dim..(slot + 1) * dim].copy_from_slice(decoded);
                }
            }
        }
        Ok(Product::Descriptors(Table { rows: Vec::new(), slots: levels.len(), dim, values }))
    }
}

/// The code of the mask at each pixel.
fn goals(pixels: &ViewPixels, world: &World, autoencoder: &Autoencoder) -> Vec<f32> {
    let features = &world.features[&pixels.view];
    let codes = autoencoder.encode(flat(features.values.view()));
    let code = autoencoder.code;
    pixels.masks.iter().flat_map(|&id| &codes[id as usize * code..(id as usize + 1) * code]).copied().collect()
}

/// Which Gaussians the sampled pixels show.
pub fn seen(views: &[ViewPixels], gaussians: usize) -> Vec<bool> {
    let mut seen = vec![false; gaussians];
    views.iter().flat_map(|v| &v.gaussian).for_each(|&i| seen[i as usize] = true);
    seen
}

/// Features to codes of unit length and back to features of unit length.
struct Autoencoder {
    encoder: Net,
    decoder: Net,
    code: usize,
    dim: usize,
}

impl Autoencoder {
    /// Learns unit `features`, `[masks][dim]`.
    fn train(features: &[f32], dim: usize, options: &Options, rng: &mut impl RngExt) -> Result<Self> {
        let count = features.len() / dim.max(1);
        if count < 2 {
            return Err(Error::new("too few mask features to learn from").found(count).expected("2 or more"));
        }
        let code = options.code;
        let encoder = Net::new(&[&[dim], &ENCODER[..], &[code]].concat(), true, rng);
        let decoder = Net::new(&[&[code], &DECODER[..], &[dim]].concat(), false, rng);
        let mut both = Self { encoder, decoder, code, dim };
        let mut gradients = [&both.encoder, &both.decoder].map(|net| vec![0.0; net.parameters.len()]);
        let mut adam = [0, 1].map(|k| Adam::new(gradients[k].len(), AUTOENCODER_RATE, EPSILON[0], 0.0));
        let mut order: Vec<usize> = (0..count).collect();
        let mut at = count;
        for _ in 0..options.autoencoder_steps {
            // A batch norm needs two rows.
            if at + 2 > count {
                order.shuffle(rng);
                at = 0;
            }
            let rows = &order[at..(at + BATCH).min(count)];
            at += BATCH;
            let batch: Vec<f32> = rows.iter().flat_map(|&r| &features[r * dim..(r + 1) * dim]).copied().collect();
            let trace = both.gradients(&batch, &mut gradients);
            both.encoder.follow(&trace, rows.len());
            adam[0].step(&mut both.encoder.parameters, &gradients[0]);
            adam[1].step(&mut both.decoder.parameters, &gradients[1]);
        }
        Ok(both)
    }

    /// Derivatives of the loss of a batch in training by the parameters of the encoder and the decoder; the encoder's trace.
    fn gradients(&self, batch: &[f32], gradients: &mut [Vec<f32>; 2]) -> neural::Trace {
        let inner = self.encoder.forward(batch, true);
        let mut codes = inner.output().to_vec();
        let code_lengths = unit_rows(&mut codes, self.code);
        let outer = self.decoder.forward(&codes, true);
        let mut outputs = outer.output().to_vec();
        let lengths = unit_rows(&mut outputs, self.dim);
        let rows = lengths.len() as f32;
        let (squared, cosine) = (2.0 / (rows * self.dim as f32), COSINE / rows);
        let mut g: Vec<f32> = outputs.iter().zip(batch).map(|(y, x)| squared * (y - x) - cosine * x).collect();
        through_unit(&mut g, &outputs, &lengths, self.dim);
        let mut g = self.decoder.backward(&outer, g, &mut gradients[1]);
        through_unit(&mut g, &codes, &code_lengths, self.code);
        self.encoder.backward(&inner, g, &mut gradients[0]);
        inner
    }

    fn encode(&self, features: &[f32]) -> Vec<f32> {
        let mut codes = self.encoder.forward(features, false).output().to_vec();
        unit_rows(&mut codes, self.code);
        codes
    }

    /// Features of unit length from codes of any length.
    fn decode(&self, codes: &[f32]) -> Vec<f32> {
        let mut codes = codes.to_vec();
        unit_rows(&mut codes, self.code);
        let mut all = Vec::with_capacity(codes.len() / self.code * self.dim);
        // In parts, because the net keeps all its layers.
        for part in codes.chunks(1024 * self.code) {
            all.extend_from_slice(self.decoder.forward(part, false).output());
        }
        unit_rows(&mut all, self.dim);
        all
    }

    /// Mean cosine of features with what comes back of them.
    fn cosine(&self, features: &[f32]) -> f64 {
        let back = self.decode(&self.encode(features));
        let sum: f64 = features.iter().zip(&back).map(|(a, b)| f64::from(a * b)).sum();
        sum / (features.len() / self.dim).max(1) as f64
    }
}

/// Learns a code of every Gaussian: brought to unit length and rendered, it is to be `goals` `[pixels][code]` of each view. Also
/// returns the mean absolute difference of the last steps.
fn fit(
    views: &[ViewPixels],
    goals: &[Vec<f32>],
    gaussians: usize,
    options: &Options,
    rng: &mut impl RngExt,
) -> (Vec<f32>, f64) {
    let code = options.code;
    let mut codes: Vec<f32> = (0..gaussians * code).map(|_| rng.random_range(-START..=START)).collect();
    let mut adam = Adam::new(codes.len(), options.rate, EPSILON[1], 0.0);
    let mut batches = Batches::default();
    let (mut loss, last) = (0.0, options.iterations.min(100));
    for iteration in 0..options.iterations {
        let Some((view, range)) = batches.draw(views, STEP_PIXELS, rng) else { break };
        let mut units = codes.clone();
        let lengths = unit_rows(&mut units, code);
        let mut g = views[view].render(range.clone(), &units, code);
        let count = g.len().max(1) as f32;
        let mut difference = 0.0;
        for (g, goal) in g.iter_mut().zip(&goals[view][range.start * code..range.end * code]) {
            difference += f64::from((*g - goal).abs() / count);
            *g = if *g > *goal { 1.0 / count } else { -1.0 / count };
        }
        if iteration + last >= options.iterations {
            loss += difference / last as f64;
        }
        let mut by_code = vec![0.0; codes.len()];
        views[view].render_back(range, &g, code, &mut by_code);
        through_unit(&mut by_code, &units, &lengths, code);
        adam.step(&mut codes, &by_code);
    }
    (codes, loss)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::options;

    #[test]
    fn codes_render_to_what_most_pixels_say() {
        // The first Gaussian alone fills four pixels; three say (1, 0), one (0, 1). A mean would point between the two, the least
        // absolute difference at the three. The second shows in the fifth pixel alone, at half its weight.
        let view = ViewPixels {
            view: 0,
            masks: vec![0; 5],
            ptr: vec![0, 1, 2, 3, 4, 5],
            gaussian: vec![0, 0, 0, 0, 1],
            weight: vec![1.0, 1.0, 1.0, 1.0, 0.5],
        };
        let goal = vec![1.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, -1.0];
        let options = options::<Options>("--code 2 --iterations 2000");
        let (mut codes, _) = fit(std::slice::from_ref(&view), &[goal], 3, &options, &mut ChaCha8Rng::seed_from_u64(1));
        unit_rows(&mut codes, 2);
        assert!(codes[0] > 0.98 && codes[3] < -0.98, "{codes:?}");
        assert_eq!(seen(&[view], 3), [true, true, false]);
    }

    #[test]
    fn the_autoencoder_brings_features_back() {
        // Four directions of a space of eight, which fit on a sphere.
        let features: Vec<f32> = (0..64 * 8).map(|k| f32::from(u8::from((k / 8) % 4 == k % 8))).collect();
        let options = options::<Options>("--autoencoder-steps 300");
        let mut rng = ChaCha8Rng::seed_from_u64(0);
        let all = Autoencoder::train(&features, 8, &options, &mut rng).unwrap();
        assert!(all.cosine(&features) > 0.95, "{}", all.cosine(&features));
        let codes = all.encode(&features[..32]);
        assert!(codes.chunks(3).all(|c| (c.iter().map(|v| v * v).sum::<f32>() - 1.0).abs() < 1e-5));
        // A code twice as long stands for the same feature.
        let twice: Vec<f32> = codes.iter().map(|c| 2.0 * c).collect();
        assert!(all.decode(&codes).iter().zip(all.decode(&twice)).all(|(a, b)| (a - b).abs() < 1e-5));
        assert!(Autoencoder::train(&features[..8], 8, &options, &mut rng).is_err());
    }
}
