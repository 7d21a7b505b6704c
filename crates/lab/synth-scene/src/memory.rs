//! How much memory a scene will take, told before it is made.

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
    // Fitted to measured peaks, which tests/cli.rs holds it against.
    (7_200_000 + 75 * a.pixels + 32 * a.texels + 50 * a.points + 17 * buckets + 30 * a.vertices) as u64
}
