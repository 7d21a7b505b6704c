//! Which cameras of a folder are read, and which file a name means.

use super::*;

#[test]
fn extensions_may_be_in_capitals_whatever_the_model_says() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path();
    let cameras = cameras(3, 40, 30);
    colmap_scene(root, &cameras);
    // As cameras write them, as a program renamed them, and as another did.
    let named = [("a.JPG", "a.JPG"), ("b.jpg", "b.JPG"), ("c.JPEG", "c.jpeg")];
    let jpeg = image::RgbImage::from_raw(40, 30, plain(40, 30).to_rgb8()).unwrap();
    fs::remove_dir_all(root.join("images")).unwrap();
    fs::create_dir(root.join("images")).unwrap();
    for (_, file) in named {
        jpeg.save_with_format(root.join("images").join(file), image::ImageFormat::Jpeg).unwrap();
    }
    let views: Vec<_> = named.iter().zip(&cameras).map(|(n, c)| (n.0.to_string(), c.clone())).collect();
    colmap::write_model(&root.join("sparse/0"), &views, &points()).unwrap();
    let found = |d: &Dataset| d.views.iter().map(|v| (v.stem().to_string(), v.image_path.clone())).collect::<Vec<_>>();
    let expected: Vec<_> =
        named.iter().map(|(_, file)| (file[..1].to_string(), root.join("images").join(file))).collect();
    let d = dataset::load(root, &FULL).unwrap();
    assert_eq!((found(&d), d.warnings.len()), (expected.clone(), 0));
    assert!(d.views.iter().all(|v| v.load_image().is_ok()));
    fs::remove_dir_all(root.join("sparse")).unwrap();
    let c = &cameras[0];
    let frames: Vec<_> = named
        .iter()
        .map(|(name, _)| json!({"file_path": format!("images/{name}"), "transform_matrix": opengl(c)}))
        .collect();
    let json = json!({"w": 40, "h": 30, "fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "frames": frames});
    write(&root.join("transforms.json"), &json.to_string());
    let d = dataset::load(root, &FULL).unwrap();
    assert_eq!((found(&d), d.warnings.len()), (expected, 0));
}

#[test]
fn names_written_in_another_way_are_found() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path();
    let cameras = cameras(3, 20, 16);
    // In the model composed, by Windows, and as it is; on the disk decomposed, in a folder, and with two blanks.
    let named =
        [("K\u{fc}che.png", "Ku\u{308}che.png"), ("a\\b.png", "a/b.png"), ("two  blanks.png", "two  blanks.png")];
    for (_, file) in named {
        let path = root.join("images").join(file);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        plain(20, 16).write_png(path).unwrap();
    }
    let views: Vec<_> = named.iter().zip(&cameras).map(|(n, c)| (n.0.to_string(), c.clone())).collect();
    let c = &cameras[0];
    let model = root.join("sparse/0");
    text_model(&model, &views, "PINHOLE", &[c.fx, c.fy, c.cx, c.cy]);
    // Saved by an editor that drops empty lines and puts a mark before the text.
    for file in ["cameras.txt", "images.txt", "points3D.txt"] {
        let text = fs::read_to_string(model.join(file)).unwrap();
        let lines: Vec<&str> = text.lines().filter(|l| !l.is_empty()).collect();
        write(&model.join(file), &format!("\u{feff}{}\r\n", lines.join("\r\n")));
    }
    let d = dataset::load(root, &FULL).unwrap();
    assert_eq!((d.views.len(), &d.warnings), (3, &vec![]));
    fs::remove_dir_all(root.join("sparse")).unwrap();
    let frames: Vec<_> = named
        .iter()
        .map(|(name, _)| {
            let name = format!("images\\{name}");
            json!({"file_path": name, "mask_path": ".\\masks\\a.png", "transform_matrix": opengl(c)})
        })
        .collect();
    let json = json!({"w": 20, "h": 16, "fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "frames": frames});
    write(&root.join("transforms.json"), &format!("\u{feff}{json}"));
    plain(20, 16).write_png(root.join("masks/a.png")).unwrap();
    let d = dataset::load(root, &FULL).unwrap();
    assert_eq!((d.views.len(), &d.warnings), (3, &vec![]));
    assert!(d.views.iter().all(|v| v.mask_path() == Some(&root.join("masks/a.png"))));
}

#[test]
fn of_several_models_the_one_with_most_photographs_is_taken_and_it_is_said() {
    let dir = tempfile::tempdir().unwrap();
    let views = colmap_scene(dir.path(), &cameras(6, 20, 16));
    let sparse = dir.path().join("sparse");
    colmap::write_model(&sparse.join("0"), &views[..2], &points()).unwrap();
    colmap::write_model(&sparse.join("10"), &views[..5], &points()).unwrap();
    let d = dataset::load(dir.path(), &FULL).unwrap();
    assert_eq!((d.views.len(), d.warnings.len()), (5, 2), "{:?}", d.warnings);
    assert!(
        d.warnings[0].contains("sparse/10 with 5 photographs is taken") && d.warnings[0].contains("sparse/0 with 2")
    );
    assert!(d.warnings[1].contains("1 of 6 photographs in") && d.warnings[1].contains("are in no view"));
}

#[test]
fn a_folder_with_several_sets_of_cameras_says_which_is_read_and_files_pick() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path();
    let views = colmap_scene(root, &cameras(4, 20, 16));
    colmap::write_model(&root.join("sparse/1"), &views[..2], &points()).unwrap();
    let c = &views[0].1;
    let frame =
        |i: usize| json!({"file_path": format!("images/frame_{i:05}"), "transform_matrix": opengl(&views[i].1)});
    let json = json!({"w": 20, "h": 16, "fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "frames": [frame(0), frame(1), frame(2)]});
    write(&root.join("transforms.json"), &json.to_string());
    let load = |path: &str| dataset::load(&root.join(path), &FULL).unwrap();
    let said = |d: &Dataset, words: &[&str]| {
        assert!(d.warnings.iter().any(|w| words.iter().all(|&word| w.contains(word))), "{:?}", d.warnings);
    };
    let d = load("");
    assert_eq!((d.format, d.views.len()), (Format::Colmap, 4));
    said(&d, &["sparse/0 is read, not", "transforms.json", "--scene"]);
    said(&d, &["sparse/0 with 4 photographs is taken, not", "--scene"]);
    for picked in ["sparse/1/cameras.bin", "sparse/1/images.bin", "sparse/1"] {
        let d = load(picked);
        assert_eq!((d.format, d.views.len()), (Format::Colmap, 2), "{picked}");
        assert!(d.views[1].load_image().is_ok());
        said(&d, &["2 of 4 photographs in", "images are in no view"]);
    }
    let d = load("transforms.json");
    assert_eq!((d.format, d.views.len()), (Format::Transforms, 3));
    said(&d, &["1 of 4 photographs in"]);
}

#[test]
fn photographs_of_a_folder_without_any_view_are_counted_and_what_blender_adds_is_not() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path();
    let views = colmap_scene(root, &cameras(2, 20, 16));
    for other in ["images/more/a.png", "images/more/b.png", "masks/frame_00000.png", "images/frame_00001.jpg"] {
        fs::create_dir_all(root.join(other).parent().unwrap()).unwrap();
        plain(20, 16).write_png(root.join(other)).unwrap();
    }
    let d = dataset::load(root, &FULL).unwrap();
    assert!(d.warnings.len() == 1 && d.warnings[0].contains("2 of 4 photographs in"), "{:?}", d.warnings);
    let blender = root.join("blender");
    for file in ["r_0.png", "r_0_normal_0001.png", "r_0_depth_0001.png", "r_1.png"] {
        fs::create_dir_all(blender.join("train")).unwrap();
        plain(20, 16).write_png(blender.join("train").join(file)).unwrap();
    }
    let frame = json!({"file_path": ".\\train\\r_0", "transform_matrix": opengl(&views[0].1)});
    write(&blender.join("transforms_train.json"), &json!({"camera_angle_x": 0.7, "frames": [frame]}).to_string());
    let d = dataset::load(&blender, &FULL).unwrap();
    assert_eq!(d.views[0].name, "train/r_0.png");
    assert!(d.warnings.len() == 1 && d.warnings[0].contains("1 of 2 photographs in"), "{:?}", d.warnings);
}
