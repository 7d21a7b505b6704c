//! Which axes the numbers of a file have, told by photographs.

use crate::metrics::psnr;
use crate::photographs::exact_target;
use crate::photographs::masks::Masks;
use gs_io::{Error, Result};
use gs_raster::{RasterOptions, render};
use gs_scene::Gaussians;
use gs_scene::dataset::{Dataset, Resolution, View};
use gs_scene::splat::{self, Splat, System};
use stage::Stage;
use std::path::Path;

/// Photographs that are looked at at most, and their size.
const PHOTOGRAPHS: usize = 8;
pub(crate) const RESOLUTION: Resolution = Resolution::Width(240);

/// The axes in which the Gaussians of the file `path` show the photographs: those that the file says, or those that it would have if its packer
/// had turned it, or had not. Some programs turn an SPZ by half a turn around x and some don't, and so it is with PLYs that were made of one.
///
/// # Errors
/// When a picture of the photographs' mean colour is as near to them as the renders in either way.
pub(crate) fn told(splat: &Splat, mut dataset: Dataset, path: &Path, stage: &Stage) -> Result<System> {
    dataset.warnings.iter().for_each(|w| stage.warn(w));
    let axes = splat.axes;
    let others = if axes == System::PLY { System::SPZ } else { System::PLY };
    let whole: Vec<u32> = (0..splat.gaussians.len() as u32).filter(|&i| splat.gaussians.is_whole(i as usize)).collect();
    let mut g = splat.gaussians.select(&whole);
    g.bound_opacities();
    let apart = dataset.views.len().div_ceil(PHOTOGRAPHS).max(1);
    let photographs = |d: &Dataset| d.views.iter().step_by(apart).cloned().collect::<Vec<View>>();
    let target = |v: &View| Ok(exact_target(v, &Masks::default(), [0.0; 3])?.rgb);
    let targets = photographs(&dataset).iter().map(target).collect::<Result<Vec<Vec<f32>>>>()?;
    let mut measured = |g: &Gaussians| {
        dataset.follow(g, path)?;
        Ok(fit(g, splat.antialias, &photographs(&dataset), &targets))
    };
    let as_said = measured(&g);
    splat::turn(&mut g, axes, others);
    // Only in its own axes a scene far from the origin is where its cameras are.
    let (as_said, turned) = match (as_said, measured(&g)) {
        (Err(e), Err(_)) => return Err(e),
        (a, b) => (a.unwrap_or(f64::NEG_INFINITY), b.unwrap_or(f64::NEG_INFINITY)),
    };
    let blank = blank(&targets);
    let found = format!(
        "{as_said:.1} dB with axes {axes}, {turned:.1} dB with {others} on {} photographs; a picture of one colour has {blank:.1} dB",
        targets.len()
    );
    if as_said.max(turned) <= blank {
        return Err(Error::new("the Gaussians do not show these photographs").file(path).found(found).hint(
            "give the photographs that they were made from; where they are a part of the scene only, say their axes (--axes RDF; AXES=RDF of make)",
        ));
    }
    let (told, why) = if turned > as_said { (others, "not as its format says") } else { (axes, "as its format says") };
    stage.info(&format!("{}: axes {told}, {why}: {found}", path.display()));
    Ok(told)
}

/// Mean PSNR in dB of renders of these views, over black or over white, whichever is nearer.
fn fit(g: &Gaussians, antialias: bool, views: &[View], targets: &[Vec<f32>]) -> f64 {
    let options = RasterOptions { antialias, ..RasterOptions::fit(g) };
    let mut sums = [0.0; 2];
    for (view, target) in views.iter().zip(targets) {
        let r = render(g, &view.camera, &options);
        for (sum, behind) in sums.iter_mut().zip([0.0, 1.0]) {
            let over = |(p, alpha): (&[f32; 3], &f32)| p.map(|v| (v + behind * (1.0 - alpha)).clamp(0.0, 1.0));
            let picture: Vec<f32> = r.rgb.as_chunks().0.iter().zip(&r.alpha).flat_map(over).collect();
            *sum += psnr(&picture, target);
        }
    }
    sums[0].max(sums[1]) / views.len() as f64
}

/// Mean PSNR in dB of a picture of the photographs' mean colour.
fn blank(targets: &[Vec<f32>]) -> f64 {
    let pixels = || targets.iter().flat_map(|t| t.as_chunks::<3>().0);
    let n = pixels().count().max(1) as f64;
    let mean = [0, 1, 2].map(|c| (pixels().map(|p| f64::from(p[c])).sum::<f64>() / n) as f32);
    targets.iter().map(|t| psnr(&[mean].repeat(t.len() / 3).into_flattened(), t)).sum::<f64>() / targets.len() as f64
}
