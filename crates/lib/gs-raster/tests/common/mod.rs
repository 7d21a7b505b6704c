//! Scenes for the tests.

use glam::DVec3;
use gs_scene::{Camera, Gaussians};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{RngCore, SeedableRng};

/// `n` Gaussians of degree 3 in a cube of side 3, of all opacities.
pub fn random(n: usize, seed: u64) -> Gaussians {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut roll = |low: f32, high: f32| low + (high - low) * (rng.next_u32() >> 8) as f32 / 16_777_216.0;
    let mut g = Gaussians { sh_degree: 3, ..Gaussians::default() };
    for _ in 0..n {
        g.means.push([roll(-1.5, 1.5), roll(-1.5, 1.5), roll(-1.5, 1.5)]);
        g.log_scales.push([roll(-5.0, -1.0), roll(-5.0, -1.0), roll(-5.0, -1.0)]);
        g.rotations.push([roll(-1.0, 1.0), roll(-1.0, 1.0), roll(-1.0, 1.0), roll(-1.0, 1.0)]);
        g.opacity_logits.push(roll(-5.0, 6.0));
        g.sh.extend((0..48).map(|_| roll(-0.5, 0.5)));
    }
    g
}

/// A camera four units from the origin, which it looks at.
pub fn camera(width: u32, height: u32) -> Camera {
    Camera::look_at(DVec3::new(1.0, -2.0, -3.3), DVec3::ZERO, DVec3::Z, width, height, 0.9)
}
