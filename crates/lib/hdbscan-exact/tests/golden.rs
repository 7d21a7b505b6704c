//! Labels of scikit-learn and Python's hdbscan on small sets, made by scripts/make_hdbscan_golden.py, and properties of clusterings.

use hdbscan_exact::{
    Clustering, Edge, Metric, Options, Selection, adjusted_rand, approximate_predict, cluster, cluster_graph,
    cluster_until, core_distances,
};
use proptest::prelude::*;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::str::FromStr;
use std::sync::atomic::AtomicBool;

struct Case {
    name: String,
    points: Vec<f32>,
    dim: usize,
    options: Options,
    /// What `sklearn.cluster.HDBSCAN` says.
    labels: Vec<i32>,
    /// What scikit-learn's tree code makes of the one spanning tree.
    one_tree: Vec<i32>,
    probabilities: Vec<f32>,
    /// What Python's `hdbscan` says with an exact spanning tree.
    python: Vec<i32>,
}

fn numbers<T: FromStr>(line: Option<&str>) -> Vec<T> {
    line.unwrap().split_whitespace().map(|v| v.parse().ok().unwrap()).collect()
}

fn testdata(file: &str) -> String {
    std::fs::read_to_string(PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("testdata").join(file)).unwrap()
}

fn read(file: &str, coordinates: Option<Vec<f32>>) -> Vec<Case> {
    let text = testdata(file);
    let mut lines = text.lines();
    let mut out = Vec::new();
    while let Some(head) = lines.next() {
        let h: Vec<&str> = head.split_whitespace().collect();
        let number = |i: usize| h[i].parse::<usize>().unwrap();
        out.push(Case {
            name: h[0].into(),
            dim: number(1),
            options: Options {
                min_cluster_size: number(2),
                min_samples: number(3),
                epsilon: h[4].parse().unwrap(),
                selection: if h[5] == "leaf" { Selection::Leaf } else { Selection::ExcessOfMass },
                allow_single_cluster: h[6] == "1",
                metric: Metric::Euclidean,
            },
            points: coordinates.clone().unwrap_or_else(|| numbers(lines.next())),
            labels: numbers(lines.next()),
            one_tree: numbers(lines.next()),
            probabilities: numbers(lines.next()),
            python: numbers(lines.next()),
        });
        // Its outlier scores.
        lines.next();
    }
    out
}

fn cases() -> Vec<Case> {
    let cases = read("golden.txt", None);
    assert_eq!(cases.len(), 18);
    cases
}

/// Agreement with the libraries: exact with scikit-learn's tree code for the one spanning tree, and at least `least` (adjusted
/// Rand index) with what scikit-learn and hdbscan say on their own, where the spanning tree is another one of those that tie.
fn check(c: &Case, least: [f64; 2]) {
    let ours = cluster(&c.points, c.dim, &c.options);
    assert_eq!(ours.labels.len(), c.one_tree.len());
    assert_eq!(adjusted_rand(&ours.labels, &c.one_tree), 1.0, "{}", c.name);
    for (i, (p, expected)) in ours.probabilities.iter().zip(&c.probabilities).enumerate() {
        assert!((p - expected).abs() < 2e-5, "{}: probability of point {i} is {p}, expected {expected}", c.name);
    }
    for (library, labels, least) in [("scikit-learn", &c.labels, least[0]), ("hdbscan", &c.python, least[1])] {
        let own = adjusted_rand(&ours.labels, labels);
        eprintln!("{}: ARI {own:.4} with {library}, expected {least:.4}", c.name);
        assert!(own >= least, "{}: ARI {own} with {library}, expected {least}", c.name);
    }
}

/// Where the spanning tree is not unique, the libraries differ from themselves as soon as the points come in another order
/// (scripts/make_hdbscan_golden.py --permutations: least ARI with themselves over 50 orders). One labelling for every order
/// cannot be nearer to them than that on all; it must not be farther either.
#[test]
fn no_farther_from_the_libraries_than_they_are_from_themselves() {
    let (text, cases) = (testdata("permutations.txt"), cases());
    assert_eq!(text.lines().count(), cases.len());
    for (line, c) in text.lines().zip(&cases) {
        let fields: Vec<&str> = line.split_whitespace().collect();
        assert_eq!(fields[0], c.name);
        // Ties matter most among many small clusters of a few points, and on grids.
        let least: f64 = if c.name.contains("uniform") || c.name == "grid" { 0.92 } else { 0.98 };
        // The file has four digits.
        check(c, [1, 3].map(|library| least.max(fields[library].parse::<f64>().unwrap() - 5e-5)));
    }
}

