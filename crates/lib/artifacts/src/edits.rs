//! `instances.edits.json`: what a person changed of the instances.

use crate::extents::Extents;
use crate::instances::{Instances, Match, OrientedBox};
use crate::runs::ranges_of;
use gs_io::{Error, IoContext, Result, write_json};
use ndarray::Array2;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::path::Path;

/// `instances.edits.json`: what a person changed of the instances, applied in order; the artifact itself is never touched.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Edits {
    /// Content hash of the `instances.safetensors` that it is about.
    pub instances: String,
    /// The changes, first to last.
    pub edits: Vec<Edit>,
}

/// A change. Ids of instances never change: they are those that the changes before it left.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "op", rename_all = "lowercase", deny_unknown_fields)]
pub enum Edit {
    /// These are one thing: the first has all their Gaussians, the others have none any more.
    Merge {
        /// At least two different instances.
        instances: Vec<u32>,
    },
    /// This is several things: the parts of its [`Family`](crate::Family).
    Split {
        /// The instance.
        instance: u32,
    },
    /// What people call it.
    Rename {
        /// The instance.
        instance: u32,
        /// 1 to 100 bytes: see [`gs_io::check_name`].
        name: String,
    },
    /// What people should know of it.
    Note {
        /// The instance.
        instance: u32,
        /// At most 500 bytes; an empty one takes the note away.
        text: String,
    },
    /// These Gaussians belong to another instance, or to none.
    Assign {
        /// The instance; -1 for none.
        instance: i32,
        /// Which, as [`crate::runs_of`] writes them.
        gaussians: String,
    },
    /// How long a known length is.
    Scale {
        /// One end, in units of the scene.
        from: [f64; 3],
        /// The other end.
        to: [f64; 3],
        /// Its length in metres, above 0.
        metres: f64,
    },
}

/// What edits say beyond the instances.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Remarks {
    /// Names by instance; only of instances that were named and hold Gaussians.
    pub names: BTreeMap<u32, String>,
    /// Notes by instance, likewise.
    pub notes: BTreeMap<u32, String>,
    /// Length of the scene's unit in metres, where a length is known.
    pub metres_per_unit: Option<f64>,
    /// Instances that were merged or split, or lost all Gaussians: no longer what they were.
    pub changed: BTreeSet<u32>,
}

/// The file.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    format: String,
    version: u32,
    instances: String,
    edits: Vec<Edit>,
}

/// Most bytes of a name.
const LONGEST_NAME: usize = 100;
/// Most bytes of a note.
const LONGEST_NOTE: usize = 500;
/// Most edits of a list: more than a person makes, and few enough for every instance that splitting adds.
const MOST_EDITS: usize = 10_000;

impl Edits {
    /// Format name in the file.
    pub const FORMAT: &str = "instances.edits";
    const VERSION: u32 = 1;

