//! Panoptic models through ONNX: every thing in a photograph with its name, in one run.
//!
//! A folder holds what the Hugging Face hub has beside an export: `onnx/model.onnx` or `model.onnx`, `config.json` (the
//! names of the classes and the kind of model) and `preprocessor_config.json` (how the photograph is shown). `model.json`
//! is for what these don't say, and may be missing. `segments` makes ids of the model's answer.

pub(crate) mod segments;

use crate::constants::{FILE, Numbers, constant};
use gs_io::{Error, IoContext, Result, check_name, hash_bytes, hash_files};
use ndarray::Array2;
use onnx_models::{EngineOptions, Kind, Model, Outputs, RgbImage, Tensor, ValueInfo, hash_model, open, resize_rgb};
use segments::Rule;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

const CONFIG: &str = "config.json";
const PREPROCESSOR: &str = "preprocessor_config.json";
/// Input that says which pixels belong to the photograph.
const PIXEL_MASK: &str = "pixel_mask";
/// Longest side of the picture that a model is shown.
pub(crate) const LONGEST: usize = 8192;

/// What the model sees in one photograph.
#[derive(Debug, Clone, PartialEq)]
pub struct Segments {
    /// Ids of the segments `[height][width]`, -1 for none.
    pub ids: Array2<i32>,
    /// The segment of each id.
    pub masks: Vec<Segment>,
}

/// One thing, or one area such as a wall.
#[derive(Debug, Clone, PartialEq)]
pub struct Segment {
    /// Its class, as `config.json` names it.
    pub name: String,
    /// How sure the model is of the class, 0 to 1.
    pub score: f32,
}

/// Kind of model: names of the outputs and rules differ.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Family {
    Detr,
    Mask2Former,
    OneFormer,
    Eomt,
}

impl Family {
    fn of(model_type: &str) -> Option<Self> {
        let all = [
            ("detr", Self::Detr),
            ("mask2former", Self::Mask2Former),
            ("oneformer", Self::OneFormer),
            ("eomt", Self::Eomt),
        ];
        all.iter().find(|f| f.0 == model_type).map(|f| f.1)
    }

    /// Names of the outputs: logits of classes and of masks.
    fn outputs(self) -> [&'static str; 2] {
        if self == Self::Detr { ["logits", "pred_masks"] } else { ["class_queries_logits", "masks_queries_logits"] }
    }
}

/// `config.json`, as far as it matters.
#[derive(Deserialize)]
struct Config {
    model_type: String,
    id2label: BTreeMap<usize, String>,
}

/// `preprocessor_config.json`, as far as it matters.
#[derive(Deserialize)]
#[serde(default)]
struct Preprocessor {
    do_rescale: bool,
    rescale_factor: f32,
    do_normalize: bool,
    /// Of each channel, of rescaled pixels.
    image_mean: [f32; 3],
    image_std: [f32; 3],
    size: Size,
    /// Width and height are multiples of it.
    size_divisor: Option<usize>,
}

impl Default for Preprocessor {
    fn default() -> Self {
        Self {
            do_rescale: true,
            rescale_factor: 1.0 / 255.0,
            do_normalize: true,
            image_mean: [0.485, 0.456, 0.406],
            image_std: [0.229, 0.224, 0.225],
            size: Size::default(),
            size_divisor: None,
        }
    }
}

/// Size of the picture that the model is shown, in pixels: the lengths of its edges at most, or exactly.
#[derive(Debug, Default, Deserialize)]
struct Size {
    shortest_edge: Option<usize>,
    longest_edge: Option<usize>,
    height: Option<usize>,
    width: Option<usize>,
}

/// `model.json`.
#[derive(Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Settings {
    constants: BTreeMap<String, Numbers>,
    threshold: Option<f32>,
    mask_threshold: f32,
    overlap: f64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { constants: BTreeMap::new(), threshold: None, mask_threshold: 0.5, overlap: 0.8 }
    }
}

/// How large a photograph is shown.
enum Frame {
    /// Width and height, whatever its shape.
    Stretched([usize; 2]),
    /// In its shape within this width and height, with black to the right and below.
    Padded([usize; 2]),
    /// In its shape: lengths of the shortest and longest edge; width and height are rounded up to multiples of the third.
    Scaled(usize, usize, usize),
}

impl Frame {
    /// Width and height of the photograph as it is shown, and of the picture that it lies in.
    fn of(&self, image: &RgbImage) -> [[usize; 2]; 2] {
        let sides = [image.width, image.height].map(|n| n as f64);
        let scaled = |by: f64| sides.map(|n| ((n * by).round_ties_even() as usize).max(1));
        match *self {
            Self::Stretched(size) => [size; 2],
            Self::Padded(size) => [scaled((size[0] as f64 / sides[0]).min(size[1] as f64 / sides[1])), size],
            Self::Scaled(shortest, longest, divisor) => {
                let by = shortest as f64 / sides[0].min(sides[1]);
                let by = by.min(longest as f64 / sides[0].max(sides[1]));
                [scaled(by).map(|n| n.next_multiple_of(divisor)); 2]
            }
        }
    }
}

