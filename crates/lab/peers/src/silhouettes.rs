//! Which mask of a view shows which instance, by silhouettes (OpenGaussian).
//!
//! One rasterisation of a view serves all instances. The silhouette of an instance is where the instance rendered alone
//! has alpha > 0.8: per pixel, 1 - prod(1 - alpha_i) over its own Gaussians, hidden ones included (OpenGaussian's rule).
//! Its mean feature is that of its own Gaussians as rendered over the silhouette; a mask's is that of all Gaussians as
//! rendered over the mask. Rendering is linear, so both are sums over Gaussians of feature times summed weight, and no
//! feature image is made.

use artifacts::{Features, Level, MaskMaps, Match, flat};
use gs_raster::{RasterOptions, TILE, TileWeights, tile_weights};
use gs_scene::{Camera, Gaussians};
use std::collections::BTreeMap;

/// An instance's silhouette is where the instance rendered alone has more alpha than this.
const SELECTED_ALPHA: f32 = 0.8;
const PIXELS: usize = TILE * TILE;

/// Pixels of an instance or a mask in a view, and the sum of rendered features over them.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Region {
    /// Its pixels.
    pub area: u32,
    /// Sum of rendered features over the pixels, `[dim]`.
    pub features: Vec<f64>,
    /// Of an instance, the blending weight of its Gaussians over the pixels: how many of them show it.
    pub visible: f64,
}

impl Region {
    fn empty(dim: usize) -> Self {
        Self { area: 0, visible: 0.0, features: vec![0.0; dim] }
    }
}

/// Silhouettes and masks of one view.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Overlaps {
    /// Silhouette of each instance that has one, by instance.
    pub instances: BTreeMap<u32, Region>,
    /// Masks by id.
    pub masks: BTreeMap<u32, Region>,
    /// Pixels common to an instance and a mask.
    pub common: BTreeMap<(u32, u32), u32>,
}

impl Overlaps {
    fn add(&mut self, tile: Self) {
        let add_all = |to: &mut BTreeMap<u32, Region>, from: BTreeMap<u32, Region>| {
            for (key, region) in from {
                let sum = to.entry(key).or_insert_with(|| Region::empty(region.features.len()));
                sum.area += region.area;
                sum.visible += region.visible;
                sum.features.iter_mut().zip(&region.features).for_each(|(s, f)| *s += f);
            }
        };
        add_all(&mut self.instances, tile.instances);
        add_all(&mut self.masks, tile.masks);
        for (key, pixels) in tile.common {
            *self.common.entry(key).or_default() += pixels;
        }
    }
}

/// Features by Gaussian.
pub struct FeatureTable<'a> {
    features: &'a Features,
    /// Position in `features` of each Gaussian, if it has one.
    position: Vec<Option<u32>>,
}

impl<'a> FeatureTable<'a> {
    /// The table for a scene of `gaussians` Gaussians.
    pub fn new(features: &'a Features, gaussians: usize) -> Self {
        let mut position = vec![None; gaussians];
        for (at, &i) in features.kept.iter().enumerate() {
            position[i as usize] = Some(at as u32);
        }
        Self { features, position }
    }

    /// Adds `weight` times the feature of a Gaussian. One without a feature is seen by no view and has nothing to add.
    fn add_to(&self, sum: &mut [f64], gaussian: u32, weight: f32) {
        if let (Some(at), true) = (self.position[gaussian as usize], weight > 0.0) {
            for (s, f) in sum.iter_mut().zip(flat(self.features.row(at as usize))) {
                *s += f64::from(weight) * f64::from(*f);
            }
        }
    }
}

/// The masks in a tile, and which of them every pixel belongs to.
struct TileMasks {
    ids: Vec<u32>,
    /// The sets of masks that some pixel lies in, one of each level at most, as indices into `ids`.
    sets: Vec<Vec<u16>>,
    /// The pixels of each set.
    pixels: Vec<Vec<u8>>,
}

impl TileMasks {
    fn new(t: &TileWeights<'_>, maps: &MaskMaps, levels: &[Level]) -> Self {
        let mut out = Self { ids: Vec::new(), sets: Vec::new(), pixels: Vec::new() };
        let mut last = 0;
        for (x, y) in (0..t.height).flat_map(|y| (0..t.width).map(move |x| (x, y))) {
            let at = [t.y0 + y, t.x0 + x];
            let ids = levels.iter().filter_map(|&level| maps.mask(level, at));
            let set: Vec<u16> = ids.map(|id| out.number(id)).collect();
            if out.sets.get(last) != Some(&set) {
                last = out.sets.iter().position(|s| *s == set).unwrap_or_else(|| {
                    out.sets.push(set);
                    out.pixels.push(Vec::new());
                    out.sets.len() - 1
                });
            }
            out.pixels[last].push((y * TILE + x) as u8);
        }
        out
    }

