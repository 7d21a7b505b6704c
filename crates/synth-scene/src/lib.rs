//! Procedural indoor scenes with exact ground truth.
//!
//! [`layout`] furnishes a room from the [`catalogue`] of [`model`]s; [`light`] computes once how much light reaches every
//! surface; [`render`] traces the photographs and what each pixel shows; [`masks`] turns that into id maps with the
//! faults of real ones, [`language`] says what each mask means; [`points`], [`label`] and [`write`] give the rest of what a capture and its truth consist of.
//! Lengths are in metres, z is up, the floor is at z = 0.

pub mod bvh;
pub mod cameras;
pub mod catalogue;
pub mod cli;
pub mod label;
pub mod language;
pub mod layout;
pub mod light;
pub mod masks;
pub mod material;
pub mod model;
pub mod points;
pub mod polygon;
pub mod render;
pub mod scannet;
pub mod scene;
pub mod shape;
#[cfg(test)]
mod testing;
pub mod write;
