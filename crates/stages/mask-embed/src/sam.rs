//! SAM through ONNX: a picture is encoded once, then asked for the masks at a point.
//!
//! The two graphs are those of SAM's own export script: an encoder with a square input of 1024 pixels, and a decoder with
//! `image_embeddings`, `point_coords`, `point_labels`, `mask_input`, `has_mask_input` and `orig_im_size`. The export
//! declares the best mask only, but computes four: one for prompts of several points, and whole, part and subpart for a
//! single one. The four are found in the graph before the choice among them and taken instead (`all_masks`); the
//! enlargement to the photograph's size, which is most of the memory and much of the time, is then never computed.

use gs_io::{Error, IoContext, Result, hash_files};
use onnx_models::{EngineOptions, Graph, Model, Outputs, RgbImage, Tensor, open, resize_rgb};
use std::path::Path;

/// Mean and standard deviation of each channel in SAM's training, of 255.
const MEAN: [f32; 3] = [123.675, 116.28, 103.53];
const STD: [f32; 3] = [58.395, 57.12, 57.375];
/// Side of the masks that the decoder makes and takes.
const MASK_SIDE: usize = 256;

/// SAM's two models.
pub struct Sam {
    encoder: Box<dyn Model>,
    decoder: Box<dyn Model>,
    side: usize,
    hash: String,
}

/// A picture as the decoder wants it.
pub struct Embedded {
    values: Tensor<'static>,
    /// Width and height of the picture within the encoder's square.
    pub frame: [usize; 2],
    /// Width and height of the picture within a mask, possibly with a fraction.
    pub extent: [f64; 2],
}

/// The decoder's answer for one point.
pub struct Candidates {
    /// Predicted IoU of each mask.
    pub quality: Vec<f32>,
    /// Logits of each mask, `[masks][MASK_SIDE][MASK_SIDE]`, of the whole square.
    pub logits: Vec<f32>,
}

impl Candidates {
    /// Logits of mask `m`, `[side][side]`.
    pub fn mask(&self, m: usize) -> &[f32] {
        &self.logits[m * MASK_SIDE * MASK_SIDE..(m + 1) * MASK_SIDE * MASK_SIDE]
    }
}

/// The values of all masks and qualities, and of the one that is declared, in the decoder's graph. `None` where the
/// graph does not choose.
///
/// The choice is `masks[arange, best]`: exporters write it as Gather of a Flatten, or as GatherND, followed by changes of
/// shape only.
fn before_choice(graph: &Graph, output: &str) -> Option<String> {
    let mut name = output.to_string();
    loop {
        let node = graph.producer(&name)?;
        let first = node.inputs.first()?.clone();
        match node.op.as_str() {
            "Unsqueeze" | "Squeeze" | "Reshape" | "Identity" | "Cast" => name = first,
            "GatherND" => return Some(first),
            "Gather" => {
                let flat = graph.producer(&first).filter(|n| n.op == "Flatten" || n.op == "Reshape")?;
                return flat.inputs.first().cloned();
            }
            _ => return None,
        }
    }
}

/// Names of the outputs to ask the decoder for: all masks and qualities where they can be found, else the declared ones.
fn all_masks(graph: &Graph) -> [String; 2] {
    let declared = ["low_res_masks", "iou_predictions"].map(String::from);
    match [before_choice(graph, &declared[0]), before_choice(graph, &declared[1])] {
        [Some(masks), Some(quality)] => [masks, quality],
        _ => declared,
    }
}

impl Sam {
    /// Side of the masks in pixels.
    pub const MASK_SIDE: usize = MASK_SIDE;