    fn number(&mut self, id: u32) -> u16 {
        let known = self.ids.iter().position(|&k| k == id).unwrap_or_else(|| {
            self.ids.push(id);
            self.ids.len() - 1
        });
        known as u16
    }
}

/// The sum of some pixels' weights.
fn sum_of(weights: &[f32], pixels: &[u8]) -> f32 {
    let mut sums = [0.0; 4];
    let mut four = pixels.chunks_exact(4);
    for p in four.by_ref() {
        (0..4).for_each(|k| sums[k] += weights[p[k] as usize]);
    }
    four.remainder().iter().map(|&p| weights[p as usize]).sum::<f32>() + (sums[0] + sums[1]) + (sums[2] + sums[3])
}

/// Where each instance has its silhouette in a tile.
fn silhouettes(t: &TileWeights<'_>, labels: &[i32]) -> BTreeMap<u32, [bool; PIXELS]> {
    // Transmittance of each instance at each pixel.
    let mut left: BTreeMap<u32, [f32; PIXELS]> = BTreeMap::new();
    for (&i, alphas) in t.gaussians.iter().zip(t.alphas.chunks_exact(PIXELS)) {
        let Ok(label) = u32::try_from(labels[i as usize]) else { continue };
        let left = left.entry(label).or_insert([1.0; PIXELS]);
        left.iter_mut().zip(alphas).for_each(|(l, a)| *l *= 1.0 - a);
    }
    left.into_iter()
        .map(|(label, left)| (label, left.map(|l| 1.0 - l > SELECTED_ALPHA)))
        .filter(|(_, at)| at.iter().any(|&a| a))
        .collect()
}

fn tile_overlaps(t: &TileWeights<'_>, labels: &[i32], table: &FeatureTable<'_>, masks: &TileMasks) -> Overlaps {
    let dim = table.features.dim();
    let inside = silhouettes(t, labels);
    let mut out = Overlaps::default();
    // Areas.
    for (&label, inside) in &inside {
        let area = inside.iter().filter(|&&p| p).count() as u32;
        out.instances.insert(label, Region { area, ..Region::empty(dim) });
        for (set, pixels) in masks.sets.iter().zip(&masks.pixels) {
            let common = pixels.iter().filter(|&&p| inside[p as usize]).count() as u32;
            for &mask in set.iter().filter(|_| common > 0) {
                *out.common.entry((label, masks.ids[mask as usize])).or_default() += common;
            }
        }
    }
    // Features: of each Gaussian its weights summed over sets of masks and over the silhouette of its instance.
    let mut left: BTreeMap<u32, [f32; PIXELS]> = inside.keys().map(|&label| (label, [1.0; PIXELS])).collect();
    let mut of_set = vec![vec![0.0; dim]; masks.sets.len()];
    for (g, &i) in t.gaussians.iter().enumerate() {
        let (alphas, weights) = (&t.alphas[g * PIXELS..(g + 1) * PIXELS], &t.weights[g * PIXELS..(g + 1) * PIXELS]);
        for ((sum, pixels), set) in of_set.iter_mut().zip(&masks.pixels).zip(&masks.sets) {
            if dim > 0 && !set.is_empty() {
                table.add_to(sum, i, sum_of(weights, pixels));
            }
        }
        let Ok(label) = u32::try_from(labels[i as usize]) else { continue };
        let (Some(pixels), Some(left), Some(region)) =
            (inside.get(&label), left.get_mut(&label), out.instances.get_mut(&label))
        else {
            continue;
        };
        let (mut sum, mut visible) = (0.0f32, 0.0f32);
        // Most blocks of pixels have nothing of a Gaussian.
        for from in (0..PIXELS).step_by(8).filter(|&from| alphas[from..from + 8].iter().any(|a| *a > 0.0)) {
            for p in from..from + 8 {
                visible += if pixels[p] { weights[p] } else { 0.0 };
                let weight = left[p] * alphas[p];
                left[p] *= 1.0 - alphas[p];
                sum += if pixels[p] { weight } else { 0.0 };
            }
        }
        table.add_to(&mut region.features, i, sum);
        region.visible += f64::from(visible);
    }
    for ((set, pixels), features) in masks.sets.iter().zip(&masks.pixels).zip(&of_set) {
        for &mask in set {
            let region = out.masks.entry(masks.ids[mask as usize]).or_insert_with(|| Region::empty(dim));
            region.area += pixels.len() as u32;
            region.features.iter_mut().zip(features).for_each(|(sum, f)| *sum += f);
        }
    }
    out
}

