//! CLIP-like features without CLIP: a unit vector for every word and thing, and for every mask what its crop shows.
//!
//! A word's vector is a fixed random direction that depends on the word alone, so scenes and seeds agree as with a real
//! encoder. A thing's vector mixes the words of its class and colour with its own name, so "red mug" is nearer to "blue
//! mug" than to "red bowl", and nearer to that than to "green plant"; a part's vector mixes its thing's with the part's
//! word. [`Language::encode`] makes of a mask the mean of what its crop shows by share of pixels, as far as the settings say
//! with what lies around it within the crop and with noise.

use crate::random::normal;
use crate::render::Frame;
use crate::scene::Scene;
use crate::truth::named::Named;
use crate::truth::scannet;
use artifacts::{Level, MaskFeatures, MaskMaps, flat};
use ndarray::Array2;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};

/// Numbers per feature, as CLIP's ViT-B has.
pub const DIM: usize = 512;
/// How much of a thing's vector is its class, its colour and its own name; squares sum to one.
const THING: [f64; 3] = [0.67, 0.45, 0.59];
/// How much of a part's vector is its thing and its own word; squares sum to one.
const PART: [f64; 2] = [0.6, 0.8];
/// How much of a class's vector is the benchmark's name for it, where it is called otherwise, and its own word.
const CLASS: [f64; 2] = [0.8, 0.6];
/// Texts that LERF's relevancy compares with.
const NEGATIVES: [&str; 4] = ["object", "things", "stuff", "texture"];

/// Faults of the features.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct Speech {
    /// Weight of a pixel that lies in the mask's bounding box but not in the mask, 0 to 1: 0 is a crop whose surroundings
    /// are blacked out, 1 a plain crop.
    pub leaking: f64,
    /// Expected length of the Gaussian noise added to a unit feature before it is scaled to unit length again.
    pub noise: f64,
}

/// Unit vectors of a scene's things and parts, and of texts.
pub struct Language {
    things: Vec<Vec<f64>>,
    parts: Vec<Vec<f64>>,
    thing_of: Vec<usize>,
    names: BTreeMap<String, Vec<f64>>,
}

/// The fixed direction of a word or phrase.
fn word(text: &str) -> Vec<f64> {
    let mut seed = [0; 32];
    seed.copy_from_slice(&gs_io::hash_bytes(text.as_bytes()).as_bytes()[..32]);
    let mut rng = ChaCha8Rng::from_seed(seed);
    unit((0..DIM).map(|_| normal(&mut rng)).collect())
}

fn unit(mut v: Vec<f64>) -> Vec<f64> {
    let length = v.iter().map(|x| x * x).sum::<f64>().sqrt();
    if length > 0.0 {
        v.iter_mut().for_each(|x| *x /= length);
    }
    v
}

fn mix<const N: usize>(weights: [f64; N], vectors: [&[f64]; N]) -> Vec<f64> {
    unit((0..DIM).map(|k| weights.iter().zip(vectors).map(|(w, v)| w * v[k]).sum()).collect())
}

fn class_vector(class: &str) -> Vec<f64> {
    match scannet::benchmark_name(class) {
        Some(name) if name != class => mix(CLASS, [&word(name), &word(class)]),
        _ => word(class),
    }
}

