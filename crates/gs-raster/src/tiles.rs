//! Which Gaussians touch which tile, front to back.

use crate::single::project::{Lens, Parameters, Splat, project};
use crate::types::{Dropped, RasterOptions};
use gs_scene::{Camera, Gaussians};
use rayon::prelude::*;

/// Side of a tile in pixels.
pub const TILE: usize = 16;
/// Pixels of a tile.
pub(crate) const PIXELS: usize = TILE * TILE;
/// Gaussians that one task projects: fixed, so that results do not depend on the number of threads.
const CHUNK: usize = 4096;

/// The Gaussians that a view sees, and the lists of its tiles.
pub(crate) struct Tiles {
    pub lens: Lens,
    /// Original indices of the splats, in depth order (ties by index).
    pub index: Vec<u32>,
    /// Projected Gaussians in depth order.
    pub splats: Vec<Splat>,
    /// Where each tile's list begins in `entries`; tiles + 1.
    pub offsets: Vec<usize>,
    /// Positions in `splats`, tile after tile, front to back within each.
    pub entries: Vec<u32>,
    pub columns: usize,
    pub dropped: Dropped,
}

impl Tiles {
    pub fn new(g: &Gaussians, camera: &Camera, options: &RasterOptions) -> Self {
        let lens = Lens::new(camera);
        let chunks: Vec<(Vec<(u64, Splat)>, Dropped)> = (0..g.len().div_ceil(CHUNK))
            .into_par_iter()
            .map(|c| {
                let (mut seen, mut dropped) = (Vec::new(), Dropped::default());
                for i in c * CHUNK..((c + 1) * CHUNK).min(g.len()) {
                    match project(&Parameters::of(g, i), &lens, options) {
                        // Positive floats sort as their bits do; the index below breaks ties.
                        Ok(s) => seen.push(((u64::from(s.depth.to_bits()) << 32) | i as u64, s)),
                        Err(reason) => dropped.count(reason),
                    }
                }
                (seen, dropped)
            })
            .collect();
        let mut dropped = Dropped::default();
        let mut visible = Vec::new();
        for (seen, own) in chunks {
            visible.extend(seen);
            dropped.add(&own);
        }
        visible.par_sort_unstable_by_key(|(key, _)| *key);
        let index: Vec<u32> = visible.iter().map(|(key, _)| *key as u32).collect();
        let splats: Vec<Splat> = visible.into_iter().map(|(_, s)| s).collect();

        let columns = (lens.width as usize).div_ceil(TILE);
        let rows = (lens.height as usize).div_ceil(TILE);
        let touched: Vec<Vec<u32>> = splats.par_iter().with_min_len(256).map(|s| tiles_of(s, columns, rows)).collect();
        let mut offsets = vec![0usize; columns * rows + 1];
        for t in touched.iter().flatten() {
            offsets[*t as usize + 1] += 1;
        }
        for t in 0..columns * rows {
            offsets[t + 1] += offsets[t];
        }
        let mut next = offsets.clone();
        let mut entries = vec![0u32; offsets[columns * rows]];
        for (i, tiles) in touched.iter().enumerate() {
            for &t in tiles {
                entries[next[t as usize]] = i as u32;
                next[t as usize] += 1;
            }
        }
        Self { lens, index, splats, offsets, entries, columns, dropped }
    }

    pub fn count(&self) -> usize {
        self.offsets.len() - 1
    }

    /// Positions in `splats` of the Gaussians that touch tile `t`.
    pub fn list(&self, t: usize) -> &[u32] {
        &self.entries[self.offsets[t]..self.offsets[t + 1]]
    }

    /// Left, top, width, height of tile `t` within the image.
    pub fn rectangle(&self, t: usize) -> (usize, usize, usize, usize) {
        let (x, y) = (t % self.columns * TILE, t / self.columns * TILE);
        (x, y, TILE.min(self.lens.width as usize - x), TILE.min(self.lens.height as usize - y))
    }
}

/// Tiles in which some pixel may get alpha >= 1/255: those that the ellipse sigma = ln(255 opacity) reaches.
fn tiles_of(s: &Splat, columns: usize, rows: usize) -> Vec<u32> {
    let range = |center: f32, extent: f32, count: usize| {
        let low = ((center - extent) / TILE as f32).floor().max(0.0) as usize;
        let high = ((center + extent) / TILE as f32).floor().max(-1.0) + 1.0;
        low..(high as usize).min(count)
    };
    let mut out = Vec::new();
    // A margin for the rounding of this test against the rounding of the pixels' own.
    let limit = s.sigma_max * (1.0 + 1e-5) + 1e-5;
    for ty in range(s.mean[1], s.extent[1], rows) {
        for tx in range(s.mean[0], s.extent[0], columns) {
            let (x0, y0) = ((tx * TILE) as f32 - s.mean[0], (ty * TILE) as f32 - s.mean[1]);
            if least_sigma(s.conic, x0, y0, x0 + TILE as f32, y0 + TILE as f32) <= limit {
                out.push((ty * columns + tx) as u32);
            }
        }
    }
    out
}

/// Smallest value of (a x^2 + 2 b x y + c y^2) / 2 over a rectangle around or beside the origin.
fn least_sigma([a, b, c]: [f32; 3], x0: f32, y0: f32, x1: f32, y1: f32) -> f32 {
    if x0 <= 0.0 && 0.0 <= x1 && y0 <= 0.0 && 0.0 <= y1 {
        return 0.0;
    }
    let sigma = |x: f32, y: f32| 0.5 * (a * x * x + c * y * y) + b * x * y;
    // The form is convex: its least value on the rectangle lies on an edge that faces the origin.
    let mut least = f32::INFINITY;
    if x0 > 0.0 || x1 < 0.0 {
        let x = if x0 > 0.0 { x0 } else { x1 };
        least = least.min(sigma(x, (-b * x / c).clamp(y0, y1)));
    }
    if y0 > 0.0 || y1 < 0.0 {
        let y = if y0 > 0.0 { y0 } else { y1 };
        least = least.min(sigma((-b * y / a).clamp(x0, x1), y));
    }
    least
}
