//! The `cags` program.

use std::process::ExitCode;

#[global_allocator]
static ALLOCATOR: stage::Allocator = stage::Allocator;

fn main() -> ExitCode {
    cags::main(std::env::args_os().collect())
}
