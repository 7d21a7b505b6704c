//! Experiments by a [`plan`]: tables of scores, run time against error, growth; two builds beside each other; numerical
//! stress. All through the stages' binaries, as people run them. `ceilings` makes what the truth of a scene allows.

mod ceilings;
mod cells;
mod chain;
mod cli;
mod compare;
mod growth;
mod interval;
mod page;
mod pictures;
mod plan;
mod stress;
mod tables;
mod task;
mod tradeoff;

use std::process::ExitCode;

#[global_allocator]
static ALLOCATOR: stage::Allocator = stage::Allocator;

fn main() -> ExitCode {
    stage::main::<cli::Args>()
}
