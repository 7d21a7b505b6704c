//! Features of any dimension, blended like colours, and their gradients.

use crate::backward::gather;
use crate::kernels::ALPHA_MAX;
use crate::project::{Splat, SplatGradient};
use crate::tiles::{PIXELS, TILE};
use crate::types::{Gradients, RasterOptions};
use crate::weights::{TileWeights, tile_weights, tiles_without_color, with_weights};
use gs_scene::{Camera, Gaussians};
use rayon::prelude::*;

/// Renders features: sum of blending weight times feature, `[height][width][dim]`, over a zero background.
///
/// # Panics
/// When `features` is not `[N][dim]`.
pub fn render_features(
    g: &Gaussians,
    features: &[f32],
    dim: usize,
    camera: &Camera,
    options: &RasterOptions,
) -> Vec<f32> {
    assert_eq!(features.len(), g.len() * dim);
    let (w, h) = (camera.width as usize, camera.height as usize);
    let tiles = tile_weights(g, camera, options, true, |t| {
        let mut out = vec![0.0f32; t.width * t.height * dim];
        for (&i, weights) in t.gaussians.iter().zip(t.weights.chunks_exact(PIXELS)) {
            let feature = &features[i as usize * dim..(i as usize + 1) * dim];
            for y in 0..t.height {
                for x in 0..t.width {
                    let weight = weights[y * TILE + x];
                    if weight > 0.0 {
                        let at = (y * t.width + x) * dim;
                        for (o, f) in out[at..at + dim].iter_mut().zip(feature) {
                            *o += weight * f;
                        }
                    }
                }
            }
        }
        (t.x0, t.y0, t.width, out)
    });
    let mut image = vec![0.0; w * h * dim];
    for (x0, y0, width, values) in tiles {
        for (y, row) in values.chunks_exact(width * dim).enumerate() {
            let at = ((y0 + y) * w + x0) * dim;
            image[at..at + width * dim].copy_from_slice(row);
        }
    }
    image
}

/// What [`features_backward`] returns.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct FeatureGradients {
    /// d loss / d features, `[N][dim]`.
    pub features: Vec<f32>,
    /// d loss / d the Gaussians' parameters, through the blending weights; zero for the harmonics.
    pub parameters: Gradients,
}

/// d loss / d features and parameters, given `d_image`, d loss / d what [`render_features`] returns for the same arguments,
/// `[height][width][dim]`. The sums run over tiles in tile order: the same bits for any number of threads.
///
/// # Panics
/// When `features` is not `[N][dim]` or `d_image` not `[height][width][dim]`.
pub fn features_backward(
    g: &Gaussians,
    features: &[f32],
    dim: usize,
    camera: &Camera,
    options: &RasterOptions,
    d_image: &[f32],
) -> FeatureGradients {
    assert_eq!(features.len(), g.len() * dim);
    assert_eq!(d_image.len(), camera.width as usize * camera.height as usize * dim);
    let tiles = tiles_without_color(g, camera, options);
    let of_tiles: Vec<(Vec<SplatGradient>, Vec<f32>)> = (0..tiles.count())
        .into_par_iter()
        .map(|t| {
            let splats = tiles.list(t).iter().map(|&e| &tiles.splats[e as usize]);
            with_weights(&tiles, t, true, |w| tile_backward(w, splats, features, dim, camera.width as usize, d_image))
        })
        .collect();

    let mut d_features = vec![0.0; features.len()];
    let mut pairs = Vec::with_capacity(tiles.entries.len());
    for (t, (of_splats, of_features)) in of_tiles.into_iter().enumerate() {
        for (&e, d) in tiles.list(t).iter().zip(of_features.chunks_exact(dim.max(1))) {
            let at = tiles.index[e as usize] as usize * dim;
            for (sum, d) in d_features[at..at + dim].iter_mut().zip(d) {
                *sum += d;
            }
        }
        pairs.extend(of_splats);
    }
    let mut parameters = Gradients::default();
    gather(g, options, &tiles, &pairs, &mut parameters);
    FeatureGradients { features: d_features, parameters }
}

/// Gradients of the splats of a tile and of their features, in the order of its list.
fn tile_backward<'a>(
    t: &TileWeights<'_>,
    splats: impl Iterator<Item = &'a Splat>,
    features: &[f32],
    dim: usize,
    image_width: usize,
    d_image: &[f32],
) -> (Vec<SplatGradient>, Vec<f32>) {
    // Channel after channel, so that the loops below run along pixels.
    let mut d = vec![[0.0f32; PIXELS]; dim];
    for y in 0..t.height {
        for x in 0..t.width {
            let from = ((t.y0 + y) * image_width + t.x0 + x) * dim;
            for (plane, v) in d.iter_mut().zip(&d_image[from..from + dim]) {
                plane[y * TILE + x] = *v;
            }
        }
    }
    // Per Gaussian and pixel: features . d image.
    let mut values = vec![[0.0f32; PIXELS]; t.gaussians.len()];
    let mut of_features = vec![0.0; t.gaussians.len() * dim];
    // Weights times values of what lies behind, per pixel; first of everything.
    let mut behind = [0.0f32; PIXELS];
    for (g, (value, weight)) in values.iter_mut().zip(t.weights.chunks_exact(PIXELS)).enumerate() {
        let id = t.gaussians[g] as usize;
        for (k, plane) in d.iter().enumerate() {
            let f = features[id * dim + k];
            for p in 0..PIXELS {
                value[p] += f * plane[p];
            }
            of_features[g * dim + k] = dot(weight, plane);
        }
        for p in 0..PIXELS {
            behind[p] += weight[p] * value[p];
        }
    }
    let mut out = Vec::with_capacity(t.gaussians.len());
    let layers = t.alphas.chunks_exact(PIXELS).zip(t.weights.chunks_exact(PIXELS));
    for ((s, value), (alpha, weight)) in splats.zip(&values).zip(layers) {
        let [a, b, c] = s.conic;
        let mut d = SplatGradient::default();
        for y in 0..t.height {
            for x in 0..t.width {
                let p = y * TILE + x;
                if weight[p] == 0.0 {
                    continue;
                }
                behind[p] -= weight[p] * value[p];
                if alpha[p] >= ALPHA_MAX {
                    continue;
                }
                // alpha = opacity exp(-sigma) and d loss / d alpha = T value - (what lies behind) / (1 - alpha).
                let d_sigma = behind[p] * alpha[p] / (1.0 - alpha[p]) - weight[p] * value[p];
                let (dx, dy) = ((t.x0 + x) as f32 + 0.5 - s.mean[0], (t.y0 + y) as f32 + 0.5 - s.mean[1]);
                d.opacity -= d_sigma / s.opacity;
                d.conic[0] += 0.5 * dx * dx * d_sigma;
                d.conic[1] += dx * dy * d_sigma;
                d.conic[2] += 0.5 * dy * dy * d_sigma;
                let (gx, gy) = (-(a * dx + b * dy) * d_sigma, -(b * dx + c * dy) * d_sigma);
                d.mean[0] += gx;
                d.mean[1] += gy;
                d.mean_abs[0] += gx.abs();
                d.mean_abs[1] += gy.abs();
            }
        }
        out.push(d);
    }
    (out, of_features)
}

/// Sixteen partial sums, so that it vectorises, in a fixed order.
fn dot(a: &[f32], b: &[f32; PIXELS]) -> f32 {
    let mut sums = [0.0f32; TILE];
    for (a, b) in a.chunks_exact(TILE).zip(b.chunks_exact(TILE)) {
        for l in 0..TILE {
            sums[l] += a[l] * b[l];
        }
    }
    sums.iter().sum()
}
