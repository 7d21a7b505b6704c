//! d loss / d camera, from d loss / d Gaussians.
//!
//! To move the camera is to move all Gaussians the other way, so the gradients of [`crate::Workspace::backward`] hold all that
//! is needed: no kernel knows of poses. Two things do not move with the Gaussians. The harmonics look along the line from the
//! camera's centre, which a turn of the camera about that centre leaves in place; and a longer focal length stretches the
//! ellipses as larger scales would.

use crate::project::{Lens, Parameters, parameters};
use crate::sh;
use crate::types::{Gradients, RasterOptions};
use glam::DVec3;
use gs_scene::{Camera, Gaussians, SH_C0, sh_coefficients};
use rayon::prelude::*;

/// Gaussians that are summed together: pieces of fixed size, so that any number of threads gives the same bits.
const CHUNK: usize = 512;

/// d loss / d camera: the camera's coordinates move as `p -> exp(turn) p + shift`, and both focal lengths grow by a factor of
/// `exp(zoom)`.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct CameraGradient {
    /// By a rotation vector in the camera's axes, per radian.
    pub turn: [f64; 3],
    /// By a shift along the camera's axes, per world unit.
    pub shift: [f64; 3],
    /// By the logarithm of the focal lengths. Gaussians so far beside the image that the Jacobian is clamped count as if it
    /// were not.
    pub zoom: f64,
    /// Mean depth of the Gaussians that have a gradient, world units; 0 without any.
    pub depth: f64,
}

impl CameraGradient {
    fn add(mut self, o: &Self) -> Self {
        for k in 0..3 {
            self.turn[k] += o.turn[k];
            self.shift[k] += o.shift[k];
        }
        self.zoom += o.zoom;
        self.depth += o.depth;
        self
    }

    /// Whether all numbers are finite.
    pub fn is_finite(&self) -> bool {
        self.turn.iter().chain(&self.shift).chain([&self.zoom]).all(|v| v.is_finite())
    }
}

/// The gradient by the camera that `gradients` were computed with; the options are those of that pass. Sums are in double
/// precision.
pub fn camera_gradient(
    g: &Gaussians,
    gradients: &Gradients,
    camera: &Camera,
    options: &RasterOptions,
) -> CameraGradient {
    let lens = Lens::new(camera);
    let (stride, degree) = (g.sh_stride(), g.sh_degree.min(options.sh_degree));
    let one = |i: usize| {
        let d = &gradients.sh[i * stride..i * stride + 3];
        let ([x, y, z], [a, b, c], [qw, qx, qy, qz]) =
            (gradients.means[i], gradients.log_scales[i], gradients.rotations[i]);
        let d_own = [x, y, z, a, b, c, qw, qx, qy, qz, gradients.opacity_logits[i]].map(f64::from);
        let d_color = [0, 1, 2].map(|k| f64::from(d[k] / SH_C0));
        let own = parameters(g, i).map(f64::from);
        part(&own, g.sh_of(i), degree, &d_own, d_color, gradients.mean2d[i].map(f64::from), camera, &lens)
    };
    // A Gaussian that is not drawn has no gradient, and its parameters may not be finite.
    let moves = |i: &usize| gradients.mean2d[*i] != [0.0; 2] || gradients.means[*i] != [0.0; 3];
    let sums: Vec<(CameraGradient, u32)> = (0..g.len().div_ceil(CHUNK))
        .into_par_iter()
        .map(|k| (k * CHUNK..g.len().min((k + 1) * CHUNK)).filter(moves).map(one))
        .map(|parts| parts.fold(Default::default(), |(sum, n): (CameraGradient, u32), p| (sum.add(&p), n + 1)))
        .collect();
    let count: u32 = sums.iter().map(|(_, n)| n).sum();
    let sum = sums.iter().fold(CameraGradient::default(), |sum, (part, _)| sum.add(part));
    CameraGradient { depth: sum.depth / f64::from(count.max(1)), ..sum }
}

/// One Gaussian's part, with its depth. `d_own` is d loss / d its parameters, `d_color` d loss / d its colour, `d_mean` d loss / d
/// its projected centre.
fn part<T: Copy + Into<f64>>(
    own: &Parameters,
    sh: &[T],
    degree: u8,
    d_own: &Parameters,
    d_color: [f64; 3],
    d_mean: [f64; 2],
    camera: &Camera,
    lens: &Lens,
) -> CameraGradient {
    let from_camera = lens.direction(own);
    let t = camera.rotation * from_camera;
    let d_center = DVec3::new(d_own[0], d_own[1], d_own[2]);
    // What reaches the centre through the view direction.
    let mut d_direction = DVec3::ZERO;
    if degree > 0 {
        let mut weights = [0.0; 16];
        for (w, s) in weights.iter_mut().zip(sh.chunks_exact(3)).take(sh_coefficients(degree)) {
            *w = (0..3).map(|c| s[c].into() * d_color[c]).sum();
        }
        d_direction = sh::direction_gradient(degree, from_camera, &weights);
    }
    // The Gaussian turned by a small v about the world's axes: q becomes (1, v / 2) q.
    let [_, _, _, d_a, d_b, d_c, dw, dx, dy, dz, _] = *d_own;
    let [_, _, _, _, _, _, w, x, y, z, _] = *own;
    let (q, d_q) = (DVec3::new(x, y, z), DVec3::new(dx, dy, dz));
    let d_axes = 0.5 * (w * d_q - dw * q + q.cross(d_q));
    let turn = camera.rotation * (from_camera.cross(d_center - d_direction) + d_axes);
    let shift = camera.rotation * d_center;
    let off = [camera.fx * t.x / t.z, camera.fy * t.y / t.z];
    let zoom = d_mean[0] * off[0] + d_mean[1] * off[1] + d_a + d_b + d_c;
    CameraGradient { turn: turn.to_array(), shift: shift.to_array(), zoom, depth: t.z }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::reference::Gaussian;

    /// The same from the reference's gradients, in double precision throughout.
    pub(crate) fn of_reference(
        scene: &[Gaussian],
        gradients: &[(Vec<f64>, [f64; 2])],
        camera: &Camera,
        options: &RasterOptions,
    ) -> CameraGradient {
        let lens = Lens::new(camera);
        let parts = scene.iter().zip(gradients).map(|(g, (d, d_mean))| {
            let stored = (g.sh.len() as f64 / 3.0).sqrt() as u8 - 1;
            let d_color = [0, 1, 2].map(|k| d[11 + k] / f64::from(SH_C0));
            let d_own = d[..11].try_into().unwrap();
            part(&g.own, &g.sh, stored.min(options.sh_degree), &d_own, d_color, *d_mean, camera, &lens)
        });
        parts.fold(CameraGradient::default(), |sum, p| sum.add(&p))
    }
}
