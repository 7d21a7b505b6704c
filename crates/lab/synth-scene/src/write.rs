//! The program told from beginning to end: furnish a room, photograph it, write all of it.

use crate::memory::{self, Amounts};
use crate::options::Args;
pub use crate::options::Options;
use crate::render::light::LightMap;
use crate::render::{self, Frame};
use crate::scene::{Family, Scene, cameras, families};
use crate::truth::benchmark::{FOLDERS, Layout};
use crate::truth::language::Language;
use crate::truth::masks;
use crate::truth::points::{self, Collector};
use crate::truth::{label, scannet, write_json};
use artifacts::{MaskTruth, TrueObject, TruePart, TruePoints, TrueScene, features_path, maps_path};
use gs_io::{Claim, Error, IoContext, Outputs, Result, create_dir, npy};
use gs_scene::{Camera, Image, PointCloud, colmap};
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
/// What takes less memory.
const FEWER: &str = "make smaller photographs (--width, --height) or fewer of them";
/// Folder of the scan, which only furnished rooms have.
const SCAN: &str = "scan";
/// Streams of the random generator, so that more views do not move the furniture.
const LAYOUT: u64 = 0;
const CAMERAS: u64 = 1;
const POINTS: u64 = 2;
const POSES: u64 = 3;
const VERTICES: u64 = 4;
const FIRST_VIEW: u64 = 16;
const FIRST_SPEECH: u64 = 1 << 32;
const FIRST_PATCHES: u64 = 2 << 32;

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
            (_, Some(folder)) => run_masks(stage, folder, &options),
            (Some(out), None) => run(stage, out, &options),
            (None, None) => Err(Error::new("no folder to write to").field("--out")),
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
        scene
    }

    /// The light in that room, as fine as the photographs show.
    pub fn light(&self, scene: &Scene) -> LightMap {
        LightMap::bake(scene, self.coarseness())
    }

    fn coarseness(&self) -> f64 {
        (FINE_HEIGHT / f64::from(self.height)).clamp(1.0, 3.0)
    }

    /// What decides about the memory of the whole scene.
    fn amounts(&self, scene: &Scene, cameras: &[Camera]) -> Amounts {
        let points = points::expected(scene, cameras);
        Amounts {
            pixels: self.width as usize * self.height as usize,
            texels: LightMap::size(scene, self.coarseness()),
            points,
            vertices: match &self.layout {
                Layout::Colmap if self.family == Family::Room => points,
                Layout::Scan { .. } => points.min(self.points),
                _ => 0,
            },
        }
    }

    /// The cameras in that room.
    pub fn cameras(&self, scene: &Scene) -> Vec<Camera> {
        cameras::place(scene, self.views, self.width, self.height, &mut self.rng(CAMERAS))
    }

    /// The options as written beside what they made.
    fn parameters(&self) -> Value {
        serde_json::to_value(self).unwrap_or_default()
    }

    /// Writes a view's id maps, and features where asked for, into a folder; returns what the masks show.
    fn write_masks(
        &self,
        folder: &Path,
        stem: &str,
        v: usize,
        scene: &Scene,
        frame: &Frame,
        language: Option<&Language>,
    ) -> Result<Vec<MaskTruth>> {
        let v = v as u64;
        let (rng, patches) = (&mut self.rng(FIRST_VIEW + v), &mut self.rng(FIRST_PATCHES + v));
        let (maps, shown) = masks::segment(scene, frame, &self.faults, rng, patches);
        maps.write(maps_path(folder, stem))?;
        if let (Some(language), Some(speech)) = (language, &self.speech) {
            let features = language.encode(frame, &maps, speech, &mut self.rng(FIRST_SPEECH + v));
            features.write(features_path(folder, stem))?;
        }
        Ok(shown)
    }

    fn language(&self, scene: &Scene) -> Option<Language> {
        self.speech.map(|_| Language::new(scene).with(&self.layout.texts()))
    }
}

/// The stem of a view's files in [`Layout::Colmap`]: `frame_00001` for the first.
pub fn stem(view: usize) -> String {
    format!("frame_{:05}", view + 1)
}

