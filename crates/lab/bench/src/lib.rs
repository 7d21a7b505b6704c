//! Experiments by a [`plan`]: tables of scores, run time against error, growth; two builds beside each other; numerical
//! stress. All through the stages' binaries, as people run them.

pub mod cells;
pub mod chain;
pub mod cli;
pub mod compare;
pub mod growth;
pub mod interval;
pub mod page;
pub mod plan;
pub mod stress;
pub mod tables;
pub mod task;
pub mod tradeoff;
