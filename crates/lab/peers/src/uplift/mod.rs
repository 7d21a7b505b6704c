//! Three systems that lift the masks' features to Gaussians in closed form, without training: [`mean`] (Occam's LGS),
//! [`dr_splat`] and [`vala`].
//!
//! All do the same in three steps. Each mask gives its feature to Gaussians, with a weight: a [`Share`]. A rule makes
//! one descriptor of a Gaussian's shares. Then texts are compared with descriptors, which is the scorer's work. Shares
//! are kept sparsely, so memory is linear in what the footprints hold.
//!
//! The authors run their systems once for every level of masks, and a text takes one level. So each level that is used
//! has a slot of its own here, and a text takes the best slot of a Gaussian. The authors let a text choose one level
//! for the whole scene; the scorer's choice by Gaussian is the nearest that descriptors allow.

mod dr_splat;
mod mean;
mod quantise;
mod vala;

pub use dr_splat::DrSplatOptions;
pub use mean::MeanOptions;
pub use vala::ValaOptions;

use crate::product::{Product, Table};
use crate::vectors::{normalised, unit};
use crate::world::World;
use artifacts::{Level, MaskMaps, Row, flat};
use glam::DVec3;
use gs_io::Result;
use gs_raster::{TILE, TileWeights};
use gs_scene::Camera;
use ndarray::Array2;
use rayon::prelude::*;
use serde::Serialize;
use stage::Stage;

/// Pixels of a tile.
const PIXELS: usize = TILE * TILE;
/// A Gaussian that is not kept.
const NONE: u32 = u32::MAX;

/// What is done to descriptors in the end.
#[derive(Debug, Clone, Copy, clap::Args, Serialize)]
struct Finish {
    /// Give Gaussians without a descriptor that of the nearest neighbour with one, not none
    #[arg(long)]
    fill: bool,
    /// Gaussians, itself and its nearest, whose mean is half of a Gaussian's descriptor; 1 to 17, 1 for none (VALA
    /// smooths relevancies so, with 10)
    #[arg(long, value_name = "COUNT", default_value_t = 1, value_parser = stage::within(1usize..=17))]
    smooth: usize,
}

impl Finish {
    fn applied(self, table: Table, world: &World) -> Product {
        let knn = &world.graph.gaussian_knn;
        let table = if self.fill { filled(table, knn) } else { table };
        Product::Descriptors(smoothed(table, knn, self.smooth))
    }
}

/// What a mask gives to a Gaussian.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Share {
    /// View of the mask.
    view: u32,
    /// Its id, which is also the row of its feature.
    mask: u32,
    /// Slot of its level.
    slot: u32,
    /// How much the Gaussian shows of it.
    weight: f64,
}

/// The shares of every kept Gaussian, in the order of views.
type Shares = Vec<Vec<Share>>;

/// The levels that are used, each once: one slot each.
fn slots(levels: &[Level]) -> Vec<Level> {
    let mut slots = Vec::new();
    for level in levels {
        if !slots.contains(level) {
            slots.push(*level);
        }
    }
    slots
}

/// Position of every Gaussian among the kept ones, or [`NONE`].
fn positions(world: &World) -> Vec<u32> {
    let mut positions = vec![NONE; world.gaussians()];
    world.footprints.kept.iter().enumerate().for_each(|(at, &i)| positions[i as usize] = at as u32);
    positions
}

/// A Gaussian whose centre a view shows.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Centre {
    /// Position among the kept Gaussians.
    gaussian: u32,
    /// Pixel of the centre, row by row.
    pixel: u32,
    /// The Gaussian's blending weight there, above 0.
    weight: f64,
}

/// The Gaussians of a view whose centre lies in a pixel to which they contribute, ascending. `positions` are those of
/// [`positions`].
fn centres(world: &World, camera: &Camera, positions: &[u32]) -> Vec<Centre> {
    let of_tile = |t: &TileWeights<'_>| {
        let mut found = Vec::new();
        for (g, &i) in t.gaussians.iter().enumerate() {
            let mean = world.geometry.gaussians.means[i as usize].map(f64::from);
            let (u, v, _) = camera.project(DVec3::from_array(mean));
            let (x, y) = (u.floor() - t.x0 as f64, v.floor() - t.y0 as f64);
            let inside = (0.0..t.width as f64).contains(&x) && (0.0..t.height as f64).contains(&y);
            if !inside || positions[i as usize] == NONE {
                continue;
            }
            let (x, y) = (x as usize, y as usize);
            let weight = f64::from(t.weights[g * PIXELS + y * TILE + x]);
            if weight > 0.0 {
                let pixel = ((t.y0 + y) * camera.width as usize + t.x0 + x) as u32;
                found.push(Centre { gaussian: positions[i as usize], pixel, weight });
            }
        }
        found
    };
    // A view stops at spent pixels, so hidden Gaussians have no weight.
    let mut all = world.tiles(camera, true, of_tile).concat();
    all.sort_unstable_by_key(|c| c.gaussian);
    all
}

