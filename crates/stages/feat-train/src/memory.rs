//! How much memory a run will take, known before it starts. docs/performance.md compares it with measured peaks.

use crate::options::Options;
use artifacts::Footprints;

/// Peak memory in bytes of a run on these footprints.
pub fn forecast(footprints: &Footprints, options: &Options) -> u64 {
    let (start, entries, _) = footprints.csr();
    let gaussians = footprints.kept.len().max(1) as u64;
    let read = 16 * footprints.pixels.col.len() as u64;
    if options.preset.is_some() {
        // Fitted to 24 runs of dimension 6, within 4 %: features, moments and gradients are of that size.
        let state = 500 * options.trained_dim() as u64 / 6 + if options.contrastive.layers > 0 { 36 } else { 0 };
        return 4_700_000 + 19 * entries.len() as u64 / 2 + read + state * gaussians;
    }
    // The footprints, the products of masks that share Gaussians, and the features. Fitted to 88 runs of 24,000 to 57,000
    // Gaussians, one to four levels of masks and 36 to 256 dimensions: 0.76 to 1.12 of their peaks.
    let rows = footprints.rows.iter().enumerate().filter(|(_, row)| options.uses(row.level));
    let (masks, used) = rows.fold((0, 0), |(masks, used), (r, _)| (masks + 1, used + start[r + 1] - start[r]));
    let dim = options.most_vectors(footprints.kept.len()).min(masks) as u64;
    let shared = (0.64 * used as f64 * used as f64 / gaussians as f64) as u64;
    3_600_000 + 8 * entries.len() as u64 + read + shared + 462 * gaussians + 74 * gaussians * dim / 10
}
