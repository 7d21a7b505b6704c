//! What instances are called: the names of a vocabulary that describe each best, and whether the best is more than a guess.

use crate::chance::share_of;
use crate::{Index, LERF_NEGATIVES, TextSource, Unrelated, encode_cached};
use artifacts::{Instances, Naming, ScoredName};
use gs_io::{Error, IoContext, Result, hash_bytes};
use rayon::prelude::*;
use std::collections::BTreeSet;
use std::path::Path;

/// Everyday things, one a line.
const EVERYDAY: &str = include_str!("everyday.txt");
/// Names that an instance keeps.
const KEPT: usize = 3;
/// Instances without any score that are added to those of the scene when a name's mean score is taken: few instances say
/// little about a name, and of one alone nothing is taken away (docs/queries.md).
const PRIOR: f32 = 4.0;
/// Most bytes of a name.
const LONGEST: usize = 100;

/// The names that instances may have.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Vocabulary {
    /// The names, in order, all different.
    pub words: Vec<String>,
    /// Lines that named something again, which are left out.
    pub repeated: usize,
}

impl Vocabulary {
    /// About 1,200 everyday things.
    pub fn everyday() -> Self {
        // The file is tested.
        Self::parse(EVERYDAY).unwrap_or(Self { words: Vec::new(), repeated: 0 })
    }

    /// Reads a list: a name a line; empty lines and those that begin with # are skipped.
    ///
    /// # Errors
    /// When the file cannot be read or is not UTF-8, a name is longer than 100 bytes or has control characters, or there are
    /// fewer than `least` names.
    pub fn read(path: impl AsRef<Path>, least: usize) -> Result<Self> {
        let path = path.as_ref();
        let bytes = std::fs::read(path).at("read", path)?;
        let text = std::str::from_utf8(&bytes);
        let text = text.map_err(|_| Error::new("not text").file(path).expected("UTF-8, a name a line"))?;
        let words = Self::parse(text.trim_start_matches('\u{feff}')).map_err(|e| e.file(path))?;
        words.enough(least).map_err(|e| e.file(path))
    }

    /// The names of a table, but those that are there for other ends: texts that mean nothing in particular, and unrelated ones.
    ///
    /// # Errors
    /// When fewer than two are left.
    pub fn of_table(names: Vec<String>) -> Result<Self> {
        let others: BTreeSet<&str> = Unrelated::texts().chain(LERF_NEGATIVES).collect();
        let words = names.into_iter().filter(|n| !others.contains(&n[..])).collect();
        Self { words, repeated: 0 }.enough(2)
    }

    fn parse(text: &str) -> Result<Self> {
        let (mut words, mut known, mut repeated) = (Vec::new(), BTreeSet::new(), 0);
        for (at, line) in text.lines().enumerate() {
            let word = line.split_whitespace().collect::<Vec<_>>().join(" ");
            if word.is_empty() || word.starts_with('#') {
                continue;
            }
            if word.len() > LONGEST || gs_io::check_name(&word).is_err() {
                let shown: String = word.chars().take(20).collect();
                let e = Error::new("not a name").field(format!("line {}", at + 1)).found(format!("{shown:?}"));
                return Err(
                    e.expected(format!("1 to {LONGEST} bytes without control characters or a dash before them"))
                );
            }
            // CLIP does not tell capitals from small letters.
            if known.insert(word.to_lowercase()) {
                words.push(word);
            } else {
                repeated += 1;
            }
        }
        Ok(Self { words, repeated })
    }

    fn enough(self, least: usize) -> Result<Self> {
        if self.words.len() >= least {
            return Ok(self);
        }
        let e = Error::new("too few names").found(self.words.len()).expected(format!("at least {least}, one a line"));
        Err(e.hint("add names of what may be there"))
    }

    /// Content hash of the names.
    pub fn hash(&self) -> String {
        hash_bytes(self.words.join("\n").as_bytes())
    }

