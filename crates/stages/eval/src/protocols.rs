//! The published evaluation protocols. Each function says in its comment what it computes; `docs/protocols.md` has the
//! same in one place, with the commands, and `scripts/protocol_oracle.py` computes the same in Python.
//!
//! `lerf`, `scannet` and `table` are the commands; `metrics` is what they write for a scene, `made` how it was made. LERF-OVS: `predict` makes masks,
//! `opengaussian` says which Gaussians they show by OpenGaussian's rule, `pairs` scores them. ScanNet:
//! `classes` scores classes of vertices, also those that `vertex_labels` reads, `instances` class-agnostic instances. `published` has the published numbers.

pub(crate) mod classes;
pub mod instances;
pub(crate) mod lerf;
mod made;
mod metrics;
pub(crate) mod opengaussian;
pub(crate) mod pairs;
pub(crate) mod predict;
pub(crate) mod published;
pub(crate) mod scannet;
pub(crate) mod table;
mod vertex_labels;
