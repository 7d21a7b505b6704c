//! Stage 2a: what is computed once because geometry is frozen.
//!
//! [`footprint`] rasterises each view once and keeps which Gaussians make up which mask; [`graph`] samples anchors among
//! the Gaussians that were seen and finds neighbours. `docs/method.md` has the equations.

pub mod cli;
pub mod contract;
pub mod footprint;
pub mod fps;
pub mod graph;
pub mod kdtree;
pub mod memory;
pub mod positions;
pub mod precompute;
#[cfg(test)]
mod testing;
