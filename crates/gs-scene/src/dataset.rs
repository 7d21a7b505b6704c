//! Posed photographs: [`load`] recognises the layout of a folder and gives its views.

mod scannet;
mod transforms;

use crate::distortion::Distortion;
use crate::{Camera, Image, PointCloud, colmap, image};
use glam::{DMat3, DVec3};
use gs_io::{Error, IoContext, Result, hash_bytes, hash_file};
use rayon::prelude::*;
use std::path::{Path, PathBuf};

/// Which layout a folder has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// A COLMAP sparse model beside an `images` folder.
    Colmap,
    /// `transforms.json` of nerfstudio, instant-ngp or Blender.
    Transforms,
    /// ScanNet: `color/`, `pose/`, `intrinsic/`.
    ScanNet,
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
    /// By this factor, at least 1.
    Divisor(f64),
}

impl std::str::FromStr for Resolution {
    type Err = Error;

    fn from_str(s: &str) -> Result<Self> {
        match s {
            "auto" | "-1" => Ok(Self::Auto),
            _ => s.parse().ok().filter(|d: &f64| (1.0..=1024.0).contains(d)).map(Self::Divisor).ok_or_else(|| {
                Error::new("not a resolution").found(s).expected("auto, or a factor from 1 (full size) such as 2, 4, 8")
            }),
        }
    }
}

impl std::fmt::Display for Resolution {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Auto => f.write_str("auto"),
            Self::Divisor(d) => write!(f, "{d}"),
        }
    }
}

impl Resolution {
    fn apply(self, width: u32, height: u32) -> (u32, u32) {
        let divisor = match self {
            Self::Auto => (f64::from(width) / 1600.0).max(1.0),
            Self::Divisor(d) => d,
        };
        let shrink = |v: u32| ((f64::from(v) / divisor).round() as u32).max(1);
        (shrink(width), shrink(height))
    }
}

/// How to load a dataset.
#[derive(Debug, Clone, PartialEq)]
pub struct LoadOptions {
    /// How much photographs are shrunk.
    pub resolution: Resolution,
    /// Every n-th view by sorted name is held out, from the first; 0 holds none out. A dataset that names its own
    /// held-out views (`transforms_test.json`) keeps to them.
    pub holdout: usize,
}

impl Default for LoadOptions {
    fn default() -> Self {
        Self { resolution: Resolution::Auto, holdout: 8 }
    }
}

