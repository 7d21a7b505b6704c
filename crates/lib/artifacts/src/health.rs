//! What `cluster-match` keeps of masks and instances in `instances.safetensors`. None of it tells whether instances are whole things: on scenes with
//! truth nothing that is known without it did (docs/results/lost.md).

use crate::Naming;
use gs_io::{Artifact, Error, Result};
use serde::{Deserialize, Serialize};

/// How far masks and instances agree, and what masks with names call them: `extra.health` of `instances.safetensors`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Health {
    /// Share of the labelled Gaussians in the largest instance, 0 to 1.
    pub largest: f64,
    /// Purity of the masks: the share of a mask's weight that lies in one instance, mean over masks by their weight. It is an
    /// estimate: all views made the instances, so a mask that most views contradict shows here as impure. None without
    /// masks.
    pub purity: Option<f64>,
    /// Names of the instances that masks with names show, ascending. The score is the share of the instance's weight, in all masks of
    /// these levels, that lies in masks of that name, times how sure the model is; half of it makes a name sure.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub names: Vec<Naming>,
}

impl Health {
    /// That of an `instances` artifact; `None` where an older program wrote it.
    ///
    /// # Errors
    /// When it is not one.
    pub fn of(artifact: &Artifact) -> Result<Option<Self>> {
        let Some(value) = artifact.provenance().extra.get("health") else { return Ok(None) };
        serde_json::from_value(value.clone()).map(Some).map_err(|e| {
            Error::new(format!("not the figures of masks and instances: {e}"))
                .file(artifact.path())
                .field("extra.health")
                .hint("run cluster-match again")
        })
    }

    /// The figures, each as its name and its value for people.
    pub fn figures(&self) -> [(String, String); 2] {
        let percent = |v: f64| format!("{:.0} %", 100.0 * v);
        [
            ("of the Gaussians in the largest instance".into(), percent(self.largest)),
            ("of a mask in one instance, on average".into(), self.purity.map_or("no masks".into(), percent)),
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Instances;
    use gs_io::Provenance;
    use serde_json::json;

    #[test]
    fn it_is_read_from_the_instances_that_have_it() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("i.safetensors");
        let read = |extra| {
            Instances::default().write(&path, Provenance { extra, ..Provenance::default() }).unwrap();
            Health::of(&Instances::read(&path).unwrap().1)
        };
        let health = Health { largest: 0.5, ..Health::default() };
        assert_eq!(read(json!({ "health": health })).unwrap(), Some(health));
        assert_eq!(read(json!(null)).unwrap(), None);
        assert!(read(json!({"health": {"largest": "all"}})).unwrap_err().to_string().contains("extra.health"));
    }
}
