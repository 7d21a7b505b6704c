//! `<name>.ids.json`: the object of each Gaussian of a splat, beside a file that cannot hold it.

use crate::Names;
use gs_io::{Error, IoContext, Result, hash_file, write_bytes};
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Ids of the Gaussians of a splat, by their order in its file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ids {
    format: String,
    version: u32,
    /// Content hash (BLAKE3) of the splat's file: another order of the Gaussians gives other bytes.
    pub splat: String,
    /// Object of each Gaussian, -1 for none.
    pub instance: Vec<i32>,
    /// What the objects are, ascending by id.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub objects: Vec<ObjectClass>,
    /// What `class_id` counts: the names, in alphabetical order.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub classes: Vec<String>,
}

/// An object and its class.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObjectClass {
    /// The number in `instance_id`.
    pub instance_id: u32,
    /// The number in `class_id`; -1 where it has no name.
    pub class_id: i32,
    /// Its name.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
}

/// The classes of objects by their names: objects of one name are of one class. Returns the classes, alphabetically.
pub fn classes(objects: &[u32], names: &Names) -> (Vec<ObjectClass>, Vec<String>) {
    let name = |id: &u32| names.get(id).map(|n| n.text.clone());
    let all: BTreeSet<String> = objects.iter().filter_map(name).collect();
    let classes: Vec<String> = all.into_iter().collect();
    let class = |&id: &u32| {
        let name = name(&id);
        let class_id = name.as_ref().and_then(|n| classes.binary_search(n).ok()).map_or(-1, |k| k as i32);
        ObjectClass { instance_id: id, class_id, name }
    };
    (objects.iter().map(class).collect(), classes)
}

impl Ids {
    /// Format name in the file.
    pub const FORMAT: &str = "gaussian-ids";
    const VERSION: u32 = 1;

    /// Where the ids of a splat lie: `a/b.spz` has `a/b.spz.ids.json`.
    pub fn path(splat: impl AsRef<Path>) -> PathBuf {
        gs_io::with_suffix(splat, ".ids.json")
    }

    /// Ids of the Gaussians of a splat as its file is now.
    ///
    /// # Errors
    /// When the splat cannot be read.
    pub fn of(splat: impl AsRef<Path>, instance: Vec<i32>) -> Result<Self> {
        let (format, splat) = (Self::FORMAT.into(), hash_file(splat)?);
        Ok(Self { format, version: Self::VERSION, splat, instance, objects: Vec::new(), classes: Vec::new() })
    }

    /// With what the objects are, as [`classes`] says.
    pub fn called(self, objects: Vec<ObjectClass>, classes: Vec<String>) -> Self {
        Self { objects, classes, ..self }
    }

    /// Writes them beside the splat.
    pub fn write(&self, splat: impl AsRef<Path>) -> Result<()> {
        // In one line: millions of numbers.
        let path = Self::path(splat);
        let json = serde_json::to_vec(self).map_err(|e| Error::new(e.to_string()).file(&path))?;
        write_bytes(&path, &json)
    }

    /// Reads the ids beside a splat that has `gaussians` Gaussians, and checks that they are of this very file.
    ///
    /// # Errors
    /// When the ids are missing or damaged, or the splat is not the file that they were made for: it was written again,
    /// perhaps in another order, so that they would name the wrong Gaussians.
    pub fn read(splat: impl AsRef<Path>, gaussians: usize) -> Result<Self> {
        let (splat, path) = (splat.as_ref(), Self::path(&splat));
        let ids = Self::parse(&std::fs::read(&path).at("read", &path)?).map_err(|e| e.file(&path))?;
        let hash = hash_file(splat)?;
        if ids.splat != hash {
            return Err(Error::new("the ids are of another file: its Gaussians may lie in another order")
                .file(&path)
                .field("splat")
                .found(format!("{:.12}", ids.splat))
                .expected(format!("{hash:.12} ({})", splat.display()))
                .hint("export splat and ids together again"));
        }
        if ids.instance.len() != gaussians {
            let e = Error::new("not an id per Gaussian").file(&path).field("instance");
            return Err(e.found(ids.instance.len()).expected(gaussians));
        }
        Ok(ids)
    }

