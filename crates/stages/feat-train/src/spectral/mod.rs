//! Features in closed form: `feat-train` without a preset.
//!
//! * [`evidence`]: the matrix of Gaussians and masks, in the blocks of [`sparse`].
//! * [`gram`]: that matrix transposed times itself.
//! * [`vectors`]: the leading singular vectors and the features; [`linalg`] has the dense algebra.

pub mod evidence;
pub mod gram;
pub mod linalg;
pub mod sparse;
#[cfg(test)]
mod testing;
pub mod vectors;

use crate::inputs::Inputs;
use crate::options::Args;
use crate::outputs::{Made, write_curve};
use gs_io::{Error, Result};
use ndarray::Array2;
use report::curve::Panel;
use serde_json::json;
use stage::Stage;
use std::time::Instant;
use vectors::{Spectral, SpectralOptions, spectral};

/// Singular value below which a vector fades out: a low one shows parts, a high one whole things.
const CUTOFF: f64 = 0.6;

const SPECTRUM: [Panel; 1] = [("singular_value", "singular values", "#1f77b4")];

/// Computes the features and writes their spectrum as the curve.
pub fn features(args: &Args, inputs: &Inputs, stage: &Stage) -> Result<Made> {
    let clock = Instant::now();
    let levels = args.options.levels();
    let matrix = evidence::collect(&inputs.footprints, &inputs.graph, &levels, &args.out)?;
    if matrix.masks.is_empty() {
        return Err(Error::new("no mask has a footprint")
            .file(&args.footprints)
            .field("--levels")
            .found(format!("{levels:?}"))
            .hint("choose other --levels, or check that masks and geometry are of one scene"));
    }
    let evidence_seconds = clock.elapsed().as_secs_f64();
    let options = SpectralOptions {
        most: args.options.most_vectors(matrix.gaussians),
        auto: args.options.dim.is_none(),
        cutoff: CUTOFF,
        seed: args.common.seed,
    };
    let Spectral { dim, features, found, gram_entries } = spectral(&matrix, &options, stage)?;
    let vectors_seconds = clock.elapsed().as_secs_f64() - evidence_seconds;
    let above = found.values.iter().filter(|v| **v > CUTOFF).count();
    if above > dim {
        let more = if above == found.values.len() { " or more" } else { "" };
        stage.warn(&format!(
            "{above}{more} singular values exceed the cutoff of {CUTOFF}, but only the first {dim} are kept: small things \
             may run together; give a larger --dim"
        ));
    }
    let without = features.chunks_exact(dim).filter(|f| f.iter().all(|v| *v == 0.0)).count();
    if without > 0 {
        stage.info(&format!("{without} of {} Gaussians lie in no mask: their features are zero", matrix.gaussians));
    }
    let values = found.values.iter().enumerate();
    write_curve(&args.out, values.map(|(i, v)| json!({ "iteration": i + 1, "singular_value": v })), &SPECTRUM)?;
    let summary = json!({
        "masks": matrix.masks.len(), "dim": dim, "passes": found.passes, "residual": found.residual,
        "evidence_seconds": evidence_seconds, "vectors_seconds": vectors_seconds, "cpu_seconds": stage::cpu_seconds(),
        "without_mask": without, "entries": matrix.entries(), "gram_entries": gram_entries,
        "singular_values": found.values,
    });
    let values = Array2::from_shape_vec((features.len() / dim, dim), features).expect("whole features");
    Ok(Made { values, summary })
}
