//! `mask-embed masks`: id maps from photographs with SAM.

use crate::ahead::ahead;
use crate::automatic::{levels, propose};
use crate::classes::with_names;
use crate::concepts::Concepts;
use crate::finished::{self, Views};
use crate::options::{Choice, MasksArgs};
use crate::paint::{MapSize, paint};
use crate::panoptic::{Panoptic, Segments};
use crate::photographs;
use crate::sam::{Embedded, Sam};
use artifacts::{LEVELS, Level, MaskMaps, MaskNames, maps_path, role};
use gs_io::{Claim, Error, Result, Watched, write_json};
use gs_scene::dataset::{Dataset, View};
use onnx_models::RgbImage;
use query::Vocabulary;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use serde_json::json;
use stage::{Stage, peak_rss_bytes};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Photographs that are worked on at a time, where there are as many threads: each takes 280 MB with MobileSAM.
const LANES: usize = 8;

/// Facts of a view's id maps.
#[derive(Serialize, Deserialize)]
struct Facts {
    /// Width and height of the maps.
    size: [usize; 2],
    /// Masks of each level.
    masks: Vec<usize>,
    /// Points of the grid, and how many of them were asked.
    points: usize,
    asked: usize,
    /// What models call masks.
    #[serde(default, skip_serializing_if = "MaskNames::is_empty")]
    names: MaskNames,
}

/// A photograph as SAM's decoder wants it, and the segments of each panoptic model.
struct Seen {
    embedded: Embedded,
    classes: Vec<Segments>,
}

/// What sees the photographs.
struct Models {
    sam: Sam,
    /// One photograph at a time: a full-size DETR takes 3.4 GB.
    panoptic: Vec<Mutex<Panoptic>>,
    concepts: Vec<Mutex<Concepts>>,
}

/// The model that it guards, for one photograph at a time.
fn lock<T>(model: &Mutex<T>) -> MutexGuard<'_, T> {
    model.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Models {
    /// What SAM's encoder and the panoptic models see.
    fn look(&self, image: &RgbImage, size: MapSize) -> Result<Seen> {
        let segments = |model: &Mutex<Panoptic>| lock(model).segments(image, [size.width, size.height]);
        let classes = self.panoptic.iter().map(segments).collect::<Result<_>>()?;
        Ok(Seen { embedded: self.sam.encode(image)?, classes })
    }

    /// What each model sees that is asked for nouns, of the first `nouns`.
    fn ask(&self, image: &RgbImage, size: MapSize, nouns: usize) -> Result<Vec<Segments>> {
        let ask = |model: &Mutex<Concepts>| lock(model).segments(image, [size.width, size.height], nouns);
        self.concepts.iter().map(ask).collect()
    }

    /// Photographs at a time: with nouns, whose model takes longer than all else, it has all threads.
    fn lanes(&self) -> usize {
        if self.concepts.is_empty() { LANES } else { 1 }
    }

    /// Content hashes of both kinds, by what they are called among inputs: panoptic, panoptic-2, ...
    fn hashes(&self) -> Vec<(String, String)> {
        let panoptic = self.panoptic.iter().map(|model| lock(model).hash().to_string()).enumerate();
        let concepts = self.concepts.iter().map(|model| lock(model).hash().to_string()).enumerate();
        let all = panoptic.map(|model| ("panoptic", model)).chain(concepts.map(|model| ("concepts", model)));
        all.map(|(kind, (at, hash))| (if at == 0 { kind.into() } else { format!("{kind}-{}", at + 1) }, hash)).collect()
    }
}

/// Masks of each level of a map.
pub(crate) fn count_masks(maps: &MaskMaps) -> Vec<usize> {
    let of = |l: &Level| maps.level(*l).iter().filter(|&&id| id >= 0).collect::<BTreeSet<_>>().len();
    maps.levels().iter().map(of).collect()
}

