//! How much memory a scene will take, told before it is made. docs/performance.md holds it against measured peaks.

/// Amounts that decide about the memory of a scene.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Amounts {
    /// Pixels of a photograph.
    pub pixels: usize,
    /// Texels of the light map; 0 where only masks are made.
    pub texels: usize,
    /// Points of the true surface; 0 where only masks are made.
    pub points: usize,
    /// Vertices of a scan with labels and segments; 0 where there is none.
    pub vertices: usize,
}

/// Peak memory in bytes.
pub fn forecast(a: &Amounts) -> u64 {
    // Rehashing touches every bucket of the table of cells, of which there is a power of two.
    let buckets = (a.points * 8 / 7).next_power_of_two();
    // Fitted to the runs of the test below. Photographs are traced and packed besides what masks need.
    let pixel = if a.texels == 0 { 75 } else { 100 };
    (7_200_000 + pixel * a.pixels + 32 * a.texels + 50 * a.points + 17 * buckets + 30 * a.vertices) as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_within_a_fifth_of_measured_peaks() {
        let of = |pixels, texels, points, vertices| Amounts { pixels, texels, points, vertices };
        for (amounts, peak) in [
            (of(19_200, 19_116, 76_152, 0), 16_232_448u64),
            (of(172_800, 148_879, 141_815, 0), 43_130_880),
            (of(2_764_800, 148_879, 111_040, 0), 301_129_728),
            (of(43_200, 244_167, 370_860, 370_860), 58_413_056),
            (of(43_200, 115_523, 82_548, 0), 20_475_904),
            (of(43_200, 28_525, 81_828, 0), 19_271_680),
            (of(172_800, 0, 0, 0), 19_755_008),
            (of(2_764_800, 0, 0, 0), 209_879_040),
        ] {
            let ratio = forecast(&amounts) as f64 / peak as f64;
            assert!((0.8..1.2).contains(&ratio), "{amounts:?}: {ratio}");
        }
    }
}
