//! Procedural indoor scenes with exact ground truth.
//!
//! [`layout`] and [`families`] furnish a room from the [`catalogue`] of [`model`]s, [`props`] and [`furniture`]; [`light`] computes once how much light reaches every
//! surface; [`render`] traces the photographs and what each pixel shows; [`masks`] turns that into id maps with the
//! faults of real ones, [`language`] says what each mask means; [`points`], [`label`] and [`mod@write`] give the rest of what a capture and its truth consist of, [`benchmark`] where it lies.
//! Lengths are in metres, z is up, the floor is at z = 0.

pub mod benchmark;
pub mod bvh;
pub mod cameras;
pub mod catalogue;
pub mod cli;
pub mod dress;
pub mod families;
pub mod furniture;
pub mod label;
pub mod language;
pub mod layout;
pub mod light;
pub mod masks;
pub mod material;
pub mod memory;
pub mod model;
pub mod points;
pub mod polygon;
pub mod props;
pub mod render;
pub mod scannet;
pub mod scene;
pub mod shape;
#[cfg(test)]
mod testing;
pub mod write;