#[test]
#[ignore = "needs ../shared/data/oracle/hdbscan_clusterable_data.npy; run make test-data"]
fn the_documentations_own_set() {
    let path =
        PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../../../shared/data/oracle/hdbscan_clusterable_data.npy");
    let bytes = std::fs::read(&path).unwrap();
    // f64 [2309, 2], C order.
    let header = 10 + usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    let points = bytes[header..].chunks_exact(8).map(|c| f64::from_le_bytes(c.try_into().unwrap()) as f32).collect();
    let case = read("clusterable.txt", Some(points)).remove(0);
    check(&case, [1.0; 2]);
}

/// With what Python's `approximate_predict` says of queries to the points of a case.
#[test]
fn predictions_agree_with_python() {
    let (text, cases) = (testdata("predict.txt"), cases());
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines.len(), 4 * 8);
    for lines in lines.chunks_exact(4) {
        let (name, queries) = (lines[0], numbers::<f32>(Some(lines[1])));
        let (labels, probabilities) = (numbers::<i32>(Some(lines[2])), numbers::<f32>(Some(lines[3])));
        let c = cases.iter().find(|c| c.name == name).unwrap();
        let clustering = cluster(&c.points, c.dim, &c.options);
        // The libraries may number the same clusters differently.
        let number: BTreeMap<i32, i32> = c.python.iter().copied().zip(clustering.labels.iter().copied()).collect();
        let number = |l: &i32| if *l < 0 { -1 } else { number[l] };
        let expected: Vec<i32> = labels.iter().map(number).collect();
        let found = approximate_predict(&c.points, c.dim, &clustering, &c.options, &queries);
        assert_eq!((found.labels.len(), found.labels.iter().filter(|&&l| l >= 0).count() > 50), (200, true), "{name}");
        let apart = found.labels.iter().zip(&expected).filter(|(a, b)| a != b).count();
        let error = found.probabilities.iter().zip(&probabilities).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        eprintln!("{name}: {apart} of 200 predictions differ from hdbscan's, probabilities by at most {error:.1e}");
        assert_eq!(found.labels, expected, "{name}");
        // Where edges tie, the trees are two of those that there are, and a point may leave them at another lambda.
        let ties = ["blobs2", "collinear"].contains(&name);
        assert!(error < if ties { 0.2 } else { 1e-6 }, "{name}: probabilities differ by {error}");
    }
}

/// Directions around four axes, of any length, some far from all.
fn directions() -> Vec<f32> {
    let wave = |k: f32| (k * 12.9898).sin() * 43758.547 % 1.0;
    let mut out = Vec::new();
    for i in 0..160 {
        let (around, length) = (if i % 10 == 9 { 2.0 } else { 0.15 }, 1.0 + 5.0 * wave(i as f32 + 0.5).abs());
        for c in 0..4 {
            let axis = if c == i % 4 { 1.0 } else { 0.0 };
            out.push(length * (axis + around * wave((4 * i + c) as f32)));
        }
    }
    out
}

/// Cosine distances of all pairs, and the graph of their mutual reachability.
#[test]
fn cosine_is_that_of_the_matrix_of_distances() {
    let (points, n) = (directions(), 160);
    let cosine = |a: usize, b: usize| {
        let [a, b] = [a, b].map(|i| &points[4 * i..4 * i + 4]);
        let dot = |x: &[f32], y: &[f32]| x.iter().zip(y).map(|(x, y)| f64::from(*x) * f64::from(*y)).sum::<f64>();
        1.0 - dot(a, b) / (dot(a, a) * dot(b, b)).sqrt()
    };
    // With core distances many edges have the same weight, and which of them are in the tree depends on the order of the points.
    for (min_samples, least) in [(1, 1.0), (5, 0.97)] {
        let options = Options { metric: Metric::Cosine, min_samples, ..Options::default() };
        let core: Vec<f64> = (0..n)
            .map(|i| {
                let mut all: Vec<f64> = (0..n).map(|j| cosine(i, j).max(0.0)).collect();
                all.sort_by(f64::total_cmp);
                all[options.min_samples - 1]
            })
            .collect();
        let edge = |a: usize, b: usize| Edge::new(a as u32, b as u32, cosine(a, b).max(core[a]).max(core[b]));
        let edges: Vec<Edge> = (0..n).flat_map(|a| (0..a).map(move |b| (a, b))).map(|(a, b)| edge(a, b)).collect();
        let (ours, expected) = (cluster(&points, 4, &options), cluster_graph(n, edges, &options));
        assert!(ours.selected.len() >= 4);
        assert!(adjusted_rand(&ours.labels, &expected.labels) >= least);
        let lambdas =
            |c: &Clustering| c.tree.edges.iter().map(|e| e.lambda).filter(|l| l.is_finite()).fold(0.0, f64::max);
        assert!((lambdas(&ours) / lambdas(&expected) - 1.0).abs() < 1e-3);
        let again = approximate_predict(&points, 4, &ours, &options, &points);
        assert!(adjusted_rand(&again.labels, &ours.labels) > 0.8);
    }
}

