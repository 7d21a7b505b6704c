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
    /// Whether the most relevant pixel lies in a box of the category; none where relevancy is not known.
    pub localised: Option<bool>,
    /// Why the IoU is 0, where it is.
    pub zero: Option<String>,
}

impl Pair {
    /// Scores one pair: |g & p| / |g | p|, where an empty union and a missing prediction, with its reason, score 0.
    ///
    /// # Panics
    /// When the prediction has another size than the truth: callers render or check sizes before.
    pub fn new(
        frame: &str,
        category: &str,
        truth: &Mask,
        predicted: &Result<Mask, String>,
        localised: Option<bool>,
    ) -> Self {
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
        Self { frame: frame.into(), category: category.into(), iou, truth_pixels, predicted_pixels, localised, zero }
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
    /// Localisation accuracy over the pairs whose relevancy is known; none without any.
    pub localisation: Option<f64>,
    /// Number of pairs.
    pub pairs: usize,
}

impl Figures {
    /// Scores a scene by the protocol of OpenGaussian, which CAGS's numbers follow: one IoU per (frame, category) of the
    /// truth, 0 where a prediction is missing; mIoU is their mean, mAcc the fraction above 0.25 (or 0.5), strictly. Zeros all
    /// for no pairs.
    pub fn of_pairs(pairs: &[Pair]) -> Self {
        let ious: Vec<f64> = pairs.iter().map(|p| p.iou).collect();
        let located: Vec<f64> = pairs.iter().filter_map(|p| p.localised).map(|l| f64::from(u8::from(l))).collect();
        Self {
            miou: mean(&ious),
            macc25: fraction_above(&ious, 0.25),
            macc50: fraction_above(&ious, 0.5),
            localisation: (!located.is_empty()).then(|| mean(&located)),
            pairs: pairs.len(),
        }
    }

    /// The same taken within each frame, then averaged over frames (THGS, Segment-then-Splat).
    pub fn of_frames(pairs: &[Pair]) -> Self {
        Self::mean(&grouped(pairs, |p| &p.frame).values().map(|p| Self::of_pairs(p)).collect::<Vec<_>>())
    }

    /// The unweighted mean, whatever the numbers of pairs: of a dataset over its scenes (docs/protocols.md). Localisation over
    /// those that have it.
    pub fn mean(all: &[Self]) -> Self {
        let over = |f: fn(&Self) -> f64| mean(&all.iter().map(f).collect::<Vec<_>>());
        let located: Vec<f64> = all.iter().filter_map(|s| s.localisation).collect();
        Self {
            miou: over(|s| s.miou),
            macc25: over(|s| s.macc25),
            macc50: over(|s| s.macc50),
            localisation: (!located.is_empty()).then(|| mean(&located)),
            pairs: all.iter().map(|s| s.pairs).sum(),
        }
    }
}

fn grouped<'a>(pairs: &'a [Pair], key: fn(&Pair) -> &String) -> BTreeMap<&'a str, Vec<Pair>> {
    let mut groups = BTreeMap::<&str, Vec<Pair>>::new();
    pairs.iter().for_each(|p| groups.entry(key(p)).or_default().push(p.clone()));
    groups
}

/// The figures of every category over its frames, by name.
pub fn object_figures(pairs: &[Pair]) -> BTreeMap<String, Figures> {
    grouped(pairs, |p| &p.category).into_iter().map(|(c, pairs)| (c.into(), Figures::of_pairs(&pairs))).collect()
}

/// Side of the window that smooths relevancy, in pixels.
const WINDOW: usize = 30;
/// Smoothed values this near the largest are as large: rendered values carry rounding of about 1e-7.
const TIE: f64 = 1e-6;

/// Localisation (LangSplat): smooths a relevancy map (`[height][width]`) by the mean over a 30 x 30 window (from 15
/// pixels before to 14 after, mirrored at the border without repeating it, as `cv2.filter2D` does) and asks whether a
/// pixel of the largest value lies in any of the `boxes` (x1, y1, x2, y2 in either order, borders included). Values within
/// 1e-6 of the largest count as equal to it.
///
/// # Panics
/// When `map` is not `width` x `height`.
pub fn localised(map: &[f32], width: usize, height: usize, boxes: &[[f64; 4]]) -> bool {
    assert_eq!(map.len(), width * height);
    if map.is_empty() {
        return false;
    }
    let smooth = smoothed(map, width, height);
    let largest = smooth.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    (0..smooth.len()).filter(|&i| smooth[i] >= largest - TIE).any(|i| {
        let (x, y) = ((i % width) as f64, (i / width) as f64);
        boxes
            .iter()
            .any(|&[x1, y1, x2, y2]| (x1.min(x2)..=x1.max(x2)).contains(&x) && (y1.min(y2)..=y1.max(y2)).contains(&y))
    })
}

