//! SAM through ONNX: a picture is encoded once, then asked for the masks at a point.
//!
//! The two graphs are those of SAM's own export script: an encoder with a square input of 1024 pixels, and a decoder with
//! `image_embeddings`, `point_coords`, `point_labels`, `mask_input`, `has_mask_input` and `orig_im_size`; or others that
//! `model.json` describes (`export`). SAM's export
//! declares the best mask only, but computes four: one for prompts of several points, and whole, part and subpart for a
//! single one. The four are found in the graph before the choice among them and taken instead (`all_masks`); the
//! enlargement to the photograph's size, which is most of the memory and much of the time, is then never computed.
//! Where the decoder is built as SAM's, `decoder` takes the place of most of its graph; where the encoder is built as
//! MobileSAM's, `encoder` takes the place of its.

mod decoder;
mod encoder;
mod export;
mod planar;
mod weights;

use crate::constants::FILE;
use decoder::{Decoder, FILLING, Names, Photograph};
use encoder::Encoder;
use export::{Export, Fit, Prompt};
use gs_io::{Error, IoContext, Result, hash_files};
use onnx_models::{EngineOptions, Graph, Model, Outputs, RgbImage, Tensor, open, resize_rgb};
use std::path::{Path, PathBuf};
use weights::File;

/// Side of the masks that the decoder makes and takes.
const MASK_SIDE: usize = 256;

/// Side of the square that MobileSAM's encoder sees.
const SQUARE: usize = 4 * MASK_SIDE;
/// Hash of the files that `make models` fetches: encoder and decoder need not be compared with their graphs again (tests).
const COMPARED: &str = "0e035ee24319251cc13d9397c606d3bc206e337791e47a0d1ab5076d732ca6bd";

/// SAM's two models.
pub struct Sam {
    encoding: Encoding,
    encoder_path: PathBuf,
    decoding: Decoding,
    prompt: Prompt,
    side: usize,
    fit: Fit,
    /// Of each channel, of 255.
    mean: [f32; 3],
    std: [f32; 3],
    hash: String,
}

enum Encoding {
    Graph(Box<dyn Model>),
    /// The encoder is built as MobileSAM's.
    Own(Box<Encoder>),
}

enum Decoding {
    /// The graph gives all masks and qualities.
    Graph(Box<dyn Model>),
    /// The decoder is built as SAM's.
    Parts(Box<Parts>),
}

/// The parts of a decoder's graph that are still asked, and what takes the place of the others.
struct Parts {
    photograph: Box<dyn Model>,
    tokens: Box<dyn Model>,
    decoder: Decoder,
}

/// A picture as the decoder wants it.
pub struct Embedded {
    values: Vec<Tensor<'static>>,
    photograph: Option<Photograph>,
    /// Width of the picture by its height.
    pub aspect: f64,
    /// Width and height of the picture within the encoder's square.
    pub frame: [usize; 2],
    /// Width and height of the picture within a mask, possibly with a fraction.
    pub extent: [f64; 2],
}

/// The decoder's answer for one point.
#[derive(Debug, Clone, Default)]
pub struct Candidates {
    /// Those of sufficient predicted IoU of SAM's three: which one, 0 for the smallest, and its predicted IoU.
    pub masks: Vec<(usize, f32)>,
    /// Logits of `masks`, `[masks][MASK_SIDE][MASK_SIDE]`, of the whole square.
    pub logits: Vec<f32>,
}

impl Candidates {
    /// The masks whose predicted IoU is at least `least`. Of four masks the first is for prompts of several points, and is
    /// left out.
    fn of_graph(quality: &[f32], logits: &[f32], least: f32) -> Self {
        let skip = usize::from(quality.len() == 4);
        let mut found = Self::default();
        for (i, (&q, logits)) in quality.iter().zip(logits.chunks_exact(MASK_SIDE * MASK_SIDE)).enumerate().skip(skip) {
            // A quality that is not a number is not sufficient.
            if q >= least {
                found.masks.push((i - skip, q));
                found.logits.extend(logits);
            }
        }
        found
    }
}

