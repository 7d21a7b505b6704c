//! Numerical stress: hostile scenes and settings through every stage, and changes of a scene that must not change the result.

mod cases;
mod matrix;
mod oracle;
pub mod world;

pub use matrix::{Row, run};
