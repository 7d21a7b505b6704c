//! Id maps as a segmentation model would give them: masks of things at four levels, with the faults of real ones.
//!
//! Without faults, levels `default` and `large` show every thing whole, `medium` shows parts with same-named parts of
//! a thing together ("cookies"), and `small` shows every part by itself. Six faults, each with its own option:
//! * granularity: with probability p a thing is shown otherwise in a view and level. On `default` and `large` it is
//!   then, with equal chance, split into its parts or merged with its nearest free neighbour on the same ground; on
//!   `small` and `medium` it is shown whole, or two of its parts become one. A thing without such a choice (one part,
//!   no neighbour) stays as it is, and background is never merged;
//! * torn masks: what lies apart in the image has masks of its own;
//! * swallowed masks: what touches another mask is in it, most often the same pairs (regions.rs);
//! * boundaries: each mask shrinks or grows by up to so many pixels; masks painted later win;
//! * missing masks;
//! * spurious masks: patches that are no thing, such as a highlight, a shadow or half of a wall.

use crate::render::Frame;
use crate::scene::Scene;
use crate::truth::regions::{Pairs, Regions, neighbours};
use artifacts::{Level, MaskMaps, MaskTruth};
use glam::DVec2;
use ndarray::Array3;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;
use std::collections::BTreeMap;
use std::f64::consts::{PI, TAU};

/// How strong each fault is.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Faults {
    /// Probability that a thing is shown at another granularity than the level's, 0 to 1.
    #[serde(rename = "granularity_p")]
    pub granularity: f64,
    /// Largest growth or shrinkage of a mask in pixels.
    #[serde(rename = "boundary_noise")]
    pub boundary: u32,
    /// Probability that a mask is missing, 0 to 1.
    pub missing: f64,
    /// Spurious masks per mask of a level, 0 to 1.
    pub spurious: f64,
    /// Probability that what lies apart in the image has masks of its own at level `small`, 0 to 1.
    #[serde(skip_serializing_if = "none")]
    pub torn: f64,
    /// Probability that of two objects that touch one is swallowed at level `large`, where it covers a hundredth of the
    /// image, 0 to 1.
    #[serde(skip_serializing_if = "none")]
    pub swallow: f64,
}

/// Scenes without a fault are written as if there were none of its kind.
fn none(p: &f64) -> bool {
    *p == 0.0
}

/// Masks of fewer pixels are not given, as segmentation models drop them.
const SMALLEST: usize = 16;
/// How far a neighbour to merge with may stand away, in metres between footprints' bounding circles.
const NEIGHBOUR: f64 = 0.45;

/// Share of the image that the smallest and the largest spurious mask cover.
const PATCH: [f64; 2] = [0.0008, 0.02];
/// A spurious mask is a patch of the things that own at least this share of it.
const PATCH_OF: f64 = 0.1;

const WHOLE: &str = "whole";
const PART: &str = "part";
const MERGED: &str = "merged";

