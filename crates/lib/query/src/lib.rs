//! What answers a question about one set of instances: the instances with their Gaussians (`scene`), features of texts
//! (`text`) that are kept beside the model (`cache`), the ranking by them (`ranking`) and whether the best is better than by chance (`chance`), what instances are called (`naming`), the part, thing or group that is meant (`granules`), Gaussians with descriptors of their own (`gaussians`), which Gaussian is nearest to a point (`nearest`) and which a pixel shows.

mod cache;
mod chance;
mod gaussians;
mod granules;
mod naming;
mod nearest;
mod ranking;
mod scene;
mod text;

pub use cache::encode_cached;
pub use chance::{Unrelated, Verdict};
pub use gaussians::{Chosen, DescribedGaussians, Share};
pub use granules::{Granules, Kind, Meant, SAME, different};
pub use gs_raster::{pixel_weights, tile_weights};
pub use naming::{Vocabulary, name_instances};
pub use nearest::{nearest, nearest_of};
pub use onnx_models::EngineArgs;
pub use ranking::{Index, Join, Ranked, Selection};
pub use scene::{LabelledScene, MIN_OPACITY, check_features, nearest_solid, read_features};
pub use text::{CLIP_TEMPLATES, LERF_NEGATIVES, TextOptions, TextSource, TextTable};
