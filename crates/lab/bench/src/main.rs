//! The `bench` program.

use std::process::ExitCode;

fn main() -> ExitCode {
    stage::main::<bench::cli::Args>()
}
