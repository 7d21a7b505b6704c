//! How much memory a run will take, said before it starts. docs/performance.md compares it with measured peaks.

/// Peak memory in bytes for so many Gaussians, `kept` of them with features of `dim` dimensions, and footprints of `entries` entries
/// besides `samples` of sampled pixels.
pub fn forecast(gaussians: usize, kept: usize, dim: usize, entries: usize, samples: usize) -> u64 {
    // Fitted to 15 runs of 5,000 to 80,000 Gaussians and up to 12 million entries, within 5 %.
    12_800_000
        + 19 * entries as u64 / 2
        + 14 * samples as u64
        + 627 * gaussians as u64
        + 123 * kept as u64 * dim as u64 / 10
}
