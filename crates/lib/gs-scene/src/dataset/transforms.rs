//! `transforms.json` of nerfstudio, instant-ngp and Blender; OpenGaussian's conversion of ScanNet is one of these.

use super::depth::{Depth, DepthCamera, MILLIMETRES};
use super::names::{check_inside, file_named, plain};
use super::upright::{Turn, size_by_center};
use super::{Format, RawDataset, RawView, Split, invert_pose, read_text};
use crate::lens::{Distortion, Lens};
use crate::{Camera, PointCloud, ply};
use glam::{DMat4, DVec4};
use gs_io::{Error, Result, write_json};
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::f64::consts::PI;
use std::path::{Path, PathBuf};

const AGAIN: &str = "export the transforms again";

/// The transforms files of a folder: one, and Blender's two that belong together.
pub(super) fn find(root: &Path) -> Vec<Vec<PathBuf>> {
    let there = |names: &[&str]| names.iter().map(|n| root.join(n)).filter(|p| p.is_file()).collect::<Vec<PathBuf>>();
    let parts = [&["transforms.json"][..], &["transforms_train.json", "transforms_test.json"]];
    parts.into_iter().map(there).filter(|files| !files.is_empty()).collect()
}

/// Writes views, file names and cameras in the world less `shift`, that all have the intrinsics of the first.
///
/// # Errors
/// When the file can't be written.
pub fn write(path: &Path, views: &[(String, Camera)], shift: [f64; 3]) -> Result<()> {
    let Some((_, c)) = views.first() else { return Ok(()) };
    let frame = |(name, camera): &(String, Camera)| -> Value {
        let mut pose = camera.opengl_pose();
        pose.iter_mut().zip(shift).for_each(|(row, shift)| row[3] += shift);
        json!({"file_path": name, "transform_matrix": pose})
    };
    let frames: Vec<Value> = views.iter().map(frame).collect();
    write_json(
        path,
        &json!({
            "camera_model": "PINHOLE", "w": c.width, "h": c.height, "fl_x": c.fx, "fl_y": c.fy, "cx": c.cx, "cy": c.cy, "frames": frames,
        }),
    )
}

/// Reads views from the files; the split comes from the names `transforms_train.json` and `transforms_test.json`, or
/// from nerfstudio's lists.
pub(super) fn load(root: &Path, files: &[PathBuf]) -> Result<RawDataset> {
    let mut out = RawDataset {
        format: Format::Transforms,
        files: files.to_vec(),
        views: Vec::new(),
        points: PointCloud::default(),
        warnings: Vec::new(),
        skipped: Vec::new(),
    };
    let mut clouds = ["points3d.ply", "points3D.ply", "sparse_pc.ply"].map(PathBuf::from).to_vec();
    for file in files {
        let split = match file.file_name().and_then(|n| n.to_str()) {
            Some("transforms_train.json") => Some(Split::Train),
            Some("transforms_test.json") => Some(Split::Test),
            _ => None,
        };
        let json = read_json(file)?;
        read_frames(root, &json, split, &mut out).map_err(|e| e.file(file))?;
        if let Some(name) = json["ply_file_path"].as_str() {
            check_inside(name, "ply_file_path").map_err(|e| e.file(file))?;
            clouds.insert(0, plain(name).into());
        }
    }
    // OpenGaussian lists every frame of ScanNet in both files; a frame to learn from is not held out.
    let train: BTreeSet<String> =
        out.views.iter().filter(|v| v.split == Some(Split::Train)).map(|v| v.name.clone()).collect();
    out.views.retain(|v| v.split != Some(Split::Test) || !train.contains(&v.name));
    if let Some(path) = clouds.iter().map(|n| root.join(n)).find(|p| p.is_file()) {
        out.points = ply::read_points(&path)?;
        out.files.push(path);
    }
    Ok(out)
}

/// The content of a JSON file.
pub(super) fn read_json(file: &Path) -> Result<Value> {
    serde_json::from_slice(&without_infinities(read_text(file)?))
        .map_err(|e| Error::new(format!("not JSON: {e}")).file(file).hint(AGAIN))
}

/// Python writes lost poses as `-Infinity` and `NaN`, which JSON does not know: makes them empty strings.
fn without_infinities(text: String) -> Vec<u8> {
    let mut bytes = text.into_bytes();
    let (mut at, mut in_string) = (0, false);
    while at < bytes.len() {
        match bytes[at] {
            b'"' => in_string = !in_string,
            b'\\' if in_string => at += 1,
            _ if !in_string => {
                if let Some(word) =
                    ["-Infinity", "Infinity", "NaN"].iter().find(|w| bytes[at..].starts_with(w.as_bytes()))
                {
                    // In place; an empty string reads as well as null and fits where NaN stood.
                    bytes[at..at + word.len()].fill(b' ');
                    bytes[at..at + 2].fill(b'"');
                    at += word.len() - 1;
                }
            }
            _ => {}
        }
        at += 1;
    }
    bytes
}

