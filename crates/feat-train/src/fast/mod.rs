//! The model of [`crate::model`] in f32 for mask losses standardised per channel: the same numbers up to rounding, in
//! about a tenth of the time. The readable model is the oracle it is tested against.
//!
//! An iteration makes five passes in parallel, each over chunks of fixed size whose sums are added up in order in f64:
//! the graph network over anchors, standardisation, centroids over the view's columns, then one pass that takes the
//! gradient of the centroids back to the columns, moves all features (Adam) and sums them for the next iteration's
//! statistics while they are at hand, and the network's backward pass over anchors.

mod kernels;
#[cfg(test)]
mod tests;

use crate::adam::{Adam, Rates};
use crate::loss::{self, Evaluated, Loss, directions};
use crate::model::{COLOR, Model, Settings, splitmix};
use crate::network::Layer;
use crate::normalize::{Axis, Moments, channel_moments};
use crate::scene::{Context, MaskSet, NONE, Neighbours, inputs_are_of_gaussians};
use kernels::{
    Half, LANES, Piece, adam_rows, centroids, channel_sums, channel_sums_of_wide, columns_backward, dense, for_pitch,
    for_width, inputs, outer, sum_rows,
};
use rayon::prelude::*;
use std::ops::Range;
use std::time::{Duration, Instant};

/// Anchors worked on at a time.
const ANCHORS: usize = 512;
/// Gaussians worked on at a time, about.
const GAUSSIANS: usize = 4096;

/// What is done less often than the method asks for; the default is nothing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shortcuts {
    /// Means and deviations are taken anew every so many iterations; 1 is exact.
    pub stats_every: u64,
    /// Gaussians without gradient stay as they are, and so do their moments.
    pub lazy_adam: bool,
}

impl Default for Shortcuts {
    fn default() -> Self {
        Self { stats_every: 1, lazy_adam: false }
    }
}

/// Where the time went.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Timings {
    /// The graph network forward, with the statistics.
    pub propagate: Duration,
    /// Centroids of the view's masks.
    pub centroids: Duration,
    /// The loss and its gradient of the centroids.
    pub loss: Duration,
    /// Gradients of the columns, Adam on all features, and their sums for the next statistics: one pass.
    pub features: Duration,
    /// The graph network backward.
    pub backward: Duration,
}

/// Places and anchors worked on together: all places that receive these anchors' output.
#[derive(Debug, Clone)]
struct Chunk {
    places: Range<usize>,
    anchors: Range<usize>,
}

/// Sums over a chunk's features, per channel: of (x - pivot), of its square, and the pivot.
#[derive(Debug, Clone, Default)]
struct Sums {
    first: Vec<f64>,
    second: Vec<f64>,
    pivot: Vec<f64>,
    count: f64,
}

impl Sums {
    fn of(&mut self, d: usize, rows: &[f32]) {
        for sums in [&mut self.first, &mut self.second] {
            sums.clear();
            sums.resize(d, 0.0);
        }
        let (s1, s2) = (&mut self.first[..], &mut self.second[..]);
        for_width!(d, channel_sums(rows, s1, s2), else channel_sums_of_wide(d, rows, s1, s2));
        self.count = (rows.len() / d) as f64;
        self.pivot.clear();
        self.pivot.extend(rows.iter().take(d).map(|&v| f64::from(v)));
    }

    fn part(&self, c: usize) -> [f64; 4] {
        [self.first[c], self.second[c], self.pivot[c], self.count]
    }
}

/// A layer with rows padded to multiples of [`LANES`].
#[derive(Debug, Default)]
struct Padded {
    w1: Vec<f32>,
    w2: Vec<f32>,
    bias: Vec<f32>,
    /// Transposed, for gradients of the layer's input.
    w1_back: Vec<f32>,
    w2_back: Vec<f32>,
}

fn padded(width: usize) -> usize {
    width.next_multiple_of(LANES)
}

