//! Which command does what.

use crate::options::{Args, Task};
use crate::{crops, embed, import, masks};
use gs_io::Result;
use stage::{CommonArgs, Program, Stage};

impl Program for Args {
    const NAME: &'static str = "mask-embed";

    fn common(&self) -> &CommonArgs {
        &self.common
    }

    fn forecasts(&self) -> bool {
        !matches!(self.task, Task::Crops(_))
    }

    fn run(self, stage: &Stage) -> Result<()> {
        match self.task {
            Task::Masks(args) => masks::run(&args, stage),
            Task::Embed(args) => embed::run(&args, stage),
            Task::Import(args) => import::run(&args, stage),
            Task::Crops(args) => crops::run(&args, stage),
        }
    }
}