/// Id maps of one view and what each id shows, in the order of ids. Every id owns pixels. `patches` draws the spurious
/// masks and `pairs` what is torn and swallowed, so that they do not change the others.
pub(crate) fn segment(
    scene: &Scene,
    frame: &Frame,
    faults: &Faults,
    rng: &mut ChaCha8Rng,
    patches: &mut ChaCha8Rng,
    pairs: &Pairs,
) -> (MaskMaps, Vec<MaskTruth>) {
    let (mut ids, mut truth) = (Vec::new(), Vec::new());
    let mut visible = vec![0usize; scene.parts.len()];
    for &p in frame.part.iter().filter(|&&p| p >= 0) {
        visible[p as usize] += 1;
    }
    for level in Level::SAM {
        let mut regions = Regions::new(scene, frame, shown(scene, &visible, level, faults.granularity, rng));
        if faults.torn > 0.0 {
            regions.tear(frame, level, faults.torn, pairs);
        }
        if faults.swallow > 0.0 {
            regions.swallow(scene, frame, level, faults.swallow, pairs);
        }
        let areas = regions.areas();
        // A level of a real file is never empty: the largest mask stays.
        let largest = (0..areas.len()).max_by_key(|&i| (areas[i], i));
        let mut kept = Vec::new();
        let mut position = vec![-1; areas.len()];
        for (i, parts) in regions.parts.iter().enumerate() {
            // Draw for every mask, so that one mask's fate does not change the others'.
            let lost = rng.random::<f64>() < faults.missing;
            if areas[i] >= SMALLEST && (!lost || Some(i) == largest) {
                position[i] = kept.len() as i32;
                kept.push(describe(scene, &visible, parts, areas[i], level));
            }
        }
        regions.map.iter_mut().filter(|i| **i >= 0).for_each(|i| *i = position[*i as usize]);
        let mut painted = paint(frame, regions.map, kept.len(), faults.boundary, rng);
        for _ in 0..kept.len() {
            if patches.random::<f64>() < faults.spurious {
                let pixels = patch(frame, patches);
                let things = pixels.iter().map(|&at| frame.thing[at]).filter(|&t| t >= 0);
                if pixels.len() >= SMALLEST {
                    kept.push(describe_patch(scene, things, level));
                    pixels.into_iter().for_each(|at| painted[at] = kept.len() as i32 - 1);
                }
            }
        }
        let owned = compact(&painted, kept.len(), truth.len() as i32, &mut ids);
        truth.extend(kept.into_iter().zip(owned).filter(|(_, owned)| *owned).map(|(t, _)| t));
    }
    let ids = Array3::from_shape_vec((Level::SAM.len(), frame.height, frame.width), ids).expect("an id of each pixel");
    (MaskMaps { ids }, truth)
}

/// The masks of a level as sets of parts. Only visible parts count.
fn shown(scene: &Scene, visible: &[usize], level: Level, p: f64, rng: &mut ChaCha8Rng) -> Vec<Vec<u32>> {
    let parts_of =
        |t: usize| -> Vec<u32> { scene.things[t].parts.clone().filter(|&p| visible[p as usize] > 0).collect() };
    let coarse = matches!(level, Level::DEFAULT | Level::LARGE);
    // Draw for every thing of the scene, seen or not: what a thing shows does not depend on the others.
    let draws: Vec<(bool, bool, f64)> =
        scene.things.iter().map(|_| (rng.random::<f64>() < p, rng.random::<bool>(), rng.random())).collect();
    let mut taken: Vec<bool> = (0..scene.things.len()).map(|t| parts_of(t).is_empty()).collect();
    let mut out = Vec::new();
    if coarse {
        for t in 0..scene.things.len() {
            if taken[t] || !draws[t].0 || !draws[t].1 {
                continue;
            }
            if let Some(other) = nearest(scene, t, &taken) {
                (taken[t], taken[other]) = (true, true);
                let (a, b) = (t.min(other), t.max(other));
                out.push([parts_of(a), parts_of(b)].concat());
            }
        }
    }
    for t in (0..scene.things.len()).filter(|&t| !taken[t]) {
        let (odd, first_way, which) = draws[t];
        let parts = parts_of(t);
        let mut groups: BTreeMap<(&str, u32), Vec<u32>> = BTreeMap::new();
        for &part in &parts {
            let key = if level == Level::MEDIUM { 0 } else { part };
            groups.entry((scene.parts[part as usize].name, key)).or_default().push(part);
        }
        let mut masks: Vec<Vec<u32>> = groups.into_values().collect();
        masks.sort();
        let whole = if coarse { !odd || first_way } else { odd && (first_way || masks.len() <= 2) };
        if whole || masks.len() == 1 {
            masks = vec![parts];
        } else if odd && !coarse {
            let at = (which * (masks.len() - 1) as f64) as usize;
            let joined = masks.remove(at + 1);
            masks[at].extend(joined);
        }
        out.extend(masks);
    }
    out
}

