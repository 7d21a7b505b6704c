//! Where text features come from: a CLIP text encoder, or a table made with one.

use artifacts::role;
use gs_io::{Artifact, Error, IoContext, Result};
use onnx_models::{ClipImage, ClipText, EngineArgs};
use serde::Serialize;
use std::collections::BTreeMap;
use std::io::Read;
use std::path::{Path, PathBuf};

/// LERF's texts that mean nothing in particular, for its relevancy.
pub const LERF_NEGATIVES: [&str; 4] = ["object", "things", "stuff", "texture"];
/// The seven templates that CLIP's authors found to do as well on ImageNet as their eighty.
pub const CLIP_TEMPLATES: [&str; 7] = [
    "itap of a {}.",
    "a bad photo of the {}.",
    "a origami {}.",
    "a photo of the large {}.",
    "a {} in a video game.",
    "art of the {}.",
    "a photo of the small {}.",
];

/// Where text features come from, and which instances have a descriptor.
#[derive(Debug, Clone, Default, clap::Args, Serialize)]
pub struct TextOptions {
    /// CLIP folder with text.onnx: the other half of the model that encoded the masks
    #[arg(long, value_name = "DIR")]
    pub clip: Option<PathBuf>,
    /// Table of text features by name, instead of --clip: JSON, OpenGaussian's text_features.zip, or npz. Whether a text matches
    /// anything is not judged, unless it holds 20 of the unrelated texts (docs/queries.md)
    #[arg(long, value_name = "FILE", conflicts_with = "clip")]
    pub text_features: Option<PathBuf>,
    /// Accept another CLIP model than the one that encoded the masks, if its features have the same dimension
    #[arg(long, requires = "clip")]
    pub any_model: bool,
    /// Use only instances that were matched with masks in at least this many views [default: 1; scannet: 2]
    #[arg(long, value_name = "VIEWS")]
    pub min_support: Option<u32>,
    /// What runs the text encoder.
    #[command(flatten)]
    #[serde(flatten)]
    pub engine: EngineArgs,
}

impl TextOptions {
    /// Whether there is a source of text features.
    pub fn given(&self) -> bool {
        self.clip.is_some() || self.text_features.is_some()
    }

    /// Bytes of memory that text features will take: an encoder's tokenizer and its weights, which are in memory twice while they are read,
    /// or a table. A file that is not there counts as empty.
    pub fn bytes(&self) -> u64 {
        let of = |p: &Path| std::fs::metadata(p).map_or(0, |m| m.len());
        let encoder = |c: &Path| TOKENIZER + of(&if c.is_dir() { c.join("text.onnx") } else { c.into() }) * 2;
        self.clip.as_deref().map_or(0, encoder) + self.text_features.as_deref().map_or(0, |t| 2 * of(t))
    }
}

/// What CLIP's tokenizer takes.
const TOKENIZER: u64 = 16_000_000;

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
    /// Reads a table: a JSON object of name -> list of numbers, as OpenGaussian's `text_features.json`; the zip of that name
    /// that it comes in; or a NumPy `.npz` with an array per name, of shape `[d]` or `[1, d]`. All vectors have one length.
    ///
    /// # Errors
    /// When the file is no such table, is empty, or a number is not finite.
    pub fn read(path: impl AsRef<Path>) -> Result<Self> {
        let path = path.as_ref();
        let bytes = std::fs::read(path).at("read", path)?;
        let read = if bytes.starts_with(b"PK") { read_zip } else { read_json };
        let features = read(&bytes).map_err(|e| e.file(path))?;
        let dim = features.values().next().map_or(0, Vec::len);
        if dim == 0 {
            return Err(Error::new("no text features").file(path).hint("give a table with at least one name"));
        }
        for (name, v) in &features {
            if v.len() != dim {
                let e = Error::new("a vector of another length").file(path).field(name);
                return Err(e.found(v.len()).expected(dim));
            }
            if let Some(bad) = v.iter().find(|x| !x.is_finite()) {
                return Err(Error::new("a number is not finite").file(path).field(name).found(bad));
            }
        }
        Ok(Self { path: path.to_path_buf(), dim, features })
    }

    /// The feature of a name, as the file has it.
    pub fn get(&self, name: &str) -> Option<&[f32]> {
        self.features.get(name).map(Vec::as_slice)
    }
}

/// Text features by name, as they are read.
type Features = BTreeMap<String, Vec<f32>>;

fn read_json(bytes: &[u8]) -> Result<Features> {
    serde_json::from_slice(bytes).map_err(|e| {
        Error::new(format!("not a table of text features: {e}"))
            .expected("a JSON object of name -> list of numbers, that in a zip, or an npz of name -> vector")
    })
}

