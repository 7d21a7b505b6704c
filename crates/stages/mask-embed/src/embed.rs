//! `mask-embed embed`: CLIP features of the masks of existing id maps; `mask-embed crops`: the pictures that CLIP sees.

use crate::args::{CropsArgs, EmbedArgs};
use crate::{finished, memory, photographs};
use artifacts::{Level, MaskFeatures, MaskMaps, features_path, hash_folder, maps_path, role};
use gs_io::{ArtifactWriter, Error, Result, Watched, hash_bytes, hash_file};
use gs_scene::dataset::View;
use onnx_models::{Bounds, ClipImage, ClipText, LabelMap, RgbImage, crop_mask, mask_bounds};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use serde_json::json;
use stage::Stage;
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};

/// Format name of the file of crops.
pub const CROPS_FORMAT: &str = "crops";

/// Masks whose pictures are made and encoded at a time: a whole number of the encoder's batches.
const AT_A_TIME: usize = 4 * ClipImage::BATCH;

/// Facts of a view's features.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
struct Facts {
    /// Rows of the file.
    masks: usize,
    /// Rows whose masks have pixels.
    features: usize,
    /// Distinct pictures among them, which is what CLIP is shown.
    pictures: usize,
}

/// A mask that owns pixels: its id, the first level that it occurs at, and its box there.
type Owner = (usize, Level, Bounds);

fn label_map(maps: &MaskMaps, level: Level) -> LabelMap<'_> {
    LabelMap { width: maps.width, height: maps.height, ids: maps.level(level) }
}

/// Masks that own pixels, ids ascending.
fn owners(maps: &MaskMaps) -> Vec<Owner> {
    let count = maps.id_count();
    let mut found: Vec<Option<(Level, Bounds)>> = vec![None; count];
    for level in Level::ALL {
        for (slot, bounds) in found.iter_mut().zip(mask_bounds(&label_map(maps, level), count)) {
            *slot = slot.or(bounds.map(|b| (level, b)));
        }
    }
    found.into_iter().enumerate().filter_map(|(id, f)| f.map(|(l, b)| (id, l, b))).collect()
}

/// Crops of these masks of a view, in their order: `(id, crop)`.
fn cut(image: &RgbImage, maps: &MaskMaps, owners: &[Owner], size: usize) -> Vec<(usize, Vec<u8>)> {
    let crop = |&(id, level, bounds): &Owner| (id, crop_mask(image, &label_map(maps, level), id as i32, bounds, size));
    owners.par_iter().map(crop).collect()
}

/// Crops of the masks that own pixels: `(id, crop)`, ids ascending. An id that occurs at several levels is taken from
/// the first.
pub fn crops(image: &RgbImage, maps: &MaskMaps, size: usize) -> Vec<(usize, Vec<u8>)> {
    cut(image, maps, &owners(maps), size)
}

/// Reads the id maps of a view; `None` with a warning when there are none.
fn read_maps(folder: &Path, view: &View, stage: &Stage) -> Result<Option<MaskMaps>> {
    let path = maps_path(folder, view.stem());
    if !path.exists() {
        stage.warn(&format!("{}: no id maps of this view; it is left out", path.display()));
        return Ok(None);
    }
    let maps = MaskMaps::read(&path)?;
    maps.expect_shape(view.camera.width, view.camera.height, &path)?;
    Ok(Some(maps))
}

/// Reads all id maps once, so that one that is damaged or of other photographs is found before the first is encoded.
fn check_maps(folder: &Path, views: &[View]) -> Result<()> {
    let fault = |v: &View| {
        let path = maps_path(folder, v.stem());
        let maps = path.exists().then(|| MaskMaps::read(&path))?;
        maps.and_then(|m| m.expect_shape(v.camera.width, v.camera.height, &path)).err()
    };
    views.par_iter().find_map_first(fault).map_or(Ok(()), Err)
}

fn no_maps(folder: &Path) -> Error {
    Error::new("no id maps of any view of the scene")
        .file(folder)
        .expected("<view>_s.npy, named after the photographs")
        .hint("run mask-embed masks or mask-embed import first")
}

