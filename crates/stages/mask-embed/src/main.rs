//! Stage 0: id maps and CLIP features of photographs.

use std::process::ExitCode;

fn main() -> ExitCode {
    stage::main::<mask_embed::Args>()
}
