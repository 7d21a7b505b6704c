//! A scan as ScanNet has it: labelled vertices, segments and the objects made of them; and the names of its benchmark
//! for what the catalogue has.

use crate::scene::Scene;
use crate::truth::write_json;
use artifacts::{NYU40, TruePoints};
use gs_io::{Result, write_bytes};
use gs_scene::{PointCloud, ply};
use serde::Serialize;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::Path;

/// Name of the scan where the scene has none.
pub const SCAN: &str = "scene0000_00";

/// Classes of the catalogue that the benchmark calls otherwise.
const CALLED: [(&str, &str); 5] = [
    ("armchair", "chair"),
    ("stool", "chair"),
    ("painting", "picture"),
    ("side table", "table"),
    ("wall cabinet", "cabinet"),
];
/// Id of furniture and props that the benchmark does not ask for ("otherprop").
const OTHER: u32 = 40;

/// The names of all classes that the benchmark asks for.
pub fn names() -> impl Iterator<Item = &'static str> {
    NYU40.iter().map(|b| b.1)
}

/// What the benchmark calls a class of the catalogue, if it asks for it.
pub fn benchmark_name(class: &str) -> Option<&'static str> {
    let class = CALLED.iter().find(|c| c.0 == class).map_or(class, |c| c.1);
    names().find(|&n| n == class)
}

/// The label id of a class of the catalogue.
pub fn label(class: &str) -> u32 {
    let name = benchmark_name(class);
    NYU40.iter().find(|b| Some(b.1) == name).map_or(OTHER, |b| b.0)
}

/// Names of the files that [`write`] writes: vertices, their labels, segments, objects. A scan that OpenGaussian has
/// `converted` has `points3d.ply` for the vertices.
pub fn files(name: &str, converted: bool) -> [String; 4] {
    let ends = ["_vh_clean_2.ply", "_vh_clean_2.labels.ply", "_vh_clean_2.0.010000.segs.json", ".aggregation.json"];
    let [vertices, labels, segs, objects] = ends.map(|end| format!("{name}{end}"));
    [if converted { "points3d.ply".into() } else { vertices }, labels, segs, objects]
}

/// Writes the files of the scan `name` into `folder`: the vertices with colours, without faces; the same with a label id
/// each; segments, which are parts; and objects: things, background included. The vertices are the true surface points.
pub fn write(
    folder: &Path,
    name: &str,
    converted: bool,
    scene: &Scene,
    points: &TruePoints,
    colors: &[[u8; 3]],
) -> Result<()> {
    let [vertices, labels, segs, objects] = files(name, converted);
    let cloud = PointCloud { positions: points.position.clone(), colors: colors.to_vec(), ..PointCloud::default() };
    ply::write_points(folder.join(vertices), &cloud, &[])?;
    let mut labelled = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\nproperty float y\n\
         property float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nproperty ushort label\n\
         end_header\n",
        points.position.len()
    )
    .into_bytes();
    for ((position, color), &instance) in points.position.iter().zip(colors).zip(&points.instance) {
        position.iter().for_each(|x| labelled.extend(x.to_le_bytes()));
        labelled.extend(color);
        let id = usize::try_from(instance).ok().and_then(|i| scene.things.get(i)).map_or(0, |t| label(t.class));
        labelled.extend((id as u16).to_le_bytes());
    }
    write_bytes(folder.join(labels), &labelled)?;
    let segments = Segments { params: BTreeMap::new(), scene_id: name, seg_indices: &points.part };
    write_json(&folder.join(&segs), &segments)?;
    let groups: Vec<Value> = scene
        .things
        .iter()
        .enumerate()
        .map(|(id, t)| {
            let class = benchmark_name(t.class).unwrap_or(t.class);
            json!({ "id": id, "objectId": id, "segments": t.parts.clone().collect::<Vec<u32>>(), "label": class })
        })
        .collect();
    let json = json!({ "sceneId": name, "segGroups": groups, "segmentsFile": segs });
    write_json(&folder.join(objects), &json)
}

/// The segment of each vertex. A [`Value`] would take many times the memory.
#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct Segments<'a> {
    params: BTreeMap<String, Value>,
    scene_id: &'a str,
    seg_indices: &'a [i32],
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::example;

    #[test]
    fn labels_segments_and_objects_agree() {
        let (scene, _) = example();
        let parts: Vec<i32> = (0..scene.parts.len() as i32).collect();
        let thing = |&p: &i32| scene.parts[p as usize].thing as i32;
        let points = TruePoints {
            position: parts.iter().map(|&p| [p as f32, 0.5, -1.0]).collect(),
            instance: parts.iter().map(thing).collect(),
            class: vec![0; parts.len()],
            part: parts.clone(),
        };
        let dir = tempfile::tempdir().unwrap();
        write(dir.path(), SCAN, false, scene, &points, &vec![[9, 8, 7]; parts.len()]).unwrap();
        let (at, labels) =
            ply::read_labels(dir.path().join("scene0000_00_vh_clean_2.labels.ply"), "label", [0.0; 3]).unwrap();
        assert_eq!(at, points.position);
        for (&l, &i) in labels.iter().zip(&points.instance) {
            assert_eq!(l, label(scene.things[i as usize].class));
        }
        assert!(labels.contains(&1) && labels.contains(&2) && labels.contains(&40));
        let read = |end: &str| -> Value {
            let bytes = std::fs::read(dir.path().join(format!("scene0000_00{end}"))).unwrap();
            serde_json::from_slice(&bytes).unwrap()
        };
        assert_eq!(read("_vh_clean_2.0.010000.segs.json")["segIndices"], json!(parts));
        let groups = read(".aggregation.json")["segGroups"].clone();
        for (p, i) in parts.iter().zip(&points.instance) {
            let owners: Vec<&Value> = groups
                .as_array()
                .unwrap()
                .iter()
                .filter(|g| g["segments"].as_array().unwrap().contains(&json!(p)))
                .collect();
            assert_eq!(owners.len(), 1);
            assert_eq!(owners[0]["objectId"], json!(i));
        }
        let cloud = ply::read_points(dir.path().join("scene0000_00_vh_clean_2.ply")).unwrap();
        assert_eq!((cloud.positions, cloud.colors[0]), (points.position, [9, 8, 7]));
    }

    #[test]
    fn classes_have_the_benchmarks_ids() {
        assert_eq!([label("wall"), label("armchair"), label("painting"), label("mug")], [1, 5, 11, 40]);
        assert_eq!(benchmark_name("wall cabinet"), Some("cabinet"));
        assert_eq!(benchmark_name("mug"), None);
    }
}
