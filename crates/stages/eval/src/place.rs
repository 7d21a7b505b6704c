//! What is at a pixel of a view, or at a point in space.

use crate::protocol::scannet::nearest;
use crate::ranking::{Index, Ranked};
use crate::scene::LabelledScene;
use gs_io::{Error, Result};
use gs_raster::{TILE, tile_weights};
use gs_scene::dataset::View;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Gaussians fainter than this are not taken for the surface nearest a point.
const MIN_OPACITY: f32 = 0.1;

/// Farther than this from all labelled Gaussians, in sizes of the scene, a point lies outside of it.
const FAR: f64 = 10.0;

/// A place that was asked about.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Place {
    /// Stem of the view, for a pixel.
    pub view: Option<String>,
    /// The pixel, x and y.
    pub pixel: Option<[u32; 2]>,
    /// Where it is in the world: the mean of what the pixel shows, or the nearest labelled Gaussian's centre. None when
    /// there is nothing.
    pub position: Option<[f64; 3]>,
    /// Accumulated alpha of the pixel, 0 to 1, or distance from the point to that Gaussian.
    pub alpha_or_distance: Option<f64>,
    /// Share of the pixel that belongs to no instance, 0 to 1.
    pub noise: f64,
    /// What it may be called: texts by falling score with the first instance's descriptor.
    pub names: Vec<(String, f32)>,
}

/// What pixel (x, y) of a view shows: the instances by falling share of the pixel's blending weight.
///
/// # Errors
/// When the pixel lies outside the view.
pub fn at_pixel(
    scene: &LabelledScene,
    index: &Index<'_>,
    view: &View,
    pixel: [u32; 2],
) -> Result<(Place, Vec<Ranked>)> {
    let camera = &view.camera;
    let [x, y] = pixel.map(|v| v as usize);
    if pixel[0] >= camera.width || pixel[1] >= camera.height {
        return Err(Error::new("the pixel lies outside the view")
            .field("--pixel")
            .found(format!("{x},{y}"))
            .expected(format!("x below {} and y below {} in {}", camera.width, camera.height, view.stem())));
    }
    let here = tile_weights(scene.gaussians(), camera, &scene.raster, true, |t| {
        let inside = (t.x0..t.x0 + t.width).contains(&x) && (t.y0..t.y0 + t.height).contains(&y);
        let at = inside.then(|| (y - t.y0) * TILE + x - t.x0)?;
        let weights = t.gaussians.iter().zip(t.weights.chunks_exact(TILE * TILE));
        Some(weights.map(|(&i, w)| (i, f64::from(w[at]))).filter(|w| w.1 > 0.0).collect::<Vec<_>>())
    });
    let weights: Vec<(u32, f64)> = here.into_iter().flatten().flatten().collect();
    let alpha: f64 = weights.iter().map(|w| w.1).sum();
    let mut shares = BTreeMap::<i32, f64>::new();
    let mut position = [0.0f64; 3];
    for &(i, w) in &weights {
        *shares.entry(scene.instances.label[i as usize]).or_default() += w;
        let mean = scene.gaussians().means[i as usize];
        (0..3).for_each(|k| position[k] += w / alpha * f64::from(mean[k]));
    }
    let noise = shares.get(&-1).copied().unwrap_or(0.0);
    let mut ranking: Vec<Ranked> = shares
        .into_iter()
        .filter_map(|(l, share)| Some(ranked(scene, index, usize::try_from(l).ok()?, share as f32)))
        .collect();
    ranking.sort_by(|a, b| b.score.total_cmp(&a.score).then(a.instance.cmp(&b.instance)));
    let place = Place {
        view: Some(view.stem().into()),
        pixel: Some(pixel),
        position: (alpha > 0.0).then_some(position),
        alpha_or_distance: Some(alpha),
        noise,
        names: Vec::new(),
    };
    Ok((place, ranking))
}

/// What is at a point of the world: the instance of the nearest labelled Gaussian of opacity at least 0.1.
///
/// # Errors
/// When that Gaussian is so far that it says nothing of the point.
pub fn at_point(scene: &LabelledScene, index: &Index<'_>, point: [f32; 3]) -> Result<(Place, Vec<Ranked>)> {
    let (g, label) = (scene.gaussians(), &scene.instances.label);
    let speaks = |&i: &u32| label[i as usize] >= 0 && g.opacity(i as usize) >= MIN_OPACITY;
    let speakers: Vec<u32> = (0..g.len() as u32).filter(speaks).collect();
    let found = nearest(g, &speakers, &[point])[0];
    let mean = found.map(|i| g.means[i as usize].map(f64::from));
    let distance = mean.map(|m| (0..3).map(|k| (m[k] - f64::from(point[k])).powi(2)).sum::<f64>().sqrt());
    let most = FAR * g.spread();
    if let Some(distance) = distance.filter(|d| *d > most) {
        return Err(Error::new("the point lies outside the scene")
            .field("--point")
            .found(format!("{point:?}, {distance:.4e} from the nearest labelled Gaussian"))
            .expected(format!("at most {most:.4e} from it, in units of the scene"))
            .hint("gs-geom inspect tells the bounds of the geometry"));
    }
    let ranking = found.map(|i| ranked(scene, index, label[i as usize] as usize, 1.0)).into_iter().collect();
    let place =
        Place { view: None, pixel: None, position: mean, alpha_or_distance: distance, noise: 0.0, names: Vec::new() };
    Ok((place, ranking))
}

fn ranked(scene: &LabelledScene, index: &Index<'_>, instance: usize, score: f32) -> Ranked {
    let (support, gaussians) = (scene.instances.support[instance], index.gaussians_of(instance).len() as u32);
    Ranked { instance: instance as u32, score, support, gaussians }
}