    /// Reads the content of such a file, whatever splat it is of.
    ///
    /// # Errors
    /// When it is no JSON of this form, or an id is less than -1.
    pub fn parse(bytes: &[u8]) -> Result<Self> {
        let ids: Self = serde_json::from_slice(bytes).map_err(|e| {
            Error::new(format!("not ids of Gaussians: {e}"))
                .expected(r#"{"format", "version", "splat", "instance": [...]}"#)
        })?;
        if (&ids.format[..], ids.version) != (Self::FORMAT, Self::VERSION) {
            let e =
                Error::new("another format").field("format").found(format!("{} version {}", ids.format, ids.version));
            return Err(e.expected(format!("{} version {}", Self::FORMAT, Self::VERSION)));
        }
        if let Some((at, id)) = ids.instance.iter().enumerate().find(|(_, id)| **id < -1) {
            return Err(Error::new("no id").field(format!("instance[{at}]")).found(id).expected("-1 or more"));
        }
        Ok(ids)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::boxes;
    use crate::{Name, NameSource};
    use gs_scene::ply;

    #[test]
    fn ids_of_a_splat_in_another_order_are_refused() {
        let dir = tempfile::tempdir().unwrap();
        let splat = dir.path().join("a.ply");
        let (instances, gaussians) = boxes(&[([0.0; 3], [1.0; 3])]);
        let n = gaussians.len();
        ply::write_gaussians(&splat, &gaussians, &[]).unwrap();
        Ids::of(&splat, instances.label.clone()).unwrap().write(&splat).unwrap();
        assert_eq!(Ids::read(&splat, n).unwrap().instance, instances.label);
        assert!(dir.path().join("a.ply.ids.json").exists());
        let refused = |gaussians| Ids::read(&splat, gaussians).unwrap_err().to_string();
        assert!(refused(n - 1).contains("instance: not an id per Gaussian; found 730, expected 729"));
        // Two Gaussians change places: as many, but not the same.
        let order: Vec<u32> = [1, 0].into_iter().chain(2..n as u32).collect();
        ply::write_gaussians(&splat, &gaussians.select(&order), &[]).unwrap();
        assert!(refused(n).contains("splat: the ids are of another file"), "{}", refused(n));
        std::fs::remove_file(Ids::path(&splat)).unwrap();
        assert!(refused(n).contains("a.ply.ids.json: cannot read"));
    }

    #[test]
    fn objects_of_one_name_are_of_one_class() {
        let name = |text: &str| Name { text: text.into(), from: NameSource::Edits, sure: true };
        let names = Names::from([(3, name("plate")), (5, name("mug")), (9, name("plate"))]);
        let (objects, classes) = classes(&[3, 4, 5, 9], &names);
        assert_eq!(classes, ["mug", "plate"]);
        assert_eq!(
            objects.iter().map(|o| (o.instance_id, o.class_id)).collect::<Vec<_>>(),
            [(3, 1), (4, -1), (5, 0), (9, 1)]
        );
    }

    #[test]
    fn damaged_ids_are_refused() {
        for (text, part) in [
            (r#"{"format":"gaussian-ids","version":1,"splat":"","instance":[0,-2]}"#, "instance[1]: no id; found -2"),
            (r#"{"format":"gaussian-ids","version":2,"splat":"","instance":[]}"#, "format: another format"),
            (r#"{"format":"gaussian-ids","version":1,"splat":"","instance":[9999999999]}"#, "not ids of Gaussians"),
            (r#"{"format":"gaussian-ids","version":1,"splat":""}"#, "not ids of Gaussians: missing field"),
            ("", "not ids of Gaussians"),
        ] {
            let e = Ids::parse(text.as_bytes()).unwrap_err().to_string();
            assert!(e.contains(part), "{part}: {e}");
        }
    }
}
