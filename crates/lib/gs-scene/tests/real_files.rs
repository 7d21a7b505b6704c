//! Real captures and trained splats, which lie beside the project.

mod common;

use common::{Differences, ROUNDING};
use gs_scene::dataset::{self, Format, LoadOptions, Resolution, Split};
use gs_scene::{Gaussians, ply, splat};
use std::path::PathBuf;

fn data(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../../../shared/data").join(name)
}

#[test]
#[ignore = "needs shared/data/desk; run make test-data"]
fn the_desk_photographs_load() {
    let d = dataset::load(&data("desk"), &LoadOptions { resolution: Resolution::Divisor(8.0), holdout: 8 }).unwrap();
    assert_eq!((d.format, d.views.len(), d.points.len()), (Format::Colmap, 29, 7562));
    assert_eq!(d.views_of(Split::Test).count(), 4);
    assert_eq!((d.views[0].camera.width, d.views[0].camera.height), (238, 134));
    let image = d.views[0].load_image().unwrap();
    assert_eq!((image.width, image.height), (238, 134));
    // Most sparse points lie in front of the first camera and many fall into its image.
    let inside = d.points.positions.iter().filter(|p| {
        let (u, v, z) = d.views[0].camera.project(glam::Vec3::from_array(**p).as_dvec3());
        z > 0.0 && (0.0..238.0).contains(&u) && (0.0..134.0).contains(&v)
    });
    assert!(inside.count() > 2000);
}

#[test]
#[ignore = "needs shared/data/splats; run make test-data"]
fn trained_splats_load_and_round_trip() {
    for (name, n, degree) in
        [("guitar.ply", 90_854, 0), ("inria_layout_9k.ply", 9_080, 3), ("inria_train_1000.ply", 1_000, 3)]
    {
        let g = ply::read_gaussians(data(&format!("splats/{name}"))).unwrap();
        assert_eq!((g.len(), g.sh_degree), (n, degree), "{name}");
        let dir = tempfile::tempdir().unwrap();
        let copy = dir.path().join("copy.ply");
        ply::write_gaussians(&copy, &g, &["made by a test".into()]).unwrap();
        let back: Gaussians = ply::read_gaussians(&copy).unwrap();
        assert_eq!(back, g, "{name}");
    }
}

#[test]
#[ignore = "needs shared/data/splats; run make test-data"]
fn the_same_scan_in_two_formats_agrees() {
    let read = |name: &str| splat::read_whole(data(&format!("splats/{name}"))).unwrap();
    // The PLY was made from the compressed one.
    let (plain, packed) = (read("guitar.ply"), read("guitar.compressed.ply"));
    assert_eq!((plain.kind.as_str(), packed.kind.as_str()), ("PLY", "compressed PLY"));
    Differences::between(&plain.gaussians, &packed.gaussians).within(ROUNDING);
    let (mut packed, spz) = (read("biker.compressed.ply"), read("biker.spz"));
    assert_eq!((spz.kind.as_str(), spz.gaussians.len()), ("SPZ version 4", 152_746));
    // SPZ holds no smaller scale.
    packed.gaussians.log_scales.as_flattened_mut().iter_mut().for_each(|s| *s = s.max(-10.0));
    // Half a step of SPZ and one of the chunks of the compressed PLY.
    let step =
        Differences { center: 2e-4, log_scale: 0.06, angle: 4e-3, opacity: 1e-6, color: 8e-3, harmonics: [0.0; 2] };
    Differences::between(&packed.gaussians, &spz.gaussians).within(step);
}

#[test]
#[ignore = "needs shared/data/splats; run make test-data"]
fn sogs_are_plausible() {
    for (name, kind, n, degree, size) in [
        ("playbot_sog", "SOG version 2, unbundled", 31_000, 2, 0.2..2.0),
        ("playbot_sog/meta.json", "SOG version 2, unbundled", 31_000, 2, 0.2..2.0),
        ("statue.sog", "SOG version 2, bundled", 54_000, 0, 0.2..20.0),
    ] {
        let path = data(&format!("splats/{name}"));
        let read = splat::read_whole(&path).unwrap();
        let g = &read.gaussians;
        eprintln!("{name}: {} Gaussians, spread {}", g.len(), g.spread());
        assert_eq!((read.kind.as_str(), g.sh_degree), (kind, degree));
        assert!((g.len() as f64 / f64::from(n) - 1.0).abs() < 0.3, "{name}: {}", g.len());
        assert!(size.contains(&g.spread()), "{name}: {}", g.spread());
        // Colours are colours, most Gaussians are small and can be seen, rotations are of length 1.
        let share = |of: &dyn Fn(usize) -> bool| (0..g.len()).filter(|&i| of(i)).count() as f64 / g.len() as f64;
        assert!(share(&|i| g.base_color(i).iter().all(|c| (-0.2..1.2).contains(c))) > 0.95, "{name}");
        assert!(share(&|i| g.opacity(i) > 0.02) > 0.9 && share(&|i| g.log_scales[i].iter().all(|s| *s < -2.0)) > 0.9);
        assert!(share(&|i| (g.rotations[i].iter().map(|v| v * v).sum::<f32>() - 1.0).abs() < 1e-3) == 1.0, "{name}");
    }
    // Several files are no geometry of a stage, and their hash is that of all.
    let unbundled = data("splats/playbot_sog/meta.json");
    let e = gs_scene::Geometry::read(&unbundled).unwrap_err().to_string();
    assert!(e.contains("several files") && e.contains("gs-geom convert"), "{e}");
    assert_eq!(splat::files(&unbundled).unwrap().len(), 8);
    assert_ne!(splat::hash(&unbundled).unwrap(), gs_io::hash_file(&unbundled).unwrap());
    assert_eq!(splat::hash(data("splats/statue.sog")).unwrap(), gs_io::hash_file(data("splats/statue.sog")).unwrap());
}
