//! Which mask of a view shows which instance (paper, "Instance Clustering and Semantic Matching").
//!
//! One rasterisation of a view serves all instances. The silhouette of an instance is where the instance rendered alone
//! has alpha > 0.8: per pixel, 1 - prod(1 - alpha_i) over its own Gaussians, hidden ones included (OpenGaussian's rule); or,
//! occlusion-aware, where its Gaussians have more than half of the blending weight.

use artifacts::{Level, MaskMaps, Match};
use gs_raster::{RasterOptions, TILE, tile_weights};
use gs_scene::{Camera, Gaussians};
use std::collections::BTreeMap;

/// What counts as an instance's silhouette.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Silhouette {
    /// The instance rendered alone, alpha > 0.8.
    Selected,
    /// Where it is seen: more than half of the blending weight.
    Visible,
}

const SELECTED_ALPHA: f32 = 0.8;
const VISIBLE_WEIGHT: f32 = 0.5;

/// Pixels of something in a view and the sum of rendered features over them.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Region {
    /// Pixels.
    pub area: u32,
    /// Sum of rendered features over the pixels, `[dim]`.
    pub features: Vec<f64>,
}

impl Region {
    fn add(&mut self, area: u32, features: &[f64]) {
        self.area += area;
        if self.features.is_empty() {
            self.features = vec![0.0; features.len()];
        }
        self.features.iter_mut().zip(features).for_each(|(s, f)| *s += f);
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

/// Measures a view. `labels` are instances of all Gaussians (-1 for none), `features` `[N][dim]`, `camera` has the size of the
/// id maps.
pub fn overlaps(
    gaussians: &Gaussians,
    labels: &[i32],
    features: &[f32],
    dim: usize,
    camera: &Camera,
    maps: &MaskMaps,
    level: Level,
    silhouette: Silhouette,
) -> Overlaps {
    let ids = maps.level(level);
    let early_stop = silhouette == Silhouette::Visible;
    let tiles = tile_weights(gaussians, camera, &RasterOptions::default(), early_stop, |t| {
        let pixels = TILE * TILE;
        let mut rendered = vec![0.0f32; pixels * dim];
        // Transmittance (selected) or weight (visible) of each instance at each pixel.
        let mut coverage: BTreeMap<u32, Vec<f32>> = BTreeMap::new();
        for (g, &i) in t.gaussians.iter().enumerate() {
            let weights = &t.weights[g * pixels..(g + 1) * pixels];
            let feature = &features[i as usize * dim..(i as usize + 1) * dim];
            for (p, &w) in weights.iter().enumerate() {
                if w > 0.0 {
                    for (r, f) in rendered[p * dim..(p + 1) * dim].iter_mut().zip(feature) {
                        *r += w * f;
                    }
                }
            }
            let Ok(label) = u32::try_from(labels[i as usize]) else { continue };
            match silhouette {
                Silhouette::Selected => {
                    let left = coverage.entry(label).or_insert_with(|| vec![1.0; pixels]);
                    for (l, a) in left.iter_mut().zip(&t.alphas[g * pixels..(g + 1) * pixels]) {
                        *l *= 1.0 - a;
                    }
                }
                Silhouette::Visible => {
                    let sum = coverage.entry(label).or_insert_with(|| vec![0.0; pixels]);
                    sum.iter_mut().zip(weights).for_each(|(s, w)| *s += w);
                }
            }
        }
        let inside = |value: f32| match silhouette {
            Silhouette::Selected => 1.0 - value > SELECTED_ALPHA,
            Silhouette::Visible => value > VISIBLE_WEIGHT,
        };
        let mut out = Overlaps::default();
        let mut feature = vec![0.0f64; dim];
        let mut id_at = vec![-1i32; pixels];
        for y in 0..t.height {
            for x in 0..t.width {
                let (p, id) = (y * TILE + x, ids[(t.y0 + y) * maps.width + t.x0 + x]);
                id_at[p] = id;
                if let Ok(id) = u32::try_from(id) {
                    feature.iter_mut().zip(&rendered[p * dim..]).for_each(|(f, r)| *f = f64::from(*r));
                    out.masks.entry(id).or_default().add(1, &feature);
                }
            }
        }
        for (instance, values) in coverage {
            let mut region = Region::default();
            for y in 0..t.height {
                for x in 0..t.width {
                    let p = y * TILE + x;
                    if !inside(values[p]) {
                        continue;
                    }
                    feature.iter_mut().zip(&rendered[p * dim..]).for_each(|(f, r)| *f = f64::from(*r));
                    region.add(1, &feature);
                    if let Ok(id) = u32::try_from(id_at[p]) {
                        *out.common.entry((instance, id)).or_default() += 1;
                    }
                }
            }
            if region.area > 0 {
                out.instances.insert(instance, region);
            }
        }
        out
    });
    let mut all = Overlaps::default();
    for tile in tiles {
        for (k, r) in tile.instances {
            all.instances.entry(k).or_default().add(r.area, &r.features);
        }
        for (k, r) in tile.masks {
            all.masks.entry(k).or_default().add(r.area, &r.features);
        }
        for (k, n) in tile.common {
            *all.common.entry(k).or_default() += n;
        }
    }
    all
}

fn cosine(a: &[f64], b: &[f64]) -> f64 {
    let dot: f64 = a.iter().zip(b).map(|(x, y)| x * y).sum();
    let norm = |v: &[f64]| v.iter().map(|x| x * x).sum::<f64>().sqrt();
    let length = norm(a) * norm(b);
    if length > 1e-30 { dot / length } else { 0.0 }
}

/// The best mask of each instance in a view: S = IoU x similarity of mean features (0 where it is negative), kept where it
/// exceeds `threshold`; ties go to the lower mask id.
pub fn matches(overlaps: &Overlaps, view: u32, threshold: f32) -> Vec<Match> {
    let mut best: BTreeMap<u32, Match> = BTreeMap::new();
    for (&(instance, mask), &common) in &overlaps.common {
        let (Some(i), Some(m)) = (overlaps.instances.get(&instance), overlaps.masks.get(&mask)) else { continue };
        let union = i.area + m.area - common;
        let iou = f64::from(common) / f64::from(union.max(1));
        let score = (iou * cosine(&i.features, &m.features).max(0.0)) as f32;
        let better = best.get(&instance).is_none_or(|b| score > b.score);
        if score > threshold && better {
            best.insert(instance, Match { instance, view, mask, score });
        }
    }
    best.into_values().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    /// Two opaque blobs side by side, and a third behind the first.
    fn scene() -> (Gaussians, Camera) {
        let g = Gaussians {
            means: vec![[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [-4.0 / 3.0, 0.0, 2.0]],
            log_scales: vec![[0.25f32.ln(); 3]; 3],
            rotations: vec![[1.0, 0.0, 0.0, 0.0]; 3],
            opacity_logits: vec![9.0; 3],
            sh: vec![0.0; 9],
            sh_degree: 0,
        };
        (g, Camera::look_at(DVec3::new(0.0, 0.0, -6.0), DVec3::ZERO, -DVec3::Y, 64, 48, 0.8))
    }

    #[test]
    fn instances_match_the_masks_they_are_seen_as() {
        let (g, camera) = scene();
        let ids: Vec<i32> = (0..48 * 64).map(|p| i32::from(p % 64 >= 32)).collect();
        let maps = MaskMaps { width: 64, height: 48, ids: ids.repeat(4) };
        let features = [1.0, 0.0, 0.0, 1.0, 1.0, 0.0];
        for silhouette in [Silhouette::Selected, Silhouette::Visible] {
            let o = overlaps(&g, &[0, 1, 2], &features, 2, &camera, &maps, Level::Large, silhouette);
            assert_eq!(o.masks[&0].area + o.masks[&1].area, 64 * 48);
            assert!(o.common.contains_key(&(0, 0)) && o.common.contains_key(&(1, 1)));
            assert!(!o.common.contains_key(&(0, 1)) && !o.common.contains_key(&(1, 0)));
            // The hidden blob has a silhouette of its own when rendered alone, and none (or a rim) when only the visible counts.
            let hidden = o.instances.get(&2).map_or(0, |r| r.area);
            match silhouette {
                Silhouette::Selected => assert!(hidden > 4),
                Silhouette::Visible => assert!(hidden * 4 < o.instances[&0].area),
            }
            let m = matches(&o, 5, 0.0);
            assert_eq!((m[0].mask, m[0].view, m[1].mask), (0, 5, 1));
            assert!(matches(&o, 5, 0.99).is_empty());
        }
    }
}
