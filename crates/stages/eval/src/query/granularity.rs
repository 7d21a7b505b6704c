//! A query's answer looked at more coarsely or more finely: the cluster that the found instance is a part of, or the parts
//! that it falls into, by the tree of clusters that the instances were selected from.

use super::ask::{Answered, Asked, QueryResult};
use crate::options::Granularity;
use artifacts::Instances;

/// The answer at a granularity: one, or with parts one for the instance and one for each part. Where the
/// tree has nothing coarser or finer, the answer stays as it is and `say` gets the reason.
pub fn apply(granularity: Granularity, instances: &Instances, asked: Asked, say: &dyn Fn(&str)) -> Vec<Asked> {
    let Some(&best) =
        asked.result.selected.first().filter(|_| [Granularity::Parent, Granularity::Parts].contains(&granularity))
    else {
        return vec![asked];
    };
    let family = instances.family(best as usize).unwrap_or_default();
    let name = asked.result.text.clone();
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
        let result = QueryResult { selected, gaussians: gaussians.len(), ..asked.result };
        return vec![Asked { result, gaussians }];
    }
    if family.parts.is_empty() {
        nothing("parts");
    }
    let count = family.parts.len();
    let part = |(at, &cluster): (usize, &u32)| {
        let gaussians = instances.gaussians_of_cluster(cluster);
        let (selected, score) = (vec![best], asked.result.score);
        let answer = Answered { selected, score, gaussians, ..Answered::default() };
        Asked::new(format!("{name}, part {} of {count}", at + 1), "part", None, answer)
    };
    let mut parts: Vec<Asked> = family.parts.iter().enumerate().map(part).collect();
    parts.insert(0, asked);
    parts
}
