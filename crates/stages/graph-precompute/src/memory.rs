//! How much memory a run will take, said before it starts. docs/performance.md compares it with measured peaks.

/// Peak memory in bytes for `gaussians` Gaussians, `views` views whose id maps have up to `pixels` pixels, and `samples` sampled
/// pixels a view, on one thread. Footprints wait on disk, so that their number hardly counts; sampled pixels stay in memory.
pub fn forecast(gaussians: usize, views: usize, pixels: u64, samples: usize) -> u64 {
    // Fitted to 15 runs of 5,000 to 80,000 Gaussians, 12 to 108 views and 10,800 to 172,800 pixels, within 15 %.
    const BASE: u64 = 19_400_000;
    const PER_GAUSSIAN: u64 = 646;
    const PER_PIXEL: u64 = 157;
    const PER_VIEW: u64 = 20_400;
    /// Of a sampled pixel, which shows some 54 Gaussians.
    const PER_SAMPLE: u64 = 330;
    BASE + PER_GAUSSIAN * gaussians as u64
        + PER_PIXEL * pixels
        + views as u64 * (PER_VIEW + PER_SAMPLE * samples as u64)
}
