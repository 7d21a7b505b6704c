//! Scenes whose views are known: balls, walls and rooms of small Gaussians.

use glam::{DMat3, DVec3};
use gs_scene::Gaussians;

/// Round Gaussians at these places.
pub fn cloud(places: &[DVec3], scale: f64, opacity: f32) -> Gaussians {
    let n = places.len();
    Gaussians {
        means: places.iter().map(|p| p.as_vec3().to_array()).collect(),
        log_scales: vec![[scale.ln() as f32; 3]; n],
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; n],
        opacity_logits: vec![gs_scene::logit(opacity); n],
        sh: (0..3 * n).map(|i| (i as f32 * 1.7).sin()).collect(),
        sh_degree: 0,
        ..Gaussians::default()
    }
}

/// `n` by `n` places on a square of side 2, spanned by two unit vectors.
pub fn wall(middle: DVec3, a: DVec3, b: DVec3, n: usize) -> Vec<DVec3> {
    let t = |i: usize| -1.0 + 2.0 * i as f64 / (n - 1) as f64;
    (0..n * n).map(|i| middle + t(i % n) * a + t(i / n) * b).collect()
}

/// The surface of a ball of radius 1.
pub fn ball(n: usize) -> Gaussians {
    let places: Vec<DVec3> = super::grid::directions(n).collect();
    cloud(&places, 1.6 / (n as f64).sqrt(), 0.95)
}

/// A closed room of 4 x 3.2 x 2 with a low table, turned by `turn`: up is `turn * Z`. Its Gaussians are flat, as trained
/// ones are.
pub fn room(turn: DMat3) -> Gaussians {
    let half = DVec3::new(2.0, 1.6, 1.0);
    let mut places = Vec::new();
    let mut normals = Vec::new();
    let mut add = |middle: DVec3, a: DVec3, b: DVec3| {
        for p in wall(middle, a, b, 31) {
            places.push(p);
            normals.push(a.cross(b).normalize());
        }
    };
    let [x, y, z] = [DVec3::X * half.x, DVec3::Y * half.y, DVec3::Z * half.z];
    for (middle, a, b) in [(x, y, z), (y, z, x), (z, x, y)] {
        add(middle, a, b);
        add(-middle, a, b);
    }
    add(DVec3::new(0.4, 0.2, -0.6), DVec3::X * 0.6, DVec3::Y * 0.4);
    let turned: Vec<DVec3> = places.iter().map(|&p| turn * p).collect();
    let mut g = cloud(&turned, 0.09, 0.95);
    for (i, n) in normals.into_iter().enumerate() {
        let q = glam::DQuat::from_mat3(&turn) * glam::DQuat::from_rotation_arc(DVec3::Z, n);
        g.rotations[i] = [q.w, q.x, q.y, q.z].map(|v| v as f32);
        g.log_scales[i][2] = 0.005f32.ln();
    }
    g
}
