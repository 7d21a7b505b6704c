//! Scores of objects selected in 3D, in 2D: by (frame, category) pairs, as LERF-OVS has them (docs/protocols.md).

use crate::Mask;
use crate::score::metrics::{fraction_above, mean};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// One (frame, category) pair.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Pair {
    /// Stem of the labelled frame.
    pub frame: String,
    /// Category of the labels.
    pub category: String,
    /// Intersection over union, 0 to 1.
    pub iou: f64,
    /// Pixels of the truth.
    pub truth_pixels: usize,
    /// Pixels of the prediction.
    pub predicted_pixels: usize,
    /// Why the IoU is 0, where it is.
    pub zero: Option<String>,
}

impl Pair {
    /// Scores one pair: |g & p| / |g | p|, where an empty union and a missing prediction, with its reason, score 0.
    pub fn new(frame: &str, category: &str, truth: &Mask, predicted: &Result<Mask, String>) -> Self {
        let (iou, predicted_pixels, why) = match predicted {
            Ok(mask) => (truth.iou(mask), mask.count(), None),
            Err(why) => (0.0, 0, Some(why.clone())),
        };
        let truth_pixels = truth.count();
        let zero = (iou == 0.0).then(|| {
            why.unwrap_or_else(|| {
                match (truth_pixels, predicted_pixels) {
                    (0, _) => "the label covers no pixel",
                    (_, 0) => "the mask is empty in this view",
                    _ => "the mask misses the object",
                }
                .into()
            })
        });
        Self { frame: frame.into(), category: category.into(), iou, truth_pixels, predicted_pixels, zero }
    }
}

/// Scores of a set of pairs: a scene, or an object over its frames.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Figures {
    /// Mean IoU, 0 to 1.
    pub miou: f64,
    /// Fraction with IoU above 0.25, strictly.
    pub macc25: f64,
    /// Fraction with IoU above 0.5, strictly.
    pub macc50: f64,
    /// Number of pairs.
    pub pairs: usize,
}

impl Figures {
    /// Scores a scene by the protocol of OpenGaussian, which CAGS's numbers follow: one IoU per (frame, category) of the
    /// truth, 0 where a prediction is missing; mIoU is their mean, mAcc the fraction above 0.25 (or 0.5), strictly. Zeros all
    /// for no pairs.
    pub fn of_pairs(pairs: &[Pair]) -> Self {
        let ious: Vec<f64> = pairs.iter().map(|p| p.iou).collect();
        Self {
            miou: mean(&ious),
            macc25: fraction_above(&ious, 0.25),
            macc50: fraction_above(&ious, 0.5),
            pairs: pairs.len(),
        }
    }

    /// The same taken within each frame, then averaged over frames (THGS, Segment-then-Splat).
    pub fn of_frames(pairs: &[Pair]) -> Self {
        Self::mean(&grouped(pairs, |p| &p.frame).values().map(|p| Self::of_pairs(p)).collect::<Vec<_>>())
    }

    /// The unweighted mean, whatever the numbers of pairs: of a dataset over its scenes (docs/protocols.md).
    pub fn mean<'a>(all: impl IntoIterator<Item = &'a Self>) -> Self {
        let all: Vec<&Self> = all.into_iter().collect();
        let over = |f: fn(&Self) -> f64| mean(&all.iter().map(|s| f(s)).collect::<Vec<_>>());
        Self {
            miou: over(|s| s.miou),
            macc25: over(|s| s.macc25),
            macc50: over(|s| s.macc50),
            pairs: all.iter().map(|s| s.pairs).sum(),
        }
    }
}

fn grouped(pairs: &[Pair], key: fn(&Pair) -> &String) -> BTreeMap<&str, Vec<Pair>> {
    let mut groups = BTreeMap::<&str, Vec<Pair>>::new();
    pairs.iter().for_each(|p| groups.entry(key(p)).or_default().push(p.clone()));
    groups
}

/// The figures of every category over its frames, by name.
pub fn object_figures(pairs: &[Pair]) -> BTreeMap<String, Figures> {
    grouped(pairs, |p| &p.category).into_iter().map(|(c, pairs)| (c.into(), Figures::of_pairs(&pairs))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn block(x0: usize, x1: usize) -> Mask {
        let mut m = Mask::new(20, 1);
        m.bits[x0..x1].fill(true);
        m
    }

    fn pair(frame: &str, category: &str, iou: f64) -> Pair {
        let mut p = Pair::new(frame, category, &block(0, 4), &Ok(block(0, 4)));
        p.iou = iou;
        p
    }

    #[test]
    fn every_zero_has_a_reason() {
        let truth = block(0, 4);
        let zero = |p: Result<Mask, String>| Pair::new("f", "c", &truth, &p).zero;
        assert_eq!(zero(Ok(block(2, 8))), None);
        assert_eq!(zero(Ok(block(9, 9))).unwrap(), "the mask is empty in this view");
        assert_eq!(zero(Ok(block(9, 12))).unwrap(), "the mask misses the object");
        assert_eq!(zero(Err("never asked".into())).unwrap(), "never asked");
        let p = Pair::new("f", "c", &block(0, 0), &Ok(block(0, 0)));
        assert_eq!((p.iou, p.zero.unwrap().as_str()), (0.0, "the label covers no pixel"), "an empty union scores 0");
    }

    #[test]
    fn thresholds_are_strict_and_averages_differ_by_rule() {
        let pairs = [pair("a", "x", 0.25), pair("a", "y", 0.75), pair("a", "z", 0.5), pair("b", "x", 1.0)];
        let f = Figures::of_pairs(&pairs);
        assert_eq!((f.miou, f.macc25, f.macc50, f.pairs), (0.625, 0.75, 0.5, 4));
        let f = Figures::of_frames(&pairs);
        assert_eq!((f.miou, f.macc50), (0.75, (1.0 / 3.0 + 1.0) / 2.0));
        assert_eq!(object_figures(&pairs)["x"].miou, 0.625);
        assert_eq!(Figures::of_frames(&[]).miou, 0.0);
    }

    #[test]
    fn the_dataset_is_the_mean_of_scenes_not_of_pairs() {
        // The paper's own row: 37.62, 36.29, 60.85 and 68.40 make 50.79 although waldo_kitchen has 22 pairs, ramen 71.
        let scene = |miou: f64, pairs: usize| Figures { miou, macc25: 0.0, macc50: 0.0, pairs };
        let all = [scene(37.62, 22), scene(36.29, 71), scene(60.85, 56), scene(68.40, 59)];
        assert!((Figures::mean(&all).miou - 50.79).abs() < 5e-3);
        assert_eq!(Figures::mean(&all).pairs, 208);
    }
}