fn read_frames(root: &Path, json: &Value, split: Option<Split>, out: &mut RawDataset) -> Result<()> {
    let frames = json["frames"]
        .as_array()
        .ok_or_else(|| Error::new("the file has no list of frames").field("frames").hint(AGAIN))?;
    for (i, frame) in frames.iter().enumerate() {
        let field = format!("frames[{i}]");
        let path = frame["file_path"].as_str().ok_or_else(|| {
            let field = format!("{field}.file_path");
            Error::new("the frame names no photograph").field(field).found(brief(&frame["file_path"])).hint(AGAIN)
        })?;
        check_inside(path, &format!("{field}.file_path"))?;
        let Some(name) = file_named(root, path) else {
            out.warnings.push(format!("{}: no such photograph, view skipped", root.join(plain(path)).display()));
            continue;
        };
        // OpenGL cameras look along -z with y up; ours along +z with y down.
        let flip = DMat4::from_diagonal(DVec4::new(1.0, -1.0, -1.0, 1.0));
        let field = format!("{field}.transform_matrix");
        let Some((rotation, translation)) = invert_pose(matrix(&frame["transform_matrix"], &field)? * flip, &field)?
        else {
            out.warnings.push(format!("{name}: the pose is not finite, view skipped"));
            out.skipped.push(root.join(name));
            continue;
        };
        let image_path = root.join(&name);
        let lens = lens(json, frame, &image_path, &format!("frames[{i}]"))?;
        let listed = |key: &str| {
            json[key].as_array().is_some_and(|l| l.iter().any(|n| n.as_str().is_some_and(|n| plain(n) == plain(path))))
        };
        let split = split.or(match (listed("test_filenames"), listed("train_filenames")) {
            (true, false) => Some(Split::Test),
            (_, true) => Some(Split::Train),
            (false, false) => None,
        });
        let short = ["images/", "color/"].iter().find_map(|folder| name.strip_prefix(folder));
        let name = short.unwrap_or(&name).to_string();
        let field = format!("frames[{i}]");
        let depth = depth(root, json, frame, &field, &mut out.warnings)?;
        let mask = companion(root, frame, &["mask_path"], &field, &mut out.warnings)?;
        let turn = Turn::NONE;
        out.views.push(RawView { name, image_path, lens, rotation, translation, split, depth, mask, turn });
    }
    Ok(())
}

/// The file beside a photograph that a frame names under one of the keys; none, with a warning, where it is not there.
fn companion(
    root: &Path,
    frame: &Value,
    keys: &[&str],
    field: &str,
    warnings: &mut Vec<String>,
) -> Result<Option<PathBuf>> {
    let Some((key, name)) = keys.iter().find_map(|key| Some((key, frame[key].as_str()?))) else { return Ok(None) };
    check_inside(name, &format!("{field}.{key}"))?;
    let found = file_named(root, name).map(|name| root.join(name));
    if found.is_none() {
        warnings.push(format!("{field}.{key}: no such file as {}", root.join(plain(name)).display()));
    }
    Ok(found)
}

/// The frame's depth image, as nerfstudio names it, or instant-ngp: a number of it is a millimetre, unless the file says otherwise.
fn depth(root: &Path, file: &Value, frame: &Value, field: &str, warnings: &mut Vec<String>) -> Result<Option<Depth>> {
    let Some(path) = companion(root, frame, &["depth_file_path", "depth_path"], field, warnings)? else {
        return Ok(None);
    };
    let given = ["depth_unit_scale_factor", "integer_depth_scale"].into_iter().find(|key| !file[key].is_null());
    let unit = given.map_or(Ok(MILLIMETRES), |key| {
        let number = file[key].as_f64().filter(|u| *u > 0.0 && u.is_finite());
        number.ok_or_else(|| {
            Error::new("no unit of depth").field(key).found(brief(&file[key])).expected("a number above zero")
        })
    })?;
    Ok(Some(Depth { path, unit, camera: DepthCamera::Photograph }))
}

/// A value's first characters, to show what was found.
fn brief(value: &Value) -> String {
    value.to_string().chars().take(80).collect()
}

/// A 4x4 matrix, or its first three rows; numbers that JSON cannot write (lost poses come as null or words) become NaN.
fn matrix(value: &Value, field: &str) -> Result<DMat4> {
    let wrong =
        || Error::new("not a 4x4 matrix").field(field).found(brief(value)).expected("four rows of four").hint(AGAIN);
    let mut m = DMat4::IDENTITY.to_cols_array();
    let rows = value.as_array().filter(|r| (3..=4).contains(&r.len())).ok_or_else(wrong)?;
    for (r, row) in rows.iter().enumerate() {
        let row = row.as_array().filter(|r| r.len() == 4).ok_or_else(wrong)?;
        for (c, v) in row.iter().enumerate() {
            m[4 * r + c] = v.as_f64().unwrap_or(f64::NAN);
        }
    }
    // Lost poses, which may be all zeros, are left out later. Rounding errors of an inverse are no translation.
    let w = if m[15].is_finite() && m[15] != 0.0 { m[15] } else { 1.0 };
    m.iter_mut().for_each(|v| *v /= w);
    if m[12..15].iter().any(|v| v.abs() > 1e-6 && v.is_finite()) {
        return Err(Error::new("the last row of the pose is not 0 0 0 1")
            .field(field)
            .found(brief(&rows[3]))
            .expected("the translation in the last column")
            .hint("transpose the matrices"));
    }
    Ok(DMat4::from_cols_array(&m).transpose())
}

