//! Cameras that are refined with the scene: a pose for each view, a focal length for each lens.
//!
//! A step turns and shifts the camera by what Adam makes of [`gs_raster::camera_gradient`]. It turns about the point on its axis that is as
//! far away as the scene: about its own centre, a turn would move the picture almost as a shift does, and Adam, which scales each number by
//! itself, would hardly tell the two apart. The scene's own steps are many times smaller than its poses' errors, and so it holds them
//! all where they are.

use glam::{DMat3, DQuat, DVec3};
use gs_raster::CameraGradient;
use gs_scene::Camera;
use serde::Serialize;

/// Numbers of a pose: quaternion (w x y z) and translation, camera from world.
pub const NUMBERS: usize = 7;
/// What a pose moves by: turn, shift.
const MOVES: usize = 6;

/// How fast cameras move.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PoseRates {
    /// Turn of a step in radians; also the shift, in the scene's extents.
    pub turn: f64,
    /// The same at the end of the run, exponential between.
    pub turn_end: f64,
    /// Of the logarithm of the focal lengths, in turns: a lens moves with each of its views.
    pub zoom: f64,
    /// Share of the run in which the rates grow from 0: the scene must show something first.
    pub warm_up: f64,
}

impl Default for PoseRates {
    fn default() -> Self {
        Self { turn: 2e-3, turn_end: 1e-4, zoom: 0.1, warm_up: 0.05 }
    }
}

impl PoseRates {
    /// The turn of a step at `t` of the run (0 to 1).
    fn at(&self, t: f64) -> f64 {
        let t = t.clamp(0.0, 1.0);
        let grown = if self.warm_up > 0.0 { (t / self.warm_up).min(1.0) } else { 1.0 };
        self.turn * (self.turn_end / self.turn).powf(t) * grown
    }
}

/// The refined cameras, with Adam's state.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Poses {
    /// Of the training views, then of those held out. None in a run without refinement.
    pub views: Vec<[f64; NUMBERS]>,
    /// Logarithm of each lens's focal lengths over those given.
    pub zooms: Vec<f64>,
    /// Adam's two moments of each view's moves.
    pub first: Vec<[f64; MOVES]>,
    pub second: Vec<[f64; MOVES]>,
    /// Adam's two moments of the zooms.
    pub of_zooms: Vec<[f64; 2]>,
    /// Steps taken, of each view, then of each lens.
    pub steps: Vec<u32>,
}

impl Poses {
    /// The cameras to begin with, of which `given` are those of the dataset; `lenses` numbers the lens of each.
    pub fn new(cameras: &[Camera], given: &[Camera], lenses: &[usize]) -> Self {
        let n = cameras.len();
        let count = lenses.iter().max().map_or(0, |l| l + 1);
        let mut zooms = vec![0.0; count];
        for ((c, g), &lens) in cameras.iter().zip(given).zip(lenses) {
            zooms[lens] = (c.fx / g.fx).ln();
        }
        Self {
            views: cameras.iter().map(numbers).collect(),
            zooms,
            first: vec![[0.0; MOVES]; n],
            second: vec![[0.0; MOVES]; n],
            of_zooms: vec![[0.0; 2]; count],
            steps: vec![0; n + count],
        }
    }

    /// A view's camera, of which `given` is the dataset's, of any size.
    pub fn camera(&self, view: usize, lens: usize, given: &Camera) -> Camera {
        let [w, x, y, z, tx, ty, tz] = self.views[view];
        let zoom = self.zooms[lens].exp();
        Camera {
            fx: given.fx * zoom,
            fy: given.fy * zoom,
            rotation: DMat3::from_quat(DQuat::from_xyzw(x, y, z, w)),
            translation: DVec3::new(tx, ty, tz),
            ..given.clone()
        }
    }

    /// Moves a view's camera and its lens against the gradient, at `t` of the run (0 to 1). A gradient that is not finite is not
    /// used.
    pub fn step(&mut self, view: usize, lens: usize, g: &CameraGradient, rates: &PoseRates, t: f64, extent: f64) {
        if !g.is_finite() {
            return;
        }
        let rate = rates.at(t);
        let mut pose = Moment { first: self.first[view], second: self.second[view], steps: self.steps[view] };
        self.views[view] = pose.step(&self.views[view], g, rate, extent);
        (self.first[view], self.second[view], self.steps[view]) = (pose.first, pose.second, pose.steps);
        let steps = &mut self.steps[self.views.len() + lens];
        *steps = steps.saturating_add(1);
        let [m, v] = &mut self.of_zooms[lens];
        self.zooms[lens] -= rate * rates.zoom * adam(m, v, g.zoom, *steps);
    }
}

/// Adam's state of one pose.
#[derive(Default)]
pub struct Moment {
    first: [f64; MOVES],
    second: [f64; MOVES],
    steps: u32,
}

