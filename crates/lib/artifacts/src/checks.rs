//! Checks that several artifacts share.

use gs_io::{Artifact, Error, Result};

/// Names of the views (file stems) that an artifact speaks of.
pub(crate) fn view_names(a: &Artifact) -> Result<Vec<String>> {
    serde_json::from_value(a.provenance().extra["views"].clone())
        .map_err(|e| Error::new(format!("no list of view names: {e}")).file(a.path()).field("views"))
}

/// Checks that every index of tensor `name` is below `limit`.
pub(crate) fn below(a: &Artifact, name: &str, indices: &[u32], limit: usize) -> Result<()> {
    match indices.iter().position(|&i| i as usize >= limit) {
        None => Ok(()),
        Some(at) => Err(Error::new("index out of range")
            .file(a.path())
            .field(format!("{name}[{at}]"))
            .found(indices[at])
            .expected(format!("below {limit}"))
            .hint("run the stage that makes it again")),
    }
}

/// Checks that `kept` ascends and stays below `total` (where known: `usize::MAX` otherwise).
pub(crate) fn check_kept(a: &Artifact, kept: &[u32], total: usize) -> Result<()> {
    below(a, "kept", kept, total)?;
    match kept.windows(2).position(|w| w[0] >= w[1]) {
        None => Ok(()),
        Some(at) => Err(Error::new("indices do not ascend")
            .file(a.path())
            .field(format!("kept[{}]", at + 1))
            .found(kept[at + 1])
            .expected(format!("more than {}", kept[at]))),
    }
}
