//! Photographs of different exposures, with alpha or masks; and what a run starts from.

mod common;

use common::world::{PIXELS, SIZE, balls, points, ring, scene, write_scene};
use common::{Folder, json, record, refused, succeeds};
use gs_raster::{RasterOptions, render};
use gs_scene::dataset::{LoadOptions, Resolution, View};
use gs_scene::{Camera, Gaussians, PointCloud, ply};
use serde_json::{Value, json};
use std::fs;
use std::path::Path;

const VIEWS: usize = 24;
/// A training of a few seconds.
const TRAINING: [&str; 10] =
    ["--iterations", "2000", "--holdout", "6", "--sh-degree", "0", "--max-gaussians", "400", "--schedule", "full"];

/// A folder with a scene of the balls; `change` may change the photographs, `[height][width][rgba]`.
fn photographed(rgba: bool, change: impl Fn(usize, &mut [[f32; 4]])) -> Folder {
    let folder = Folder::new();
    write_scene(&folder.path("scene"), &ring(VIEWS), &points(), |i, c, path| {
        let r = render(&balls(60), c, &RasterOptions::default());
        // As files have them: not multiplied by alpha.
        let pixel = |(p, &a): (&[f32], &f32)| {
            let straight = |v: f32| if rgba { v / a.max(1e-6) } else { v };
            [straight(p[0]), straight(p[1]), straight(p[2]), a]
        };
        let mut pixels: Vec<[f32; 4]> = r.rgb.chunks(3).zip(&r.alpha).map(pixel).collect();
        change(i, &mut pixels);
        let values = pixels.iter().flat_map(|p| p[..if rgba { 4 } else { 3 }].iter());
        let bytes: Vec<u8> = values.map(|v| (v.clamp(0.0, 1.0) * 255.0).round() as u8).collect();
        let kind = if rgba { image::ColorType::Rgba8 } else { image::ColorType::Rgb8 };
        image::save_buffer(path, &bytes, SIZE.0, SIZE.1, kind).unwrap();
    });
    folder
}

/// Trains; the run's summary.
fn train(dir: &Folder, out: &str, more: &[&str]) -> Value {
    let (scene, out) = (dir.path("scene"), dir.path(out));
    succeeds(&[&["train", "--scene", &scene, "--out", &out], &TRAINING[..], more].concat());
    record(&out)["summary"].clone()
}

/// PSNR of a geometry on the held-out views, by `gs-geom eval`.
fn eval(dir: &Folder, geometry: &str, more: &[&str]) -> f64 {
    let (scene, geometry, out) = (dir.path("scene"), dir.path(geometry), dir.path("m.json"));
    let all = ["eval", "--scene", &scene, "--geometry", &geometry, "--holdout", "6", "--out", &out];
    succeeds(&[&all[..], more].concat());
    psnr(&json(&out))
}

fn psnr(summary: &Value) -> f64 {
    summary["psnr_heldout"].as_f64().unwrap()
}

#[test]
fn exposures_that_differ_are_compensated() {
    // From one side all is bright, from the other dark. Every sixth view is held out and as the scene is; the others' gains
    // have a mean of 1.
    let gain = |i: usize| 1.0 + 0.3 * (i as f32 / VIEWS as f32 * std::f32::consts::TAU).sin();
    let dir = photographed(false, |i, pixels| {
        if i % 6 != 0 {
            pixels.iter_mut().for_each(|p| p[..3].iter_mut().for_each(|v| *v *= gain(i)));
        }
    });
    let without = train(&dir, "a.ply", &[]);
    let with = train(&dir, "b.ply", &["--exposure"]);
    assert!(psnr(&with) > psnr(&without) + 2.0, "{} {}", psnr(&with), psnr(&without));
    let maps = json(&dir.path("b.ply.exposures.json"));
    assert_eq!(maps.as_object().unwrap().len(), VIEWS - 4);
    // What a grey becomes: maps may mix the channels as well.
    let green = |name: &str| (0..3).map(|c| maps[name][1][c].as_f64().unwrap()).sum::<f64>();
    for i in [5, 19] {
        let found = green(&format!("{i:02}.png"));
        assert!((found - f64::from(gain(i))).abs() < 0.06, "{i}: {found} {}", gain(i));
    }
}

/// Mean absolute difference of the alpha that a file's Gaussians have from that of the balls.
fn alpha_error(file: &str) -> f64 {
    let g = ply::read_gaussians(file).unwrap();
    let alpha = |g: &Gaussians, c: &Camera| render(g, c, &RasterOptions::default()).alpha;
    let errors = ring(VIEWS).into_iter().map(|c| {
        let (a, b) = (alpha(&g, &c), alpha(&balls(60), &c));
        a.iter().zip(&b).map(|(a, b)| f64::from((a - b).abs())).sum::<f64>() / a.len() as f64
    });
    errors.sum::<f64>() / VIEWS as f64
}