#[test]
fn what_is_stopped_returns_nothing() {
    let (points, options) = (directions(), Options::default());
    assert_eq!(cluster_until(&points, 4, &options, &AtomicBool::new(true)), None);
    assert_eq!(cluster_until(&points, 4, &options, &AtomicBool::new(false)), Some(cluster(&points, 4, &options)));
}

/// Clusters the points in another order and puts the result back into the first one.
fn permuted(points: &[f32], dim: usize, order: &[usize], options: &Options) -> Clustering {
    let shuffled: Vec<f32> = order.iter().flat_map(|&i| points[i * dim..(i + 1) * dim].iter().copied()).collect();
    let mut r = cluster(&shuffled, dim, options);
    let found = r.clone();
    for (to, &i) in order.iter().enumerate() {
        (r.labels[i], r.nodes[i], r.distinct[i]) = (found.labels[to], found.nodes[to], found.distinct[to]);
        (r.probabilities[i], r.outlier_scores[i]) = (found.probabilities[to], found.outlier_scores[to]);
    }
    r
}

#[test]
fn the_order_of_points_does_not_matter() {
    for c in cases() {
        let n = c.labels.len();
        let mut order: Vec<usize> = (0..n).collect();
        order.sort_by_key(|i| (i * 7919 + 13) % n);
        assert_eq!(permuted(&c.points, c.dim, &order, &c.options), cluster(&c.points, c.dim, &c.options), "{}", c.name);
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(100))]

    /// Ties included: the points lie on a grid, many at the same place.
    #[test]
    fn the_order_of_points_does_not_matter_among_ties(
        coordinates in prop::collection::vec((-6i8..6, -6i8..6), 2..120),
        by in any::<u32>(),
        min_cluster_size in 2usize..8,
        min_samples in 1usize..6,
        leaf in any::<bool>(),
        allow_single_cluster in any::<bool>(),
        epsilon in prop::sample::select(vec![0.0, 1.5]),
    ) {
        let points: Vec<f32> = coordinates.iter().flat_map(|&(x, y)| [f32::from(x), f32::from(y)]).collect();
        let selection = if leaf { Selection::Leaf } else { Selection::ExcessOfMass };
        let options = Options { min_cluster_size, min_samples, epsilon, selection, allow_single_cluster, metric: Metric::Euclidean };
        let mut order: Vec<usize> = (0..coordinates.len()).collect();
        order.sort_by_key(|&i| (i as u32 ^ by).wrapping_mul(2_654_435_761));
        let straight = cluster(&points, 2, &options);
        prop_assert_eq!(&permuted(&points, 2, &order, &options), &straight);
        // What any clustering keeps to.
        let k = straight.selected.len() as i32;
        prop_assert!(straight.labels.iter().all(|&l| (-1..k).contains(&l)));
        for (l, p) in straight.labels.iter().zip(&straight.probabilities) {
            prop_assert!((0.0..=1.0).contains(p) && (*l >= 0 || *p == 0.0));
        }
        let mut sizes = vec![0; k as usize];
        straight.labels.iter().filter(|&&l| l >= 0).for_each(|&l| sizes[l as usize] += 1);
        let root = straight.tree.points;
        prop_assert!(sizes.iter().zip(&straight.selected).all(|(&s, &c)| s >= min_cluster_size || c == root));
        // Every point leaves the tree once, and clusters lose what they hold.
        let m = straight.tree.points;
        let points_of = |edges: &[hdbscan_exact::CondensedEdge]| edges.iter().filter(|e| e.child < m).map(|e| e.size).sum::<u32>();
        prop_assert_eq!(points_of(&straight.tree.edges) as usize, coordinates.len());
        for e in straight.tree.edges.iter().filter(|e| e.child >= m) {
            let held: u32 = straight.tree.edges.iter().filter(|x| x.parent == e.child).map(|x| x.size).sum();
            prop_assert_eq!(held, e.size);
            // As many points name a cluster or one below it as smallest as it holds.
            let below = |node: u32| {
                let mut at = node;
                while at > e.child {
                    at = straight.tree.edges.iter().find(|x| x.child == at).map_or(0, |x| x.parent);
                }
                at == e.child
            };
            prop_assert_eq!(straight.nodes.iter().filter(|&&n| below(n)).count() as u32, e.size);
        }
    }
}

