//! Time per pixel-Gaussian pair on one core, for `make bench-raster`. The last argument names the JSON file to write; further
//! arguments before it name PLYs to measure besides the synthetic scenes.

use glam::{DMat3, DVec3};
use gs_raster::{Measured, RasterOptions, Workspace, tile_weights};
use gs_scene::{Camera, Gaussians};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use serde_json::{Value, json};

const REPETITIONS: usize = 15;

/// Gaussians of a trained scene's statistics: log-normal footprints of about `radius` pixels, flat, most of them either faint
/// or nearly opaque, on surfaces at several depths.
fn synthetic(n: usize, radius: f32, camera: &Camera) -> Gaussians {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut roll = || (rng.next_u32() >> 8) as f32 / 16_777_216.0;
    let mut g = Gaussians { sh_degree: 3, ..Gaussians::default() };
    for _ in 0..n {
        let z = 2.0 + 6.0 * (roll() * 6.0).floor() / 6.0 + 0.2 * roll();
        let pixel = z / camera.fx as f32;
        let x = (roll() * 1.1 - 0.05) * camera.width as f32 - camera.cx as f32;
        let y = (roll() * 1.1 - 0.05) * camera.height as f32 - camera.cy as f32;
        g.means.push([x * pixel, y * pixel, z]);
        let mut normal = || roll() + roll() + roll() + roll() + roll() + roll() - 3.0;
        let size = (radius * pixel).ln() + normal();
        g.log_scales.push([size, size + normal() * 0.7, size - 2.0]);
        g.rotations.push([normal(), normal(), normal(), normal()]);
        g.opacity_logits.push(3.0 * normal());
        g.sh.extend((0..48).map(|k| if k < 3 { normal() } else { 0.1 * normal() }));
    }
    g
}

fn front_camera(width: u32, height: u32) -> Camera {
    Camera {
        width,
        height,
        fx: f64::from(width),
        fy: f64::from(width),
        cx: f64::from(width) / 2.0,
        cy: f64::from(height) / 2.0,
        rotation: DMat3::IDENTITY,
        translation: DVec3::ZERO,
    }
}

/// Looks at the middle half of the Gaussians from outside.
fn outside_camera(g: &Gaussians) -> Camera {
    let [low, high] = [1, 3].map(|quarter| {
        DVec3::from([0, 1, 2].map(|axis| {
            let mut v: Vec<f32> = g.means.iter().map(|m| m[axis]).filter(|v| v.is_finite()).collect();
            v.sort_by(f32::total_cmp);
            f64::from(v[v.len() * quarter / 4])
        }))
    });
    let middle = (low + high) / 2.0;
    Camera::look_at(middle + DVec3::new(0.5, 0.3, 1.0) * (high - low).length(), middle, DVec3::Y, 640, 480, 0.9)
}

/// CPU time of this thread.
fn cpu_seconds() -> f64 {
    let t = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    t.tv_sec as f64 + t.tv_nsec as f64 * 1e-9
}

/// Median, and half the distance between the quartiles relative to it.
fn summary(mut values: Vec<f64>) -> (f64, f64) {
    values.sort_by(f64::total_cmp);
    let median = values[values.len() / 2];
    (median, (values[values.len() * 3 / 4] - values[values.len() / 4]) / 2.0 / median)
}

/// Measures what an optimisation asks for; with `everything`, depth as well.
fn bench(name: &str, g: &Gaussians, camera: &Camera, everything: bool) -> Value {
    let options = RasterOptions { depth: everything, ..RasterOptions::default() };
    let pixels = camera.width as usize * camera.height as usize;
    let d: Vec<f32> = (0..3 * pixels).map(|i| ((i * 7919) % 1000) as f32 * 2e-3 - 1.0).collect();
    let counts = tile_weights(g, camera, &options, true, |t| t.weights.iter().filter(|w| **w > 0.0).count());
    let contributing: usize = counts.iter().sum();
    let mut workspace = Workspace::default();
    let runs: Vec<_> =
        (0..=REPETITIONS).map(|_| workspace.measure(g, camera, &options, &d, cpu_seconds)).skip(1).collect();
    let pairs = runs[0].pairs_evaluated as f64;
    let of = |seconds: fn(&Measured) -> f64| summary(runs.iter().map(seconds).collect());
    let ((forward, forward_spread), (backward, backward_spread)) = (of(|r| r.forward_s), of(|r| r.backward_s));
    let found = json!({
        "scene": name,
        "gaussians": g.len(),
        "width": camera.width,
        "height": camera.height,
        "forward_ns_per_pair": forward * 1e9 / pairs,
        "forward_spread": forward_spread,
        "backward_ns_per_pair": backward * 1e9 / pairs,
        "backward_spread": backward_spread,
        "pairs_evaluated": pairs,
        "pairs_contributing": contributing,
        "project_ms": of(|r| r.project_s).0 * 1e3,
        "forward_ms": forward * 1e3,
        "backward_ms": backward * 1e3,
        "gather_ms": of(|r| r.gather_s).0 * 1e3,
    });
    eprintln!("{found}");
    found
}

fn features() -> Vec<&'static str> {
    #[cfg(target_arch = "x86_64")]
    {
        let all = [
            ("avx2", std::is_x86_feature_detected!("avx2")),
            ("fma", std::is_x86_feature_detected!("fma")),
            ("avx512f", std::is_x86_feature_detected!("avx512f")),
        ];
        all.iter().filter(|(_, there)| *there).map(|(name, _)| *name).collect()
    }
    #[cfg(not(target_arch = "x86_64"))]
    vec![std::env::consts::ARCH]
}

fn main() {
    // cargo itself passes --bench.
    let mut paths: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).collect();
    let out = paths.pop();
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("a thread");
    let scenes = pool.install(|| {
        let camera = front_camera(640, 480);
        let small = front_camera(129, 235);
        let mut scenes = vec![
            bench("trained-like", &synthetic(60_000, 3.0, &camera), &camera, false),
            bench("trained-like, everything", &synthetic(60_000, 3.0, &camera), &camera, true),
            bench("large footprints", &synthetic(6_000, 15.0, &camera), &camera, false),
            bench("small footprints", &synthetic(120_000, 0.7, &camera), &camera, false),
            bench("small image", &synthetic(16_000, 2.0, &small), &small, false),
        ];
        for path in &paths {
            match gs_scene::ply::read_gaussians(path) {
                Ok(g) => scenes.push(bench(path.rsplit('/').next().unwrap_or(path), &g, &outside_camera(&g), false)),
                Err(e) => eprintln!("skipped: {e}"),
            }
        }
        scenes
    });
    let report = json!({
        "repetitions": REPETITIONS,
        "threads": 1,
        "clock": "CPU time of the thread",
        "cpu_features": features(),
        "spread": "half the distance between the quartiles, relative to the median",
        "scenes": scenes,
    });
    if let Some(out) = out {
        let text = serde_json::to_string_pretty(&report).expect("a report") + "\n";
        let made = std::path::Path::new(&out).parent().map_or(Ok(()), std::fs::create_dir_all);
        if let Err(e) = made.and_then(|()| std::fs::write(&out, text)) {
            eprintln!("cannot write {out}: {e}");
            std::process::exit(2);
        }
    }
}
