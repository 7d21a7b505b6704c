//! Which pixels of a photograph count: alpha channels and mask files.

use super::border;
use gs_io::{Error, Result, hash_bytes, hash_file};
use gs_scene::dataset::{Dataset, Odd, Split, View};
use gs_scene::image_has_alpha;
use rayon::prelude::*;
use serde::Serialize;
use stage::Stage;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// What transparent pixels of the photographs mean.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Alpha {
    /// Nothing is there: the photograph lies over the background.
    #[default]
    Background,
    /// Unknown: they do not count.
    Ignore,
}

/// Which pixels count: mask files by the names of the views they belong to, and dark borders of photographs by their size.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Masks {
    files: BTreeMap<String, PathBuf>,
    borders: border::BySize,
}

impl Masks {
    /// The masks in a folder: a PNG or JPEG a view, with the name of the photograph, with (as COLMAP has it) or without its
    /// extension. A view without a file has no mask.
    pub fn find(folder: &Path, views: &[View]) -> Result<Self> {
        let mut all = BTreeMap::new();
        for view in views {
            let bare = Path::new(&view.name).with_extension("").to_string_lossy().into_owned();
            let names = [view.name.clone(), format!("{}.png", view.name), format!("{bare}.png"), format!("{bare}.jpg")];
            let names = names.into_iter().chain([format!("{}.png", view.stem())]);
            let others = ["PNG", "JPG", "jpeg", "JPEG"].map(|e| format!("{bare}.{e}"));
            let named = names.chain(others).map(|n| folder.join(n));
            if let Some(path) = named.into_iter().find(|p| p.is_file()) {
                all.insert(view.name.clone(), path);
            }
        }
        if all.is_empty() {
            return Err(Error::new("no masks in this folder")
                .file(folder)
                .field("--masks")
                .expected(views.first().map_or_else(String::new, |v| format!("pictures such as {}.png", v.stem()))));
        }
        Ok(Self { files: all, borders: BTreeMap::new() })
    }

    /// Those that the dataset itself has.
    pub fn of_dataset(views: &[View]) -> Self {
        let files = views.iter().filter_map(|v| Some((v.name.clone(), v.mask_path()?.to_path_buf()))).collect();
        Self { files, borders: BTreeMap::new() }
    }

    /// And the borders of the photographs as large as the dataset's cameras are, where they have some; says so. Without masks, transparent
    /// photographs have none: their alpha means something else.
    pub fn with_borders(mut self, dataset: &Dataset, stage: &Stage) -> Result<Self> {
        let views: Vec<&View> = dataset.views_of(Split::Train).collect();
        let clear = |v: &View| Ok(self.files.is_empty() && image_has_alpha(&v.image_path)?);
        if !views.iter().map(|v| clear(v)).collect::<Result<Vec<bool>>>()?.contains(&true) {
            self.borders = border::find(&views, stage)?;
        }
        Ok(self)
    }

    /// Which pixels of a photograph of this size lie within its border, 0 or 1; none where it has none.
    pub fn border(&self, size: (u32, u32)) -> Option<&[f32]> {
        self.borders.get(&size).map(|b| &b[..])
    }

    /// What transparent pixels mean: with masks, that they do not count.
    pub fn alpha(&self) -> Alpha {
        if self.files.is_empty() && self.borders.is_empty() { Alpha::Background } else { Alpha::Ignore }
    }

    /// Views whose masks are written in an odd way. Reads them all.
    ///
    /// # Errors
    /// When one cannot be read or has another size than its photograph.
    pub fn odd(&self, views: &[View]) -> Result<BTreeMap<Odd, Vec<String>>> {
        let odd = |view: &View| self.of(view).map_or(Ok(None), |path| Ok(view.read_mask(path)?.odd));
        let all = views.par_iter().map(odd).collect::<Result<Vec<_>>>()?;
        let mut by_kind = BTreeMap::<Odd, Vec<String>>::new();
        for (view, odd) in views.iter().zip(all) {
            odd.into_iter().for_each(|odd| by_kind.entry(odd).or_default().push(view.name.clone()));
        }
        Ok(by_kind)
    }

    pub fn of(&self, view: &View) -> Option<&Path> {
        self.files.get(&view.name).map(PathBuf::as_path)
    }

    pub fn len(&self) -> usize {
        self.files.len()
    }

    pub fn files(&self) -> impl Iterator<Item = PathBuf> {
        self.files.values().cloned()
    }

    /// Content hash of names and files; none without masks.
    pub fn hash(&self) -> Result<Option<String>> {
        let mut text = String::new();
        for (name, path) in &self.files {
            text += &format!("{name}\n{}\n", hash_file(path)?);
        }
        Ok((!self.files.is_empty()).then(|| hash_bytes(text.as_bytes())))
    }
}

/// Multiplies `[pixels][rgb]` by `[pixels]`.
pub fn multiply(rgb: &mut [f32], alpha: &[f32]) {
    for (pixel, a) in rgb.as_chunks_mut::<3>().0.iter_mut().zip(alpha) {
        pixel.iter_mut().for_each(|v| *v *= a);
    }
}
