//! The iteration on footprints gives what rendering and averaging give.

#[path = "../benches/rendering.rs"]
#[allow(dead_code)] // Seconds are the benchmark's.
mod rendering;
#[path = "../benches/scene.rs"]
#[allow(dead_code)] // The benchmark has more scenes.
mod scene;

use feat_train::model::{Model, Settings};
use feat_train::scene::Neighbours;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

#[test]
fn footprints_give_what_rendering_and_averaging_give() {
    let s = scene::scene(60);
    let context = s.context(Neighbours::Gaussians, true);
    let settings = Settings::printed(6, 2);
    let mut model = Model::<f32>::new(settings, &context, &mut ChaCha8Rng::seed_from_u64(0));
    // Away from the start, where all centroids are nearly parallel and gradients nearly cancel.
    for (i, f) in model.features.iter_mut().enumerate() {
        *f = 3.0 * *f - 1.5 + (i / 600 % 7) as f32 * 0.3;
    }
    let found = rendering::View::new(&s.positions, 60.0, 160, 120).compare(&context, &model, 1);
    eprintln!("{found:?}");
    assert!(found.centroids <= 1e-5 && found.loss <= 1e-5 && found.gradients <= 1e-5, "{found:?}");
    // The synthetic views of the benchmark are of the size that they promise.
    let views = s.views(&context, 1);
    assert!((60..=100).contains(&views[0].len()) && views[0].columns.len() > 60 * 60 / 6);
}

#[test]
fn views_of_the_benchmark_show_things_whole_in_parts_and_merged() {
    let s = scene::scene(300);
    let things = scene::Things::new(300);
    let numbers: Vec<usize> = (0..4).map(|v| s.entries(v, Some(&things)).1.len()).collect();
    // About a fifth of 240 things, and as many masks more as parts are shown more often than merged.
    assert!(numbers.iter().all(|n| (40..120).contains(n)) && numbers.iter().any(|n| *n != numbers[0]), "{numbers:?}");
    let (entries, pixels) = s.entries(0, Some(&things));
    for k in [0, pixels.len() - 1] {
        let sum: f64 = entries.iter().filter(|e| usize::from(e.1) == k).map(|e| f64::from(e.2)).sum();
        assert!((sum - 0.9).abs() < 1e-3, "{k}: {sum}");
    }
}
