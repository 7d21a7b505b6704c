//! Small cases beside the crate `hdbscan`, whose quadratic algorithm shares no code with ours.

use hdbscan::{Hdbscan, HdbscanHyperParams};
use hdbscan_exact::{Options, cluster};
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::BTreeMap;

/// Whether two labelings are the same partition with the same noise.
fn same_partition(a: &[i32], b: &[i32]) -> bool {
    let (mut forth, mut back) = (BTreeMap::from([(-1, -1)]), BTreeMap::from([(-1, -1)]));
    a.iter().zip(b).all(|(&x, &y)| *forth.entry(x).or_insert(y) == y && *back.entry(y).or_insert(x) == x)
}

#[test]
fn clusters_are_those_of_the_quadratic_crate() {
    for (seed, dim, min_cluster_size, min_samples) in [(0, 2, 8, 4), (1, 3, 10, 5), (2, 6, 15, 10), (3, 16, 12, 6)] {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let centers: Vec<f32> = (0..4 * dim).map(|_| rng.random_range(-6.0..6.0)).collect();
        // Continuous coordinates: no two distances tie, and the spanning tree is unique.
        let points: Vec<f32> = (0..400)
            .flat_map(|i| (0..dim).map(move |c| (i, c)))
            .map(|(i, c)| match i % 5 {
                4 => rng.random_range(-8.0f32..8.0),
                blob => centers[blob * dim + c] + rng.random_range(-0.7..0.7),
            })
            .collect();
        let ours = cluster(&points, dim, &Options { min_cluster_size, min_samples, ..Options::default() });
        let rows: Vec<Vec<f64>> = points.chunks_exact(dim).map(|p| p.iter().map(|&v| f64::from(v)).collect()).collect();
        let parameters =
            HdbscanHyperParams::builder().min_cluster_size(min_cluster_size).min_samples(min_samples).build();
        let theirs = Hdbscan::new(&rows, parameters).cluster().unwrap();
        let count = ours.labels.iter().max().unwrap() + 1;
        assert!(count >= 3, "{dim} dimensions: {count} clusters tell too little");
        // The crate differs on which side of a cluster's border single points fall, where scikit-learn agrees with ours (golden.rs).
        let both: Vec<usize> = (0..400).filter(|&i| (ours.labels[i] < 0) == (theirs[i] < 0)).collect();
        assert!(both.len() >= 398, "{dim} dimensions: {} points are noise in one only", 400 - both.len());
        let of = |labels: &[i32]| both.iter().map(|&i| labels[i]).collect::<Vec<_>>();
        assert!(same_partition(&of(&ours.labels), &of(&theirs)), "{dim} dimensions");
    }
}
