//! Points on the surfaces that the cameras see: the truth that instances are scored against, and the sparse cloud that
//! structure from motion would have found.

use crate::random::normal;
use crate::render::{Frame, ray};
use crate::scene::Scene;
use artifacts::TruePoints;
use glam::DVec3;
use gs_scene::{Camera, PointCloud};
use rand_chacha::ChaCha8Rng;
use std::collections::HashSet;

/// Cells of which one point each is kept, in metres: on objects, tables, floor and walls.
const CELLS: [f64; 3] = [0.006, 0.012, 0.03];
/// Share of the sparse cloud that lies on objects.
const OBJECT_SHARE: f64 = 0.5;

/// Collects surface points view by view: the first seen in each cell of each part.
#[derive(Default)]
pub struct Collector {
    seen: HashSet<(u32, [i32; 3])>,
    positions: Vec<DVec3>,
    parts: Vec<u32>,
    /// Of the points of [`Self::truth`], in its order.
    pub colors: Vec<[u8; 3]>,
}

impl Collector {
    /// Adds what a view shows. Call in the order of the views.
    pub fn add(&mut self, scene: &Scene, camera: &Camera, frame: &Frame) {
        let eye = camera.position();
        for y in 0..frame.height {
            for x in 0..frame.width {
                let at = y * frame.width + x;
                if frame.part[at] < 0 {
                    continue;
                }
                let part = frame.part[at] as u32;
                let p = eye + ray(camera, x as f64 + 0.5, y as f64 + 0.5) * frame.distance[at];
                let cell = (p / CELLS[ground(scene, part)]).floor().to_array().map(|v| v as i32);
                if self.seen.insert((part, cell)) {
                    self.positions.push(p);
                    self.parts.push(part);
                    self.colors.push([0, 1, 2].map(|c| frame.rgb[3 * at + c]));
                }
            }
        }
    }

    /// The truth of all points. Class ids are positions in [`Scene::classes`].
    pub fn truth(&self, scene: &Scene) -> TruePoints {
        let classes = scene.classes();
        let thing = |&p: &u32| scene.parts[p as usize].thing as usize;
        let class = |t: usize| classes.iter().position(|&c| c == scene.things[t].class).map_or(-1, |c| c as i32);
        TruePoints {
            position: self.positions.iter().map(|p| p.as_vec3().to_array()).collect(),
            instance: self.parts.iter().map(|p| thing(p) as i32).collect(),
            part: self.parts.iter().map(|&p| p as i32).collect(),
            class: self.parts.iter().map(|p| class(thing(p))).collect(),
        }
    }

    /// At most `count` of the points of [`Self::truth`] with their colours, evenly chosen, in its order: the vertices of a
    /// scan.
    pub fn vertices(&self, scene: &Scene, count: usize, rng: &mut ChaCha8Rng) -> (TruePoints, Vec<[u8; 3]>) {
        let mut picked = rand::seq::index::sample(rng, self.parts.len(), count.min(self.parts.len())).into_vec();
        picked.sort_unstable();
        let chosen = Self {
            seen: HashSet::new(),
            positions: picked.iter().map(|&i| self.positions[i]).collect(),
            parts: picked.iter().map(|&i| self.parts[i]).collect(),
            colors: picked.iter().map(|&i| self.colors[i]).collect(),
        };
        (chosen.truth(scene), chosen.colors)
    }

    /// At most `count` of the points, half of them on objects, with noise of standard deviation `noise` metres.
    pub fn sparse(&self, scene: &Scene, count: usize, noise: f64, rng: &mut ChaCha8Rng) -> PointCloud {
        let (objects, background): (Vec<usize>, Vec<usize>) =
            (0..self.parts.len()).partition(|&i| ground(scene, self.parts[i]) == 0);
        let on_objects = objects.len().min((count as f64 * OBJECT_SHARE) as usize);
        let on_background = background.len().min(count - on_objects);
        let on_objects = objects.len().min(count - on_background);
        let mut cloud = PointCloud::default();
        for (from, count) in [(&objects, on_objects), (&background, on_background)] {
            let mut picked = rand::seq::index::sample(rng, from.len(), count).into_vec();
            picked.sort_unstable();
            for k in picked {
                let i = from[k];
                let p = self.positions[i] + DVec3::new(normal(rng), normal(rng), normal(rng)) * noise;
                cloud.positions.push(p.as_vec3().to_array());
                cloud.colors.push(self.colors[i]);
            }
        }
        cloud
    }
}

/// 0 for objects, 1 for tables, 2 for floor and walls.
fn ground(scene: &Scene, part: u32) -> usize {
    let thing = &scene.things[scene.parts[part as usize].thing as usize];
    match (thing.background, thing.class) {
        (false, _) => 0,
        (true, "table") => 1,
        (true, _) => 2,
    }
}
