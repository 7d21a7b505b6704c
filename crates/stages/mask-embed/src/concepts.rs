//! Models that are asked for nouns, through ONNX: SAM 3 and its kin.
//!
//! A folder holds three graphs, by default as samexporter 0.5 (`export_sam3`) names them: one sees a photograph, one reads a noun, and the
//! decoder gives masks with scores for both. Other exports have a `model.json` (docs/masks.md). Nouns are read once in a run.

use crate::constants::{FILE, Numbers, constant};
use crate::logits::{Grid, Logits};
use crate::nms::Pixels;
use crate::panoptic::segments::sigmoid;
use crate::panoptic::{LONGEST, Segment, Segments, check_shares, names, planes, read, scaled};
use gs_io::{Error, Result, hash_bytes, hash_files};
use ndarray::Array2;
use onnx_models::{
    EngineOptions, Kind, Model, Outputs, RgbImage, Tensor, Tokenizer, ValueInfo, hash_model, open, resize_rgb,
};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::Path;

/// Side of the picture, in pixels, and ids of a noun, where the graphs leave them open.
const SIDE: usize = 1008;
const IDS: usize = 32;
/// Outputs of the decoder: logits of the queries, their masks, and, beginning so, one that says whether there is such a thing at all.
const OUTPUTS: [&str; 3] = ["pred_logits", "pred_masks", "presence_logit"];
/// samexporter's inputs of the decoder, with the outputs of the text encoder that they get.
const INPUTS: [[&str; 2]; 3] = [
    ["language_mask", "text_attention_mask"],
    ["language_features", "text_memory"],
    ["language_embeds", "text_embeds"],
];
/// What others of its inputs get: no boxes, and a size that only older exports used.
const CONSTANTS: [(&str, f32); 5] = [
    ("box_coords", 0.0),
    ("box_labels", 1.0),
    ("box_masks", 1.0),
    ("original_height", 1008.0),
    ("original_width", 1008.0),
];

/// `model.json`.
#[derive(Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Layout {
    /// Names of the graphs.
    image: String,
    text: String,
    decoder: String,
    /// Of each channel, of pixels in 0 to 1; not for graphs that take integers.
    mean: [f32; 3],
    std: [f32; 3],
    /// Inputs of the decoder, with the outputs of the other two that they get; without, those of the same name.
    inputs: BTreeMap<String, String>,
    /// What other inputs get.
    constants: BTreeMap<String, Numbers>,
    /// A query is found when its score is larger.
    threshold: f32,
    /// A mask stays when more than this share of it is not of surer ones.
    overlap: f64,
}

impl Default for Layout {
    fn default() -> Self {
        Self {
            image: "sam3_image_encoder.onnx".into(),
            text: "sam3_language_encoder.onnx".into(),
            decoder: "sam3_decoder.onnx".into(),
            mean: [0.5; 3],
            std: [0.5; 3],
            inputs: BTreeMap::new(),
            constants: BTreeMap::new(),
            threshold: 0.5,
            overlap: 0.5,
        }
    }
}

