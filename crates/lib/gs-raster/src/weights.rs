//! Per-pixel weights, for footprints, silhouettes and features.

use crate::kernels::weights_tile;
use crate::tiles::{PIXELS, Tiles};
use crate::types::RasterOptions;
use gs_scene::{Camera, Gaussians};
use rayon::prelude::*;

/// Alphas and blending weights of a tile. Pixel (x, y) of the image is at index (y - y0) * TILE + (x - x0).
pub struct TileWeights<'a> {
    /// Left edge in pixels.
    pub x0: usize,
    /// Top edge in pixels.
    pub y0: usize,
    /// Width within the image, at most [`crate::TILE`].
    pub width: usize,
    /// Height within the image, at most [`crate::TILE`].
    pub height: usize,
    /// Original indices of the Gaussians that touch the tile, front to back; G of them.
    pub gaussians: &'a [u32],
    /// alpha of each Gaussian at each pixel, 0 where it is skipped; `[G][TILE * TILE]`.
    pub alphas: &'a [f32],
    /// Blending weight T * alpha, `[G][TILE * TILE]`.
    pub weights: &'a [f32],
    /// Accumulated alpha, `[TILE * TILE]`.
    pub alpha: &'a [f32],
}

/// Calls `f` for every tile of the view, in parallel, and returns the results in tile order (row by row). With
/// `early_stop` pixels take nothing more once their transmittance is spent, as when rendering; without, alphas of hidden
/// Gaussians are there too.
pub fn tile_weights<R: Send>(
    g: &Gaussians,
    camera: &Camera,
    options: &RasterOptions,
    early_stop: bool,
    f: impl Fn(&TileWeights<'_>) -> R + Sync,
) -> Vec<R> {
    // Nobody asks for colours: the harmonics are skipped.
    let tiles = Tiles::new(g, camera, &RasterOptions { sh_degree: 0, ..options.clone() });
    let one = |t: usize| {
        let tile = tiles.tile(t);
        let (x0, y0, width, height) = tile.rectangle;
        let gaussians: Vec<u32> = tile.list.iter().map(|&e| tiles.index[e as usize]).collect();
        let [mut alphas, mut weights] = [(); 2].map(|()| vec![0.0; gaussians.len() * PIXELS]);
        let alpha = weights_tile(tile, early_stop, &mut alphas, &mut weights);
        let [alphas, weights] = [&alphas, &weights];
        f(&TileWeights { x0, y0, width, height, gaussians: &gaussians, alphas, weights, alpha: &alpha })
    };
    (0..tiles.count()).into_par_iter().map(one).collect()
}
