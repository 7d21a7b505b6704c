//! Stage 2b: one feature vector per Gaussian.
//!
//! Two methods. [`train`] is the paper's: contextual propagation on the anchor graph and a contrastive loss on the
//! centroids of masks, which are a sparse matrix times the features once geometry is frozen. [`spectral`] is a closed
//! form: the leading singular vectors of the matrix of Gaussians and masks. `docs/method.md` has the equations.

pub mod adam;
pub mod checkpoint;
pub mod cli;
pub mod cross_view;
pub mod evidence;
pub mod fast;
pub mod gram;
pub mod linalg;
pub mod loss;
pub mod memory;
pub mod model;
pub mod network;
pub mod normalize;
pub mod pixels;
pub mod real;
pub mod scene;
pub mod sparse;
pub mod spectral;
#[cfg(test)]
mod testing;
pub mod train;
