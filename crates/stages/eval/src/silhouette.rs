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

/// Selections rendered at once; more are done in turns, which bounds the memory.
const CHANNELS: usize = 16;

impl Rendering {
    /// A selection alone.
    pub const SELECTED: Self = Self { silhouette: Silhouette::Selected, threshold: 0.7 };
    /// What is seen of a selection: half of a pixel.
    pub const SEEN: Self = Self { silhouette: Silhouette::Visible, threshold: 0.5 };

    /// Masks of several selections (ascending indices of Gaussians) in one view, in order; rendered as `raster` says.
    pub fn masks(
        self,
        gaussians: &Gaussians,
        raster: &RasterOptions,
        selections: &[&[u32]],
        camera: &Camera,
    ) -> Vec<Mask> {
        let (width, height) = (camera.width as usize, camera.height as usize);
        let above = |v: &f32| *v > self.threshold;
        let alone = |selection: &&[u32]| {
            if selection.is_empty() {
                return Mask::new(width, height);
            }
            // Of the render only alpha counts.
            let raster = RasterOptions { sh_degree: 0, depth: false, ..raster.clone() };
            let alpha = gs_raster::render(&gaussians.select(selection), camera, &raster).alpha;
            Mask { width, height, bits: alpha.iter().map(above).collect() }
        };
        let visible = |some: &[&[u32]]| {
            let d = some.len();
            let mut member = vec![0.0f32; gaussians.len() * d];
            for (k, selection) in some.iter().enumerate() {
                selection.iter().for_each(|&i| member[i as usize * d + k] = 1.0);
            }
            let shares = gs_raster::render_features(gaussians, &member, d, camera, raster);
            let mask = |k| Mask { width, height, bits: shares.iter().skip(k).step_by(d).map(above).collect() };
            (0..d).map(mask).collect::<Vec<_>>()
        };
        match self.silhouette {
            Silhouette::Selected => selections.iter().map(alone).collect(),
            Silhouette::Visible => selections.chunks(CHANNELS).flat_map(visible).collect(),
        }
    }
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

    fn masks(rendering: Rendering, selections: &[&[u32]]) -> Vec<Mask> {
        let (g, camera) = balls();
        rendering.masks(&g, &RasterOptions::default(), selections, &camera)
    }

    #[test]
    fn a_hidden_part_counts_only_when_rendered_alone() {
        let alone = &masks(Rendering::SELECTED, &[&[1]])[0];
        let seen = &masks(Rendering::SEEN, &[&[1], &[0, 1]]);
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
        for rendering in [Rendering::SELECTED, Rendering::SEEN] {
            assert_eq!(masks(rendering, &[&[]])[0].count(), 0);
        }
        let (g, camera) = balls();
        let most = gs_raster::render(&g, &camera, &RasterOptions::default()).alpha.into_iter().fold(0.0, f32::max);
        assert_eq!(
            masks(Rendering { threshold: most, ..Rendering::SELECTED }, &[&[0, 1]])[0].count(),
            0,
            "the threshold is strict"
        );
    }

    #[test]
    fn many_selections_are_rendered_in_turns() {
        let selections: Vec<&[u32]> = [&[0u32][..], &[1]].into_iter().cycle().take(CHANNELS + 3).collect();
        let masks = masks(Rendering::SEEN, &selections);
        assert_eq!((masks.len(), &masks[CHANNELS..][..2]), (CHANNELS + 3, &masks[..2]));
    }
}