/// The nearest free object on the same ground, if one is near.
pub(crate) fn nearest(scene: &Scene, t: usize, taken: &[bool]) -> Option<usize> {
    let a = &scene.things[t];
    if a.background {
        return None;
    }
    let gap = |b: &crate::scene::Thing| {
        (a.position - b.position).truncate().length() - a.footprint.max_element() - b.footprint.max_element()
    };
    (0..scene.things.len())
        .filter(|&o| o != t && !taken[o] && !scene.things[o].background)
        .map(|o| (gap(&scene.things[o]), o))
        .filter(|&(g, o)| g < NEIGHBOUR && (scene.things[o].position.z - a.position.z).abs() < 1e-9)
        .min_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)))
        .map(|(_, o)| o)
}

/// What a mask of these parts and so many pixels shows, of the `visible` pixels of each part.
fn describe(scene: &Scene, visible: &[usize], parts: &[u32], pixels: usize, level: Level) -> MaskTruth {
    let mut instances: Vec<u32> = parts.iter().map(|&p| scene.parts[p as usize].thing).collect();
    instances.sort_unstable();
    instances.dedup();
    let all = |t: &u32| scene.things[*t as usize].parts.clone().map(|p| visible[p as usize]).sum::<usize>();
    let kind = match &instances[..] {
        [only] if pixels < all(only) => PART,
        [_] => WHOLE,
        _ => MERGED,
    };
    let name = |t: &u32| scene.things[*t as usize].name.clone();
    let caption = match kind {
        WHOLE | MERGED => instances.iter().map(name).collect::<Vec<_>>().join(" and "),
        _ => {
            let mut names: Vec<String> = Vec::new();
            for &p in parts {
                let part = scene.parts[p as usize].name;
                let count = parts.iter().filter(|&&q| scene.parts[q as usize].name == part).count();
                // "cookies", not "cookie and cookie"; names such as "legs" are plural already.
                let word = if count > 1 { format!("{part}s") } else { part.to_string() };
                if !names.contains(&word) {
                    names.push(word);
                }
            }
            let thing = &scene.things[instances[0] as usize];
            match &names[..] {
                // Not "wall of the white wall".
                [only] if only == thing.class => thing.name.clone(),
                _ => format!("{} of the {}", names.join(" and "), thing.name),
            }
        }
    };
    MaskTruth {
        level: level.index() as u32,
        part: (kind == PART && parts.len() == 1).then(|| parts[0]),
        instances,
        kind: kind.into(),
        caption,
    }
}

/// Pixels of an ellipse anywhere in the image.
fn patch(frame: &Frame, rng: &mut ChaCha8Rng) -> Vec<usize> {
    let (w, h) = (frame.width as f64, frame.height as f64);
    let centre = DVec2::new(rng.random::<f64>() * w, rng.random::<f64>() * h);
    // Small patches are the most frequent: the logarithm of the area is uniform.
    let area = w * h * PATCH[0] * (PATCH[1] / PATCH[0]).powf(rng.random());
    let aspect = 0.4 + 0.6 * rng.random::<f64>();
    let axis = DVec2::from_angle(rng.random::<f64>() * TAU);
    let radius = (area / (PI * aspect)).sqrt();
    let reach = radius.ceil();
    let span = |at: f64, size: usize| (at - reach).max(0.0) as usize..((at + reach + 1.0) as usize).min(size);
    let mut pixels = Vec::new();
    for y in span(centre.y, frame.height) {
        for x in span(centre.x, frame.width) {
            let d = DVec2::new(x as f64 + 0.5, y as f64 + 0.5) - centre;
            if DVec2::new(d.dot(axis), d.perp_dot(axis) / aspect).length() < radius {
                pixels.push(y * frame.width + x);
            }
        }
    }
    pixels
}

fn describe_patch(scene: &Scene, things: impl Iterator<Item = i32>, level: Level) -> MaskTruth {
    let mut counts = BTreeMap::<u32, usize>::new();
    things.for_each(|t| *counts.entry(t as u32).or_default() += 1);
    let least = PATCH_OF * counts.values().sum::<usize>() as f64;
    let instances: Vec<u32> = counts.into_iter().filter(|&(_, n)| n as f64 >= least).map(|(t, _)| t).collect();
    let names: Vec<String> = instances.iter().map(|&t| format!("the {}", scene.things[t as usize].name)).collect();
    let caption = format!("patch of {}", names.join(" and "));
    MaskTruth { level: level.index() as u32, instances, part: None, kind: "spurious".into(), caption }
}

