//! The program on a small scene on disk: the artifacts, the same bytes for any thread count, and bad input.

use artifacts::{Footprints, Graph, Level, MaskMaps, Row, maps_path, role};
use glam::DVec3;
use gs_io::Provenance;
use gs_raster::{RasterOptions, Rendered, render};
use gs_scene::dataset::{self, LoadOptions, Resolution};
use gs_scene::{Camera, Gaussians, Image, Learnt, PointCloud, colmap, ply};
use ndarray::Array3;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

const SIZE: u32 = 48;

/// A COLMAP scene of two clusters of Gaussians in photographs of `size` x `size` pixels, one mask each and one for both; and a
/// folder for the output.
fn setup(size: u32) -> (tempfile::TempDir, PathBuf, PathBuf) {
    let dir = tempfile::tempdir().unwrap();
    let (s, o) = (dir.path().join("scene"), dir.path().join("out"));
    std::fs::create_dir_all(&o).unwrap();
    let n = (size * size) as usize;
    let half = |x| i32::from(x >= size as usize / 2);
    let id = |(level, _, x)| if level == 3 { 6 } else { 2 * level as i32 + half(x) };
    let maps = MaskMaps { ids: Array3::from_shape_fn((4, size as usize, size as usize), id) };
    let grey = Image { width: size, height: size, rgb: vec![0.5; 3 * n], alpha: None };
    let mut views = Vec::new();
    for v in 0..5 {
        let eye = DVec3::new(f64::from(v) * 0.1 - 0.2, -0.2, -3.0);
        views.push((format!("v{v}.png"), Camera::look_at(eye, DVec3::ZERO, DVec3::NEG_Y, size, size, 0.9)));
        grey.write_png(s.join(format!("images/v{v}.png"))).unwrap();
        maps.write(s.join(format!("masks/v{v}_s.npy"))).unwrap();
    }
    colmap::write_model(&s.join("sparse/0"), &views, &PointCloud::default()).unwrap();
    ply::write_gaussians(s.join("geometry.ply"), &gaussians(), &[]).unwrap();
    (dir, s, o)
}

fn gaussians() -> Gaussians {
    let mut g = Gaussians::default();
    for i in 0..60 {
        let side = if i % 2 == 0 { -0.7 } else { 0.7 };
        g.means.push([side + (i % 7) as f32 * 0.05, (i % 11) as f32 * 0.1 - 0.5, (i % 5) as f32 * 0.05]);
    }
    g.means.push([0.0, 0.0, -50.0]); // behind every camera
    let n = g.means.len();
    g.log_scales = vec![[-1.5; 3]; n];
    g.rotations = vec![[1.0, 0.0, 0.0, 0.0]; n];
    g.opacity_logits = vec![3.0; n];
    g.sh = vec![0.3; 3 * n];
    g
}

fn run(dir: &Path, out: &Path, extra: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_graph-precompute"))
        .args(["--scene".as_ref(), dir.as_os_str(), "--geometry".as_ref(), dir.join("geometry.ply").as_os_str()])
        .args(["--masks".as_ref(), dir.join("masks").as_os_str()])
        .args(["--footprints".as_ref(), out.join("footprints.safetensors").as_os_str()])
        .args(["--graph".as_ref(), out.join("graph.safetensors").as_os_str()])
        .args(extra)
        .output()
        .unwrap()
}

fn succeed(output: &Output) -> String {
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{said}");
    said
}

