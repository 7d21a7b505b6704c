//! `names.json`: what instances are called, by a vocabulary.

use crate::edits::Remarks;
use gs_io::{Error, IoContext, Result, check_name, write_json};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// `names.json`: the best names of every instance, as it was clustered. docs/queries.md says how they are found.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct InstanceNames {
    /// [`InstanceNames::FORMAT`].
    pub format: String,
    /// [`InstanceNames::VERSION`].
    pub version: u32,
    /// Content hash of the `instances.safetensors` that it is about.
    pub instances: String,
    /// Where text features came from, for people.
    pub source: String,
    /// Content hash of the text encoder's graph, or of the table; empty where masks alone gave the names.
    pub model: String,
    /// Content hash of the vocabulary: its names, one a line; empty where masks alone gave the names.
    pub vocabulary: String,
    /// Names in it.
    pub words: usize,
    /// The margin that is no better than chance; none where the names have fewer than three meanings, or nothing is named.
    pub by_chance: Option<f32>,
    /// Instances with a descriptor or with masks that have names, ascending.
    pub named: Vec<Naming>,
}

/// What an instance may be called.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Naming {
    /// Index of the instance.
    pub instance: u32,
    /// The best names, best first; 1 to 3.
    pub names: Vec<ScoredName>,
    /// How much better the first name is than the best one of another meaning, on the scale of the scores; 0 or more.
    pub margin: f32,
    /// Whether that is more than chance.
    pub sure: bool,
}

/// A name with its score.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScoredName {
    /// The name.
    pub name: String,
    /// Cosine of its feature with the descriptor, -1 to 1; of a name that masks give, see [`crate::Health::names`].
    pub score: f32,
}

/// What one instance is called.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Called {
    /// The name.
    pub name: String,
    /// Whether a person said so; else it is the best of a vocabulary.
    pub by_person: bool,
    /// Whether it is more than a guess: always so where a person said it.
    pub sure: bool,
}

impl InstanceNames {
    /// Format name in the file.
    pub const FORMAT: &str = "names";
    /// Version of the format.
    pub const VERSION: u32 = 1;

    /// The names that masks give to instances of this content hash ([`crate::Health::names`]), without a vocabulary.
    pub fn by_masks(named: Vec<Naming>, instances: &str) -> Self {
        let words: BTreeSet<&str> = named.iter().flat_map(|n| &n.names).map(|s| s.name.as_str()).collect();
        Self {
            format: Self::FORMAT.into(),
            version: Self::VERSION,
            instances: instances.into(),
            source: "names of the masks".into(),
            words: words.len(),
            named,
            ..Self::default()
        }
    }

    /// Where the names of instances lie: `names.json` beside them.
    pub fn path_beside(instances: impl AsRef<Path>) -> PathBuf {
        instances.as_ref().with_file_name("names.json")
    }

    /// Reads the names of the instances of this content hash.
    ///
    /// # Errors
    /// When the file is missing, not such a file, or about other instances.
    pub fn read(path: impl AsRef<Path>, instances: &str) -> Result<Self> {
        let path = path.as_ref();
        let bytes = std::fs::read(path).at("read", path)?;
        let names = Self::parse(&bytes).map_err(|e| e.file(path))?;
        if names.instances != instances {
            return Err(Error::new("names of other instances")
                .file(path)
                .field("instances")
                .found(format!("{:.12}", names.instances))
                .expected(format!("{instances:.12}"))
                .hint("run eval names again"));
        }
        Ok(names)
    }

    /// Reads the content of such a file.
    ///
    /// # Errors
    /// When it is no JSON of this form, instances do not ascend, or one has no name or a bad one ([`check_name`]).
    pub fn parse(bytes: &[u8]) -> Result<Self> {
        let wrong = |what: String| Error::new(what).hint("make it again with eval names");
        let names: Self = serde_json::from_slice(bytes).map_err(|e| wrong(format!("not a names.json: {e}")))?;
        if (&names.format[..], names.version) != (Self::FORMAT, Self::VERSION) {
            let found = format!("{} version {}", names.format, names.version);
            let e = wrong("another format".into()).field("format").found(found);
            return Err(e.expected(format!("{} version {}", Self::FORMAT, Self::VERSION)));
        }
        let ascend = names.named.windows(2).all(|w| w[0].instance < w[1].instance);
        if !ascend || names.named.iter().any(|n| n.names.is_empty() || n.names.iter().any(|s| s.name.is_empty())) {
            let e = wrong("names that do not fit".into()).field("named");
            return Err(e.expected("instances that ascend, each with a name"));
        }
        let mut all = names.named.iter().flat_map(|n| &n.names);
        all.try_for_each(|s| check_name(&s.name)).map_err(|e| e.field("named"))?;
        Ok(names)
    }

