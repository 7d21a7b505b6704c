//! A run, loaded.

use crate::cells::Cells;
use crate::options::Source;
use crate::pack::{Packed, pack};
use crate::reach::Reach;
use artifacts::{Called, Edits, InstanceNames, Instances, Remarks, called};
use gs_io::{Error, IoContext, Result};
use gs_scene::dataset::{self, Dataset, LoadOptions, Resolution, View};
use gs_scene::{Gaussians, splat};
use objects::Up;
use query::{Granules, Index, LabelledScene, TextSource, Unrelated, Verdict};
use stage::Stage;
use std::collections::BTreeMap;
use std::sync::OnceLock;

/// What the page shows, and what answers its questions.
pub struct World {
    /// Where it was read from.
    pub source: Source,
    /// The photographs.
    pub dataset: Dataset,
    /// Gaussians and instances, without anybody's edits.
    pub scene: LabelledScene,
    /// The Gaussians as the page gets them.
    pub packed: Packed,
    /// Where their Gaussians can be seen.
    pub reach: Reach,
    /// What the page shows and hides together, before anybody's edits.
    pub cells: Cells,
    /// Colours of the features, rgb per packed Gaussian; empty where the run has no features.
    pub feature_colors: Vec<[u8; 3]>,
    /// Where text features come from, or why there are none.
    pub words: std::result::Result<TextSource, String>,
    /// What says whether a text matches anything; encoded at the first text.
    unrelated: OnceLock<Option<Unrelated>>,
    /// What instances are called by a vocabulary, where the run has that.
    pub names: Option<InstanceNames>,
    /// What a person should know: photographs that are missing, features of another scene.
    pub messages: Vec<String>,
}

/// Instances as a person left them.
pub struct Edited {
    /// What was done.
    pub edits: Edits,
    /// Which content of the file that is.
    pub version: String,
    /// The instances after it.
    pub instances: Instances,
    /// Names, notes and scale.
    pub remarks: Remarks,
    /// What the page shows and hides together.
    pub cells: Cells,
    objects: OnceLock<objects::Scene>,
    by_chance: OnceLock<Option<f32>>,
}

impl Edited {
    /// The objects as `scene.json` has them; found once.
    pub fn objects(&self, world: &World) -> &objects::Scene {
        self.objects.get_or_init(|| {
            let up = Up::of_cameras(world.dataset.views.iter().map(|v| &v.camera));
            let inputs = world.scene.inputs.clone();
            let names = self.called(world).into_iter().map(|(k, c)| (k, c.into())).collect();
            objects::describe(&self.instances, world.gaussians(), &self.remarks, &names, up, inputs)
        })
    }

    /// What instances are called, by a person or else by a vocabulary.
    pub fn called(&self, world: &World) -> BTreeMap<u32, Called> {
        called(world.names.as_ref(), &self.remarks)
    }

    /// Whether a text of this feature matches anything; none where that is not judged.
    pub fn verdict(&self, world: &World, feature: &[f32]) -> Option<Verdict> {
        let unrelated = world.unrelated()?;
        let (index, granules) = (Index::new(&self.instances), Granules::new(&self.instances));
        let by_chance = *self.by_chance.get_or_init(|| unrelated.chance(&index, &granules, &[], 1));
        Verdict::on(feature, by_chance?, &index, &granules, &[], 1)
    }
}

impl World {
    /// Reads a run. What is needed for looking and clicking must be there and of one scene; without a language model or
    /// features the page says so.
    ///
    /// # Errors
    /// When files are missing, damaged or of different scenes.
    pub fn read(o: &Source, resolution: Resolution, stage: &Stage) -> Result<Self> {
        let mut dataset = dataset::load(&o.scene, &LoadOptions { resolution, ..LoadOptions::default() })?;
        stage.forecast(forecast(o, &dataset), "give a smaller geometry (gs-geom train --max-gaussians)")?;
        let scene = LabelledScene::read(&o.instances, &o.geometry, None)?;
        scene.check_dataset(&mut dataset)?;
        let mut messages = dataset.warnings.clone();
        messages.extend(scene.geometry.damage());
        let words = words(o, &scene);
        let names = names(o, &scene).unwrap_or_else(|e| {
            messages.push(format!("names are left out: {e}"));
            None
        });
        let packed = pack(scene.gaussians(), o.sh);
        let reach = Reach::new(scene.gaussians(), &packed.order);
        let cells = Cells::new(&scene.instances);
        let feature_colors = match feature_colors(o, &scene, &packed) {
            Ok(colors) => colors,
            Err(e) => {
                messages.push(format!("colours of features are left out: {e}"));
                Vec::new()
            }
        };
        messages.iter().for_each(|m| stage.warn(m));
        let n = scene.gaussians().len();
        if packed.order.len() < n {
            stage.skipped(&format!("{} of {n} Gaussians: too faint to be drawn", n - packed.order.len()));
        }
        Ok(Self {
            source: o.clone(),
            dataset,
            scene,
            packed,
            reach,
            cells,
            feature_colors,
            words,
            unrelated: OnceLock::new(),
            names,
            messages,
        })
    }

