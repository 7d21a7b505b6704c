//! How much memory a run will take, said before it starts. docs/performance.md compares it with measured peaks.

use crate::inputs::Inputs;
use crate::linkage::MOST_ENTRIES;
use crate::options::{Settings, Space};
use artifacts::Level;

/// Bytes that a run takes, and for each Gaussian.
const BASE: u64 = 15_500_000;
const PER_GAUSSIAN: u64 = 1000;

/// The least that a run with so many Gaussians takes, known before they are read.
pub fn least(gaussians: u64) -> u64 {
    BASE + PER_GAUSSIAN * gaussians
}

/// Peak memory in bytes of clustering with these settings.
pub fn forecast(inputs: &Inputs, settings: &Settings) -> u64 {
    let footprints = &inputs.footprints;
    let (n, kept) = (inputs.geometry.gaussians.len() as u64, inputs.features.kept.len() as u64);
    let (dim, samples) = (inputs.features.dim() as u64, footprints.pixels.col.len() as u64);
    // First every entry is held by its Gaussian or, where there are too many, by a small piece; then come the pieces' surfaces.
    let by_masks = |levels: &[Level]| {
        let entries = footprints.total_at(levels);
        (650 * n + (10 * entries.min(MOST_ENTRIES)).max(3 * entries)).max(1250 * n)
    };
    let parts = if settings.split > 0.0 { by_masks(&[Level::SMALL]) } else { 0 };
    // Features as they are read and as they are clustered; free points are also parted from their duplicates and lie in a tree:
    // coordinates, the leaves' blocks, boxes. Entries are read in batches of 4 million.
    let by_features = (PER_GAUSSIAN * n + 9 * footprints.total().min(1 << 22)).max(parts);
    let (value, clustering) = match settings.cluster {
        Space::Masks => (4, by_masks(&settings.levels)),
        Space::Graph => (6, by_features),
        Space::Free => (18, by_features),
    };
    // By features fitted to 11 runs of 5,000 to 950,000 Gaussians; by the masks to 11 of 45,000 to 2,660,000.
    BASE + clustering + 14 * samples + value * kept * dim
}
