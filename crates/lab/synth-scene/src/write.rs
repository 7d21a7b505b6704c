//! The program told from beginning to end: furnish a room, photograph it, write all of it.

use crate::options::Args;
pub use crate::options::Options;
use crate::render::light::LightMap;
use crate::render::{self, Frame};
use crate::scene::{Family, Scene, cameras, families};
use crate::truth::benchmark::{FOLDERS, Layout};
use crate::truth::language::{Language, Speech};
use crate::truth::named::{self, Named};
use crate::truth::points::Collector;
use crate::truth::regions::Pairs;
use crate::truth::{label, masks, scannet, write_json};
use artifacts::{MaskTruth, TrueObject, TruePart, TruePoints, TrueScene, features_path, maps_path};
use gs_io::{IoContext, Outputs, Result, npy};
use gs_scene::{Camera, Image, PointCloud, colmap};
use ndarray::ArrayView2;
use query::Unrelated;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde_json::{Value, json};
use stage::{CommonArgs, Program, Stage};
use std::collections::BTreeMap;
use std::path::Path;

/// Standard deviation of the sparse cloud's points in metres.
const POINT_NOISE: f64 = 0.003;
/// Photographs of at least this many rows show the finest shadows.
const FINE_HEIGHT: f64 = 360.0;
/// Name of the table of text features.
const TABLE: &str = "text_features.json";
/// Streams of the random generator, so that more views do not move the furniture.
const LAYOUT: u64 = 0;
const CAMERAS: u64 = 1;
const POINTS: u64 = 2;
const POSES: u64 = 3;
const VERTICES: u64 = 4;
const SPEECH: u64 = 5;
const FIRST_VIEW: u64 = 16;
const FIRST_SPEECH: u64 = 1 << 32;
const FIRST_PATCHES: u64 = 2 << 32;
const FIRST_PAIRS: u64 = 1 << 48;

impl Program for Args {
    const NAME: &'static str = "synth-scene";

    fn common(&self) -> &CommonArgs {
        &self.common
    }

    fn check(&self) -> Result<()> {
        self.options(self.common.seed).map(drop)
    }

    fn run(self, stage: &Stage) -> Result<()> {
        let options = self.options(stage.seed())?;
        match (&self.out, &self.masks_to) {
            (Some(out), None) => run(stage, out, &options),
            (_, folder) => run_masks(stage, folder.as_deref().expect("one of the two"), &options),
        }
    }
}

impl Options {
    /// A generator of one of the streams.
    fn rng(&self, stream: u64) -> ChaCha8Rng {
        let mut rng = ChaCha8Rng::seed_from_u64(self.seed);
        rng.set_stream(stream);
        rng
    }

    /// The furnished room.
    pub fn scene(&self) -> Scene {
        let mut scene = families::plan(self.family, self.objects, &mut self.rng(LAYOUT));
        self.layout.rename(&mut scene);
        scene.detail = self.detail;
        scene
    }

    /// The cameras in that room.
    pub fn cameras(&self, scene: &Scene) -> Vec<Camera> {
        cameras::place(scene, self.views, self.width, self.height, &mut self.rng(CAMERAS))
    }

    /// How coarse the light may be: as the photographs are.
    fn coarseness(&self) -> f64 {
        (FINE_HEIGHT / f64::from(self.height)).clamp(1.0, 3.0)
    }

    /// The options as written beside what they made.
    fn parameters(&self) -> Value {
        serde_json::to_value(self).unwrap_or_default()
    }
}

/// What the masks of each view show, by the stem of its files.
type Shown = BTreeMap<String, Vec<MaskTruth>>;

/// A scene that is written.
struct Work<'a> {
    stage: &'a Stage,
    options: &'a Options,
    scene: Scene,
    cameras: Vec<Camera>,
    language: Option<Language>,
}

impl<'a> Work<'a> {
    fn new(stage: &'a Stage, options: &'a Options) -> Self {
        let scene = options.scene();
        let cameras = options.cameras(&scene);
        let named: Vec<Named> = options.layout.finer(&scene).into_iter().flat_map(|(_, named)| named).collect();
        let texts: Vec<&str> = options.layout.texts().into_iter().chain(Unrelated::texts()).collect();
        let language =
            |speech: Speech| Language::new(speech.language, &scene, &named, &texts, &mut options.rng(SPEECH));
        let language = options.speech.map(language);
        Self { stage, options, scene, cameras, language }
    }

