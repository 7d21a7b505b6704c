//! Asking instances for what a feature means: the parts of a query that stay loaded between queries.

use crate::options::{Choice, Granularity};
use artifacts::role;
use gs_io::Result;
use query::{
    Granules, Index, Join, Kind, LabelledScene, Ranked, Selection, TextSource, Unrelated, Verdict, read_features,
};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Everything that answers queries about one set of instances.
pub struct Asker<'a> {
    /// The instances, laid out.
    pub index: Index<'a>,
    /// Where text features come from; none where only pictures or places are asked for.
    pub source: Option<TextSource>,
    /// Templates that every text is put into; none: the text as it is.
    pub templates: Vec<String>,
    /// Features of texts that mean nothing in particular ([`Index::scores`]).
    pub negatives: Vec<Vec<f32>>,
    /// Which instances of a ranking are selected.
    pub selection: Selection,
    /// Whether look-alikes of the best are selected with it.
    pub join: Option<Join>,
    /// Parts, things and groups.
    pub granules: Granules<'a>,
    /// Whether these answer instead of instances.
    pub any: bool,
    /// Whether the best is selected also where nothing matches.
    pub always: bool,
    /// What unrelated texts score ([`Unrelated`]); none where that is not asked.
    pub by_chance: Option<f32>,
}

/// The answer to one feature.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Answered {
    /// All instances with a score, best first.
    pub ranking: Vec<Ranked>,
    /// The selected ones, best first.
    pub selected: Vec<u32>,
    /// Score of the first selected.
    pub score: Option<f32>,
    /// What was found, where it is no instance but a part, a thing or a group.
    pub granule: Option<Found>,
    /// The selected Gaussians, ascending.
    pub gaussians: Vec<u32>,
    /// Whether a text matches anything; none where that is not judged.
    pub verdict: Option<Verdict>,
}

/// The part, thing or group that answers a query.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Found {
    /// Its index.
    pub index: u32,
    /// What it is.
    pub kind: Kind,
    /// Views in which a mask shows it.
    pub support: u32,
    /// Mean IoU with the best mask of each view, 0 to 1.
    pub fit: f32,
}

/// A place that was asked about.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
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

/// Ranked instances that `query.json` keeps for each text.
const KEPT_RANKS: usize = 20;

/// The answer to one query, in `query.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct QueryResult {
    /// What was asked for, also in names of files: the text, a picture's name, a place.
    pub text: String,
    /// `text`, `image`, `pixel`, `point`, or `part` of what was found.
    pub kind: String,
    /// Where, for a pixel or a point.
    pub place: Option<Place>,
    /// Whether a text matches anything; none where that is not judged: of pictures, places, and texts of a table.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub verdict: Option<Verdict>,
    /// What was found, where parts, things and groups answered.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub granule: Option<Found>,
    /// Selected instances, best first; of a part the instance that it is a part of.
    pub selected: Vec<u32>,
    /// Score of the best selected instance: cosine, relevancy, or share of a pixel.
    pub score: Option<f32>,
    /// Gaussians selected.
    pub gaussians: usize,
    /// File of the selected Gaussians, beside `query.json`; none when nothing is selected.
    pub ply: Option<String>,
    /// The best instances, selected or not.
    pub ranking: Vec<Entry>,
    /// Pictures.
    pub views: Vec<QueryView>,
}

/// An instance in the ranking of `query.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Entry {
    /// Which instance, and how well it fits.
    #[serde(flatten)]
    pub ranked: Ranked,
    /// What a person named it, where one did.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
}

/// Pictures of an answer in one view.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct QueryView {
    /// Stem of the view.
    pub view: String,
    /// File of the photograph with the selection brought out, beside `query.json`.
    pub overlay: String,
    /// File of the mask (255 inside, 0 outside), beside `query.json`.
    pub mask: String,
    /// Pixels of the mask.
    pub pixels: usize,
}

/// An answer, with the Gaussians that it selects, ascending.
pub struct Asked {
    pub result: QueryResult,
    pub gaussians: Vec<u32>,
}

