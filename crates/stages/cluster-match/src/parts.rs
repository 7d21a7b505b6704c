//! Parts that leave their instance: what stands on a shelf is no shelf.

use crate::assignment::Assignment;
use crate::granules::are_shown;
use crate::profile::with_rest;
use artifacts::{Footprints, Level, TreeEdge};
use gs_io::Result;
use std::collections::BTreeMap;

/// Least share of a part that lies in an instance for it to be that instance's.
const INSIDE: f64 = 0.7;
/// A part is a thing of its own where large masks hold it and the rest less often than medium masks do, by this probability.
const APART: f64 = 0.2;
/// Fewest views with a mask that shows a part as one. Small things in furnished rooms are seen well in one view only (docs/results/real-masks.md).
const VIEWS: usize = 1;

/// What several instances have of several parts: each pair of an instance and a part that share Gaussians.
struct Pieces {
    /// The instance and the part; -1 for no part.
    pairs: Vec<(i32, i32)>,
    /// The pair of each kept Gaussian, -1 for none.
    labels: Vec<i32>,
}

impl Pieces {
    fn new(wholes: &Assignment, parts: &Assignment, kept: &[u32]) -> Self {
        let pair = |i: &u32| (wholes.labels[*i as usize], parts.labels[*i as usize]);
        let mut pairs: Vec<(i32, i32)> = kept.iter().map(pair).filter(|p| p.0 >= 0).collect();
        pairs.sort_unstable();
        pairs.dedup();
        let number = |i: &u32| pairs.binary_search(&pair(i)).map_or(-1, |k| k as i32);
        let labels = kept.iter().map(number).collect();
        Self { pairs, labels }
    }

    /// Those that the masks of whole things (`large`) set apart: the probability that one of them holds the part and the rest of the
    /// instance is lower, by [`APART`], than that of the medium masks. SAM's largest mask of a place is the whole thing there. Where either
    /// level says nothing of a part, it is not apart.
    fn apart(&self, footprints: &Footprints, large: &[Level]) -> Result<Vec<bool>> {
        let wholes: Vec<i32> = self.pairs.iter().map(|p| p.0).collect();
        let agreements = |levels| with_rest(&self.labels, &wholes, footprints, levels);
        let (medium, large) = (agreements(&[Level::MEDIUM])?, agreements(large)?);
        Ok(medium.into_iter().zip(large).map(|(m, l)| m.zip(l).is_some_and(|(m, l)| m - l >= APART)).collect())
    }

    /// Those that leave, with their numbers of Gaussians. `shares` has the largest share of its instance that each may have; None where
    /// it may not leave.
    fn leaving(&self, shares: &[Option<f64>]) -> Vec<(usize, u32)> {
        let mut counts = vec![0u32; self.pairs.len()];
        self.labels.iter().filter_map(|&k| usize::try_from(k).ok()).for_each(|k| counts[k] += 1);
        let (mut wholes, mut parts): (BTreeMap<i32, u32>, BTreeMap<i32, u32>) = Default::default();
        for (&(whole, part), &n) in self.pairs.iter().zip(&counts) {
            *wholes.entry(whole).or_default() += n;
            *parts.entry(part).or_default() += n;
        }
        let may = |k: usize| {
            let (whole, part) = self.pairs[k];
            let (size, of_part) = (f64::from(wholes[&whole]), f64::from(parts[&part]));
            part >= 0
                && shares[k].is_some_and(|share| f64::from(counts[k]) >= INSIDE * of_part && of_part <= share * size)
        };
        let mut leaving: Vec<usize> = (0..counts.len()).filter(|&k| may(k)).collect();
        let mut left: BTreeMap<i32, u32> = BTreeMap::new();
        leaving.iter().for_each(|&k| *left.entry(self.pairs[k].0).or_default() += counts[k]);
        leaving.retain(|&k| 2 * left[&self.pairs[k].0] <= wholes[&self.pairs[k].0]);
        leaving.into_iter().map(|k| (k, counts[k])).collect()
    }
}