/// A posed photograph.
#[derive(Debug, Clone, PartialEq)]
pub struct View {
    /// File name relative to the images folder, or as the dataset gives it.
    pub name: String,
    /// Where the photograph lies.
    pub image_path: PathBuf,
    /// The undistorted camera at the requested resolution.
    pub camera: Camera,
    /// What the view is for.
    pub split: Split,
    /// The camera as it took the photograph: width, height, fx, fy, cx, cy, and its lens.
    source: Source,
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Source {
    size: (u32, u32),
    focal_center: [f64; 4],
    distortion: Distortion,
}

/// Posed photographs and sparse points.
#[derive(Debug, Clone, PartialEq)]
pub struct Dataset {
    /// The folder.
    pub root: PathBuf,
    /// Its layout.
    pub format: Format,
    /// All views, sorted by name.
    pub views: Vec<View>,
    /// Sparse points; may be empty.
    pub points: PointCloud,
    /// What was odd: views without a file, poses without numbers.
    pub warnings: Vec<String>,
}

/// A view before resolution and split are applied.
struct RawView {
    name: String,
    image_path: PathBuf,
    source: Source,
    rotation: DMat3,
    translation: DVec3,
    split: Option<Split>,
}

struct RawDataset {
    format: Format,
    views: Vec<RawView>,
    points: PointCloud,
    warnings: Vec<String>,
}

/// Loads the dataset in a folder (or the `transforms.json` given), whatever its layout.
///
/// # Errors
/// When the layout is not recognised, a file is damaged, or no view is left.
pub fn load(path: &Path, options: &LoadOptions) -> Result<Dataset> {
    let raw = if path.extension().is_some_and(|e| e == "json") {
        transforms::load(path.parent().unwrap_or(Path::new(".")), &[path.to_path_buf()])?
    } else if !path.is_dir() {
        return Err(Error::new("no such folder")
            .file(path)
            .hint("give the folder of a COLMAP, transforms.json or ScanNet scene"));
    } else if let Some(model) = colmap::find_model(path) {
        load_colmap(path, &model)?
    } else if let Some(files) = transforms::find(path) {
        transforms::load(path, &files)?
    } else if scannet::is_scannet(path) {
        scannet::load(path)?
    } else {
        return Err(Error::new("no dataset recognised in this folder")
            .file(path)
            .expected("sparse/0/cameras.bin|txt (COLMAP), transforms.json or transforms_train.json, or color/ pose/ intrinsic/ (ScanNet)")
            .hint("run COLMAP on the photographs first"));
    };
    finish(path, raw, options)
}

fn finish(root: &Path, mut raw: RawDataset, options: &LoadOptions) -> Result<Dataset> {
    raw.views.sort_by(|a, b| a.name.cmp(&b.name));
    if let Some(w) = raw.views.windows(2).find(|w| w[0].name == w[1].name) {
        return Err(Error::new("two views have the same name").file(root).field(&w[0].name));
    }
    if raw.views.is_empty() {
        return Err(Error::new("no view is left")
            .file(root)
            .found(raw.warnings.first().map_or("no images", String::as_str))
            .expected("at least one posed photograph")
            .hint("check that the images lie where the dataset says"));
    }
    let views = raw
        .views
        .into_iter()
        .enumerate()
        .map(|(i, v)| {
            let (w, h) = v.source.size;
            let [fx, fy, cx, cy] = v.source.focal_center;
            let full = Camera { width: w, height: h, fx, fy, cx, cy, rotation: v.rotation, translation: v.translation };
            let (width, height) = options.resolution.apply(w, h);
            let held_out = options.holdout > 0 && i % options.holdout == 0;
            View {
                camera: full.resized(width, height),
                split: v.split.unwrap_or(if held_out { Split::Test } else { Split::Train }),
                name: v.name,
                image_path: v.image_path,
                source: v.source,
            }
        })
        .collect();
    Ok(Dataset { root: root.to_path_buf(), format: raw.format, views, points: raw.points, warnings: raw.warnings })
}

fn load_colmap(root: &Path, folder: &Path) -> Result<RawDataset> {
    let model = colmap::read_model(folder)?;
    let images = ["images", "input", "."].iter().map(|d| root.join(d)).find(|d| d.is_dir()).unwrap_or_default();
    let mut warnings = Vec::new();
    let mut views = Vec::new();
    for image in model.images {
        let relative = Path::new(&image.name);
        // A name inside a file must not lead out of the dataset.
        if relative.components().any(|c| !matches!(c, std::path::Component::Normal(_) | std::path::Component::CurDir)) {
            return Err(Error::new("the image's name leads out of the folder")
                .file(folder)
                .field("images")
                .found(&image.name));
        }
        let image_path = images.join(relative);
        if !image_path.is_file() {
            warnings.push(format!("{}: no such photograph, view skipped", image_path.display()));
            continue;
        }
        let c = &model.cameras[&image.camera];
        views.push(RawView {
            name: image.name,
            image_path,
            source: Source { size: (c.width, c.height), focal_center: c.focal_center, distortion: c.distortion },
            rotation: image.rotation,
            translation: image.translation,
            split: None,
        });
    }
    Ok(RawDataset { format: Format::Colmap, views, points: model.points, warnings })
}

impl View {
    /// The file name without folder and last extension, by which masks are found.
    pub fn stem(&self) -> &str {
        Path::new(&self.name).file_stem().and_then(|s| s.to_str()).unwrap_or(&self.name)
    }

