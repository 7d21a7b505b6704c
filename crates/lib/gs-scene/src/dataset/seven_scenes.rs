//! 7-Scenes: `seq-01/frame-000000.color.png`, `.pose.txt` and, where they are there, `.depth.png`, of a Kinect. The folder of a scene, with the
//! sequences to hold out in `TestSplit.txt`, or that of one sequence.
//!
//! The dataset comes without calibration. Its page names the depth camera's default, 585 pixels; 525 is the usual value for the
//! photographs of this sensor. Poses are the depth camera's, a few centimetres beside: `--refine-poses` finds both.

use super::depth::{Depth, MILLIMETRES};
use super::{Format, RawDataset, RawView, Split, invert_pose, list, matrix, read_text};
use crate::lens::{Distortion, Lens};
use crate::{PointCloud, image};
use gs_io::{Error, Result};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

const COLOR: &str = ".color.png";
/// Focal lengths in pixels of 640 a line.
const FOCAL: f64 = 525.0;
const FOCAL_OF_DEPTH: f64 = 585.0;
const WIDTH: f64 = 640.0;

/// Whether a folder has the layout.
pub(super) fn is_seven_scenes(root: &Path) -> bool {
    sequences(root).is_ok_and(|folders| folders.iter().any(|f| frames(f).is_ok_and(|frames| !frames.is_empty())))
}

/// Loads the views of all sequences.
pub(super) fn load(root: &Path) -> Result<RawDataset> {
    let split = root.join("TestSplit.txt");
    let (mut files, mut warnings, mut views) = (Vec::new(), Vec::new(), Vec::new());
    let mut test = BTreeSet::new();
    if split.is_file() {
        // A line is "sequence3".
        for line in read_text(&split)?.lines().map(str::trim).filter(|l| !l.is_empty()) {
            let number = line.trim_start_matches(|c: char| !c.is_ascii_digit()).parse::<u32>().map_err(|_| {
                Error::new("not a sequence").file(&split).found(line).expected("a line such as sequence3")
            })?;
            test.insert(format!("seq-{number:02}"));
        }
        files.push(split);
    }
    for folder in sequences(root)? {
        let sequence = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let is_test = folder != root && test.contains(&sequence);
        for (name, image_path) in frames(&folder)? {
            let pose_path = folder.join(format!("{name}.pose.txt"));
            if !pose_path.is_file() {
                warnings.push(format!("{}: no such pose, view skipped", pose_path.display()));
                continue;
            }
            let pose = invert_pose(matrix(&pose_path)?, "pose").map_err(|e| e.file(&pose_path))?;
            let Some((rotation, translation)) = pose else {
                warnings.push(format!("{}: the pose is not finite, view skipped", pose_path.display()));
                continue;
            };
            let size = image::size_of(&image_path)?;
            let lens = Lens { size, focal_center: camera(size, FOCAL), distortion: Distortion::default() };
            let path = folder.join(format!("{name}.depth.png"));
            let depth = path.is_file().then(|| -> Result<Depth> {
                let focal_center = Some(camera(image::size_of(&path)?, FOCAL_OF_DEPTH));
                Ok(Depth { path, unit: MILLIMETRES, focal_center })
            });
            let name = image_path.strip_prefix(root).unwrap_or(&image_path).to_string_lossy().replace('\\', "/");
            let split = Some(if is_test { Split::Test } else { Split::Train });
            views.push(RawView { name, image_path, lens, rotation, translation, split, depth: depth.transpose()? });
            files.push(pose_path);
        }
    }
    Ok(RawDataset { format: Format::SevenScenes, files, views, points: PointCloud::default(), warnings })
}

/// fx, fy, cx, cy in pixels of a picture whose middle the camera looks at.
fn camera((width, height): (u32, u32), focal: f64) -> [f64; 4] {
    let (w, h) = (f64::from(width), f64::from(height));
    let focal = focal * w / WIDTH;
    [focal, focal, 0.5 * w, 0.5 * h]
}

/// The folders of the sequences; the folder itself where it has none.
fn sequences(root: &Path) -> Result<Vec<PathBuf>> {
    let is_one = |p: &PathBuf| p.is_dir() && p.file_name().is_some_and(|n| n.to_string_lossy().starts_with("seq-"));
    let folders: Vec<PathBuf> = list(root)?.into_iter().filter(is_one).collect();
    Ok(if folders.is_empty() { vec![root.to_path_buf()] } else { folders })
}

/// The frames of a sequence: their names without what follows the first dot, and their photographs.
fn frames(folder: &Path) -> Result<Vec<(String, PathBuf)>> {
    let frame = |path: PathBuf| {
        let name = path.file_name()?.to_str()?.strip_suffix(COLOR)?.to_string();
        Some((name, path))
    };
    Ok(list(folder)?.into_iter().filter_map(frame).collect())
}
