//! Labels by votes of masks.
//!
//! The clustering cuts where features differ most. At the rim of a thing this is wrong by a few Gaussians, and noise has
//! the label of its nearest neighbour. Once instances are known, each view tells where they end: a Gaussian gets the label of
//! the neighbouring instance whose masks hold most of its weight. Its neighbours have no say, or rims would be smooth.

use crate::profile::{mask_weights, units};
use artifacts::{Entries, Footprints, Graph, Level};
use gs_io::Result;
use rayon::prelude::*;
use std::ops::Range;

/// Gaussians that one task handles.
const CHUNK: usize = 8192;
/// A Gaussian changes its instance only for one with this many times its votes.
const LEAD: f32 = 1.02;

/// Gives Gaussians the neighbouring instance with most votes, in at most `rounds` rounds, until none changes. `labels` are
/// those of the kept Gaussians; those in no instance (-1) stay so. A Gaussian's votes for an instance are its weights in all masks,
/// each times the share of the instance that the view shows in this mask. Returns how many labels changed.
///
/// # Errors
/// When the footprints can't be read.
pub fn by_votes(
    labels: &mut [i32],
    instances: usize,
    footprints: &Footprints,
    graph: &Graph,
    levels: &[Level],
    rounds: usize,
) -> Result<usize> {
    let mut moved = 0;
    for _ in 0..rounds {
        let new = vote(labels, instances, footprints, graph, levels)?;
        if new.is_empty() {
            break;
        }
        moved += new.len();
        new.into_iter().for_each(|(i, label)| labels[i as usize] = label as i32);
    }
    Ok(moved)
}

/// The Gaussians whose label changes in this round, with the new one.
fn vote(
    labels: &[i32],
    instances: usize,
    footprints: &Footprints,
    graph: &Graph,
    levels: &[Level],
) -> Result<Vec<(u32, u32)>> {
    // The Gaussians with several instances around them, and these: (Gaussian, instance), ascending.
    let asked: Vec<(u32, u32)> = (0..labels.len())
        .into_par_iter()
        .with_min_len(CHUNK)
        .filter(|&i| labels[i] >= 0)
        .flat_map_iter(|i| {
            let around = graph.gaussian_knn.row(i).into_iter().map(|&j| labels[j as usize]);
            let mut choice: Vec<u32> = around.chain([labels[i]]).filter_map(|l| u32::try_from(l).ok()).collect();
            choice.sort_unstable();
            choice.dedup();
            let choice = if choice.len() > 1 { choice } else { Vec::new() };
            choice.into_iter().map(move |label| (i as u32, label))
        })
        .collect();
    let votes = count(&asked, labels, instances, footprints, levels)?;
    let mut changed = Vec::new();
    let mut at = 0;
    for choice in asked.chunk_by(|a, b| a.0 == b.0) {
        let votes = &votes[at..at + choice.len()];
        at += choice.len();
        let (gaussian, own) = (choice[0].0, labels[choice[0].0 as usize] as u32);
        let others = || choice.iter().zip(votes).map(|(c, &v)| (c.1, v));
        let now = others().find(|o| o.0 == own).map_or(0.0, |o| LEAD * o.1);
        let best = others().filter(|o| o.0 != own).fold((own, now), |b, o| if o.1 > b.1 { o } else { b });
        if best.0 != own {
            changed.push((gaussian, best.0));
        }
    }
    Ok(changed)
}

/// The votes for each pair of Gaussian and instance in `asked`.
fn count(
    asked: &[(u32, u32)],
    labels: &[i32],
    instances: usize,
    footprints: &Footprints,
    levels: &[Level],
) -> Result<Vec<f32>> {
    let unit_of = units(footprints);
    let weights = mask_weights(labels, footprints, levels)?;
    // Share of each instance in each mask, of what the mask's view and level show of it.
    let mut in_unit = vec![0.0f64; instances];
    let mut shares: Vec<Vec<(u32, f32)>> = Vec::with_capacity(weights.len());
    for unit in weights.chunk_by(|a, b| unit_of[a.0 as usize] == unit_of[b.0 as usize]) {
        in_unit.fill(0.0);
        unit.iter().flat_map(|(_, of)| of).for_each(|(&label, w)| in_unit[label as usize] += w);
        for (_, of) in unit {
            let share = |(&label, w): (&u32, &f64)| (label, (w / in_unit[label as usize].max(1e-300)) as f32);
            shares.push(of.iter().map(share).collect());
        }
    }
    let mut chunks: Vec<Chunk<'_>> = (0..labels.len().div_ceil(CHUNK)).map(|c| Chunk::new(c, asked)).collect();
    let rows: Vec<u32> = weights.iter().map(|(r, _)| *r).collect();
    let mut at = 0;
    footprints.in_batches(&rows, |_, batch| {
        let shares = &shares[at..at + batch.len()];
        at += batch.len();
        chunks.par_iter_mut().for_each_init(|| vec![0.0f32; instances], |room, chunk| chunk.add(batch, shares, room));
    })?;
    Ok(chunks.into_iter().flat_map(|c| c.votes).collect())
}

