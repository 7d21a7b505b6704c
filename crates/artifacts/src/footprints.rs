//! `footprints.safetensors`: which Gaussians make up which mask.

use crate::graph::{below, check_kept};
use gs_io::{Artifact, ArtifactWriter, Error, Provenance, Result};
use serde_json::json;
use std::path::Path;

/// Facts of one mask of one view at one level.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Row {
    /// Index of the view in [`Footprints::views`].
    pub view: u32,
    /// Level, 0 to 3: default, small, medium, large.
    pub level: u32,
    /// Id in the view's `*_s.npy`, which is also the row of its `*_f.npy`.
    pub mask: u32,
    /// Pixels of the mask.
    pub pixels: u32,
    /// Pixels of the mask where the accumulated alpha passes the gate; these alone count for weights.
    pub gated: u32,
    /// Mean accumulated alpha over the mask's pixels.
    pub alpha: f32,
}

/// The footprints of all masks: a sparse matrix, masks x kept Gaussians, of blending weights summed over gated pixels.
/// `weight / gated` is the matrix A of docs/method.md, with centroids c = A f.
#[derive(Debug)]
pub struct Footprints {
    /// Names of the views (file stems).
    pub views: Vec<String>,
    /// Original indices of the kept Gaussians, ascending; n.
    pub kept: Vec<u32>,
    /// Facts of each mask, ordered by view, level, mask; R.
    pub rows: Vec<Row>,
    row_ptr: Vec<u64>,
    artifact: Artifact,
}

/// Footprints while they are computed.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct FootprintsBuilder {
    /// Names of the views (file stems).
    pub views: Vec<String>,
    /// Original indices of the kept Gaussians, ascending; n.
    pub kept: Vec<u32>,
    /// Facts of each mask, ordered by view, level, mask; R.
    pub rows: Vec<Row>,
    /// Where the entries of each row begin; R + 1.
    pub row_ptr: Vec<u64>,
    /// Positions in `kept`, ascending within a row.
    pub col: Vec<u32>,
    /// Blending weight summed over the mask's gated pixels.
    pub weight: Vec<f32>,
}

impl FootprintsBuilder {
    /// Writes the artifact.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write(&self, path: impl AsRef<Path>, mut provenance: Provenance) -> Result<()> {
        provenance.format = Footprints::FORMAT.into();
        provenance.version = Footprints::VERSION;
        provenance.extra = json!({ "views": self.views });
        let r = self.rows.len();
        let column = |f: fn(&Row) -> u32| self.rows.iter().map(f).collect::<Vec<u32>>();
        let alpha: Vec<f32> = self.rows.iter().map(|r| r.alpha).collect();
        ArtifactWriter::new(provenance)
            .tensor("kept", &[self.kept.len()], &self.kept)
            .tensor("row_view", &[r], &column(|r| r.view))
            .tensor("row_level", &[r], &column(|r| r.level))
            .tensor("row_mask", &[r], &column(|r| r.mask))
            .tensor("row_pixels", &[r], &column(|r| r.pixels))
            .tensor("row_gated", &[r], &column(|r| r.gated))
            .tensor("row_alpha", &[r], &alpha)
            .tensor("row_ptr", &[r + 1], &self.row_ptr)
            .tensor("col", &[self.col.len()], &self.col)
            .tensor("weight", &[self.weight.len()], &self.weight)
            .write(path)
    }
}

impl Footprints {
    /// Format name in the file.
    pub const FORMAT: &str = "footprints";
    const VERSION: u32 = 1;