/// Makes the id maps of every view of a scene that are not done already, then the manifest.
pub(crate) fn run(args: &MasksArgs, stage: &Stage) -> Result<()> {
    let scene = photographs::open(&args.scene, stage)?;
    let folder = &args.out;
    let manifest = folder.join("masks.json");
    let mut claim = claim(args, &scene, &manifest, stage)?;
    let models = open(args, stage)?;
    let watched = Watched::new(scene.views.iter().map(|v| &v.image_path));
    let parameters = json!(args);
    let mut inputs = BTreeMap::from([
        (role::DATASET.to_string(), scene.hash()?),
        ("sam".to_string(), models.sam.hash().to_string()),
    ]);
    let hashes = models.hashes();
    inputs.extend(hashes.clone());
    warn_of_other_maps(folder, &scene.views, stage)?;

    let mut views = Views::new(stage, scene.views.len());
    let read = |view: &View| {
        let (image, image_hash) = photographs::read(view)?;
        let mut parts = vec![parameters.to_string(), models.sam.hash().to_string(), image_hash];
        parts.extend(hashes.iter().map(|(_, hash)| hash.clone()));
        let key = finished::made_from(&parts.iter().map(String::as_str).collect::<Vec<_>>());
        let done = finished::is_done(&maps_path(folder, view.stem()), &key);
        Ok((image, key, done))
    };
    let todo = |view| read(view).ok().filter(|(.., done)| !done).map(|(image, key, _)| (image, key));
    let lanes = models.lanes().min(rayon::current_num_threads());
    let mut first = Vec::new();
    for some in scene.views.chunks(rayon::current_num_threads()) {
        if first.len() < lanes {
            first.par_extend(some.par_iter().filter_map(todo));
        }
    }
    first.truncate(lanes);
    let seen = Mutex::new(forecast(args, &models, &scene.views, first, stage)?);
    let prepare = |view| {
        let (image, key, done) = read(view)?;
        let seen = lock(&seen).remove(&key);
        Ok((view, key, if done { None } else { Some(make(args, &models, &image, seen)?) }))
    };
    let (mut asked, mut points, mut large) = (0, 0, 0);
    let finish = |(view, key, made): (&View, String, Option<(MaskMaps, Facts)>)| {
        let output = maps_path(folder, view.stem());
        let facts: Facts = views.next(view, &output, &key, || {
            let (maps, facts) = made.ok_or_else(|| Error::new("the id map changed during the run").file(&output))?;
            finished::begin(&manifest, &output)?;
            maps.write(&output)?;
            Ok(facts)
        })?;
        asked += facts.asked;
        points += facts.points;
        large += facts.masks[Level::LARGE.index()];
        Ok(())
    };
    ahead(&scene.views.iter().collect::<Vec<_>>(), models.lanes(), prepare, finish)?;
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

/// The models that see the photographs.
fn open(args: &MasksArgs, stage: &Stage) -> Result<Models> {
    let most = (LEVELS - Level::SAM.len()) / 2;
    for (option, models) in [("--panoptic", &args.panoptic), ("--concepts", &args.concepts)] {
        if models.len() > most {
            let e = Error::new("too many models").field(option).found(models.len());
            return Err(e.expected(format!("at most {most}")));
        }
    }
    let sam = Sam::open(&args.sam, &args.engine.options(), args.choice.no_skip)?;
    let panoptic = args.panoptic.iter().map(|folder| Ok(Mutex::new(Panoptic::open(folder, &args.engine.options())?)));
    Ok(Models { sam, panoptic: panoptic.collect::<Result<_>>()?, concepts: concepts(args, stage)? })
}

/// The id maps of a photograph, of which the models may have seen their part already.
fn make(args: &MasksArgs, models: &Models, image: &RgbImage, seen: Option<Seen>) -> Result<(MaskMaps, Facts)> {
    let size = MapSize::of(image, args.map_size, args.min_area);
    let Seen { embedded, classes } = seen.map_or_else(|| models.look(image, size), Ok)?;
    let proposals = propose(&models.sam, &embedded, &args.choice)?;
    drop(embedded);
    let (mut maps, mut names) = (paint(&proposals, &levels(&proposals.masks), size), MaskNames::new());
    let (points, asked) = (proposals.points, proposals.asked);
    drop(proposals);
    let concepts = models.ask(image, size, usize::MAX)?;
    if !classes.is_empty() || !concepts.is_empty() {
        (maps, names) = with_names(&maps, &classes, &concepts, size.min_area);
    }
    let facts = Facts { size: [size.width, size.height], masks: count_masks(&maps), points, asked, names };
    Ok((maps, facts))
}

/// The models that are asked for nouns.
fn concepts(args: &MasksArgs, stage: &Stage) -> Result<Vec<Mutex<Concepts>>> {
    if args.concepts.is_empty() {
        return Ok(Vec::new());
    }
    let nouns = args.nouns.as_ref().map_or_else(|| Ok(Vocabulary::everyday()), |file| Vocabulary::read(file, 1))?;
    if nouns.repeated > 0 {
        stage.warn(&format!("lines of --nouns that name something again are left out: {}", nouns.repeated));
    }
    stage.info(&format!("{} nouns are looked for in each photograph", nouns.words.len()));
    let open = |folder: &PathBuf| Ok(Mutex::new(Concepts::open(folder, &nouns.words, &args.engine.options())?));
    args.concepts.iter().map(open).collect()
}

/// The right to write id maps, their notes and the manifest. Maps that this program did not make stay.
fn claim(args: &MasksArgs, scene: &Dataset, manifest: &Path, stage: &Stage) -> Result<Claim> {
    let maps: Vec<PathBuf> = scene.views.iter().map(|v| maps_path(&args.out, v.stem())).collect();
    let notes = maps.iter().map(|m| finished::note_path(m));
    let outputs = stage.outputs(manifest).file(manifest).files(notes).files(&maps).reads(&scene.files).drop_stale();
    outputs.known_by(finished::is_own).claim()
}

/// Says how much memory the photographs will take. The models look at the `first` photographs, one in each lane, as their need is known
/// only then. What they saw is given back, by what the map will be made from, which each photograph comes with.
fn forecast(
    args: &MasksArgs,
    models: &Models,
    views: &[View],
    first: Vec<(RgbImage, String)>,
    stage: &Stage,
) -> Result<BTreeMap<String, Seen>> {
    let choice = Choice { points_per_side: 4, ..args.choice };
    let mut found = BTreeMap::new();
    if first.is_empty() {
        return Ok(found);
    }
    let look = |(image, key): &(RgbImage, String)| {
        let size = MapSize::of(image, args.map_size, args.min_area);
        let seen = models.look(image, size)?;
        drop(propose(&models.sam, &seen.embedded, &choice)?);
        models.ask(image, size, 1)?;
        Ok((key.clone(), seen))
    };
    ahead(&first.iter().collect::<Vec<_>>(), first.len(), look, |(key, seen)| {
        found.insert(key, seen);
        Ok(())
    })?;
    let (side, pixels) = (args.choice.points_per_side as u64, photographs::largest(views));
    let map = if args.map_size == 0 { pixels } else { pixels.min((args.map_size * args.map_size * 3 / 4) as u64) };
    // Of every third point of the grid or so that is asked three masks wait with their logits, 200 kB where one fills the
    // picture; then the map, 16 bytes a pixel and at most 32 more for each two levels with names, and the masks of a level, a byte for
    // each pixel of their boxes. What is larger than the first photographs takes 9 bytes a pixel more.
    let waiting = 100_000 * (side * side * 3 / 4);
    let more = 32 * models.panoptic.len().max(models.concepts.len()) as u64;
    let larger = pixels.saturating_sub(first.iter().map(|(i, _)| (i.width * i.height) as u64).max().unwrap_or(0));
    let needed = peak_rss_bytes().unwrap_or(0) + first.len() as u64 * (waiting + (30 + more) * map + 9 * larger);
    stage.forecast(needed, "give fewer --threads, or smaller photographs (--resolution) and maps (--map-size)")?;
    Ok(found)
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
