//! The `cluster-match` program.

use std::process::ExitCode;

fn main() -> ExitCode {
    stage::main::<cluster_match::options::Args>()
}
