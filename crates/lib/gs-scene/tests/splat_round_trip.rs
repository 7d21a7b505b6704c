//! What is written in a format reads back within its steps, number by number; docs/splats.md has the table.

mod common;

use common::{Differences, cloud};
use gs_scene::splat::{self, Extra, Format};
use gs_scene::{Gaussians, ply};
use proptest::prelude::*;

/// A cloud moved and grown; `seed` chooses which of a large one.
fn scene(seed: u64, n: usize, sh_degree: u8, scale: f32) -> Gaussians {
    let all = cloud(4000, sh_degree);
    let first = (seed % (4000 - n as u64)) as u32;
    let mut g = all.select(&(first..first + n as u32).collect::<Vec<_>>());
    g.means.as_flattened_mut().iter_mut().for_each(|v| *v = (*v + 1.0) * scale);
    g
}

fn through(g: &Gaussians, name: &str, extra: &Extra<'_>) -> splat::Splat {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join(name);
    splat::write(&path, g, extra).unwrap();
    let format = Format::to_write(&path).unwrap();
    assert_eq!(std::fs::read(&path).unwrap(), splat::encode(format, g, extra).unwrap());
    assert_eq!(Format::of_file(&path).unwrap(), format);
    assert_eq!(splat::count(&path).unwrap(), g.len() as u64);
    splat::read_whole(&path).unwrap()
}

