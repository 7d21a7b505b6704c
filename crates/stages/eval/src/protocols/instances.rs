//! Class-agnostic instances of a ScanNet scan: truth from segs and aggregation, mIoU and average precision
//! (docs/protocols.md).

use crate::score::metrics;
use gs_io::{Error, IoContext, Result};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// True instances with fewer points, and predicted ones, take no part in average precision, as in ScanNet's benchmark.
pub const MIN_POINTS: usize = 100;

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Segs {
    seg_indices: Vec<i64>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Aggregation {
    seg_groups: Vec<Group>,
}

#[derive(Deserialize)]
#[serde(rename_all = "camelCase")]
struct Group {
    object_id: i32,
    segments: Vec<i64>,
}

/// The true instance of every vertex: `<scan>_vh_clean_2.0.010000.segs.json` gives each vertex a segment
/// (`segIndices`), `<scan>.aggregation.json` gives each object its segments (`segGroups[].objectId, segments, label`).
/// -1 for vertices of no object.
///
/// # Errors
/// When a file is not such a file, segments are not as many as `vertices`, or two objects claim one.
pub fn read_truth(segs: &Path, aggregation: &Path, vertices: usize) -> Result<Vec<i32>> {
    let read = |path: &Path| std::fs::read(path).at("read", path);
    let bad = |path: &Path, what: &str, e: serde_json::Error| Error::new(format!("{what}: {e}")).file(path);
    let s: Segs = serde_json::from_slice(&read(segs)?).map_err(|e| bad(segs, "not a file of segments", e))?;
    if s.seg_indices.len() != vertices {
        return Err(Error::new("not a segment per vertex")
            .file(segs)
            .field("segIndices")
            .found(s.seg_indices.len())
            .expected(format!("{vertices}, as many as labels"))
            .hint("use the segs.json of the same mesh as the labels, *_vh_clean_2.0.010000.segs.json"));
    }
    let a: Aggregation =
        serde_json::from_slice(&read(aggregation)?).map_err(|e| bad(aggregation, "not an aggregation file", e))?;
    let mut object = BTreeMap::new();
    for (i, group) in a.seg_groups.iter().enumerate() {
        for &segment in &group.segments {
            if let Some(other) = object.insert(segment, group).filter(|g| g.object_id != group.object_id) {
                return Err(Error::new("two objects claim one segment")
                    .file(aggregation)
                    .field(format!("segGroups[{i}].segments"))
                    .found(format!("segment {segment} of objects {} and {}", other.object_id, group.object_id)));
            }
        }
    }
    let id = |segment: &i64| match object.get(segment) {
        Some(group) if group.object_id >= 0 => group.object_id,
        _ => -1,
    };
    Ok(s.seg_indices.iter().map(id).collect())
}

/// Class-agnostic scores of a scan.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct InstanceFigures {
    /// Mean over true instances of the best IoU with any predicted one (InstanceGaussian).
    pub miou: f64,
    /// Fraction of true instances with best IoU above 0.25.
    pub acc25: f64,
    /// Fraction of true instances with best IoU above 0.5.
    pub acc50: f64,
    /// Average precision at IoU 0.25 (ScanNet's matching); none without a true instance of [`MIN_POINTS`] points.
    pub ap25: Option<f64>,
    /// The same at IoU 0.5.
    pub ap50: Option<f64>,
    /// True instances.
    pub truth: usize,
    /// Predicted instances that own points of the scan.
    pub predicted: usize,
}

/// Scores the predicted instance of every point (negative: none) against the true one (negative: no object, which counts
/// neither for nor against), with the `confidence` of each predicted instance.
pub fn score(truth: &[i32], predicted: &[i32], confidence: &[f32], min_points: usize) -> InstanceFigures {
    let best = metrics::score_instances(truth, predicted);
    let ids: BTreeSet<i32> = predicted.iter().copied().filter(|&p| p >= 0).collect();
    let overlaps = Overlaps::of_labels(truth, predicted, min_points);
    let ap = |threshold| average_precision(&overlaps, |p| confidence[p], threshold);
    InstanceFigures {
        miou: best.miou,
        acc25: best.macc25,
        acc50: best.macc50,
        ap25: ap(0.25),
        ap50: ap(0.5),
        truth: best.objects.len(),
        predicted: ids.len(),
    }
}

