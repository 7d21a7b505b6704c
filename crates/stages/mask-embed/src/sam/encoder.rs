//! MobileSAM's encoder (Zhang et al. 2023), which is TinyViT (Wu et al. 2022). What lies between two narrow layers is made row by
//! row and stays in the processor's cache, where its graph writes all of it to memory.
//!
//! The graph itself is the oracle: [`super::Sam`] compares the two when it opens a model that it does not know.

use super::decoder::{EPSILON, EPSILON_OF_PICTURES, Linear, Norm, matrix};
use super::planar::{biased_gelu, depthwise, softmax_rows};
use super::weights::{File, Matrix as Weights};
use onnx_models::Tensor;
use rayon::prelude::*;
use rten_gemm::{BiasVector, GemmExecutor, GemmInputA, GemmInputB, GemmOptions};
use rten_tensor::{Matrix, NdTensorView};

/// Rows that go through a layer together: what lies between stays in the processor's cache.
const ROWS: usize = 128;
/// Steps of the three convolutions between the four stages.
const STEPS: [usize; 3] = [2, 2, 1];

/// `[height][width][channels]`.
struct Map {
    width: usize,
    height: usize,
    channels: usize,
    values: Vec<f32>,
}

impl Map {
    fn row(&self, y: usize) -> &[f32] {
        let length = self.width * self.channels;
        &self.values[y * length..][..length]
    }
}

/// A row, the one above and the one below it, made from top to bottom. Beside the picture are zeros.
struct Neighbours {
    /// Row y - 1 at y modulo 3; a pixel of zeros at both ends.
    rows: [Vec<f32>; 3],
    height: usize,
    channels: usize,
    /// The first row that is not made yet, plus one.
    next: usize,
}

impl Neighbours {
    /// Of rows of `x` with other `channels`, from row `first` on.
    fn new(x: &Map, channels: usize, first: usize) -> Self {
        let rows = [(); 3].map(|()| vec![0.0; (x.width + 2) * channels]);
        Self { rows, height: x.height, channels, next: first }
    }

    /// Those of row `y`; `make` writes a row that is needed.
    fn of(&mut self, y: usize, mut make: impl FnMut(usize, &mut [f32])) -> [&[f32]; 3] {
        while self.next <= y + 2 {
            let row = &mut self.rows[self.next % 3];
            let inside = self.channels..row.len() - self.channels;
            match (1..=self.height).contains(&self.next) {
                true => make(self.next - 1, &mut row[inside]),
                false => row.fill(0.0),
            }
            self.next += 1;
        }
        [y, y + 1, y + 2].map(|v| &self.rows[v % 3][..])
    }
}

/// A map of `channels` with every `step`-th pixel of `x`, row by row: `make` writes a row of `inner` channels, and `take` makes one of
/// the result of row y, its neighbours and memory that is kept.
fn by_rows(
    x: &Map,
    inner: usize,
    channels: usize,
    step: usize,
    make: impl Fn(usize, &mut [f32]) + Sync,
    take: impl Fn(usize, [&[f32]; 3], &mut Vec<f32>, &mut [f32]) + Sync,
) -> Map {
    let [width, height] = [x.width, x.height].map(|n| n.div_ceil(step));
    let mut values = vec![0.0; width * height * channels];
    let band = height.div_ceil(rayon::current_num_threads());
    values.par_chunks_mut(band * width * channels).enumerate().for_each(|(i, out)| {
        let mut neighbours = Neighbours::new(x, inner, i * band * step);
        let mut kept = Vec::new();
        for (y, out) in (i * band..).map(|y| y * step).zip(out.chunks_exact_mut(width * channels)) {
            take(y, neighbours.of(y, &make), &mut kept, out);
        }
    });
    Map { width, height, channels, values }
}

fn local(x: &Map, layer: &Depthwise) -> Map {
    let copy = |v: usize, row: &mut [f32]| row.copy_from_slice(x.row(v));
    by_rows(x, x.channels, x.channels, 1, copy, |_, rows, _, out| {
        depthwise(rows, 1, &layer.weights, &layer.bias, out);
    })
}

