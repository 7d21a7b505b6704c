//! `scene.json`: the objects of a scene and how they stand to each other.

use crate::up::Up;
use crate::upright::ObjectBox;
use artifacts::Called;
use gs_io::{Error, IoContext, Result, write_json};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// JSON schema (draft 2020-12) of `scene.json`.
pub const SCHEMA: &str = include_str!("../scene.schema.json");

/// Where an object's name comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum NameSource {
    /// A person gave it (`instances.edits.json`).
    Edits,
    /// The text that it answers best (`query.json` of `eval query`).
    Query,
    /// The best name of a vocabulary (`names.json` of `eval names`).
    Vocabulary,
}

/// What an object is called.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Name {
    /// The name.
    pub text: String,
    /// Who says so.
    pub from: NameSource,
    /// False where it is a guess; left out of the file where it is none.
    #[serde(default = "yes", skip_serializing_if = "is_true")]
    pub sure: bool,
}

fn yes() -> bool {
    true
}

fn is_true(sure: &bool) -> bool {
    *sure
}

impl From<Called> for Name {
    fn from(called: Called) -> Self {
        let from = if called.by_person { NameSource::Edits } else { NameSource::Vocabulary };
        Self { text: called.name, from, sure: called.sure }
    }
}

impl std::fmt::Display for Name {
    /// The name; a guess with a question mark.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}{}", self.text, if self.sure { "" } else { "?" })
    }
}

/// A cluster of the tree above an object: what it is a part of.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Family {
    /// Number of the cluster in the tree of `instances.safetensors`.
    pub cluster: u32,
    /// Gaussians in it.
    pub gaussians: u32,
    /// Ids of all objects in it, ascending, this one among them.
    pub objects: Vec<u32>,
}

/// A cluster of the tree that is a part of an object.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Part {
    /// Number of the cluster in the tree of `instances.safetensors`.
    pub cluster: u32,
    /// Gaussians in it.
    pub gaussians: u32,
}

/// The view that shows most of an object as one mask.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BestView {
    /// Stem of the view's files.
    pub view: String,
    /// Id of the mask in `<view>_s.npy`.
    pub mask: u32,
    /// Association score of object and mask, 0 to 1.
    pub score: f32,
    /// Pixels of the silhouette that show the object, by blending weight.
    pub visible: f32,
}

/// A thing of the scene. Lengths are in units of the scene.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Object {
    /// Instance: the number that Gaussians of it have in `instance` of the PLY.
    pub id: u32,
    /// What it is called, where somebody, a query or a vocabulary said.
    pub name: Option<Name>,
    /// What a person noted of it; left out where nobody did.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub note: Option<String>,
    /// Confidence that it is one whole thing, 0 to 1.
    pub score: f32,
    /// Gaussians in it; at least 1.
    pub gaussians: u32,
    /// What it is a part of; none where that is the whole scene or a heap of things that nothing connects.
    pub parent: Option<Family>,
    /// The clusters that it consists of.
    pub parts: Vec<Part>,
    /// Mean of its Gaussians' centres.
    pub centroid: [f32; 3],
    /// Its box, without its few outermost Gaussians.
    #[serde(rename = "box")]
    pub bounds: ObjectBox,
    /// Volume of that box, cubic units.
    pub volume: f32,
    /// The view that shows most of it; none where no mask was matched with it.
    pub best_view: Option<BestView>,
    /// Share of the box's surface that no view saw, 0 to 1; left out where the views were not looked at.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unseen: Option<f32>,
}

/// How an object stands to another.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum RelationKind {
    /// It is carried by the other.
    #[serde(rename = "on")]
    On,
    /// The other encloses it.
    #[serde(rename = "in")]
    In,
    /// It lies below the other, which doesn't touch it.
    #[serde(rename = "under")]
    Under,
    /// It stands beside the other, on the same thing or height. Said once for each pair: the smaller id first.
    #[serde(rename = "next to")]
    NextTo,
}

/// `subject` is `relation` `object`: the mug is on the table.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Relation {
    /// Id of the one that it is said of.
    pub subject: u32,
    /// What is said.
    pub relation: RelationKind,
    /// Id of the other.
    pub object: u32,
}

/// `scene.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scene {
    /// [`Scene::FORMAT`].
    pub format: String,
    /// [`Scene::VERSION`].
    pub version: u32,
    /// Content hashes (BLAKE3) of what it was made from, by role: `geometry`, `instances`, `edits`.
    pub inputs: BTreeMap<String, String>,
    /// Gaussians of the geometry, those without an object among them.
    pub gaussians: u32,
    /// What is up; without it boxes lie along principal axes, and there are no relations but `in` and `next to`.
    pub up: Option<Up>,
    /// Length of the scene's unit in metres, where a person gave a length.
    pub metres_per_unit: Option<f64>,
    /// What was subtracted from all coordinates of a scene that is far from the origin, and is to be added for those of the world; left out
    /// where nothing was.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub shift: Option<[f64; 3]>,
    /// All objects, ascending by id. Ids have gaps where objects were merged.
    pub objects: Vec<Object>,
    /// Relations, ascending by subject, relation, object.
    pub relations: Vec<Relation>,
}

