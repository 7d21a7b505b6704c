//! The method on real photographs: SAM's masks of a desk and small Gaussians of it lie in testdata/desk-run, the photographs don't.
//! The figures move when a rule of stage 3 breaks: without small parts that leave they are 0.570 and 0.464, with an agreement of 0.08
//! 0.617 and 0.439, of 0.4 0.630 and 0.507, with large masks alone 0.486 and 0.364, with small ones alone 0.602 and 0.484.

use ndarray::Array3;
use std::path::Path;
use std::process::Command;

const LEVELS: usize = 4;

#[test]
fn things_on_a_desk_are_found_as_well_as_ever() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").canonicalize().unwrap();
    let given = root.join("testdata/desk-run");
    let dir = tempfile::tempdir().unwrap();
    let here = |name: &str| dir.path().join(name);
    for folder in ["scene/images", "scene/sparse/0", "masks"] {
        std::fs::create_dir_all(here(folder)).unwrap();
    }
    for file in ["cameras.bin", "images.bin", "points3D.bin"] {
        std::fs::copy(given.join("sparse/0").join(file), here("scene/sparse/0").join(file)).unwrap();
    }
    // No stage looks at the photographs, but all want to see them.
    let photograph = here("grey.jpg");
    image::GrayImage::new(1906, 1070).save(&photograph).unwrap();
    let mut views = 0;
    for file in std::fs::read_dir(given.join("masks")).unwrap() {
        let file = file.unwrap().path();
        let view = file.file_stem().unwrap().to_str().unwrap();
        std::fs::copy(&photograph, here("scene/images").join(format!("{view}.jpg"))).unwrap();
        // The levels lie below each other; 0 is no mask.
        let picture = image::open(&file).unwrap().into_luma16();
        let (width, height) = (picture.width() as usize, picture.height() as usize / LEVELS);
        let ids = picture.into_raw().into_iter().map(|id| i32::from(id) - 1).collect();
        let ids = Array3::from_shape_vec((LEVELS, height, width), ids).unwrap();
        gs_io::npy::write_i32(here("masks").join(format!("{view}_s.npy")), &ids).unwrap();
        views += 1;
    }
    assert_eq!(views, 29);

    let run = |words: &[&str]| {
        let geometry = given.join("geometry.spz");
        let mut command = Command::new(env!("CARGO_BIN_EXE_cags"));
        command.current_dir(dir.path()).args(words).args(["--scene", "scene", "--quiet", "--geometry"]).arg(geometry);
        let done = command.output().unwrap();
        assert!(done.status.success(), "{words:?}: {}", String::from_utf8_lossy(&done.stderr));
    };
    run(&["graph", "--masks", "masks", "--graph", "graph.safetensors", "--footprints", "footprints.safetensors"]);
    let inputs = ["--masks", "masks", "--graph", "graph.safetensors", "--footprints", "footprints.safetensors"];
    run(&[&["cluster"], &inputs[..], &["--out", "instances.safetensors"]].concat());
    // Label mIoU on nine things in four views, and on 36 in six.
    for (labels, least, most) in [("desk", 0.64, 0.70), ("desk-full", 0.47, 0.53)] {
        let labels = root.join("testdata").join(labels);
        let labels = labels.to_str().unwrap();
        run(&[
            "score",
            "--instances",
            "instances.safetensors",
            "--labels",
            labels,
            "--out",
            "score.json",
            "--overwrite",
        ]);
        let score: serde_json::Value = serde_json::from_slice(&std::fs::read(here("score.json")).unwrap()).unwrap();
        let miou = score["label_miou"].as_f64().unwrap();
        assert!((least..=most).contains(&miou), "{labels}: {miou}; if the method got better, raise the range");
    }
}
