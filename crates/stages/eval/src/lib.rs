//! The last stage: text queries, evaluation protocols and the report.

pub mod ablation;
pub mod ask;
pub mod cli;
pub mod granularity;
pub mod label_iou;
pub mod labels;
pub mod lerf;
mod mask;
pub mod mask_stats;
pub mod memory;
pub mod metrics;
pub mod pca;
pub mod place;
pub mod polygon;
pub mod protocol;
pub mod query;
pub mod ranking;
pub mod report;
pub mod runs;
pub mod scan;
pub mod scene;
pub mod score;
pub mod segment;
pub mod silhouette;
pub mod text;

pub use mask::Mask;
