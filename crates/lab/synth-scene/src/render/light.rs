//! Light that reaches the surfaces, computed once and looked up by every view.
//!
//! Surfaces are diffuse but for a weak highlight, so the light on them does not depend on the view. It is stored in a
//! grid over each primitive's chart: direct light of two rectangular lamps with soft shadows, light of the sky above
//! the open room, and one bounce.

use crate::scene::Scene;
use crate::things::shape::ChartPoint;
use glam::{DMat3, DVec3};
use rayon::prelude::*;
use std::f64::consts::{PI, TAU};

/// A rectangular lamp that shines downwards.
#[derive(Debug, Clone, Copy)]
struct Lamp {
    centre: DVec3,
    half: f64,
    radiance: DVec3,
}

/// Light at a point of a surface.
#[derive(Debug, Clone, Copy, Default)]
pub struct Light {
    /// Irradiance over pi: what a white surface sends out.
    pub diffuse: DVec3,
    /// Share of the first lamp that is seen, 0 to 1, for highlights.
    pub key: f64,
}

/// The stored light of a scene.
pub struct LightMap {
    lamps: [Lamp; 2],
    /// First grid of each primitive; one grid per face.
    first: Vec<usize>,
    grids: Vec<Grid>,
    texels: Vec<[f32; 4]>,
}

/// The texels of one face: `nu` x `nv`, u fastest, starting at `start`.
#[derive(Debug, Clone, Copy)]
struct Grid {
    primitive: usize,
    face: usize,
    nu: usize,
    nv: usize,
    start: usize,
    wraps: bool,
}

/// Shadow rays per lamp: `LAMP_GRID` squared.
const LAMP_GRID: usize = 5;
/// Rays over the hemisphere.
const SKY_RAYS: usize = 64;
/// Texels of one parallel piece of work: fixed, so that threads do not matter.
const CHUNK: usize = 256;
/// Largest number of texels along an axis of a face.
const MOST: usize = 256;
/// How far a ray starts from its surface, in metres.
const LIFT: f64 = 2e-5;

fn sky(direction: DVec3) -> DVec3 {
    DVec3::new(0.52, 0.57, 0.64) * (0.6 + 0.4 * direction.z.max(0.0))
}

impl LightMap {
    /// Computes the light of a scene. `coarseness` of at least 1 multiplies the sides of texels: small pictures need
    /// no fine shadows.
    pub fn bake(scene: &Scene, coarseness: f64) -> Self {
        // Larger rooms have larger lamps, a little less than in proportion: they also have more walls near them.
        let area = scene.room.x * scene.room.y / (2.45 * 2.45);
        let lamp = |x: f64, y: f64, size: f64, power: [f64; 3]| {
            let half = size * area.sqrt();
            let radiance = DVec3::from_array(power) * area.powf(0.6) / (4.0 * half * half);
            Lamp { centre: DVec3::new(x * scene.room.x, y * scene.room.y, 2.65), half, radiance }
        };
        let lamps = [lamp(0.42, -0.34, 0.30, [14.5, 13.4, 11.8]), lamp(-0.50, 0.45, 0.45, [3.4, 3.6, 4.0])];
        let (first, grids, count) = lay_out(scene, coarseness);
        let mut map = Self { lamps, first, grids, texels: Vec::new() };
        map.texels = map.for_each_texel(count, |grid, k, index| map.direct(scene, grid, k, index));
        map.tidy(&vec![true; count]);
        let indirect = map.for_each_texel(count, |grid, k, index| map.indirect(scene, grid, k, index));
        for (texel, extra) in map.texels.iter_mut().zip(&indirect) {
            for c in 0..3 {
                texel[c] += extra[c];
            }
        }
        map.tidy(&indirect.iter().map(|t| t[3] >= 0.5).collect::<Vec<_>>());
        map
    }

    /// How many texels [`Self::bake`] computes.
    pub fn size(scene: &Scene, coarseness: f64) -> usize {
        lay_out(scene, coarseness).2
    }

    /// The light at `local`, a point on the surface of a primitive, interpolated.
    pub fn at(&self, scene: &Scene, primitive: usize, local: DVec3) -> Light {
        let at = scene.primitives[primitive].shape.chart(local);
        let g = &self.grids[self.first[primitive] + at.face];
        let (x, y) = (at.u * g.nu as f64 - 0.5, at.v * g.nv as f64 - 0.5);
        let (x0, y0) = (x.floor(), y.floor());
        let (fx, fy) = (x - x0, y - y0);
        let mut sum = [0.0f64; 4];
        for (dx, wx) in [(0, 1.0 - fx), (1, fx)] {
            for (dy, wy) in [(0, 1.0 - fy), (1, fy)] {
                let t = self.texels[g.start + g.local(x0 as i64 + dx, y0 as i64 + dy)];
                for c in 0..4 {
                    sum[c] += wx * wy * f64::from(t[c]);
                }
            }
        }
        Light { diffuse: DVec3::new(sum[0], sum[1], sum[2]), key: sum[3] }
    }

