//! Where the photographs are taken from.

use crate::layout::TABLE_HEIGHT;
use crate::scene::Scene;
use glam::{DVec2, DVec3};
use gs_scene::Camera;
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use std::f64::consts::TAU;

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
