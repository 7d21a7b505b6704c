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
    /// Dimension of the features of parts; 0 where there are none.
    pub parts_dim: usize,
    /// Features that tell parts and small things apart, from the masks of level small; `[n][parts_dim]`, finite.
    pub parts: Vec<f32>,
}

impl Features {
    /// Format name in the file.
    pub const FORMAT: &str = "features";
    const VERSION: u32 = 1;

    /// Writes the artifact.
    pub fn write(&self, path: impl AsRef<Path>, mut provenance: Provenance) -> Result<()> {
        provenance.format = Self::FORMAT.into();
        provenance.version = Self::VERSION;
        let n = self.kept.len();
        let writer = ArtifactWriter::new(provenance).tensor("kept", &[n], &self.kept);
        let writer = writer.tensor("features", &[n, self.dim], &self.values);
        match self.parts_dim {
            0 => writer.write(path),
            dim => writer.tensor("parts", &[n, dim], &self.parts).write(path),
        }
    }

    /// Reads and checks the artifact.
    ///
    /// # Errors
    /// When the file is damaged, tensors do not fit together, or a feature is not finite.
    pub fn read(path: impl AsRef<Path>) -> Result<(Self, Artifact)> {
        // Left in the file, to be in memory once.
        let a = Artifact::open_leaving(path, Self::FORMAT, Self::VERSION, &["features", "parts"])?;
        let kept = a.tensor::<u32>("kept", &[None])?.to_vec();
        check_kept(&a, &kept, usize::MAX)?;
        let (dim, values) = finite(&a, "features", kept.len())?;
        let (parts_dim, parts) = match a.shape("parts") {
            Some(_) => finite(&a, "parts", kept.len())?,
            None => (0, Vec::new()),
        };
        Ok((Self { kept, dim, values, parts_dim, parts }, a))
    }

    /// Feature of the kept Gaussian at `position`.
    pub fn row(&self, position: usize) -> &[f32] {
        &self.values[position * self.dim..(position + 1) * self.dim]
    }
}

/// Columns and values of a tensor of `rows` rows, all finite.
pub(crate) fn finite(a: &Artifact, name: &str, rows: usize) -> Result<(usize, Vec<f32>)> {
    let dim = a.extents::<f32>(name, &[Some(rows), None])?[1];
    let values: Vec<f32> = a.read(name, 0..rows * dim)?;
    if let Some(at) = values.iter().position(|v| !v.is_finite()) {
        return Err(Error::new("not a finite number")
            .file(a.path())
            .field(format!("{name}[{}][{}]", at / dim, at % dim))
            .found(values[at])
            .hint("run the stage that makes it again"));
    }
    Ok((dim, values))
}
