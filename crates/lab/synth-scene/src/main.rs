//! The `synth-scene` program.

use std::process::ExitCode;

fn main() -> ExitCode {
    stage::main::<synth_scene::Args>()
}
