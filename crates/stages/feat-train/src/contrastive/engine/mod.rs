//! The model of [`super::model`] in f32 for mask losses standardised per channel: the same numbers up to rounding, in
//! about a tenth of the time. The readable model is the oracle it is tested against.
//!
//! An iteration makes five passes in parallel, each over chunks of fixed size whose sums are added up in order in f64:
//!
//! 1. the graph network over anchors;
//! 2. standardisation of its output;
//! 3. centroids of the masks over the view's columns;
//! 4. the gradient of the centroids back to the columns, Adam on all features, and the sums of the features for the next
//!    iteration's statistics, chunk by chunk while a chunk is in cache;
//! 5. the backward pass of the network over anchors.

mod kernels;
#[cfg(test)]
mod tests;

use super::adam::{Adam, Rates};
use super::alignment::alignment;
use super::context::{Context, NONE};
use super::loss::{self, Evaluated};
use super::masks::MaskSet;
use super::model::{COLOR, Model};
use super::normalize::{Moments, channel_moments};
use crate::options::{Axis, Contrastive, Loss, Neighbours, UnitLength};
use kernels::{BLOCK, Half, Lanes, Piece, centroids, columns_backward, for_width, inputs};
use rayon::prelude::*;
use std::ops::Range;

/// Rows of anchors are padded to multiples of this.
const PAD: usize = 8;
/// Gaussians worked on at a time, about.
const GAUSSIANS: usize = 4096;

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
        kernels::channel_sums(d, rows, &mut self.first, &mut self.second);
        self.count = (rows.len() / d) as f64;
        self.pivot.clear();
        self.pivot.extend(rows.iter().take(d).map(|&v| f64::from(v)));
    }

    fn part(&self, c: usize) -> [f64; 4] {
        [self.first[c], self.second[c], self.pivot[c], self.count]
    }
}

/// `[rows][columns]` to `[columns][rows]`.
fn transposed(w: &[f32], rows: usize) -> Vec<f32> {
    let columns = w.len() / rows;
    (0..w.len()).map(|i| w[i % rows * columns + i / rows]).collect()
}

/// Everything an iteration needs beside the parameters, allocated once.
#[derive(Debug)]
pub struct Engine<'a> {
    context: &'a Context,
    options: Contrastive,
    d: usize,
    /// Channels of a padded feature.
    pitch: usize,
    chunks: Vec<Chunk>,
    sums: Vec<Sums>,
    moments: Vec<Moments>,
    /// Input of each layer, block by block; the colours of the first never change.
    inputs: Vec<Vec<Lanes>>,
    /// Its sums over neighbours; with Gaussians as neighbours those of the first layer serve all.
    around: Vec<Vec<Lanes>>,
    /// Output of the last layer.
    output: Vec<Lanes>,
    /// With anchors as neighbours, rows of what is summed over lists of anchors.
    rows: Vec<f32>,
    /// Standardised output, padded.
    hat: Vec<f32>,
    hat_moments: Vec<Moments>,
    hat_gradient: Vec<f32>,
    /// Gradients of the outputs of two layers, and sums of one over anchors that have it as a neighbour.
    gradients: [Vec<Lanes>; 3],
}

