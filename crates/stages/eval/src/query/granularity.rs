//! A query's answer looked at more coarsely or more finely: the cluster that the found instance is a part of, or the parts
//! that it falls into, by the tree of clusters that the instances were selected from.

use super::ask::{Answered, Asked};
use crate::options::Granularity;
use artifacts::Instances;

/// The answer at a granularity: one, or with parts one for the instance and one for each part. Where the
/// tree has nothing coarser or finer, the answer stays as it is and `say` gets the reason.
pub fn apply(granularity: Granularity, instances: &Instances, asked: Asked, say: &dyn Fn(&str)) -> Vec<Asked> {
    let Some(&best) = asked.answer.selected.first().filter(|_| granularity != Granularity::Instance) else {
        return vec![asked];
    };
    let family = instances.family(best as usize).unwrap_or_default();
    let name = asked.name.clone();
    let nothing = |what: &str| say(&format!("{name:?}: instance {best} has no {what}; it is shown as it is"));
    if granularity == Granularity::Parent {
        let Some(parent) = family.parent else {
            nothing("parent but the whole scene");
            return vec![asked];
        };
        // The best first, as in every answer.
        let mut selected = vec![best];
        selected.extend(instances.instances_of_cluster(parent).into_iter().filter(|&i| i != best));
        let gaussians = instances.gaussians_of_cluster(parent);
        return vec![Asked { answer: Answered { selected, gaussians, ..asked.answer }, ..asked }];
    }
    if family.parts.is_empty() {
        nothing("parts");
    }
    let count = family.parts.len();
    let part = |(at, &cluster): (usize, &u32)| Asked {
        name: format!("{name}, part {} of {count}", at + 1),
        kind: "part",
        answer: Answered {
            ranking: Vec::new(),
            selected: vec![best],
            score: asked.answer.score,
            gaussians: instances.gaussians_of_cluster(cluster),
        },
        place: None,
    };
    let mut parts: Vec<Asked> = family.parts.iter().enumerate().map(part).collect();
    parts.insert(0, asked);
    parts
}

#[cfg(test)]
mod tests {
    use super::*;
    use artifacts::TreeEdge;
    use std::cell::RefCell;

    #[test]
    fn parents_hold_their_children_and_parts_divide_an_instance() {
        let edge = |parent, child, instance| TreeEdge { parent, child, lambda: 1.0, size: 2, instance };
        // 9 is everything; 10 holds the instances 0 (parts 13 and 14) and 1; instance 2 stands alone.
        let tree =
            vec![edge(9, 10, -1), edge(9, 11, 2), edge(10, 12, 0), edge(10, 15, 1), edge(12, 13, -1), edge(12, 14, -1)];
        let instances = Instances { tree, node: vec![13, 14, 14, 12, 15, 11, 10], ..Instances::default() };
        let ask = |granularity: Granularity, instances: &Instances, best: u32, gaussians: &[u32]| {
            let answer =
                Answered { ranking: Vec::new(), selected: vec![best], score: Some(0.5), gaussians: gaussians.to_vec() };
            let said = RefCell::new(String::new());
            let asked = Asked::new("mug".into(), "text", answer);
            let out = apply(granularity, instances, asked, &|s| said.borrow_mut().push_str(s));
            let found: Vec<(String, Vec<u32>, Vec<u32>)> =
                out.into_iter().map(|a| (a.name, a.answer.selected, a.answer.gaussians)).collect();
            (found, said.into_inner())
        };
        let own = |best, gaussians: &[u32]| vec![("mug".to_string(), vec![best], gaussians.to_vec())];
        let silent = String::new();
        assert_eq!(ask(Granularity::Instance, &instances, 0, &[0, 1, 2, 3]), (own(0, &[0, 1, 2, 3]), silent.clone()));
        let (parent, said) = ask(Granularity::Parent, &instances, 1, &[4]);
        assert_eq!((&parent[0].1, &parent[0].2, said), (&vec![1, 0], &vec![0, 1, 2, 3, 4, 6], silent.clone()));
        let (parts, said) = ask(Granularity::Parts, &instances, 0, &[0, 1, 2, 3]);
        assert_eq!((parts.len(), &parts[0], said), (3, &own(0, &[0, 1, 2, 3])[0], silent));
        assert_eq!(parts[1], ("mug, part 1 of 2".into(), vec![0], vec![0]));
        assert_eq!(parts[2], ("mug, part 2 of 2".into(), vec![0], vec![1, 2]));
        let (alone, said) = ask(Granularity::Parent, &instances, 2, &[5]);
        assert!(alone == own(2, &[5]) && said.contains("no parent but the whole scene"), "{said}");
        let (whole, said) = ask(Granularity::Parts, &instances, 1, &[4]);
        assert!(whole == own(1, &[4]) && said.contains("instance 1 has no parts"), "{said}");
    }
}
