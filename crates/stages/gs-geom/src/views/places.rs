//! Where cameras may stand, and what they look at.

use super::grid::{OUTSIDE, directions};
use super::matter::Matter;
use super::options::Look;
use glam::DVec3;
use gs_scene::Camera;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
use std::f64::consts::TAU;
use std::ops::Range;

/// Free cubes on every side of a camera in a room, and around an object.
const CLEARANCE: i32 = 2;
/// Least share of the directions that end in matter, of a place in a room.
const INDOORS: f64 = 0.5;
/// Most places in a room that are tried, and of those, far from each other, that cameras get.
const TRIED: usize = 2000;
const STANDS: usize = 48;
/// Ways that a camera turns at a stand in a room: even steps around, each with a pitch in turn, radians, down is negative.
const TURNS: usize = 6;
const PITCHES: [f64; 4] = [-0.1, -0.45, 0.15, -0.8];
/// Directions from which an object is seen; distances, in the one from which all of it fits the picture.
const SIDES: usize = 120;
const DISTANCES: [f64; 3] = [1.0, 0.7, 0.4];
/// Sine of the steepest view up or down: at 75 degrees.
const STEEPEST: f64 = 0.966;
/// Sine of the lowest elevation of a camera around a thing on the ground: 8 degrees.
const ABOVE_GROUND: f64 = 0.14;
/// How near a camera comes to its target, of the farthest that is near enough.
const NEARNESS: Range<f64> = 0.35..0.95;
/// Attempts to find a place for a target.
const ATTEMPTS: usize = 16;

/// What cameras have in common.
#[derive(Debug, Clone, Copy)]
pub struct Lens {
    /// Width and height in pixels.
    pub size: (u32, u32),
    /// Horizontal field of view, radians.
    pub fov: f64,
}

/// Where cameras may stand.
pub struct Places<'a> {
    matter: &'a Matter,
    lens: Lens,
    up: DVec3,
    /// Free places in the room; none for an object.
    indoors: Vec<DVec3>,
    look: Look,
    /// Which free space each cube is in, and those in which the farthest cameras around an object stand: no nearer one gets
    /// into the object.
    space: Vec<i32>,
    entered: Vec<i32>,
    /// Whether the scene stands on a ground, which no camera looks at from below.
    pub ground: bool,
}

impl<'a> Places<'a> {
    /// The places of a scene; none where nothing in a room is free.
    pub fn new(
        matter: &'a Matter,
        centres: &[DVec3],
        up: DVec3,
        look: Look,
        lens: Lens,
        rng: &mut ChaCha8Rng,
    ) -> Option<Self> {
        let indoors = if look == Look::InsideOut { indoors(matter, rng) } else { Vec::new() };
        if look == Look::InsideOut && indoors.is_empty() {
            return None;
        }
        let ground = look == Look::OutsideIn && stands_on_ground(centres, up);
        Some(Self { matter, lens, up, indoors, look, space: matter.grid.spaces(), entered: Vec::new(), ground })
    }

    /// The distance from which the core fits the picture.
    pub fn fitting(&self) -> f64 {
        let (w, h) = (f64::from(self.lens.size.0), f64::from(self.lens.size.1));
        let half = (0.5 * self.lens.fov).tan();
        let least = (half * (h / w).min(1.0)).atan();
        self.matter.radius / least.sin()
    }

