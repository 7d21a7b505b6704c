//! Which Gaussians a pixel can show at all, so that a click need not project a million of them.

use crate::pack::CHUNK;
use glam::DVec3;
use gs_scene::{Camera, Gaussians};
use rayon::prelude::*;

/// Standard deviations at which the alpha of an opaque Gaussian falls below 1/255: sqrt(2 ln 255), rounded up.
const REACH: f64 = 3.34;
/// Standard deviation of the low-pass in pixels, rounded up.
const LOW_PASS: f64 = 0.55;
/// Of the image's size, by which the Jacobian's clamp lies outside of the image.
const MARGIN: f64 = 0.15;

/// Balls around the centres of neighbouring Gaussians.
pub struct Reach {
    balls: Vec<Ball>,
}

struct Ball {
    center: DVec3,
    radius: f64,
    /// Largest standard deviation of its Gaussians.
    scale: f64,
}

impl Reach {
    /// Of Gaussians in this order, which keeps neighbours together.
    pub fn new(g: &Gaussians, order: &[u32]) -> Self {
        Self { balls: order.par_chunks(CHUNK).map(|some| Ball::around(g, some)).collect() }
    }

    /// The Gaussians that may be seen at a pixel, ascending: all that are, and some more. `g` and `order` are those of
    /// [`Self::new`].
    pub fn candidates(&self, g: &Gaussians, order: &[u32], camera: &Camera, near: f64, pixel: [u32; 2]) -> Vec<u32> {
        let chunks = self.balls.par_iter().zip(order.par_chunks(CHUNK));
        let near_ones = chunks.filter(|(ball, _)| ball.may_show(camera, near, pixel));
        let alone = |i: &&u32| Ball::around(g, &[**i]).may_show(camera, near, pixel);
        let mut some: Vec<u32> = near_ones.flat_map_iter(|(_, some)| some.iter().filter(alone).copied()).collect();
        some.sort_unstable();
        some
    }
}

impl Ball {
    fn around(g: &Gaussians, some: &[u32]) -> Self {
        let at = |&i: &u32| DVec3::from(g.means[i as usize].map(f64::from));
        let center = some.iter().map(at).sum::<DVec3>() / some.len() as f64;
        let radius = some.iter().map(|i| at(i).distance(center)).fold(0.0, f64::max);
        let scales = some.iter().flat_map(|&i| g.log_scales[i as usize]);
        Self { center, radius, scale: f64::from(scales.fold(f32::NEG_INFINITY, f32::max)).exp() }
    }

    fn may_show(&self, camera: &Camera, near: f64, pixel: [u32; 2]) -> bool {
        let t = camera.to_camera(self.center);
        if t.z + self.radius < near {
            return false;
        }
        // What is drawn lies at least so far.
        let z = (t.z - self.radius).max(near);
        let axes =
            [(camera.fx, camera.cx, camera.width, t.x, pixel[0]), (camera.fy, camera.cy, camera.height, t.y, pixel[1])];
        t.z <= 0.0
            || axes.into_iter().all(|(focal, middle, size, across, pixel)| {
                let slope = across / t.z;
                let size = f64::from(size);
                let clamp = (middle.abs().max((size - middle).abs()) + MARGIN * size) / focal;
                // A centre p of the ball has |p.x / p.z - slope| <= radius (1 + |slope|) / p.z.
                let centers = self.radius * (1.0 + slope.abs()) / z;
                let spread = REACH * (self.scale * (1.0 + clamp) / z + LOW_PASS / focal);
                (f64::from(pixel) + 0.5 - middle - focal * slope).abs() <= focal * (centers + spread) + 1.0
            })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pack::{pack, tests::cloud};
    use gs_raster::RasterOptions;

    #[test]
    fn what_a_pixel_shows_is_among_the_candidates() {
        let mut g = cloud(20_000);
        // Needles and sheets, some of them large.
        for i in (0..g.len()).step_by(50) {
            g.log_scales[i] = [0.5, -7.0, -2.0];
        }
        let order = pack(&g, 0).order;
        let reach = Reach::new(&g, &order);
        let raster = RasterOptions::fit(&g);
        let (mut shown, mut asked) = (0, 0);
        for (eye, cx) in
            [(DVec3::new(3.0, 0.0, 0.0), 80.0), (DVec3::new(0.2, 0.1, -0.3), 80.0), (DVec3::new(0.0, -2.0, 1.0), -30.0)]
        {
            let camera = Camera { cx, ..Camera::look_at(eye, DVec3::new(0.0, 0.1, 0.0), DVec3::Z, 160, 120, 1.0) };
            for pixel in [[0, 0], [80, 60], [159, 119], [20, 100], [130, 30]] {
                let all = gs_raster::pixel_weights(&g, &camera, &raster, pixel);
                let some = reach.candidates(&g, &order, &camera, f64::from(raster.near), pixel);
                let of_some = gs_raster::pixel_weights(&g.select(&some), &camera, &raster, pixel);
                let of_some: Vec<(u32, f64)> = of_some.into_iter().map(|(i, w)| (some[i as usize], w)).collect();
                assert_eq!(of_some, all, "{eye} {pixel:?}");
                shown += all.len();
                asked += some.len();
            }
        }
        assert!(shown > 100 && asked < 15 * g.len() / 3, "{shown} {asked}");
    }
}
