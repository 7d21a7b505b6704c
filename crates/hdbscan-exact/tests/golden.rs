//! Labels of scikit-learn on small sets, made by scripts/make_hdbscan_golden.py, and properties of clusterings.

use hdbscan_exact::{Edge, Options, Selection, cluster, cluster_graph, spanning_tree};
use std::collections::BTreeMap;
use std::path::PathBuf;

/// Adjusted Rand index; noise (-1) counts as a class of its own.
fn ari(a: &[i32], b: &[i32]) -> f64 {
    let mut joint: BTreeMap<(i32, i32), f64> = BTreeMap::new();
    let (mut rows, mut columns): (BTreeMap<i32, f64>, BTreeMap<i32, f64>) = Default::default();
    for (&x, &y) in a.iter().zip(b) {
        *joint.entry((x, y)).or_default() += 1.0;
        *rows.entry(x).or_default() += 1.0;
        *columns.entry(y).or_default() += 1.0;
    }
    let pairs = |n: &f64| n * (n - 1.0) / 2.0;
    let (s, r, c) = (
        joint.values().map(pairs).sum::<f64>(),
        rows.values().map(pairs).sum::<f64>(),
        columns.values().map(pairs).sum::<f64>(),
    );
    let expected = r * c / pairs(&(a.len() as f64));
    if (r + c) / 2.0 == expected { 1.0 } else { (s - expected) / ((r + c) / 2.0 - expected) }
}

struct Case {
    name: String,
    points: Vec<f32>,
    dim: usize,
    options: Options,
    labels: Vec<i32>,
    least_ari: f64,
}

fn cases() -> Vec<Case> {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("testdata/golden.txt");
    let text = std::fs::read_to_string(path).unwrap();
    let mut lines = text.lines();
    let mut out = Vec::new();
    while let Some(head) = lines.next() {
        let h: Vec<&str> = head.split_whitespace().collect();
        let number = |i: usize| h[i].parse::<usize>().unwrap();
        let list = |line: &str| line.split_whitespace().map(String::from).collect::<Vec<_>>();
        let points = list(lines.next().unwrap()).iter().map(|v| v.parse().unwrap()).collect();
        let labels = list(lines.next().unwrap()).iter().map(|v| v.parse().unwrap()).collect();
        out.push(Case {
            name: h[0].into(),
            dim: number(1),
            options: Options {
                min_cluster_size: number(2),
                min_samples: number(3),
                epsilon: h[4].parse().unwrap(),
                selection: if h[5] == "leaf" { Selection::Leaf } else { Selection::ExcessOfMass },
                allow_single_cluster: h[6] == "1",
            },
            least_ari: h[7].parse().unwrap(),
            points,
            labels,
        });
    }
    out
}

#[test]
fn labels_agree_with_scikit_learn() {
    let cases = cases();
    assert!(cases.len() >= 10);
    for c in cases {
        let ours = cluster(&c.points, c.dim, &c.options);
        let index = ari(&ours.labels, &c.labels);
        eprintln!("{}: ARI {index:.4}", c.name);
        assert!(index >= c.least_ari, "{}: ARI {index}, expected at least {}", c.name, c.least_ari);
    }
}

#[test]
fn the_order_of_points_does_not_matter() {
    for c in cases().iter().filter(|c| c.least_ari >= 0.99) {
        let n = c.labels.len();
        let order: Vec<usize> = (0..n).map(|i| (i * 7919 + 13) % n).collect();
        let mut seen = order.clone();
        seen.sort_unstable();
        seen.dedup();
        if seen.len() < n {
            continue;
        }
        let shuffled: Vec<f32> =
            order.iter().flat_map(|&i| c.points[i * c.dim..(i + 1) * c.dim].iter().copied()).collect();
        let straight = cluster(&c.points, c.dim, &c.options).labels;
        let other = cluster(&shuffled, c.dim, &c.options).labels;
        let back: Vec<i32> = order.iter().map(|&i| straight[i]).collect();
        // Among edges of equal weight the order of points decides, which can move a few points at a cluster's rim.
        let index = ari(&back, &other);
        assert!(index >= 0.99, "{}: {index}", c.name);
    }
}

