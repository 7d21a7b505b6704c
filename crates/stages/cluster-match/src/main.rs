//! The `cluster-match` program.

use std::process::ExitCode;

#[global_allocator]
static ALLOCATOR: stage::Allocator = stage::Allocator;

fn main() -> ExitCode {
    stage::main::<cluster_match::Args>()
}
