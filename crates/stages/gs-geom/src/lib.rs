//! Stage 1: optimisation of 3D Gaussians from posed photographs, on the CPU (Kerbl et al. 2023).
//!
//! [`train`] is the loop; what it is made of is pure and in a module each: [`loss`], [`optimiser`], [`densify`], [`mcmc`],
//! [`schedule`], [`init`]. [`checkpoint`] makes a killed run go on to the bytes of an undisturbed one.

pub mod checkpoint;
pub mod cli;
pub mod content;
pub mod convert;
pub mod curve;
pub mod densify;
pub mod exposure;
pub mod init;
pub mod inspect;
pub mod loss;
pub mod masks;
pub mod mcmc;
pub mod memory;
pub mod metrics;
pub mod optimiser;
pub mod photographs;
pub mod plan;
pub mod schedule;
pub mod train;
