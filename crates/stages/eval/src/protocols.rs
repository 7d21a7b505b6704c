//! The published evaluation protocols. Each function says in its comment what it computes; `docs/protocols.md` has the
//! same in one place, with the commands, and `scripts/protocol_oracle.py` computes the same in Python.
//!
//! [`lerf`], [`scannet`] and [`table`] are the commands. LERF-OVS: [`predict`] makes masks, [`pairs`] scores them. ScanNet:
//! [`classes`] scores classes of vertices, [`instances`] class-agnostic instances. [`published`] has the published numbers.

pub mod classes;
pub mod instances;
pub mod lerf;
pub mod pairs;
pub mod predict;
pub mod published;
pub mod scannet;
pub mod table;
