//! Datasets in every layout, made on the spot.

mod beside;
mod upright;
mod which;

use glam::{DMat3, DVec3};
use gs_scene::dataset::{self, Dataset, Format, LoadOptions, Resolution, Split};
use gs_scene::{Camera, Image, PointCloud, colmap, ply};
use serde_json::json;
use std::fs;
use std::path::Path;

const FULL: LoadOptions = LoadOptions { resolution: Resolution::Divisor(1.0), holdout: 8 };

/// Cameras around the origin, none of whose axes lies along another's.
fn cameras(n: usize, width: u32, height: u32) -> Vec<Camera> {
    (0..n)
        .map(|i| {
            let a = 0.3 + 0.7 * i as f64;
            let eye = DVec3::new(3.0 * a.cos(), 3.0 * a.sin(), 1.0 + 0.1 * i as f64);
            let c = Camera::look_at(eye, DVec3::new(0.1, -0.2, 0.3), DVec3::Z, width, height, 1.0);
            Camera { fx: c.fx * 1.01, cx: c.cx + 1.5, cy: c.cy - 0.75, ..c }
        })
        .collect()
}

/// A smooth picture of two variables, -1 to 1 over a 90-degree field of view.
fn picture(u: f64, v: f64) -> [f32; 3] {
    [0.5 + 0.4 * (2.0 * u).sin(), 0.5 + 0.4 * (3.0 * v).cos(), 0.5 + 0.3 * (u * v)].map(|x| x as f32)
}

/// What a camera with these intrinsics and OpenCV distortion k1 k2 p1 p2 sees of [`picture`], a closed form but for the
/// inversion of the distortion, which is Newton's.
fn photograph(w: u32, h: u32, [fx, fy, cx, cy]: [f64; 4], [k1, k2, p1, p2]: [f64; 4]) -> Image {
    let distort = |u: f64, v: f64| {
        let r2 = u * u + v * v;
        let radial = 1.0 + k1 * r2 + k2 * r2 * r2;
        (
            u * radial + 2.0 * p1 * u * v + p2 * (r2 + 2.0 * u * u),
            v * radial + p1 * (r2 + 2.0 * v * v) + 2.0 * p2 * u * v,
        )
    };
    let mut rgb = Vec::new();
    for i in 0..w * h {
        let x = (f64::from(i % w) + 0.5 - cx) / fx;
        let y = (f64::from(i / w) + 0.5 - cy) / fy;
        let (mut u, mut v) = (x, y);
        for _ in 0..20 {
            let (e, (a, b)) = (1e-6, distort(u, v));
            let ((au, bu), (av, bv)) = (distort(u + e, v), distort(u, v + e));
            let (j00, j01, j10, j11) = ((au - a) / e, (av - a) / e, (bu - b) / e, (bv - b) / e);
            let det = j00 * j11 - j01 * j10;
            u -= (j11 * (a - x) - j01 * (b - y)) / det;
            v -= (j00 * (b - y) - j10 * (a - x)) / det;
        }
        rgb.extend(picture(u, v));
    }
    Image { width: w, height: h, rgb, alpha: None }
}

fn plain(w: u32, h: u32) -> Image {
    photograph(w, h, [f64::from(w), f64::from(w), 0.5 * f64::from(w), 0.5 * f64::from(h)], [0.0; 4])
}

fn points() -> PointCloud {
    PointCloud {
        positions: vec![[0.5, -0.25, 1.0], [1.0, 2.0, 3.0]],
        colors: vec![[1, 2, 3], [250, 251, 252]],
        ..PointCloud::default()
    }
}

/// Names of the files that a dataset consists of, below its folder.
fn files(d: &Dataset) -> Vec<String> {
    d.files.iter().map(|f| f.strip_prefix(&d.root).unwrap().to_string_lossy().into_owned()).collect()
}

/// A COLMAP scene in `root` with a photograph a camera.
fn colmap_scene(root: &Path, cameras: &[Camera]) -> Vec<(String, Camera)> {
    let views: Vec<_> = cameras.iter().enumerate().map(|(i, c)| (format!("frame_{i:05}.png"), c.clone())).collect();
    colmap::write_model(&root.join("sparse/0"), &views, &points()).unwrap();
    for (name, c) in &views {
        plain(c.width, c.height).write_png(root.join("images").join(name)).unwrap();
    }
    views
}

fn write(path: &Path, text: &str) {
    fs::create_dir_all(path.parent().unwrap()).unwrap();
    fs::write(path, text).unwrap();
}

/// Writes the model as text, with `model` and its parameters, in place of a binary one.
fn text_model(folder: &Path, views: &[(String, Camera)], model: &str, parameters: &[f64]) {
    let _ = fs::remove_dir_all(folder);
    let words = |v: &[f64]| v.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
    let c = &views[0].1;
    let size = format!("{} {}", c.width, c.height);
    write(&folder.join("cameras.txt"), &format!("# Camera list\n7 {model} {size} {}\n", words(parameters)));
    let mut images = String::from("# Image list\n# two lines an image\n");
    for (i, (name, c)) in views.iter().enumerate() {
        let [x, y, z, w] = glam::DQuat::from_mat3(&c.rotation).to_array();
        let pose = words(&[&[w, x, y, z][..], &c.translation.to_array()].concat());
        // Half of the images see nothing: an empty line.
        let seen = if i % 2 == 0 { "1.5 2.5 -1 3.0 4.0 12" } else { "" };
        images += &format!("{} {pose} 7 {name}\n{seen}\n", i + 1);
    }
    write(&folder.join("images.txt"), &images);
    let points = "# Points\n1 0.5 -0.25 1 1 2 3 0.7 1 0 2 5\n2 1 2 3 250 251 252 0.1\n";
    write(&folder.join("points3D.txt"), points);
}

fn assert_same_cameras(a: &Dataset, b: &Dataset, tolerance: f64) {
    assert_eq!(a.views.len(), b.views.len());
    for (a, b) in a.views.iter().zip(&b.views) {
        assert_eq!((a.camera.width, a.camera.height), (b.camera.width, b.camera.height));
        let numbers = |c: &Camera| {
            [&[c.fx, c.fy, c.cx, c.cy][..], &c.rotation.to_cols_array(), &c.translation.to_array()].concat()
        };
        for (x, y) in numbers(&a.camera).into_iter().zip(numbers(&b.camera)) {
            assert!((x - y).abs() < tolerance, "{}: {x} {y}", a.name);
        }
    }
}