fn smoothed(map: &[f32], width: usize, height: usize) -> Vec<f64> {
    // The mean over a square is that over rows of that over columns; each is a difference of running sums.
    let pass = |values: &[f64], len: usize, lines: usize, at: &dyn Fn(usize, usize) -> usize| {
        let mut out = vec![0.0; values.len()];
        for line in 0..lines {
            let mut sums = vec![0.0];
            for i in 0..len + WINDOW - 1 {
                let from = mirrored(i as i64 - (WINDOW / 2) as i64, len as i64);
                sums.push(sums[i] + values[at(line, from)]);
            }
            for i in 0..len {
                out[at(line, i)] = (sums[i + WINDOW] - sums[i]) / WINDOW as f64;
            }
        }
        out
    };
    let values: Vec<f64> = map.iter().map(|&v| f64::from(v)).collect();
    let rows = pass(&values, width, height, &|y, x| y * width + x);
    pass(&rows, height, width, &|x, y| y * width + x)
}

/// Index within 0..n of position `i` when the line is mirrored about its end pixels.
fn mirrored(mut i: i64, n: i64) -> usize {
    if n == 1 {
        return 0;
    }
    while !(0..n).contains(&i) {
        i = if i < 0 { -i } else { 2 * (n - 1) - i };
    }
    i as usize
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
        let mut p = Pair::new(frame, category, &block(0, 4), &Ok(block(0, 4)), None);
        p.iou = iou;
        p
    }

    #[test]
    fn every_zero_has_a_reason() {
        let truth = block(0, 4);
        let zero = |p: Result<Mask, String>| Pair::new("f", "c", &truth, &p, None).zero;
        assert_eq!(zero(Ok(block(2, 8))), None);
        assert_eq!(zero(Ok(block(9, 9))).unwrap(), "the mask is empty in this view");
        assert_eq!(zero(Ok(block(9, 12))).unwrap(), "the mask misses the object");
        assert_eq!(zero(Err("never asked".into())).unwrap(), "never asked");
        let p = Pair::new("f", "c", &block(0, 0), &Ok(block(0, 0)), None);
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
        let scene = |miou: f64, pairs: usize| Figures { miou, macc25: 0.0, macc50: 0.0, localisation: None, pairs };
        let all = [scene(37.62, 22), scene(36.29, 71), scene(60.85, 56), scene(68.40, 59)];
        assert!((Figures::mean(&all).miou - 50.79).abs() < 5e-3);
        assert_eq!(Figures::mean(&all).pairs, 208);
    }

    #[test]
    fn localisation_looks_at_the_smoothed_peak() {
        let (w, h) = (80, 60);
        let mut map = vec![0.0f32; w * h];
        // A lone bright pixel on the left, a wide weaker patch on the right: smoothing prefers the patch.
        map[30 * w + 5] = 1.0;
        (20..40).for_each(|y| map[y * w + 50..y * w + 70].fill(0.5));
        assert!(localised(&map, w, h, &[[70.0, 40.0, 50.0, 20.0]]), "corners in either order");
        assert!(!localised(&map, w, h, &[[0.0, 25.0, 10.0, 35.0]]));
        assert!(localised(&map, w, h, &[[0.0, 0.0, 1.0, 1.0], [59.0, 29.0, 61.0, 31.0]]), "any box");
        assert!(!localised(&map, w, h, &[]));
        assert!(localised(&[0.5; 4], 2, 2, &[[1.0, 1.0, 1.0, 1.0]]), "a flat map is all peak, smaller than the window");
    }

    #[test]
    fn mirroring_does_not_repeat_the_border() {
        assert_eq!((-3..7).map(|i| mirrored(i, 4)).collect::<Vec<_>>(), [3, 2, 1, 0, 1, 2, 3, 2, 1, 0]);
        assert_eq!(mirrored(-100, 1), 0);
    }
}