/// A panoptic model.
pub struct Panoptic {
    model: Box<dyn Model>,
    rule: Rule,
    names: BTreeMap<usize, String>,
    config: PathBuf,
    frame: Frame,
    /// Factor and sum for the 8-bit values of each channel.
    norm: [(f32, f32); 3],
    /// Name of the input for the picture.
    picture: String,
    /// Extents of `pixel_mask` `[1, height, width]`, those of the picture where they are free.
    mask: Option<[Option<usize>; 2]>,
    constants: Vec<(String, Tensor<'static>)>,
    /// Which outputs are the logits of classes and of masks.
    outputs: [usize; 2],
    hash: String,
}

/// Reads a file that describes a model.
pub(crate) fn read<T: DeserializeOwned>(path: &Path) -> Result<T> {
    if !path.exists() {
        return Err(Error::new("no such file").file(path).hint("copy it from the page that the model is from"));
    }
    let wrong = |e| Error::new(format!("not what describes such a model: {e}")).file(path);
    serde_json::from_slice(&std::fs::read(path).at("read", path)?)
        .map_err(|e| wrong(e).hint("docs/masks.md says what the folder holds"))
}

pub(crate) fn names(values: &[ValueInfo]) -> String {
    values.iter().map(|v| v.name.as_str()).collect::<Vec<_>>().join(", ")
}

impl Panoptic {
    /// Opens the model of a folder.
    ///
    /// # Errors
    /// When a file is missing, damaged or not of a panoptic model, or the engine lacks an operator.
    pub fn open(folder: impl AsRef<Path>, options: &EngineOptions) -> Result<Self> {
        let folder = folder.as_ref();
        let paths = ["onnx/model.onnx", "model.onnx"].map(|n| folder.join(n));
        let Some(path) = paths.iter().find(|p| p.exists()) else {
            return Err(Error::new("no such model")
                .file(&paths[1])
                .hint("give a folder with model.onnx or onnx/model.onnx, config.json and preprocessor_config.json"));
        };
        let [config, preprocessor, description] = [CONFIG, PREPROCESSOR, FILE].map(|n| folder.join(n));
        let Config { model_type, id2label } = read(&config)?;
        for (label, name) in &id2label {
            let empty = || Error::new("a class without a name");
            let checked = if name.is_empty() { Err(empty()) } else { check_name(name) };
            checked.map_err(|e| e.file(&config).field(format!("id2label.{label}")))?;
        }
        let family = Family::of(&model_type).ok_or_else(|| {
            let what = "not a kind of panoptic model that this program knows";
            Error::new(what)
                .file(&config)
                .field("model_type")
                .found(&model_type)
                .expected("detr, mask2former, oneformer or eomt")
        })?;
        let shown: Preprocessor = read(&preprocessor)?;
        let settings = if description.exists() { read(&description)? } else { Settings::default() };
        let rule = rule(family, &settings, &description)?;
        let norm = norm(&shown, &preprocessor)?;

        let model = open(path, Outputs::Declared, &EngineOptions { threads_per_run: 0, ..options.clone() })?;
        let is_picture =
            |v: &&ValueInfo| v.kind != Some(Kind::Integer) && v.shape.as_ref().is_some_and(|s| s.len() == 4);
        let picture = model.inputs().iter().find(is_picture).ok_or_else(|| {
            let wrong = Error::new("the model has no input for a picture").file(path).found(names(model.inputs()));
            wrong.expected("floats [1, 3, height, width]").hint("give a panoptic model")
        })?;
        let frame = frame(family, picture, &shown, &preprocessor)?;
        let (mut mask, mut constants) = (None, Vec::new());
        for input in model.inputs().iter().filter(|i| i.name != picture.name) {
            match settings.constants.get(&input.name) {
                Some(numbers) => constants.push((input.name.clone(), constant(input, numbers, path)?)),
                None if input.name == PIXEL_MASK => {
                    mask = Some([1, 2].map(|axis| input.fixed(axis).filter(|n| *n <= LONGEST)));
                }
                None => {
                    return Err(Error::new("nothing says what this input gets")
                        .file(path)
                        .field(&input.name)
                        .expected(format!("its numbers under constants of {FILE}")));
                }
            }
        }
        if let Some(name) = settings.constants.keys().find(|n| constants.iter().all(|c| c.0 != **n)) {
            let unknown =
                Error::new("the model has no such input").file(&description).field(format!("constants.{name}"));
            return Err(unknown.expected(format!("one of {}", names(model.inputs()))));
        }
        let place = |name: &str| {
            model.outputs().iter().position(|o| o.name == name).ok_or_else(|| {
                let missing =
                    Error::new("the model has no such output").file(path).field(name).found(names(model.outputs()));
                missing.hint(format!("export the {model_type} model for segmentation"))
            })
        };
        let [classes, masks] = family.outputs();
        let outputs = [place(classes)?, place(masks)?];
        let mut files = vec![(CONFIG, &config), (PREPROCESSOR, &preprocessor)];
        files.extend(description.exists().then_some((FILE, &description)));
        let hash = hash_bytes((hash_model(path)? + &hash_files(files)?).as_bytes());
        let picture = picture.name.clone();
        Ok(Self { model, rule, names: id2label, config, frame, norm, picture, mask, constants, outputs, hash })
    }

