//! Per-pixel weights, for footprints, silhouettes and features.

use crate::kernels::weights_tile;
use crate::tiles::{PIXELS, TILE, Tiles};
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
    /// Original indices of the Gaussians that touch the tile, front to back; G of them. With an early stop those behind all that
    /// is seen are left out.
    pub gaussians: &'a [u32],
    /// alpha of each Gaussian at each pixel, 0 where it is skipped; `[G][TILE * TILE]`.
    pub alphas: &'a [f32],
    /// Blending weight T * alpha, `[G][TILE * TILE]`.
    pub weights: &'a [f32],
    /// Accumulated alpha, `[TILE * TILE]`.
    pub alpha: &'a [f32],
}

impl TileWeights<'_> {
    /// Alpha and blending weight of the Gaussian at this place of the list at a pixel (x, y) of the image, which lies in the tile.
    pub fn of(&self, place: usize, x: usize, y: usize) -> (f32, f32) {
        let at = place * PIXELS + (y - self.y0) * TILE + x - self.x0;
        (self.alphas[at], self.weights[at])
    }
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
    let tiles = Tiles::new(g, camera, &colourless(options));
    (0..tiles.count()).into_par_iter().map(|t| one_tile(&tiles, t, early_stop, &f)).collect()
}

/// What [`tile_weights`] takes at once in bytes, for so many Gaussians in a view of so many pixels: two numbers for each Gaussian and pixel of a
/// tile, a tile for each thread. A crowded tile has about four times the mean.
pub fn tile_bytes(gaussians: u64, pixels: u64) -> u64 {
    let tiles = (pixels / PIXELS as u64).max(1);
    let crowded = (4 * gaussians / tiles).min(gaussians);
    rayon::current_num_threads() as u64 * crowded * (2 * size_of::<f32>() * PIXELS) as u64
}

/// The Gaussians that a pixel (x, y) of the view shows, front to back, with their blending weights, 0 to 1 and all above 0: what
/// [`tile_weights`] with `early_stop` has of it, without the work for the other tiles. Empty outside the view.
pub fn pixel_weights(g: &Gaussians, camera: &Camera, options: &RasterOptions, [x, y]: [u32; 2]) -> Vec<(u32, f64)> {
    if x >= camera.width || y >= camera.height {
        return Vec::new();
    }
    let (x, y) = (x as usize, y as usize);
    let (tiles, number) = Tiles::around(g, camera, &colourless(options), [x, y]);
    one_tile(&tiles, number, true, &|t: &TileWeights<'_>| {
        let at = (y - t.y0) * TILE + x - t.x0;
        let weights = t.weights.iter().skip(at).step_by(PIXELS).map(|&w| f64::from(w));
        t.gaussians.iter().copied().zip(weights).filter(|w| w.1 > 0.0).collect()
    })
}

/// Nobody asks for colours: the harmonics are skipped.
fn colourless(options: &RasterOptions) -> RasterOptions {
    RasterOptions { sh_degree: 0, ..options.clone() }
}

/// What `f` makes of a tile.
fn one_tile<R>(tiles: &Tiles, number: usize, early_stop: bool, f: &impl Fn(&TileWeights<'_>) -> R) -> R {
    let tile = tiles.tile(number);
    let (x0, y0, width, height) = tile.rectangle;
    let [mut alphas, mut weights] = [(); 2].map(|()| Vec::with_capacity(tile.list.len() * PIXELS));
    let alpha = weights_tile(tile, early_stop, &mut alphas, &mut weights);
    let list = &tile.list[..weights.len() / PIXELS];
    let gaussians: Vec<u32> = list.iter().map(|&e| tiles.index[e as usize]).collect();
    let [alphas, weights] = [&alphas, &weights];
    f(&TileWeights { x0, y0, width, height, gaussians: &gaussians, alphas, weights, alpha: &alpha })
}
