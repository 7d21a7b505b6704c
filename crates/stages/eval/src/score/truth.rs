//! Instances against the true things of a synthetic scene: over points of their surfaces, and over Gaussians.

use super::metrics::{self, InstanceScore};
use super::scores::{GaussianScores, Precision, ProposalScores, Scores, ThingScore, WholeScore};
use crate::protocols::instances::{MIN_POINTS, Overlaps, average_precision};
use artifacts::{Granule, TruePoints, TrueScene};
use gs_io::Result;
use gs_scene::Geometry;
use query::{LabelledScene, MIN_OPACITY, SAME, different, nearest_of, nearest_solid};
use std::path::Path;

/// Scores the instances against `truth/points.safetensors` of the scene: each surface point takes the label of the
/// nearest labelled Gaussian of opacity at least 0.1; then per true thing the best IoU over instances. Without that
/// file, `scores.skipped` says so.
pub fn score_instances(scene: &LabelledScene, root: &Path, scores: &mut Scores) -> Result<()> {
    let path = root.join("truth/points.safetensors");
    if !path.exists() {
        scores.skipped.push(format!("instance scores: the scene has no {}", path.display()));
        return Ok(());
    }
    let truth = TruePoints::read(&path)?;
    let names = root.join("truth/scene.json");
    let things = if names.exists() { TrueScene::read(&names)?.objects } else { Vec::new() };
    let label = |nearest: Option<u32>| nearest.map_or(-1, |i| scene.instances.label[i as usize]);
    let nearest = scene.nearest_labelled(&truth.position);
    let predicted: Vec<i32> = nearest.iter().copied().map(label).collect();
    let found = metrics::score_instances(&truth.instance, &predicted);
    if found.objects.is_empty() {
        scores.skipped.push(format!("instance scores: {} holds no point of a thing", path.display()));
        return Ok(());
    }
    let thing = |o: &metrics::ObjectScore| {
        let thing = usize::try_from(o.id).ok().and_then(|i| things.get(i));
        ThingScore {
            id: o.id,
            name: thing.map_or_else(|| format!("thing {}", o.id), |t| t.name.clone()),
            background: thing.is_some_and(|t| t.background),
            points: o.points,
            iou: o.iou,
            instance: o.best,
            fragments: o.fragments,
        }
    };
    scores.things = found.objects.iter().map(thing).collect();
    let object_ious: Vec<f64> = scores.things.iter().filter(|t| !t.background).map(|t| t.iou).collect();
    scores.object_miou = (!object_ious.is_empty()).then(|| metrics::mean(&object_ious));
    let InstanceScore { miou, macc25, macc50, fragmented, merging, .. } = found;
    (scores.instance_miou, scores.instance_macc25, scores.instance_macc50) = (Some(miou), Some(macc25), Some(macc50));
    (scores.fragmented, scores.merging) = (Some(fragmented), Some(merging));
    scores.instances_per_thing = Some(found.instances_per_object);
    scores.things_per_instance = Some(found.objects_per_instance);
    let confidence = &scene.instances.score;
    let overlaps = Overlaps::of_labels(&truth.instance, &predicted, MIN_POINTS);
    let ranked = Precision::of(&overlaps, |p| confidence[p]);
    (scores.ap25, scores.ap50) = (ranked.ap25, ranked.ap50);
    let mut whole: Vec<(f32, bool)> = overlaps.whole().map(|(p, whole)| (confidence[p as usize], whole)).collect();
    // Of equals the first; the sort is stable.
    whole.sort_by(|a, b| b.0.total_cmp(&a.0));
    let count = |of: &[(f32, bool)]| of.iter().filter(|(_, whole)| *whole).count();
    let (instances, in_upper_half) = (whole.len(), count(&whole[..whole.len() / 2]));
    scores.whole = Some(WholeScore { instances, whole: count(&whole), in_upper_half });
    scores.unranked = Some(Precision::of(&overlaps, |_| 1.0));
    let background = |id: i32| scores.things.iter().any(|t| t.id == id && t.background);
    scores.proposals = score_proposals(scene, &truth.instance, &nearest, background);
    scores.gaussians = Some(score_gaussians(scene, &truth));
    Ok(())
}

