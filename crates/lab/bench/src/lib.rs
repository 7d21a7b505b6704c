//! Run time against error, growth, and numerical stress. All through the stages' binaries, as people run them.

pub mod chain;
pub mod cli;
pub mod compare;
pub mod growth;
pub mod page;
pub mod plan;
pub mod stress;
pub mod tradeoff;