impl Asked {
    /// What was asked for with its answer, of which there is no file yet.
    pub fn new(text: String, kind: &str, place: Option<Place>, answer: Answered) -> Self {
        let Answered { ranking, selected, score, granule, gaussians, verdict } = answer;
        let ranking = ranking.into_iter().take(KEPT_RANKS).map(|ranked| Entry { ranked, name: None }).collect();
        let (kind, count) = (kind.into(), gaussians.len());
        let (ply, views) = (None, Vec::new());
        let result =
            QueryResult { text, kind, place, verdict, granule, selected, score, gaussians: count, ply, ranking, views };
        Self { result, gaussians }
    }

    /// Puts in what instances were named.
    pub fn name(&mut self, names: &BTreeMap<u32, String>) {
        self.result.ranking.iter_mut().for_each(|e| e.name = names.get(&e.ranked.instance).cloned());
    }
}

impl<'a> Asker<'a> {
    /// What answers queries about a scene by the options.
    pub fn new(
        scene: &'a LabelledScene,
        source: Option<TextSource>,
        choice: &Choice,
        min_support: Option<u32>,
        granularity: Granularity,
    ) -> Result<Self> {
        let join = match (&choice.features, choice.join) {
            (Some(path), Some(distance)) => {
                let features = read_features(path, &scene.inputs[role::GEOMETRY], scene.gaussians().len())?;
                Some(Join::new(&scene.instances, &features, distance))
            }
            _ => None,
        };
        let negatives = source.as_ref().map_or(Ok(Vec::new()), |s| s.known(&[], &choice.negatives(), "--negatives"))?;
        let one = !choice.is_decided() && join.is_none();
        Ok(Self {
            granules: Granules::new(&scene.instances),
            any: one && granularity == Granularity::Any,
            always: choice.is_decided(),
            by_chance: None,
            index: Index::new(&scene.instances),
            source,
            templates: choice.templates.all(),
            negatives,
            selection: Selection::new(choice.top_k, choice.threshold, min_support.unwrap_or(1)),
            join,
        })
    }

    /// From here on texts are judged, where the source of their features can.
    ///
    /// # Errors
    /// When the encoder fails.
    pub fn judge(&mut self) -> Result<()> {
        let Some(source) = &self.source else { return Ok(()) };
        let chance = |u: Unrelated| u.chance(&self.index, &self.granules, &self.negatives, self.selection.min_support);
        self.by_chance = Unrelated::encode(source, &self.templates)?.and_then(chance);
        Ok(())
    }

    /// Answers a text by its feature: where it is judged and nothing matches, nothing is selected, unless people said how many.
    pub fn answer_text(&self, feature: &[f32]) -> Answered {
        let answer = self.answer(feature);
        let (negatives, least) = (&self.negatives, self.selection.min_support);
        let on = |chance| Verdict::on(feature, chance, &self.index, &self.granules, negatives, least);
        let verdict = self.by_chance.and_then(on);
        if verdict.is_some_and(|v| !v.matches) && !self.always {
            return Answered { ranking: answer.ranking, verdict, ..Answered::default() };
        }
        Answered { verdict, ..answer }
    }

    /// Answers one feature of the descriptors' dimension.
    pub fn answer(&self, feature: &[f32]) -> Answered {
        let ranking = self.index.rank(feature, &self.negatives);
        let meant = || self.granules.meant(feature, &self.negatives, self.selection.min_support);
        if let Some(meant) = self.any.then(meant).flatten() {
            let artifacts::Granule { support, fit, .. } = self.index.instances.granules[meant.granule as usize];
            let granule = Some(Found { index: meant.granule, kind: meant.kind, support, fit });
            let (selected, gaussians) = (meant.instances, meant.gaussians);
            return Answered { ranking, selected, score: Some(meant.score), granule, gaussians, verdict: None };
        }
        let mut selected = self.selection.choose(&ranking);
        if let Some(join) = &self.join {
            selected = join.extend(&ranking, self.selection.min_support, &selected);
        }
        let score = ranking.iter().find(|r| selected.first() == Some(&r.instance)).map(|r| r.score);
        let gaussians = self.index.members(&selected);
        Answered { ranking, selected, score, granule: None, gaussians, verdict: None }
    }
}