/// Where an input of the decoder comes from: an output of the graph of the photograph or of the noun, by its place.
enum Source {
    Image(usize),
    Text(usize),
    Always(Tensor<'static>),
}

/// A mask that was found for a noun.
struct Found {
    noun: usize,
    score: f32,
    grid: Grid,
    logits: Logits,
}

/// A model that is asked for nouns.
pub struct Concepts {
    image: Box<dyn Model>,
    /// Until all nouns are read.
    text: Option<Box<dyn Model>>,
    decoder: Box<dyn Model>,
    /// Width and height of the picture.
    size: [usize; 2],
    /// Factor and sum for the 8-bit values of each channel.
    norm: [(f32, f32); 3],
    /// Where each input of the decoder comes from.
    sources: Vec<(String, Source)>,
    /// Places of [`OUTPUTS`].
    outputs: [usize; 3],
    nouns: Vec<String>,
    /// Ids of each noun, filled with 0.
    ids: Vec<Vec<i32>>,
    /// What the text encoder gives for each noun so far.
    texts: Vec<Vec<Tensor<'static>>>,
    threshold: f32,
    overlap: f64,
    hash: String,
}

impl Concepts {
    /// Opens the model of a folder, to be asked for `nouns`, which are of option `--nouns`.
    ///
    /// # Errors
    /// When a file is missing, damaged or of another kind of model, the engine lacks an operator, or a noun is too long for the model.
    pub fn open(folder: impl AsRef<Path>, nouns: &[String], options: &EngineOptions) -> Result<Self> {
        let description = folder.as_ref().join(FILE);
        let layout = if description.exists() { read(&description)? } else { Layout::default() };
        let Layout { threshold, overlap, mean, std, .. } = layout;
        check_shares(&[("threshold", threshold.into()), ("overlap", overlap)], &description)?;
        let norm = scaled(1.0 / 255.0, mean, std).ok_or_else(|| {
            let e = Error::new("not a usable value").file(&description).field("mean or std");
            e.found(format!("{mean:?}, {std:?}")).expected("finite numbers, the last positive")
        })?;
        let options = EngineOptions { threads_per_run: 0, ..options.clone() };
        let paths = [&layout.image, &layout.text, &layout.decoder].map(|name| folder.as_ref().join(name));
        if let Some(missing) = paths.iter().find(|p| !p.is_file()) {
            let hint =
                format!("give a folder with the three graphs of samexporter's export_sam3, or name others in {FILE}");
            return Err(Error::new("no such model").file(missing).hint(hint));
        }
        let hashes = paths.iter().map(|p| hash_model(p)).collect::<Result<Vec<_>>>()?;
        let described = hash_files(description.exists().then_some((FILE, &description)))?;
        let hash =
            hash_bytes([&hashes.concat(), &described, &nouns.join("\n")].map(String::as_str).join("\n").as_bytes());
        let [image, text, decoder] = paths.map(|path| open(path, Outputs::Declared, &options));
        let (image, text, decoder) = (image?, text?, decoder?);

        let ([picture], [tokens]) = (image.inputs(), text.inputs()) else {
            let model = if image.inputs().len() == 1 { &text } else { &image };
            let e = Error::new("another number of inputs").file(model.path()).found(names(model.inputs()));
            return Err(e.expected("one: a picture, or the ids of a text"));
        };
        let rank = picture.shape.as_ref().map_or(4, Vec::len);
        if !(3..=4).contains(&rank) {
            let e = Error::new("not an input for a picture").file(image.path()).field(&picture.name);
            return Err(e.found(format!("{rank} axes")).expected("[3, height, width] or [1, 3, height, width]"));
        }
        let size = [rank - 1, rank - 2].map(|axis| fixed(picture, axis, SIDE));
        let norm = if picture.kind == Some(Kind::Integer) { [(1.0, 0.0); 3] } else { norm };
        let ids = ids(nouns, tokens)?;
        let sources = sources(&layout, &description, &*image, &*text, &*decoder)?;
        let place = |name: &str| {
            decoder.outputs().iter().position(|o| o.name.starts_with(name)).ok_or_else(|| {
                let e = Error::new("the model has no such output").file(decoder.path()).field(name);
                e.found(names(decoder.outputs())).hint("export it with samexporter 0.5 or later")
            })
        };
        let [logits, masks, presence] = OUTPUTS;
        let outputs = [place(logits)?, place(masks)?, place(presence)?];
        let (nouns, text, texts) = (nouns.to_vec(), Some(text), Vec::new());
        Ok(Self { image, text, decoder, size, norm, sources, outputs, nouns, ids, texts, threshold, overlap, hash })
    }

    /// Content hash of the graphs, of what describes them, and of the nouns.
    pub fn hash(&self) -> &str {
        &self.hash
    }