/// Gives each of some Gaussians the masks at the pixel of its centre.
fn give_centres(shares: &mut Shares, view: u32, centres: &[Centre], maps: &MaskMaps, slots: &[Level]) {
    for c in centres {
        for (slot, &level) in slots.iter().enumerate() {
            if let Ok(mask) = u32::try_from(flat(maps.level(level))[c.pixel as usize]) {
                shares[c.gaussian as usize].push(Share { view, mask, slot: slot as u32, weight: c.weight });
            }
        }
    }
}

/// What the masks of all pixels give to Gaussians. `gate` sees the blending weights of a tile, `[Gaussian][PIXELS]`,
/// and changes what may not count as it is.
fn by_pixels(world: &World, stage: &Stage, gate: impl Fn(&mut [f32]) + Sync) -> Result<Shares> {
    let (slots, positions) = (slots(&world.levels), positions(world));
    let mut shares: Shares = vec![Vec::new(); world.kept()];
    for view in 0..world.views.len() {
        stage.go_on()?;
        let (maps, camera) = world.maps(view)?;
        // A view stops at spent pixels, so hidden Gaussians have no weight.
        let tiles = world.tiles(&camera, true, |t| {
            let mut weights = t.weights.to_vec();
            gate(&mut weights);
            parts_of(t, &weights, &masks_of(t, &maps, &slots), &positions)
        });
        merged(&mut shares, view as u32, tiles.concat());
    }
    Ok(shares)
}

/// What a mask gives to a Gaussian in a tile.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Part {
    gaussian: u32,
    slot: u32,
    mask: u32,
    weight: f64,
}

/// What the masks of a tile give to its kept Gaussians, by `weights` in the place of the tile's own.
fn parts_of(t: &TileWeights<'_>, weights: &[f32], masks: &[(u32, u32, Vec<u8>)], positions: &[u32]) -> Vec<Part> {
    let mut parts = Vec::new();
    for (&i, weights) in t.gaussians.iter().zip(weights.chunks_exact(PIXELS)) {
        let gaussian = positions[i as usize];
        if gaussian == NONE || weights.iter().all(|&w| w == 0.0) {
            continue;
        }
        for (slot, mask, pixels) in masks {
            let weight: f64 = pixels.iter().map(|&p| f64::from(weights[p as usize])).sum();
            if weight > 0.0 {
                parts.push(Part { gaussian, slot: *slot, mask: *mask, weight });
            }
        }
    }
    parts
}

/// The masks of a tile: slot, id, and pixels as indices into the tile.
fn masks_of(t: &TileWeights<'_>, maps: &MaskMaps, slots: &[Level]) -> Vec<(u32, u32, Vec<u8>)> {
    let mut masks: Vec<(u32, u32, Vec<u8>)> = Vec::new();
    for (slot, &level) in slots.iter().enumerate() {
        for (x, y) in (0..t.height).flat_map(|y| (0..t.width).map(move |x| (x, y))) {
            let Ok(id) = u32::try_from(maps.level(level)[[t.y0 + y, t.x0 + x]]) else { continue };
            let pixel = (y * TILE + x) as u8;
            match masks.iter_mut().rev().find(|m| m.0 == slot as u32 && m.1 == id) {
                Some(mask) => mask.2.push(pixel),
                None => masks.push((slot as u32, id, vec![pixel])),
            }
        }
    }
    masks
}

/// Adds what the tiles of a view found to the shares, summed over tiles in their order.
fn merged(shares: &mut Shares, view: u32, mut parts: Vec<Part>) {
    parts.sort_by_key(|p| (p.gaussian, p.slot, p.mask));
    for same in parts.chunk_by(|a, b| (a.gaussian, a.slot, a.mask) == (b.gaussian, b.slot, b.mask)) {
        let Part { gaussian, slot, mask, .. } = same[0];
        let weight = same.iter().map(|p| p.weight).sum();
        shares[gaussian as usize].push(Share { view, mask, slot, weight });
    }
}