    /// Reads the file.
    ///
    /// # Errors
    /// When it is missing or not such a file.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        Self::parse(&std::fs::read(path).at("read", path)?).map_err(|e| e.file(path))
    }

    /// Reads the content of such a file.
    ///
    /// # Errors
    /// When it is no JSON of this form. Whether the changes fit the instances is seen by [`Self::apply`].
    pub fn parse(bytes: &[u8]) -> Result<Self> {
        let file: File = serde_json::from_slice(bytes).map_err(|e| {
            Error::new(format!("not a list of edits: {e}")).expected(
                r#"{"format", "version", "instances", "edits": [{"op": "merge", "split", "rename", "note", "assign" or "scale", ...}]}"#,
            )
        })?;
        let found = (&file.format[..], file.version);
        if found != (Self::FORMAT, Self::VERSION) {
            let e = Error::new("another format").field("format").found(format!("{} version {}", found.0, found.1));
            return Err(e.expected(format!("{} version {}", Self::FORMAT, Self::VERSION)));
        }
        Ok(Self { instances: file.instances, edits: file.edits })
    }

    /// Writes the file.
    pub fn write(&self, path: impl AsRef<Path>) -> Result<()> {
        let (format, version) = (Self::FORMAT.into(), Self::VERSION);
        let (instances, edits) = (self.instances.clone(), self.edits.clone());
        write_json(path, &File { format, version, instances, edits })
    }

    /// Changes the instances, whose Gaussians have these centres (`[N][3]`), and tells the rest.
    ///
    /// *Merge*: the descriptor is the mean of theirs weighted by support, at unit length; the support is the number of different
    /// views with a match; a mask that showed several of them is one match; the score is their best; edges of the tree name the
    /// first. *Split*: the part with most of the instance's Gaussians (ties: the first) keeps its id, with what lies in no part; the others are K, K + 1, ... in the order of
    /// the parts. They have descriptor, support, score and matches of the whole; a part without a Gaussian has none of these. The
    /// edges of the tree name the parts. *Assign*: an instance that loses all its Gaussians loses everything but its id.
    /// Count, centroid and boxes are measured again. Each of them leaves no granules.
    ///
    /// # Errors
    /// When a change does not fit the instances that those before it left; it is named by its number. The instances are then
    /// changed in part: do not use them.
    pub fn apply(&self, instances: &mut Instances, means: &[[f32; 3]]) -> Result<Remarks> {
        let n = instances.label.len();
        if means.len() != n {
            return Err(Error::new("not a label per Gaussian").field("label").found(n).expected(means.len()));
        }
        if self.edits.len() > MOST_EDITS {
            let e = Error::new("too many edits").field("edits").found(self.edits.len());
            return Err(e.expected(format!("at most {MOST_EDITS}")));
        }
        let (mut remarks, mut moved) = (Remarks::default(), BTreeSet::new());
        for (at, edit) in self.edits.iter().enumerate() {
            let field = |name: &str| format!("edits[{at}].{name}");
            match edit {
                Edit::Merge { instances: ids } => {
                    merge(instances, ids).map_err(|e| e.field(field("instances")))?;
                    ids[1..].iter().for_each(|&id| remarks.forget(id));
                    remarks.changed.extend(ids);
                }
                Edit::Split { instance } => {
                    let first_new = instances.len() as u32;
                    split(instances, *instance).map_err(|e| e.field(field("instance")))?;
                    remarks.changed.insert(*instance);
                    remarks.changed.extend(first_new..instances.len() as u32);
                }
                Edit::Rename { instance, name } => {
                    check_id(instances, *instance).map_err(|e| e.field(field("instance")))?;
                    check_name(name).map_err(|e| e.field(field("name")))?;
                    remarks.names.insert(*instance, name.clone());
                }
                Edit::Note { instance, text } => {
                    check_id(instances, *instance).map_err(|e| e.field(field("instance")))?;
                    check_note(text).map_err(|e| e.field(field("text")))?;
                    remarks.notes.insert(*instance, text.clone());
                    remarks.notes.retain(|_, text| !text.is_empty());
                }
                Edit::Assign { instance, gaussians } => {
                    let ranges = ranges_of(gaussians, n).map_err(|e| e.field(field("gaussians")))?;
                    let touched = assign(instances, *instance, &ranges).map_err(|e| e.field(field("instance")))?;
                    for &id in touched.iter().filter(|&&id| instances.count[id as usize] == 0) {
                        remarks.forget(id);
                        remarks.changed.insert(id);
                    }
                    moved.extend(touched);
                }
                Edit::Scale { from, to, metres } => {
                    let metres_per_unit = scale(*from, *to, *metres, field)?;
                    remarks.metres_per_unit = Some(metres_per_unit);
                }
            }
        }
        moved.extend(&remarks.changed);
        if !moved.is_empty() {
            // What a person made of the instances is what texts are to find.
            instances.granules.clear();
            instances.granule_descriptor = Array2::default((0, instances.dim()));
            measure(instances, means, &moved);
        }
        Ok(remarks)
    }
}

