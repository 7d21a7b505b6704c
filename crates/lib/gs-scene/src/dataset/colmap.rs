//! COLMAP sparse models: `cameras`, `images` and `points3D`, `.bin` or `.txt`.

mod binary;
mod text;

use super::names::{check_inside, file_named};
use super::upright::Turn;
use super::{Format, RawDataset, RawView};
use crate::PointCloud;
use crate::lens::{Distortion, Lens};
use crate::middle::shifted;
pub use binary::write_model;
use glam::{DMat3, DQuat, DVec3};
use gs_io::{Error, IoContext, Result};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// A registered image.
struct Registered {
    /// File name relative to the images folder.
    name: String,
    /// Key of its camera.
    camera: u32,
    /// Camera from world.
    rotation: DMat3,
    translation: DVec3,
}

const AGAIN: &str = "export the COLMAP model again";

/// A sparse model of a scene.
pub(crate) struct Model {
    folder: PathBuf,
    /// What to say where it was chosen among several.
    chosen: Option<String>,
}

impl Model {
    pub fn folder(&self) -> &Path {
        &self.folder
    }
}

/// The sparse model within a scene, if any: of `sparse/0`, `sparse/1`, ... the one with most photographs, else `sparse`, one of
/// `colmap/sparse/0`, ..., or the folder itself.
pub(crate) fn find_model(scene: &Path) -> Option<Model> {
    let own = |folder: &str| {
        let folder = Some(scene.join(folder)).filter(|f| file_of(f, "cameras").is_some())?;
        Some(Model { folder, chosen: None })
    };
    let largest = |folder: &str| largest_model(&scene.join(folder));
    largest("sparse").or_else(|| own("sparse")).or_else(|| largest("colmap/sparse")).or_else(|| own("."))
}

/// The model that a file belongs to: its `cameras`, `images` or `points3D`.
pub(super) fn model_of_file(path: &Path) -> Option<Model> {
    let is_part =
        path.file_stem().is_some_and(|stem| ["cameras", "images", "points3D"].iter().any(|part| *part == stem));
    let folder = path.parent().filter(|folder| is_part && path.is_file() && file_of(folder, "cameras").is_some())?;
    Some(Model { folder: folder.to_path_buf(), chosen: None })
}

/// COLMAP writes a model for each group of photographs that it can link, in folders with numbers for names: of these the one with most
/// photographs, of equals the first. A model that can't be read has none.
fn largest_model(folder: &Path) -> Option<Model> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let numbered = entries.filter_map(|e| Some((e.file_name().to_str()?.parse::<u32>().ok()?, e.path())));
    let mut models: Vec<_> = numbered.filter(|(_, path)| file_of(path, "cameras").is_some()).collect();
    models.sort();
    if models.len() < 2 {
        return models.pop().map(|(_, folder)| Model { folder, chosen: None });
    }
    let photographs = |path: &Path| part(path, "images", binary::images, text::images).map_or(0, |(_, all)| all.len());
    let counts: Vec<usize> = models.iter().map(|(_, path)| photographs(path)).collect();
    let best = (0..models.len()).rev().max_by_key(|&k| counts[k])?;
    let said = |k: usize| format!("{} with {}", models[k].1.display(), counts[k]);
    let others: Vec<String> = (0..models.len()).filter(|&k| k != best).map(said).collect();
    let chosen = format!(
        "the model {} photographs is taken, not {}: COLMAP could not link them; --scene takes the cameras file of another",
        said(best),
        others.join(", ")
    );
    Some(Model { folder: models.swap_remove(best).1, chosen: Some(chosen) })
}

/// A file of a model: `.bin` where there is one, else `.txt`.
fn file_of(folder: &Path, name: &str) -> Option<PathBuf> {
    ["bin", "txt"].iter().map(|e| folder.join(format!("{name}.{e}"))).find(|p| p.is_file())
}

