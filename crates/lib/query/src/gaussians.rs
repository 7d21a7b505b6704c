//! Gaussians that have language descriptors of their own, and which of them answer a text.

use crate::ranking::{Question, norm};
use artifacts::{Descriptors, flat, role};
use gs_io::{Artifact, Error, Result};
use serde::Serialize;
use std::path::Path;

/// Descriptors of Gaussians, laid out for many texts.
pub struct DescribedGaussians {
    /// The descriptors themselves.
    pub descriptors: Descriptors,
    /// Their file.
    pub artifact: Artifact,
    /// Length of each descriptor; `[rows][slots]`.
    lengths: Vec<f64>,
}

/// Which Gaussians answer a text.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub enum Share {
    /// Each answers the text that it is most like, of all that are asked (how OpenGaussian compares LangSplat in 3D); of equals
    /// the first.
    MostAlike,
    /// Those of at least this score.
    Threshold(f32),
    /// So many of the highest scores; of equals the first.
    Most(usize),
}

/// The Gaussians that answer a text.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Chosen {
    /// Original indices, ascending.
    pub gaussians: Vec<u32>,
    /// The highest score of any Gaussian; none where none has one.
    pub score: Option<f32>,
}

impl DescribedGaussians {
    /// Reads descriptors that belong to a geometry of this content hash, with so many Gaussians.
    ///
    /// # Errors
    /// When the file is damaged, or of another geometry.
    pub fn read(path: &Path, geometry_hash: &str, gaussians: usize) -> Result<Self> {
        let (descriptors, artifact) = Descriptors::read(path)?;
        artifact.expect_input(role::GEOMETRY, geometry_hash)?;
        if let Some(last) = descriptors.kept.last().filter(|&&last| last as usize >= gaussians) {
            let wrong = Error::new("a Gaussian that the geometry lacks").file(path).field("kept");
            return Err(wrong.found(last).expected(format!("less than {gaussians}")));
        }
        Ok(Self::new(descriptors, artifact))
    }

    fn new(descriptors: Descriptors, artifact: Artifact) -> Self {
        let lengths = descriptors.values.rows().into_iter().map(flat).map(norm).collect();
        Self { descriptors, artifact, lengths }
    }

    /// The Gaussians that answer each feature, where `features` are of all texts that are asked; none for a text without one.
    pub fn choose(&self, features: &[Option<Vec<f32>>], negatives: &[Vec<f32>], share: Share) -> Vec<Chosen> {
        choose(&self.descriptors, &self.lengths, features, negatives, share)
    }
}

/// Scores of the rows: the best of a row's descriptors.
fn row_scores(d: &Descriptors, lengths: &[f64], feature: &[f32], negatives: &[Vec<f32>]) -> Vec<Option<f32>> {
    let question = Question::new(feature, negatives);
    let slots = d.values.rows().into_iter().zip(lengths).map(|(v, &length)| question.score(flat(v), length));
    let slots: Vec<Option<f32>> = slots.collect();
    let best = |row: &[Option<f32>]| row.iter().copied().flatten().reduce(f32::max);
    slots.chunks_exact(d.values.dim().1.max(1)).map(best).collect()
}

fn choose(
    d: &Descriptors,
    lengths: &[f64],
    features: &[Option<Vec<f32>>],
    negatives: &[Vec<f32>],
    share: Share,
) -> Vec<Chosen> {
    let scores = |feature: &Option<Vec<f32>>| match feature {
        Some(feature) => row_scores(d, lengths, feature, negatives),
        None => vec![None; d.values.dim().0],
    };
    let scores: Vec<Vec<Option<f32>>> = features.iter().map(scores).collect();
    let highest = |row: usize| {
        let of_row = scores.iter().enumerate().filter_map(|(text, s)| Some((text, s[row]?)));
        of_row.fold(None, |best: Option<(usize, f32)>, s| if best.is_some_and(|b| b.1 >= s.1) { best } else { Some(s) })
    };
    let most_alike: Vec<Option<usize>> = match share {
        Share::MostAlike => (0..d.values.dim().0).map(|row| highest(row).map(|best| best.0)).collect(),
        _ => Vec::new(),
    };
    let one = |(text, scores): (usize, &Vec<Option<f32>>)| {
        let of = |row: u32| scores[row as usize];
        let all = || d.kept.iter().copied().zip(&d.row).filter_map(|(i, &row)| Some((i, row, of(row)?)));
        let gaussians = match share {
            Share::MostAlike => all().filter(|g| most_alike[g.1 as usize] == Some(text)).map(|g| g.0).collect(),
            Share::Threshold(least) => all().filter(|g| g.2 >= least).map(|g| g.0).collect(),
            Share::Most(count) => {
                let mut all: Vec<(u32, f32)> = all().map(|g| (g.0, g.2)).collect();
                all.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
                let mut first: Vec<u32> = all.into_iter().take(count).map(|g| g.0).collect();
                first.sort_unstable();
                first
            }
        };
        let score = all().map(|g| g.2).reduce(f32::max);
        Chosen { gaussians, score }
    };
    scores.iter().enumerate().map(one).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::arr3;

    /// Rows along x, along y, between both with a second descriptor along -x, and without any; Gaussian 5 shares the first.
    fn answers(share: Share, negatives: &[Vec<f32>]) -> Vec<Chosen> {
        let one = |v: [f32; 2]| [v, [0.0; 2]];
        let values = arr3(&[one([1.0, 0.0]), one([0.0, 1.0]), [[0.6, 0.8], [-1.0, 0.0]], one([0.0; 2])]);
        let d = Descriptors { kept: vec![1, 2, 3, 4, 5], row: vec![0, 1, 2, 3, 0], values };
        let lengths: Vec<f64> = d.values.rows().into_iter().map(flat).map(norm).collect();
        let texts = [Some(vec![2.0, 0.0]), Some(vec![0.0, 3.0]), None, Some(vec![-1.0, 0.0])];
        choose(&d, &lengths, &texts, negatives, share)
    }

    fn gaussians(share: Share) -> Vec<Vec<u32>> {
        answers(share, &[]).into_iter().map(|c| c.gaussians).collect()
    }

    #[test]
    fn gaussians_are_shared_out_by_each_rule() {
        assert_eq!(gaussians(Share::MostAlike), [vec![1, 5], vec![2], vec![], vec![3]]);
        assert_eq!(gaussians(Share::Threshold(0.5)), [vec![1, 3, 5], vec![2, 3], vec![], vec![3]]);
        assert_eq!(gaussians(Share::Most(2)), [vec![1, 5], vec![2, 3], vec![], vec![2, 3]]);
        let scores: Vec<_> = answers(Share::Most(1), &[]).iter().map(|c| c.score).collect();
        assert_eq!(scores, [Some(1.0), Some(1.0), None, Some(1.0)]);
    }

    #[test]
    fn with_negatives_scores_are_relevancies() {
        // Cosine 1 against 0 of the negative: 1 / (1 + exp(-10)); of the one between 0.6 against 0.8: 1 / (1 + exp(2)) = 0.119.
        let of = |least: f32| answers(Share::Threshold(least), &[vec![0.0, 1.0]])[0].gaussians.clone();
        assert_eq!(of(0.99995), [1, 5]);
        assert_eq!((of(0.11), of(0.12)), (vec![1, 3, 5], vec![1, 5]));
    }
}
