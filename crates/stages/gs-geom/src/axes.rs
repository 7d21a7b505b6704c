//! Which axes the numbers of a file have, told by photographs.

use gs_io::Result;
use gs_raster::{Likeness, Photographs};
use gs_scene::Gaussians;
use gs_scene::dataset::{Dataset, View};
use gs_scene::splat::{self, Splat, System};
use stage::Stage;
use std::path::Path;

/// The axes in which the Gaussians of the file `path` show the photographs: those that the file says, or those that it would have if its packer
/// had turned it, or had not. Some programs turn an SPZ by half a turn around x and some don't, and so it is with PLYs that were made of one.
///
/// # Errors
/// When one plain colour is as near to the photographs as the renders in either way.
pub(crate) fn told(splat: &Splat, mut dataset: Dataset, path: &Path, stage: &Stage) -> Result<System> {
    dataset.warnings.iter().for_each(|w| stage.warn(w));
    let axes = splat.axes;
    let others = if axes == System::PLY { System::SPZ } else { System::PLY };
    let whole: Vec<u32> = (0..splat.gaussians.len() as u32).filter(|&i| splat.gaussians.is_whole(i as usize)).collect();
    let mut g = splat.gaussians.select(&whole);
    g.bound_opacities();
    let photographs = Photographs::of(&dataset.views.iter().collect::<Vec<&View>>())?;
    let mut measured = |g: &Gaussians| -> Result<Likeness> {
        dataset.follow(g, path)?;
        Ok(photographs.likeness(g, splat.antialias, &dataset.views.iter().collect::<Vec<&View>>()))
    };
    let as_said = measured(&g);
    splat::turn(&mut g, axes, others);
    // Only in its own axes a scene far from the origin is where its cameras are.
    let (best, turned, found) = match (as_said, measured(&g)) {
        (Err(e), Err(_)) => return Err(e),
        (Ok(said), Err(_)) => (said, false, format!("with axes {axes} {said}")),
        (Err(_), Ok(turned)) => (turned, true, format!("with axes {others} {turned}")),
        (Ok(said), Ok(turned)) => {
            let is_turned = turned.gain() > said.gain();
            let found = format!("with axes {axes} {said}; with {others} {turned}");
            (if is_turned { turned } else { said }, is_turned, found)
        }
    };
    best.expect_same(path, &found)?;
    let (told, why) = if turned { (others, "not as its format says") } else { (axes, "as its format says") };
    stage.info(&format!("{}: axes {told}, {why}: {found}", path.display()));
    Ok(told)
}
