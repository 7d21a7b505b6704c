//! Semantic segmentation of the cloud: every Gaussian gets the text that fits its instance best.

use super::ask::Asker;
use crate::options::QueryOptions;
use crate::scene::{view_name, views_to_show};
use artifacts::{NOISE_COLOR, instance_color};
use gs_io::{Result, write_bytes};
use gs_scene::dataset::Dataset;
use gs_scene::{Gaussians, SH_C0};
use query::{Index, LabelledScene};
use report::picture::Picture;
use serde::{Deserialize, Serialize};
use std::path::Path;

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
    /// File of the Gaussians in the texts' colours, without view dependence.
    pub ply: String,
}

/// Divides the Gaussians among `features`: each instance goes to the feature of highest score (ties: the first), if that
/// reaches `threshold`. Returns the index of the text per Gaussian, -1 for none, and per text its instances.
pub fn divide(
    index: &Index<'_>,
    features: &[Vec<f32>],
    negatives: &[Vec<f32>],
    threshold: Option<f32>,
) -> (Vec<i32>, Vec<Vec<u32>>) {
    let mut best: Vec<Option<(usize, f32)>> = vec![None; index.instances.len()];
    for (t, feature) in features.iter().enumerate() {
        for (b, score) in best.iter_mut().zip(index.scores(feature, negatives)) {
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
    (index.instances.label.iter().map(of).collect(), of_text)
}

/// Divides the cloud among the texts of these features; writes `labels.npy`, `segmentation.ply` and renders of it.
pub(super) fn write(
    o: &QueryOptions,
    features: &[Vec<f32>],
    scene: &LabelledScene,
    dataset: &Dataset,
    asker: &Asker<'_>,
    out: &Path,
) -> Result<Segmentation> {
    let (labels, instances) = divide(&asker.index, features, &asker.negatives, o.choice.threshold);
    let color = |&l: &i32| u32::try_from(l).map_or(NOISE_COLOR, instance_color);
    let sh = labels.iter().flat_map(|l| color(l).map(|c| (c - 0.5) / SH_C0)).collect();
    let coloured = Gaussians { sh, sh_degree: 0, ..scene.gaussians().clone() };
    let (npy, ply) = ("labels.npy", "segmentation.ply");
    gs_io::npy::write_i32(out.join(npy), &ndarray::aview1(&labels))?;
    let comments: Vec<String> = o.text.iter().enumerate().map(|(t, text)| format!("cags label {t}: {text}")).collect();
    gs_scene::ply::write_gaussians(out.join(ply), &coloured, &scene.geometry.comments(comments))?;
    for view in views_to_show(dataset, &o.views.views, |_| true)? {
        let image = gs_raster::render(&coloured, &view.camera, &scene.raster);
        let picture = Picture::new(image.width, image.height, &image.rgb);
        write_bytes(out.join(format!("segmentation.{}.png", view_name(dataset, view))), &picture.png()?)?;
    }
    let segments = o.text.iter().zip(instances).enumerate().map(|(t, (text, instances))| Segment {
        text: text.clone(),
        instances,
        gaussians: labels.iter().filter(|&&l| l == t as i32).count(),
        color: instance_color(t as u32),
    });
    let segments = segments.collect();
    let unlabelled = labels.iter().filter(|&&l| l < 0).count();
    Ok(Segmentation { segments, unlabelled, labels: npy.into(), ply: ply.into() })
}
