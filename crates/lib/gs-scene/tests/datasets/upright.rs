//! Photographs with EXIF orientation.

use super::*;
use std::io::Cursor;

/// A JPEG whose EXIF data say an orientation; 1 is upright.
fn jpeg(picture: &Image, orientation: u8) -> Vec<u8> {
    let picture = image::RgbImage::from_raw(picture.width, picture.height, picture.to_rgb8()).unwrap();
    let mut out = Cursor::new(Vec::new());
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut out, 98).encode_image(&picture).unwrap();
    let mut bytes = out.into_inner();
    // One entry, 0x0112, of one short number.
    let tiff =
        [b"II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0".as_slice(), &[orientation, 0, 0, 0, 0, 0, 0, 0]].concat();
    let segment = [&[0xFF, 0xE1, 0, (tiff.len() + 8) as u8], b"Exif\0\0".as_slice(), &tiff].concat();
    bytes.splice(2..2, segment);
    bytes
}

/// What each pixel of the turned picture was, and where a point of the picture as it lies comes to be.
fn turned(lying: &Image, orientation: u8) -> Image {
    let rgb = image::ImageBuffer::<image::Rgb<f32>, Vec<f32>>::from_raw(lying.width, lying.height, lying.rgb.clone())
        .unwrap();
    let rgb = match orientation {
        3 => image::imageops::rotate180(&rgb),
        6 => image::imageops::rotate90(&rgb),
        8 => image::imageops::rotate270(&rgb),
        _ => rgb,
    };
    Image { width: rgb.width(), height: rgb.height(), rgb: rgb.into_raw(), alpha: None }
}

fn turned_point((x, y): (f64, f64), (w, h): (f64, f64), orientation: u8) -> (f64, f64) {
    match orientation {
        3 => (w - x, h - y),
        6 => (h - y, x),
        8 => (y, w - x),
        _ => (x, y),
    }
}

fn seen(c: &Camera, p: DVec3) -> (f64, f64) {
    let p = c.rotation * p + c.translation;
    (c.fx * p.x / p.z + c.cx, c.fy * p.y / p.z + c.cy)
}

fn worst(a: &Image, b: &Image) -> f32 {
    assert_eq!((a.width, a.height), (b.width, b.height));
    a.rgb.iter().zip(&b.rgb).fold(0.0f32, |m, (a, b)| m.max((a - b).abs()))
}

/// A lens whose numbers all differ, and the photograph that it takes.
const LENS: [f64; 8] = [50.0, 56.0, 33.0, 22.0, 0.08, -0.02, 0.012, -0.007];
const SIZE: (u32, u32) = (64, 48);

fn lying() -> Image {
    let [fx, fy, cx, cy, k1, k2, p1, p2] = LENS;
    photograph(SIZE.0, SIZE.1, [fx, fy, cx, cy], [k1, k2, p1, p2])
}

/// A COLMAP scene of one photograph, with a camera of its pixels as they lie.
fn scene(root: &Path, orientation: u8) -> Dataset {
    let views = vec![("a.jpg".to_string(), cameras(1, SIZE.0, SIZE.1).remove(0))];
    text_model(&root.join("sparse/0"), &views, "OPENCV", &LENS);
    fs::create_dir_all(root.join("images")).unwrap();
    fs::write(root.join("images/a.jpg"), jpeg(&lying(), orientation)).unwrap();
    dataset::load(root, &FULL).unwrap()
}