/// Largest array of an npz that is read, in bytes: a vector of text features has a few thousand.
const LARGEST_ARRAY: u64 = 1 << 24;
/// The file in OpenGaussian's zip.
const TABLE: &str = "text_features.json";

type Archive<'a> = zip::ZipArchive<std::io::Cursor<&'a [u8]>>;

/// A zip holds a table as JSON, or is an npz.
fn read_zip(bytes: &[u8]) -> Result<Features> {
    let broken = |e: zip::result::ZipError| Error::new(format!("not a readable zip: {e}")).hint("copy it again");
    let mut archive = Archive::new(std::io::Cursor::new(bytes)).map_err(broken)?;
    // All that comes out together: entries may be packed a thousandfold, and several may be the same bytes of the file.
    let most = (64 * bytes.len() as u64).max(LARGEST_ARRAY);
    let names: Vec<String> = archive.file_names().map(|n| n.map_err(broken).map(Into::into)).collect::<Result<_>>()?;
    if let Some(table) = names.iter().position(|n| Path::new(n).file_name().is_some_and(|n| n == TABLE)) {
        let json = unpack(&mut archive, table, most)?.1;
        return read_json(&json).map_err(|e| e.field(TABLE));
    }
    if names.iter().any(|n| n.ends_with(".npy")) {
        return read_npz(&mut archive, most);
    }
    Err(Error::new("no text features in this zip")
        .found(format!("{} files: {}", names.len(), names.iter().take(3).cloned().collect::<Vec<_>>().join(", ")))
        .expected(format!("{TABLE}, as OpenGaussian ships it, or the arrays of numpy.savez")))
}

/// Name and content of a file of a zip, of at most so many bytes: not the size that it claims, but what comes out.
fn unpack(archive: &mut Archive<'_>, index: usize, most: u64) -> Result<(String, Vec<u8>)> {
    let broken = |e: &dyn std::fmt::Display| Error::new(format!("not a readable zip: {e}")).hint("copy it again");
    let mut entry = archive.by_index(index).map_err(|e| broken(&e))?;
    let (name, mut data) = (entry.name().map_err(|e| broken(&e))?.to_string(), Vec::new());
    (&mut entry).take(most + 1).read_to_end(&mut data).map_err(|e| broken(&e).field(&name))?;
    if data.len() as u64 > most {
        let e = Error::new("too large for text features").field(&name);
        return Err(e.expected(format!("at most {most} bytes")).hint("give a table of fewer names"));
    }
    Ok((name, data))
}

fn read_npz(archive: &mut Archive<'_>, most: u64) -> Result<Features> {
    let mut features = BTreeMap::new();
    let mut left = most;
    for i in 0..archive.len() {
        let (file, data) = unpack(archive, i, LARGEST_ARRAY.min(left))?;
        left -= data.len() as u64;
        let name = file.trim_end_matches(".npy").to_string();
        let array = gs_io::npy::parse(&data).map_err(|e| e.field(&name))?;
        if !matches!(array.shape(), [_] | [1, _]) {
            let e = Error::new("not a vector").field(&name).found(format!("{:?}", array.shape()));
            return Err(e.expected("[d] or [1, d]"));
        }
        features.insert(name, array.into_iter().collect());
    }
    Ok(features)
}

impl TextSource {
    /// Opens what the options name: a CLIP folder or a table.
    pub fn open(o: &TextOptions) -> Result<Self> {
        match (&o.clip, &o.text_features) {
            (Some(clip), _) => Ok(Self::Clip(Box::new(ClipText::open(clip, &o.engine.options())?))),
            (None, Some(table)) => Ok(Self::Table(TextTable::read(table)?)),
            (None, None) => {
                Err(Error::new("no source of text features").field("--clip").expected("--clip or --text-features"))
            }
        }
    }

