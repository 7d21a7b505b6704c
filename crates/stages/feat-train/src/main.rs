//! The `feat-train` program.

use std::process::ExitCode;

fn main() -> ExitCode {
    stage::main::<feat_train::options::Args>()
}
