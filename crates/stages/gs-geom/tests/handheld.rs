//! Datasets without points, with depth images, and with poses that are off: starts and refined cameras, through the program.

mod common;

use common::world::{SIZE, balls, photograph, ring, write_scene};
use common::{Folder, json, killed, record, succeeds, training};
use glam::DVec3;
use gs_raster::{RasterOptions, render};
use gs_scene::dataset::{self, LoadOptions};
use gs_scene::{Camera, Image, PointCloud, ply};
use image::{ImageBuffer, Luma};
use serde_json::json;
use std::fs;
use std::path::Path;

const VIEWS: usize = 16;

/// The ring's cameras, shaken by about a degree and two hundredths.
fn shaken() -> Vec<Camera> {
    let off = |i: usize, k: usize| (7.3 * (3 * i + k) as f64).sin();
    let shake = |(i, c): (usize, Camera)| {
        let turn = 0.02 * DVec3::new(off(i, 0), off(i, 1), off(i, 2));
        let rotation = glam::DMat3::from_quat(glam::DQuat::from_scaled_axis(turn)) * c.rotation;
        let translation = c.translation + 0.02 * DVec3::new(off(i, 3), off(i, 4), off(i, 5));
        Camera { rotation, translation, ..c }
    };
    ring(VIEWS).into_iter().enumerate().map(shake).collect()
}

/// Photographs of the true cameras under the poses given.
fn write_posed(root: &str, poses: &[Camera], points: &PointCloud) {
    let truth = ring(VIEWS);
    write_scene(root, poses, points, |i, _, path| photograph(i, &truth[i], path));
}

#[test]
fn refined_cameras_are_the_same_bytes_after_a_kill_and_on_any_threads_and_stand_for_the_dataset() {
    let dir = Folder::new();
    let (scene, out, again) = (dir.path("scene"), dir.path("g.ply"), dir.path("h.ply"));
    write_posed(&scene, &shaken(), &common::world::points());
    let options = ["--refine-poses", "--seed", "3", "--threads", "2"];
    succeeds(&training(&scene, &out, "160", &options));
    let one = ["--refine-poses", "--seed", "3", "--threads", "1"];
    killed(&training(&scene, &again, "160", &one), &again, "1");
    succeeds(&training(&scene, &again, "160", &one));
    let [cameras, others] = [&out, &again].map(|o| format!("{o}.cameras.json"));
    for (a, b) in [(&out, &again), (&cameras, &others)] {
        assert!(fs::read(a).unwrap() == fs::read(b).unwrap(), "{a} and {b}");
    }
    // Without it poses stay, and fit less.
    let (still, psnr) = (dir.path("still.ply"), |out: &str| record(out)["summary"]["psnr_heldout"].as_f64().unwrap());
    succeeds(&training(&scene, &still, "160", &["--seed", "3"]));
    assert!(!Path::new(&format!("{still}.cameras.json")).exists());
    assert!(psnr(&out) > psnr(&still) + 0.3, "{} dB refined, {} not", psnr(&out), psnr(&still));
    // The file stands for the dataset: photographs and points are the same, the cameras those that were measured.
    let load = |path: &str| dataset::load(Path::new(path), &LoadOptions::default()).unwrap();
    let (given, refined) = (load(&scene), load(&cameras));
    assert_eq!((given.points == refined.points, given.views.len()), (true, refined.views.len()));
    assert_ne!(given.hash().unwrap(), refined.hash().unwrap());
    assert!(refined.files.contains(&cameras.clone().into()));
    let figures = dir.path("eval.json");
    succeeds(&["eval", "--scene", &cameras, "--geometry", &out, "--out", &figures]);
    let measured = json(&figures)["psnr_heldout"].as_f64().unwrap();
    assert!((measured - psnr(&out)).abs() < 0.05, "{measured} {}", psnr(&out));
    // It knows where the photographs lie, also when both were moved.
    fs::rename(dir.path("scene"), dir.path("moved")).unwrap();
    assert!(dataset::load(Path::new(&cameras), &LoadOptions::default()).unwrap_err().to_string().contains("dataset"));
    fs::rename(dir.path("moved"), dir.path("scene")).unwrap();
    let text = fs::read_to_string(&cameras).unwrap();
    fs::write(&cameras, text.replacen("03.png", "93.png", 1)).unwrap();
    let e = dataset::load(Path::new(&cameras), &LoadOptions::default()).unwrap_err().to_string();
    assert!(e.contains("03.png"), "{e}");
}

#[test]
fn a_dataset_that_shows_too_little_starts_at_random_and_says_so() {
    let dir = Folder::new();
    let (scene, out) = (dir.path("scene"), dir.path("g.ply"));
    let plain = |_: usize, _: &Camera, path: &Path| {
        ImageBuffer::from_pixel(SIZE.0, SIZE.1, image::Rgb([90u8, 90, 90])).save(path).unwrap();
    };
    write_scene(&scene, &ring(4), &PointCloud::default(), plain);
    let said = succeeds(&["train", "--scene", &scene, "--out", &out, "--iterations", "2", "--init-points", "77"]);
    assert!(said.contains("starting from 77 random points"), "{said}");
}

