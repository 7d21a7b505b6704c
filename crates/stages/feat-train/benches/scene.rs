//! The scene of the benchmark: footprints at full size without a rasteriser.
//!
//! Gaussians lie on one bumpy surface, 1000 x 1000 of them at jittered places, in shuffled order, as a PLY has them. A
//! tenth are anchors, shuffled too (farthest point sampling orders them so that followers lie far apart), each serving
//! the ten Gaussians around it. A view is a window of a fifth of the surface, 447 Gaussians wide, so what it sees is
//! contiguous on the surface. It is cut into 60 to 100 masks: a grid of cells with jittered borders, different in every
//! view, as masks of inconsistent granularity are. A Gaussian belongs to the mask it lies in, and within two Gaussians of
//! a border, where its splat reaches over, to the masks of both sides (three or four at a corner): 1.2 entries a Gaussian.
//! A mask's weights sum to about 0.9, the mean alpha of its pixels; the 750,000 pixels of a view are shared out by area.

use artifacts::{FootprintsBuilder, Graph, Row, ScratchEntries, role};
use gs_io::{Provenance, hash_file};
use gs_scene::{Gaussians, ply};
use ndarray::{Array2, Axis};
use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use stage::RunRecord;
use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;

/// Neighbours of an anchor.
const K: usize = 16;
/// Gaussians of an anchor: a block so high and so wide.
const BLOCK: (usize, usize) = (2, 5);
/// Pixels of a view.
const PIXELS: f64 = 1000.0 * 750.0;
/// The files of a scene.
const FILES: [&str; 3] = ["geometry.ply", "graph.safetensors", "footprints.safetensors"];

/// Writes a scene of `side` x `side` Gaussians (a multiple of ten) and `views` views into `folder`.
pub fn write(side: usize, views: usize, folder: &Path) {
    let [geometry, graph, footprints] = FILES.map(|name| folder.join(name));
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let n = side * side;
    let mut shuffled = |count: usize| {
        let mut order: Vec<u32> = (0..count as u32).collect();
        order.shuffle(&mut rng);
        order
    };
    let columns = side / BLOCK.1;
    let m = side / BLOCK.0 * columns;
    let (index, anchor_id) = (shuffled(n), shuffled(m));
    let mut gaussians = Gaussians {
        means: vec![[0.0; 3]; n],
        log_scales: vec![[0.0; 3]; n],
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; n],
        opacity_logits: vec![2.0; n],
        sh: (0..3 * n).map(|_| rng.random_range(-1.0..1.0)).collect(),
        sh_degree: 0,
        ..Gaussians::default()
    };
    let (mut nearest_anchor, mut anchors) = (vec![0u32; n], vec![0u32; m]);
    for (place, &i) in index.iter().enumerate() {
        let (y, x) = (place / side, place % side);
        let (u, v) = (x as f32 + rng.random_range(-0.4..0.4), y as f32 + rng.random_range(-0.4..0.4));
        gaussians.means[i as usize] = [u, v, 20.0 * (u / 31.0).sin() * (v / 47.0).cos()];
        let anchor = anchor_id[y / BLOCK.0 * columns + x / BLOCK.1];
        nearest_anchor[i as usize] = anchor;
        if (y % BLOCK.0, x % BLOCK.1) == (0, BLOCK.1 / 2) {
            anchors[anchor as usize] = i;
        }
    }
    ply::write_gaussians(&geometry, &gaussians, &[]).expect("room for the geometry");
    drop(gaussians);
    let gaussian_knn = neighbours(&index, side, (1, 1));
    let graph_of_all = Graph {
        kept: (0..n as u32).collect(),
        knn: gaussian_knn.select(Axis(0), &anchors.iter().map(|&a| a as usize).collect::<Vec<_>>()),
        anchor_knn: neighbours(&anchor_id, columns, BLOCK),
        anchors,
        nearest_anchor,
        gaussian_knn,
        seen_views: vec![1; n],
        seen_weight: vec![1.0; n],
    };
    let inputs = BTreeMap::from([(role::GEOMETRY.to_string(), hash_file(&geometry).expect("just written"))]);
    let provenance = Provenance { inputs, ..Provenance::default() };
    graph_of_all.write(graph, provenance.clone()).expect("room for the graph");
    write_footprints(&index, side, views, &footprints, provenance);
}

/// The K nearest of each on a grid that is `width` wide and has this spacing; `ids` names its places row by row.
fn neighbours(ids: &[u32], width: usize, spacing: (usize, usize)) -> Array2<u32> {
    let mut steps: Vec<(i64, i64)> = (-9..=9).flat_map(|dy| (-9..=9).map(move |dx| (dy, dx))).collect();
    steps.sort_by_key(|(dy, dx)| (dy * spacing.0 as i64).pow(2) + (dx * spacing.1 as i64).pow(2));
    let (height, across) = ((ids.len() / width) as i64, width as i64);
    let mut out = Array2::zeros((ids.len(), K));
    for (place, &id) in ids.iter().enumerate() {
        let (y, x) = (place as i64 / across, place as i64 % across);
        let inside = |&(dy, dx): &(i64, i64)| {
            let within = (0..height).contains(&(y + dy)) && (0..across).contains(&(x + dx));
            within.then(|| ids[((y + dy) * across + x + dx) as usize])
        };
        let near = steps[1..].iter().filter_map(inside);
        out.row_mut(id as usize).iter_mut().zip(near).for_each(|(to, j)| *to = j);
    }
    out
}

