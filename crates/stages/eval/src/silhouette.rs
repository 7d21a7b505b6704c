//! Silhouettes of selected Gaussians in a view.

use crate::Mask;
use gs_raster::RasterOptions;
use gs_scene::{Camera, Gaussians};
use serde::{Deserialize, Serialize};

/// How a selection becomes a mask. The two give different scores: say which was used (docs/protocols.md).
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Silhouette {
    /// Render the selected Gaussians alone; what stands before them does not hide them (OpenGaussian, CAGS)
    Selected,
    /// Render all Gaussians, count the share of the selected: what is hidden is not shown (AG2aussian, LaGa)
    Visible,
}

impl Silhouette {
    /// The value above which a pixel belongs, where none is given: 0.7 of accumulated alpha, or half of the pixel.
    pub fn default_threshold(self) -> f32 {
        match self {
            Self::Selected => 0.7,
            Self::Visible => 0.5,
        }
    }

    /// The name it has on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Selected => "selected",
            Self::Visible => "visible",
        }
    }
}

/// The rule by which selections become masks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rendering {
    /// Rendered alone, or as far as visible.
    pub silhouette: Silhouette,
    /// The value above which a pixel belongs.
    pub threshold: f32,
}

impl Rendering {
    /// Masks of several selections (ascending indices of Gaussians) in one view, in order; rendered as `raster` says.
    pub fn masks(
        self,
        gaussians: &Gaussians,
        raster: &RasterOptions,
        selections: &[&[u32]],
        camera: &Camera,
    ) -> Vec<Mask> {
        match self.silhouette {
            Silhouette::Selected => {
                selections.iter().map(|s| alone(gaussians, raster, s, camera, self.threshold)).collect()
            }
            Silhouette::Visible => visible(gaussians, raster, selections, camera, self.threshold),
        }
    }
}

fn alone(gaussians: &Gaussians, raster: &RasterOptions, selection: &[u32], camera: &Camera, threshold: f32) -> Mask {
    let (w, h) = (camera.width as usize, camera.height as usize);
    if selection.is_empty() {
        return Mask::new(w, h);
    }
    // Of the render only alpha counts.
    let raster = RasterOptions { sh_degree: 0, depth: false, ..raster.clone() };
    Mask::above(w, h, &gs_raster::render(&gaussians.select(selection), camera, &raster).alpha, threshold)
}

/// Selections rendered at once; more are done in turns, which bounds the memory.
const CHANNELS: usize = 16;

fn visible(
    gaussians: &Gaussians,
    raster: &RasterOptions,
    selections: &[&[u32]],
    camera: &Camera,
    threshold: f32,
) -> Vec<Mask> {
    let (w, h) = (camera.width as usize, camera.height as usize);
    let shares = blended(gaussians, raster, selections.len(), camera, |member, k, d| {
        for &i in selections[k] {
            member[i as usize * d] = 1.0;
        }
    });
    shares.iter().map(|share| Mask::above(w, h, share, threshold)).collect()
}

/// Blends `count` values per Gaussian. `fill(values, k, d)` writes value k of Gaussian i to `values[i * d]`.
fn blended(
    gaussians: &Gaussians,
    raster: &RasterOptions,
    count: usize,
    camera: &Camera,
    fill: impl Fn(&mut [f32], usize, usize),
) -> Vec<Vec<f32>> {
    let mut maps = Vec::with_capacity(count);
    for first in (0..count).step_by(CHANNELS) {
        let d = CHANNELS.min(count - first);
        let mut values = vec![0.0f32; gaussians.len() * d];
        if !gaussians.is_empty() {
            (0..d).for_each(|k| fill(&mut values[k..], first + k, d));
        }
        let image = gs_raster::render_features(gaussians, &values, d, camera, raster);
        maps.extend((0..d).map(|k| image.iter().skip(k).step_by(d).copied().collect::<Vec<f32>>()));
    }
    maps
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::DVec3;

    /// Two opaque balls on the axis of the camera: a small near one before a large far one.
    fn balls() -> (Gaussians, Camera) {
        let mut g = Gaussians::default();
        for (z, scale) in [(2.0, 0.1f32), (4.0, 0.5)] {
            g.means.push([0.0, 0.0, z]);
            g.log_scales.push([scale.ln(); 3]);
            g.rotations.push([1.0, 0.0, 0.0, 0.0]);
            g.opacity_logits.push(6.0);
            g.sh.extend([0.0; 3]);
        }
        (g, Camera::look_at(DVec3::ZERO, DVec3::Z, -DVec3::Y, 64, 48, 1.0))
    }

    fn raster() -> RasterOptions {
        RasterOptions::default()
    }

    const SELECTED: Rendering = Rendering { silhouette: Silhouette::Selected, threshold: 0.7 };
    const VISIBLE: Rendering = Rendering { silhouette: Silhouette::Visible, threshold: 0.5 };

    #[test]
    fn a_hidden_part_counts_only_when_rendered_alone() {
        let (g, camera) = balls();
        let far: &[u32] = &[1];
        let alone = &SELECTED.masks(&g, &raster(), &[far], &camera)[0];
        let seen = &VISIBLE.masks(&g, &raster(), &[far, &[0, 1]], &camera);
        let centre = 24 * 64 + 32;
        assert!(alone.bits[centre] && !seen[0].bits[centre] && seen[1].bits[centre]);
        assert!(seen[0].count() > 20, "its rim is seen");
        // alpha = 0.99753 exp(-r^2 / (2 s^2)) > 0.7 within r = s sqrt(2 ln(0.99753 / 0.7)); s^2 = (f 0.5 / 4)^2 + 0.3.
        let f = 32.0 / 0.5f64.tan();
        let s2 = (f * 0.125).powi(2) + 0.3;
        let area = std::f64::consts::PI * s2 * 2.0 * (0.99753f64 / 0.7).ln();
        assert!((alone.count() as f64 - area).abs() < 0.06 * area + 4.0, "{} {area}", alone.count());
    }

    #[test]
    fn nothing_selected_covers_nothing() {
        let (g, camera) = balls();
        for s in [SELECTED, VISIBLE] {
            assert_eq!(s.masks(&g, &raster(), &[&[]], &camera)[0].count(), 0);
        }
    }

    #[test]
    fn many_selections_are_rendered_in_turns() {
        let (g, camera) = balls();
        let selections: Vec<&[u32]> =
            (0..CHANNELS + 3).map(|i| if i % 2 == 0 { &[0u32][..] } else { &[1][..] }).collect();
        let masks = VISIBLE.masks(&g, &raster(), &selections, &camera);
        assert_eq!(masks.len(), CHANNELS + 3);
        assert_eq!(masks[CHANNELS], masks[0]);
        assert_eq!(masks[CHANNELS + 1], masks[1]);
    }
}
