//! Times of a million points in six dimensions: `cargo test --release -p hdbscan-exact --test speed -- --ignored --nocapture`.

use hdbscan_exact::{Options, cluster, core_distances, spanning_tree};
use std::time::Instant;

/// `n` points around 200 centres of different spread, a tenth of them scattered, from a fixed stream of numbers.
fn blobs(n: usize, dim: usize) -> Vec<f32> {
    let mut state = 1u64;
    let mut uniform = move || {
        // splitmix64
        state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = (state ^ (state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    };
    let centres: Vec<f64> = (0..200 * dim).map(|_| uniform() * 20.0 - 10.0).collect();
    let spreads: Vec<f64> = (0..200).map(|_| 0.05 + 0.3 * uniform()).collect();
    let mut out = Vec::with_capacity(n * dim);
    for i in 0..n {
        let c = (uniform() * 200.0) as usize;
        for k in 0..dim {
            let normal = (-2.0 * (1.0 - uniform()).ln()).sqrt() * (std::f64::consts::TAU * uniform()).cos();
            let scattered = uniform() * 20.0 - 10.0;
            out.push(if i % 10 == 0 { scattered } else { centres[c * dim + k] + spreads[c] * normal } as f32);
        }
    }
    out
}

#[test]
#[ignore = "takes a minute"]
fn a_million_points() {
    for n in [125_000, 250_000, 500_000, 1_000_000] {
        let points = blobs(n, 6);
        for min_samples in [10, 30] {
            let start = Instant::now();
            let _ = core_distances(&points, 6, min_samples);
            let cores = start.elapsed().as_secs_f64();
            let start = Instant::now();
            let (edges, _) = spanning_tree(&points, 6, &vec![1; n], min_samples);
            let tree = start.elapsed().as_secs_f64();
            assert_eq!(edges.len(), n - 1);
            let start = Instant::now();
            let o = Options { min_cluster_size: 100, min_samples, ..Options::default() };
            let clusters = cluster(&points, 6, &o).selected.len();
            let all = start.elapsed().as_secs_f64();
            assert!((150..=200).contains(&clusters), "{clusters} of 200 centres");
            eprintln!(
                "{n} points, min_samples {min_samples}: core {cores:.1} s, tree {tree:.1} s, all {all:.1} s, {clusters} clusters"
            );
        }
    }
}
