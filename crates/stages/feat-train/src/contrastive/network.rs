//! The graph network on anchors (paper, "Neighborhood Feature Aggregation"):
//! f_m^(l+1) = ReLU(W1 f_m^(l) + Σ_{n in N(m)} W2 h_n), with f_m^(0) = h_m.
//!
//! Σ W2 h_n = W2 Σ h_n, so neighbours are summed in the input's channels, once for all layers. The inputs are detached: gradients reach the weights only.

use super::context::Context;
use super::real::Real;
use rand::RngExt;
use rayon::prelude::*;

/// Channels between layers (paper: "an intermediate channel size of 16").
const HIDDEN: usize = 16;
/// Anchors worked on at a time.
const CHUNK: usize = 512;

/// Weights of one layer, input-major: `[input][output]`.
#[derive(Debug, Clone, PartialEq)]
pub struct Layer<T> {
    /// Channels of the anchor's own feature.
    pub input: usize,
    /// Channels of its neighbours' features.
    pub neighbour: usize,
    /// Channels of its output.
    pub output: usize,
    /// W1 `[input][output]`, then W2 `[neighbour][output]`.
    pub weights: Vec<T>,
}

impl<T: Real> Layer<T> {
    /// Uniform in ±1/sqrt(inputs), as linear layers usually start.
    fn random(input: usize, neighbour: usize, output: usize, rng: &mut impl RngExt) -> Self {
        let mut draw = |count: usize, fan_in: usize| -> Vec<T> {
            let bound = 1.0 / (fan_in as f64).sqrt();
            (0..count).map(|_| T::of(rng.random_range(-bound..bound))).collect()
        };
        let mut weights = draw(input * output, input);
        weights.extend(draw(neighbour * output, neighbour));
        Self { input, neighbour, output, weights }
    }

    /// W1 and W2.
    fn split(&self) -> (&[T], &[T]) {
        self.weights.split_at(self.input * self.output)
    }
}

/// The layers: `input` → 16 → … → `output` channels.
pub fn random_layers<T: Real>(count: usize, input: usize, output: usize, rng: &mut impl RngExt) -> Vec<Layer<T>> {
    (0..count)
        .map(|l| {
            let own = if l == 0 { input } else { HIDDEN };
            Layer::random(own, input, if l + 1 == count { output } else { HIDDEN }, rng)
        })
        .collect()
}

/// What the forward pass keeps for the backward pass.
#[derive(Debug, Clone, Default)]
pub struct Activations<T> {
    /// Input of each layer, and the output of the last: `[M][channels]`.
    pub features: Vec<Vec<T>>,
    /// Summed inputs of the neighbours `[M][channels]`, the same for all layers.
    pub sums: Vec<T>,
}

/// Runs the layers on the anchors' inputs `h` `[M][channels]`; `sums` are the summed inputs of the neighbours.
pub fn forward<T: Real>(layers: &[Layer<T>], context: &Context, h: Vec<T>, sums: Vec<T>) -> Activations<T> {
    let mut out = Activations { features: vec![h], sums };
    for (l, layer) in layers.iter().enumerate() {
        let (x, s) = (&out.features[l], &out.sums);
        let (w1, w2) = layer.split();
        let m = context.anchors.len();
        let mut y = vec![T::default(); m * layer.output];
        y.par_chunks_mut(CHUNK * layer.output).enumerate().for_each(|(chunk, rows)| {
            for (i, row) in rows.chunks_exact_mut(layer.output).enumerate() {
                let a = chunk * CHUNK + i;
                multiply_add(&x[a * layer.input..(a + 1) * layer.input], w1, row);
                multiply_add(&s[a * layer.neighbour..(a + 1) * layer.neighbour], w2, row);
                for v in row.iter_mut().filter(|v| **v < T::default()) {
                    *v = T::default();
                }
            }
        });
        out.features.push(y);
    }
    out
}

/// row += x W, with W `[x][row]`.
#[inline]
fn multiply_add<T: Real>(x: &[T], w: &[T], row: &mut [T]) {
    for (&x, w) in x.iter().zip(w.chunks_exact(row.len())) {
        for (r, &w) in row.iter_mut().zip(w) {
            *r += x * w;
        }
    }
}

/// Gradients of all weights, layer by layer, given the gradient of the last output `[M][channels]`.
pub fn backward<T: Real>(
    layers: &[Layer<T>],
    context: &Context,
    activations: &Activations<T>,
    mut gradient: Vec<T>,
) -> Vec<Vec<T>> {
    let mut out = vec![Vec::new(); layers.len()];
    for (l, layer) in layers.iter().enumerate().rev() {
        let output = &activations.features[l + 1];
        // ReLU: what did not pass takes no gradient.
        gradient.par_iter_mut().zip(output).with_min_len(CHUNK).for_each(|(g, &y)| {
            if y <= T::default() {
                *g = T::default();
            }
        });
        out[l] = weight_gradients(layer, &activations.features[l], &activations.sums, &gradient);
        if l > 0 {
            gradient = input_gradients(layer, context, &gradient);
        }
    }
    out
}

fn weight_gradients<T: Real>(layer: &Layer<T>, x: &[T], s: &[T], gradient: &[T]) -> Vec<T> {
    let width = layer.output;
    let parts: Vec<Vec<f64>> = gradient
        .par_chunks(CHUNK * width)
        .enumerate()
        .map(|(chunk, rows)| {
            let mut sums = vec![T::default(); layer.weights.len()];
            for (i, g) in rows.chunks_exact(width).enumerate() {
                if g.iter().all(|g| *g == T::default()) {
                    continue;
                }
                let a = chunk * CHUNK + i;
                let inputs = x[a * layer.input..(a + 1) * layer.input]
                    .iter()
                    .chain(&s[a * layer.neighbour..(a + 1) * layer.neighbour]);
                for (&v, row) in inputs.zip(sums.chunks_exact_mut(width)) {
                    row.iter_mut().zip(g).for_each(|(r, &g)| *r += v * g);
                }
            }
            sums.iter().map(|v| v.get()).collect()
        })
        .collect();
    let mut total = vec![0.0; layer.weights.len()];
    for part in parts {
        total.iter_mut().zip(part).for_each(|(t, p)| *t += p);
    }
    total.into_iter().map(T::of).collect()
}

/// Gradient of a layer's input, through W1.
fn input_gradients<T: Real>(layer: &Layer<T>, context: &Context, gradient: &[T]) -> Vec<T> {
    let (w1, _) = layer.split();
    let (width, input) = (layer.output, layer.input);
    let mut out = vec![T::default(); context.anchors.len() * input];
    out.par_chunks_mut(CHUNK * input).enumerate().for_each(|(chunk, rows)| {
        for (i, row) in rows.chunks_exact_mut(input).enumerate() {
            let a = chunk * CHUNK + i;
            multiply_transposed(&gradient[a * width..(a + 1) * width], w1, row);
        }
    });
    out
}

/// row += g Wᵀ, with W `[row][g]`.
#[inline]
fn multiply_transposed<T: Real>(g: &[T], w: &[T], row: &mut [T]) {
    for (r, w) in row.iter_mut().zip(w.chunks_exact(g.len())) {
        for (&g, &w) in g.iter().zip(w) {
            *r += g * w;
        }
    }
}
