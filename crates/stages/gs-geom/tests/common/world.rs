//! Balls of different colours, cameras in a ring around them, and COLMAP scenes of their photographs.

use glam::DVec3;
use gs_raster::{RasterOptions, render};
use gs_scene::{Camera, Gaussians, Image, PointCloud, colmap};
use std::path::Path;
use std::sync::OnceLock;

pub const SIZE: (u32, u32) = (72, 56);
pub const PIXELS: usize = (SIZE.0 * SIZE.1) as usize;

/// `n` balls on a spiral around the origin.
pub fn balls(n: usize) -> Gaussians {
    let t = |i: usize| i as f32 / n as f32;
    Gaussians {
        means: (0..n).map(|i| [(11.0 * t(i)).cos() * t(i), (11.0 * t(i)).sin() * t(i), t(i) - 0.5]).collect(),
        log_scales: vec![[-1.9, -2.1, -1.8]; n],
        rotations: vec![[1.0, 0.2, -0.1, 0.3]; n],
        opacity_logits: vec![3.0; n],
        sh: (0..3 * n).map(|i| (i as f32 * 1.7).sin()).collect(),
        sh_degree: 0,
        ..Gaussians::default()
    }
}

/// The centres of 60 balls, as structure from motion would give them.
pub fn points() -> PointCloud {
    let color = |i: usize| balls(60).base_color(i).map(|v| (v.clamp(0.0, 1.0) * 255.0) as u8);
    PointCloud { positions: balls(60).means, colors: (0..60).map(color).collect(), ..PointCloud::default() }
}

/// Cameras around the origin.
pub fn ring(views: usize) -> Vec<Camera> {
    let at = |i: usize| {
        let a = i as f64 / views as f64 * std::f64::consts::TAU;
        let eye = DVec3::new(3.0 * a.cos(), 3.0 * a.sin(), 0.5);
        Camera::look_at(eye, DVec3::ZERO, DVec3::Z, SIZE.0, SIZE.1, 0.8)
    };
    (0..views).map(at).collect()
}

/// Writes a COLMAP scene; `photograph` writes that of each camera to a path.
pub fn write_scene(root: &str, cameras: &[Camera], points: &PointCloud, photograph: impl Fn(usize, &Camera, &Path)) {
    let root = Path::new(root);
    std::fs::create_dir_all(root.join("images")).unwrap();
    let views: Vec<(String, Camera)> =
        cameras.iter().enumerate().map(|(i, c)| (format!("{i:02}.png"), c.clone())).collect();
    for (i, (name, camera)) in views.iter().enumerate() {
        photograph(i, camera, &root.join("images").join(name));
    }
    colmap::write_model(&root.join("sparse/0"), &views, points).unwrap();
}

/// Writes what a camera sees of 60 balls.
pub fn photograph(_: usize, camera: &Camera, path: &Path) {
    let r = render(&balls(60), camera, &RasterOptions::default());
    Image { width: r.width, height: r.height, rgb: r.rgb, alpha: None }.write_png(path).unwrap();
}

/// Writes 60 balls seen from `views` cameras.
pub fn write_world(root: &str, views: usize, points: &PointCloud) {
    write_scene(root, &ring(views), points, photograph);
}

/// The balls with points and ten views, written once.
pub fn scene() -> &'static str {
    static ONCE: OnceLock<tempfile::TempDir> = OnceLock::new();
    let dir = ONCE.get_or_init(|| {
        let dir = tempfile::tempdir().unwrap();
        write_world(dir.path().to_str().unwrap(), 10, &points());
        dir
    });
    dir.path().to_str().unwrap()
}
