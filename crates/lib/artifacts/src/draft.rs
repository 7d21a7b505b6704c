//! Instances before language, and the masks whose features say what they mean.

use crate::Instances;
use crate::checks::{below, column};
use gs_io::{Artifact, ArtifactWriter, Provenance, Result};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// A mask whose feature is a part of a descriptor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Witness {
    /// Index of the instance, or of the granule, that it describes.
    pub of: u32,
    /// Index of the view in [`Instances::views`].
    pub view: u32,
    /// Id of the mask in the view's `*_s.npy`.
    pub mask: u32,
    /// How much it counts in the mean.
    pub weight: f64,
}

/// What is known before a language model has seen a mask.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Draft {
    /// The instances, without descriptors.
    pub instances: Instances,
    /// Masks of the instances, ordered by instance, view.
    pub of_instances: Vec<Witness>,
    /// Masks of the granules, ordered by granule, view.
    pub of_granules: Vec<Witness>,
    /// Number of mask ids of each view.
    pub masks: Vec<u32>,
}

impl Draft {
    /// Format name in the file.
    pub const FORMAT: &str = "draft";
    const VERSION: u32 = 1;

    /// The masks whose features the descriptors read, by view (file stem); views without one are left out.
    pub fn wanted(&self) -> BTreeMap<&str, BTreeSet<u32>> {
        let mut wanted: BTreeMap<&str, BTreeSet<u32>> = BTreeMap::new();
        for w in self.of_instances.iter().chain(&self.of_granules) {
            wanted.entry(&self.instances.views[w.view as usize]).or_default().insert(w.mask);
        }
        wanted
    }

    /// Writes the artifact.
    ///
    /// # Errors
    /// When the file cannot be written.
    pub fn write(&self, path: impl AsRef<Path>, mut provenance: Provenance) -> Result<()> {
        provenance.format = Self::FORMAT.into();
        provenance.version = Self::VERSION;
        let columns = |of: &[Witness]| {
            (column(of, |w| w.of), column(of, |w| w.view), column(of, |w| w.mask), column(of, |w| w.weight))
        };
        let (instances, granules) = (columns(&self.of_instances), columns(&self.of_granules));
        let mut writer = ArtifactWriter::new(self.instances.provenance(provenance)).tensor(
            "masks",
            &[self.masks.len()],
            &self.masks,
        );
        for (name, (of, view, mask, weight)) in [("instance_witness", &instances), ("granule_witness", &granules)] {
            writer = writer
                .tensor(&format!("{name}_of"), &[of.len()], of)
                .tensor(&format!("{name}_view"), &[of.len()], view)
                .tensor(&format!("{name}_mask"), &[of.len()], mask)
                .tensor(&format!("{name}_weight"), &[of.len()], weight);
        }
        self.instances.write_into(writer, path)
    }

    /// Reads and checks the artifact.
    ///
    /// # Errors
    /// When the file is damaged, tensors do not fit together, or an index is out of range.
    pub fn read(path: impl AsRef<Path>) -> Result<(Self, Artifact)> {
        let a = Artifact::open(path, Self::FORMAT, Self::VERSION)?;
        let instances = Instances::from_artifact(&a)?;
        let (views, granules) = (instances.views.len(), instances.granules.len());
        let of_instances = read_witnesses(&a, "instance_witness", instances.len(), views)?;
        let of_granules = read_witnesses(&a, "granule_witness", granules, views)?;
        let masks = a.tensor::<u32>("masks", &[Some(views)])?.to_vec();
        Ok((Self { instances, of_instances, of_granules, masks }, a))
    }
}

fn read_witnesses(a: &Artifact, name: &str, count: usize, views: usize) -> Result<Vec<Witness>> {
    let tensor = |field: &str| format!("{name}_{field}");
    let of = a.tensor::<u32>(&tensor("of"), &[None])?;
    let n = Some(of.len());
    let (view, mask) = (a.tensor::<u32>(&tensor("view"), &[n])?, a.tensor::<u32>(&tensor("mask"), &[n])?);
    let weight = a.tensor::<f64>(&tensor("weight"), &[n])?;
    below(a, &tensor("of"), of, count)?;
    below(a, &tensor("view"), view, views)?;
    let at = |i| Witness { of: of[i], view: view[i], mask: mask[i], weight: weight[i] };
    Ok((0..of.len()).map(at).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_back_and_lists_each_mask_once() {
        let w = |of, view, mask, weight| Witness { of, view, mask, weight };
        let instances = Instances {
            label: vec![0],
            descriptor: ndarray::Array2::zeros((1, 0)),
            support: vec![2],
            score: vec![0.5],
            count: vec![1],
            centroid: vec![[0.0; 3]],
            bbox_min: vec![[0.0; 3]],
            bbox_max: vec![[0.0; 3]],
            oriented: vec![crate::OrientedBox::default()],
            views: vec!["a".into(), "b".into(), "c".into()],
            node: vec![-1],
            granules: vec![crate::Granule { members: crate::Members::Instance(0), support: 2, fit: 0.5 }],
            granule_descriptor: ndarray::Array2::zeros((1, 0)),
            ..Instances::default()
        };
        let draft = Draft {
            instances,
            of_instances: vec![w(0, 0, 7, 1.0), w(0, 2, 3, 1.0)],
            of_granules: vec![w(0, 0, 7, 0.3), w(0, 2, 1, 0.09)],
            masks: vec![9, 0, 4],
        };
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("draft.safetensors");
        draft.write(&path, Provenance::default()).unwrap();
        assert_eq!(Draft::read(&path).unwrap().0, draft);
        assert_eq!(draft.wanted(), BTreeMap::from([("a", [7].into()), ("c", [1, 3].into())]));
        assert!(Instances::read(&path).unwrap_err().to_string().contains("draft"), "a draft is no result");
        let bad = Draft { of_granules: vec![w(1, 0, 7, 0.3)], ..draft };
        bad.write(&path, Provenance::default()).unwrap();
        assert!(Draft::read(&path).unwrap_err().to_string().contains("granule_witness_of"));
    }
}
