//! Point sets that trees find hard, and a small scene.

use glam::DVec3;
use gs_scene::{Camera, Gaussians};
use proptest::prelude::{Strategy, prop};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::ops::Range;

/// Random, planar, gridded, duplicated, collinear and far-flung point sets.
pub fn points(size: Range<usize>) -> impl Strategy<Value = Vec<[f32; 3]>> {
    let coordinates = prop::collection::vec(prop::array::uniform3(-2f32..2.0), size);
    (coordinates, 0u8..6).prop_map(|(mut points, kind)| {
        for (i, p) in points.iter_mut().enumerate() {
            match kind {
                1 => p[2] = 0.5,
                2 => *p = p.map(|v| (v * 2.0).round()),
                3 => *p = p.map(f32::round),
                4 => *p = [p[0], 2.0 * p[0], -p[0]],
                5 if i % 7 == 0 => *p = p.map(|v| v * 1e15),
                5 => *p = p.map(|v| v * 1e-12),
                _ => {}
            }
        }
        points
    })
}

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