impl Precision {
    fn of(overlaps: &Overlaps, confidence: impl Fn(usize) -> f32) -> Self {
        let ap = |threshold| average_precision(overlaps, &confidence, threshold);
        Self { ap25: ap(0.25), ap50: ap(0.5) }
    }
}

/// Scores the parts, things and groups that masks show, which may overlap, by the nearest Gaussian of each point. None where there are none.
fn score_proposals(
    scene: &LabelledScene,
    truth: &[i32],
    nearest: &[Option<u32>],
    background: impl Fn(i32) -> bool,
) -> Option<ProposalScores> {
    let instances = &scene.instances;
    let mut points = vec![Vec::new(); instances.label.len()];
    for (point, gaussian) in (0u32..).zip(nearest) {
        gaussian.iter().for_each(|&g| points[g as usize].push(point));
    }
    let of = |q: &Granule| {
        let gaussians = q.gaussians(instances);
        (q.fit, gaussians.iter().flat_map(|&g| &points[g as usize]).copied().collect::<Vec<u32>>())
    };
    let proposals: Vec<_> = instances.granules.iter().map(of).filter(|(_, own)| own.len() >= MIN_POINTS).collect();
    let kept = different(&proposals, truth.len(), SAME).into_iter().map(|k| &proposals[k]);
    let (fit, kept): (Vec<f32>, Vec<Vec<u32>>) = kept.cloned().unzip();
    let overlaps = Overlaps::of_sets(truth, &kept, MIN_POINTS);
    let best: Vec<f64> = overlaps.best().filter(|b| !background(b.0)).map(|b| b.1).collect();
    (!instances.granules.is_empty()).then(|| ProposalScores {
        count: kept.len(),
        things: best.len(),
        found: best.iter().filter(|iou| **iou > 0.5).count(),
        object_miou: metrics::mean(&best),
        ranked: Precision::of(&overlaps, |p| fit[p]),
        unranked: Precision::of(&overlaps, |_| 1.0),
    })
}

/// Labels of Gaussians that suit `eval score` best: each takes the thing of most of the surface points whose nearest
/// Gaussian of opacity at least 0.1 it is (of equals the one of the lower id), one that is no point's nearest the thing of the
/// point nearest to it. -1 for damaged Gaussians, and where there is no thing.
pub fn true_labels(geometry: &Geometry, truth: &TruePoints) -> Vec<i32> {
    let (g, whole) = (&geometry.gaussians, geometry.whole());
    let mut labels: Vec<i32> = nearest_of(&truth.position, &g.means)
        .into_iter()
        .zip(whole)
        .map(|(point, whole)| point.filter(|_| whole).map_or(-1, |p| truth.instance[p as usize]))
        .collect();
    let mut owned: Vec<(u32, i32)> = nearest_solid(g, &truth.position, |_| true)
        .into_iter()
        .zip(&truth.instance)
        .filter_map(|(gaussian, &thing)| gaussian.filter(|_| thing >= 0).map(|i| (i, thing)))
        .collect();
    owned.sort_unstable();
    for own in owned.chunk_by(|a, b| a.0 == b.0) {
        let most = own.chunk_by(|a, b| a == b).rev().max_by_key(|same| same.len());
        labels[own[0].0 as usize] = most.map_or(-1, |same| same[0].1);
    }
    labels
}

/// The confidence of `instances` instances that suits average precision best: the IoU of each with the thing whose best it is,
/// as `eval score` finds it, 0 to 1. `labels` are those of all Gaussians, -1 for none.
pub fn true_confidence(geometry: &Geometry, labels: &[i32], instances: usize, truth: &TruePoints) -> Vec<f32> {
    let label = |nearest: Option<u32>| nearest.map_or(-1, |i| labels[i as usize]);
    let found = nearest_solid(&geometry.gaussians, &truth.position, |i| labels[i] >= 0);
    let predicted: Vec<i32> = found.into_iter().map(label).collect();
    let mut confidence = vec![0.0f32; instances];
    for thing in metrics::score_instances(&truth.instance, &predicted).objects {
        if let Some(best) = thing.best {
            let own = &mut confidence[best as usize];
            *own = own.max(thing.iou as f32);
        }
    }
    confidence
}