#[test]
fn clusters_born_below_epsilon_are_joined() {
    // Two pairs of heaps: gaps of 1 within a pair, 50 between the pairs.
    let points: Vec<f32> =
        (0..80).map(|i| (i / 20 % 2) as f32 * 1.5 + (i / 40) as f32 * 50.0 + (i % 20) as f32 * 0.01).collect();
    let o = Options { min_cluster_size: 5, min_samples: 3, selection: Selection::Leaf, ..Options::default() };
    assert!(cluster(&points, 1, &o).selected.len() >= 4);
    let joined = cluster(&points, 1, &Options { epsilon: 2.0, ..o });
    assert_eq!(joined.selected.len(), 2);
    assert!((0..40).all(|i| joined.labels[i] == joined.labels[0]) && joined.labels[79] != joined.labels[0]);
}

#[test]
fn threads_do_not_matter() {
    let c = &cases()[0];
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| cluster(&c.points, c.dim, &c.options))
    };
    assert_eq!(run(1), run(3));
}

#[test]
fn degenerate_sets_are_fine() {
    let o = Options { min_cluster_size: 3, min_samples: 3, ..Options::default() };
    assert!(cluster(&[], 2, &o).labels.is_empty());
    assert_eq!(cluster(&[1.0, 2.0], 2, &o).labels, [-1]);
    let same = cluster(&[1.0; 20], 2, &o);
    assert_eq!(same.labels.len(), 10);
    let one = cluster(&[1.0; 20], 2, &Options { allow_single_cluster: true, ..o });
    assert_eq!(one.labels, [0; 10], "equal points are one cluster where one is allowed");
    // Two heaps of equal points.
    let heaps: Vec<f32> = (0..12).map(|i| if i < 6 { 0.0 } else { 9.0 }).collect();
    let two = cluster(&heaps, 1, &o);
    assert_eq!(two.labels, [0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1]);
    assert!(two.probabilities.iter().all(|&p| p == 1.0));
}

#[test]
fn a_complete_graph_gives_the_clusters_of_the_points() {
    for c in cases().iter().filter(|c| c.least_ari >= 0.99 && c.labels.len() <= 600) {
        let core = hdbscan_exact::core_distances(&c.points, c.dim, c.options.min_samples);
        let n = c.labels.len();
        let row = |i: usize| &c.points[i * c.dim..(i + 1) * c.dim];
        let mut edges = Vec::new();
        for a in 0..n {
            for b in a + 1..n {
                let d: f64 = row(a).iter().zip(row(b)).map(|(x, y)| (f64::from(*x) - f64::from(*y)).powi(2)).sum();
                edges.push(Edge::new(a as u32, b as u32, d.sqrt().max(core[a]).max(core[b])));
            }
        }
        let graph = cluster_graph(n, &edges, &c.options);
        let points = cluster(&c.points, c.dim, &c.options);
        assert_eq!(ari(&graph.labels, &points.labels), 1.0, "{}", c.name);
        assert_eq!(spanning_tree(&c.points, c.dim, &core).len(), n - 1);
    }
}

#[test]
fn the_documentations_own_set() {
    let path =
        PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data/oracle/hdbscan_clusterable_data.npy");
    let Ok(bytes) = std::fs::read(&path) else {
        eprintln!("skipped: {} is not present", path.display());
        return;
    };
    // f8 [2309, 2], C order.
    let header = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    let points: Vec<f32> =
        bytes[header..].chunks_exact(8).map(|c| f64::from_le_bytes(c.try_into().unwrap()) as f32).collect();
    assert_eq!(points.len(), 2 * 2309);
    let o = Options { min_cluster_size: 15, min_samples: 15, ..Options::default() };
    let r = cluster(&points, 2, &o);
    let noise = r.labels.iter().filter(|&&l| l < 0).count();
    eprintln!("{} clusters, {noise} noise", r.selected.len());
    assert_eq!(r.selected.len(), 6);
}
