//! Posed photographs: [`load`] recognises the layout of a folder and gives its views.

pub mod colmap;
mod depth;
mod mask;
mod names;
pub mod refined;
mod scannet;
mod seven_scenes;
mod shift;
mod transforms;
mod upright;
mod view;

use crate::PointCloud;
use crate::lens::Lens;
use depth::Depth;
pub use depth::DepthMap;
use glam::{DMat3, DMat4, DQuat, DVec3};
use gs_io::{Error, IoContext, Result, hash_bytes, hash_file};
pub use mask::Odd;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
pub use transforms::write as write_transforms;
use upright::Turn;
pub use view::View;
use view::stems;

/// Which layout a folder has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// A COLMAP sparse model beside an `images` folder.
    Colmap,
    /// `transforms.json` of nerfstudio, instant-ngp or Blender.
    Transforms,
    /// ScanNet: `color/`, `pose/`, `intrinsic/`.
    ScanNet,
    /// 7-Scenes: `seq-01/frame-000000.color.png` and `.pose.txt`.
    SevenScenes,
}

/// What a view is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Split {
    /// To learn from.
    Train,
    /// Held out, to measure with.
    Test,
}

/// How much photographs are shrunk.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Resolution {
    /// To 1600 pixels wide where they are wider.
    Auto,
    /// To this many pixels wide where they are wider; written `640px`.
    Width(u32),
    /// By this factor, at least 1.
    Divisor(f64),
}

impl std::str::FromStr for Resolution {
    type Err = Error;

    fn from_str(s: &str) -> Result<Self> {
        let width = |w: &str| w.parse().ok().filter(|w| *w >= 1).map(Self::Width);
        let divisor = || s.parse().ok().filter(|d| (1.0..=1024.0).contains(d)).map(Self::Divisor);
        let resolution = match (s, s.strip_suffix("px")) {
            ("auto" | "-1", _) => Some(Self::Auto),
            (_, Some(pixels)) => width(pixels),
            _ => divisor(),
        };
        resolution.ok_or_else(|| {
            Error::new("not a resolution")
                .found(s)
                .expected("auto, a width such as 640px, or a factor from 1 (full size) such as 2, 4, 8")
        })
    }
}

impl std::fmt::Display for Resolution {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Auto => f.write_str("auto"),
            Self::Width(w) => write!(f, "{w}px"),
            Self::Divisor(d) => write!(f, "{d}"),
        }
    }
}

/// As it is written.
impl serde::Serialize for Resolution {
    fn serialize<S: serde::Serializer>(&self, to: S) -> std::result::Result<S::Ok, S::Error> {
        to.collect_str(self)
    }
}

/// A side of a photograph in pixels below which its resolution was hardly meant.
const SMALL: u32 = 24;

impl Resolution {
    fn apply(self, width: u32, height: u32) -> (u32, u32) {
        let divisor = match self {
            Self::Auto => return Self::Width(1600).apply(width, height),
            Self::Width(w) => (f64::from(width) / f64::from(w)).max(1.0),
            Self::Divisor(d) => d,
        };
        let shrink = |v: u32| ((f64::from(v) / divisor).round() as u32).max(1);
        (shrink(width), shrink(height))
    }
}

/// Every n-th view is held out where nothing says otherwise.
pub const HOLDOUT: usize = 8;

/// How to load a dataset.
#[derive(Debug, Clone, PartialEq)]
pub struct LoadOptions {
    /// How much photographs are shrunk.
    pub resolution: Resolution,
    /// Every n-th view by sorted name is held out, from the first; 0 holds none out. A dataset that names its own
    /// held-out views (in `transforms_test.json`, nerfstudio's `test_filenames` or 7-Scenes' `TestSplit.txt`) keeps to them.
    pub holdout: usize,
}

impl Default for LoadOptions {
    fn default() -> Self {
        Self { resolution: Resolution::Auto, holdout: HOLDOUT }
    }
}

