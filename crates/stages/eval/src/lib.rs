//! The last stage: text queries, evaluation protocols and the report.
//!
//! `options` holds the options of every command; `cli` says which command runs what: `query` answers questions, `names` says what is there,
//! `check` looks at what a benchmark needs, `score` compares with the truth of a scene, `protocols` follows the published benchmarks, `page` makes the report.
//! They share what answers a question (the library `query`), what they load and how they name it (`scene`), how a selection
//! becomes a mask (`silhouette`) and the forecast of memory (`memory`).

mod check;
mod cli;
mod mask;
mod mask_stats;
mod memory;
mod names;
mod options;
mod page;
mod protocols;
mod query;
mod scene;
mod score;
mod silhouette;

pub use self::query::ask::Asker;
pub use self::query::segment::divide;
pub use cli::Args;
pub use mask::Mask;
pub use protocols::instances::read_truth;
pub use scene::numbered;
pub use score::labels::{read as read_labels, read_mask};
pub use score::{true_confidence, true_labels};