    /// Opens what the options name. It must have the dimension `dim` of the descriptors in `described`, and a CLIP pair must be
    /// the one whose other half encoded the masks, as far as that file knows it.
    pub fn open_for(described: &Artifact, dim: usize, o: &TextOptions) -> Result<Self> {
        let source = Self::open(o)?;
        let found = format!("dimension {dim}");
        let e = |what: &str| Error::new(what).file(described.path()).field("descriptor").found(&found);
        if dim == 0 {
            return Err(e("the instances have no language features")
                .hint("run mask-embed embed --clip (or add *_f.npy to the masks folder), then cluster-match again"));
        }
        if dim != source.dim() {
            return Err(e("the text features are of another model than the masks'")
                .expected(format!("{} ({})", source.dim(), source.describe()))
                .hint("text and masks must be encoded with the two halves of one CLIP model"));
        }
        let Some(clip) = o.clip.as_deref().filter(|_| !o.any_model) else { return Ok(source) };
        let made_with = |role: &str| described.provenance().inputs.get(role).cloned();
        let (image, text) = (made_with(role::CLIP), made_with(role::CLIP_TEXT));
        let unknown = image.is_none() && text.is_none();
        // The text encoder is open, and has its hash already; the image encoder is read only where that is not enough.
        if unknown || text == Some(source.hash()?) || image.is_some() && image == ClipImage::hash_in(clip) {
            return Ok(source);
        }
        let hint =
            "give that model, run mask-embed embed and cluster-match with this one, or accept it with --any-model";
        Err(Error::new("another CLIP model than the one that encoded the masks")
            .file(clip)
            .field("--clip")
            .expected(format!("the model that {} was made with", described.path().display()))
            .hint(hint))
    }

    /// Dimension of the features.
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

    /// Features of `texts`, in order; none for a text that a table does not hold.
    fn encode(&self, texts: &[String]) -> Result<Vec<Option<Vec<f32>>>> {
        match self {
            Self::Clip(clip) => {
                let all = clip.encode(texts)?;
                Ok(all.chunks_exact(clip.dimension()).map(|c| Some(c.to_vec())).collect())
            }
            Self::Table(table) => Ok(texts.iter().map(|t| table.features.get(t).cloned()).collect()),
        }
    }

    /// [`Self::encode_in`] for texts that must all have a feature; `option` gave them.
    pub fn known(&self, templates: &[String], texts: &[String], option: &str) -> Result<Vec<Vec<f32>>> {
        let one = |(f, text): (Option<Vec<f32>>, &String)| f.ok_or_else(|| self.unknown(text).field(option));
        self.encode_in(templates, texts)?.into_iter().zip(texts).map(one).collect()
    }

    /// Features of `texts` where each is put into the place of `{}` in every template, such as "a photo of a {}", and the
    /// unit features of what comes out are averaged and scaled to unit length. None for a text that a table does not hold.
    pub fn encode_in(&self, templates: &[String], texts: &[String]) -> Result<Vec<Option<Vec<f32>>>> {
        if templates.is_empty() {
            return self.encode(texts);
        }
        let filled: Vec<String> = texts.iter().flat_map(|t| templates.iter().map(|p| p.replace("{}", t))).collect();
        let features = self.encode(&filled)?;
        Ok(features.chunks_exact(templates.len()).map(mean_direction).collect())
    }

    /// All names, where the source is a table.
    pub fn names(&self) -> Vec<String> {
        match self {
            Self::Clip(_) => Vec::new(),
            Self::Table(table) => table.features.keys().cloned().collect(),
        }
    }

    /// Which features exactly: the content hash of the encoder's graph or of the table, for reports.
    pub fn hash(&self) -> Result<String> {
        match self {
            Self::Clip(clip) => Ok(clip.hash().into()),
            Self::Table(table) => gs_io::hash_file(&table.path),
        }
    }

    /// The error for a text without a feature; it names a few that have one.
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

/// The unit mean of unit features; none when one is missing.
fn mean_direction(features: &[Option<Vec<f32>>]) -> Option<Vec<f32>> {
    let unit = |v: &mut Vec<f64>| {
        let norm = v.iter().map(|x| x * x).sum::<f64>().sqrt();
        v.iter_mut().for_each(|x| *x /= if norm > 0.0 { norm } else { 1.0 });
    };
    let mut sum = vec![0.0; features.first()?.as_ref()?.len()];
    for feature in features {
        let mut one: Vec<f64> = feature.as_ref()?.iter().map(|&x| f64::from(x)).collect();
        unit(&mut one);
        sum.iter_mut().zip(&one).for_each(|(s, x)| *s += x);
    }
    unit(&mut sum);
    Some(sum.into_iter().map(|x| x as f32).collect())
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
    use ndarray::{ArrayD, arr1, arr2};

    fn table(json: &str) -> Result<TextSource> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("text.json");
        std::fs::write(&path, json).unwrap();
        Ok(TextSource::Table(TextTable::read(&path)?))
    }

