//! Which Gaussians make up which mask: sums of blending weights over the pixels of each mask.
//!
//! A view is rasterised tile by tile. Within a tile, pixels that belong to the same masks at all levels form a cell;
//! weights are summed per cell, and a cell's sum goes to each of its masks. Tiles are added up in their order, so the sums
//! do not depend on the number of threads.

use artifacts::{LEVELS, Level, MaskMaps, Row};
use gs_io::mixed;
use gs_raster::{RasterOptions, TILE, TileWeights};
use gs_scene::{Camera, Gaussians};
use rayon::prelude::*;

/// No mask, or a mask too small to count.
const NONE: u32 = u32::MAX;

/// The footprints of the masks of one view.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ViewFootprints {
    /// Masks by level and id; their `view` is 0.
    pub rows: Vec<Row>,
    /// Per mask: Gaussians, ascending, and their weights summed over the mask's gated pixels, in f64 and then rounded.
    pub entries: Vec<Vec<(u32, f32)>>,
    /// Gaussians that contribute to the view, ascending, and their weights summed over all pixels.
    pub seen: Vec<(u32, f64)>,
    /// Masks left out because they have too few pixels.
    pub small_masks: usize,
    /// Single pixels of the masks, in the order of `rows`.
    pub pixels: Vec<Pixel>,
}

/// How the footprints of a view are measured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FootprintOptions {
    /// Accumulated alpha above which a pixel counts for the weights.
    pub gate: f32,
    /// Masks with fewer pixels are left out.
    pub min_pixels: usize,
    /// Single pixels kept of each mask, at most.
    pub samples: usize,
    /// Seed of their choice.
    pub seed: u64,
}

/// A pixel of a mask and the Gaussians that it shows.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Pixel {
    /// The mask, as a position in [`ViewFootprints::rows`].
    pub row: u32,
    /// The lowest keys of a mask are kept; well-mixed, so that they are a random choice.
    key: u64,
    /// Gaussians, ascending, and their blending weights.
    pub entries: Vec<(u32, f32)>,
}

/// Computes the footprints of one view, rendered as `raster` says; colour plays no part.
///
/// `camera` must have the size of `maps`.
pub fn view_footprints(
    gaussians: &Gaussians,
    raster: &RasterOptions,
    camera: &Camera,
    maps: &MaskMaps,
    options: &FootprintOptions,
) -> ViewFootprints {
    // The two common numbers of levels have loops of their own: with 16 for all it takes a fifth longer.
    match maps.levels().len() {
        4 => of_levels::<4>(gaussians, raster, camera, maps, options),
        6 => of_levels::<6>(gaussians, raster, camera, maps, options),
        _ => of_levels::<LEVELS>(gaussians, raster, camera, maps, options),
    }
}

/// The same for maps of at most `N` levels.
fn of_levels<const N: usize>(
    gaussians: &Gaussians,
    raster: &RasterOptions,
    camera: &Camera,
    maps: &MaskMaps,
    options: &FootprintOptions,
) -> ViewFootprints {
    let (mut rows, row_of, small_masks) = mask_rows(maps, options.min_pixels);
    let below: Vec<u64> = rows.iter().map(|r| candidates_below(options.samples, r.pixels)).collect();
    let mut tiles = gs_raster::tile_weights(gaussians, camera, raster, true, |tile| {
        let mut sums = tile_sums::<N>(tile, maps, &row_of, options.gate);
        if options.samples > 0 {
            sums.pixels = tile_pixels::<N>(tile, maps, &row_of, options, &below);
        }
        sums
    });
    let mut alpha = vec![0.0f64; rows.len()];
    for fact in tiles.iter().flat_map(|t| &t.facts) {
        rows[fact.row as usize].gated += fact.gated;
        alpha[fact.row as usize] += fact.alpha;
    }
    for (row, alpha) in rows.iter_mut().zip(alpha) {
        row.alpha = (alpha / f64::from(row.pixels)) as f32;
    }
    let entries = add_up(rows.len(), tiles.iter().flat_map(|t| &t.entries).copied());
    let mut seen = add_up(1, tiles.iter().flat_map(|t| &t.seen).map(|&(g, w)| (0, g, w)));
    ViewFootprints {
        rows,
        entries: entries.into_iter().map(|e| e.into_iter().map(|(g, w)| (g, w as f32)).collect()).collect(),
        seen: seen.pop().unwrap_or_default(),
        small_masks,
        pixels: lowest_keys(tiles.iter_mut().flat_map(|t| std::mem::take(&mut t.pixels)).collect(), options.samples),
    }
}

/// The key below which a pixel of a mask of `pixels` is worth keeping for a while: four times as many as `samples` are,
/// so that enough pass the gate.
fn candidates_below(samples: usize, pixels: u32) -> u64 {
    let share = 4.0 * samples as f64 / f64::from(pixels.max(1));
    if share >= 1.0 { u64::MAX } else { (share * u64::MAX as f64) as u64 }
}

