//! Files of the pipeline.
//!
//! Everything a stage does to the file system goes through this crate, so that the promises hold in one place:
//! an error is one line that names file, field, what was found, what was expected and what to do ([`Error`]);
//! an output appears whole or not at all ([`write_atomic`]);
//! a run writes only what it claimed, and nothing that somebody else made ([`Outputs`]); one run at a time works on an output ([`Lock`]); inputs that change meanwhile are noticed ([`Watched`]); an artifact says what it was made from ([`artifact`]).

pub mod artifact;
mod atomic;
mod error;
mod expected;
mod hash;
mod lock;
mod names;
pub mod npy;
mod outputs;
mod place;
mod watch;

pub use artifact::{Artifact, ArtifactWriter, Provenance};
pub use atomic::{create_dir, write_atomic, write_bytes, write_json};
pub use error::{Error, ErrorKind, IoContext, Result};
pub use expected::{Expecting, expect_new};
pub use hash::{hash_bytes, hash_file, hash_files, mixed};
pub use lock::Lock;
pub use names::{check_name, escaped, is_control};
pub use outputs::{Claim, Outputs, Written, record_path};
pub use place::with_suffix;
pub use watch::Watched;
