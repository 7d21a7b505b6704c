//! `mask-embed import`: id maps from label pictures.

use crate::masks::count_masks;
use crate::options::ImportArgs;
use crate::{finished, memory};
use artifacts::{LEVELS, Level, MaskMaps, hash_folder, maps_path};
use gs_io::{Error, IoContext, Result, hash_files};
use image::DynamicImage;
use serde_json::json;
use stage::Stage;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Labels of a picture, 0 for none.
struct Labels {
    width: usize,
    height: usize,
    values: Vec<u16>,
}

fn read(path: &Path) -> Result<Labels> {
    let bytes = std::fs::read(path).at("read", path)?;
    if image::guess_format(&bytes).ok() != Some(image::ImageFormat::Png) {
        return Err(Error::new("not a readable PNG").file(path).hint("make or copy it again"));
    }
    let picture = gs_scene::decode_image(&bytes, path)?;
    let (width, height) = (picture.width() as usize, picture.height() as usize);
    let values = match picture {
        DynamicImage::ImageLuma8(p) => p.into_raw().into_iter().map(u16::from).collect(),
        DynamicImage::ImageLuma16(p) => p.into_raw(),
        other => {
            return Err(Error::new("labels in colour")
                .file(path)
                .found(format!("{:?}", other.color()))
                .expected("8 or 16 bits of grey")
                .hint("save the label numbers themselves, without a palette"));
        }
    };
    Ok(Labels { width, height, values })
}

/// Id maps of four pictures of labels, which count for themselves: ids by ascending label, from level to level.
fn number(levels: [&Labels; LEVELS]) -> MaskMaps {
    let mut ids = Vec::with_capacity(LEVELS * levels[0].values.len());
    let mut first = 0;
    for labels in levels {
        let distinct: BTreeSet<u16> = labels.values.iter().copied().filter(|&l| l > 0).collect();
        let id_of: BTreeMap<u16, i32> = distinct.into_iter().zip(first..).collect();
        ids.extend(labels.values.iter().map(|l| id_of.get(l).copied().unwrap_or(-1)));
        first += id_of.len() as i32;
    }
    MaskMaps { width: levels[0].width, height: levels[0].height, ids }
}

/// Pictures by view: the one for all levels, or one for each.
fn find(folder: &Path) -> Result<BTreeMap<String, Vec<PathBuf>>> {
    let mut names = BTreeSet::new();
    for entry in std::fs::read_dir(folder).at("list", folder)? {
        let name = entry.at("list", folder)?.file_name().to_string_lossy().into_owned();
        if let Some(stem) = name.strip_suffix(".png") {
            names.insert(stem.to_string());
        }
    }
    let mut views: BTreeMap<String, Vec<PathBuf>> = BTreeMap::new();
    for name in &names {
        let level = Level::ALL.iter().find_map(|l| name.strip_suffix(&format!("_{l}")));
        let view = level.unwrap_or(name);
        let all = Level::ALL.map(|l| folder.join(format!("{view}_{l}.png")));
        if level.is_none() {
            if all.iter().any(|p| p.exists()) {
                return Err(Error::new("labels for all levels and for single ones")
                    .file(folder)
                    .field(view)
                    .expected("one picture, or one for each level")
                    .hint("delete what is not meant"));
            }
            views.insert(view.to_string(), vec![folder.join(format!("{name}.png"))]);
        } else if !views.contains_key(view) {
            if let Some(missing) = all.iter().find(|p| !p.exists()) {
                return Err(Error::new("the labels of a level are missing")
                    .file(missing)
                    .hint(format!("give all four levels of {view}, or one {view}.png")));
            }
            views.insert(view.to_string(), all.to_vec());
        }
    }
    if views.is_empty() {
        return Err(Error::new("no label pictures").file(folder).expected("<view>.png, named after the photographs"));
    }
    Ok(views)
}

/// The id maps of one view.
fn load(paths: &[PathBuf]) -> Result<MaskMaps> {
    let labels = paths.iter().map(|p| read(p)).collect::<Result<Vec<Labels>>>()?;
    for (l, path) in labels.iter().zip(paths) {
        if (l.width, l.height) != (labels[0].width, labels[0].height) {
            return Err(Error::new("the levels of a view differ in size")
                .file(path)
                .found(format!("{} x {}", l.width, l.height))
                .expected(format!("{} x {}, as the first", labels[0].width, labels[0].height)));
        }
    }
    let of = |level: usize| labels.get(level).unwrap_or(&labels[0]);
    Ok(number([of(0), of(1), of(2), of(3)]))
}

/// Turns label pictures into id maps, then writes the manifest. Nothing is written before all pictures have been read
/// once.
///
/// # Errors
/// When a picture cannot be read or is not grey, the levels of a view differ in size, or the output cannot be written.
pub(crate) fn run(args: &ImportArgs, stage: &Stage) -> Result<()> {
    let found = find(&args.labels)?;
    let folder = &args.maps.out;
    let manifest = folder.join("masks.json");
    let maps = found.keys().map(|view| maps_path(folder, view));
    let outputs = stage.outputs(&manifest).file(&manifest).files(maps).drop_stale();
    let mut claim = outputs.reads(found.values().flatten()).claim()?;
    // A file whose size cannot be told is refused below.
    let sizes = found.values().flatten().filter_map(|p| image::image_dimensions(p).ok());
    let pixels = sizes.map(|(w, h)| u64::from(w) * u64::from(h)).max().unwrap_or(0);
    let levels = found.values().map(Vec::len).max().unwrap_or(0) as u64;
    stage.forecast(memory::of_import(memory::so_far(), pixels, levels), "give smaller pictures")?;
    let mut views = BTreeMap::new();
    for (view, paths) in &found {
        let maps = load(paths)?;
        let masks = count_masks(&maps);
        if masks.iter().all(|&n| n == 0) {
            stage.warn(&format!("{}: no label but 0", paths[0].display()));
        }
        views.insert(view.clone(), json!({ "size": [maps.width, maps.height], "masks": masks }));
    }
    finished::remove_manifest(&manifest)?;
    let mut progress = stage.progress("views", found.len() as u64);
    for (view, paths) in &found {
        load(paths)?.write(maps_path(folder, view))?;
        progress.step();
    }
    progress.finish(&[]);
    let files = found.values().flatten().map(|p| (p.file_name().unwrap_or_default().to_string_lossy(), p));
    let inputs = BTreeMap::from([("labels".to_string(), hash_files(files)?)]);
    let mut provenance = stage.provenance("masks", 1, json!({}), inputs.clone());
    provenance.extra = json!({ "views": views, "hash": hash_folder(folder, "_s.npy")? });
    finished::write_json(&manifest, &provenance)?;
    stage.record(&mut claim, json!({}), inputs, json!({ "views": views.len() }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_become_ids_that_count_on() {
        let l = |values: Vec<u16>| Labels { width: 3, height: 1, values };
        let (a, b) = (l(vec![500, 0, 7]), l(vec![0, 9, 9]));
        let m = number([&a, &b, &l(vec![0, 0, 0]), &a]);
        assert_eq!(m.ids, [1, -1, 0, -1, 2, 2, -1, -1, -1, 4, -1, 3]);
        assert_eq!(m.id_count(), 5);
    }
}