/// Per mask the `count` pixels of the lowest keys; masks ascend.
fn lowest_keys(mut pixels: Vec<Pixel>, count: usize) -> Vec<Pixel> {
    pixels.sort_by_key(|p| (p.row, p.key));
    let (mut row, mut kept) = (NONE, 0);
    pixels.retain(|p| {
        kept = if p.row == row { kept + 1 } else { 1 };
        row = p.row;
        kept <= count
    });
    pixels
}

/// Gated pixels of a tile whose keys are low, and what they show.
fn tile_pixels<const N: usize>(
    tile: &TileWeights,
    maps: &MaskMaps,
    row_of: &[Vec<u32>],
    options: &FootprintOptions,
    below: &[u64],
) -> Vec<Pixel> {
    let mut out = Vec::new();
    for y in 0..tile.height {
        for x in 0..tile.width {
            let (at, pixel) = (y * TILE + x, (tile.y0 + y) * maps.width() + tile.x0 + x);
            let rows: [u32; N] = rows_at(maps, row_of, [tile.y0 + y, tile.x0 + x]);
            for (level, row) in rows.into_iter().enumerate() {
                let key = mixed(options.seed ^ mixed((pixel * Level::SAM.len() + level) as u64));
                if row == NONE || tile.alpha[at] <= options.gate || key > below[row as usize] {
                    continue;
                }
                let weights = tile.weights.chunks_exact(TILE * TILE).map(|w| w[at]);
                let mut entries: Vec<(u32, f32)> =
                    tile.gaussians.iter().copied().zip(weights).filter(|(_, w)| *w > 0.0).collect();
                entries.sort_unstable_by_key(|e| e.0);
                out.push(Pixel { row, key, entries });
            }
        }
    }
    out
}

/// The masks that own enough pixels, by level and id; per level, the row of each id (`NONE` where it has none); how many
/// masks were too small.
fn mask_rows(maps: &MaskMaps, min_pixels: usize) -> (Vec<Row>, Vec<Vec<u32>>, usize) {
    let mut rows = Vec::new();
    let mut small = 0;
    let of_level = |&level: &Level| {
        let mut pixels = vec![0u32; maps.id_count()];
        for &id in maps.level(level) {
            if id >= 0 {
                pixels[id as usize] += 1;
            }
        }
        let mut row_of = vec![NONE; pixels.len()];
        for (id, &pixels) in pixels.iter().enumerate().filter(|(_, p)| **p > 0) {
            if (pixels as usize) < min_pixels {
                small += 1;
                continue;
            }
            row_of[id] = rows.len() as u32;
            rows.push(Row { level: level.index() as u32, mask: id as u32, pixels, ..Row::default() });
        }
        row_of
    };
    let row_of = maps.levels().iter().map(of_level).collect();
    (rows, row_of, small)
}

/// The rows of the masks that a pixel belongs to, level by level.
#[inline(always)]
fn rows_at<const N: usize>(maps: &MaskMaps, row_of: &[Vec<u32>], [y, x]: [usize; 2]) -> [u32; N] {
    std::array::from_fn(|at| maps.mask(Level::ALL[at], [y, x]).map_or(NONE, |id| row_of[at][id as usize]))
}

/// What one tile adds.
#[derive(Default)]
struct TileSums {
    /// (row, Gaussian, weight), Gaussians in the tile's order.
    entries: Vec<(u32, u32, f32)>,
    /// (Gaussian, weight over all pixels of the tile).
    seen: Vec<(u32, f32)>,
    facts: Vec<Fact>,
    pixels: Vec<Pixel>,
}

/// What one tile adds to a mask's facts.
struct Fact {
    row: u32,
    gated: u32,
    alpha: f64,
}