/// Runs `feat-train` on the scene in `folder`, and gives the record of the run.
pub fn run(folder: &Path, options: &[&str]) -> RunRecord {
    let out = folder.join("features.safetensors");
    let mut command = Command::new(env!("CARGO_BIN_EXE_feat-train"));
    command.args(options).arg("--quiet").arg("--overwrite").arg("--out").arg(&out);
    for (option, file) in ["--geometry", "--graph", "--footprints"].iter().zip(FILES) {
        command.arg(option).arg(folder.join(file));
    }
    assert!(command.status().expect("the program starts").success());
    RunRecord::read(&out).expect("the program writes a record")
}

/// Masks and entries of all views, which are in memory one at a time. `index` names the Gaussians of the surface row by row.
fn write_footprints(index: &[u32], side: usize, views: usize, path: &Path, provenance: Provenance) {
    let kept = (0..index.len() as u32).collect();
    let mut builder = FootprintsBuilder { kept, row_ptr: vec![0], ..FootprintsBuilder::default() };
    let mut scratch = ScratchEntries::beside(path).expect("room for footprints");
    for view in 0..views as u32 {
        builder.views.push(view.to_string());
        let masks = masks(index, side, u64::from(view));
        let total: f64 = masks.iter().flatten().map(|e| f64::from(e.1)).sum();
        for (mask, mut entries) in (0..).zip(masks) {
            let sum: f64 = entries.iter().map(|e| f64::from(e.1)).sum();
            let pixels = (PIXELS * sum / total).round() as u32;
            entries.sort_unstable_by_key(|e| e.0);
            for (i, w) in entries {
                let share = 0.9 * f64::from(w) / sum;
                scratch.push(i, (share * f64::from(pixels)) as f32).expect("room for footprints");
            }
            builder.row_ptr.push(scratch.count);
            builder.rows.push(Row { view, level: 3, mask, pixels, gated: pixels, alpha: 0.9 });
        }
    }
    builder.write_with(scratch, path, provenance).expect("room for footprints");
}

/// The Gaussians of each mask of a view, with how much of them it shows.
fn masks(index: &[u32], side: usize, view: u64) -> Vec<Vec<(u32, f32)>> {
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    rng.set_stream(view);
    let width = (side as f64 * 0.2f64.sqrt()) as usize;
    let corner = (rng.random_range(0..=side - width), rng.random_range(0..=side - width));
    let (count, cells) = grid(width, &mut rng);
    let mut out = vec![Vec::new(); count];
    let last = width - 1;
    for y in 0..width {
        for x in 0..width {
            let own = cells[y * width + x];
            let reach = |(y, x): (usize, usize)| cells[y.min(last) * width + x.min(last)];
            let mut mine = vec![own];
            for other in [(y.saturating_sub(2), x), (y + 2, x), (y, x.saturating_sub(2)), (y, x + 2)].map(reach) {
                if !mine.contains(&other) {
                    mine.push(other);
                }
            }
            for k in mine {
                let w = rng.random_range(0.2f32..1.0) * if k == own { 1.0 } else { 0.2 };
                out[usize::from(k)].push((index[(y + corner.0) * side + x + corner.1], w));
            }
        }
    }
    out
}

/// 60 to 100 cells with jittered borders: their number, and the cell of each place of a window.
fn grid(width: usize, rng: &mut ChaCha8Rng) -> (usize, Vec<u16>) {
    let masks = rng.random_range(60..=100usize);
    let rows = (masks as f64).sqrt() as usize;
    // Each row of cells has as many as make up the number of masks.
    let mut cuts = |parts: usize| -> Vec<usize> {
        let step = width as f64 / parts as f64;
        let inner = (1..parts).map(|p| ((p as f64 + rng.random_range(-0.3..0.3)) * step) as usize);
        std::iter::once(0).chain(inner.collect::<Vec<_>>()).chain([width]).collect()
    };
    let row_cuts = cuts(rows);
    let cells: Vec<Vec<usize>> = (0..rows).map(|r| cuts((r + 1) * masks / rows - r * masks / rows)).collect();
    let cell_of = |y: usize, x: usize| -> u16 {
        let r = row_cuts.partition_point(|&c| c <= y) - 1;
        (r * masks / rows + cells[r].partition_point(|&c| c <= x) - 1) as u16
    };
    (masks, (0..width * width).map(|i| cell_of(i / width, i % width)).collect())
}
