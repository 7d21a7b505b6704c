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
use feat_train::contrastive::context::Context;
use feat_train::contrastive::masks::MaskSet;
use feat_train::options::Neighbours;
use gs_io::{Provenance, hash_file};
use gs_scene::{Gaussians, ply};
use rand::seq::SliceRandom;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rayon::prelude::*;
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

/// The scene without its views.
pub struct Scene {
    /// The graph.
    pub graph: Graph,
    /// Colours.
    pub colors: Vec<[f32; 3]>,
    /// Centres.
    pub positions: Vec<[f32; 3]>,
    /// Index of the Gaussian at each place of the surface, row by row.
    index: Vec<u32>,
    side: usize,
}

/// Makes the surface and its graph, of `side` x `side` Gaussians; `side` is a multiple of ten.
pub fn scene(side: usize) -> Scene {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let n = side * side;
    let shuffled = |count: usize, rng: &mut ChaCha8Rng| {
        let mut order: Vec<u32> = (0..count as u32).collect();
        order.shuffle(rng);
        order
    };
    let index = shuffled(n, &mut rng);
    let (rows, columns) = (side / BLOCK.0, side / BLOCK.1);
    let m = rows * columns;
    let anchor_id = shuffled(m, &mut rng);
    let mut positions = vec![[0.0f32; 3]; n];
    let mut colors = vec![[0.0f32; 3]; n];
    let mut nearest_anchor = vec![0u32; n];
    let mut anchors = vec![0u32; m];
    for y in 0..side {
        for x in 0..side {
            let i = index[y * side + x] as usize;
            let (u, v) = (x as f32 + rng.random_range(-0.4..0.4), y as f32 + rng.random_range(-0.4..0.4));
            positions[i] = [u, v, 20.0 * (u / 31.0).sin() * (v / 47.0).cos()];
            colors[i] = std::array::from_fn(|c| 0.5 + 0.3 * ((u + v) / (20.0 + 9.0 * c as f32)).sin())
                .map(|c: f32| c + rng.random_range(-0.1..0.1));
            let block = y / BLOCK.0 * columns + x / BLOCK.1;
            nearest_anchor[i] = anchor_id[block];
            if (y % BLOCK.0, x % BLOCK.1) == (0, BLOCK.1 / 2) {
                anchors[anchor_id[block] as usize] = i as u32;
            }
        }
    }
    // The K nearest of the given steps from each place of a grid of `height` x `width`.
    let near = |steps: &[(i64, i64)], y: usize, x: usize, height: usize, width: usize| -> Vec<usize> {
        let inside = |(dy, dx): &(i64, i64)| {
            let (y, x) = (y as i64 + dy, x as i64 + dx);
            ((0..height as i64).contains(&y) && (0..width as i64).contains(&x))
                .then_some(y as usize * width + x as usize)
        };
        steps[1..].iter().filter_map(inside).take(K).collect()
    };
    let (one, block) = (steps((1, 1)), steps(BLOCK));
    let (mut knn, mut anchor_knn) = (vec![0u32; m * K], vec![0u32; m * K]);
    let lists: Vec<(Vec<usize>, Vec<usize>)> = (0..m)
        .into_par_iter()
        .map(|b| {
            let (y, x) = (b / columns, b % columns);
            let at = (y * BLOCK.0, x * BLOCK.1 + BLOCK.1 / 2);
            (near(&one, at.0, at.1, side, side), near(&block, y, x, rows, columns))
        })
        .collect();
    for (b, (gaussians, blocks)) in lists.iter().enumerate() {
        let row = anchor_id[b] as usize * K;
        for j in 0..K {
            knn[row + j] = index[gaussians[j]];
            anchor_knn[row + j] = anchor_id[blocks[j]];
        }
    }
    let mut gaussian_knn = vec![0u32; n * K];
    for place in 0..n {
        let row = index[place] as usize * K;
        for (j, other) in near(&one, place / side, place % side, side, side).into_iter().enumerate() {
            gaussian_knn[row + j] = index[other];
        }
    }
    let graph = Graph {
        kept: (0..n as u32).collect(),
        anchors,
        knn,
        anchor_knn,
        nearest_anchor,
        gaussian_knn,
        k: K,
        gaussian_k: K,
        seen_views: vec![1; n],
        seen_weight: vec![1.0; n],
    };
    Scene { graph, colors, positions, index, side }
}

/// Steps on a grid of the given spacing, nearest first.
fn steps(spacing: (usize, usize)) -> Vec<(i64, i64)> {
    let mut steps: Vec<(i64, i64)> = (-9..=9).flat_map(|dy| (-9..=9).map(move |dx| (dy, dx))).collect();
    steps.sort_by_key(|(dy, dx)| (dy * spacing.0 as i64).pow(2) + (dx * spacing.1 as i64).pow(2));
    steps
}

impl Scene {
    /// The graph in the order of training.
    pub fn context(&self) -> Context {
        Context::new(&self.graph, &self.colors, &self.positions, Neighbours::Gaussians, true)
    }