/// Loads a model of the scene `root`; photographs lie in `images`, `input`, or the scene itself. Those of a model that is given by
/// itself lie in such a folder beside it or above. Without `points3D` there are no points.
pub(crate) fn load(root: &Path, model: Model) -> Result<RawDataset> {
    let Model { folder: model, chosen } = model;
    let model = model.as_path();
    let (cameras_path, cameras) = part(model, "cameras", binary::cameras, text::cameras)?;
    if cameras.is_empty() {
        let e = Error::new("the model has no camera").file(&cameras_path);
        return Err(e.field("camera count").found(0).hint(AGAIN));
    }
    let (path, images) = part(model, "images", binary::images, text::images)?;
    if images.is_empty() {
        return Err(Error::new("the model has no image")
            .file(&path)
            .field("image count")
            .found(0)
            .hint("COLMAP registered no photograph: give it more of them, with more overlap"));
    }
    if let Some(image) = images.iter().find(|i| !cameras.contains_key(&i.camera)) {
        return Err(Error::new("the image's camera is unknown")
            .file(&path)
            .field(&image.name)
            .found(format!("camera {}", image.camera))
            .expected(format!("one of the {} in {}", cameras.len(), cameras_path.display()))
            .hint(AGAIN));
    }
    let mut files = vec![cameras_path, path];
    let mut points = PointCloud::default();
    if file_of(model, "points3D").is_some() {
        let (path, found) = part(model, "points3D", binary::points, text::points)?;
        files.push(path);
        let (shift, positions) = shifted(&found.positions);
        points = PointCloud { positions, colors: found.colors, shift };
    }
    let below = |root: &Path| ["images", "input"].map(|name| root.join(name)).into_iter().find(|d| d.is_dir());
    let folder = if model.starts_with(root) && model != root {
        below(root).unwrap_or_else(|| root.to_path_buf())
    } else {
        let first = |folder: &PathBuf| file_named(folder, &images[0].name).is_some();
        let above = model.ancestors().skip(1).take(3).filter_map(below);
        below(model)
            .into_iter()
            .chain([model.to_path_buf()])
            .chain(above)
            .find(first)
            .unwrap_or_else(|| model.to_path_buf())
    };
    let (mut views, mut warnings) = (Vec::new(), Vec::new());
    for Registered { name, camera, rotation, translation } in images {
        check_inside(&name, "images").map_err(|e| e.file(model))?;
        let found = file_named(&folder, &name);
        let image_path = folder.join(found.as_ref().unwrap_or(&name));
        if found.is_some() {
            views.push(RawView {
                name,
                image_path,
                lens: cameras[&camera],
                rotation,
                translation,
                split: None,
                depth: None,
                mask: None,
                turn: Turn::NONE,
            });
        } else {
            warnings.push(format!("{}: no such photograph, view skipped", image_path.display()));
        }
    }
    warnings.extend(chosen);
    // Those of scripts/poses.py are as the camera took them.
    warnings.extend(distorted(model, &views).filter(|_| !root.join("poses.json").is_file()));
    Ok(RawDataset { format: Format::Colmap, files, views, points, warnings, skipped: Vec::new() })
}

/// Says that the model's photographs are not undistorted, where they are not: who undistorted them has another model, too.
fn distorted(model: &Path, views: &[RawView]) -> Option<String> {
    let bent = views.iter().filter(|v| !v.lens.distortion.is_none()).count();
    (bent > 0).then(|| {
        format!(
            "{}: the lenses of {bent} of {} photographs are distorted: photographs, id maps and labels of them are undistorted \
             as they are read; where the photographs are undistorted already, give the model that belongs \
             to them (COLMAP's image_undistorter writes both)",
            model.display(),
            views.len()
        )
    })
}

type Read<T> = fn(&[u8]) -> Result<T>;

/// Reads one of the files of a model; gives its path too.
fn part<T>(folder: &Path, name: &str, binary: Read<T>, text: Read<T>) -> Result<(PathBuf, T)> {
    let path = file_of(folder, name).unwrap_or_else(|| folder.join(format!("{name}.txt")));
    let bytes = std::fs::read(&path).at("read", &path)?;
    let read = if path.extension().is_some_and(|e| e == "bin") { binary } else { text };
    let value = read(&bytes).map_err(|e| e.file(&path))?;
    Ok((path, value))
}

