//! What lies beside photographs: masks and depth images, in all the ways that people write them.

use super::*;
use gs_scene::dataset::Odd;
use image::{GrayAlphaImage, GrayImage, ImageBuffer, Luma, LumaA, RgbaImage};
use std::path::PathBuf;

/// A scene of one photograph of 4 x 2 pixels, with these fields of its frame and of its file.
fn scene(root: &Path, frame: serde_json::Value, file: serde_json::Value) -> gs_io::Result<Dataset> {
    plain(4, 2).write_png(root.join("a.png")).unwrap();
    let mut all = json!({"file_path": "a.png", "transform_matrix": opengl(&cameras(1, 4, 2)[0])});
    all.as_object_mut().unwrap().extend(frame.as_object().unwrap().clone());
    let mut json = json!({"w": 4, "h": 2, "fl_x": 4.0, "frames": [all]});
    json.as_object_mut().unwrap().extend(file.as_object().unwrap().clone());
    write(&root.join("transforms.json"), &json.to_string());
    dataset::load(root, &FULL)
}

#[test]
fn a_mask_means_the_same_however_it_is_written() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path();
    let d = scene(root, json!({}), json!({})).unwrap();
    let drawn = [1u8, 1, 0, 1, 0, 0, 0, 1];
    let counts = drawn.map(f32::from);
    let grey = |white: u8| GrayImage::from_raw(4, 2, drawn.map(|v| v * white).to_vec()).unwrap();
    let deep =
        |white: u16| ImageBuffer::<Luma<u16>, _>::from_raw(4, 2, drawn.map(|v| u16::from(v) * white).to_vec()).unwrap();
    let rgba = |f: fn(u8) -> [u8; 4]| RgbaImage::from_raw(4, 2, drawn.iter().flat_map(|&v| f(v)).collect()).unwrap();
    let path = |name: &str| root.join(format!("{name}.png"));
    grey(255).save(path("usual")).unwrap();
    grey(1).save(path("0 and 1")).unwrap();
    deep(65_535).save(path("16 bits")).unwrap();
    deep(255).save(path("16 bits to 255")).unwrap();
    deep(1).save(path("16 bits to 1")).unwrap();
    rgba(|v| [255, 255, 255, 255 * v]).save(path("alpha of white")).unwrap();
    rgba(|v| [0, 0, 0, 255 * v]).save(path("alpha of black")).unwrap();
    rgba(|v| [255 * v, 255 * v, 255 * v, 255]).save(path("opaque")).unwrap();
    GrayAlphaImage::from_fn(4, 2, |x, y| LumaA([255, 255 * drawn[(4 * y + x) as usize]]))
        .save(path("grey and alpha"))
        .unwrap();
    // Of one bit a pixel.
    let bits = "89504e470d0a1a0a0000000d494844520000000400000002010000000057d340ce0000000f494441547801010400fbff00d00010028400e1455c66d40000000049454e44ae426082";
    let bytes =
        (0..bits.len()).step_by(2).map(|i| u8::from_str_radix(&bits[i..i + 2], 16).unwrap()).collect::<Vec<_>>();
    fs::write(path("bits"), bytes).unwrap();
    for (name, odd) in [
        ("usual", None),
        ("0 and 1", Some(Odd::ZeroAndOne)),
        ("16 bits", None),
        ("16 bits to 255", Some(Odd::EightBits)),
        ("16 bits to 1", Some(Odd::ZeroAndOne)),
        ("alpha of white", Some(Odd::Alpha)),
        ("alpha of black", Some(Odd::Alpha)),
        ("opaque", None),
        ("grey and alpha", Some(Odd::Alpha)),
        ("bits", None),
    ] {
        assert_eq!(d.views[0].load_mask(&path(name)).unwrap(), counts, "{name}");
        assert_eq!(d.views[0].read_mask(&path(name)).unwrap().odd, odd, "{name}");
    }
    // Numbers of things, as many programs write them, are no masks: that is said.
    grey(3).save(path("ids")).unwrap();
    assert_eq!(d.views[0].read_mask(&path("ids")).unwrap().odd, Some(Odd::Dim));
    // Nothing counts, or everything.
    for (white, all, odd) in [(0, 0.0, Some(Odd::Black)), (255, 1.0, None)] {
        GrayImage::from_pixel(4, 2, Luma([white])).save(path("plain")).unwrap();
        let mask = d.views[0].read_mask(&path("plain")).unwrap();
        assert_eq!((mask.values, mask.odd), (vec![all; 8], odd));
    }
    GrayImage::new(2, 1).save(path("small")).unwrap();
    let e = d.views[0].load_mask(&path("small")).unwrap_err().to_string();
    assert!(e.contains("small.png") && e.contains("found 2x1, expected 4x2"), "{e}");
}

