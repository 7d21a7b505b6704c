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
/// Of fewer scores the mean says nothing, and counts as 0.
const FEW: usize = 5;

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
    /// What that would have to surpass: the mean of all scores of the text, and what 95 of 100 unrelated texts have at most above theirs.
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

    /// How far above the mean of all its scores the best of 95 of 100 of them is at most; none where nothing has a score. With CLIP each
    /// text has a level of its own, on which all pictures lie: what is above it tells more than the score (docs/results/queries.md).
    pub fn chance(&self, index: &Index, granules: &Granules, negatives: &[Vec<f32>], min_support: u32) -> Option<f32> {
        let best = |f: &Vec<f32>| {
            let (best, mean) = best_and_mean(index, granules, f, negatives, min_support)?;
            Some(best - mean)
        };
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
    /// On a text's feature, where unrelated texts are `chance` above their mean ([`Unrelated::chance`]); none where nothing has a score.
    pub fn on(
        feature: &[f32],
        chance: f32,
        index: &Index,
        granules: &Granules,
        negatives: &[Vec<f32>],
        min_support: u32,
    ) -> Option<Self> {
        let (best, mean) = best_and_mean(index, granules, feature, negatives, min_support)?;
        let by_chance = mean + chance;
        Some(Self { matches: best > by_chance, best, by_chance })
    }
}

/// The best score of what masks show in enough views, an instance, a part or a group, and the mean of all.
fn best_and_mean(
    index: &Index,
    granules: &Granules,
    feature: &[f32],
    negatives: &[Vec<f32>],
    min_support: u32,
) -> Option<(f32, f32)> {
    let instances = index.scores(feature, negatives).into_iter().zip(&index.instances.support);
    let instances = instances.filter(|(_, support)| **support >= min_support).filter_map(|(score, _)| score);
    let granules = granules.scores(feature, negatives, min_support).into_iter();
    let scores: Vec<f32> = instances.chain(granules.map(|(_, score)| score)).collect();
    let best = scores.iter().copied().reduce(f32::max)?;
    let mean = scores.iter().map(|&s| f64::from(s)).sum::<f64>() / scores.len() as f64;
    Some((best, if scores.len() < FEW { 0.0 } else { mean as f32 }))
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
    fn what_counts_is_above_the_mean_of_many() {
        let mut i = instances();
        // Along z all score high and nearly alike; along x they score low, and one stands out.
        let row = |(k, d): (usize, usize)| [if k == 5 { 0.4 } else { 0.0 }, 0.1 * (k % 2) as f32, 1.0][d];
        i.label = (0..6).collect();
        i.descriptor = ndarray::Array2::from_shape_fn((6, 3), row);
        (i.support, i.count) = (vec![3; 6], vec![1; 6]);
        let (index, granules) = (Index::new(&i), Granules::new(&i));
        let on = |f: &[f32]| Verdict::on(f, 0.2, &index, &granules, &[], 1).unwrap();
        let (x, z) = (on(&[1.0, 0.0, 0.0]), on(&[0.0, 0.0, 1.0]));
        assert!(x.matches && !z.matches && z.best > x.best, "{x:?} {z:?}");
        assert!((z.by_chance - z.best - 0.2).abs() < 0.1, "{z:?}");
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
