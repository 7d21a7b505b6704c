//! Stage 3: 3D instances, the masks they were seen as, and a language descriptor for each.
//!
//! `options` is the command line, `run` the story, `inputs` and `outputs` its ends. `linkage` clusters Gaussians by how far
//! their masks agree (`profile` says how far, `plane` tells floors and walls), `group` by their features;
//! `assignment` keeps who belongs to which instance, and gives noise and unseen Gaussians to their neighbours; where features
//! were clustered, `vote` corrects rims. `granules` finds parts, things and groups, and the masks that fit them and the instances best,
//! `matching` says which of these count, `describe` gathers
//! what is known of each instance and which masks say what it means, `rank` says how sure it is one whole thing, `health` how far
//! masks and instances agree, `memory` forecasts the peak.

mod assignment;
mod describe;
mod doubt;
mod granules;
mod group;
mod health;
mod inputs;
mod linkage;
mod matching;
mod memory;
mod options;
mod outputs;
mod parts;
mod plane;
mod profile;
mod rank;
mod run;
mod surface;
#[cfg(test)]
mod testing;
mod vote;

pub use describe::{Witnesses, descriptors, gather};
pub use options::Args;
pub use profile::mask_weights;
