//! Id maps and mask features in LangSplat's layout: `<stem>_s.npy` and `<stem>_f.npy` in one folder.

use crate::{flat, role};
use gs_io::{Error, IoContext, Provenance, Result, Watched, check_name, hash_file, hash_files, npy};
use gs_scene::dataset::View;
use ndarray::{Array2, Array3, ArrayView1, ArrayView2, Axis, s};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Most levels that an id map file may have: SAM's four, then classes and concepts of up to six models of each kind.
pub const LEVELS: usize = 16;

/// A level of masks: its place in the files. Granularities of SAM come first, then models that name what they see.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Level(u8);

/// What made the masks of a level.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LevelKind {
    /// SAM, at one of its granularities.
    Segments,
    /// A panoptic model: a mask is a thing, or all that is seen of a class.
    Classes,
    /// A model that is asked for words.
    Concepts,
}

impl Level {
    /// SAM's default masks.
    pub const DEFAULT: Self = Self(0);
    /// Subparts.
    pub const SMALL: Self = Self(1);
    /// Parts.
    pub const MEDIUM: Self = Self(2);
    /// Whole things.
    pub const LARGE: Self = Self(3);
    /// What the first panoptic model sees.
    pub const CLASSES: Self = Self(4);
    /// What the first model finds that is asked for words.
    pub const CONCEPTS: Self = Self(5);
    /// LangSplat's levels, which every file has.
    pub const SAM: [Self; 4] = [Self::DEFAULT, Self::SMALL, Self::MEDIUM, Self::LARGE];
    /// All levels in the order of the files.
    pub const ALL: [Self; LEVELS] = {
        let mut all = [Self::DEFAULT; LEVELS];
        let mut at = 0;
        while at < LEVELS {
            all[at] = Self(at as u8);
            at += 1;
        }
        all
    };
    const SAM_NAMES: [&str; 4] = ["default", "small", "medium", "large"];

    /// Its place in the files, from 0.
    pub const fn index(self) -> usize {
        self.0 as usize
    }

    /// What made its masks. After SAM's levels the kinds take turns: classes, concepts, classes-2, concepts-2, ...
    pub const fn kind(self) -> LevelKind {
        match self.0 {
            0..4 => LevelKind::Segments,
            n if n % 2 == 0 => LevelKind::Classes,
            _ => LevelKind::Concepts,
        }
    }
}

impl std::str::FromStr for Level {
    type Err = Error;

    fn from_str(s: &str) -> Result<Self> {
        let is_meant = |l: &Self| s == l.to_string() || s == l.0.to_string();
        let expected = "default, small, medium, large, classes, concepts, classes-2, ... concepts-6 (or 0 to 15)";
        Self::ALL.into_iter().find(is_meant).ok_or_else(|| Error::new("unknown level").found(s).expected(expected))
    }
}

impl std::fmt::Display for Level {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let name = match self.kind() {
            LevelKind::Segments => Self::SAM_NAMES[self.index()],
            LevelKind::Classes => "classes",
            LevelKind::Concepts => "concepts",
        };
        match self.0 / 2 {
            0..=2 => f.write_str(name),
            nth => write!(f, "{name}-{}", nth - 1),
        }
    }
}

impl std::fmt::Debug for Level {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{self}")
    }
}

impl Serialize for Level {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> std::result::Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

/// Where the id maps of a view lie: `<folder>/<stem>_s.npy`.
pub fn maps_path(folder: impl AsRef<Path>, stem: &str) -> PathBuf {
    folder.as_ref().join(format!("{stem}_s.npy"))
}

/// Where the mask features of a view lie: `<folder>/<stem>_f.npy`.
pub fn features_path(folder: impl AsRef<Path>, stem: &str) -> PathBuf {
    folder.as_ref().join(format!("{stem}_f.npy"))
}

/// Where it lies what the id maps of a view were made from, and the names of the masks: `<folder>/<stem>_s.json`.
pub fn note_path(folder: impl AsRef<Path>, stem: &str) -> PathBuf {
    maps_path(folder, stem).with_extension("json")
}

/// What a model calls a mask.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MaskName {
    /// The name of its class.
    pub name: String,
    /// How sure the model is, 0 to 1.
    pub score: f32,
}

