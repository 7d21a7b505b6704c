//! The command line: a system, its inputs and settings.

use crate::product::{Product, write};
use crate::world::{Inputs, World};
use crate::{laga, langsplat, legaussians, lightsplat, mask_clustering, opengaussian, pairgs, saga, truth, uplift};
use artifacts::Instances;
use gs_io::{Error, Result};
use serde::Serialize;
use stage::{CommonArgs, Stage};
use std::path::Path;

/// Other systems of the field, on our geometry, masks and footprints
///
/// Each writes instances for eval score --instances, or a descriptor of every Gaussian for eval score --descriptors.
#[derive(Debug, clap::Parser)]
#[command(name = "peers", version)]
pub struct Args {
    #[command(subcommand)]
    system: System,
    #[command(flatten)]
    common: CommonArgs,
}

#[derive(Debug, clap::Subcommand, Serialize)]
#[serde(rename_all = "kebab-case")]
enum System {
    /// OpenGaussian: a codebook of two levels over learned features, and its own matching with masks
    Opengaussian(opengaussian::Options),
    /// SAGA: learned features smoothed over neighbours, HDBSCAN on a sample
    Saga(saga::Options),
    /// LaGa: mask prototypes of all views clustered, several descriptors for each object
    Laga(laga::Options),
    /// Occam's LGS: the weighted mean of the masks' features
    Mean(uplift::MeanOptions),
    /// Dr. Splat: the strongest Gaussians of every pixel, product quantisation
    DrSplat(uplift::DrSplatOptions),
    /// VALA: gated visibility, streaming geometric median
    Vala(uplift::ValaOptions),
    /// LangSplat: a scene's autoencoder, a code of three numbers for every Gaussian
    Langsplat(langsplat::Options),
    /// LEGaussians: a codebook of features, a code of eight numbers for every Gaussian
    Legaussians(legaussians::Options),
    /// PairGS: affinities of neighbours from masks of all views, a tree of clusters
    Pairgs(pairgs::Options),
    /// MaskClustering: masks of all views clustered by how many views agree
    MaskClustering(mask_clustering::Options),
    /// LightSplat: masks of all views linked by their Gaussians and features
    Lightsplat(lightsplat::Options),
    /// No rival: what the truth of a synthetic scene allows
    Truth(truth::Options),
}

/// A system with its settings.
pub trait Peer {
    /// What it reads and where it writes.
    fn inputs(&self) -> &Inputs;

    /// The features of feat-train that it reads ([`World::learned`]).
    fn features(&self) -> Option<&Path> {
        None
    }

    /// Where descriptors go that come beside instances.
    fn descriptors(&self) -> Option<&Path> {
        None
    }

    /// Format of what `--out` gets.
    fn format(&self) -> &'static str {
        Instances::FORMAT
    }

    /// Runs the system. It must give the same bytes for the same seed, whatever the number of threads.
    ///
    /// # Errors
    /// When an input is damaged, or lacks what the system needs.
    fn make(&self, world: &World, stage: &Stage) -> Result<Product>;
}

impl System {
    fn peer(&self) -> &dyn Peer {
        match self {
            Self::Opengaussian(o) => o,
            Self::Saga(o) => o,
            Self::Laga(o) => o,
            Self::Mean(o) => o,
            Self::DrSplat(o) => o,
            Self::Vala(o) => o,
            Self::Langsplat(o) => o,
            Self::Legaussians(o) => o,
            Self::Pairgs(o) => o,
            Self::MaskClustering(o) => o,
            Self::Lightsplat(o) => o,
            Self::Truth(o) => o,
        }
    }
}

impl stage::Program for Args {
    const NAME: &'static str = "peers";

    fn common(&self) -> &CommonArgs {
        &self.common
    }

    fn forecasts(&self) -> bool {
        false
    }

    fn run(self, stage: &Stage) -> Result<()> {
        let peer = self.system.peer();
        let mut claim = peer.inputs().claim(peer, stage)?;
        let world = World::read(peer, stage)?;
        let product = peer.make(&world, stage)?;
        world.unchanged()?;
        let parameters = serde_json::to_value(&self.system).map_err(|e| Error::new(e.to_string()))?;
        write(&world, product, peer, parameters, stage, &mut claim)
    }
}
