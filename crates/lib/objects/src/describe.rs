//! From instances and Gaussians to [`Scene`].

use crate::relations::relations;
use crate::scene::{BestView, Family, Name, NameSource, Object, Part, Scene};
use crate::up::Up;
use crate::upright::upright_box;
use artifacts::{Instances, Remarks};
use gs_scene::Gaussians;
use std::collections::BTreeMap;

/// Gaussians of less opacity are no surface, so they don't shape a box.
const MIN_OPACITY: f32 = 0.1;

/// Names of objects by id.
pub type Names = BTreeMap<u32, Name>;

/// The Gaussians of every instance, ascending; as many lists as instances.
pub fn members(label: &[i32], instances: usize) -> Vec<Vec<u32>> {
    let mut members = vec![Vec::new(); instances];
    for (i, &label) in label.iter().enumerate() {
        if let Ok(k) = usize::try_from(label) {
            members[k].push(i as u32);
        }
    }
    members
}

/// The objects of a scene and their relations. Instances have the edits applied and one label for each Gaussian; what a
/// person named (`remarks`) goes before the names of `others`. `inputs` are the content hashes of what all
/// of this was read from.
pub fn describe(
    instances: &Instances,
    gaussians: &Gaussians,
    remarks: &Remarks,
    others: &Names,
    up: Option<Up>,
    inputs: BTreeMap<String, String>,
) -> Scene {
    let members = members(&instances.label, instances.len());
    let sizes = instances.cluster_sizes();
    let there: Vec<u32> = (0..instances.len() as u32).filter(|&k| !members[k as usize].is_empty()).collect();
    let centers: Vec<_> = there.iter().map(|&k| solid_centers(gaussians, &members[k as usize])).collect();
    let objects: Vec<Object> = there
        .iter()
        .zip(&centers)
        .map(|(&k, centers)| {
            let own = &members[k as usize];
            let bounds = upright_box(centers, up.map(|u| u.vector()));
            let (parent, parts) = family(instances, &sizes, k);
            Object {
                id: k,
                name: name(remarks, others, k),
                note: remarks.notes.get(&k).cloned(),
                score: instances.score[k as usize],
                gaussians: own.len() as u32,
                parent,
                parts,
                centroid: instances.centroid[k as usize],
                bounds,
                volume: bounds.volume(),
                best_view: best_view(instances, k),
                unseen: None,
            }
        })
        .collect();
    Scene {
        format: Scene::FORMAT.into(),
        version: Scene::VERSION,
        inputs,
        gaussians: gaussians.len() as u32,
        up,
        metres_per_unit: remarks.metres_per_unit,
        shift: Some(gaussians.shift).filter(|s| *s != [0.0; 3]),
        relations: relations(&objects, &centers),
        objects,
    }
}

/// The centres of those Gaussians that are a surface; all of them where none is.
pub fn solid_centers(g: &Gaussians, own: &[u32]) -> Vec<[f32; 3]> {
    let of = |least: f32| -> Vec<[f32; 3]> {
        own.iter().filter(|&&i| g.opacity(i as usize) >= least).map(|&i| g.means[i as usize]).collect()
    };
    Some(of(MIN_OPACITY)).filter(|c| !c.is_empty()).unwrap_or_else(|| of(0.0))
}

fn name(remarks: &Remarks, others: &Names, k: u32) -> Option<Name> {
    let given = remarks.names.get(&k).map(|text| Name { text: text.clone(), from: NameSource::Edits, sure: true });
    given.or_else(|| others.get(&k).cloned())
}

fn family(instances: &Instances, sizes: &BTreeMap<u32, u32>, k: u32) -> (Option<Family>, Vec<Part>) {
    let Some(family) = instances.family(k as usize) else { return (None, Vec::new()) };
    let gaussians = |cluster: u32| sizes.get(&cluster).copied().unwrap_or(0);
    let parent = family.parent.map(|cluster| {
        let mut objects = instances.instances_of_cluster(cluster);
        objects.dedup();
        Family { cluster, gaussians: gaussians(cluster), objects }
    });
    (parent, family.parts.iter().map(|&cluster| Part { cluster, gaussians: gaussians(cluster) }).collect())
}