/// Descriptors of the kept Gaussians: what `rule` makes of the features and weights of each Gaussian's shares in a
/// slot.
fn described<'a>(
    world: &'a World,
    slots: usize,
    shares: &[Vec<Share>],
    rule: impl Fn(&[(&'a [f32], f64)]) -> Option<Vec<f32>> + Sync,
) -> Table {
    let dim = world.dim();
    let mut values = vec![0.0; shares.len() * slots * dim];
    values.par_chunks_mut((slots * dim).max(1)).zip(shares).for_each(|(row, shares)| {
        for (slot, out) in row.chunks_exact_mut(dim.max(1)).enumerate() {
            let own = shares.iter().filter(|s| s.slot as usize == slot);
            let feature = |s: &Share| {
                let row = Row { view: s.view, mask: s.mask, ..Row::default() };
                world.feature(&row).map(|f| (f, s.weight))
            };
            if let Some(made) = rule(&own.filter_map(feature).collect::<Vec<_>>()) {
                out.copy_from_slice(&made);
            }
        }
    });
    Table { rows: Vec::new(), slots, dim, values }
}

/// The weighted mean of features, of unit length; none where all weights are 0 or the features cancel out.
fn weighted_mean(features: &[(&[f32], f64)]) -> Option<Vec<f32>> {
    let mut sum = vec![0.0; features.first()?.0.len()];
    for (feature, weight) in features {
        sum.iter_mut().zip(*feature).for_each(|(s, &f)| *s += weight * f64::from(f));
    }
    normalised(&sum)
}

/// Whether a descriptor is one.
fn is_some(descriptor: &[f32]) -> bool {
    descriptor.iter().any(|&v| v != 0.0)
}

/// Descriptors of Gaussians with their neighbours', as texts are answered in VALA: half its own, half the mean of
/// `count` Gaussians, itself and the nearest of its neighbours that have a descriptor. Rows of `knn` are nearest first,
/// filled up with the Gaussian itself; fewer are averaged where it has fewer.
fn smoothed(table: Table, knn: &Array2<u32>, count: usize) -> Table {
    let (width, most) = (table.slots * table.dim, count.saturating_sub(1));
    if most == 0 || width == 0 {
        return table;
    }
    let old = &table.values;
    let mut values = vec![0.0; old.len()];
    values.par_chunks_mut(width).enumerate().for_each(|(i, row)| {
        for (slot, out) in row.chunks_exact_mut(table.dim).enumerate() {
            let of = |g: usize| &old[g * width + slot * table.dim..][..table.dim];
            if !is_some(of(i)) {
                continue;
            }
            let near = knn.row(i).into_iter().map(|&g| g as usize).filter(|&g| g != i);
            let near = near.map(of).filter(|d| is_some(d)).take(most);
            let all: Vec<&[f32]> = std::iter::once(of(i)).chain(near).collect();
            for (c, out) in out.iter_mut().enumerate() {
                let mean = all.iter().map(|d| f64::from(d[c])).sum::<f64>() / all.len() as f64;
                *out = (0.5 * f64::from(of(i)[c]) + 0.5 * mean) as f32;
            }
            unit(out);
        }
    });
    Table { values, ..table }
}

/// Descriptors with those of neighbours where there was none: of the nearest that has one, and so on from neighbour to
/// neighbour. `knn` is as in [`smoothed`].
fn filled(mut table: Table, knn: &Array2<u32>) -> Table {
    let (width, dim) = (table.slots * table.dim, table.dim);
    loop {
        let old = &table.values;
        let from = |at: usize| {
            let (i, slot) = (at / table.slots, at % table.slots);
            let of = |g: usize| g * width + slot * dim;
            let mut near = knn.row(i).into_iter().map(|&g| of(g as usize));
            if is_some(&old[of(i)..][..dim]) { None } else { near.find(|&from| is_some(&old[from..][..dim])) }
        };
        let copies: Vec<(usize, usize)> = (0..old.len() / dim.max(1))
            .into_par_iter()
            .filter_map(|at| from(at).map(|from| (at * dim, from)))
            .collect();
        if copies.is_empty() {
            return table;
        }
        copies.into_iter().for_each(|(to, from)| table.values.copy_within(from..from + dim, to));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::{arr2, arr3};

    #[test]
    fn levels_have_one_slot_each() {
        assert_eq!(slots(&[Level::LARGE, Level::SMALL, Level::LARGE]), [Level::LARGE, Level::SMALL]);
    }

    #[test]
    fn the_mean_is_weighted_and_of_unit_length() {
        let (x, y) = ([1.0, 0.0], [0.0, 1.0]);
        // (3, 4) / 5.
        assert_eq!(weighted_mean(&[(&x, 3.0), (&y, 4.0)]), Some(vec![0.6, 0.8]));
        assert_eq!(weighted_mean(&[]), None);
        assert_eq!(weighted_mean(&[(&x, 1.0), (&[-1.0, 0.0], 1.0)]), None, "opposite features say nothing");
    }

    #[test]
    fn smoothing_is_half_own_and_half_the_mean_of_neighbours() {
        // Four Gaussians in a plane of features; the last has no descriptor.
        let values = vec![1.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0];
        let table = Table { rows: Vec::new(), slots: 1, dim: 2, values };
        let knn = arr2(&[[1, 2], [0, 2], [1, 3], [1, 2]]);
        let made = smoothed(table.clone(), &knn, 3).values;
        // Of Gaussian 0: 0.5 (1, 0) + 0.5 (1/3, 2/3) = (2/3, 1/3), of length sqrt(5)/3.
        let (a, b) = (2.0 / 5f32.sqrt(), 1.0 / 5f32.sqrt());
        assert!((made[0] - a).abs() < 1e-6 && (made[1] - b).abs() < 1e-6, "{made:?}");
        // Gaussian 2 has neighbours 1 and 3, and 3 has nothing to say.
        assert_eq!(made[4..], [0.0, 1.0, 0.0, 0.0]);
        assert_eq!(smoothed(table.clone(), &knn, 1), table, "a Gaussian alone is not smoothed");
    }

    #[test]
    fn a_centre_takes_the_masks_of_its_pixel() {
        // Two pixels at four levels; -1 is no mask.
        let maps = MaskMaps { ids: arr3(&[[[-1, -1]], [[0, 1]], [[-1, -1]], [[2, -1]]]) };
        let mut shares = vec![Vec::new(); 2];
        let seen = |gaussian, pixel| Centre { gaussian, pixel, weight: 0.5 };
        give_centres(&mut shares, 7, &[seen(0, 1), seen(1, 0)], &maps, &[Level::LARGE, Level::SMALL]);
        let share = |mask, slot| Share { view: 7, mask, slot, weight: 0.5 };
        assert_eq!(shares, [vec![share(1, 1)], vec![share(2, 0), share(0, 1)]]);
    }

    #[test]
    fn gaussians_without_a_descriptor_take_one_from_neighbour_to_neighbour() {
        // Slots of one number each. Gaussian 1 sees 0, and 2 sees only 1.
        let values = vec![5.0, 0.0, 0.0, 7.0, 0.0, 0.0];
        let table = Table { rows: Vec::new(), slots: 2, dim: 1, values };
        let made = filled(table, &arr2(&[[1, 2], [2, 0], [1, 2]])).values;
        assert_eq!(made, [5.0, 7.0, 5.0, 7.0, 5.0, 7.0]);
        let none = Table { rows: Vec::new(), slots: 1, dim: 1, values: vec![0.0; 2] };
        assert_eq!(filled(none.clone(), &arr2(&[[1], [0]])), none);
    }

    #[test]
    fn a_view_adds_up_its_tiles() {
        let part = |gaussian, mask, weight| Part { gaussian, slot: 0, mask, weight };
        let mut shares = vec![Vec::new(); 2];
        merged(&mut shares, 4, vec![part(1, 8, 0.5), part(0, 8, 1.0), part(1, 7, 2.0), part(1, 8, 0.25)]);
        let share = |mask, weight| Share { view: 4, mask, slot: 0, weight };
        assert_eq!(shares, [vec![share(8, 1.0)], vec![share(7, 2.0), share(8, 0.75)]]);
    }

    #[test]
    fn masks_of_a_tile_have_its_pixels() {
        // A tile of 2 x 1 pixels at column 1 of an image of 3 x 1; ids by level, -1 for none.
        let maps = MaskMaps { ids: arr3(&[[[-1, -1, -1]], [[0, 1, 1]], [[-1, -1, -1]], [[2, 3, -1]]]) };
        let none = [0.0; 0];
        let alpha = [0.0; PIXELS];
        let t = TileWeights {
            x0: 1,
            y0: 0,
            width: 2,
            height: 1,
            gaussians: &[],
            alphas: &none,
            weights: &none,
            alpha: &alpha,
        };
        assert_eq!(masks_of(&t, &maps, &[Level::LARGE, Level::SMALL]), [(0, 3, vec![0]), (1, 1, vec![0, 1])]);
    }
}