fn intrinsics(model: &str, width: u64, height: u64, p: &[f64], field: &str) -> Result<Lens> {
    let fail = |what: &str| Error::new(what).field(field);
    let d = Distortion::default();
    let (focal_center, distortion) = match (model, p) {
        ("SIMPLE_PINHOLE", &[f, cx, cy]) => ([f, f, cx, cy], d),
        ("PINHOLE", &[fx, fy, cx, cy]) => ([fx, fy, cx, cy], d),
        ("SIMPLE_RADIAL", &[f, cx, cy, k]) => ([f, f, cx, cy], Distortion { k: [k, 0.0, 0.0], ..d }),
        ("RADIAL", &[f, cx, cy, k1, k2]) => ([f, f, cx, cy], Distortion { k: [k1, k2, 0.0], ..d }),
        ("OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2]) => {
            ([fx, fy, cx, cy], Distortion { k: [k1, k2, 0.0], p: [p1, p2], ..d })
        }
        ("FULL_OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6]) => {
            ([fx, fy, cx, cy], Distortion { k: [k1, k2, k3], denominator: [k4, k5, k6], p: [p1, p2] })
        }
        _ => {
            return Err(fail("unsupported camera model")
                .found(format!("{model} with {} parameters", p.len()))
                .expected("PINHOLE, SIMPLE_PINHOLE, SIMPLE_RADIAL, RADIAL, OPENCV or FULL_OPENCV")
                .hint("run COLMAP's image_undistorter"));
        }
    };
    if ![width, height].iter().all(|v| (1..=1 << 20).contains(v)) {
        return Err(fail("impossible image size")
            .found(format!("{width}x{height}"))
            .expected("1 to 1048576 pixels each")
            .hint(AGAIN));
    }
    if !(focal_center[..2].iter().all(|f| *f > 0.0) && p.iter().all(|v| v.is_finite())) {
        return Err(fail("impossible camera parameters")
            .found(format!("{p:?}"))
            .expected("finite numbers, focal lengths above zero")
            .hint(AGAIN));
    }
    Ok(Lens { size: (width as u32, height as u32), focal_center, distortion })
}

/// Adds a camera; ids are unique.
fn push_camera(out: &mut BTreeMap<u32, Lens>, id: u32, camera: Lens, field: &str) -> Result<()> {
    match out.insert(id, camera) {
        None => Ok(()),
        Some(_) => Err(Error::new("two cameras have the same id").field(field).found(id).hint(AGAIN)),
    }
}

fn pose(q: [f64; 4], t: [f64; 3], field: &str) -> Result<(DMat3, DVec3)> {
    let quat = DQuat::from_xyzw(q[1], q[2], q[3], q[0]);
    let norm = quat.length();
    if !(norm.is_finite() && norm > 1e-9 && t.iter().all(|v| v.is_finite())) {
        return Err(Error::new("impossible pose")
            .field(field)
            .found(format!("quaternion {q:?}, translation {t:?}"))
            .expected("finite numbers and a quaternion other than zero")
            .hint(AGAIN));
    }
    Ok((DMat3::from_quat(quat.normalize()), DVec3::from_array(t)))
}

/// Points as the model has them.
#[derive(Default)]
struct Points {
    positions: Vec<[f64; 3]>,
    colors: Vec<[u8; 3]>,
}

fn push_point(out: &mut Points, p: [f64; 3], color: [u8; 3], field: &str) -> Result<()> {
    if !p.iter().all(|v| (*v as f32).is_finite()) {
        return Err(Error::new("the position is not finite")
            .field(field)
            .found(format!("{p:?}"))
            .expected("numbers within the range of f32")
            .hint(AGAIN));
    }
    out.positions.push(p);
    out.colors.push(color);
    Ok(())
}