#[test]
fn frames_name_their_masks() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path();
    fs::create_dir(root.join("masks")).unwrap();
    GrayImage::new(4, 2).save(root.join("masks/a.png")).unwrap();
    let d = scene(root, json!({"mask_path": "./masks/a.png"}), json!({})).unwrap();
    assert_eq!(d.views[0].mask_path(), Some(&*root.join("masks/a.png")));
    assert!(d.files.contains(&root.join("masks/a.png")) && d.warnings.is_empty());
    let d = scene(root, json!({"mask_path": "masks/b.png"}), json!({})).unwrap();
    assert!(
        d.views[0].mask_path().is_none() && d.warnings[0].contains("frames[0].mask_path: no such file"),
        "{:?}",
        d.warnings
    );
    let e = scene(root, json!({"mask_path": "../b.png"}), json!({})).unwrap_err().to_string();
    assert!(e.contains("frames[0].mask_path"), "{e}");
}

#[test]
fn depth_images_have_the_names_and_units_of_nerfstudio_and_of_instant_ngp() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path();
    let depth = ImageBuffer::from_fn(4, 2, |x, y| Luma([(1000 + 10 * x + y) as u16]));
    depth.save(root.join("d.png")).unwrap();
    let metres =
        ndarray::Array2::from_shape_fn((2, 4), |(y, x)| if (y, x) == (0, 0) { f32::NAN } else { 2.0 + x as f32 });
    gs_io::npy::write_f32(root.join("d.npy"), &metres).unwrap();
    let at = |frame, file, i: usize| scene(root, frame, file).unwrap().views[0].load_depth().unwrap().unwrap().depth[i];
    for (frame, file, i, expected) in [
        (json!({"depth_file_path": "d.png"}), json!({}), 6, 1.021),
        (json!({"depth_path": "d.png"}), json!({"integer_depth_scale": 0.0002}), 6, 0.2042),
        (json!({"depth_path": ".\\d.png"}), json!({"depth_unit_scale_factor": 0.01}), 6, 10.21),
        (json!({"depth_file_path": "d.npy"}), json!({"depth_unit_scale_factor": 1.0}), 6, 4.0),
        (json!({"depth_file_path": "d.npy"}), json!({"depth_unit_scale_factor": 1.0}), 0, 0.0),
    ] {
        let found = at(frame.clone(), file, i);
        assert!((f64::from(found) - expected).abs() < 1e-6, "{frame}: {found}");
    }
    let refused = |name: &str, file: serde_json::Value, says: &[&str]| {
        let e = scene(root, json!({"depth_path": name}), file)
            .and_then(|d| d.views[0].load_depth())
            .unwrap_err()
            .to_string();
        assert!(says.iter().all(|word| e.contains(word)) && e.lines().count() == 1, "{e}");
    };
    refused("d.png", json!({"integer_depth_scale": 0}), &["integer_depth_scale", "a number above zero"]);
    gs_io::npy::write_f32(root.join("flat.npy"), &ndarray::Array1::<f32>::zeros(8)).unwrap();
    refused("flat.npy", json!({}), &["flat.npy", "not a depth image", "[8]"]);
    ImageBuffer::from_pixel(2, 4, Luma([1u16])).save(root.join("tall.png")).unwrap();
    refused("tall.png", json!({}), &["tall.png", "another shape than the photograph", "2x4"]);
    let exr = PathBuf::from("d.exr");
    fs::write(root.join(&exr), b"v/1\x01").unwrap();
    refused("d.exr", json!({}), &["d.exr"]);
}