/// Posed photographs and sparse points.
#[derive(Debug, Clone, PartialEq)]
pub struct Dataset {
    /// The folder.
    pub root: PathBuf,
    /// Its layout.
    pub format: Format,
    /// All views, sorted by name (ScanNet's by number).
    pub views: Vec<View>,
    /// Sparse points; may be empty.
    pub points: PointCloud,
    /// All files that it consists of: cameras, poses, points, photographs.
    pub files: Vec<PathBuf>,
    /// What was odd: views without a file, poses without numbers.
    pub warnings: Vec<String>,
    /// Whether it names its own held-out views.
    pub(crate) names_its_own: bool,
    /// What was subtracted from the world's coordinates, cameras' included, so that single precision holds them
    /// ([`Gaussians::shift`](crate::Gaussians::shift)).
    pub shift: [f64; 3],
}

/// A view before resolution and split are applied.
pub(crate) struct RawView {
    pub name: String,
    pub image_path: PathBuf,
    pub lens: Lens,
    pub rotation: DMat3,
    pub translation: DVec3,
    pub split: Option<Split>,
    pub depth: Option<Depth>,
    /// Black where the photograph is not to be learnt from.
    pub mask: Option<PathBuf>,
    pub turn: Turn,
}

pub(crate) struct RawDataset {
    pub format: Format,
    /// All but the photographs.
    pub files: Vec<PathBuf>,
    pub views: Vec<RawView>,
    pub points: PointCloud,
    pub warnings: Vec<String>,
    /// Photographs that a warning names.
    pub skipped: Vec<PathBuf>,
}

impl RawDataset {
    /// Whether both have the same photographs, seen from the same poses by the same lenses, to the digits that files keep.
    fn same_cameras(&self, other: &Self) -> bool {
        let numbers =
            |v: &RawView| [&v.lens.focal_center[..], &v.rotation.to_cols_array(), &v.translation.to_array()].concat();
        let by_photograph = |d: &Self| -> BTreeMap<PathBuf, Vec<f64>> {
            d.views.iter().map(|v| (v.image_path.clone(), numbers(v))).collect()
        };
        let near = |a: &[f64], b: &[f64]| a.iter().zip(b).all(|(a, b)| (a - b).abs() <= 1e-6 * a.abs().max(1.0));
        let (ours, theirs) = (by_photograph(self), by_photograph(other));
        self.views.len() == other.views.len() && ours.iter().zip(&theirs).all(|(a, b)| a.0 == b.0 && near(a.1, b.1))
    }
}

/// Focal lengths in longer sides of the photograph. A pinhole camera of the least sees 179.9 degrees; lenses stay below 150.
/// The most is a view of 2 arcseconds; telescopes and satellites' cameras stay below 10,000.
const FOCAL: std::ops::Range<f64> = 1e-3..1e5;
/// The principal point's distance from the middle of the photograph, in focal lengths, where it lies outside: 63 degrees. A
/// part cut out of a larger photograph has it outside, but no part of it is farther from the lens's axis than that.
const OFF_AXIS: f64 = 2.0;
/// Distance of a camera from the origin. The Earth is 1e10 mm wide; single precision holds squares up to 1e19.
const FARTHEST: f64 = 1e12;

impl RawView {
    /// Refuses numbers that no camera has, whatever the dataset's layout: nothing can be learnt with them.
    fn check(&self, format: Format) -> Result<()> {
        let wrong = |field: &str, found: String, expected: String| {
            let from = match format {
                Format::Colmap => "COLMAP's model",
                Format::Transforms => "transforms.json",
                Format::ScanNet => "intrinsic/ and pose/",
                Format::SevenScenes => "its .pose.txt",
            };
            let hint = format!("correct the camera in {from}, or export it again");
            Err(Error::new("no camera has this")
                .file(&self.image_path)
                .field(field)
                .found(found)
                .expected(expected)
                .hint(hint))
        };
        let [fx, fy, cx, cy] = self.lens.focal_center;
        let (w, h) = (f64::from(self.lens.size.0), f64::from(self.lens.size.1));
        let side = w.max(h);
        if ![fx, fy].iter().all(|f| FOCAL.contains(&(f / side))) {
            let expected = format!("{} to {} pixels for {w}x{h} pixels", FOCAL.start * side, FOCAL.end * side);
            return wrong("focal lengths", format!("{fx:?} {fy:?}"), expected);
        }
        let off = |c: f64, size: f64, f: f64| (c - 0.5 * size).abs() <= side.max(OFF_AXIS * f);
        if !(off(cx, w, fx) && off(cy, h, fy)) {
            let expected = format!("a point in the photograph of {w}x{h} pixels, or not far from it");
            return wrong("principal point", format!("{cx:?} {cy:?}"), expected);
        }
        if !self.translation.to_array().iter().all(|t| t.abs() <= FARTHEST) {
            let expected = format!("numbers from -{FARTHEST:e} to {FARTHEST:e}");
            return wrong("translation", format!("{:?}", self.translation.to_array()), expected);
        }
        Ok(())
    }
}