    #[test]
    fn a_table_knows_its_names_and_suggests_near_ones() {
        let t = table(r#"{"coffee mug": [1, 0], "coffee": [0, 1], "sheep": [0.6, 0.8]}"#).unwrap();
        let found = t.encode(&["sheep".into(), "mug".into()]).unwrap();
        assert_eq!(found, [Some(vec![0.6, 0.8]), None]);
        let e = t.unknown("coffe mugg").to_string();
        assert!(e.contains("one of its 3 names, such as \"coffee mug\", \"coffee\""), "{e}");
    }

    fn zipped(name: &str, files: &[(String, Vec<u8>)]) -> Result<TextSource> {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join(name);
        let mut archive = zip::ZipWriter::new(std::fs::File::create(&path).unwrap());
        for (name, bytes) in files {
            archive.start_file(name, zip::write::SimpleFileOptions::default()).unwrap();
            std::io::Write::write_all(&mut archive, bytes).unwrap();
        }
        archive.finish().unwrap();
        Ok(TextSource::Table(TextTable::read(&path)?))
    }

    fn npz(entries: &[(&str, ArrayD<f32>)]) -> Result<TextSource> {
        let dir = tempfile::tempdir().unwrap();
        let file = |(name, array): &(&str, ArrayD<f32>)| {
            let path = dir.path().join("a.npy");
            gs_io::npy::write_f32(&path, array).unwrap();
            (format!("{name}.npy"), std::fs::read(&path).unwrap())
        };
        zipped("text.npz", &entries.iter().map(file).collect::<Vec<_>>())
    }

    #[test]
    fn opengaussians_table_reads_in_the_zip_that_it_comes_in() {
        let file = |name: &str, content: &str| (name.to_string(), content.as_bytes().to_vec());
        let table = file("assets/text_features.json", r#"{"coffee mug": [1, 0], "sheep": [0.6, 0.8]}"#);
        // As the Finder packs it, too.
        let finder = file("__MACOSX/assets/._text_features.json", "Mac OS X");
        for files in [&[table.clone()][..], &[finder, table]] {
            let t = zipped("text_features.zip", files).unwrap();
            assert_eq!(t.encode(&["sheep".into()]).unwrap(), [Some(vec![0.6, 0.8])]);
        }
        let refused = |files: &[_], part: &str| {
            let e = zipped("text_features.zip", files).err().unwrap().to_string();
            assert!(e.contains("text_features.zip") && e.contains(part), "{e}");
        };
        refused(
            &[file("notes.txt", "x")],
            "no text features in this zip; found 1 files: notes.txt, expected text_features.json",
        );
        refused(&[file("text_features.json", "[1]")], "text_features.json: not a table of text features");
        refused(&[file("text_features.json", &" ".repeat((1 << 24) + 1))], "too large for text features");
    }

    #[test]
    fn an_npz_is_a_table_too() {
        let [mug, sheep] = [arr1(&[1.0, 0.0]).into_dyn(), arr2(&[[0.6, 0.8]]).into_dyn()];
        let t = npz(&[("coffee mug", mug), ("sheep", sheep)]).unwrap();
        assert_eq!(t.encode(&["sheep".into()]).unwrap(), [Some(vec![0.6, 0.8])]);
        assert_eq!((t.dim(), t.names()), (2, vec!["coffee mug".to_string(), "sheep".into()]));
        let e = npz(&[("a", ArrayD::zeros(vec![2, 2]))]).err().unwrap().to_string();
        assert!(e.contains("text.npz: a: not a vector; found [2, 2], expected [d] or [1, d]"), "{e}");
        let e = npz(&[("a", arr1(&[f32::NAN]).into_dyn())]).err().unwrap().to_string();
        assert!(e.contains("a: a number is not finite"), "{e}");
        assert!(npz(&[]).err().unwrap().to_string().contains("no text features"));
        assert!(table("PK\u{3}\u{4}cut").err().unwrap().to_string().contains("not a readable zip"));
    }

    #[test]
    fn templates_are_averaged_as_directions() {
        let t = table(r#"{"a cup": [3, 0], "the cup": [0, 1], "cup": [1, 1]}"#).unwrap();
        let templates = ["a {}".to_string(), "the {}".into()];
        let found = t.encode_in(&templates, &["cup".into(), "pot".into()]).unwrap();
        let half = std::f32::consts::FRAC_1_SQRT_2;
        assert_eq!(found, [Some(vec![half, half]), None], "each template counts alike, whatever its length");
        assert_eq!(t.encode_in(&[], &["cup".into()]).unwrap(), [Some(vec![1.0, 1.0])]);
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
    #[ignore = "needs opengaussian_text_features.json; run make test-data"]
    fn opengaussians_table_reads() {
        let path =
            Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../../shared/data/text/opengaussian_text_features.json");
        let t = TextSource::Table(TextTable::read(path).unwrap());
        assert_eq!(t.dim(), 512);
        let v = t.encode(&["coffee mug".into()]).unwrap().remove(0).unwrap();
        let norm: f32 = v.iter().map(|x| x * x).sum::<f32>().sqrt();
        assert!((norm - 1.0).abs() < 1e-3);
    }
}
