//! The published evaluation protocols. Each function says in its comment what it computes; `docs/protocols.md` has the
//! same in one place, with the commands, and `scripts/protocol_oracle.py` computes the same in Python.

pub mod instances;
pub mod lerf;
pub mod published;
pub mod scannet;
