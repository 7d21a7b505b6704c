//! What the page shows and hides together: Gaussians of one instance and one cluster, cut further where a person gave some of
//! them to another instance.

use artifacts::{Edit, Instances, ranges_of};
use gs_io::Result;
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;

/// A cell for every Gaussian.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Cells {
    /// Instance and cluster of each cell, before anybody's edits.
    pub pairs: Vec<(i32, i32)>,
    /// Gaussians of each cell.
    pub counts: Vec<u32>,
    /// Cell of every Gaussian; N.
    pub of: Vec<u32>,
    /// The cells of every [`Edit::Assign`], in order.
    pub assigned: Vec<Vec<u32>>,
}

impl Cells {
    /// The different pairs of label and node, in order of their first Gaussian.
    pub fn new(instances: &Instances) -> Self {
        let (mut known, mut cells) = (BTreeMap::new(), Self::default());
        for pair in instances.label.iter().copied().zip(instances.node.iter().copied()) {
            let cell = *known.entry(pair).or_insert_with(|| {
                cells.pairs.push(pair);
                cells.counts.push(0);
                cells.pairs.len() as u32 - 1
            });
            cells.counts[cell as usize] += 1;
            cells.of.push(cell);
        }
        cells
    }

    /// The same with each cell cut in two of which an edit assigns a part: new ones come last.
    pub fn cut(&self, edits: &[Edit]) -> Result<Self> {
        let mut cells = self.clone();
        let lists = edits.iter().filter_map(|e| match e {
            Edit::Assign { gaussians, .. } => Some(ranges_of(gaussians, self.of.len())),
            _ => None,
        });
        let lists = lists.collect::<Result<Vec<_>>>()?;
        for ranges in &lists {
            let mut inside = BTreeMap::<u32, u32>::new();
            each(ranges).for_each(|i| *inside.entry(cells.of[i]).or_default() += 1);
            let mut new = BTreeMap::new();
            for (cell, n) in inside.into_iter().filter(|&(cell, n)| n < cells.counts[cell as usize]).collect::<Vec<_>>()
            {
                new.insert(cell, cells.pairs.len() as u32);
                cells.pairs.push(cells.pairs[cell as usize]);
                cells.counts[cell as usize] -= n;
                cells.counts.push(n);
            }
            each(ranges).for_each(|i| cells.of[i] = new.get(&cells.of[i]).copied().unwrap_or(cells.of[i]));
        }
        let of = |ranges: &Vec<_>| each(ranges).map(|i| cells.of[i]).collect::<BTreeSet<u32>>().into_iter().collect();
        cells.assigned = lists.iter().map(of).collect();
        Ok(cells)
    }
}

fn each(ranges: &[Range<u32>]) -> impl Iterator<Item = usize> {
    ranges.iter().cloned().flatten().map(|i| i as usize)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_are_pairs_of_instance_and_cluster_cut_by_what_was_assigned() {
        let i = Instances { label: vec![0, 0, -1, 0, 1], node: vec![7, 8, -1, 7, 7], ..Instances::default() };
        let cells = Cells::new(&i);
        assert_eq!(cells.pairs, [(0, 7), (0, 8), (-1, -1), (1, 7)]);
        assert_eq!((&cells.of, &cells.counts), (&vec![0, 1, 2, 0, 3], &vec![2, 1, 1, 1]));
        assert_eq!(cells.cut(&[]).unwrap(), cells);
        // Gaussians 0 to 2: half of the first cell, all of two others; then 3 and 4: the other half, and a whole one.
        let assign = |gaussians: &str| Edit::Assign { instance: 1, gaussians: gaussians.into() };
        let cut = cells.cut(&[assign("0 3"), assign("3 2")]).unwrap();
        assert_eq!(cut.of, [4, 1, 2, 0, 3]);
        assert_eq!((&cut.counts, cut.pairs[4]), (&vec![1, 1, 1, 1, 1], (0, 7)));
        assert_eq!(cut.assigned, [vec![1, 2, 4], vec![0, 3]]);
    }
}
