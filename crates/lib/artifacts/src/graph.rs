//! `graph.safetensors`: anchors and neighbours.

use crate::checks::{below, check_kept, table};
use crate::flat;
use gs_io::{Artifact, ArtifactWriter, Provenance, Result};
use ndarray::Array2;
use std::path::Path;

/// The anchor graph of the paper's "Local Graph Sampling", and which Gaussians take part.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Graph {
    /// Original indices of the kept Gaussians, ascending; n.
    pub kept: Vec<u32>,
    /// Anchors as positions in `kept`; M.
    pub anchors: Vec<u32>,
    /// Nearest kept Gaussians of each anchor, itself excluded, nearest first, ties by index; `[M][k]`, positions in
    /// `kept`. Rows are padded with the anchor's own position where a scene has too few Gaussians.
    pub knn: Array2<u32>,
    /// Nearest anchors of each anchor, itself excluded; `[M][k]`, indices into `anchors`, padded likewise.
    pub anchor_knn: Array2<u32>,
    /// Nearest anchor of each kept Gaussian; n, indices into `anchors`.
    pub nearest_anchor: Vec<u32>,
    /// Nearest kept Gaussians of each kept Gaussian, itself excluded; `[n][k of its own]`, padded with itself.
    pub gaussian_knn: Array2<u32>,
    /// In how many views each Gaussian contributes; N.
    pub seen_views: Vec<u32>,
    /// Sum of blending weights over all pixels of all views; N.
    pub seen_weight: Vec<f32>,
}

impl Graph {
    /// Format name in the file.
    pub const FORMAT: &str = "graph";
    const VERSION: u32 = 1;

    /// Writes the artifact.
    pub fn write(&self, path: impl AsRef<Path>, mut provenance: Provenance) -> Result<()> {
        provenance.format = Self::FORMAT.into();
        provenance.version = Self::VERSION;
        let (n, m) = (self.kept.len(), self.anchors.len());
        ArtifactWriter::new(provenance)
            .tensor("kept", &[n], &self.kept)
            .tensor("anchors", &[m], &self.anchors)
            .tensor("knn", &[m, self.knn.ncols()], flat(self.knn.view()))
            .tensor("anchor_knn", &[m, self.anchor_knn.ncols()], flat(self.anchor_knn.view()))
            .tensor("nearest_anchor", &[n], &self.nearest_anchor)
            .tensor("gaussian_knn", &[n, self.gaussian_knn.ncols()], flat(self.gaussian_knn.view()))
            .tensor("seen_views", &[self.seen_views.len()], &self.seen_views)
            .tensor("seen_weight", &[self.seen_weight.len()], &self.seen_weight)
            .write(path)
    }

    /// Reads and checks the artifact.
    ///
    /// # Errors
    /// When the file is damaged, tensors do not fit together, or an index is out of range.
    pub fn read(path: impl AsRef<Path>) -> Result<(Self, Artifact)> {
        let a = Artifact::open(path, Self::FORMAT, Self::VERSION)?;
        let kept = a.tensor::<u32>("kept", &[None])?.to_vec();
        let anchors = a.tensor::<u32>("anchors", &[None])?.to_vec();
        let (n, m) = (kept.len(), anchors.len());
        let knn = table(&a, "knn", [Some(m), None])?;
        let seen_views = a.tensor::<u32>("seen_views", &[None])?.to_vec();
        let total = seen_views.len();
        let graph = Self {
            anchor_knn: table(&a, "anchor_knn", [Some(m), Some(knn.ncols())])?,
            nearest_anchor: a.tensor("nearest_anchor", &[Some(n)])?.to_vec(),
            gaussian_knn: table(&a, "gaussian_knn", [Some(n), None])?,
            seen_weight: a.tensor("seen_weight", &[Some(total)])?.to_vec(),
            kept,
            anchors,
            knn,
            seen_views,
        };
        check_kept(&a, &graph.kept, total)?;
        below(&a, "anchors", &graph.anchors, n)?;
        below(&a, "knn", flat(graph.knn.view()), n)?;
        below(&a, "anchor_knn", flat(graph.anchor_knn.view()), m)?;
        below(&a, "nearest_anchor", &graph.nearest_anchor, m)?;
        below(&a, "gaussian_knn", flat(graph.gaussian_knn.view()), n)?;
        Ok((graph, a))
    }
}
