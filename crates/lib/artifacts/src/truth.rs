//! The ground truth of a synthetic scene: `truth/scene.json`, `truth/points.safetensors`, `truth/masks.json`.

use gs_io::{Artifact, ArtifactWriter, Error, IoContext, Provenance, Result, write_json};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// A part of an object.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TruePart {
    /// Id, unique in the scene.
    pub id: u32,
    /// What people call it, such as "handle".
    pub name: String,
}

/// A thing of the scene.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct TrueObject {
    /// Instance id: the position in [`TrueScene::objects`].
    pub id: u32,
    /// What people call it, unique in the scene: the text that asks for it.
    pub name: String,
    /// Its class, such as "mug".
    pub class: String,
    /// Its main colour's name.
    pub color: String,
    /// Whether it is background: floor, wall, table.
    pub background: bool,
    /// Its parts; at least one.
    pub parts: Vec<TruePart>,
}

/// `truth/scene.json`: all things of the scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrueScene {
    /// All things, background included; ids are positions.
    pub objects: Vec<TrueObject>,
    /// Parameters that made the scene.
    pub parameters: serde_json::Value,
}

/// What a mask of an id map shows.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct MaskTruth {
    /// Level of the mask, 0 to 3.
    pub level: u32,
    /// Instance ids of the things it shows.
    pub instances: Vec<u32>,
    /// Part id when it shows a single part of a thing.
    pub part: Option<u32>,
    /// `whole`, `part`, `merged`, or `spurious`: a patch that is no thing.
    pub kind: String,
    /// A caption, such as "handle of the red mug".
    pub caption: String,
}

impl TrueScene {
    /// Reads `truth/scene.json`.
    ///
    /// # Errors
    /// When the file is missing or not such a file.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let scene: Self = read_json(path.as_ref())?;
        if let Some(o) = scene.objects.iter().enumerate().find(|(i, o)| o.id as usize != *i) {
            return Err(Error::new("ids are not positions")
                .file(path)
                .field(format!("objects[{}].id", o.0))
                .found(o.1.id));
        }
        Ok(scene)
    }

    /// Writes `truth/scene.json`.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<()> {
        write_json(path, self)
    }
}

impl MaskTruth {
    /// Reads `truth/masks.json`: per view (stem), the masks in the order of their ids.
    ///
    /// # Errors
    /// When the file is missing or not such a file.
    pub fn read_all(path: impl AsRef<Path>) -> Result<BTreeMap<String, Vec<Self>>> {
        read_json(path.as_ref())
    }

    /// Writes `truth/masks.json`.
    pub fn write_all(path: impl AsRef<Path>, masks: &BTreeMap<String, Vec<Self>>) -> Result<()> {
        write_json(path, masks)
    }
}

fn read_json<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T> {
    let bytes = std::fs::read(path).at("read", path)?;
    serde_json::from_slice(&bytes).map_err(|e| Error::new(format!("not the JSON expected: {e}")).file(path))
}

/// `truth/points.safetensors`: samples of the surfaces that some view sees; P of them.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct TruePoints {
    /// Positions in the world; P.
    pub position: Vec<[f32; 3]>,
    /// Instance id; P.
    pub instance: Vec<i32>,
    /// Part id; P.
    pub part: Vec<i32>,
    /// Class id; P.
    pub class: Vec<i32>,
}

impl TruePoints {
    /// Format name in the file.
    pub const FORMAT: &str = "truth-points";
    const VERSION: u32 = 1;

    /// Writes the artifact.
    pub fn write(&self, path: impl AsRef<Path>, mut provenance: Provenance) -> Result<()> {
        provenance.format = Self::FORMAT.into();
        provenance.version = Self::VERSION;
        let p = self.position.len();
        ArtifactWriter::new(provenance)
            .tensor("position", &[p, 3], self.position.as_flattened())
            .tensor("instance", &[p], &self.instance)
            .tensor("part", &[p], &self.part)
            .tensor("class", &[p], &self.class)
            .write(path)
    }

    /// Reads the artifact.
    ///
    /// # Errors
    /// When the file is damaged or tensors do not fit together.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let a = Artifact::open(path, Self::FORMAT, Self::VERSION)?;
        let flat = a.tensor::<f32>("position", &[None, Some(3)])?;
        let p = Some(flat.len() / 3);
        Ok(Self {
            position: flat.chunks_exact(3).map(|c| [c[0], c[1], c[2]]).collect(),
            instance: a.tensor("instance", &[p])?.to_vec(),
            part: a.tensor("part", &[p])?.to_vec(),
            class: a.tensor("class", &[p])?.to_vec(),
        })
    }
}