/// The names of the masks of one view, by id.
pub type MaskNames = BTreeMap<u32, MaskName>;

/// Reads the names of the masks of a view, `facts.names` of its note; none where there are none.
///
/// # Errors
/// When the file is damaged or of another id map, a name is empty or bad ([`check_name`]), or a score is not in 0 to 1.
pub fn read_mask_names(folder: impl AsRef<Path>, stem: &str) -> Result<MaskNames> {
    let folder = folder.as_ref();
    let path = note_path(folder, stem);
    if !path.is_file() {
        return Ok(MaskNames::new());
    }
    let wrong = |e| Error::new(format!("not the names of masks: {e}")).file(&path).field("facts.names");
    let bytes = std::fs::read(&path).at("read", &path)?;
    let note: serde_json::Value = serde_json::from_slice(&bytes).map_err(wrong)?;
    let Some(names) = note["facts"].get("names") else { return Ok(MaskNames::new()) };
    // mask-embed notes which map they are of.
    let map = maps_path(folder, stem);
    if note["hash"].as_str().is_some_and(|hash| hash_file(&map).is_ok_and(|found| found != hash)) {
        let e = Error::new("names of another id map").file(&path).field("hash");
        return Err(e.hint("run mask-embed masks again"));
    }
    let names = MaskNames::deserialize(names).map_err(wrong)?;
    for (id, mask) in &names {
        check_name(&mask.name).map_err(|e| e.file(&path).field(id.to_string()))?;
        if mask.name.is_empty() || !(0.0..=1.0).contains(&mask.score) {
            let e = Error::new("not the name of a mask").file(&path).field(id.to_string()).found(format!("{mask:?}"));
            return Err(e.expected("a name, and a score from 0 to 1"));
        }
    }
    Ok(names)
}

/// Stems of all views that have id maps in `folder`, sorted.
pub fn stems(folder: impl AsRef<Path>) -> Result<Vec<String>> {
    with_suffix(folder.as_ref(), "_s.npy")
}

fn with_suffix(folder: &Path, suffix: &str) -> Result<Vec<String>> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).at("list", folder)? {
        let name = entry.at("list", folder)?.file_name();
        if let Some(stem) = name.to_string_lossy().strip_suffix(suffix) {
            found.push(stem.to_string());
        }
    }
    found.sort();
    Ok(found)
}

/// The files of a masks folder that end in `suffix` (`_s.npy` or `_f.npy`), sorted by stem.
pub fn folder_files(folder: impl AsRef<Path>, suffix: &str) -> Result<Vec<PathBuf>> {
    let folder = folder.as_ref();
    Ok(with_suffix(folder, suffix)?.into_iter().map(|stem| folder.join(stem + suffix)).collect())
}

/// One hash for all files of a masks folder that end in `suffix` (`_s.npy` or `_f.npy`): of names and contents.
pub fn hash_folder(folder: impl AsRef<Path>, suffix: &str) -> Result<String> {
    let folder = folder.as_ref();
    let names = with_suffix(folder, suffix)?.into_iter().map(|s| s + suffix);
    hash_files(names.map(|n| (n.clone(), folder.join(n))))
}

/// Notes how the files that [`hash_folder`] would hash are now, for a stage that hashes them at one time and reads them at
/// another.
pub fn watch_folder(folder: impl AsRef<Path>, suffix: &str) -> Result<Watched> {
    Ok(Watched::new(folder_files(folder, suffix)?))
}

/// The id maps of one view.
#[derive(Debug, Clone, PartialEq)]
pub struct MaskMaps {
    /// Mask id per pixel, -1 for none; `[levels][height][width]`, levels an even number from 4. Ids count on from level to level, so that an id is the row
    /// of the mask in `*_f.npy`; ids without pixels exist.
    pub ids: Array3<i32>,
}

