//! Parts, things and groups: what masks of several views show as one, for texts to choose among.
//!
//! Instances share the Gaussians out. A text does not: "coffee set" asks for a group, "spoon" for a part of it. So every
//! instance and every cluster of the tree is compared with the masks of all levels in every view, by blending weight. What some
//! mask fits in two views or more can be asked for, and these masks say what it means.

use crate::describe::Witnesses;
use crate::matching::Likeness;
use crate::profile::{Sums, shown_of};
use artifacts::{Footprints, Granule, Level, Members, Witness};
use gs_io::Result;
use rayon::prelude::*;
use std::collections::{BTreeMap, HashMap};

/// A view counts when it shows at least this share of what the view that shows most does.
const SHOWN: f64 = 0.05;
/// A mask shows a granule when the two have at least this IoU.
const LEAST_FIT: f64 = 0.3;
/// Two granules are one when this share of the masks that show the second shows the first.
const SAME: f64 = 0.9;
/// A cluster is a candidate when it has at most this share of the Gaussians of the smallest candidate above it.
const SHRINKS: f64 = 0.95;
/// Fewest Gaussians of a candidate.
const SMALLEST: usize = 3;

/// What may be a granule.
pub(crate) struct Candidates {
    members: Vec<Members>,
    /// The candidates that the Gaussians of each cluster are in, by cluster.
    above: BTreeMap<i32, Vec<u32>>,
}

impl Candidates {
    /// The instances, and the clusters of the tree that are clearly smaller than those above them. `labels` and `nodes` are those
    /// of the kept Gaussians; `parents` has the cluster above each cluster.
    pub fn new(labels: &[i32], instances: usize, nodes: &[i32], parents: &BTreeMap<u32, u32>) -> Self {
        let mut sizes: BTreeMap<u32, usize> = BTreeMap::new();
        nodes.iter().filter_map(|&n| u32::try_from(n).ok()).for_each(|n| *sizes.entry(n).or_default() += 1);
        // Children have larger numbers than their parents.
        for (child, parent) in parents.iter().rev() {
            *sizes.entry(*parent).or_default() += sizes.get(child).copied().unwrap_or(0);
        }
        let mut members: Vec<Members> = (0..instances as u32).map(Members::Instance).collect();
        let mut above: BTreeMap<i32, (usize, Vec<u32>)> = BTreeMap::new();
        for (&child, &parent) in parents {
            let size = sizes.get(&child).copied().unwrap_or(0);
            let (mut smallest, mut own) = above.get(&(parent as i32)).cloned().unwrap_or((labels.len(), Vec::new()));
            if size >= SMALLEST && size as f64 <= SHRINKS * smallest as f64 {
                smallest = size;
                own.push(members.len() as u32);
                members.push(Members::Cluster(child));
            }
            above.insert(child as i32, (smallest, own));
        }
        Self { members, above: above.into_iter().map(|(node, (_, own))| (node, own)).collect() }
    }
}

/// A mask that shows a candidate, as a row of the footprints.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Shown {
    pub row: u32,
    /// Their IoU, 0 to 1, times how alike they are.
    pub fit: f64,
    /// Weight of what the view shows of the candidate: about its visible pixels.
    pub seen: f64,
}

/// A granule, and its mask in each view that shows it.
pub(crate) type Witnessed = (Granule, Vec<Shown>);

/// How well masks fit an instance, and its mask in each view that shows it.
pub(crate) type Fitted = (f32, Vec<Shown>);

/// Finds what masks of at least `views` views show as one, what they show best and most often first, with these masks; nothing for 0 views.
/// And of each instance how well masks fit it, 0 to 1, as [`Granule::fit`], with these. `labels` and `nodes` are those of the kept Gaussians.
///
/// # Errors
/// When the footprints can't be read.
pub(crate) fn find(
    candidates: &Candidates,
    labels: &[i32],
    nodes: &[i32],
    footprints: &Footprints,
    views: usize,
) -> Result<(Vec<Witnessed>, Vec<Fitted>)> {
    let best = best_masks(candidates, labels, nodes, footprints, &Level::ALL, &|_, _| 1.0)?;
    let (mut found, mut instances) = (Vec::new(), Vec::new());
    for (&members, mut shown) in candidates.members.iter().zip(best) {
        let fit = fit(&mut shown);
        if let Members::Instance(_) = members {
            instances.push((fit, shown.clone()));
        }
        found.extend(judge(members, fit, shown, views));
    }
    // Of equals the first.
    found.sort_by(|a, b| b.0.total_cmp(&a.0));
    Ok((different(found), instances))
}

