//! Stage 0: SAM masks and CLIP features of photographs through ONNX.
//!
//! `masks` asks SAM for everything in each photograph and writes id maps at four levels ([`automatic`], [`nms`],
//! [`paint`]); `import` takes them from label pictures instead; `embed` shows the picture of each mask to CLIP. All write
//! LangSplat's files: `<view>_s.npy` and `<view>_f.npy`. `crops` and `tokenize` give the training script of the small
//! encoder what the pipeline would see.

mod args;
pub mod automatic;
pub mod embed;
mod finished;
pub mod import;
pub mod logits;
pub mod masks;
mod memory;
pub mod nms;
pub mod paint;
mod photographs;
mod regions;
pub mod sam;
pub mod tokenize;

pub use args::{ChoiceArgs, CropsArgs, EmbedArgs, EngineArgs, ImportArgs, MasksArgs, SceneArgs, TokenizeArgs};

use gs_io::Result;
use stage::{CommonArgs, Stage};

/// Id maps and CLIP features of photographs, in LangSplat's files.
#[derive(Debug, Clone, clap::Parser)]
#[command(name = "mask-embed", version)]
pub struct Args {
    #[command(flatten)]
    common: CommonArgs,
    #[command(subcommand)]
    task: Task,
}

#[derive(Debug, Clone, clap::Subcommand)]
enum Task {
    /// Make id maps of photographs with SAM
    Masks(Box<MasksArgs>),
    /// Make CLIP features of the masks of existing id maps
    Embed(EmbedArgs),
    /// Make id maps from label pictures
    Import(ImportArgs),
    /// Write the pictures of all masks into one file, for training
    Crops(CropsArgs),
    /// Write token ids of the captions of synthetic scenes, for training
    Tokenize(TokenizeArgs),
}

impl stage::Program for Args {
    const NAME: &'static str = "mask-embed";

    fn common(&self) -> &CommonArgs {
        &self.common
    }

    fn forecasts(&self) -> bool {
        !matches!(self.task, Task::Crops(_) | Task::Tokenize(_))
    }

    fn run(self, stage: &Stage) -> Result<()> {
        match self.task {
            Task::Masks(args) => masks::run(&args, stage),
            Task::Embed(args) => embed::run(&args, stage),
            Task::Import(args) => import::run(&args, stage),
            Task::Crops(args) => embed::write_crops(&args, stage),
            Task::Tokenize(args) => tokenize::run(&args, stage),
        }
    }
}
