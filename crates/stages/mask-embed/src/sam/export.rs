//! How an export of SAM is laid out: `model.json` beside its two graphs. What is not said there is as in SAM's own export.

use crate::constants::{FILE, Numbers, constant};
use gs_io::{Error, IoContext, Result};
use onnx_models::{Kind, Model, Tensor, ValueInfo};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::Path;

/// How a photograph gets into the encoder's square.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Fit {
    /// In its shape, with zeros to the right and below.
    Pad,
    /// Stretched to the whole square.
    Stretch,
}

/// What `model.json` says.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(super) struct Export {
    /// Names of the two files.
    pub encoder: String,
    pub decoder: String,
    /// Of each channel, of pixels in 0 to 1.
    pub mean: [f64; 3],
    pub std: [f64; 3],
    pub fit: Fit,
    /// Inputs of the decoder, and the encoder's output for each. When there are none, `image_embeddings` gets the only output.
    embeddings: BTreeMap<String, String>,
    /// Inputs of the decoder.
    points: String,
    labels: String,
    /// Side of the encoder's square in the unit of the points; 0 for pixels.
    point_frame: f32,
    /// Whether a second point, of label -1, says that there is no box.
    pad_point: bool,
    /// Inputs of the decoder that are always the same.
    constants: BTreeMap<String, Numbers>,
    /// Outputs of the decoder.
    pub masks: String,
    pub scores: String,
}

impl Default for Export {
    fn default() -> Self {
        Self {
            encoder: "encoder.onnx".into(),
            decoder: "sam.onnx".into(),
            mean: [0.485, 0.456, 0.406],
            std: [0.229, 0.224, 0.225],
            fit: Fit::Pad,
            embeddings: BTreeMap::new(),
            points: "point_coords".into(),
            labels: "point_labels".into(),
            point_frame: 0.0,
            pad_point: true,
            constants: BTreeMap::new(),
            masks: "low_res_masks".into(),
            scores: "iou_predictions".into(),
        }
    }
}

impl Export {
    /// Reads `model.json` of a folder; the defaults when there is none.
    pub fn read(folder: &Path) -> Result<Self> {
        let path = folder.join(FILE);
        if !path.exists() {
            return Ok(Self::default());
        }
        let bytes = std::fs::read(&path).at("read", &path)?;
        let export: Self = serde_json::from_slice(&bytes).map_err(|e| {
            Error::new(format!("not a description of SAM's graphs: {e}"))
                .file(&path)
                .hint("docs/masks.md lists the fields")
        })?;
        let bad = |field: &str, found: String, expected: &str| {
            Err(Error::new("not a usable value").file(&path).field(field).found(found).expected(expected))
        };
        if export.std.iter().any(|s| !s.is_finite() || *s <= 0.0) {
            return bad("std", format!("{:?}", export.std), "three positive numbers");
        }
        if export.mean.iter().any(|m| !m.is_finite()) {
            return bad("mean", format!("{:?}", export.mean), "three finite numbers");
        }
        if !(0.0..=4096.0).contains(&export.point_frame) {
            return bad("point_frame", export.point_frame.to_string(), "0 to 4096");
        }
        Ok(export)
    }
}