/// Loads the dataset in a folder (or the `transforms.json` or the file of [`refined`] cameras given), whatever its layout.
///
/// # Errors
/// When the layout is not recognised, a file is damaged, or no view is left.
pub fn load(path: &Path, options: &LoadOptions) -> Result<Dataset> {
    if path.extension().is_some_and(|e| e == "json") && path.is_file() {
        let json = transforms::read_json(path)?;
        if let Some((root, refined)) = refined::read(path, &json)? {
            let mut raw = read(&root)?;
            refined.apply(&mut raw)?;
            return finish(&root, raw, options);
        }
    }
    finish(path, read(path)?, options)
}

fn read(path: &Path) -> Result<RawDataset> {
    let mut raw = if path.extension().is_some_and(|e| e == "json") {
        transforms::load(path.parent().unwrap_or(Path::new(".")), &[path.to_path_buf()])?
    } else if let Some(model) = colmap::model_of_file(path) {
        colmap::load(path, model)?
    } else if !path.is_dir() {
        return Err(Error::new("no such folder").file(path).hint(
            "give the folder of a COLMAP, transforms.json, ScanNet or 7-Scenes scene, a transforms.json, or a COLMAP model's cameras.bin",
        ));
    } else {
        let mut layouts = layouts(path).into_iter();
        let Some(layout) = layouts.next() else {
            if is_bare(path) {
                return Err(Error::new("photographs without poses")
                    .file(path)
                    .expected("cameras of COLMAP, a transforms.json, ScanNet or 7-Scenes beside them")
                    .hint("make scene PHOTOGRAPHS=folder, or cags run, finds the poses first (scripts/poses.py)"));
            }
            return Err(Error::new("no dataset recognised in this folder")
                .file(path)
                .expected("sparse/0/cameras.bin|txt (COLMAP), transforms.json or transforms_train.json, color/ pose/ intrinsic/ (ScanNet), or seq-01/frame-000000.color.png (7-Scenes)")
                .hint("run COLMAP on the photographs first"));
        };
        let name = layout.name();
        let mut raw = layout.load(path)?;
        // Which of two is read matters where they differ.
        let differs = |other: Layout| {
            let name = other.name();
            other.load(path).map_or(true, |other| !raw.same_cameras(&other)).then_some(name)
        };
        let others: Vec<String> = layouts.filter_map(differs).collect();
        if !others.is_empty() {
            raw.warnings.push(format!(
                "the folder has several sets of cameras: {name} is read, not {}; --scene takes the file of another",
                others.join(" or ")
            ));
        }
        raw
    };
    upright::turn(&mut raw)?;
    Ok(raw)
}

/// Whether a folder has photographs and no cameras.
pub fn is_bare(folder: &Path) -> bool {
    layouts(folder).is_empty() && list(folder).is_ok_and(|files| files.iter().any(|file| names::is_picture(file)))
}

/// The cameras that a folder has.
enum Layout {
    Colmap(colmap::Model),
    Transforms(Vec<PathBuf>),
    ScanNet,
    SevenScenes,
}

/// All of a folder, the one to be read first: COLMAP's, as trainers of Gaussians do, then a transforms.json.
fn layouts(path: &Path) -> Vec<Layout> {
    let mut all: Vec<Layout> = colmap::find_model(path).map(Layout::Colmap).into_iter().collect();
    all.extend(transforms::find(path).into_iter().map(Layout::Transforms));
    all.extend(scannet::is_scannet(path).then_some(Layout::ScanNet));
    all.extend(seven_scenes::is_seven_scenes(path).then_some(Layout::SevenScenes));
    all
}