    /// Says how much memory the run will take, for masks alone or with light and true points. Fitted to measured peaks,
    /// which tests/cli.rs holds it against: about as many points as the finest light has texels, and no more than a third
    /// of all pixels.
    fn forecast(&self, masks_alone: bool) -> Result<()> {
        let Self { options, scene, .. } = self;
        let pixels = options.width as usize * options.height as usize;
        let points = LightMap::size(scene, 1.0).min(options.views * pixels / 3);
        let more = (32 * LightMap::size(scene, options.coarseness()) + 55 * points).max(115 * points);
        let fewer = "make smaller photographs (--width, --height) or fewer of them";
        self.stage.forecast((7_200_000 + 75 * pixels + if masks_alone { 0 } else { more }) as u64, fewer)
    }

    /// Writes the id maps of every view, and features where asked for, into a folder, and the table of text features into
    /// another. `see` gives what the view of this number and stem shows.
    fn write_masks(
        &self,
        folder: &Path,
        texts: &Path,
        mut see: impl FnMut(usize, &str, &Camera) -> Result<Frame>,
    ) -> Result<Shown> {
        let Self { stage, options, scene, cameras, language } = self;
        let mut progress = stage.progress("views", cameras.len() as u64);
        let mut masks = BTreeMap::new();
        for (v, (camera, stem)) in cameras.iter().zip(options.layout.stems(cameras.len())).enumerate() {
            stage.go_on()?;
            let frame = see(v, &stem, camera)?;
            let v = v as u64;
            let (rng, patches) = (&mut options.rng(FIRST_VIEW + v), &mut options.rng(FIRST_PATCHES + v));
            let pairs = Pairs { rng: options.rng(0), first: FIRST_PAIRS, view: v };
            let (maps, shown) = masks::segment(scene, &frame, &options.faults, rng, patches, &pairs);
            maps.write(maps_path(folder, &stem))?;
            if let (Some(language), Some(speech)) = (language, &options.speech) {
                let features = language.encode(&frame, &maps, speech, &mut options.rng(FIRST_SPEECH + v));
                features.write(features_path(folder, &stem))?;
            }
            masks.insert(stem, shown);
            progress.step();
        }
        progress.finish(&[]);
        language.iter().try_for_each(|language| write_json(&texts.join(TABLE), &language.table()))?;
        Ok(masks)
    }

    /// Writes the poses, noisy where asked for, and the sparse cloud.
    fn write_cameras(&self, out: &Path, sparse: &PointCloud) -> Result<()> {
        let Self { options, cameras, .. } = self;
        let stems = options.layout.stems(cameras.len());
        let named = |cameras: Vec<Camera>| -> Vec<(String, Camera)> {
            stems.iter().map(|stem| format!("{stem}.png")).zip(cameras).collect()
        };
        let mut views = named(cameras.clone());
        if options.pose_noise > 0.0 {
            colmap::write_model(&out.join("truth/sparse/0"), &views, &PointCloud::default())?;
            views = named(cameras::perturbed(cameras, options.pose_noise, &mut options.rng(POSES)));
        }
        options.layout.write_cameras(out, &views, sparse)
    }

    /// Writes the true points and the scan made of them; returns how many points there are.
    fn write_points(&self, out: &Path, points: &Collector) -> Result<usize> {
        let Self { stage, options, scene, .. } = self;
        let truth = points.truth(scene);
        let mut provenance = stage.provenance(TruePoints::FORMAT, 1, options.parameters(), BTreeMap::new());
        provenance.extra = json!({ "classes": scene.classes() });
        truth.write(out.join("truth/points.safetensors"), provenance)?;
        if options.layout == Layout::Colmap && options.family == Family::Room {
            scannet::write(&out.join("scan"), scannet::SCAN, false, scene, &truth, &points.colors)?;
        }
        let (vertices, colors) = points.vertices(scene, options.points, &mut options.rng(VERTICES));
        options.layout.write_scan(out, scene, &vertices, &colors)?;
        Ok(truth.position.len())
    }

    fn true_scene(&self) -> TrueScene {
        let part = |id: u32| TruePart { id, name: self.scene.parts[id as usize].name.into() };
        let objects = self.scene.things.iter().enumerate().map(|(id, t)| TrueObject {
            id: id as u32,
            name: t.name.clone(),
            class: t.class.into(),
            color: t.color.into(),
            background: t.background,
            parts: t.parts.clone().map(part).collect(),
        });
        TrueScene { objects: objects.collect(), parameters: self.options.parameters() }
    }
}