impl Remarks {
    /// Leaves nothing of an instance that is no more.
    fn forget(&mut self, id: u32) {
        self.names.remove(&id);
        self.notes.remove(&id);
    }
}

/// An id must be that of an instance with Gaussians.
fn check_id(instances: &Instances, id: u32) -> Result<()> {
    let k = instances.len();
    match instances.count.get(id as usize) {
        None if k == 0 => Err(Error::new("no such instance").found(id).expected("none: the scene has no instances")),
        None => Err(Error::new("no such instance").found(id).expected(format!("0 to {}", k - 1))),
        Some(0) => Err(Error::new("the instance has no Gaussians")
            .found(id)
            .expected("one with Gaussians")
            .hint("if it was merged, name the instance that it was merged into")),
        Some(_) => Ok(()),
    }
}

fn check_name(name: &str) -> Result<()> {
    let e = |what: &str| Err(Error::new(what).expected(format!("1 to {LONGEST_NAME} bytes")));
    match name {
        _ if name.trim().is_empty() => e("an empty name"),
        _ if name.len() > LONGEST_NAME => {
            e("the name is too long").map_err(|e: Error| e.found(format!("{} bytes", name.len())))
        }
        _ => gs_io::check_name(name),
    }
}

fn check_note(text: &str) -> Result<()> {
    let e = |what: &str, found: String| {
        let e = Error::new(what).found(found);
        Err(e.expected(format!("one line of at most {LONGEST_NOTE} bytes")))
    };
    match text {
        _ if text.len() > LONGEST_NOTE => e("the note is too long", format!("{} bytes", text.len())),
        _ if text.contains(gs_io::is_control) => e("a control character in the note", format!("{text:?}")),
        _ => Ok(()),
    }
}

/// Metres of a unit, where the distance between two points is so many metres.
fn scale(from: [f64; 3], to: [f64; 3], metres: f64, field: impl Fn(&str) -> String) -> Result<f64> {
    if !(metres.is_finite() && metres > 0.0) {
        return Err(Error::new("not a length").field(field("metres")).found(metres).expected("metres, above 0"));
    }
    let distance = (0..3).map(|c| to[c] - from[c]).fold(0.0, f64::hypot);
    let metres_per_unit = metres / distance;
    if !(metres_per_unit.is_finite() && metres_per_unit > 0.0) {
        let e = Error::new("no length between the two points").field(field("to")).found(format!("distance {distance}"));
        return Err(e.expected("two points apart from each other"));
    }
    Ok(metres_per_unit)
}

