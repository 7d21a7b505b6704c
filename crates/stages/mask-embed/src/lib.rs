//! Stage 0: SAM masks and CLIP features of photographs through ONNX.
//!
//! `options` is the command line, `run` calls the command, and each command has a file: `masks` asks SAM for everything in each photograph ([`sam`],
//! [`automatic`]), chooses ([`nms`]) and writes id maps at four levels ([`paint`], `regions`); `import` takes them from label
//! pictures instead; `embed` shows the picture of each mask to CLIP. All write LangSplat's files: `<view>_s.npy` and
//! `<view>_f.npy`. [`crops`] gives the training script of the small encoder what the pipeline would see. `finished` knows
//! which views are done already, [`logits`] how sure a mask is of each pixel.

pub mod automatic;
pub mod crops;
pub mod embed;
mod finished;
pub mod import;
pub mod logits;
pub mod masks;
mod memory;
pub mod nms;
mod options;
pub mod paint;
mod photographs;
mod regions;
mod run;
pub mod sam;

pub use options::{Args, Choice};
