//! What `eval score` finds: `score.json`.

use super::label_iou::LabelScore;
use crate::silhouette::Silhouette;
use serde::{Deserialize, Serialize};

/// `score.json`. Fields are null where the scene has no truth for them; `skipped` says why.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Scores {
    /// Mean over all true things of the best IoU with any instance.
    pub instance_miou: Option<f64>,
    /// The same over objects only, without floor, walls and other background.
    pub object_miou: Option<f64>,
    /// Fraction of true things with best IoU above 0.25.
    pub instance_macc25: Option<f64>,
    /// Fraction of true things with best IoU above 0.5.
    pub instance_macc50: Option<f64>,
    /// True things that fell into several instances.
    pub fragmented: Option<usize>,
    /// Instances that hold several true things.
    pub merging: Option<usize>,
    /// Fragmentation: instances per true thing (see [`InstanceScore`](super::metrics::InstanceScore)).
    pub instances_per_thing: Option<f64>,
    /// Merging: true things per instance.
    pub things_per_instance: Option<f64>,
    /// Average precision at IoU 0.25 over surface points, by ScanNet's matching,
    /// of instances of at least 100 points.
    pub ap25: Option<f64>,
    /// The same at IoU 0.5.
    pub ap50: Option<f64>,
    /// The same with all instances alike confident, as the tables of methods without scores have it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unranked: Option<Precision>,
    /// How many instances are one whole thing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub whole: Option<WholeScore>,
    /// What masks show as one, overlapping, where the instances have such proposals.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub proposals: Option<ProposalScores>,
    /// The same scores over Gaussians instead of surface points.
    pub gaussians: Option<GaussianScores>,
    /// Each true thing.
    pub things: Vec<ThingScore>,
    /// Mean over all labelled objects of all labelled views of the best IoU with any instance's visible pixels.
    pub label_miou: Option<f64>,
    /// Fraction of them with best IoU above 0.25.
    pub label_macc25: Option<f64>,
    /// Fraction of them with best IoU above 0.5.
    pub label_macc50: Option<f64>,
    /// Each labelled object of each labelled view.
    pub labels: Vec<LabelScore>,
    /// Mean IoU over all (frame, category) pairs.
    pub query_miou: Option<f64>,
    /// Fraction of pairs with IoU above 0.25.
    pub query_macc25: Option<f64>,
    /// Fraction of pairs with IoU above 0.5.
    pub query_macc50: Option<f64>,
    /// Mean IoU over all pairs when only what the view shows of the selection counts (occlusion-aware, share above 0.5),
    /// whatever `silhouette` says. Labels outline what is seen, so hidden objects cost `query_miou` but not this.
    pub query_miou_visible: Option<f64>,
    /// Number of (frame, category) pairs.
    pub query_pairs: usize,
    /// Each query with its mean IoU.
    pub queries: Vec<QueryScore>,
    /// Queries for parts of things ("handle of the red mug"), where the scene has labels of them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub parts: Option<FinerScore>,
    /// Queries for groups of things ("red mug and blue bowl"), likewise.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub groups: Option<FinerScore>,
    /// Queries for what is absent, for one thing and for several, where the scene has labels of them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub counted: Option<CountedScore>,
    /// How selections became masks, `selected` or `visible`, and above which value.
    pub silhouette: Option<(Silhouette, f32)>,
    /// What was left out, and why.
    pub skipped: Vec<String>,
}

/// Average precision over surface points, of what has at least 100 of them; none without a true thing.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Precision {
    /// At IoU 0.25.
    pub ap25: Option<f64>,
    /// At IoU 0.5.
    pub ap50: Option<f64>,
}

/// Instances of at least 100 surface points, and those with an IoU above 0.5 with a true thing, background too.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct WholeScore {
    /// Instances.
    pub instances: usize,
    /// Those that are whole.
    pub whole: usize,
    /// The half of the instances with the higher confidence, rounded down, has so many of these.
    pub in_upper_half: usize,
}

/// Parts, things and groups that masks show as one (`granules`), by falling fit; one that has an IoU of 0.3 or more with a better one is
/// left out, and one of fewer than 100 surface points.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ProposalScores {
    /// Proposals that are left.
    pub count: usize,
    /// True things of at least 100 points, without background.
    pub things: usize,
    /// Those of the things that some proposal has an IoU above 0.5 with.
    pub found: usize,
    /// Mean over the things of the best IoU with any proposal.
    pub object_miou: f64,
    /// Average precision, ranked by fit, of all true things.
    pub ranked: Precision,
    /// The same with all proposals alike confident.
    pub unranked: Precision,
}

/// Scores over Gaussians of opacity at least 0.1, each belonging to the thing of the nearest surface point.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GaussianScores {
    /// Gaussians that count.
    pub count: usize,
    /// Mean over true things of the best IoU with any instance.
    pub instance_miou: f64,
    /// Average precision at IoU 0.25, of instances of at least 10 Gaussians.
    pub ap25: Option<f64>,
    /// The same at IoU 0.5.
    pub ap50: Option<f64>,
}

/// How one true thing was found.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ThingScore {
    /// Id of the thing.
    pub id: i32,
    /// Its name, where the truth has one.
    pub name: String,
    /// Whether it is background.
    pub background: bool,
    /// Points of its surface.
    pub points: usize,
    /// Best IoU with any instance.
    pub iou: f64,
    /// The instance that gives it.
    pub instance: Option<i32>,
    /// Instances that hold at least a tenth of it.
    pub fragments: usize,
}

