//! Forecasts of the memory that a command takes, from the sizes of its files. docs/performance.md compares them with
//! measured peaks.

use gs_scene::dataset::View;
use query::TextOptions;
use std::path::Path;

/// Sizes of what a command reads.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Sizes {
    /// Bytes of the geometry as a PLY.
    pub geometry: u64,
    /// Bytes that the text encoder, or the table instead of it, takes.
    pub language: u64,
    /// Bytes of true points, or of a scan's files.
    pub truth: u64,
    /// Pixels of all masks of the labels: a byte each.
    pub labels: u64,
    /// Pixels of the largest view.
    pub pixels: u64,
    /// Bytes of the features that a report shows, or that look-alikes are joined by.
    pub features: u64,
    /// Views that it shows.
    pub shown: u64,
}

impl Sizes {
    /// The sizes of a scene, its text features and its largest view, before any of them is read.
    pub fn new(geometry: &Path, texts: &TextOptions, views: &[View]) -> Self {
        Self { geometry: bytes_as_ply(geometry), language: texts.bytes(), pixels: pixels(views), ..Self::default() }
    }
}

/// What takes less memory.
pub const SMALLER: &str = "give a smaller geometry (gs-geom train --max-gaussians) or smaller pictures";

/// What the program takes for itself.
const PROGRAM: u64 = 8_000_000;

/// Bytes of a file or, for a folder, of the files in it; 0 where it cannot be read: that is an error later, when it is read.
pub fn bytes(path: &Path) -> u64 {
    let of = |p: &Path| std::fs::metadata(p).map_or(0, |m| if m.is_file() { m.len() } else { 0 });
    match std::fs::read_dir(path) {
        Ok(entries) => entries.flatten().map(|e| of(&e.path())).sum(),
        Err(_) => of(path),
    }
}

/// Bytes that a file of Gaussians, which may be packed, takes as a PLY; 0 where it cannot be read.
pub fn bytes_as_ply(geometry: &Path) -> u64 {
    gs_scene::splat::bytes_as_ply(geometry).unwrap_or(0)
}

/// Pixels of the largest view.
pub fn pixels<'a>(views: impl IntoIterator<Item = &'a View>) -> u64 {
    views.into_iter().map(|v| u64::from(v.camera.width) * u64::from(v.camera.height)).max().unwrap_or(0)
}

/// Peak in bytes of `score` and `lerf`.
pub fn of_scores(s: &Sizes) -> u64 {
    // The geometry's file and its Gaussians at the same time; then true points, masks and, where there are some, renders.
    let renders = if s.labels == 0 { 0 } else { 20 * s.pixels };
    PROGRAM + s.language + 2 * (s.geometry + s.features) + 9 * s.truth / 5 + s.labels + renders
}

/// Peak in bytes of `query`.
pub fn of_query(s: &Sizes) -> u64 {
    PROGRAM + s.language + 23 * s.geometry / 10 + 34 * s.pixels
}

/// Peak in bytes of `report`.
pub fn of_report(s: &Sizes) -> u64 {
    // Of each view shown photograph and render stay, and its figures as text, twice at the end.
    PROGRAM + 5 * s.geometry / 2 + 4 * s.features + (65 + 32 * s.shown) * s.pixels
}

/// Peak in bytes of `scannet`.
pub fn of_scan(s: &Sizes) -> u64 {
    PROGRAM + s.language + 2 * s.geometry + 2 * s.truth
}