    /// Features of all names; `option` gave them. Of a model they are kept beside it ([`encode_cached`]).
    ///
    /// # Errors
    /// When the encoder fails, or a table lacks a name.
    pub fn encode(&self, source: &TextSource, templates: &[String], option: &str) -> Result<Vec<Vec<f32>>> {
        let one = |(f, word): (Option<Vec<f32>>, &String)| f.ok_or_else(|| source.unknown(word).field(option));
        encode_cached(source, templates, &self.words)?.into_iter().zip(&self.words).map(one).collect()
    }
}

/// Names of all instances that have a descriptor, ascending by instance, and the margin that is no better than chance.
///
/// A name's rank goes by its cosine with the descriptor less its mean cosine over the scene's instances, because some names lie near to
/// everything. The margin is the best name's lead over the best name of another meaning. At most one name is right, so what
/// the second leads the third by is chance: a name is sure where its margin is above that of 95 of 100 instances. Instances matched in fewer views than
/// `min_support` get no name; without three names of different meaning nothing is sure.
///
/// # Panics
/// When there is not a feature of the descriptors' dimension for each word: a programming error.
pub fn name_instances(
    instances: &Instances,
    vocabulary: &Vocabulary,
    features: &[Vec<f32>],
    min_support: u32,
) -> (Vec<Naming>, Option<f32>) {
    assert_eq!(vocabulary.words.len(), features.len(), "a feature for each word");
    let index = Index::new(instances);
    let all: Vec<Vec<Option<f32>>> = features.par_iter().map(|f| index.scores(f, &[])).collect();
    let described = |k: &u32| instances.support[*k as usize] >= min_support && index.has_descriptor(*k as usize);
    let described: Vec<u32> = (0..instances.len() as u32).filter(described).collect();
    // A feature of zeros resembles nothing.
    let score = |word: usize, k: u32| all[word][k as usize].unwrap_or(0.0);
    let mean = |word: usize| {
        let sum: f64 = described.iter().map(|&k| f64::from(score(word, k))).sum();
        (sum / (described.len() as f64 + f64::from(PRIOR))) as f32
    };
    let means: Vec<f32> = (0..features.len()).into_par_iter().map(mean).collect();
    let meanings: Vec<BTreeSet<String>> = vocabulary.words.iter().map(|w| meaning(w)).collect();
    let one = |&k: &u32| {
        let lift = |word: usize| score(word, k) - means[word];
        let mut ranked: Vec<usize> = (0..features.len()).collect();
        ranked.sort_by(|&a, &b| lift(b).total_cmp(&lift(a)).then(a.cmp(&b)));
        let mut leaders: Vec<usize> = Vec::new();
        for &word in &ranked {
            if leaders.iter().all(|&l| !alike(&meanings[l], &meanings[word])) {
                leaders.push(word);
            }
            if leaders.len() == 3 {
                break;
            }
        }
        let lead = |at: usize| leaders.get(at + 1).map(|&next| lift(leaders[at]) - lift(next));
        let kept = |&w: &usize| ScoredName { name: vocabulary.words[w].clone(), score: score(w, k) };
        let names = ranked.iter().take(KEPT).map(kept).collect();
        (Naming { instance: k, names, margin: lead(0).unwrap_or(0.0), sure: false }, lead(1))
    };
    let (mut named, seconds): (Vec<Naming>, Vec<Option<f32>>) = described.par_iter().map(one).unzip();
    let by_chance = share_of(seconds.into_iter().flatten().collect());
    named.iter_mut().for_each(|n| n.sure = by_chance.is_some_and(|chance| n.margin > chance));
    (named, by_chance)
}

/// The words of a name.
fn meaning(name: &str) -> BTreeSet<String> {
    let name = name.to_lowercase();
    let words: BTreeSet<String> =
        name.split(|c: char| !c.is_alphanumeric()).filter(|w| !w.is_empty()).map(String::from).collect();
    // A name of signs alone means itself.
    if words.is_empty() { BTreeSet::from([name]) } else { words }
}