/// Measures a view in one rasterisation, as `raster` says. `labels` are instances of all Gaussians (-1 for none); `camera`
/// has the size of the id maps; masks are those of `levels`.
pub fn overlaps(
    gaussians: &Gaussians,
    raster: &RasterOptions,
    labels: &[i32],
    table: &FeatureTable<'_>,
    camera: &Camera,
    maps: &MaskMaps,
    levels: &[Level],
) -> Overlaps {
    // Hidden Gaussians count too, so no pixel is left before the last of them.
    let early_stop = false;
    let tiles = tile_weights(gaussians, camera, raster, early_stop, |t| {
        tile_overlaps(t, labels, table, &TileMasks::new(t, maps, levels))
    });
    let mut all = Overlaps::default();
    tiles.into_iter().for_each(|tile| all.add(tile));
    all
}

fn cosine(a: &[f64], b: &[f64]) -> f64 {
    if a.is_empty() {
        return 1.0;
    }
    let dot: f64 = a.iter().zip(b).map(|(x, y)| x * y).sum();
    let norm = |v: &[f64]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
    let length = norm(a) * norm(b);
    if length > 1e-30 { dot / length } else { 0.0 }
}

/// The best mask of each instance in a view: S = IoU x similarity of mean features (0 where it is negative; 1 where features
/// have no dimension), kept where it exceeds `threshold`; ties go to the lower mask id.
pub fn matches(overlaps: &Overlaps, view: u32, threshold: f32) -> Vec<Match> {
    best_masks(overlaps, view, threshold, |iou, i, (_, m)| iou * cosine(&i.features, &m.features).max(0.0))
}

