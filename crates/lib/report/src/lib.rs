//! What people look at: pages, tables, plots and pictures.
//!
//! [`html`] writes a page that needs no other file, [`sheet`] tables of published and measured figures, [`plot`] charts as
//! SVG, [`curve`] the charts of a training run, [`picture`] images with overlays,
//! [`feature_colors`] features as colours.

pub mod curve;
pub mod html;
mod pca;
pub mod picture;
pub mod plot;
pub mod sheet;

pub use pca::feature_colors;
