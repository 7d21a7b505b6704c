//! LERF-OVS labels: one ISAT JSON file per labelled frame, with polygons by category; or the pictures that the published
//! scorers made of them.

use super::polygon::fill_polygon;
use crate::Mask;
use crate::scene::full_path;
use artifacts::same_shape;
use gs_io::{Error, IoContext, Result};
use gs_scene::Camera;
use gs_scene::dataset::View;
use serde::Deserialize;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Largest accepted width or height of a labelled frame, in pixels.
const MAX_SIDE: u64 = 1 << 15;
/// Pixels that the masks of all categories of a frame may have at most: a small file of polygons can ask for any number.
const MAX_PIXELS: u64 = 1 << 28;

/// The labels of one frame.
#[derive(Debug, Clone, PartialEq)]
pub struct FrameLabels {
    /// The file, or the folder of pictures.
    pub file: PathBuf,
    /// Name of the frame: the file's stem, which is the view's stem.
    pub frame: String,
    /// Width in pixels of the labelled image.
    pub width: u32,
    /// Height in pixels of the labelled image.
    pub height: u32,
    /// Pixels of each category; several polygons of one category are joined.
    pub categories: BTreeMap<String, Mask>,
}

impl FrameLabels {
    /// The camera of a view in the size of its labelled image.
    pub fn camera(&self, view: &View) -> Result<Camera> {
        let (w, h) = (self.width, self.height);
        if !same_shape([w, h], [view.camera.width, view.camera.height]) {
            return Err(Error::new("the labelled image has another shape than the photograph")
                .file(&self.file)
                .field("info")
                .found(format!("{w}x{h}"))
                .expected(format!("{}x{} or a multiple", view.camera.width, view.camera.height))
                .hint("use the labels of this scene"));
        }
        Ok(view.camera.resized(w, h))
    }
}

#[derive(Deserialize)]
struct Isat {
    info: Info,
    objects: Vec<Object>,
}

impl Isat {
    fn names(&self) -> BTreeSet<&str> {
        self.objects.iter().map(|o| o.category.as_str()).collect()
    }

