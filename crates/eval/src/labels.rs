//! LERF-OVS labels: one ISAT JSON file per labelled frame, with polygons by category.

use crate::{Mask, polygon};
use gs_io::{Error, IoContext, Result};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::Path;

/// Largest width or height of a labelled frame that is believed, in pixels.
const MAX_SIDE: u64 = 1 << 15;

/// The labels of one frame.
#[derive(Debug, Clone, PartialEq)]
pub struct FrameLabels {
    /// Name of the frame: the file's stem, which is the view's stem.
    pub frame: String,
    /// Width in pixels of the labelled image.
    pub width: u32,
    /// Height in pixels of the labelled image.
    pub height: u32,
    /// Pixels of each category; several polygons of one category are joined.
    pub categories: BTreeMap<String, Mask>,
}

#[derive(Deserialize)]
struct Isat {
    info: Info,
    objects: Vec<Object>,
}

#[derive(Deserialize)]
struct Info {
    width: u64,
    height: u64,
}

#[derive(Deserialize)]
struct Object {
    category: String,
    segmentation: Vec<[f64; 2]>,
}

/// Reads all `*.json` of a label folder, by name.
///
/// # Errors
/// When the folder cannot be read, a file is not such a label file, or its image size is absurd.
pub fn read_folder(folder: impl AsRef<Path>) -> Result<Vec<FrameLabels>> {
    let folder = folder.as_ref();
    let mut paths = Vec::new();
    for entry in std::fs::read_dir(folder).at("list", folder)? {
        let path = entry.at("list", folder)?.path();
        if path.extension().is_some_and(|e| e == "json") {
            paths.push(path);
        }
    }
    paths.sort();
    paths.iter().map(read).collect()
}

/// Reads one label file and fills its polygons: vertices are truncated toward zero, borders included (methods.md 4.1).
///
/// # Errors
/// As [`read_folder`].
pub fn read(path: impl AsRef<Path>) -> Result<FrameLabels> {
    let path = path.as_ref();
    let bytes = std::fs::read(path).at("read", path)?;
    let hint = "label files are ISAT JSON: info {width, height}, objects [{category, segmentation}]";
    let isat: Isat = serde_json::from_slice(&bytes)
        .map_err(|e| Error::new(format!("not a label file: {e}")).file(path).hint(hint))?;
    for (field, side) in [("info.width", isat.info.width), ("info.height", isat.info.height)] {
        if !(1..=MAX_SIDE).contains(&side) {
            return Err(Error::new("not an image size")
                .file(path)
                .field(field)
                .found(side)
                .expected(format!("1 to {MAX_SIDE}")));
        }
    }
    let (width, height) = (isat.info.width as u32, isat.info.height as u32);
    let mut categories = BTreeMap::new();
    for object in &isat.objects {
        // JSON has no infinities or NaN; the cast truncates toward zero and saturates.
        let vertices: Vec<[i64; 2]> = object.segmentation.iter().map(|&[x, y]| [x as i64, y as i64]).collect();
        let mask =
            categories.entry(object.category.clone()).or_insert_with(|| Mask::new(width as usize, height as usize));
        polygon::fill_polygon(mask, &vertices);
    }
    let frame = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    Ok(FrameLabels { frame, width, height, categories })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn write(json: &str) -> (tempfile::TempDir, std::path::PathBuf) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("frame_00007.json");
        std::fs::write(&path, json).unwrap();
        (dir, path)
    }

    #[test]
    fn polygons_of_one_category_are_joined() {
        let (dir, path) = write(
            r#"{"info":{"description":"ISAT","name":"frame_00007.jpg","width":20,"height":10,"depth":3,"note":""},
               "objects":[{"category":"cup","group":1,"segmentation":[[1.9,1.2],[4.7,1.9],[4.2,3.3],[1.1,3.9]],"bbox":[1,1,4,3]},
                          {"category":"cup","segmentation":[[10,1],[11,1],[11,2],[10,2]]},
                          {"category":"lid","segmentation":[]}]}"#,
        );
        let labels = read(&path).unwrap();
        assert_eq!((labels.frame.as_str(), labels.width, labels.height), ("frame_00007", 20, 10));
        assert_eq!(labels.categories["cup"].count(), 4 * 3 + 4, "truncated corners, borders included");
        assert_eq!(labels.categories["lid"].count(), 0);
        assert_eq!(read_folder(dir.path()).unwrap(), [labels]);
    }

    #[test]
    fn bad_label_files_are_errors_that_name_the_field() {
        for (json, part) in [
            ("{", "not a label file"),
            (r#"{"info":{"width":0,"height":5},"objects":[]}"#, "info.width: not an image size; found 0"),
            (r#"{"info":{"width":5,"height":99999999},"objects":[]}"#, "info.height"),
            (
                r#"{"info":{"width":5,"height":5},"objects":[{"category":"a","segmentation":[[1]]}]}"#,
                "not a label file",
            ),
            (
                r#"{"info":{"width":5,"height":5},"objects":[{"category":"a","segmentation":[[1,1e999]]}]}"#,
                "number out of range",
            ),
        ] {
            let (_dir, path) = write(json);
            let e = read(&path).unwrap_err().to_string();
            assert!(e.contains(part) && e.contains("frame_00007.json"), "{e}");
        }
    }
}