/// The mask at `levels` of each view that fits each instance best, times how alike they are. `labels` are those of the kept Gaussians.
///
/// # Errors
/// When the footprints can't be read.
pub(crate) fn best_at(
    levels: &[Level],
    labels: &[i32],
    count: usize,
    footprints: &Footprints,
    likeness: &Likeness,
) -> Result<Vec<Vec<Shown>>> {
    let nodes = vec![-1; labels.len()];
    let candidates = Candidates::new(labels, count, &nodes, &BTreeMap::new());
    let mut best = best_masks(&candidates, labels, &nodes, footprints, levels, &|k, row| likeness.of(k, row))?;
    best.iter_mut().for_each(|shown| _ = fit(shown));
    Ok(best)
}

/// The masks that say what each granule means, `most` of each, 0 for all. One that fits twice as well counts four times.
pub(crate) fn witnesses(
    granules: &[Witnessed],
    footprints: &Footprints,
    most: usize,
    chosen: &mut Witnesses,
) -> Vec<Witness> {
    let of_one = |(of, (_, shown)): (usize, &Witnessed)| {
        let witness = |s: &Shown| {
            let row = &footprints.rows[s.row as usize];
            (s.fit, Witness { of: of as u32, view: row.view, mask: row.mask, weight: s.fit * s.fit })
        };
        chosen.choose(shown.iter().map(witness), most)
    };
    granules.iter().enumerate().flat_map(of_one).collect()
}

/// The mean of the IoUs over the views that show enough of it, which alone are left in `shown`.
fn fit(shown: &mut Vec<Shown>) -> f32 {
    let most = shown.iter().map(|s| s.seen).fold(0.0, f64::max);
    shown.retain(|s| s.seen >= SHOWN * most);
    (shown.iter().map(|s| s.fit).sum::<f64>() / shown.len().max(1) as f64) as f32
}

/// Which of `count` instances masks of at least `views` views show as one. `labels` are those of the kept Gaussians.
///
/// # Errors
/// When the footprints can't be read.
pub(crate) fn are_shown(labels: &[i32], count: usize, footprints: &Footprints, views: usize) -> Result<Vec<bool>> {
    let nodes = vec![-1; labels.len()];
    let candidates = Candidates::new(labels, count, &nodes, &BTreeMap::new());
    let best = best_masks(&candidates, labels, &nodes, footprints, &Level::ALL, &|_, _| 1.0)?;
    let is_shown = |(&m, mut shown): (&Members, Vec<Shown>)| {
        let fit = fit(&mut shown);
        judge(m, fit, shown, views).is_some()
    };
    Ok(candidates.members.iter().zip(best).map(is_shown).collect())
}

/// The mask at `levels` that fits each candidate best, of each view that shows it. `like` says how alike a candidate and a row are.
fn best_masks(
    c: &Candidates,
    labels: &[i32],
    nodes: &[i32],
    footprints: &Footprints,
    levels: &[Level],
    like: &impl Fn(u32, u32) -> f64,
) -> Result<Vec<Vec<Shown>>> {
    let mut best: Vec<Vec<Shown>> = vec![Vec::new(); c.members.len()];
    // Numbers of clusters begin after those of all Gaussians.
    let root = nodes.iter().copied().filter(|&n| n >= 0).min().unwrap_or(0);
    let nodes: Vec<i32> = nodes.iter().map(|&n| if n < 0 { -1 } else { n - root }).collect();
    let above = c.above.iter().filter(|(node, _)| **node >= root).map(|(node, own)| (node - root, &own[..])).collect();
    let mut first = 0;
    for rows in footprints.rows.chunk_by(|a, b| a.view == b.view) {
        let masks = (first..first + rows.len())
            .into_par_iter()
            .map_init(Default::default, |sums, r| Mask::new(r, &above, labels, &nodes, footprints, sums))
            .collect::<Result<Vec<Mask>>>()?;
        first += rows.len();
        best_of_view(&masks, levels, like, &mut best);
    }
    Ok(best)
}