/// Makes the features of every view's masks that do not stand already, then the manifest.
///
/// # Errors
/// When scene, id maps or model cannot be read, or the output cannot be written.
pub fn run(args: &EmbedArgs, stage: &Stage) -> Result<()> {
    let scene = photographs::open(&args.scene, stage)?;
    let out = args.out.as_ref().unwrap_or(&args.masks);
    let manifest = out.join("features.json");
    let maps = artifacts::folder_files(&args.masks, "_s.npy")?;
    let with_maps = scene.views.iter().map(View::stem).filter(|stem| maps_path(&args.masks, stem).exists());
    let features: Vec<PathBuf> = with_maps.map(|stem| features_path(out, stem)).collect();
    let notes = features.iter().map(|f| finished::note_path(f));
    // Features of maps that are gone would be taken for this run's.
    let outputs = stage.outputs(&manifest).file(&manifest).files(notes).files(&features).drop_stale();
    let mut claim = outputs.reads(&scene.files).reads(maps).claim()?;
    check_maps(&args.masks, &scene.views)?;
    let clip = ClipImage::open(&args.clip, &args.engine.options())?;
    let watched =
        Watched::new(scene.views.iter().map(|v| &v.image_path)).and(artifacts::watch_folder(&args.masks, "_s.npy")?);
    let engine = if args.engine.onnx_runtime.is_some() { "onnxruntime" } else { "rten" };
    let parameters = json!({
        "model": clip.config(), "image_size": clip.size(), "dimension": clip.dimension(),
        "resolution": args.scene.resolution.to_string(), "engine": engine,
    });
    let dataset_hash = scene.hash()?;

    let mut views = BTreeMap::new();
    let mut progress = stage.progress("views", scene.views.len() as u64);
    let (mut kept, mut masks, mut pictures, mut foretold) = (0, 0, 0, false);
    for view in &scene.views {
        if stage.interrupted() {
            return Err(Error::new(
                "interrupted; the views that are done stay, and the same command goes on with the next",
            ));
        }
        let Some(maps) = read_maps(&args.masks, view, stage)? else { continue };
        let (image, image_hash) = photographs::read(view)?;
        let maps_hash = hash_file(maps_path(&args.masks, view.stem()))?;
        let key = finished::made_from(&[&parameters.to_string(), clip.hash(), &image_hash, &maps_hash]);
        let output = features_path(out, view.stem());
        let note = if let Some(note) = finished::find::<Facts>(&output, &key) {
            kept += 1;
            note
        } else {
            if !std::mem::replace(&mut foretold, true) {
                foretell(&clip, &scene.views, stage)?;
            }
            let (features, pictures) = embed(&clip, &image, &maps)?;
            let shown = features.values.chunks(features.dim).filter(|r| r.iter().any(|&v| v != 0.0)).count();
            let facts = Facts { masks: features.count, features: shown, pictures };
            watched.check()?;
            finished::remove_manifest(&manifest)?;
            features.write(&output)?;
            finished::write(&output, &key, facts)?
        };
        masks += note.facts.features;
        pictures += note.facts.pictures;
        views.insert(view.stem().to_string(), json!({ "hash": note.hash, "facts": note.facts }));
        progress.step();
    }
    progress.finish(&[]);
    if views.is_empty() {
        return Err(no_maps(&args.masks));
    }
    if kept > 0 {
        stage.skipped(&format!("{kept} of {} views: their features stand already", views.len()));
    }
    if pictures < masks {
        stage.skipped(&format!("{} of {masks} masks: the same pictures as masks of other levels", masks - pictures));
    }
    watched.check()?;
    let mut inputs = BTreeMap::from([
        (role::DATASET.to_string(), dataset_hash),
        (role::MASKS.to_string(), hash_folder(&args.masks, "_s.npy")?),
        (role::CLIP.to_string(), clip.hash().to_string()),
    ]);
    inputs.extend(ClipText::hash_in(&args.clip).map(|text| (role::CLIP_TEXT.to_string(), text)));
    let mut provenance = stage.provenance("mask-features", 1, parameters.clone(), inputs.clone());
    provenance.extra = json!({ "views": views });
    finished::write_json(&manifest, &provenance)?;
    stage.record(&mut claim, parameters, inputs, json!({ "views": views.len(), "masks": masks, "pictures": pictures }))
}