#[test]
fn artifacts_are_right_and_the_same_for_any_number_of_threads() {
    let (_dir, s, o) = setup(SIZE);
    let said = succeed(&run(&s, &o, &["--threads", "1"]));
    assert!(said.contains("skipped 1 of 61 Gaussians: never seen"), "{said}");
    let read = || ["graph.safetensors", "footprints.safetensors"].map(|f| std::fs::read(o.join(f)).unwrap());
    let first = read();
    succeed(&run(&s, &o, &["--threads", "2"]));
    assert!(first == read(), "the number of threads changes the artifacts");
    let (graph, a) = Graph::read(o.join("graph.safetensors")).unwrap();
    assert_eq!((graph.kept.len(), graph.anchors.len()), (60, 6));
    assert_eq!((graph.knn.dim(), graph.gaussian_knn.dim()), ((6, 16), (60, 16)));
    assert_eq!(graph.seen_views[60], 0);
    let f = Footprints::read(o.join("footprints.safetensors")).unwrap();
    assert_eq!(f.artifact().provenance().inputs, a.provenance().inputs);
    assert_eq!(f.kept, graph.kept);
    // Every 8th view is held out: the first.
    assert_eq!(f.views, ["v1", "v2", "v3", "v4"]);
    assert_eq!(f.rows.len(), 4 * 7);
    // The whole's footprint is the sum of the halves'.
    let sum = |r: usize| f.entries(r).unwrap().iter().map(|(_, w)| f64::from(w)).sum::<f64>();
    assert!((sum(0) + sum(1) - sum(6)).abs() < 1e-3 * sum(6) && sum(6) > 100.0);

    // The provenance holds every option.
    let expected = serde_json::json!({
        "views": "train", "holdout": 8, "anchor_ratio": 0.1, "k": 16, "levels": [], "gate": 0.7, "min_mask_pixels": 50.0, "cut": 0.0,
        "pixel_samples": 0, "no_skip": false, "preset": null, "seed": 0,
    });
    assert_eq!(a.provenance().parameters, expected);

    let said = succeed(&run(&s, &o, &["--no-skip", "--views", "all", "--cut", "0.01", "--min-mask-pixels", "0"]));
    assert!(said.contains("the cut dropped at most"), "{said}");
    assert_eq!(Graph::read(o.join("graph.safetensors")).unwrap().0.kept.len(), 61);
    let cut = Footprints::read(o.join("footprints.safetensors")).unwrap();
    assert_eq!(cut.views.len(), 5);
    assert!(cut.total() * 4 < f.total() * 5);
}

#[test]
fn gaussians_of_other_photographs_are_refused() {
    let (_dir, s, o) = setup(SIZE);
    // One cluster is red, the other one green.
    let mut g = gaussians();
    for (i, colour) in g.sh.as_chunks_mut::<3>().0.iter_mut().enumerate() {
        *colour = if i % 2 == 0 { [1.5, -1.5, -1.5] } else { [-1.5, 1.5, -1.5] };
    }
    let load = LoadOptions { resolution: Resolution::Divisor(1.0), holdout: 0 };
    for view in dataset::load(&s, &load).unwrap().views {
        let Rendered { width, height, rgb, .. } = render(&g, &view.camera, &RasterOptions::fit(&g));
        Image { width, height, rgb, alpha: None }.write_png(&view.image_path).unwrap();
    }
    ply::write_gaussians(s.join("geometry.ply"), &g, &[]).unwrap();
    succeed(&run(&s, &o, &[]));
    // The same thing in the coordinates of cameras on its other side.
    g.means.iter_mut().for_each(|m| m[0] = -m[0]);
    ply::write_gaussians(s.join("geometry.ply"), &g, &[]).unwrap();
    let refused = run(&s, &o, &["--overwrite"]);
    let said = String::from_utf8_lossy(&refused.stderr).into_owned();
    assert!(
        refused.status.code() == Some(2)
            && said.contains("geometry.ply: the Gaussians do not show these photographs; found "),
        "{said}"
    );
    assert!(said.contains(" dB, where one plain colour has ") && said.contains(" on 4 photographs"), "{said}");
}

#[test]
fn views_are_held_out_as_the_gaussians_were_trained() {
    let (_dir, s, o) = setup(SIZE);
    let dataset = dataset::load(&s, &LoadOptions::default()).unwrap();
    let hash = Learnt::hash(&dataset, 2);
    let comments = ["holdout 2".to_string(), format!("learnt_views \"{hash}\"")];
    ply::write_gaussians(s.join("geometry.ply"), &gaussians(), &comments).unwrap();
    let views = || Footprints::read(o.join("footprints.safetensors")).unwrap().views;
    succeed(&run(&s, &o, &[]));
    assert_eq!(views(), ["v1", "v3"]);
    let provenance = Graph::read(o.join("graph.safetensors")).unwrap().1;
    assert_eq!(provenance.provenance().parameters["holdout"], 2);
    let said = succeed(&run(&s, &o, &["--holdout", "0"]));
    assert!(said.contains("--holdout 0, but the Gaussians were trained with --holdout 2"), "{said}");
    assert_eq!(views().len(), 5);
}