/// What a mask shows of the candidates.
struct Mask {
    row: u32,
    level: u32,
    /// Weight of all its Gaussians.
    area: f64,
    /// Weight of each candidate in it, ascending.
    of: Vec<(u32, f64)>,
}

impl Mask {
    fn new(
        row: usize,
        above: &BTreeMap<i32, &[u32]>,
        labels: &[i32],
        nodes: &[i32],
        footprints: &Footprints,
        sums: &mut (Sums, Sums),
    ) -> Result<Self> {
        let (by_node, of) = sums;
        let mut area = 0.0;
        for (i, w) in footprints.entries(row)?.iter() {
            let w = f64::from(w);
            area += w;
            by_node.add(nodes[i as usize], w);
            of.add(labels[i as usize], w);
        }
        for (node, w) in by_node.take() {
            above.get(&(node as i32)).into_iter().copied().flatten().for_each(|&own| of.add(own as i32, w));
        }
        Ok(Self { row: row as u32, level: footprints.rows[row].level, area, of: of.take().collect() })
    }
}

/// Adds the mask at `levels` of a view that fits each candidate best, of equals the first. What a view shows of a candidate is what the masks
/// of a level hold of it, of that level which holds most.
fn best_of_view(masks: &[Mask], levels: &[Level], like: &impl Fn(u32, u32) -> f64, best: &mut [Vec<Shown>]) {
    let seen = shown_of(masks.iter().map(|m| (m.level, m.of.iter().copied())));
    let mut of_view: BTreeMap<u32, Shown> = BTreeMap::new();
    for m in masks.iter().filter(|m| levels.contains(&Level::ALL[m.level as usize])) {
        for &(c, w) in m.of.iter().filter(|(_, w)| *w > 0.0) {
            let seen = seen[&c];
            let shown = Shown { row: m.row, fit: w / (seen + m.area - w) * like(c, m.row), seen };
            let now = of_view.entry(c).or_insert(shown);
            if shown.fit > now.fit {
                *now = shown;
            }
        }
    }
    of_view.into_iter().for_each(|(c, shown)| best[c as usize].push(shown));
}

/// Whether a candidate with this fit is a granule, and how surely: the sum of its IoUs. `shown` has its best mask in every view that shows
/// enough of it. None is for 0 views.
fn judge(members: Members, fit: f32, mut shown: Vec<Shown>, least: usize) -> Option<(f64, Granule, Vec<Shown>)> {
    shown.retain(|s| s.fit >= LEAST_FIT);
    let granule = Granule { members, support: shown.len() as u32, fit };
    let sure = shown.iter().map(|s| s.fit).sum();
    (least > 0 && shown.len() >= least).then_some((sure, granule, shown))
}

