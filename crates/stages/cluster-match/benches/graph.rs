//! `make bench-cluster-graph`: `cluster-match --cluster graph` at a million Gaussians with 16 neighbours each, from features
//! to labels. Writes out/bench/cluster-graph.json.
//!
//! Gaussians lie on a grid in shuffled order. They make up 240 things of two parts; a feature is a random direction of
//! its thing, one of its part a tenth as long, and noise of 0.02 a dimension, at unit length.

use artifacts::{Features, Graph};
use cluster_match::group::group;
use cluster_match::options::Space;
use hdbscan_exact::Options;
use rand::seq::SliceRandom;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde_json::json;
use std::path::Path;
use std::time::Instant;

/// Gaussians along a side of the grid.
const SIDE: usize = 1000;
/// Dimension of a feature.
const DIM: usize = 64;
/// Runs, of which the median is reported.
const RUNS: usize = 3;
/// Things across and down.
const THINGS: (usize, usize) = (16, 15);
const K: usize = 16;

/// Features, graph, and the thing of every Gaussian.
fn scene() -> (Features, Graph, Vec<i32>) {
    let (side, dim) = (SIDE, DIM);
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    let n = side * side;
    let mut index: Vec<u32> = (0..n as u32).collect();
    index.shuffle(&mut rng);
    let mut normal = |scale: f32| -> Vec<f32> {
        (0..dim).map(|_| scale * (0..12).map(|_| rng.random_range(-0.5f32..0.5)).sum::<f32>()).collect()
    };
    let length = (dim as f32).sqrt();
    let things: Vec<Vec<f32>> = (0..THINGS.0 * THINGS.1).map(|_| normal(1.0 / length)).collect();
    let parts: Vec<Vec<f32>> = (0..2 * things.len()).map(|_| normal(0.1 / length)).collect();
    // The nearest places on the grid, nearest first.
    let mut steps: Vec<(i64, i64)> = (-4..=4).flat_map(|y| (-4..=4).map(move |x| (y, x))).collect();
    steps.sort_by_key(|(y, x)| y * y + x * x);
    let mut truth = vec![0; n];
    let (mut values, mut knn) = (vec![0.0f32; n * dim], vec![0u32; n * K]);
    for y in 0..side {
        for x in 0..side {
            let i = index[y * side + x] as usize;
            let across = x * THINGS.0 * 2 / side;
            let thing = y * THINGS.1 / side * THINGS.0 + across / 2;
            truth[i] = thing as i32;
            let row = &mut values[i * dim..(i + 1) * dim];
            let noise = normal(0.02);
            for c in 0..dim {
                row[c] = things[thing][c] + parts[2 * thing + across % 2][c] + noise[c];
            }
            let norm = row.iter().map(|v| v * v).sum::<f32>().sqrt();
            row.iter_mut().for_each(|v| *v /= norm);
            let near = steps[1..].iter().filter_map(|(dy, dx)| {
                let (y, x) = (y as i64 + dy, x as i64 + dx);
                let inside = (0..side as i64).contains(&y) && (0..side as i64).contains(&x);
                inside.then(|| index[y as usize * side + x as usize])
            });
            knn[i * K..(i + 1) * K].iter_mut().zip(near).for_each(|(to, j)| *to = j);
        }
    }
    let kept: Vec<u32> = (0..n as u32).collect();
    let graph = Graph { kept: kept.clone(), gaussian_k: K, gaussian_knn: knn, ..Graph::default() };
    (Features { kept, dim, values }, graph, truth)
}

fn main() {
    if !std::env::args().any(|a| a == "--bench") {
        // `cargo test --benches`: nothing to measure.
        return;
    }
    let (features, graph, truth) = scene();
    let before = stage::peak_rss_bytes();
    let options = Options { min_cluster_size: 30, min_samples: 10, epsilon: 0.15, ..Options::default() };
    let (mut seconds, mut cpu, mut instances, mut right) = (Vec::new(), Vec::new(), 0, 0);
    for _ in 0..RUNS {
        let (clock, used) = (Instant::now(), stage::cpu_seconds().unwrap_or(0.0));
        let found = group(&features, &graph, Space::Graph, &options);
        seconds.push(clock.elapsed().as_secs_f64());
        cpu.push(stage::cpu_seconds().unwrap_or(0.0) - used);
        instances = found.selected.len();
        // Gaussians whose instance is mostly theirs: the commonest thing of each instance.
        let mut votes = vec![vec![0usize; THINGS.0 * THINGS.1]; instances];
        let labelled = || found.labels.iter().zip(&truth).filter(|(l, _)| **l >= 0);
        labelled().for_each(|(&l, &t)| votes[l as usize][t as usize] += 1);
        right = votes.iter().map(|v| v.iter().max().copied().unwrap_or(0)).sum();
    }
    let median = |mut v: Vec<f64>| {
        v.sort_by(f64::total_cmp);
        v[v.len() / 2]
    };
    let report = json!({
        "gaussians": features.kept.len(), "neighbours": K, "dim": DIM, "threads": rayon::current_num_threads(),
        "runs": RUNS, "range": [seconds.iter().copied().fold(f64::INFINITY, f64::min), seconds.iter().copied().fold(0.0, f64::max)],
        "seconds": median(seconds), "cpu_seconds": median(cpu), "things": THINGS.0 * THINGS.1, "instances": instances,
        "in_their_thing": right as f64 / truth.len() as f64,
        "peak_rss_bytes": stage::peak_rss_bytes(), "rss_bytes_before": before,
    });
    let text = serde_json::to_string_pretty(&report).expect("a report is JSON") + "\n";
    eprint!("{text}");
    let out = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../out/bench");
    std::fs::create_dir_all(&out).expect("the folder can be made");
    std::fs::write(out.join("cluster-graph.json"), text).expect("the report can be written");
}
