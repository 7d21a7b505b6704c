//! Where the time of a pass goes.

use crate::Workspace;
use crate::backward::{gather, pair_gradients};
use crate::forward::composite;
use crate::types::{PixelGradients, RasterOptions};
use gs_scene::{Camera, Gaussians};

/// Seconds of one forward and backward pass, stage by stage, and the pairs it went through.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measured {
    /// Projection, harmonics, sorting, lists of tiles.
    pub project_s: f64,
    /// Compositing.
    pub forward_s: f64,
    /// Gradients of every splat in every tile.
    pub backward_s: f64,
    /// Summing these over tiles and taking them to the parameters.
    pub gather_s: f64,
    /// Pixel-Gaussian pairs that the kernels looked at, each way.
    pub pairs_evaluated: usize,
}

/// Runs [`Workspace::forward`] and [`Workspace::backward`], on the current rayon pool, with a clock between their stages. `d_rgb` is
/// d loss / d colour, `[height][width][rgb]`; `clock` returns seconds: on a pool of one thread its CPU time serves best, which
/// other loads on the machine do not stretch.
pub fn measure(
    workspace: &mut Workspace,
    g: &Gaussians,
    camera: &Camera,
    options: &RasterOptions,
    d_rgb: &[f32],
    clock: impl Fn() -> f64,
) -> Measured {
    let mut last = clock();
    let mut lap = || {
        let now = clock();
        let seconds = now - last;
        last = now;
        seconds
    };
    let Workspace { forward, gradients, pairs } = workspace;
    forward.tiles.build(g, camera, options);
    let project_s = lap();
    let pairs_evaluated = composite(&forward.tiles, options, &mut forward.rendered);
    let forward_s = lap();
    pair_gradients(forward, camera, options, PixelGradients { rgb: d_rgb, alpha: None, depth: None }, pairs);
    let backward_s = lap();
    gather(g, options, &forward.tiles, pairs, gradients);
    Measured { project_s, forward_s, backward_s, gather_s: lap(), pairs_evaluated }
}
