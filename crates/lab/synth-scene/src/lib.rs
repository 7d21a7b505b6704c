//! Procedural indoor scenes with exact ground truth.
//!
//! * `options`: the command line, and what it means for a scene.
//! * [`mod@write`]: the program told from beginning to end: furnish, photograph, write.
//! * `things`: the classes of things and how each is built.
//! * `scene`: what stands in a room, where it stands (`families`, `layout`, `workshop`) and where cameras go.
//! * `render`: photographs, and the light in the room.
//! * `truth`: id maps with the faults of real ones, what each mask means, labels, points, scans, and where files lie.
//!
//! Lengths are in metres, z is up, the floor is at z = 0.

mod options;
mod random;
mod render;
mod scene;
#[cfg(test)]
mod testing;
mod things;
mod truth;
pub mod write;

pub use options::Args;
pub use truth::masks;