/// Makes instances of `parts`. A part leaves where at least [`INSIDE`] of its Gaussians lie in one instance, it has at most `share` of that
/// instance's (or a half, where large masks set it apart), and some mask shows it as one. An instance of which more than half would leave
/// stays as it is. `large` are the levels of whole things. In the tree such a part hangs below the cluster of that instance. Returns how many
/// there are.
///
/// # Errors
/// When the footprints can't be read.
pub(crate) fn split(
    wholes: &mut Assignment,
    parts: &Assignment,
    kept: &[u32],
    footprints: &Footprints,
    large: &[Level],
    share: f64,
) -> Result<usize> {
    let pieces = Pieces::new(wholes, parts, kept);
    let apart = pieces.apart(footprints, large)?;
    let shown = are_shown(&pieces.labels, pieces.pairs.len(), footprints, VIEWS)?;
    let shares = apart.iter().zip(shown).map(|(&apart, shown)| shown.then_some(if apart { 0.5 } else { share }));
    let leaving = pieces.leaving(&shares.collect::<Vec<_>>());
    let before = wholes.instances;
    let mut new = vec![None; pieces.pairs.len()];
    let mut child = wholes.tree.iter().map(|e| e.child).max().unwrap_or(0);
    for (k, size) in leaving {
        // Of a joined instance the first cluster; the whole scene is no cluster of the tree.
        let above = wholes.tree.iter().find(|e| e.instance == pieces.pairs[k].0).copied();
        let node = above.map(|e| {
            child += 1;
            // The masks of wholes do not part them at any distance.
            let (lambda, instance) = (f32::MAX, wholes.instances as i32);
            wholes.tree.push(TreeEdge { parent: e.child, child, lambda, size, instance });
            child as i32
        });
        new[k] = Some((wholes.instances as i32, node));
        wholes.instances += 1;
    }
    for (&i, &piece) in kept.iter().zip(&pieces.labels) {
        if let Some((instance, node)) = usize::try_from(piece).ok().and_then(|k| new[k]) {
            wholes.labels[i as usize] = instance;
            wholes.nodes[i as usize] = node.unwrap_or(wholes.nodes[i as usize]);
        }
    }
    Ok(wholes.instances - before)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::footprints_of;

    fn of(labels: Vec<i32>, instances: usize) -> Assignment {
        let tree = vec![TreeEdge { parent: 4, child: 5, lambda: 2.0, size: 100, instance: 0 }];
        Assignment { nodes: vec![5; labels.len()], labels, instances, tree, clusters: Vec::new() }
    }

    #[test]
    fn parts_much_smaller_than_their_instance_leave_it() {
        let (all, may) = ((0..120).collect::<Vec<u32>>(), |share| vec![Some(share); 9]);
        let pieces = |whole: &dyn Fn(i32) -> i32, part: &dyn Fn(i32) -> i32| {
            Pieces::new(&of((0..120).map(whole).collect(), 2), &of((0..120).map(part).collect(), 20), &all)
        };
        // Part 0 is most of instance 0; 1 is small and lies in it; 2 lies half in either; 3 is half of instance 1.
        let whole = |i: i32| i32::from(i >= 100);
        let part = |i: i32| [(90, 0), (96, 1), (104, 2), (120, 3)].iter().find(|(end, _)| i < *end).unwrap().1;
        let a = pieces(&whole, &part);
        assert_eq!(a.pairs, [(0, 0), (0, 1), (0, 2), (1, 2), (1, 3)]);
        assert_eq!(a.leaving(&may(0.1)), [(1, 6)]);
        assert_eq!(a.leaving(&may(0.05)), [], "nothing is small enough");
        assert_eq!(a.leaving(&[Some(0.1), None, Some(0.1), None, None]), []);
        // A larger share lets more leave, but no more than half of an instance.
        let last = |i: i32| if i < 90 { -1 } else { 0 };
        assert_eq!(pieces(&last, &part).leaving(&may(0.3)), [(0, 6), (1, 8)]);
        assert_eq!(pieces(&whole, &|i| i / 6).leaving(&[Some(0.1); 22]), [], "the instance would fall apart");
    }

    #[test]
    fn parts_are_apart_that_large_masks_separate_more_often_than_medium_ones() {
        // A mouse on its pad; the last two Gaussians are another instance.
        let all: Vec<u32> = (0..8).collect();
        let pieces = Pieces::new(&of(vec![0, 0, 0, 0, 0, 0, 1, 1], 2), &of(vec![0, 0, 1, 1, 1, 1, 2, 2], 3), &all);
        let together: [&[&[u32]]; 2] = [&[&[0, 1, 2, 3, 4, 5], &[6, 7]]; 2];
        let once: [&[&[u32]]; 2] = [together[0], &[&[0, 1], &[2, 3, 4, 5], &[6, 7]]];
        let unseen: [&[&[u32]]; 2] = [&[&[6, 7]]; 2];
        let apart = |medium, large| {
            pieces.apart(&footprints_of(&[(Level::MEDIUM, medium), (Level::LARGE, large)]), &[Level::LARGE]).unwrap()
        };
        assert_eq!(apart(&together, &once), [true, true, false]);
        for (medium, large) in [(&together, &together), (&once, &together), (&once, &once), (&together, &unseen)] {
            assert_eq!(apart(medium, large), [false; 3], "{medium:?} {large:?}");
        }
    }

    #[test]
    fn parts_leave_where_a_mask_shows_them() {
        let all: Vec<u32> = (0..8).collect();
        let split = |views: [&[&[u32]]; 2]| {
            let mut wholes = of(vec![0; 8], 1);
            let parts = of(vec![0, 0, 0, 0, 0, 0, 1, 1], 2);
            let split =
                split(&mut wholes, &parts, &all, &footprints_of(&[(Level::SMALL, &views)]), &[Level::LARGE], 0.3)
                    .unwrap();
            (split, wholes)
        };
        let shown: &[&[u32]] = &[&[0, 1, 2, 3, 4, 5], &[6, 7]];
        let (count, wholes) = split([shown; 2]);
        assert_eq!((count, wholes.instances, &wholes.labels[..]), (1, 2, &[0, 0, 0, 0, 0, 0, 1, 1][..]));
        // It hangs below the instance's cluster.
        assert_eq!(wholes.tree[1], TreeEdge { parent: 5, child: 6, lambda: f32::MAX, size: 2, instance: 1 });
        assert_eq!(wholes.nodes, [5, 5, 5, 5, 5, 5, 6, 6]);
        let whole: &[&[u32]] = &[&[0, 1, 2, 3, 4, 5, 6, 7]];
        assert_eq!((split([shown, whole]).0, split([whole; 2]).0), (1, 0));
    }
}
