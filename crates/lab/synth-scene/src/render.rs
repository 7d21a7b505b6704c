//! Photographs by ray tracing, with what each pixel shows.

pub mod bvh;
pub mod light;

use crate::render::light::LightMap;
use crate::scene::{Hit, Scene};
use crate::things::material::marks;
use glam::DVec3;
use gs_scene::Camera;
use rayon::prelude::*;

/// What a camera sees.
pub struct Frame {
    pub width: usize,
    pub height: usize,
    /// The photograph, sRGB, `[height][width][3]`.
    pub rgb: Vec<u8>,
    /// Thing at each pixel's centre, -1 for none, `[height][width]`.
    pub thing: Vec<i32>,
    /// Part at each pixel's centre, -1 for none, `[height][width]`.
    pub part: Vec<i32>,
    /// Distance of the surface at each pixel's centre along the ray, infinite for none, `[height][width]`.
    pub distance: Vec<f64>,
}

/// The four samples around a pixel's centre: a rotated grid, so that near-horizontal and near-vertical edges are
/// smooth.
const SAMPLES: [[f64; 2]; 4] = [[0.375, 0.125], [0.875, 0.375], [0.625, 0.875], [0.125, 0.625]];
/// Brightness of the print.
const EXPOSURE: f64 = 1.12;
/// Sharpness of highlights.
const GLOSS: f64 = 60.0;
/// A mirror does not see what is nearer than this, in metres: itself.
const MIRROR_NEAR: f64 = 1e-4;

/// What each pixel shows, without a photograph: [`Frame::rgb`] is empty, everything else as [`render`] gives it.
pub fn identify(scene: &Scene, camera: &Camera) -> Frame {
    let (w, h) = (camera.width as usize, camera.height as usize);
    let eye = camera.position();
    let pixel = |at: usize| {
        let direction = ray(camera, (at % w) as f64 + 0.5, (at / w) as f64 + 0.5);
        scene.trace(eye, direction, 0.0).map_or((-1, -1, f64::INFINITY), |hit| {
            let p = &scene.primitives[hit.primitive];
            (p.thing as i32, p.part as i32, hit.t)
        })
    };
    let pixels: Vec<(i32, i32, f64)> = (0..w * h).into_par_iter().with_min_len(w).map(pixel).collect();
    Frame {
        width: w,
        height: h,
        rgb: Vec::new(),
        thing: pixels.iter().map(|p| p.0).collect(),
        part: pixels.iter().map(|p| p.1).collect(),
        distance: pixels.iter().map(|p| p.2).collect(),
    }
}

/// Renders the scene; the same bytes for any number of threads.
pub fn render(scene: &Scene, light: &LightMap, camera: &Camera) -> Frame {
    let eye = camera.position();
    let pixel = |at: usize| {
        let (x, y) = (at % camera.width as usize, at / camera.width as usize);
        let mut sum = DVec3::ZERO;
        for [sx, sy] in SAMPLES {
            let direction = ray(camera, x as f64 + sx, y as f64 + sy);
            if let Some(hit) = scene.trace(eye, direction, 0.0) {
                // Each sample is clipped by itself, or bright ones would eat the edges around them.
                sum += (EXPOSURE * shade_with_mirror(scene, light, direction, &hit)).min(DVec3::ONE);
            }
        }
        (sum / SAMPLES.len() as f64).to_array().map(to_srgb8)
    };
    let mut frame = identify(scene, camera);
    let row = frame.width;
    frame.rgb = vec![0; 3 * frame.thing.len()];
    frame
        .rgb
        .as_chunks_mut::<3>()
        .0
        .par_iter_mut()
        .with_min_len(row)
        .enumerate()
        .for_each(|(at, rgb)| *rgb = pixel(at));
    frame
}

/// Unit direction of the ray through (x, y) in pixels from the image's corner.
pub fn ray(camera: &Camera, x: f64, y: f64) -> DVec3 {
    let d = DVec3::new((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0);
    (camera.rotation.transpose() * d).normalize_or_zero()
}

/// Radiance towards the eye, linear.
fn shade(scene: &Scene, light: &LightMap, direction: DVec3, hit: &Hit) -> DVec3 {
    let p = &scene.primitives[hit.primitive];
    let m = &p.material;
    let here = light.at(scene, hit.primitive, hit.local);
    let mut color = m.color(hit.local);
    if scene.detail > 0.0 {
        // Each surface has its own.
        color *= (1.0 + scene.detail * marks(hit.local + 3.7 * hit.primitive as f64)).max(0.0);
    }
    let mut out = color * (here.diffuse + m.glow);
    if m.specular > 0.0 && here.key > 0.0 {
        let normal = p.rotation * p.shape.normal(hit.local);
        let to_lamp = (light.key_lamp() - p.to_world(hit.local)).normalize_or_zero();
        let half = (to_lamp - direction).normalize_or_zero();
        out += DVec3::splat(m.specular * here.key * normal.dot(half).max(0.0).powf(GLOSS) * 3.0);
    }
    out
}

/// Radiance towards the eye with one mirror image.
fn shade_with_mirror(scene: &Scene, light: &LightMap, direction: DVec3, hit: &Hit) -> DVec3 {
    let own = shade(scene, light, direction, hit);
    let p = &scene.primitives[hit.primitive];
    if p.material.mirror == 0.0 {
        return own;
    }
    let normal = p.rotation * p.shape.normal(hit.local);
    let reflected = direction - normal * (2.0 * direction.dot(normal));
    let Some(seen) = scene.trace(p.to_world(hit.local), reflected, MIRROR_NEAR) else { return own };
    // Schlick's approximation with its fifth power tamed, as for lacquer that is not quite smooth.
    let share =
        p.material.mirror + (1.0 - p.material.mirror) * 0.5 * (1.0 + direction.dot(normal)).clamp(0.0, 1.0).powi(4);
    own.lerp(shade(scene, light, reflected, &seen), share)
}

fn to_srgb8(linear: f64) -> u8 {
    let c = linear.clamp(0.0, 1.0);
    let s = if c <= 0.003_130_8 { 12.92 * c } else { 1.055 * c.powf(1.0 / 2.4) - 0.055 };
    (255.0 * s + 0.5) as u8
}
