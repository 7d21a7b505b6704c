//! Semantic segmentation of the cloud: every Gaussian gets the text that fits its instance best.

use super::ranking::{Index, Scoring};
use artifacts::{NOISE_COLOR, instance_color};
use gs_scene::{Gaussians, SH_C0};
use serde::{Deserialize, Serialize};

/// A text in `query.json`'s segmentation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Segment {
    /// The text; its position is the label in `labels.npy`.
    pub text: String,
    /// Instances that it fits best.
    pub instances: Vec<u32>,
    /// Their Gaussians.
    pub gaussians: usize,
    /// Its colour in `segmentation.ply`, sRGB in 0 to 1.
    pub color: [f32; 3],
}

/// The cloud divided among texts.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Segmentation {
    /// The texts, in the order given.
    pub segments: Vec<Segment>,
    /// Gaussians that no text has: noise, instances without a descriptor or below the threshold.
    pub unlabelled: usize,
    /// File of the labels, i32 per Gaussian, -1 for none.
    pub labels: String,
    /// File of the Gaussians in the texts' colours.
    pub ply: String,
}

/// Divides the Gaussians among `features`: each instance goes to the feature of highest score (ties: the first), if that
/// reaches `threshold`. Returns the index of the text per Gaussian, -1 for none, and per text its instances.
pub fn divide(
    index: &Index<'_>,
    label: &[i32],
    instances: usize,
    features: &[Vec<f32>],
    scoring: &Scoring,
    threshold: Option<f32>,
) -> (Vec<i32>, Vec<Vec<u32>>) {
    let mut best: Vec<Option<(usize, f32)>> = vec![None; instances];
    for (t, feature) in features.iter().enumerate() {
        for (b, score) in best.iter_mut().zip(index.scores(feature, scoring)) {
            if let Some(s) = score.filter(|s| threshold.is_none_or(|t| *s >= t) && b.is_none_or(|b| *s > b.1)) {
                *b = Some((t, s));
            }
        }
    }
    let mut of_text = vec![Vec::new(); features.len()];
    for (k, b) in best.iter().enumerate() {
        if let Some((t, _)) = b {
            of_text[*t].push(k as u32);
        }
    }
    let of = |&l: &i32| usize::try_from(l).ok().and_then(|l| best[l]).map_or(-1, |b| b.0 as i32);
    (label.iter().map(of).collect(), of_text)
}

/// The Gaussians in the colours of their labels (of [`divide`]), without view dependence.
pub fn coloured(gaussians: &Gaussians, labels: &[i32]) -> Gaussians {
    let color = |&l: &i32| u32::try_from(l).map_or(NOISE_COLOR, instance_color);
    let sh = labels.iter().flat_map(|l| color(l).map(|c| (c - 0.5) / SH_C0)).collect();
    Gaussians { sh, sh_degree: 0, ..gaussians.clone() }
}