/// Rows of the world-from-camera matrix with OpenGL's axes.
fn opengl(c: &Camera) -> [[f64; 4]; 4] {
    let r = c.rotation.transpose() * DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    let p = c.position();
    let row = |i: usize| [r.x_axis[i], r.y_axis[i], r.z_axis[i], p[i]];
    [row(0), row(1), row(2), [0.0, 0.0, 0.0, 1.0]]
}

#[test]
fn a_binary_model_round_trips() {
    let dir = tempfile::tempdir().unwrap();
    let cameras = cameras(9, 40, 30);
    let views = colmap_scene(dir.path(), &cameras);
    let d = dataset::load(dir.path(), &FULL).unwrap();
    assert_eq!((d.format, d.points, d.warnings.len()), (Format::Colmap, points(), 0));
    assert_eq!(d.views.len(), 9);
    for (v, (name, c)) in d.views.iter().zip(&views) {
        assert_eq!(&v.name, name);
        assert_eq!(v.stem(), name.trim_end_matches(".png"));
        assert_eq!([v.camera.fx, v.camera.fy, v.camera.cx, v.camera.cy], [c.fx, c.fy, c.cx, c.cy]);
        assert!(v.camera.position().distance(c.position()) < 1e-12);
        assert!((v.camera.rotation - c.rotation).to_cols_array().iter().all(|e| e.abs() < 1e-14));
    }
    // Equal cameras are written once.
    assert_eq!(fs::read(dir.path().join("sparse/0/cameras.bin")).unwrap().len(), 8 + 24 + 4 * 8);
    assert_eq!(d.views[3].load_image().unwrap().rgb.len(), 3 * 40 * 30);
}

#[test]
fn text_and_binary_models_are_the_same() {
    let dir = tempfile::tempdir().unwrap();
    let (a, b) = (dir.path().join("a"), dir.path().join("b"));
    let views = colmap_scene(&a, &cameras(5, 40, 30));
    colmap_scene(&b, &cameras(5, 40, 30));
    let c = &views[0].1;
    text_model(&b.join("sparse"), &views, "PINHOLE", &[c.fx, c.fy, c.cx, c.cy]);
    let (a, b) = (dataset::load(&a, &FULL).unwrap(), dataset::load(&b, &FULL).unwrap());
    assert_same_cameras(&a, &b, 1e-12);
    assert_eq!(a.points, b.points);
}

#[test]
fn names_may_hold_blanks_and_folders_and_stems_stay_apart() {
    let dir = tempfile::tempdir().unwrap();
    let mut views = colmap_scene(dir.path(), &cameras(3, 16, 12));
    let images = dir.path().join("images");
    for (i, name) in ["left/my photo.png", "right/my photo.png", "c.png"].into_iter().enumerate() {
        fs::create_dir_all(images.join(name).parent().unwrap()).unwrap();
        fs::rename(images.join(&views[i].0), images.join(name)).unwrap();
        views[i].0 = name.into();
    }
    text_model(&dir.path().join("sparse/0"), &views, "SIMPLE_PINHOLE", &[20.0, 8.0, 6.0]);
    let d = dataset::load(dir.path(), &FULL).unwrap();
    let stems: Vec<&str> = d.views.iter().map(dataset::View::stem).collect();
    assert_eq!(stems, ["c", "left_my photo", "right_my photo"]);
    assert_eq!(d.views[0].camera.fy, 20.0);
    let model = ["cameras", "images", "points3D"].map(|name| format!("sparse/0/{name}.txt"));
    let photographs = ["c.png", "left/my photo.png", "right/my photo.png"].map(|name| format!("images/{name}"));
    assert_eq!(files(&d), [model, photographs].concat());
}

#[test]
fn holding_out_and_shrinking() {
    let dir = tempfile::tempdir().unwrap();
    colmap_scene(dir.path(), &cameras(9, 41, 30));
    let held = |holdout| {
        let d = dataset::load(dir.path(), &LoadOptions { holdout, ..FULL }).unwrap();
        (0..9).filter(|&i| d.views[i].split == Split::Test).collect::<Vec<_>>()
    };
    assert_eq!(held(8), [0, 8]);
    assert_eq!(held(3), [0, 3, 6]);
    assert!(held(0).is_empty());
    let resolution = "2".parse().unwrap();
    let d = dataset::load(dir.path(), &LoadOptions { resolution, holdout: 8 }).unwrap();
    let full = dataset::load(dir.path(), &LoadOptions::default()).unwrap();
    let (small, large) = (&d.views[0].camera, &full.views[0].camera);
    assert_eq!((small.width, small.height, large.width), (21, 15, 41));
    // The same ray falls on the same fraction of the image.
    let p = DVec3::new(0.2, 0.1, 0.4);
    let ((u, v, _), (lu, lv, _)) = (small.project(p), large.project(p));
    assert!((u / 21.0 - lu / 41.0).abs() < 1e-12 && (v / 15.0 - lv / 30.0).abs() < 1e-12);
    let image = d.views[0].load_image().unwrap();
    assert_eq!((image.width, image.height, image.rgb.len()), (21, 15, 21 * 15 * 3));
    let wide = |text: &str| {
        let d = LoadOptions { resolution: text.parse().unwrap(), holdout: 8 };
        let c = dataset::load(dir.path(), &d).unwrap().views[0].camera.clone();
        (c.width, c.height, d.resolution.to_string())
    };
    assert_eq!(wide("20px"), (20, 15, "20px".to_string()));
    assert_eq!(wide("800px"), (41, 30, "800px".to_string()), "photographs are never enlarged");
    for bad in ["0", "0.5", "-3", "NaN", "inf", "big", "", "px", "0px", "-20px", "2.5px"] {
        let e = bad.parse::<Resolution>().unwrap_err().to_string();
        assert!(e.contains("not a resolution") && e.contains("auto"), "{e}");
    }
    assert_eq!("auto".parse::<Resolution>().unwrap(), Resolution::Auto);
    // 20 for 20px is easily typed.
    let resolution = Resolution::Divisor(20.0);
    let said = dataset::load(dir.path(), &LoadOptions { resolution, ..FULL }).unwrap().warnings.join(" ");
    assert!(full.warnings.is_empty() && said.contains("2x2 pixels") && said.contains("write 20px"), "{said}");
}

