//! How much memory a run will take, known before it starts. docs/performance.md compares it with measured peaks.

use crate::contrastive::engine::Engine;
use crate::inputs::Inputs;
use crate::options::Options;
use crate::spectral;
use crate::spectral::evidence::{blocks, masks_of_blocks};
use crate::spectral::gram;
use artifacts::{Footprints, LEVELS, Level};

/// Peak memory in bytes of a run on these inputs, whose geometry is a file of `geometry` bytes.
pub fn forecast(inputs: &Inputs, options: &Options, geometry: u64) -> u64 {
    if options.preset.is_some() {
        return trained(&inputs.footprints, options, geometry);
    }
    let footprints = &inputs.footprints;
    let (start, entries, _) = footprints.csr();
    let gaussians = footprints.kept.len().max(1) as u64;
    let read = 16 * footprints.pixels.col.len() as u64;
    // The matrix (the average over neighbours gives it two thirds more entries than the footprints have), and the features, for all
    // of them and for the blocks at work.
    let blocks = blocks(&inputs.graph);
    let of = |levels: &[Level]| {
        let rows = footprints.rows.iter().enumerate().filter(|(_, row)| row.is_of(levels));
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

/// With a preset: the peak is while the geometry is read, or in training. Fitted to 21 runs.
fn trained(footprints: &Footprints, options: &Options, geometry: u64) -> u64 {
    let (_, entries, _) = footprints.csr();
    let gaussians = footprints.kept.len() as u64;
    let read = 4_700_000 + 8 * entries.len() as u64 + 26 * footprints.pixels.col.len() as u64;
    let (entries, columns) = in_mask_sets(footprints, &options.levels());
    let per_value = if Engine::serves(&options.contrastive) { 20 } else { 53 };
    let state = 200 + per_value * options.trained_dim() as u64;
    read + (2 * geometry + 117 * gaussians).max(6 * entries + 8 * columns + state * gaussians)
}

/// Entries and columns of the mask sets of all views at `levels`: a column is a Gaussian that a view shows at a level.
fn in_mask_sets(footprints: &Footprints, levels: &[Level]) -> (u64, u64) {
    let (mut entries, mut columns) = (0, 0);
    let mut last = vec![u64::MAX; footprints.kept.len()];
    for (r, row) in footprints.rows.iter().enumerate().filter(|(_, row)| row.is_of(levels)) {
        let set = u64::from(row.view) * LEVELS as u64 + u64::from(row.level);
        for &i in footprints.entries(r).0 {
            columns += u64::from(std::mem::replace(&mut last[i as usize], set) != set);
            entries += 1;
        }
    }
    (entries, columns)
}
