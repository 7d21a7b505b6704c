//! Where text features come from: a CLIP text encoder, or a table made with one.

use gs_io::{Error, IoContext, Result};
use onnx_models::{ClipText, EngineOptions};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// A source of text features.
pub enum TextSource {
    /// A live encoder: any words.
    Clip(Box<ClipText>),
    /// A table of names, such as OpenGaussian's text_features.json: only its names.
    Table(TextTable),
}

/// Text features by name.
#[derive(Debug, Clone, PartialEq)]
pub struct TextTable {
    path: PathBuf,
    dim: usize,
    features: BTreeMap<String, Vec<f32>>,
}

impl TextTable {
    /// Reads a JSON object of name -> list of numbers, all of one length.
    ///
    /// # Errors
    /// When the file is missing or not such a table, is empty, or its vectors differ in length.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let bytes = std::fs::read(path).at("read", path)?;
        let features: BTreeMap<String, Vec<f32>> = serde_json::from_slice(&bytes).map_err(|e| {
            Error::new(format!("not a table of text features: {e}"))
                .file(path)
                .expected("a JSON object of name -> list of numbers")
        })?;
        let dim = features.values().next().map_or(0, Vec::len);
        if dim == 0 {
            return Err(Error::new("no text features").file(path).hint("give a table with at least one name"));
        }
        for (name, v) in &features {
            if v.len() != dim {
                let e = Error::new("a vector of another length").file(path).field(name);
                return Err(e.found(v.len()).expected(dim));
            }
        }
        Ok(Self { path: path.to_path_buf(), dim, features })
    }
}

impl TextSource {
    /// Opens what the options name: a CLIP folder or a table.
    ///
    /// # Errors
    /// When neither or both are given, or the one given cannot be used.
    pub fn open(clip: Option<&Path>, table: Option<&Path>, engine: &EngineOptions) -> Result<Self> {
        match (clip, table) {
            (Some(clip), None) => Ok(Self::Clip(Box::new(ClipText::open(clip, engine)?))),
            (None, Some(table)) => Ok(Self::Table(TextTable::read(table)?)),
            (None, None) => {
                Err(Error::new("no source of text features").field("--clip").expected("--clip or --text-features"))
            }
            (Some(_), Some(_)) => Err(Error::new("two sources of text features")
                .field("--clip, --text-features")
                .hint("give one of them")),
        }
    }

    /// Numbers per feature.
    pub fn dim(&self) -> usize {
        match self {
            Self::Clip(clip) => clip.dimension(),
            Self::Table(table) => table.dim,
        }
    }

    /// What it is, for people.
    pub fn describe(&self) -> String {
        match self {
            Self::Clip(clip) if clip.config().name.is_empty() => "CLIP text encoder".into(),
            Self::Clip(clip) => format!("CLIP text encoder {}", clip.config().name),
            Self::Table(table) => format!("table of {} text features", table.features.len()),
        }
    }

    /// Checks that descriptors of `dim` numbers can be compared with this source.
    ///
    /// # Errors
    /// When there are no descriptors, or the dimensions differ.
    pub fn check_dim(&self, dim: usize, instances: &Path) -> Result<()> {
        let e = |what: &str| Error::new(what).file(instances).field("descriptor").found(format!("dimension {dim}"));
        if dim == 0 {
            return Err(e("the instances have no language features")
                .hint("run mask-embed with --clip (or add *_f.npy to the masks folder), then cluster-match again"));
        }
        if dim != self.dim() {
            return Err(e("the text features are of another model than the masks'")
                .expected(format!("{} ({})", self.dim(), self.describe()))
                .hint("text and masks must be encoded with the two halves of one CLIP model"));
        }
        Ok(())
    }

    /// Features of `texts`, in order; none for a text that a table does not hold.
    ///
    /// # Errors
    /// When the engine fails.
    pub fn encode(&self, texts: &[String]) -> Result<Vec<Option<Vec<f32>>>> {
        match self {
            Self::Clip(clip) => {
                let all = clip.encode(texts)?;
                Ok(all.chunks_exact(clip.dimension()).map(|c| Some(c.to_vec())).collect())
            }
            Self::Table(table) => Ok(texts.iter().map(|t| table.features.get(t).cloned()).collect()),
        }
    }

