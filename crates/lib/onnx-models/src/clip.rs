//! The two halves of a CLIP-shaped dual encoder.
//!
//! A model is a folder with `image.onnx` (pixels f32 `[n, 3, S, S]` -> `[n, d]`), `text.onnx` (token ids `[n, 77]` or `[n, l]`,
//! with or without an `attention_mask` of that shape -> `[n, d]`) and, unless OpenAI's constants are right, `clip.json` ([`ClipConfig`]). Where a graph has several outputs,
//! the one whose name ends in `_embeds` is taken, else the first. What comes out is scaled to unit length here.

use crate::{EngineOptions, Kind, Model, Outputs, Tensor, Tokenizer, hash_model, open, parallel_map};
use gs_io::{Error, IoContext, Result};
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Texts per run of a model whose batch is free. Fixed, so that results do not depend on the number of threads.
const TEXTS: usize = 16;
/// Pictures per run. With ViT-B/16 four are as fast as sixteen, and the few of a photograph are shared out among threads more evenly.
const PICTURES: usize = 4;
/// Longest side of a picture that a model may ask for; larger is a damaged configuration.
const MAX_SIZE: usize = 4096;

/// `clip.json`: what the two graphs do not tell. Every field may be left out.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ClipConfig {
    /// Which model this is, such as `ViT-B-16 laion2b_s34b_b88k`: image and text features of different models cannot be compared.
    pub name: String,
    /// Dimension of a feature; checked against the graphs. 0 when not given.
    pub dimension: usize,
    /// Side S of the pictures in pixels. When not given (0): what `image.onnx` declares, else 224.
    pub image_size: usize,
    /// Subtracted from each channel of the picture, scaled to 0..1.
    pub mean: [f32; 3],
    /// Divides each channel afterwards.
    pub std: [f32; 3],
    /// Most ids per text. When not given (0): what `text.onnx` declares, else 77.
    pub context_length: usize,
    /// Read and not used: short texts are filled with 0 ([`ClipText::encode`] says why).
    #[serde(skip_serializing)]
    pub pad_id: i32,
}

impl Default for ClipConfig {
    fn default() -> Self {
        Self {
            name: String::new(),
            dimension: 0,
            image_size: 0,
            mean: [0.481_454_66, 0.457_827_5, 0.408_210_73],
            std: [0.268_629_55, 0.261_302_6, 0.275_777_1],
            context_length: 0,
            pad_id: 0,
        }
    }
}

impl ClipConfig {
    /// Reads `clip.json` of a model folder; the defaults when there is none.
    fn read(folder: &Path) -> Result<Self> {
        let path = folder.join("clip.json");
        if !path.exists() {
            return Ok(Self::default());
        }
        let bytes = std::fs::read(&path).at("read", &path)?;
        let config: Self = serde_json::from_slice(&bytes)
            .map_err(|e| Error::new(format!("not a CLIP configuration: {e}")).file(&path))?;
        let bad = |field: &str, found: String, expected: &str| {
            Err(Error::new("not a usable value").file(&path).field(field).found(found).expected(expected))
        };
        if config.std.iter().any(|s| !s.is_finite() || *s <= 0.0) {
            return bad("std", format!("{:?}", config.std), "three positive numbers");
        }
        if config.mean.iter().any(|m| !m.is_finite()) {
            return bad("mean", format!("{:?}", config.mean), "three finite numbers");
        }
        if config.image_size > MAX_SIZE {
            return bad("image_size", config.image_size.to_string(), "at most 4096");
        }
        if config.context_length != 0 && !(3..=MAX_SIZE).contains(&config.context_length) {
            return bad("context_length", config.context_length.to_string(), "3 to 4096");
        }
        Ok(config)
    }
}

/// The input of a text encoder that says which ids count.
const MASK: &str = "attention_mask";
/// Fills short texts. A text encoder finds a text's end as the largest id, or as the first that is 49407. Hub models are fed more of
/// that id after it: ONNX says that the first of equals is the largest, but rten (0.27) takes the last. With zeros all agree.
const PAD: i32 = 0;

/// One graph of the pair: `[n, …]` in, `[n, d]` out.
struct Encoder {
    model: Box<dyn Model>,
    /// The main input, and the mask where there is one.
    inputs: Vec<String>,
    output: usize,
    dimension: usize,
    /// Items per run.
    batch: usize,
    /// Whether the graph insists on so many.
    always: bool,
    hash: String,
    config: ClipConfig,
}

