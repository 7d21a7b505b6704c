//! Whether a text means anything that is there. Some instance is always the most like a text, so a best score says little alone:
//! beside it stand the best scores of texts that have nothing to do with any scene.

use crate::{Granules, Index, TextSource, encode_cached};
use gs_io::Result;
use serde::{Deserialize, Serialize};

/// Names of what is hardly ever in a scene, one a line.
const TEXTS: &str = include_str!("unrelated.txt");
/// The share of them whose best score a text that matches surpasses (docs/queries.md says how it was chosen).
const SHARE: f64 = 0.95;
/// A table that holds fewer of them judges nothing.
const LEAST: usize = 20;

/// Features of texts that have nothing to do with a scene.
pub struct Unrelated {
    features: Vec<Vec<f32>>,
}

/// Whether a text matches anything, and by what.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Verdict {
    /// Whether its best score is better than by chance.
    pub matches: bool,
    /// Its best score over instances, parts and groups: cosine, or relevancy with negatives.
    pub best: f32,
    /// What 95 of 100 unrelated texts do not surpass.
    pub by_chance: f32,
}

impl Unrelated {
    /// The texts: names of what is hardly ever in a scene.
    pub fn texts() -> impl Iterator<Item = &'static str> {
        TEXTS.lines()
    }

    /// Their features within the templates; none where the source is a table with fewer than 20 of them.
    ///
    /// # Errors
    /// When the encoder fails.
    pub fn encode(source: &TextSource, templates: &[String]) -> Result<Option<Self>> {
        let texts: Vec<String> = Self::texts().map(String::from).collect();
        let features: Vec<Vec<f32>> = encode_cached(source, templates, &texts)?.into_iter().flatten().collect();
        Ok((features.len() >= LEAST).then_some(Self { features }))
    }

    /// The score that 95 of 100 of them do not surpass; none where nothing has a score.
    pub fn chance(&self, index: &Index, granules: &Granules, negatives: &[Vec<f32>], min_support: u32) -> Option<f32> {
        let best = |f: &Vec<f32>| best_score(index, granules, f, negatives, min_support);
        share_of(self.features.iter().filter_map(best).collect())
    }
}

/// The value that 95 of 100 of these do not surpass; none of none.
pub(crate) fn share_of(mut values: Vec<f32>) -> Option<f32> {
    values.sort_unstable_by(f32::total_cmp);
    let at = (SHARE * values.len() as f64).ceil() as usize;
    values.get(at.saturating_sub(1)).copied()
}

impl Verdict {
    /// On a text's feature, where unrelated texts reach `by_chance`; none where nothing has a score.
    pub fn on(
        feature: &[f32],
        by_chance: f32,
        index: &Index,
        granules: &Granules,
        negatives: &[Vec<f32>],
        min_support: u32,
    ) -> Option<Self> {
        let best = best_score(index, granules, feature, negatives, min_support)?;
        Some(Self { matches: best > by_chance, best, by_chance })
    }
}

/// The best score of what masks show in enough views: an instance, a part or a group.
fn best_score(
    index: &Index,
    granules: &Granules,
    feature: &[f32],
    negatives: &[Vec<f32>],
    min_support: u32,
) -> Option<f32> {
    let instances = index.scores(feature, negatives).into_iter().zip(&index.instances.support);
    let instances = instances.filter(|(_, support)| **support >= min_support).filter_map(|(score, _)| score);
    let granules = granules.scores(feature, negatives, min_support).into_iter();
    instances.chain(granules.map(|(_, score)| score)).reduce(f32::max)
}

#[cfg(test)]
mod tests {
    use super::*;
    use artifacts::{Granule, Instances, Members};
    use ndarray::arr2;

    /// Instances along x and y; a group between x and z.
    fn instances() -> Instances {
        Instances {
            label: vec![0, 1],
            descriptor: arr2(&[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]),
            support: vec![5, 2],
            count: vec![1, 1],
            granules: vec![Granule { members: Members::Cluster(9), support: 3, fit: 0.9 }],
            granule_descriptor: arr2(&[[0.6, 0.0, 0.8]]),
            ..Instances::default()
        }
    }

    #[test]
    fn chance_is_what_nineteen_of_twenty_do_not_surpass() {
        let i = instances();
        let (index, granules) = (Index::new(&i), Granules::new(&i));
        // Cosines with x of 0.00 to 0.19, all smaller with the others.
        let feature = |k: usize| vec![k as f32 / 100.0, -1.0, 0.0];
        let unrelated = Unrelated { features: (0..20).map(feature).collect() };
        let chance = unrelated.chance(&index, &granules, &[], 1).unwrap();
        assert!((f64::from(chance) - 0.18 / f64::hypot(0.18, 1.0)).abs() < 1e-6, "{chance}");
        let on = |f: &[f32], least| Verdict::on(f, chance, &index, &granules, &[], least);
        let equal = on(&feature(18), 1).unwrap();
        assert_eq!((equal.matches, equal.best), (false, chance), "no better than chance");
        assert!(on(&feature(19), 1).unwrap().matches);
        assert!((on(&[0.6, 0.0, 0.8], 1).unwrap().best - 1.0).abs() < 1e-6, "groups count");
        assert!((on(&[0.6, 0.0, 0.8], 4).unwrap().best - 0.6).abs() < 1e-6, "rare ones do not");
        assert_eq!(on(&[0.0; 3], 1), None);
        assert_eq!(Unrelated { features: vec![vec![0.0; 3]] }.chance(&index, &granules, &[], 1), None);
    }

    #[test]
    fn the_texts_are_many_and_different() {
        let mut texts: Vec<&str> = Unrelated::texts().collect();
        assert!(texts.len() >= 60 && texts.iter().all(|t| !t.trim().is_empty()));
        texts.sort_unstable();
        assert!(texts.windows(2).all(|w| w[0] != w[1]));
    }

    #[test]
    fn a_table_judges_when_it_holds_twenty_of_them() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("texts.json");
        let judges = |count: usize| {
            let table: std::collections::BTreeMap<&str, [f32; 2]> =
                Unrelated::texts().take(count).chain(["mug"]).map(|t| (t, [1.0, 0.0])).collect();
            std::fs::write(&path, serde_json::to_string(&table).unwrap()).unwrap();
            let source = TextSource::Table(crate::TextTable::read(&path).unwrap());
            Unrelated::encode(&source, &[]).unwrap().is_some()
        };
        assert!(judges(20) && !judges(19));
    }
}
