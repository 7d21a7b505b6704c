//! Names of photographs: how datasets write them, and what of a folder no name means.

use super::{Format, View, list};
use gs_io::{Error, Result};
use std::collections::BTreeSet;
use std::ffi::OsStr;
use std::path::{Component, Path, PathBuf};
use unicode_normalization::UnicodeNormalization;

/// Extensions of photographs, which some programs leave out.
const EXTENSIONS: [&str; 6] = ["png", "jpg", "jpeg", "PNG", "JPG", "JPEG"];

/// Whether a file is named as photographs of phones and cameras are.
pub(super) fn is_picture(file: &Path) -> bool {
    let kind = file.extension().unwrap_or_default().to_ascii_lowercase();
    ["jpg", "jpeg", "png", "heic", "heif", "webp"].iter().any(|k| kind == *k)
}

/// A path as other systems than Windows write it, from the folder on.
pub(super) fn plain(path: &str) -> String {
    path.replace('\\', "/").trim_start_matches("./").to_string()
}

/// The file in a folder that a name means, as it is written there: without the extension, which Blender leaves out; `a.JPG` for
/// `a.jpg`, for cameras and copying programs differ in that; `images/a.png` for Windows' `images\\a.png`; letters with accents in one
/// piece or in two, as macOS has them.
pub(super) fn file_named(folder: &Path, name: &str) -> Option<String> {
    let plain = plain(name);
    let forms = [plain.clone(), name.to_string(), plain.nfc().collect(), plain.nfd().collect()];
    let cases = |form: &String| match form.rsplit_once('.') {
        Some((bare, extension)) => {
            vec![
                form.clone(),
                format!("{bare}.{}", extension.to_ascii_lowercase()),
                format!("{bare}.{}", extension.to_ascii_uppercase()),
            ]
        }
        None => vec![form.clone()],
    };
    let exact = forms.iter().flat_map(cases);
    let longer = forms.iter().flat_map(|form| EXTENSIONS.map(|e| format!("{form}.{e}")));
    exact.chain(longer).find(|n| folder.join(n).is_file())
}

/// Refuses a name inside a file that leads out of the dataset's folder.
pub(crate) fn check_inside(name: &str, field: &str) -> Result<()> {
    let inside = |c: Component| matches!(c, Component::Normal(_) | Component::CurDir);
    if !name.is_empty() && Path::new(&plain(name)).components().all(inside) {
        return Ok(());
    }
    Err(Error::new("the photograph's name leads out of the dataset")
        .field(field)
        .found(name)
        .expected("a path below the dataset's folder")
        .hint("move the photographs there and name them relative to it"))
}

/// Says how many photographs beside those of the views no view uses, but for those that were `skipped` with a warning. Pictures of other kinds there are masks and the like, and so
/// are, beside a transforms.json, those whose names go on from a photograph's: Blender's `r_0_normal.png` beside `r_0.png`.
pub(super) fn unused(root: &Path, format: Format, views: &[View], skipped: &[PathBuf]) -> Option<String> {
    let kind = |path: &Path| path.extension().map(OsStr::to_ascii_lowercase);
    let used: BTreeSet<&Path> = views.iter().map(|v| v.image_path.as_path()).collect();
    let beside = views.iter().flat_map(|v| [v.depth_path(), v.mask_path()]).flatten();
    let beside: BTreeSet<&Path> = beside.chain(skipped.iter().map(PathBuf::as_path)).collect();
    let kinds: BTreeSet<_> = used.iter().map(|path| kind(path)).collect();
    let stems: BTreeSet<PathBuf> = used.iter().map(|path| path.with_extension("")).collect();
    let goes_on = |path: &Path| {
        let Some(name) = path.file_stem().and_then(OsStr::to_str) else { return false };
        let ends = name.char_indices().filter(|(_, c)| !c.is_alphanumeric()).map(|(at, _)| at);
        ends.into_iter().any(|at| stems.contains(&path.with_file_name(&name[..at])))
    };
    let is_photograph = |path: &Path| match format {
        Format::Colmap | Format::ScanNet => true,
        Format::Transforms => !goes_on(path),
        Format::SevenScenes => path.to_str().is_some_and(|p| p.ends_with(".color.png")),
    };
    let mut folders: BTreeSet<PathBuf> = used.iter().filter_map(|path| path.parent()).map(Path::to_path_buf).collect();
    if format == Format::Colmap {
        // A folder of which the model has no photograph is one of these, too.
        let above =
            |v: &View| v.image_path.ancestors().nth(Path::new(&v.name).components().count()).map(Path::to_path_buf);
        let all = views.first().and_then(above).filter(|f| f.ends_with("images") || f.ends_with("input"));
        folders.extend(all.iter().flat_map(|folder| list(folder).unwrap_or_default()).filter(|path| path.is_dir()));
    }
    let files = folders.iter().flat_map(|folder| list(folder).unwrap_or_default());
    let unused = files.filter(|file| {
        let other = !used.contains(file.as_path()) && !beside.contains(file.as_path());
        other && kinds.contains(&kind(file)) && is_photograph(file) && file.is_file()
    });
    let (unused, folder) = (unused.count(), folders.first().filter(|_| folders.len() == 1));
    let folder = folder.map_or(root, PathBuf::as_path).display();
    let all = unused + used.len();
    (unused > 0)
        .then(|| format!("{unused} of {all} photographs in {folder} are in no view: the dataset has no pose of them"))
}
