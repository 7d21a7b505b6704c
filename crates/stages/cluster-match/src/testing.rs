//! Small footprints and instances for tests.

use artifacts::{Footprints, FootprintsBuilder, Instances, Level, Row};
use gs_io::Provenance;

/// Footprints of eight Gaussians, of all weight 1, with the masks of each view; all of level large.
pub fn footprints(views: &[&[&[u32]]]) -> Footprints {
    footprints_of(&[(Level::LARGE, views)])
}

/// The same with several levels.
pub fn footprints_of(levels: &[(Level, &[&[&[u32]]])]) -> Footprints {
    let names = (0..levels[0].1.len()).map(|v| v.to_string()).collect();
    let mut b = FootprintsBuilder { views: names, kept: (0..8).collect(), ..FootprintsBuilder::default() };
    for (view, _) in levels[0].1.iter().enumerate() {
        for (level, views) in levels {
            for (mask, gaussians) in views[view].iter().enumerate() {
                let (view, level, mask, pixels) =
                    (view as u32, level.index() as u32, mask as u32, gaussians.len() as u32);
                let row = Row { view, level, mask, pixels, gated: pixels, alpha: 1.0 };
                b.push(row, gaussians.iter().map(|&i| (i, 1.0)));
            }
        }
    }
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("f.safetensors");
    b.write(&path, Provenance::default()).unwrap();
    Footprints::read(&path).unwrap()
}

/// Instances of eight Gaussians.
pub fn instances(label: [i32; 8]) -> Instances {
    let count = |k| label.iter().filter(|&&l| l == k).count() as u32;
    let count = (0..=label.into_iter().max().unwrap()).map(count).collect();
    Instances { label: label.to_vec(), count, ..Instances::default() }
}
