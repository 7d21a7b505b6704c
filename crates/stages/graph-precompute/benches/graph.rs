//! Times the anchor graph on a file of positions: `cargo bench -p graph-precompute --bench graph -- POSITIONS.npy [RUNS]`.
//! Prints one JSON object; scripts/bench_graph.py puts another library's figures beside it.

use graph_precompute::positions::shifted;
use gs_scene::points::{KdTree, farthest_points};
use ndarray::{ArrayView2, Axis, aview1};
use serde_json::json;
use std::time::Instant;

fn column(v: &[u32]) -> ArrayView2<'_, u32> {
    aview1(v).insert_axis(Axis(1))
}

fn main() {
    let mut arguments = std::env::args().skip(1).filter(|a| a != "--bench");
    let Some(file) = arguments.next() else {
        // `cargo test --benches` comes without a file: nothing to measure.
        return;
    };
    let runs: usize = arguments.next().map_or(3, |r| r.parse().expect("a number of runs"));
    let array = gs_io::npy::read_f32(&file).expect("positions, f32 [n, 3]");
    let means: Vec<[f32; 3]> = array.rows().into_iter().map(|p| [p[0], p[1], p[2]]).collect();
    drop(array);
    let k = 16;
    let mut seconds = Vec::new();
    let mut digest = String::new();
    for _ in 0..runs.max(1) {
        let clock = Instant::now();
        let points = shifted(&means).points;
        let tree = KdTree::new(&points);
        let build = clock.elapsed().as_secs_f64();
        let clock = Instant::now();
        let sample = farthest_points(&tree, (points.len() / 10).max(1), 0);
        let fps = clock.elapsed().as_secs_f64();
        let clock = Instant::now();
        let anchors: Vec<[f32; 3]> = sample.anchors.iter().map(|&a| points[a as usize]).collect();
        let among_all = tree.nearest_to(&sample.anchors, k);
        let among_anchors = KdTree::new(&anchors).all_nearest(k);
        let knn = clock.elapsed().as_secs_f64();
        seconds.push(json!({"tree": build, "fps": fps, "knn": knn, "nearest": 0.0, "total": build + fps + knn}));
        let made = [column(&sample.anchors), column(&sample.nearest), among_all.view(), among_anchors.view()];
        let bytes =
            |v: ArrayView2<'_, u32>| gs_io::hash_bytes(&v.iter().flat_map(|i| i.to_le_bytes()).collect::<Vec<u8>>());
        digest = made.map(bytes).join(" ");
        if let Ok(folder) = std::env::var("GRAPH_OUT") {
            for (name, v) in ["anchors", "nearest", "knn", "anchor_knn"].iter().zip(made) {
                let path = format!("{folder}/{name}.npy");
                gs_io::npy::write_i32(path, &v.mapv(|i| i as i32)).expect("a folder to write to");
            }
        }
    }
    let peak = stage::peak_rss_bytes();
    eprintln!("digest {digest}");
    let out = json!({"n": means.len(), "anchors": means.len() / 10, "k": k, "runs": seconds, "peak_rss_bytes": peak});
    #[allow(clippy::print_stdout, reason = "the result of the program")]
    {
        println!("{out}");
    }
}
