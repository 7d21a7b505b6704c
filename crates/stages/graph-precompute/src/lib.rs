//! Stage 2a: what is computed once because geometry is frozen.
//!
//! `options` is the command line, `run` the story. `precompute` goes through the views: [`footprint`] rasterises each once
//! and keeps which Gaussians make up which mask; then [`graph`] samples anchors ([`fps`]) among the Gaussians that were seen
//! and finds neighbours ([`kdtree`]), at [`positions`] that f32 can bear. `memory` forecasts the peak. `docs/method.md` has
//! the equations.

pub mod footprint;
pub mod fps;
pub mod graph;
pub mod kdtree;
mod memory;
mod options;
pub mod positions;
mod precompute;
mod run;
#[cfg(test)]
mod testing;

pub use options::Args;
