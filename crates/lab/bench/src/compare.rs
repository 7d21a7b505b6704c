//! Two builds of the programs, in turns on the same scenes.

use crate::chain::{Cost, Files, Options, Programs, STAGES, Stage};
use crate::plan::Plan;
use crate::tradeoff::{prepare, spread};
use gs_io::{IoContext, Result};
use serde::Serialize;
use std::path::Path;

/// A stage on a scene, by both builds.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Compared {
    pub scene: String,
    pub stage: Stage,
    /// Processor seconds of the base: median, least, most.
    pub base: [f64; 3],
    /// Of this build.
    pub own: [f64; 3],
    /// This build's median over the base's: below 1 is faster.
    pub ratio: f64,
    /// Peak memory of this build over the base's.
    pub memory_ratio: f64,
    /// Whether both wrote the same data. What the headers say of options and inputs may differ.
    pub same_data: bool,
}

/// Times all stages of `base` and `own` on the plan's scenes, each after the other `plan.repeats` times. Both work on a
/// scene that `own` made; each on its own artifacts.
pub fn compare(base: &Programs, own: &Programs, plan: &Plan, folder: &Path) -> Result<Vec<Compared>> {
    let mut all = Vec::new();
    for scene in &plan.scenes {
        let root = prepare(own, scene, &folder.join(&scene.name))?;
        let options = Options::of(Stage::Geometry, &scene.geometry);
        let side = |name: &str| {
            let out = folder.join(&scene.name).join(name);
            Files { geometry: out.join("geometry.ply"), ..root.within(&out) }
        };
        let sides = [(base, side("base")), (own, side("own"))];
        let mut costs = [vec![Vec::<Cost>::new(); STAGES.len()], vec![Vec::new(); STAGES.len()]];
        for _ in 0..plan.repeats {
            for stage in STAGES {
                for ((programs, files), of) in sides.iter().zip(&mut costs) {
                    of[stage as usize].push(files.run(programs, stage, &options)?);
                }
            }
        }
        for stage in STAGES {
            let [b, o] = [0, 1].map(|s| spread(costs[s][stage as usize].iter().map(|c| c.cpu).collect()));
            let [mb, mo] = [0, 1].map(|s| spread(costs[s][stage as usize].iter().map(|c| c.peak as f64).collect())[0]);
            let same_data = data(sides[0].1.output(stage))? == data(sides[1].1.output(stage))?;
            let (scene, ratio, memory_ratio) = (scene.name.clone(), o[0] / b[0].max(1e-9), mo / mb.max(1.0));
            all.push(Compared { scene, stage, base: b, own: o, ratio, memory_ratio, same_data });
        }
    }
    Ok(all)
}

/// What follows the header of a PLY or a safetensors file.
fn data(path: &Path) -> Result<Vec<u8>> {
    let bytes = std::fs::read(path).at("read", path)?;
    let header = if path.extension().is_some_and(|e| e == "ply") {
        let end = b"end_header\n";
        bytes.windows(end.len()).position(|w| w == end).map_or(0, |at| at + end.len())
    } else {
        let length = bytes.first_chunk().map_or(0, |l| u64::from_le_bytes(*l) as usize);
        length.saturating_add(8).min(bytes.len())
    };
    Ok(bytes[header..].to_vec())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn headers_do_not_count() {
        let dir = tempfile::tempdir().unwrap();
        let of = |name: &str, bytes: &[u8]| {
            let path = dir.path().join(name);
            std::fs::write(&path, bytes).unwrap();
            data(&path).unwrap()
        };
        assert_eq!(of("a.ply", b"ply\ncomment x\nend_header\n12"), of("b.ply", b"ply\nend_header\n12"));
        assert_ne!(of("a.ply", b"ply\nend_header\n12"), of("b.ply", b"ply\nend_header\n13"));
        assert_eq!(of("a.safetensors", b"\x02\0\0\0\0\0\0\0{}45"), b"45");
        assert_eq!(of("b.safetensors", b"\xff\xff\xff\xff\xff\xff\xff\xff{}"), b"");
    }
}
