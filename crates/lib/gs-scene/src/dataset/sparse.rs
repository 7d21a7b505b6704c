//! A COLMAP sparse model beside its photographs.

use super::{Format, RawDataset, RawView, check_inside};
use crate::colmap;
use gs_io::Result;
use std::path::Path;

/// Loads the model in folder `model` of the scene `root`; photographs lie in `images`, `input`, or the scene itself.
pub(super) fn load(root: &Path, model: &Path) -> Result<RawDataset> {
    let colmap::Model { cameras, images, points } = colmap::read_model(model)?;
    let folder = ["images", "input"].iter().map(|d| root.join(d)).find(|d| d.is_dir());
    let folder = folder.unwrap_or_else(|| root.to_path_buf());
    let mut warnings = Vec::new();
    let mut views = Vec::new();
    for image in images {
        check_inside(&image.name, "images").map_err(|e| e.file(model))?;
        let image_path = folder.join(&image.name);
        if !image_path.is_file() {
            warnings.push(format!("{}: no such photograph, view skipped", image_path.display()));
            continue;
        }
        views.push(RawView {
            name: image.name,
            image_path,
            lens: cameras[&image.camera],
            rotation: image.rotation,
            translation: image.translation,
            split: None,
        });
    }
    Ok(RawDataset { format: Format::Colmap, files: colmap::files_of(model), views, points, warnings })
}