/// True and predicted instances of fewer Gaussians take no part in average precision over Gaussians.
const MIN_GAUSSIANS: usize = 10;

/// Scores the labels of Gaussians themselves.
fn score_gaussians(scene: &LabelledScene, points: &TruePoints) -> GaussianScores {
    let (g, whole) = (scene.gaussians(), scene.geometry.whole());
    let counted: Vec<usize> = (0..g.len()).filter(|&i| whole[i] && g.opacity(i) >= MIN_OPACITY).collect();
    let means: Vec<[f32; 3]> = counted.iter().map(|&i| g.means[i]).collect();
    let thing = |nearest: Option<u32>| nearest.map_or(-1, |p| points.instance[p as usize]);
    let truth: Vec<i32> = nearest_of(&points.position, &means).into_iter().map(thing).collect();
    let predicted: Vec<i32> = counted.iter().map(|&i| scene.instances.label[i]).collect();
    let confidence = &scene.instances.score;
    let Precision { ap25, ap50 } =
        Precision::of(&Overlaps::of_labels(&truth, &predicted, MIN_GAUSSIANS), |p| confidence[p]);
    GaussianScores {
        count: counted.len(),
        instance_miou: metrics::score_instances(&truth, &predicted).miou,
        ap25,
        ap50,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gs_scene::Gaussians;

    /// Gaussians at these places on a line, with these opacity logits.
    fn line(places: &[(f32, f32)]) -> Geometry {
        let mut gaussians = Gaussians::default();
        for &(x, logit) in places {
            gaussians.means.push([x, 0.0, 0.0]);
            gaussians.opacity_logits.push(logit);
        }
        Geometry { gaussians, ..Geometry::default() }
    }

    #[test]
    fn no_labels_score_more_than_the_true_ones() {
        let truth: Vec<(f32, i32)> =
            vec![(0.0, 0), (0.2, 0), (0.9, 0), (1.1, 1), (1.2, 1), (2.0, 1), (2.9, 1), (3.0, 2), (3.1, 2), (4.0, 2)];
        let points = TruePoints {
            position: truth.iter().map(|&(x, _)| [x, 0.0, 0.0]).collect(),
            instance: truth.iter().map(|&(_, thing)| thing).collect(),
            ..TruePoints::default()
        };
        // The Gaussian at 1 lies nearest to a point of thing 0, but most of its points are of thing 1.
        let geometry = line(&[(0.0, 4.0), (0.98, 4.0), (2.1, 4.0), (3.0, 4.0), (4.2, 4.0)]);
        let found = nearest_solid(&geometry.gaussians, &points.position, |_| true);
        let miou = |labels: &[i32]| {
            let predicted: Vec<i32> = found.iter().map(|g| g.map_or(-1, |g| labels[g as usize])).collect();
            metrics::score_instances(&points.instance, &predicted).miou
        };
        let labels = true_labels(&geometry, &points);
        assert_eq!(labels, [0, 1, 1, 2, 2]);
        assert_eq!(true_confidence(&geometry, &labels, 4, &points), [2.0 / 3.0, 0.6, 0.75, 0.0]);
        let best = miou(&labels);
        for code in 0..4i32.pow(5) {
            let other: Vec<i32> = (0..5).map(|i| code / 4i32.pow(i) % 4 - 1).collect();
            assert!(miou(&other) <= best, "{other:?} scores {}, the truth {best}", miou(&other));
        }
    }

    #[test]
    fn gaussians_that_are_no_surface_take_the_nearest_point() {
        let points = TruePoints {
            position: vec![[0.0; 3], [0.1, 0.0, 0.0], [1.0, 0.0, 0.0]],
            instance: vec![3, 5, -1],
            ..TruePoints::default()
        };
        // The second is faint, so both things are the first one's: of equals the lower id.
        let mut geometry = line(&[(0.0, 4.0), (0.1, -4.0), (0.2, -50.0), (0.9, 4.0)]);
        geometry.damaged = vec![2];
        assert_eq!(true_labels(&geometry, &points), [3, 5, -1, -1]);
        assert_eq!(true_labels(&geometry, &TruePoints::default()), [-1; 4]);
    }
}
