//! Gaussians for tests.

use crate::{Gaussians, sh_coefficients};

/// `n` Gaussians of a room, of unit quaternions; the same on every call.
pub(crate) fn cloud(n: usize, sh_degree: u8) -> Gaussians {
    let mut state = 7;
    let mut draw = move |low: f32, high: f32| {
        state += 1;
        low + (high - low) * (gs_io::mixed(state) >> 40) as f32 / (1 << 24) as f32
    };
    let mut g = Gaussians { sh_degree, ..Gaussians::default() };
    for _ in 0..n {
        g.means.push([(); 3].map(|()| draw(-4.0, 4.0)));
        g.log_scales.push([(); 3].map(|()| draw(-7.0, -1.0)));
        let q = [(); 4].map(|()| draw(-1.0, 1.0));
        let length = q.iter().map(|v| v * v).sum::<f32>().sqrt();
        g.rotations.push(q.map(|v| v / length));
        g.opacity_logits.push(draw(-4.0, 5.0));
        g.sh.extend((0..3).map(|_| draw(-1.5, 1.5)));
        g.sh.extend((3..3 * sh_coefficients(sh_degree)).map(|_| draw(-0.7, 0.7)));
    }
    g
}