/// The best mask of each instance in a view by a score of their IoU, the instance, and the mask with its id; kept where it exceeds
/// `threshold`; ties go to the lower mask id.
pub fn best_masks(
    overlaps: &Overlaps,
    view: u32,
    threshold: f32,
    score: impl Fn(f64, &Region, (u32, &Region)) -> f64,
) -> Vec<Match> {
    let mut best: BTreeMap<u32, Match> = BTreeMap::new();
    for (&(instance, mask), &common) in &overlaps.common {
        let (Some(i), Some(m)) = (overlaps.instances.get(&instance), overlaps.masks.get(&mask)) else { continue };
        let union = i.area + m.area - common;
        let iou = f64::from(common) / f64::from(union.max(1));
        let score = score(iou, i, (mask, m)) as f32;
        let better = best.get(&instance).is_none_or(|b| score > b.score);
        if score > threshold && better {
            best.insert(instance, Match { instance, view, mask, score, visible: i.visible as f32 });
        }
    }
    best.into_values().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;
    use gs_scene::Geometry;
    use ndarray::{Array3, arr2};

    const W: usize = 64;
    const H: usize = 48;

    /// Two opaque blobs side by side, and a third behind the first.
    fn scene() -> (Gaussians, Camera) {
        let g = Gaussians {
            means: vec![[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [-4.0 / 3.0, 0.0, 2.0]],
            log_scales: vec![[0.25f32.ln(); 3]; 3],
            rotations: vec![[1.0, 0.0, 0.0, 0.0]; 3],
            opacity_logits: vec![9.0; 3],
            sh: vec![0.0; 9],
            sh_degree: 0,
            ..Gaussians::default()
        };
        (g, Camera::look_at(DVec3::new(0.0, 0.0, -6.0), DVec3::ZERO, -DVec3::Y, W as u32, H as u32, 0.8))
    }

    /// Halves of the image on one level, the whole of it on another.
    fn maps() -> MaskMaps {
        let id = |(level, _, x)| [i32::from(x >= W / 2), 2, -1, 3 + i32::from(x >= W / 2)][level];
        MaskMaps { ids: Array3::from_shape_fn((4, H, W), id) }
    }

    #[test]
    fn instances_match_the_masks_they_are_seen_as() {
        let (g, camera) = scene();
        let values = arr2(&[[1.0, 0.0], [0.0, 1.0], [-1.0, 0.2]]);
        let features = Features { kept: vec![0, 1, 2], values };
        let table = FeatureTable::new(&features, 3);
        let o = overlaps(&g, &RasterOptions::default(), &[0, 1, 2], &table, &camera, &maps(), &[Level::LARGE]);
        assert_eq!(o.masks[&3].area + o.masks[&4].area, (W * H) as u32);
        assert!(o.common.contains_key(&(0, 3)) && o.common.contains_key(&(1, 4)));
        assert!(!o.common.contains_key(&(0, 4)) && !o.common.contains_key(&(1, 3)));
        // The hidden blob has a silhouette of its own, but little of it is seen.
        let (hidden, seen) = (&o.instances[&2], &o.instances[&0]);
        assert!(hidden.area > 4 && hidden.visible < 0.1 * seen.visible, "{hidden:?} {seen:?}");
        let m = matches(&o, 5, 0.0);
        assert_eq!((m[0].mask, m[0].view, m[1].mask), (3, 5, 4));
        // It covers the mask of what hides it, but its features are its own and tell it from that.
        assert!(m.iter().all(|m| m.instance != 2), "{m:?}");
        assert!(matches(&o, 5, 0.99).is_empty());
    }

    #[test]
    fn areas_and_features_are_those_of_rendered_images() {
        // Without and with the 2D filter, as a marked geometry asks for; it shrinks what is smaller than a pixel.
        let areas = [false, true].map(are_those_of_rendered_images);
        assert!(areas[1] < areas[0], "{areas:?}");
    }

    fn are_those_of_rendered_images(antialias: bool) -> u32 {
        let raster = &RasterOptions::of(&Geometry { antialias, ..Geometry::default() });
        let options = &RasterOptions { antialias, ..RasterOptions::default() };
        let (mut g, camera) = scene();
        // Half transparent, so that silhouettes have shades.
        g.opacity_logits = vec![2.5, 2.0, 1.5];
        let values = arr2(&[[1.0, 2.0, 0.5], [-1.0, 3.0, 0.25]]);
        let features = Features { kept: vec![0, 2], values };
        let all = [1.0, 2.0, 0.5, 0.0, 0.0, 0.0, -1.0, 3.0, 0.25];
        let (labels, maps, levels) = ([0, -1, 0], maps(), [Level::DEFAULT, Level::SMALL]);
        let table = FeatureTable::new(&features, 3);
        let o = overlaps(&g, raster, &labels, &table, &camera, &maps, &levels);
        let image = gs_raster::render_features(&g, &all, 3, &camera, options);
        let alone = g.select(&[0, 2]);
        let own = gs_raster::render_features(&alone, flat(features.values.view()), 3, &camera, options);
        let alpha = gs_raster::render(&alone, &camera, options).alpha;
        let sum = |image: &[f32], inside: &dyn Fn(usize) -> bool| -> (u32, [f64; 3]) {
            let mut out = (0, [0.0; 3]);
            for p in (0..W * H).filter(|&p| inside(p)) {
                out.0 += 1;
                (0..3).for_each(|c| out.1[c] += f64::from(image[p * 3 + c]));
            }
            out
        };
        let check = |region: &Region, (area, features): (u32, [f64; 3])| {
            assert_eq!(region.area, area);
            for (a, b) in region.features.iter().zip(features) {
                assert!((a - b).abs() < 1e-3 * b.abs().max(1.0), "{region:?}, expected {features:?}");
            }
        };
        for (id, level) in [(0, Level::DEFAULT), (1, Level::DEFAULT), (2, Level::SMALL)] {
            check(&o.masks[&id], sum(&image, &|p| flat(maps.level(level))[p] == id as i32));
        }
        let inside = |p: usize| alpha[p] > SELECTED_ALPHA;
        check(&o.instances[&0], sum(&own, &inside));
        let common = |mask: i32| sum(&own, &|p| inside(p) && flat(maps.level(Level::DEFAULT))[p] == mask).0;
        assert_eq!(o.common[&(0, 0)], common(0));
        assert_eq!(o.common.get(&(0, 1)).copied().unwrap_or(0), common(1));
        assert_eq!(o.common[&(0, 2)], o.instances[&0].area);
        // IoU of areas, and the cosine of the sums.
        let (i, m) = (&o.instances[&0], &o.masks[&0]);
        let best = matches(&o, 0, 0.0)[0];
        let iou = f64::from(common(0)) / f64::from(i.area + m.area - common(0));
        assert_eq!(best.mask, 0);
        assert!((f64::from(best.score) - iou * cosine(&i.features, &m.features)).abs() < 1e-6);
        i.area
    }
}
