//! The paper's stage 2, `feat-train --preset literal` and `--preset paper`: contextual propagation and contrastive learning on masks.
//!
//! * [`context`] and [`masks`]: what training reads of a scene.
//! * [`model`], with [`network`], [`normalize`], [`loss`] and [`terms`]: the equations and their gradients, for f32 and
//!   f64 ([`real`]).
//! * [`mod@train`]: the loop, on the [`state`], which [`checkpoint`] saves. [`solver`]: one iteration of it. [`adam`]: the optimiser.

mod adam;
mod alignment;
pub mod checkpoint;
mod context;
mod loss;
pub mod masks;
mod model;
mod network;
mod normalize;
mod real;
mod solver;
mod state;
mod terms;
#[cfg(test)]
mod testing;
mod train;

use crate::inputs::Inputs;
use crate::options::Args;
use crate::outputs::Made;
use context::Context;
use gs_io::{Error, Result};
use gs_scene::{Geometry, SH_C0};
use masks::MaskSets;
use stage::Stage;
use train::train;

/// Trains the features and writes their curve.
pub fn features(args: &Args, inputs: &Inputs, stage: &Stage) -> Result<Made> {
    let context = frozen_graph(args, inputs, stage)?;
    let sets = masks_to_learn_from(args, inputs, &context, stage)?;
    train(args, inputs, &context, sets, stage)
}

/// The graph with the colours and positions of its Gaussians.
fn frozen_graph(args: &Args, inputs: &Inputs, stage: &Stage) -> Result<Context> {
    // Damaged Gaussians are not among the kept ones: graph-precompute leaves them out.
    let geometry = Geometry::read(&args.geometry)?;
    if let Some(damage) = geometry.damage() {
        stage.skipped(&damage);
    }
    let gaussians = geometry.gaussians;
    let kept = &inputs.graph.kept;
    if let Some(&last) = kept.last().filter(|l| **l as usize >= gaussians.len()) {
        return Err(Error::new("the graph has Gaussians that the geometry lacks")
            .file(&args.graph)
            .field("kept")
            .found(last)
            .expected(format!("below {}", gaussians.len()))
            .hint("run graph-precompute on this geometry"));
    }
    let color = |&i: &u32| [0, 1, 2].map(|channel| 0.5 + SH_C0 * gaussians.sh_of(i as usize)[channel]);
    let colors: Vec<[f32; 3]> = kept.iter().map(color).collect();
    let positions: Vec<[f32; 3]> = kept.iter().map(|&i| gaussians.means[i as usize]).collect();
    Ok(Context::new(&inputs.graph, &colors, &positions, !args.options.contrastive.no_propagation))
}

/// The masks of every view and level that teaches something.
fn masks_to_learn_from<'a>(
    args: &Args,
    inputs: &'a Inputs,
    context: &'a Context,
    stage: &Stage,
) -> Result<MaskSets<'a>> {
    let (levels, options) = (args.options.levels(), &args.options.contrastive);
    // A single mask has no other to be separated from, but cohesion works on it.
    let least = if options.cohesion > 0.0 { 1 } else { 2 };
    let sets = MaskSets::new(&inputs.footprints, context, &levels, least)?;
    let units = inputs.footprints.views.len() * levels.len();
    if sets.len() < units {
        let why = if least == 1 { "no mask" } else { "fewer than two masks" };
        stage.skipped(&format!("{} of {units} views and levels: {why}", units - sets.len()));
    }
    if sets.len() == 0 {
        let what = if least == 1 { "no view has a mask" } else { "no view has two masks to tell apart" };
        return Err(Error::new(what)
            .file(&args.footprints)
            .field("--levels")
            .found(format!("{levels:?}"))
            .hint("choose other --levels, or make masks with more than one segment a view"));
    }
    if options.needs_pixels() && !sets.have_pixels() {
        return Err(Error::new("no sampled pixels, which --loss pixel and --cohesion need")
            .file(&args.footprints)
            .field("pixel_row")
            .hint("run graph-precompute with --pixel-samples 16"));
    }
    Ok(sets)
}
