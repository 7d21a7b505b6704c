//! Features of any dimension, blended like colours.

use crate::tiles::{PIXELS, TILE};
use crate::types::RasterOptions;
use crate::weights::tile_weights;
use gs_scene::{Camera, Gaussians};

/// Renders features: sum of blending weight times feature, `[height][width][dim]`, over a zero background.
///
/// # Panics
/// When `features` is not `[N][dim]`.
pub fn render_features(
    g: &Gaussians,
    features: &[f32],
    dim: usize,
    camera: &Camera,
    options: &RasterOptions,
) -> Vec<f32> {
    assert_eq!(features.len(), g.len() * dim);
    let (w, h) = (camera.width as usize, camera.height as usize);
    let tiles = tile_weights(g, camera, options, true, |t| {
        let mut out = vec![0.0f32; t.width * t.height * dim];
        for (&i, weights) in t.gaussians.iter().zip(t.weights.chunks_exact(PIXELS)) {
            let feature = &features[i as usize * dim..(i as usize + 1) * dim];
            for y in 0..t.height {
                for x in 0..t.width {
                    let weight = weights[y * TILE + x];
                    if weight > 0.0 {
                        let at = (y * t.width + x) * dim;
                        for (o, f) in out[at..at + dim].iter_mut().zip(feature) {
                            *o += weight * f;
                        }
                    }
                }
            }
        }
        (t.x0, t.y0, t.width, out)
    });
    let mut image = vec![0.0; w * h * dim];
    for (x0, y0, width, values) in tiles {
        for (y, row) in values.chunks_exact(width * dim).enumerate() {
            let at = ((y0 + y) * w + x0) * dim;
            image[at..at + width * dim].copy_from_slice(row);
        }
    }
    image
}
