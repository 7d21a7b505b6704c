//! How far masks and instances agree, and what masks with names call them.

use crate::profile::shown_of;
use artifacts::{Footprints, Health, Instances, Level, MaskNames, Naming, ScoredName, read_mask_names};
use gs_io::Result;
use std::collections::BTreeMap;
use std::path::Path;

/// Weight of each instance in masks, which are rows of the footprints.
type Weights = [(u32, BTreeMap<u32, f64>)];

/// A name that this share of an instance's weight speaks for is sure.
const SURE: f32 = 0.5;

/// The health of `instances`, from the weight of each in the masks.
pub fn measure(instances: &Instances, weights: &Weights) -> Health {
    let labelled: usize = instances.count.iter().map(|&c| c as usize).sum();
    let largest = instances.count.iter().max().map_or(0.0, |&c| f64::from(c) / labelled.max(1) as f64);
    let (mut inside, mut all) = (0.0, 0.0);
    for (_, of) in weights {
        inside += of.values().copied().fold(0.0, f64::max);
        all += of.values().sum::<f64>();
    }
    Health { largest, purity: (all > 0.0).then(|| inside / all), names: Vec::new() }
}

/// What masks call each instance ([`Health::names`]), by the share of what the views show of it. `weights` are those in the masks of all
/// levels. Where a view has several levels with names, the one that says most counts. `folder` has the id maps.
///
/// # Errors
/// When a file of names is damaged.
pub fn names(weights: &Weights, footprints: &Footprints, folder: &Path) -> Result<Vec<Naming>> {
    let row_of = |row: u32| &footprints.rows[row as usize];
    if weights.iter().all(|(row, _)| row_of(*row).is_of(&Level::SAM)) {
        return Ok(Vec::new());
    }
    let names =
        footprints.views.iter().map(|view| read_mask_names(folder, view)).collect::<Result<Vec<MaskNames>>>()?;
    let mut all: BTreeMap<u32, f64> = BTreeMap::new();
    let mut called: BTreeMap<u32, BTreeMap<&str, f64>> = BTreeMap::new();
    for of_view in weights.chunk_by(|a, b| row_of(a.0).view == row_of(b.0).view) {
        let mut said: BTreeMap<(u32, u32), BTreeMap<&str, f64>> = BTreeMap::new();
        for (row, of) in of_view {
            let row = row_of(*row);
            let Some(mask) = names[row.view as usize].get(&row.mask) else { continue };
            for (&k, &w) in of {
                *said.entry((k, row.level)).or_default().entry(&mask.name).or_default() += w * f64::from(mask.score);
            }
        }
        let masks = of_view.iter().map(|(row, of)| (row_of(*row).level, of.iter().map(|(&k, &w)| (k, w))));
        for (k, shown) in shown_of(masks) {
            *all.entry(k).or_default() += shown;
            let sum = |of: &BTreeMap<&str, f64>| of.values().sum::<f64>();
            let of_level = said.range((k, 0)..=(k, u32::MAX)).map(|(_, of)| of);
            let more = of_level.max_by(|a, b| sum(a).total_cmp(&sum(b)));
            for (name, w) in more.into_iter().flatten() {
                *called.entry(k).or_default().entry(name).or_default() += w;
            }
        }
    }
    let naming = |(instance, of): (u32, BTreeMap<&str, f64>)| {
        let score = |w: f64| (w / all[&instance]) as f32;
        let mut names: Vec<ScoredName> =
            of.into_iter().map(|(name, w)| ScoredName { name: name.into(), score: score(w) }).collect();
        // Of equals the first by name; the sort is stable.
        names.sort_by(|a, b| b.score.total_cmp(&a.score));
        names.truncate(3);
        let margin = names[0].score - names.get(1).map_or(0.0, |second| second.score);
        Naming { instance, margin, sure: names[0].score >= SURE, names }
    };
    Ok(called.into_iter().map(naming).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::profile::mask_weights;
    use crate::testing::{footprints, footprints_of, instances};
    use artifacts::{MaskName, note_path};
    use serde_json::json;

    fn health(instances: &Instances, footprints: &Footprints, level: Level) -> Health {
        measure(instances, &mask_weights(&instances.label, footprints, &[level]).unwrap())
    }

    #[test]
    fn it_counts_the_largest_instance_and_what_masks_hold_of_one() {
        // Instance 0 holds Gaussians 0 to 5, instance 1 holds 6 and 7. One mask fits, one holds 3 and 1.
        let footprints = footprints(&[&[&[0, 1], &[3, 4, 5, 6]]]);
        let instances = instances([0, 0, 0, 0, 0, 0, 1, 1]);
        let found = health(&instances, &footprints, Level::LARGE);
        assert_eq!(found, Health { largest: 0.75, purity: Some(5.0 / 6.0), names: vec![] });
        assert_eq!(health(&instances, &footprints, Level::SMALL).purity, None);
    }

    #[test]
    fn an_instance_is_called_what_most_of_its_weight_is() {
        let dir = tempfile::tempdir().unwrap();
        let called = |name: &str, score| MaskName { name: name.into(), score };
        // Two views of level classes; the second has a mask without a name.
        let views: [&[&[u32]]; 2] = [&[&[0, 1, 2, 3], &[4, 5, 6, 7]], &[&[0, 1], &[2, 3], &[4, 5, 6, 7]]];
        let footprints = footprints_of(&[(Level::CLASSES, &views), (Level::LARGE, &views)]);
        let masks: [&[(u32, MaskName)]; 2] = [
            &[(0, called("sofa", 0.9)), (1, called("table", 0.5))],
            &[(0, called("chair", 1.0)), (2, called("table", 0.6))],
        ];
        for (view, names) in masks.iter().enumerate() {
            let names: MaskNames = names.iter().cloned().collect();
            let note = json!({ "facts": { "names": names } });
            gs_io::write_json(note_path(dir.path(), &view.to_string()), &note).unwrap();
        }
        let weights = mask_weights(&[0, 0, 0, 0, 1, 1, 1, 1], &footprints, &Level::ALL).unwrap();
        let found = names(&weights, &footprints, dir.path()).unwrap();
        let said: Vec<_> = found.iter().map(|n| (n.instance, n.sure, n.names[0].name.as_str())).collect();
        assert_eq!(said, [(0, false, "sofa"), (1, true, "table")]);
        let scores: Vec<f32> = found.iter().flat_map(|n| &n.names).map(|n| n.score).collect();
        assert!(scores.iter().zip([0.45, 0.25, 0.55]).all(|(a, b)| (a - b).abs() < 1e-6), "{scores:?}");
        let wrong = json!({ "facts": { "names": { "0": { "name": "", "score": 2 } } } });
        gs_io::write_json(note_path(dir.path(), "0"), &wrong).unwrap();
        let e = names(&weights, &footprints, dir.path()).unwrap_err().to_string();
        assert!(e.contains("0_s.json: 0: not the name of a mask"), "{e}");
    }

    #[test]
    fn one_mask_that_grazes_an_instance_does_not_name_it() {
        let dir = tempfile::tempdir().unwrap();
        let name = |name: &str| MaskName { name: name.into(), score: 0.9 };
        // The only concept of two views holds one of four Gaussians of instance 0; a class holds all of instance 1, with a concept.
        let large: [&[&[u32]]; 2] = [&[&[0, 1, 2, 3], &[4, 5, 6, 7]]; 2];
        let classes: [&[&[u32]]; 2] = [&[&[], &[], &[4, 5, 6, 7]]; 2];
        let concepts: [&[&[u32]]; 2] = [&[&[], &[], &[], &[0, 4, 5]], &[]];
        let footprints =
            footprints_of(&[(Level::LARGE, &large), (Level::CLASSES, &classes), (Level::CONCEPTS, &concepts)]);
        let names_of = MaskNames::from([(2, name("table")), (3, name("lamp"))]);
        for view in ["0", "1"] {
            let note = json!({ "facts": { "names": names_of } });
            gs_io::write_json(note_path(dir.path(), view), &note).unwrap();
        }
        let weights = mask_weights(&[0, 0, 0, 0, 1, 1, 1, 1], &footprints, &Level::ALL).unwrap();
        let found = names(&weights, &footprints, dir.path()).unwrap();
        let said: Vec<_> =
            found.iter().map(|n| (n.instance, n.sure, n.names[0].name.as_str(), n.names.len())).collect();
        assert_eq!(said, [(0, false, "lamp", 1), (1, true, "table", 1)]);
        assert!((found[0].names[0].score - 0.9 / 8.0).abs() < 1e-6 && (found[1].names[0].score - 0.9).abs() < 1e-6);
    }
}
