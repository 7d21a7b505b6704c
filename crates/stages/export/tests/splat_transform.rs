//! Another program splits objects from our PLYs: splat-transform, which scripts/test_splats.sh installs.

use artifacts::{Extents, Instances, role};
use gs_io::{Provenance, hash_file};
use gs_scene::{Gaussians, ply};
use std::collections::BTreeMap;
use std::process::Command;

/// Gaussians, and objects that they are dealt out to, with some for none.
const GAUSSIANS: usize = 3000;
const OBJECTS: i32 = 9;

#[test]
#[ignore = "needs splat-transform: scripts/test_splats.sh"]
fn splat_transform_splits_objects_from_our_ply() {
    let program = std::env::var_os("SPLAT_TRANSFORM").expect("SPLAT_TRANSFORM names the program");
    let dir = tempfile::tempdir().unwrap();
    let path = |name: &str| dir.path().join(name);
    let g = Gaussians {
        means: (0..GAUSSIANS).map(|i| [i as f32 * 0.25, (i % 7) as f32, 0.5]).collect(),
        log_scales: vec![[-3.0; 3]; GAUSSIANS],
        rotations: vec![[1.0, 0.0, 0.0, 0.0]; GAUSSIANS],
        opacity_logits: vec![2.0; GAUSSIANS],
        sh: (0..48 * GAUSSIANS).map(|i| (i % 89) as f32 * 0.01 - 0.3).collect(),
        sh_degree: 3,
        ..Gaussians::default()
    };
    let label: Vec<i32> = (0..GAUSSIANS as i32).map(|i| i * i % (OBJECTS + 1) - 1).collect();
    ply::write_gaussians(path("geometry.ply"), &g, &[]).unwrap();
    let (k, e) = (OBJECTS as usize, Extents::of(&g.means, &label, OBJECTS as usize));
    let instances = Instances {
        node: vec![-1; GAUSSIANS],
        label: label.clone(),
        support: vec![1; k],
        score: vec![1.0; k],
        count: e.count,
        centroid: e.centroid,
        bbox_min: e.bbox_min,
        bbox_max: e.bbox_max,
        oriented: e.oriented,
        ..Instances::default()
    };
    let inputs = BTreeMap::from([(role::GEOMETRY.into(), hash_file(path("geometry.ply")).unwrap())]);
    instances.write(path("i.safetensors"), Provenance { inputs, ..Provenance::default() }).unwrap();
    let mut export = Command::new(env!("CARGO_BIN_EXE_export"));
    export.arg("splats").arg("--geometry").arg(path("geometry.ply")).arg("--instances").arg(path("i.safetensors"));
    assert!(export.arg("--ids").arg("--out").arg(path("all.ply")).status().unwrap().success());

    // Those with most, with fewest, and those of no object; the program reads all whole numbers as unsigned.
    for (property, id) in [("instance", -1), ("instance_id", 3), ("instance", 5), ("instance_id", 8)] {
        let mut split = Command::new("node");
        split
            .arg(&program)
            .arg("--overwrite")
            .arg(path("all.ply"))
            .arg("--filter-value")
            .arg(format!("{property},eq,{}", id as u32));
        let done = split.arg(path("one.ply")).output().unwrap();
        let own: Vec<u32> = (0..GAUSSIANS as u32).filter(|&i| label[i as usize] == id).collect();
        assert!(done.status.success() && !own.is_empty(), "{}", String::from_utf8_lossy(&done.stderr));
        // As many, the same, in the same order, with all their harmonics.
        assert_eq!(ply::read_gaussians(path("one.ply")).unwrap(), g.select(&own), "object {id}");
    }
}
