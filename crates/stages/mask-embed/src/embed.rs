//! `mask-embed embed`: CLIP features of the masks of existing id maps.

use crate::crops::{cut, no_maps, owners, read_maps};
use crate::finished::{self, Views};
use crate::options::EmbedArgs;
use crate::photographs;
use artifacts::{MaskFeatures, MaskFolder, MaskMaps, features_path, hash_folder, maps_path, role};
use gs_io::{Claim, Result, Watched, hash_bytes, hash_file, write_json};
use gs_scene::dataset::{Dataset, View};
use ndarray::{Array2, aview1};
use onnx_models::{ClipImage, ClipText, Crop, RgbImage};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use serde_json::json;
use stage::{Stage, peak_rss_bytes};
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};

/// Masks whose pictures are made and encoded at a time: a whole number of the encoder's batches.
const AT_A_TIME: usize = 4 * ClipImage::BATCH;

/// Facts of a view's features.
#[derive(Serialize, Deserialize)]
struct Facts {
    /// Rows of the file.
    masks: usize,
    /// Rows whose masks have pixels.
    features: usize,
    /// Distinct pictures among them, which is what CLIP is shown.
    pictures: usize,
}

/// Reads all id maps once, so that one that is damaged or of other photographs is found before the first is encoded.
fn check_maps(folder: &Path, views: &[View]) -> Result<()> {
    let there = |v: &&View| maps_path(folder, v.stem()).exists();
    let fault = |v: &View| Some(v).filter(there).and_then(|v| MaskFolder::open(folder).read(v).err());
    views.par_iter().find_map_first(fault).map_or(Ok(()), Err)
}

/// Makes the features of every view's masks that are not done already, then the manifest.
pub(crate) fn run(args: &EmbedArgs, stage: &Stage) -> Result<()> {
    let (scene, folder) = (photographs::open(&args.scene, stage)?, &args.masks);
    let out = args.out.as_ref().unwrap_or(folder);
    let manifest = out.join("features.json");
    let mut claim = claim(args, &scene, out, &manifest, stage)?;
    check_maps(folder, &scene.views)?;
    let clip = ClipImage::open(&args.clip, &args.engine.options())?;
    let watched =
        Watched::new(scene.views.iter().map(|v| &v.image_path)).and(artifacts::watch_folder(folder, "_s.npy")?);
    let mut parameters = json!(args);
    parameters["model"] = json!(clip.config());
    parameters["image_size"] = clip.size().into();
    parameters["dimension"] = clip.dimension().into();
    let dataset_hash = scene.hash()?;

    let mut views = Views::new(stage, scene.views.len());
    let (mut masks, mut pictures, mut forecast_made) = (0, 0, false);
    for view in &scene.views {
        let Some(maps) = read_maps(folder, view, stage)? else { continue };
        let (image, image_hash) = photographs::read(view)?;
        let maps_hash = hash_file(maps_path(folder, view.stem()))?;
        let bent = if MaskFolder::open(folder).bends(view) { "\nundistorted" } else { "" };
        let key = finished::made_from(&[&parameters.to_string(), clip.hash(), &image_hash, &(maps_hash + bent)]);
        let output = features_path(out, view.stem());
        let facts: Facts = views.next(view, &output, &key, || {
            if !std::mem::replace(&mut forecast_made, true) {
                forecast(&clip, &scene.views, stage)?;
            }
            let (features, pictures) = embed(&clip, &image, &maps, &args.show.crop)?;
            let shown = features.values.rows().into_iter().filter(|r| r.iter().any(|&v| v != 0.0)).count();
            watched.check()?;
            finished::remove_manifest(&manifest)?;
            features.write(&output)?;
            Ok(Facts { masks: features.values.nrows(), features: shown, pictures })
        })?;
        masks += facts.features;
        pictures += facts.pictures;
    }
    let views = views.finish("features");
    if views.is_empty() {
        return Err(no_maps(folder));
    }
    let shown = masks * args.show.crop.len();
    if pictures < shown {
        stage.skipped(&format!("{} of {shown} pictures: the same as of masks of other levels", shown - pictures));
    }
    watched.check()?;
    let mut inputs = BTreeMap::from([
        (role::DATASET.to_string(), dataset_hash),
        (role::MASKS.to_string(), hash_folder(folder, "_s.npy")?),
        (role::CLIP.to_string(), clip.hash().to_string()),
    ]);
    inputs.extend(ClipText::hash_in(&args.clip).map(|text| (role::CLIP_TEXT.to_string(), text)));
    let mut provenance = stage.provenance("mask-features", 1, parameters.clone(), inputs.clone());
    let count = views.len();
    provenance.extra = json!({ "views": views });
    write_json(&manifest, &provenance)?;
    stage.record(&mut claim, parameters, inputs, json!({ "views": count, "masks": masks, "pictures": pictures }))
}