/// Makes the scene and writes it to `out`; `truth/scene.json` comes last.
///
/// # Errors
/// When a file cannot be written, when `out` holds another dataset, or when the stage is interrupted.
pub fn run(stage: &Stage, out: &Path, options: &Options) -> Result<()> {
    let marker = out.join("truth/scene.json");
    let mut claim = claim(stage, out, &marker, &options.layout)?;
    let scene = options.scene();
    let cameras = options.cameras(&scene);
    stage.info(&format!(
        "{} things of {} parts and {} surfaces",
        scene.things.len(),
        scene.parts.len(),
        scene.primitives.len()
    ));
    stage.forecast(memory::forecast(&options.amounts(&scene, &cameras)), FEWER)?;
    prepare(out, &marker, &options.layout)?;
    let language = options.language(&scene);
    let mut points = Collector::default();
    let (masks, labelled) = photograph(stage, out, options, &scene, &cameras, language.as_ref(), &mut points)?;
    let sparse = points.sparse(&scene, options.points, POINT_NOISE, &mut options.rng(POINTS));
    write_cameras(out, options, &cameras, &sparse)?;
    if let Some(language) = &language {
        write_table(&out.join("truth"), language)?;
    }
    let parameters = options.parameters();
    let truth_points = write_points(stage, out, options, &scene, &points, &parameters)?;
    MaskTruth::write_all(out.join("truth/masks.json"), &masks)?;
    let summary = json!({
        "objects": options.objects, "parts": scene.parts.len(), "views": cameras.len(), "labelled_views": labelled,
        "masks": masks.values().map(Vec::len).sum::<usize>(), "points": sparse.len(), "truth_points": truth_points,
    });
    // The record before the marker: a rule that finds the marker finds everything.
    stage.record(&mut claim, parameters.clone(), BTreeMap::new(), summary)?;
    remove_unused(out, &options.layout);
    true_scene(&scene, parameters).write(&marker)?;
    stage.info(&format!("{} photographs, {} points, {}", cameras.len(), sparse.len(), marker.display()));
    Ok(())
}

/// Makes only the masks of the scene, without its photographs: id maps (and features and their table of texts, where
/// asked for) as [`run`] with the same options puts them into `language_features`, and last of all `masks.json`, what each
/// mask shows.
///
/// # Errors
/// When a file cannot be written, when `folder` holds something else, or when the stage is interrupted.
pub fn run_masks(stage: &Stage, folder: &Path, options: &Options) -> Result<()> {
    let marker = folder.join("masks.json");
    let stems = options.layout.stems(options.views);
    let maps = stems.iter().flat_map(|stem| [maps_path(folder, stem), features_path(folder, stem)]);
    let outputs = stage.outputs(&marker).files([marker.clone(), folder.join(TABLE)]).files(maps).drop_stale();
    let mut claim = outputs.claim()?;
    let scene = options.scene();
    let cameras = options.cameras(&scene);
    let pixels = options.width as usize * options.height as usize;
    stage.forecast(memory::forecast(&Amounts { pixels, ..Amounts::default() }), FEWER)?;
    // An empty list says that the masks are not complete.
    MaskTruth::write_all(&marker, &BTreeMap::new())?;
    let language = options.language(&scene);
    let masks = each_view(stage, options, &cameras, |v, stem, camera| {
        options.write_masks(folder, stem, v, &scene, &render::identify(&scene, camera), language.as_ref())
    })?;
    if let Some(language) = &language {
        write_table(folder, language)?;
    }
    let count = masks.values().map(Vec::len).sum::<usize>();
    let summary = json!({ "views": cameras.len(), "masks": count });
    MaskTruth::write_all(&marker, &masks)?;
    stage.record(&mut claim, options.parameters(), BTreeMap::new(), summary)?;
    stage.info(&format!("{count} masks in {} views, {}", cameras.len(), marker.display()));
    Ok(())
}

/// What the masks of each view show, by the stem of its files.
type Shown = BTreeMap<String, Vec<MaskTruth>>;

/// Runs `make` for every view and collects what its masks show.
fn each_view(
    stage: &Stage,
    options: &Options,
    cameras: &[Camera],
    mut make: impl FnMut(usize, &str, &Camera) -> Result<Vec<MaskTruth>>,
) -> Result<Shown> {
    let mut progress = stage.progress("views", cameras.len() as u64);
    let mut masks = BTreeMap::new();
    for (v, (camera, stem)) in cameras.iter().zip(options.layout.stems(cameras.len())).enumerate() {
        stage.go_on()?;
        let shown = make(v, &stem, camera)?;
        masks.insert(stem, shown);
        progress.step();
    }
    progress.finish(&[]);
    Ok(masks)
}

/// Writes photographs, masks and labels, and collects the points that the views see. Returns what the masks show and the
/// number of labelled views.
fn photograph(
    stage: &Stage,
    out: &Path,
    options: &Options,
    scene: &Scene,
    cameras: &[Camera],
    language: Option<&Language>,
    points: &mut Collector,
) -> Result<(Shown, usize)> {
    let light = options.light(scene);
    let labels = options.layout.labels(out);
    let mut labelled = 0;
    let masks = each_view(stage, options, cameras, |v, stem, camera| {
        let frame = render::render(scene, &light, camera);
        points.add(scene, camera, &frame);
        write_view(out, options.layout.images(), stem, &frame)?;
        if options.layout.is_labelled(v, stem, options.label_every) {
            label::write(&labels.join(format!("{stem}.json")), &format!("{stem}.png"), scene, &frame)?;
            labelled += 1;
        }
        options.write_masks(&out.join("language_features"), stem, v, scene, &frame, language)
    })?;
    Ok((masks, labelled))
}