/// A 3 x 3 convolution of each channel by itself: weights `[3][3][channels]`.
struct Depthwise {
    weights: Vec<f32>,
    bias: Vec<f32>,
}

/// Channels are mixed, then each is convolved, then they are mixed again.
struct Separable {
    first: Linear,
    middle: Depthwise,
    last: Linear,
}

/// A block that attends within windows.
struct Block {
    norm: Norm,
    qkv: Linear,
    /// Added to the scores, `[heads][pixels][pixels]` of a window.
    places: Vec<f32>,
    heads: usize,
    /// Of a window, in pixels.
    side: usize,
    out: Linear,
    local: Depthwise,
    mlp_norm: Norm,
    mlp: [Linear; 2],
}

/// The encoder's weights.
pub(super) struct Encoder {
    gemm: GemmExecutor,
    stem: [Linear; 2],
    convolutions: Vec<Separable>,
    /// The convolution before each of the last three stages, and the stage.
    stages: Vec<(Separable, Vec<Block>)>,
    neck: [Linear; 2],
    neck_norms: [Norm; 2],
}

struct Reader<'a> {
    file: &'a File<'a>,
    gemm: &'a GemmExecutor,
}

impl Reader<'_> {
    fn pack(&self, weights: &Weights, bias: Vec<f32>) -> Option<Linear> {
        (weights.columns == bias.len())
            .then(|| Linear { weight: self.gemm.prepack_b(matrix(&weights.values, weights.columns)), bias })
    }

    /// A convolution that reads all channels of `side` x `side` pixels, as rows of pixels and channels.
    fn convolution(&self, end: &str, side: usize) -> Option<Linear> {
        let (shape, values, bias) = self.file.convolution(end)?;
        let &[to, from, height, width] = &shape[..] else { return None };
        let places = side * side;
        let at = |i: usize| values[(i % to * from + i / to % from) * places + i / to / from];
        let values: Vec<f32> =
            if [height, width] == [side; 2] { (0..values.len()).map(at).collect() } else { return None };
        self.pack(&Weights { rows: places * from, columns: to, values }, bias)
    }

    fn depthwise(&self, end: &str) -> Option<Depthwise> {
        let (shape, values, bias) = self.file.convolution(end)?;
        let channels = bias.len();
        let at = |i: usize| values[i % channels * 9 + i / channels];
        (shape == [channels, 1, 3, 3]).then(|| Depthwise { weights: (0..values.len()).map(at).collect(), bias })
    }

    fn separable(&self, end: &str) -> Option<Separable> {
        let mixed = |i| self.convolution(&format!("{end}/conv{i}/c"), 1);
        Some(Separable { first: mixed(1)?, middle: self.depthwise(&format!("{end}/conv2/c"))?, last: mixed(3)? })
    }

    fn linear(&self, end: &str) -> Option<Linear> {
        let layer = self.file.layer(end)?;
        self.pack(&layer.weight, layer.bias)
    }

    fn block(&self, stage: usize, i: usize) -> Option<Block> {
        let (path, end) = (format!("layers.{stage}/blocks.{i}"), format!("layers.{stage}.blocks.{i}"));
        let (shape, places) = self.file.added_to(&format!("{path}/attn/Add_output_0"))?;
        let &[heads, pixels, _] = &shape[..] else { return None };
        let side = pixels.isqrt();
        let block = Block {
            norm: Norm::read(self.file, &format!("{end}.attn.norm"))?,
            qkv: self.linear(&format!("{end}.attn.qkv"))?,
            places,
            heads,
            side,
            out: self.linear(&format!("{end}.attn.proj"))?,
            local: self.depthwise(&format!("{path}/local_conv/c"))?,
            mlp_norm: Norm::read(self.file, &format!("{end}.mlp.norm"))?,
            mlp: [self.linear(&format!("{end}.mlp.fc1"))?, self.linear(&format!("{end}.mlp.fc2"))?],
        };
        let channels = block.out.bias.len();
        let fits = shape == [heads, side * side, side * side]
            && heads > 0
            && channels.is_multiple_of(heads)
            && block.qkv.reads_and_makes() == [channels, 3 * channels]
            && block.out.reads_and_makes() == [channels; 2]
            && block.mlp[0].reads_and_makes()[0] == channels
            && block.mlp[1].reads_and_makes() == [block.mlp[0].bias.len(), channels]
            && [&block.norm, &block.mlp_norm].iter().all(|n| [n.scale.len(), n.shift.len()] == [channels; 2])
            && block.local.bias.len() == channels;
        fits.then_some(block)
    }
}

