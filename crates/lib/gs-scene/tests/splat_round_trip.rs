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

/// What is read of a file, and what was written to it, in its order.
fn through(g: &Gaussians, name: &str, extra: &Extra<'_>) -> (splat::Splat, Gaussians) {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join(name);
    let order = splat::write(&path, g, extra).unwrap();
    let format = Format::to_write(&path).unwrap();
    assert_eq!(std::fs::read(&path).unwrap(), splat::encode(format, g, extra).unwrap());
    assert_eq!(Format::of_file(&path).unwrap(), format);
    assert_eq!(splat::count(&path).unwrap(), g.len() as u64);
    (splat::read_whole(&path).unwrap(), order.map_or_else(|| g.clone(), |order| g.select(&order)))
}

/// The largest difference within a chunk, which the steps are fractions of: here of the whole scene.
fn widest(rows: &[[f32; 3]]) -> f32 {
    let of = |k: usize| {
        let (low, high) = rows.iter().fold((f32::MAX, f32::MIN), |(l, h), r| (l.min(r[k]), h.max(r[k])));
        high - low
    };
    of(0).max(of(1)).max(of(2))
}

fn range<'a>(values: impl IntoIterator<Item = &'a f32>) -> f32 {
    let (low, high) = values.into_iter().fold((f32::MAX, f32::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
    (high - low).max(0.0)
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
        Format::Sog => {
            // No number is farther from an entry of its table than 2/255 of the range.
            let step = |from: usize, to: usize| {
                let of = |i: usize| &g.sh_of(i)[from.min(g.sh_stride())..to.min(g.sh_stride())];
                half(4.0 / 255.0 * range((0..g.len()).flat_map(of)), 8.0)
            };
            Differences {
                // 16 bits of sign(x) ln(1 + |x|).
                center: half(2.0 * farthest.ln_1p() / 65535.0 * (1.0 + farthest), 8.0 * farthest),
                log_scale: half(4.0 / 255.0 * range(g.log_scales.as_flattened()), 8.0),
                // Three parts, each off by half a step of sqrt 2 / 255.
                angle: 0.02,
                opacity: half(1.0 / 255.0, 1.0),
                color: gs_scene::SH_C0 * step(0, 3),
                harmonics: [step(3, 48); 2],
            }
        }
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

const NAMES: [&str; 6] = ["a.ply", "a.compressed.ply", "a.spz", "a.sog", "a.splat", "a.glb"];

proptest! {
    #![proptest_config(ProptestConfig { cases: 40, ..ProptestConfig::default() })]
    #[test]
    fn every_number_comes_back_within_a_step(
        seed: u64, n in prop_oneof![Just(1usize), Just(3), 1usize..700], degree in 0u8..4,
        scale in prop_oneof![Just(0.01f32), Just(1.0), Just(300.0)]
    ) {
        let g = scene(seed, n, degree, scale);
        for name in NAMES {
            let format = Format::to_write(name).unwrap();
            let (back, mut wanted) = through(&g, name, &Extra::default());
            if format == Format::Splat {
                wanted = wanted.with_degree(0);
            }
            Differences::between(&wanted, &back.gaussians).within(limits(format, &g));
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
        let (back, mut wanted) = through(&g, name, &Extra::default());
        if format == Format::Splat {
            wanted = wanted.with_degree(0);
        }
        eprintln!("{name}: {bytes:.0} bytes a Gaussian, {:?}", Differences::between(&wanted, &back.gaussians));
    }
}

#[test]
fn comments_the_filter_and_instances_go_where_they_can() {
    let g = cloud(5, 1);
    let comments = ["made by a test".to_string()];
    let extra = Extra { comments: &comments, antialias: true, ids: &[] };
    for (name, kept) in [
        ("a.ply", true),
        ("a.compressed.ply", true),
        ("a.spz", true),
        ("a.sog", true),
        ("a.splat", false),
        ("a.glb", false),
    ] {
        assert_eq!(through(&g, name, &extra).0.antialias, kept, "{name}");
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
    assert!(refused("meta.json", &g).contains("ends in .ply"));
    assert!(refused("a", &g).contains("ends in .ply"));
    g.means[3][1] = f32::NAN;
    for name in ["a.spz", "a.sog"] {
        assert!(refused(name, &g).contains("vertex 3, x, y, z: a parameter is not finite"));
    }
    g.means[3][1] = 1e9;
    assert!(refused("a.spz", &g).contains("too far from the origin"));
    for name in ["a.glb", "a.sog"] {
        assert!(refused(name, &Gaussians::default()).contains("no Gaussians"));
    }
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
        let back = through(&g, name, &Extra::default()).0.gaussians;
        let mut opacities: Vec<f32> = (0..4).map(|i| back.opacity(i)).collect();
        opacities.sort_unstable_by(f32::total_cmp);
        assert!(opacities[0] < 1e-6 && (opacities[1] - 0.5).abs() < 0.003 && opacities[2] > 1.0 - 1e-6, "{name}");
    }
}