    /// Content hash of the model and of what describes it.
    pub fn hash(&self) -> &str {
        &self.hash
    }

    /// The segments of a photograph in a map of `size`, width and height in pixels. Takes memory for the masks of the sure
    /// queries at the model's resolution, and for the map; uses the threads of rayon's pool.
    ///
    /// # Errors
    /// When the engine fails, the model's answer is not that of a panoptic model, or a class has no name.
    pub fn segments(&self, image: &RgbImage, size: [usize; 2]) -> Result<Segments> {
        let frame = self.frame.of(image);
        let [[width, height], input] = frame;
        let pixels = planes(&resize_rgb(image, width, height), input, &self.norm);
        let mut inputs = vec![(self.picture.as_str(), Tensor::f32(&[1, 3, input[1], input[0]], pixels))];
        inputs.extend(self.constants.iter().map(|(name, value)| (name.as_str(), value.view())));
        if let Some([h, w]) = self.mask {
            let (h, w) = (h.unwrap_or(input[1]), w.unwrap_or(input[0]));
            inputs.push((PIXEL_MASK, Tensor::i32(&[1, h, w], vec![1; h * w])));
        }
        let out = self.model.run(&inputs)?;
        let [classes, masks] = self.outputs.map(|i| &out[i]);
        let wrong = |what: &str| Error::new(what).file(self.model.path());
        let (logits, columns, shape, mask_logits) = match (&classes.shape[..], &masks.shape[..]) {
            (&[1, q, columns], &[1, n, h, w]) if q == n && columns > 1 && w * h > 0 => {
                (classes.as_f32(), columns, [h, w], masks.as_f32())
            }
            _ => {
                let [a, b] = self.rule.family.outputs();
                return Err(wrong("the model's outputs have other shapes")
                    .found(format!("{a} {:?} and {b} {:?}", classes.shape, masks.shape))
                    .expected("[1, queries, classes + 1] and [1, queries, height, width]"));
            }
        };
        let finite = |values: &&[f32]| values.iter().all(|v| v.is_finite());
        let (Some(logits), Some(mask_logits)) = (logits.filter(finite), mask_logits.filter(finite)) else {
            return Err(wrong("the model does not give finite numbers"));
        };
        let queries = self.rule.sure(logits, columns - 1);
        if let Some(query) = queries.iter().find(|q| !self.names.contains_key(&q.class)) {
            return Err(Error::new("the model found a class without a name")
                .file(&self.config)
                .field("id2label")
                .found(format!("no {}", query.class))
                .expected(format!("names for 0 to {}", columns - 2))
                .hint(format!("copy {CONFIG} from where the model is from")));
        }
        let (ids, found) = self.rule.segments(queries, mask_logits, shape, frame, size);
        let segment = |q: &segments::Query| Segment { name: self.names[&q.class].clone(), score: q.score };
        let ids = Array2::from_shape_vec((size[1], size[0]), ids).expect("as many ids as the map has pixels");
        Ok(Segments { ids, masks: found.iter().map(segment).collect() })
    }
}

/// The channels of a picture one after the other, with black to the right and below up to a width and height; `norm` has a factor
/// and a sum for the 8-bit values of each.
pub(crate) fn planes(image: &RgbImage, [width, height]: [usize; 2], norm: &[(f32, f32); 3]) -> Vec<f32> {
    let mut pixels = Vec::with_capacity(3 * width * height);
    for (c, (factor, sum)) in norm.iter().enumerate() {
        let norm = |v: u8| f32::from(v) * factor + sum;
        for row in image.pixels.chunks_exact(3 * image.width) {
            pixels.extend(row.iter().skip(c).step_by(3).map(|&v| norm(v)));
            pixels.extend(std::iter::repeat_n(norm(0), width - image.width));
        }
        pixels.resize((c + 1) * width * height, norm(0));
    }
    pixels
}

fn rule(family: Family, settings: &Settings, path: &Path) -> Result<Rule> {
    let threshold = settings.threshold.unwrap_or(if family == Family::Eomt { 0.8 } else { 0.5 });
    let shares = [
        ("threshold", threshold.into()),
        ("mask_threshold", settings.mask_threshold.into()),
        ("overlap", settings.overlap),
    ];
    check_shares(&shares, path)?;
    Ok(Rule { family, threshold, mask_threshold: settings.mask_threshold, overlap: settings.overlap })
}

/// Refuses fields of a file, each with its value, that are not from 0 to 1.
pub(crate) fn check_shares(shares: &[(&str, f64)], path: &Path) -> Result<()> {
    shares.iter().find(|s| !(0.0..=1.0).contains(&s.1)).map_or(Ok(()), |(field, found)| {
        Err(Error::new("not a usable value").file(path).field(*field).found(found).expected("0 to 1"))
    })
}

/// Factor and sum for the 8-bit values of each channel.
fn norm(shown: &Preprocessor, path: &Path) -> Result<[(f32, f32); 3]> {
    let factor = if shown.do_rescale { shown.rescale_factor } else { 1.0 };
    let (mean, std) = if shown.do_normalize { (shown.image_mean, shown.image_std) } else { ([0.0; 3], [1.0; 3]) };
    scaled(factor, mean, std).ok_or_else(|| {
        Error::new("not a usable value")
            .file(path)
            .field("rescale_factor, image_mean or image_std")
            .found(format!("{factor}, {mean:?}, {std:?}"))
            .expected("finite numbers, the first and the last positive")
    })
}

/// Factor and sum for 8-bit values that are multiplied by `factor`, then lose a mean and are divided by a deviation; None where these are
/// no positive or no finite numbers.
pub(crate) fn scaled(factor: f32, mean: [f32; 3], std: [f32; 3]) -> Option<[(f32, f32); 3]> {
    let norm = [0, 1, 2].map(|c| (factor / std[c], -mean[c] / std[c]));
    let usable = factor > 0.0 && std.iter().all(|s| *s > 0.0);
    (usable && norm.iter().all(|(f, s)| f.is_finite() && s.is_finite())).then_some(norm)
}

/// How the input `picture` shows a photograph.
fn frame(family: Family, picture: &ValueInfo, shown: &Preprocessor, path: &Path) -> Result<Frame> {
    let Size { shortest_edge, longest_edge, height, width } = shown.size;
    let exact = match (picture.fixed(3).zip(picture.fixed(2)), width.zip(height)) {
        (Some((w, h)), _) | (None, Some((w, h))) => Some([w, h]),
        _ => None,
    };
    let divisor = shown.size_divisor.unwrap_or(if family == Family::Mask2Former { 32 } else { 1 });
    let frame = match (exact, shortest_edge) {
        (Some(size), _) if family == Family::Eomt => Frame::Padded(size),
        (Some(size), _) => Frame::Stretched(size),
        (None, Some(short)) if family == Family::Eomt => Frame::Padded([longest_edge.unwrap_or(short), short]),
        (None, Some(short)) => Frame::Scaled(short, longest_edge.unwrap_or(LONGEST), divisor),
        (None, None) => Frame::Stretched([0; 2]),
    };
    let (Frame::Stretched([a, b]) | Frame::Padded([a, b]) | Frame::Scaled(a, b, _)) = frame;
    if [a, b, divisor].iter().all(|n| (1..=LONGEST).contains(n)) {
        return Ok(frame);
    }
    Err(Error::new("not a usable size of pictures")
        .file(path)
        .field("size or size_divisor")
        .found(format!("{:?}, {divisor}", shown.size))
        .expected(format!("shortest_edge and longest_edge, or height and width: 1 to {LONGEST} pixels")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn photographs_are_shown_as_large_as_to_transformers() {
        let photo = |width, height| RgbImage { width, height, pixels: Vec::new() };
        let detr = Frame::Scaled(800, 1333, 1);
        assert_eq!(detr.of(&photo(640, 480)), [[1067, 800]; 2]);
        assert_eq!(detr.of(&photo(1906, 1070)), [[1333, 748]; 2]);
        assert_eq!(detr.of(&photo(748, 1333)), [[748, 1333]; 2]);
        assert_eq!(Frame::Scaled(800, 1333, 32).of(&photo(1906, 1070)), [[1344, 768]; 2]);
        assert_eq!(Frame::Padded([640, 640]).of(&photo(1906, 1070)), [[640, 359], [640, 640]]);
        assert_eq!(Frame::Stretched([512, 384]).of(&photo(9, 9000)), [[512, 384]; 2]);
    }
}