/// Makes the scene and writes it to `out`; `truth/scene.json` comes last.
///
/// # Errors
/// When a file cannot be written, when `out` holds another dataset, or when the stage is interrupted.
pub fn run(stage: &Stage, out: &Path, options: &Options) -> Result<()> {
    let (marker, layout) = (out.join("truth/scene.json"), &options.layout);
    // The folders may hold nothing but an earlier synthetic scene.
    let folders = FOLDERS.iter().map(|f| out.join(f)).chain([layout.labels(out)]);
    let root = layout.root_files().into_iter().map(|name| out.join(name));
    let outputs = folders.fold(stage.outputs(&marker).file(&marker).files(root), Outputs::folder);
    let mut claim = outputs.drop_stale().claim()?;
    let work = Work::new(stage, options);
    let Work { scene, cameras, .. } = &work;
    let (things, parts, surfaces) = (scene.things.len(), scene.parts.len(), scene.primitives.len());
    stage.info(&format!("{things} things of {parts} parts and {surfaces} surfaces"));
    work.forecast(false)?;
    if marker.exists() {
        std::fs::remove_file(&marker).at("replace", &marker)?;
    }
    let light = LightMap::bake(scene, options.coarseness());
    let mut points = Collector::default();
    let mut labelled = 0;
    let labels = layout.labels(out);
    let named = [(labels.clone(), named::things(scene))].into_iter();
    let named: Vec<_> = named.chain(layout.finer(scene).into_iter().map(|(kind, n)| (labels.join(kind), n))).collect();
    let masks = work.write_masks(&out.join("language_features"), &out.join("truth"), |v, stem, camera| {
        let frame = render::render(scene, &light, camera);
        points.add(scene, camera, &frame);
        write_view(out, layout.images(), stem, &frame)?;
        if layout.is_labelled(v, stem, options.label_every) {
            for (folder, named) in &named {
                label::write(&folder.join(format!("{stem}.json")), &format!("{stem}.png"), scene, named, &frame)?;
            }
            labelled += 1;
        }
        Ok(frame)
    })?;
    drop(light);
    let sparse = points.sparse(scene, options.points, POINT_NOISE, &mut options.rng(POINTS));
    work.write_cameras(out, &sparse)?;
    let truth_points = work.write_points(out, &points)?;
    MaskTruth::write_all(out.join("truth/masks.json"), &masks)?;
    let summary = json!({
        "objects": options.objects, "parts": parts, "views": cameras.len(), "labelled_views": labelled,
        "masks": masks.values().map(Vec::len).sum::<usize>(), "points": sparse.len(), "truth_points": truth_points,
    });
    // The record before the marker: a rule that finds the marker finds everything.
    stage.record(&mut claim, options.parameters(), BTreeMap::new(), summary)?;
    for folder in FOLDERS {
        // Empty folders of an earlier scene of another layout; one that is not empty stays as it is.
        let _ = std::fs::remove_dir(out.join(folder));
    }
    work.true_scene().write(&marker)?;
    stage.info(&format!("{} photographs, {} points, {}", cameras.len(), sparse.len(), marker.display()));
    Ok(())
}

/// Makes only the masks of the scene, without its photographs: id maps (and features and their table of texts, where
/// asked for) as [`run`] with the same options puts them into `language_features`, and last of all `masks.json`, what each
/// mask shows.
fn run_masks(stage: &Stage, folder: &Path, options: &Options) -> Result<()> {
    let marker = folder.join("masks.json");
    let stems = options.layout.stems(options.views);
    let maps = stems.iter().flat_map(|stem| [maps_path(folder, stem), features_path(folder, stem)]);
    let outputs = stage.outputs(&marker).files([marker.clone(), folder.join(TABLE)]).files(maps).drop_stale();
    let mut claim = outputs.claim()?;
    let work = Work::new(stage, options);
    work.forecast(true)?;
    // An empty list says that the masks are not complete.
    MaskTruth::write_all(&marker, &BTreeMap::new())?;
    let masks = work.write_masks(folder, folder, |_, _, camera| Ok(render::identify(&work.scene, camera)))?;
    let count = masks.values().map(Vec::len).sum::<usize>();
    let summary = json!({ "views": options.views, "masks": count });
    MaskTruth::write_all(&marker, &masks)?;
    stage.record(&mut claim, options.parameters(), BTreeMap::new(), summary)?;
    stage.info(&format!("{count} masks in {} views, {}", options.views, marker.display()));
    Ok(())
}

/// Writes a view's photograph and what each of its pixels shows.
fn write_view(out: &Path, images: &str, stem: &str, frame: &Frame) -> Result<()> {
    let (w, h) = (frame.width, frame.height);
    Image::from_rgb8(w as u32, h as u32, &frame.rgb).write_png(out.join(images).join(format!("{stem}.png")))?;
    for (folder, ids) in [("truth/views", &frame.thing), ("truth/parts", &frame.part)] {
        let ids = ArrayView2::from_shape((h, w), ids).expect("an id of each pixel");
        npy::write_i32(out.join(folder).join(format!("{stem}.npy")), &ids)?;
    }
    Ok(())
}