impl Language {
    /// The vectors of all things and parts of a scene, and of further texts, such as those that a benchmark asks of other scenes.
    /// `named` are parts and groups that are asked for by name; a group's vector is the mean of its things'.
    pub fn new(scene: &Scene, named: &[Named], texts: &[&str]) -> Self {
        let mut names: BTreeMap<String, Vec<f64>> =
            NEGATIVES.into_iter().chain(scannet::names()).map(|n| (n.to_string(), word(n))).collect();
        names.extend(scene.classes().into_iter().map(|c| (c.to_string(), class_vector(c))));
        let things: Vec<Vec<f64>> = scene
            .things
            .iter()
            .map(|t| match t.name == t.class {
                true => class_vector(t.class),
                false => mix(THING, [&class_vector(t.class), &word(t.color), &word(&t.name)]),
            })
            .collect();
        names.extend(scene.things.iter().map(|t| t.name.clone()).zip(things.iter().cloned()));
        for &text in texts {
            names.entry(text.into()).or_insert_with(|| word(text));
        }
        let thing_of: Vec<usize> = scene.parts.iter().map(|p| p.thing as usize).collect();
        let parts: Vec<Vec<f64>> =
            scene.parts.iter().map(|p| mix(PART, [&things[p.thing as usize], &word(p.name)])).collect();
        for Named { name, parts: own, .. } in named {
            let of: BTreeSet<usize> = own.iter().map(|&p| thing_of[p as usize]).collect();
            let vectors: Vec<&Vec<f64>> = match of.len() {
                1 => own.iter().map(|&p| &parts[p as usize]).collect(),
                _ => of.iter().map(|&t| &things[t]).collect(),
            };
            names.insert(name.clone(), unit((0..DIM).map(|k| vectors.iter().map(|v| v[k]).sum()).collect()));
        }
        Self { things, parts, thing_of, names }
    }

    /// Vectors by text: of every thing's name, the parts and groups that were given, every class, the classes of ScanNet's benchmark and LERF's negatives.
    pub fn table(&self) -> BTreeMap<&str, Vec<f32>> {
        self.names.iter().map(|(n, v)| (n.as_str(), v.iter().map(|&x| x as f32).collect())).collect()
    }

    /// The features of a view's masks, in the order of their ids; unit length. `frame` is what the view shows.
    pub fn encode(&self, frame: &Frame, maps: &MaskMaps, speech: &Speech, rng: &mut ChaCha8Rng) -> MaskFeatures {
        let mut visible = vec![0.0; self.things.len()];
        for &t in frame.thing.iter().filter(|&&t| t >= 0) {
            visible[t as usize] += 1.0;
        }
        let count = maps.id_count();
        let mut shares: Vec<BTreeMap<u32, f64>> = vec![BTreeMap::new(); count];
        for level in Level::ALL {
            let map = flat(maps.level(level));
            let mut boxes: BTreeMap<i32, [usize; 4]> = BTreeMap::new();
            for (at, &id) in map.iter().enumerate().filter(|(_, id)| **id >= 0) {
                let (x, y) = (at % frame.width, at / frame.width);
                let b = boxes.entry(id).or_insert([x, y, x, y]);
                *b = [b[0].min(x), b[1].min(y), b[2].max(x), b[3].max(y)];
                if frame.part[at] >= 0 {
                    *shares[id as usize].entry(frame.part[at] as u32).or_default() += 1.0;
                }
            }
            if speech.leaking > 0.0 {
                for (id, [x0, y0, x1, y1]) in boxes {
                    for at in (y0..=y1).flat_map(|y| (x0..=x1).map(move |x| y * frame.width + x)) {
                        if map[at] != id && frame.part[at] >= 0 {
                            *shares[id as usize].entry(frame.part[at] as u32).or_default() += speech.leaking;
                        }
                    }
                }
            }
        }
        let mut values = Vec::with_capacity(count * DIM);
        for share in &shares {
            let mut v = self.crop(share, &visible);
            if speech.noise > 0.0 {
                let scale = speech.noise / (DIM as f64).sqrt();
                v.iter_mut().for_each(|x| *x += scale * normal(rng));
                v = unit(v);
            }
            values.extend(v.into_iter().map(|x| x as f32));
        }
        MaskFeatures { values: Array2::from_shape_vec((count, DIM), values).expect("DIM of each") }
    }

