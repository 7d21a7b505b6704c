//! How long a query takes once everything is loaded, without the text encoder: `cargo bench -p eval --bench query --
//! --out FILE [--gaussians N] [--instances K] [--dim D]`. Medians over texts; the reference beside it scans labels and
//! descriptors anew for every query, as a script does.

use artifacts::Instances;
use eval::query::ask::Asker;
use eval::query::ranking::{Index, Scoring, Selection};
use eval::query::segment;
use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::time::Instant;

const TEXTS: usize = 101;
/// What a query may take at a million Gaussians and 500 instances, without the encoder.
const LIMIT_SECONDS: f64 = 0.05;

fn option(name: &str) -> Option<String> {
    let mut all = std::env::args();
    all.find(|a| a == name).and_then(|_| all.next())
}

fn size(name: &str, default: usize) -> usize {
    option(name).map_or(default, |v| v.parse().expect("a number"))
}

fn median(mut seconds: Vec<f64>) -> f64 {
    seconds.sort_by(f64::total_cmp);
    seconds[seconds.len() / 2]
}

/// The value below which a share of the values lies.
fn quantile(seconds: &[f64], share: f64) -> f64 {
    let mut sorted = seconds.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted[((sorted.len() - 1) as f64 * share).round() as usize]
}

fn unit(rng: &mut ChaCha8Rng, dim: usize) -> Vec<f32> {
    let v: Vec<f32> = (0..dim).map(|_| rng.random::<f32>() - 0.5).collect();
    let norm = v.iter().map(|x| x * x).sum::<f32>().sqrt();
    v.into_iter().map(|x| x / norm).collect()
}

fn main() {
    let (n, k, dim) = (size("--gaussians", 1_000_000), size("--instances", 500), size("--dim", 512));
    let mut rng = ChaCha8Rng::seed_from_u64(0);
    let label: Vec<i32> = (0..n).map(|_| rng.random_range(-1..k as i32)).collect();
    let instances = Instances {
        dim,
        descriptor: (0..k).flat_map(|_| unit(&mut rng, dim)).collect(),
        support: vec![5; k],
        score: vec![0.5; k],
        count: (0..k).map(|_| (n / k) as u32).collect(),
        centroid: vec![[0.0; 3]; k],
        bbox_min: vec![[0.0; 3]; k],
        bbox_max: vec![[0.0; 3]; k],
        label,
        ..Instances::default()
    };
    let texts: Vec<Vec<f32>> = (0..TEXTS).map(|_| unit(&mut rng, dim)).collect();
    let started = Instant::now();
    let index = Index::new(&instances);
    let load = started.elapsed().as_secs_f64();
    let mut asker = Asker {
        index,
        source: None,
        templates: Vec::new(),
        scoring: Scoring::default(),
        selection: Selection::new(None, None, 1),
        join: None,
    };
    let time = |asker: &Asker<'_>| {
        let one = |text: &Vec<f32>| {
            let started = Instant::now();
            let answer = std::hint::black_box(asker.answer(text));
            assert!(!answer.gaussians.is_empty());
            started.elapsed().as_secs_f64()
        };
        texts.iter().map(one).collect::<Vec<f64>>()
    };
    let best = time(&asker);
    let slowest = quantile(&best, 1.0);
    asker.selection = Selection::new(Some(10), None, 1);
    let top10 = median(time(&asker));
    asker.scoring = Scoring { negatives: texts[..4].to_vec() };
    let relevancy = median(time(&asker));
    let started = Instant::now();
    let divided = segment::divide(&asker.index, &instances.label, k, &texts[..20], &Scoring::default(), None);
    let segmentation = started.elapsed().as_secs_f64();
    assert_eq!(divided.0.len(), n);
    let scan = texts.iter().take(21).map(|text| {
        let started = Instant::now();
        let cosine = |d: &[f32]| d.iter().zip(text).map(|(a, b)| a * b).sum::<f32>();
        let scores: Vec<f32> = instances.descriptor.chunks_exact(dim).map(cosine).collect();
        let first = (0..k).max_by(|&a, &b| scores[a].total_cmp(&scores[b])).expect("instances") as i32;
        let members: Vec<u32> = (0..n as u32).filter(|&i| instances.label[i as usize] == first).collect();
        std::hint::black_box(members);
        started.elapsed().as_secs_f64()
    });
    let reference = median(scan.collect());
    let result = serde_json::json!({
        "gaussians": n, "instances": k, "dim": dim, "texts": TEXTS,
        "index_seconds": load, "query_seconds_p10": quantile(&best, 0.1), "query_seconds_p90": quantile(&best, 0.9),
        "query_seconds": median(best), "query_seconds_slowest": slowest,
        "limit_seconds": LIMIT_SECONDS, "slowest_is_within_limit": slowest < LIMIT_SECONDS,
        "query_top10_seconds": top10, "query_top10_with_4_negatives_seconds": relevancy,
        "segmentation_of_20_texts_seconds": segmentation, "scan_reference_seconds": reference,
        "peak_rss_bytes": stage::peak_rss_bytes(),
    });
    let text = serde_json::to_string_pretty(&result).expect("JSON") + "\n";
    if let Some(out) = option("--out") {
        gs_io::write_bytes(&out, text.as_bytes()).expect("the output can be written");
    }
    eprint!("{text}");
}