/// `n` points on a line, densest in the middle, so that they are one leaf of the hierarchy.
fn heap(centre: f32, n: usize) -> impl Iterator<Item = f32> {
    (0..n).map(move |i| {
        let t = i as f32 - n as f32 / 2.0 + 0.25;
        centre + 0.002 * t * t.abs()
    })
}

#[test]
fn clusters_born_below_epsilon_are_joined() {
    // Two pairs of heaps: gaps of 1.5 within a pair, 50 between the pairs.
    let points: Vec<f32> = [0.0, 1.5, 50.0, 51.5].into_iter().flat_map(|c| heap(c, 20)).collect();
    let o = Options { min_cluster_size: 5, min_samples: 3, selection: Selection::Leaf, ..Options::default() };
    let apart = cluster(&points, 1, &o);
    assert_eq!(apart.selected.len(), 4);
    assert!((0..80).all(|i| apart.labels[i] == apart.labels[i / 20 * 20 + 10]), "{:?}", apart.labels);
    for selection in [Selection::Leaf, Selection::ExcessOfMass] {
        let joined = cluster(&points, 1, &Options { epsilon: 2.0, selection, ..o });
        assert_eq!(joined.selected.len(), 2);
        assert!(
            (0..80).all(|i| joined.labels[i] == joined.labels[i / 40 * 40]) && joined.labels[79] != joined.labels[0]
        );
    }
}

#[test]
fn lambdas_of_two_pairs_are_those_of_paper_and_pencil() {
    // Gaps 1 and 2 within the pairs, 7 between them; core distances are the gaps.
    let o = Options { min_cluster_size: 2, min_samples: 2, ..Options::default() };
    let r = cluster(&[0.0, 1.0, 8.0, 10.0], 1, &o);
    assert_eq!(r.labels, [0, 0, 1, 1]);
    let mut found: Vec<_> = r.tree.edges.iter().map(|e| (e.parent, e.child, e.lambda, e.size)).collect();
    found.sort_by_key(|f| (f.0, f.1));
    let (first, second) = (r.selected[0], r.selected[1]);
    let expected = [
        (4, 5, 1.0 / 7.0, 2),
        (4, 6, 1.0 / 7.0, 2),
        (first, 0, 1.0, 1),
        (first, 1, 1.0, 1),
        (second, 2, 0.5, 1),
        (second, 3, 0.5, 1),
    ];
    assert_eq!(found, expected);
    assert_eq!(r.probabilities, [1.0; 4]);
}

#[test]
fn degenerate_sets_are_fine() {
    let o = Options { min_cluster_size: 3, min_samples: 3, ..Options::default() };
    assert!(cluster(&[], 2, &o).labels.is_empty());
    assert_eq!(cluster(&[1.0, 2.0], 2, &o).labels, [-1]);
    // Equal points: no hierarchy above them, so one cluster where one is allowed and noise where not.
    assert_eq!(cluster(&[1.0; 20], 2, &o).labels, [-1; 10]);
    assert_eq!(cluster(&[1.0; 20], 2, &Options { allow_single_cluster: true, ..o }).labels, [0; 10]);
    // Two heaps of equal points.
    let heaps: Vec<f32> = (0..12).map(|i| if i < 6 { 0.0 } else { 9.0 }).collect();
    let two = cluster(&heaps, 1, &o);
    assert_eq!(two.labels, [0, 0, 0, 0, 0, 0, 1, 1, 1, 1, 1, 1]);
    assert!(two.probabilities.iter().all(|&p| p == 1.0));
    // Zero and minus zero are one place; the largest numbers have distances.
    assert_eq!(core_distances(&[0.0, -0.0, 1.0], 1, 2), [0.0, 0.0, 1.0]);
    let far = cluster(&[-3e38, -3e38, -3e38, 3e38, 3e38, 3e38], 1, &o);
    assert_eq!(far.labels, [0, 0, 0, 1, 1, 1]);
}