    /// The masks of `count` views.
    pub fn views(&self, context: &Context, count: usize) -> Vec<MaskSet> {
        let mut place = vec![0u32; context.order.len()];
        for (p, &i) in context.order.iter().enumerate() {
            place[i as usize] = p as u32;
        }
        let view = |v: usize| {
            let (mut entries, pixels) = self.entries(v as u64);
            entries.iter_mut().for_each(|e| e.0 = place[e.0 as usize]);
            MaskSet::from_entries((0..pixels.len() as u32).collect(), pixels, entries, context)
        };
        (0..count).map(view).collect()
    }

    /// Runs `feat-train` on the scene with `views` views, as files in `folder`, and gives the record of the run.
    pub fn run(&self, views: usize, options: &[&str], folder: &Path) -> RunRecord {
        let file = |name: &str| folder.join(format!("scene-{name}"));
        let (geometry, graph, footprints) =
            (file("geometry.ply"), file("graph.safetensors"), file("footprints.safetensors"));
        let n = self.positions.len();
        let gaussians = Gaussians {
            means: self.positions.clone(),
            log_scales: vec![[0.0; 3]; n],
            rotations: vec![[1.0, 0.0, 0.0, 0.0]; n],
            opacity_logits: vec![2.0; n],
            sh: vec![0.0; 3 * n],
            sh_degree: 0,
        };
        ply::write_gaussians(&geometry, &gaussians, &[]).expect("room for the geometry");
        drop(gaussians);
        let inputs = BTreeMap::from([(role::GEOMETRY.to_string(), hash_file(&geometry).expect("just written"))]);
        let provenance = Provenance { inputs, ..Provenance::default() };
        self.graph.write(&graph, provenance.clone()).expect("room for the graph");
        self.write_footprints(views, &footprints, provenance);
        let out = file("features.safetensors");
        let mut command = Command::new(env!("CARGO_BIN_EXE_feat-train"));
        command.args(options).arg("--quiet").arg("--overwrite").arg("--out").arg(&out);
        for (option, file) in [("--geometry", &geometry), ("--graph", &graph), ("--footprints", &footprints)] {
            command.arg(option).arg(file);
        }
        assert!(command.status().expect("the program starts").success());
        let record = RunRecord::read(&out).expect("the program writes a record");
        for file in [geometry, graph, footprints, out] {
            std::fs::remove_file(file).expect("just written");
        }
        record
    }

    /// Masks and entries of all views, which are in memory one at a time.
    fn write_footprints(&self, views: usize, path: &Path, provenance: Provenance) {
        let mut builder =
            FootprintsBuilder { kept: self.graph.kept.clone(), row_ptr: vec![0], ..FootprintsBuilder::default() };
        let mut scratch = ScratchEntries::beside(path).expect("room for footprints");
        for v in 0..views {
            builder.views.push(v.to_string());
            let (mut entries, pixels) = self.entries(v as u64);
            entries.sort_unstable_by_key(|e| (e.1, e.0));
            let mut entries = entries.into_iter().peekable();
            for (k, pixels) in pixels.into_iter().enumerate() {
                while let Some((i, _, w)) = entries.next_if(|e| usize::from(e.1) == k) {
                    scratch.push(i, w * pixels as f32).expect("room for footprints");
                }
                builder.row_ptr.push(scratch.count);
                let pixels = pixels as u32;
                builder.rows.push(Row { view: v as u32, level: 3, mask: k as u32, pixels, gated: pixels, alpha: 0.9 });
            }
        }
        builder.write_with(scratch, path, provenance).expect("room for footprints");
    }

    /// Gaussian, mask and weight, as a share of the mask, of all entries of a view, and the pixels of its masks.
    fn entries(&self, v: u64) -> (Vec<(u32, u16, f32)>, Vec<f64>) {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        rng.set_stream(v);
        let side = self.side;
        let width = (side as f64 * 0.2f64.sqrt()) as usize;
        let corner = (rng.random_range(0..=side - width), rng.random_range(0..=side - width));
        let (masks, cells) = grid(width, &mut rng);
        let cell_of = |y: usize, x: usize| cells[y * width + x];
        let mut entries: Vec<(u32, u16, f32)> = Vec::with_capacity(width * width * 5 / 4);
        let mut sum = vec![0.0f64; masks];
        let last = width - 1;
        for y in 0..width {
            for x in 0..width {
                let at = self.index[(y + corner.0) * side + x + corner.1];
                let own = cell_of(y, x);
                let reach = |dy: i64, dx: i64| {
                    let clamp = |a: usize, d: i64| (a as i64 + d).clamp(0, last as i64) as usize;
                    cell_of(clamp(y, dy), clamp(x, dx))
                };
                let mut mine = vec![own];
                for other in [reach(-2, 0), reach(2, 0), reach(0, -2), reach(0, 2)] {
                    if !mine.contains(&other) {
                        mine.push(other);
                    }
                }
                for k in mine {
                    let w = rng.random_range(0.2f32..1.0) * if k == own { 1.0 } else { 0.2 };
                    sum[k as usize] += f64::from(w);
                    entries.push((at, k, w));
                }
            }
        }
        entries.iter_mut().for_each(|e| e.2 = (0.9 * f64::from(e.2) / sum[e.1 as usize]) as f32);
        let total: f64 = sum.iter().sum();
        (entries, sum.iter().map(|s| (PIXELS * s / total).round()).collect())
    }
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
