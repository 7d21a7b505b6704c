//! Terms of the loss that look at single Gaussians or single pixels: the per-pixel InfoNCE that the paper compares with
//! ("Contrastive Learning Strategy"), the same per Gaussian, and OpenGaussian's cohesion of pixels.
//!
//! A term gives its value and its gradient of the columns' features `[columns][d]`, and adds that of the centroids `[K][d]`.

use super::loss::{Prototypes, cohesion};
use super::masks::MaskSet;
use crate::options::{Contrastive, Loss};
use rayon::prelude::*;

/// Pixels worked on at a time.
const CHUNK: usize = 64;

/// The mean over Gaussians of the cross-entropy with the masks' centroids, each by its blending weight in pixels. `feature`
/// writes the feature of a column.
pub fn of_gaussians(
    d: usize,
    tau: f64,
    set: &MaskSet,
    feature: impl Fn(usize, &mut [f64]) + Sync,
    centroids: &[f64],
    to_centroids: &mut [f64],
) -> (f64, Vec<f64>) {
    let prototypes = Prototypes::new(centroids, d, tau);
    let pixels = |(&k, &w): (&u16, &f32)| f64::from(w) * set.pixels[k as usize];
    let total: f64 = set.mask.iter().zip(&set.weight).map(pixels).sum();
    let bounds: Vec<usize> = set.pieces.iter().map(|&c| c as usize).collect();
    sum(&bounds, d, to_centroids, |c, to_centroids, to_feature| {
        let (mut f, mut share) = (vec![0.0; d], vec![0.0; set.len()]);
        feature(c, &mut f);
        let (masks, weights) = set.entries(c);
        for (&k, &w) in masks.iter().zip(weights) {
            share[k as usize] += f64::from(w) * set.pixels[k as usize] / total;
        }
        prototypes.cross_entropy(&f, &share, to_centroids, to_feature)
    })
}

/// The mean over sampled pixels of the cross-entropy with the masks' centroids, and the mean over masks of the mean distance
/// of their pixels from the centroid, as far as `options` ask for them. `noise` chooses pixels where not all take part.
/// `feature` writes the feature of a column.
pub fn of_pixels(
    d: usize,
    options: &Contrastive,
    set: &MaskSet,
    noise: u64,
    feature: impl Fn(usize, &mut [f64]) + Sync,
    centroids: &[f64],
    to_centroids: &mut [f64],
) -> (f64, Vec<f64>) {
    let (pixels, prototypes) = (&set.sampled, Prototypes::new(centroids, d, options.tau));
    let drawn = pixels.drawn(options.pixels, noise);
    let mut of_mask = vec![0.0; set.len()];
    drawn.iter().for_each(|&p| of_mask[pixels.mask[p] as usize] += 1.0);
    let masks = of_mask.iter().filter(|n| **n > 0.0).count() as f64;
    let bounds: Vec<usize> = (0..drawn.len()).step_by(CHUNK).chain([drawn.len()]).collect();
    let (value, to_pixels) = sum(&bounds, d, to_centroids, |i, to_centroids, to_pixel| {
        let p = drawn[i];
        let (mut f, mut one) = (vec![0.0; d], vec![0.0; d]);
        for (c, w) in pixels.entries(p) {
            feature(c, &mut one);
            f.iter_mut().zip(&one).for_each(|(f, v)| *f += w * v);
        }
        let (k, mut value) = (pixels.mask[p] as usize, 0.0);
        if options.loss == Loss::Pixel {
            let mut share = vec![0.0; set.len()];
            share[k] = 1.0 / drawn.len() as f64;
            value += prototypes.cross_entropy(&f, &share, to_centroids, to_pixel);
        }
        if options.cohesion > 0.0 {
            let range = k * d..(k + 1) * d;
            let scale = options.cohesion / (masks * of_mask[k]);
            value += cohesion(&f, &centroids[range.clone()], scale, &mut to_centroids[range], to_pixel);
        }
        value
    });
    let mut to_columns = vec![0.0; set.columns.len() * d];
    for (&p, g) in drawn.iter().zip(to_pixels.chunks_exact(d)) {
        for (c, w) in pixels.entries(p) {
            to_columns[c * d..(c + 1) * d].iter_mut().zip(g).for_each(|(t, g)| *t += w * g);
        }
    }
    (value, to_columns)
}

/// Adds up the terms of single points, from one of `bounds` to the next in parallel, and the parts in order. `term` adds its
/// gradients of the centroids and of the point's own feature; those of the features are returned, `[points][d]`.
fn sum(
    bounds: &[usize],
    d: usize,
    centroids: &mut [f64],
    term: impl Fn(usize, &mut [f64], &mut [f64]) -> f64 + Sync,
) -> (f64, Vec<f64>) {
    let length = centroids.len();
    let part = |b: &[usize]| {
        let (mut value, mut to_centroids, mut rows) = (0.0, vec![0.0; length], vec![0.0; (b[1] - b[0]) * d]);
        for (p, row) in (b[0]..b[1]).zip(rows.chunks_exact_mut(d)) {
            value += term(p, &mut to_centroids, row);
        }
        (value, to_centroids, rows)
    };
    let parts: Vec<(f64, Vec<f64>, Vec<f64>)> = bounds.par_windows(2).map(part).collect();
    let (mut total, mut features) = (0.0, Vec::new());
    for (value, to_centroids, rows) in parts {
        total += value;
        centroids.iter_mut().zip(to_centroids).for_each(|(c, g)| *c += g);
        features.extend(rows);
    }
    (total, features)
}
