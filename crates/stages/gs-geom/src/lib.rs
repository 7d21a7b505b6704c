//! Stage 1: optimisation of 3D Gaussians from posed photographs, on the CPU (Kerbl et al. 2023).
//!
//! * [`options`]: the options of every command; `run`: what the commands do, `gs-geom train` first; [`render`], [`eval`],
//!   [`inspect`], [`convert`]: the other commands
//! * [`training`]: the loop, and in its folder the loss, the optimiser, the schedule, exposures and checkpoints
//! * [`densification`]: how the number of Gaussians changes
//! * [`photographs`]: the photographs and their masks; [`start`]: the Gaussians before the first iteration
//! * [`budget`]: a plan for a given time; [`memory`]: forecasts; [`metrics`]: PSNR and SSIM

pub mod bounds;
pub mod budget;
pub mod convert;
pub mod densification;
pub mod eval;
pub mod inspect;
pub mod memory;
pub mod metrics;
pub mod options;
pub mod photographs;
pub mod render;
mod run;
pub mod start;
pub mod training;

/// Property tests that are the same at every run.
#[cfg(test)]
fn property_tests(cases: u32) -> proptest::test_runner::Config {
    let rng_seed = proptest::test_runner::RngSeed::Fixed(1);
    proptest::test_runner::Config { cases, rng_seed, failure_persistence: None, ..Default::default() }
}
