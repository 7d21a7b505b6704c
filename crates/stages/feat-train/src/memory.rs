//! How much memory a run will take, known before it starts. docs/performance.md compares it with measured peaks.

use crate::contrastive::masks::MaskSets;
use crate::inputs::Inputs;
use crate::options::Options;
use crate::spectral::evidence::{self, blocks, masks_of_blocks};
use crate::spectral::gram;
use artifacts::{Footprints, LEVELS, Level};
use gs_io::Result;

/// Peak memory in bytes of a run on these inputs, whose geometry is a file of `geometry` bytes.
///
/// # Errors
/// When the footprints can't be read.
pub fn forecast(inputs: &Inputs, options: &Options, geometry: u64) -> Result<u64> {
    if options.preset.is_some() {
        return trained(&inputs.footprints, options, geometry);
    }
    let footprints = &inputs.footprints;
    let gaussians = footprints.kept.len().max(1) as u64;
    let read = 16 * footprints.pixels.col.len() as u64;
    // The blocks at work, the product of the matrix with itself, and the features.
    let blocks = blocks(&inputs.graph);
    let levels = options.levels();
    let rows = footprints.rows.iter().enumerate().filter(|(_, row)| row.is_of(&levels));
    let (masks, used) = rows.fold((0, 0), |(masks, used), (r, _)| (masks + 1, used + footprints.entries_of(r) as u64));
    let dim = options.most_vectors(footprints.kept.len()).min(masks) as u64;
    let product = gram::bytes(&masks_of_blocks(footprints, &blocks, &levels)?, masks, used);
    // With the footprints' rows and the graph.
    Ok(6_200_000 + read + 360 * gaussians + evidence::bytes(used).max(product).max(5 * gaussians * dim))
}

/// With a preset: the peak is while the geometry is read, or in training. Fitted to 21 runs.
fn trained(footprints: &Footprints, options: &Options, geometry: u64) -> Result<u64> {
    let gaussians = footprints.kept.len() as u64;
    let read = 4_700_000 + 26 * footprints.pixels.col.len() as u64;
    let sets = in_mask_sets(footprints, &options.levels())?;
    let state = 200 + 53 * options.trained_dim() as u64;
    Ok(read + (2 * geometry + 117 * gaussians).max(sets + state * gaussians))
}

/// What the mask sets of all views at `levels` take: 6 bytes for an entry, 8 for a column, which is a Gaussian that a view shows
/// at a level. Above what is kept, one that is made anew joins, with the entries that it is made of.
fn in_mask_sets(footprints: &Footprints, levels: &[Level]) -> Result<u64> {
    let (mut all, mut entries, mut largest) = (0, 0, 0);
    let mut last = vec![u64::MAX; footprints.kept.len()];
    let mut set = u64::MAX;
    for (r, row) in footprints.rows.iter().enumerate().filter(|(_, row)| row.is_of(levels)) {
        let of = u64::from(row.view) * LEVELS as u64 + u64::from(row.level);
        if of != set {
            (set, entries) = (of, 0);
        }
        for &i in &footprints.entries(r)?.gaussians {
            all += 6 + 8 * u64::from(std::mem::replace(&mut last[i as usize], set) != set);
            entries += 1;
        }
        largest = largest.max(entries);
    }
    Ok(all.min(MaskSets::MOST as u64) + 26 * largest)
}
