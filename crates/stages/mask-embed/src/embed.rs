//! `mask-embed embed`: CLIP features of the masks of existing id maps.

use crate::ahead::ahead;
use crate::crops::{Owner, cut, no_maps, owners, read_maps};
use crate::finished::{self, Views};
use crate::options::EmbedArgs;
use crate::photographs;
use artifacts::{Draft, MaskFeatures, MaskFolder, MaskMaps, features_path, hash_folder, maps_path, role};
use gs_io::{Claim, Error, Result, Watched, hash_bytes, hash_file, write_json};
use gs_scene::dataset::{Dataset, View};
use ndarray::{Array2, aview1};
use onnx_models::{ClipImage, ClipText, Crop, RgbImage};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use serde_json::json;
use stage::{Stage, peak_rss_bytes};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::{Path, PathBuf};

/// Pictures of a photograph that the forecast counts with: more are hardly ever in one.
const PICTURES: usize = 256;
/// By view (file stem), the masks that are wanted.
type Wanted = BTreeMap<String, BTreeSet<u32>>;

/// Facts of a view's features.
#[derive(Serialize, Deserialize)]
struct Facts {
    /// Rows of the file.
    masks: usize,
    /// Rows whose masks have pixels.
    features: usize,
    /// Distinct pictures among them, which is what CLIP was shown.
    pictures: usize,
    /// Hash of all that shaped the features.
    from: String,
    /// The masks that have a feature, where not all were asked for.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    only: Option<BTreeSet<u32>>,
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
    let wanted = args.only.as_ref().map(|draft| wanted(draft, folder, &scene)).transpose()?;
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
    let size = clip.size();
    // Views without a map are left out, and so are those of which no mask is wanted.
    let with_maps = scene.views.iter().filter(|view| wanted.as_ref().is_none_or(|w| w.contains_key(view.stem())));
    let prepare = |view| {
        let Some(maps) = read_maps(folder, view, stage)? else { return Ok(None) };
        let (image, image_hash) = photographs::read(view)?;
        let maps_hash = hash_file(maps_path(folder, view.stem()))?;
        let bent = if MaskFolder::open(folder).bends(view) { "\nundistorted" } else { "" };
        let from = [&parameters.to_string(), clip.hash(), &image_hash, &(maps_hash + bent)];
        let from = finished::made_from(&from.map(|part: &str| part));
        let output = features_path(out, view.stem());
        // Features that are there already stay, and are not made again.
        let there = finished::facts::<Facts>(&output).filter(|facts| facts.from == from);
        let only = wanted.as_ref().map(|wanted| &wanted[view.stem()]);
        let (only, mut owners) = match (only, &there) {
            (_, Some(Facts { only: None, .. })) => (None, Vec::new()),
            (Some(only), Some(Facts { only: Some(there), .. })) => (Some(only | there), owners(&maps)),
            (only, _) => (only.cloned(), owners(&maps)),
        };
        let kept = there.as_ref().and_then(|facts| facts.only.as_ref());
        owners.retain(|(id, ..)| {
            let among = |ids: Option<&BTreeSet<u32>>| ids.map(|ids| ids.contains(&(*id as u32)));
            among(only.as_ref()) != Some(false) && among(kept) != Some(true)
        });
        let shown = shown(&image, &maps, &owners, size, &args.show.crop);
        let masks = maps.id_count();
        Ok(Some(Prepared { view, output, from, only, there, masks, shown }))
    };
    let finish = |prepared: Option<Prepared>| {
        let Some(Prepared { view, output, from, only, there, masks: rows, shown }) = prepared else { return Ok(()) };
        let key = finished::made_from(&[&from, &json!(only).to_string()]);
        let facts: Facts = views.next(view, &output, &key, || {
            if !std::mem::replace(&mut forecast_made, true) {
                forecast(&clip, &scene.views, stage)?;
            }
            let mut values = features(&clip, &shown, rows, args.show.crop.len())?;
            let mut pictures = shown.count;
            if let Some(Facts { only: Some(kept), pictures: before, .. }) = there {
                let old = MaskFeatures::read(&output)?.values;
                kept.iter().for_each(|&id| values.row_mut(id as usize).assign(&old.row(id as usize)));
                pictures += before;
            }
            let features = values.rows().into_iter().filter(|r| r.iter().any(|&v| v != 0.0)).count();
            watched.check()?;
            finished::begin(&manifest, &output)?;
            MaskFeatures { values }.write(&output)?;
            Ok(Facts { masks: rows, features, pictures, from, only })
        })?;
        masks += facts.features;
        pictures += facts.pictures;
        Ok(())
    };
    ahead(&with_maps.collect::<Vec<_>>(), 1, prepare, finish)?;
    let views = views.finish("features");
    if views.is_empty() {
        match &wanted {
            Some(wanted) if wanted.is_empty() => stage.warn("no mask describes an instance: nothing is encoded"),
            _ => return Err(no_maps(folder)),
        }
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
    if let Some(draft) = &args.only {
        inputs.insert(Draft::FORMAT.to_string(), hash_file(draft)?);
    }
    inputs.extend(ClipText::hash_in(&args.clip).map(|text| (role::CLIP_TEXT.to_string(), text)));
    let mut provenance = stage.provenance("mask-features", 1, parameters.clone(), inputs.clone());
    let count = views.len();
    provenance.extra = json!({ "views": views });
    write_json(&manifest, &provenance)?;
    stage.record(&mut claim, parameters, inputs, json!({ "views": count, "masks": masks, "pictures": pictures }))
}

/// The masks that a draft of these masks and this scene wants.
///
/// # Errors
/// When the draft is damaged, or of others.
fn wanted(draft: &Path, folder: &Path, scene: &Dataset) -> Result<Wanted> {
    let (draft, file) = Draft::read(draft)?;
    file.expect_input(role::MASKS, &hash_folder(folder, "_s.npy")?)?;
    // Not the dataset's hash: stage 1 may have refined the cameras that the draft was made with.
    let stems: BTreeSet<&str> = scene.views.iter().map(View::stem).collect();
    if let Some(stem) = draft.wanted().into_keys().find(|stem| !stems.contains(stem)) {
        let e = Error::new("a view of the draft is not in the scene").file(file.path()).field("views").found(stem);
        return Err(e.hint("give the scene that the draft was made from"));
    }
    Ok(draft.wanted().into_iter().map(|(stem, masks)| (stem.to_string(), masks)).collect())
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
    let outputs = outputs.known_by(finished::is_own);
    outputs.reads(&scene.files).reads(maps).reads(&args.only).claim()
}

/// A photograph on its way to the features of its masks.
struct Prepared<'a> {
    view: &'a View,
    output: PathBuf,
    /// Hash of all that shapes the features.
    from: String,
    /// The masks that will have a feature; none for all.
    only: Option<BTreeSet<u32>>,
    /// What is known of features that are there already.
    there: Option<Facts>,
    /// Number of mask ids.
    masks: usize,
    shown: Shown,
}

