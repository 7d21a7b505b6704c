//! The `gs-geom` program.

use std::process::ExitCode;

fn main() -> ExitCode {
    stage::main::<gs_geom::Args>()
}
