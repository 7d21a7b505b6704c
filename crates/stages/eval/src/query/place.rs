//! What is at a pixel of a view, or at a point in space.

use super::ask::{Answered, Asked, Asker, Place};
use crate::options::QueryOptions;
use crate::scene::find_view;
use gs_io::{Error, Result};
use gs_scene::dataset::{Dataset, View};
use query::{Index, LabelledScene, Ranked, pixel_weights};
use std::collections::BTreeMap;

/// Names that a place is given.
const NAMES: usize = 5;
/// Farther than this from all labelled Gaussians, in sizes of the scene, a point lies outside of it.
const FAR: f64 = 10.0;

/// The answers to places: pixels as VIEW:X,Y, then points as X,Y,Z. They are named by the texts, or by all names of the
/// table.
pub fn answers(o: &QueryOptions, scene: &LabelledScene, dataset: &Dataset, asker: &Asker<'_>) -> Result<Vec<Asked>> {
    let mut named = Vec::new();
    if let Some(source) = asker.source.as_ref().filter(|_| !o.pixel.is_empty() || !o.point.is_empty()) {
        let texts = if o.text.is_empty() { source.names() } else { o.text.clone() };
        let features = source.encode_in(&asker.templates, &texts)?;
        named.extend(texts.into_iter().zip(features).filter_map(|(text, f)| Some((text, f?))));
    }
    let mut asked = Vec::new();
    for text in &o.pixel {
        let bad = || Error::new("not understood").field("--pixel").found(text).expected("VIEW:X,Y");
        let (view, at) = text.rsplit_once(':').ok_or_else(bad)?;
        let found = at_pixel(scene, &asker.index, find_view(dataset, view)?, numbers(at, "--pixel")?)?;
        asked.push(located(text, "pixel", found, asker, &named));
    }
    for text in &o.point {
        let point: [f32; 3] = numbers(text, "--point")?;
        if point.iter().any(|v| !v.is_finite()) {
            return Err(Error::new("not a point").field("--point").found(text).expected("finite numbers"));
        }
        asked.push(located(text, "point", at_point(scene, &asker.index, point)?, asker, &named));
    }
    Ok(asked)
}

/// Numbers with commas between, as many as `N`.
fn numbers<T: std::str::FromStr + Copy, const N: usize>(text: &str, option: &str) -> Result<[T; N]> {
    let parsed: Option<Vec<T>> = text.split(',').map(|p| p.trim().parse().ok()).collect();
    parsed.and_then(|all| <[T; N]>::try_from(all).ok()).ok_or_else(|| {
        Error::new("not understood").field(option).found(text).expected(format!("{N} numbers with commas between"))
    })
}

/// The instance with the largest share of a place is the answer, whatever the options of selection say. `named` are texts
/// that the place may be called, with their features.
fn located(
    text: &str,
    kind: &str,
    (mut place, ranking): (Place, Vec<Ranked>),
    asker: &Asker<'_>,
    named: &[(String, Vec<f32>)],
) -> Asked {
    let first = ranking.first().copied();
    if let Some(first) = first {
        let score = |f: &[f32]| asker.index.scores(f, &asker.negatives)[first.instance as usize];
        place.names = named.iter().filter_map(|(text, f)| Some((text.clone(), score(f)?))).collect();
        place.names.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
        place.names.truncate(NAMES);
    }
    let selected: Vec<u32> = first.map(|r| r.instance).into_iter().collect();
    let gaussians = asker.index.members(&selected);
    let answer = Answered { score: first.map(|r| r.score), gaussians, selected, ranking, ..Answered::default() };
    Asked::new(format!("{kind} {text}"), kind, Some(place), answer)
}

/// What pixel (x, y) of a view shows: the instances by falling share of the pixel's blending weight.
fn at_pixel(scene: &LabelledScene, index: &Index<'_>, view: &View, pixel: [u32; 2]) -> Result<(Place, Vec<Ranked>)> {
    let camera = &view.camera;
    let [x, y] = pixel;
    if x >= camera.width || y >= camera.height {
        return Err(Error::new("the pixel lies outside the view")
            .field("--pixel")
            .found(format!("{x},{y}"))
            .expected(format!("x below {} and y below {} in {}", camera.width, camera.height, view.stem())));
    }
    let weights = pixel_weights(scene.gaussians(), camera, &scene.raster, pixel);
    let alpha: f64 = weights.iter().map(|w| w.1).sum();
    let mut shares = BTreeMap::<i32, f64>::new();
    let mut position = [0.0f64; 3];
    for &(i, w) in &weights {
        *shares.entry(scene.instances.label[i as usize]).or_default() += w;
        let mean = scene.gaussians().means[i as usize];
        (0..3).for_each(|k| position[k] += w / alpha * f64::from(mean[k]));
    }
    let noise = shares.get(&-1).copied().unwrap_or(0.0);
    let shares = shares.into_iter().filter_map(|(l, share)| Some((usize::try_from(l).ok()?, share as f32)));
    let ranking = index.ranking(shares);
    let place = Place {
        view: Some(view.stem().into()),
        pixel: Some(pixel),
        position: (alpha > 0.0).then_some(position),
        alpha_or_distance: Some(alpha),
        noise,
        ..Place::default()
    };
    Ok((place, ranking))
}

/// What is at a point of the world: the instance of the nearest labelled Gaussian of opacity at least 0.1.
fn at_point(scene: &LabelledScene, index: &Index<'_>, point: [f32; 3]) -> Result<(Place, Vec<Ranked>)> {
    let (g, label) = (scene.gaussians(), &scene.instances.label);
    let found = scene.nearest_labelled(&[point])[0];
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
    let ranking = index.ranking(found.map(|i| (label[i as usize] as usize, 1.0)).into_iter());
    Ok((Place { position: mean, alpha_or_distance: distance, ..Place::default() }, ranking))
}