#[test]
fn alpha_is_learnt_from_transparent_photographs() {
    // Over black, dark things may be transparent or opaque; over any colour they may not.
    let dir = photographed(true, |_, pixels| {
        pixels.iter_mut().for_each(|p| p[..3].iter_mut().for_each(|v| *v *= 0.1));
    });
    let background = train(&dir, "a.ply", &[]);
    train(&dir, "b.ply", &["--background", "random"]);
    let [plain, random] = ["a.ply", "b.ply"].map(|f| alpha_error(&dir.path(f)));
    assert!(random < 0.8 * plain, "{plain} {random}");
    assert!(psnr(&background) > 30.0, "{background}");
    // What should be opaque hides a background of another colour.
    let [plain, random] = ["a.ply", "b.ply"].map(|f| eval(&dir, f, &["--background", "white"]));
    assert!(random > plain + 1.0, "{plain} {random}");
}

#[test]
fn masked_pixels_do_not_count() {
    // Something passes through the photographs, held-out ones as well; the masks are black there.
    let at = |i: usize| {
        let (x, y) = ((7 * i) % 40 + 6, (5 * i) % 24 + 4);
        (0..18).flat_map(move |dy| (0..18).map(move |dx| (y + dy) * SIZE.0 as usize + x + dx))
    };
    let dir = photographed(false, |i, pixels| at(i).for_each(|p| pixels[p] = [0.9, 0.9, (i % 2) as f32, 1.0]));
    let masks = dir.path("masks");
    fs::create_dir(&masks).unwrap();
    for i in 0..VIEWS {
        let mut mask = vec![255u8; PIXELS];
        at(i).for_each(|p| mask[p] = 0);
        // As COLMAP calls masks, and without the photograph's own extension, in capitals or not.
        let name = [format!("{i:02}.png.png"), format!("{i:02}.png"), format!("{i:02}.PNG")];
        image::save_buffer_with_format(
            Path::new(&masks).join(&name[i % 3]),
            &mask,
            SIZE.0,
            SIZE.1,
            image::ColorType::L8,
            image::ImageFormat::Png,
        )
        .unwrap();
    }
    let whole = train(&dir, "a.ply", &[]);
    let masked = train(&dir, "b.ply", &["--masks", &masks]);
    assert!(psnr(&masked) > 22.0 && psnr(&whole) < 18.0, "{masked} {whole}");
    let masked_eval = |geometry: &str| eval(&dir, geometry, &["--masks", &masks]);
    let (without, with) = (masked_eval("a.ply"), masked_eval("b.ply"));
    assert!(with > without + 1.0 && (with - psnr(&masked)).abs() < 0.2, "{without} {with} {masked}");
    black_masks_do_not_count(&dir, &masks);
    // Without a mask for some, and for all.
    fs::remove_file(Path::new(&masks).join("01.png")).unwrap();
    let (scene, out) = (dir.path("scene"), dir.path("c.ply"));
    let train = ["train", "--scene", &scene, "--out", &out, "--iterations", "3", "--masks"];
    assert!(succeeds(&[&train[..], &[&masks]].concat()).contains("1 of 24 photographs have no mask"));
    fs::create_dir(dir.path("none")).unwrap();
    assert!(refused(&[&train[..], &[&dir.path("none")]].concat()).contains("no masks in this folder"));
}