/// What a decoder's graph is asked with.
pub(super) struct Prompt {
    /// Inputs that are the encoder's outputs, and which.
    embeddings: Vec<(String, usize)>,
    /// Names and ranks.
    points: (String, usize),
    labels: (String, usize),
    /// Labels are integers.
    whole_labels: bool,
    constants: Vec<(String, Tensor<'static>)>,
    pad_point: bool,
    /// Of the encoder's pixels.
    scale: f32,
}

impl Prompt {
    /// That of two graphs; `side` is the encoder's.
    pub fn new(export: &Export, encoder: &dyn Model, decoder: &dyn Model, side: usize) -> Result<Self> {
        let names = |all: &[ValueInfo]| all.iter().map(|v| v.name.clone()).collect::<Vec<_>>().join(", ");
        let wrong = |what: &str, model: &dyn Model, name: &str| {
            Error::new(what).file(model.path()).field(name).hint(format!("docs/masks.md says what {FILE} holds"))
        };
        let input = |name: &str| {
            let missing = || wrong("the decoder has no such input", decoder, name).expected(names(decoder.inputs()));
            decoder.inputs().iter().find(|i| i.name == name).ok_or_else(missing)
        };
        let rank = |info: &ValueInfo, least: usize| -> Result<(String, usize)> {
            let rank = info.shape.as_ref().map_or(least, Vec::len);
            if (least..=least + 1).contains(&rank) {
                return Ok((info.name.clone(), rank));
            }
            let expected = format!("an array of rank {least} or {}", least + 1);
            Err(wrong("not an input for points", decoder, &info.name).found(format!("rank {rank}")).expected(expected))
        };
        let mut embeddings = Vec::new();
        for (to, from) in &export.embeddings {
            let at = encoder.outputs().iter().position(|o| o.name == *from);
            let missing = || wrong("the encoder has no such output", encoder, from).expected(names(encoder.outputs()));
            embeddings.push((input(to)?.name.clone(), at.ok_or_else(missing)?));
        }
        if embeddings.is_empty() {
            if encoder.outputs().len() != 1 {
                let what = "the encoder has several outputs, and nothing says where they go";
                return Err(wrong(what, encoder, "embeddings").found(names(encoder.outputs())));
            }
            embeddings.push((input("image_embeddings")?.name.clone(), 0));
        }
        let points = rank(input(&export.points)?, 3)?;
        let labels = input(&export.labels)?;
        let whole_labels = labels.kind == Some(Kind::Integer);
        let labels = rank(labels, 2)?;
        let mut constants = Vec::new();
        // What SAM's own export wants besides.
        let side_of_masks = Numbers::Each(vec![super::MASK_SIDE as f32; 2]);
        let own =
            [("mask_input", Numbers::All(0.0)), ("has_mask_input", Numbers::All(0.0)), ("orig_im_size", side_of_masks)];
        for (name, numbers) in &export.constants {
            constants.push((name.clone(), constant(input(name)?, numbers, decoder.path())?));
        }
        for info in decoder.inputs() {
            let given = constants.iter().map(|c| &c.0).chain(embeddings.iter().map(|e| &e.0));
            match given.chain([&points.0, &labels.0]).filter(|n| **n == info.name).count() {
                0 => {}
                1 => continue,
                _ => return Err(wrong("the input of the decoder is named twice", decoder, &info.name)),
            }
            let Some((_, numbers)) = own.iter().find(|o| o.0 == info.name) else {
                return Err(wrong("nothing says what this input of the decoder gets", decoder, &info.name)
                    .expected(format!("it under embeddings, points, labels or constants of {FILE}")));
            };
            constants.push((info.name.clone(), constant(info, numbers, decoder.path())?));
        }
        let scale = if export.point_frame > 0.0 { export.point_frame / side as f32 } else { 1.0 };
        Ok(Self { embeddings, points, labels, whole_labels, constants, pad_point: export.pad_point, scale })
    }

    /// The encoder's outputs that the decoder is asked with, in the order of [`Self::inputs`].
    pub fn outputs(&self) -> impl Iterator<Item = usize> + '_ {
        self.embeddings.iter().map(|e| e.1)
    }

    /// Name of the embedding, where there is only one.
    pub fn only_embedding(&self) -> Option<&str> {
        let [(name, _)] = &self.embeddings[..] else { return None };
        Some(name)
    }

    /// The inputs for a point in the encoder's pixels.
    pub fn inputs<'a>(&'a self, values: &'a [Tensor], point: [f32; 2]) -> Vec<(&'a str, Tensor<'a>)> {
        let count = 1 + usize::from(self.pad_point);
        let axes = |rank: usize, last: &[usize]| [&vec![1; rank - last.len()], last].concat();
        let place = [point[0] * self.scale, point[1] * self.scale, 0.0, 0.0];
        let points = Tensor::f32(&axes(self.points.1, &[count, 2]), place[..2 * count].to_vec());
        let shape = axes(self.labels.1, &[count]);
        let labels = if self.whole_labels {
            Tensor::i32(&shape, [1, -1][..count].to_vec())
        } else {
            Tensor::f32(&shape, [1.0, -1.0][..count].to_vec())
        };
        let embeddings = self.embeddings.iter().zip(values).map(|((name, _), value)| (name.as_str(), value.view()));
        let constants = self.constants.iter().map(|(name, value)| (name.as_str(), value.view()));
        embeddings.chain([(self.points.0.as_str(), points), (&self.labels.0, labels)]).chain(constants).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pixels_are_normed_as_in_sams_training() {
        let of_255 = |v: [f64; 3]| v.map(|v| (v * 255.0) as f32);
        let Export { mean, std, .. } = Export::default();
        assert_eq!((of_255(mean), of_255(std)), ([123.675, 116.28, 103.53], [58.395, 57.12, 57.375]));
    }
}