#[test]
fn id_maps_are_shrunk_where_that_is_asked_for() {
    let (_dir, s, o) = setup(SIZE);
    let read = |extra: &[&str]| {
        succeed(&run(&s, &o, extra));
        Footprints::read(o.join("footprints.safetensors")).unwrap()
    };
    let whole = read(&[]);
    let half = read(&["--mask-divisor", "2"]);
    let parameters = |f: &Footprints| f.artifact().provenance().parameters["mask_divisor"].clone();
    assert_eq!((parameters(&whole), parameters(&half)), (serde_json::Value::Null, serde_json::json!(2)));
    assert_eq!(half.rows.len(), whole.rows.len());
    assert!(half.rows.iter().zip(&whole.rows).all(|(half, whole)| 4 * half.pixels == whole.pixels));
    // A quarter of the pixels shows a quarter of the weight, but for what the wider low-pass of small pictures adds.
    let sum = |f: &Footprints| f.entries(6).unwrap().iter().map(|(_, w)| f64::from(w)).sum::<f64>();
    let share = sum(&half) / sum(&whole);
    assert!((0.2..0.3).contains(&share), "{share}");
    let out = run(&s, &o, &["--mask-divisor", "0"]);
    assert!(!out.status.success() && String::from_utf8_lossy(&out.stderr).contains("'--mask-divisor <N>'"));
}

#[test]
fn the_forecast_is_near_the_peak() {
    const SIDE: usize = 25;
    let (_dir, s, o) = setup(192);
    let one = gaussians().select(&[0]);
    let mut g = one.select(&vec![0; SIDE * SIDE * SIDE]);
    for (i, p) in g.means.iter_mut().enumerate() {
        let at = |i: usize| (i % SIDE) as f32 / SIDE as f32 - 0.5;
        *p = [2.5 * at(i), 2.5 * at(i / SIDE), 0.3 * at(i / SIDE / SIDE)];
    }
    g.log_scales.fill([-2.8; 3]);
    ply::write_gaussians(s.join("geometry.ply"), &g, &[]).unwrap();
    succeed(&run(&s, &o, &["--threads", "2"]));
    let record = stage::RunRecord::read(o.join("graph.safetensors")).unwrap();
    if let (Some(forecast), Some(peak)) = (record.memory_predicted_bytes, record.peak_rss_bytes) {
        let (forecast, peak) = (forecast as f64, peak as f64);
        // How much of the program itself lies in memory differs from system to system: 20 MB.
        assert!((forecast - peak).abs() < 0.5 * peak + 20e6, "forecast {forecast}, peak {peak}");
    }
}

#[test]
fn bad_input_is_one_line_and_leaves_outputs_alone() {
    let (_dir, s, o) = setup(SIZE);
    for f in ["graph.safetensors", "footprints.safetensors"] {
        std::fs::write(o.join(f), "good").unwrap();
    }
    let fail = |extra: &[&str], needles: &[&str]| {
        let out = run(&s, &o, &[extra, &["--overwrite"]].concat());
        let said = String::from_utf8_lossy(&out.stderr).into_owned();
        assert_eq!(out.status.code(), Some(2), "{said}");
        for needle in needles {
            assert!(said.contains(needle), "{needle:?} is not in {said:?}");
        }
        assert!(!said.contains("panicked"), "{said}");
        assert_eq!(std::fs::read(o.join("graph.safetensors")).unwrap(), b"good");
        assert_eq!(std::fs::read(o.join("footprints.safetensors")).unwrap(), b"good");
    };
    // clap's own errors have exit code 2 as well, and name option and range.
    fail(&["--k", "0"], &["--k", "expected 1 to 1024"]);
    fail(&["--anchor-ratio", "NaN"], &["--anchor-ratio", "to 1"]);
    fail(&["--gate", "1.5"], &["--gate", "expected 0 to 0.999"]);
    fail(&["--pixel-samples", "5000"], &["--pixel-samples", "expected 0 to 4096"]);
    fail(&["--holdout", "1"], &["scene", "all views are held out", "--holdout 0"]);
    fail(&["--min-mask-pixels", "1000000"], &["masks", "too small", "--min-mask-pixels"]);
    let masks = s.join("masks/v2_s.npy");
    let good = std::fs::read(&masks).unwrap();
    std::fs::write(&masks, &good[..good.len() / 2]).unwrap();
    fail(&[], &["v2_s.npy"]);
    MaskMaps { ids: Array3::zeros((4, 48, 20)) }.write(&masks).unwrap();
    fail(&[], &["v2_s.npy", "found 20x48", "expected 48x48"]);
    MaskMaps { ids: Array3::from_elem((4, 48, 48), -1) }.write(&masks).unwrap();
    for v in [1, 3, 4] {
        std::fs::remove_file(s.join(format!("masks/v{v}_s.npy"))).unwrap();
    }
    fail(&[], &["masks", "no view has a mask"]);
    std::fs::remove_file(&masks).unwrap();
    fail(&[], &["masks", "no view has an id map", "mask-embed"]);
    let mut g = gaussians();
    g.means.iter_mut().for_each(|p| p[2] = -80.0);
    ply::write_gaussians(s.join("geometry.ply"), &g, &[]).unwrap();
    std::fs::write(&masks, &good).unwrap();
    fail(&[], &["no Gaussian is seen"]);
    std::fs::remove_file(s.join("geometry.ply")).unwrap();
    fail(&[], &["geometry.ply", "cannot open"]);
}