impl Layout {
    fn name(&self) -> String {
        match self {
            Self::Colmap(model) => format!("COLMAP's {}", model.folder().display()),
            Self::Transforms(files) => files.iter().map(|f| f.display().to_string()).collect::<Vec<_>>().join(" and "),
            Self::ScanNet => "ScanNet's color, pose and intrinsic".into(),
            Self::SevenScenes => "the frames of 7-Scenes".into(),
        }
    }

    fn load(self, path: &Path) -> Result<RawDataset> {
        match self {
            Self::Colmap(model) => colmap::load(path, model),
            Self::Transforms(files) => transforms::load(path, &files),
            Self::ScanNet => scannet::load(path),
            Self::SevenScenes => seven_scenes::load(path),
        }
    }
}

fn finish(root: &Path, mut raw: RawDataset, options: &LoadOptions) -> Result<Dataset> {
    if raw.format != Format::ScanNet {
        raw.views.sort_by(|a, b| a.name.cmp(&b.name));
    }
    if raw.views.is_empty() {
        return Err(Error::new("no view is left")
            .file(root)
            .found(raw.warnings.first().map_or("no image", String::as_str))
            .expected("at least one posed photograph")
            .hint("check that the photographs lie where the dataset says"));
    }
    let names: Vec<&str> = raw.views.iter().map(|v| v.name.as_str()).collect();
    let stems = stems(&names).map_err(|e| e.file(root))?;
    raw.views.iter().try_for_each(|v| v.check(raw.format))?;
    let names_its_own = raw.views.iter().any(|v| v.split == Some(Split::Test));
    let views = raw.views.into_iter().zip(stems).enumerate().map(|(i, (v, stem))| {
        let split = match v.split.filter(|_| names_its_own) {
            Some(split) => split,
            None if is_held_out(i, options.holdout) => Split::Test,
            None => Split::Train,
        };
        View::new(v, stem, split, options.resolution)
    });
    let views = views.collect::<Result<Vec<_>>>()?;
    let smallest =
        views.iter().map(|v| (v.camera.width, v.camera.height)).min_by_key(|(w, h)| *w.min(h)).unwrap_or_default();
    if let Resolution::Divisor(d) = options.resolution
        && d > 1.0
        && smallest.0.min(smallest.1) < SMALL
    {
        let (w, h) = smallest;
        raw.warnings.push(format!("photographs of {w}x{h} pixels after division by {d}: for a width, write {d}px"));
    }
    let RawDataset { format, mut files, points, mut warnings, skipped, .. } = raw;
    warnings.extend(names::unused(root, format, &views, &skipped));
    files.extend(views.iter().map(|v| v.image_path.clone()));
    let beside =
        |v: &View| [v.depth_path(), v.mask_path()].into_iter().flatten().map(Path::to_path_buf).collect::<Vec<_>>();
    files.extend(views.iter().flat_map(beside));
    let root = root.to_path_buf();
    let mut dataset = Dataset { root, format, views, points, files, warnings, names_its_own, shift: [0.0; 3] };
    dataset.settle();
    Ok(dataset)
}

/// Whether view `i` is held out where every n-th one is.
fn is_held_out(i: usize, every: usize) -> bool {
    every > 0 && i.is_multiple_of(every)
}

impl Dataset {
    /// Whether each view is held out where every n-th one is; views that the dataset itself holds out stay so.
    pub fn held_out(&self, every: usize) -> impl Iterator<Item = bool> {
        self.views
            .iter()
            .enumerate()
            .map(move |(i, v)| if self.names_its_own { v.split == Split::Test } else { is_held_out(i, every) })
    }

    /// Views of one split.
    pub fn views_of(&self, split: Split) -> impl Iterator<Item = &View> {
        self.views.iter().filter(move |v| v.split == split)
    }

