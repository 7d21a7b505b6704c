//! Times HDBSCAN on a file of points: `cargo bench -p hdbscan-exact --bench cluster -- POINTS.npy [MIN_CLUSTER_SIZE]
//! [MIN_SAMPLES] [LABELS.npy]`. Prints one JSON object; scripts/bench_cluster.py puts other libraries' figures beside it.

use hdbscan_exact::{Options, cluster};
use serde_json::json;
use std::time::Instant;

fn main() {
    let mut arguments = std::env::args().skip(1).filter(|a| a != "--bench");
    let Some(file) = arguments.next() else {
        // `cargo test --benches` comes without a file: nothing to measure.
        return;
    };
    let mut number = |default: usize| arguments.next().map_or(default, |a| a.parse().expect("a number"));
    let options = Options { min_cluster_size: number(100), min_samples: number(10), ..Options::default() };
    let labels = arguments.next();
    let points = gs_io::npy::read_f32(&file).expect("points, f32 [n, d]");
    let (n, dim) = (points.shape[0], points.shape[1]);
    let clock = Instant::now();
    let found = cluster(&points.data, dim, &options);
    let seconds = clock.elapsed().as_secs_f64();
    if let Some(path) = labels {
        gs_io::npy::write_i32(path, &[n], &found.labels).expect("a place for the labels");
    }
    let peak = stage::peak_rss_bytes();
    let out = json!({"n": n, "d": dim, "seconds": seconds, "peak_rss_bytes": peak, "clusters": found.selected.len()});
    #[allow(clippy::print_stdout, reason = "the result of the program")]
    {
        println!("{out}");
    }
}
