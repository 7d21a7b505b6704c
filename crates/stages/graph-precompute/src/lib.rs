//! Stage 2a: what is computed once because geometry is frozen.
//!
//! `options` is the command line, `run` the story. `precompute` goes through the views: `footprint` rasterises each once
//! and keeps which Gaussians make up which mask; then `graph` samples anchors among the Gaussians that were seen
//! and finds neighbours ([`gs_scene::points`]), at [`positions`] that f32 can bear. `docs/method.md` has the equations.

mod footprint;
mod graph;
mod options;
pub mod positions;
mod precompute;
mod run;
#[cfg(test)]
mod testing;

pub use options::Args;