#[test]
fn cameras_of_the_pixels_as_they_lie_are_turned_with_the_photograph() {
    let dir = tempfile::tempdir().unwrap();
    let straight = scene(dir.path(), 1);
    let (flat, size) = (straight.views[0].load_image().unwrap(), (f64::from(SIZE.0), f64::from(SIZE.1)));
    for orientation in [3, 6, 8] {
        let d = scene(dir.path(), orientation);
        let view = &d.views[0];
        assert!(worst(&view.load_image().unwrap(), &turned(&flat, orientation)) < 1e-4, "{orientation}");
        for p in [DVec3::ZERO, DVec3::new(0.4, -0.3, 0.2), DVec3::new(-0.5, 0.1, 0.6)] {
            let expected = turned_point(seen(&straight.views[0].camera, p), size, orientation);
            let (x, y) = seen(&view.camera, p);
            assert!(
                (x - expected.0).abs() < 1e-9 && (y - expected.1).abs() < 1e-9,
                "{orientation}: {x} {y} {expected:?}"
            );
        }
        // Only upside down, the size does not tell whether the camera is turned.
        let unclear =
            d.warnings.iter().filter(|w| w.contains("1 of 1 photographs, a.jpg first, are turned by EXIF")).count();
        assert_eq!(unclear, usize::from(orientation == 3), "{:?}", d.warnings);
        // Masks and id maps are of the pixels as they lie, or of the turned ones where their shape says so.
        let path = dir.path().join("mask.png");
        turned(&lying(), orientation).write_png(&path).unwrap();
        let of_turned = view.load_mask(&path);
        lying().write_png(&path).unwrap();
        let of_lying = view.load_mask(&path).unwrap();
        if orientation != 3 {
            assert_eq!(of_turned.unwrap(), of_lying);
        }
        let blue: Vec<f32> = flat.rgb.chunks_exact(3).map(|p| p.iter().sum::<f32>() / 3.0).collect();
        let blue = Image { rgb: blue.into_iter().flat_map(|v| [v; 3]).collect(), ..flat.clone() };
        let expected = turned(&blue, orientation);
        let off = of_lying.iter().zip(expected.rgb.iter().step_by(3)).fold(0.0f32, |m, (a, b)| m.max((a - b).abs()));
        assert!(off < 0.03, "{orientation}: {off}");
        let ids: Vec<u32> = (0..SIZE.0 * SIZE.1).collect();
        let (mut plain, mut turned_ids) = (ids.clone(), ids);
        let shape = (SIZE.0 as usize, SIZE.1 as usize);
        straight.views[0].straighten(&mut plain, shape);
        let found = view.straighten(&mut turned_ids, shape);
        assert_eq!(found, (view.camera.width as usize, view.camera.height as usize));
        let at = |x: usize, y: usize| {
            let (x, y) = turned_point((x as f64 + 0.5, y as f64 + 0.5), size, orientation);
            turned_ids[y as usize * found.0 + x as usize]
        };
        // Rounding on the border between two pixels may go either way.
        let same = (0..shape.1).flat_map(|y| (0..shape.0).map(move |x| (x, y)));
        let same = same.filter(|&(x, y)| at(x, y) == plain[y * shape.0 + x]).count();
        assert!(same * 100 > 99 * plain.len(), "{orientation}: {same} of {}", plain.len());
    }
    // Photographs whose poses scripts/poses.py found are known to be as the lens saw them.
    assert!(straight.warnings.len() == 1 && straight.warnings[0].contains("distorted"), "{:?}", straight.warnings);
    write(&dir.path().join("poses.json"), "{}");
    assert!(scene(dir.path(), 6).warnings.is_empty());
}

#[test]
fn cameras_of_turned_photographs_and_those_without_a_size_see_them_upright() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path();
    let c = &cameras(1, 48, 64)[0];
    fs::write(root.join("a.jpg"), jpeg(&lying(), 6)).unwrap();
    let upright = turned(&lying(), 6);
    let lens = |size: serde_json::Value, cx: f64, cy: f64| {
        let mut json = json!({"fl_x": 50.0, "fl_y": 50.0, "cx": cx, "cy": cy,
            "frames": [{"file_path": "a.jpg", "transform_matrix": opengl(c)}]});
        json.as_object_mut().unwrap().extend(size.as_object().unwrap().clone());
        write(&root.join("transforms.json"), &json.to_string());
        dataset::load(root, &FULL)
    };
    for size in [json!({"w": 48, "h": 64}), json!({})] {
        let d = lens(size, 25.5, 31.25).unwrap();
        assert_eq!((d.views[0].camera.width, d.views[0].camera.cx, d.warnings.len()), (48, 25.5, 0));
        assert!((d.views[0].camera.rotation - c.rotation).to_cols_array().iter().all(|v| v.abs() < 1e-9));
        assert!(worst(&d.views[0].load_image().unwrap(), &upright) < 0.03);
    }
    // The middle is that of the pixels as they lie: so is the camera.
    let d = lens(json!({}), 32.0, 24.0).unwrap();
    assert_eq!((d.views[0].camera.width, d.views[0].camera.cx), (48, 24.0));
    assert!((d.views[0].camera.rotation - c.rotation).to_cols_array().iter().any(|v| v.abs() > 0.1));
    let e = lens(json!({"w": 30, "h": 40}), 15.0, 20.0).unwrap_err().to_string();
    assert!(e.contains("another size than its camera; found 64x48"), "{e}");
    // A picture by itself is upright, too.
    assert!(worst(&Image::read(root.join("a.jpg")).unwrap(), &upright) < 0.03);
}

#[test]
fn square_photographs_say_that_their_size_tells_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path();
    let views = colmap_scene(root, &cameras(3, 32, 32));
    for (name, c) in &views[1..] {
        fs::write(root.join("images").join(name), jpeg(&plain(c.width, c.height), 8)).unwrap();
    }
    let d = dataset::load(root, &FULL).unwrap();
    assert!(
        d.warnings.len() == 1 && d.warnings[0].contains("2 of 3 photographs, frame_00001.png first"),
        "{:?}",
        d.warnings
    );
    assert!(worst(&d.views[1].load_image().unwrap(), &turned(&plain(32, 32), 8)) < 0.03);
}