impl Padded {
    fn new(layer: &Layer<f32>) -> Self {
        let (w1, w2, bias) = layer.split();
        let pad = |w: &[f32], rows: usize| -> Vec<f32> {
            let (from, to) = (w.len() / rows.max(1), padded(w.len() / rows.max(1)));
            let mut out = vec![0.0; rows * to];
            for (out, w) in out.chunks_exact_mut(to).zip(w.chunks_exact(from)) {
                out[..from].copy_from_slice(w);
            }
            out
        };
        let transpose = |w: &[f32], rows: usize| -> Vec<f32> {
            let columns = w.len() / rows;
            (0..w.len()).map(|i| w[i % rows * columns + i / rows]).collect()
        };
        Self {
            w1: pad(w1, layer.input),
            w2: pad(w2, layer.neighbour),
            bias: pad(bias, 1),
            w1_back: pad(&transpose(w1, layer.input), layer.output),
            w2_back: pad(&transpose(w2, layer.neighbour), layer.output),
        }
    }
}

/// Everything an iteration needs beside the parameters, allocated once.
#[derive(Debug)]
pub struct Engine<'a> {
    context: &'a Context,
    settings: Settings,
    shortcuts: Shortcuts,
    d: usize,
    /// Channels of a padded feature.
    pitch: usize,
    chunks: Vec<Chunk>,
    sums: Vec<Sums>,
    moments: Vec<Moments>,
    /// Inputs of the anchors `[M][d + 3]`; the colours never change.
    own: Vec<f32>,
    /// Their sums over neighbours.
    around: Vec<f32>,
    layers: Vec<Padded>,
    /// Outputs of the layers, padded.
    outputs: Vec<Vec<f32>>,
    /// With anchors as neighbours, the sums of the neighbours' features from layer 1 on, padded.
    later: Vec<Vec<f32>>,
    /// Standardised output, padded.
    hat: Vec<f32>,
    hat_moments: Vec<Moments>,
    hat_gradient: Vec<f32>,
    /// Gradients of two layers' outputs, padded.
    gradients: [Vec<f32>; 2],
    /// Where the time went.
    pub timings: Timings,
}

/// The parts of `values` that end at `ends`.
fn split<'a, T>(mut values: &'a mut [T], ends: impl Iterator<Item = usize>) -> Vec<&'a mut [T]> {
    let mut from = 0;
    ends.map(|end| {
        let (part, rest) = std::mem::take(&mut values).split_at_mut(end - from);
        values = rest;
        from = end;
        part
    })
    .collect()
}

impl<'a> Engine<'a> {
    /// Whether the engine can train with these settings; the readable model can with all.
    pub fn serves(settings: &Settings) -> bool {
        settings.norm_axis == Axis::Channel && settings.cohesion == 0.0 && settings.loss != Loss::Gaussian
    }

    /// For training `model` on `context`.
    ///
    /// # Panics
    /// When the engine does not serve the model's settings.
    pub fn new(context: &'a Context, model: &Model<f32>, shortcuts: Shortcuts) -> Self {
        assert!(Self::serves(&model.settings), "settings of the readable model only");
        let d = model.settings.dim;
        let (pitch, m) = (padded(d), if model.layers.is_empty() { 0 } else { context.anchors.len() });
        let chunks = chunks(context);
        let (own, around) = if m == 0 { Default::default() } else { color_inputs(context, d) };
        let outputs: Vec<Vec<f32>> = model.layers.iter().map(|l| vec![0.0; m * padded(l.output)]).collect();
        let later = match context.kind {
            Neighbours::Anchors => outputs[..outputs.len().max(1) - 1].to_vec(),
            _ => Vec::new(),
        };
        let widest = outputs.iter().map(Vec::len).max().unwrap_or(0);
        let mut engine = Self {
            context,
            settings: model.settings.clone(),
            shortcuts,
            d,
            pitch,
            sums: vec![Sums::default(); chunks.len()],
            chunks,
            moments: Vec::new(),
            own,
            around,
            layers: Vec::new(),
            outputs,
            later,
            hat: vec![0.0; m * pitch],
            hat_moments: Vec::new(),
            hat_gradient: vec![0.0; m * pitch],
            gradients: [vec![0.0; widest], vec![0.0; widest]],
            timings: Timings::default(),
        };
        engine.sum_features(model);
        engine
    }