    /// Unrelated texts, encoded once; none where the source of text features has none, or fails.
    fn unrelated(&self) -> Option<&Unrelated> {
        let encode = |source| Unrelated::encode(source, &[]).ok().flatten();
        self.unrelated.get_or_init(|| self.words.as_ref().ok().and_then(encode)).as_ref()
    }

    /// Does what the first text would have to wait for.
    pub fn warm_up(&self) {
        self.unrelated();
    }

    /// All Gaussians of the geometry.
    pub fn gaussians(&self) -> &Gaussians {
        self.scene.gaussians()
    }

    /// What lies in the run's folder as edits, and its version; nothing where there is no such file.
    ///
    /// # Errors
    /// When the file cannot be read.
    pub fn edits_file(&self) -> Result<(Vec<u8>, String)> {
        let path = self.source.edits();
        match std::fs::read(&path) {
            Ok(bytes) => {
                let version = format!("{:.32}", gs_io::hash_bytes(&bytes));
                Ok((bytes, version))
            }
            Err(e) if e.kind() == std::io::ErrorKind::NotFound => Ok((Vec::new(), "none".into())),
            Err(e) => Err(e).at("read", path),
        }
    }

    /// The instances after the edits of [`Self::edits_file`].
    ///
    /// # Errors
    /// When the file is damaged, is about other instances, or an edit does not fit them.
    pub fn saved(&self, (bytes, version): (Vec<u8>, String)) -> Result<Edited> {
        let (path, hash) = (&self.source.edits(), self.scene.artifact.hash());
        if version == "none" {
            return self.edited(Edits { instances: hash.into(), edits: Vec::new() }, version);
        }
        let edits = Edits::parse(&bytes).map_err(|e| e.file(path))?;
        if edits.instances == hash {
            return self.edited(edits, version).map_err(|e| e.file(path));
        }
        Err(Error::new("these edits are about other instances")
            .file(path)
            .field("instances")
            .found(&edits.instances)
            .expected(format!("{hash} ({})", self.source.instances.display()))
            .hint("move the file away to start anew"))
    }

    /// The instances after some edits, of this version.
    ///
    /// # Errors
    /// When an edit does not fit the instances.
    pub fn edited(&self, edits: Edits, version: String) -> Result<Edited> {
        let mut instances = self.scene.instances.clone();
        let remarks = edits.apply(&mut instances, &self.gaussians().means)?;
        let cells = self.cells.cut(&edits.edits)?;
        Ok(Edited { edits, version, instances, remarks, cells, objects: OnceLock::new(), by_chance: OnceLock::new() })
    }

    /// The view of this stem.
    pub fn view(&self, stem: &str) -> Option<(usize, &View)> {
        self.dataset.views.iter().enumerate().find(|(_, v)| v.stem() == stem)
    }
}

/// Peak of memory in bytes: geometry, packed Gaussians and a photograph (docs/results/explore.md has measured peaks).
fn forecast(source: &Source, dataset: &Dataset) -> u64 {
    const PROGRAM: u64 = 45_000_000;
    let geometry = splat::bytes_as_ply(&source.geometry).unwrap_or(0);
    let pixels = |v: &View| u64::from(v.camera.width) * u64::from(v.camera.height);
    PROGRAM + source.texts().bytes() + geometry * 19 / 10 + 40 * dataset.views.iter().map(pixels).max().unwrap_or(0)
}

fn words(source: &Source, scene: &LabelledScene) -> std::result::Result<TextSource, String> {
    if scene.instances.dim() == 0 {
        return Err("The instances have no language features: run make clip, then make scene again. \
                    Clicking works, and names that you give can be found."
            .into());
    }
    if !source.texts().given() {
        return Err(
            "No language model: give --clip models/clip or --text-features FILE. Clicking works, and names that \
                    you give can be found."
                .into(),
        );
    }
    TextSource::open_for(&scene.artifact, scene.instances.dim(), &source.texts()).map_err(|e| e.to_string())
}

/// The names that lie beside the instances.
fn names(source: &Source, scene: &LabelledScene) -> Result<Option<InstanceNames>> {
    let path = Some(source.names()).filter(|path| path.exists());
    path.map(|path| InstanceNames::read(path, scene.artifact.hash())).transpose()
}

/// Grey of a Gaussian that no view sees and that has no features.
const NO_FEATURE: [u8; 3] = [64; 3];

fn feature_colors(source: &Source, scene: &LabelledScene, packed: &Packed) -> Result<Vec<[u8; 3]>> {
    let Some(path) = source.features() else { return Ok(Vec::new()) };
    let hash = &scene.inputs[artifacts::role::GEOMETRY];
    let features = query::read_features(&path, hash, scene.gaussians().len())?;
    let mut colors = vec![NO_FEATURE; scene.gaussians().len()];
    let of_kept = report::feature_colors(artifacts::flat(features.values.view()), features.dim());
    for (&i, color) in features.kept.iter().zip(of_kept) {
        colors[i as usize] = color.map(|v| (255.0 * v).round() as u8);
    }
    Ok(packed.order.iter().map(|&i| colors[i as usize]).collect())
}
