//! Stage 0: id maps and CLIP features of photographs.

use std::process::ExitCode;

#[global_allocator]
static ALLOCATOR: stage::Allocator = stage::Allocator;

fn main() -> ExitCode {
    stage::main::<mask_embed::Args>()
}
