//! The last stage: text queries, evaluation protocols and the report.

pub mod html;
pub mod labels;
mod mask;
pub mod metrics;
pub mod pca;
pub mod picture;
pub mod polygon;
pub mod ranking;
pub mod svg;

pub use mask::Mask;
