//! The picture of each mask as CLIP sees it; `mask-embed crops`: all of them in one file, for training.

#![allow(rustdoc::invalid_html_tags, reason = "errors name files as <view>_s.npy")]

use crate::options::CropsArgs;
use crate::photographs;
use artifacts::{Level, MaskFolder, MaskMaps, MaskTruth, TrueScene, flat, hash_folder, maps_path, role};
use gs_io::{ArtifactWriter, Error, Result};
use gs_scene::dataset::View;
use onnx_models::{Bounds, Crop, LabelMap, RgbImage, Tokenizer, crop_mask, mask_bounds};
use rayon::prelude::*;
use serde_json::json;
use stage::Stage;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// Format name of the file of crops.
pub const CROPS_FORMAT: &str = "crops";

/// A mask that owns pixels: its id, the first level that it occurs at, and its box there.
pub(crate) type Owner = (usize, Level, Bounds);

fn label_map(maps: &MaskMaps, level: Level) -> LabelMap<'_> {
    LabelMap { width: maps.width(), height: maps.height(), ids: flat(maps.level(level)) }
}

/// Masks that own pixels, ids ascending.
pub(crate) fn owners(maps: &MaskMaps) -> Vec<Owner> {
    let count = maps.id_count();
    let mut found: Vec<Option<(Level, Bounds)>> = vec![None; count];
    for &level in maps.levels() {
        for (slot, bounds) in found.iter_mut().zip(mask_bounds(&label_map(maps, level), count)) {
            *slot = slot.or(bounds.map(|b| (level, b)));
        }
    }
    found.into_iter().enumerate().filter_map(|(id, f)| f.map(|(l, b)| (id, l, b))).collect()
}

/// Pictures of these masks of a view, in their order, and of each mask in the order of `crops`: `(id, picture)`.
pub(crate) fn cut(
    image: &RgbImage,
    maps: &MaskMaps,
    owners: &[Owner],
    size: usize,
    crops: &[Crop],
) -> Vec<(usize, Vec<u8>)> {
    let crops: Vec<(Crop, [u8; 3])> = crops.iter().map(|&crop| (crop, crop.fill(image))).collect();
    let pictures: Vec<(&Owner, (Crop, [u8; 3]))> =
        owners.iter().flat_map(|owner| crops.iter().map(move |&crop| (owner, crop))).collect();
    let picture = |&(&(id, level, bounds), (crop, fill)): &(&Owner, (Crop, [u8; 3]))| {
        (id, crop_mask(image, &label_map(maps, level), id as i32, bounds, size, crop, fill))
    };
    pictures.par_iter().map(picture).collect()
}

/// Reads the id maps of a view; `None` with a warning when there are none.
pub(crate) fn read_maps(folder: &Path, view: &View, stage: &Stage) -> Result<Option<MaskMaps>> {
    let path = maps_path(folder, view.stem());
    if !path.exists() {
        stage.warn(&format!("{}: no id maps of this view; it is left out", path.display()));
        return Ok(None);
    }
    MaskFolder::open(folder).read(view).map(Some)
}

pub(crate) fn no_maps(folder: &Path) -> Error {
    Error::new("no id maps of any view of the scene")
        .file(folder)
        .expected("<view>_s.npy, named after the photographs")
        .hint("run mask-embed masks or mask-embed import first")
}

/// Token ids, without marks of start and end, of every caption, name, class and coloured class of a synthetic scene, so that
/// training and queries share one tokenizer; none for another scene.
fn tokens(scene: &Path) -> Result<BTreeMap<String, Vec<i32>>> {
    let [things, masks] = ["scene.json", "masks.json"].map(|name| scene.join("truth").join(name));
    let mut texts = BTreeSet::new();
    if things.exists() {
        for object in TrueScene::read(things)?.objects {
            texts.insert(format!("{} {}", object.color, object.class).trim().to_string());
            texts.extend([object.name, object.class]);
        }
        texts.extend(MaskTruth::read_all(masks)?.into_values().flatten().map(|m| m.caption));
    }
    let tokenizer = Tokenizer::default();
    let ids = |text: &String| {
        let mut ids = tokenizer.encode(text, 77);
        ids.retain(|&i| i != Tokenizer::START && i != Tokenizer::END);
        ids
    };
    Ok(texts.into_iter().map(|text| (text.clone(), ids(&text))).collect())
}

/// Writes the crops of all masks of a scene into one file.
pub(crate) fn run(args: &CropsArgs, stage: &Stage) -> Result<()> {
    let (scene, folder) = (photographs::open(&args.scene, stage)?, &args.masks);
    let maps = artifacts::folder_files(folder, "_s.npy")?;
    let mut claim =
        stage.outputs(&args.out).artifact(&args.out, CROPS_FORMAT).reads(&scene.files).reads(maps).claim()?;
    let (mut pixels, mut view_of, mut mask_of, mut names) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let mut progress = stage.progress("views", scene.views.len() as u64);
    for view in &scene.views {
        let Some(maps) = read_maps(folder, view, stage)? else { continue };
        let (image, _) = photographs::read(view)?;
        for (id, crop) in cut(&image, &maps, &owners(&maps), args.size, &args.show.crop) {
            pixels.extend(crop);
            view_of.push(names.len() as u32);
            mask_of.push(id as u32);
        }
        names.push(view.stem().to_string());
        progress.step();
    }
    progress.finish(&[]);
    if names.is_empty() {
        return Err(no_maps(folder));
    }
    let parameters = json!(args);
    let inputs = BTreeMap::from([
        (role::DATASET.to_string(), scene.hash()?),
        (role::MASKS.to_string(), hash_folder(folder, "_s.npy")?),
    ]);
    let mut provenance = stage.provenance(CROPS_FORMAT, 1, parameters.clone(), inputs.clone());
    provenance.extra = json!({ "views": names, "tokens": tokens(&args.scene.scene)? });
    ArtifactWriter::new(provenance)
        .tensor("pixels", &[mask_of.len(), 3, args.size, args.size], &pixels)
        .tensor("view", &[mask_of.len()], &view_of)
        .tensor("mask", &[mask_of.len()], &mask_of)
        .write(&args.out)?;
    stage.record(&mut claim, parameters, inputs, json!({ "views": names.len(), "crops": mask_of.len() }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::arr3;

    #[test]
    fn every_mask_with_pixels_has_a_crop_whatever_its_level() {
        let crops = |image: &RgbImage, maps: &MaskMaps| cut(image, maps, &owners(maps), 2, &[Crop::Black]);
        // 2 x 1 map: default has mask 0 on the left; small none; medium mask 2 on both; large masks 2 (again) and 3.
        let maps = MaskMaps { ids: arr3(&[[[0, -1]], [[-1, -1]], [[2, 2]], [[2, 3]]]) };
        let image = RgbImage { width: 2, height: 1, pixels: vec![10, 10, 10, 200, 200, 200] };
        let all = crops(&image, &maps);
        assert_eq!(all.iter().map(|(id, _)| *id).collect::<Vec<_>>(), [0, 2, 3]);
        assert_eq!(all[0].1, [10; 12]);
        // Two pixels beside each other, black below (the odd row of padding).
        assert_eq!(all[1].1[..4], [10, 200, 0, 0]);
        assert_eq!(all[2].1, [200; 12]);
        let none = MaskMaps { ids: arr3(&[[[-1, -1]]; 4]) };
        assert!(crops(&image, &none).is_empty());
    }
}