#[test]
fn the_hash_is_of_contents_not_of_places() {
    let dir = tempfile::tempdir().unwrap();
    let (a, b) = (dir.path().join("a"), dir.path().join("elsewhere/b"));
    colmap_scene(&a, &cameras(4, 20, 16));
    colmap_scene(&b, &cameras(4, 20, 16));
    let hash = |p: &Path, o: &LoadOptions| dataset::load(p, o).unwrap().hash().unwrap();
    let first = hash(&a, &FULL);
    assert_eq!(first, hash(&b, &FULL));
    assert_eq!(first.len(), 64);
    // One scene has one hash, however a stage loads it.
    assert_eq!(first, hash(&a, &LoadOptions { holdout: 2, resolution: Resolution::Divisor(2.0) }));
    let mut other = plain(20, 16);
    other.rgb[5] = 0.0;
    other.write_png(b.join("images/frame_00002.png")).unwrap();
    assert_ne!(first, hash(&b, &FULL));
    let mut moved = cameras(4, 20, 16);
    moved[1].translation.x += 1e-9;
    colmap_scene(&b, &moved);
    assert_ne!(first, hash(&b, &FULL));
}

/// Loads a scene of one view whose camera has `model` and compares the undistorted photograph to the closed form.
fn check_undistortion(model: &str, parameters: &[f64], intrinsics: [f64; 4], distortion: [f64; 4]) -> Camera {
    let dir = tempfile::tempdir().unwrap();
    let (w, h) = (160, 120);
    let c = Camera { width: w, height: h, ..cameras(1, w, h)[0].clone() };
    let photo = photograph(w, h, intrinsics, distortion);
    photo.write_png(dir.path().join("images/a.png")).unwrap();
    text_model(&dir.path().join("sparse/0"), &[("a.png".into(), c)], model, parameters);
    let d = dataset::load(dir.path(), &FULL).unwrap();
    let (view, image) = (&d.views[0], d.views[0].load_image().unwrap());
    let k = &view.camera;
    assert_eq!((k.width, k.height, image.width, image.height), (w, h, w, h));
    let mut worst = 0.0f32;
    for y in 0..h {
        for x in 0..w {
            let (u, v) = ((f64::from(x) + 0.5 - k.cx) / k.fx, (f64::from(y) + 0.5 - k.cy) / k.fy);
            let at = 3 * (y * w + x) as usize;
            let found = &image.rgb[at..at + 3];
            worst = found.iter().zip(picture(u, v)).fold(worst, |m, (a, b)| m.max((a - b).abs()));
        }
    }
    // 8 bits and bilinear interpolation on 160 pixels leave less than this; a shift of one pixel is 0.015.
    assert!(worst < 0.006, "{model}: {worst}");
    assert_eq!(d.warnings.len(), usize::from(view.is_distorted()), "{:?}", d.warnings);
    assert!(
        d.warnings.iter().all(|w| w.contains("the lenses of 1 of 1 photographs are distorted")),
        "{:?}",
        d.warnings
    );
    // What cannot be mixed comes from the nearest pixel: half a pixel off, of a map of the same or of half the size.
    for (shrink, most) in [(1, 0.012), (2, 0.02)] {
        let (before, after) = (photo.resize_area(w / shrink, h / shrink), image.resize_area(w / shrink, h / shrink));
        let planes = |i: &Image| [0, 1].map(|c| i.rgb.iter().skip(c).step_by(3).copied().collect::<Vec<_>>()).concat();
        let mut found = planes(&before);
        view.straighten(&mut found, ((w / shrink) as usize, (h / shrink) as usize));
        assert!(found.iter().all(|v| before.rgb.contains(v)), "{model}: a number that was not there");
        let worst = found.iter().zip(planes(&after)).fold(0.0f32, |m, (a, b)| m.max((a - b).abs()));
        assert!(worst < most, "{model}, shrunk by {shrink}: {worst}");
    }
    if distortion != [0.0; 4] {
        let off = photo.rgb.iter().zip(&image.rgb).fold(0.0f32, |m, (a, b)| m.max((a - b).abs()));
        assert!(off > 0.02, "{model}: the distortion does something");
    }
    k.clone()
}

#[test]
fn undistortion_matches_the_closed_form() {
    let (f, fx, fy, cx, cy) = (100.0, 101.0, 103.0, 82.0, 57.0);
    let square = [f, f, cx, cy];
    let k = check_undistortion("SIMPLE_PINHOLE", &[f, cx, cy], square, [0.0; 4]);
    assert_eq!([k.fx, k.fy, k.cx, k.cy], square);
    // A barrel leaves no corner empty, and the focal length stays.
    let k = check_undistortion("SIMPLE_RADIAL", &[f, cx, cy, -0.08], square, [-0.08, 0.0, 0.0, 0.0]);
    assert_eq!([k.fx, k.fy, k.cx, k.cy], square);
    // A pincushion does, and the camera zooms in.
    let k = check_undistortion("SIMPLE_RADIAL", &[f, cx, cy, 0.06], square, [0.06, 0.0, 0.0, 0.0]);
    assert!(k.fx > 1.02 * f && k.fx < 1.1 * f && k.fx == k.fy, "{}", k.fx);
    check_undistortion("RADIAL", &[f, cx, cy, -0.1, 0.02], square, [-0.1, 0.02, 0.0, 0.0]);
    let d = [-0.09, 0.015, 0.002, -0.003];
    let opencv = [fx, fy, cx, cy, d[0], d[1], d[2], d[3]];
    check_undistortion("OPENCV", &opencv, [fx, fy, cx, cy], d);
    check_undistortion("FULL_OPENCV", &[&opencv[..], &[0.0; 4]].concat(), [fx, fy, cx, cy], d);
    // (1 + a r2) / (1 + a r2) is no distortion at all.
    let parameters = [100.0, 100.0, 80.0, 60.0, 0.2, 0.1, 0.0, 0.0, 0.05, 0.2, 0.1, 0.05];
    check_undistortion("FULL_OPENCV", &parameters, [100.0, 100.0, 80.0, 60.0], [0.0; 4]);
}

