//! Where the photographs are taken from.

use crate::layout::TABLE_HEIGHT;
use crate::points::normal;
use crate::scene::Scene;
use glam::{DMat3, DVec2, DVec3, EulerRot};
use gs_scene::Camera;
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use std::f64::consts::{PI, TAU};

/// How the photographer moves.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub enum Path {
    /// Once around the room at two heights, looking inwards.
    Ring,
    /// Around one table after the other, near and far, high and low.
    Walk,
}

/// Horizontal field of view in radians.
const FIELD: f64 = 0.90;
/// Heights of the ring's two levels.
const HEIGHTS: [f64; 2] = [1.40, 1.98];
/// From the wall to the ring.
const WALL_DISTANCE: f64 = 0.68;
/// Least free space around a camera.
const CLEARANCE: f64 = 0.35;

/// `views` cameras; pictures of `width` x `height` pixels.
pub fn place(scene: &Scene, path: Path, views: usize, width: u32, height: u32, rng: &mut ChaCha8Rng) -> Vec<Camera> {
    (0..views)
        .map(|i| {
            let (mut eye, mut target) = match path {
                Path::Ring => ring(scene, i, views),
                Path::Walk => walk(scene, i, views),
            };
            let mut shake = |size: f64| DVec3::new(rng.random(), rng.random(), rng.random()) * 2.0 * size - size;
            eye += shake(0.05);
            target += shake(0.06);
            clear(scene, &mut eye);
            Camera::look_at(eye, target, DVec3::Z, width, height, FIELD)
        })
        .collect()
}

/// The same cameras as structure from motion would have found them: turned about each axis by Gaussian noise of standard
/// deviation `noise` degrees, and moved along each by as many centimetres.
pub fn perturbed(cameras: &[Camera], noise: f64, rng: &mut ChaCha8Rng) -> Vec<Camera> {
    if noise == 0.0 {
        return cameras.to_vec();
    }
    cameras
        .iter()
        .map(|camera| {
            let mut draw = || DVec3::new(normal(rng), normal(rng), normal(rng)) * noise;
            let (turn, shift) = (draw() * PI / 180.0, draw() * 0.01);
            let rotation = DMat3::from_euler(EulerRot::XYZ, turn.x, turn.y, turn.z) * camera.rotation;
            let eye = camera.position() + shift;
            Camera { rotation, translation: -(rotation * eye), ..camera.clone() }
        })
        .collect()
}

fn ring(scene: &Scene, i: usize, views: usize) -> (DVec3, DVec3) {
    let angle = TAU * (i as f64 + 0.25) / views as f64;
    let radius = scene.room - WALL_DISTANCE;
    let around = DVec2::from_angle(angle) * radius;
    // Off-centre in large rooms: look at what is near, not across everything.
    let target = around * (1.0 - 1.75 / radius.min_element().max(1.75)) * 0.6;
    (around.extend(HEIGHTS[i % 2]), target.extend(TABLE_HEIGHT + 0.02))
}

fn walk(scene: &Scene, i: usize, views: usize) -> (DVec3, DVec3) {
    let along = scene.tables.len() as f64 * (i as f64 + 0.5) / views as f64;
    let table = (along as usize).min(scene.tables.len() - 1);
    let turn = along - table as f64;
    let radius = 1.50 + 0.20 * (TAU * 3.0 * turn).sin();
    let height = 1.60 + 0.28 * (TAU * 5.0 * turn).cos();
    let centre = scene.tables[table];
    let around = DVec2::from_angle(TAU * turn) * radius;
    ((centre.truncate() + around).extend(height), centre + DVec3::new(0.0, 0.0, 0.04))
}

/// Lifts the camera over things that it would come too close to.
fn clear(scene: &Scene, eye: &mut DVec3) {
    for t in scene.things.iter().filter(|t| t.class != "wall" && t.class != "floor") {
        let away = (eye.truncate() - t.position.truncate()).length() - t.footprint.length();
        let top = t.position.z + t.height;
        if away < CLEARANCE && eye.z < top + CLEARANCE {
            eye.z = top + CLEARANCE;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;

    #[test]
    fn pose_noise_has_the_size_asked_for_and_keeps_the_lens() {
        let camera = Camera::look_at(DVec3::new(1.0, 2.0, 1.5), DVec3::ZERO, DVec3::Z, 64, 48, FIELD);
        let cameras = vec![camera.clone(); 2000];
        let rng = &mut ChaCha8Rng::seed_from_u64(4);
        let (mut turns, mut shifts) = (0.0, 0.0);
        for c in perturbed(&cameras, 0.5, rng) {
            assert_eq!((c.fx, c.fy, c.cx, c.cy, c.width), (camera.fx, camera.fy, camera.cx, camera.cy, camera.width));
            assert!((c.rotation * c.rotation.transpose() - DMat3::IDENTITY).abs_diff_eq(DMat3::ZERO, 1e-12));
            let relative = c.rotation * camera.rotation.transpose();
            let cosine: f64 = 0.5 * (relative.x_axis.x + relative.y_axis.y + relative.z_axis.z - 1.0);
            turns += cosine.clamp(-1.0, 1.0).acos().to_degrees().powi(2);
            shifts += (100.0 * (c.position() - camera.position())).length_squared();
        }
        // Three axes, each with the variance 0.25.
        assert!((turns / 2000.0 - 0.75).abs() < 0.06, "{turns}");
        assert!((shifts / 2000.0 - 0.75).abs() < 0.06, "{shifts}");
        assert_eq!(perturbed(&cameras[..1], 0.0, rng), cameras[..1]);
    }
}