/// Compressed PLYs have another order: Gaussians are found again by the nearest opacity and centre.
fn reordered(g: &Gaussians, back: &Gaussians) -> Gaussians {
    let near = |i: usize| {
        let far = |k: &u32| -> f32 {
            let (a, b) = (g.means[*k as usize], back.means[i]);
            (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f32>() + (g.opacity(*k as usize) - back.opacity(i)).powi(2)
        };
        (0..g.len() as u32).min_by(|a, b| far(a).total_cmp(&far(b))).unwrap()
    };
    let order: Vec<u32> = (0..back.len()).map(near).collect();
    let mut once = order.clone();
    once.sort_unstable();
    once.dedup();
    assert_eq!(once.len(), g.len(), "each is found once");
    g.select(&order)
}

/// The largest difference within a chunk, which the steps are fractions of: here of the whole scene.
fn widest(rows: &[[f32; 3]]) -> f32 {
    let of = |k: usize| {
        let (low, high) = rows.iter().fold((f32::MAX, f32::MIN), |(l, h), r| (l.min(r[k]), h.max(r[k])));
        high - low
    };
    of(0).max(of(1)).max(of(2))
}

fn limits(format: Format, g: &Gaussians) -> Differences {
    let farthest = g.means.as_flattened().iter().fold(0.0f32, |m, v| m.max(v.abs()));
    // A number in steps of `step` is off by half of one, and by the rounding of single precision.
    let half = |step: f32, size: f32| 0.5 * step + 4.0 * f32::EPSILON * size;
    match format {
        Format::CompressedPly => Differences {
            center: half(widest(&g.means) / 1023.0, farthest),
            log_scale: half(widest(&g.log_scales) / 1023.0, 8.0),
            // Three parts, each off by half a step of sqrt 2 / 1023, and what follows from them for the fourth.
            angle: 6e-3,
            opacity: half(1.0 / 255.0, 1.0),
            color: half(1.0 / 255.0, 1.0),
            harmonics: [half(1.0 / 32.0, 1.0); 2],
        },
        Format::Spz => Differences {
            center: half(2f32.powi(-((8_388_607.0 / farthest).log2().floor().min(16.0) as i32)), farthest),
            log_scale: half(1.0 / 16.0, 8.0),
            angle: 6e-3,
            opacity: half(1.0 / 255.0, 1.0),
            color: half(gs_scene::SH_C0 / 0.15 / 255.0, 1.0),
            // Steps of 8 and 16 in 128, after a step of 1.
            harmonics: [0.5 * 9.0 / 128.0, 0.5 * 17.0 / 128.0],
        },
        Format::Splat => Differences {
            center: 0.0,
            log_scale: 1e-5,
            angle: 0.025,
            opacity: half(1.0 / 255.0, 1.0),
            color: half(1.0 / 255.0, 1.0),
            harmonics: [0.0; 2],
        },
        Format::Gltf => Differences { log_scale: 1e-5, opacity: 1e-6, angle: 1e-6, ..exact() },
        _ => exact(),
    }
}

fn exact() -> Differences {
    Differences { center: 0.0, log_scale: 0.0, angle: 0.0, opacity: 0.0, color: 0.0, harmonics: [0.0; 2] }
}

const NAMES: [&str; 5] = ["a.ply", "a.compressed.ply", "a.spz", "a.splat", "a.glb"];

proptest! {
    #![proptest_config(ProptestConfig { cases: 40, ..ProptestConfig::default() })]
    #[test]
    fn every_number_comes_back_within_a_step(
        seed: u64, n in 1usize..700, degree in 0u8..4, scale in prop_oneof![Just(0.01f32), Just(1.0), Just(300.0)]
    ) {
        let g = scene(seed, n, degree, scale);
        for name in NAMES {
            let format = Format::to_write(name).unwrap();
            let back = through(&g, name, &Extra::default()).gaussians;
            let mut wanted = if format == Format::CompressedPly && scale < 2.0 { reordered(&g, &back) } else { g.clone() };
            if format == Format::CompressedPly && scale > 2.0 {
                // Too coarse for finding them again; other scales are enough.
                continue;
            }
            if format == Format::Splat {
                wanted = wanted.with_degree(0);
            }
            Differences::between(&wanted, &back).within(limits(format, &g));
        }
    }
}

/// The table of docs/splats.md: `cargo test --release -p gs-scene --test splat_round_trip -- --ignored --nocapture table`.
#[test]
#[ignore = "prints a table; nothing to fail"]
fn table_of_errors() {
    let g = scene(0, 3000, 3, 1.0);
    eprintln!("largest error of 3,000 Gaussians within {:.1} units", widest(&g.means));
    for name in NAMES {
        let format = Format::to_write(name).unwrap();
        let bytes = splat::encode(format, &g, &Extra::default()).unwrap().len() as f64 / g.len() as f64;
        let back = through(&g, name, &Extra::default()).gaussians;
        let wanted = match format {
            Format::CompressedPly => reordered(&g, &back),
            Format::Splat => g.clone().with_degree(0),
            _ => g.clone(),
        };
        eprintln!("{name}: {bytes:.0} bytes a Gaussian, {:?}", Differences::between(&wanted, &back));
    }
}

#[test]
fn comments_the_filter_and_instances_go_where_they_can() {
    let g = cloud(5, 1);
    let comments = ["made by a test".to_string()];
    let extra = Extra { comments: &comments, antialias: true, ids: &[] };
    for (name, kept) in
        [("a.ply", true), ("a.compressed.ply", true), ("a.spz", true), ("a.splat", false), ("a.glb", false)]
    {
        assert_eq!(through(&g, name, &extra).antialias, kept, "{name}");
    }
    let instance = [0, 1, -1, 1, 0];
    let extra = Extra { ids: &[("instance", &instance), ("class_id", &instance)], ..Extra::default() };
    let bytes = splat::encode(Format::Ply, &g, &extra).unwrap();
    assert!(String::from_utf8_lossy(&bytes).contains("property int instance\nproperty int class_id\n"));
    let e = splat::encode(Format::Spz, &g, &extra).unwrap_err().to_string();
    assert!(e.contains("only a PLY holds instances"), "{e}");
    let short = Extra { ids: &[("instance", &instance[..2])], ..Extra::default() };
    assert!(splat::encode(Format::Ply, &g, &short).is_err());
}

#[test]
fn what_a_format_cannot_hold_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let refused = |name: &str, g: &Gaussians| {
        let path = dir.path().join(name);
        let e = splat::write(&path, g, &Extra::default()).unwrap_err().to_string();
        assert!(!path.exists() && e.starts_with(&path.display().to_string()), "{e}");
        e
    };
    let mut g = cloud(5, 1);
    assert!(refused("a.sog", &g).contains(".spz"));
    assert!(refused("a", &g).contains("ends in .ply"));
    g.means[3][1] = f32::NAN;
    assert!(refused("a.spz", &g).contains("vertex 3, x, y, z: a parameter is not finite"));
    g.means[3][1] = 1e9;
    assert!(refused("a.spz", &g).contains("too far from the origin"));
    assert!(refused("a.glb", &Gaussians::default()).contains("no Gaussians"));
    // A PLY holds anything.
    g.means[3][1] = f32::NAN;
    splat::write(dir.path().join("a.ply"), &g, &Extra::default()).unwrap();
    assert!(ply::read_gaussians_as_they_are(dir.path().join("a.ply")).unwrap().means[3][1].is_nan());
}

#[test]
fn opaque_and_invisible_gaussians_stay_so() {
    let mut g = cloud(4, 0);
    g.opacity_logits = vec![f32::INFINITY, f32::NEG_INFINITY, 30.0, 0.0];
    for name in NAMES {
        let back = through(&g, name, &Extra::default()).gaussians;
        let mut opacities: Vec<f32> = (0..4).map(|i| back.opacity(i)).collect();
        opacities.sort_unstable_by(f32::total_cmp);
        assert!(opacities[0] < 1e-6 && (opacities[1] - 0.5).abs() < 0.003 && opacities[2] > 1.0 - 1e-6, "{name}");
    }
}
