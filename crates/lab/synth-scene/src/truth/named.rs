//! What can be asked of a scene by name: its things, their parts, groups of two that stand together, all of a class, and what is
//! not there.

use crate::scene::{Scene, Thing};
use crate::things::catalogue::{CLASSES, PROPS};
use crate::truth::masks::nearest;
use std::collections::{BTreeMap, BTreeSet};

/// Something with a name.
#[derive(Debug, Clone, PartialEq)]
pub struct Named {
    /// What it is called; unique in the scene.
    pub name: String,
    /// Its number among its like.
    pub id: usize,
    /// The parts that it consists of, as positions in [`Scene::parts`]; none of what is not there.
    pub parts: Vec<u32>,
}

/// All things but background, numbered as in the scene.
pub fn things(scene: &Scene) -> Vec<Named> {
    let objects = scene.things.iter().enumerate().filter(|(_, t)| !t.background);
    objects.map(|(id, t)| Named { name: t.name.clone(), id, parts: t.parts.clone().collect() }).collect()
}

/// The parts of things, such as "handle of the red mug"; those of one name are one. A thing of one name of part has none.
pub fn parts(scene: &Scene) -> Vec<Named> {
    let mut out = Vec::new();
    for t in scene.things.iter().filter(|t| !t.background) {
        let mut by_name: BTreeMap<&str, Vec<u32>> = BTreeMap::new();
        t.parts.clone().for_each(|p| by_name.entry(scene.parts[p as usize].name).or_default().push(p));
        if by_name.len() > 1 {
            for (name, parts) in by_name {
                out.push(Named { name: format!("{name} of the {}", t.name), id: out.len(), parts });
            }
        }
    }
    out
}

/// Every thing with the one that is nearest to it on the same ground, if one is near: "red mug and blue bowl".
pub fn groups(scene: &Scene) -> Vec<Named> {
    let free = vec![false; scene.things.len()];
    let pair = |t: usize| nearest(scene, t, &free).map(|other| (t.min(other), t.max(other)));
    let pairs: BTreeSet<(usize, usize)> = (0..scene.things.len()).filter_map(pair).collect();
    let both = |(id, (a, b)): (usize, (usize, usize))| {
        let (a, b) = (&scene.things[a], &scene.things[b]);
        Named {
            name: format!("{} and {}", a.name, b.name),
            id,
            parts: a.parts.clone().chain(b.parts.clone()).collect(),
        }
    };
    pairs.into_iter().enumerate().map(both).collect()
}

/// Classes of which there are several: "plate" means all plates.
pub fn several(scene: &Scene) -> Vec<Named> {
    let mut by_class: BTreeMap<&str, Vec<&Thing>> = BTreeMap::new();
    scene.things.iter().filter(|t| !t.background).for_each(|t| by_class.entry(t.class).or_default().push(t));
    let all = by_class.into_iter().filter(|(_, things)| things.len() > 1).enumerate();
    let named = |(id, (class, things)): (usize, (&str, Vec<&Thing>))| Named {
        name: class.into(),
        id,
        parts: things.iter().flat_map(|t| t.parts.clone()).collect(),
    };
    all.map(named).collect()
}

/// Classes of the catalogue that are not there, nor anything that shares a word with them: where there is a row of books, a
/// book is not absent.
pub fn absent(scene: &Scene) -> Vec<Named> {
    let words = |text: &'static str| text.split(' ').filter(|w| w.len() > 2).map(|w| w.trim_end_matches('s'));
    let there: BTreeSet<&str> = scene.classes().into_iter().flat_map(words).collect();
    let gone = CLASSES.iter().chain(PROPS).map(|c| c.name).filter(|name| words(name).all(|w| !there.contains(w)));
    gone.enumerate().map(|(id, name)| Named { name: name.into(), id, parts: Vec::new() }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::example;

    #[test]
    fn names_are_unique_and_parts_are_of_their_thing() {
        let (scene, _) = example();
        let (things, parts, groups) = (things(scene), parts(scene), groups(scene));
        let all: Vec<&Named> = things.iter().chain(&parts).chain(&groups).collect();
        let names: BTreeSet<&str> = all.iter().map(|n| n.name.as_str()).collect();
        assert_eq!(names.len(), all.len());
        assert!(things.len() >= 6 && parts.len() > things.len(), "{} {}", things.len(), parts.len());
        for part in &parts {
            let of: BTreeSet<u32> = part.parts.iter().map(|&p| scene.parts[p as usize].thing).collect();
            let whole = &scene.things[*of.first().unwrap() as usize];
            assert!(of.len() == 1 && part.parts.len() < whole.parts.len(), "{}", part.name);
            assert!(part.name.ends_with(&format!(" of the {}", whole.name)), "{}", part.name);
        }
        let (several, absent) = (several(scene), absent(scene));
        for of in &several {
            let things = scene.things.iter().filter(|t| t.class == of.name);
            assert!(things.clone().count() > 1 && of.parts.len() == things.map(|t| t.parts.len()).sum::<usize>());
        }
        assert!(absent.len() > 10 && absent.iter().all(|a| a.parts.is_empty()));
        assert!(absent.iter().all(|a| scene.things.iter().all(|t| t.class != a.name)));
        for group in &groups {
            let of: BTreeSet<u32> = group.parts.iter().map(|&p| scene.parts[p as usize].thing).collect();
            assert!(of.len() == 2 && !of.iter().any(|&t| scene.things[t as usize].background), "{}", group.name);
        }
    }
}