impl Encoder {
    /// The encoder of a file; `None` when it is not built like MobileSAM's.
    pub fn read(file: &File) -> Option<Self> {
        let gemm = GemmExecutor::new();
        let reader = Reader { file, gemm: &gemm };
        let stem = |i: usize| reader.convolution(&format!("patch_embed/seq/seq.{i}/c"), 3);
        let convolutions = (0..).map_while(|i| reader.separable(&format!("layers.0/blocks.{i}"))).collect::<Vec<_>>();
        let stage = |i: usize| {
            let blocks: Vec<Block> = (0..).map_while(|b| reader.block(i + 1, b)).collect();
            Some((reader.separable(&format!("layers.{i}/downsample"))?, blocks))
        };
        let stages = (0..STEPS.len()).map(stage).collect::<Option<Vec<_>>>()?;
        let norm = |[scale, shift]: [Vec<f32>; 2]| Norm { scale, shift };
        let [first, last] = [file.scale_and_shift_before("neck.2.weight")?, file.last_scale_and_shift()?];
        let encoder = Self {
            stem: [stem(0)?, stem(2)?],
            neck: [reader.convolution("neck/neck.0", 1)?, reader.convolution("neck/neck.2", 3)?],
            neck_norms: [norm(first), norm(last)],
            convolutions,
            stages,
            gemm,
        };
        (encoder.fits() && encoder.is_all_of(file)).then_some(encoder)
    }

    /// Whether each layer reads what the one before it makes.
    fn fits(&self) -> bool {
        let separable = |s: &Separable| {
            let [[reads, inner], [last, makes]] = [&s.first, &s.last].map(Linear::reads_and_makes);
            (s.middle.bias.len() == inner && last == inner).then_some([reads, makes])
        };
        let stem = self.stem.each_ref().map(Linear::reads_and_makes);
        let mut layers = vec![Some(stem[0]), Some([stem[1][0] / 9, stem[1][1]])];
        layers.extend(self.convolutions.iter().map(|s| separable(s).filter(|[reads, makes]| reads == makes)));
        for (before, blocks) in &self.stages {
            layers.push(separable(before));
            layers.extend(blocks.iter().map(|b| Some([b.out.bias.len(); 2])));
        }
        let neck = self.neck.each_ref().map(Linear::reads_and_makes);
        layers.extend([Some(neck[0]), Some([neck[1][0] / 9, neck[1][1]])]);
        let norms = self.neck_norms.iter().zip(&neck);
        layers[0].is_some_and(|[reads, _]| reads == 27)
            && layers.windows(2).all(|w| matches!(w, [Some(a), Some(b)] if a[1] == b[0]))
            && norms.into_iter().all(|(n, [_, makes])| [n.scale.len(), n.shift.len()] == [*makes; 2])
    }

    /// Whether the graph has as many operators of each important kind.
    fn is_all_of(&self, file: &File) -> bool {
        let [convolutions, blocks] = [self.convolutions.len(), self.stages.iter().map(|(_, b)| b.len()).sum::<usize>()];
        let between = self.stages.len();
        let expected: [(&[&str], usize); 5] = [
            (&["Conv"], 2 + 3 * convolutions + 3 * between + blocks + 2),
            (&["Erf"], 1 + 3 * convolutions + 2 * between + blocks),
            (&["MatMul"], 6 * blocks),
            (&["Softmax"], blocks),
            (&["Sqrt", "LayerNormalization"], 2 * blocks + 2),
        ];
        let count = |ops: &[&str]| file.graph.producers.values().filter(|n| ops.contains(&n.op.as_str())).count();
        self.stages.iter().all(|(_, blocks)| !blocks.is_empty()) && expected.iter().all(|(ops, n)| count(ops) == *n)
    }