    /// Bytes of the graph network's activations and gradients.
    pub fn network_bytes(&self) -> usize {
        let vectors = self.outputs.iter().chain(&self.later).chain(&self.gradients);
        let rows = vectors.chain([&self.own, &self.around, &self.hat, &self.hat_gradient]);
        rows.map(|v| v.len() * size_of::<f32>()).sum()
    }

    /// The statistics in use, for a checkpoint: with `stats_every` they are older than the features.
    pub fn statistics(&self) -> Vec<f64> {
        let all = self.moments.iter().chain(&self.hat_moments);
        all.flat_map(|m| [m.mean, m.deviation, m.inverse, m.count]).collect()
    }

    /// Takes up the statistics of a checkpoint.
    pub fn restore(&mut self, statistics: &[f64]) {
        let mut all: Vec<Moments> = statistics
            .chunks_exact(4)
            .map(|s| Moments { mean: s[0], deviation: s[1], inverse: s[2], count: s[3] })
            .collect();
        if all.len() == 2 * self.d {
            self.hat_moments = all.split_off(self.d);
            self.moments = all;
        }
    }

    fn sum_features(&mut self, model: &Model<f32>) {
        let d = self.d;
        self.sums.par_iter_mut().zip(&self.chunks).for_each(|(sums, chunk)| {
            sums.of(d, &model.features[chunk.places.start * d..chunk.places.end * d]);
        });
    }

    /// Whether statistics are taken anew in iteration `iteration`, which counts from 0.
    fn due(&self, iteration: u64) -> bool {
        iteration.is_multiple_of(self.shortcuts.stats_every) || self.moments.is_empty()
    }

    /// Runs the graph network; `iteration` counts from 0.
    pub fn propagate(&mut self, model: &Model<f32>, iteration: u64) {
        if model.layers.is_empty() {
            return;
        }
        let start = Instant::now();
        let (d, pitch, context) = (self.d, self.pitch, self.context);
        let due = self.due(iteration);
        if due {
            self.moments = (0..d).map(|c| Moments::from_parts(self.sums.iter().map(|s| s.part(c)))).collect();
        }
        self.layers = model.layers.iter().map(Padded::new).collect();
        self.take_inputs(model);
        for l in 0..model.layers.len() {
            self.run_layer(model, l);
        }
        let last = self.outputs.last().expect("there are layers");
        if due || self.hat_moments.is_empty() {
            self.hat_moments = output_moments(last, pitch, d, &context.served);
        }
        let (mean, inverse) = floats(&self.hat_moments);
        self.hat.par_chunks_mut(ANCHORS * pitch).zip(last.par_chunks(ANCHORS * pitch)).for_each(|(hat, y)| {
            for (hat, y) in hat.chunks_exact_mut(pitch).zip(y.chunks_exact(pitch)) {
                for c in 0..d {
                    hat[c] = (y[c] - mean[c]) * inverse[c];
                }
            }
        });
        self.timings.propagate += start.elapsed();
    }

    /// Standardised features of the anchors and their sums over neighbours.
    fn take_inputs(&mut self, model: &Model<f32>) {
        let (d, channels, context) = (self.d, self.d + COLOR, self.context);
        let (mean, inverse) = floats(&self.moments);
        let of_gaussians = inputs_are_of_gaussians(context.kind);
        let rows = self.own.par_chunks_mut(ANCHORS * channels).zip(self.around.par_chunks_mut(ANCHORS * channels));
        rows.enumerate().for_each(|(chunk, (own, around))| {
            let first = chunk * ANCHORS;
            let count = own.len() / channels;
            let anchors = &context.anchors[first..first + count];
            // Neighbouring anchors' inputs are those of their Gaussians.
            let around = if of_gaussians { around } else { &mut [] };
            let start = &context.neighbour_start[first..=first + count];
            let (features, list) = (&model.features[..], &context.neighbours[..]);
            for_width!(d, inputs(d, features, anchors, list, start, &mean, &inverse, channels, own, around));
        });
        if !of_gaussians {
            let own = &self.own;
            self.around.par_chunks_mut(ANCHORS * channels).enumerate().for_each(|(chunk, rows)| {
                for (i, row) in rows.chunks_exact_mut(channels).enumerate() {
                    let mut sum = [0.0f32; 64];
                    let sum = &mut sum[..d];
                    for &n in context.neighbours_of(chunk * ANCHORS + i) {
                        let x = &own[n as usize * channels..n as usize * channels + d];
                        sum.iter_mut().zip(x).for_each(|(s, x)| *s += x);
                    }
                    row[..d].copy_from_slice(sum);
                }
            });
        }
    }

