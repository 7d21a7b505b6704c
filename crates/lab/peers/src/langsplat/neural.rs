//! Small dense networks with their gradients, and Adam.

use nalgebra::{DMatrixView, DMatrixViewMut};
use rand::RngExt;

const NORM_EPSILON: f32 = 1e-5;
/// How fast the running mean and variance of a batch norm follow.
const NORM_MOMENTUM: f32 = 0.1;

/// The transpose of a matrix of `cols` columns; both lie in memory row by row.
fn transposed(values: &[f32], cols: usize) -> Vec<f32> {
    let rows = values.len() / cols.max(1);
    let mut out = vec![0.0; values.len()];
    for (r, row) in values.chunks_exact(cols).enumerate() {
        row.iter().enumerate().for_each(|(c, &v)| out[c * rows + r] = v);
    }
    out
}

/// `out` = `keep` `out` + `a` `b`, all row by row; `out` has `cols` columns.
fn multiply(out: &mut [f32], cols: usize, a: &[f32], b: &[f32], keep: f32) {
    let (rows, inner) = (out.len() / cols.max(1), b.len() / cols.max(1));
    // The library reads matrices column by column, so it sees all of them transposed: out' = b' a'.
    let (a, b) = (DMatrixView::from_slice(a, inner, rows), DMatrixView::from_slice(b, cols, inner));
    DMatrixViewMut::from_slice(out, cols, rows).gemm(1.0, &b, &a, keep);
}

/// The scalar products of all rows of `a` with all rows of `b`, all of length `dim`; `[a][b]`.
pub fn products(a: &[f32], b: &[f32], dim: usize) -> Vec<f32> {
    let cols = b.len() / dim.max(1);
    let mut out = vec![0.0; a.len() / dim.max(1) * cols];
    multiply(&mut out, cols, a, &transposed(b, dim), 0.0);
    out
}

/// A network of dense layers. Between two of them are a batch norm, if wanted, and a ReLU.
#[derive(Debug, Clone, PartialEq)]
pub struct Net {
    sizes: Vec<usize>,
    norm: bool,
    /// Of each layer the weights `[out][in]`, the biases, and where a norm follows its gains and shifts.
    pub parameters: Vec<f32>,
    /// Running means and variances of each norm.
    running: Vec<[Vec<f32>; 2]>,
}

/// What [`Net::forward`] leaves for [`Net::backward`].
pub struct Trace {
    /// What goes into each layer, and last what comes out of the net; `[rows][size]`.
    pub values: Vec<Vec<f32>>,
    /// Of each norm its normalised inputs and one over their deviations.
    normalised: Vec<(Vec<f32>, Vec<f32>)>,
    /// Of each norm the means and variances of the batch.
    moments: Vec<[Vec<f32>; 2]>,
}

impl Trace {
    /// What comes out; `[rows][size]`.
    pub fn output(&self) -> &[f32] {
        self.values.last().map_or(&[], Vec::as_slice)
    }
}

impl Net {
    /// A net of these sizes, input first. Weights and biases are uniform within one over the root of a layer's inputs.
    pub fn new(sizes: &[usize], norm: bool, rng: &mut impl RngExt) -> Self {
        let mut parameters = Vec::new();
        let mut running = Vec::new();
        for (at, pair) in sizes.windows(2).enumerate() {
            let bound = 1.0 / (pair[0].max(1) as f32).sqrt();
            parameters.extend((0..(pair[0] + 1) * pair[1]).map(|_| rng.random_range(-bound..=bound)));
            if norm && at + 2 < sizes.len() {
                parameters.extend(std::iter::repeat_n(1.0, pair[1]).chain(std::iter::repeat_n(0.0, pair[1])));
                running.push([vec![0.0; pair[1]], vec![1.0; pair[1]]]);
            }
        }
        Self { sizes: sizes.to_vec(), norm, parameters, running }
    }

    /// Whether a norm follows a layer.
    fn norm_follows(&self, layer: usize) -> bool {
        self.norm && layer + 2 < self.sizes.len()
    }

