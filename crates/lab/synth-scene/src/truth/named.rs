//! What can be asked of a scene by name: its things, their parts, and groups of two that stand together.

use crate::scene::Scene;
use crate::truth::masks::nearest;
use std::collections::{BTreeMap, BTreeSet};

/// Something with a name.
#[derive(Debug, Clone, PartialEq)]
pub struct Named {
    /// What it is called; unique in the scene.
    pub name: String,
    /// Its number among its like.
    pub id: usize,
    /// The parts that it consists of, as positions in [`Scene::parts`].
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
        for group in &groups {
            let of: BTreeSet<u32> = group.parts.iter().map(|&p| scene.parts[p as usize].thing).collect();
            assert!(of.len() == 2 && !of.iter().any(|&t| scene.things[t as usize].background), "{}", group.name);
        }
    }
}
