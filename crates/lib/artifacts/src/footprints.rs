//! `footprints.safetensors`: which Gaussians make up which mask.

use crate::Level;
use crate::ScratchEntries;
use crate::checks::{below, below_part, check, check_kept, check_part, column, view_names};
use gs_io::{Artifact, ArtifactWriter, Error, Provenance, Result};
use serde_json::json;
use std::path::Path;

/// Facts of one mask of one view at one level.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Row {
    /// Index of the view in [`Footprints::views`].
    pub view: u32,
    /// Level, 0 to 15, in the order of [`Level::ALL`].
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

impl Row {
    /// Whether its mask is of one of the `levels`.
    pub fn is_of(&self, levels: &[Level]) -> bool {
        levels.iter().any(|&l| l.index() as u32 == self.level)
    }
}

/// The footprints of all masks: a sparse matrix, masks x kept Gaussians, of blending weights summed over gated pixels.
/// `weight / gated` is the matrix A of docs/method.md, with centroids c = A f. Its entries, which may be more than fit into
/// memory, stay in the file.
#[derive(Debug)]
pub struct Footprints {
    /// Names of the views (file stems).
    pub views: Vec<String>,
    /// Original indices of the kept Gaussians, ascending; n.
    pub kept: Vec<u32>,
    /// Facts of each mask, ordered by view, level, mask; R.
    pub rows: Vec<Row>,
    /// Single pixels of the masks, where they were asked for.
    pub pixels: PixelSamples,
    row_ptr: Vec<u64>,
    artifact: Artifact,
}

/// Entries of a mask: positions in `kept`, ascending, and summed weights.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Entries {
    /// Positions in [`Footprints::kept`].
    pub gaussians: Vec<u32>,
    /// Blending weight of each, summed over the mask's gated pixels.
    pub weights: Vec<f32>,
}

impl Entries {
    /// Gaussians with their weights.
    pub fn iter(&self) -> impl Iterator<Item = (u32, f32)> + '_ {
        self.gaussians.iter().copied().zip(self.weights.iter().copied())
    }

    /// Those of Gaussians in `range`.
    pub fn within(&self, range: std::ops::Range<u32>) -> impl Iterator<Item = (u32, f32)> + '_ {
        let from = self.gaussians.partition_point(|&i| i < range.start);
        let to = from + self.gaussians[from..].partition_point(|&i| i < range.end);
        self.gaussians[from..to].iter().copied().zip(self.weights[from..to].iter().copied())
    }
}

/// Single pixels of masks: a sparse matrix, pixels x kept Gaussians, of blending weights.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct PixelSamples {
    /// Mask of each pixel, as a row of the footprints, ascending; P.
    pub row: Vec<u32>,
    /// Where the entries of each pixel begin; P + 1, or empty without pixels.
    pub ptr: Vec<u64>,
    /// Positions in `kept`, ascending within a pixel.
    pub col: Vec<u32>,
    /// Blending weights.
    pub weight: Vec<f32>,
}

impl PixelSamples {
    fn read(a: &Artifact, rows: usize, kept: usize) -> Result<Self> {
        if !a.has("pixel_row") {
            return Ok(Self::default());
        }
        let row = a.tensor::<u32>("pixel_row", &[None])?.to_vec();
        let ptr = a.tensor::<u64>("pixel_ptr", &[Some(row.len() + 1)])?.to_vec();
        let col = a.tensor::<u32>("pixel_col", &[None])?.to_vec();
        let weight = a.tensor::<f32>("pixel_weight", &[Some(col.len())])?.to_vec();
        below(a, "pixel_row", &row, rows)?;
        below(a, "pixel_col", &col, kept)?;
        check_pointers(a, "pixel_ptr", &ptr, col.len())?;
        check_weights(a, "pixel_weight", 0, &weight)?;
        let expected = |at: usize| format!("{} or more", row[at - 1]);
        check(a, "pixel_row", &row, |at, r| at == 0 || row[at - 1] <= r, "does not ascend", expected)?;
        Ok(Self { row, ptr, col, weight })
    }

