//! 7-Scenes: `seq-01/frame-000000.color.png`, `.pose.txt` and, where they are there, `.depth.png`, of a Kinect. The folder of a scene, with the
//! sequences to hold out in `TestSplit.txt`, or that of one sequence.
//!
//! The dataset comes without calibration. Its page names the depth camera's default, 585 pixels; 525 is the usual value for the
//! photographs of this sensor. Poses are the depth camera's; the photographs were taken a few centimetres beside.

use super::depth::{Depth, DepthCamera, MILLIMETRES};
use super::upright::Turn;
use super::{Format, RawDataset, RawView, Split, list, pose, read_text};
use crate::lens::{Distortion, Lens};
use crate::{PointCloud, image};
use gs_io::{Error, Result};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

const COLOR: &str = ".color.png";
/// Focal lengths of photographs and depth images, in widths.
const FOCAL: f64 = 525.0 / 640.0;
const FOCAL_OF_DEPTH: f64 = 585.0 / 640.0;

/// Whether a folder has the layout.
pub(super) fn is_seven_scenes(root: &Path) -> bool {
    sequences(root).is_ok_and(|folders| folders.iter().any(|f| frames(f).is_ok_and(|frames| !frames.is_empty())))
}

/// Loads the views of all sequences.
pub(super) fn load(root: &Path) -> Result<RawDataset> {
    let split = root.join("TestSplit.txt");
    let (mut files, mut warnings, mut views, mut skipped) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let mut test = BTreeSet::new();
    if split.is_file() {
        for line in read_text(&split)?.lines().map(str::trim).filter(|l| !l.is_empty()) {
            let number = number(line).ok_or_else(|| {
                Error::new("not a sequence").file(&split).found(line).expected("a line such as sequence3")
            })?;
            test.insert(number);
        }
        files.push(split);
    }
    for folder in sequences(root)? {
        let is_test = folder != root && number(&name_of(&folder)).is_some_and(|n| test.contains(&n));
        for (name, image_path) in frames(&folder)? {
            let pose_path = folder.join(format!("{name}.pose.txt"));
            let Some((rotation, translation)) = pose(&pose_path, &mut warnings)? else {
                skipped.push(image_path);
                continue;
            };
            let size = image::size_of(&image_path)?;
            let (w, h) = (f64::from(size.0), f64::from(size.1));
            let focal_center = [FOCAL * w, FOCAL * w, 0.5 * w, 0.5 * h];
            let lens = Lens { size, focal_center, distortion: Distortion::default() };
            let path = folder.join(format!("{name}.depth.png"));
            let depth = Depth { path, unit: MILLIMETRES, camera: DepthCamera::Focal(FOCAL_OF_DEPTH) };
            let depth = Some(depth).filter(|d| d.path.is_file());
            let name = image_path.strip_prefix(root).unwrap_or(&image_path).to_string_lossy().replace('\\', "/");
            let split = Some(if is_test { Split::Test } else { Split::Train });
            let turn = Turn::NONE;
            views.push(RawView { name, image_path, lens, rotation, translation, split, depth, mask: None, turn });
            files.push(pose_path);
        }
    }
    // A copy of the sequences to hold out alone is a scene of its own.
    if views.iter().all(|v: &RawView| v.split == Some(Split::Test)) {
        views.iter_mut().for_each(|v| v.split = None);
    }
    Ok(RawDataset { format: Format::SevenScenes, files, views, points: PointCloud::default(), warnings, skipped })
}

/// The number in the name of a sequence, which is `sequence3` in lists and `seq-03` on disk.
fn number(name: &str) -> Option<u32> {
    name.trim_start_matches(|c: char| !c.is_ascii_digit()).parse().ok()
}

fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// The folders of the sequences; the folder itself where it has none.
fn sequences(root: &Path) -> Result<Vec<PathBuf>> {
    let is_one = |p: &PathBuf| p.is_dir() && name_of(p).starts_with("seq-");
    let folders: Vec<PathBuf> = list(root)?.into_iter().filter(is_one).collect();
    Ok(if folders.is_empty() { vec![root.to_path_buf()] } else { folders })
}

/// The frames of a sequence, such as `frame-000000`, and their photographs.
fn frames(folder: &Path) -> Result<Vec<(String, PathBuf)>> {
    let frame = |path: PathBuf| {
        let name = path.file_name()?.to_str()?.strip_suffix(COLOR)?.to_string();
        Some((name, path))
    };
    Ok(list(folder)?.into_iter().filter_map(frame).collect())
}