/// Features of all masks, and how many different pictures they come from. Levels often hold the very same mask, which is
/// then encoded once. Pictures are made and encoded [`AT_A_TIME`], so that memory does not grow with the masks.
fn embed(clip: &ClipImage, image: &RgbImage, maps: &MaskMaps) -> Result<(MaskFeatures, usize)> {
    let (dim, side) = (clip.dimension(), 3 * clip.size() * clip.size());
    let mut first: HashMap<String, usize> = HashMap::new();
    let mut picture_of: Vec<(usize, usize)> = Vec::new();
    let (mut waiting, mut encoded): (Vec<u8>, Vec<f32>) = (Vec::new(), Vec::new());
    for owners in owners(maps).chunks(AT_A_TIME) {
        for (id, crop) in cut(image, maps, owners, clip.size()) {
            let next = first.len();
            picture_of.push((
                id,
                *first.entry(hash_bytes(&crop)).or_insert_with(|| {
                    waiting.extend_from_slice(&crop);
                    next
                }),
            ));
        }
        // Whole pieces only: the batches are those that all pictures at once would be encoded in.
        let ready = waiting.len() / (AT_A_TIME * side) * (AT_A_TIME * side);
        encoded.extend(clip.encode(&waiting[..ready])?);
        waiting.drain(..ready);
    }
    encoded.extend(clip.encode(&waiting)?);
    let mut values = vec![0f32; maps.id_count() * dim];
    for (id, picture) in picture_of {
        values[id * dim..(id + 1) * dim].copy_from_slice(&encoded[picture * dim..(picture + 1) * dim]);
    }
    Ok((MaskFeatures { count: maps.id_count(), dim, values }, first.len()))
}

/// Says how much memory the photographs will take, and refuses more than there may be.
fn foretell(clip: &ClipImage, views: &[View], stage: &Stage) -> Result<()> {
    let size = clip.size();
    clip.encode(&vec![0; ClipImage::BATCH * rayon::current_num_threads() * 3 * size * size])?;
    let pixels = memory::largest(views);
    let needed = memory::of_features(memory::so_far(), AT_A_TIME as u64, size as u64, pixels);
    stage.forecast(needed, "give fewer --threads, or smaller photographs (--resolution)")
}

/// Writes the crops of all masks of a scene into one file.
///
/// # Errors
/// When scene or id maps cannot be read, or the output cannot be written.
pub fn write_crops(args: &CropsArgs, stage: &Stage) -> Result<()> {
    let scene = photographs::open(&args.scene, stage)?;
    let maps = artifacts::folder_files(&args.masks, "_s.npy")?;
    let mut claim =
        stage.outputs(&args.out).artifact(&args.out, CROPS_FORMAT).reads(&scene.files).reads(maps).claim()?;
    let size = usize::from(args.size);
    let (mut pixels, mut view_of, mut mask_of, mut names) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let mut progress = stage.progress("views", scene.views.len() as u64);
    for view in &scene.views {
        let Some(maps) = read_maps(&args.masks, view, stage)? else { continue };
        let (image, _) = photographs::read(view)?;
        for (id, crop) in crops(&image, &maps, size) {
            pixels.extend(crop);
            view_of.push(names.len() as u32);
            mask_of.push(id as u32);
        }
        names.push(view.stem().to_string());
        progress.step();
    }
    progress.finish(&[]);
    if names.is_empty() {
        return Err(no_maps(&args.masks));
    }
    let parameters = json!({ "size": size, "resolution": args.scene.resolution.to_string() });
    let inputs = BTreeMap::from([
        (role::DATASET.to_string(), scene.hash()?),
        (role::MASKS.to_string(), hash_folder(&args.masks, "_s.npy")?),
    ]);
    let mut provenance = stage.provenance(CROPS_FORMAT, 1, parameters.clone(), inputs.clone());
    provenance.extra = json!({ "views": names });
    ArtifactWriter::new(provenance)
        .tensor("pixels", &[mask_of.len(), 3, size, size], &pixels)
        .tensor("view", &[mask_of.len()], &view_of)
        .tensor("mask", &[mask_of.len()], &mask_of)
        .write(&args.out)?;
    stage.record(&mut claim, parameters, inputs, json!({ "views": names.len(), "crops": mask_of.len() }))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_mask_with_pixels_has_a_crop_whatever_its_level() {
        // 2 x 1 map: default has mask 0 on the left; small none; medium mask 2 on both; large masks 2 (again) and 3.
        let maps = MaskMaps { width: 2, height: 1, ids: vec![0, -1, -1, -1, 2, 2, 2, 3] };
        let image = RgbImage { width: 2, height: 1, pixels: vec![10, 10, 10, 200, 200, 200] };
        let all = crops(&image, &maps, 2);
        assert_eq!(all.iter().map(|(id, _)| *id).collect::<Vec<_>>(), [0, 2, 3]);
        assert_eq!(all[0].1, [10; 12]);
        // Two pixels beside each other, black below (the odd row of padding).
        assert_eq!(all[1].1[..4], [10, 200, 0, 0]);
        assert_eq!(all[2].1, [200; 12]);
        let none = MaskMaps { width: 2, height: 1, ids: vec![-1; 8] };
        assert!(crops(&image, &none, 2).is_empty());
    }
}