/// The parts of `values` that end at `ends`.
fn split<T>(mut values: &mut [T], ends: impl Iterator<Item = usize>) -> Vec<&mut [T]> {
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
    /// Whether the engine can train with these options; the readable model can with all.
    pub fn serves(options: &Contrastive) -> bool {
        let of_masks = !matches!(options.loss, Loss::Gaussian | Loss::Pixel);
        options.norm_axis == Axis::Channel
            && options.cohesion == 0.0
            && of_masks
            && options.unit_length == UnitLength::Never
    }

    /// For training `model` on `context`.
    pub fn new(context: &'a Context, model: &Model<f32>) -> Self {
        assert!(Self::serves(&model.options), "options of the readable model only");
        let d = model.dim;
        let m = if model.layers.is_empty() { 0 } else { context.anchors.len() };
        let (pitch, blocks) = (d.next_multiple_of(PAD), m.div_ceil(BLOCK));
        let lanes = |channels: usize| vec![[0.0f32; BLOCK]; blocks * channels];
        let anchors = context.kind == Neighbours::Anchors;
        let mut layer_inputs: Vec<_> = model.layers.iter().map(|l| lanes(l.input)).collect();
        let summed = if anchors { &model.layers[..] } else { &model.layers[..model.layers.len().min(1)] };
        let mut around: Vec<_> = summed.iter().map(|l| lanes(l.neighbour)).collect();
        if m > 0 {
            color_inputs(context, d, &mut layer_inputs[0], &mut around[0]);
        }
        let widest = model.layers.iter().map(|l| l.input.max(l.output)).max().unwrap_or(0);
        let chunks = chunks(context);
        let mut engine = Self {
            context,
            options: model.options.clone(),
            d,
            pitch,
            sums: vec![Sums::default(); chunks.len()],
            chunks,
            moments: Vec::new(),
            inputs: layer_inputs,
            around,
            output: if m > 0 { lanes(d) } else { Vec::new() },
            rows: vec![0.0; if anchors { m * widest } else { 0 }],
            hat: vec![0.0; m * pitch],
            hat_moments: Vec::new(),
            hat_gradient: vec![0.0; m * pitch],
            gradients: [lanes(widest), lanes(widest), if anchors { lanes(widest) } else { Vec::new() }],
        };
        engine.sums.par_iter_mut().zip(&engine.chunks).for_each(|(sums, chunk)| {
            sums.of(d, &model.features[chunk.places.start * d..chunk.places.end * d]);
        });
        engine
    }

    /// Bytes of the graph network's activations and gradients.
    pub fn network_bytes(&self) -> usize {
        let blocks = self.inputs.iter().chain(&self.around).chain(&self.gradients).chain([&self.output]);
        let rows = [&self.hat, &self.hat_gradient, &self.rows];
        blocks.map(|v| v.len() * size_of::<Lanes>()).sum::<usize>()
            + rows.map(|v| v.len() * size_of::<f32>()).iter().sum::<usize>()
    }

    pub fn propagate(&mut self, model: &Model<f32>) {
        if model.layers.is_empty() {
            return;
        }
        let (d, pitch, context) = (self.d, self.pitch, self.context);
        self.moments = (0..d).map(|c| Moments::from_parts(self.sums.iter().map(|s| s.part(c)))).collect();
        self.take_inputs(model);
        for l in 0..model.layers.len() {
            self.run_layer(model, l);
        }
        self.hat_moments = output_moments(&self.output, d, &context.served);
        let (mean, inverse) = floats(&self.hat_moments);
        self.hat.par_chunks_mut(BLOCK * pitch).zip(self.output.par_chunks(d)).for_each(|(hat, y)| {
            for (a, hat) in hat.chunks_exact_mut(pitch).enumerate() {
                for c in 0..d {
                    hat[c] = (y[c][a] - mean[c]) * inverse[c];
                }
            }
        });
    }

    /// Standardised features of the anchors, and, with Gaussians as neighbours, their sums.
    fn take_inputs(&mut self, model: &Model<f32>) {
        let (d, channels, context) = (self.d, self.d + COLOR, self.context);
        let (mean, inverse) = floats(&self.moments);
        let of_gaussians = context.neighbours_are_places();
        let blocks = self.inputs[0].par_chunks_mut(channels).zip(self.around[0].par_chunks_mut(channels));
        blocks.enumerate().for_each(|(block, (own, around))| {
            let anchors = block * BLOCK..((block + 1) * BLOCK).min(context.anchors.len());
            let start = &context.neighbour_start[anchors.start..=anchors.end];
            let around = if of_gaussians { around } else { &mut [] };
            let (features, list) = (&model.features[..], &context.neighbours[..]);
            let places = &context.anchors[anchors];
            for_width!(d, inputs(d, features, places, list, start, &mean, &inverse, own, around));
        });
    }

    /// The sums over neighbours that layer `l` reads.
    fn around(&self, l: usize) -> &[Lanes] {
        &self.around[l.min(self.around.len() - 1)]
    }

    fn run_layer(&mut self, model: &Model<f32>, l: usize) {
        let (context, layer) = (self.context, &model.layers[l]);
        if context.kind == Neighbours::Anchors {
            let (list, start) = (&context.neighbours, &context.neighbour_start);
            sum_over_lists(&self.inputs[l], layer.input, &mut self.rows, list, start, &mut self.around[l]);
        }
        let mut output =
            std::mem::take(if l + 1 < model.layers.len() { &mut self.inputs[l + 1] } else { &mut self.output });
        let (w1, w2, bias) = layer.split();
        let inputs = self.inputs[l].par_chunks(layer.input).zip(self.around(l).par_chunks(layer.neighbour));
        output.par_chunks_mut(layer.output).zip(inputs).for_each(|(y, (x, s))| {
            let bias = bias.iter().copied().chain(std::iter::repeat(0.0));
            y.iter_mut().zip(bias).for_each(|(y, b)| y.fill(b));
            kernels::dense(x, w1, y);
            kernels::dense(s, w2, y);
            if layer.relu {
                kernels::relu(y);
            }
        });
        *(if l + 1 < model.layers.len() { &mut self.inputs[l + 1] } else { &mut self.output }) = output;
    }

    /// Centroids A f of all masks `[K][d]`, after [`Engine::propagate`].
    pub fn centroids(&self, model: &Model<f32>, set: &MaskSet) -> Vec<f64> {
        self.mask_means(model, set, None).0
    }

    /// Centroids of the masks `[K][d]`, and of their halves where asked for.
    fn mask_means(&self, model: &Model<f32>, set: &MaskSet, half: Option<Half<'_>>) -> (Vec<f64>, Vec<f64>) {
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
        let (all, halves): (Vec<_>, Vec<_>) = parts.into_iter().unzip();
        let total = |parts: Vec<Vec<f32>>| {
            let mut total = vec![0.0f64; set.len() * d];
            for part in parts {
                for (total, part) in total.chunks_exact_mut(d).zip(part.chunks_exact(pitch)) {
                    total.iter_mut().zip(part).for_each(|(t, p)| *t += f64::from(*p));
                }
            }
            total
        };
        (total(all), if half.is_some() { total(halves) } else { Vec::new() })
    }

    fn piece<'b>(&'b self, set: &'b MaskSet, columns: Range<usize>) -> Piece<'b> {
        Piece {
            columns: &set.columns[columns.clone()],
            start: &set.start[columns.start..=columns.end],
            mask: &set.mask,
            weight: &set.weight,
            source: &self.context.source,
        }
    }

    /// The loss on one view and its gradients of the centroids. `noise` seeds the halves of [`Loss::HalfMask`]; `beside` are
    /// positives from another view `[K][d]` for [`Loss::CrossView`].
    pub fn evaluate(&self, model: &Model<f32>, set: &MaskSet, noise: u64, beside: Option<&[f64]>) -> Evaluated {
        let s = &self.options;
        let half = move |entry: usize| loss::in_half(noise, entry);
        let with_halves = s.loss == Loss::HalfMask;
        let (means, positives) = self.mask_means(model, set, with_halves.then_some(&half));
        let positives = with_halves.then_some(&positives[..]).or(beside);
        loss::evaluate(s.loss, &means, positives, self.d, s.tau)
    }

    /// Takes the gradients of the centroids back, and updates the features by one step of Adam. `noise` is that of
    /// [`Engine::evaluate`]. Returns, per channel, the sums of g and of g y over anchors, y being the standardised output and
    /// g its gradient.
    pub fn update_features(
        &mut self,
        model: &mut Model<f32>,
        adam: &mut Adam<f32>,
        set: &MaskSet,
        evaluated: &Evaluated,
        noise: u64,
        rates: &Rates,
    ) -> Vec<[f64; 2]> {
        let (d, pitch) = (self.d, self.pitch);
        let half = move |entry: usize| loss::in_half(noise, entry);
        let masks = pad_rows(&evaluated.centroids, d, pitch);
        let halves = pad_rows(&evaluated.positives, d, pitch);
        let with_network = !model.layers.is_empty();
        let places = || self.chunks.iter().map(|c| c.places.end * d);
        let mut hat_gradient = std::mem::take(&mut self.hat_gradient);
        let mut sums = std::mem::take(&mut self.sums);
        let jobs: Vec<_> = split(&mut model.features, places())
            .into_iter()
            .zip(split(&mut adam.mean, places()))
            .zip(split(&mut adam.square, places()))
            .zip(split(
                &mut hat_gradient,
                self.chunks.iter().map(|c| if with_network { c.anchors.end * pitch } else { 0 }),
            ))
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
                    kernels::adam_without(p, m, v, rates);
                } else {
                    rows.clear();
                    rows.resize(p.len(), 0.0);
                    let piece = this.piece(set, columns);
                    let both = (!halves.is_empty()).then_some((&halves[..], &half as Half<'_>));
                    let (place, anchor) = (chunk.places.start, chunk.anchors.start);
                    for_width!(d, columns_backward(d, pitch, piece, &masks, both, place, rows, anchor, anchors));
                    kernels::adam(p, m, v, rows, rates);
                }
                if with_network {
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

    /// Gradients of the network's weights, given what [`Engine::update_features`] returned.
    pub fn network_gradients(&mut self, model: &Model<f32>, totals: &[[f64; 2]]) -> Vec<Vec<f32>> {
        let context = self.context;
        let mut out = vec![Vec::new(); model.layers.len()];
        let [mut gradient, mut above, mut around] = std::mem::take(&mut self.gradients);
        let blocks = self.output.len() / self.d;
        self.output_gradient(totals, &mut gradient);
        for (l, layer) in model.layers.iter().enumerate().rev() {
            if let Some(next) = model.layers.get(l + 1) {
                let (w1, w2, _) = next.split();
                let (w1, w2) = (transposed(w1, next.input), transposed(w2, next.neighbour));
                let above = &above[..blocks * next.output];
                let around = if context.kind == Neighbours::Anchors {
                    let around = &mut around[..blocks * next.output];
                    sum_over_lists(
                        above,
                        next.output,
                        &mut self.rows,
                        &context.reverse,
                        &context.reverse_start,
                        around,
                    );
                    around
                } else {
                    &mut []
                };
                let to = gradient[..blocks * layer.output].par_chunks_mut(layer.output);
                to.zip(above.par_chunks(next.output)).enumerate().for_each(|(block, (to, g))| {
                    to.as_flattened_mut().fill(0.0);
                    kernels::dense(g, &w1, to);
                    if !around.is_empty() {
                        kernels::dense(&around[block * next.output..(block + 1) * next.output], &w2, to);
                    }
                });
            }
            let output = self.inputs.get(l + 1).unwrap_or(&self.output);
            let inputs = self.inputs[l].par_chunks(layer.input).zip(self.around(l).par_chunks(layer.neighbour));
            let parts: Vec<Vec<f32>> = gradient[..blocks * layer.output]
                .par_chunks_mut(layer.output)
                .zip(output.par_chunks(layer.output))
                .zip(inputs)
                .map(|((g, y), (x, s))| {
                    if layer.relu {
                        kernels::relu_backward(y, g);
                    }
                    let mut sums = vec![0.0f32; layer.weights.len()];
                    let (w1, rest) = sums.split_at_mut(layer.input * layer.output);
                    let (w2, bias) = rest.split_at_mut(layer.neighbour * layer.output);
                    kernels::outer(x, g, w1);
                    kernels::outer(s, g, w2);
                    kernels::sum_lanes(g, bias);
                    sums
                })
                .collect();
            let mut total = vec![0.0f64; layer.weights.len()];
            for part in &parts {
                total.iter_mut().zip(part).for_each(|(t, p)| *t += f64::from(*p));
            }
            out[l] = total.into_iter().map(|v| v as f32).collect();
            std::mem::swap(&mut gradient, &mut above);
        }
        self.gradients = [gradient, above, around];
        out
    }

    /// Gradient of the last output, from that of its standardised values: see [`Moments::backward`].
    fn output_gradient(&self, totals: &[[f64; 2]], to: &mut [Lanes]) {
        let (d, pitch) = (self.d, self.pitch);
        let scale: Vec<[f32; 3]> = self
            .hat_moments
            .iter()
            .zip(totals)
            .map(|(m, [g, gy])| {
                if m.inverse == 0.0 {
                    return [0.0; 3];
                }
                [m.inverse, m.inverse * g / m.count, gy / ((m.count - 1.0) * m.deviation)].map(|v| v as f32)
            })
            .collect();
        let rows = self.hat.par_chunks(BLOCK * pitch).zip(self.hat_gradient.par_chunks(BLOCK * pitch));
        let served = self.context.served.par_chunks(BLOCK);
        to.par_chunks_mut(d).zip(rows.zip(served)).for_each(|(to, ((hat, gradient), served))| {
            // Lanes beyond the last anchor take no gradient.
            to.as_flattened_mut().fill(0.0);
            for (a, &served) in served.iter().enumerate() {
                for (c, [inverse, mean, slope]) in scale.iter().enumerate() {
                    let (g, y) = (gradient[a * pitch + c], hat[a * pitch + c]);
                    to[c][a] = inverse * g - served as f32 * (mean + slope * y);
                }
            }
        });
    }

    /// f_final of the Gaussian at `place`.
    fn final_feature<'b>(&'b self, model: &'b Model<f32>, place: usize) -> impl Iterator<Item = f32> + 'b {
        let (d, source) = (self.d, self.context.source[place]);
        let received = source != NONE && !self.hat.is_empty();
        let hat = received.then(|| &self.hat[source as usize * self.pitch..]);
        let own = model.features[place * d..(place + 1) * d].iter().enumerate();
        own.map(move |(c, &v)| hat.map_or(v, |hat| v + hat[c]))
    }

    /// f_final of all Gaussians `[n][d]`, in the order of `kept`, after [`Engine::propagate`].
    pub fn final_features(&self, model: &Model<f32>) -> Vec<f32> {
        let d = self.d;
        let mut out = vec![0.0f32; model.features.len()];
        for (place, &i) in self.context.order.iter().enumerate() {
            let to = &mut out[i as usize * d..(i as usize + 1) * d];
            to.iter_mut().zip(self.final_feature(model, place)).for_each(|(o, v)| *o = v);
        }
        out
    }

    /// [Alignment](alignment()) of a view's masks.
    pub fn alignment(&self, model: &Model<f32>, set: &MaskSet) -> f64 {
        alignment(set, &self.centroids(model, set), self.d, |place, f| {
            f.iter_mut().zip(self.final_feature(model, place)).for_each(|(f, v)| *f = f64::from(v));
        })
    }
}

/// Positions of the columns of `set` whose places lie in the chunk.
fn columns_in(set: &MaskSet, chunk: &Chunk) -> Range<usize> {
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

/// Puts the standardised colours, which never change, into the inputs of anchors and sums over their neighbours, after
/// `d` channels of features.
fn color_inputs(context: &Context, d: usize, own: &mut [Lanes], around: &mut [Lanes]) {
    let moments = channel_moments(context.colors.as_flattened(), COLOR, None);
    let color = |place: u32, c: usize| moments[c].apply(f64::from(context.colors[place as usize][c]));
    let of_gaussians = context.neighbours_are_places();
    for (a, &place) in context.anchors.iter().enumerate() {
        for c in 0..COLOR {
            let (channel, lane) = (a / BLOCK * (d + COLOR) + d + c, a % BLOCK);
            own[channel][lane] = color(place, c) as f32;
            if of_gaussians {
                let sum: f64 = context.neighbours_of(a).iter().map(|&n| color(n, c)).sum();
                around[channel][lane] = sum as f32;
            }
        }
    }
}

/// Means and inverse deviations in f32.
fn floats(moments: &[Moments]) -> (Vec<f32>, Vec<f32>) {
    moments.iter().map(|m| (m.mean as f32, m.inverse as f32)).unzip()
}

/// Moments of each channel of a network's output, each anchor counting `served` times.
fn output_moments(output: &[Lanes], d: usize, served: &[u32]) -> Vec<Moments> {
    let parts: Vec<Sums> = output
        .par_chunks(d)
        .zip(served.par_chunks(BLOCK))
        .map(|(y, served)| {
            let mut sums = Sums { count: served.iter().map(|&s| f64::from(s)).sum(), ..Sums::default() };
            for y in y {
                let pivot = y[0];
                let (mut s1, mut s2) = (0.0, 0.0);
                for (&y, &w) in y.iter().zip(served) {
                    let (x, w) = (f64::from(y - pivot), f64::from(w));
                    s1 += w * x;
                    s2 += w * x * x;
                }
                sums.first.push(s1);
                sums.second.push(s2);
                sums.pivot.push(f64::from(pivot));
            }
            sums
        })
        .collect();
    (0..d).map(|c| Moments::from_parts(parts.iter().map(|s| s.part(c)))).collect()
}

/// Sums over lists of anchors of their `channels`; `rows` is room for them row by row.
fn sum_over_lists(from: &[Lanes], channels: usize, rows: &mut [f32], list: &[u32], start: &[u32], sums: &mut [Lanes]) {
    let m = start.len() - 1;
    let rows = &mut rows[..m * channels];
    rows.par_chunks_mut(BLOCK * channels).zip(from.par_chunks(channels)).for_each(|(rows, block)| {
        for (a, row) in rows.chunks_exact_mut(channels).enumerate() {
            row.iter_mut().zip(block).for_each(|(r, lanes)| *r = lanes[a]);
        }
    });
    sums.par_chunks_mut(channels).enumerate().for_each(|(block, sums)| {
        let end = ((block + 1) * BLOCK).min(m);
        kernels::sum_rows(rows, list, &start[block * BLOCK..=end], sums);
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
