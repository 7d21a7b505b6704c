//! Levels of an id map whose masks have names: classes, what a panoptic model sees, and concepts, what a model finds that is asked for
//! nouns.

use crate::panoptic::Segments;
use artifacts::{Level, LevelKind, MaskMaps, MaskName, MaskNames};
use ndarray::{Array3, ArrayViewMut2, Axis, s};
use std::collections::BTreeMap;

/// Adds the levels of masks with names to SAM's, one for each of `classes` and `concepts`, and gives the names: segments of at least
/// `min_area` pixels. A level of classes has the large masks too where none of its own is, without a name: a thing of no known class is
/// better seen by SAM than not at all (docs/results/real-masks.md). What was seen has the maps' size; a level of nothing is empty.
pub fn with_names(
    maps: &MaskMaps,
    classes: &[Segments],
    concepts: &[Segments],
    min_area: usize,
) -> (MaskMaps, MaskNames) {
    let large = maps.level(Level::LARGE);
    let (mut names, mut next) = (MaskNames::new(), maps.id_count() as i32);
    // Paints what is large enough of the free pixels' part of each mask.
    let mut paint = |level: &mut ArrayViewMut2<'_, i32>, source: &[i32], segments: Option<&Segments>| {
        let mut areas = BTreeMap::<i32, usize>::new();
        let of_free = source.iter().zip(&*level).filter(|(id, now)| **id >= 0 && **now < 0);
        of_free.for_each(|(&id, _)| *areas.entry(id).or_default() += 1);
        areas.retain(|_, area| *area >= min_area.max(1));
        let id_of: BTreeMap<i32, i32> = areas.into_keys().zip(next..).collect();
        next += id_of.len() as i32;
        for (now, id) in level.iter_mut().zip(source).filter(|(now, _)| **now < 0) {
            *now = id_of.get(id).copied().unwrap_or(-1);
        }
        let named = |segments: &Segments, id: i32| {
            let segment = &segments.masks[id as usize];
            MaskName { name: segment.name.clone(), score: segment.score }
        };
        names.extend(id_of.into_iter().filter_map(|(id, new)| Some((new as u32, named(segments?, id)))));
    };
    let named = &Level::ALL[Level::SAM.len()..][..2 * classes.len().max(concepts.len())];
    let mut all = Array3::from_elem((Level::SAM.len() + named.len(), maps.height(), maps.width()), -1);
    all.slice_mut(s![..Level::SAM.len(), .., ..]).assign(&maps.ids);
    for (at, level) in named.iter().enumerate() {
        let of_kind = if level.kind() == LevelKind::Classes { classes } else { concepts };
        let Some(seen) = of_kind.get(at / 2) else { continue };
        let mut map = all.index_axis_mut(Axis(0), level.index());
        paint(&mut map, artifacts::flat(seen.ids.view()), Some(seen));
        if level.kind() == LevelKind::Classes {
            paint(&mut map, artifacts::flat(large), None);
        }
    }
    (MaskMaps { ids: all }, names)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::panoptic::Segment;
    use ndarray::arr2;

    #[test]
    fn large_masks_fill_what_no_segment_covers() {
        // At all four levels a mask on the left and one on the right.
        let maps = MaskMaps { ids: Array3::from_shape_fn((4, 2, 6), |(l, _, x)| 2 * l as i32 + i32::from(x >= 3)) };
        let segment = |name: &str, score| Segment { name: name.into(), score };
        let ids = arr2(&[[-1, 0, 0, 0, -1, -1], [-1, 0, 0, 0, 1, -1]]);
        let seen = Segments { ids, masks: vec![segment("door", 0.9), segment("crumb", 0.8)] };
        let (found, names) = with_names(&maps, std::slice::from_ref(&seen), &[], 2);
        assert_eq!(found.levels(), &Level::ALL[..6]);
        assert_eq!(found.ids.slice(ndarray::s![..4, .., ..]), maps.ids);
        // The crumb is too small; what is left of the large masks is not.
        assert_eq!(found.level(Level::CLASSES), arr2(&[[9, 8, 8, 8, 10, 10], [9, 8, 8, 8, 10, 10]]));
        assert!(found.level(Level::CONCEPTS).iter().all(|&id| id == -1));
        let door = |id| (id, MaskName { name: "door".into(), score: 0.9 });
        assert_eq!(names, MaskNames::from([door(8)]));
        // Of nouns alone: classes stays empty, as where there is no such level.
        let (asked, names) = with_names(&maps, &[], std::slice::from_ref(&seen), 2);
        assert!(asked.level(Level::CLASSES).iter().all(|&id| id == -1));
        assert_eq!(asked.level(Level::CONCEPTS), arr2(&[[-1, 8, 8, 8, -1, -1]; 2]));
        assert_eq!(names, MaskNames::from([door(8)]));
        let (both, names) = with_names(&maps, std::slice::from_ref(&seen), std::slice::from_ref(&seen), 2);
        assert_eq!(both.level(Level::CLASSES), found.level(Level::CLASSES));
        assert_eq!(both.level(Level::CONCEPTS), arr2(&[[-1, 11, 11, 11, -1, -1]; 2]));
        assert_eq!(names, MaskNames::from([door(8), door(11)]));
        // A second panoptic model has a level of its own, and so would a second model for nouns.
        let (two, names) = with_names(&maps, &[seen.clone(), seen.clone()], &[seen], 2);
        assert_eq!(two.levels(), &Level::ALL[..8]);
        assert_eq!(two.ids.slice(ndarray::s![..6, .., ..]), both.ids);
        assert_eq!(two.level("classes-2".parse().unwrap()), found.level(Level::CLASSES).mapv(|id| id + 4));
        assert!(two.level("concepts-2".parse().unwrap()).iter().all(|&id| id == -1));
        assert_eq!(names, MaskNames::from([door(8), door(11), door(12)]));
    }
}