    /// Centre of the lamp that makes highlights.
    pub fn key_lamp(&self) -> DVec3 {
        self.lamps[0].centre
    }

    /// Runs `f(grid, texel of the grid, texel of all)` over all texels in parallel; results in order.
    fn for_each_texel(&self, count: usize, f: impl Fn(&Grid, usize, usize) -> [f32; 4] + Sync) -> Vec<[f32; 4]> {
        let mut out = vec![[0f32; 4]; count];
        out.par_chunks_mut(CHUNK).enumerate().for_each(|(chunk, texels)| {
            let mut g = self.grids.partition_point(|g| g.start <= chunk * CHUNK) - 1;
            for (k, texel) in texels.iter_mut().enumerate() {
                let index = chunk * CHUNK + k;
                while self.grids.get(g + 1).is_some_and(|next| next.start <= index) {
                    g += 1;
                }
                *texel = f(&self.grids[g], index - self.grids[g].start, index);
            }
        });
        out
    }

    fn direct(&self, scene: &Scene, grid: &Grid, k: usize, index: usize) -> [f32; 4] {
        let (point, normal) = grid.place(scene, k);
        if outside(scene, point) {
            return [0.0; 4];
        }
        let mut sum = DVec3::ZERO;
        let mut key = 0.0;
        for (l, lamp) in self.lamps.iter().enumerate() {
            let [jx, jy] = jitter(index * 2 + l);
            let mut seen = 0.0;
            for i in 0..LAMP_GRID * LAMP_GRID {
                let (a, b) = ((i % LAMP_GRID) as f64 + jx, (i / LAMP_GRID) as f64 + jy);
                let across = |k: f64| (2.0 * k / LAMP_GRID as f64 - 1.0) * lamp.half;
                let offset = DVec3::new(across(a), across(b), 0.0);
                let to = lamp.centre + offset - point;
                let distance = to.length();
                let direction = to / distance;
                let (cos, cos_lamp) = (direction.dot(normal), direction.z);
                if cos <= 0.0 || cos_lamp <= 0.0 || scene.blocked(point, direction, LIFT, distance) {
                    continue;
                }
                seen += 1.0;
                let area = 4.0 * lamp.half * lamp.half / (LAMP_GRID * LAMP_GRID) as f64;
                sum += lamp.radiance * (area * cos * cos_lamp / (distance * distance * PI));
            }
            if l == 0 {
                key = seen / (LAMP_GRID * LAMP_GRID) as f64;
            }
        }
        [sum.x as f32, sum.y as f32, sum.z as f32, key as f32]
    }

    /// Sky and first bounce; the fourth number is 1 in the open and 0 inside a solid, where most rays meet surfaces
    /// from behind.
    fn indirect(&self, scene: &Scene, grid: &Grid, k: usize, index: usize) -> [f32; 4] {
        let (point, normal) = grid.place(scene, k);
        if outside(scene, point) {
            return [0.0; 4];
        }
        let (x, y) = normal.any_orthonormal_pair();
        let frame = DMat3::from_cols(x, y, normal);
        let [jx, jy] = jitter(index);
        let mut sum = DVec3::ZERO;
        let mut behind = 0;
        for i in 0..SKY_RAYS {
            // A rank-1 lattice, shifted at random per texel; directions weighted by the cosine.
            let a = ((i as f64 + 0.5) / SKY_RAYS as f64 + jx).fract();
            let b = (i as f64 * 0.618_033_988_749_894_9 + jy).fract();
            let (r, angle) = (a.sqrt(), b * TAU);
            let direction = frame * DVec3::new(r * angle.cos(), r * angle.sin(), (1.0 - a).max(0.0).sqrt());
            match scene.trace(point, direction, LIFT) {
                None => sum += sky(direction),
                Some(hit) => {
                    let p = &scene.primitives[hit.primitive];
                    if (p.rotation * p.shape.normal(hit.local)).dot(direction) > 0.0 {
                        behind += 1;
                        if 2 * behind > SKY_RAYS {
                            return [0.0; 4];
                        }
                        continue;
                    }
                    let at = p.shape.chart(hit.local);
                    let g = &self.grids[self.first[hit.primitive] + at.face];
                    let texel = g.local((at.u * g.nu as f64) as i64, (at.v * g.nv as f64) as i64);
                    let t = self.texels[g.start + texel];
                    let light = DVec3::new(f64::from(t[0]), f64::from(t[1]), f64::from(t[2]));
                    // What has bounced more often is taken as even.
                    sum += p.material.albedo * (light + 0.16 + p.material.glow);
                }
            }
        }
        sum /= SKY_RAYS as f64;
        [sum.x as f32, sum.y as f32, sum.z as f32, 1.0]
    }

