//! Which share of an object's box no view saw.

use glam::DVec3;
use gs_raster::{RasterOptions, TILE, tile_weights};
use gs_scene::{Camera, Gaussians};
use objects::ObjectBox;

/// Points along each side of a box.
const GRID: u32 = 8;
/// Pixels of the longer side of what is rendered of a view.
const PIXELS: f64 = 256.0;
/// Accumulated opacity that hides what is behind.
const HIDES: f32 = 0.5;

/// The share of each box's surface, 0 to 1, that no camera saw. A camera sees a point of its image that is no deeper than where the
/// opacity of all Gaussians adds up to one half. An eighth of the box's shortest side more, or two pixels, is let pass.
pub fn unseen(g: &Gaussians, options: &RasterOptions, cameras: &[Camera], boxes: &[ObjectBox]) -> Vec<f32> {
    let mut hidden: Vec<Vec<Point>> = boxes.iter().map(points).collect();
    let area = |points: &[Point]| points.iter().fold(0.0, |sum, p| sum + p.area);
    let all: Vec<f64> = hidden.iter().map(|points| area(points)).collect();
    for camera in cameras {
        let by = PIXELS / f64::from(camera.width.max(camera.height));
        let side = |pixels: u32| (f64::from(pixels) * by).round().max(1.0) as u32;
        let small = camera.resized(side(camera.width), side(camera.height));
        let depth = depths(g, &small, options);
        for (points, b) in hidden.iter_mut().zip(boxes) {
            let cell = f64::from(2.0 * b.half_size.into_iter().fold(f32::INFINITY, f32::min)) / f64::from(GRID);
            let sees = |p: &Point| {
                small.sees(p.at).is_some_and(|(u, v, z)| {
                    let depth = depth[v as usize * small.width as usize + u as usize];
                    z <= depth + cell.max(2.0 * z / small.fx)
                })
            };
            points.retain(|p| !sees(p));
        }
    }
    hidden.iter().zip(all).map(|(points, all)| (area(points) / all) as f32).collect()
}

/// A point of a box's surface, and how much of the surface it stands for.
struct Point {
    at: DVec3,
    area: f64,
}

/// The middles of 8 x 8 cells on each side.
fn points(b: &ObjectBox) -> Vec<Point> {
    let [center, x, y, z] = [b.center, b.axes[0], b.axes[1], b.axes[2]].map(|v| DVec3::from(v.map(f64::from)));
    let half = b.half_size.map(f64::from);
    let sides = [x * half[0], y * half[1], z * half[2]];
    let along = |k: u32| f64::from(2 * k + 1) / f64::from(GRID) - 1.0;
    let mut all = Vec::new();
    for (c, sign) in [0, 1, 2].into_iter().flat_map(|c| [(c, -1.0), (c, 1.0)]) {
        let (a, b) = ((c + 1) % 3, (c + 2) % 3);
        for i in 0..GRID * GRID {
            let at = center + sides[c] * sign + sides[a] * along(i % GRID) + sides[b] * along(i / GRID);
            // A box without extent has points, too.
            all.push(Point { at, area: half[a] * half[b] + f64::MIN_POSITIVE });
        }
    }
    all
}

/// The depth (camera z) of each pixel where opacity adds up to one half; infinity where it does not.
fn depths(g: &Gaussians, camera: &Camera, options: &RasterOptions) -> Vec<f64> {
    let tiles = tile_weights(g, camera, options, true, |t| {
        let (mut sum, mut depth) = ([0.0; TILE * TILE], [f64::INFINITY; TILE * TILE]);
        for (&i, weights) in t.gaussians.iter().zip(t.weights.chunks_exact(TILE * TILE)) {
            let z = camera.to_camera(DVec3::from(g.means[i as usize].map(f64::from))).z;
            for ((sum, depth), weight) in sum.iter_mut().zip(&mut depth).zip(weights) {
                *sum += weight;
                if *sum >= HIDES && z < *depth {
                    *depth = z;
                }
            }
        }
        (t.x0, t.y0, t.width, t.height, depth)
    });
    let width = camera.width as usize;
    let mut all = vec![f64::INFINITY; width * camera.height as usize];
    for (x0, y0, w, h, depth) in tiles {
        for y in 0..h {
            all[(y0 + y) * width + x0..][..w].copy_from_slice(&depth[y * TILE..][..w]);
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Opaque Gaussians all over the sides of a cube from -1 to 1.
    fn cube() -> Gaussians {
        let mut means = Vec::new();
        for (c, side) in [0, 1, 2].into_iter().flat_map(|c| [(c, -1.0), (c, 1.0)]) {
            for i in 0..41 * 41 {
                let mut at = [side; 3];
                (at[(c + 1) % 3], at[(c + 2) % 3]) = ((i % 41) as f32 / 20.0 - 1.0, (i / 41) as f32 / 20.0 - 1.0);
                means.push(at);
            }
        }
        let n = means.len();
        Gaussians {
            log_scales: vec![[-3.5; 3]; n],
            rotations: vec![[1.0, 0.0, 0.0, 0.0]; n],
            opacity_logits: vec![6.0; n],
            sh: vec![0.0; 3 * n],
            means,
            ..Gaussians::default()
        }
    }

    #[test]
    fn a_cube_is_seen_from_where_cameras_are() {
        let g = cube();
        let from = |eye: [f64; 3]| {
            let up = if eye[2] == 0.0 { DVec3::Z } else { DVec3::X };
            Camera::look_at(eye.into(), DVec3::ZERO, up, 640, 480, 0.8)
        };
        let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let upright = ObjectBox { center: [0.0; 3], half_size: [1.0; 3], axes, upright: true };
        let share = |cameras: &[Camera]| unseen(&g, &RasterOptions::fit(&g), cameras, &[upright])[0];
        let sides =
            [[6.0, 0.0, 0.0], [-6.0, 0.0, 0.0], [0.0, 6.0, 0.0], [0.0, -6.0, 0.0], [0.0, 0.0, 6.0], [0.0, 0.0, -6.0]];
        let all = sides.map(from);
        assert_eq!(share(&[]), 1.0);
        // One side of six, and of the four beside it the first of eight rows, which a cell reaches.
        assert!((share(&all[..1]) - (1.0 - 1.5 / 6.0)).abs() < 1e-6, "{}", share(&all[..1]));
        assert_eq!(share(&all), 0.0);
        // Seen by nobody behind a wall, and not where it looks away.
        assert_eq!(share(&[Camera::look_at(DVec3::X * 6.0, DVec3::X * 9.0, DVec3::Z, 640, 480, 0.8)]), 1.0);
    }
}
