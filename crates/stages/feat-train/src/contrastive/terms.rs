//! Terms of the loss that look at single Gaussians or single pixels: the per-pixel InfoNCE that the paper compares with
//! ("Contrastive Learning Strategy"), the same per Gaussian, and OpenGaussian's cohesion of pixels.

use super::loss::{self, Prototypes};
use super::masks::{MaskSet, Pixels};
use crate::options::{Contrastive, Loss};
use rayon::prelude::*;

/// Pixels worked on at a time.
const CHUNK: usize = 64;

/// The mean over Gaussians of the cross-entropy with the masks' centroids, each by its blending weight in pixels.
pub struct GaussianTerms<'a> {
    set: &'a MaskSet,
    prototypes: Prototypes,
    /// Blending weight of all entries, in pixels.
    total: f64,
}

impl<'a> GaussianTerms<'a> {
    /// For the columns of `set`, whose masks have these `centroids` `[K][d]`.
    pub fn new(d: usize, tau: f64, set: &'a MaskSet, centroids: &[f64]) -> Self {
        let pixels = |(&k, &w): (&u16, &f32)| f64::from(w) * set.pixels[k as usize];
        let total = set.mask.iter().zip(&set.weight).map(pixels).sum();
        Self { set, prototypes: Prototypes::new(centroids, d, tau), total }
    }

    /// The term of column `c` with feature `f`; adds its gradients of the centroids and of the feature where asked for.
    pub fn add(&self, c: usize, f: &[f64], centroids: Option<&mut [f64]>, feature: Option<&mut [f64]>) -> f64 {
        let (masks, weights) = self.set.entries(c);
        let mut share = vec![0.0; self.set.len()];
        for (&k, &w) in masks.iter().zip(weights) {
            share[k as usize] += f64::from(w) * self.set.pixels[k as usize] / self.total;
        }
        self.prototypes.cross_entropy(f, &share, centroids, feature)
    }
}

/// Terms of the loss that look at single pixels: the mean over pixels of the cross-entropy with the masks' centroids, and
/// the mean over masks of the mean distance of their pixels from the centroid.
pub struct PixelTerms<'a> {
    d: usize,
    options: &'a Contrastive,
    centroids: &'a [f64],
    prototypes: Prototypes,
    /// Sampled pixels of each mask.
    pixels: Vec<f64>,
    /// Masks that have any.
    masks: f64,
}

impl<'a> PixelTerms<'a> {
    /// For the pixels of `set`, whose masks have these `centroids` `[K][d]`.
    pub fn new(d: usize, options: &'a Contrastive, set: &'a MaskSet, centroids: &'a [f64]) -> Self {
        let mut pixels = vec![0.0; set.len()];
        set.sampled.mask.iter().for_each(|&k| pixels[k as usize] += 1.0);
        let masks = pixels.iter().filter(|n| **n > 0.0).count() as f64;
        let prototypes = Prototypes::new(centroids, d, options.tau);
        Self { d, options, centroids, prototypes, pixels, masks }
    }

    /// The terms; adds their gradient of the centroids and returns that of the columns' features `[columns][d]`. `feature`
    /// writes the feature of a column.
    pub fn gradients(
        &self,
        pixels: &Pixels,
        columns: usize,
        feature: impl Fn(usize, &mut [f64]) + Sync,
        centroids: &mut [f64],
    ) -> (f64, Vec<f64>) {
        let d = self.d;
        let all: Vec<usize> = (0..pixels.len()).collect();
        // Per chunk of pixels: the terms, their gradient of the centroids, and of the pixels' features.
        let parts: Vec<(f64, Vec<f64>, Vec<f64>)> = all
            .par_chunks(CHUNK)
            .map(|some| {
                let mut to_centroids = vec![0.0; centroids.len()];
                let mut to_pixels = vec![0.0; some.len() * d];
                let (mut f, mut one) = (vec![0.0; d], vec![0.0; d]);
                let mut value = 0.0;
                for (&p, to_pixel) in some.iter().zip(to_pixels.chunks_exact_mut(d)) {
                    f.fill(0.0);
                    for (c, w) in pixels.entries(p) {
                        feature(c, &mut one);
                        f.iter_mut().zip(&one).for_each(|(f, v)| *f += w * v);
                    }
                    value += self.of_pixel(&f, pixels.mask[p] as usize, pixels.len(), &mut to_centroids, to_pixel);
                }
                (value, to_centroids, to_pixels)
            })
            .collect();
        let mut value = 0.0;
        let mut to_columns = vec![0.0; columns * d];
        for (some, (part, to_centroids, to_pixels)) in all.chunks(CHUNK).zip(parts) {
            value += part;
            centroids.iter_mut().zip(&to_centroids).for_each(|(c, g)| *c += g);
            for (&p, g) in some.iter().zip(to_pixels.chunks_exact(d)) {
                for (c, w) in pixels.entries(p) {
                    to_columns[c * d..(c + 1) * d].iter_mut().zip(g).for_each(|(t, g)| *t += w * g);
                }
            }
        }
        (value, to_columns)
    }

    /// The terms of one of `count` pixels, of mask `k` and with feature `f`.
    fn of_pixel(&self, f: &[f64], k: usize, count: usize, centroids: &mut [f64], feature: &mut [f64]) -> f64 {
        let (s, d) = (self.options, self.d);
        let mut value = 0.0;
        if s.loss == Loss::Pixel {
            let mut share = vec![0.0; self.pixels.len()];
            share[k] = 1.0 / count as f64;
            value += self.prototypes.cross_entropy(f, &share, Some(&mut *centroids), Some(&mut *feature));
        }
        if s.cohesion > 0.0 {
            let range = k * d..(k + 1) * d;
            let scale = s.cohesion / (self.masks * self.pixels[k]);
            value +=
                loss::cohesion(f, &self.centroids[range.clone()], scale, Some(&mut centroids[range]), Some(feature));
        }
        value
    }
}
