//! What instances of a synthetic scene can reach at most: with true labels on the Gaussians, and with masks that the truth
//! groups. Both become instances that `eval score` scores as any others.

use artifacts::{Footprints, Instances, Level, TruePoints, role};
use cluster_match::{gather, mask_weights};
use gs_io::{Error, Result, Watched, hash_file, write_json};
use gs_scene::Geometry;
use gs_scene::dataset::{self, Dataset, LoadOptions};
use serde::Serialize;
use serde_json::json;
use stage::Stage;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// A mask is pure when one true thing has at least this share of it.
const PURE: f64 = 0.8;

/// Files of one geometry and its masks.
#[derive(Debug, Clone, clap::Args)]
pub struct Inputs {
    /// Scene of synth-scene, with its truth/
    #[arg(long, value_name = "DIR")]
    scene: PathBuf,
    /// The geometry.ply of the footprints
    #[arg(long, value_name = "FILE")]
    geometry: PathBuf,
    /// footprints.safetensors of graph-precompute: the masks
    #[arg(long, value_name = "FILE")]
    footprints: PathBuf,
}

/// A ceiling, as the output lists it.
#[derive(Debug, Clone, PartialEq, Serialize)]
struct Ceiling {
    /// `true labels`, a level of masks, or `all` of them.
    name: String,
    /// Its instances, a file beside the output.
    instances: String,
    /// Masks that were grouped; none for the true labels.
    masks: Option<usize>,
    /// Share of the masks' weight that lies in masks of which less than 80 % is one true thing, 0 to 1.
    impure: Option<f64>,
}

/// A mask as its row in the footprints, and its weight in each thing.
type Mask = (u32, BTreeMap<u32, f64>);

/// What the ceilings are made from.
struct World {
    geometry: Geometry,
    footprints: Footprints,
    points: TruePoints,
    /// The thing of every Gaussian, numbered from 0; -1 for none.
    truth: Vec<i32>,
    /// Content hashes, by role.
    hashes: BTreeMap<String, String>,
}

/// Writes `out`, a JSON list of ceilings, and the instances of each beside it: `<out>.true-labels.safetensors`, one of every
/// level that has masks, such as `<out>.small.safetensors`, and `<out>.all.safetensors`.
///
/// # Errors
/// When the scene has no truth, the files do not belong together, or one is damaged.
pub fn run(inputs: &Inputs, out: &Path, stage: &Stage) -> Result<()> {
    let points = inputs.scene.join("truth/points.safetensors");
    if !points.exists() {
        return Err(Error::new("the scene has no truth").file(&points).hint("give --scene a scene of synth-scene"));
    }
    let dataset = dataset::load(&inputs.scene, &LoadOptions::default())?;
    let mut sets = vec![("true labels".to_string(), vec![])];
    sets.extend(Level::SAM.map(|level| (level.to_string(), vec![level])));
    sets.push(("all".into(), Level::SAM.to_vec()));
    let file = |name: &str| out.with_extension(name.replace(' ', "-") + ".safetensors");
    let outputs =
        stage.outputs(out).file(out).reads(&dataset.files).reads([&points, &inputs.geometry, &inputs.footprints]);
    let outputs = sets.iter().fold(outputs, |o, (name, _)| o.artifact(file(name), Instances::FORMAT));
    let mut claim = outputs.drop_stale().claim()?;
    let world = World::read(inputs, &dataset, TruePoints::read(&points)?)?;
    if let Some(damage) = world.geometry.damage() {
        stage.skipped(&damage);
    }
    let kept: Vec<i32> = world.footprints.kept.iter().map(|&i| world.truth[i as usize]).collect();
    let mut all = Vec::new();
    for (name, levels) in sets {
        let masks = mask_weights(&kept, &world.footprints, &levels)?;
        if masks.is_empty() && !levels.is_empty() {
            continue;
        }
        let labels = if levels.is_empty() { world.truth.clone() } else { world.grouped(&masks)? };
        let parameters = json!({"command": "ceilings", "ceiling": name});
        let provenance = stage.provenance(Instances::FORMAT, 1, parameters, world.hashes.clone());
        let path = file(&name);
        world.instances(labels).write(&path, provenance)?;
        let instances = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let count = (!levels.is_empty()).then_some(masks.len());
        all.push(Ceiling { name, instances, masks: count, impure: impure(&masks) });
    }
    write_json(out, &all)?;
    stage.info(&format!("wrote {} and the instances of {} ceilings, for eval score", out.display(), all.len()));
    let summary = json!({"ceilings": all.len()});
    stage.record(&mut claim, json!({"command": "ceilings"}), world.hashes, summary)
}

