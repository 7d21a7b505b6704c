//! The stage from its inputs to its features.

use crate::contrastive::{self, checkpoint};
use crate::inputs::Inputs;
use crate::memory;
use crate::options::Args;
use crate::outputs::CURVE;
use crate::spectral;
use artifacts::Features;
use gs_io::{Result, Watched, with_suffix};
use stage::{CommonArgs, Program, Stage};

impl Program for Args {
    const NAME: &'static str = "feat-train";

    fn common(&self) -> &CommonArgs {
        &self.common
    }

    fn check(&self) -> Result<()> {
        self.options.check()
    }

    fn run(self, stage: &Stage) -> Result<()> {
        let unfinished = checkpoint::path(&self.out);
        let mut claim = stage
            .outputs(&self.out)
            .artifact(&self.out, Features::FORMAT)
            .artifact(&unfinished, checkpoint::FORMAT)
            .files(CURVE.map(|suffix| with_suffix(&self.out, suffix)))
            .reads([&self.geometry, &self.graph, &self.footprints])
            .claim()?;
        let watched = Watched::new([&self.geometry, &self.footprints]);
        let inputs = Inputs::read(&self)?;
        let geometry = gs_scene::splat::bytes_as_ply(&self.geometry).unwrap_or(0);
        let needed = memory::forecast(&inputs, &self.options, geometry)?;
        stage.forecast(needed, "drop small footprint entries: graph-precompute --cut 0.001")?;

        let made = match self.options.preset {
            Some(_) => contrastive::features(&self, &inputs, stage)?,
            None => spectral::features(&self, &inputs, stage)?,
        };

        let parameters = self.options.parameters(self.common.seed);
        let features = Features { kept: inputs.graph.kept, values: made.values };
        watched.check()?;
        features.write(&self.out, stage.provenance("", 0, parameters.clone(), inputs.hashes.clone()))?;
        // The run is complete: what is left of it must not look like an unfinished one.
        let _ = std::fs::remove_file(unfinished);
        stage.info(&format!("features of {} Gaussians, {} dimensions", features.kept.len(), features.dim()));
        stage.record(&mut claim, parameters, inputs.hashes, made.summary)
    }
}