    /// Opens `encoder.onnx` and `sam.onnx` of a folder.
    ///
    /// # Errors
    /// When a file is missing or damaged, or is not SAM.
    pub fn open(folder: impl AsRef<Path>, options: &EngineOptions) -> Result<Self> {
        let folder = folder.as_ref();
        let [encoder_path, decoder_path] = ["encoder.onnx", "sam.onnx"].map(|n| folder.join(n));
        for path in [&encoder_path, &decoder_path] {
            if !path.exists() {
                return Err(Error::new("no such model")
                    .file(path)
                    .hint("`make models` fetches it, or give the folder with --sam"));
            }
        }
        let wrong = |what: &str, path: &Path| {
            Error::new(what).file(path).hint("give a folder with SAM's encoder.onnx and decoder sam.onnx")
        };
        let encoder = open(&encoder_path, Outputs::Declared, &EngineOptions { threads_per_run: 0, ..options.clone() })?;
        let [input] = encoder.inputs() else {
            return Err(wrong("SAM's encoder has one input", &encoder_path).found(encoder.inputs().len()));
        };
        let side = input.fixed(3).unwrap_or(1024);
        if input.shape.as_ref().is_none_or(|s| s.len() != 4) || !(64..=4096).contains(&side) {
            return Err(wrong("the input is not a picture", &encoder_path)
                .field(&input.name)
                .found(format!("{:?}", input.shape))
                .expected("[1, 3, 1024, 1024]"));
        }
        let bytes = std::fs::read(&decoder_path).at("read", &decoder_path)?;
        let [masks, quality] = all_masks(&Graph::parse(&bytes).map_err(|e| e.file(&decoder_path))?);
        let decoder = open(
            &decoder_path,
            Outputs::Values(&[&masks, &quality]),
            &EngineOptions { threads_per_run: 1, ..options.clone() },
        )?;
        let hash = hash_files([("encoder.onnx", &encoder_path), ("sam.onnx", &decoder_path)])?;
        Ok(Self { encoder, decoder, side, hash })
    }

    /// Content hash of both models.
    pub fn hash(&self) -> &str {
        &self.hash
    }

    /// Encodes a picture: longest side resized to the square's, zeros to the right and below.
    ///
    /// # Errors
    /// When the engine fails.
    pub fn encode(&self, image: &RgbImage) -> Result<Embedded> {
        let side = self.side;
        let scale = side as f64 / image.width.max(image.height) as f64;
        let frame = [image.width, image.height].map(|n| ((n as f64 * scale).round() as usize).clamp(1, side));
        let small = resize_rgb(image, frame[0], frame[1]);
        let mut pixels = vec![0f32; 3 * side * side];
        for (i, p) in small.pixels.chunks_exact(3).enumerate() {
            let at = i / frame[0] * side + i % frame[0];
            for c in 0..3 {
                pixels[c * side * side + at] = (f32::from(p[c]) - MEAN[c]) / STD[c];
            }
        }
        let name = self.encoder.inputs()[0].name.clone();
        let mut out = self.encoder.run(&[(&name, Tensor::f32(&[1, 3, side, side], pixels))])?;
        if out.len() != 1 || out[0].as_f32().is_none_or(|v| v.iter().any(|v| !v.is_finite())) {
            return Err(Error::new("the encoder does not give one array of finite numbers").file(self.encoder.path()));
        }
        let extent = frame.map(|n| n as f64 * MASK_SIDE as f64 / side as f64);
        Ok(Embedded { values: out.swap_remove(0), frame, extent })
    }

    /// Masks at a point of the picture, `x` and `y` in 0..1 of its width and height. One thread; may be called from
    /// several at once.
    ///
    /// # Errors
    /// When the engine fails or does not give masks of 256 x 256.
    pub fn decode(&self, embedded: &Embedded, [x, y]: [f64; 2]) -> Result<Candidates> {
        let point = [(x * embedded.frame[0] as f64) as f32, (y * embedded.frame[1] as f64) as f32];
        let out = self.decoder.run(&[
            ("image_embeddings", embedded.values.view()),
            // The second point, of label -1, stands for "no box".
            ("point_coords", Tensor::f32(&[1, 2, 2], vec![point[0], point[1], 0.0, 0.0])),
            ("point_labels", Tensor::f32(&[1, 2], vec![1.0, -1.0])),
            ("mask_input", Tensor::f32(&[1, 1, MASK_SIDE, MASK_SIDE], vec![0.0; MASK_SIDE * MASK_SIDE])),
            ("has_mask_input", Tensor::f32(&[1], vec![0.0])),
            ("orig_im_size", Tensor::f32(&[2], vec![MASK_SIDE as f32; 2])),
        ])?;
        let (Some(logits), Some(quality)) = (out[0].as_f32(), out[1].as_f32()) else {
            return Err(Error::new("the decoder's outputs are not floats").file(self.decoder.path()));
        };
        let count = quality.len();
        if count == 0 || logits.len() != count * MASK_SIDE * MASK_SIDE {
            return Err(Error::new("the decoder does not give masks of 256 x 256 and a quality for each")
                .file(self.decoder.path())
                .found(format!("{:?} and {:?}", out[0].shape, out[1].shape)));
        }
        // With several masks the first is the one for prompts of several points.
        let skip = usize::from(count == 4);
        Ok(Candidates { quality: quality[skip..].to_vec(), logits: logits[skip * MASK_SIDE * MASK_SIDE..].to_vec() })
    }
}