impl Encoder {
    /// Opens the graph `name` of a folder, or a file, for `batch` items per run unless it insists on another number.
    fn open(
        path: &Path,
        name: &str,
        (rank, kind, batch): (usize, Kind, usize),
        options: &EngineOptions,
    ) -> Result<Self> {
        let path = &if path.is_dir() { path.join(name) } else { path.to_path_buf() };
        if !path.exists() {
            let hint = "fetch one with make clip, export one with scripts/export_clip.py, or use the one in testdata/clip-tiny";
            return Err(Error::new("no such model").file(path).hint(hint));
        }
        let config = ClipConfig::read(path.parent().unwrap_or(Path::new("")))?;
        // Before the model is in memory: hashing reads the file, too.
        let hash = hash_model(path)?;
        let model = open(path, Outputs::Declared, &EngineOptions { threads_per_run: 1, ..options.clone() })?;
        let wrong = |what: &str| Error::new(what).file(path).hint("export the model with scripts/export_clip.py");
        let (masks, given): (Vec<_>, Vec<_>) = model.inputs().iter().partition(|i| i.name == MASK);
        let [input] = given[..] else {
            let names: Vec<&str> = model.inputs().iter().map(|i| i.name.as_str()).collect();
            return Err(wrong("another number of inputs").found(names.join(", ")).expected("one"));
        };
        if input.kind.is_some_and(|k| k != kind) || input.shape.as_ref().is_some_and(|s| s.len() != rank) {
            return Err(wrong("the input is of another kind")
                .field(&input.name)
                .found(format!("{} of rank {}", input.kind.unwrap_or(kind), input.shape.as_ref().map_or(0, Vec::len)))
                .expected(format!("{kind} of rank {rank}")));
        }
        let output = model.outputs().iter().position(|o| o.name.ends_with("_embeds")).unwrap_or(0);
        let fixed = input.fixed(0);
        let (batch, always) = (fixed.unwrap_or(batch), fixed.is_some());
        let inputs = [input].into_iter().chain(masks).map(|i| i.name.clone()).collect();
        Ok(Self { inputs, output, dimension: config.dimension, batch, always, hash, model, config })
    }

    /// Features of `count` items, each unit length or zero. `fill` makes the inputs of items `range`, padded to `batch`.
    fn encode<'t>(
        &self,
        count: usize,
        fill: impl Fn(std::ops::Range<usize>, usize) -> Vec<Tensor<'t>> + Sync,
    ) -> Result<Vec<f32>> {
        let batch = self.batch;
        let parts = parallel_map(count.div_ceil(batch), |b| {
            let range = b * batch..((b + 1) * batch).min(count);
            let size = if self.always { batch } else { range.len() };
            let names = self.inputs.iter().map(String::as_str);
            let given: Vec<(&str, Tensor)> = names.zip(fill(range.clone(), size)).collect();
            let out = self.model.run(&given)?;
            let tensor = &out[self.output];
            let wrong = |what: &str| {
                Error::new(what)
                    .file(self.model.path())
                    .field(format!("output {}", self.model.outputs()[self.output].name))
                    .hint("export the model with scripts/export_clip.py")
            };
            let (&[n, d], Some(values)) = (&tensor.shape[..], tensor.as_f32()) else {
                return Err(wrong("not a feature per item")
                    .found(format!("{:?}", tensor.shape))
                    .expected("floats [n, dimension]"));
            };
            if n != size || d == 0 || (self.dimension != 0 && d != self.dimension) {
                let d = if self.dimension == 0 { "dimension".into() } else { self.dimension.to_string() };
                return Err(wrong("not a feature per item")
                    .found(format!("{:?}", tensor.shape))
                    .expected(format!("[{size}, {d}]")));
            }
            if values.iter().any(|v| !v.is_finite()) {
                return Err(wrong("the model gives numbers that are not finite"));
            }
            let mut rows = values[..range.len() * d].to_vec();
            for row in rows.chunks_exact_mut(d) {
                let norm = row.iter().map(|&v| f64::from(v) * f64::from(v)).sum::<f64>().sqrt();
                if norm > 0.0 {
                    for v in row {
                        *v = (f64::from(*v) / norm) as f32;
                    }
                }
            }
            Ok(rows)
        })?;
        Ok(parts.concat())
    }
}