/// The value from which the graph chose `output`; `None` where it does not choose.
///
/// The choice is `masks[arange, best]`: exporters write it as Gather of a Flatten, or as GatherND, followed by changes of
/// shape only.
fn before_choice(graph: &Graph, output: &str) -> Option<String> {
    let mut name = output.to_string();
    for _ in 0..16 {
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
    None
}

/// Names of the outputs to ask the decoder for: all masks and qualities where they can be found, else the declared ones.
fn all_masks(graph: &Graph, export: &Export) -> [String; 2] {
    let declared = [export.masks.clone(), export.scores.clone()];
    match [before_choice(graph, &declared[0]), before_choice(graph, &declared[1])] {
        [Some(masks), Some(quality)] => [masks, quality],
        _ => declared,
    }
}

impl Sam {
    /// Side of the masks in pixels.
    pub const MASK_SIDE: usize = MASK_SIDE;

    /// Opens the graphs of a folder: `encoder.onnx` and `sam.onnx`, or what `model.json` says. `plain` runs these and nothing of our
    /// own, for comparison.
    ///
    /// # Errors
    /// When a file is missing or damaged, or is not SAM.
    pub fn open(folder: impl AsRef<Path>, options: &EngineOptions, plain: bool) -> Result<Self> {
        let folder = folder.as_ref();
        let export = Export::read(folder)?;
        let [encoder_path, decoder_path] = [&export.encoder, &export.decoder].map(|n| folder.join(n));
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
        let graph = Graph::parse(&bytes).map_err(|e| e.file(&decoder_path))?;
        let [masks, quality] = all_masks(&graph, &export);
        let part = |values: &[&str]| {
            let options = EngineOptions { threads_per_run: 1, ..options.clone() };
            open(&decoder_path, Outputs::Values(values), &options)
        };
        let whole = part(&[&masks, &quality])?;
        let prompt = Prompt::new(&export, &*encoder, &*whole, side)?;
        let mut files = vec![("encoder.onnx", &encoder_path), ("sam.onnx", &decoder_path)];
        let description = folder.join(FILE);
        files.extend(description.exists().then_some((FILE, &description)));
        let hash = hash_files(files)?;
        let compared = hash == COMPARED;
        // Whatever keeps the parts from being made or asked, the whole graph is there.
        let parts = || {
            let (decoder, Names { photograph, tokens }) = Decoder::read(&File { graph: &graph, bytes: &bytes })?;
            let photograph = part(&photograph.each_ref().map(String::as_str)).ok()?;
            let parts = Parts { photograph, tokens: part(&[&tokens]).ok()?, decoder };
            (compared || parts.agree_with(&*whole, &prompt, side).ok()?).then(|| Box::new(parts))
        };
        let own = || {
            let (1, SQUARE) = (encoder.outputs().len(), side) else { return None };
            prompt.only_embedding()?;
            let bytes = std::fs::read(&encoder_path).ok()?;
            let own = Encoder::read(&File { graph: &Graph::parse(&bytes).ok()?, bytes: &bytes })?;
            drop(bytes);
            (compared || agree(&own, &*encoder).ok()?).then(|| Box::new(own))
        };
        let decoding = if plain { None } else { parts() };
        let encoding = if plain { None } else { own() };
        let decoding = decoding.map_or_else(|| Decoding::Graph(whole), Decoding::Parts);
        let encoding = encoding.map_or_else(|| Encoding::Graph(encoder), Encoding::Own);
        let [mean, std] = [export.mean, export.std].map(|c| c.map(|v| (v * 255.0) as f32));
        Ok(Self { encoding, encoder_path, decoding, prompt, side, fit: export.fit, mean, std, hash })
    }

    /// Content hash of both models and their description.
    pub fn hash(&self) -> &str {
        &self.hash
    }

    /// Encodes a picture.
    ///
    /// # Errors
    /// When the engine fails.
    pub fn encode(&self, image: &RgbImage) -> Result<Embedded> {
        let side = self.side;
        let scale = side as f64 / image.width.max(image.height) as f64;
        let frame = match self.fit {
            Fit::Pad => [image.width, image.height].map(|n| ((n as f64 * scale).round() as usize).clamp(1, side)),
            Fit::Stretch => [side; 2],
        };
        let small = resize_rgb(image, frame[0], frame[1]);
        let normal = |(i, p): (usize, &u8)| (f32::from(*p) - self.mean[i % 3]) / self.std[i % 3];
        let pixels: Vec<f32> = small.pixels.iter().enumerate().map(normal).collect();
        let values: Vec<Tensor> = match &self.encoding {
            Encoding::Own(encoder) => vec![encoder.encode(&pixels, frame[0], side)],
            Encoding::Graph(graph) => {
                let out = encode_by_graph(&**graph, &pixels, frame[0], side)?;
                self.prompt.outputs().map(|i| out[i].clone()).collect()
            }
        };
        if values.iter().any(|t| t.as_f32().is_none_or(|v| v.iter().any(|v| !v.is_finite()))) {
            return Err(Error::new("the encoder does not give finite numbers").file(&self.encoder_path));
        }
        let extent = frame.map(|n| n as f64 * MASK_SIDE as f64 / side as f64);
        let photograph = match &self.decoding {
            Decoding::Graph(_) => None,
            Decoding::Parts(parts) => parts.photograph(&self.prompt, &values, extent, FILLING)?,
        };
        let aspect = image.width as f64 / image.height as f64;
        Ok(Embedded { values, photograph, aspect, frame, extent })
    }

    /// Masks at a point of the picture, `x` and `y` in 0..1 of its width and height, whose predicted IoU is at least
    /// `least`. One thread; may be called from several at once.
    ///
    /// # Errors
    /// When the engine fails or does not give masks of 256 x 256.
    pub fn decode(&self, embedded: &Embedded, [x, y]: [f64; 2], least: f32) -> Result<Candidates> {
        let point = [(x * embedded.frame[0] as f64) as f32, (y * embedded.frame[1] as f64) as f32];
        let inputs = self.prompt.inputs(&embedded.values, point);
        match (&self.decoding, &embedded.photograph) {
            (Decoding::Graph(graph), _) => ask_graph(&**graph, &inputs, least),
            (Decoding::Parts(parts), Some(photograph)) => parts.ask(&inputs, photograph, least),
            (Decoding::Parts(parts), None) => Err(Error::new("the encoder's embedding does not suit the decoder")
                .file(parts.tokens.path())
                .found(format!("{:?}", embedded.values[0].shape))),
        }
    }
}

impl Parts {
    /// What the photograph alone decides, of the pixels beside it one of `filling`; `None` where the shapes are not SAM's.
    fn photograph(
        &self,
        prompt: &Prompt,
        values: &[Tensor],
        extent: [f64; 2],
        filling: usize,
    ) -> Result<Option<Photograph>> {
        let pixels = extent.map(|n| (n / 4.0).ceil() as usize);
        Ok(Photograph::new(&self.photograph.run(&prompt.inputs(values, [0.0; 2]))?, pixels, filling))
    }

    fn ask(&self, inputs: &[(&str, Tensor)], photograph: &Photograph, least: f32) -> Result<Candidates> {
        let tokens = self.tokens.run(inputs)?;
        let Some(tokens) = tokens[0].as_f32().filter(|t| self.decoder.fits(photograph, t)) else {
            return Err(Error::new("the decoder's tokens do not suit its weights").file(self.tokens.path()));
        };
        self.decoder.decode(photograph, tokens, least)
    }

    /// Whether the answer about a point is the whole graph's.
    fn agree_with(&self, whole: &dyn Model, prompt: &Prompt, side: usize) -> Result<bool> {
        let embedding = whole.inputs().iter().find(|i| prompt.only_embedding() == Some(&i.name));
        let embedding = embedding.and_then(|i| i.shape.as_ref());
        let count = |s: &[Option<usize>]| s.iter().flatten().try_fold(1usize, |n, &d| n.checked_mul(d));
        let embedding = embedding.filter(|s| count(s).is_some_and(|n| n <= 1 << 24));
        let Some(shape) = embedding.and_then(|s| s.iter().copied().collect::<Option<Vec<usize>>>()) else {
            return Ok(false);
        };
        // Any numbers of about the size of an embedding's.
        let numbers = (0..shape.iter().product()).map(|i: usize| (i as f32).sin() * (i as f32 * 0.01).cos());
        let values = [Tensor::f32(&shape, numbers.collect::<Vec<_>>())];
        let Some(photograph) = self.photograph(prompt, &values, [MASK_SIDE as f64; 2], FILLING)? else {
            return Ok(false);
        };
        let inputs = prompt.inputs(&values, [0.25, 0.75].map(|p| p * side as f32));
        let want = ask_graph(whole, &inputs, f32::NEG_INFINITY)?;
        let Ok(got) = self.ask(&inputs, &photograph, f32::NEG_INFINITY) else { return Ok(false) };
        let near = |a: f32, b: f32| (a - b).abs() <= 1e-3 * (1.0 + a.abs());
        Ok(want.masks.len() == got.masks.len()
            && want.masks.iter().zip(&got.masks).all(|(a, b)| near(a.1, b.1))
            && want.logits.iter().zip(&got.logits).all(|(&a, &b)| near(a, b)))
    }
}

/// Outputs of the encoder's graph for a picture in the upper left corner of a square of `side` pixels. `pixels` are normalised,
/// `[height][width][3]`; those beside them are zero.
fn encode_by_graph(graph: &dyn Model, pixels: &[f32], width: usize, side: usize) -> Result<Vec<Tensor<'static>>> {
    let mut planes = vec![0.0; 3 * side * side];
    for (i, pixel) in pixels.chunks_exact(3).enumerate() {
        let at = i / width * side + i % width;
        pixel.iter().enumerate().for_each(|(c, v)| planes[c * side * side + at] = *v);
    }
    graph.run(&[(&graph.inputs()[0].name, Tensor::f32(&[1, 3, side, side], planes))])
}