/// Whether one name says no less than the other: "mug" and "coffee mug".
fn alike(a: &BTreeSet<String>, b: &BTreeSet<String>) -> bool {
    a.is_subset(b) || b.is_subset(a)
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::{Array2, arr2};

    fn instances(descriptor: Array2<f32>) -> Instances {
        let k = descriptor.nrows();
        Instances {
            label: (0..k as i32).collect(),
            descriptor,
            support: vec![3; k],
            count: vec![1; k],
            ..Instances::default()
        }
    }

    fn words(words: &[&str]) -> Vocabulary {
        Vocabulary { words: words.iter().map(|w| (*w).into()).collect(), repeated: 0 }
    }

    fn first(named: &[Naming]) -> Vec<&str> {
        named.iter().map(|n| &n.names[0].name[..]).collect()
    }

    #[test]
    fn one_instance_has_the_name_of_the_best_cosine() {
        let i = instances(arr2(&[[0.6, 0.8, 0.0]]));
        let features = [vec![2.0, 0.0, 0.0], vec![0.0, 1.0, 0.0], vec![0.0, 0.0, 5.0]];
        let (named, by_chance) = name_instances(&i, &words(&["mug", "bowl", "lamp"]), &features, 1);
        let scores: Vec<(&str, f32)> = named[0].names.iter().map(|n| (&n.name[..], n.score)).collect();
        assert_eq!(scores.iter().map(|s| s.0).collect::<Vec<_>>(), ["bowl", "mug", "lamp"]);
        assert!((scores[0].1 - 0.8).abs() < 1e-6 && (scores[1].1 - 0.6).abs() < 1e-6);
        // A fifth of the only instance's own scores is taken away.
        assert!((named[0].margin - 0.8 * 0.2).abs() < 1e-6 && (by_chance.unwrap() - 0.8 * 0.6).abs() < 1e-6);
        assert!(!named[0].sure, "the second leads the third by more");
    }

    #[test]
    fn a_name_that_is_near_to_everything_names_nothing() {
        // All lie along the fourth axis, where the hub lies; what tells them apart is on the other three.
        let descriptor =
            Array2::from_shape_fn((12, 4), |(k, c)| if c == 3 { 1.0 } else { f32::from(k % 3 == c) * 0.5 });
        let features: Vec<Vec<f32>> =
            (0..4).map(|w| (0..4).map(|c| if c == 3 { 0.5 } else { f32::from(w == c) }).collect()).collect();
        let vocabulary = words(&["mug", "bowl", "lamp", "room"]);
        let i = instances(descriptor);
        let raw: Vec<Option<f32>> = features.iter().map(|f| Index::new(&i).scores(f, &[])[0]).collect();
        assert!(raw[3] > raw[0], "by cosine alone all would be rooms");
        let (named, _) = name_instances(&i, &vocabulary, &features, 1);
        assert_eq!(first(&named), ["mug", "bowl", "lamp"].repeat(4));
    }

    #[test]
    fn what_lies_between_two_names_is_not_sure() {
        let axis = |c: usize, v: f32| -> Vec<f32> { (0..5).map(|k| if k == c { v } else { 0.0 }).collect() };
        let features: Vec<Vec<f32>> = (0..5).map(|c| axis(c, 1.0)).collect();
        let mut rows: Vec<Vec<f32>> = (0..4).map(|c| axis(c, 1.0)).collect();
        rows.push(vec![0.0, 0.0, 0.0, 0.7, 0.7]);
        let i = instances(Array2::from_shape_vec((5, 5), rows.concat()).unwrap());
        let (named, by_chance) = name_instances(&i, &words(&["a", "b", "c", "d", "e"]), &features, 1);
        let sure: Vec<bool> = named.iter().map(|n| n.sure).collect();
        assert_eq!(sure, [true, true, true, true, false], "{by_chance:?} {named:?}");
        assert_eq!(named[4].names[0].name, "e", "d is the name of another, too");
    }

    #[test]
    fn a_longer_name_of_the_same_is_no_rival() {
        let i = instances(arr2(&[[1.0, 0.0], [0.0, 1.0]]));
        let features = [vec![1.0, 0.1], vec![1.0, 0.0], vec![0.0, 1.0]];
        let (named, by_chance) = name_instances(&i, &words(&["mug", "coffee mug", "plate"]), &features, 1);
        assert_eq!(named[0].names[1].name, "mug");
        assert!(named[0].margin > 0.9 && !named[0].sure && by_chance.is_none(), "two meanings: {named:?}");
        assert!(alike(&meaning("Coffee-mug"), &meaning("mug")) && !alike(&meaning("mug"), &meaning("smug")));
    }

    #[test]
    fn instances_without_a_descriptor_and_rare_ones_have_no_name() {
        let mut i = instances(arr2(&[[1.0, 0.0], [0.0, 0.0], [0.0, 1.0]]));
        i.support[2] = 1;
        let features = [vec![1.0, 0.0], vec![0.0, 1.0]];
        let of = |least| -> Vec<u32> {
            name_instances(&i, &words(&["mug", "bowl"]), &features, least).0.iter().map(|n| n.instance).collect()
        };
        assert_eq!((of(1), of(2), of(4)), (vec![0, 2], vec![0], vec![]));
        // Features of zeros are no names, but do no harm.
        let (named, _) = name_instances(&i, &words(&["mug", "bowl"]), &[vec![0.0; 2], vec![0.0, 1.0]], 1);
        assert_eq!(first(&named), ["mug", "bowl"]);
    }

    #[test]
    fn the_vocabulary_is_large_and_plain() {
        let v = Vocabulary::everyday();
        assert!((1150..=1300).contains(&v.words.len()) && v.repeated == 0, "{}", v.words.len());
        let plain = |w: &String| *w == w.to_lowercase() && w.len() <= 30 && w.is_ascii();
        assert!(v.words.iter().all(plain) && v.words.is_sorted());
        assert!(["chair", "mug", "kettle", "laptop", "bicycle"].iter().all(|w| v.words.iter().any(|v| v == w)));
    }

    #[test]
    fn a_list_of_a_person_is_read_line_by_line() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("words.txt");
        let read = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            Vocabulary::read(&path, 2).map_err(|e| e.to_string())
        };
        let v = read("\u{feff}# mine\r\n\r\n Mug \nsoup   bowl\n\nmug\n#bowl".as_bytes()).unwrap();
        assert_eq!((v.words, v.repeated), (vec!["Mug".to_string(), "soup bowl".into()], 1));
        for (bytes, part) in [
            (&b"# nothing\n\n"[..], "words.txt: too few names; found 0, expected at least 2"),
            (b"mug\nMUG", "found 1"),
            (b"\xff\xfe", "words.txt: not text; expected UTF-8"),
            (b"mug\na\0b", "words.txt: line 2: not a name; found \"a\\0b\""),
        ] {
            let e = read(bytes).unwrap_err();
            assert!(e.contains(part), "{e}");
        }
        assert!(read("x".repeat(101).as_bytes()).unwrap_err().contains("line 1: not a name"));
        let e = Vocabulary::read(dir.path().join("none"), 1).unwrap_err().to_string();
        assert!(e.contains("none: cannot read"), "{e}");
    }

    #[test]
    fn a_table_is_a_vocabulary_without_what_it_holds_for_other_ends() {
        let names = ["mug", "object", "galaxy", "plate"].map(String::from).to_vec();
        assert_eq!(Vocabulary::of_table(names).unwrap().words, ["mug", "plate"]);
        assert!(Vocabulary::of_table(vec!["galaxy".into(), "mug".into()]).is_err());
    }
}