    /// Pixels of the masks of all categories.
    fn pixels(&self) -> u64 {
        self.info.width * self.info.height * self.names().len() as u64
    }
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

/// Brings labels, which are drawn on photographs as they lie on disk, to the cameras of their views: upright and undistorted.
pub fn straighten(frames: &mut [FrameLabels], views: &[View]) {
    for frame in frames {
        let Some(view) = views.iter().find(|v| v.stem() == frame.frame && !v.is_straight()) else { continue };
        let (width, height) = view.straighten::<bool>(&mut [], (frame.width as usize, frame.height as usize));
        (frame.width, frame.height) = (width as u32, height as u32);
        for mask in frame.categories.values_mut() {
            (mask.width, mask.height) = view.straighten(&mut mask.bits, (mask.width, mask.height));
        }
    }
}

/// Reads all `*.json` of a label folder, by name.
pub fn read_folder(folder: &Path) -> Result<Vec<FrameLabels>> {
    files(folder)?.iter().map(read).collect()
}

/// Where the labels of a scene lie: in the folder given, in the scene, or beside it, where beside a linked scene is beside the
/// link; none where there are none.
pub fn folder(given: Option<&Path>, scene: &Path) -> Result<Option<PathBuf>> {
    if let Some(given) = given {
        let e = || Error::new("no such folder").file(given).field("--labels").hint("check the path");
        return if given.is_dir() { Ok(Some(given.into())) } else { Err(e()) };
    }
    let full = full_path(scene);
    let beside = full.parent().zip(full.file_name()).map(|(data, name)| data.join("label").join(name));
    Ok([Some(scene.join("label")), beside].into_iter().flatten().find(|f| f.is_dir()))
}

/// What a folder holds, by name.
pub fn list(folder: &Path) -> Result<Vec<PathBuf>> {
    let entries = std::fs::read_dir(folder).at("list", folder)?;
    let mut paths = entries.map(|e| Ok(e.at("list", folder)?.path())).collect::<Result<Vec<_>>>()?;
    paths.sort();
    Ok(paths)
}

/// All `*.json` of a folder, by name.
fn files(folder: &Path) -> Result<Vec<PathBuf>> {
    Ok(list(folder)?.into_iter().filter(|p| p.extension().is_some_and(|e| e == "json")).collect())
}

/// Pixels of the masks of all categories of all frames of a label folder, a byte each in memory; files that cannot be read
/// count nothing, because [`read_folder`] says so.
pub fn pixels(folder: &Path) -> u64 {
    let of = |path: &PathBuf| parse(path).map_or(0, |isat| isat.pixels());
    files(folder).map_or(0, |paths| paths.iter().map(of).sum())
}

/// Reads one label file and fills its polygons: vertices are truncated toward zero, borders included (docs/protocols.md).
///
/// # Errors
/// When the file is no such label file, or its image size is absurd.
pub fn read(path: impl AsRef<Path>) -> Result<FrameLabels> {
    let path = path.as_ref();
    let isat = parse(path)?;
    let (width, height) = (isat.info.width as u32, isat.info.height as u32);
    let mut categories = BTreeMap::new();
    for object in &isat.objects {
        // JSON has no infinities or NaN; the cast truncates toward zero and saturates.
        let vertices: Vec<[i64; 2]> = object.segmentation.iter().map(|&[x, y]| [x as i64, y as i64]).collect();
        let mask =
            categories.entry(object.category.clone()).or_insert_with(|| Mask::new(width as usize, height as usize));
        fill_polygon(mask, &vertices);
    }
    let frame = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    Ok(FrameLabels { file: path.into(), frame, width, height, categories })
}

/// Reads one label file without filling its polygons.
fn parse(path: &Path) -> Result<Isat> {
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
    if isat.pixels() > MAX_PIXELS {
        return Err(Error::new("too many pixels in the masks of all categories")
            .file(path)
            .field("info.width, info.height")
            .found(format!("{}x{} for each of {}", isat.info.width, isat.info.height, isat.names().len()))
            .expected(format!("at most {MAX_PIXELS}"))
            .hint("check the size, or shrink photographs and labels"));
    }
    Ok(isat)
}

/// Grey level above which a pixel of a truth or prediction picture belongs to the object, strictly. Truth pictures are
/// JPEG, whose ringing lights up dark pixels beside the object: a scorer that tests "above 0" has larger objects.
pub const GREY: u8 = 10;

/// The pixels of a picture above grey level 10.
///
/// # Errors
/// When the file cannot be read as a picture.
pub fn read_mask(path: &Path) -> Result<Mask> {
    let bytes = std::fs::read(path).at("read", path)?;
    let grey = gs_scene::decode_image(&bytes, path)?.to_luma8();
    let (width, height) = (grey.width() as usize, grey.height() as usize);
    Ok(Mask { width, height, bits: grey.into_raw().into_iter().map(|v| v > GREY).collect() })
}

/// Reads the pictures that LangSplat's scorer made of the labels, `<folder>/<frame>/<category>.jpg` (or png), with pixels
/// above [`GREY`].
pub fn read_pictures(folder: &Path) -> Result<Vec<FrameLabels>> {
    let mut frames = Vec::new();
    for place in list(folder)?.into_iter().filter(|p| p.is_dir()) {
        let frame = place.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let paths = list(&place)?;
        let mut labels = FrameLabels { file: place, frame, width: 0, height: 0, categories: BTreeMap::new() };
        for path in paths {
            if !path.extension().is_some_and(|e| ["jpg", "jpeg", "png"].iter().any(|k| e.eq_ignore_ascii_case(k))) {
                continue;
            }
            let mask = read_mask(&path)?;
            if labels.categories.is_empty() {
                (labels.width, labels.height) = (mask.width as u32, mask.height as u32);
            } else if (mask.width, mask.height) != (labels.width as usize, labels.height as usize) {
                return Err(Error::new("pictures of one frame differ in size")
                    .file(&path)
                    .found(format!("{}x{}", mask.width, mask.height))
                    .expected(format!("{}x{}", labels.width, labels.height)));
            }
            let category = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
            labels.categories.insert(category, mask);
        }
        if !labels.categories.is_empty() {
            frames.push(labels);
        }
    }
    Ok(frames)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn write(json: &str) -> (tempfile::TempDir, PathBuf) {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("frame_00007.json");
        std::fs::write(&path, json).unwrap();
        (dir, path)
    }

    #[test]
    fn labels_of_a_distorted_photograph_are_undistorted() {
        let (dir, path) = write(
            r#"{"info":{"width":80,"height":60},
               "objects":[{"category":"wall","segmentation":[[20,0],[79,0],[79,59],[20,59]]}]}"#,
        );
        std::fs::create_dir_all(dir.path().join("sparse/0")).unwrap();
        let sparse = |name: &str, text: &str| std::fs::write(dir.path().join("sparse/0").join(name), text).unwrap();
        sparse("cameras.txt", "1 SIMPLE_RADIAL 80 60 50 40 30 -0.3\n");
        sparse("images.txt", "1 1 0 0 0 0 0 0 1 frame_00007.png\n\n");
        let grey = gs_scene::Image { width: 80, height: 60, rgb: vec![0.5; 3 * 80 * 60], alpha: None };
        grey.write_png(dir.path().join("images/frame_00007.png")).unwrap();
        let load = gs_scene::dataset::LoadOptions { resolution: "1".parse().unwrap(), holdout: 0 };
        let views = gs_scene::dataset::load(dir.path(), &load).unwrap().views;
        let mut frames = [read(path).unwrap()];
        let begins = |frames: &[FrameLabels], row: usize| {
            frames[0].categories["wall"].bits[80 * row..].iter().position(|inside| *inside).unwrap()
        };
        assert_eq!([begins(&frames, 0), begins(&frames, 30)], [20, 20]);
        straighten(&mut frames, &views);
        // As for id maps of such a photograph: a barrel pulls inwards, and more so the farther out.
        assert!(begins(&frames, 0) < 19 && begins(&frames, 30) == 19);
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
    fn pictures_are_read_above_their_ringing() {
        let dir = tempfile::tempdir().unwrap();
        let place = dir.path().join("frame_00007");
        std::fs::create_dir(&place).unwrap();
        let grey = |levels: Vec<u8>| image::GrayImage::from_raw(4, 2, levels).unwrap();
        grey(vec![0, 10, 11, 255, 0, 0, 12, 3]).save(place.join("red cup.png")).unwrap();
        std::fs::write(place.join("notes.txt"), "x").unwrap();
        let labels = read_pictures(dir.path()).unwrap();
        assert_eq!((labels.len(), labels[0].frame.as_str(), labels[0].width), (1, "frame_00007", 4));
        let cup = &labels[0].categories["red cup"];
        assert_eq!(cup.bits, [false, false, true, true, false, false, true, false], "10 is still ringing");
        grey(vec![255; 8]).save(place.join("plate.png")).unwrap();
        std::fs::rename(place.join("plate.png"), place.join("plate.JPG")).unwrap();
        assert_eq!(read_pictures(dir.path()).unwrap()[0].categories["plate"].count(), 8);
        image::GrayImage::new(3, 2).save(place.join("spoon.png")).unwrap();
        assert!(read_pictures(dir.path()).unwrap_err().to_string().contains("differ in size; found 3x2, expected 4x2"));
        std::fs::write(place.join("spoon.png"), "no").unwrap();
        assert!(read_pictures(dir.path()).unwrap_err().to_string().contains("spoon.png: not a readable picture"));
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