/// The right to write features, their notes and the manifest.
fn claim(args: &EmbedArgs, scene: &Dataset, out: &Path, manifest: &Path, stage: &Stage) -> Result<Claim> {
    let folder = &args.masks;
    let maps = artifacts::folder_files(folder, "_s.npy")?;
    let with_maps = scene.views.iter().map(View::stem).filter(|stem| maps_path(folder, stem).exists());
    let features: Vec<PathBuf> = with_maps.map(|stem| features_path(out, stem)).collect();
    let notes = features.iter().map(|f| finished::note_path(f));
    // Features of maps that are gone would be taken for this run's.
    let outputs = stage.outputs(manifest).file(manifest).files(notes).files(&features).drop_stale();
    outputs.reads(&scene.files).reads(maps).claim()
}

/// Features of all masks, and how many different pictures they come from. Levels often hold the very same mask, which is
/// then encoded once. Pictures are made and encoded [`AT_A_TIME`], so that memory does not grow with the masks.
fn embed(clip: &ClipImage, image: &RgbImage, maps: &MaskMaps, crops: &[Crop]) -> Result<(MaskFeatures, usize)> {
    let (dim, side) = (clip.dimension(), 3 * clip.size() * clip.size());
    let mut first: HashMap<String, usize> = HashMap::new();
    let mut picture_of: Vec<(usize, usize)> = Vec::new();
    let (mut waiting, mut encoded): (Vec<u8>, Vec<f32>) = (Vec::new(), Vec::new());
    for owners in owners(maps).chunks((AT_A_TIME / crops.len()).max(1)) {
        for (id, crop) in cut(image, maps, owners, clip.size(), crops) {
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
    let mut values = Array2::zeros((maps.id_count(), dim));
    for of_mask in picture_of.chunks(crops.len()) {
        let features: Vec<&[f32]> = of_mask.iter().map(|&(_, p)| &encoded[p * dim..(p + 1) * dim]).collect();
        values.row_mut(of_mask[0].0).assign(&aview1(&unit_mean(&features)));
    }
    Ok((MaskFeatures { values }, first.len()))
}

/// The mean of features, scaled to unit length; one alone as it is.
fn unit_mean(features: &[&[f32]]) -> Vec<f32> {
    if let [one] = features {
        return one.to_vec();
    }
    let mut sum = vec![0.0; features[0].len()];
    features.iter().for_each(|f| sum.iter_mut().zip(*f).for_each(|(s, &v)| *s += f64::from(v)));
    let norm = sum.iter().map(|v| v * v).sum::<f64>().sqrt();
    sum.into_iter().map(|v| if norm > 0.0 { (v / norm) as f32 } else { 0.0 }).collect()
}

/// Says how much memory the photographs will take, after a full batch of empty pictures has shown what the model takes.
/// [`AT_A_TIME`] pictures wait for it, and the map of a photograph has as many pixels as itself at the most.
fn forecast(clip: &ClipImage, views: &[View], stage: &Stage) -> Result<()> {
    let size = clip.size();
    clip.encode(&vec![0; ClipImage::BATCH * rayon::current_num_threads() * 3 * size * size])?;
    let needed =
        peak_rss_bytes().unwrap_or(0) + (6 * size * size * AT_A_TIME) as u64 + 20 * photographs::largest(views);
    stage.forecast(needed, "give fewer --threads, or smaller photographs (--resolution)")
}
