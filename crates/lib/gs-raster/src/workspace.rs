//! Both passes, in memory that those over many views share.

use crate::backward::{gather, pair_gradients};
use crate::forward::{Forward, composite};
use crate::project::SplatGradient;
use crate::types::{Gradients, PixelGradients, RasterOptions};
use gs_scene::{Camera, Gaussians};

/// Renders and differentiates in memory that it keeps: fresh memory of that size comes from the operating system page by page,
/// which costs more than what is done with it.
#[derive(Default)]
pub struct Workspace {
    /// Of the last view rendered.
    pub forward: Forward,
    /// Of the last backward pass. It writes every value, so callers may change them.
    pub gradients: Gradients,
    pairs: Vec<SplatGradient>,
}

impl Workspace {
    /// Renders a view.
    pub fn forward(&mut self, g: &Gaussians, camera: &Camera, options: &RasterOptions) -> &Forward {
        self.forward.again(g, camera, options);
        &self.forward
    }

    /// d loss / d every parameter, given d loss / d every pixel of the view last rendered, which must have been with the same
    /// arguments.
    ///
    /// # Panics
    /// When a gradient image has another size than the rendered view, or is that of a depth that was not rendered.
    pub fn backward(
        &mut self,
        g: &Gaussians,
        camera: &Camera,
        options: &RasterOptions,
        d: PixelGradients<'_>,
    ) -> &mut Gradients {
        pair_gradients(&self.forward, camera, options, d, &mut self.pairs);
        gather(g, options, &self.forward.tiles, &self.pairs, &mut self.gradients);
        &mut self.gradients
    }

    /// [`Self::forward`] and [`Self::backward`] on the current rayon pool, with a clock between their stages. `d_rgb` is
    /// d loss / d colour, `[height][width][rgb]`; `clock` returns seconds: on a pool of one thread its CPU time serves best,
    /// which other loads on the machine do not stretch.
    pub fn measure(
        &mut self,
        g: &Gaussians,
        camera: &Camera,
        options: &RasterOptions,
        d_rgb: &[f32],
        clock: impl Fn() -> f64,
    ) -> Measured {
        let Self { forward, gradients, pairs } = self;
        let start = clock();
        forward.tiles.build(g, camera, options);
        let projected = clock();
        let pairs_evaluated = composite(&forward.tiles, options, &mut forward.rendered);
        let rendered = clock();
        pair_gradients(forward, camera, options, PixelGradients { rgb: d_rgb, alpha: None, depth: None }, pairs);
        let differentiated = clock();
        gather(g, options, &forward.tiles, pairs, gradients);
        Measured {
            project_s: projected - start,
            forward_s: rendered - projected,
            backward_s: differentiated - rendered,
            gather_s: clock() - differentiated,
            pairs_evaluated,
        }
    }
}

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
