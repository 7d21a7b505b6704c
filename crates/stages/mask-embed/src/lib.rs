//! Stage 0: SAM masks and CLIP features of photographs through ONNX.
//!
//! `options` is the command line, and each command has a file: `masks` asks SAM for everything in each photograph ([`sam`],
//! [`automatic`]), chooses ([`nms`]) and writes id maps at four levels ([`paint`], `regions`); `import` takes them from label
//! pictures instead; `embed` shows the picture of each mask to CLIP. All write LangSplat's files: `<view>_s.npy` and
//! `<view>_f.npy`. [`crops`] gives the training script of the small encoder what the pipeline would see. `finished` knows
//! which views are done already, `ahead` works on several at a time, `logits` how sure a mask is of each pixel.
//! [`panoptic`] runs models that give all things of a photograph at once, with names, [`concepts`] models that are asked for nouns;
//! [`classes`] makes levels of what both see.

mod ahead;
pub mod automatic;
mod check;
pub mod classes;
pub mod concepts;
mod constants;
pub mod crops;
mod embed;
mod finished;
mod import;
mod logits;
mod masks;
pub mod nms;
mod options;
pub mod paint;
pub mod panoptic;
mod photographs;
mod regions;
pub mod sam;

pub use options::{Args, Choice};

use gs_io::Result;
use options::Task;
use stage::{CommonArgs, Program, Stage};

impl Program for Args {
    const NAME: &'static str = "mask-embed";

    fn common(&self) -> &CommonArgs {
        &self.common
    }

    fn forecasts(&self) -> bool {
        !matches!(self.task, Task::Crops(_) | Task::Check(_))
    }

    fn run(self, stage: &Stage) -> Result<()> {
        match self.task {
            Task::Masks(args) => masks::run(&args, stage),
            Task::Embed(args) => embed::run(&args, stage),
            Task::Import(args) => import::run(&args, stage),
            Task::Crops(args) => crops::run(&args, stage),
            Task::Check(args) => check::run(&args, stage),
        }
    }
}
