//! How much memory a run will take, known before it starts. docs/performance.md compares it with measured peaks.

use crate::inputs::Inputs;
use crate::options::Options;
use crate::spectral;
use crate::spectral::evidence::{blocks, masks_of_blocks};
use crate::spectral::gram;
use artifacts::Level;

/// Peak memory in bytes of a run on these inputs.
pub fn forecast(inputs: &Inputs, options: &Options) -> u64 {
    let footprints = &inputs.footprints;
    let (start, entries, _) = footprints.csr();
    let gaussians = footprints.kept.len().max(1) as u64;
    let read = 16 * footprints.pixels.col.len() as u64;
    if options.preset.is_some() {
        // Fitted to 24 runs of dimension 6, within 4 %: features, moments and gradients are of that size.
        let state = 500 * options.trained_dim() as u64 / 6 + if options.contrastive.layers > 0 { 36 } else { 0 };
        return 4_700_000 + 19 * entries.len() as u64 / 2 + read + state * gaussians;
    }
    // The matrix (the average over neighbours gives it two thirds more entries than the footprints have), and the features, for all
    // of them and for the blocks at work.
    let blocks = blocks(&inputs.graph);
    let of = |levels: &[Level]| {
        let rows = footprints.rows.iter().enumerate().filter(|(_, row)| levels.iter().any(|&l| l as u32 == row.level));
        let (masks, used) = rows.fold((0, 0), |(masks, used), (r, _)| (masks + 1, used + start[r + 1] - start[r]));
        let dim = options.most_vectors(footprints.kept.len()).min(masks) as u64;
        let product = gram::bytes(&masks_of_blocks(footprints, &blocks, levels), used);
        (14 * used + product + 8 * gaussians * dim, 4 * gaussians * dim)
    };
    let levels = options.levels();
    let (features, kept) = of(&levels);
    // The features of parts are made when those are there.
    let parts = if spectral::has_parts(&levels) { kept + of(&[Level::Small]).0 } else { 0 };
    // With the footprints and the graph.
    3_600_000 + 8 * entries.len() as u64 + read + 462 * gaussians + features.max(parts)
}
