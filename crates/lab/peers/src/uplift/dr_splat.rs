//! Dr. Splat (arXiv 2502.16652): the strongest Gaussians of every pixel take the feature of its mask; product
//! quantisation.
//!
//! Every pixel of every view gives the feature of its mask to the Gaussians with the largest blending weights there (40
//! in the paper's tables, 45 in the README). Weights of one Gaussian and one mask are summed over pixels; the
//! descriptor is the mean of the masks' features, weighted by these sums over their total (the paper's w_ij and f_i),
//! at unit length. Neither the equations nor the code divide weights by the sum of a pixel's strongest; `--even` does,
//! so that every pixel counts alike. The authors keep a dense table of Gaussians and masks; here it is sparse.
//!
//! Masks are those of the id maps, small ones too, and every pixel counts, whatever its accumulated alpha: the authors
//! drop neither. The code shows an intention to weigh masks evenly where a Gaussian has less than 0.0001 weight in all,
//! but the statement changes a copy and so does nothing. It is left out.
//!
//! The authors quantise each descriptor of 512 numbers to 128 bytes (128 parts, 256 centres each), with centres learned
//! from features of a large set of photographs. There is no such set at hand, so centres are learned from the scene's
//! own descriptors, by k-means from a seeded draw. That is at least as kind: the centres fit this scene (and k-means
//! even takes some noise away). Where features have fewer than 256 numbers, parts are of two numbers each.

use super::quantise::{Codebook, quantise};
use super::{PIXELS, by_pixels, described, slots, weighted_mean};
use crate::cli::Peer;
use crate::product::Product;
use crate::world::{Inputs, World};
use artifacts::Descriptors;
use gs_io::Result;
use serde::Serialize;
use stage::Stage;

/// Rounds of k-means: the default of faiss, the library that the authors quantise with.
const ROUNDS: usize = 25;
/// Descriptors that k-means sees, for each centre. faiss wants 39 to 256; a scene's descriptors are alike and need
/// fewer.
const LEARNING: usize = 10;
/// Bytes of a quantised descriptor, but no more than half as many as a descriptor has numbers (the authors).
const PARTS: usize = 128;
/// Centres for each byte (the authors).
const CENTRES: usize = 256;

/// Settings of Dr. Splat.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct DrSplatOptions {
    #[command(flatten)]
    #[serde(flatten)]
    inputs: Inputs,
    /// Gaussians that take the feature of a pixel, those with the largest blending weights; 1 to 1000
    #[arg(long, value_name = "COUNT", default_value_t = 40, value_parser = stage::within(1usize..=1000))]
    top_k: usize,
    /// Divide the weights of a pixel's Gaussians by their sum
    #[arg(long)]
    even: bool,
    /// Leave descriptors as they are
    #[arg(long)]
    no_quantisation: bool,
}

impl Peer for DrSplatOptions {
    fn inputs(&self) -> &Inputs {
        &self.inputs
    }

    fn format(&self) -> &'static str {
        Descriptors::FORMAT
    }

    fn make(&self, world: &World, stage: &Stage) -> Result<Product> {
        let shares = by_pixels(world, stage, |weights| {
            keep_top(weights, PIXELS, self.top_k);
            if self.even {
                even_out(weights, PIXELS);
            }
        })?;
        let mut table = described(world, slots(&world.levels).len(), &shares, weighted_mean);
        if !self.no_quantisation {
            let codebook = Codebook {
                parts: PARTS.min(table.dim / 2),
                centres: CENTRES,
                rounds: ROUNDS,
                most: LEARNING * CENTRES,
                seed: stage.seed(),
            };
            quantise(&mut table.values, table.dim, &codebook);
        }
        Ok(Product::Descriptors(table))
    }
}

/// Leaves only the `k` largest of the weights at each of some pixels, `[Gaussian][pixel]`; of equals the first.
fn keep_top(weights: &mut [f32], pixels: usize, k: usize) {
    let mut counts = vec![0; pixels];
    for row in weights.chunks_exact(pixels) {
        counts.iter_mut().zip(row).for_each(|(c, &w)| *c += usize::from(w > 0.0));
    }
    let mut found: Vec<(f32, usize)> = Vec::new();
    for pixel in (0..pixels).filter(|&p| counts[p] > k) {
        found.clear();
        let at = (pixel..weights.len()).step_by(pixels);
        found.extend(at.map(|at| (weights[at], at)).filter(|(w, _)| *w > 0.0));
        found.select_nth_unstable_by(k, |a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        found[k..].iter().for_each(|&(_, at)| weights[at] = 0.0);
    }
}

/// Divides the weights at each of some pixels by their sum.
fn even_out(weights: &mut [f32], pixels: usize) {
    let mut sums = vec![0.0; pixels];
    for row in weights.chunks_exact(pixels) {
        sums.iter_mut().zip(row).for_each(|(s, &w)| *s += w);
    }
    for row in weights.chunks_exact_mut(pixels) {
        row.iter_mut().zip(&sums).filter(|(_, s)| **s > 0.0).for_each(|(w, s)| *w /= s);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_largest_weights_of_a_pixel_stay() {
        // Three Gaussians at two pixels.
        let mut weights = vec![0.2, 0.5, 0.3, 0.0, 0.2, 0.25];
        keep_top(&mut weights, 2, 2);
        assert_eq!(weights, [0.2, 0.5, 0.3, 0.0, 0.0, 0.25], "of equals the first stays");
        even_out(&mut weights, 2);
        let expected = [0.4, 2.0 / 3.0, 0.6, 0.0, 0.0, 1.0 / 3.0];
        assert!(weights.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{weights:?}");
        keep_top(&mut weights, 2, 1);
        assert_eq!(weights.iter().map(|w| *w > 0.0).collect::<Vec<_>>(), [false, true, true, false, false, false]);
    }
}