impl Scene {
    /// Format name in the file.
    pub const FORMAT: &str = "scene";
    /// Version of the format.
    pub const VERSION: u32 = 1;

    /// Reads the file.
    ///
    /// # Errors
    /// When it is missing or not such a file.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        Self::parse(&std::fs::read(path).at("read", path)?).map_err(|e| e.file(path))
    }

    /// Reads the content of such a file.
    ///
    /// # Errors
    /// When it is no JSON of this form, a number is not finite, ids don't ascend, or something names an object that isn't
    /// there.
    pub fn parse(bytes: &[u8]) -> Result<Self> {
        // The format first: a newer one may have other fields.
        #[derive(Deserialize)]
        struct Head {
            format: String,
            version: u32,
        }
        let damaged =
            |e: serde_json::Error| Error::new(format!("not a scene.json: {e}")).hint("make it again with export scene");
        let head: Head = serde_json::from_slice(bytes).map_err(damaged)?;
        if (&head.format[..], head.version) != (Self::FORMAT, Self::VERSION) {
            return Err(Error::new("another format")
                .field("format")
                .found(format!("{} version {}", head.format, head.version))
                .expected(format!("{} version {}", Self::FORMAT, Self::VERSION)));
        }
        let scene: Self = serde_json::from_slice(bytes).map_err(damaged)?;
        scene.check()?;
        Ok(scene)
    }

    /// Writes the file.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<()> {
        write_json(path, self)
    }

    /// The object of an id.
    pub fn object(&self, id: u32) -> Option<&Object> {
        self.objects.binary_search_by_key(&id, |o| o.id).ok().map(|i| &self.objects[i])
    }

    fn check(&self) -> Result<()> {
        for (at, o) in self.objects.iter().enumerate() {
            if at > 0 && self.objects[at - 1].id >= o.id {
                return Err(Error::new("ids do not ascend").field(format!("objects[{at}].id")).found(o.id));
            }
        }
        let ids: BTreeSet<u32> = self.objects.iter().map(|o| o.id).collect();
        for (at, r) in self.relations.iter().enumerate() {
            if let Some(id) = [r.subject, r.object].into_iter().find(|id| !ids.contains(id)) {
                let field = format!("relations[{at}]");
                return Err(Error::new("no such object").field(field).found(id).expected("an id of objects"));
            }
        }
        if let Some(up) = &self.up
            && !up.is_unit()
        {
            let found = format!("{:?}", up.direction);
            return Err(Error::new("not a direction").field("up.direction").found(found).expected("a unit vector"));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{describe, testing};
    use artifacts::Remarks;
    use serde_json::{Value, json};

    fn sample() -> Value {
        let (instances, gaussians) = testing::boxes(&[([0.0; 3], [1.0; 3]), ([0.2, 0.2, 1.0], [0.4, 0.4, 1.2])]);
        let up = "z".parse().ok();
        let scene = describe(&instances, &gaussians, &Remarks::default(), &BTreeMap::new(), up, BTreeMap::new());
        serde_json::to_value(scene).unwrap()
    }

    #[test]
    fn a_scene_reads_as_it_was_written() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("scene.json");
        let scene = Scene::parse(sample().to_string().as_bytes()).unwrap();
        scene.write(&path).unwrap();
        assert_eq!(Scene::read(&path).unwrap(), scene);
        assert_eq!(scene.relations.len(), 1);
        assert!(scene.shift.is_none() && !sample().as_object().unwrap().contains_key("shift"));
        let far = Scene { shift: Some([448_262.0, 5_411_932.0, 114.0]), ..scene.clone() };
        far.write(&path).unwrap();
        assert_eq!(Scene::read(&path).unwrap(), far);
        assert_eq!((scene.object(1).map(|o| o.id), scene.object(2)), (Some(1), None));
    }

    #[test]
    fn scenes_that_cannot_be_are_refused() {
        let refused = |change: &dyn Fn(&mut Value), part: &str| {
            let mut scene = sample();
            change(&mut scene);
            let e = Scene::parse(scene.to_string().as_bytes()).unwrap_err().to_string();
            assert!(e.contains(part), "{part}: {e}");
        };
        refused(
            &|s| s["version"] = json!(2),
            "format: another format; found scene version 2, expected scene version 1",
        );
        refused(&|s| s["format"] = json!("features"), "another format");
        refused(&|s| s["objects"][1]["id"] = json!(0), "objects[1].id: ids do not ascend; found 0");
        refused(&|s| s["objects"][0]["centroid"][1] = json!(1e39), "not a scene.json: number out of range");
        refused(&|s| s["relations"][0]["object"] = json!(9), "relations[0]: no such object; found 9");
        refused(&|s| s["relations"][0]["relation"] = json!("above"), "not a scene.json");
        refused(&|s| s["up"]["direction"] = json!([0, 0, 2]), "up.direction: not a direction");
        refused(&|s| s["more"] = json!(1), "not a scene.json: unknown field `more`");
        assert!(Scene::parse(b"{").is_err() && Scene::parse(&[0xff; 9]).is_err() && Scene::parse(b"").is_err());
        let e = Scene::read("no/such/scene.json").unwrap_err().to_string();
        assert!(e.starts_with("no/such/scene.json: cannot read"), "{e}");
    }
}
