//! The last stage: text queries, evaluation protocols and the report.

pub mod cli;
pub mod curves;
pub mod html;
pub mod labels;
mod mask;
pub mod metrics;
pub mod pca;
pub mod picture;
pub mod polygon;
pub mod query;
pub mod ranking;
pub mod report;
pub mod runs;
pub mod scene;
pub mod score;
pub mod silhouette;
pub mod svg;
pub mod text;

pub use mask::Mask;
