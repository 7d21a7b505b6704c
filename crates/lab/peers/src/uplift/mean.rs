//! Occam's LGS (arXiv 2412.01807): the weighted mean of the masks' features.
//!
//! The paper averages over views: a Gaussian takes the feature at the pixel of its projected centre, weighted by its
//! blending weight there, in each view in which it is visible. In its code a Gaussian is visible in a view when it is
//! blended into the pixel of its centre, before that pixel is opaque; a view counts when that pixel lies in a mask;
//! Gaussians that no view counts for are removed. `--at centre` does that.
//!
//! The default takes the same mean over all pixels of all masks, not over centres alone: weights are the footprints'
//! rows, of pixels that pass their gate. It has more samples than one in a view, and it describes Gaussians whose
//! centre is hidden. Gaussians that no mask shows have no descriptor.

use super::{Finish, Share, Shares, centres, described, give_centres, positions, slots, weighted_mean};
use crate::cli::Peer;
use crate::product::Product;
use crate::world::{Inputs, World};
use artifacts::Descriptors;
use gs_io::Result;
use serde::Serialize;
use stage::Stage;

/// Settings of Occam's LGS.
#[derive(Debug, Clone, clap::Args, Serialize)]
pub struct MeanOptions {
    #[command(flatten)]
    #[serde(flatten)]
    inputs: Inputs,
    /// Pixels in which a Gaussian is seen
    #[arg(long, value_enum, default_value_t = At::Masks)]
    at: At,
    #[command(flatten)]
    #[serde(flatten)]
    finish: Finish,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, Serialize)]
#[serde(rename_all = "kebab-case")]
enum At {
    /// All pixels of all masks
    Masks,
    /// The pixel of its centre, one in a view, as in the paper
    Centre,
}

impl Peer for MeanOptions {
    fn inputs(&self) -> &Inputs {
        &self.inputs
    }

    fn format(&self) -> &'static str {
        Descriptors::FORMAT
    }

    fn make(&self, world: &World, stage: &Stage) -> Result<Product> {
        let shares = match self.at {
            At::Masks => of_footprints(world)?,
            At::Centre => of_centres(world, stage)?,
        };
        let table = described(world, slots(&world.levels).len(), &shares, weighted_mean);
        Ok(self.finish.applied(table, world))
    }
}

/// What every mask gives to the Gaussians of its footprint.
fn of_footprints(world: &World) -> Result<Shares> {
    let slots = slots(&world.levels);
    let mut shares = vec![Vec::new(); world.kept()];
    world.footprints.in_batches(&world.rows(), |rows, entries| {
        for (&r, entries) in rows.iter().zip(entries) {
            let row = world.footprints.rows[r as usize];
            let Some(slot) = slots.iter().position(|&l| row.is_of(&[l])) else { continue };
            let share = |weight| Share { view: row.view, mask: row.mask, slot: slot as u32, weight: f64::from(weight) };
            entries.iter().for_each(|(i, weight)| shares[i as usize].push(share(weight)));
        }
    })?;
    Ok(shares)
}

/// What the masks at their centres give to Gaussians.
fn of_centres(world: &World, stage: &Stage) -> Result<Shares> {
    let (slots, positions) = (slots(&world.levels), positions(world));
    let mut shares = vec![Vec::new(); world.kept()];
    for view in 0..world.views.len() {
        stage.go_on()?;
        let (maps, camera) = world.maps(view)?;
        give_centres(&mut shares, view as u32, &centres(world, &camera, &positions), &maps, &slots);
    }
    Ok(shares)
}