/// Paints so many masks in their order, each grown or shrunk; `exact` and the result hold their numbers, -1 for none.
fn paint(frame: &Frame, exact: Vec<i32>, masks: usize, boundary: u32, rng: &mut ChaCha8Rng) -> Vec<i32> {
    if boundary == 0 {
        return exact;
    }
    let mut out = vec![-1; exact.len()];
    let mut pixels: Vec<Vec<usize>> = vec![Vec::new(); masks];
    for (at, &id) in exact.iter().enumerate().filter(|(_, id)| **id >= 0) {
        pixels[id as usize].push(at);
    }
    for (id, mut mask) in pixels.into_iter().enumerate() {
        let change = rng.random_range(-(boundary as i64)..=boundary as i64);
        if change < 0 {
            let whole = mask.clone();
            for _ in 0..-change {
                mask = eroded(&mask, frame.width, frame.height);
            }
            // What is only a few pixels wide does not vanish.
            if mask.len() < SMALLEST {
                mask = whole;
            }
        }
        for _ in 0..change {
            mask = dilated(&mask, frame.width, frame.height);
        }
        for at in mask {
            out[at] = id as i32;
        }
    }
    out
}

/// Pixels all of whose four neighbours are in the mask too; beyond the image counts as within. `mask` ascends.
fn eroded(mask: &[usize], width: usize, height: usize) -> Vec<usize> {
    mask.iter().copied().filter(|&at| neighbours(at, width, height).all(|n| mask.binary_search(&n).is_ok())).collect()
}

/// The mask with all four neighbours of its pixels, ascending.
fn dilated(mask: &[usize], width: usize, height: usize) -> Vec<usize> {
    let mut all: Vec<usize> = mask.iter().flat_map(|&at| neighbours(at, width, height).chain([at])).collect();
    all.sort_unstable();
    all.dedup();
    all
}