impl World {
    fn read(inputs: &Inputs, dataset: &Dataset, points: TruePoints) -> Result<Self> {
        let watched = Watched::new([&inputs.geometry]);
        let geometry = Geometry::read(&inputs.geometry)?;
        let hashes = BTreeMap::from([
            (role::GEOMETRY.to_string(), hash_file(&inputs.geometry)?),
            (role::DATASET.to_string(), dataset.hash()?),
        ]);
        watched.check()?;
        let footprints = Footprints::read(&inputs.footprints)?;
        hashes.iter().try_for_each(|(role, hash)| footprints.artifact().expect_input(role, hash))?;
        let n = geometry.gaussians.len();
        if let Some(last) = footprints.kept.last().filter(|&&last| last as usize >= n) {
            let wrong = Error::new("a Gaussian that the geometry lacks").file(&inputs.footprints).field("kept");
            return Err(wrong.found(last).expected(format!("less than {n}")).hint("run graph-precompute again"));
        }
        let truth = numbered(&eval::true_labels(&geometry, &points));
        Ok(Self { geometry, footprints, points, truth, hashes })
    }

    /// Labels by ideal grouping: every mask is given the thing that holds most of its weight, and every Gaussian takes the
    /// thing with most weight in its masks; of equals the first. -1 for Gaussians in no mask.
    fn grouped(&self, masks: &[Mask]) -> Result<Vec<i32>> {
        let mut of_thing = BTreeMap::<u32, Vec<u32>>::new();
        let some = masks.iter().filter(|(_, of)| !of.is_empty());
        some.for_each(|(row, of)| of_thing.entry(main_thing(of).0).or_default().push(*row));
        let mut best = vec![0.0; self.footprints.kept.len()];
        let mut labels = vec![-1; self.truth.len()];
        for (thing, rows) in of_thing {
            let mut weight = vec![0.0f64; best.len()];
            for row in rows {
                self.footprints.entries(row as usize)?.iter().for_each(|(i, w)| weight[i as usize] += f64::from(w));
            }
            for (i, (best, weight)) in best.iter_mut().zip(weight).enumerate() {
                if weight > *best {
                    *best = weight;
                    labels[self.footprints.kept[i] as usize] = thing as i32;
                }
            }
        }
        Ok(labels)
    }

    /// Instances of these labels, without masks, language or tree, ranked by how well they fit.
    fn instances(&self, labels: Vec<i32>) -> Instances {
        let (nodes, things) = (vec![-1; labels.len()], labels.iter().max().map_or(0, |&most| (most + 1) as usize));
        let score = eval::true_confidence(&self.geometry, &labels, things, &self.points);
        let gathered = gather(&self.geometry.gaussians.means, labels, things, Vec::new());
        Instances { score, node: nodes, ..gathered }
    }
}

/// The labels numbered from 0 in their order, without gaps; -1 stays.
fn numbered(labels: &[i32]) -> Vec<i32> {
    let mut used: Vec<i32> = labels.iter().copied().filter(|&l| l >= 0).collect();
    used.sort_unstable();
    used.dedup();
    labels.iter().map(|l| used.binary_search(l).map_or(-1, |at| at as i32)).collect()
}

/// The thing that holds most of a mask's weight, of equals the first, and that weight.
fn main_thing(mask: &BTreeMap<u32, f64>) -> (u32, f64) {
    mask.iter().fold((0, 0.0), |best, (&thing, &weight)| if weight > best.1 { (thing, weight) } else { best })
}

/// Share of the masks' weight in masks that are not pure; none without weight.
fn impure(masks: &[Mask]) -> Option<f64> {
    let (mut bad, mut all) = (0.0, 0.0);
    for (_, of) in masks {
        let weight: f64 = of.values().sum();
        all += weight;
        bad += if main_thing(of).1 < PURE * weight { weight } else { 0.0 };
    }
    (all > 0.0).then(|| bad / all)
}

#[cfg(test)]
mod tests {
    use super::*;
    use artifacts::{FootprintsBuilder, Row};
    use glam::DVec3;
    use gs_io::{Provenance, create_dir};
    use gs_scene::{Camera, Gaussians, Image, PointCloud, colmap, ply};
    use std::fs;

