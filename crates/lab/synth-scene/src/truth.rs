//! What a scene is known to show: masks and what they mean, labels, points, scans, and the layouts of benchmarks.

pub mod benchmark;
pub mod label;
pub mod language;
pub mod masks;
pub mod points;
pub mod polygon;
pub mod scannet;