/// Appends a level with ids from `first` on, skipping masks that own no pixel; says which own some.
fn compact(painted: &[i32], masks: usize, first: i32, ids: &mut Vec<i32>) -> Vec<bool> {
    let mut owned = vec![false; masks];
    for &m in painted.iter().filter(|&&m| m >= 0) {
        owned[m as usize] = true;
    }
    let new: Vec<i32> = owned
        .iter()
        .scan(first - 1, |id, &o| {
            *id += i32::from(o);
            Some(*id)
        })
        .collect();
    ids.extend(painted.iter().map(|&m| if m < 0 { -1 } else { new[m as usize] }));
    owned
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::example;
    use artifacts::flat;
    use proptest::prelude::*;
    use rand::SeedableRng;

    const EXACT: Faults =
        Faults { granularity: 0.0, boundary: 0, missing: 0.0, spurious: 0.0, torn: 0.0, swallow: 0.0 };

    fn rng() -> ChaCha8Rng {
        ChaCha8Rng::seed_from_u64(11)
    }

    fn pairs() -> Pairs {
        Pairs { rng: rng(), first: 0, view: 0 }
    }

    /// Ids count on from level to level, each owns pixels and has its truth at its position.
    fn check_ids(maps: &MaskMaps, truth: &[MaskTruth]) {
        assert_eq!(maps.id_count(), truth.len());
        for level in Level::SAM {
            let map = flat(maps.level(level));
            for (id, t) in truth.iter().enumerate() {
                assert_eq!(map.contains(&(id as i32)), t.level == level.index() as u32, "{id} {t:?}");
            }
            assert!(map.iter().any(|&id| id >= 0), "a level is never empty");
        }
    }

    #[test]
    fn without_faults_large_masks_are_things_and_small_masks_are_parts() {
        let (scene, frame) = example();
        let (maps, truth) = segment(scene, frame, &EXACT, &mut rng(), &mut rng(), &pairs());
        check_ids(&maps, &truth);
        for (at, &thing) in frame.thing.iter().enumerate() {
            for level in [Level::DEFAULT, Level::LARGE] {
                let id = flat(maps.level(level))[at];
                if id >= 0 {
                    assert_eq!(truth[id as usize].instances, [thing as u32]);
                    assert_eq!(truth[id as usize].caption, scene.things[thing as usize].name);
                } else {
                    assert!(frame.thing.iter().filter(|&&t| t == thing).count() < SMALLEST);
                }
            }
            let id = flat(maps.level(Level::SMALL))[at];
            if id >= 0 {
                let t = &truth[id as usize];
                assert!(t.kind == "whole" || t.part == Some(frame.part[at] as u32));
            }
        }
    }

    #[test]
    fn granularity_alone_changes_what_masks_show_but_no_boundary_of_parts() {
        let (scene, frame) = example();
        let (maps, truth) =
            segment(scene, frame, &Faults { granularity: 1.0, ..EXACT }, &mut rng(), &mut rng(), &pairs());
        check_ids(&maps, &truth);
        let large: Vec<&MaskTruth> = truth.iter().filter(|t| t.level == 3).collect();
        assert!(large.iter().any(|t| t.kind == "merged" && t.instances.len() == 2 && t.caption.contains(" and ")));
        assert!(large.iter().any(|t| t.kind == "part" && t.caption.contains(" of the ")));
        assert!(truth.iter().any(|t| t.level == 1 && t.kind == "whole"));
        // A part is never cut: its pixels all have one id.
        for level in Level::SAM {
            let mut id_of = BTreeMap::new();
            for (at, &part) in frame.part.iter().enumerate() {
                let id = flat(maps.level(level))[at];
                assert_eq!(*id_of.entry(part).or_insert(id), id);
            }
        }
    }

    #[test]
    fn boundary_alone_moves_edges_by_a_few_pixels() {
        let (scene, frame) = example();
        let (exact, _) = segment(scene, frame, &EXACT, &mut rng(), &mut rng(), &pairs());
        let (moved, truth) = segment(scene, frame, &Faults { boundary: 2, ..EXACT }, &mut rng(), &mut rng(), &pairs());
        check_ids(&moved, &truth);
        let changed = exact.ids.iter().zip(&moved.ids).filter(|(a, b)| a != b).count();
        assert!(changed > 100 && changed < exact.ids.len() / 5, "{changed} of {}", exact.ids.len());
        for (at, &id) in moved.level(Level::LARGE).iter().enumerate().filter(|(_, id)| **id >= 0) {
            let thing = truth[id as usize].instances[0] as i32;
            let two = dilated(&dilated(&[at], frame.width, frame.height), frame.width, frame.height);
            let near = two.iter().any(|&n| frame.thing[n] == thing);
            assert!(near, "no further than two pixels");
        }
    }

    #[test]
    fn missing_alone_drops_whole_masks() {
        let (scene, frame) = example();
        let (_, all) = segment(scene, frame, &EXACT, &mut rng(), &mut rng(), &pairs());
        let (maps, half) = segment(scene, frame, &Faults { missing: 0.5, ..EXACT }, &mut rng(), &mut rng(), &pairs());
        check_ids(&maps, &half);
        assert!(half.len() > all.len() / 4 && half.len() < 3 * all.len() / 4, "{} of {}", half.len(), all.len());
        assert!(half.iter().all(|t| all.contains(t)));
        let (maps, none) = segment(scene, frame, &Faults { missing: 1.0, ..EXACT }, &mut rng(), &mut rng(), &pairs());
        check_ids(&maps, &none);
        assert_eq!(none.len(), 4, "the largest of each level stays");
    }

    #[test]
    fn spurious_alone_paints_patches_over_untouched_masks() {
        let (scene, frame) = example();
        let with = |spurious| segment(scene, frame, &Faults { spurious, ..EXACT }, &mut rng(), &mut rng(), &pairs());
        let (exact, all) = with(0.0);
        for p in [0.3, 1.0] {
            let (maps, truth) = with(p);
            check_ids(&maps, &truth);
            let patches = truth.iter().filter(|t| t.kind == "spurious").count();
            let share = patches as f64 / all.len() as f64;
            assert!((share - p).abs() < 0.15, "{share} of {p}");
            for (&id, &before) in maps.ids.iter().zip(&exact.ids) {
                let shown = &truth[id.max(0) as usize];
                if id >= 0 && shown.kind != "spurious" {
                    assert_eq!(shown, &all[before as usize], "what is not covered stays");
                } else if id < 0 {
                    assert_eq!(before, -1);
                }
            }
            let patch = truth.iter().find(|t| t.kind == "spurious").unwrap();
            assert!(!patch.instances.is_empty() && patch.caption.starts_with("patch of the "), "{patch:?}");
        }
    }

    #[test]
    fn torn_alone_gives_connected_masks_of_the_same_things() {
        let (scene, frame) = example();
        let with = |torn| segment(scene, frame, &Faults { torn, ..EXACT }, &mut rng(), &mut rng(), &pairs());
        let ((exact, all), (maps, truth)) = (with(0.0), with(1.0));
        check_ids(&maps, &truth);
        assert!(truth.len() > all.len());
        let mut from = BTreeMap::new();
        for (&old, &new) in exact.level(Level::SMALL).iter().zip(maps.level(Level::SMALL)) {
            assert_eq!(old < 0, new < 0);
            assert_eq!(*from.entry(new).or_insert(old), old, "a piece is of one mask");
        }
    }

    #[test]
    fn swallow_alone_joins_masks_that_touch_and_most_often_the_same() {
        let (scene, frame) = example();
        let shown = |swallow, view| {
            let pairs = Pairs { view, ..pairs() };
            segment(scene, frame, &Faults { swallow, ..EXACT }, &mut rng(), &mut rng(), &pairs)
        };
        let (exact, all) = shown(0.0, 0);
        let pair_of = |view| -> Vec<Vec<u32>> {
            let (maps, truth) = shown(0.35, view);
            check_ids(&maps, &truth);
            assert!(truth.len() < all.len());
            for level in Level::SAM {
                let mut into = BTreeMap::new();
                for (&old, &new) in exact.level(level).iter().zip(maps.level(level)).filter(|(old, _)| **old >= 0) {
                    assert_eq!(*into.entry(old).or_insert(new), new, "a mask is swallowed whole");
                }
            }
            truth.into_iter().filter(|t| t.level == 3 && t.kind == "merged").map(|t| t.instances).collect()
        };
        let first = pair_of(0);
        assert!(!first.is_empty());
        let again = (1..=10).filter(|&view| first.iter().any(|pair| pair_of(view).contains(pair))).count();
        assert!(again >= 5, "{again} of 10 views swallow as the first does");
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]
        /// Whatever the faults, ids are dense, each has pixels and its truth, and what a mask says it shows is in it.
        #[test]
        fn any_faults_together_give_sound_maps(
            granularity in 0.0..=1.0, boundary in 0u32..4, missing in 0.0..=1.0, spurious in 0.0..=1.0,
            torn in 0.0..=1.0, swallow in 0.0..=1.0, seed: u64,
        ) {
            let (scene, frame) = example();
            let faults = Faults { granularity, boundary, missing, spurious, torn, swallow };
            let (a, b) = (&mut ChaCha8Rng::seed_from_u64(seed), &mut ChaCha8Rng::seed_from_u64(!seed));
            let (maps, truth) = segment(scene, frame, &faults, a, b, &Pairs { rng: ChaCha8Rng::seed_from_u64(seed), ..pairs() });
            check_ids(&maps, &truth);
            for t in &truth {
                prop_assert!(!t.instances.is_empty() && t.instances.iter().all(|&i| (i as usize) < scene.things.len()));
                prop_assert_eq!(t.kind == "merged", t.kind != "spurious" && t.instances.len() > 1);
            }
            // Exact edges: every pixel of a mask that is not spurious shows one of its things.
            if boundary == 0 {
                for level in Level::SAM {
                    for (&id, &thing) in maps.level(level).iter().zip(&frame.thing).filter(|(id, _)| **id >= 0) {
                        let t = &truth[id as usize];
                        prop_assert!(t.kind == "spurious" || t.instances.contains(&(thing as u32)));
                    }
                }
            }
        }
    }
}