    /// Eight Gaussians in a row, of two things with the ids 3 and 7, and one that no mask holds. The small level has pure
    /// masks; one large mask is half and half, one reaches over the border by a tenth.
    fn example(folder: &Path) -> Inputs {
        let scene = folder.join("scene");
        ["images", "sparse/0", "truth"].iter().for_each(|d| create_dir(scene.join(d)).unwrap());
        Image::from_rgb8(2, 2, &[9; 12]).write_png(scene.join("images/a.png")).unwrap();
        let camera = Camera::look_at(DVec3::ZERO, DVec3::Z, -DVec3::Y, 2, 2, 1.0);
        colmap::write_model(&scene.join("sparse/0"), &[("a.png".into(), camera)], &PointCloud::default()).unwrap();
        let place = |i: u32| [i as f32, 0.0, 2.0];
        let points = TruePoints {
            position: (0..9).map(place).collect(),
            instance: vec![3, 3, 3, 3, 7, 7, 7, 7, 7],
            part: vec![0; 9],
            class: vec![0; 9],
        };
        points.write(scene.join("truth/points.safetensors"), Provenance::default()).unwrap();
        let mut g = Gaussians::default();
        for i in 0..9 {
            g.means.push(place(i));
            g.log_scales.push([-2.0; 3]);
            g.rotations.push([1.0, 0.0, 0.0, 0.0]);
            g.opacity_logits.push(4.0);
            g.sh.extend([0.0; 3]);
        }
        let geometry = folder.join("geometry.ply");
        ply::write_gaussians(&geometry, &g, &[]).unwrap();
        let mut b = FootprintsBuilder { views: vec!["a".into()], kept: (0..9).collect(), ..Default::default() };
        let masks: [(u32, &[u32], f32); 5] = [
            (1, &[0, 1, 2, 3], 1.0),
            (1, &[4, 5, 6, 7], 1.0),
            (3, &[0, 1], 1.0),
            (3, &[2, 3, 4, 5], 2.0),
            (3, &[3, 6, 7], 4.0),
        ];
        for (mask, (level, gaussians, weight)) in masks.into_iter().enumerate() {
            let row = Row { view: 0, level, mask: mask as u32, pixels: 9, gated: 9, alpha: 1.0 };
            b.push(row, gaussians.iter().map(|&i| (i, if mask == 4 && i == 3 { 1.0 } else { weight })));
        }
        let dataset = dataset::load(&scene, &LoadOptions::default()).unwrap().hash().unwrap();
        let hashes = [(role::GEOMETRY, hash_file(&geometry).unwrap()), (role::DATASET, dataset)];
        let inputs = hashes.into_iter().map(|(role, hash)| (role.to_string(), hash)).collect();
        let footprints = folder.join("footprints.safetensors");
        b.write(&footprints, Provenance { inputs, ..Provenance::default() }).unwrap();
        Inputs { scene, geometry, footprints }
    }

    #[test]
    fn masks_are_grouped_by_their_main_thing_and_their_purity_is_told() {
        let dir = tempfile::tempdir().unwrap();
        let (inputs, out) = (example(dir.path()), dir.path().join("g.ceilings.json"));
        let stage = Stage::silent("bench");
        run(&inputs, &out, &stage).unwrap();
        let read = |name: &str| Instances::read(dir.path().join(format!("g.ceilings.{name}.safetensors"))).unwrap().0;
        let labels = |name: &str| read(name).label;
        assert_eq!(labels("true-labels"), [0, 0, 0, 0, 1, 1, 1, 1, 1]);
        assert_eq!(labels("small"), [0, 0, 0, 0, 1, 1, 1, 1, -1]);
        // The mask that is half and half goes to the first thing, with all that it holds.
        assert_eq!(labels("large"), [0, 0, 0, 0, 0, 0, 1, 1, -1]);
        assert_eq!((read("large").score, read("large").count), (vec![4.0 / 6.0, 3.0 / 5.0], vec![6, 2]));
        // Of 2 for the large mask and 1 for the small one the large one wins.
        assert_eq!(labels("all"), [0, 0, 0, 0, 0, 0, 1, 1, -1]);
        let told: serde_json::Value = serde_json::from_slice(&fs::read(&out).unwrap()).unwrap();
        let of = |name: &str| {
            let c = told.as_array().unwrap().iter().find(|c| c["name"] == name).expect(name);
            (c["masks"].as_u64(), c["impure"].as_f64())
        };
        assert_eq!((of("true labels"), of("small")), ((None, None), (Some(2), Some(0.0))));
        assert_eq!(of("large"), (Some(3), Some(8.0 / 19.0)));
        assert_eq!(of("all"), (Some(5), Some(8.0 / 27.0)));
        assert_eq!(told.as_array().unwrap().len(), 4, "no levels without masks");
    }

    #[test]
    fn other_files_are_refused_and_nothing_is_written() {
        let dir = tempfile::tempdir().unwrap();
        let (inputs, out) = (example(dir.path()), dir.path().join("g.json"));
        let stage = Stage::silent("bench");
        let other = Inputs { geometry: dir.path().join("other.ply"), ..inputs.clone() };
        let mut g = ply::read_gaussians(&inputs.geometry).unwrap();
        g.means[0][0] = -1.0;
        ply::write_gaussians(&other.geometry, &g, &[]).unwrap();
        let refused = run(&other, &out, &stage).unwrap_err().to_string();
        assert!(refused.contains("footprints.safetensors") && refused.contains("geometry"), "{refused}");
        fs::remove_file(inputs.scene.join("truth/points.safetensors")).unwrap();
        let refused = run(&inputs, &out, &stage).unwrap_err().to_string();
        assert!(refused.contains("has no truth") && refused.contains("--scene"), "{refused}");
        assert!(!out.exists() && !out.with_extension("true-labels.safetensors").exists());
    }
}
