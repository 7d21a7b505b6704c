//! Terms of the loss that look at single Gaussians or single pixels: the per-pixel InfoNCE that the paper compares with
//! ("Contrastive Learning Strategy"), the same per Gaussian, and OpenGaussian's cohesion of pixels.
//!
//! A term gives its value and its gradient of the columns' features `[columns][d]`, and adds that of the centroids `[K][d]`.

use super::loss::{self, Prototypes, cohesion};
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
    sum(&bounds, d, &prototypes, to_centroids, |c, room, sums, to_feature| {
        let Room { f, share, entropy, .. } = room;
        feature(c, f);
        share.fill(0.0);
        let (masks, weights) = set.entries(c);
        for (&k, &w) in masks.iter().zip(weights) {
            share[k as usize] += f64::from(w) * set.pixels[k as usize] / total;
        }
        prototypes.cross_entropy(f, share, entropy, &mut sums.directions, to_feature)
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
    let (value, to_pixels) = sum(&bounds, d, &prototypes, to_centroids, |i, room, sums, to_pixel| {
        let p = drawn[i];
        let Room { f, one, share, entropy } = room;
        f.fill(0.0);
        for (c, w) in pixels.entries(p) {
            feature(c, one);
            f.iter_mut().zip(&*one).for_each(|(f, v)| *f += w * v);
        }
        let (k, mut value) = (pixels.mask[p] as usize, 0.0);
        if options.loss == Loss::Pixel {
            share.fill(0.0);
            share[k] = 1.0 / drawn.len() as f64;
            value += prototypes.cross_entropy(f, share, entropy, &mut sums.directions, to_pixel);
        }
        if options.cohesion > 0.0 {
            let range = k * d..(k + 1) * d;
            let scale = options.cohesion / (masks * of_mask[k]);
            value += cohesion(f, &centroids[range.clone()], scale, &mut sums.centroids[range], to_pixel);
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

/// Room for one point: features, shares in masks.
struct Room {
    f: Vec<f64>,
    one: Vec<f64>,
    share: Vec<f64>,
    entropy: loss::Room,
}

/// Gradients of the masks' centroids `[K][d]`: those that come by way of their directions, and the others.
struct Sums {
    directions: Vec<f64>,
    centroids: Vec<f64>,
}

/// Adds up the terms of single points, from one of `bounds` to the next in parallel, and the parts in order. `term` adds its
/// gradients of the masks and of the point's own feature; those of the features are returned, `[points][d]`.
fn sum(
    bounds: &[usize],
    d: usize,
    prototypes: &Prototypes,
    centroids: &mut [f64],
    term: impl Fn(usize, &mut Room, &mut Sums, &mut [f64]) -> f64 + Sync,
) -> (f64, Vec<f64>) {
    let length = centroids.len();
    let empty = || Sums { directions: vec![0.0; length], centroids: vec![0.0; length] };
    let part = |b: &[usize]| {
        let (f, share) = (vec![0.0; d], vec![0.0; length / d]);
        let mut room = Room { one: f.clone(), f, share, entropy: loss::Room::default() };
        let (mut value, mut sums, mut rows) = (0.0, empty(), vec![0.0; (b[1] - b[0]) * d]);
        for (p, row) in (b[0]..b[1]).zip(rows.chunks_exact_mut(d)) {
            value += term(p, &mut room, &mut sums, row);
        }
        (value, sums, rows)
    };
    let parts: Vec<(f64, Sums, Vec<f64>)> = bounds.par_windows(2).map(part).collect();
    let (mut total, mut all, mut features) = (0.0, empty(), Vec::new());
    for (value, sums, rows) in parts {
        total += value;
        all.directions.iter_mut().zip(sums.directions).for_each(|(a, g)| *a += g);
        all.centroids.iter_mut().zip(sums.centroids).for_each(|(a, g)| *a += g);
        features.extend(rows);
    }
    prototypes.add_gradient(&all.directions, centroids);
    centroids.iter_mut().zip(all.centroids).for_each(|(c, g)| *c += g);
    (total, features)
}