fn tile_sums<const N: usize>(tile: &TileWeights, maps: &MaskMaps, row_of: &[Vec<u32>], gate: f32) -> TileSums {
    let mut out = TileSums { seen: Vec::with_capacity(tile.gaussians.len()), ..TileSums::default() };
    // Cell 0 holds the pixels that count for no mask.
    let mut cells: Vec<[u32; N]> = vec![[NONE; N]];
    let mut cell_of = [0u16; TILE * TILE];
    for y in 0..tile.height {
        for x in 0..tile.width {
            let masks: [u32; N] = rows_at(maps, row_of, [tile.y0 + y, tile.x0 + x]);
            let at = y * TILE + x;
            let passes = tile.alpha[at] > gate;
            for &row in masks.iter().filter(|r| **r != NONE) {
                let at_fact = out.facts.iter().position(|f| f.row == row).unwrap_or_else(|| {
                    out.facts.push(Fact { row, gated: 0, alpha: 0.0 });
                    out.facts.len() - 1
                });
                out.facts[at_fact].gated += u32::from(passes);
                out.facts[at_fact].alpha += f64::from(tile.alpha[at]);
            }
            if passes {
                let cell = cells.iter().position(|c| *c == masks).unwrap_or_else(|| {
                    cells.push(masks);
                    cells.len() - 1
                });
                cell_of[at] = cell as u16;
            }
        }
    }
    let mut sums = vec![0.0f32; cells.len()];
    for (&gaussian, weights) in tile.gaussians.iter().zip(tile.weights.chunks_exact(TILE * TILE)) {
        sum_by_cell(weights, &cell_of, &mut sums);
        let total: f32 = sums.iter().sum();
        if total > 0.0 {
            out.seen.push((gaussian, total));
        }
        for (&sum, masks) in sums.iter().zip(&cells).skip(1) {
            if sum > 0.0 {
                out.entries.extend(masks.iter().filter(|r| **r != NONE).map(|&row| (row, gaussian, sum)));
            }
        }
    }
    out
}

/// Pixels that [`sum_by_cell`] looks at together.
const BLOCK: usize = 8;

/// Sums a tile's weights by the pixels' cells, pixel after pixel. Most blocks of pixels have no weight, or lie in one cell.
fn sum_by_cell(weights: &[f32], cell_of: &[u16; TILE * TILE], sums: &mut [f32]) {
    sums.fill(0.0);
    for (weights, cells) in weights.as_chunks::<BLOCK>().0.iter().zip(cell_of.as_chunks::<BLOCK>().0) {
        if weights.iter().fold(0, |all, w| all | w.to_bits()) == 0 {
            continue;
        }
        if cells.iter().fold(0, |all, c| all | (c ^ cells[0])) == 0 {
            let sum = &mut sums[cells[0] as usize];
            *sum = weights.iter().fold(*sum, |sum, w| sum + w);
        } else {
            weights.iter().zip(cells).for_each(|(w, &c)| sums[c as usize] += w);
        }
    }
}

