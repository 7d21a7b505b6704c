//! ONNX models behind one small interface, and CLIP on top of it.
//!
//! [`Model`] runs a graph with named inputs and outputs. Two engines implement it: rten (pure Rust, the default, nothing
//! to install) and ONNX Runtime, whose shared library is loaded at run time when a path to it is given. [`ClipImage`] and
//! [`ClipText`] are the two halves of a CLIP-shaped dual encoder in a folder with `image.onnx`, `text.onnx` and
//! `clip.json` ([`ClipConfig`]); [`crop_mask`] cuts the picture of a mask that such an encoder is shown.

mod clip;
mod crop;
mod engine;
mod graph;
mod ort_engine;
mod rten_engine;
mod tensor;
mod tokenizer;

pub use clip::{ClipConfig, ClipImage, ClipText};
pub use crop::{Bounds, Crop, LabelMap, RgbImage, crop_mask, mask_bounds, resize_rgb};
pub use engine::{EngineArgs, EngineOptions, Kind, Model, Outputs, ValueInfo, hash_model, open, parallel_map};
pub use graph::{Graph, Node};
pub use tensor::{Data, Tensor};
pub use tokenizer::Tokenizer;
