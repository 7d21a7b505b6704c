//! Asking instances for what a feature means: the parts of a query that stay loaded between queries.

use crate::ranking::{Index, Join, Ranked, Scoring, Selection};
use crate::text::TextSource;
use gs_io::Result;

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

impl Asker<'_> {
    /// Features of texts, in order; none for a text that a table does not hold.
    ///
    /// # Errors
    /// When the engine fails.
    ///
    /// # Panics
    /// Without a source of text features: callers check.
    pub fn features(&self, texts: &[String]) -> Result<Vec<Option<Vec<f32>>>> {
        self.source.as_ref().expect("a source of text features").encode_in(&self.templates, texts)
    }

    /// Answers one feature.
    ///
    /// # Panics
    /// When the feature has another dimension than the descriptors.
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

    /// Relevancy of every instance for a map of it, 0 to 1: LERF's with negatives, else (1 + cosine) / 2; 0 for an
    /// instance without a descriptor.
    ///
    /// # Panics
    /// As [`Self::answer`].
    pub fn relevancy(&self, feature: &[f32]) -> Vec<f32> {
        let plain = self.scoring.negatives.is_empty();
        let one = |s: Option<f32>| s.map_or(0.0, |s| if plain { 0.5 * (1.0 + s) } else { s });
        self.index.scores(feature, &self.scoring).into_iter().map(one).collect()
    }
}