/// Writes the poses, noisy where asked for, and the sparse cloud.
fn write_cameras(out: &Path, options: &Options, cameras: &[Camera], sparse: &PointCloud) -> Result<()> {
    let stems = options.layout.stems(cameras.len());
    let named = |cameras: Vec<Camera>| -> Vec<(String, Camera)> {
        stems.iter().map(|stem| format!("{stem}.png")).zip(cameras).collect()
    };
    if options.pose_noise > 0.0 {
        colmap::write_model(&out.join("truth/sparse/0"), &named(cameras.to_vec()), &PointCloud::default())?;
    }
    let views = named(cameras::perturbed(cameras, options.pose_noise, &mut options.rng(POSES)));
    options.layout.write_cameras(out, &views, sparse)
}

/// Writes the true points and the scan made of them; returns how many points there are.
fn write_points(
    stage: &Stage,
    out: &Path,
    options: &Options,
    scene: &Scene,
    points: &Collector,
    parameters: &Value,
) -> Result<usize> {
    let truth = points.truth(scene);
    let mut provenance = stage.provenance(TruePoints::FORMAT, 1, parameters.clone(), BTreeMap::new());
    provenance.extra = json!({ "classes": scene.classes() });
    truth.write(out.join("truth/points.safetensors"), provenance)?;
    if options.layout == Layout::Colmap && options.family == Family::Room {
        scannet::write(&out.join(SCAN), scannet::SCAN, scene, &truth, points.colors())?;
    }
    let (vertices, colors) = points.vertices(scene, options.points, &mut options.rng(VERTICES));
    options.layout.write_scan(out, scene, &vertices, &colors)?;
    Ok(truth.position.len())
}

/// Name of the table of text features.
const TABLE: &str = "text_features.json";

fn write_table(folder: &Path, language: &Language) -> Result<()> {
    write_json(&folder.join(TABLE), &language.table())
}

/// The right to write a scene. Its folders may hold nothing but an earlier synthetic scene.
fn claim(stage: &Stage, out: &Path, marker: &Path, layout: &Layout) -> Result<Claim> {
    let root = layout.root_files().into_iter().map(|name| out.join(name));
    let folders = FOLDERS.iter().map(|f| out.join(f)).chain([layout.labels(out)]);
    let outputs = folders.fold(stage.outputs(marker).file(marker).files(root), Outputs::folder);
    outputs.drop_stale().claim()
}

/// Makes the folders; an earlier scene there is complete no more.
fn prepare(out: &Path, marker: &Path, layout: &Layout) -> Result<()> {
    if marker.exists() {
        std::fs::remove_file(marker).at("replace", marker)?;
    }
    layout.folders().into_iter().try_for_each(|f| create_dir(out.join(f)))
}

/// Removes the empty folders of an earlier scene of another layout.
fn remove_unused(out: &Path, layout: &Layout) {
    let used = layout.folders();
    for folder in FOLDERS.into_iter().filter(|f| !used.contains(f)) {
        // One that is not empty, or not there, stays as it is.
        let _ = std::fs::remove_dir(out.join(folder));
    }
}

/// Writes a view's photograph and what each of its pixels shows.
fn write_view(out: &Path, images: &str, stem: &str, frame: &Frame) -> Result<()> {
    let (w, h) = (frame.width, frame.height);
    Image::from_rgb8(w as u32, h as u32, &frame.rgb).write_png(out.join(images).join(format!("{stem}.png")))?;
    npy::write_i32(out.join("truth/views").join(format!("{stem}.npy")), &[h, w], &frame.thing)?;
    npy::write_i32(out.join("truth/parts").join(format!("{stem}.npy")), &[h, w], &frame.part)
}

fn true_scene(scene: &Scene, parameters: Value) -> TrueScene {
    let parts = |range: std::ops::Range<u32>| {
        range.map(|id| TruePart { id, name: scene.parts[id as usize].name.into() }).collect()
    };
    let objects = scene.things.iter().enumerate().map(|(id, t)| TrueObject {
        id: id as u32,
        name: t.name.clone(),
        class: t.class.into(),
        color: t.color.into(),
        background: t.background,
        parts: parts(t.parts.clone()),
    });
    TrueScene { objects: objects.collect(), parameters }
}
