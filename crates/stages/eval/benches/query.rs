//! How long a query takes once everything is loaded, without the text encoder: `cargo bench -p eval --bench query --
//! --out FILE`. Medians over texts; the reference beside it scans labels and descriptors anew for every query, as a script
//! does.

use artifacts::{Instances, flat};
use eval::Asker;
use ndarray::Array2;
use query::{Granules, Index, Selection};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::time::Instant;

const GAUSSIANS: usize = 1_000_000;
const INSTANCES: usize = 500;
const DIM: usize = 512;
const TEXTS: usize = 101;
/// What a query may take, without the encoder.
const LIMIT_SECONDS: f64 = 0.05;

/// Seconds that each item takes, in rising order.
fn times<T>(items: &[T], mut run: impl FnMut(&T)) -> Vec<f64> {
    let one = |item: &T| {
        let started = Instant::now();
        run(item);
        started.elapsed().as_secs_f64()
    };
    let mut all: Vec<f64> = items.iter().map(one).collect();
    all.sort_by(f64::total_cmp);
    all
}

fn median(times: &[f64]) -> f64 {
    times[times.len() / 2]
}

fn unit(rng: &mut ChaCha8Rng) -> Vec<f32> {
    let v: Vec<f32> = (0..DIM).map(|_| rng.random::<f32>() - 0.5).collect();
    let norm = v.iter().map(|x| x * x).sum::<f32>().sqrt();
    v.into_iter().map(|x| x / norm).collect()
}

fn main() {
    let mut rng = ChaCha8Rng::seed_from_u64(0);
    let instances = Instances {
        label: (0..GAUSSIANS).map(|_| rng.random_range(-1..INSTANCES as i32)).collect(),
        descriptor: Array2::from_shape_vec((INSTANCES, DIM), (0..INSTANCES).flat_map(|_| unit(&mut rng)).collect())
            .expect("DIM of each"),
        support: vec![5; INSTANCES],
        score: vec![0.5; INSTANCES],
        count: vec![(GAUSSIANS / INSTANCES) as u32; INSTANCES],
        centroid: vec![[0.0; 3]; INSTANCES],
        bbox_min: vec![[0.0; 3]; INSTANCES],
        bbox_max: vec![[0.0; 3]; INSTANCES],
        ..Instances::default()
    };
    let texts: Vec<Vec<f32>> = (0..TEXTS).map(|_| unit(&mut rng)).collect();
    let started = Instant::now();
    let index = Index::new(&instances);
    let load = started.elapsed().as_secs_f64();
    let selection = Selection::new(None, None, 1);
    let mut asker = Asker {
        index,
        source: None,
        templates: Vec::new(),
        negatives: Vec::new(),
        selection,
        join: None,
        granules: Granules::new(&instances),
        any: false,
        always: false,
        by_chance: None,
    };
    let ask = |asker: &Asker<'_>| times(&texts, |text| assert!(!asker.answer(text).gaussians.is_empty()));
    let best = ask(&asker);
    asker.selection = Selection::new(Some(10), None, 1);
    let top10 = ask(&asker);
    asker.negatives = texts[..4].to_vec();
    let relevancy = ask(&asker);
    let segmentation = times(&[()], |()| {
        assert_eq!(eval::divide(&asker.index, &texts[..20], &[], None).0.len(), GAUSSIANS);
    });
    let scan = times(&texts[..21], |text| {
        let cosine = |d: &[f32]| d.iter().zip(text).map(|(a, b)| a * b).sum::<f32>();
        let scores: Vec<f32> = instances.descriptor.rows().into_iter().map(|d| cosine(flat(d))).collect();
        let first = (0..INSTANCES).max_by(|&a, &b| scores[a].total_cmp(&scores[b])).expect("instances") as i32;
        let members: Vec<u32> = (0..GAUSSIANS as u32).filter(|&i| instances.label[i as usize] == first).collect();
        std::hint::black_box(members);
    });
    let slowest = best[TEXTS - 1];
    let result = serde_json::json!({
        "gaussians": GAUSSIANS, "instances": INSTANCES, "dim": DIM, "texts": TEXTS, "index_seconds": load,
        "query_seconds": median(&best), "query_seconds_slowest": slowest,
        "limit_seconds": LIMIT_SECONDS, "slowest_is_within_limit": slowest < LIMIT_SECONDS,
        "query_top10_seconds": median(&top10), "query_top10_with_4_negatives_seconds": median(&relevancy),
        "segmentation_of_20_texts_seconds": segmentation[0], "scan_reference_seconds": median(&scan),
        "peak_rss_bytes": stage::peak_rss_bytes(),
    });
    let text = serde_json::to_string_pretty(&result).expect("JSON") + "\n";
    let mut arguments = std::env::args();
    if let Some(out) = arguments.find(|a| a == "--out").and_then(|_| arguments.next()) {
        gs_io::write_bytes(&out, text.as_bytes()).expect("the output can be written");
    }
    eprint!("{text}");
}