/// The votes asked for of [`CHUNK`] Gaussians.
struct Chunk<'a> {
    gaussians: Range<u32>,
    asked: &'a [(u32, u32)],
    /// Where those of each Gaussian begin.
    start: Vec<usize>,
    votes: Vec<f32>,
}

impl<'a> Chunk<'a> {
    fn new(c: usize, asked: &'a [(u32, u32)]) -> Self {
        let gaussians = (c * CHUNK) as u32..((c + 1) * CHUNK) as u32;
        let upto = |i: u32| asked.partition_point(|a| a.0 < i);
        let asked = &asked[upto(gaussians.start)..upto(gaussians.end)];
        let mut start = vec![0usize; CHUNK + 1];
        asked.iter().for_each(|a| start[(a.0 - gaussians.start) as usize + 1] += 1);
        (0..CHUNK).for_each(|i| start[i + 1] += start[i]);
        Self { gaussians, asked, start, votes: vec![0.0; asked.len()] }
    }

    /// Adds those of some masks, of which `shares` has the share of each instance. `room` has a zero for each instance.
    fn add(&mut self, masks: &[Entries], shares: &[Vec<(u32, f32)>], room: &mut [f32]) {
        for (entries, of) in masks.iter().zip(shares) {
            of.iter().for_each(|&(label, s)| room[label as usize] = s);
            for (i, w) in entries.within(self.gaussians.clone()) {
                let at = (i - self.gaussians.start) as usize;
                let range = self.start[at]..self.start[at + 1];
                for (v, a) in self.votes[range.clone()].iter_mut().zip(&self.asked[range]) {
                    *v += w * room[a.1 as usize];
                }
            }
            of.iter().for_each(|&(label, _)| room[label as usize] = 0.0);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use artifacts::{FootprintsBuilder, Row};
    use gs_io::Provenance;

    /// 20 Gaussians in a row, of which four views show two masks: those for which `second` holds, and the others.
    fn row(second: impl Fn(u32) -> bool) -> (tempfile::TempDir, Footprints, Graph) {
        let n = 20u32;
        let mut b = FootprintsBuilder { kept: (0..n).collect(), ..FootprintsBuilder::default() };
        for view in 0..4 {
            b.views.push(view.to_string());
            for mask in 0..2 {
                let row = Row { view, level: 3, mask, pixels: 10, gated: 10, alpha: 1.0 };
                b.push(row, (0..n).filter(|&i| second(i) == (mask == 1)).map(|i| (i, 1.0)));
            }
        }
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("f.safetensors");
        b.write(&path, Provenance::default()).unwrap();
        let footprints = Footprints::read(&path).unwrap();
        let near = |i: i64| [i - 1, i + 1].map(|j| if (0..20).contains(&j) { j as u32 } else { i as u32 });
        let graph = Graph {
            kept: (0..n).collect(),
            gaussian_knn: (0..20).map(near).collect::<Vec<_>>().into(),
            ..Graph::default()
        };
        (dir, footprints, graph)
    }

    #[test]
    fn a_thing_as_thin_as_a_gaussian_stays_what_its_masks_say() {
        let (_dir, footprints, graph) = row(|i| i == 7);
        let mut labels: Vec<i32> = (0..20).map(|i| i32::from(i == 7 || i == 8)).collect();
        assert_eq!(by_votes(&mut labels, 2, &footprints, &graph, &[Level::LARGE], 5).unwrap(), 1);
        assert_eq!(labels, (0..20).map(|i| i32::from(i == 7)).collect::<Vec<_>>());
    }

    #[test]
    fn a_rim_goes_where_its_masks_are_and_strays_come_home() {
        // Labels are off by two, and one is astray.
        let (_dir, footprints, graph) = row(|i| i >= 10);
        let mut labels: Vec<i32> = (0..20).map(|i| i32::from(i >= 12)).collect();
        labels[4] = 1;
        labels[17] = -1;
        let mut expected: Vec<i32> = (0..20).map(|i| i32::from(i >= 10)).collect();
        expected[17] = -1;
        let moved = by_votes(&mut labels, 2, &footprints, &graph, &[Level::LARGE], 5).unwrap();
        assert_eq!((moved, &labels), (3, &expected));
        assert_eq!(by_votes(&mut labels, 2, &footprints, &graph, &[Level::LARGE], 5).unwrap(), 0);
        // No masks of this level: no votes, no change.
        let mut off = vec![0; 20];
        off[3] = 1;
        assert_eq!(by_votes(&mut off, 2, &footprints, &graph, &[Level::SMALL], 5).unwrap(), 0);
    }
}