    /// Where the weights, biases, gains and shifts of each layer begin, and where they end.
    fn layout(&self) -> Vec<[usize; 5]> {
        let mut begin = 0;
        let of_layer = |at: usize| {
            let (inputs, outputs) = (self.sizes[at], self.sizes[at + 1]);
            let extra = if self.norm_follows(at) { outputs } else { 0 };
            let bias = begin + inputs * outputs;
            let all = [begin, bias, bias + outputs, bias + outputs + extra, bias + outputs + 2 * extra];
            begin = all[4];
            all
        };
        (0..self.sizes.len() - 1).map(of_layer).collect()
    }

    /// Runs the net on rows of inputs. In `training` a norm takes the moments of the batch, else the running ones.
    pub fn forward(&self, input: &[f32], training: bool) -> Trace {
        let mut trace = Trace { values: vec![input.to_vec()], normalised: Vec::new(), moments: Vec::new() };
        let layout = self.layout();
        for (layer, &[weight, bias, gain, shift, end]) in layout.iter().enumerate() {
            let (inputs, outputs) = (self.sizes[layer], self.sizes[layer + 1]);
            let x = &trace.values[layer];
            let mut y = self.parameters[bias..gain].repeat(x.len() / inputs);
            multiply(&mut y, outputs, x, &transposed(&self.parameters[weight..bias], inputs), 1.0);
            if self.norm_follows(layer) {
                let [mean, variance] =
                    if training { moments(&y, outputs) } else { self.running[trace.moments.len()].clone() };
                let inverse: Vec<f32> = variance.iter().map(|v| 1.0 / (v + NORM_EPSILON).sqrt()).collect();
                let (gains, shifts) = (&self.parameters[gain..shift], &self.parameters[shift..end]);
                let mut normalised = y.clone();
                for (n, y) in normalised.chunks_exact_mut(outputs).zip(y.chunks_exact_mut(outputs)) {
                    for c in 0..outputs {
                        n[c] = (n[c] - mean[c]) * inverse[c];
                        y[c] = gains[c] * n[c] + shifts[c];
                    }
                }
                trace.normalised.push((normalised, inverse));
                trace.moments.push([mean, variance]);
            }
            if layer + 1 < layout.len() {
                y.iter_mut().for_each(|v| *v = v.max(0.0));
            }
            trace.values.push(y);
        }
        trace
    }

    /// The derivatives by the inputs, from those by the outputs; those by the parameters go to `gradient`. The trace is one in
    /// training.
    pub fn backward(&self, trace: &Trace, outputs: Vec<f32>, gradient: &mut [f32]) -> Vec<f32> {
        let mut g = outputs;
        let mut norms = trace.normalised.len();
        let layout = self.layout();
        for (layer, &[weight, bias, gain, shift, end]) in layout.iter().enumerate().rev() {
            let (inputs, outputs) = (self.sizes[layer], self.sizes[layer + 1]);
            if layer + 1 < layout.len() {
                g.iter_mut().zip(&trace.values[layer + 1]).for_each(|(g, &y)| *g = if y > 0.0 { *g } else { 0.0 });
            }
            if self.norm_follows(layer) {
                norms -= 1;
                let (normalised, inverse) = &trace.normalised[norms];
                let (mut by_gain, mut by_shift) = (vec![0.0; outputs], vec![0.0; outputs]);
                for (g, n) in g.chunks_exact(outputs).zip(normalised.chunks_exact(outputs)) {
                    for c in 0..outputs {
                        by_gain[c] += g[c] * n[c];
                        by_shift[c] += g[c];
                    }
                }
                let rows = (g.len() / outputs) as f32;
                let gains = &self.parameters[gain..shift];
                for (g, n) in g.chunks_exact_mut(outputs).zip(normalised.chunks_exact(outputs)) {
                    for c in 0..outputs {
                        let spread = g[c] - (by_shift[c] + n[c] * by_gain[c]) / rows;
                        g[c] = gains[c] * inverse[c] * spread;
                    }
                }
                gradient[gain..shift].copy_from_slice(&by_gain);
                gradient[shift..end].copy_from_slice(&by_shift);
            }
            let x = &trace.values[layer];
            let by_weight = &mut gradient[weight..bias];
            multiply(by_weight, inputs, &transposed(&g, outputs), x, 0.0);
            let by_bias = &mut gradient[bias..gain];
            by_bias.fill(0.0);
            g.chunks_exact(outputs).for_each(|row| by_bias.iter_mut().zip(row).for_each(|(b, g)| *b += g));
            let mut by_input = vec![0.0; x.len()];
            multiply(&mut by_input, inputs, &g, &self.parameters[weight..bias], 0.0);
            g = by_input;
        }
        g
    }