/// How queries of one kind were answered, over all (frame, category) pairs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FinerScore {
    /// Mean IoU.
    pub query_miou: f64,
    /// Fraction with IoU above 0.25.
    pub query_macc25: f64,
    /// Mean IoU when only what the view shows of the selection counts.
    pub query_miou_visible: f64,
    /// Number of pairs.
    pub query_pairs: usize,
}

/// How queries were answered that ask for none, one or several things, where a text that matches nothing selects nothing.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CountedScore {
    /// Mean of the generalised IoU over all pairs.
    pub giou: f64,
    /// Names of what is not there.
    pub absent: Option<Counted>,
    /// Names of things.
    pub one: Option<Counted>,
    /// Names that mean several things.
    pub several: Option<Counted>,
}

/// Queries that ask for so many.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Counted {
    /// Texts asked.
    pub texts: usize,
    /// Texts that are said to match something.
    pub believed: usize,
    /// Number of (frame, text) pairs.
    pub pairs: usize,
    /// Mean over the pairs of the IoU of what the view shows of the selection; where nothing is to be found 1 for nothing, 0 for
    /// anything.
    pub giou: f64,
}

/// How one query was answered.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct QueryScore {
    /// The category of the labels, which is the text.
    pub text: String,
    /// Mean IoU over its frames.
    pub iou: f64,
    /// Selected instances, best first.
    pub selected: Vec<u32>,
    /// Cosine of the best.
    pub score: Option<f32>,
    /// Place among all instances, best first from 1, of the one that fits the labels best ([`LabelScore`]); none where no
    /// instance touches them, or it has no descriptor.
    #[serde(default)]
    pub rank: Option<usize>,
    /// Stem and IoU of each labelled frame.
    pub frames: Vec<(String, f64)>,
}

impl CountedScore {
    /// The figures of all pairs; none where there are none.
    pub fn of([absent, one, several]: [Option<Counted>; 3]) -> Option<Self> {
        let all: Vec<&Counted> = [&absent, &one, &several].into_iter().flatten().collect();
        let pairs: usize = all.iter().map(|c| c.pairs).sum();
        let giou = all.iter().map(|c| c.giou * c.pairs as f64).sum::<f64>() / pairs.max(1) as f64;
        (pairs > 0).then_some(Self { giou, absent, one, several })
    }
}

impl Scores {
    /// The scores as a table for the terminal.
    pub fn table(&self) -> String {
        let mut s = String::new();
        let mut line = |name: &str, value: Option<String>| {
            if let Some(value) = value {
                s += &format!("{name:<16} {value}\n");
            }
        };
        let number = |v: Option<f64>| v.map(|v| format!("{v:.4}"));
        line("instance_miou", number(self.instance_miou));
        line("object_miou", number(self.object_miou));
        line("instance_macc25", number(self.instance_macc25));
        line("instance_macc50", number(self.instance_macc50));
        line("fragmented", self.fragmented.map(|n| format!("{n} of {} things", self.things.len())));
        line("merging", self.merging.map(|n| format!("{n} instances")));
        line("label_miou", number(self.label_miou));
        line("label_macc25", number(self.label_macc25));
        line("label_macc50", number(self.label_macc50));
        line("labels", self.label_miou.map(|_| format!("{} objects in views", self.labels.len())));
        line("instances/thing", number(self.instances_per_thing));
        line("things/instance", number(self.things_per_instance));
        line("ap25", number(self.ap25));
        line("ap50", number(self.ap50));
        line("  unranked", number(self.unranked.and_then(|u| u.ap50)));
        line("whole", self.whole.map(|w| format!("{} of {} instances", w.whole, w.instances)));
        if let Some(p) = &self.proposals {
            line("proposals", Some(format!("{} of {} things found", p.found, p.things)));
            line("  object_miou", number(Some(p.object_miou)));
            line("  ap25", number(p.ranked.ap25));
            line("  ap50", number(p.ranked.ap50));
        }
        line("per Gaussian", number(self.gaussians.as_ref().map(|g| g.instance_miou)));
        line("  ap25", number(self.gaussians.as_ref().and_then(|g| g.ap25)));
        line("  ap50", number(self.gaussians.as_ref().and_then(|g| g.ap50)));
        line("query_miou", number(self.query_miou));
        line("  visible only", number(self.query_miou_visible));
        line("query_macc25", number(self.query_macc25));
        line("query_macc50", number(self.query_macc50));
        line("parts", number(self.parts.as_ref().map(|p| p.query_miou)));
        line("groups", number(self.groups.as_ref().map(|g| g.query_miou)));
        if let Some(CountedScore { giou, absent, one, several }) = &self.counted {
            line("0, 1 or N", Some(format!("{giou:.4}")));
            for (name, of) in [("  absent", absent), ("  one", one), ("  several", several)] {
                let shown = |c: &Counted| format!("{:.4}, {} of {} texts match", c.giou, c.believed, c.texts);
                line(name, of.as_ref().map(shown));
            }
        }
        line("queries", self.query_miou.map(|_| format!("{} in {} pairs", self.queries.len(), self.query_pairs)));
        for reason in &self.skipped {
            s += &format!("skipped          {reason}\n");
        }
        s
    }
}