impl MaskMaps {
    /// Largest id a file may name: as many as f32 counts exactly.
    const MAX_ID: f32 = 16_777_216.0;

    /// Reads `*_s.npy`: any real dtype, `[L, H, W]` with L levels, an even number from 4 (or `[1, H, W]` and `[H, W]`: one level for SAM's four).
    ///
    /// # Errors
    /// When the file is damaged, has another shape, or an id is not a whole number of at least -1 or out of proportion to
    /// the number of pixels.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let a = npy::read_f32(path)?;
        let (levels, height, width) = match *a.shape() {
            [levels, h, w] if levels == 1 || (Level::SAM.len()..=LEVELS).contains(&levels) && levels % 2 == 0 => {
                (levels, h, w)
            }
            [h, w] => (1, h, w),
            _ => (0, 0, 0),
        };
        if levels * height * width == 0 {
            return Err(Error::new("not an id map")
                .file(path)
                .field("shape")
                .found(format!("{:?}", a.shape()))
                .expected("[4, height, width], or two more for each pair of classes and concepts, up to 16"));
        }
        // Tables with a row for each id are made from this: ids are dense, so there are no more of them than pixels.
        let most = Self::MAX_ID.min((levels * height * width).max(1 << 16) as f32);
        let values = flat(a.view());
        if let Some(at) = values.iter().position(|&v| v.fract() != 0.0 || !(-1.0..most).contains(&v)) {
            let (x, y, l) = (at % width, at / width % height, at / (width * height));
            return Err(Error::new("not a mask id")
                .file(path)
                .field(format!("level {l}, row {y}, column {x}"))
                .found(values[at])
                .expected(format!("-1 or a whole number from 0, below {most}"))
                .hint("id maps must not be interpolated or blended"));
        }
        let mut ids: Vec<i32> = values.iter().map(|&v| v as i32).collect();
        if levels == 1 {
            ids = ids.repeat(Level::SAM.len());
        }
        let levels = levels.max(Level::SAM.len());
        Ok(Self { ids: Array3::from_shape_vec((levels, height, width), ids).expect("ids of all levels") })
    }

    /// Writes `*_s.npy` as LangSplat does: f32 `[4, H, W]`; more levels where models name masks.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<()> {
        npy::write_f32(path, &self.ids.mapv(|id| id as f32))
    }

    /// Width in pixels; the photograph may have another size.
    pub fn width(&self) -> usize {
        self.ids.dim().2
    }

    /// Height in pixels.
    pub fn height(&self) -> usize {
        self.ids.dim().1
    }

    /// The levels that there are: SAM's, and perhaps more.
    pub fn levels(&self) -> &'static [Level] {
        &Level::ALL[..self.ids.dim().0]
    }

    /// The mask of a level that owns the pixel in this row and column; None too where there is no such level.
    #[inline(always)]
    pub fn mask(&self, level: Level, [y, x]: [usize; 2]) -> Option<u32> {
        self.ids.get([level.index(), y, x]).and_then(|&id| u32::try_from(id).ok())
    }

    /// The map of one level, `[height][width]`.
    ///
    /// # Panics
    /// When there is no such level.
    pub fn level(&self, level: Level) -> ArrayView2<'_, i32> {
        self.ids.index_axis(Axis(0), level.index())
    }

    /// Forgets the masks of all levels but these.
    pub fn keep(&mut self, levels: &[Level]) {
        for level in self.levels().iter().filter(|level| !levels.contains(level)) {
            self.ids.index_axis_mut(Axis(0), level.index()).fill(-1);
        }
    }

    /// The maps with every `step`-th pixel of every `step`-th row, the first ones among them, so that no id is blended; of `ids`
    /// with fewer pixels than a step some vanish.
    #[must_use]
    pub fn shrunk(&self, step: usize) -> Self {
        let step = step as isize;
        Self { ids: self.ids.slice(s![.., ..;step, ..;step]).as_standard_layout().into_owned() }
    }

    /// Refuses maps, read from `file`, of another shape than a photograph of `width` x `height`: maps may be of another size.
    ///
    /// # Errors
    /// When they have not the [`same_shape`].
    pub fn expect_shape(&self, width: u32, height: u32, file: impl AsRef<Path>) -> Result<()> {
        let (w, h) = (self.width(), self.height());
        if same_shape([w as u32, h as u32], [width, height]) {
            return Ok(());
        }
        Err(Error::new("the id map has another shape than the photograph")
            .file(file)
            .field("shape")
            .found(format!("{w}x{h}"))
            .expected(format!("{width}x{height}, or that scaled"))
            .hint("make the masks from the photographs of this scene"))
    }

    /// Number of ids: the largest id of any level and one.
    pub fn id_count(&self) -> usize {
        self.ids.iter().max().map_or(0, |&m| (m + 1) as usize)
    }
}