    /// The error for a text that [`Self::encode`] knows no feature of; it names a few that it knows.
    pub fn unknown(&self, text: &str) -> Error {
        let mut e = Error::new("no such text in the table").field("--text").found(format!("{text:?}"));
        if let Self::Table(table) = self {
            let some: Vec<String> = closest(text, table.features.keys()).map(|n| format!("{n:?}")).collect();
            let n = table.features.len();
            e = e.file(&table.path).expected(format!("one of its {n} names, such as {}", some.join(", ")));
        }
        e.hint("a CLIP text encoder (--clip) takes any words")
    }
}

/// The five names that share most letters with `text`, by Dice's coefficient of letter pairs.
fn closest<'a>(text: &str, names: impl Iterator<Item = &'a String>) -> impl Iterator<Item = &'a String> {
    let pairs = |s: &str| -> std::collections::BTreeSet<(char, char)> {
        let s = s.to_lowercase();
        s.chars().zip(s.chars().skip(1)).collect()
    };
    let wanted = pairs(text);
    let mut ranked: Vec<(f64, &String)> = names
        .map(|n| {
            let p = pairs(n);
            (2.0 * p.intersection(&wanted).count() as f64 / (p.len() + wanted.len()).max(1) as f64, n)
        })
        .collect();
    ranked.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(b.1)));
    ranked.into_iter().take(5).map(|r| r.1)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table(json: &str) -> Result<TextSource> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("text.json");
        std::fs::write(&path, json).unwrap();
        TextSource::open(None, Some(&path), &EngineOptions::default())
    }

    #[test]
    fn a_table_knows_its_names_and_suggests_near_ones() {
        let t = table(r#"{"coffee mug": [1, 0], "coffee": [0, 1], "sheep": [0.6, 0.8]}"#).unwrap();
        let found = t.encode(&["sheep".into(), "mug".into()]).unwrap();
        assert_eq!(found, [Some(vec![0.6, 0.8]), None]);
        let e = t.unknown("coffe mugg").to_string();
        assert!(e.contains("one of its 3 names, such as \"coffee mug\", \"coffee\""), "{e}");
        assert!(t.check_dim(2, Path::new("i")).is_ok());
        let e = t.check_dim(512, Path::new("i")).unwrap_err().to_string();
        assert!(e.contains("found dimension 512, expected 2"), "{e}");
        let e = t.check_dim(0, Path::new("i")).unwrap_err().to_string();
        assert!(e.contains("no language features") && e.contains("mask-embed"), "{e}");
    }

    #[test]
    fn bad_tables_are_errors() {
        for (json, part) in [
            ("[1]", "not a table"),
            ("{}", "no text features"),
            (r#"{"a": []}"#, "no text features"),
            (r#"{"a": [1], "b": [1, 2]}"#, "b: a vector of another length; found 2, expected 1"),
            (r#"{"a": [1e60]}"#, "number out of range"),
            (r#"{"a": ["x"]}"#, "not a table"),
        ] {
            let e = table(json).err().unwrap().to_string();
            assert!(e.contains(part), "{json}: {e}");
        }
    }

    #[test]
    fn opengaussians_table_reads() {
        let path =
            Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data/text/opengaussian_text_features.json");
        if !path.exists() {
            eprintln!("skipped: no opengaussian_text_features.json in the shared data");
            return;
        }
        let t = TextSource::open(None, Some(&path), &EngineOptions::default()).unwrap();
        assert_eq!(t.dim(), 512);
        let v = t.encode(&["coffee mug".into()]).unwrap().remove(0).unwrap();
        let norm: f32 = v.iter().map(|x| x * x).sum::<f32>().sqrt();
        assert!((norm - 1.0).abs() < 1e-3);
    }
}
