//! The `eval` program.

use std::process::ExitCode;

fn main() -> ExitCode {
    stage::main::<eval::cli::Args>()
}
