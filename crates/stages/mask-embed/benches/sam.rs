//! SAM on photographs: the default beside every point of the grid, in one run. `cargo bench -p mask-embed --bench sam --
//! PHOTOGRAPHS MODELS OUT` takes up to 8 pictures of a folder and writes JSON.
//!
//! Each photograph goes through three settings in turn: the default; `--no-skip` (every point, each through the decoder's
//! whole graph); and every point with the default's encoder and decoder, which shows what these are worth. Recall is the
//! share of the masks that `--no-skip` chooses, at any level, that a mask of the default's meets with an IoU of 0.7. That of
//! the maps is stricter: after painting, where masks hide parts of others, and at the same level.

use artifacts::{Level, MaskMaps};
use mask_embed::Choice;
use mask_embed::automatic::{levels, propose};
use mask_embed::nms::Pixels;
use mask_embed::paint::{MapSize, paint};
use mask_embed::sam::Sam;
use onnx_models::{EngineOptions, RgbImage};
use serde_json::json;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Photographs of a run.
const PHOTOGRAPHS: usize = 8;
/// A mask is found above this IoU.
const FOUND: f64 = 0.7;
/// Longest side of the id maps, and their smallest mask, as by default.
const MAP_SIDE: usize = 800;
const MIN_AREA: usize = 200;

/// What a setting took for one photograph, in seconds, and what it made.
struct Run {
    encode: f64,
    decode: f64,
    choose: f64,
    asked: usize,
    masks: Vec<Pixels>,
    maps: MaskMaps,
}

impl Run {
    fn seconds(&self) -> f64 {
        self.encode + self.decode + self.choose
    }
}

fn run(sam: &Sam, image: &RgbImage, no_skip: bool) -> Run {
    let choice = Choice { points_per_side: 32, pred_iou: 0.7, stability: 0.7, no_skip };
    let start = Instant::now();
    let embedded = sam.encode(image).expect("the encoder runs");
    let encode = start.elapsed().as_secs_f64();
    let proposals = propose(sam, &embedded, &choice).expect("the decoder runs");
    let decode = start.elapsed().as_secs_f64() - encode;
    let chosen = levels(&proposals.masks);
    let maps = paint(&proposals, &chosen, MapSize::of(image, MAP_SIDE, MIN_AREA));
    let choose = start.elapsed().as_secs_f64() - encode - decode;
    let distinct: BTreeSet<usize> = chosen[1..].iter().flatten().copied().collect();
    let masks = distinct.into_iter().map(|i| proposals.masks[i].pixels.clone()).collect();
    Run { encode, decode, choose, asked: proposals.asked, masks, maps }
}

fn iou(both: usize, a: usize, b: usize) -> f64 {
    both as f64 / (a + b - both) as f64
}

/// How many masks of `all` are among `some`.
fn recall(some: &[Pixels], all: &[Pixels]) -> usize {
    all.iter().filter(|a| some.iter().any(|s| iou(s.overlap(a), s.area, a.area) >= FOUND)).count()
}

/// How many masks of the maps `all` at levels small, medium and large the maps `some` have, and their number.
fn recall_of_maps(some: &MaskMaps, all: &MaskMaps) -> [usize; 2] {
    let mut found = [0, 0];
    for level in &Level::SAM[1..] {
        let (mut both, mut areas) = (BTreeMap::<_, usize>::new(), [BTreeMap::<i32, usize>::new(), BTreeMap::new()]);
        for (&a, &b) in some.level(*level).iter().zip(all.level(*level)) {
            *both.entry((b, a)).or_default() += 1;
            *areas[0].entry(a).or_default() += 1;
            *areas[1].entry(b).or_default() += 1;
        }
        for (b, area) in areas[1].iter().filter(|(id, _)| **id >= 0) {
            let mut mates = both.range((*b, 0)..=(*b, i32::MAX)).map(|((_, a), n)| iou(*n, areas[0][a], *area));
            found[0] += usize::from(mates.any(|iou| iou >= FOUND));
            found[1] += 1;
        }
    }
    found
}

fn mean(runs: &[Run], of: impl Fn(&Run) -> f64) -> f64 {
    runs.iter().map(of).sum::<f64>() / runs.len() as f64
}

fn main() {
    // Cargo adds --bench.
    let arguments: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).collect();
    let [folder, models, out] = arguments.as_slice() else { panic!("expected PHOTOGRAPHS MODELS OUT: {arguments:?}") };
    let pictures = std::fs::read_dir(folder).expect("a folder of photographs").map(|e| e.expect("an entry").path());
    let read = |path: PathBuf| {
        let image = image::open(&path).ok()?.to_rgb8();
        let [width, height] = [image.width(), image.height()].map(|n| n as usize);
        Some((path, RgbImage { width, height, pixels: image.into_raw() }))
    };
    let mut pictures: Vec<(PathBuf, RgbImage)> = pictures.filter_map(read).collect();
    pictures.sort_by(|a, b| a.0.cmp(&b.0));
    let step = pictures.len().div_ceil(PHOTOGRAPHS).max(1);
    let [fast, plain] = [false, true].map(|plain| Sam::open(models, &EngineOptions::default(), plain).expect("models"));
    let mut runs: [Vec<Run>; 3] = Default::default();
    let (mut found, mut found_in_maps) = ([0, 0], [0, 0]);
    for (path, image) in pictures.iter().step_by(step) {
        let each = [(&fast, false), (&plain, true), (&fast, true)].map(|(sam, no_skip)| run(sam, image, no_skip));
        let [hit, all] = [recall(&each[0].masks, &each[1].masks), each[1].masks.len()];
        let maps = recall_of_maps(&each[0].maps, &each[1].maps);
        let seconds = each.each_ref().map(Run::seconds);
        eprintln!("{}: {seconds:.2?} s, {hit} of {all} masks", path.display());
        found = [found[0] + hit, found[1] + all];
        found_in_maps = [found_in_maps[0] + maps[0], found_in_maps[1] + maps[1]];
        runs.iter_mut().zip(each).for_each(|(all, one)| all.push(one));
    }
    let [default, full, full_fast] = &runs;
    let per_point = |runs: &[Run]| 1e3 * mean(runs, |r| r.decode) / mean(runs, |r| r.asked as f64);
    let report = json!({
        "photographs": default.len(),
        "threads": rayon::current_num_threads(),
        "seconds_per_photograph": mean(default, Run::seconds),
        "seconds_per_photograph_full_grid": mean(full, Run::seconds),
        "seconds_per_photograph_full_grid_own": mean(full_fast, Run::seconds),
        "speedup": mean(full, Run::seconds) / mean(default, Run::seconds),
        "prompts": mean(default, |r| r.asked as f64),
        "prompts_full_grid": mean(full, |r| r.asked as f64),
        "recall_iou70": found[0] as f64 / found[1] as f64,
        "recall_iou70_of_maps": found_in_maps[0] as f64 / found_in_maps[1] as f64,
        "masks_full_grid": found[1],
        "seconds": {
            "encoder": mean(default, |r| r.encode),
            "decoder": mean(default, |r| r.decode),
            "choice_and_painting": mean(default, |r| r.choose),
        },
        "milliseconds_per_prompt": { "default": per_point(default), "whole_graph": per_point(full) },
    });
    let text = serde_json::to_string_pretty(&report).expect("numbers");
    std::fs::create_dir_all(Path::new(out).parent().expect("a folder")).expect("the folder of the report");
    std::fs::write(out, text.clone() + "\n").expect("the report");
    eprintln!("{text}");
}