/// Points of true and predicted instances that take part in average precision.
pub struct Overlaps {
    /// Of each true instance.
    truth: BTreeMap<i32, usize>,
    /// Of each predicted instance.
    predicted: BTreeMap<i32, usize>,
    /// Of a true and a predicted instance.
    common: BTreeMap<(i32, i32), usize>,
}

impl Overlaps {
    /// Of instances that share the points out: those of every point, negative for none.
    pub fn of_labels(truth: &[i32], predicted: &[i32], min_points: usize) -> Self {
        assert_eq!(truth.len(), predicted.len());
        let common = metrics::counts(truth.iter().copied().zip(predicted.iter().copied()));
        Self::new(truth, metrics::counts(predicted.iter().copied()), common, min_points)
    }

    /// Of predicted instances that may overlap: the points of each.
    pub fn of_sets(truth: &[i32], predicted: &[Vec<u32>], min_points: usize) -> Self {
        let sets = (0i32..).zip(predicted);
        let pairs = sets.clone().flat_map(|(p, points)| points.iter().map(move |&i| (truth[i as usize], p)));
        let common = metrics::counts(pairs);
        Self::new(truth, sets.map(|(p, points)| (p, points.len())).collect(), common, min_points)
    }

    fn new(
        truth: &[i32],
        mut predicted: BTreeMap<i32, usize>,
        common: BTreeMap<(i32, i32), usize>,
        min_points: usize,
    ) -> Self {
        let mut truth = metrics::counts(truth.iter().copied());
        for sizes in [&mut truth, &mut predicted] {
            sizes.retain(|&id, n| id >= 0 && *n >= min_points);
        }
        Self { truth, predicted, common }
    }

    /// IoU of a true and a predicted instance that both take part.
    pub fn iou(&self, truth: i32, predicted: i32) -> f64 {
        let both = self.common.get(&(truth, predicted)).copied().unwrap_or(0);
        both as f64 / (self.truth[&truth] + self.predicted[&predicted] - both) as f64
    }

    /// The best IoU of each true instance with any predicted one, by rising id.
    pub fn best(&self) -> impl Iterator<Item = (i32, f64)> + '_ {
        let best = |&t: &i32| self.predicted.keys().map(|&p| self.iou(t, p)).fold(0.0, f64::max);
        self.truth.keys().map(move |t| (*t, best(t)))
    }

    /// Whether each predicted instance is one whole thing, by rising id: it has an IoU above 0.5 with a true one.
    pub fn whole(&self) -> impl Iterator<Item = (i32, bool)> + '_ {
        self.predicted.keys().map(|&p| (p, self.truth.keys().any(|&t| self.iou(t, p) > 0.5)))
    }
}