    /// Content hash: names, lenses, poses, sparse points and photographs. It depends neither on where the folder lies nor
    /// on how the dataset was loaded: all stages know a scene by the same hash.
    pub fn hash(&self) -> Result<String> {
        let mut text = String::new();
        let files: Result<Vec<String>> = self.views.par_iter().map(|v| hash_file(&v.image_path)).collect();
        for (v, file) in self.views.iter().zip(files?) {
            // Without any shift: which one that is depends on the Gaussians that the dataset goes with.
            let (rotation, translation) = (v.camera.rotation, v.translation());
            text += &format!("{}\n{rotation:?}\n{translation:?}\n{:?}\n{file}\n", v.name, v.lens());
        }
        let mut bytes = text.into_bytes();
        bytes.extend(self.points.positions.iter().flatten().flat_map(|v| v.to_le_bytes()));
        bytes.extend(self.points.colors.iter().flatten());
        bytes.extend(self.points.shift.iter().filter(|s| **s != 0.0).flat_map(|v| v.to_le_bytes()));
        Ok(hash_bytes(&bytes))
    }
}

/// Camera-from-world rotation and translation of a world-from-camera matrix (OpenCV axes); none where a number is not
/// finite, by which datasets mark lost poses.
///
/// A uniform scale, which Blender's objects may carry, is taken out.
fn invert_pose(world_from_camera: DMat4, field: &str) -> Result<Option<(DMat3, DVec3)>> {
    if !world_from_camera.is_finite() {
        return Ok(None);
    }
    let m = DMat3::from_mat4(world_from_camera);
    let scale = m.determinant().cbrt();
    let rotation = m * scale.recip();
    let off = rotation.transpose() * rotation - DMat3::IDENTITY;
    // A scale of zero or less leads to NaN or to a reflection.
    if !(scale > 0.0 && off.to_cols_array().iter().all(|v| v.abs() < 1e-2)) {
        return Err(Error::new("the pose is not a rotation and a translation")
            .field(field)
            .found(m.transpose())
            .expected("three orthogonal axes of equal length, right-handed")
            .hint("export the poses again"));
    }
    let inverse = DMat3::from_quat(DQuat::from_mat3(&rotation).normalize()).transpose();
    Ok(Some((inverse, -(inverse * world_from_camera.w_axis.truncate()))))
}

fn read_text(path: &Path) -> Result<String> {
    let bytes = std::fs::read(path).at("read", path)?;
    let text = String::from_utf8(bytes);
    let text = text.map_err(|_| Error::new("not a text file").file(path).hint("copy or export it again"))?;
    Ok(if text.starts_with(MARK) { text[MARK.len_utf8()..].into() } else { text })
}

/// The byte order mark that Windows' editors put before a text.
const MARK: char = '\u{feff}';

/// Paths in a folder, sorted.
fn list(folder: &Path) -> Result<Vec<PathBuf>> {
    let entries = std::fs::read_dir(folder).at("list", folder)?;
    let mut paths = entries.map(|e| Ok(e.at("list", folder)?.path())).collect::<Result<Vec<_>>>()?;
    paths.sort();
    Ok(paths)
}

/// Camera-from-world rotation and translation of the 4x4 matrix in a file; none, with a warning, where there is none or it is not finite.
fn pose(path: &Path, warnings: &mut Vec<String>) -> Result<Option<(DMat3, DVec3)>> {
    let why = if path.is_file() {
        match invert_pose(matrix(path)?, "pose").map_err(|e| e.file(path))? {
            Some(pose) => return Ok(Some(pose)),
            None => "the pose is not finite",
        }
    } else {
        "no such pose"
    };
    warnings.push(format!("{}: {why}, view skipped", path.display()));
    Ok(None)
}

/// A 4x4 matrix of numbers in rows; `-inf` marks a lost pose.
fn matrix(path: &Path) -> Result<DMat4> {
    let text = read_text(path)?;
    let number = |w: &str| {
        let wrong = |_| Error::new("not a number").file(path).found(w).hint("extract the scene again");
        w.parse::<f64>().map_err(wrong)
    };
    let numbers = text.split_ascii_whitespace().map(number).collect::<Result<Vec<_>>>()?;
    let m: &[f64; 16] = numbers.as_slice().try_into().map_err(|_| {
        Error::new("not a 4x4 matrix")
            .file(path)
            .found(format!("{} numbers", numbers.len()))
            .expected("16 numbers")
            .hint("extract the scene again")
    })?;
    Ok(DMat4::from_cols_array(m).transpose())
}
