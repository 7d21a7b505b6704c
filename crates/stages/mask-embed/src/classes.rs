//! Level classes of an id map: what a panoptic model sees, and SAM's large masks where it sees nothing.

use crate::panoptic::Segments;
use artifacts::{LEVELS, Level, MaskMaps, MaskName, MaskNames};
use ndarray::{Array2, Array3, Axis, concatenate};
use std::collections::BTreeMap;

/// Adds the levels of masks with names to SAM's, and gives the names: segments of at least `min_area` pixels, then the large masks where
/// none of these is, without a name. A thing of no known class is better seen by SAM than not at all (docs/results/real-masks.md).
/// `seen` has the maps' size; level concepts stays empty.
pub fn with_classes(maps: &MaskMaps, seen: &Segments, min_area: usize) -> (MaskMaps, MaskNames) {
    let large = maps.level(Level::Large);
    let mut level = Array2::from_elem(large.dim(), -1);
    let (mut names, mut next) = (MaskNames::new(), maps.id_count() as i32);
    let mut paint = |source: &[i32], is_free: &dyn Fn(i32) -> bool, name: &dyn Fn(i32) -> Option<MaskName>| {
        let mut areas = BTreeMap::<i32, usize>::new();
        let of_free = source.iter().zip(&level).filter(|(id, now)| **id >= 0 && is_free(**now));
        of_free.for_each(|(&id, _)| *areas.entry(id).or_default() += 1);
        areas.retain(|_, area| *area >= min_area.max(1));
        let id_of: BTreeMap<i32, i32> = areas.into_keys().zip(next..).collect();
        next += id_of.len() as i32;
        for (now, id) in level.iter_mut().zip(source).filter(|(now, _)| is_free(**now)) {
            *now = id_of.get(id).copied().unwrap_or(-1);
        }
        names.extend(id_of.into_iter().filter_map(|(id, new)| Some((new as u32, name(id)?))));
    };
    let named = |id: i32| {
        let segment = &seen.masks[id as usize];
        Some(MaskName { name: segment.name.clone(), score: segment.score })
    };
    paint(artifacts::flat(seen.ids.view()), &|_| true, &named);
    paint(artifacts::flat(large), &|now| now < 0, &|_| None);
    let (height, width) = large.dim();
    let none = Array3::from_elem((LEVELS - maps.levels().len() - 1, height, width), -1);
    let ids = concatenate![Axis(0), maps.ids, level.insert_axis(Axis(0)), none];
    (MaskMaps { ids }, names)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::panoptic::Segment;
    use ndarray::{Array3, arr2};

    #[test]
    fn large_masks_fill_what_no_segment_covers() {
        // At all four levels a mask on the left and one on the right.
        let maps = MaskMaps { ids: Array3::from_shape_fn((4, 2, 6), |(l, _, x)| 2 * l as i32 + i32::from(x >= 3)) };
        let segment = |name: &str, score| Segment { name: name.into(), score };
        let ids = arr2(&[[-1, 0, 0, 0, -1, -1], [-1, 0, 0, 0, 1, -1]]);
        let seen = Segments { ids, masks: vec![segment("door", 0.9), segment("crumb", 0.8)] };
        let (found, names) = with_classes(&maps, &seen, 2);
        assert_eq!(found.levels(), Level::ALL);
        assert_eq!(found.ids.slice(ndarray::s![..4, .., ..]), maps.ids);
        // The crumb is too small; what is left of the large masks is not.
        assert_eq!(found.level(Level::Classes), arr2(&[[9, 8, 8, 8, 10, 10], [9, 8, 8, 8, 10, 10]]));
        assert!(found.level(Level::Concepts).iter().all(|&id| id == -1));
        assert_eq!(names, MaskNames::from([(8, MaskName { name: "door".into(), score: 0.9 })]));
    }
}
