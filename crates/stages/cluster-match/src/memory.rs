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
    let (gaussians, kept) = (inputs.geometry.gaussians.len(), inputs.features.kept.len() as u64);
    let (dim, samples) = (inputs.features.dim() as u64, footprints.pixels.col.len() as u64);
    // By the masks: every entry in the profile of its Gaussian or, where there are too many, of a small piece.
    let profiles = |levels: &[Level]| {
        let entries = footprints.total_at(levels);
        14 * entries.min(MOST_ENTRIES) + 3 * entries.saturating_sub(MOST_ENTRIES)
    };
    let parts = if settings.split > 0.0 { profiles(&[Level::SMALL]) } else { 0 };
    // Features as they are read and as they are clustered; free points are also parted from their duplicates and lie in a tree:
    // coordinates, the leaves' blocks, boxes. Entries are read in batches of 4 million.
    let batch = 9 * footprints.total().min(1 << 22);
    let (value, entries) = match settings.cluster {
        Space::Masks => (4, profiles(&settings.levels)),
        Space::Graph => (6, batch.max(parts)),
        Space::Free => (18, batch.max(parts)),
    };
    // By features fitted to 11 runs of 5,000 to 950,000 Gaussians; by the masks to 11 of 14,000 to 890,000.
    least(gaussians as u64) + entries + 14 * samples + value * kept * dim
}
