//! On the scene of the benchmark, made small.

#[path = "../benches/scene.rs"]
mod scene;

#[test]
fn a_run_takes_about_the_memory_that_it_forecasts() {
    let folder = tempfile::tempdir().unwrap();
    scene::write(120, 15, folder.path());
    let footprints = artifacts::Footprints::read(folder.path().join("footprints.safetensors")).unwrap();
    for view in footprints.rows.chunk_by(|a, b| a.view == b.view) {
        assert!((60..=100).contains(&view.len()), "masks as the benchmark promises them");
    }
    assert!(footprints.total() > 15 * 120 * 120 / 6);
    for options in [&["--dim", "64"][..], &["--preset", "paper", "--iterations", "20"]] {
        let record = scene::run(folder.path(), options);
        let forecast = record.memory_predicted_bytes.expect("feat-train forecasts its memory") as f64;
        let Some(peak) = record.peak_rss_bytes else { continue };
        let peak = peak as f64;
        // How much of the program itself lies in memory differs from system to system: 20 MB.
        assert!((forecast - peak).abs() < 0.5 * peak + 20e6, "{options:?}: forecast {forecast}, peak {peak}");
    }
}