    /// Lets the running moments follow those of a batch in training of `rows` rows.
    pub fn follow(&mut self, trace: &Trace, rows: usize) {
        let unbiased = rows as f32 / (rows.max(2) - 1) as f32;
        for (running, batch) in self.running.iter_mut().zip(&trace.moments) {
            for (which, factor) in [(0, 1.0), (1, unbiased)] {
                for (r, b) in running[which].iter_mut().zip(&batch[which]) {
                    *r += NORM_MOMENTUM * (factor * b - *r);
                }
            }
        }
    }
}

/// Mean and variance of each column.
fn moments(values: &[f32], cols: usize) -> [Vec<f32>; 2] {
    let rows = (values.len() / cols).max(1) as f32;
    let mut mean = vec![0.0; cols];
    values.chunks_exact(cols).for_each(|row| mean.iter_mut().zip(row).for_each(|(m, v)| *m += v / rows));
    let mut variance = vec![0.0; cols];
    for row in values.chunks_exact(cols) {
        (0..cols).for_each(|c| variance[c] += (row[c] - mean[c]).powi(2) / rows);
    }
    [mean, variance]
}

/// Brings each row to unit length and returns their lengths. A row of length zero stays.
pub fn unit_rows(values: &mut [f32], dim: usize) -> Vec<f32> {
    let unit = |row: &mut [f32]| {
        let length = row.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-9);
        row.iter_mut().for_each(|v| *v /= length);
        length
    };
    values.chunks_exact_mut(dim).map(unit).collect()
}

/// Derivatives by rows before [`unit_rows`], from those by the unit rows, in place.
pub fn through_unit(gradient: &mut [f32], units: &[f32], lengths: &[f32], dim: usize) {
    for ((g, u), length) in gradient.chunks_exact_mut(dim).zip(units.chunks_exact(dim)).zip(lengths) {
        let along: f32 = g.iter().zip(u).map(|(g, u)| g * u).sum();
        g.iter_mut().zip(u).for_each(|(g, u)| *g = (*g - along * u) / length);
    }
}

/// Adam.
#[derive(Debug, Clone)]
pub struct Adam {
    rate: f32,
    epsilon: f32,
    /// Share of a parameter that a step at rate 1 takes off (AdamW).
    decay: f32,
    first: Vec<f32>,
    second: Vec<f32>,
    steps: i32,
}

impl Adam {
    /// For `count` parameters.
    pub fn new(count: usize, rate: f32, epsilon: f32, decay: f32) -> Self {
        Self { rate, epsilon, decay, first: vec![0.0; count], second: vec![0.0; count], steps: 0 }
    }