    /// Cameras all over: at stands far from each other and turned all around in a room, on spheres around an object.
    pub fn all_over(&mut self, rng: &mut ChaCha8Rng) -> Vec<Camera> {
        let (a, b) = across(self.up);
        let mut cameras = Vec::new();
        if self.look == Look::InsideOut {
            for (k, &eye) in far_apart(&self.indoors, STANDS).iter().enumerate() {
                let start = rng.random_range(0.0..TAU);
                for turn in 0..TURNS {
                    let (sin, cos) = (start + TAU * turn as f64 / TURNS as f64).sin_cos();
                    let pitch = PITCHES[(k + turn) % PITCHES.len()];
                    let forward = pitch.cos() * (cos * a + sin * b) + pitch.sin() * self.up;
                    cameras.extend(self.camera(eye, forward));
                }
            }
            return cameras;
        }
        let start = rng.random_range(0.0..TAU);
        let (sin, cos) = start.sin_cos();
        let sides: Vec<DVec3> = directions(SIDES)
            .map(|s| s.z * self.up + (cos * s.x - sin * s.y) * a + (sin * s.x + cos * s.y) * b)
            .collect();
        for distance in DISTANCES {
            for (k, &side) in sides.iter().enumerate() {
                // From near, another part each time.
                let off = if distance < 1.0 { 0.3 * self.matter.radius } else { 0.0 };
                let corner = DVec3::new(1.0, if k % 2 == 0 { 1.0 } else { -1.0 }, if k % 3 == 0 { 1.0 } else { -1.0 });
                let target = self.matter.middle + off * corner * if k % 4 < 2 { 1.0 } else { -1.0 };
                let eye = target + distance * self.fitting() * side;
                if self.may_stand(eye) {
                    cameras.extend(self.camera(eye, -side));
                }
            }
            if self.entered.is_empty() {
                self.entered = cameras.iter().map(|c| self.space_of(c.position())).collect();
                self.entered.sort_unstable();
                self.entered.dedup();
            }
        }
        cameras
    }

    /// At most `count` cameras that look at targets, each at one drawn at random, past nothing that hides it. With each target is how
    /// much the picture's shorter side may show at its distance, world units.
    pub fn aimed(&self, targets: &[(DVec3, f64)], count: usize, rng: &mut ChaCha8Rng) -> Vec<Camera> {
        if targets.is_empty() {
            return Vec::new();
        }
        (0..count).filter_map(|_| self.at(targets[rng.random_range(0..targets.len())], rng)).collect()
    }

    fn at(&self, (target, widest): (DVec3, f64), rng: &mut ChaCha8Rng) -> Option<Camera> {
        let side = self.matter.grid.side;
        let (w, h) = (f64::from(self.lens.size.0), f64::from(self.lens.size.1));
        let farthest = widest * w / (2.0 * w.min(h) * (0.5 * self.lens.fov).tan());
        let wanted = farthest * rng.random_range(NEARNESS);
        let mut best: Option<(f64, Camera)> = None;
        for _ in 0..ATTEMPTS {
            let eye = if self.look == Look::InsideOut {
                self.indoors[rng.random_range(0..self.indoors.len())]
            } else {
                target + wanted * direction(rng)
            };
            let way = target - eye;
            let away = way.length();
            if away < 4.0 * side || !self.may_stand(eye) {
                continue;
            }
            let free = self.matter.grid.distance(eye, way / away).is_none_or(|d| d > away - 3.0 * side);
            let off = (away / wanted).ln().abs();
            if free && best.as_ref().is_none_or(|b| off < b.0) {
                best = self.camera(eye, way / away).map(|c| (off, c)).or(best);
            }
        }
        best.map(|b| b.1)
    }

    /// Whether a camera may stand here: nothing is near; around an object, also that it is above the ground, that nothing is
    /// between it and the core, such as the wall of a room that the object stands in, and that it is not in the object.
    fn may_stand(&self, eye: DVec3) -> bool {
        if !self.matter.grid.is_clear(eye, CLEARANCE) {
            return false;
        }
        let from = eye - self.matter.middle;
        let away = from.length();
        let above = !self.ground || from.dot(self.up) >= ABOVE_GROUND * away;
        let open = || self.matter.grid.distance(eye, -from / away).is_none_or(|d| d >= away - self.matter.radius);
        let entered = || self.entered.is_empty() || self.entered.contains(&self.space_of(eye));
        self.look == Look::InsideOut || above && away > 0.0 && open() && entered()
    }

    /// The free space that a point is in.
    fn space_of(&self, point: DVec3) -> i32 {
        let cube = self.matter.grid.cube(point);
        if self.matter.grid.has(cube) { self.space[self.matter.grid.index(cube)] } else { OUTSIDE }
    }

    /// A camera that looks along `forward`, upright; none where that is too steep.
    fn camera(&self, eye: DVec3, forward: DVec3) -> Option<Camera> {
        let (w, h) = self.lens.size;
        let level = forward.dot(self.up).abs() <= STEEPEST;
        level.then(|| Camera::look_at(eye, eye + forward, self.up, w, h, self.lens.fov))
    }
}