#[test]
fn impossible_lenses_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let views = colmap_scene(dir.path(), &cameras(1, 40, 30));
    for (model, parameters, expected) in [
        ("SIMPLE_RADIAL", &[20.0, 20.0, 15.0, -1e6][..], "frame_00000.png: camera: the lens distortion is too strong"),
        (
            "SIMPLE_RADIAL",
            &[20.0, 20.0, 15.0],
            "line 2: unsupported camera model; found SIMPLE_RADIAL with 3 parameters",
        ),
        ("OPENCV_FISHEYE", &[20.0, 20.0, 20.0, 15.0, 0.0, 0.0, 0.0, 0.0], "unsupported camera model"),
        ("PINHOLE", &[20.0, f64::NAN, 20.0, 15.0], "impossible camera parameters"),
        ("PINHOLE", &[20.0, 0.0, 20.0, 15.0], "impossible camera parameters"),
    ] {
        text_model(&dir.path().join("sparse/0"), &views, model, parameters);
        let e = dataset::load(dir.path(), &FULL).unwrap_err().to_string();
        assert!(e.contains(expected), "{e}\nlacks {expected}");
        assert_eq!(e.contains("image_undistorter"), !e.contains("impossible"), "{e}");
    }
}

#[test]
fn transforms_give_the_poses_of_colmap() {
    let dir = tempfile::tempdir().unwrap();
    let (a, b) = (dir.path().join("a"), dir.path().join("b"));
    let cameras = cameras(4, 40, 30);
    let views = colmap_scene(&a, &cameras);
    colmap_scene(&b, &cameras);
    fs::remove_dir_all(b.join("sparse")).unwrap();
    ply::write_points(b.join("sparse_pc.ply"), &points(), &[]).unwrap();
    let frames: Vec<_> = views
        .iter()
        .map(|(name, c)| json!({"file_path": format!("./images/{name}"), "transform_matrix": opengl(c)}))
        .collect();
    let c = &cameras[0];
    let json = json!({"camera_model": "OPENCV", "w": 40, "h": 30, "fl_x": c.fx, "fl_y": c.fy, "cx": c.cx,
        "cy": c.cy, "k1": 0.0, "k2": 0, "p1": 0.0, "p2": 0.0, "ply_file_path": "sparse_pc.ply", "frames": frames});
    write(&b.join("transforms.json"), &json.to_string());
    let (a, b) = (dataset::load(&a, &FULL).unwrap(), dataset::load(&b, &FULL).unwrap());
    assert_eq!(b.format, Format::Transforms);
    assert_same_cameras(&a, &b, 1e-12);
    assert_eq!(a.points, b.points);
    assert_eq!(b.views[1].name, "frame_00001.png");
    assert_eq!(files(&b)[..3], ["transforms.json", "sparse_pc.ply", "images/frame_00000.png"].map(String::from));
    assert!(a.files.len() == 7 && b.files.len() == 6);
    // The file itself may be named as well as its folder.
    let by_file = dataset::load(&b.root.join("transforms.json"), &FULL).unwrap();
    assert_eq!(by_file.views, b.views);
}

#[test]
fn blender_leaves_extension_and_size_out_and_keeps_alpha() {
    let dir = tempfile::tempdir().unwrap();
    let c = &cameras(1, 20, 16)[0];
    let mut rgba = Vec::new();
    for i in 0..320u32 {
        rgba.extend([200, 100, 50, (i % 256) as u8]);
    }
    for name in ["train/r_0.png", "test/r_0.png"] {
        let path = dir.path().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        image::save_buffer(&path, &rgba, 20, 16, image::ColorType::Rgba8).unwrap();
    }
    for part in ["train", "test"] {
        let frames = [json!({"file_path": format!("./{part}/r_0"), "rotation": 0.1, "transform_matrix": opengl(c)})];
        let json = json!({"camera_angle_x": 0.8, "frames": frames});
        write(&dir.path().join(format!("transforms_{part}.json")), &json.to_string());
    }
    let d = dataset::load(dir.path(), &FULL).unwrap();
    let splits: Vec<_> = d.views.iter().map(|v| (v.stem(), v.split)).collect();
    assert_eq!(splits, [("test_r_0", Split::Test), ("train_r_0", Split::Train)]);
    let k = &d.views[0].camera;
    assert!((k.fx - 10.0 / 0.4f64.tan()).abs() < 1e-12 && k.fy == k.fx && (k.cx, k.cy) == (10.0, 8.0));
    let alpha = d.views[1].load_image().unwrap().alpha.unwrap();
    assert!((alpha[7] - 7.0 / 255.0).abs() < 1e-6);
}

#[test]
fn frames_have_their_own_cameras_and_missing_files_are_listed() {
    let dir = tempfile::tempdir().unwrap();
    let c = cameras(4, 20, 16);
    plain(20, 16).write_png(dir.path().join("images/a.png")).unwrap();
    plain(30, 24).write_png(dir.path().join("images/b.png")).unwrap();
    plain(20, 16).write_png(dir.path().join("images/c.png")).unwrap();
    let m: Vec<_> = c.iter().map(opengl).collect();
    let json = json!({"fl_x": 20.0, "w": 20, "h": 16, "test_filenames": ["images/a.png"],
        "train_filenames": ["images/b.png"], "frames": [
        {"file_path": "images/a.png", "transform_matrix": m[0]},
        {"file_path": "images/b.png", "transform_matrix": m[1], "fl_x": 33.0, "fl_y": 34.0, "cx": 14.0, "cy": 13.0, "w": 30,
         "h": 24, "k1": -0.05},
        {"file_path": "images/c.png", "transform_matrix": [[0, 0, 0, 1], "LOST", [0, 0, 0, 0], [0, 0, 0, 0]]},
        {"file_path": "images/gone.png", "transform_matrix": m[3]}]});
    // Python writes infinities as words that are no JSON.
    let text = json.to_string().replace("\"LOST\"", "[NaN, -Infinity, 0, Infinity]");
    write(&dir.path().join("transforms.json"), &text);
    let d = dataset::load(dir.path(), &FULL).unwrap();
    let found: Vec<_> = d.views.iter().map(|v| (v.name.as_str(), v.split)).collect();
    assert_eq!(found, [("a.png", Split::Test), ("b.png", Split::Train)]);
    let k = &d.views[1].camera;
    assert_eq!([k.fx, k.fy, k.cx, k.cy, f64::from(k.width)], [33.0, 34.0, 14.0, 13.0, 30.0]);
    assert_eq!(d.warnings.len(), 2);
    assert!(d.warnings[0].contains("c.png: the pose is not finite, view skipped"), "{:?}", d.warnings);
    assert!(d.warnings[1].contains("gone.png: no such photograph, view skipped"), "{:?}", d.warnings);
}

