//! ScanNet as its tools extract it: `color/<id>.jpg`, `pose/<id>.txt`, `intrinsic/intrinsic_color.txt`, and the scan's
//! vertices in `*_vh_clean_2.ply`; where they are there, depth images in `depth/<id>.png`.

use super::depth::{Depth, DepthCamera, MILLIMETRES};
use super::upright::{Turn, size_by_center};
use super::{Format, RawDataset, RawView, list, matrix, pose};
use crate::lens::{Distortion, Lens};
use crate::{PointCloud, ply};
use glam::DMat4;
use gs_io::{Error, Result};
use std::path::{Path, PathBuf};

/// Whether a folder has the layout.
pub(super) fn is_scannet(root: &Path) -> bool {
    ["color", "pose", "intrinsic"].iter().all(|d| root.join(d).is_dir())
}

/// Loads the views in the order of their numbers; files whose names are no numbers are no frames.
pub(super) fn load(root: &Path) -> Result<RawDataset> {
    let intrinsic = root.join("intrinsic/intrinsic_color.txt");
    let k = matrix(&intrinsic)?;
    let mut frames: Vec<(u64, PathBuf)> = list(&root.join("color"))?
        .into_iter()
        .filter_map(|path| Some((path.file_stem()?.to_str()?.parse().ok()?, path)))
        .collect();
    frames.sort();
    let depths = Depths::find(root)?;
    let mut files = vec![intrinsic.clone()];
    files.extend(depths.intrinsic.clone());
    let (mut warnings, mut skipped) = (Vec::new(), Vec::new());
    let mut views = Vec::new();
    for (_, image_path) in frames {
        let pose_path = root.join("pose").join(image_path.with_extension("txt").file_name().unwrap_or_default());
        let Some((rotation, translation)) = pose(&pose_path, &mut warnings)? else {
            skipped.push(image_path);
            continue;
        };
        let size = size_by_center(&image_path, Some((k.z_axis.x, k.z_axis.y)))?;
        let lens = Lens {
            size,
            focal_center: [k.x_axis.x, k.y_axis.y, k.z_axis.x, k.z_axis.y],
            distortion: Distortion::default(),
        };
        check_intrinsics(&lens).map_err(|e| e.file(&intrinsic))?;
        let name = image_path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let depth = depths.of(&image_path);
        views.push(RawView {
            name,
            image_path,
            lens,
            rotation,
            translation,
            split: None,
            depth,
            mask: None,
            turn: Turn::NONE,
        });
        files.push(pose_path);
    }
    let scan = list(root)?.into_iter().find(|p| p.to_string_lossy().ends_with("_vh_clean_2.ply"));
    let points = scan.as_ref().map_or_else(|| Ok(PointCloud::default()), ply::read_points)?;
    files.extend(scan);
    Ok(RawDataset { format: Format::ScanNet, files, views, points, warnings, skipped })
}

/// The depth images, `depth/<id>.png` in millimetres, with a camera of their own.
struct Depths {
    folder: PathBuf,
    intrinsic: Option<PathBuf>,
    camera: DepthCamera,
}

impl Depths {
    fn find(root: &Path) -> Result<Self> {
        let folder = root.join("depth");
        let intrinsic = Some(root.join("intrinsic/intrinsic_depth.txt")).filter(|p| folder.is_dir() && p.is_file());
        let k = intrinsic.as_deref().map(matrix).transpose()?;
        let own = |k: DMat4| DepthCamera::Pixels([k.x_axis.x, k.y_axis.y, k.z_axis.x, k.z_axis.y]);
        Ok(Self { folder, intrinsic, camera: k.map_or(DepthCamera::Photograph, own) })
    }

    fn of(&self, image: &Path) -> Option<Depth> {
        let path = self.folder.join(image.with_extension("png").file_name()?);
        path.is_file().then_some(Depth { path, unit: MILLIMETRES, camera: self.camera })
    }
}

/// The file does not say for which image size it holds, and frames are often extracted smaller than they were taken:
/// the principal point, which lies near the middle, tells.
fn check_intrinsics(lens: &Lens) -> Result<()> {
    let [fx, fy, cx, cy] = lens.focal_center;
    let (w, h) = (f64::from(lens.size.0), f64::from(lens.size.1));
    let sane = |f: f64| f > 0.0 && f.is_finite();
    let central = |c: f64, size: f64| (0.25..0.75).contains(&(c / size));
    if sane(fx) && sane(fy) && central(cx, w) && central(cy, h) {
        return Ok(());
    }
    Err(Error::new("the intrinsics do not fit the frames")
        .field("fx fy cx cy")
        .found(format!("{fx} {fy} {cx} {cy}"))
        .expected(format!("a principal point near the middle of {w}x{h} pixels"))
        .hint("extract the frames at full size, or scale the intrinsics with them"))
}