fn merge(instances: &mut Instances, ids: &[u32]) -> Result<()> {
    let &[first, ref others @ ..] = ids else {
        return Err(Error::new("nothing to merge").found("none").expected("at least two instances"));
    };
    if others.is_empty() {
        return Err(Error::new("nothing to merge").found("one").expected("at least two instances"));
    }
    let all: BTreeSet<u32> = ids.iter().copied().collect();
    if all.len() < ids.len() {
        return Err(Error::new("an instance is named twice").expected("different instances"));
    }
    ids.iter().try_for_each(|&id| check_id(instances, id))?;
    let merged = |l: i32| u32::try_from(l).is_ok_and(|l| all.contains(&l));
    let labels = instances.label.iter_mut().chain(instances.tree.iter_mut().map(|e| &mut e.instance));
    labels.filter(|l| merged(**l)).for_each(|l| *l = first as i32);
    instances.matches.iter_mut().filter(|m| all.contains(&m.instance)).for_each(|m| m.instance = first);
    // A mask that showed several of them is one match: else splitting and merging again would double all, again and again.
    let of = |m: &Match| (m.instance, m.view, m.mask);
    instances.matches.sort_by(|a, b| of(a).cmp(&of(b)).then(b.score.total_cmp(&a.score)));
    instances.matches.dedup_by_key(|m| of(m));

    let mut sum = vec![0.0; instances.dim()];
    for &id in ids {
        let support = f64::from(instances.support[id as usize]);
        sum.iter_mut().zip(instances.descriptor_of(id as usize)).for_each(|(s, &v)| *s += support * f64::from(v));
    }
    let length = sum.iter().map(|v| v * v).sum::<f64>().sqrt();
    let score = ids.iter().map(|&id| instances.score[id as usize]).fold(0.0, f32::max);
    let count = ids.iter().map(|&id| instances.count[id as usize]).sum();
    others.iter().for_each(|&id| clear(instances, id as usize));
    let views: BTreeSet<u32> = instances.matches.iter().filter(|m| m.instance == first).map(|m| m.view).collect();
    let first = first as usize;
    let unit = sum.iter().map(|v| if length > 1e-12 { (v / length) as f32 } else { 0.0 });
    instances.descriptor.row_mut(first).iter_mut().zip(unit).for_each(|(d, v)| *d = v);
    (instances.support[first], instances.score[first]) = (views.len() as u32, score);
    instances.count[first] = count;
    Ok(())
}

/// Leaves nothing of an instance but its id.
fn clear(instances: &mut Instances, id: usize) {
    instances.descriptor.row_mut(id).fill(0.0);
    (instances.count[id], instances.support[id], instances.score[id]) = (0, 0, 0.0);
    instances.matches.retain(|m| m.instance as usize != id);
}

fn split(instances: &mut Instances, id: u32) -> Result<()> {
    check_id(instances, id)?;
    let whole = id as usize;
    let parts = instances.family(whole).map(|f| f.parts).unwrap_or_default();
    if parts.len() < 2 {
        let e = Error::new("the instance has no parts").found(id).expected("an instance with at least two parts");
        return Err(e.hint("instances.json of cluster-match lists the parts of every instance"));
    }
    let own = |i: &u32| instances.label[*i as usize] == id as i32;
    let members = |&part: &u32| instances.gaussians_of_cluster(part).into_iter().filter(own).collect();
    let members: Vec<Vec<u32>> = parts.iter().map(members).collect();
    let largest = (0..parts.len()).rev().max_by_key(|&p| members[p].len()).unwrap_or(0);
    let of_whole: Vec<Match> = instances.matches.iter().filter(|m| m.instance == id).copied().collect();
    instances.tree.iter_mut().filter(|e| e.instance == id as i32).for_each(|e| e.instance = -1);
    for (p, (&part, members)) in parts.iter().zip(&members).enumerate() {
        let instance = if p == largest { id } else { instances.len() as u32 };
        instances.tree.iter_mut().filter(|e| e.child == part).for_each(|e| e.instance = instance as i32);
        if p == largest {
            continue;
        }
        copy(instances, whole);
        if members.is_empty() {
            clear(instances, instance as usize);
            continue;
        }
        instances.matches.extend(of_whole.iter().map(|m| Match { instance, ..*m }));
        members.iter().for_each(|&i| instances.label[i as usize] = instance as i32);
        instances.count[instance as usize] = members.len() as u32;
        instances.count[whole] -= members.len() as u32;
    }
    Ok(())
}

/// Gives Gaussians to an instance, or to none; the instances that had or have them.
fn assign(instances: &mut Instances, to: i32, ranges: &[Range<u32>]) -> Result<BTreeSet<u32>> {
    let mut touched = BTreeSet::new();
    match u32::try_from(to) {
        Ok(id) => {
            check_id(instances, id)?;
            touched.insert(id);
        }
        Err(_) if to == -1 => {}
        Err(_) => return Err(Error::new("no such instance").found(to).expected("an id, or -1 for none")),
    }
    for i in ranges.iter().cloned().flatten() {
        let from = std::mem::replace(&mut instances.label[i as usize], to);
        if let Ok(id) = u32::try_from(from) {
            instances.count[id as usize] -= 1;
            touched.insert(id);
        }
        if let Ok(id) = usize::try_from(to) {
            instances.count[id] += 1;
        }
    }
    for &id in touched.iter().filter(|&&id| instances.count[id as usize] == 0).collect::<Vec<_>>() {
        clear(instances, id as usize);
        instances.tree.iter_mut().filter(|e| e.instance == id as i32).for_each(|e| e.instance = -1);
    }
    Ok(touched)
}