    /// What a crop with so many (weighted) pixels of each part means. A thing of which it shows all that the view sees is
    /// meant as a whole; the less of it is shown, the more its parts are.
    fn crop(&self, share: &BTreeMap<u32, f64>, visible: &[f64]) -> Vec<f64> {
        let mut shown = BTreeMap::<usize, f64>::new();
        for (&part, &weight) in share {
            *shown.entry(self.thing_of[part as usize]).or_default() += weight;
        }
        let mut v = vec![0.0; DIM];
        for (&part, &weight) in share {
            let thing = self.thing_of[part as usize];
            let whole = (shown[&thing] / visible[thing].max(1.0)).min(1.0);
            let (of_thing, of_part) = (&self.things[thing], &self.parts[part as usize]);
            for k in 0..DIM {
                v[k] += weight * (whole * of_thing[k] + (1.0 - whole) * of_part[k]);
            }
        }
        unit(v)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::example;
    use crate::truth::masks::{self, Faults};
    use crate::truth::regions::Pairs;
    use artifacts::MaskTruth;

    fn dot(a: &[f64], b: &[f64]) -> f64 {
        a.iter().zip(b).map(|(a, b)| a * b).sum()
    }

    fn exact() -> (MaskMaps, Vec<MaskTruth>) {
        let (scene, frame) = example();
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let pairs = Pairs { rng: rng.clone(), first: 0, view: 0 };
        masks::segment(scene, frame, &Faults::default(), &mut rng, &mut ChaCha8Rng::seed_from_u64(2), &pairs)
    }

    fn encode(maps: &MaskMaps, leaking: f64, noise: f64) -> Vec<Vec<f64>> {
        let (scene, frame) = example();
        let speech = Speech { leaking, noise };
        let f = Language::new(scene, &[], &[]).encode(frame, maps, &speech, &mut ChaCha8Rng::seed_from_u64(3));
        f.values.rows().into_iter().map(|row| row.iter().map(|&x| f64::from(x)).collect()).collect()
    }

    #[test]
    fn near_meanings_have_near_vectors() {
        let of = |class, color: &str, name| mix(THING, [&word(class), &word(color), &word(name)]);
        let (mug, blue) = (of("mug", "red", "red mug"), of("mug", "blue", "blue mug"));
        let (bowl, plant) = (of("bowl", "red", "red bowl"), of("plant", "green", "green plant"));
        assert!(dot(&mug, &blue) > 0.35 && dot(&mug, &blue) < 0.6, "{}", dot(&mug, &blue));
        assert!(dot(&mug, &bowl) > 0.1 && dot(&mug, &bowl) < dot(&mug, &blue) - 0.1, "{}", dot(&mug, &bowl));
        assert!(dot(&mug, &plant).abs() < 0.15);
        assert!((dot(&class_vector("armchair"), &word("chair")) - 0.8).abs() < 0.1);
        assert_eq!(class_vector("chair"), word("chair"));
    }

    #[test]
    fn a_whole_thing_is_its_name_and_a_part_lies_between() {
        let (scene, _) = example();
        let language = Language::new(scene, &[], &[]);
        let (maps, truth) = exact();
        let features = encode(&maps, 0.0, 0.0);
        let table = language.table();
        let mut parts = 0;
        for (f, t) in features.iter().zip(&truth) {
            assert!((dot(f, f) - 1.0).abs() < 1e-5);
            let name = &scene.things[t.instances[0] as usize].name;
            let text: Vec<f64> = table[name.as_str()].iter().map(|&x| f64::from(x)).collect();
            match t.kind.as_str() {
                "whole" => assert!(dot(f, &text) > 0.999, "{}: {}", t.caption, dot(f, &text)),
                _ => {
                    assert!(dot(f, &text) > 0.5, "{}: {}", t.caption, dot(f, &text));
                    parts += usize::from(dot(f, &text) < 0.8);
                }
            }
        }
        assert!(parts > 5);
    }

    #[test]
    fn leaking_mixes_in_the_neighbours_and_noise_has_the_length_asked_for() {
        let (maps, _) = exact();
        let (pure, leaky, noisy) = (encode(&maps, 0.0, 0.0), encode(&maps, 0.5, 0.0), encode(&maps, 0.0, 0.5));
        let mean = |other: &[Vec<f64>]| pure.iter().zip(other).map(|(a, b)| dot(a, b)).sum::<f64>() / pure.len() as f64;
        assert!(mean(&leaky) < 0.97 && mean(&leaky) > 0.6, "{}", mean(&leaky));
        let expected = 1.0 / 1.25f64.sqrt();
        assert!((mean(&noisy) - expected).abs() < 0.01, "{} is not {expected}", mean(&noisy));
    }
}