/// Refuses lenses that are not of OpenCV's family: their photographs have to be undistorted by other programs.
fn check_model<'a>(value: impl Fn(&str) -> &'a Value, field: &str) -> Result<()> {
    const KNOWN: [&str; 7] =
        ["OPENCV", "FULL_OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE"];
    // How instant-ngp marks other lenses.
    const OTHERS: [&str; 5] = ["is_fisheye", "orthographic", "latlong", "equirectangular", "ftheta_p1"];
    let unsupported = |key: &str, expected: String| {
        let v = value(key);
        Err(Error::new("unsupported camera model")
            .field(format!("{field}, {key}"))
            .found(v.as_str().map_or_else(|| brief(v), String::from))
            .expected(expected)
            .hint("undistort the photographs first"))
    };
    let model = value("camera_model");
    if !(model.is_null() || model.as_str().is_some_and(|m| KNOWN.contains(&m))) {
        return unsupported("camera_model", KNOWN.join(", "));
    }
    let is_off = |v: &Value| v.is_null() || v.as_bool() == Some(false) || v.as_f64() == Some(0.0);
    match OTHERS.iter().find(|key| !is_off(value(key))) {
        Some(key) => unsupported(key, "false, or nothing: a lens of OpenCV's model".into()),
        None => Ok(()),
    }
}

/// The camera: of the frame where it has one, else of the file.
fn lens(file: &Value, frame: &Value, image: &Path, field: &str) -> Result<Lens> {
    let value = |key: &str| if frame[key].is_null() { &file[key] } else { &frame[key] };
    let get = |key: &str| match value(key) {
        Value::Null => Ok(None),
        v => v
            .as_f64()
            .map(Some)
            .ok_or_else(|| Error::new("not a number").field(format!("{field}, {key}")).found(brief(v)).hint(AGAIN)),
    };
    check_model(value, field)?;
    let (w, h) = match (get("w")?, get("h")?) {
        (Some(w), Some(h)) => {
            if ![w, h].iter().all(|v| (1.0..=1_048_576.0).contains(v)) {
                return Err(Error::new("impossible image size")
                    .field(format!("{field}, w and h"))
                    .found(format!("{w}x{h}"))
                    .expected("1 to 1048576 pixels each")
                    .hint(AGAIN));
            }
            (w as u32, h as u32)
        }
        _ => size_by_center(image, get("cx")?.zip(get("cy")?))?,
    };
    // Of a tangent nobody could tell degrees from radians.
    let of_angle = |key: &str, size: u32| match get(key)? {
        Some(a) if !(a > 0.0 && a < PI) => Err(Error::new("no angle of view")
            .field(format!("{field}, {key}"))
            .found(a)
            .expected("radians, between 0 and 3.1416")
            .hint(AGAIN)),
        angle => Ok(angle.map(|a| 0.5 * f64::from(size) / (0.5 * a).tan())),
    };
    let pixels = |key: &str, angle: &str, size: u32| get(key)?.map_or_else(|| of_angle(angle, size), |f| Ok(Some(f)));
    let fx = pixels("fl_x", "camera_angle_x", w)?;
    let fy = pixels("fl_y", "camera_angle_y", h)?;
    let focal = fx.or(fy).zip(fy.or(fx)).filter(|(x, y)| [x, y].iter().all(|f| **f > 0.0 && f.is_finite()));
    let Some((fx, fy)) = focal else {
        return Err(Error::new("no usable focal length")
            .field(format!("{field}, fl_x or camera_angle_x"))
            .found(format!("{fx:?} pixels"))
            .expected("a number of pixels, or an angle of less than a half-turn in radians")
            .hint(AGAIN));
    };
    let cx = get("cx")?.unwrap_or(0.5 * f64::from(w));
    let cy = get("cy")?.unwrap_or(0.5 * f64::from(h));
    let coefficient = |key: &str| get(key).map(Option::unwrap_or_default);
    let k = [coefficient("k1")?, coefficient("k2")?, coefficient("k3")?];
    let p = [coefficient("p1")?, coefficient("p2")?];
    // FULL_OPENCV divides by a second polynomial; other models leave k4 to k6 out or at zero.
    let denominator = [coefficient("k4")?, coefficient("k5")?, coefficient("k6")?];
    let distortion = Distortion { k, denominator, p };
    Ok(Lens { size: (w, h), focal_center: [fx, fy, cx, cy], distortion })
}
