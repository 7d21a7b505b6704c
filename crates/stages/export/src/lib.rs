//! `export`: the objects of a scene for other programs.
//!
//! [`options`](Args) is the command line; `run` reads the scene and writes what a command asks for: splats itself,
//! `points` labelled point clouds, `hull` and `mesh` closed meshes around objects, `usd` all of it as a USD stage, `names` what
//! queries call them, `unseen` what of them no view saw.

mod hull;
mod mesh;
mod names;
mod options;
mod points;
mod run;
mod unseen;
mod usd;

pub use hull::hull;
pub use mesh::Mesh;
pub use options::Args;
