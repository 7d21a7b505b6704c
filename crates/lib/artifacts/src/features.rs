//! `features.safetensors`: a feature vector per kept Gaussian.

use crate::checks::check_kept;
use gs_io::{Artifact, ArtifactWriter, Error, Provenance, Result};
use std::path::Path;

/// The learned (or computed) features, f_final in the paper.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Features {
    /// Original indices of the kept Gaussians, ascending; n.
    pub kept: Vec<u32>,
    /// Dimension of a feature.
    pub dim: usize,
    /// `[n][dim]`, finite.
    pub values: Vec<f32>,
}

impl Features {
    /// Format name in the file.
    pub const FORMAT: &str = "features";
    const VERSION: u32 = 1;

    /// Writes the artifact.
    pub fn write(&self, path: impl AsRef<Path>, mut provenance: Provenance) -> Result<()> {
        provenance.format = Self::FORMAT.into();
        provenance.version = Self::VERSION;
        ArtifactWriter::new(provenance)
            .tensor("kept", &[self.kept.len()], &self.kept)
            .tensor("features", &[self.kept.len(), self.dim], &self.values)
            .write(path)
    }

    /// Reads and checks the artifact.
    ///
    /// # Errors
    /// When the file is damaged, tensors do not fit together, or a feature is not finite.
    pub fn read(path: impl AsRef<Path>) -> Result<(Self, Artifact)> {
        let a = Artifact::open(path, Self::FORMAT, Self::VERSION)?;
        let kept = a.tensor::<u32>("kept", &[None])?.to_vec();
        check_kept(&a, &kept, usize::MAX)?;
        let values = a.tensor::<f32>("features", &[Some(kept.len()), None])?.to_vec();
        let dim = a.shape("features").map_or(0, |s| s[1]);
        if let Some(at) = values.iter().position(|v| !v.is_finite()) {
            return Err(Error::new("not a finite number")
                .file(a.path())
                .field(format!("features[{}][{}]", at / dim, at % dim))
                .found(values[at])
                .hint("train the features again"));
        }
        Ok((Self { kept, dim, values }, a))
    }

    /// Feature of the kept Gaussian at `position`.
    pub fn row(&self, position: usize) -> &[f32] {
        &self.values[position * self.dim..(position + 1) * self.dim]
    }
}