    /// Inputs of layer `l` and their pitch: of the anchors, and of their neighbours summed.
    fn inputs_of(&self, l: usize) -> [(&[f32], usize); 2] {
        let channels = self.d + COLOR;
        let pitch = |rows: &[f32]| rows.len() / self.context.anchors.len().max(1);
        let own = if l == 0 { (&self.own[..], channels) } else { (&self.outputs[l - 1][..], pitch(&self.outputs[l - 1])) };
        let around = match self.context.kind {
            Neighbours::Anchors if l > 0 => (&self.later[l - 1][..], pitch(&self.later[l - 1])),
            _ => (&self.around[..], channels),
        };
        [own, around]
    }

    fn run_layer(&mut self, model: &Model<f32>, l: usize) {
        let context = self.context;
        if l > 0 && context.kind == Neighbours::Anchors {
            let rows = &self.outputs[l - 1];
            let o = padded(model.layers[l].input);
            self.later[l - 1].resize(context.anchors.len() * o, 0.0);
            sum_lists(rows, o, &context.neighbours, &context.neighbour_start, &mut self.later[l - 1]);
        }
        let mut output = std::mem::take(&mut self.outputs[l]);
        let o = padded(model.layers[l].output);
        let [(x, xp), (s, sp)] = self.inputs_of(l);
        let w = &self.layers[l];
        output.par_chunks_mut(ANCHORS * o).enumerate().for_each(|(chunk, y)| {
            let from = chunk * ANCHORS;
            let (x, s) = ((&x[from * xp..], xp, &w.w1[..]), (&s[from * sp..], sp, &w.w2[..]));
            for_pitch!(o, dense(x, s, &w.bias, true, y));
        });
        self.outputs[l] = output;
    }

    /// Centroids of the masks `[K][d]`, and of their halves where asked for.
    fn centroids(&self, model: &Model<f32>, set: &MaskSet<f32>, half: Option<Half<'_>>) -> (Vec<f64>, Vec<f64>) {
        let (d, pitch) = (self.d, self.pitch);
        let length = set.len() * pitch;
        let parts: Vec<(Vec<f32>, Vec<f32>)> = self
            .chunks
            .par_iter()
            .filter_map(|chunk| {
                let columns = columns_in(set, chunk);
                if columns.is_empty() {
                    return None;
                }
                let mut sums = vec![0.0; length];
                let mut halves = vec![0.0; if half.is_some() { length } else { 0 }];
                let both = half.map(|half| (&mut halves[..], half));
                let piece = self.piece(set, columns);
                for_width!(d, centroids(d, pitch, piece, &model.features, &self.hat, &mut sums, both));
                Some((sums, halves))
            })
            .collect();
        let total = |of: fn(&(Vec<f32>, Vec<f32>)) -> &Vec<f32>| {
            let mut total = vec![0.0f64; set.len() * d];
            for part in parts.iter().map(of).filter(|p| !p.is_empty()) {
                for (total, part) in total.chunks_exact_mut(d).zip(part.chunks_exact(pitch)) {
                    total.iter_mut().zip(part).for_each(|(t, p)| *t += f64::from(*p));
                }
            }
            total
        };
        (total(|p| &p.0), if half.is_some() { total(|p| &p.1) } else { Vec::new() })
    }

    fn piece<'b>(&'b self, set: &'b MaskSet<f32>, columns: Range<usize>) -> Piece<'b> {
        Piece {
            columns: &set.columns[columns.clone()],
            start: &set.start[columns.start..=columns.end],
            mask: &set.mask,
            weight: &set.weight,
            source: &self.context.source,
        }
    }

