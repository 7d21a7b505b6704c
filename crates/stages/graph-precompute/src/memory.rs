//! How much memory a run will take, told before it does. docs/performance.md holds it against measured peaks.

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

#[cfg(test)]
mod tests {
    use super::forecast;

    #[test]
    fn it_is_within_a_fifth_of_measured_peaks() {
        for (gaussians, views, pixels, samples, peak) in [
            (4967, 21, 43_200, 0, 28_155_904u64),
            (77_790, 21, 43_200, 0, 90_497_024),
            (19_522, 21, 172_800, 0, 68_775_936),
            (19_563, 94, 43_200, 0, 48_259_072),
            (11_993, 28, 43_200, 16 * 4245 / 28, 68_579_328),
            (11_996, 32, 43_200, 16 * 2946 / 32, 44_093_440),
        ] {
            let ratio = forecast(gaussians, views, pixels, samples) as f64 / peak as f64;
            assert!((0.8..1.2).contains(&ratio), "{gaussians} {views} {pixels} {samples}: {ratio}");
        }
    }
}
