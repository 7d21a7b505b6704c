//! Stage 2b: one feature vector per Gaussian.
//!
//! Two methods. `contrastive` is the paper's: contextual propagation on the anchor graph and a contrastive loss on the
//! centroids of masks, which are a sparse matrix times the features once geometry is frozen. `spectral` is a closed form:
//! the leading singular vectors of the matrix of Gaussians and masks. `docs/method.md` has the equations.
//!
//! * `options` and `run`: the command line, and the stage from inputs to features.
//! * `inputs`, `outputs`, `memory`, `random`: what both methods share.

mod contrastive;
mod inputs;
mod memory;
mod options;
mod outputs;
mod random;
mod run;
mod spectral;

pub use options::Args;