/// `kept` is the mapping from what takes part to the PLY.
#[test]
fn damaged_gaussians_are_left_out_and_said_to_be() {
    let (_dir, s, o) = setup(SIZE);
    let mut g = gaussians();
    g.means[3][1] = f32::NAN;
    g.means[7][0] = f32::INFINITY;
    g.means[9][2] = 1e30;
    g.log_scales[5][0] = f32::NAN;
    g.opacity_logits[6] = f32::INFINITY;
    ply::write_gaussians(s.join("geometry.ply"), &g, &[]).unwrap();
    let said = succeed(&run(&s, &o, &[]));
    assert!(said.contains("skipped 4 of 61 Gaussians: damaged") && said.contains("vertex 3"), "{said}");
    assert!(said.contains("skipped 1 of 61 Gaussians: never seen"), "{said}");
    let (graph, _) = Graph::read(o.join("graph.safetensors")).unwrap();
    let left_out: Vec<u32> = (0..61).filter(|i| !graph.kept.contains(i)).collect();
    assert_eq!(left_out, [3, 5, 7, 9, 60]);
    let record = std::fs::read_to_string(o.join("graph.safetensors.run.json")).unwrap();
    let summary = &serde_json::from_str::<serde_json::Value>(&record).unwrap()["summary"];
    assert_eq!(summary["damaged"], 4, "{record}");
    // The paper's preset keeps what no view sees, but nothing without a place.
    succeed(&run(&s, &o, &["--preset", "literal"]));
    let (graph, a) = Graph::read(o.join("graph.safetensors")).unwrap();
    assert_eq!(graph.kept.len(), 57);
    let parameters = &a.provenance().parameters;
    assert_eq!((&parameters["gate"], &parameters["min_mask_pixels"]), (&0.0.into(), &0.0.into()));
}

#[test]
fn only_the_masks_of_the_named_levels_are_kept() {
    let (_dir, s, o) = setup(SIZE);
    let footprints = || Footprints::read(o.join("footprints.safetensors")).unwrap();
    succeed(&run(&s, &o, &[]));
    let all = footprints();
    succeed(&run(&s, &o, &["--levels", "large,small"]));
    let some = footprints();
    let of = |f: &Footprints| -> Vec<(Row, Vec<(u32, f32)>)> {
        let wanted = |r: &usize| f.rows[*r].is_of(&[Level::SMALL, Level::LARGE]);
        let entries = |r| f.entries(r).unwrap().iter().collect();
        (0..f.rows.len()).filter(wanted).map(|r| (f.rows[r], entries(r))).collect()
    };
    assert_eq!(of(&all), of(&some));
    assert!(some.rows.len() < all.rows.len() && some.rows.len() == of(&some).len());
}

#[test]
fn pixels_are_kept_where_asked_for_and_change_nothing_else() {
    let (_dir, s, o) = setup(SIZE);
    let footprints = || Footprints::read(o.join("footprints.safetensors")).unwrap();
    succeed(&run(&s, &o, &[]));
    let without = footprints();
    assert!(without.pixels.is_empty());
    succeed(&run(&s, &o, &["--pixel-samples", "8", "--threads", "1"]));
    let with = footprints();
    assert!((0..with.rows.len()).all(|r| with.entries(r).unwrap() == without.entries(r).unwrap()));
    assert_eq!(with.total(), without.total());
    assert!(with.pixels.len() > 4 * 7 * 4 && with.pixels.len() <= 4 * 7 * 8, "{}", with.pixels.len());
    let hash = with.artifact().hash().to_string();
    succeed(&run(&s, &o, &["--pixel-samples", "8", "--threads", "2"]));
    assert_eq!(hash, footprints().artifact().hash());
    // Its Gaussians are among those of its mask.
    let p = with.pixels;
    for (i, &row) in p.row.iter().enumerate() {
        let mask = without.entries(row as usize).unwrap().gaussians;
        let mine = &p.col[p.ptr[i] as usize..p.ptr[i + 1] as usize];
        assert!(!mine.is_empty() && mine.iter().all(|c| mask.contains(c)));
    }
}