/// Content hash of one half of a CLIP pair.
fn hash_in(path: &Path, name: &str) -> Option<String> {
    let folder = if path.is_dir() { path } else { path.parent()? };
    hash_model(&folder.join(name)).ok()
}

/// CLIP's image encoder.
pub struct ClipImage {
    encoder: Encoder,
    size: usize,
}

impl ClipImage {
    /// Pictures that are encoded in one run of the model, where the graph does not fix another number.
    pub const BATCH: usize = PICTURES;

    /// Opens `image.onnx` and `clip.json` of a folder, or a file and the `clip.json` beside it. The model runs once, on
    /// black, which checks it and gives its dimension.
    ///
    /// # Errors
    /// When a file is missing or damaged, or the graph is not `[n, 3, S, S]` -> `[n, d]`.
    pub fn open(path: impl AsRef<Path>, options: &EngineOptions) -> Result<Self> {
        let encoder = Encoder::open(path.as_ref(), "image.onnx", (4, Kind::Float, PICTURES), options)?;
        let declared = encoder.model.inputs()[0].fixed(2).unwrap_or(224).min(MAX_SIZE);
        let size = if encoder.config.image_size > 0 { encoder.config.image_size } else { declared };
        let mut this = Self { encoder, size };
        this.encoder.dimension = this.encode(&vec![0; 3 * size * size])?.len();
        Ok(this)
    }

    /// What is known of the model.
    pub fn config(&self) -> &ClipConfig {
        &self.encoder.config
    }

    /// Side S of the pictures in pixels.
    pub fn size(&self) -> usize {
        self.size
    }

    /// Dimension of a feature.
    pub fn dimension(&self) -> usize {
        self.encoder.dimension
    }

    /// Content hash of the graph.
    pub fn hash(&self) -> &str {
        &self.encoder.hash
    }

    /// [`Self::hash`] of the model in a folder, or beside a file, without opening it; None where there is none.
    pub fn hash_in(path: impl AsRef<Path>) -> Option<String> {
        hash_in(path.as_ref(), "image.onnx")
    }

    /// Features `[n][d]`, each of unit length, of `n` pictures `[n][3][S][S]` as [`crate::crop_mask`] gives them.
    ///
    /// # Errors
    /// When the engine fails, or the model gives something other than `[n, d]` finite floats.
    ///
    /// # Panics
    /// When `crops` is not a whole number of pictures: a programming error.
    pub fn encode(&self, crops: &[u8]) -> Result<Vec<f32>> {
        let plane = self.size * self.size;
        assert_eq!(crops.len() % (3 * plane), 0, "whole pictures");
        self.encoder.encode(crops.len() / (3 * plane), |range, batch| {
            let mut pixels = Vec::with_capacity(batch * 3 * plane);
            for (c, values) in crops[range.start * 3 * plane..range.end * 3 * plane].chunks_exact(plane).enumerate() {
                let (mean, std) = (self.encoder.config.mean[c % 3], self.encoder.config.std[c % 3]);
                pixels.extend(values.iter().map(|&v| (f32::from(v) / 255.0 - mean) / std));
            }
            pixels.resize(batch * 3 * plane, 0.0);
            vec![Tensor::f32(&[batch, 3, self.size, self.size], pixels)]
        })
    }
}

/// CLIP's text encoder with its tokenizer.
pub struct ClipText {
    encoder: Encoder,
    /// Most ids of a text.
    most: usize,
    /// Whether every text has so many, because the graph takes no fewer.
    always: bool,
    tokenizer: Tokenizer,
}