    /// What a photograph shows of the first `most` nouns, in a map of `size`, width and height in pixels: ids from the surest on, each with
    /// those pixels of its mask that no surer one has. Takes memory for the masks at the model's resolution, and for the map; uses the threads of rayon's pool.
    ///
    /// # Errors
    /// When the engine fails, or the model gives other shapes or numbers that are not finite.
    pub fn segments(&mut self, image: &RgbImage, size: [usize; 2], most: usize) -> Result<Segments> {
        let most = most.min(self.nouns.len());
        self.read_nouns(most)?;
        let [width, height] = self.size;
        let pixels = planes(&resize_rgb(image, width, height), self.size, &self.norm);
        let input = &self.image.inputs()[0];
        let shape = &[1, 3, height, width][4 - input.shape.as_ref().map_or(4, Vec::len)..];
        let picture = match input.kind {
            Some(Kind::Integer) => Tensor::i32(shape, pixels.iter().map(|&v| v as i32).collect::<Vec<_>>()),
            _ => Tensor::f32(shape, pixels),
        };
        let seen = self.image.run(&[(&input.name, picture)])?;
        let mut found = Vec::new();
        for noun in 0..most {
            self.look_for(noun, &seen, &mut found)?;
        }
        // Of equals the earlier noun; the sort is stable.
        found.sort_by(|a, b| b.score.total_cmp(&a.score));
        let (mut ids, mut masks) = (Array2::from_elem((size[1], size[0]), -1), Vec::new());
        for Found { noun, score, grid, logits } in &found {
            let mask = logits.enlarge(grid, size[0], size[1]);
            let (all, free) =
                mask.pixels().fold((0usize, 0usize), |n, (x, y)| (n.0 + 1, n.1 + usize::from(ids[[y, x]] < 0)));
            if free as f64 > self.overlap * all as f64 {
                for (x, y) in mask.pixels() {
                    if ids[[y, x]] < 0 {
                        ids[[y, x]] = masks.len() as i32;
                    }
                }
                masks.push(Segment { name: self.nouns[*noun].clone(), score: *score });
            }
        }
        Ok(Segments { ids, masks })
    }

    /// Reads nouns until the first `most` are.
    fn read_nouns(&mut self, most: usize) -> Result<()> {
        let Some(text) = &self.text else { return Ok(()) };
        for ids in &self.ids[self.texts.len().min(most)..most] {
            let out = text.run(&[(&text.inputs()[0].name, Tensor::i32(&[1, ids.len()], &ids[..]))])?;
            out.iter().try_for_each(|t| finite(t, text.path()))?;
            self.texts.push(out);
        }
        if self.texts.len() == self.nouns.len() {
            self.text = None;
        }
        Ok(())
    }

    /// Adds the masks of a noun in what the image encoder has seen.
    fn look_for<'a>(&'a self, noun: usize, seen: &'a [Tensor<'static>], found: &mut Vec<Found>) -> Result<()> {
        let given = |(name, source): &'a (String, Source)| {
            let value = match source {
                Source::Image(i) => &seen[*i],
                Source::Text(i) => &self.texts[noun][*i],
                Source::Always(value) => value,
            };
            (name.as_str(), value.view())
        };
        let out = self.decoder.run(&self.sources.iter().map(given).collect::<Vec<_>>())?;
        let [logits, masks, presence] = self.outputs.map(|i| &out[i]);
        [logits, masks, presence].into_iter().try_for_each(|t| finite(t, self.decoder.path()))?;
        let floats = [logits, masks, presence].map(Tensor::as_f32);
        let (&[1, queries, height, width], [Some(logits), Some(masks), Some(&[presence])]) = (&masks.shape[..], floats)
        else {
            return Err(self.other_shapes(&out));
        };
        if logits.len() != queries || width * height == 0 {
            return Err(self.other_shapes(&out));
        }
        let grid = Grid { width, height, extent: [width as f64, height as f64] };
        for (logit, mask) in logits.iter().zip(masks.chunks_exact(width * height)) {
            let score = sigmoid(*logit) * sigmoid(presence);
            if score > self.threshold {
                let pixels = Pixels::new(width, mask.iter().map(|&l| l > 0.0));
                let logits = Logits::new(|y| &mask[y * width..][..width], &grid, pixels.bounds);
                found.push(Found { noun, score, grid, logits });
            }
        }
        Ok(())
    }

    fn other_shapes(&self, out: &[Tensor]) -> Error {
        let shown = self.outputs.map(|i| format!("{} {:?}", self.decoder.outputs()[i].name, out[i].shape));
        let e = Error::new("the model's outputs have other shapes").file(self.decoder.path()).found(shown.join(", "));
        e.expected("[1, queries, 1], [1, queries, height, width] and [1, 1]")
    }
}

