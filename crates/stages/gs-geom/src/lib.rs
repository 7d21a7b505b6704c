//! Stage 1: optimisation of 3D Gaussians from posed photographs, on the CPU (Kerbl et al. 2023).
//!
//! * `options`: the options of every command; `run`: what the commands do, `gs-geom train` first; `render`, `eval`, `inspect`,
//!   `convert`: the other commands
//! * `training`: the loop, and in its folder the loss, the optimiser, the schedule, exposures and checkpoints
//! * `densification`: how the number of Gaussians changes
//! * `photographs`: the photographs and their masks; `start`: the Gaussians before the first iteration
//! * `views`: a dataset of renders from Gaussians alone
//! * `budget`: a plan for a given time; `memory`: forecasts; `metrics`: PSNR and SSIM

mod axes;
mod bounds;
mod budget;
mod convert;
mod densification;
mod eval;
mod inspect;
mod memory;
mod metrics;
mod options;
mod photographs;
mod render;
mod run;
mod start;
mod training;
mod views;
#[cfg(test)]
#[path = "../tests/common/world.rs"]
#[allow(dead_code, reason = "the tests of the program use more of it")]
mod world;

pub use options::Args;
