//! Where the photographs are taken from.

use crate::random::normal;
use crate::scene::Family;
use crate::scene::Scene;
use crate::scene::room::TABLE_HEIGHT;
use glam::{DMat3, DVec2, DVec3, EulerRot};
use gs_scene::Camera;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use std::f64::consts::{PI, TAU};

/// Horizontal field of view in radians.
const FIELD: f64 = 0.90;
/// Heights of the ring's two levels.
const HEIGHTS: [f64; 2] = [1.40, 1.98];
/// The same in furnished rooms, where walls are near.
const WIDE_FIELD: f64 = 1.15;
/// From the walls of a furnished room to the way through it.
const ROOM_AWAY: f64 = 1.22;
/// From the wall to the ring.
const WALL_DISTANCE: f64 = 0.68;
/// Least free space around a camera.
const CLEARANCE: f64 = 0.35;

/// `views` cameras; pictures of `width` x `height` pixels.
pub fn place(scene: &Scene, views: usize, width: u32, height: u32, rng: &mut ChaCha8Rng) -> Vec<Camera> {
    (0..views)
        .map(|i| {
            let (mut eye, mut target) = match scene.family {
                Family::Studio if scene.tables.len() == 1 => ring(scene, i, views),
                Family::Studio => walk(scene, i, views),
                Family::Table => table(scene, i, views),
                Family::Kitchen => kitchen(scene, i, views),
                Family::Room => room(scene, i, views),
                Family::Workshop => workshop(scene, i, views),
            };
            let mut shake = |size: f64| DVec3::new(rng.random(), rng.random(), rng.random()) * 2.0 * size - size;
            eye += shake(0.05);
            target += shake(0.06);
            if scene.family == Family::Studio {
                clear(scene, &mut eye);
            }
            let field = if scene.family == Family::Room { WIDE_FIELD } else { FIELD };
            Camera::look_at(eye, target, DVec3::Z, width, height, field)
        })
        .collect()
}

/// The same cameras as structure from motion would have found them: turned about each axis by Gaussian noise of standard
/// deviation `noise` degrees, and moved along each by as many centimetres.
pub fn perturbed(cameras: &[Camera], noise: f64, rng: &mut ChaCha8Rng) -> Vec<Camera> {
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

/// A point of a rectangle's border and the direction in which it runs, `along` from 0 to 1, counter-clockwise.
fn border(half: DVec2, along: f64) -> (DVec2, DVec2) {
    let corners = [DVec2::new(-half.x, -half.y), DVec2::new(half.x, -half.y), half, DVec2::new(-half.x, half.y)];
    let length = 4.0 * (half.x + half.y);
    let mut left = along.rem_euclid(1.0) * length;
    for k in 0..4 {
        let side = corners[(k + 1) % 4] - corners[k];
        if left <= side.length() || k == 3 {
            let direction = side.normalize_or_zero();
            return (corners[k] + direction * left, direction);
        }
        left -= side.length();
    }
    (corners[0], DVec2::X)
}

/// Half extents of the first table, counter or workbench.
fn top_half(scene: &Scene) -> DVec2 {
    let is_top = |t: &&crate::scene::Thing| ["table", "counter", "workbench"].contains(&t.class);
    scene.things.iter().find(is_top).map_or(DVec2::ONE, |t| t.footprint)
}

/// Three rounds, from beside the table to above it.
fn table(scene: &Scene, i: usize, views: usize) -> (DVec3, DVec3) {
    let (top, half) = (scene.tables[0], top_half(scene));
    let around = DVec2::from_angle(TAU * (i as f64 + 0.25) / views as f64);
    let (out, up) = [(0.75, 0.45), (0.50, 0.80), (0.20, 1.10)][i % 3];
    (top + (around * (half + out)).extend(up), top + (around * half * 0.25).extend(0.03))
}

/// Along the counter and back, at two heights and distances.
fn kitchen(scene: &Scene, i: usize, views: usize) -> (DVec3, DVec3) {
    let (top, half) = (scene.tables[0], top_half(scene));
    let t = (i as f64 + 0.5) / views as f64;
    let (x, away) = if t < 0.5 { (4.0 * t - 1.0, 1.15) } else { (3.0 - 4.0 * t, 1.45) };
    let x = x * (half.x - 0.25);
    let sway = 0.45 * (TAU * 6.0 * t).sin();
    (DVec3::new(x, top.y - away, [1.40, 1.75][i % 2]), DVec3::new(x + sway, top.y, top.z + 0.18))
}

/// Along the bench and back, nearer and farther, looking at the bench, the wall above it and the upper shelves in turn.
fn workshop(scene: &Scene, i: usize, views: usize) -> (DVec3, DVec3) {
    let half = top_half(scene);
    let t = (i as f64 + 0.5) / views as f64;
    let (x, away) = if t < 0.5 { (4.0 * t - 1.0, 1.05) } else { (3.0 - 4.0 * t, 1.40) };
    let end = half.x - 0.30;
    let x = x * end;
    // Not past the ends, where nothing is.
    let ahead = (x + 0.40 * (TAU * 7.0 * t).sin()).clamp(-end, end);
    let (eye, target) = [(1.58, 0.96), (1.38, 1.28), (1.62, 1.62)][i % 3];
    let wall = scene.room.y;
    (DVec3::new(x, wall - away, eye), DVec3::new(ahead, wall - 0.15, target))
}

/// A round through the room between what stands at the walls and in the middle, looking ahead and to both sides.
fn room(scene: &Scene, i: usize, views: usize) -> (DVec3, DVec3) {
    let t = (i as f64 + 0.5) / views as f64;
    let (at, ahead) = border(scene.room - ROOM_AWAY, t);
    let eye = at.extend(1.52 + 0.12 * (TAU * 7.0 * t).sin());
    // Left is inwards; what is right is too near to be seen whole.
    let look = DVec2::from_angle(0.55 + 1.15 * (TAU * 5.0 * t).sin()).rotate(ahead);
    (eye, eye + look.extend(-0.38))
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
    fn cameras_see_things_and_stand_in_none() {
        let families = [
            (Family::Table, 40),
            (Family::Kitchen, 50),
            (Family::Room, 70),
            (Family::Room, 30),
            (Family::Workshop, 90),
        ];
        for (family, objects) in families {
            let rng = &mut ChaCha8Rng::seed_from_u64(objects as u64);
            let scene = crate::scene::families::plan(family, objects, rng);
            let mut seen = vec![0usize; scene.things.len()];
            for camera in place(&scene, 24, 96, 72, rng) {
                let frame = crate::render::identify(&scene, &camera);
                let near = frame.distance.iter().copied().fold(f64::INFINITY, f64::min);
                assert!(near > 0.12, "{family:?}: {near} m from something");
                assert!(frame.thing.iter().all(|&t| t >= 0), "{family:?}: outside the room");
                let mut here = vec![0usize; scene.things.len()];
                frame.thing.iter().for_each(|&t| here[t as usize] += 1);
                assert!(here.iter().filter(|&&n| n > 0).count() >= 3, "{family:?}: sees nothing");
                seen.iter_mut().zip(here).for_each(|(s, n)| *s += usize::from(n >= 4));
            }
            let objects = scene.things.iter().zip(&seen).filter(|(t, _)| !t.background);
            let often = objects.clone().filter(|(_, n)| **n >= 2).count();
            assert!(5 * often >= 3 * objects.count(), "{family:?}: {often} are seen in two views");
        }
    }

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
    }
}
