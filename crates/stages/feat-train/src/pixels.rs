//! Single pixels: the per-pixel InfoNCE that the paper compares with ("Contrastive Learning Strategy"), and OpenGaussian's
//! cohesion of pixels.
//!
//! Rendering is as linear for a pixel as it is for a mask: the feature of pixel p is the row w[p,.] times the features.
//! graph-precompute keeps the rows of some pixels of each mask (`--pixel-samples`), so these losses need no rasteriser.

use crate::loss::{self, Loss, Prototypes};
use crate::model::{CohesionOf, Settings};
use crate::real::Weight;
use crate::scene::MaskSet;
use artifacts::PixelSamples;
use rayon::prelude::*;

/// Pixels worked on at a time.
const CHUNK: usize = 64;

/// Pixels of the masks of one view: a sparse matrix of pixels and columns of the [`MaskSet`].
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Pixels {
    /// Mask of each pixel, below K, ascending; P.
    pub mask: Vec<u16>,
    /// Where the entries of each pixel begin; P + 1, or empty.
    pub start: Vec<u32>,
    /// Column of each entry, as a position in [`MaskSet::columns`].
    pub column: Vec<u32>,
    /// Blending weight of each entry.
    pub weight: Vec<f32>,
}

impl Pixels {
    /// Those of the masks `rows` (ascending rows of the footprints). `column` gives the position of a kept Gaussian among
    /// the columns; entries without one, which a cut of the footprints may leave, are dropped.
    pub fn of_masks(samples: &PixelSamples, rows: &[u32], column: impl Fn(u32) -> Option<u32>) -> Self {
        let mut out = Self { start: vec![0], ..Self::default() };
        for (k, &row) in rows.iter().enumerate() {
            let from = samples.row.partition_point(|&r| r < row);
            let to = from + samples.row[from..].partition_point(|&r| r == row);
            for p in from..to {
                for e in samples.ptr[p] as usize..samples.ptr[p + 1] as usize {
                    if let Some(c) = column(samples.col[e]) {
                        out.column.push(c);
                        out.weight.push(samples.weight[e]);
                    }
                }
                out.mask.push(k as u16);
                out.start.push(out.column.len() as u32);
            }
        }
        out
    }

    /// Number of pixels.
    pub fn len(&self) -> usize {
        self.mask.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.mask.is_empty()
    }

    /// Columns and weights of pixel `p`.
    fn entries(&self, p: usize) -> impl Iterator<Item = (usize, f64)> + '_ {
        let range = self.start[p] as usize..self.start[p + 1] as usize;
        self.column[range.clone()].iter().zip(&self.weight[range]).map(|(&c, &w)| (c as usize, f64::from(w)))
    }
}

/// Terms of the loss that look at single pixels: the mean over pixels of the cross-entropy with the masks' centroids, and
/// the mean over masks of the mean distance of their pixels from the centroid.
pub struct Terms<'a> {
    settings: &'a Settings,
    centroids: &'a [f64],
    prototypes: Prototypes,
    /// Sampled pixels of each mask.
    pixels: Vec<f64>,
    /// Masks that have any.
    masks: f64,
}

impl<'a> Terms<'a> {
    /// For the pixels of `set`, whose masks have these `centroids` `[K][d]`.
    pub fn new<W: Weight>(settings: &'a Settings, set: &'a MaskSet<W>, centroids: &'a [f64]) -> Self {
        let mut pixels = vec![0.0; set.len()];
        set.sampled.mask.iter().for_each(|&k| pixels[k as usize] += 1.0);
        let masks = pixels.iter().filter(|n| **n > 0.0).count() as f64;
        let prototypes = Prototypes::new(centroids, settings.dim, settings.tau);
        Self { settings, centroids, prototypes, pixels, masks }
    }

    /// The terms; adds their gradient of the centroids and gives that of the columns' features `[columns][d]`. `feature`
    /// writes the feature of a column.
    pub fn gradients(
        &self,
        pixels: &Pixels,
        columns: usize,
        feature: impl Fn(usize, &mut [f64]) + Sync,
        centroids: &mut [f64],
    ) -> (f64, Vec<f64>) {
        let d = self.settings.dim;
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
        let (s, d) = (self.settings, self.settings.dim);
        let mut value = 0.0;
        if s.loss == Loss::Pixel {
            let mut share = vec![0.0; self.pixels.len()];
            share[k] = 1.0 / count as f64;
            value += self.prototypes.cross_entropy(f, &share, Some(&mut *centroids), Some(&mut *feature));
        }
        if s.cohesion > 0.0 && s.cohesion_of == CohesionOf::Pixels {
            let range = k * d..(k + 1) * d;
            let scale = s.cohesion / (self.masks * self.pixels[k]);
            value +=
                loss::cohesion(f, &self.centroids[range.clone()], scale, Some(&mut centroids[range]), Some(feature));
        }
        value
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_follow_their_masks_and_cut_entries_are_dropped() {
        let samples = PixelSamples {
            row: vec![3, 5, 5, 9],
            ptr: vec![0, 1, 3, 4, 5],
            col: vec![0, 1, 2, 1, 7],
            weight: vec![0.1, 0.2, 0.3, 0.4, 0.5],
        };
        let p = Pixels::of_masks(&samples, &[4, 5, 9], |c| (c != 2).then_some(c + 10));
        let want = Pixels {
            mask: vec![1, 1, 2],
            start: vec![0, 1, 2, 3],
            column: vec![11, 11, 17],
            weight: vec![0.2, 0.4, 0.5],
        };
        assert_eq!(p, want);
        assert!(Pixels::of_masks(&PixelSamples::default(), &[1, 2], Some).is_empty());
    }
}
