//! Polygon labels of a view in LERF-OVS's form (ISAT JSON).

use crate::render::Frame;
use crate::scene::Scene;
use crate::truth::named::Named;
use crate::truth::polygon::{self, Polygon};
use crate::truth::write_json;
use gs_io::Result;
use serde_json::json;
use std::collections::BTreeMap;
use std::path::Path;

/// An object of which a view shows fewer pixels is not labelled in it.
const SMALLEST: usize = 40;
/// A separate piece of an object with fewer pixels is not labelled.
const SMALLEST_PIECE: usize = 6;

/// Writes polygons around what `frame` shows of each of `named`. What consists of several things is labelled where all of them
/// are to be seen, and what is not there has a polygon without corners.
pub fn write(path: &Path, image: &str, scene: &Scene, named: &[Named], frame: &Frame) -> Result<()> {
    let mut shown = vec![0usize; scene.parts.len()];
    frame.part.iter().filter(|&&p| p >= 0).for_each(|&p| shown[p as usize] += 1);
    let mut objects = Vec::new();
    for Named { name, id, parts } in named {
        let mut of_thing: BTreeMap<u32, usize> = BTreeMap::new();
        for &p in parts {
            *of_thing.entry(scene.parts[p as usize].thing).or_default() += shown[p as usize];
        }
        if of_thing.values().any(|&pixels| pixels < SMALLEST) {
            continue;
        }
        let mut own = vec![false; scene.parts.len()];
        parts.iter().for_each(|&p| own[p as usize] = true);
        let inside: Vec<bool> = frame.part.iter().map(|&p| p >= 0 && own[p as usize]).collect();
        let mut lines = polygon::trace(&inside, frame.width, frame.height, SMALLEST_PIECE);
        if parts.is_empty() {
            lines.push(Polygon::new());
        }
        for line in lines {
            let range = |axis: usize| {
                line.iter().map(|p| p[axis]).fold((i32::MAX, i32::MIN), |(low, high), v| (low.min(v), high.max(v)))
            };
            let ((x0, x1), (y0, y1)) = (range(0), range(1));
            objects.push(json!({
                "category": name,
                "group": id,
                "segmentation": line,
                "bbox": if line.is_empty() { [0; 4] } else { [x0, y0, x1, y1] },
                "layer": objects.len() as f64 + 1.0,
                "iscrowd": false,
                "note": "",
            }));
        }
    }
    let info = json!({
        "description": "ISAT", "name": image, "width": frame.width, "height": frame.height, "depth": 3, "note": "",
    });
    write_json(path, &json!({ "info": info, "objects": objects }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{example, fill};
    use crate::truth::named;

    #[test]
    fn filled_polygons_give_back_the_instance_map() {
        let (scene, frame) = example();
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("frame_00001.json");
        write(&path, "frame_00001.png", scene, &named::things(scene), frame).unwrap();
        let json: serde_json::Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
        assert_eq!(json["info"]["width"], frame.width);
        let objects = json["objects"].as_array().unwrap();
        let mut labelled = 0;
        for (t, thing) in scene.things.iter().enumerate() {
            let mine: Vec<&serde_json::Value> =
                objects.iter().filter(|o| o["category"] == thing.name.as_str()).collect();
            let shown: Vec<bool> = frame.thing.iter().map(|&i| i == t as i32).collect();
            let pixels = shown.iter().filter(|s| **s).count();
            assert_eq!(!mine.is_empty(), !thing.background && pixels >= SMALLEST, "{}", thing.name);
            labelled += usize::from(!mine.is_empty());
            let mut mask = vec![false; frame.thing.len()];
            for object in mine {
                let line: Polygon = serde_json::from_value(object["segmentation"].clone()).unwrap();
                for (m, f) in mask.iter_mut().zip(fill(&line, frame.width, frame.height)) {
                    *m |= f;
                }
            }
            let wrong = mask.iter().zip(&shown).filter(|(m, s)| m != s).count();
            assert!(!mask.contains(&true) || 100 * wrong < 3 * pixels, "{}: {wrong} of {pixels}", thing.name);
        }
        assert!(labelled >= 6, "{labelled}");
    }
}
