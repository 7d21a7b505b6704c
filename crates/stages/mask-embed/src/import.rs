//! `mask-embed import`: id maps from label pictures.

use crate::finished;
use crate::masks::count_masks;
use crate::options::ImportArgs;
use artifacts::{Level, MaskMaps, hash_folder, maps_path};
use gs_io::{Error, IoContext, Result, hash_files, write_json};
use image::DynamicImage;
use ndarray::Array3;
use serde_json::json;
use stage::{Stage, peak_rss_bytes};
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

/// Pictures by view: the one for all levels, or one for each.
fn find(folder: &Path) -> Result<BTreeMap<String, Vec<PathBuf>>> {
    let mut views: BTreeMap<String, Vec<PathBuf>> = BTreeMap::new();
    for picture in artifacts::folder_files(folder, ".png")? {
        let name = picture.file_stem().unwrap_or_default().to_string_lossy();
        let level = Level::SAM.iter().find_map(|l| name.strip_suffix(&format!("_{l}")));
        let view = level.unwrap_or(&name);
        let all = Level::SAM.map(|l| folder.join(format!("{view}_{l}.png")));
        if level.is_none() {
            if all.iter().any(|p| p.exists()) {
                return Err(Error::new("labels for all levels and for single ones")
                    .file(folder)
                    .field(view)
                    .expected("one picture, or one for each level")
                    .hint("delete what is not meant"));
            }
            views.insert(view.to_string(), vec![picture]);
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

/// The id maps of one view: ids by ascending label, counting on from level to level.
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
    let Labels { width, height, .. } = labels[0];
    let (mut ids, mut first) = (Vec::with_capacity(Level::SAM.len() * width * height), 0);
    for Labels { values, .. } in labels.iter().cycle().take(Level::SAM.len()) {
        let distinct: BTreeSet<u16> = values.iter().copied().filter(|&l| l > 0).collect();
        let id_of: BTreeMap<u16, i32> = distinct.into_iter().zip(first..).collect();
        ids.extend(values.iter().map(|l| id_of.get(l).copied().unwrap_or(-1)));
        first += id_of.len() as i32;
    }
    Ok(MaskMaps { ids: Array3::from_shape_vec((Level::SAM.len(), height, width), ids).expect("four pictures") })
}

/// Turns label pictures into id maps, then writes the manifest. Nothing is written before all pictures have been read
/// once.
pub(crate) fn run(args: &ImportArgs, stage: &Stage) -> Result<()> {
    let found = find(&args.labels)?;
    let folder = &args.out;
    let manifest = folder.join("masks.json");
    let maps = found.keys().map(|view| maps_path(folder, view));
    let outputs = stage.outputs(&manifest).file(&manifest).files(maps).drop_stale();
    let mut claim = outputs.reads(found.values().flatten()).claim()?;
    // A file whose size cannot be told is refused below.
    let sizes = found.values().flatten().filter_map(|p| image::image_dimensions(p).ok());
    let pixels = sizes.map(|(w, h)| u64::from(w) * u64::from(h)).max().unwrap_or(0);
    let levels = found.values().map(Vec::len).max().unwrap_or(0) as u64;
    stage.forecast(peak_rss_bytes().unwrap_or(0) + (30 + 3 * levels) * pixels, "give smaller pictures")?;
    let mut views = BTreeMap::new();
    for (view, paths) in &found {
        let maps = load(paths)?;
        let masks = count_masks(&maps);
        if masks.iter().all(|&n| n == 0) {
            stage.warn(&format!("{}: no label but 0", paths[0].display()));
        }
        views.insert(view.clone(), json!({ "size": [maps.width(), maps.height()], "masks": masks }));
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
    write_json(&manifest, &provenance)?;
    stage.record(&mut claim, json!({}), inputs, json!({ "views": views.len() }))
}
