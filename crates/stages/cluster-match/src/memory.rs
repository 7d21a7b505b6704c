//! How much memory a run will take, said before it starts. docs/performance.md compares it with measured peaks.

use crate::inputs::Inputs;

/// Peak memory in bytes.
pub fn forecast(inputs: &Inputs) -> u64 {
    let (entries, samples) = (inputs.footprints.csr().1.len(), inputs.footprints.pixels.col.len());
    let (gaussians, kept, dim) = (inputs.geometry.gaussians.len(), inputs.features.kept.len(), inputs.features.dim);
    // Fitted to 15 runs of 5,000 to 80,000 Gaussians and up to 12 million entries, within 5 %.
    12_800_000
        + 19 * entries as u64 / 2
        + 14 * samples as u64
        + 627 * gaussians as u64
        + 123 * kept as u64 * dim as u64 / 10
}