#[test]
fn photographs_give_the_points_and_leave_half_of_the_gaussians_to_grow() {
    let dir = Folder::new();
    let (scene, out) = (dir.path("scene"), dir.path("g.ply"));
    let cameras: Vec<Camera> = ring(40).iter().map(|c| c.resized(4 * SIZE.0, 4 * SIZE.1)).collect();
    let mut specks = balls(300);
    specks.log_scales.iter_mut().flatten().for_each(|s| *s -= 1.5);
    write_scene(&scene, &cameras, &PointCloud::default(), |_, camera, path| {
        let r = render(&specks, camera, &RasterOptions::default());
        Image { width: r.width, height: r.height, rgb: r.rgb, alpha: None }.write_png(path).unwrap();
    });
    for most in [1usize, 500] {
        let limits = ["--max-gaussians", &most.to_string(), "--no-skip"];
        let said = succeeds(&training(&scene, &out, "1", &limits));
        assert!(said.contains("of depths by plane sweep"), "{said}");
        let found = ply::read_gaussians(&out).unwrap().len();
        assert!(found <= most && found * 4 >= most, "{found} of {most}");
    }
}

#[test]
fn auto_leaves_poses_of_colmap_and_nothing_of_a_run_that_refined_others() {
    let dir = Folder::new();
    let mut specks = balls(1200);
    specks.log_scales.iter_mut().flatten().for_each(|s| *s -= 2.0);
    let truth: Vec<Camera> = ring(40).iter().map(|c| c.resized(6 * SIZE.0, 6 * SIZE.1)).collect();
    let out = dir.path("g.ply");
    // One after the other into one output: what a run leaves and the next one does not is gone.
    for (name, choice) in [("off", "on"), ("exact", "auto"), ("off", "on"), ("exact", "off")] {
        let (scene, off) = (dir.path(name), choice == "on");
        let shaken = |(i, c): (usize, &Camera)| {
            let by = |k: usize| if off { 0.008 * (7.3 * (3 * i + k) as f64).sin() } else { 0.0 };
            let turn = glam::DQuat::from_scaled_axis(DVec3::new(by(0), by(1), by(2)));
            Camera { rotation: glam::DMat3::from_quat(turn) * c.rotation, ..c.clone() }
        };
        let given: Vec<Camera> = truth.iter().enumerate().map(shaken).collect();
        write_scene(&scene, &given, &common::world::points(), |i, _, path| {
            let r = render(&specks, &truth[i], &RasterOptions::default());
            Image { width: r.width, height: r.height, rgb: r.rgb, alpha: None }.write_png(path).unwrap();
        });
        let choice = ["--refine-poses", choice, "--max-gaussians", "500"];
        let said = succeeds(&training(&scene, &out, "2", &choice));
        assert_eq!(Path::new(&format!("{out}.cameras.json")).exists(), off, "{said}");
        assert_eq!(said.contains("they stay as they are given"), choice[1] == "auto", "{said}");
        let parameters = &record(&out)["parameters"];
        assert!(parameters["refine_poses"] == off && parameters["poses"].is_null() != off, "{parameters}");
    }
}

#[test]
fn depth_images_give_the_points() {
    let dir = Folder::new();
    let (scene, out) = (dir.path("scene"), dir.path("g.ply"));
    fs::create_dir_all(dir.path("scene/images")).unwrap();
    fs::create_dir_all(dir.path("scene/depth")).unwrap();
    let frames: Vec<_> = ring(6)
        .iter()
        .enumerate()
        .map(|(i, c)| {
            photograph(i, c, Path::new(&dir.path(&format!("scene/images/{i}.png"))));
            let r = render(&balls(60), c, &RasterOptions::default());
            let depth = r.depth.iter().zip(&r.alpha).map(|(z, a)| if *a > 0.9 { (1000.0 * z / a) as u16 } else { 0 });
            let depth = ImageBuffer::<Luma<u16>, _>::from_vec(SIZE.0, SIZE.1, depth.collect()).unwrap();
            depth.save(dir.path(&format!("scene/depth/{i}.png"))).unwrap();
            json!({
                "file_path": format!("images/{i}.png"), "depth_file_path": format!("depth/{i}.png"),
                "transform_matrix": c.opengl_pose(),
            })
        })
        .collect();
    let c = &ring(6)[0];
    let all =
        json!({"w": c.width, "h": c.height, "fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "frames": frames});
    fs::write(dir.path("scene/transforms.json"), all.to_string()).unwrap();
    let train = ["train", "--scene", &scene, "--out", &out, "--iterations", "1", "--init-points", "300", "--no-skip"];
    let said = succeeds(&train);
    assert!(said.contains("of 5 depth images"), "{said}");
    let found = ply::read_gaussians(&out).unwrap();
    assert!((100..=300).contains(&found.len()), "{}", found.len());
    // On the balls, whose radius is about 0.3.
    let near = |p: &[f32; 3]| {
        let p = DVec3::from(p.map(f64::from));
        balls(60).means.iter().any(|m| p.distance(DVec3::from(m.map(f64::from))) < 0.4)
    };
    let on = found.means.iter().filter(|p| near(p)).count();
    // Where one ball shines through another, depths are between both.
    assert!(on * 4 > found.len() * 3, "{on} of {}", found.len());
    // They count as an input, and another file there is refused in one line.
    let inputs = &record(&out)["inputs"];
    assert!(inputs["depths"].is_string(), "{inputs}");
    fs::copy(dir.path("scene/images/1.png"), dir.path("scene/depth/1.png")).unwrap();
    assert!(common::refused(&train).contains("16-bit"));
}