/// The match with the largest product of score and visible pixels; of equals the first.
fn best_view(instances: &Instances, k: u32) -> Option<BestView> {
    let worth = |m: &artifacts::Match| f64::from(m.score) * f64::from(m.visible);
    let own = instances.matches.iter().filter(|m| m.instance == k);
    let best = own.reduce(|best, m| if worth(m) > worth(best) { m } else { best })?;
    let view = instances.views[best.view as usize].clone();
    Some(BestView { view, mask: best.mask, score: best.score, visible: best.visible })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Relation, RelationKind};
    use crate::testing::boxes;
    use artifacts::{Edit, Edits};

    /// A table top, a mug on it, a lamp beside the mug.
    const TABLE: [([f32; 3], [f32; 3]); 3] =
        [([0.0; 3], [2.0, 1.0, 0.7]), ([0.4, 0.4, 0.7], [0.5, 0.5, 0.8]), ([0.58, 0.4, 0.7], [0.68, 0.5, 0.85])];

    fn of(instances: &Instances, gaussians: &Gaussians, remarks: &Remarks, up: &str) -> Scene {
        let name = |text: &str, from, sure| Name { text: text.into(), from, sure };
        let others =
            Names::from([(0, name("table", NameSource::Query, true)), (1, name("cup", NameSource::Vocabulary, false))]);
        describe(
            instances,
            gaussians,
            remarks,
            &others,
            up.parse().ok(),
            BTreeMap::from([("geometry".into(), "h".into())]),
        )
    }

    #[test]
    fn a_scene_holds_what_is_known_of_each_object() {
        let (instances, gaussians) = boxes(&TABLE);
        let remarks = Remarks {
            names: BTreeMap::from([(1, "red mug".into())]),
            notes: BTreeMap::from([(1, "chipped".into())]),
            metres_per_unit: Some(0.5),
            ..Remarks::default()
        };
        let scene = of(&instances, &gaussians, &remarks, "z");
        let name = |text: &str, from| Some(Name { text: text.into(), from, sure: true });
        let names: Vec<_> = scene.objects.iter().map(|o| o.name.clone()).collect();
        assert_eq!(names, [name("table", NameSource::Query), name("red mug", NameSource::Edits), None]);
        let mug = scene.object(1).unwrap();
        assert_eq!((mug.gaussians, mug.score, mug.id), (729, 0.5, 1));
        assert_eq!((mug.note.as_deref(), &scene.objects[0].note), (Some("chipped"), &None));
        // A hundredth of 729 centres is less than a layer of the grid: the box is that of all.
        assert!((mug.bounds.center[2] - 0.75).abs() < 1e-6 && (mug.volume - 0.001).abs() < 1e-6, "{mug:?}");
        assert_eq!(mug.centroid, instances.centroid[1]);
        let n = gaussians.len() as u32;
        assert_eq!(mug.parent, Some(Family { cluster: n + 1, gaussians: 2 * 729, objects: vec![0, 1] }));
        assert_eq!(scene.object(2).unwrap().parent, None, "below the root");
        let best = BestView { view: "b".into(), mask: 21, score: 0.5, visible: 2.0 };
        assert_eq!(mug.best_view, Some(best));
        assert_eq!((scene.metres_per_unit, scene.gaussians), (Some(0.5), n));
        let says = |subject, relation, object| Relation { subject, relation, object };
        use RelationKind::{NextTo, On};
        assert_eq!(scene.relations, [says(1, On, 0), says(1, NextTo, 2), says(2, On, 0)]);
    }

    #[test]
    fn merged_objects_leave_a_gap_and_nothing_refers_to_it() {
        let (mut instances, gaussians) = boxes(&TABLE);
        let edits = Edits { edits: vec![Edit::Merge { instances: vec![0, 1] }], ..Edits::default() };
        let remarks = edits.apply(&mut instances, &gaussians.means).unwrap();
        let scene = of(&instances, &gaussians, &remarks, "z");
        assert_eq!(scene.objects.iter().map(|o| o.id).collect::<Vec<_>>(), [0, 2]);
        assert!(scene.relations.iter().all(|r| r.subject != 1 && r.object != 1));
        assert_eq!(Scene::parse(&serde_json::to_vec(&scene).unwrap()).unwrap(), scene);
    }

    #[test]
    fn faint_gaussians_and_those_without_up_do_no_harm() {
        let (instances, mut gaussians) = boxes(&TABLE);
        // A tenth of the mug's Gaussians are faint and far away.
        for i in (730..1459).step_by(10) {
            (gaussians.means[i], gaussians.opacity_logits[i]) = ([-40.0; 3], -5.0);
        }
        let scene = of(&instances, &gaussians, &Remarks::default(), "no direction");
        let mug = scene.object(1).unwrap();
        assert!(!mug.bounds.upright && mug.bounds.half_size.iter().all(|h| *h < 0.09), "{mug:?}");
        assert!(scene.up.is_none());
        assert!(scene.relations.iter().all(|r| matches!(r.relation, RelationKind::In | RelationKind::NextTo)));
    }
}
