//! How much memory a run will take, told before it does. docs/performance.md holds it against measured peaks.

/// What a run's memory grows with.
#[derive(Debug, Clone, Copy)]
pub struct Sizes {
    /// Entries of the footprints.
    pub entries: usize,
    /// Entries of their sampled pixels.
    pub samples: usize,
    /// Kept Gaussians.
    pub gaussians: usize,
}

/// Peak memory in bytes of the closed form with features of up to `dim` dimensions from masks with `used` entries: the
/// footprints, the products of masks that share Gaussians, and the features.
pub fn spectral(s: Sizes, used: usize, dim: usize) -> u64 {
    // Fitted to 88 runs of 24,000 to 57,000 Gaussians, one to four levels of masks and 36 to 256 dimensions: 0.76 to 1.12 of
    // their peaks.
    let (gaussians, used) = (s.gaussians.max(1) as u64, used as u64);
    let shared = (0.64 * used as f64 * used as f64 / gaussians as f64) as u64;
    3_600_000
        + 8 * s.entries as u64
        + 16 * s.samples as u64
        + shared
        + 462 * gaussians
        + 74 * gaussians * dim as u64 / 10
}

/// Peak memory in bytes of contrastive training with this many numbers a feature and layers.
pub fn contrastive(s: Sizes, dim: usize, layers: usize) -> u64 {
    // Fitted to 24 runs with six numbers a feature, within 4 %: features, moments and gradients are of that size.
    let state = 500 * dim.max(1) as u64 / 6 + if layers > 0 { 36 } else { 0 };
    4_700_000 + 19 * s.entries as u64 / 2 + 16 * s.samples as u64 + state * s.gaussians as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn training_is_within_a_tenth_of_measured_peaks() {
        for (entries, gaussians, trained) in [
            (2_610_897, 19_460, 38_600_000u64),
            (6_782_131, 77_767, 106_400_000),
            (11_768_612, 19_562, 133_200_000),
            (863_725, 19_716, 23_900_000),
        ] {
            let s = Sizes { entries, samples: 0, gaussians };
            let ratio = contrastive(s, 6, 2) as f64 / trained as f64;
            assert!((0.9..1.1).contains(&ratio), "{s:?}: {ratio}");
        }
    }

    #[test]
    fn the_closed_form_is_within_a_quarter_of_measured_peaks() {
        // Entries in all, of the levels used, Gaussians, dimension, peak: three scenes, one to four levels.
        for (entries, used, gaussians, dim, peak) in [
            (7_281_826, 1_673_229, 57_076, 64, 139_440_128u64),
            (7_281_826, 5_379_004, 57_076, 256, 506_753_024),
            (1_811_184, 394_588, 23_971, 42, 39_133_184),
            (1_811_184, 492_759, 23_971, 256, 83_000_000),
            (1_811_184, 1_811_184, 23_971, 256, 155_000_000),
            (1_094_172, 810_898, 23_985, 256, 81_797_120),
        ] {
            let s = Sizes { entries, samples: 0, gaussians };
            let ratio = spectral(s, used, dim) as f64 / peak as f64;
            assert!((0.75..1.25).contains(&ratio), "{s:?} {used} {dim}: {ratio}");
        }
    }
}
