//! `transforms.json` of nerfstudio, instant-ngp and Blender; OpenGaussian's conversion of ScanNet is one of these.

use super::{Format, RawDataset, RawView, Source, Split, picture_size, read_text};
use crate::distortion::Distortion;
use crate::{PointCloud, ply};
use glam::{DMat4, DVec4};
use gs_io::{Error, Result};
use serde_json::Value;
use std::path::{Path, PathBuf};

/// The transforms files of a folder, if it has any.
pub(super) fn find(root: &Path) -> Option<Vec<PathBuf>> {
    let whole = root.join("transforms.json");
    if whole.is_file() {
        return Some(vec![whole]);
    }
    let parts: Vec<PathBuf> = ["transforms_train.json", "transforms_test.json"]
        .iter()
        .map(|n| root.join(n))
        .filter(|p| p.is_file())
        .collect();
    (!parts.is_empty()).then_some(parts)
}

/// Reads views from the files; the split comes from the name `transforms_test.json`.
pub(super) fn load(root: &Path, files: &[PathBuf]) -> Result<RawDataset> {
    let mut out = RawDataset {
        format: Format::Transforms,
        views: Vec::new(),
        points: PointCloud::default(),
        warnings: Vec::new(),
    };
    for file in files {
        let split = match file.file_name().and_then(|n| n.to_str()) {
            Some("transforms_train.json") => Some(Split::Train),
            Some("transforms_test.json") => Some(Split::Test),
            _ => None,
        };
        read_file(root, file, split, &mut out).map_err(|e| e.file(file))?;
    }
    // OpenGaussian lists every frame of ScanNet in both files; a frame to learn from is not held out.
    let train: std::collections::BTreeSet<String> =
        out.views.iter().filter(|v| v.split == Some(Split::Train)).map(|v| v.name.clone()).collect();
    out.views.retain(|v| v.split != Some(Split::Test) || !train.contains(&v.name));
    let named = ["points3d.ply", "points3D.ply", "sparse_pc.ply"].iter().map(|n| root.join(n)).find(|p| p.is_file());
    if let Some(path) = named {
        out.points = ply::read_points(path)?;
    }
    Ok(out)
}

fn read_file(root: &Path, file: &Path, split: Option<Split>, out: &mut RawDataset) -> Result<()> {
    let json: Value = serde_json::from_str(&read_text(file)?)
        .map_err(|e| Error::new(format!("not JSON: {e}")).hint("export the transforms again"))?;
    let frames = json["frames"].as_array().ok_or_else(|| Error::new("no list of frames").field("frames"))?;
    for (i, frame) in frames.iter().enumerate() {
        let field = format!("frames[{i}]");
        let name = frame["file_path"]
            .as_str()
            .ok_or_else(|| Error::new("no file name").field(format!("{field}.file_path")))?
            .trim_start_matches("./");
        let leads_out = Path::new(name).components().any(|c| !matches!(c, std::path::Component::Normal(_)));
        if leads_out {
            return Err(Error::new("the name leads out of the folder").field(format!("{field}.file_path")).found(name));
        }
        let found = ["", ".png", ".jpg", ".jpeg", ".JPG", ".PNG"]
            .iter()
            .map(|e| format!("{name}{e}"))
            .find(|n| root.join(n).is_file());
        let Some(name) = found else {
            out.warnings.push(format!("{}: no such photograph, view skipped", root.join(name).display()));
            continue;
        };
        let image_path = root.join(&name);
        let world_from_camera = matrix(&frame["transform_matrix"], &field)?;
        // OpenGL cameras look along -z with y up; ours along +z with y down.
        let flip = DMat4::from_diagonal(DVec4::new(1.0, -1.0, -1.0, 1.0));
        let camera_from_world = (world_from_camera * flip).inverse();
        if !camera_from_world.is_finite() {
            out.warnings.push(format!("{name}: the pose is not finite, view skipped"));
            continue;
        }
        let source = source(&json, frame, &image_path, &field)?;
        let short = name.strip_prefix("images/").or(name.strip_prefix("color/")).unwrap_or(&name).to_string();
        out.views.push(RawView {
            name: short,
            image_path,
            source,
            rotation: glam::DMat3::from_mat4(camera_from_world),
            translation: camera_from_world.w_axis.truncate(),
            split,
        });
    }
    Ok(())
}

/// A 4x4 matrix; numbers that JSON cannot write (infinite poses come as null or strings) become NaN.
fn matrix(value: &Value, field: &str) -> Result<DMat4> {
    let rows = value.as_array().filter(|r| (3..=4).contains(&r.len()));
    let mut m = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0];
    let rows = rows.ok_or_else(|| Error::new("not a 4x4 matrix").field(format!("{field}.transform_matrix")))?;
    for (r, row) in rows.iter().enumerate() {
        let row = row.as_array().filter(|r| r.len() == 4);
        let row = row.ok_or_else(|| Error::new("not a 4x4 matrix").field(format!("{field}.transform_matrix[{r}]")))?;
        for (c, v) in row.iter().enumerate() {
            m[4 * r + c] = v.as_f64().unwrap_or(f64::NAN);
        }
    }
    Ok(DMat4::from_cols_array(&m).transpose())
}

/// Intrinsics: of the frame where it has them, else of the file.
fn source(file: &Value, frame: &Value, image: &Path, field: &str) -> Result<Source> {
    let get = |key: &str| frame[key].as_f64().or_else(|| file[key].as_f64());
    let (w, h) = match (get("w"), get("h")) {
        (Some(w), Some(h)) if (1.0..1e6).contains(&w) && (1.0..1e6).contains(&h) => (w as u32, h as u32),
        _ => picture_size(image)?,
    };
    let focal = |length: &str, angle: &str, size: u32| {
        get(length).or_else(|| get(angle).map(|a| 0.5 * f64::from(size) / (0.5 * a).tan()))
    };
    let fx = focal("fl_x", "camera_angle_x", w);
    let fy = focal("fl_y", "camera_angle_y", h).or(fx);
    let (Some(fx), Some(fy)) = (fx.or(fy), fy) else {
        return Err(Error::new("no focal length").field(field).expected("fl_x or camera_angle_x"));
    };
    let center = [get("cx").unwrap_or(0.5 * f64::from(w)), get("cy").unwrap_or(0.5 * f64::from(h))];
    let zero = |key: &str| get(key).unwrap_or(0.0);
    let distortion =
        Distortion { k: [zero("k1"), zero("k2"), zero("k3")], p: [zero("p1"), zero("p2")], ..Distortion::default() };
    if !(fx.is_finite() && fy.is_finite() && fx > 0.0 && fy > 0.0) {
        return Err(Error::new("impossible focal length").field(field).found(format!("{fx} {fy}")));
    }
    if file["camera_model"].as_str().is_some_and(|m| m.contains("FISHEYE")) {
        return Err(Error::new("unsupported camera model")
            .field("camera_model")
            .found("FISHEYE")
            .expected("a perspective camera"));
    }
    Ok(Source { size: (w, h), focal_center: [fx, fy, center[0], center[1]], distortion })
}