    /// Number of pixels.
    pub fn len(&self) -> usize {
        self.row.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.row.is_empty()
    }
}

fn check_pointers(a: &Artifact, name: &str, ptr: &[u64], entries: usize) -> Result<()> {
    let monotone = ptr.windows(2).all(|w| w[0] <= w[1]);
    if ptr[0] != 0 || !monotone || ptr[ptr.len() - 1] != entries as u64 {
        return Err(Error::new("row pointers do not ascend from 0 to the number of entries")
            .file(a.path())
            .field(name)
            .hint("run graph-precompute again"));
    }
    Ok(())
}

fn check_weights(a: &Artifact, name: &str, first: usize, weight: &[f32]) -> Result<()> {
    check_part(a, name, first, weight, |_, w| w.is_finite() && w >= 0.0, "not a weight", |_| "0 or more".into())
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
    /// Single pixels, if any; their columns are positions in `kept` too.
    pub pixels: PixelSamples,
}

impl FootprintsBuilder {
    /// Adds a mask with its entries: positions in `kept`, ascending, and weights.
    pub fn push(&mut self, row: Row, entries: impl IntoIterator<Item = (u32, f32)>) {
        if self.row_ptr.is_empty() {
            self.row_ptr.push(0);
        }
        for (col, weight) in entries {
            self.col.push(col);
            self.weight.push(weight);
        }
        self.row_ptr.push(self.col.len() as u64);
        self.rows.push(row);
    }

    /// Writes the artifact.
    pub fn write(&self, path: impl AsRef<Path>, provenance: Provenance) -> Result<()> {
        let mut entries = ScratchEntries::beside(path.as_ref())?;
        self.col.iter().zip(&self.weight).try_for_each(|(&col, &weight)| entries.push(col, weight))?;
        self.write_with(entries, path, provenance)
    }

    /// [`FootprintsBuilder::write`] with the entries of all rows from scratch files; `col` and `weight` are ignored.
    pub fn write_with(
        &self,
        entries: ScratchEntries,
        path: impl AsRef<Path>,
        mut provenance: Provenance,
    ) -> Result<()> {
        provenance.format = Footprints::FORMAT.into();
        provenance.version = Footprints::VERSION;
        provenance.extra = json!({ "views": self.views });
        let mut writer = ArtifactWriter::new(provenance);
        let (r, p, rows) = (self.rows.len(), &self.pixels, &self.rows);
        if !p.is_empty() {
            writer = writer
                .tensor("pixel_row", &[p.row.len()], &p.row)
                .tensor("pixel_ptr", &[p.ptr.len()], &p.ptr)
                .tensor("pixel_col", &[p.col.len()], &p.col)
                .tensor("pixel_weight", &[p.weight.len()], &p.weight);
        }
        let count = entries.count as usize;
        let (col, weight) = entries.finish()?;
        writer
            .tensor("kept", &[self.kept.len()], &self.kept)
            .tensor("row_view", &[r], &column(rows, |r| r.view))
            .tensor("row_level", &[r], &column(rows, |r| r.level))
            .tensor("row_mask", &[r], &column(rows, |r| r.mask))
            .tensor("row_pixels", &[r], &column(rows, |r| r.pixels))
            .tensor("row_gated", &[r], &column(rows, |r| r.gated))
            .tensor("row_alpha", &[r], &column(rows, |r| r.alpha))
            .tensor("row_ptr", &[r + 1], &self.row_ptr)
            .tensor_from_file::<u32>("col", &[count], col)
            .tensor_from_file::<f32>("weight", &[count], weight)
            .write(path)
    }
}

impl Footprints {
    /// Format name in the file.
    pub const FORMAT: &str = "footprints";
    const VERSION: u32 = 1;

    /// Entries that are read at a time, about.
    const MOST: usize = 1 << 22;

