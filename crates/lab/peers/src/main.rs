//! The `peers` program: other systems of the field on our geometry, masks and footprints, one file each, so that all are
//! compared on the same inputs. docs/peers.md says what was taken from where and what differs.
//!
//! [`world`] is what they read, [`product`] what they make: instances, or a language descriptor for every Gaussian.

mod cli;
mod kmeans;
mod laga;
mod langsplat;
mod legaussians;
mod lightsplat;
mod mask_clustering;
mod opengaussian;
mod pairgs;
mod product;
mod saga;
mod silhouettes;
#[cfg(test)]
mod testing;
mod truth;
mod union;
mod uplift;
mod vectors;
mod world;

use std::process::ExitCode;

#[global_allocator]
static ALLOCATOR: stage::Allocator = stage::Allocator;

fn main() -> ExitCode {
    stage::main::<cli::Args>()
}
