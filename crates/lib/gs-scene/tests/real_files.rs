//! Real captures and trained splats, which lie beside the project.

use gs_scene::dataset::{self, Format, LoadOptions, Resolution, Split};
use gs_scene::{Gaussians, ply};
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
