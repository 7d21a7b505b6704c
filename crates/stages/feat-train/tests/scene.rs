//! On the scene of the benchmark, made small.

#[path = "../benches/scene.rs"]
mod scene;

#[test]
fn views_of_the_benchmark_have_the_masks_that_they_promise() {
    let s = scene::scene(60);
    let views = s.views(&s.context(), 1);
    assert!((60..=100).contains(&views[0].len()) && views[0].columns.len() > 60 * 60 / 6);
}

#[test]
fn a_run_takes_about_the_memory_that_it_forecasts() {
    let (s, folder) = (scene::scene(120), tempfile::tempdir().unwrap());
    for options in [&["--dim", "64"][..], &["--preset", "paper", "--iterations", "20"]] {
        let record = s.run(15, options, folder.path());
        let forecast = record.memory_predicted_bytes.expect("feat-train forecasts its memory") as f64;
        let Some(peak) = record.peak_rss_bytes else { continue };
        let peak = peak as f64;
        // How much of the program itself lies in memory differs from system to system: 20 MB.
        assert!((forecast - peak).abs() < 0.5 * peak + 20e6, "{options:?}: forecast {forecast}, peak {peak}");
    }
}
