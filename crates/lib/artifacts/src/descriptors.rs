//! `descriptors.safetensors`: language descriptors of single Gaussians, of systems that do not describe instances.

use crate::checks::{below, check, check_kept, finite};
use crate::flat;
use gs_io::{Artifact, ArtifactWriter, Error, Provenance, Result};
use ndarray::{Array3, ArrayView2, Axis};
use std::path::Path;

/// Language descriptors of Gaussians: each names a row of a table, which holds one descriptor or several.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Descriptors {
    /// Original indices of the Gaussians that have one, ascending; n.
    pub kept: Vec<u32>,
    /// Row of each; n. Gaussians may share one.
    pub row: Vec<u32>,
    /// `[rows][slots][dim]`, with at least 1 slot; each descriptor of unit length, or zero for none.
    pub values: Array3<f32>,
}

impl Descriptors {
    /// Format name in the file.
    pub const FORMAT: &str = "descriptors";
    const VERSION: u32 = 1;

    /// Dimension of a descriptor.
    pub fn dim(&self) -> usize {
        self.values.dim().2
    }

    /// The descriptors of a row, `[slots][dim]`.
    pub fn of_row(&self, row: usize) -> ArrayView2<'_, f32> {
        self.values.index_axis(Axis(0), row)
    }

    /// Writes the artifact.
    pub fn write(&self, path: impl AsRef<Path>, mut provenance: Provenance) -> Result<()> {
        provenance.format = Self::FORMAT.into();
        provenance.version = Self::VERSION;
        let (rows, slots, dim) = self.values.dim();
        ArtifactWriter::new(provenance)
            .tensor("kept", &[self.kept.len()], &self.kept)
            .tensor("row", &[self.row.len()], &self.row)
            .tensor("slots", &[1], &[slots as u32])
            .tensor("descriptor", &[rows * slots, dim], flat(self.values.view()))
            .write(path)
    }

    /// Reads and checks the artifact.
    ///
    /// # Errors
    /// When the file is damaged, tensors do not fit together, or a number is not finite.
    pub fn read(path: impl AsRef<Path>) -> Result<(Self, Artifact)> {
        // Left in the file, to be in memory once.
        let a = Artifact::open_leaving(path, Self::FORMAT, Self::VERSION, &["descriptor"])?;
        let kept = a.tensor::<u32>("kept", &[None])?.to_vec();
        check_kept(&a, &kept, usize::MAX)?;
        let row = a.tensor::<u32>("row", &[Some(kept.len())])?.to_vec();
        let slots = a.tensor::<u32>("slots", &[Some(1)])?;
        let shape = a.extents::<f32>("descriptor", &[None, None])?;
        let all = shape[0];
        if shape[1] == 0 {
            return Err(Error::new("descriptors without a dimension").file(a.path()).field("descriptor"));
        }
        let fits = |_, s: u32| s > 0 && all.is_multiple_of(s as usize);
        check(&a, "slots", slots, fits, "not as many in every row", |_| format!("a divisor of {all}"))?;
        let slots = slots[0] as usize;
        below(&a, "row", &row, all / slots)?;
        let shape = (all / slots, slots, shape[1]);
        let values = finite(&a, "descriptor", all)?.into_shape_with_order(shape);
        let values = values.map_err(|e| Error::new(e.to_string()).file(a.path()).field("slots").found(slots))?;
        Ok((Self { kept, row, values }, a))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::{arr2, arr3};

    #[test]
    fn reads_back_and_refuses_what_does_not_fit() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("descriptors.safetensors");
        let values = arr3(&[[[1.0, 0.0], [0.6, 0.8]], [[0.0, 1.0], [0.0, 0.0]]]);
        let good = Descriptors { kept: vec![1, 4, 5], row: vec![1, 0, 1], values };
        good.write(&path, Provenance::default()).unwrap();
        let (read, _) = Descriptors::read(&path).unwrap();
        assert_eq!(read, good);
        assert_eq!((read.values.dim().0, read.of_row(1)), (2, arr2(&[[0.0, 1.0], [0.0, 0.0]]).view()));
        let mut nan = good.values.clone();
        nan[[0, 1, 1]] = f32::NAN;
        for (bad, said) in [
            (Descriptors { values: nan, ..good.clone() }, "descriptor[1][1]: not a finite number"),
            (Descriptors { kept: vec![4, 1, 5], ..good.clone() }, "do not ascend"),
            (Descriptors { row: vec![1, 2, 0], ..good.clone() }, "row[1]: index out of range"),
            (Descriptors { values: Array3::default((0, 2, 0)), ..good.clone() }, "without a dimension"),
        ] {
            bad.write(&path, Provenance::default()).unwrap();
            let e = Descriptors::read(&path).unwrap_err().to_string();
            assert!(e.contains(said), "{e}");
        }
    }
}