#[test]
fn a_complete_graph_gives_the_clusters_of_the_points() {
    for c in cases().iter().filter(|c| c.labels.len() <= 500 && !["grid", "duplicates"].contains(&c.name.as_str())) {
        let n = c.labels.len();
        let row = |i: usize| &c.points[i * c.dim..(i + 1) * c.dim];
        // A graph's points are the caller's: named lexicographically here, as the points are.
        let mut order: Vec<usize> = (0..n).collect();
        order.sort_by(|&a, &b| row(a).partial_cmp(row(b)).unwrap());
        let core = core_distances(&c.points, c.dim, c.options.min_samples);
        let mut edges = Vec::new();
        for a in 0..n {
            for b in a + 1..n {
                let (i, j) = (order[a], order[b]);
                let d: f64 = row(i).iter().zip(row(j)).map(|(x, y)| (f64::from(*x) - f64::from(*y)).powi(2)).sum();
                edges.push(Edge::new(a as u32, b as u32, d.sqrt().max(core[i]).max(core[j])));
            }
        }
        let graph = cluster_graph(n, &edges[..], &c.options);
        let points = cluster(&c.points, c.dim, &c.options);
        let expected: Vec<i32> = order.iter().map(|&i| points.labels[i]).collect();
        assert_eq!(graph.labels, expected, "{}", c.name);
    }
}

#[test]
fn parts_of_a_graph_are_apart_however_near_they_are() {
    // Two chains of ten points and a lone pair, without an edge between them.
    let chain = |from: u32| (from..from + 9).map(|i| Edge::new(i, i + 1, 0.5));
    let edges: Vec<Edge> = chain(0).chain(chain(10)).chain([Edge::new(20, 21, 0.1)]).collect();
    let o = Options { min_cluster_size: 5, ..Options::default() };
    for options in [o, Options { epsilon: 100.0, ..o }, Options { selection: Selection::Leaf, ..o }] {
        let r = cluster_graph(22, &edges[..], &options);
        assert_eq!(r.selected.len(), 2);
        assert!(
            r.labels[..10].iter().all(|&l| l == r.labels[0]) && r.labels[10..20].iter().all(|&l| l == r.labels[10])
        );
        assert_ne!(r.labels[0], r.labels[10]);
        assert_eq!(r.labels[20..], [-1, -1]);
        assert!(r.tree.edges.iter().all(|e| e.child < 22 || e.lambda == 0.0));
    }
    assert!(cluster_graph(0, [], &o).labels.is_empty());
    assert_eq!(cluster_graph(3, [], &o).labels, [-1; 3]);
}

#[test]
fn outlier_scores_are_those_of_paper_and_pencil() {
    // Gaps 1, 1, 2 and 6 within a heap, then a pair far off: the core distances (2 samples) are the gaps to the nearest.
    let o = Options { min_cluster_size: 2, min_samples: 2, ..Options::default() };
    let r = cluster(&[0.0, 1.0, 2.0, 4.0, 10.0, 100.0, 101.0], 1, &o);
    // 0, 1, 2 leave at distance 1, 4 at 2, 10 at 6; the pair at 1.
    let expected = [0.0, 0.0, 0.0, 0.5, 1.0 - 1.0 / 6.0, 0.0, 0.0];
    assert!(
        r.outlier_scores.iter().zip(expected).all(|(a, b): (&f32, f32)| (a - b).abs() < 1e-6),
        "{:?}",
        r.outlier_scores
    );
    assert_eq!(cluster(&[1.0; 5], 1, &o).outlier_scores, [0.0; 5]);
}

#[test]
fn predictions_without_queries_or_points() {
    let o = Options::default();
    let points = [0.0, 1.0, 2.0];
    assert!(approximate_predict(&points, 1, &cluster(&points, 1, &o), &o, &[]).labels.is_empty());
    assert_eq!(approximate_predict(&[], 1, &cluster(&[], 1, &o), &o, &[1.0]).labels, [-1]);
}

/// A part of the graph that nothing joins to the rest is a root of its own: it is not the cluster where it divides.
#[test]
fn a_part_that_divides_gives_way_to_what_it_divides_into() {
    let chain = |from: u32, to: u32| (from..to - 1).map(|a| Edge::new(a, a + 1, 1.0));
    // Two chains with a bridge hardly longer than their links, and an island.
    let edges: Vec<Edge> =
        chain(0, 40).chain(chain(40, 80)).chain(chain(80, 90)).chain([Edge::new(39, 40, 1.2)]).collect();
    let options = Options { min_cluster_size: 5, ..Options::default() };
    let labels = cluster_graph(90, &edges[..], &options).labels;
    assert!(labels.iter().all(|l| *l >= 0), "{labels:?}");
    let of = |range: std::ops::Range<usize>| labels[range].iter().copied().collect::<std::collections::BTreeSet<_>>();
    assert!([of(0..40), of(40..80), of(80..90)].iter().all(|l| l.len() == 1), "{labels:?}");
    assert_eq!(of(0..90).len(), 3, "{labels:?}");
}