    /// Gives texels that are not `open` their neighbours' light, then smooths what sampling left rough.
    fn tidy(&mut self, open: &[bool]) {
        for g in &self.grids {
            let range = g.start..g.start + g.nu * g.nv;
            let mut known = open[range.clone()].to_vec();
            if known.iter().any(|&k| k) {
                for _ in 0..3 {
                    let before = self.texels[range.clone()].to_vec();
                    let known_before = known.clone();
                    for k in (0..known.len()).filter(|&k| !known_before[k]) {
                        let near: Vec<usize> = g.around(k).filter(|&n| known_before[n]).collect();
                        if !near.is_empty() {
                            let mean = |c: usize| near.iter().map(|&n| before[n][c]).sum::<f32>() / near.len() as f32;
                            self.texels[g.start + k] = [0, 1, 2, 3].map(mean);
                            known[k] = true;
                        }
                    }
                }
            }
            let before = self.texels[range].to_vec();
            for k in (0..before.len()).filter(|&k| known[k]) {
                let mut sum = before[k].map(|v| 2.0 * v);
                let mut weight = 2.0;
                for n in g.around(k).filter(|&n| known[n]) {
                    for c in 0..4 {
                        sum[c] += before[n][c];
                    }
                    weight += 1.0;
                }
                self.texels[g.start + k] = sum.map(|v| v / weight);
            }
        }
    }
}

impl Grid {
    fn local(&self, x: i64, y: i64) -> usize {
        let (nu, nv) = (self.nu as i64, self.nv as i64);
        let x = if self.wraps { x.rem_euclid(nu) } else { x.clamp(0, nu - 1) };
        (y.clamp(0, nv - 1) * nu + x) as usize
    }

    /// The four neighbours of texel `k`; at an edge the texel itself stands in.
    fn around(&self, k: usize) -> impl Iterator<Item = usize> {
        let (x, y) = ((k % self.nu) as i64, (k / self.nu) as i64);
        let grid = *self;
        [(-1, 0), (1, 0), (0, -1), (0, 1)].into_iter().map(move |(dx, dy)| grid.local(x + dx, y + dy))
    }

    /// The middle of texel `k` in the world, lifted off the surface, and the normal there.
    fn place(&self, scene: &Scene, k: usize) -> (DVec3, DVec3) {
        let p = &scene.primitives[self.primitive];
        let u = ((k % self.nu) as f64 + 0.5) / self.nu as f64;
        let v = ((k / self.nu) as f64 + 0.5) / self.nv as f64;
        let (point, normal) = p.shape.surface(ChartPoint { face: self.face, u, v });
        let normal = p.rotation * normal;
        (p.to_world(point) + normal * LIFT, normal)
    }
}

/// The first grid of each primitive, the grids of all faces, and the number of their texels.
fn lay_out(scene: &Scene, coarseness: f64) -> (Vec<usize>, Vec<Grid>, usize) {
    let (mut first, mut grids, mut count) = (Vec::new(), Vec::new(), 0);
    for (primitive, p) in scene.primitives.iter().enumerate() {
        first.push(grids.len());
        let size = texel_size(scene, p.thing) * coarseness;
        for face in 0..p.shape.faces() {
            let (du, dv) = p.shape.face_size(face);
            let wraps = p.shape.faces() == 1;
            let nu = ((du / size).ceil() as usize).clamp(if wraps { 8 } else { 2 }, MOST);
            let nv = ((dv / size).ceil() as usize).clamp(2, MOST);
            grids.push(Grid { primitive, face, nu, nv, start: count, wraps });
            count += nu * nv;
        }
    }
    (first, grids, count)
}

/// Side of a texel in metres.
fn texel_size(scene: &Scene, thing: u32) -> f64 {
    let t = &scene.things[thing as usize];
    match t.class {
        "floor" => 0.035,
        "wall" => 0.07,
        "table" => 0.011,
        "chair" | "armchair" | "cabinet" | "stool" | "waste bin" => 0.018,
        _ => 0.008,
    }
}

/// Whether a point lies behind the walls or under the floor, where no camera goes.
fn outside(scene: &Scene, point: DVec3) -> bool {
    point.z < -1e-3 || (point.truncate().abs() - scene.room).max_element() > 1e-3
}

/// Two numbers of 0..1 that belong to `index`.
fn jitter(index: usize) -> [f64; 2] {
    let mut h = (index as u64).wrapping_add(0x9E37_79B9_7F4A_7C15).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    h = (h ^ (h >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    h ^= h >> 31;
    [(h >> 32) as f64 / 4_294_967_296.0, (h & 0xFFFF_FFFF) as f64 / 4_294_967_296.0]
}
