//! Adam (Kingma and Ba), dense: parameters without a gradient are updated by their momentum, as in the original.

use super::real::Real;
use rayon::prelude::*;

/// Decay of the mean of gradients.
const BETA1: f64 = 0.9;
/// Decay of the mean of squared gradients.
const BETA2: f64 = 0.999;
/// Added to the root (OpenGaussian's value).
const EPSILON: f64 = 1e-15;
/// Means below this become zero: without a gradient they would decay into denormal numbers, which are slow.
const TINY: f64 = 1e-30;
/// So are mean squares below this.
const TINY_SQUARE: f64 = 1e-37;
/// Parameters updated at a time.
const CHUNK: usize = 16_384;

/// The rate with the first moment's bias taken out, and the root of that of the second; `step` counts from 1.
fn corrected(rate: f64, step: u64) -> (f64, f64) {
    let power = |beta: f64| 1.0 - beta.powi(step.min(1 << 30) as i32);
    (rate / power(BETA1), power(BETA2).sqrt())
}

/// State of the optimiser for one array of parameters.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Adam<T> {
    /// Mean of gradients.
    pub mean: Vec<T>,
    /// Mean of squared gradients.
    pub square: Vec<T>,
}

impl<T: Real> Adam<T> {
    /// For `count` parameters.
    pub fn new(count: usize) -> Self {
        Self { mean: vec![T::default(); count], square: vec![T::default(); count] }
    }

    /// One update; `step` counts from 1.
    pub fn update(&mut self, parameters: &mut [T], gradient: &[T], rate: f64, step: u64) {
        let (rate, root) = corrected(rate, step);
        let (b1, b2) = (T::of(BETA1), T::of(BETA2));
        let (c1, c2) = (T::of(1.0 - BETA1), T::of(1.0 - BETA2));
        parameters
            .par_chunks_mut(CHUNK)
            .zip(self.mean.par_chunks_mut(CHUNK))
            .zip(self.square.par_chunks_mut(CHUNK))
            .zip(gradient.par_chunks(CHUNK))
            .for_each(|(((p, m), v), g)| {
                for i in 0..p.len() {
                    m[i] = b1 * m[i] + c1 * g[i];
                    v[i] = b2 * v[i] + c2 * g[i] * g[i];
                    if v[i].get() < TINY_SQUARE {
                        v[i] = T::default();
                    }
                    let mean = m[i].get();
                    if mean.abs() < TINY {
                        m[i] = T::default();
                        continue;
                    }
                    p[i] += T::of(-rate * mean / (v[i].get().sqrt() / root + EPSILON));
                }
            });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn follows_the_recurrence_and_keeps_moving_without_gradient() {
        let mut adam = Adam::<f64>::new(1);
        let mut p = [1.0];
        adam.update(&mut p, &[0.5], 0.1, 1);
        assert!((p[0] - 0.9).abs() < 1e-12, "the first step has the size of the rate");
        adam.update(&mut p, &[0.0], 0.1, 2);
        let (m, v): (f64, f64) = (0.9 * 0.05 / (1.0 - 0.81), 0.999 * 0.00025 / (1.0 - 0.998_001));
        assert!((p[0] - (0.9 - 0.1 * m / v.sqrt())).abs() < 1e-12);
    }
}
