//! A small scene.

use glam::DVec3;
use gs_scene::{Camera, Gaussians};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Gaussians in a thick slab around the origin.
pub fn cloud(n: usize) -> Gaussians {
    let mut rng = ChaCha8Rng::seed_from_u64(4);
    let mut draw = |lo: f32, hi: f32| rng.random_range(lo..hi);
    let mut g = Gaussians { sh_degree: 0, ..Gaussians::default() };
    for _ in 0..n {
        g.means.push([draw(-1.5, 1.5), draw(-1.0, 1.0), draw(-0.5, 0.5)]);
        g.log_scales.push([draw(-2.5, -1.5), draw(-2.5, -1.5), draw(-2.5, -1.5)]);
        g.rotations.push([1.0, draw(-1.0, 1.0), draw(-1.0, 1.0), draw(-1.0, 1.0)]);
        g.opacity_logits.push(draw(-1.0, 3.0));
        g.sh.extend([draw(-1.0, 1.0), draw(-1.0, 1.0), draw(-1.0, 1.0)]);
    }
    g
}

/// A camera that sees the slab.
pub fn camera(width: u32, height: u32) -> Camera {
    Camera::look_at(DVec3::new(0.2, -0.1, -2.0), DVec3::ZERO, DVec3::NEG_Y, width, height, 1.2)
}
