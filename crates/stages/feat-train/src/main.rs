//! The `feat-train` program.

use std::process::ExitCode;

#[global_allocator]
static ALLOCATOR: stage::Allocator = stage::Allocator;

fn main() -> ExitCode {
    stage::main::<feat_train::Args>()
}
