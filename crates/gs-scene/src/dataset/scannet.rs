//! ScanNet as its tools extract it: `color/<id>.jpg`, `pose/<id>.txt`, `intrinsic/intrinsic_color.txt`, and the scan's
//! vertices in `*_vh_clean_2.ply`.

use super::{Format, RawDataset, RawView, Source, picture_size, read_text};
use crate::distortion::Distortion;
use crate::{PointCloud, ply};
use glam::DMat4;
use gs_io::{Error, IoContext, Result};
use std::path::Path;

pub(super) fn is_scannet(root: &Path) -> bool {
    ["color", "pose", "intrinsic"].iter().all(|d| root.join(d).is_dir())
}

pub(super) fn load(root: &Path) -> Result<RawDataset> {
    let k = matrix(&root.join("intrinsic/intrinsic_color.txt"))?;
    let mut warnings = Vec::new();
    let mut views = Vec::new();
    let color = root.join("color");
    for entry in std::fs::read_dir(&color).at("list", &color)? {
        let image_path = entry.at("list", &color)?.path();
        let Some(stem) = image_path.file_stem().and_then(|s| s.to_str()) else { continue };
        let Ok(id) = stem.parse::<u64>() else { continue };
        let pose_path = root.join("pose").join(format!("{stem}.txt"));
        if !pose_path.is_file() {
            warnings.push(format!("{}: no such pose, view skipped", pose_path.display()));
            continue;
        }
        let camera_from_world = matrix(&pose_path)?.inverse();
        if !camera_from_world.is_finite() {
            warnings.push(format!("{}: the pose is not finite, view skipped", pose_path.display()));
            continue;
        }
        let size = picture_size(&image_path)?;
        views.push((
            id,
            RawView {
                name: image_path.file_name().unwrap_or_default().to_string_lossy().into_owned(),
                source: Source {
                    size,
                    focal_center: [k.x_axis.x, k.y_axis.y, k.z_axis.x, k.z_axis.y],
                    distortion: Distortion::default(),
                },
                image_path,
                rotation: glam::DMat3::from_mat4(camera_from_world),
                translation: camera_from_world.w_axis.truncate(),
                split: None,
            },
        ));
    }
    views.sort_by_key(|(id, _)| *id);
    warnings.sort();
    let mut scans: Vec<_> = std::fs::read_dir(root)
        .at("list", root)?
        .filter_map(|e| Some(e.ok()?.path()))
        .filter(|p| p.to_string_lossy().ends_with("_vh_clean_2.ply"))
        .collect();
    scans.sort();
    let points = scans.first().map_or_else(|| Ok(PointCloud::default()), ply::read_points)?;
    Ok(RawDataset { format: Format::ScanNet, views: views.into_iter().map(|(_, v)| v).collect(), points, warnings })
}

/// A 4x4 (or 3x3) matrix of whitespace-separated numbers; `-inf` marks a lost pose.
fn matrix(path: &Path) -> Result<DMat4> {
    let text = read_text(path)?;
    let numbers: Result<Vec<f64>> = text
        .split_ascii_whitespace()
        .map(|w| w.parse().map_err(|_| Error::new("not a number").file(path).found(w)))
        .collect();
    let numbers = numbers?;
    if numbers.len() != 16 {
        return Err(Error::new("not a 4x4 matrix").file(path).found(format!("{} numbers", numbers.len())).expected(16));
    }
    Ok(DMat4::from_cols_slice(&numbers).transpose())
}