    /// The loss on one view and its gradients of the centroids. `noise` seeds the halves of [`Loss::HalfMask`].
    pub fn evaluate(&mut self, model: &Model<f32>, set: &MaskSet<f32>, noise: u64) -> Evaluated {
        let start = Instant::now();
        let s = &self.settings;
        let half = move |entry: usize| in_half(noise, entry);
        let with_halves = s.loss == Loss::HalfMask;
        let (means, positives) = self.centroids(model, set, with_halves.then_some(&half));
        let taken = start.elapsed();
        let positives = with_halves.then_some(&positives[..]);
        let evaluated = loss::evaluate(s.loss, &means, positives, self.d, s.tau);
        self.timings.centroids += taken;
        self.timings.loss += start.elapsed() - taken;
        evaluated
    }

    /// Takes the gradients of the centroids back, and moves the features by one step of Adam. Gives the gradients of the
    /// network's weights. `iteration` counts from 0; `noise` is that of [`Engine::evaluate`].
    pub fn backward(
        &mut self,
        model: &mut Model<f32>,
        adam: &mut Adam<f32>,
        set: &MaskSet<f32>,
        evaluated: &Evaluated,
        noise: u64,
        rates: &Rates,
        iteration: u64,
    ) -> Vec<Vec<f32>> {
        let start = Instant::now();
        let totals = self.move_features(model, adam, set, evaluated, noise, rates, iteration);
        let moved = start.elapsed();
        let gradients = if model.layers.is_empty() { Vec::new() } else { self.network_gradients(model, &totals) };
        self.timings.features += moved;
        self.timings.backward += start.elapsed() - moved;
        gradients
    }