    /// A step.
    pub fn step(&mut self, parameters: &mut [f32], gradient: &[f32]) {
        self.steps = self.steps.saturating_add(1);
        let [c1, c2] = [0.9f64, 0.999].map(|b| (1.0 - b.powi(self.steps)) as f32);
        let (rate, root, epsilon) = (self.rate / c1, 1.0 / c2.sqrt(), self.epsilon);
        let keep = 1.0 - self.rate * self.decay;
        let moments = self.first.iter_mut().zip(&mut self.second);
        for ((p, &g), (m, v)) in parameters.iter_mut().zip(gradient).zip(moments) {
            *m = 0.9 * *m + 0.1 * g;
            *v = 0.999 * *v + 0.001 * g * g;
            *p = keep * *p - rate * *m / (v.sqrt() * root + epsilon);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn a_net_is_its_formula() {
        let mut net = Net::new(&[2, 2, 1], false, &mut ChaCha8Rng::seed_from_u64(0));
        // Hidden: relu(x + 2 y - 1), relu(-x + 0.5); output: 3 a - b + 0.25.
        net.parameters = vec![1.0, 2.0, -1.0, 0.0, -1.0, 0.5, 3.0, -1.0, 0.25];
        // (1, 1): 2 and 0 (from -0.5), so 6.25. (0, 0): 0 (from -1) and 0.5, so -0.25.
        assert_eq!(net.forward(&[1.0, 1.0, 0.0, 0.0], true).output(), [6.25, -0.25]);
    }

    #[test]
    fn a_norm_takes_the_batch_in_training_and_what_it_learnt_after() {
        let mut net = Net::new(&[1, 1, 1], true, &mut ChaCha8Rng::seed_from_u64(0));
        net.parameters = vec![1.0, 0.0, 2.0, 1.0, 1.0, 0.0];
        // Inputs 1 and 3: mean 2, variance 1, so -1 and 1; times 2 plus 1: -1 and 3; the ReLU takes the first.
        let trace = net.forward(&[1.0, 3.0], true);
        assert!(trace.output()[0] == 0.0 && (trace.output()[1] - 3.0).abs() < 1e-4);
        net.follow(&trace, 2);
        // Running mean 0.1 * 2 = 0.2, variance 0.9 + 0.1 * 2 (unbiased) = 1.1: (1 - 0.2) / sqrt(1.1) * 2 + 1 = 2.5255.
        assert!((net.forward(&[1.0], false).output()[0] - 2.5255).abs() < 1e-3);
    }

    #[test]
    fn gradients_are_finite_differences() {
        for norm in [false, true] {
            let mut rng = ChaCha8Rng::seed_from_u64(3);
            let mut net = Net::new(&[3, 5, 4, 2], norm, &mut rng);
            let input: Vec<f32> = (0..18).map(|_| rng.random_range(-1.0..1.0)).collect();
            let goal: Vec<f32> = (0..12).map(|_| rng.random_range(-1.0..1.0)).collect();
            // The scalar product of the unit outputs with the goal.
            let loss = |net: &Net, input: &[f32]| {
                let mut y = net.forward(input, true).output().to_vec();
                unit_rows(&mut y, 2);
                y.iter().zip(&goal).map(|(y, g)| f64::from(y * g)).sum::<f64>()
            };
            let trace = net.forward(&input, true);
            let mut units = trace.output().to_vec();
            let lengths = unit_rows(&mut units, 2);
            let mut g = goal.clone();
            through_unit(&mut g, &units, &lengths, 2);
            let mut gradient = vec![0.0; net.parameters.len()];
            let by_input = net.backward(&trace, g, &mut gradient);
            let step = 1e-3;
            let close = |a: f32, b: f64| assert!((f64::from(a) - b).abs() < 5e-3 * b.abs().max(1.0), "{a} {b} {norm}");
            for at in 0..gradient.len() {
                let was = net.parameters[at];
                let [up, down] = [step, -step].map(|s| {
                    net.parameters[at] = was + s;
                    loss(&net, &input)
                });
                net.parameters[at] = was;
                close(gradient[at], (up - down) / f64::from(2.0 * step));
            }
            for at in 0..input.len() {
                let [up, down] = [step, -step].map(|s| {
                    let mut moved = input.clone();
                    moved[at] += s;
                    loss(&net, &moved)
                });
                close(by_input[at], (up - down) / f64::from(2.0 * step));
            }
        }
    }

    #[test]
    fn adams_first_step_is_its_rate_whatever_the_gradient() {
        let mut p = [1.0, 1.0, 1.0];
        Adam::new(3, 0.1, 1e-15, 0.0).step(&mut p, &[5.0, -1e-6, 0.0]);
        assert!((p[0] - 0.9).abs() < 1e-6 && (p[1] - 1.1).abs() < 1e-6 && p[2] == 1.0, "{p:?}");
        // With decay a step takes rate times decay off first: 1 - 0.1 * 0.5 = 0.95.
        Adam::new(3, 0.1, 1e-15, 0.5).step(&mut p[2..], &[0.0]);
        assert!((p[2] - 0.95).abs() < 1e-6);
    }

    #[test]
    fn products_are_scalar_products() {
        assert_eq!(products(&[1.0, 2.0, 3.0, 4.0], &[1.0, 0.0, 1.0, 1.0], 2), [1.0, 3.0, 3.0, 7.0]);
    }
}