    /// Writes the file.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<()> {
        write_json(path, self)
    }

    /// What an instance is called by the vocabulary.
    pub fn best(&self, instance: u32) -> Option<Called> {
        let at = self.named.binary_search_by_key(&instance, |n| n.instance).ok()?;
        let naming = &self.named[at];
        Some(Called { name: naming.names.first()?.name.clone(), by_person: false, sure: naming.sure })
    }
}

/// What instances are called after a person's edits: as the person said, else as the vocabulary has it. What was merged, split or emptied is no longer what
/// the vocabulary was asked about, and has no name of it.
pub fn called(names: Option<&InstanceNames>, remarks: &Remarks) -> BTreeMap<u32, Called> {
    let ids = names.into_iter().flat_map(|n| &n.named).map(|one| one.instance);
    let best = |k: u32| Some((k, names?.best(k)?));
    let mut called: BTreeMap<u32, Called> = ids.filter(|k| !remarks.changed.contains(k)).filter_map(best).collect();
    let by_person = |name: &String| Called { name: name.clone(), by_person: true, sure: true };
    called.extend(remarks.names.iter().map(|(&k, name)| (k, by_person(name))));
    called
}

impl std::fmt::Display for Called {
    /// The name; a guess with a question mark.
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}{}", self.name, if self.sure { "" } else { "?" })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names() -> InstanceNames {
        let naming = |instance, name: &str, sure| {
            let names = vec![ScoredName { name: name.into(), score: 0.5 }];
            Naming { instance, names, margin: 0.1, sure }
        };
        InstanceNames {
            format: InstanceNames::FORMAT.into(),
            version: InstanceNames::VERSION,
            instances: "h".into(),
            named: vec![naming(0, "mug", true), naming(2, "plate", false), naming(3, "bowl", true)],
            ..InstanceNames::default()
        }
    }

    #[test]
    fn a_person_is_believed_first_and_what_was_changed_has_no_guess() {
        let remarks = Remarks {
            names: BTreeMap::from([(0, "my cup".into()), (5, "lamp".into())]),
            changed: BTreeSet::from([3]),
            ..Remarks::default()
        };
        let said = |names: Option<&InstanceNames>| {
            called(names, &remarks).into_iter().map(|(k, c)| (k, c.to_string(), c.by_person)).collect::<Vec<_>>()
        };
        let [cup, lamp] = [(0, "my cup".to_string(), true), (5, "lamp".into(), true)];
        assert_eq!(said(Some(&names())), [cup.clone(), (2, "plate?".into(), false), lamp.clone()]);
        assert_eq!(said(None), [cup, lamp]);
    }

    #[test]
    fn a_file_reads_as_it_was_written_and_only_for_its_instances() {
        let dir = tempfile::tempdir().unwrap();
        let path = InstanceNames::path_beside(dir.path().join("instances.safetensors"));
        names().write(&path).unwrap();
        assert_eq!(InstanceNames::read(&path, "h").unwrap(), names());
        let e = InstanceNames::read(&path, "other").unwrap_err().to_string();
        assert!(
            e.contains("instances: names of other instances; found h, expected other; run eval names again"),
            "{e}"
        );
        for (from, to, part) in [
            ("\"version\": 1", "\"version\": 2", "found names version 2, expected names version 1"),
            ("\"instance\": 2", "\"instance\": 0", "names that do not fit"),
            ("\"bowl\"", "\"\"", "names that do not fit"),
            ("\"bowl\"", "\"\\u001b[2J\"", "named: a control character in the name"),
            ("\"sure\"", "\"Sure\"", "not a names.json"),
        ] {
            let text = std::fs::read_to_string(&path).unwrap().replace(from, to);
            let e = InstanceNames::parse(text.as_bytes()).unwrap_err().to_string();
            assert!(e.contains(part), "{e}");
        }
        assert!(InstanceNames::parse(b"").is_err());
    }
}