/// What CLIP is shown of a photograph.
struct Shown {
    /// The distinct pictures, `[count][3][S][S]`: levels often hold the very same mask.
    pictures: Vec<u8>,
    count: usize,
    /// A mask and one of its pictures; all pictures of a mask follow each other.
    of: Vec<(usize, usize)>,
}

fn shown(image: &RgbImage, maps: &MaskMaps, owners: &[Owner], size: usize, crops: &[Crop]) -> Shown {
    let mut first: HashMap<String, usize> = HashMap::new();
    let (mut pictures, mut of) = (Vec::new(), Vec::new());
    for (id, picture) in cut(image, maps, owners, size, crops) {
        let next = first.len();
        let at = *first.entry(hash_bytes(&picture)).or_insert_with(|| {
            pictures.extend_from_slice(&picture);
            next
        });
        of.push((id, at));
    }
    Shown { pictures, count: first.len(), of }
}

/// Features `[masks][dimension]` of the masks that are shown, each in so many pictures; zeros of others.
fn features(clip: &ClipImage, shown: &Shown, masks: usize, crops: usize) -> Result<Array2<f32>> {
    let (dim, encoded) = (clip.dimension(), clip.encode(&shown.pictures)?);
    let mut values = Array2::zeros((masks, dim));
    for of_mask in shown.of.chunks(crops) {
        let features: Vec<&[f32]> = of_mask.iter().map(|&(_, p)| &encoded[p * dim..(p + 1) * dim]).collect();
        values.row_mut(of_mask[0].0).assign(&aview1(&unit_mean(&features)));
    }
    Ok(values)
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

/// Says how much memory the photographs will take, after one batch of empty pictures has shown what a thread takes. Those of
/// two photographs wait for the model, and the map of a photograph has as many pixels as itself at the most.
fn forecast(clip: &ClipImage, views: &[View], stage: &Stage) -> Result<()> {
    let (size, peak) = (clip.size(), || peak_rss_bytes().unwrap_or(0));
    let before = peak();
    clip.encode(&vec![0; ClipImage::BATCH * 3 * size * size])?;
    let threads = rayon::current_num_threads() as u64;
    let pictures = (6 * size * size * PICTURES) as u64;
    let needed = before + threads * (peak() - before) + pictures + 20 * photographs::largest(views);
    stage.forecast(needed, "give fewer --threads, or smaller photographs (--resolution)")
}