/// Adds an instance with descriptor, support and score of another; the rest of it is measured later.
fn copy(instances: &mut Instances, of: usize) {
    let descriptor = instances.descriptor_of(of).to_owned();
    instances.descriptor.push_row(descriptor.view()).expect("of one dimension");
    instances.support.push(instances.support[of]);
    instances.score.push(instances.score[of]);
    instances.count.push(0);
    for corner in [&mut instances.centroid, &mut instances.bbox_min, &mut instances.bbox_max] {
        corner.push([0.0; 3]);
    }
    instances.oriented.push(OrientedBox::default());
}

/// Measures these instances again.
fn measure(instances: &mut Instances, means: &[[f32; 3]], which: &BTreeSet<u32>) {
    let extents = Extents::of(means, &instances.label, instances.len());
    for k in which.iter().map(|&k| k as usize) {
        instances.count[k] = extents.count[k];
        instances.centroid[k] = extents.centroid[k];
        (instances.bbox_min[k], instances.bbox_max[k]) = (extents.bbox_min[k], extents.bbox_max[k]);
        instances.oriented[k] = extents.oriented[k];
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::instances::TreeEdge;
    use crate::{Granule, Members};
    use ndarray::{arr2, aview1};

    /// Instances 0 of parts 12 (Gaussians 0, 1) and 13 (2, 3, 4) with Gaussian 5 in neither, and 1 (6, 7); 8 is noise.
    fn example() -> (Instances, Vec<[f32; 3]>) {
        let edge = |parent, child, instance| TreeEdge { parent, child, lambda: 1.0, size: 2, instance };
        let seen = |instance, view| Match { instance, view, mask: view, score: 0.5, visible: 1.0 };
        let label = vec![0, 0, 0, 0, 0, 0, 1, 1, -1];
        let means: Vec<[f32; 3]> = (0..9).map(|i| [i as f32, 0.0, 0.0]).collect();
        let extents = Extents::of(&means, &label, 2);
        let instances = Instances {
            label,
            descriptor: arr2(&[[1.0, 0.0], [0.0, 1.0]]),
            support: vec![3, 1],
            score: vec![0.4, 0.6],
            count: extents.count,
            centroid: extents.centroid,
            bbox_min: extents.bbox_min,
            bbox_max: extents.bbox_max,
            oriented: extents.oriented,
            views: ["a", "b", "c"].map(String::from).into(),
            matches: vec![seen(0, 0), seen(0, 1), seen(0, 2), seen(1, 1)],
            tree: vec![edge(9, 10, 0), edge(9, 11, 1), edge(10, 12, -1), edge(10, 13, -1)],
            node: vec![12, 12, 13, 13, 13, 10, 11, 11, -1],
            granules: vec![Granule { members: Members::Instance(1), support: 1, fit: 1.0 }],
            granule_descriptor: arr2(&[[0.0, 1.0]]),
        };
        (instances, means)
    }

    fn applied(edits: Vec<Edit>) -> Result<(Instances, Remarks)> {
        let (mut instances, means) = example();
        let remarks = Edits { edits, ..Edits::default() }.apply(&mut instances, &means)?;
        let extents = Extents::of(&means, &instances.label, instances.len());
        assert_eq!((&instances.count, &instances.oriented), (&extents.count, &extents.oriented), "measured again");
        assert_eq!((&instances.centroid, &instances.bbox_max), (&extents.centroid, &extents.bbox_max));
        // What was made of them is as good as an artifact.
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("i.safetensors");
        instances.write(&path, gs_io::Provenance::default()).unwrap();
        assert_eq!(Instances::read(&path).unwrap().0, instances);
        Ok((instances, remarks))
    }

    fn rename(instance: u32, name: &str) -> Edit {
        Edit::Rename { instance, name: name.into() }
    }

    #[test]
    fn merging_gives_everything_to_the_first() {
        let (i, remarks) =
            applied(vec![rename(0, "pot"), rename(1, "mug"), Edit::Merge { instances: vec![1, 0] }]).unwrap();
        assert_eq!(i.label, [1, 1, 1, 1, 1, 1, 1, 1, -1]);
        assert_eq!((&i.count, &i.support), (&vec![0, 8], &vec![0, 3]), "three views, one of them twice");
        assert_eq!((i.score[1], i.bbox_min[1], i.descriptor_of(0)), (0.6, [0.0; 3], aview1(&[0.0; 2])));
        let (d, ten) = (i.descriptor_of(1), 10f32.sqrt());
        assert!((d[0] - 3.0 / ten).abs() < 1e-6 && (d[1] - 1.0 / ten).abs() < 1e-6, "weighted by support: {d:?}");
        assert_eq!(
            i.matches.iter().map(|m| (m.instance, m.view)).collect::<Vec<_>>(),
            [(1, 0), (1, 1), (1, 2)],
            "the mask that showed both is one match"
        );
        assert_eq!(i.tree.iter().map(|e| e.instance).collect::<Vec<_>>(), [1, 1, -1, -1]);
        assert_eq!(remarks.names, BTreeMap::from([(1, "mug".to_string())]), "what is gone has no name");
        // Its pieces are its parts now: it can be taken apart again.
        let (i, _) = applied(vec![Edit::Merge { instances: vec![1, 0] }, Edit::Split { instance: 1 }]).unwrap();
        assert_eq!(i.label, [1, 1, 1, 1, 1, 1, 2, 2, -1]);
    }

    #[test]
    fn splitting_and_merging_again_and_again_adds_no_matches() {
        let before = example().0.matches.len();
        let again = |k: u32| [Edit::Split { instance: 0 }, Edit::Merge { instances: vec![0, 2 + k] }];
        let (i, _) = applied((0..40).flat_map(again).collect()).unwrap();
        assert_eq!((i.matches.len(), i.count[0]), (before, 6));
        let many = vec![rename(0, "pot"); MOST_EDITS + 1];
        assert!(applied(many).unwrap_err().to_string().contains("too many edits"));
    }

    #[test]
    fn splitting_gives_the_parts_new_ids_and_the_largest_keeps_its_own() {
        let (i, _) = applied(vec![Edit::Split { instance: 0 }]).unwrap();
        assert_eq!(i.label, [2, 2, 0, 0, 0, 0, 1, 1, -1], "what is in no part stays");
        assert_eq!((&i.count, &i.support, &i.score), (&vec![4, 2, 2], &vec![3, 1, 3], &vec![0.4, 0.6, 0.4]));
        assert_eq!(i.descriptor_of(2), i.descriptor_of(0));
        assert_eq!(i.matches.iter().filter(|m| m.instance == 2).map(|m| m.view).collect::<Vec<_>>(), [0, 1, 2]);
        assert_eq!(i.tree.iter().map(|e| e.instance).collect::<Vec<_>>(), [-1, 1, 2, 0]);
        // A part whose Gaussians another instance has is empty, but its id is taken.
        let (mut taken, means) = example();
        taken.label[..2].fill(1);
        let edits = Edits { edits: vec![Edit::Split { instance: 0 }], ..Edits::default() };
        edits.apply(&mut taken, &means).unwrap();
        assert_eq!((taken.count[2], taken.support[2], taken.descriptor_of(2)), (0, 0, aview1(&[0.0; 2])));
    }

    fn note(instance: u32, text: &str) -> Edit {
        Edit::Note { instance, text: text.into() }
    }

    fn assign(instance: i32, gaussians: &str) -> Edit {
        Edit::Assign { instance, gaussians: gaussians.into() }
    }

    #[test]
    fn gaussians_are_given_to_another_instance_or_to_none() {
        // Noise and a Gaussian of 0 to instance 1; then one of those to none.
        let (i, remarks) = applied(vec![assign(1, "1 1 6 1"), assign(-1, "8 1")]).unwrap();
        assert_eq!(i.label, [0, 1, 0, 0, 0, 0, 1, 1, -1]);
        assert_eq!((&i.count, remarks.changed.len(), i.granules.len()), (&vec![5, 3], 0, 0));
        assert_eq!(i.descriptor_of(1), example().0.descriptor_of(1), "what it is stays");
        // Twice is once; splitting afterwards leaves what was given away where it is.
        let again = vec![assign(1, "0 1"), assign(1, "0 1"), Edit::Split { instance: 0 }];
        assert_eq!(applied(again).unwrap().0.label, [1, 2, 0, 0, 0, 0, 1, 1, -1]);
        // Without a Gaussian nothing is left but the id.
        let (i, remarks) = applied(vec![rename(1, "cup"), note(1, "chipped"), assign(0, "6 2")]).unwrap();
        assert_eq!((&i.count, &i.support, i.tree[1].instance), (&vec![8, 0], &vec![3, 0], -1));
        assert_eq!(remarks, Remarks { changed: BTreeSet::from([1]), ..Remarks::default() });
        let e = applied(vec![assign(0, "6 2"), assign(1, "6 1")]).unwrap_err().to_string();
        assert!(e.contains("edits[1].instance: the instance has no Gaussians"), "{e}");
    }

    #[test]
    fn the_last_note_counts_and_an_empty_one_takes_it_away() {
        let kept = |edits| applied(edits).unwrap().1.notes;
        let persian = "مال مادربزرگ <b>";
        assert_eq!(kept(vec![note(0, "a"), note(0, persian), note(1, "b")])[&0], persian);
        assert_eq!(kept(vec![note(0, "a"), note(0, "")]), BTreeMap::new());
        let merged = vec![note(0, "a"), note(1, "b"), Edit::Merge { instances: vec![1, 0] }];
        assert_eq!(kept(merged), BTreeMap::from([(1, "b".to_string())]));
    }

    #[test]
    fn the_last_name_and_the_last_length_count() {
        let scale = |metres| Edit::Scale { from: [1.0, 0.0, 0.0], to: [1.0, 3.0, 4.0], metres };
        let edits = vec![rename(1, "cup"), rename(1, "kettle"), scale(1.0), scale(0.5)];
        let (i, remarks) = applied(edits).unwrap();
        assert_eq!((remarks.names[&1].as_str(), remarks.metres_per_unit), ("kettle", Some(0.1)));
        assert_eq!(i, example().0);
    }

    #[test]
    fn the_file_reads_back_and_is_the_one_of_the_docs() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("instances.edits.json");
        let text = r#"{"format":"instances.edits","version":1,"instances":"ab","edits":[
            {"op":"merge","instances":[3,5]},{"op":"split","instance":3},{"op":"rename","instance":3,"name":"kettle"},
            {"op":"note","instance":3,"text":"from grandma"},{"op":"assign","instance":3,"gaussians":"120 3 5 1"},
            {"op":"scale","from":[0,0,0],"to":[1,0,0],"metres":0.3}]}"#;
        let edits = Edits::parse(text.as_bytes()).unwrap();
        assert_eq!((edits.instances.as_str(), &edits.edits[2]), ("ab", &rename(3, "kettle")));
        edits.write(&path).unwrap();
        assert_eq!(Edits::read(&path).unwrap(), edits);
    }

    #[test]
    fn what_is_no_such_file_is_an_error() {
        let good = r#"{"format":"instances.edits","version":1,"instances":"ab","edits":[{"op":"split","instance":3}]}"#;
        Edits::parse(good.as_bytes()).unwrap();
        for (from, to, part) in [
            ("instances.edits", "instances", "format: another format; found instances version 1"),
            (":1,", ":2,", "found instances.edits version 2, expected instances.edits version 1"),
            ("split", "spilt", "unknown variant `spilt`"),
            ("instance\":3", "instance\":-3", "not a list of edits"),
            ("instance\":3", "instances\":[3]", "unknown field"),
            ("instance\":3", "instance\":3,\"name\":\"x\"", "unknown field"),
            ("\"version", "\"versions", "unknown field"),
            ("}]}", "}]", "EOF"),
        ] {
            let e = Edits::parse(good.replace(from, to).as_bytes()).unwrap_err().to_string();
            assert!(e.contains(part), "{to}: {e}");
        }
    }

    #[test]
    fn what_does_not_fit_names_the_edit() {
        let merge = |ids: &[u32]| Edit::Merge { instances: ids.into() };
        let scale = |to, metres| Edit::Scale { from: [1.0; 3], to, metres };
        let split = |instance| Edit::Split { instance };
        for (edits, part) in [
            (vec![split(1)], "edits[0].instance: the instance has no parts; found 1"),
            (vec![split(0), split(3)], "edits[1].instance: no such instance; found 3, expected 0 to 2"),
            (vec![merge(&[0, 1]), rename(1, "x")], "edits[1].instance: the instance has no Gaussians; found 1"),
            (vec![merge(&[])], "edits[0].instances: nothing to merge; found none"),
            (vec![merge(&[1])], "edits[0].instances: nothing to merge; found one"),
            (vec![merge(&[1, 0, 1])], "edits[0].instances: an instance is named twice"),
            (vec![merge(&[1, 9])], "edits[0].instances: no such instance; found 9"),
            (vec![rename(7, "x")], "edits[0].instance: no such instance"),
            (vec![rename(0, " ")], "edits[0].name: an empty name"),
            (vec![rename(0, &"é".repeat(51))], "edits[0].name: the name is too long; found 102 bytes"),
            (vec![rename(0, "a\u{7}")], "edits[0].name: a control character in the name"),
            (vec![rename(0, "mug\u{202e}gpj")], "a control character in the name; found \"mug\\u{202e}gpj\""),
            (vec![rename(0, "-rf")], "edits[0].name: the name begins with a dash"),
            (vec![note(9, "x")], "edits[0].instance: no such instance; found 9"),
            (vec![note(0, &"é".repeat(251))], "edits[0].text: the note is too long; found 502 bytes"),
            (vec![note(0, "a\nb")], "edits[0].text: a control character in the note; found \"a\\nb\""),
            (vec![assign(2, "0 1")], "edits[0].instance: no such instance; found 2, expected 0 to 1"),
            (vec![assign(-2, "0 1")], "edits[0].instance: no such instance; found -2"),
            (vec![assign(1, "8 2")], "edits[0].gaussians: not a list of Gaussians; found \"8 2\""),
            (vec![scale([2.0; 3], 0.0)], "edits[0].metres: not a length; found 0"),
            (vec![scale([2.0; 3], f64::NAN)], "edits[0].metres: not a length"),
            (vec![scale([1.0; 3], 1.0)], "edits[0].to: no length between the two points; found distance 0"),
            (vec![scale([f64::INFINITY; 3], 1.0)], "edits[0].to: no length between the two points"),
        ] {
            let e = applied(edits).unwrap_err().to_string();
            assert!(e.contains(part), "{part}: {e}");
        }
    }
}