fn finite(values: &Tensor, model: &Path) -> Result<()> {
    match values.as_f32() {
        Some(v) if !v.iter().all(|v| v.is_finite()) => {
            Err(Error::new("the model does not give finite numbers").file(model))
        }
        _ => Ok(()),
    }
}

/// The ids of each noun as the text encoder reads them, filled with 0.
fn ids(nouns: &[String], input: &ValueInfo) -> Result<Vec<Vec<i32>>> {
    let (most, tokenizer) = (fixed(input, 1, IDS), Tokenizer::default());
    let one = |noun: &String| {
        let mut ids = tokenizer.encode(noun, usize::MAX);
        if ids.len() > most {
            let e = Error::new("a noun that is too long for the model").field("--nouns");
            let e = e.found(format!("{noun}: {} tokens", ids.len())).hint("name it in fewer words");
            return Err(e.expected(format!("at most {most}, a start and an end among them")));
        }
        ids.resize(most, 0);
        Ok(ids)
    };
    nouns.iter().map(one).collect()
}

/// The extent of an axis, or what it has where the graph leaves it open.
fn fixed(input: &ValueInfo, axis: usize, open: usize) -> usize {
    input.fixed(axis).filter(|n| *n <= LONGEST).unwrap_or(open)
}

/// Where each input of the decoder comes from.
fn sources(
    layout: &Layout,
    description: &Path,
    image: &dyn Model,
    text: &dyn Model,
    decoder: &dyn Model,
) -> Result<Vec<(String, Source)>> {
    let inputs = decoder.inputs();
    if let Some(name) =
        layout.inputs.keys().chain(layout.constants.keys()).find(|n| inputs.iter().all(|i| i.name != **n))
    {
        let e = Error::new("the decoder has no such input").file(description).field(name);
        return Err(e.expected(format!("one of {}", names(inputs))));
    }
    let source = |input: &ValueInfo| {
        let name = input.name.as_str();
        let usual = INPUTS.iter().find(|i| i[0] == name).map(|i| i[1]);
        let given = layout.inputs.get(name).map(String::as_str);
        let outputs = given.map_or_else(|| vec![Some(name), usual], |g| vec![Some(g)]);
        let place = |model: &dyn Model| model.outputs().iter().position(|o| outputs.contains(&Some(&o.name)));
        let usual = CONSTANTS.iter().find(|c| c.0 == name).map(|c| Numbers::All(c.1));
        let numbers = layout.constants.get(name);
        let source = match (numbers, place(image), place(text), numbers.or(usual.as_ref())) {
            (None, Some(i), ..) => Source::Image(i),
            (None, _, Some(i), _) => Source::Text(i),
            (.., Some(numbers)) if given.is_none() => Source::Always(constant(input, numbers, decoder.path())?),
            _ => {
                let e = Error::new("nothing says what this input gets").file(decoder.path()).field(name);
                let all = [names(image.outputs()), names(text.outputs())].join(", ");
                return Err(e
                    .found(given.unwrap_or("nothing"))
                    .expected(format!("in {FILE}, its numbers under constants or under inputs one of {all}")));
            }
        };
        Ok((name.to_string(), source))
    };
    inputs.iter().map(source).collect()
}
