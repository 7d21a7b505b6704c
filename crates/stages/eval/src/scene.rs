//! What every command loads: instances with their geometry, and the views of the scene; names of what is written.

use crate::options::Inputs;
use gs_io::{Error, Result};
use gs_scene::dataset::{self, Dataset, LoadOptions, View};
use query::LabelledScene;
use stage::Stage;
use std::path::{Path, PathBuf};

/// Loads a dataset and passes on its warnings.
pub fn load(folder: &Path, options: &LoadOptions, stage: &Stage) -> Result<Dataset> {
    let dataset = dataset::load(folder, options)?;
    dataset.warnings.iter().for_each(|w| stage.warn(w));
    Ok(dataset)
}

impl Inputs {
    /// The files of the scene, its geometry, its instances and their edits.
    pub fn files<'a>(&'a self, dataset: &'a Dataset) -> impl Iterator<Item = &'a PathBuf> {
        dataset.files.iter().chain([&self.instances, &self.geometry]).chain(&self.edits)
    }

    /// Reads instances and geometry, which must be those of the dataset, whose cameras follow them. Damaged Gaussians are reported.
    pub fn read(&self, dataset: &mut Dataset, stage: &Stage) -> Result<LabelledScene> {
        let scene = LabelledScene::read(&self.instances, &self.geometry, self.edits.as_deref())?;
        if let Some(damage) = scene.geometry.damage() {
            stage.skipped(&damage);
        }
        scene.check_dataset(dataset)?;
        Ok(scene)
    }
}

/// A folder with all the folders above it as they were given: a link keeps its own name, because it is how people call
/// what it leads to. Only of `..` at the end the name is asked from the file system.
pub fn full_path(path: &Path) -> PathBuf {
    let full = std::path::absolute(path).unwrap_or_else(|_| path.to_path_buf());
    if full.file_name().is_some() { full } else { path.canonicalize().unwrap_or(full) }
}

/// The name of a folder, also of `.`; a link's own.
pub fn folder_name(path: &Path) -> String {
    full_path(path).file_name().map_or("scene".into(), |n| n.to_string_lossy().into_owned())
}

/// The view of this name: a file name, with or without its extension.
pub fn find_view<'a>(dataset: &'a Dataset, name: &str) -> Result<&'a View> {
    dataset.views.iter().find(|v| v.name == name || v.stem() == name).ok_or_else(|| {
        let some: Vec<&str> = dataset.views.iter().take(4).map(View::stem).collect();
        let expected = format!("one of {} names such as {}", dataset.views.len(), some.join(", "));
        Error::new("no such view").file(&dataset.root).field("--views").found(name).expected(expected)
    })
}

/// Views that are shown where none are named.
pub const VIEWS: usize = 3;

/// The views of these names; without names a few of those that `fit`, or of all where none does, which lie apart.
pub fn views_to_show<'a>(dataset: &'a Dataset, names: &[String], fit: impl Fn(&View) -> bool) -> Result<Vec<&'a View>> {
    if !names.is_empty() {
        return names.iter().map(|n| find_view(dataset, n)).collect();
    }
    let mut views: Vec<&View> = dataset.views.iter().filter(|v| fit(v)).collect();
    if views.is_empty() {
        views = dataset.views.iter().collect();
    }
    Ok(spread(&views, VIEWS))
}

/// At most `count` of `all`, evenly spread, in order.
fn spread<T: Copy>(all: &[T], count: usize) -> Vec<T> {
    let n = all.len();
    let k = count.min(n);
    (0..k).map(|i| all[(2 * i + 1) * n / (2 * k)]).collect()
}

/// Most bytes of a name that is made of a text.
const LONGEST_NAME: usize = 100;

/// A view's stem as part of a file name (names of views may hold folders), with its number where two would be the same.
pub fn view_name(dataset: &Dataset, view: &View) -> String {
    let name = |v: &View| slug(v.stem(), "_.");
    let own = name(view);
    let twins = dataset.views.iter().filter(|v| name(v) == own).count();
    let number = dataset.views.iter().position(|v| v.name == view.name).unwrap_or(0);
    if twins > 1 { format!("{number:04}-{own}") } else { own }
}

/// A text as part of a file name of at most 100 bytes: letters, digits and what is in `also`; everything else is
/// a hyphen.
pub fn slug(text: &str, also: &str) -> String {
    let kept = |c: char| if c.is_alphanumeric() || also.contains(c) { c } else { ' ' };
    let words: String = text.chars().map(kept).collect();
    let mut joined = words.split_whitespace().collect::<Vec<_>>().join("-");
    joined.truncate(joined.floor_char_boundary(LONGEST_NAME));
    if joined.is_empty() { "query".into() } else { joined }
}

/// The file name of the answer to a text, number first: no two are the same, and none is a name that means something else.
pub fn numbered(number: usize, text: &str) -> String {
    let mut name = format!("{number:02}-{}", slug(&text.to_lowercase(), ""));
    name.truncate(name.floor_char_boundary(LONGEST_NAME));
    name
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spreading_keeps_order_and_ends_apart() {
        assert_eq!(spread(&[0, 1, 2, 3, 4, 5, 6, 7, 8], 3), [1, 4, 7]);
        assert_eq!(spread(&[5, 6], 3), [5, 6]);
        assert_eq!(spread(&[5], 1), [5]);
        assert!(spread::<u8>(&[], 3).is_empty());
    }

    #[test]
    fn slugs_are_file_names() {
        assert_eq!(slug("Rubik's  cube/..\\x", ""), "Rubik-s-cube-x");
        assert_eq!(slug("cam0/IMG_1.a", "_."), "cam0-IMG_1.a");
        assert_eq!(slug("../", ""), "query");
        for text in ["é".repeat(200), "x".repeat(300), "日本".repeat(90)] {
            let name = numbered(1234, &text);
            assert!(name.len() <= 100 && name.len() > 96 && name.starts_with("1234-"), "{name}");
        }
        assert_eq!(numbered(1, "Coffee mug"), "01-coffee-mug");
        assert_ne!(numbered(1, "coffee mug"), numbered(2, "Coffee, mug!"));
    }
}
