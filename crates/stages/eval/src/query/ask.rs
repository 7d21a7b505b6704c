//! Asking instances for what a feature means: the parts of a query that stay loaded between queries.

use super::ranking::{Index, Join, Ranked, Scoring, Selection};
use super::text::TextSource;
use crate::options::Choice;
use crate::scene::LabelledScene;
use artifacts::{Features, role};
use gs_io::{Error, Result};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Everything that answers queries about one set of instances.
pub struct Asker<'a> {
    /// The instances, laid out.
    pub index: Index<'a>,
    /// Where text features come from; none where only pictures or places are asked for.
    pub source: Option<TextSource>,
    /// Templates that every text is put into; none: the text as it is.
    pub templates: Vec<String>,
    /// How descriptors are compared with features.
    pub scoring: Scoring,
    /// Which instances of a ranking are selected.
    pub selection: Selection,
    /// Whether look-alikes of the best are selected with it.
    pub join: Option<Join>,
}

/// The answer to one feature.
#[derive(Debug, Clone, PartialEq)]
pub struct Answered {
    /// All instances with a score, best first.
    pub ranking: Vec<Ranked>,
    /// The selected ones, best first.
    pub selected: Vec<u32>,
    /// Score of the first selected.
    pub score: Option<f32>,
    /// Their Gaussians, ascending.
    pub gaussians: Vec<u32>,
}

/// A place that was asked about.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Place {
    /// Stem of the view, for a pixel.
    pub view: Option<String>,
    /// The pixel, x and y.
    pub pixel: Option<[u32; 2]>,
    /// Where it is in the world: the mean of what the pixel shows, or the nearest labelled Gaussian's centre. None when
    /// there is nothing.
    pub position: Option<[f64; 3]>,
    /// Accumulated alpha of the pixel, 0 to 1, or distance from the point to that Gaussian.
    pub alpha_or_distance: Option<f64>,
    /// Share of the pixel that belongs to no instance, 0 to 1.
    pub noise: f64,
    /// What it may be called: texts by falling score with the first instance's descriptor.
    pub names: Vec<(String, f32)>,
}

/// What was asked for, with its answer.
pub struct Asked {
    /// What it is called in `query.json` and in names of files: the text, a picture's name, a place.
    pub name: String,
    /// `text`, `image`, `pixel`, `point`, or `part` of what was found.
    pub kind: &'static str,
    /// The answer.
    pub answer: Answered,
    /// Where, for a pixel or a point.
    pub place: Option<Place>,
}

impl Asked {
    /// The answer to a text or a picture.
    pub fn new(name: String, kind: &'static str, answer: Answered) -> Self {
        Self { name, kind, answer, place: None }
    }
}

fn join(path: &Path, distance: f32, scene: &LabelledScene) -> Result<Join> {
    let (features, artifact) = Features::read(path)?;
    artifact.expect_input(role::GEOMETRY, scene.inputs.get(role::GEOMETRY).map_or("", |h| h))?;
    if features.kept.last().is_some_and(|&last| last as usize >= scene.instances.label.len()) {
        return Err(Error::new("the features are of other Gaussians").file(path).field("kept"));
    }
    Ok(Join::new(&scene.instances, &features, distance))
}

impl<'a> Asker<'a> {
    /// What answers queries about a scene by the options.
    pub fn new(
        scene: &'a LabelledScene,
        source: Option<TextSource>,
        choice: &Choice,
        min_support: Option<u32>,
    ) -> Result<Self> {
        let join = match (&choice.features, choice.join) {
            (Some(path), Some(distance)) => Some(join(path, distance, scene)?),
            _ => None,
        };
        let negatives = source.as_ref().map_or(Ok(Vec::new()), |s| s.known(&choice.negatives, "--negatives"))?;
        Ok(Self {
            index: Index::new(&scene.instances),
            source,
            templates: choice.template.clone(),
            scoring: Scoring { negatives },
            selection: Selection::new(choice.top_k, choice.threshold, min_support.unwrap_or(1)),
            join,
        })
    }

    /// The source of text features, in words.
    pub fn describe(&self) -> String {
        self.source.as_ref().map_or("none".into(), TextSource::describe)
    }

    /// Features of texts, all of which must have one.
    pub fn known_features(&self, texts: &[String]) -> Result<Vec<Vec<f32>>> {
        let source = self.source.as_ref().expect("a source of text features");
        let one = |(f, text): (Option<Vec<f32>>, &String)| f.ok_or_else(|| source.unknown(text));
        self.features(texts)?.into_iter().zip(texts).map(one).collect()
    }

    /// Features of texts, in order; none for a text that a table does not hold.
    pub fn features(&self, texts: &[String]) -> Result<Vec<Option<Vec<f32>>>> {
        self.source.as_ref().expect("a source of text features").encode_in(&self.templates, texts)
    }

    /// Answers one feature.
    pub fn answer(&self, feature: &[f32]) -> Answered {
        self.select(self.index.rank(feature, &self.scoring))
    }

    /// Selects from a ranking that is there already.
    pub fn select(&self, ranking: Vec<Ranked>) -> Answered {
        let mut selected = self.selection.choose(&ranking);
        if let Some(join) = &self.join {
            selected = join.extend(&ranking, self.selection.min_support, &selected);
        }
        let score = ranking.iter().find(|r| selected.first() == Some(&r.instance)).map(|r| r.score);
        let gaussians = self.index.members(&selected);
        Answered { ranking, selected, score, gaussians }
    }
}
