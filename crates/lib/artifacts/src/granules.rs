//! Parts, things and groups, which a text may ask for.

use crate::checks::{below, check};
use crate::{Instances, TreeEdge};
use gs_io::{Artifact, Result};

/// Whose Gaussians a granule has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Members {
    /// Those of an instance.
    Instance(u32),
    /// Those of a cluster of the tree.
    Cluster(u32),
}

/// What masks of several views show as one: a part, a thing or a group of things. Granules may overlap.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Granule {
    /// Its Gaussians.
    pub members: Members,
    /// Views in which a mask shows it.
    pub support: u32,
    /// Mean IoU, over the views that show it, with the mask that fits best there, by blending weight; 0 to 1.
    pub fit: f32,
}

impl Granule {
    /// Its Gaussians, ascending.
    pub fn gaussians(&self, of: &Instances) -> Vec<u32> {
        match self.members {
            Members::Instance(k) => (0..of.label.len() as u32).filter(|&i| of.label[i as usize] == k as i32).collect(),
            Members::Cluster(c) => of.gaussians_of_cluster(c),
        }
    }
}

/// Reads those of an artifact with so many instances and this tree.
pub(crate) fn read(a: &Artifact, instances: usize, tree: &[TreeEdge]) -> Result<Vec<Granule>> {
    // Files of before November 2026 have none.
    if !a.has("granule_cluster") {
        return Ok(Vec::new());
    }
    let cluster = a.tensor::<u32>("granule_cluster", &[None])?;
    let q = Some(cluster.len());
    let (instance, support) = (a.tensor::<i32>("granule_instance", &[q])?, a.tensor::<u32>("granule_support", &[q])?);
    let fit = a.tensor::<f32>("granule_fit", &[q])?;
    crate::checks::check_labels(a, "granule_instance", instance, instances)?;
    below(a, "granule_cluster", cluster, tree.iter().map(|e| e.child as usize + 1).max().unwrap_or(1))?;
    check(a, "granule_fit", fit, |_, f| (0.0..=1.0).contains(&f), "not a share", |_| "0 to 1".into())?;
    let members = |i: usize| u32::try_from(instance[i]).map_or(Members::Cluster(cluster[i]), Members::Instance);
    Ok((0..cluster.len()).map(|i| Granule { members: members(i), support: support[i], fit: fit[i] }).collect())
}