/// Average precision by ScanNet's matching. Only true and predicted instances of at least `min_points` points take part;
/// IoU counts all points, also those without a true object. True instances are taken by rising id; each takes the
/// predictions (by rising id) whose IoU with it exceeds `threshold` and that were not the first match of an earlier one:
/// the most confident is its hit, every other a false alarm. A prediction that exceeds the threshold with no true instance
/// is a false alarm too, unless more than `threshold` of its points belong to no true instance that takes part. For every
/// distinct confidence, precision p_i and recall r_i of what is at least that confident; after them (1, 0); the result is
/// the sum over i of p_i (r_(i-1) - r_(i+1)) / 2, with r repeated before the first and 0 after the last. None without a
/// true instance that takes part.
pub fn average_precision(overlaps: &Overlaps, confidence: impl Fn(usize) -> f32, threshold: f64) -> Option<f64> {
    let Overlaps { truth: truth_points, predicted: predicted_points, common } = overlaps;
    if truth_points.is_empty() {
        return None;
    }
    let matches = |t: i32, p: i32| overlaps.iou(t, p) > threshold;
    let confidence = |p: i32| confidence(p as usize);
    // Outcomes: confidence and whether it is a hit. What no prediction reaches is missed at every confidence.
    let mut outcomes: Vec<(f32, bool)> = Vec::new();
    let mut taken = BTreeSet::<i32>::new();
    let mut missed = 0usize;
    for &t in truth_points.keys() {
        let free = |p: &&i32| matches(t, **p) && !taken.contains(*p);
        let found: Vec<i32> = predicted_points.keys().filter(free).copied().collect();
        taken.extend(found.first());
        let mut confidences: Vec<f32> = found.iter().map(|&p| confidence(p)).collect();
        confidences.sort_by(f32::total_cmp);
        missed += usize::from(found.is_empty());
        outcomes.extend(confidences.pop().map(|most| (most, true)));
        outcomes.extend(confidences.into_iter().map(|c| (c, false)));
    }
    for (&p, &points) in predicted_points {
        if truth_points.keys().any(|&t| matches(t, p)) {
            continue;
        }
        let counted: usize = truth_points.keys().filter_map(|&t| common.get(&(t, p))).sum();
        if (points - counted) as f64 / points as f64 <= threshold {
            outcomes.push((confidence(p), false));
        }
    }
    // From the least confident cut to the most.
    outcomes.sort_by(|a, b| a.0.total_cmp(&b.0));
    let all_hits = outcomes.iter().filter(|o| o.1).count();
    let (mut curve, mut dropped_hits, mut at) = (Vec::new(), 0usize, 0usize);
    for group in outcomes.chunk_by(|a, b| a.0 == b.0) {
        let (hits, shown) = (all_hits - dropped_hits, outcomes.len() - at);
        curve.push((hits as f64 / shown as f64, hits as f64 / (all_hits + missed) as f64));
        dropped_hits += group.iter().filter(|o| o.1).count();
        at += group.len();
    }
    curve.push((1.0, 0.0));
    let recall = |i: usize| curve.get(i).map_or(0.0, |c: &(f64, f64)| c.1);
    Some((0..curve.len()).map(|i| curve[i].0 * (recall(i.saturating_sub(1)) - recall(i + 1)) / 2.0).sum())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ap(truth: &[i32], predicted: &[i32], confidence: &[f32]) -> f64 {
        average_precision(&Overlaps::of_labels(truth, predicted, 1), |p| confidence[p], 0.5).unwrap()
    }

    #[test]
    fn instances_that_overlap_are_scored_by_the_points_of_each() {
        let truth = [0, 0, 0, 0, 1, 1, 1, 1, -1];
        let sets = [vec![0, 1, 2, 3], vec![0, 1, 2, 3, 4, 5, 6, 7], vec![4, 5, 6], vec![7, 8]];
        let o = Overlaps::of_sets(&truth, &sets, 3);
        assert_eq!(o.best().collect::<Vec<_>>(), [(0, 1.0), (1, 0.75)]);
        assert_eq!(o.whole().collect::<Vec<_>>(), [(0, true), (1, false), (2, true)]);
        // Both things are found; the group is a false alarm, which costs nothing where it comes last.
        assert_eq!(average_precision(&o, |p| [0.9, 0.1, 0.8][p], 0.5), Some(1.0));
        assert!(average_precision(&o, |p| [0.8, 0.9, 0.7][p], 0.5) < Some(0.8));
        // Sets that share the points out are scored as labels are.
        let labels = [0, 0, 0, 0, 2, 2, 2, -1, -1];
        let apart = Overlaps::of_sets(&truth, &[sets[0].clone(), vec![], sets[2].clone()], 3);
        let [a, b] = [&apart, &Overlaps::of_labels(&truth, &labels, 3)].map(|o| average_precision(o, |_| 1.0, 0.8));
        assert_eq!(a, b);
    }

    /// The benchmark's own way: lists of outcomes, sorted, summed up from the least confident, and the area by a convolution with
    /// (-1/2, 0, 1/2).
    fn as_the_benchmark_counts(
        truth: &[i32],
        predicted: &[i32],
        confidence: &[f32],
        least: usize,
        iou: f64,
    ) -> Option<f64> {
        let points = |of: &[i32], id: i32| of.iter().filter(|&&v| v == id).count();
        let both = |t: i32, p: i32| truth.iter().zip(predicted).filter(|&(&a, &b)| (a, b) == (t, p)).count();
        let large = |of: &[i32]| {
            let mut ids: Vec<i32> = of.iter().copied().filter(|&id| id >= 0 && points(of, id) >= least).collect();
            ids.sort_unstable();
            ids.dedup();
            ids
        };
        let (things, found) = (large(truth), large(predicted));
        let overlap = |t: i32, p: i32| {
            let both = both(t, p);
            both as f64 / (points(truth, t) + points(predicted, p) - both) as f64
        };
        let (mut outcomes, mut missed, mut visited) = (Vec::new(), 0, BTreeSet::new());
        for &t in &things {
            let mut best: Option<f32> = None;
            for &p in found.iter().filter(|&&p| overlap(t, p) > iou) {
                let score = confidence[p as usize];
                if visited.contains(&p) {
                    continue;
                }
                match best {
                    Some(before) => {
                        outcomes.push((before.min(score), 0));
                        best = Some(before.max(score));
                    }
                    None => {
                        best = Some(score);
                        visited.insert(p);
                    }
                }
            }
            match best {
                Some(score) => outcomes.push((score, 1)),
                None => missed += 1,
            }
        }
        for &p in found.iter().filter(|&&p| things.iter().all(|&t| overlap(t, p) <= iou)) {
            let ignored = truth.iter().zip(predicted).filter(|&(t, &q)| q == p && !things.contains(t)).count();
            if ignored as f64 / points(predicted, p) as f64 <= iou {
                outcomes.push((confidence[p as usize], 0));
            }
        }
        outcomes.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut cuts: Vec<f32> = outcomes.iter().map(|o| o.0).collect();
        cuts.dedup();
        let all: usize = outcomes.iter().map(|o| o.1).sum();
        let (mut precision, mut recall) = (Vec::new(), Vec::new());
        for cut in cuts {
            let hits: usize = outcomes.iter().filter(|o| o.0 >= cut).map(|o| o.1).sum();
            precision.push(hits as f64 / outcomes.iter().filter(|o| o.0 >= cut).count() as f64);
            recall.push(hits as f64 / (all + missed) as f64);
        }
        precision.push(1.0);
        recall.push(0.0);
        let padded = [&recall[..1], &recall, &[0.0]].concat();
        let widths = padded.windows(3).map(|w| 0.5 * (w[0] - w[2]));
        (!things.is_empty()).then(|| precision.iter().zip(widths).map(|(p, w)| p * w).sum())
    }

    #[test]
    fn forty_random_scans_are_scored_as_the_benchmark_scores_them() {
        let mut state = 7u64;
        let mut random = |below: usize| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as usize % below
        };
        let mut informative = 0;
        for case in 0..40 {
            let n = 60 + random(120);
            let things = 2 + random(8);
            let truth: Vec<i32> = (0..n).map(|i| (i * things / n) as i32 - i32::from(random(6) == 0)).collect();
            let shown: Vec<i32> = (0..n)
                .map(|i| if random(4) == 0 { random(things + 3) as i32 - 1 } else { truth[i] / (1 + case % 2) })
                .collect();
            let confidence: Vec<f32> = (0..things + 3).map(|_| random(5) as f32 / 4.0).collect();
            // Faint vertices leave truth and prediction alike.
            let seen: Vec<usize> = (0..n).filter(|_| random(7) > 0).collect();
            let [truth, shown] = [truth, shown].map(|of| seen.iter().map(|&i| of[i]).collect::<Vec<i32>>());
            let s = score(&truth, &shown, &confidence, 5);
            for (ours, iou) in [(s.ap25, 0.25), (s.ap50, 0.5)] {
                let theirs = as_the_benchmark_counts(&truth, &shown, &confidence, 5, iou);
                assert!(ours.zip(theirs).is_some_and(|(a, b)| (a - b).abs() < 1e-12), "{case}: {ours:?} {theirs:?}");
                informative += usize::from(ours.is_some_and(|ap| ap > 0.05 && ap < 0.95));
            }
        }
        assert!(informative > 40, "{informative}");
    }

    #[test]
    fn average_precision_by_hand() {
        let truth = [0, 0, 0, 0, 1, 1, 1, 1];
        assert_eq!(ap(&truth, &[0, 0, 0, 0, 1, 1, 1, 1], &[0.9, 0.8]), 1.0);
        // One of two found: cuts 0.8 (p 1, r 1/2), then (1, 0): 1 * (1/2 - 0) / 2 + 1 * (1/2 - 0) / 2.
        assert_eq!(ap(&truth, &[0, 0, 0, 0, -1, -1, -1, -1], &[0.8]), 0.5);
        // A false alarm below the hit halves precision at the lower cut only.
        let low = ap(&truth, &[0, 0, 0, 0, 1, -1, -1, -1], &[0.8, 0.1]);
        let high = ap(&truth, &[0, 0, 0, 0, 1, -1, -1, -1], &[0.1, 0.8]);
        assert!(high < low && low <= 0.5, "{high} {low}");
        assert_eq!(ap(&truth, &[-1; 8], &[]), 0.0);
    }

    #[test]
    fn points_without_an_object_excuse_a_prediction() {
        let truth = [vec![0; 4], vec![-1; 4]].concat();
        let on_void = [vec![0; 4], vec![1; 4]].concat();
        assert_eq!(ap(&truth, &on_void, &[0.5, 0.9]), 1.0, "a prediction on nothing labelled is no false alarm");
        assert_eq!(average_precision(&Overlaps::of_labels(&[-1; 4], &[0; 4], 1), |_| 1.0, 0.5), None);
    }

    #[test]
    fn small_instances_take_no_part() {
        let truth = [vec![0; 10], vec![1; 3]].concat();
        let predicted = [vec![0; 10], vec![-1; 3]].concat();
        assert_eq!(average_precision(&Overlaps::of_labels(&truth, &predicted, 5), |_| 1.0, 0.5), Some(1.0));
        let s = score(&truth, &predicted, &[1.0], 5);
        assert_eq!((s.miou, s.acc25, s.truth, s.predicted), (0.5, 0.5, 2, 1), "but they count in mIoU");
        assert_eq!(score(&truth, &[-1; 13], &[], 5).ap25, Some(0.0), "all noise");
    }

    #[test]
    fn segs_and_aggregation_make_instances() {
        let dir = tempfile::tempdir().unwrap();
        let (s, a) = (dir.path().join("s.segs.json"), dir.path().join("a.aggregation.json"));
        std::fs::write(&s, r#"{"params":{},"sceneId":"x","segIndices":[5,5,7,9,11]}"#).unwrap();
        let groups = r#"{"segGroups":[{"id":0,"objectId":0,"segments":[5],"label":"wall"},
                         {"id":1,"objectId":1,"segments":[7,9],"label":"chair"}]}"#;
        std::fs::write(&a, groups).unwrap();
        assert_eq!(read_truth(&s, &a, 5).unwrap(), [0, 0, 1, 1, -1]);
        let e = read_truth(&s, &a, 6).unwrap_err().to_string();
        assert!(e.contains("segIndices: not a segment per vertex; found 5, expected 6"), "{e}");
        std::fs::write(&a, groups.replace("[7,9]", "[5,9]")).unwrap();
        let e = read_truth(&s, &a, 5).unwrap_err().to_string();
        assert!(e.contains("segment 5 of objects 0 and 1"), "{e}");
        std::fs::write(&a, "{}").unwrap();
        assert!(read_truth(&s, &a, 5).unwrap_err().to_string().contains("not an aggregation file"));
    }
}