    /// Decodes the photograph, undistorts it and brings it to the camera's size.
    ///
    /// # Errors
    /// When the file cannot be read or its shape is not the camera's.
    pub fn load_image(&self) -> Result<Image> {
        let photo = Image::read(&self.image_path)?;
        let (w, h) = self.source.size;
        // Photographs may have been shrunk after COLMAP ran, but not cropped or turned.
        let ratio = f64::from(photo.width) / f64::from(photo.height) / (f64::from(w) / f64::from(h));
        if !(0.99..1.01).contains(&ratio) {
            return Err(Error::new("the photograph has another shape than its camera")
                .file(&self.image_path)
                .field("size")
                .found(format!("{}x{}", photo.width, photo.height))
                .expected(format!("{w}x{h}"))
                .hint("use the photographs that the poses were made from"));
        }
        let flat = if self.source.distortion.is_none() { photo } else { self.undistort(&photo) };
        Ok(flat.resize_area(self.camera.width, self.camera.height))
    }

    /// Resamples the photograph as a pinhole camera of the same focal lengths would have seen it.
    fn undistort(&self, photo: &Image) -> Image {
        let (w, h) = (photo.width as usize, photo.height as usize);
        let (sx, sy) = (w as f64 / f64::from(self.source.size.0), h as f64 / f64::from(self.source.size.1));
        let [fx, fy, cx, cy] = self.source.focal_center;
        let source_of = |x: usize, y: usize| {
            let (u, v) = (((x as f64 + 0.5) / sx - cx) / fx, ((y as f64 + 0.5) / sy - cy) / fy);
            let (du, dv) = self.source.distortion.distort(u, v);
            ((du * fx + cx) * sx, (dv * fy + cy) * sy)
        };
        let mut out = Image { rgb: vec![0.0; w * h * 3], alpha: None, ..*photo };
        out.rgb.par_chunks_mut(3 * w).enumerate().for_each(|(y, row)| {
            for (x, pixel) in row.chunks_exact_mut(3).enumerate() {
                let (sx, sy) = source_of(x, y);
                pixel.copy_from_slice(&photo.sample(sx, sy));
            }
        });
        if photo.alpha.is_some() {
            out.alpha = Some(
                (0..w * h)
                    .map(|i| {
                        let (x, y) = source_of(i % w, i / w);
                        photo.sample_alpha(x, y)
                    })
                    .collect(),
            );
        }
        out
    }
}

impl Dataset {
    /// Views of one split.
    pub fn views_of(&self, split: Split) -> impl Iterator<Item = &View> {
        self.views.iter().filter(move |v| v.split == split)
    }

    /// Content hash: names, cameras, splits, sparse points and photographs, independent of where the folder lies.
    ///
    /// # Errors
    /// When a photograph cannot be read.
    pub fn hash(&self) -> Result<String> {
        let mut text = String::new();
        let files: Result<Vec<String>> = self.views.par_iter().map(|v| hash_file(&v.image_path)).collect();
        for (v, file) in self.views.iter().zip(files?) {
            text += &format!("{}\n{:?}\n{:?}\n{:?}\n{file}\n", v.name, v.camera, v.split, v.source);
        }
        let mut bytes = text.into_bytes();
        bytes.extend(self.points.positions.iter().flatten().flat_map(|v| v.to_le_bytes()));
        bytes.extend(self.points.colors.iter().flatten());
        Ok(hash_bytes(&bytes))
    }
}

/// Size of a picture, for layouts whose files do not say.
fn picture_size(path: &Path) -> Result<(u32, u32)> {
    image::size_of(path)
}

fn read_text(path: &Path) -> Result<String> {
    let bytes = std::fs::read(path).at("read", path)?;
    String::from_utf8(bytes).map_err(|_| Error::new("not a text file").file(path))
}