#[test]
fn given_maps_of_distorted_photographs_are_undistorted_with_them() {
    let (_dir, s, o) = setup(SIZE);
    // The views share a camera: the same with a barrel lens.
    let f = 0.5 * f64::from(SIZE) / 0.45f64.tan();
    std::fs::remove_file(s.join("sparse/0/cameras.bin")).unwrap();
    let camera = format!("1 SIMPLE_RADIAL {SIZE} {SIZE} {f} 24 24 -0.3\n");
    std::fs::write(s.join("sparse/0/cameras.txt"), camera).unwrap();
    // A thing that ends left of the middle, as it is drawn on the photographs.
    let size = SIZE as usize;
    let drawn = MaskMaps { ids: Array3::from_shape_fn((4, size, size), |(_, _, x)| i32::from(x >= 14)) };
    let load = LoadOptions { resolution: Resolution::Divisor(1.0), holdout: 8 };
    let views = dataset::load(&s, &load).unwrap().views;
    let mut flat = drawn.clone();
    views[0].straighten(flat.ids.as_slice_mut().unwrap(), (size, size));
    assert_ne!(flat, drawn);
    let write = |maps: &MaskMaps| views.iter().for_each(|v| maps.write(maps_path(s.join("masks"), v.stem())).unwrap());
    let rows = || {
        let f = Footprints::read(o.join("footprints.safetensors")).unwrap();
        (0..f.rows.len()).map(|r| (f.rows[r], f.entries(r).unwrap())).collect::<Vec<_>>()
    };
    write(&drawn);
    let said = succeed(&run(&s, &o, &[]));
    assert!(said.contains("the lenses of 5 of 5 photographs are distorted"), "{said}");
    assert!(said.contains("the id maps of 4 views are undistorted"), "{said}");
    let given = rows();
    // The maps that mask-embed would have made of the undistorted photographs are taken as they are.
    write(&flat);
    let made = Provenance { inputs: [(role::DATASET.to_string(), String::new())].into(), ..Provenance::default() };
    gs_io::write_json(s.join("masks/masks.json"), &made).unwrap();
    let said = succeed(&run(&s, &o, &[]));
    assert!(!said.contains("id maps of 4 views"), "{said}");
    assert!(given == rows() && !given.is_empty(), "other footprints");
}

#[test]
fn one_gaussian_and_one_view_are_enough() {
    let (_dir, s, o) = setup(SIZE);
    let one = gaussians().select(&[0]);
    let mut one = Gaussians { log_scales: vec![[0.5; 3]], ..one };
    one.means[0] = [0.0; 3];
    ply::write_gaussians(s.join("geometry.ply"), &one, &[]).unwrap();
    for v in 1..4 {
        std::fs::remove_file(s.join(format!("masks/v{v}_s.npy"))).unwrap();
    }
    succeed(&run(&s, &o, &[]));
    let (graph, _) = Graph::read(o.join("graph.safetensors")).unwrap();
    assert_eq!((&graph.anchors[..], &graph.nearest_anchor[..]), (&[0u32][..], &[0u32][..]));
    assert!(graph.knn.iter().chain(&graph.anchor_knn).chain(&graph.gaussian_knn).all(|&i| i == 0));
}

/// The header tells how many Gaussians there are: this file has nothing behind it, which only unpacking would find.
#[test]
fn a_limit_of_memory_holds_before_packed_gaussians_are_unpacked() {
    let (_dir, scene, out) = setup(32);
    let header =
        [&b"NGSP\x04\0\0\0"[..], &10_000_000u32.to_le_bytes(), &[0, 12, 0, 5], &[32, 0, 0, 0], &[0; 12]].concat();
    std::fs::write(scene.join("geometry.ply"), [header, vec![7; 100_000]].concat()).unwrap();
    for (limit, wanted) in
        [("200M", "--memory-limit: the run needs more memory than it may take"), ("900G", "not a value of SPZ")]
    {
        let refused = run(&scene, &out, &["--memory-limit", limit]);
        let said = String::from_utf8_lossy(&refused.stderr).into_owned();
        assert!(refused.status.code() == Some(2) && said.contains(wanted), "{said}");
    }
}