/// Leaves out what the same masks show as something before it.
fn different(found: Vec<(f64, Granule, Vec<Shown>)>) -> Vec<Witnessed> {
    let mut shows: HashMap<u32, Vec<u32>> = HashMap::new();
    let mut kept: Vec<Witnessed> = Vec::new();
    for (_, granule, shown) in found {
        let mut common: BTreeMap<u32, usize> = BTreeMap::new();
        for other in shown.iter().filter_map(|s| shows.get(&s.row)).flatten() {
            *common.entry(*other).or_default() += 1;
        }
        if common.values().all(|&n| (n as f64) < SAME * shown.len() as f64) {
            shown.iter().for_each(|s| shows.entry(s.row).or_default().push(kept.len() as u32));
            kept.push((granule, shown));
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;
    use artifacts::{FootprintsBuilder, Row};
    use gs_io::Provenance;

    const PARENTS: [(u32, u32); 4] = [(11, 10), (12, 10), (13, 11), (14, 11)];
    /// A cup (11) of bowl (13: Gaussians 0 to 3) and handle (14: 4 to 6), and a spoon (12: 7 to 10); the root is 10.
    const NODES: [i32; 11] = [13, 13, 13, 13, 14, 14, 14, 12, 12, 12, 12];
    const LABELS: [i32; 11] = [0, 0, 0, 0, 0, 0, 0, 1, 1, 1, 1];

    /// Masks of three views, by level, each with a weight of 1 for each of its Gaussians; the last view shows no handle.
    fn footprints(masks: &[(Level, std::ops::Range<u32>)]) -> (tempfile::TempDir, Footprints) {
        let mut b = FootprintsBuilder { kept: (0..11).collect(), ..FootprintsBuilder::default() };
        for view in 0..3 {
            b.views.push(view.to_string());
            for (mask, (level, range)) in masks.iter().enumerate() {
                let row =
                    Row { view, level: level.index() as u32, mask: mask as u32, pixels: 10, gated: 10, alpha: 1.0 };
                let shown = range.clone().filter(|i| view < 2 || !(4..7).contains(i));
                b.push(row, shown.map(|i| (i, 1.0)));
            }
        }
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("f.safetensors");
        b.write(&path, Provenance::default()).unwrap();
        let footprints = Footprints::read(&path).unwrap();
        (dir, footprints)
    }

    fn found(masks: &[(Level, std::ops::Range<u32>)]) -> Vec<(Granule, Vec<u32>)> {
        let (_dir, f) = footprints(masks);
        let candidates = Candidates::new(&LABELS, 2, &NODES, &PARENTS.into());
        let found = find(&candidates, &LABELS, &NODES, &f, 2).unwrap().0;
        found.into_iter().map(|(g, shown)| (g, shown.iter().map(|s| f.rows[s.row as usize].mask).collect())).collect()
    }

    #[test]
    fn masks_of_each_level_find_their_part_and_thing() {
        let (small, large) = (Level::SMALL, Level::LARGE);
        let all = [(small, 0..4), (small, 4..7), (small, 7..11), (large, 0..7), (large, 7..11)];
        let of = |members, support| Granule { members, support, fit: 1.0 };
        let expected = [
            (of(Members::Instance(0), 3), vec![3, 3, 0]),
            (of(Members::Instance(1), 3), vec![2, 2, 2]),
            (of(Members::Cluster(13), 3), vec![0, 0, 0]),
            (of(Members::Cluster(14), 2), vec![1, 1]),
        ];
        // Of two masks that fit alike the first; what instance and cluster have in common is there once.
        assert_eq!(found(&all), expected);
    }

    #[test]
    fn the_fit_of_an_instance_is_the_mean_over_its_views() {
        let (_dir, f) = footprints(&[(Level::LARGE, 0..4), (Level::LARGE, 4..11)]);
        let candidates = Candidates::new(&LABELS, 2, &NODES, &PARENTS.into());
        let (none, instances) = find(&candidates, &LABELS, &NODES, &f, 0).unwrap();
        let fits: Vec<f32> = instances.iter().map(|(fit, _)| *fit).collect();
        // 4 of 7 Gaussians in two views; the third shows no handle, and there a mask is the whole instance.
        let expected = ((4.0 / 7.0 * 2.0 + 1.0) / 3.0) as f32;
        assert!(none.is_empty() && fits.iter().all(|fit| (fit - expected).abs() < 1e-6) && fits.len() == 2, "{fits:?}");
    }

    #[test]
    fn what_no_mask_shows_as_one_is_no_granule() {
        // One mask over everything: IoU 3 / 11 with the handle, which is too little, 4 / 11 with bowl and spoon.
        let members: Vec<Members> = found(&[(Level::LARGE, 0..11)]).iter().map(|(g, _)| g.members).collect();
        assert!(!members.contains(&Members::Cluster(14)), "{members:?}");
        // The last view shows the bowl of the cup alone.
        let cup = found(&[(Level::LARGE, 0..7), (Level::LARGE, 7..11)]);
        assert_eq!(cup.len(), 2, "the bowl is nothing of its own: {cup:?}");
        assert_eq!((cup[0].0.members, cup[0].0.support, cup[0].0.fit), (Members::Instance(0), 3, 1.0));
    }

    #[test]
    fn a_cluster_much_like_the_one_above_is_no_candidate_of_its_own() {
        // 100 Gaussians in 20, of which 97 in 21, of which 50 in 22.
        let nodes: Vec<i32> = (0..100)
            .map(|i| {
                if i < 50 {
                    22
                } else if i < 97 {
                    21
                } else {
                    20
                }
            })
            .collect();
        let parents = BTreeMap::from([(20, 19), (21, 20), (22, 21)]);
        let c = Candidates::new(&vec![-1; 110], 0, &[nodes, vec![19; 10]].concat(), &parents);
        assert_eq!(c.members, [Members::Cluster(20), Members::Cluster(22)]);
        assert_eq!(c.above[&22], [0, 1]);
        assert_eq!(c.above[&21], [0]);
    }
}
