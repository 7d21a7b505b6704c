//! Stage 3: 3D instances from features, the masks they were seen as, and a language descriptor for each.
//!
//! [`group`] clusters Gaussians, [`extend`] gives noise and unseen Gaussians to their neighbours, [`join`] joins pieces of one thing, [`vote`] mends their rims, [`associate`] matches
//! instances with the masks of each view, [`describe`] gathers what is known of each instance, [`health`] says
//! how far the masks and the instances agree.

pub mod associate;
pub mod cli;
pub mod describe;
pub mod extend;
pub mod group;
pub mod health;
pub mod join;
pub mod memory;
pub mod vote;