/// Sums (row, Gaussian, weight) triples per row and Gaussian, in the order given; Gaussians ascend.
fn add_up(rows: usize, triples: impl Iterator<Item = (u32, u32, f32)>) -> Vec<Vec<(u32, f64)>> {
    let mut by_row: Vec<Vec<(u32, f32)>> = vec![Vec::new(); rows];
    for (row, gaussian, weight) in triples {
        by_row[row as usize].push((gaussian, weight));
    }
    by_row
        .into_par_iter()
        .map(|mut parts| {
            // Stable: the parts of one Gaussian stay in the order of tiles.
            parts.sort_by_key(|p| p.0);
            let mut sums: Vec<(u32, f64)> = Vec::new();
            for (gaussian, weight) in parts {
                match sums.last_mut() {
                    Some(last) if last.0 == gaussian => last.1 += f64::from(weight),
                    _ => sums.push((gaussian, f64::from(weight))),
                }
            }
            sums
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{camera, cloud};
    use artifacts::flat;
    use gs_scene::Geometry;
    use ndarray::Array3;

    const W: usize = 70;
    const H: usize = 45;

    /// Stripes at one level, blocks at another, a mask of three pixels, and pixels without a mask.
    fn maps() -> MaskMaps {
        let id = |(level, y, x)| match Level::ALL[level] {
            Level::DEFAULT if x < 60 => (x / 13) as i32,
            Level::LARGE => 10 + (y / 20) as i32 * 2 + (x / 50) as i32,
            Level::SMALL if y == 30 && x < 3 => 9,
            _ => -1,
        };
        MaskMaps { ids: Array3::from_shape_fn((LEVELS, H, W), id) }
    }

    fn options(min_pixels: usize, samples: usize) -> FootprintOptions {
        FootprintOptions { gate: 0.7, min_pixels, samples, seed: 3 }
    }

    #[test]
    fn pixels_times_features_are_rendered_features_and_no_mask_has_more_than_asked_for() {
        let (g, camera, maps) = (cloud(400), camera(W as u32, H as u32), maps());
        let (d, raster) = (2, RasterOptions::default());
        let features: Vec<f32> = (0..g.len() * d).map(|i| ((i * 37) % 101) as f32 / 50.0 - 1.0).collect();
        let image = gs_raster::render_features(&g, &features, d, &camera, &raster);
        let alpha = gs_raster::render(&g, &camera, &raster).alpha;
        let result = view_footprints(&g, &raster, &camera, &maps, &options(5, 6));
        assert!(result.pixels.windows(2).all(|p| (p[0].row, p[0].key) < (p[1].row, p[1].key)));
        for (k, row) in result.rows.iter().enumerate() {
            let mine: Vec<&Pixel> = result.pixels.iter().filter(|p| p.row as usize == k).collect();
            assert!(mine.len() <= 6 && (mine.len() == 6 || row.gated < 30), "{row:?}: {}", mine.len());
            let map = flat(maps.level(Level::ALL[row.level as usize]));
            for pixel in mine {
                let rendered: Vec<f32> = (0..d)
                    .map(|c| pixel.entries.iter().map(|&(i, w)| w * features[i as usize * d + c]).sum())
                    .collect();
                let close = |p: usize| (0..d).all(|c| (image[p * d + c] - rendered[c]).abs() < 1e-5);
                let found = (0..W * H).any(|p| map[p] == row.mask as i32 && alpha[p] > 0.7 && close(p));
                assert!(found, "no pixel of mask {k} looks like it");
            }
        }
        assert!(result.pixels.len() > 40, "{}", result.pixels.len());
        let reseeded = FootprintOptions { seed: 4, ..options(5, 6) };
        let other = view_footprints(&g, &raster, &camera, &maps, &reseeded);
        assert_ne!(result.pixels, other.pixels);
        assert_eq!(result.entries, other.entries);
    }

    #[test]
    fn a_footprint_times_features_is_the_mean_of_rendered_features() {
        // As the mark of a PLY says: without and with the 2D filter, which matters for Gaussians smaller than a pixel.
        let dir = tempfile::tempdir().unwrap();
        let mut small = cloud(400);
        small.log_scales.iter_mut().step_by(3).for_each(|s| *s = [-5.0; 3]);
        let weight = [false, true].map(|antialias| {
            let marked = Geometry { gaussians: small.clone(), antialias, ..Geometry::default() };
            let path = dir.path().join("g.ply");
            gs_scene::ply::write_gaussians(&path, &small, &marked.comments(Vec::new())).unwrap();
            let geometry = Geometry::read(&path).unwrap();
            let raster = RasterOptions { antialias, ..RasterOptions::default() };
            let read = RasterOptions::of(&geometry);
            let result =
                view_footprints(&geometry.gaussians, &read, &camera(W as u32, H as u32), &maps(), &options(5, 0));
            is_the_mean_of_rendered_features(&small, &raster, &result);
            result.seen.iter().filter(|s| s.0 % 3 == 0).map(|s| s.1).sum::<f64>()
        });
        assert!(weight[1] < 0.5 * weight[0], "the filter takes weight from small Gaussians: {weight:?}");
    }

    fn is_the_mean_of_rendered_features(g: &Gaussians, raster: &RasterOptions, result: &ViewFootprints) {
        let (camera, maps) = (camera(W as u32, H as u32), maps());
        let d = 3;
        let features: Vec<f32> = (0..g.len() * d).map(|i| ((i * 37) % 101) as f32 / 50.0 - 1.0).collect();
        let image = gs_raster::render_features(g, &features, d, &camera, raster);
        let alpha = gs_raster::render(g, &camera, raster).alpha;
        assert!(result.pixels.is_empty());
        assert_eq!(result.small_masks, 1);
        assert_eq!(result.rows.len(), 5 + 6);
        let mut gated_all = 0;
        for (row, entries) in result.rows.iter().zip(&result.entries) {
            let map = flat(maps.level(Level::ALL[row.level as usize]));
            let mine: Vec<usize> = (0..W * H).filter(|&p| map[p] == row.mask as i32).collect();
            let gated: Vec<usize> = mine.iter().copied().filter(|&p| alpha[p] > 0.7).collect();
            assert_eq!((row.pixels as usize, row.gated as usize), (mine.len(), gated.len()));
            let mean_alpha = mine.iter().map(|&p| f64::from(alpha[p])).sum::<f64>() / mine.len() as f64;
            assert!((f64::from(row.alpha) - mean_alpha).abs() < 1e-6);
            assert!(entries.windows(2).all(|e| e[0].0 < e[1].0));
            for c in 0..d {
                let dense = gated.iter().map(|&p| f64::from(image[p * d + c])).sum::<f64>() / gated.len().max(1) as f64;
                let sparse =
                    entries.iter().map(|&(i, w)| f64::from(w) * f64::from(features[i as usize * d + c])).sum::<f64>()
                        / gated.len().max(1) as f64;
                assert!((dense - sparse).abs() < 1e-5, "{row:?} channel {c}: {dense} {sparse}");
            }
            gated_all += gated.len();
        }
        assert!(gated_all > 1500, "the cloud covers most of the view: {gated_all}");
        // All weights of a view add up to all of its alpha.
        let weight: f64 = result.seen.iter().map(|s| s.1).sum();
        let covered: f64 = alpha.iter().map(|&a| f64::from(a)).sum();
        assert!((weight - covered).abs() < 1e-3 * covered);
    }
}
