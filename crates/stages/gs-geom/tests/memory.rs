//! Forecasts of memory against the peaks of the same runs.

mod common;

use common::world::scene;
use common::{Folder, program, record, succeeds};
use serde_json::Value;

/// Checks that the forecast is near the peak.
fn near(forecast: &Value, out: &str) {
    let (forecast, peak) = (forecast.as_f64().unwrap(), record(out)["peak_rss_bytes"].as_f64().unwrap());
    // How much of the program itself lies in memory differs from system to system: 20 MB.
    assert!((forecast - peak).abs() < 0.34 * peak + 20e6, "{out}: forecast {forecast}, peak {peak}");
}

#[test]
#[cfg(target_os = "linux")]
fn forecasts_are_near_the_peaks() {
    let dir = Folder::new();
    let [geometry, metrics, pictures, converted] = ["g.ply", "m.json", "pictures", "c.ply"].map(|n| dir.path(n));
    let base = ["train", "--scene", scene(), "--threads", "2", "--iterations", "10", "--out", &geometry];
    for count in ["2000", "60000"] {
        let said = succeeds(&[&base[..], &["--init", "random", "--init-points", count]].concat());
        assert!(said.contains("memory: about"), "{said}");
        near(&record(&geometry)["summary"]["memory_predicted_bytes"], &geometry);
    }
    let drawn = ["--scene", scene(), "--geometry", &geometry, "--threads", "2", "--out"];
    for (command, out) in [
        ([&["render"], &drawn[..], &[&pictures]].concat(), &pictures),
        ([&["eval"], &drawn[..], &[&metrics]].concat(), &metrics),
        (vec!["convert", &geometry, &converted, "--min-opacity", "0.0"], &converted),
    ] {
        succeeds(&command);
        near(&record(out)["memory_predicted_bytes"], out);
    }
    let wrong = program(&[&base[..], &["--image-cache", "512"]].concat()).output().unwrap();
    assert!(String::from_utf8_lossy(&wrong.stderr).contains("512M or 2G"));
}