/// Whether our encoder gives a picture's embedding as the graph does.
fn agree(own: &Encoder, graph: &dyn Model) -> Result<bool> {
    let number = |i: usize| 2.0 * (i as f32 * 0.37).sin() * (i as f32 * 1e-4).cos();
    let pixels: Vec<f32> = (0..3 * SQUARE * SQUARE / 2).map(number).collect();
    let (got, want) = (own.encode(&pixels, SQUARE, SQUARE), encode_by_graph(graph, &pixels, SQUARE, SQUARE)?);
    let (Some(a), Some(b)) = (got.as_f32(), want[0].as_f32()) else { return Ok(false) };
    Ok(got.shape == want[0].shape && a.iter().zip(b).all(|(a, b)| (a - b).abs() <= 1e-3 * (1.0 + b.abs())))
}

/// The whole graph's answer.
fn ask_graph(graph: &dyn Model, inputs: &[(&str, Tensor)], least: f32) -> Result<Candidates> {
    let out = graph.run(inputs)?;
    let (Some(logits), Some(quality)) = (out[0].as_f32(), out[1].as_f32()) else {
        return Err(Error::new("the decoder's outputs are not floats").file(graph.path()));
    };
    let count = quality.len();
    if !(3..=4).contains(&count) || logits.len() != count * MASK_SIDE * MASK_SIDE {
        return Err(Error::new("the decoder's masks are not SAM's")
            .file(graph.path())
            .found(format!("masks {:?} and their predicted IoU {:?}", out[0].shape, out[1].shape))
            .expected("3 masks of 256 x 256 for a point, or 4 with the one for several points"));
    }
    Ok(Candidates::of_graph(quality, logits, least))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tiny() -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("testdata/sam-tiny")
    }

    fn picture(width: usize, height: usize) -> RgbImage {
        let pixels = (0..width * height * 3).map(|i: usize| ((i as f32 * 0.01).sin() * 100.0 + 120.0) as u8).collect();
        RgbImage { width, height, pixels }
    }

    #[test]
    fn the_decoder_gives_the_answers_of_its_graph() {
        let options = EngineOptions::default();
        let [fast, plain] = [false, true].map(|plain| Sam::open(tiny(), &options, plain).unwrap());
        assert!(matches!(fast.decoding, Decoding::Parts(_)) && matches!(plain.decoding, Decoding::Graph(_)));
        // With every pixel that fills the square the answers are the same, with a sample of them they differ.
        for (picture, filling) in
            [picture(40, 40), picture(60, 40), picture(30, 60)].iter().flat_map(|p| [(p, 1), (p, FILLING)])
        {
            let [mut a, b] = [&fast, &plain].map(|sam| sam.encode(picture).unwrap());
            if let Decoding::Parts(parts) = &fast.decoding {
                a.photograph = parts.photograph(&fast.prompt, &a.values, a.extent, filling).unwrap();
            }
            // A pixel of the encoder has four by four of a mask.
            let [width, height] = a.extent.map(|n| (n / 4.0).ceil() as usize * 4);
            let inside = |i: usize| i % MASK_SIDE < width && i / MASK_SIDE % MASK_SIDE < height;
            let mut least = f32::NEG_INFINITY;
            for point in [[0.1, 0.2], [0.5, 0.5], [0.9, 0.3], [0.7, 0.99]] {
                let [got, want] = [(&fast, &a), (&plain, &b)].map(|(sam, e)| sam.decode(e, point, least).unwrap());
                let logits = || got.logits.iter().zip(&want.logits).enumerate();
                assert!(logits().all(|(i, (a, _))| inside(i) || *a == 0.0));
                let within = || logits().filter(|(i, _)| inside(*i)).map(|(_, pair)| pair);
                if filling == 1 || picture.width == picture.height {
                    let near = |a: f32, b: f32| (a - b).abs() < 2e-4 * (1.0 + a.abs());
                    assert_eq!(got.masks.len(), want.masks.len());
                    assert!(got.masks.iter().zip(&want.masks).all(|(a, b)| a.0 == b.0 && near(a.1, b.1)));
                    assert!(within().all(|(&a, &b)| near(a, b)));
                    // The next point leaves out the worst mask.
                    least = want.masks.iter().map(|m| m.1).fold(f32::INFINITY, f32::min) + 1e-3;
                } else {
                    let off: f32 = within().map(|(a, b)| (a - b).abs()).sum();
                    let size: f32 = within().map(|(_, b)| b.abs()).sum();
                    assert!(off < 0.2 * size, "{off} {size}");
                }
            }
        }
    }

    /// The embeddings of pictures by our encoder and by the graph of the models in a folder are the same.
    fn compare_encoders(folder: &Path) {
        let options = EngineOptions::default();
        let [fast, plain] = [false, true].map(|plain| Sam::open(folder, &options, plain).unwrap());
        assert!(matches!(fast.encoding, Encoding::Own(_)) && matches!(plain.encoding, Encoding::Graph(_)));
        for picture in [picture(40, 40), picture(64, 36), picture(30, 60)] {
            let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
            let [got, want] = [&fast, &plain].map(|sam| sam.encode(&picture).unwrap().values.remove(0));
            assert_eq!(got, one.install(|| fast.encode(&picture).unwrap().values.remove(0)));
            assert_eq!(got.shape, want.shape);
            let pairs = got.as_f32().unwrap().iter().zip(want.as_f32().unwrap());
            pairs.for_each(|(a, b)| assert!((a - b).abs() < 1e-4 * (1.0 + b.abs()), "{a} {b}"));
        }
    }

    #[test]
    fn the_encoder_gives_the_embedding_of_its_graph() {
        compare_encoders(&tiny());
    }

    #[test]
    #[ignore = "needs MobileSAM in models/: make models"]
    fn mobile_sam_is_computed_as_its_graphs_do() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../models");
        compare_encoders(&folder);
        let [fast, plain] = [false, true].map(|plain| Sam::open(&folder, &EngineOptions::default(), plain).unwrap());
        assert_eq!(fast.hash, COMPARED, "other models than those that were compared");
        let (Decoding::Parts(parts), Decoding::Graph(whole)) = (&fast.decoding, &plain.decoding) else { panic!() };
        assert!(parts.agree_with(&**whole, &plain.prompt, SQUARE).unwrap());
    }

    #[test]
    fn an_encoder_that_only_looks_like_mobile_sams_is_run_as_its_graph() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::copy(tiny().join("sam.onnx"), folder.path().join("sam.onnx")).unwrap();
        // Another function by its name, and the same operators with another number in GELU and in a norm.
        let changes: [(&[u8], &[u8]); 3] = [
            (b"Erf", b"Sin"),
            (&std::f32::consts::SQRT_2.to_le_bytes(), &1.2f32.to_le_bytes()),
            (&1e-6f32.to_le_bytes(), &0.1f32.to_le_bytes()),
        ];
        for (what, with) in changes {
            let mut bytes = std::fs::read(tiny().join("encoder.onnx")).unwrap();
            let at = bytes.windows(what.len()).position(|w| w == what).unwrap();
            bytes[at..at + with.len()].copy_from_slice(with);
            std::fs::write(folder.path().join("encoder.onnx"), bytes).unwrap();
            let sam = Sam::open(folder.path(), &EngineOptions::default(), false).unwrap();
            assert!(matches!(sam.encoding, Encoding::Graph(_)));
            assert_eq!(sam.encode(&picture(60, 40)).unwrap().values[0].shape, [1, 16, 64, 64]);
        }
    }

    #[test]
    fn a_decoder_that_only_looks_like_sams_is_asked_through_its_graph() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::copy(tiny().join("encoder.onnx"), folder.path().join("encoder.onnx")).unwrap();
        let mut bytes = std::fs::read(tiny().join("sam.onnx")).unwrap();
        // GELU becomes another function: the activation's node is renamed to one that has the same inputs.
        let at = bytes.windows(3).position(|w| w == b"Erf").unwrap();
        bytes[at..at + 3].copy_from_slice(b"Sin");
        std::fs::write(folder.path().join("sam.onnx"), bytes).unwrap();
        let sam = Sam::open(folder.path(), &EngineOptions::default(), false).unwrap();
        assert!(matches!(sam.decoding, Decoding::Graph(_)));
        let embedded = sam.encode(&picture(60, 40)).unwrap();
        assert_eq!(sam.decode(&embedded, [0.5, 0.5], f32::NEG_INFINITY).unwrap().masks.len(), 3);
    }
}