    /// The pass over all features. Gives, per channel, the sums of g and of g y over anchors, y being the standardised
    /// output and g its gradient.
    fn move_features(
        &mut self,
        model: &mut Model<f32>,
        adam: &mut Adam<f32>,
        set: &MaskSet<f32>,
        evaluated: &Evaluated,
        noise: u64,
        rates: &Rates,
        iteration: u64,
    ) -> Vec<[f64; 2]> {
        let (d, pitch) = (self.d, self.pitch);
        let half = move |entry: usize| in_half(noise, entry);
        let masks = pad_rows(&evaluated.centroids, d, pitch);
        let halves = pad_rows(&evaluated.positives, d, pitch);
        let with_network = !model.layers.is_empty();
        let sum_again = with_network && self.due(iteration + 1);
        let lazy = self.shortcuts.lazy_adam;
        let places = || self.chunks.iter().map(|c| c.places.end * d);
        let mut hat_gradient = std::mem::take(&mut self.hat_gradient);
        let mut sums = std::mem::take(&mut self.sums);
        let jobs: Vec<_> = split(&mut model.features, places())
            .into_iter()
            .zip(split(&mut adam.mean, places()))
            .zip(split(&mut adam.square, places()))
            .zip(split(&mut hat_gradient, self.chunks.iter().map(|c| if with_network { c.anchors.end * pitch } else { 0 })))
            .zip(&mut sums)
            .zip(&self.chunks)
            .collect();
        let this = &*self;
        let parts: Vec<Vec<[f64; 2]>> = jobs
            .into_par_iter()
            .map_init(Vec::new, |rows: &mut Vec<f32>, (((((p, m), v), anchors), sums), chunk)| {
                let columns = columns_in(set, chunk);
                anchors.fill(0.0);
                if columns.is_empty() {
                    if !lazy {
                        kernels::adam_without(p, m, v, rates);
                    }
                } else {
                    rows.clear();
                    rows.resize(p.len(), 0.0);
                    let piece = this.piece(set, columns);
                    let both = (!halves.is_empty()).then_some((&halves[..], &half as Half<'_>));
                    let to = (chunk.places.start, &mut rows[..]);
                    let to_anchors = (chunk.anchors.start, &mut anchors[..]);
                    for_width!(d, columns_backward(d, pitch, piece, &masks, both, to, to_anchors));
                    if lazy {
                        for_width!(d, adam_rows(d, piece.columns, chunk.places.start, p, m, v, rows, rates));
                    } else {
                        kernels::adam(p, m, v, rows, rates);
                    }
                }
                if sum_again {
                    sums.of(d, p);
                }
                if anchors.is_empty() || columns_in(set, chunk).is_empty() {
                    return Vec::new();
                }
                let hat = &this.hat[chunk.anchors.start * pitch..];
                let mut totals = vec![[0.0f64; 2]; d];
                for (g, y) in anchors.chunks_exact(pitch).zip(hat.chunks_exact(pitch)) {
                    for c in 0..d {
                        totals[c][0] += f64::from(g[c]);
                        totals[c][1] += f64::from(g[c]) * f64::from(y[c]);
                    }
                }
                totals
            })
            .collect();
        self.hat_gradient = hat_gradient;
        self.sums = sums;
        let mut totals = vec![[0.0f64; 2]; d];
        for part in parts {
            for (total, part) in totals.iter_mut().zip(part) {
                total[0] += part[0];
                total[1] += part[1];
            }
        }
        totals
    }

    fn network_gradients(&mut self, model: &Model<f32>, totals: &[[f64; 2]]) -> Vec<Vec<f32>> {
        let (d, pitch, context) = (self.d, self.pitch, self.context);
        let m = context.anchors.len();
        // Gradient of the last output, from that of its standardised values: see Moments::backward.
        let mut scale = [[0.0f32; 3]; 64];
        for (c, (scale, moments)) in scale.iter_mut().zip(&self.hat_moments).enumerate() {
            if moments.inverse != 0.0 {
                let [g, gy] = totals[c];
                let mean = moments.inverse * g / moments.count;
                let slope = gy / ((moments.count - 1.0) * moments.deviation);
                *scale = [moments.inverse as f32, mean as f32, slope as f32];
            }
        }
        let mut out = vec![Vec::new(); model.layers.len()];
        let [mut gradient, mut above] = std::mem::take(&mut self.gradients);
        for (l, layer) in model.layers.iter().enumerate().rev() {
            let o = padded(layer.output);
            let last = l + 1 == model.layers.len();
            let around = if !last && context.kind == Neighbours::Anchors {
                let above_width = padded(model.layers[l + 1].output);
                let mut sums = std::mem::take(&mut self.later[l]);
                sums.resize(m * above_width, 0.0);
                sum_lists(&above[..m * above_width], above_width, &context.reverse, &context.reverse_start, &mut sums);
                sums
            } else {
                Vec::new()
            };
            let output = &self.outputs[l];
            let [(x, xp), (s, sp)] = self.inputs_of(l);
            let parts: Vec<Vec<f32>> = gradient[..m * o]
                .par_chunks_mut(ANCHORS * o)
                .zip(output.par_chunks(ANCHORS * o))
                .enumerate()
                .map(|(chunk, (g, y))| {
                    let first = chunk * ANCHORS;
                    let count = y.len() / o;
                    if last {
                        let hat = &self.hat[first * pitch..];
                        let hat_gradient = &self.hat_gradient[first * pitch..];
                        for a in 0..count {
                            let served = context.served[first + a] as f32;
                            for c in 0..d {
                                let [inverse, mean, slope] = scale[c];
                                let (i, y) = (a * pitch + c, hat[a * pitch + c]);
                                g[i] = inverse * hat_gradient[i] - served * (mean + slope * y);
                            }
                            g[a * pitch + d..(a + 1) * pitch].fill(0.0);
                        }
                    } else {
                        let up = padded(model.layers[l + 1].output);
                        let w = &self.layers[l + 1];
                        let direct = (&above[first * up..], up, &w.w1_back[..]);
                        let sums = if around.is_empty() {
                            (&around[..], 0, &[][..])
                        } else {
                            (&around[first * up..], up, &w.w2_back[..])
                        };
                        let zero = [0.0f32; 64];
                        for_pitch!(o, dense(direct, sums, &zero, false, g));
                    }
                    // ReLU: what did not pass takes no gradient.
                    for (g, &y) in g.iter_mut().zip(y) {
                        *g = if y > 0.0 { *g } else { 0.0 };
                    }
                    let mut sums = vec![0.0f32; (layer.input + layer.neighbour + 1) * o];
                    let (w1, rest) = sums.split_at_mut(layer.input * o);
                    let (w2, bias) = rest.split_at_mut(layer.neighbour * o);
                    for_pitch!(o, outer(&x[first * xp..], xp, layer.input, g, w1));
                    for_pitch!(o, outer(&s[first * sp..], sp, layer.neighbour, g, w2));
                    for_pitch!(o, outer(&[1.0; ANCHORS], 1, 1, g, bias));
                    sums
                })
                .collect();
            let mut total = vec![0.0f64; layer.weights.len()];
            for part in &parts {
                for (total, part) in total.chunks_exact_mut(layer.output).zip(part.chunks_exact(o)) {
                    total.iter_mut().zip(part).for_each(|(t, p)| *t += f64::from(*p));
                }
            }
            out[l] = total.into_iter().map(|v| v as f32).collect();
            if !around.is_empty() {
                self.later[l] = around;
            }
            std::mem::swap(&mut gradient, &mut above);
        }
        self.gradients = [gradient, above];
        out
    }

    /// f_final of the Gaussian at `place`, into `out`.
    fn final_feature(&self, model: &Model<f32>, place: usize, out: &mut [f32]) {
        let (d, source) = (self.d, self.context.source[place]);
        out.copy_from_slice(&model.features[place * d..(place + 1) * d]);
        if source != NONE && !self.hat.is_empty() {
            let hat = &self.hat[source as usize * self.pitch..];
            out.iter_mut().zip(hat).for_each(|(o, h)| *o += h);
        }
    }

    /// f_final of all Gaussians `[n][d]`, in the order of `kept`, after [`Engine::propagate`].
    pub fn final_features(&self, model: &Model<f32>) -> Vec<f32> {
        let d = self.d;
        let mut out = vec![0.0f32; model.features.len()];
        for (place, &i) in self.context.order.iter().enumerate() {
            self.final_feature(model, place, &mut out[i as usize * d..(i as usize + 1) * d]);
        }
        out
    }

    /// Mean over masks of the weighted mean cosine between a mask's Gaussians and its centroid.
    pub fn alignment(&self, model: &Model<f32>, set: &MaskSet<f32>) -> f64 {
        let (d, masks) = (self.d, set.len());
        let (unit, _) = directions(&self.centroids(model, set, None).0, d);
        let parts: Vec<Vec<f64>> = set
            .pieces
            .par_windows(2)
            .map(|bounds| {
                let mut sums = vec![0.0; 2 * masks];
                let mut f = vec![0.0f32; d];
                for c in bounds[0] as usize..bounds[1] as usize {
                    self.final_feature(model, set.columns[c] as usize, &mut f);
                    let length = f.iter().map(|v| f64::from(*v) * f64::from(*v)).sum::<f64>().sqrt();
                    let inverse = if length > loss::SHORTEST { 1.0 / length } else { 0.0 };
                    let (mask, weight) = set.entries(c);
                    for (&k, &w) in mask.iter().zip(weight) {
                        let k = k as usize;
                        let along: f64 = unit[k * d..(k + 1) * d].iter().zip(&f).map(|(u, f)| u * f64::from(*f)).sum();
                        sums[k] += f64::from(w) * along * inverse;
                        sums[masks + k] += f64::from(w);
                    }
                }
                sums
            })
            .collect();
        let mut sums = vec![0.0; 2 * masks];
        for part in parts {
            sums.iter_mut().zip(part).for_each(|(s, p)| *s += p);
        }
        let means = (0..masks).filter(|&k| sums[masks + k] > 0.0).map(|k| sums[k] / sums[masks + k]);
        means.sum::<f64>() / masks.max(1) as f64
    }
}

/// Whether an entry belongs to the half of its mask that is the positive of [`Loss::HalfMask`].
fn in_half(noise: u64, entry: usize) -> bool {
    splitmix(noise ^ entry as u64) & 1 == 1
}

/// Positions of the columns of `set` whose places lie in the chunk.
fn columns_in(set: &MaskSet<f32>, chunk: &Chunk) -> Range<usize> {
    let before = |place: usize| set.columns.partition_point(|&c| (c as usize) < place);
    before(chunk.places.start)..before(chunk.places.end)
}

/// Cuts all places into chunks that part no anchor's Gaussians.
fn chunks(context: &Context) -> Vec<Chunk> {
    let n = context.source.len();
    let mut out: Vec<Chunk> = Vec::new();
    let mut next_anchor = 0;
    let (mut place_from, mut anchor_from) = (0, 0);
    for place in 0..=n {
        let source = context.source.get(place).copied().filter(|s| *s != NONE);
        let begins = place == n || source.is_none() || source.is_some_and(|s| s as usize >= next_anchor);
        if place == n || begins && place - place_from >= GAUSSIANS {
            let anchor_to = if place == n { context.anchors.len() } else { next_anchor };
            out.push(Chunk { places: place_from..place, anchors: anchor_from..anchor_to });
            (place_from, anchor_from) = (place, anchor_to);
        }
        if let Some(s) = source {
            next_anchor = s as usize + 1;
        }
    }
    out
}

/// Inputs of anchors and sums over their neighbours `[M][d + 3]` with the standardised colours, which never change.
fn color_inputs(context: &Context, d: usize) -> (Vec<f32>, Vec<f32>) {
    let moments = channel_moments(context.colors.as_flattened(), COLOR, None);
    let color = |place: usize, c: usize| moments[c].apply(f64::from(context.colors[place][c]));
    let channels = d + COLOR;
    let m = context.anchors.len();
    let (mut own, mut around) = (vec![0.0f32; m * channels], vec![0.0f32; m * channels]);
    let rows = own.chunks_exact_mut(channels).zip(around.chunks_exact_mut(channels));
    for (a, (own, around)) in rows.enumerate() {
        for c in 0..COLOR {
            own[d + c] = color(context.anchors[a] as usize, c) as f32;
            let place = |&n: &u32| {
                if inputs_are_of_gaussians(context.kind) { n as usize } else { context.anchors[n as usize] as usize }
            };
            around[d + c] = context.neighbours_of(a).iter().map(|n| color(place(n), c)).sum::<f64>() as f32;
        }
    }
    (own, around)
}

/// Means and inverse deviations in f32.
fn floats(moments: &[Moments]) -> (Vec<f32>, Vec<f32>) {
    moments.iter().map(|m| (m.mean as f32, m.inverse as f32)).unzip()
}

/// Moments of the first `d` channels of padded rows, each row counting `served` times.
fn output_moments(rows: &[f32], pitch: usize, d: usize, served: &[u32]) -> Vec<Moments> {
    let parts: Vec<Sums> = rows
        .par_chunks(ANCHORS * pitch)
        .zip(served.par_chunks(ANCHORS))
        .map(|(rows, served)| {
            let pivot: Vec<f64> = rows[..d].iter().map(|&v| f64::from(v)).collect();
            let mut sums = Sums { first: vec![0.0; d], second: vec![0.0; d], pivot, count: 0.0 };
            for (row, &w) in rows.chunks_exact(pitch).zip(served) {
                let w = f64::from(w);
                sums.count += w;
                for c in 0..d {
                    let x = f64::from(row[c]) - sums.pivot[c];
                    sums.first[c] += w * x;
                    sums.second[c] += w * x * x;
                }
            }
            sums
        })
        .collect();
    (0..d).map(|c| Moments::from_parts(parts.iter().map(|s| s.part(c)))).collect()
}

/// Sums of padded rows over lists of them.
fn sum_lists(rows: &[f32], o: usize, list: &[u32], start: &[u32], sums: &mut [f32]) {
    sums.par_chunks_mut(ANCHORS * o).enumerate().for_each(|(chunk, sums)| {
        let first = chunk * ANCHORS;
        let start = &start[first..=first + sums.len() / o];
        for_pitch!(o, sum_rows(rows, list, start, sums));
    });
}

/// f64 rows of `d` to f32 rows of `pitch`.
fn pad_rows(rows: &[f64], d: usize, pitch: usize) -> Vec<f32> {
    let mut out = vec![0.0f32; rows.len() / d * pitch];
    for (out, row) in out.chunks_exact_mut(pitch).zip(rows.chunks_exact(d)) {
        out.iter_mut().zip(row).for_each(|(o, r)| *o = *r as f32);
    }
    out
}
