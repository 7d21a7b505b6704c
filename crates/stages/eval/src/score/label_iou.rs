//! Instances against polygon labels, without text: how well any instance fits each labelled object in each view.

use super::labels::FrameLabels;
use super::metrics::counts;
use crate::silhouette::Rendering;
use gs_io::Result;
use gs_raster::{RasterOptions, TILE};
use gs_scene::dataset::Dataset;
use gs_scene::{Camera, Gaussians};
use query::LabelledScene;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// How a labelled object is found in a view.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct LabelScore {
    /// Stem of the view.
    pub frame: String,
    /// The labelled category.
    pub category: String,
    /// Best IoU of its pixels with those of any one instance.
    pub iou: f64,
    /// The instance that gives it; none where no instance touches it.
    pub instance: Option<i32>,
    /// Labelled pixels.
    pub pixels: usize,
}

/// The best instance for each labelled object of each frame, as far as it is visible: an
/// instance owns the pixels of which it gives more than half of the blended weight. Objects of a frame that is no view
/// have IoU 0.
pub fn score(scene: &LabelledScene, dataset: &Dataset, frames: &[FrameLabels]) -> Result<Vec<LabelScore>> {
    let mut scores = Vec::new();
    for frame in frames {
        let map = match dataset.views.iter().find(|v| v.stem() == frame.frame) {
            None => vec![-1; frame.width as usize * frame.height as usize],
            Some(view) => instance_map(scene.gaussians(), &scene.instances.label, &frame.camera(view)?, &scene.raster),
        };
        let sizes = counts(map.iter().copied());
        for (category, mask) in &frame.categories {
            let labelled = map.iter().zip(&mask.bits).filter(|(i, inside)| **inside && **i >= 0);
            let both = counts(labelled.map(|(i, _)| *i));
            let pixels = mask.count();
            let iou = |(i, n): (&i32, &usize)| (*n as f64 / (pixels + sizes[i] - n) as f64, *i);
            let best = both.iter().map(iou).max_by(|a, b| a.0.total_cmp(&b.0).then(b.1.cmp(&a.1)));
            scores.push(LabelScore {
                frame: frame.frame.clone(),
                category: category.clone(),
                iou: best.map_or(0.0, |b| b.0),
                instance: best.map(|b| b.1),
                pixels,
            });
        }
    }
    Ok(scores)
}

/// Which instance each pixel shows, `[height][width]`; -1 where none has more than half of the weight.
fn instance_map(gaussians: &Gaussians, label: &[i32], camera: &Camera, raster: &RasterOptions) -> Vec<i32> {
    let (w, h) = (camera.width as usize, camera.height as usize);
    let mut map = vec![-1; w * h];
    if gaussians.is_empty() {
        return map;
    }
    let tiles = gs_raster::tile_weights(gaussians, camera, raster, true, |tile| {
        let mut shares = BTreeMap::<i32, Vec<f32>>::new();
        for (k, &g) in tile.gaussians.iter().enumerate().filter(|(_, g)| label[**g as usize] >= 0) {
            let share = shares.entry(label[g as usize]).or_insert_with(|| vec![0.0; TILE * TILE]);
            let weights = &tile.weights[k * TILE * TILE..(k + 1) * TILE * TILE];
            share.iter_mut().zip(weights).for_each(|(s, w)| *s += w);
        }
        let mut shown = Vec::new();
        for y in 0..tile.height {
            for x in 0..tile.width {
                let at = y * TILE + x;
                let winner = shares.iter().find(|(_, s)| s[at] > Rendering::SEEN.threshold).map_or(-1, |(i, _)| *i);
                shown.push(((tile.y0 + y) * w + tile.x0 + x, winner));
            }
        }
        shown
    });
    tiles.into_iter().flatten().for_each(|(at, instance)| map[at] = instance);
    map
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    #[test]
    fn the_map_agrees_with_the_visible_silhouettes() {
        let mut g = Gaussians::default();
        for (x, z, scale) in [(0.0, 2.0, 0.1f32), (0.1, 4.0, 0.5), (-0.8, 3.0, 0.3), (0.9, 3.5, 0.2)] {
            g.means.push([x, 0.0, z]);
            g.log_scales.push([scale.ln(); 3]);
            g.rotations.push([1.0, 0.0, 0.0, 0.0]);
            g.opacity_logits.push(6.0);
            g.sh.extend([0.0; 3]);
        }
        let camera = Camera::look_at(DVec3::ZERO, DVec3::Z, -DVec3::Y, 75, 50, 1.0);
        let map = instance_map(&g, &[2, 0, 0, -1], &camera, &RasterOptions::default());
        let masks = Rendering::SEEN.masks(&g, &RasterOptions::default(), &[&[1, 2], &[], &[0]], &camera);
        for (at, &i) in map.iter().enumerate() {
            for (k, mask) in masks.iter().enumerate() {
                assert_eq!(mask.bits[at], i == k as i32, "pixel {at}, instance {k}");
            }
        }
        assert!(map.iter().filter(|&&i| i == 0).count() > 100 && map.contains(&2));
    }
}
