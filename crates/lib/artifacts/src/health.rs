//! How sound masks and instances are: figures that `cluster-match` keeps in `instances.safetensors`, and what they say.

use gs_io::{Artifact, Error, Result};
use serde::{Deserialize, Serialize};

/// An instance with more than this share of the labelled Gaussians is doubtful.
const TOO_LARGE: f64 = 1.0 / 3.0;
/// Masks below this purity are.
const IMPURE: f64 = 0.7;
/// Two instances that share this much of their masks or more may be one thing.
pub const SHARED: f64 = 0.8;
/// More than this share of the Gaussians in such instances is doubtful: a few small pieces always share their masks.
const SHARING: f64 = 0.1;
/// Pairs that a sentence names.
const NAMED: usize = 3;

/// Two instances and how often they lie in one mask.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct SharedMasks {
    /// The instances, the smaller number first.
    pub instances: [u32; 2],
    /// Share of the views that show both, levels counted apart and each weighted by what it sees of them, in which one mask
    /// holds the greater part of either; [`SHARED`] to 1.
    pub share: f64,
}

/// How far masks and instances agree: `extra.health` of `instances.safetensors`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Health {
    /// Share of the labelled Gaussians in the largest instance, 0 to 1.
    pub largest: f64,
    /// Purity of the masks: the share of a mask's weight that lies in one instance, mean over masks by their weight. It is an
    /// estimate: all views made the instances, so a mask that most views contradict shows here as impure. None without
    /// masks.
    pub purity: Option<f64>,
    /// Share of the labelled Gaussians in instances that share [`SHARED`] of their masks or more with another, 0 to 1.
    pub sharing: f64,
    /// Pairs of such instances.
    pub pairs: usize,
    /// The first of these, those that share most first.
    pub shared: Vec<SharedMasks>,
}

/// One figure, and what to do about it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Finding {
    /// What was measured.
    pub name: &'static str,
    /// What was found, for people.
    pub found: String,
    /// What is wrong and what to try; none where all is well.
    pub advice: Option<String>,
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

    /// The figures in words, each with what to try where it is doubtful.
    pub fn findings(&self) -> [Finding; 3] {
        let percent = |v: f64| format!("{:.0} %", 100.0 * v);
        let (largest, purity) = (percent(self.largest), self.purity.map_or("no masks".into(), percent));
        let too_large = format!(
            "one instance holds {largest} of the Gaussians; if it is more than floor or walls, try cluster-match --levels \
             small, or a larger --agreement"
        );
        let impure = "the masks of the views contradict each other; look at the masks in the report, and try \
                      cluster-match --levels small, or more views";
        let pair = |s: &SharedMasks| {
            let [a, b] = s.instances;
            format!("instances {a} and {b} share {} of their masks", percent(s.share))
        };
        let named = self.shared.iter().take(NAMED).map(pair).collect::<Vec<_>>().join(", ");
        let more = match self.pairs.saturating_sub(NAMED) {
            0 => String::new(),
            n => format!(" and {n} more pairs share most of theirs"),
        };
        let one_thing = format!(
            "{named}{more}: each pair may be one thing in pieces; try cluster-match with a smaller --agreement, or more views"
        );
        [
            Finding {
                name: "of the Gaussians in the largest instance",
                found: largest,
                advice: (self.largest > TOO_LARGE).then_some(too_large),
            },
            Finding {
                name: "of a mask in one instance, on average",
                found: purity,
                advice: self.purity.filter(|p| *p < IMPURE).map(|_| impure.into()),
            },
            Finding {
                name: "of the Gaussians in instances that share most of their masks with another",
                found: percent(self.sharing),
                advice: (self.sharing > SHARING).then_some(one_thing),
            },
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
    fn sound_figures_have_no_advice_and_doubtful_ones_say_what_to_try() {
        let sound = Health { largest: 0.3, purity: Some(0.9), sharing: 0.1, pairs: 1, ..Health::default() };
        assert!(sound.findings().iter().all(|f| f.advice.is_none()) && sound.findings()[0].found == "30 %");
        let pair = |a, b, share| SharedMasks { instances: [a, b], share };
        let shared = vec![pair(3, 17, 0.85), pair(1, 2, 0.84), pair(4, 5, 0.83), pair(6, 7, 0.8)];
        let doubtful = Health { largest: 0.4, purity: Some(0.6), sharing: 0.2, pairs: 9, shared };
        let advice = doubtful.findings().map(|f| f.advice.unwrap());
        assert!(advice[0].contains("40 %") && advice[0].contains("--levels small"), "{advice:?}");
        assert!(advice[1].contains("contradict"), "{advice:?}");
        assert!(advice[2].starts_with("instances 3 and 17 share 85 % of their masks, "), "{advice:?}");
        assert!(advice[2].contains("and 6 more pairs") && !advice[2].contains("instances 6 and 7"), "{advice:?}");
    }

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
