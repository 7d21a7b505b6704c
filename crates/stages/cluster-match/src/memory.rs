//! How much memory a run will take, told before it does. docs/performance.md holds it against measured peaks.

/// Peak memory in bytes for so many Gaussians, `kept` of them with `dim` numbers a feature, and footprints of `entries` entries
/// besides `samples` of sampled pixels.
pub fn forecast(gaussians: usize, kept: usize, dim: usize, entries: usize, samples: usize) -> u64 {
    // Fitted to 15 runs of 5,000 to 80,000 Gaussians and up to 12 million entries, within 5 %.
    12_800_000
        + 19 * entries as u64 / 2
        + 14 * samples as u64
        + 627 * gaussians as u64
        + 123 * kept as u64 * dim as u64 / 10
}

#[cfg(test)]
mod tests {
    use super::forecast;

    #[test]
    fn it_is_within_a_fifth_of_measured_peaks() {
        for (gaussians, dim, entries, samples, peak) in [
            (4967, 15, 1_234_233, 0, 30_093_312u64),
            (77_790, 64, 6_782_131, 0, 192_233_472),
            (19_563, 27, 11_768_612, 0, 150_614_016),
            (11_993, 64, 2_176_266, 3_898_438, 110_952_448),
        ] {
            let ratio = forecast(gaussians, gaussians, dim, entries, samples) as f64 / peak as f64;
            assert!((0.8..1.2).contains(&ratio), "{gaussians} {dim} {entries} {samples}: {ratio}");
        }
    }
}