impl Moment {
    /// The pose after a step of `rate` radians, and as many extents.
    pub fn step(&mut self, pose: &[f64; NUMBERS], g: &CameraGradient, rate: f64, extent: f64) -> [f64; NUMBERS] {
        self.steps = self.steps.saturating_add(1);
        let pivot = g.depth * DVec3::Z;
        let turn = DVec3::from(g.turn) - pivot.cross(DVec3::from(g.shift));
        let gradient = [turn.to_array(), g.shift].concat();
        let by: [f64; MOVES] =
            std::array::from_fn(|k| -rate * adam(&mut self.first[k], &mut self.second[k], gradient[k], self.steps));
        let [w, x, y, z, tx, ty, tz] = *pose;
        let turn = DQuat::from_scaled_axis(DVec3::new(by[0], by[1], by[2]));
        let q = (turn * DQuat::from_xyzw(x, y, z, w)).normalize();
        let t = turn * (DVec3::new(tx, ty, tz) - pivot) + pivot + extent * DVec3::new(by[3], by[4], by[5]);
        [q.w, q.x, q.y, q.z, t.x, t.y, t.z]
    }
}

/// Adam's direction for one number; its length is about 1.
fn adam(first: &mut f64, second: &mut f64, gradient: f64, steps: u32) -> f64 {
    let steps = i32::try_from(steps).unwrap_or(i32::MAX);
    *first = 0.9 * *first + 0.1 * gradient;
    *second = 0.99 * *second + 0.01 * gradient * gradient;
    *first / (1.0 - 0.9f64.powi(steps)) / ((*second / (1.0 - 0.99f64.powi(steps))).sqrt() + 1e-15)
}

fn numbers(c: &Camera) -> [f64; NUMBERS] {
    let (q, t) = (DQuat::from_mat3(&c.rotation), c.translation);
    [q.w, q.x, q.y, q.z, t.x, t.y, t.z]
}

#[cfg(test)]
mod tests {
    use super::*;
    use gs_sfm::turn::{moved, turned_from};

    fn camera() -> Camera {
        Camera::look_at(DVec3::new(1.0, -2.0, 0.5), DVec3::ZERO, DVec3::Z, 64, 48, 1.0)
    }

    #[test]
    fn a_camera_is_what_it_was_and_moves_against_its_gradient() {
        let given = camera();
        let begun = moved(&given, DVec3::new(0.01, 0.0, 0.0), DVec3::ZERO, 0.02);
        let mut poses = Poses::new(std::slice::from_ref(&begun), std::slice::from_ref(&given), &[0]);
        let close = |a: &Camera, b: &Camera| {
            (a.rotation - b.rotation).abs().to_cols_array().iter().all(|v| *v < 1e-12)
                && a.translation.distance(b.translation) < 1e-12
                && (a.fx - b.fx).abs() < 1e-9
        };
        assert!(close(&poses.camera(0, 0, &given), &begun));
        let before = poses.clone();
        let rates = PoseRates { warm_up: 0.0, ..PoseRates::default() };
        poses.step(0, 0, &CameraGradient { zoom: f64::NAN, ..CameraGradient::default() }, &rates, 0.0, 2.0);
        assert_eq!(poses, before);
        let g = CameraGradient { turn: [0.0, 5.0, 0.0], shift: [0.0, 0.0, -3.0], zoom: 1.0, depth: 0.0 };
        poses.step(0, 0, &g, &rates, 0.0, 2.0);
        let expected = moved(
            &begun,
            DVec3::new(0.0, -rates.turn, 0.0),
            DVec3::new(0.0, 0.0, 2.0 * rates.turn),
            -rates.turn * rates.zoom,
        );
        assert!(close(&poses.camera(0, 0, &given), &expected));
    }

    #[test]
    fn a_turn_leaves_what_is_in_the_middle_in_place() {
        let given = camera();
        let middle = given.rotation.transpose() * (DVec3::new(0.0, 0.0, 1.5) - given.translation);
        let mut poses = Poses::new(std::slice::from_ref(&given), std::slice::from_ref(&given), &[0]);
        let g = CameraGradient { turn: [0.0, 5.0, 0.0], depth: 1.5, ..CameraGradient::default() };
        poses.step(0, 0, &g, &PoseRates { warm_up: 0.0, ..PoseRates::default() }, 0.0, 2.0);
        let after = poses.camera(0, 0, &given);
        assert!(after.to_camera(middle).distance(DVec3::new(0.0, 0.0, 1.5)) < 1e-12);
        assert!(turned_from(&given.rotation, &after.rotation).y < -1e-3);
    }

    #[test]
    fn rates_warm_up_and_fall() {
        let rates = PoseRates::default();
        assert!(rates.at(0.0) == 0.0 && rates.at(0.04) < rates.at(0.05) && rates.at(0.5) < rates.at(0.1));
        assert!((rates.at(1.0) / rates.turn_end - 1.0).abs() < 1e-9);
    }
}