    /// Opens and checks the artifact; columns and weights stay memory-mapped.
    ///
    /// # Errors
    /// When the file is damaged, tensors do not fit together, or an index is out of range.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let a = Artifact::open(path, Self::FORMAT, Self::VERSION)?;
        let kept = a.tensor::<u32>("kept", &[None])?.to_vec();
        check_kept(&a, &kept, usize::MAX)?;
        let views: Vec<String> = serde_json::from_value(a.provenance().extra["views"].clone())
            .map_err(|e| Error::new(format!("no list of view names: {e}")).file(a.path()).field("views"))?;
        let row_view = a.tensor::<u32>("row_view", &[None])?;
        let r = row_view.len();
        let column = |name: &str| a.tensor::<u32>(name, &[Some(r)]);
        let (level, mask) = (column("row_level")?, column("row_mask")?);
        let (pixels, gated) = (column("row_pixels")?, column("row_gated")?);
        let alpha = a.tensor::<f32>("row_alpha", &[Some(r)])?;
        let rows: Vec<Row> = (0..r)
            .map(|i| Row {
                view: row_view[i],
                level: level[i],
                mask: mask[i],
                pixels: pixels[i],
                gated: gated[i],
                alpha: alpha[i],
            })
            .collect();
        below(&a, "row_view", row_view, views.len())?;
        below(&a, "row_level", level, crate::LEVELS)?;
        let row_ptr = a.tensor::<u64>("row_ptr", &[Some(r + 1)])?.to_vec();
        let col = a.tensor::<u32>("col", &[None])?;
        let weight = a.tensor::<f32>("weight", &[Some(col.len())])?;
        let monotone = row_ptr.windows(2).all(|w| w[0] <= w[1]);
        if row_ptr[0] != 0 || !monotone || row_ptr[r] != col.len() as u64 {
            return Err(Error::new("row pointers do not ascend from 0 to the number of entries")
                .file(a.path())
                .field("row_ptr")
                .hint("run graph-precompute again"));
        }
        below(&a, "col", col, kept.len())?;
        if let Some(at) = weight.iter().position(|w| !w.is_finite() || *w < 0.0) {
            return Err(Error::new("not a weight").file(a.path()).field(format!("weight[{at}]")).found(weight[at]));
        }
        Ok(Self { views, kept, rows, row_ptr, artifact: a })
    }

    /// Entries of row `r`: positions in `kept` (ascending) and summed weights.
    pub fn entries(&self, r: usize) -> (&[u32], &[f32]) {
        let (start, end) = (self.row_ptr[r] as usize, self.row_ptr[r + 1] as usize);
        // Checked when the artifact was opened.
        let col = self.artifact.tensor::<u32>("col", &[None]).expect("checked on opening");
        let weight = self.artifact.tensor::<f32>("weight", &[None]).expect("checked on opening");
        (&col[start..end], &weight[start..end])
    }

    /// All column indices and weights with the row pointers: a CSR matrix.
    pub fn csr(&self) -> (&[u64], &[u32], &[f32]) {
        let col = self.artifact.tensor::<u32>("col", &[None]).expect("checked on opening");
        let weight = self.artifact.tensor::<f32>("weight", &[None]).expect("checked on opening");
        (&self.row_ptr, col, weight)
    }

    /// The file behind.
    pub fn artifact(&self) -> &Artifact {
        &self.artifact
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_back_and_refuses_indices_out_of_range() {
        let dir = tempfile::tempdir().unwrap();
        let p = dir.path().join("f.safetensors");
        let row = |mask| Row { view: 0, level: 3, mask, pixels: 9, gated: 8, alpha: 0.9 };
        let mut b = FootprintsBuilder {
            views: vec!["frame_00001".into()],
            kept: vec![1, 4, 6],
            rows: vec![row(0), row(5)],
            row_ptr: vec![0, 2, 3],
            col: vec![0, 2, 1],
            weight: vec![1.0, 2.0, 3.0],
        };
        b.write(&p, Provenance::default()).unwrap();
        let f = Footprints::read(&p).unwrap();
        assert_eq!(f.rows, b.rows);
        assert_eq!(f.entries(0), (&[0u32, 2][..], &[1.0f32, 2.0][..]));
        assert_eq!(f.entries(1), (&[1u32][..], &[3.0f32][..]));
        b.col[1] = 3;
        b.write(&p, Provenance::default()).unwrap();
        let e = Footprints::read(&p).unwrap_err().to_string();
        assert!(e.contains("col[1]: index out of range; found 3, expected below 3"), "{e}");
    }
}