/// ScanNet's pose file.
fn pose_text(c: &Camera) -> String {
    let r = c.rotation.transpose();
    let p = c.position();
    let row = |i: usize| format!("{} {} {} {}\n", r.x_axis[i], r.y_axis[i], r.z_axis[i], p[i]);
    row(0) + &row(1) + &row(2) + "0 0 0 1\n"
}

#[test]
fn both_layouts_of_scannet_agree() {
    let dir = tempfile::tempdir().unwrap();
    let (raw, converted) = (dir.path().join("raw"), dir.path().join("converted"));
    let cameras = cameras(5, 40, 30);
    let ids = [0, 20, 100, 40, 60];
    let mut frames = Vec::new();
    for (c, id) in cameras.iter().zip(ids) {
        let jpeg = image::RgbImage::from_raw(40, 30, plain(40, 30).to_rgb8()).unwrap();
        for root in [&raw, &converted] {
            fs::create_dir_all(root.join("color")).unwrap();
            jpeg.save(root.join(format!("color/{id}.jpg"))).unwrap();
        }
        let lost = "-inf -inf -inf -inf\n".repeat(4);
        write(&raw.join(format!("pose/{id}.txt")), &if id == 60 { lost } else { pose_text(c) });
        frames.push(json!({"file_path": format!("color/{id}"), "transform_matrix": opengl(c)}));
    }
    write(&raw.join("color/notes.txt"), "not a frame");
    let c = &cameras[0];
    let intrinsics = format!("{} 0 {} 0\n0 {} {} 0\n0 0 1 0\n0 0 0 1\n", c.fx, c.cx, c.fy, c.cy);
    write(&raw.join("intrinsic/intrinsic_color.txt"), &intrinsics);
    ply::write_points(raw.join("scene0000_00_vh_clean_2.ply"), &points(), &[]).unwrap();
    ply::write_points(converted.join("points3d.ply"), &points(), &[]).unwrap();
    frames.pop();
    let json = json!({"w": 40, "h": 30, "fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "frames": frames});
    // OpenGaussian writes all frames into both files.
    write(&converted.join("transforms_train.json"), &json.to_string());
    write(&converted.join("transforms_test.json"), &json.to_string());
    let mut a = dataset::load(&raw, &FULL).unwrap();
    let b = dataset::load(&converted, &FULL).unwrap();
    let names = |d: &Dataset| d.views.iter().map(|v| v.name.clone()).collect::<Vec<_>>();
    assert_eq!(
        (a.format, names(&a)),
        (Format::ScanNet, ["0.jpg", "20.jpg", "40.jpg", "100.jpg"].map(String::from).to_vec())
    );
    assert_eq!(
        (b.format, names(&b)),
        (Format::Transforms, ["0.jpg", "100.jpg", "20.jpg", "40.jpg"].map(String::from).to_vec())
    );
    assert!(a.warnings.len() == 1 && a.warnings[0].contains("60.txt: the pose is not finite"), "{:?}", a.warnings);
    a.views.sort_by(|a, b| a.name.cmp(&b.name));
    assert_same_cameras(&a, &b, 1e-12);
    assert_eq!((&a.points, &b.points), (&points(), &points()));
    let mut read = files(&a);
    read.sort();
    let poses = ["0", "100", "20", "40"].map(|id| format!("pose/{id}.txt")).to_vec();
    let photographs = ["0", "100", "20", "40"].map(|id| format!("color/{id}.jpg")).to_vec();
    let others = ["intrinsic/intrinsic_color.txt", "scene0000_00_vh_clean_2.ply"].map(String::from);
    assert_eq!(read, [photographs, others[..1].to_vec(), poses, others[1..].to_vec()].concat());
    assert_eq!(files(&b)[..3], ["transforms_train.json", "transforms_test.json", "points3d.ply"].map(String::from));
    assert_eq!(b.views_of(Split::Test).count(), 1, "no file names held-out views, so every eighth is");
    // Frames extracted at half size under full-size intrinsics.
    image::RgbImage::new(20, 15).save(raw.join("color/20.jpg")).unwrap();
    let e = dataset::load(&raw, &FULL).unwrap_err().to_string();
    assert!(e.contains("intrinsic_color.txt: fx fy cx cy: the intrinsics do not fit the frames"), "{e}");
}

#[test]
fn errors_name_file_field_found_and_expected() {
    fn put<const N: usize>(mut file: Vec<u8>, at: usize, bytes: [u8; N]) -> Vec<u8> {
        file[at..at + N].copy_from_slice(&bytes);
        file
    }
    type Spoil = fn(Vec<u8>) -> Vec<u8>;
    let cases: [(&str, Spoil, &str); 18] = [
        (
            "cameras.bin",
            |b| put(b, 0, u64::MAX.to_le_bytes()),
            "cameras.bin: camera count: the count does not fit the file's length; found 18446744073709551615, expected at most 2",
        ),
        (
            "cameras.bin",
            |b| put(b, 0, 0u64.to_le_bytes()),
            "cameras.bin: camera count: the count does not fit the file's length",
        ),
        ("cameras.bin", |_| vec![0; 8], "cameras.bin: camera count: the model has no camera"),
        // COLMAP 4's panoramic lens has no parameters but a size.
        ("cameras.bin", |b| put(b, 12, [17, 0, 0, 0])[..48].to_vec(), "unknown camera model; found model 17"),
        ("cameras.bin", |b| put(b, 12, [99, 0, 0, 0]), "cameras.bin: camera 1: unknown camera model; found model 99"),
        ("cameras.bin", |b| put(b, 12, [5, 0, 0, 0]), "cameras.bin: camera 1: the file is cut short"),
        ("cameras.bin", |b| put(b, 16, [0; 8]), "cameras.bin: camera 1: impossible image size; found 0x16"),
        (
            "cameras.bin",
            |b| put(b, 8, [42, 0, 0, 0]),
            "frame_00000.png: the image's camera is unknown; found camera 1, expected one of the 1 in",
        ),
        (
            "images.bin",
            |b| put(b, 0, 1u64.to_le_bytes()),
            "images.bin: image count: the count does not fit the file's length; found 1, and",
        ),
        (
            "images.bin",
            |b| put(b, 12, f64::NAN.to_le_bytes()),
            "images.bin: image 0: impossible pose; found quaternion [NaN",
        ),
        ("images.bin", |b| put(b, 44, f64::INFINITY.to_le_bytes()), "images.bin: image 0: impossible pose"),
        ("images.bin", |b| b[..b.len() - 9].to_vec(), "images.bin: image 1: the image's name does not end"),
        ("images.bin", |_| vec![0; 8], "images.bin: image count: the model has no image"),
        ("points3D.bin", |b| put(b, 16, f64::NAN.to_le_bytes()), "points3D.bin: point 0: the position is not finite"),
        ("points3D.bin", |b| put(b, 0, u64::MAX.to_le_bytes()), "points3D.bin: point count: the count does not fit"),
        ("points3D.bin", |b| b[..b.len() - 1].to_vec(), "points3D.bin: "),
        (
            "frame_00001.png",
            |_| plain(16, 20).to_png(),
            "frame_00001.png: size: the photograph has another size than its camera; found 16x20, expected 20x16",
        ),
        ("frame_00001.png", |_| b"not a picture".to_vec(), "frame_00001.png: not a readable picture"),
    ];
    let dir = tempfile::tempdir().unwrap();
    colmap_scene(dir.path(), &cameras(2, 20, 16));
    let refused = |expected: &str| {
        let e = dataset::load(dir.path(), &FULL).unwrap_err().to_string();
        assert!(e.contains(expected) && !e.contains('\n'), "{e}\nlacks {expected}");
    };
    for (name, spoil, expected) in cases {
        let path = dir.path().join(if name.ends_with("png") { "images" } else { "sparse/0" }).join(name);
        let good = fs::read(&path).unwrap();
        fs::write(&path, spoil(good.clone())).unwrap();
        refused(expected);
        fs::write(&path, good).unwrap();
    }
    fs::remove_file(dir.path().join("sparse/0/images.bin")).unwrap();
    refused("images.txt: cannot read");
}

#[test]
fn cameras_that_no_one_has_are_refused_whatever_the_layout() {
    let dir = tempfile::tempdir().unwrap();
    let root = |name: &str| dir.path().join(name);
    let camera = &cameras(1, 40, 30)[0];
    let colmap = |c: Camera| {
        colmap_scene(&root("colmap"), &[c]);
        dataset::load(&root("colmap"), &FULL).map_err(|e| e.to_string())
    };
    let transforms = |c: Camera| {
        plain(40, 30).write_png(root("json/a.png")).unwrap();
        let json = json!({"fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy,
            "frames": [{"file_path": "a.png", "transform_matrix": opengl(&c)}]});
        write(&root("json/transforms.json"), &json.to_string());
        dataset::load(&root("json"), &FULL).map_err(|e| e.to_string())
    };
    type Change = fn(&mut Camera);
    let of = |change: Change| {
        let mut c = camera.clone();
        change(&mut c);
        c
    };
    let focal = ": focal lengths: no camera has this; found ";
    let point = ": principal point: no camera has this; found ";
    let pose = ": translation: no camera has this; found [";
    let cases: [(Change, &str); 7] = [
        (|c| c.fx = 1e9, focal),
        (|c| (c.fx, c.fy) = (1e-9, 1e-9), focal),
        (|c| c.fy = 1e7, focal),
        (|c| c.cx = 1e6, point),
        (|c| c.cy = -200.0, point),
        (|c| c.translation.x = 2e12, pose),
        (|c| c.translation.y = 1e300, pose),
    ];
    for (change, expected) in cases {
        for e in [colmap(of(change)), transforms(of(change))].map(Result::unwrap_err) {
            assert!(e.contains(&format!(".png{expected}")) && e.contains("; correct the camera in "), "{e}");
        }
    }
    // A satellite's camera, one of 170 degrees, a quarter cut out of a photograph, a scene in metres from the Earth's middle.
    let real: [Change; 4] = [
        |c| (c.fx, c.fy) = (2e5, 2e5),
        |c| (c.fx, c.fy) = (1.8, 1.8),
        |c| (c.cx, c.cy) = (0.0, 30.0),
        |c| c.translation *= 6.4e6,
    ];
    for change in real {
        colmap(of(change)).unwrap();
        transforms(of(change)).unwrap();
    }
}

#[test]
fn missing_photographs_are_skipped_until_none_is_left() {
    let dir = tempfile::tempdir().unwrap();
    colmap_scene(dir.path(), &cameras(3, 20, 16));
    fs::remove_file(dir.path().join("images/frame_00001.png")).unwrap();
    let d = dataset::load(dir.path(), &FULL).unwrap();
    assert_eq!((d.views.len(), d.warnings.len()), (2, 1));
    assert!(d.warnings[0].contains("frame_00001.png: no such photograph"), "{:?}", d.warnings);
    fs::remove_dir_all(dir.path().join("images")).unwrap();
    let e = dataset::load(dir.path(), &FULL).unwrap_err().to_string();
    assert!(e.contains("no view is left; found ") && e.contains("frame_00000.png: no such photograph"), "{e}");
}

#[test]
fn photographs_without_poses_say_how_to_find_them() {
    let dir = tempfile::tempdir().unwrap();
    fs::write(dir.path().join("IMG_1.HEIC"), "").unwrap();
    let e = dataset::load(dir.path(), &FULL).unwrap_err().to_string();
    assert!(
        dataset::is_bare(dir.path()) && e.contains("photographs without poses") && e.contains("PHOTOGRAPHS="),
        "{e}"
    );
}

#[test]
fn folders_that_are_no_dataset_say_what_one_is() {
    let dir = tempfile::tempdir().unwrap();
    let e = dataset::load(dir.path(), &FULL).unwrap_err().to_string();
    assert!(e.contains("no dataset recognised") && e.contains("COLMAP") && e.contains("transforms.json"), "{e}");
    let e = dataset::load(&dir.path().join("nowhere"), &FULL).unwrap_err().to_string();
    assert!(e.contains("nowhere: no such folder"), "{e}");
}

#[test]
fn bad_transforms_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    plain(20, 16).write_png(dir.path().join("a.png")).unwrap();
    let good = opengl(&cameras(1, 20, 16)[0]);
    let load = |json: &serde_json::Value| {
        write(&dir.path().join("transforms.json"), &json.to_string());
        dataset::load(dir.path(), &FULL).map_err(|e| e.to_string())
    };
    let with = |key: &str, value: serde_json::Value| {
        let mut json = json!({"fl_x": 20.0, "frames": [{"file_path": "a.png", "transform_matrix": good}]});
        let owner = if key.starts_with("frame.") { &mut json["frames"][0] } else { &mut json };
        owner[key.trim_start_matches("frame.")] = value;
        load(&json)
    };
    // A row of other scale is the same pose; a transposed one is not.
    let scaled = good.map(|row| row.map(|v| 2.0 * v));
    assert!(with("frame.transform_matrix", json!(scaled)).is_ok());
    // Degrees.
    let wide = json!({"camera_angle_x": 51.5, "frames": [{"file_path": "a.png", "transform_matrix": good}]});
    assert!(load(&wide).unwrap_err().contains("frames[0], camera_angle_x: no angle of view; found 51.5"));
    for (key, value) in [("extra", json!(1)), ("is_fisheye", json!(false)), ("camera_model", json!("PINHOLE"))] {
        assert!(with(key, value).is_ok(), "{key}");
    }
    let mirrored = json!([[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]);
    let cases = [
        ("frames", json!(3), "frames: the file has no list of frames"),
        ("frames", json!([]), "no view is left"),
        ("frame.file_path", json!(null), "frames[0].file_path: the frame names no photograph; found null"),
        (
            "frame.file_path",
            json!("../../secret.png"),
            "frames[0].file_path: the photograph's name leads out of the dataset",
        ),
        ("frame.file_path", json!("/etc/a.png"), "leads out of the dataset"),
        ("frame.file_path", json!("..\\..\\etc\\a.png"), "leads out of the dataset"),
        ("frame.transform_matrix", json!([[1, 2], [3, 4]]), "frames[0].transform_matrix: not a 4x4 matrix"),
        ("frame.transform_matrix", mirrored, "frames[0].transform_matrix: the pose is not a rotation"),
        ("frame.transform_matrix", json!([[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]), "the pose is not a rotation"),
        (
            "frame.transform_matrix",
            json!([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1.5, 0, 2, 1]]),
            "the last row of the pose is not 0 0 0 1; found [1.5,0,2,1]",
        ),
        ("fl_x", json!(null), "no usable focal length"),
        ("fl_x", json!(-4), "no usable focal length"),
        ("fl_x", json!("long"), "frames[0], fl_x: not a number; found \"long\""),
        ("camera_model", json!("OPENCV_FISHEYE"), "unsupported camera model; found OPENCV_FISHEYE"),
        ("camera_model", json!(3), "frames[0], camera_model: unsupported camera model; found 3"),
        ("is_fisheye", json!(true), "frames[0], is_fisheye: unsupported camera model; found true, expected false"),
        ("is_fisheye", json!(1), "frames[0], is_fisheye: unsupported camera model; found 1"),
        ("frame.is_fisheye", json!("true"), "frames[0], is_fisheye: unsupported camera model; found true"),
        ("equirectangular", json!(true), "frames[0], equirectangular: unsupported camera model"),
        ("ftheta_p1", json!(0.001), "undistort the photographs first"),
        ("ply_file_path", json!("/etc/points.ply"), "ply_file_path: the photograph's name leads out"),
    ];
    for (key, value, expected) in cases {
        let e = with(key, value).unwrap_err();
        assert!(e.contains(expected) && !e.contains('\n'), "{e}\nlacks {expected}");
    }
    let two_sizes =
        json!({"fl_x": 20.0, "w": 21, "h": 16, "frames": [{"file_path": "a.png", "transform_matrix": good}]});
    assert!(load(&two_sizes).unwrap_err().contains("found 20x16, expected 21x16"));
    let twice = json!({"fl_x": 20.0, "frames": [{"file_path": "a.png", "transform_matrix": good},
        {"file_path": "a", "transform_matrix": good}]});
    assert!(load(&twice).unwrap_err().contains("two views have the same name"));
    write(&dir.path().join("transforms.json"), "{\"frames\": [");
    assert!(dataset::load(dir.path(), &FULL).unwrap_err().to_string().contains("transforms.json: not JSON"));
}

/// A dataset whose lens is distorted, and the same under refined cameras: other poses and focal lengths, the same pictures.
#[test]
fn refined_cameras_stand_for_a_dataset() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("scene");
    let views = colmap_scene(&root, &cameras(4, 60, 44));
    text_model(&root.join("sparse/0"), &views, "OPENCV", &[55.0, 56.0, 29.0, 22.5, -0.2, 0.05, 0.002, -0.003]);
    for name in ["cameras.bin", "images.bin"] {
        let _ = fs::remove_file(root.join("sparse/0").join(name));
    }
    let halved = LoadOptions { resolution: Resolution::Divisor(2.0), ..FULL };
    let given = dataset::load(&root, &halved).unwrap();
    let moved = |v: &dataset::View| {
        let turn = DMat3::from_rotation_y(0.02);
        let (rotation, translation) = (turn * v.camera.rotation, v.camera.translation + DVec3::new(0.1, 0.0, -0.05));
        Camera { fx: 1.03 * v.camera.fx, fy: 1.03 * v.camera.fy, rotation, translation, ..v.camera.clone() }
    };
    let wanted: Vec<Camera> = given.views.iter().map(moved).collect();
    let file = dir.path().join("g.cameras.json");
    dataset::refined::write(&file, &given, &wanted).unwrap();
    assert!(fs::read_to_string(&file).unwrap().contains("\"dataset\": \"scene\""), "relative where it lies below");
    for options in [&halved, &FULL] {
        let (own, refined) = (dataset::load(&root, options).unwrap(), dataset::load(&file, options).unwrap());
        assert_eq!(
            (&refined.root, refined.format, &refined.points),
            (&dir.path().join("scene"), own.format, &own.points)
        );
        for ((a, b), c) in refined.views.iter().zip(&own.views).zip(&wanted) {
            assert_eq!((&a.name, a.stem(), a.split, &a.image_path), (&b.name, b.stem(), b.split, &b.image_path));
            let d = c.resized(a.camera.width, a.camera.height);
            assert!((a.camera.rotation - d.rotation).abs().to_cols_array().iter().all(|v| *v < 1e-12));
            assert!(a.camera.translation.distance(d.translation) < 1e-12);
            assert!((a.camera.fx / d.fx - 1.0).abs() < 1e-9 && (a.camera.fy / d.fy - 1.0).abs() < 1e-9);
            let (x, y) = (a.load_image().unwrap(), b.load_image().unwrap());
            assert!(x.rgb.iter().zip(&y.rgb).all(|(x, y)| (x - y).abs() < 1e-5));
        }
    }
    for (from, to, says) in [
        ("\"dataset\": \"scene\"", "\"dataset\": \"gone\"", "dataset"),
        ("\"focal\": 1.03", "\"focal\": 103", "focal"),
        ("\"translation\": [", "\"translation\": [1,", "translation"),
        ("\"rotation\": [", "\"rotation\": [9.5, 0, 0, 0], \"was\": [", "rotation"),
    ] {
        let text = fs::read_to_string(&file).unwrap();
        assert!(text.contains(from), "{text}");
        let bad = dir.path().join("bad.json");
        fs::write(&bad, text.replace(from, to)).unwrap();
        let e = dataset::load(&bad, &FULL).unwrap_err().to_string();
        assert!(e.contains("bad.json") && e.contains(says) && e.lines().count() == 1, "{e}");
    }
}

#[test]
fn depth_images_of_scannet_have_a_camera_of_their_own() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path();
    let c = &cameras(1, 40, 30)[0];
    for folder in ["color", "depth"] {
        fs::create_dir_all(root.join(folder)).unwrap();
    }
    for id in [0, 20] {
        image::RgbImage::new(40, 30).save(root.join(format!("color/{id}.jpg"))).unwrap();
        write(&root.join(format!("pose/{id}.txt")), &pose_text(c));
    }
    let depth = image::ImageBuffer::from_fn(20, 16, |x, y| image::Luma([(1000 + 10 * x + y) as u16]));
    depth.save(root.join("depth/20.png")).unwrap();
    let matrix = |fx: f64, cx: f64, cy: f64| format!("{fx} 0 {cx} 0\n0 {fx} {cy} 0\n0 0 1 0\n0 0 0 1\n");
    write(&root.join("intrinsic/intrinsic_color.txt"), &matrix(40.0, 20.0, 15.0));
    let load = || dataset::load(root, &FULL).unwrap();
    let map = |d: &Dataset, v: usize| d.views[v].load_depth().unwrap();
    // Without intrinsics of their own, depth images are smaller photographs.
    let found = map(&load(), 1).unwrap();
    assert_eq!((found.camera.width, found.camera.fx, found.camera.cy), (20, 20.0, 8.0));
    assert!((found.depth[20 * 3 + 7] - 1.073).abs() < 1e-6);
    assert!(map(&load(), 0).is_none());
    write(&root.join("intrinsic/intrinsic_depth.txt"), &matrix(22.0, 10.5, 7.5));
    let d = load();
    let found = map(&d, 1).unwrap();
    assert_eq!((found.camera.fx, found.camera.cx, found.camera.rotation), (22.0, 10.5, d.views[1].camera.rotation));
    assert!(files(&d).contains(&"depth/20.png".into()) && files(&d).contains(&"intrinsic/intrinsic_depth.txt".into()));
}