    /// The embedding `[1, channels, side / 16, side / 16]` of a picture in the upper left corner of a square of `side` pixels.
    /// `pixels` are normalised, `[height][width][3]`; those beside them are zero.
    pub fn encode(&self, pixels: &[f32], width: usize, side: usize) -> Tensor<'static> {
        let mut x = Map { width: side, height: side, channels: 3, values: vec![0.0; 3 * side * side] };
        for (to, from) in x.values.chunks_exact_mut(3 * side).zip(pixels.chunks_exact(3 * width)) {
            to[..from.len()].copy_from_slice(from);
        }
        x = self.convolve(&x, &self.stem[0], 2);
        biased_gelu(&mut x.values, 0.0);
        x = self.convolve(&x, &self.stem[1], 2);
        for s in &self.convolutions {
            x = self.separable(&x, s, 1, true);
        }
        for ((before, blocks), step) in self.stages.iter().zip(STEPS) {
            x = self.separable(&x, before, step, false);
            for block in blocks {
                self.attend(&mut x, block);
                x = local(&x, &block.local);
                self.mix(&mut x, block);
            }
        }
        let mut mixed = vec![0.0; x.width * x.height * self.neck[0].bias.len()];
        self.times(matrix(&x.values, x.channels), &self.neck[0], 0.0, &mut mixed);
        self.neck_norms[0].rows(&mut mixed, EPSILON_OF_PICTURES);
        x = Map { channels: self.neck[0].bias.len(), values: mixed, ..x };
        x = self.convolve(&x, &self.neck[1], 1);
        self.neck_norms[1].rows(&mut x.values, EPSILON_OF_PICTURES);
        let (count, channels) = (x.width * x.height, x.channels);
        let values = (0..channels * count).map(|i| x.values[i % count * channels + i / count]);
        Tensor::f32(&[1, channels, x.height, x.width], values.collect::<Vec<_>>())
    }

    /// `out = a W + b + keep * out`.
    fn times(&self, a: Matrix, layer: &Linear, keep: f32, out: &mut [f32]) {
        let options = GemmOptions { beta: keep, bias: Some(BiasVector::Row(&layer.bias)), ..Default::default() };
        let b = GemmInputB::Packed(&layer.weight);
        self.gemm.gemm(out, GemmInputA::Unpacked(a), b, options).expect("the shapes fit");
    }

    /// A 3 x 3 convolution of all channels; zeros beside the picture.
    fn convolve(&self, x: &Map, layer: &Linear, step: usize) -> Map {
        let copy = |v: usize, row: &mut [f32]| row.copy_from_slice(x.row(v));
        by_rows(x, x.channels, layer.bias.len(), step, copy, |_, rows, patches, out| {
            patches.resize(out.len() / layer.bias.len() * 9 * x.channels, 0.0);
            for (u, patch) in patches.chunks_exact_mut(9 * x.channels).enumerate() {
                for (part, row) in patch.chunks_exact_mut(3 * x.channels).zip(rows) {
                    part.copy_from_slice(&row[u * step * x.channels..][..3 * x.channels]);
                }
            }
            self.times(matrix(patches, 9 * x.channels), layer, 0.0, out);
        })
    }

    /// Mixes channels, convolves each with steps of `step`, mixes again; `adds` to what was there.
    fn separable(&self, x: &Map, s: &Separable, step: usize, adds: bool) -> Map {
        let (inner, channels) = (s.first.bias.len(), s.last.bias.len());
        let mix = |v: usize, row: &mut [f32]| {
            self.times(matrix(x.row(v), x.channels), &s.first, 0.0, row);
            biased_gelu(row, 0.0);
        };
        by_rows(x, inner, channels, step, mix, |y, rows, convolved, out| {
            convolved.resize(out.len() / channels * inner, 0.0);
            depthwise(rows, step, &s.middle.weights, &s.middle.bias, convolved);
            biased_gelu(convolved, 0.0);
            if adds {
                out.copy_from_slice(x.row(y));
            }
            self.times(matrix(convolved, inner), &s.last, f32::from(u8::from(adds)), out);
            if adds {
                biased_gelu(out, 0.0);
            }
        })
    }

    /// Every pixel attends to those of its window. Zeros fill windows that reach beyond the picture.
    fn attend(&self, x: &mut Map, block: &Block) {
        let Block { side, heads, .. } = *block;
        let (channels, line, count, pixels) = (x.channels, x.width * x.channels, x.width.div_ceil(side), side * side);
        let width = channels / heads;
        let attend = |rows: &mut [f32]| {
            let mut windows = vec![0.0; count * pixels * channels];
            // The parts of a row that lie in windows, and where in them.
            let place = |y: usize, part: usize| (part * pixels + y * side) * channels;
            for (y, row) in rows.chunks_exact(line).enumerate() {
                for (i, part) in row.chunks(side * channels).enumerate() {
                    windows[place(y, i)..][..part.len()].copy_from_slice(part);
                }
            }
            block.norm.rows(&mut windows, EPSILON);
            let mut qkv = vec![0.0; 3 * windows.len()];
            self.times(matrix(&windows, channels), &block.qkv, 0.0, &mut qkv);
            let (mut scores, mut taken) = (vec![0.0; pixels * pixels], vec![0.0; pixels * width]);
            for (qkv, window) in
                qkv.chunks_exact(3 * pixels * channels).zip(windows.chunks_exact_mut(pixels * channels))
            {
                for (h, places) in block.places.chunks_exact(pixels * pixels).enumerate() {
                    let [q, k, v] = [0, 1, 2].map(|i| {
                        let strides = [3 * channels, 1];
                        NdTensorView::from_slice_with_strides([pixels, width], &qkv[(3 * h + i) * width..], strides)
                            .expect("the view lies within")
                    });
                    scores.copy_from_slice(places);
                    let alpha = (width as f32).sqrt().recip();
                    self.gemm
                        .gemm(
                            &mut scores,
                            GemmInputA::Unpacked(q),
                            GemmInputB::Unpacked(k.transposed()),
                            GemmOptions { alpha, beta: 1.0, ..Default::default() },
                        )
                        .expect("the shapes fit");
                    softmax_rows(&mut scores, pixels, pixels);
                    self.gemm
                        .gemm(
                            &mut taken,
                            GemmInputA::Unpacked(matrix(&scores, pixels)),
                            GemmInputB::Unpacked(v),
                            GemmOptions::default(),
                        )
                        .expect("the shapes fit");
                    for (to, from) in window.chunks_exact_mut(channels).zip(taken.chunks_exact(width)) {
                        to[h * width..][..width].copy_from_slice(from);
                    }
                }
            }
            let out = &mut qkv[..windows.len()];
            self.times(matrix(&windows, channels), &block.out, 0.0, out);
            for (y, row) in rows.chunks_exact_mut(line).enumerate() {
                for (i, part) in row.chunks_mut(side * channels).enumerate() {
                    part.iter_mut().zip(&out[place(y, i)..]).for_each(|(x, o)| *x += o);
                }
            }
        };
        x.values.par_chunks_mut(side * line).for_each(attend);
    }

    /// Mixes the channels of every pixel.
    fn mix(&self, x: &mut Map, block: &Block) {
        let [first, last] = &block.mlp;
        x.values.par_chunks_mut(ROWS * x.channels).for_each_init(
            || [(); 2].map(|()| Vec::new()),
            |[normed, hidden], x| {
                normed.clear();
                normed.extend_from_slice(x);
                block.mlp_norm.rows(normed, EPSILON);
                hidden.resize(x.len() / last.bias.len() * first.bias.len(), 0.0);
                self.times(matrix(normed, last.bias.len()), first, 0.0, hidden);
                biased_gelu(hidden, 0.0);
                self.times(matrix(hidden, first.bias.len()), last, 1.0, x);
            },
        );
    }
}