#[test]
fn masks_that_the_frames_name_are_used_and_odd_ones_are_said() {
    let dir = photographed(false, |_, _| ());
    let (scene, masks) = (dir.path("scene"), dir.path("scene/masks"));
    fs::create_dir(&masks).unwrap();
    let options = LoadOptions { resolution: Resolution::Divisor(1.0), holdout: 8 };
    let views = gs_scene::dataset::load(Path::new(&scene), &options).unwrap().views;
    let frame = |view: &View| {
        // 0 and 1, as many programs write them; the right half does not count.
        let mask: Vec<u8> = (0..PIXELS).map(|p| u8::from(p % (SIZE.0 as usize) < SIZE.0 as usize / 2)).collect();
        image::save_buffer(Path::new(&masks).join(&view.name), &mask, SIZE.0, SIZE.1, image::ColorType::L8).unwrap();
        json!({"file_path": format!("images/{}", view.name), "mask_path": format!("masks/{}", view.name), "transform_matrix": view.camera.opengl_pose()})
    };
    let c = &views[0].camera;
    let frames: Vec<Value> = views.iter().map(frame).collect();
    let json = json!({"w": SIZE.0, "h": SIZE.1, "fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "frames": frames});
    let transforms = dir.path("scene/transforms.json");
    fs::write(&transforms, json.to_string()).unwrap();
    let train = |out: &str, more: &[&str]| {
        let out = dir.path(out);
        let said = succeeds(&[&["train", "--scene", &transforms, "--out", &out, "--iterations", "20"], more].concat());
        assert!(said.contains("24 of 24 masks, 00.png first, have no value above 1: taken as white"), "{said}");
        fs::read(out).unwrap()
    };
    assert!(train("own.ply", &[]) == train("given.ply", &["--masks", &masks]));
}

/// A held-out view whose mask is black has no figures, and the means are those of the others.
fn black_masks_do_not_count(dir: &Folder, masks: &str) {
    let metrics = || json(&dir.path("m.json"));
    let figures = |m: &Value| m["views"].as_array().unwrap().iter().map(|v| v["psnr"].as_f64()).collect::<Vec<_>>();
    let before = figures(&metrics());
    let blacken = |i: usize| {
        let (file, mask) = (Path::new(masks).join(format!("{i:02}.png.png")), vec![0u8; PIXELS]);
        image::save_buffer(file, &mask, SIZE.0, SIZE.1, image::ColorType::L8).unwrap();
    };
    blacken(6);
    let mean = eval(dir, "b.ply", &["--masks", masks]);
    let m = metrics();
    assert_eq!(figures(&m), [before[0], None, before[2], before[3]]);
    assert_eq!(m["views"][1]["ssim"], Value::Null);
    let others = [0, 2, 3].map(|i| before[i].unwrap()).iter().sum::<f64>() / 3.0;
    assert!((mean - others).abs() < 1e-9, "{mean} {others}");
    let said = record(&dir.path("m.json"))["skipped"].to_string();
    assert!(said.contains("1 of the views measured: no pixel counts there (a black mask), in 06.png"), "{said}");
    // Training measures the same views in the same way.
    [0, 12, 18].into_iter().for_each(blacken);
    let summary = train(dir, "black.ply", &["--masks", masks]);
    assert_eq!(summary["psnr_heldout"], Value::Null, "{summary}");
}

#[test]
fn antialiased_gaussians_say_so_and_are_rendered_so() {
    let dir = photographed(false, |_, _| ());
    train(&dir, "a.ply", &[]);
    let learnt = psnr(&train(&dir, "b.ply", &["--antialias"]));
    let eval = |geometry: &str, resolution: &str| eval(&dir, geometry, &["--resolution", resolution]);
    assert!((eval("b.ply", "1") - learnt).abs() < 0.2);
    // Far away, where Gaussians are smaller than pixels, those learnt without the filter are too thick.
    let (coarse, coarse_filtered) = (eval("a.ply", "8"), eval("b.ply", "8"));
    assert!(coarse_filtered > coarse, "{coarse} {coarse_filtered}");
    let (plain, filtered) = (dir.path("a.ply"), dir.path("b.ply"));
    // What says so is the comment; convert hands it on.
    let converted = dir.path("c.ply");
    succeeds(&["convert", &filtered, &converted]);
    assert!(ply::is_antialiased(&converted).unwrap() && !ply::is_antialiased(&plain).unwrap());
    let mut bytes = fs::read(&filtered).unwrap();
    let at = bytes.windows(14).position(|w| w == b"antialias true").unwrap();
    bytes[at..at + 14].copy_from_slice(b"antialias none");
    fs::write(&filtered, bytes).unwrap();
    assert!((eval("b.ply", "8") - coarse_filtered).abs() > 0.01);
}

#[test]
fn a_run_starts_from_what_it_is_told_to() {
    let dir = Folder::new();
    let (out, cloud, gaussians) = (dir.path("g.ply"), dir.path("p.ply"), dir.path("i.ply"));
    let points =
        PointCloud { positions: balls(60).means[..7].to_vec(), colors: vec![[10, 20, 30]; 7], ..PointCloud::default() };
    ply::write_points(&cloud, &points, &[]).unwrap();
    ply::write_gaussians(&gaussians, &balls(60), &[]).unwrap();
    for (init, count, says) in [
        ("points", 60, "60 Gaussians"),
        ("random", 55, "starting from 55 random points"),
        (&cloud, 7, "starting from the 7 points"),
        (&gaussians, 60, "60 Gaussians"),
    ] {
        let all =
            ["train", "--scene", scene(), "--out", &out, "--iterations", "2", "--init-points", "55", "--init", init];
        let said = succeeds(&all);
        assert!(said.contains(says), "{init}: {said}");
        assert_eq!(ply::read_gaussians(&out).unwrap().len(), count, "{init}");
    }
    refused(&["train", "--scene", scene(), "--out", &out, "--init", &format!("{}/images/00.png", scene())]);
}
