//! On the scene of the benchmark, made small: the iteration on footprints gives what rendering and averaging give, and the
//! program takes about the memory that it forecasts.

#[path = "../benches/rendering.rs"]
#[allow(dead_code)] // Seconds are the benchmark's.
mod rendering;
#[path = "../benches/scene.rs"]
mod scene;

use feat_train::contrastive::model::Model;
use feat_train::options::Contrastive;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

#[test]
fn footprints_give_what_rendering_and_averaging_give() {
    let s = scene::scene(60);
    let context = s.context();
    let mut model = Model::<f32>::new(6, Contrastive::default(), &context, &mut ChaCha8Rng::seed_from_u64(0));
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
fn a_run_takes_about_the_memory_that_it_forecasts() {
    let (s, folder) = (scene::scene(120), tempfile::tempdir().unwrap());
    for options in [&["--dim", "64"][..], &["--preset", "paper", "--iterations", "20"]] {
        let record = s.run(15, options, folder.path());
        let forecast = record.memory_predicted_bytes.expect("feat-train forecasts its memory") as f64;
        let Some(peak) = record.peak_rss_bytes else { continue };
        let ratio = forecast / peak as f64;
        assert!((0.5..2.0).contains(&ratio), "{options:?}: {ratio} of {peak}");
    }
}
