//! The artifacts that stages exchange: one type, one reader and one writer each, so that what two stages share on disk
//! is said in one place. docs/artifacts.md is the same for readers in other languages.
//!
//! Indices: N counts the Gaussians of `geometry.ply`; *kept* are the Gaussians that some view sees, as ascending
//! original indices, n of them. Graph, footprints and features name kept Gaussians by their position in that list.

mod checks;
mod descriptors;
mod draft;
mod edits;
mod extents;
mod features;
mod footprints;
mod granules;
mod graph;
mod health;
mod instances;
mod lerf_ovs;
mod masks;
mod names;
mod nyu40;
mod palette;
mod runs;
mod scratch;
mod truth;

use ndarray::{ArrayView, Dimension};

pub use descriptors::Descriptors;
pub use draft::{Draft, Witness};
pub use edits::{Edit, Edits, Remarks};
pub use extents::Extents;
pub use features::Features;
pub use footprints::{Entries, Footprints, FootprintsBuilder, PixelSamples, Row};
pub use granules::{Granule, Members};
pub use graph::Graph;
pub use health::Health;
pub use instances::{Family, Instances, Match, OrientedBox, TreeEdge};
pub use lerf_ovs::{LERF_OVS, LerfScene};
pub use masks::{
    LEVELS, Level, LevelKind, MaskFeatures, MaskFolder, MaskMaps, MaskName, MaskNames, features_path, folder_files,
    hash_folder, maps_path, note_path, read_mask_names, same_shape, stems, watch_folder,
};
pub use names::{Called, InstanceNames, Naming, ScoredName, called};
pub use nyu40::NYU40;
pub use palette::{NOISE_COLOR, instance_color};
pub use runs::{ranges_of, runs_of};
pub use scratch::{Scratch, ScratchEntries};
pub use truth::{MaskTruth, TrueObject, TruePart, TruePoints, TrueScene};

/// The values of an array in C order, for what works on slices.
///
/// # Panics
/// When the array is not in standard layout, which those of artifacts are.
pub fn flat<T, D: Dimension>(array: ArrayView<'_, T, D>) -> &[T] {
    array.to_slice().expect("standard layout")
}

/// Roles under which artifacts record the hashes of their inputs.
pub mod role {
    /// `geometry.ply`.
    pub const GEOMETRY: &str = "geometry";
    /// The dataset: names, cameras and photographs.
    pub const DATASET: &str = "dataset";
    /// All id maps (`*_s.npy`) of a masks folder.
    pub const MASKS: &str = "masks";
    /// All mask features (`*_f.npy`) of a masks folder.
    pub const MASK_FEATURES: &str = "mask-features";
    /// All `*_s.json` of the masks folder, where masks have names.
    pub const MASK_NAMES: &str = "mask-names";
    /// `image.onnx` of the CLIP pair that made the mask features.
    pub const CLIP: &str = "clip";
    /// `text.onnx` of the same pair.
    pub const CLIP_TEXT: &str = "clip-text";
    /// `graph.safetensors`.
    pub const GRAPH: &str = "graph";
    /// `footprints.safetensors`.
    pub const FOOTPRINTS: &str = "footprints";
    /// `instances.edits.json`.
    pub const EDITS: &str = "edits";
    /// `features.safetensors`.
    pub const FEATURES: &str = "features";
}