/// The id maps of a folder as the pinhole cameras of a scene see them.
#[derive(Debug, Clone, PartialEq)]
pub struct MaskFolder {
    path: PathBuf,
    /// Whether the maps were made from undistorted photographs.
    undistorted: bool,
}

impl MaskFolder {
    /// A folder, with what its `masks.json` says of it: `mask-embed masks` sees undistorted photographs, and names the dataset
    /// that they are of. Maps of other programs, and imported ones, are of the photographs as they lie on disk.
    pub fn open(path: impl Into<PathBuf>) -> Self {
        let path = path.into();
        let manifest = std::fs::read(path.join("masks.json")).ok();
        let made = manifest.and_then(|bytes| serde_json::from_slice::<Provenance>(&bytes).ok());
        let undistorted = made.is_some_and(|m| m.inputs.contains_key(role::DATASET));
        Self { path, undistorted }
    }

    /// Whether the maps of this view have the distortion of its lens or lie on a side, which [`Self::read`] takes out.
    pub fn bends(&self, view: &View) -> bool {
        !view.is_straight() && !self.undistorted
    }

    /// Reads the id maps of a view, upright and undistorted.
    ///
    /// # Errors
    /// As [`MaskMaps::read`] and [`MaskMaps::expect_shape`].
    pub fn read(&self, view: &View) -> Result<MaskMaps> {
        let file = maps_path(&self.path, view.stem());
        let mut maps = MaskMaps::read(&file)?;
        if self.bends(view) {
            let size = (maps.width(), maps.height());
            let (width, height) = view.straighten(maps.ids.as_slice_mut().expect("as read"), size);
            let levels = maps.levels().len();
            maps.ids = maps.ids.into_shape_with_order((levels, height, width)).expect("as many ids");
        }
        maps.expect_shape(view.camera.width, view.camera.height, &file)?;
        Ok(maps)
    }
}

/// Whether a picture has the shape (aspect ratio) of a photograph: its height is that of the photograph scaled to its width,
/// to 2 % or two pixels. Both are given as width and height.
pub fn same_shape([width, height]: [u32; 2], photograph: [u32; 2]) -> bool {
    let [w, h] = photograph.map(f64::from);
    let expected = f64::from(width) * h / w;
    (expected - f64::from(height)).abs() <= (0.02 * f64::from(height)).max(2.0)
}

/// The language features of the masks of one view.
#[derive(Debug, Clone, PartialEq)]
pub struct MaskFeatures {
    /// `[masks][dim]`, the masks of all levels; unit length, or zero for a mask without pixels.
    pub values: Array2<f32>,
}

