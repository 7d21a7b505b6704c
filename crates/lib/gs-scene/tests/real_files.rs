//! Real captures and trained splats, which lie beside the project.

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

/// The largest differences between two versions of the same Gaussians: of centres, logarithms of scales, rotations (angle in
/// radians), opacities and harmonic coefficients.
fn differences(a: &Gaussians, b: &Gaussians) -> [f32; 5] {
    assert_eq!((a.len(), a.sh_degree), (b.len(), b.sh_degree));
    let most = |a: &[f32], b: &[f32]| a.iter().zip(b).fold(0.0f32, |m, (x, y)| m.max((x - y).abs()));
    let angle = |i: usize| {
        let length = |q: &[f32; 4]| q.iter().map(|v| v * v).sum::<f32>().sqrt();
        let (p, q) = (&a.rotations[i], &b.rotations[i]);
        let dot = p.iter().zip(q).map(|(x, y)| x * y).sum::<f32>() / (length(p) * length(q));
        2.0 * dot.abs().min(1.0).acos()
    };
    [
        most(a.means.as_flattened(), b.means.as_flattened()),
        most(a.log_scales.as_flattened(), b.log_scales.as_flattened()),
        (0..a.len()).map(angle).fold(0.0, f32::max),
        (0..a.len()).map(|i| (a.opacity(i) - b.opacity(i)).abs()).fold(0.0, f32::max),
        most(&a.sh, &b.sh),
    ]
}

#[test]
#[ignore = "needs shared/data/splats; run make test-data"]
fn the_same_scan_in_two_formats_agrees() {
    let read = |name: &str| splat::read_whole(data(&format!("splats/{name}"))).unwrap();
    // The PLY was made from the compressed one.
    let (plain, packed) = (read("guitar.ply"), read("guitar.compressed.ply"));
    assert_eq!((plain.kind.as_str(), packed.kind.as_str()), ("PLY", "compressed PLY"));
    let [centre, scale, angle, opacity, sh] = differences(&plain.gaussians, &packed.gaussians);
    assert!(
        centre < 1e-5 && scale < 1e-5 && angle < 2e-3 && opacity < 1e-6 && sh < 1e-5,
        "{centre} {scale} {angle} {opacity} {sh}"
    );
    let (mut packed, spz) = (read("biker.compressed.ply"), read("biker.spz"));
    assert_eq!((spz.kind.as_str(), spz.gaussians.len()), ("SPZ version 4", 152_746));
    // SPZ holds no smaller scale.
    packed.gaussians.log_scales.as_flattened_mut().iter_mut().for_each(|s| *s = s.max(-10.0));
    let [centre, scale, angle, opacity, sh] = differences(&packed.gaussians, &spz.gaussians);
    assert!(
        centre < 2e-4 && scale < 0.06 && angle < 4e-3 && opacity < 1e-6 && sh < 0.02,
        "{centre} {scale} {angle} {opacity} {sh}"
    );
}
