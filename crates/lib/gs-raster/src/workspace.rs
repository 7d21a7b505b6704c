//! Memory that passes over many views share.

use crate::backward::{gather, pair_gradients};
use crate::forward::Forward;
use crate::project::SplatGradient;
use crate::types::{Gradients, PixelGradients, RasterOptions};
use gs_scene::{Camera, Gaussians};

/// Renders and differentiates like [`crate::forward()`] and [`crate::backward()`], to the same bits, in memory that it keeps:
/// fresh memory of that size comes from the operating system page by page, which costs more than what is done with it.
#[derive(Default)]
pub struct Workspace {
    /// Of the last view rendered.
    pub forward: Forward,
    /// Of the last backward pass. It writes every value, so callers may change them.
    pub gradients: Gradients,
    pub(crate) pairs: Vec<SplatGradient>,
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
}
