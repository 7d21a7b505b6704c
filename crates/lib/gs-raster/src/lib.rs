//! Differentiable rasteriser of 3D Gaussians on the CPU: projection, tiles, forward, backward, per-pixel weights; and whether
//! Gaussians show photographs. It knows nothing of training.
//!
//! Conventions (those of gsplat and the original 3DGS): pixel centres at +0.5; 0.3 added to the 2D covariance's diagonal;
//! alpha = min(0.99, opacity exp(-sigma)), skipped below 1/255; compositing stops before the Gaussian that would bring the
//! transmittance to 1e-4; depth order by camera z, ties by index; colour = max(SH + 0.5, 0). Gaussians whose parameters are
//! not finite, whose quaternion is zero, or that lie behind the near plane are not drawn.
//!
//! The same inputs give the same bits for any number of threads: tiles are independent, and a Gaussian's gradients are
//! summed over its tiles in tile order.

mod backward;
#[cfg(test)]
mod checks;
mod dropped;
mod features;
mod forward;
mod kernels;
mod lanes;
mod photographs;
mod pose;
mod project;
mod reference;
mod sh;
mod tiles;
mod types;
mod weights;
mod workspace;

pub use dropped::Dropped;
pub use features::render_features;
pub use forward::{Forward, drawn, forward, render};
pub use photographs::{Likeness, Photographs};
pub use pose::{CameraGradient, camera_gradient};
pub use reference::{Pixel, render_gaussians as render_reference};
pub use tiles::TILE;
pub use types::{Gradients, PixelGradients, RasterOptions, Rendered, near_plane};
pub use weights::{TileWeights, pixel_weights, tile_bytes, tile_weights};
pub use workspace::{Measured, Workspace};
