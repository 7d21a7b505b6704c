//! `mask-embed masks`: id maps from photographs with SAM.

use crate::ahead::one_ahead;
use crate::automatic::{levels, propose};
use crate::finished::{self, Views};
use crate::options::{Choice, MasksArgs};
use crate::paint::{MapSize, paint};
use crate::photographs;
use crate::sam::{Embedded, Sam};
use artifacts::{LEVELS, Level, MaskMaps, maps_path, role};
use gs_io::{Claim, Result, Watched, write_json};
use gs_scene::dataset::{Dataset, View};
use onnx_models::RgbImage;
use serde::{Deserialize, Serialize};
use serde_json::json;
use stage::{Stage, peak_rss_bytes};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Facts of a view's id maps.
#[derive(Serialize, Deserialize)]
struct Facts {
    /// Width and height of the maps.
    size: [usize; 2],
    /// Masks of each level.
    masks: [usize; LEVELS],
    /// Points of the grid, and how many of them were asked.
    points: usize,
    asked: usize,
}

/// Masks of each level of a map.
pub(crate) fn count_masks(maps: &MaskMaps) -> [usize; LEVELS] {
    Level::ALL.map(|l| maps.level(l).iter().filter(|&&id| id >= 0).collect::<BTreeSet<_>>().len())
}

/// Makes the id maps of every view of a scene that are not done already, then the manifest.
pub(crate) fn run(args: &MasksArgs, stage: &Stage) -> Result<()> {
    let scene = photographs::open(&args.scene, stage)?;
    let folder = &args.out;
    let manifest = folder.join("masks.json");
    let mut claim = claim(args, &scene, &manifest, stage)?;
    let sam = Sam::open(&args.sam, &args.engine.options(), args.choice.no_skip)?;
    let watched = Watched::new(scene.views.iter().map(|v| &v.image_path));
    let parameters = json!(args);
    let inputs =
        BTreeMap::from([(role::DATASET.to_string(), scene.hash()?), ("sam".to_string(), sam.hash().to_string())]);
    warn_of_other_maps(folder, &scene.views, stage)?;

    let mut views = Views::new(stage, scene.views.len());
    let mut forecast_made = false;
    let prepare = |view| {
        let (image, image_hash) = photographs::read(view)?;
        let key = finished::made_from(&[&parameters.to_string(), sam.hash(), &image_hash]);
        let mut embedded = None;
        if !finished::is_done(&maps_path(folder, view.stem()), &key) {
            if !std::mem::replace(&mut forecast_made, true) {
                forecast(args, &sam, &scene.views, stage)?;
            }
            embedded = Some(sam.encode(&image)?);
        }
        Ok(Prepared { view, image, key, embedded })
    };
    let (mut asked, mut points, mut large) = (0, 0, 0);
    let finish = |Prepared { view, image, key, embedded }: Prepared| {
        let output = maps_path(folder, view.stem());
        let facts: Facts = views.next(view, &output, &key, || {
            let (maps, facts) = make(args, &sam, &image, embedded)?;
            finished::begin(&manifest, &output)?;
            maps.write(&output)?;
            Ok(facts)
        })?;
        asked += facts.asked;
        points += facts.points;
        large += facts.masks[Level::Large as usize];
        Ok(())
    };
    one_ahead(scene.views.iter(), prepare, finish)?;
    let views = views.finish("id maps");
    if asked < points {
        stage.skipped(&format!("{} of {points} points: within masks already found", points - asked));
    }
    watched.check()?;
    let mut provenance = stage.provenance("masks", 1, parameters.clone(), inputs.clone());
    let count = views.len();
    provenance.extra = json!({ "views": views });
    write_json(&manifest, &provenance)?;
    stage.record(&mut claim, parameters, inputs, json!({ "views": count, "masks_large": large }))
}

/// A photograph on its way to its id maps.
struct Prepared<'a> {
    view: &'a View,
    image: RgbImage,
    /// Hash of what its maps are made from.
    key: String,
    /// For SAM's decoder, where maps are to be made.
    embedded: Option<Embedded>,
}

/// The id maps of a photograph.
fn make(args: &MasksArgs, sam: &Sam, image: &RgbImage, embedded: Option<Embedded>) -> Result<(MaskMaps, Facts)> {
    let embedded = embedded.map_or_else(|| sam.encode(image), Ok)?;
    let proposals = propose(sam, &embedded, &args.choice)?;
    let size = MapSize::of(image, args.map_size, args.min_area);
    let maps = paint(&proposals, &levels(&proposals.masks), size);
    let (points, asked) = (proposals.points, proposals.asked);
    let facts = Facts { size: [size.width, size.height], masks: count_masks(&maps), points, asked };
    Ok((maps, facts))
}

/// The right to write id maps, their notes and the manifest. Maps that this program did not make stay.
fn claim(args: &MasksArgs, scene: &Dataset, manifest: &Path, stage: &Stage) -> Result<Claim> {
    let maps: Vec<PathBuf> = scene.views.iter().map(|v| maps_path(&args.out, v.stem())).collect();
    let notes = maps.iter().map(|m| finished::note_path(m));
    let outputs = stage.outputs(manifest).file(manifest).files(notes).files(&maps).reads(&scene.files).drop_stale();
    outputs.known_by(finished::is_own).claim()
}

/// Says how much memory the photographs will take. The models run on an empty picture first: their need is known only then.
fn forecast(args: &MasksArgs, sam: &Sam, views: &[View], stage: &Stage) -> Result<()> {
    let nothing = RgbImage { width: 4, height: 3, pixels: vec![0; 36] };
    // Twice: the decoder answers about one photograph while the next is encoded.
    let choice = Choice { points_per_side: 4, ..args.choice };
    one_ahead(0..2, |_| sam.encode(&nothing), |embedded| propose(sam, &embedded, &choice).map(drop))?;
    let (side, pixels) = (args.choice.points_per_side as u64, photographs::largest(views));
    let map = if args.map_size == 0 { pixels } else { pixels.min((args.map_size * args.map_size * 3 / 4) as u64) };
    // Of every third point of the grid or so that is asked three masks wait with their logits, 200 kB where one fills the
    // picture; then the map, 16 bytes a pixel, and the masks of a level, a byte for each pixel of their boxes.
    let waiting = 100_000 * (side * side * 3 / 4);
    let needed = peak_rss_bytes().unwrap_or(0) + waiting + 9 * pixels + 30 * map;
    stage.forecast(needed, "give fewer --threads, or smaller photographs (--resolution) and maps (--map-size)")
}

/// Warns of id maps of other views in the folder: later stages would take them for maps of this scene.
fn warn_of_other_maps(folder: &Path, views: &[View], stage: &Stage) -> Result<()> {
    let mut others = artifacts::stems(folder)?;
    others.retain(|s| views.iter().all(|v| v.stem() != s));
    if let Some(first) = others.first() {
        stage.warn(&format!(
            "{}: {} id maps of views that are not in the scene, such as {first}; delete them if they are old",
            folder.display(),
            others.len()
        ));
    }
    Ok(())
}
