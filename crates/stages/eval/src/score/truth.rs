//! Instances against the true things of a synthetic scene: over points of their surfaces, and over Gaussians.

use super::metrics::{self, InstanceScore};
use super::scores::{GaussianScores, Scores, ThingScore};
use crate::nearest::nearest_of;
use crate::protocols::instances::{MIN_POINTS, average_precision};
use crate::scene::{LabelledScene, MIN_OPACITY};
use artifacts::{TruePoints, TrueScene};
use gs_io::Result;
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
    let predicted: Vec<i32> = scene.nearest_labelled(&truth.position).into_iter().map(label).collect();
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
    let ap = |threshold| average_precision(&truth.instance, &predicted, confidence, MIN_POINTS, threshold);
    (scores.ap25, scores.ap50) = (ap(0.25), ap(0.5));
    scores.gaussians = Some(score_gaussians(scene, &truth));
    Ok(())
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
    let ap = |threshold| average_precision(&truth, &predicted, confidence, MIN_GAUSSIANS, threshold);
    GaussianScores {
        count: counted.len(),
        instance_miou: metrics::score_instances(&truth, &predicted).miou,
        ap25: ap(0.25),
        ap50: ap(0.5),
    }
}
