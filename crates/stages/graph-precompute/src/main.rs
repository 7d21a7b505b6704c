//! The `graph-precompute` program.

use std::process::ExitCode;

fn main() -> ExitCode {
    stage::main::<graph_precompute::Args>()
}
