//! A small random scene in memory.

use super::context::Context;
use super::masks::{MaskSet, Pixels};
use artifacts::Graph;
use ndarray::Array2;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// A graph of `n` Gaussians on a line, every fourth an anchor.
pub fn graph(n: usize, k: usize) -> Graph {
    let anchors: Vec<u32> = (0..n as u32).step_by(4).collect();
    let m = anchors.len();
    let near = |i: usize, of: &[u32], pad: u32, skip: usize| -> Vec<u32> {
        let mut all: Vec<u32> = (0..of.len() as u32).filter(|&j| j as usize != skip).collect();
        all.sort_by_key(|&j| ((of[j as usize] as i64 - i as i64).abs(), j));
        all.resize(all.len().max(k), pad);
        all.truncate(k);
        all
    };
    let table = |rows: Vec<u32>| Array2::from_shape_vec((rows.len() / k, k), rows).unwrap();
    let everyone: Vec<u32> = (0..n as u32).collect();
    Graph {
        kept: everyone.clone(),
        knn: table(anchors.iter().flat_map(|&a| near(a as usize, &everyone, a, a as usize)).collect()),
        anchor_knn: table((0..m).flat_map(|a| near(anchors[a] as usize, &anchors, a as u32, a)).collect()),
        nearest_anchor: (0..n).map(|i| (((i + 1) / 4) as u32).min(m as u32 - 1)).collect(),
        gaussian_knn: table((0..n).flat_map(|i| near(i, &everyone, i as u32, i)).collect()),
        seen_views: vec![1; n],
        seen_weight: vec![1.0; n],
        anchors,
    }
}

pub fn colors(n: usize) -> Vec<[f32; 3]> {
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    (0..n).map(|_| std::array::from_fn(|_| rng.random_range(0.0..1.0))).collect()
}

pub fn context(n: usize, propagate: bool) -> Context {
    let positions: Vec<[f32; 3]> = (0..n).map(|i| [i as f32, 0.0, 0.0]).collect();
    Context::new(&graph(n, 3), &colors(n), &positions, propagate)
}

/// `masks` masks over most of the Gaussians, some of which lie in two.
pub fn mask_set(context: &Context, masks: usize, seed: u64) -> MaskSet {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let n = context.order.len();
    let mut entries = Vec::new();
    for place in 0..n as u32 {
        if rng.random_range(0.0..1.0) < 0.2 {
            continue;
        }
        let first = rng.random_range(0..masks as u32);
        let second = rng.random_range(0..masks as u32);
        for k in [Some(first), (second > first).then_some(second)].into_iter().flatten() {
            entries.push((place, k as u16, rng.random_range(0.01..0.1)));
        }
    }
    let pixels = (0..masks).map(|k| 10.0 + k as f64).collect();
    let mut set = MaskSet::from_entries((0..masks as u32).collect(), pixels, entries, context);
    set.sampled = sampled(&set, &mut rng);
    set
}

/// Three pixels of every mask, each of a few of its Gaussians; the second mask has none.
fn sampled(set: &MaskSet, rng: &mut ChaCha8Rng) -> Pixels {
    let mut pixels = Pixels { start: vec![0], ..Pixels::default() };
    for k in (0..set.len() as u16).filter(|&k| k != 1) {
        let mine: Vec<u32> =
            (0..set.columns.len() as u32).filter(|&c| set.entries(c as usize).0.contains(&k)).collect();
        for _ in 0..if mine.is_empty() { 0 } else { 3 } {
            let first = rng.random_range(0..mine.len());
            let few = &mine[first..(first + 4).min(mine.len())];
            pixels.mask.push(k);
            pixels.column.extend(few);
            pixels.weight.extend(few.iter().map(|_| rng.random_range(0.05f32..0.3)));
            pixels.start.push(pixels.column.len() as u32);
        }
    }
    pixels
}
