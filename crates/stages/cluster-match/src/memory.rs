//! How much memory a run will take, said before it starts. docs/performance.md compares it with measured peaks.

use crate::inputs::Inputs;
use crate::options::Space;

/// Peak memory in bytes of clustering in this space.
pub fn forecast(inputs: &Inputs, space: Space) -> u64 {
    let (entries, samples) = (inputs.footprints.total(), inputs.footprints.pixels.col.len());
    let (gaussians, kept) = (inputs.geometry.gaussians.len(), inputs.features.kept.len() as u64);
    let dim = inputs.features.dim() as u64;
    // Features as they are read and as they are clustered; free points are also parted from their duplicates and lie in a tree:
    // coordinates, the leaves' blocks, boxes. By the masks: every entry in the profile of its Gaussian, and those growing. Entries
    // are read in batches of 4 million.
    let (value, entries) = match space {
        Space::Masks => (4, 18 * entries),
        Space::Graph => (6, 9 * entries.min(1 << 22)),
        Space::Free => (18, 9 * entries.min(1 << 22)),
    };
    // Fitted to 11 runs of 5,000 to 950,000 Gaussians; by the masks to 11 of 12,000 to 950,000.
    12_800_000 + entries + 14 * samples as u64 + 1000 * gaussians as u64 + value * kept * dim
}