#[test]
fn seven_scenes_has_its_sequences_and_its_kinect() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path();
    let c = cameras(3, 40, 30);
    let frame = |sequence: &str, id: usize, pose: &str| {
        let at = |end: &str| root.join(format!("seq-0{sequence}/frame-00000{id}.{end}"));
        write(&at("pose.txt"), pose);
        image::RgbImage::new(40, 30).save(at("color.png")).unwrap();
        at("depth.png")
    };
    let depth = image::ImageBuffer::from_fn(20, 15, |x, _| image::Luma([if x == 3 { 65535u16 } else { 1500 }]));
    depth.save(frame("1", 0, &pose_text(&c[0]))).unwrap();
    frame("1", 1, &"nan ".repeat(16));
    frame("2", 0, &pose_text(&c[1]));
    fs::remove_file(frame("2", 2, "")).unwrap_err();
    fs::remove_file(root.join("seq-02/frame-000002.pose.txt")).unwrap();
    write(&root.join("TestSplit.txt"), "sequence2\r\n");
    let d = dataset::load(root, &FULL).unwrap();
    let found: Vec<_> = d.views.iter().map(|v| (v.name.as_str(), v.split)).collect();
    let [a, b] = ["seq-01/frame-000000.color.png", "seq-02/frame-000000.color.png"];
    assert_eq!((d.format, found), (Format::SevenScenes, vec![(a, Split::Train), (b, Split::Test)]));
    assert!(d.warnings.len() == 2 && d.warnings[0].contains("frame-000001.pose.txt: the pose is not finite"));
    assert!(d.warnings[1].contains("frame-000002.pose.txt: no such pose"), "{:?}", d.warnings);
    let k = &d.views[0].camera;
    assert!((k.fx - 525.0 / 16.0).abs() < 1e-9 && (k.position() - c[0].position()).length() < 1e-9);
    let map = d.views[0].load_depth().unwrap().unwrap();
    assert_eq!((map.camera.fx, map.camera.cx, map.depth[2], map.depth[3]), (585.0 / 32.0, 10.0, 1.5, 0.0));
    // Sequences to hold out alone; one sequence; a damaged list of those to hold out.
    let parts = tempfile::tempdir().unwrap();
    fs::create_dir(parts.path().join("seq-2")).unwrap();
    for end in ["color.png", "pose.txt"] {
        let name = format!("frame-000000.{end}");
        fs::copy(root.join("seq-02").join(&name), parts.path().join("seq-2").join(&name)).unwrap();
    }
    write(&parts.path().join("TestSplit.txt"), "sequence2");
    let all_held_out = dataset::load(parts.path(), &LoadOptions { holdout: 0, ..FULL }).unwrap();
    assert_eq!(all_held_out.views[0].split, Split::Train);
    let one = dataset::load(&root.join("seq-02"), &FULL).unwrap();
    assert_eq!((one.views.len(), one.views[0].name.as_str()), (1, "frame-000000.color.png"));
    write(&root.join("TestSplit.txt"), "all");
    let e = dataset::load(root, &FULL).unwrap_err().to_string();
    assert!(e.contains("TestSplit.txt") && e.contains("sequence3"), "{e}");
}