/// Free places within a room: those from which most directions end in matter, in the part of the free space that holds most
/// of them.
fn indoors(matter: &Matter, rng: &mut ChaCha8Rng) -> Vec<DVec3> {
    let grid = &matter.grid;
    let middle = |c: usize| grid.middle(grid.cube_at(c));
    let free: Vec<bool> = (0..grid.depth.len())
        .into_par_iter()
        .map(|c| matter.contains(middle(c)) && grid.is_clear(middle(c), CLEARANCE))
        .collect();
    let (group, groups) = grid.groups(|c| free[c], false);
    let all: Vec<usize> = (0..free.len()).filter(|&c| free[c]).collect();
    if all.is_empty() {
        return Vec::new();
    }
    let tried: Vec<usize> = (0..TRIED).map(|_| all[rng.random_range(0..all.len())]).collect();
    let within: Vec<bool> = tried.par_iter().map(|&c| matter.enclosure(middle(c)) >= INDOORS).collect();
    let good: Vec<usize> = tried.into_iter().zip(within).filter(|t| t.1).map(|t| t.0).collect();
    let mut members = vec![0usize; groups];
    good.iter().for_each(|&c| members[group[c] as usize] += 1);
    let most = members.iter().copied().max().unwrap_or(0);
    let main = members.iter().position(|&m| m == most).unwrap_or(0) as i32;
    good.into_iter().filter(|&c| group[c] == main).map(middle).collect()
}

/// Whether what lies lowest is a ground: it reaches under most of the scene, and what stands on it covers less.
fn stands_on_ground(centres: &[DVec3], up: DVec3) -> bool {
    const CELLS: usize = 24;
    let mut heights: Vec<f64> = centres.iter().map(|c| c.dot(up)).collect();
    heights.sort_by(f64::total_cmp);
    let (low, high) = (heights[heights.len() / 100], heights[heights.len() - 1 - heights.len() / 100]);
    let (a, b) = across(up);
    let flat: Vec<(f64, f64)> = centres.iter().map(|c| (c.dot(a), c.dot(b))).collect();
    let range = |of: &dyn Fn(&(f64, f64)) -> f64| {
        let values = flat.iter().map(of);
        values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)))
    };
    let (ra, rb) = (range(&|f| f.0), range(&|f| f.1));
    let cell = |v: f64, (low, high): (f64, f64)| {
        (((v - low) / (high - low).max(f64::MIN_POSITIVE) * CELLS as f64) as usize).min(CELLS - 1)
    };
    let [mut any, mut lowest, mut upper] = [(); 3].map(|()| vec![false; CELLS * CELLS]);
    for (c, f) in centres.iter().zip(&flat) {
        let at = cell(f.0, ra) + CELLS * cell(f.1, rb);
        let height = (c.dot(up) - low) / (high - low).max(f64::MIN_POSITIVE);
        any[at] = true;
        lowest[at] |= height <= 0.12;
        upper[at] |= height >= 0.5;
    }
    let count = |of: &[bool]| of.iter().filter(|&&b| b).count() as f64;
    count(&lowest) >= 0.6 * count(&any) && count(&upper) <= 0.6 * count(&any)
}

/// At most `count` of the places, each as far from those before it as can be.
fn far_apart(places: &[DVec3], count: usize) -> Vec<DVec3> {
    let mut chosen: Vec<DVec3> = places.first().copied().into_iter().collect();
    let mut far: Vec<f64> = places.iter().map(|p| p.distance_squared(places[0])).collect();
    while chosen.len() < count.min(places.len()) {
        let (at, _) = far.iter().enumerate().fold((0, -1.0), |best, (i, &d)| if d > best.1 { (i, d) } else { best });
        chosen.push(places[at]);
        far.iter_mut().zip(places).for_each(|(d, p)| *d = d.min(p.distance_squared(places[at])));
    }
    chosen
}

/// Two unit directions across another, and each other.
fn across(up: DVec3) -> (DVec3, DVec3) {
    let a = up.any_orthonormal_vector();
    (a, up.cross(a))
}

/// A random direction, evenly over the sphere.
fn direction(rng: &mut ChaCha8Rng) -> DVec3 {
    let (z, turn): (f64, f64) = (rng.random_range(-1.0..1.0), rng.random_range(0.0..TAU));
    let r = (1.0 - z * z).sqrt();
    DVec3::new(r * turn.cos(), r * turn.sin(), z)
}
