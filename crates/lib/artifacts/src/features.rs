//! `features.safetensors`: a feature vector per kept Gaussian.

use crate::checks::{check_kept, finite};
use crate::flat;
use gs_io::{Artifact, ArtifactWriter, Provenance, Result};
use ndarray::{Array2, ArrayView1};
use std::path::Path;

/// The learned (or computed) features, f_final in the paper.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Features {
    /// Original indices of the kept Gaussians, ascending; n.
    pub kept: Vec<u32>,
    /// `[n][dim]`, finite.
    pub values: Array2<f32>,
}

impl Features {
    /// Format name in the file.
    pub const FORMAT: &str = "features";
    const VERSION: u32 = 1;

    /// Features of no dimension: they tell no two Gaussians apart, and leave the IoU of matches alone.
    pub fn none(kept: &[u32]) -> Self {
        Self { kept: kept.to_vec(), values: Array2::zeros((kept.len(), 0)) }
    }

    /// Writes the artifact.
    pub fn write(&self, path: impl AsRef<Path>, mut provenance: Provenance) -> Result<()> {
        provenance.format = Self::FORMAT.into();
        provenance.version = Self::VERSION;
        let n = self.kept.len();
        let writer = ArtifactWriter::new(provenance).tensor("kept", &[n], &self.kept);
        writer.tensor("features", &[n, self.dim()], flat(self.values.view())).write(path)
    }

    /// Reads and checks the artifact.
    ///
    /// # Errors
    /// When the file is damaged, tensors do not fit together, or a feature is not finite.
    pub fn read(path: impl AsRef<Path>) -> Result<(Self, Artifact)> {
        // Left in the file, to be in memory once.
        let a = Artifact::open_leaving(path, Self::FORMAT, Self::VERSION, &["features"])?;
        let kept = a.tensor::<u32>("kept", &[None])?.to_vec();
        check_kept(&a, &kept, usize::MAX)?;
        let values = finite(&a, "features", kept.len())?;
        Ok((Self { kept, values }, a))
    }

    /// Feature of the kept Gaussian at `position`.
    pub fn row(&self, position: usize) -> ArrayView1<'_, f32> {
        self.values.row(position)
    }

    /// Dimension of a feature.
    pub fn dim(&self) -> usize {
        self.values.ncols()
    }
}