impl MaskFeatures {
    /// Reads `*_f.npy`: `[masks, dim]`, any real dtype.
    ///
    /// # Errors
    /// When the file is damaged, has another shape, or holds a number that is not finite.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let a = npy::read_f32(path)?;
        let found = format!("{:?}", a.shape());
        let values: Array2<f32> = a.into_dimensionality().map_err(|_| {
            Error::new("not mask features").file(path).field("shape").found(found).expected("[masks, dimension]")
        })?;
        if let Some(((row, column), v)) = values.indexed_iter().find(|(_, v)| !v.is_finite()) {
            let field = format!("row {row}, column {column}");
            return Err(Error::new("not a finite number").file(path).field(field).found(v));
        }
        Ok(Self { values })
    }

    /// Those of the masks of a view, if `folder` has any: at least one for each of its `masks` ids, and of `dim` dimensions where that is
    /// known.
    ///
    /// # Errors
    /// When the file is damaged or does not fit.
    pub fn of_view(folder: &Path, stem: &str, masks: usize, dim: Option<usize>) -> Result<Option<Self>> {
        let path = features_path(folder, stem);
        if !path.is_file() {
            return Ok(None);
        }
        let features = Self::read(&path)?;
        let wrong = |what: &str, field: &str, found: usize, expected: String| {
            let e = Error::new(what).file(&path).field(field).found(found).expected(expected);
            Err(e.hint("run mask-embed embed again, with the model of the other features and of the texts"))
        };
        let (rows, columns) = features.values.dim();
        if rows < masks {
            return wrong("fewer features than masks", "rows", rows, format!("at least {masks}"));
        }
        match dim {
            Some(dim) if dim != columns => wrong("features of different models", "columns", columns, dim.to_string()),
            _ => Ok(Some(features)),
        }
    }

    /// Writes `*_f.npy`: f32 `[masks, dim]`.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<()> {
        npy::write_f32(path, &self.values)
    }

    /// Feature of mask `id`, if there is one.
    pub fn row(&self, id: usize) -> Option<ArrayView1<'_, f32>> {
        (id < self.values.nrows()).then(|| self.values.row(id))
    }

    /// Dimension of a feature.
    pub fn dim(&self) -> usize {
        self.values.ncols()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::arr2;

    #[test]
    fn shrunk_maps_keep_the_first_of_every_few_pixels() {
        // 5 x 3 pixels at four levels: level, row and column are the digits of the id.
        let id = |(l, y, x)| (100 * l + 10 * y + x) as i32;
        let m = MaskMaps { ids: Array3::from_shape_fn((4, 3, 5), id) };
        let half = m.shrunk(2);
        assert_eq!((half.width(), half.height()), (3, 2));
        assert_eq!(half.level(Level::DEFAULT), arr2(&[[0, 2, 4], [20, 22, 24]]));
        assert_eq!(half.level(Level::LARGE), arr2(&[[300, 302, 304], [320, 322, 324]]));
        assert_eq!(m.shrunk(1), m);
        assert_eq!(flat(m.shrunk(64).ids.view()), [0, 100, 200, 300]);
    }

    #[test]
    fn id_maps_read_back_and_refuse_blended_ids() {
        let dir = tempfile::tempdir().unwrap();
        let p = maps_path(dir.path(), "frame_00001");
        let m = MaskMaps { ids: Array3::from_shape_fn((4, 2, 3), |(l, y, x)| (6 * l + 3 * y + x) as i32 % 7 - 1) };
        m.write(&p).unwrap();
        assert_eq!(MaskMaps::read(&p).unwrap(), m);
        assert_eq!(flat(m.level(Level::LARGE)), &flat(m.ids.view())[18..]);
        assert_eq!(stems(dir.path()).unwrap(), ["frame_00001"]);
        npy::write_f32(&p, &arr2(&[[0.0, 0.5, 0.0], [0.0, 0.0, 0.0]])).unwrap();
        let e = MaskMaps::read(&p).unwrap_err().to_string();
        assert!(e.contains("level 0, row 0, column 1") && e.contains("found 0.5"), "{e}");
        npy::write_f32(&p, &arr2(&[[-1.0, 0.0, 1.0], [2.0, 3.0, 4.0]])).unwrap();
        assert_eq!(MaskMaps::read(&p).unwrap().level(Level::MEDIUM), arr2(&[[-1, 0, 1], [2, 3, 4]]));
        npy::write_f32(&p, &Array2::<f32>::zeros((0, 3))).unwrap();
        assert!(MaskMaps::read(&p).is_err());
    }

    #[test]
    fn levels_are_known_by_name_and_a_file_may_have_as_many_as_it_likes() {
        let named = Level::ALL.map(|level| level.to_string());
        assert_eq!(named[3..9], ["large", "classes", "concepts", "classes-2", "concepts-2", "classes-3"]);
        assert!(Level::ALL.iter().zip(&named).all(|(level, name)| name.parse::<Level>().unwrap() == *level));
        assert!(["classes-1", "classes-7", "16", ""].iter().all(|name| name.parse::<Level>().is_err()));
        let kinds = [Level::LARGE, Level::CLASSES, Level::ALL[7]].map(Level::kind);
        assert_eq!(kinds, [LevelKind::Segments, LevelKind::Classes, LevelKind::Concepts]);
        let dir = tempfile::tempdir().unwrap();
        let p = maps_path(dir.path(), "a");
        for (levels, good) in [(4, true), (5, false), (6, true), (8, true), (16, true), (18, false)] {
            let maps = MaskMaps { ids: Array3::from_shape_fn((levels, 2, 3), |(l, ..)| l as i32) };
            maps.write(&p).unwrap();
            assert_eq!(MaskMaps::read(&p).ok(), good.then_some(maps), "{levels}");
        }
    }

    #[test]
    fn given_maps_of_a_distorted_lens_are_undistorted_and_our_own_are_not() {
        let dir = tempfile::tempdir().unwrap();
        let (root, masks) = (dir.path(), dir.path().join("masks"));
        std::fs::create_dir_all(root.join("sparse/0")).unwrap();
        let sparse = |name: &str, text: &str| std::fs::write(root.join("sparse/0").join(name), text).unwrap();
        sparse("cameras.txt", "1 SIMPLE_RADIAL 80 60 50 40 30 -0.3\n");
        sparse("images.txt", "1 1 0 0 0 0 0 0 1 a.png\n\n");
        let grey = vec![0.5; 3 * 80 * 60];
        gs_scene::Image { width: 80, height: 60, rgb: grey, alpha: None }.write_png(root.join("images/a.png")).unwrap();
        let load = gs_scene::dataset::LoadOptions { resolution: "1".parse().unwrap(), holdout: 0 };
        let view = gs_scene::dataset::load(root, &load).unwrap().views.remove(0);
        // A wall that ends at column 20 of the photograph, 20 pixels left of its middle.
        let given = MaskMaps { ids: Array3::from_shape_fn((4, 60, 80), |(_, _, x)| i32::from(x >= 20)) };
        given.write(maps_path(&masks, "a")).unwrap();
        let folder = MaskFolder::open(&masks);
        let read = folder.read(&view).unwrap();
        assert!(folder.bends(&view));
        let begins = |row: usize| read.level(Level::LARGE).row(row).iter().position(|&id| id == 1).unwrap();
        // A barrel pulls inwards, and more so the farther out: in the middle row x of the undistorted picture is seen at
        // 40 + (x - 40) (1 - 0.3 ((x - 40) / 50)^2).
        assert_eq!([begins(30), begins(29)], [19, 19]);
        assert!(begins(0) < 19 && begins(59) < 19, "{} {}", begins(0), begins(59));
        let made = Provenance { inputs: [(role::DATASET.to_string(), String::new())].into(), ..Provenance::default() };
        gs_io::write_json(masks.join("masks.json"), &made).unwrap();
        assert_eq!(MaskFolder::open(&masks).read(&view).unwrap(), given, "mask-embed saw undistorted photographs");
        let imported = Provenance { inputs: [("labels".to_string(), String::new())].into(), ..made };
        gs_io::write_json(masks.join("masks.json"), &imported).unwrap();
        assert_eq!(MaskFolder::open(&masks).read(&view).unwrap(), read);
    }
}