    /// Opens and checks the artifact; its entries stay in the file.
    ///
    /// # Errors
    /// When the file is damaged, tensors do not fit together, or an index is out of range.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let a = Artifact::open_leaving(path, Self::FORMAT, Self::VERSION, &["col", "weight"])?;
        let kept = a.tensor::<u32>("kept", &[None])?.to_vec();
        check_kept(&a, &kept, usize::MAX)?;
        let views = view_names(&a)?;
        let view = a.tensor::<u32>("row_view", &[None])?;
        let r = view.len();
        let column = |name: &str| a.tensor::<u32>(name, &[Some(r)]);
        let (level, mask) = (column("row_level")?, column("row_mask")?);
        let (pixels, gated) = (column("row_pixels")?, column("row_gated")?);
        let alpha = a.tensor::<f32>("row_alpha", &[Some(r)])?;
        let (facts, areas) = (view.iter().zip(level).zip(mask), pixels.iter().zip(gated).zip(alpha));
        let row =
            |(((&view, &level), &mask), ((&pixels, &gated), &alpha))| Row { view, level, mask, pixels, gated, alpha };
        let rows: Vec<Row> = facts.zip(areas).map(row).collect();
        below(&a, "row_view", view, views.len())?;
        below(&a, "row_level", level, crate::LEVELS)?;
        let row_ptr = a.tensor::<u64>("row_ptr", &[Some(r + 1)])?.to_vec();
        let count = a.extents::<u32>("col", &[None])?[0];
        a.extents::<f32>("weight", &[Some(count)])?;
        check_pointers(&a, "row_ptr", &row_ptr, count)?;
        for from in (0..count).step_by(Self::MOST) {
            let some = from..count.min(from + Self::MOST);
            below_part(&a, "col", from, &a.read::<u32>("col", some.clone())?, kept.len())?;
            check_weights(&a, "weight", from, &a.read::<f32>("weight", some)?)?;
        }
        let pixels = PixelSamples::read(&a, r, kept.len())?;
        Ok(Self { views, kept, rows, pixels, row_ptr, artifact: a })
    }

    /// Number of entries of row `r`.
    pub fn entries_of(&self, r: usize) -> usize {
        (self.row_ptr[r + 1] - self.row_ptr[r]) as usize
    }

    /// Number of all entries.
    pub fn total(&self) -> u64 {
        self.row_ptr[self.rows.len()]
    }

    /// Number of entries of the masks at `levels`.
    pub fn total_at(&self, levels: &[Level]) -> u64 {
        let of_levels = self.rows.iter().enumerate().filter(|(_, row)| row.is_of(levels));
        of_levels.map(|(r, _)| self.entries_of(r) as u64).sum()
    }

    /// Reads the entries of row `r`.
    ///
    /// # Errors
    /// When the file can't be read, or was changed so that a Gaussian is out of range or a weight is not finite.
    pub fn entries(&self, r: usize) -> Result<Entries> {
        let range = self.row_ptr[r] as usize..self.row_ptr[r + 1] as usize;
        let gaussians: Vec<u32> = self.artifact.read("col", range.clone())?;
        let weights: Vec<f32> = self.artifact.read("weight", range)?;
        let good = gaussians.iter().all(|&i| (i as usize) < self.kept.len()) && weights.iter().all(|w| w.is_finite());
        if !good || !gaussians.is_sorted() {
            return Err(Error::new("the file was changed while it was read")
                .file(self.artifact.path())
                .hint("run the stage again when nothing writes into its inputs"));
        }
        Ok(Entries { gaussians, weights })
    }

    /// Hands the entries of `rows` on, in their order and in batches: a batch is of as many rows as memory for a few million
    /// entries takes.
    ///
    /// # Errors
    /// Those of [`Footprints::entries`].
    pub fn in_batches(&self, rows: &[u32], mut take: impl FnMut(&[u32], &[Entries])) -> Result<()> {
        let mut from = 0;
        while from < rows.len() {
            let mut left = Self::MOST;
            let fits = |&&r: &&u32| {
                let count = self.entries_of(r as usize);
                let fits = count <= left;
                left = left.saturating_sub(count);
                fits
            };
            let count = rows[from..].iter().take_while(fits).count().max(1);
            let batch = &rows[from..from + count];
            take(batch, &batch.iter().map(|&r| self.entries(r as usize)).collect::<Result<Vec<_>>>()?);
            from += count;
        }
        Ok(())
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
        let (views, kept) = (vec!["frame_00001".into()], vec![1, 4, 6]);
        let mut b = FootprintsBuilder { views, kept, ..FootprintsBuilder::default() };
        b.push(row(0), [(0, 1.0), (2, 2.0)]);
        b.push(row(5), [(1, 3.0)]);
        b.write(&p, Provenance::default()).unwrap();
        let f = Footprints::read(&p).unwrap();
        assert_eq!(f.rows, b.rows);
        assert_eq!(f.entries(0).unwrap(), Entries { gaussians: vec![0, 2], weights: vec![1.0, 2.0] });
        assert_eq!(f.entries(1).unwrap().within(1..2).collect::<Vec<_>>(), [(1, 3.0)]);
        let mut batches = Vec::new();
        f.in_batches(&[1, 0], |rows, entries| batches.push((rows.to_vec(), entries.to_vec()))).unwrap();
        assert_eq!(batches, [(vec![1, 0], vec![f.entries(1).unwrap(), f.entries(0).unwrap()])]);
        // Whoever changes the file meanwhile is told.
        let bytes = std::fs::read(&p).unwrap();
        std::fs::write(&p, vec![255; bytes.len()]).unwrap();
        assert!(f.entries(0).unwrap_err().to_string().contains("was changed while it was read"));
        std::fs::write(&p, &bytes).unwrap();
        assert!(f.pixels.is_empty());
        // From scratch files, under other numbers at first: the same bytes.
        let mut scratch = ScratchEntries::beside(&p).unwrap();
        for (c, w) in b.col.iter().zip(&b.weight) {
            scratch.push(c + 2, *w).unwrap();
        }
        scratch.renumber(&[9, 9, 0, 1, 2]).unwrap();
        let without = FootprintsBuilder { col: Vec::new(), weight: Vec::new(), ..b.clone() };
        let other = dir.path().join("other.safetensors");
        without.write_with(scratch, &other, Provenance::default()).unwrap();
        assert_eq!(std::fs::read(&other).unwrap(), std::fs::read(&p).unwrap());
        b.pixels = PixelSamples { row: vec![0, 0, 1], ptr: vec![0, 1, 1, 3], col: vec![2, 0, 1], weight: vec![0.5; 3] };
        b.write(&p, Provenance::default()).unwrap();
        assert_eq!(Footprints::read(&p).unwrap().pixels, b.pixels);
        for (bad, said) in [
            (PixelSamples { row: vec![0, 0, 2], ..b.pixels.clone() }, "pixel_row"),
            (PixelSamples { row: vec![1, 0, 1], ..b.pixels.clone() }, "pixel_row"),
            (PixelSamples { ptr: vec![0, 2, 1, 3], ..b.pixels.clone() }, "pixel_ptr"),
            (PixelSamples { col: vec![2, 0, 9], ..b.pixels.clone() }, "pixel_col"),
            (PixelSamples { weight: vec![0.5, f32::NAN, 0.5], ..b.pixels.clone() }, "pixel_weight"),
        ] {
            FootprintsBuilder { pixels: bad, ..b.clone() }.write(&p, Provenance::default()).unwrap();
            let e = Footprints::read(&p).unwrap_err().to_string();
            assert!(e.contains(said), "{e}");
        }
        b.col[1] = 3;
        b.write(&p, Provenance::default()).unwrap();
        let e = Footprints::read(&p).unwrap_err().to_string();
        assert!(e.contains("col[1]: index out of range; found 3, expected below 3"), "{e}");
    }
}