impl ClipText {
    /// Opens `text.onnx` and `clip.json` of a folder, or a file and the `clip.json` beside it. The model runs once, on
    /// an empty text, which checks it and gives its dimension and whether it takes short texts.
    ///
    /// # Errors
    /// When a file is missing or damaged, or the graph is not `[n, 77]` -> `[n, d]`.
    pub fn open(path: impl AsRef<Path>, options: &EngineOptions) -> Result<Self> {
        let encoder = Encoder::open(path.as_ref(), "text.onnx", (2, Kind::Integer, TEXTS), options)?;
        let fixed = encoder.model.inputs()[0].fixed(1).filter(|&l| (3..=MAX_SIZE).contains(&l));
        let given = Some(encoder.config.context_length).filter(|&l| l > 0);
        let most = given.or(fixed).unwrap_or(77);
        let mut this = Self { encoder, most, always: fixed.is_some(), tokenizer: Tokenizer::default() };
        // Some graphs leave the length open and fix it further in.
        this.always |= this.encode(&[""]).is_err();
        this.encoder.dimension = this.encode(&[""])?.len();
        Ok(this)
    }

    /// What is known of the model.
    pub fn config(&self) -> &ClipConfig {
        &self.encoder.config
    }

    /// Dimension of a feature.
    pub fn dimension(&self) -> usize {
        self.encoder.dimension
    }

    /// Content hash of the graph.
    pub fn hash(&self) -> &str {
        &self.encoder.hash
    }

    /// [`Self::hash`] of the model in a folder, or beside a file, without opening it; None where there is none.
    pub fn hash_in(path: impl AsRef<Path>) -> Option<String> {
        hash_in(path.as_ref(), "text.onnx")
    }

    /// The file of the graph.
    pub fn path(&self) -> &Path {
        self.encoder.model.path()
    }

    /// Features `[n][d]`, each of unit length, of `n` texts. Texts are as long as the longest that is encoded with them, where the graph
    /// allows it: what follows a text's end counts for nothing ([`Self::check`]).
    ///
    /// # Errors
    /// When the engine fails, or the model gives something other than `[n, d]` finite floats.
    pub fn encode(&self, texts: &[impl AsRef<str> + Sync]) -> Result<Vec<f32>> {
        self.encode_padded(texts, PAD, if self.always { self.most } else { 0 })
    }

    /// [`Self::encode`] with another id after the end of texts, and at least `least` ids a text.
    fn encode_padded(&self, texts: &[impl AsRef<str> + Sync], pad: i32, least: usize) -> Result<Vec<f32>> {
        self.encoder.encode(texts.len(), |range, batch| {
            let texts = texts[range].iter().map(AsRef::as_ref).chain(std::iter::repeat("")).take(batch);
            let texts: Vec<Vec<i32>> = texts.map(|text| self.tokenizer.encode(text, self.most)).collect();
            let length = texts.iter().map(Vec::len).max().unwrap_or(0).max(least);
            let (mut ids, mut mask) = (vec![pad; batch * length], vec![0; batch * length]);
            for (at, text) in texts.iter().enumerate() {
                ids[at * length..][..text.len()].copy_from_slice(text);
                mask[at * length..][..text.len()].fill(1);
            }
            vec![Tensor::i32(&[batch, length], ids), Tensor::i32(&[batch, length], mask)]
        })
    }

    /// Checks that what follows a text's end counts for nothing: a text has the same feature whatever fills it up, and however long.
    ///
    /// # Errors
    /// When it has not, or the engine fails.
    pub fn check(&self) -> Result<()> {
        const TEXTS: [&str; 2] = ["a photo of a cat", "mug"];
        /// Least cosine of two features that rounding alone tells apart.
        const SAME: f64 = 0.9999;
        let right = self.encode(&TEXTS)?;
        let word = self.tokenizer.encode("a", 3)[1];
        for (pad, least, how) in [(PAD, self.most, "longer"), (word, self.most, "filled with another id")] {
            let other = self.encode_padded(&TEXTS, pad, least)?;
            let cosine = |(a, b): (&[f32], &[f32])| a.iter().zip(b).map(|(&a, &b)| f64::from(a) * f64::from(b)).sum();
            let rows = right.chunks_exact(self.dimension()).zip(other.chunks_exact(self.dimension()));
            if let Some(cosine) = rows.map(cosine).find(|cosine: &f64| *cosine < SAME) {
                return Err(Error::new(format!("a text has another feature when it is {how}"))
                    .file(self.encoder.model.path())
                    .found(format!("a cosine of {cosine:.4}"))
                    .expected("1: CLIP reads a text up to its end")
                    .hint("this is no CLIP text encoder, or a damaged one: export it with scripts/export_clip.py"));
            }
        }
        Ok(())
    }
}
