//! Balls of different colours, and cameras in a ring around them.

use super::write_scene;
use glam::DVec3;
use gs_raster::{RasterOptions, render};
use gs_scene::{Camera, Gaussians, Image, PointCloud, SH_C0};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use std::path::Path;
use std::sync::OnceLock;

pub const SIZE: (u32, u32) = (72, 56);

pub fn world() -> (Gaussians, Vec<Camera>) {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let mut unit = || rng.random_range(-1.0f32..1.0);
    let mut g = Gaussians { sh_degree: 0, ..Gaussians::default() };
    for _ in 0..60 {
        g.means.push([unit(), unit(), 0.6 * unit()]);
        g.log_scales.push([unit(), unit(), unit()].map(|v| -2.0 + 0.4 * v));
        g.rotations.push([1.0, unit(), unit(), unit()]);
        g.opacity_logits.push(2.0);
        g.sh.extend([unit(), unit(), unit()].map(|v| 0.45 * v / SH_C0));
    }
    let cameras = (0..10).map(|i| {
        let a = f64::from(i) / 10.0 * std::f64::consts::TAU;
        let eye = DVec3::new(3.2 * a.cos(), 3.2 * a.sin(), 0.8 + 0.5 * (3.0 * a).sin());
        Camera::look_at(eye, DVec3::ZERO, DVec3::Z, SIZE.0, SIZE.1, 0.9)
    });
    (g, cameras.collect())
}

/// Points near the balls, as structure from motion would give them.
pub fn points() -> PointCloud {
    let (g, _) = world();
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    let mut cloud = PointCloud::default();
    for i in 0..g.len() {
        for _ in 0..3 {
            cloud.positions.push(g.means[i].map(|v| v + rng.random_range(-0.05f32..0.05)));
            cloud.colors.push(g.base_color(i).map(|v| (v.clamp(0.0, 1.0) * 255.0) as u8));
        }
    }
    cloud
}

/// Writes the world with photographs by its first `views` cameras.
pub fn write_world(root: &str, views: usize, points: &PointCloud) {
    let (g, cameras) = world();
    write_scene(Path::new(root), &cameras[..views], points, |_, c, path| {
        let r = render(&g, c, &RasterOptions::default());
        Image { width: r.width, height: r.height, rgb: r.rgb, alpha: None }.write_png(path).unwrap();
    });
}

/// The world with points and ten views, written once.
pub fn scene() -> &'static str {
    static ONCE: OnceLock<(tempfile::TempDir, String)> = OnceLock::new();
    &ONCE
        .get_or_init(|| {
            let dir = tempfile::tempdir().unwrap();
            let path = dir.path().to_string_lossy().into_owned();
            write_world(&path, 10, &points());
            (dir, path)
        })
        .1
}
